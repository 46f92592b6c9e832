"""Facades as closed geometry: walls with openings, panels, sills, reveals, frames, bars and panes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.description import Openings, WallRelief
from geoscene.buildings.shells import triangulate
from geoscene.geometry.mesh import DOOR, WALL, WINDOW, Mesh, concatenate
from geoscene.geometry.watertight import edge_uses, weld
from geoscene.support.columns import Columns, nth
from geoscene.typing import Bools, Float, Ints

_OF_WALL = 255
"""Material of faces of a template that have the material and colour of their wall."""


@dataclass(frozen=True, slots=True)
class _Template:
    """One kind of opening as triangles, with a rectangular rim in the plane of the wall.

    corners  : (t, 3, 3) x and y in the cell, and the depth behind the wall
    material : (t,) uint8, ``_OF_WALL`` for the wall's
    color    : (t, 3) uint8
    surface  : (t,) uint8, codes of `geoscene.geometry.mesh`
    rim      : (4,) left, lower, right and upper edge
    """

    corners: Float
    material: NDArray[np.uint8]
    color: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    rim: Float


def relief_mesh(mesh: Mesh, relief: WallRelief) -> Mesh:
    """The mesh of a tile with its facades as geometry; solids stay closed, without T-junctions.

    Faces of walls with openings are replaced, all others are kept.
    """
    if not len(relief.facades):
        return mesh
    cells = _Placed.of(relief)
    rings = outlines(mesh, relief.wall, count=len(relief.facades))
    facing, done = _pierced_walls(mesh, relief, outlines=rings, cells=cells)
    kept = (relief.wall < 0) | ~done[relief.wall]
    templates = [_template(relief.openings, k) for k in range(len(relief.openings))]
    insets = _insets(mesh, relief, cells=cells.take(done[cells.wall]), templates=templates)
    return _weld([mesh.take(kept), facing, insets])


@dataclass(frozen=True, slots=True)
class _Placed(Columns):
    """Openings of the walls, sorted by wall.

    wall   : (n,) int64
    kind   : (n,) int64 row of `Openings`
    corner : (n, 2) lower left corner of the cell from the foot of the wall
    rim    : (n, 4) edges of the opening in the plane of the wall, from the foot of the wall
    """

    wall: Ints
    kind: Ints
    corner: Float
    rim: Float

    @classmethod
    def of(cls, relief: WallRelief) -> _Placed:
        facades = relief.facades
        sizes = facades.grid.prod(axis=1).astype(np.int64)
        wall = np.repeat(np.arange(len(facades)), sizes)
        place = nth(sizes)
        row, column = np.divmod(place, facades.grid[wall, 0])
        kind = relief.cells[facades.first[wall] + place].astype(np.int64)
        up = np.where(row > 0, facades.ground[wall] + (row - 1) * facades.cell[wall, 1], 0.0)
        corner = facades.start[wall] + np.column_stack([column * facades.cell[wall, 0], up])
        some = kind >= 0
        wall, kind, corner = wall[some], kind[some], corner[some]
        return cls(wall, kind, corner, np.tile(corner, (1, 2)) + _rims(relief.openings)[kind])


def _rims(openings: Openings) -> Float:
    """The hole (t, 4) in the wall: the panel, or the opening where the panel has no depth."""
    return np.where(openings.panel_depth[:, None] > 0, openings.panel, openings.opening)


def outlines(mesh: Mesh, of_face: NDArray[np.int32], *, count: int) -> list[list[Ints] | None]:
    """Rings of each wall (count,) as vertices of the mesh, in the order seen from outside.

    None stands for an outline that touches itself, which cannot be cut in one way only.

    of_face : (m,) wall of each face, -1 for none
    """
    vertex, start, stop, of = _open_edges(mesh, of_face)
    order = np.lexsort((start, of))
    start, stop, of = start[order], stop[order], of[order]
    cuts = np.searchsorted(of, np.arange(count + 1))
    return [
        _rings(start[a:b] % len(vertex), stop[a:b] % len(vertex), vertex=vertex)
        for a, b in pairwise(cuts.tolist())
    ]


def are_simple(mesh: Mesh, of_face: NDArray[np.int32], *, count: int) -> Bools:
    """Whether the outline of each wall (count,) does not touch itself: `outlines` has rings of it."""
    _, start, stop, of = _open_edges(mesh, of_face)
    order = np.argsort(start, kind="stable")
    start, of = start[order], of[order]
    # of rings, each vertex is one edge's start and one edge's stop; vertices have numbers of their wall
    odd = (np.sort(stop) != start) | (np.diff(start, prepend=-1) == 0)
    return np.asarray(np.bincount(of[odd], minlength=count) == 0, np.bool_)


def _open_edges(mesh: Mesh, of_face: NDArray[np.int32]) -> tuple[NDArray[np.int32], Ints, Ints, Ints]:
    """Vertices (v,) of walls, and edges (n,) of one face of a wall: start and stop, and the wall.

    Starts and stops are rows of the vertices plus v times the wall.
    """
    face = np.flatnonzero(of_face >= 0)
    wall = of_face[face].astype(np.int64)
    # one vertex has one number in each wall
    vertex, faces = np.unique(mesh.faces[face].ravel(), return_inverse=True)
    own = wall[:, None] * len(vertex) + faces.reshape(-1, 3)
    edge, uses, _ = edge_uses(own)
    open_ = uses[edge] == 1
    return vertex, own.ravel()[open_], np.roll(own, -1, axis=1).ravel()[open_], np.repeat(wall, 3)[open_]


def _rings(start: Ints, stop: Ints, *, vertex: NDArray[np.int32]) -> list[Ints] | None:
    """Closed rings of vertices from directed edges; None if two edges start at one vertex."""
    following = dict(zip(start.tolist(), stop.tolist(), strict=True))
    if len(following) < len(start):
        return None
    rings = []
    while following:
        first = next(iter(following))
        ring, at = [first], following.pop(first)
        while at != first:
            if at not in following:
                return None
            ring.append(at)
            at = following.pop(at)
        rings.append(vertex[np.array(ring)].astype(np.int64))
    return rings


def _pierced_walls(
    mesh: Mesh, relief: WallRelief, *, outlines: list[list[Ints] | None], cells: _Placed
) -> tuple[Mesh, Bools]:
    """Faces of the walls without their holes, and which walls (k,) could be made so."""
    facades = relief.facades
    cuts = np.searchsorted(cells.wall, np.arange(len(facades) + 1))
    polygons = np.full(len(facades), None, object)
    points, places = dict[int, Float](), dict[int, Float]()
    for w, rings in enumerate(outlines):
        if not rings:  # touches itself, or has no face
            continue
        rims = cells.rim[cuts[w] : cuts[w + 1]]
        holes = rims[:, [[0, 1], [0, 3], [2, 3], [2, 1]]]
        ids = np.concatenate(rings)
        xyz = mesh.vertices[ids]
        uv = np.column_stack(
            [(xyz[:, :2] - facades.foot[w, :2]) @ facades.tangent[w], xyz[:, 2] - facades.foot[w, 2]]
        )
        ends = np.cumsum([len(ring) for ring in rings])[:-1]
        shells = sorted(np.split(uv, ends), key=lambda ring: -np.ptp(ring, axis=0).prod())
        polygons[w] = shapely.Polygon(shells[0], [*shells[1:], *holes])
        corners = holes.reshape(-1, 2)
        points[w] = np.concatenate([uv, corners])
        places[w] = np.concatenate([xyz, _on_wall(relief, np.full(len(corners), w), point=corners)])
    made = np.flatnonzero(polygons != None)  # noqa: E711 - element by element
    made = made[shapely.is_valid(polygons[made])]
    xy, owner = triangulate(polygons[made])
    wall = made[owner]
    corners = np.empty((len(xy), 3, 3))
    bounds = np.searchsorted(wall, np.arange(len(facades) + 1))
    done = np.zeros(len(facades), np.bool_)
    for w in np.unique(wall).tolist():
        some = slice(bounds[w], bounds[w + 1])
        found = _looked_up(xy[some].reshape(-1, 2), points[w])
        corners[some] = places[w][found].reshape(-1, 3, 3)
        done[w] = True
    return _faces_like(mesh, _face_of(relief)[wall], corners=corners), done


def _looked_up(wanted: Float, points: Float) -> Ints:
    """Index (n,) of each wanted point (n, 2) among points, which hold it exactly."""
    keys = points[:, 0] + 1j * points[:, 1]
    order = np.argsort(keys, kind="stable")
    return order[np.searchsorted(keys[order], wanted[:, 0] + 1j * wanted[:, 1])]


def _faces_like(mesh: Mesh, row: Ints, *, corners: Float) -> Mesh:
    """Faces with the given corners (m, 3, 3) and the attributes of faces (m,) of a mesh."""
    return Mesh.of(
        corners.reshape(-1, 3),
        np.arange(3 * len(row)).reshape(-1, 3),
        feature=mesh.feature[row],
        klass=mesh.klass[row],
        material=mesh.material[row],
        surface=mesh.surface[row],
        color=mesh.color[row],
        closed=mesh.closed[row],
    )


def _on_wall(relief: WallRelief, wall: Ints, *, point: Float) -> Float:
    """Points (n, 3) on the grid of 0.1 mm at x and y on walls (n,) and, if given, at depths behind them."""
    facades = relief.facades
    tangent = facades.tangent[wall]
    xyz = facades.foot[wall] + np.column_stack([point[:, :1] * tangent, point[:, 1]])
    if point.shape[1] > 2:
        xyz[:, :2] += point[:, 2:] * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    return np.round(xyz, 4)


def _insets(mesh: Mesh, relief: WallRelief, *, cells: _Placed, templates: list[_Template]) -> Mesh:
    """The faces of all openings."""
    sizes = np.array([len(template.surface) for template in templates], np.int64)
    first = np.cumsum(sizes) - sizes
    count = sizes[cells.kind]
    of = np.repeat(np.arange(len(cells)), count)
    at = first[cells.kind[of]] + nth(count)
    corners = np.concatenate([np.empty((0, 3, 3)), *(t.corners for t in templates)])[at]
    material = np.concatenate([np.empty(0, np.uint8), *(t.material for t in templates)])[at]
    color = np.concatenate([np.empty((0, 3), np.uint8), *(t.color for t in templates)])[at]
    surface = np.concatenate([np.empty(0, np.uint8), *(t.surface for t in templates)])[at]
    corners[:, :, :2] += cells.corner[of][:, None]
    wall = cells.wall[of]
    placed = _on_wall(relief, np.repeat(wall, 3), point=corners.reshape(-1, 3)).reshape(-1, 3, 3)
    made = _faces_like(mesh, _face_of(relief)[wall], corners=placed)
    own = material == _OF_WALL
    return replace(
        made,
        material=np.where(own, made.material, material),
        color=np.where(own[:, None], made.color, color),
        surface=surface,
    )


def _face_of(relief: WallRelief) -> Ints:
    """A face (k,) of each wall, for what all have in common."""
    face = np.flatnonzero(relief.wall >= 0)
    out = np.zeros(len(relief.facades), np.int64)
    out[relief.wall[face]] = face
    return out


def _weld(parts: list[Mesh]) -> Mesh:
    """The parts as one mesh, sorted by solids and surfaces; faces of one solid share vertices."""
    whole = concatenate(parts)
    bodies = whole.take(np.flatnonzero(whole.closed)[np.argsort(whole.feature[whole.closed], kind="stable")])
    corners = bodies.vertices[bodies.faces].reshape(-1, 3)
    ids, first = weld(corners, np.repeat(bodies.feature, 3))
    bodies = replace(bodies, vertices=corners[first], faces=ids.reshape(-1, 3).astype(np.int32))
    return concatenate([bodies, whole.take(~whole.closed)])


def _template(openings: Openings, k: int) -> _Template:
    """The triangles of a kind of opening."""
    rim = _rims(openings)[k]
    regions = _regions(openings, k)
    lines = shapely.node(shapely.union_all([shapely.boundary(r.shape) for r in regions]))
    cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(lines)))
    inside = shapely.point_on_surface(cells)
    region = np.full(len(cells), -1, np.int64)
    for n, r in enumerate(regions):
        region[shapely.contains(r.shape, inside)] = n
    cells, region = cells[region >= 0], region[region >= 0]
    depth = np.array([r.depth for r in regions])
    xy, owner = triangulate(cells)
    flat = np.concatenate([xy, np.broadcast_to(depth[region[owner], None, None], (len(xy), 3, 1))], axis=2)
    sides, front = _sides(xy, depth[region[owner]], region=region[owner], outside=len(regions))
    regions.append(_Region(shapely.Polygon(), 0.0, _OF_WALL, (0, 0, 0), WALL))
    of = np.concatenate([region[owner], front])
    return _Template(
        np.concatenate([flat, sides]),
        np.array([r.material for r in regions], np.uint8)[of],
        np.array([r.color for r in regions], np.uint8).reshape(-1, 3)[of],
        np.array([r.surface for r in regions], np.uint8)[of],
        rim,
    )


@dataclass(frozen=True, slots=True)
class _Region:
    """A part of an opening at one depth."""

    shape: shapely.Geometry
    depth: float
    material: int
    color: tuple[int, ...]
    surface: int


def _regions(openings: Openings, k: int) -> list[_Region]:
    """The parts of an opening by depth: sill, panel, frame with bars, and panes."""
    depth = [float(d[k]) for d in (openings.panel_depth, openings.reveal_depth, openings.pane_depth)]
    color = [tuple(c[k].tolist()) for c in (openings.trim_color, openings.frame_color, openings.infill_color)]
    opening = shapely.box(*openings.opening[k])
    left, low, right, high = openings.opening[k] + openings.frame[k] * np.array([1, 1, -1, -1])
    half = openings.bar[k] / 2
    upright, level = (
        np.linspace(*ends, int(number) + 2)[1:-1]
        for ends, number in zip(((left, right), (low, high)), openings.bars[k], strict=True)
    )
    bars = [shapely.box(x - half, low, x + half, high) for x in upright]
    bars += [shapely.box(left, y - half, right, y + half) for y in level]
    panes = shapely.difference(shapely.box(left, low, right, high), shapely.union_all(bars))
    surface = DOOR if openings.door[k] else WINDOW
    found = [
        _Region(panes, depth[2], int(openings.infill[k]), color[2], surface),
        _Region(
            shapely.difference(opening, panes), depth[1], int(openings.frame_material[k]), color[1], surface
        ),
    ]
    if depth[0] > 0:
        panel = shapely.difference(shapely.box(*openings.panel[k]), opening)
        sill = openings.sill[k]
        if sill[2] > sill[0]:
            found.append(_Region(shapely.box(*sill), 0.0, int(openings.trim[k]) or _OF_WALL, color[0], WALL))
            panel = shapely.difference(panel, shapely.box(*sill))
        found.append(_Region(panel, depth[0], _OF_WALL, (0, 0, 0), WALL))
    return [r for r in found if not shapely.is_empty(r.shape)]


def _sides(xy: Float, depth: Float, *, region: Ints, outside: int) -> tuple[Float, Ints]:
    """Triangles (s, 3, 3) between parts of different depth, and the part (s,) in front, whose look they have.

    xy      : (t, 3, 2) triangles of all parts, which meet edge to edge
    depth   : (t,) of each
    region  : (t,) part of each; ``outside`` is that of the wall around them, at depth 0
    """
    ids, first = weld(np.pad(xy.reshape(-1, 2), ((0, 0), (0, 1))), np.zeros(3 * len(xy), np.int64))
    place, corner = xy.reshape(-1, 2)[first], ids.reshape(-1, 3)
    edge, uses, _ = edge_uses(corner)
    start, stop = corner.ravel(), np.roll(corner, -1, axis=1).ravel()
    face = np.repeat(np.arange(len(xy)), 3)
    halves = np.split(np.argsort(edge, kind="stable"), np.cumsum(uses)[:-1])
    levels = [set[float]() for _ in place]
    for vertex, value in zip(start.tolist(), depth[face].tolist(), strict=True):
        levels[vertex].add(value)
    for half in (mine[0] for mine in halves if len(mine) == 1):
        levels[start[half]].add(0.0)
        levels[stop[half]].add(0.0)
    out, front = [], []
    for mine in halves:
        half = max(mine.tolist(), key=lambda h: depth[face[h]])
        others = [h for h in mine.tolist() if h != half]
        ahead = depth[face[others[0]]] if others else 0.0
        ends = [
            [(*place[v].tolist(), d) for d in sorted(levels[v]) if ahead <= d <= depth[face[half]]]
            for v in (start[half], stop[half])
        ]
        made = _zip_lines(*ends)
        out += made
        front += [int(region[face[others[0]]]) if others else outside] * len(made)
    return np.array(out, float).reshape(-1, 3, 3), np.array(front, np.int64)


_Line = list[tuple[float, ...]]


def _zip_lines(left: _Line, right: _Line) -> list[_Line]:
    """Triangles between two lines of points from front to back; seen from the space, ``left`` is left."""
    out, i, j = [], 0, 0
    while i + 1 < len(left) or j + 1 < len(right):
        if j + 1 == len(right) or (i + 1 < len(left) and left[i + 1][2] <= right[j + 1][2]):
            out.append([left[i], right[j], left[i + 1]])
            i += 1
        else:
            out.append([left[i], right[j], right[j + 1]])
            j += 1
    return out
