"""Unions of the solids of a building; faces that nearly touch are parted."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import manifold3d as m3
import numpy as np
import shapely

from geoscene.buildings.footprints import to_grid
from geoscene.buildings.shells import ShellTriangles
from geoscene.geometry.intersections import (
    close_faces,
    common_corners,
    distances,
    intersecting_faces,
    plan_axes,
)
from geoscene.geometry.mesh import WALL
from geoscene.geometry.watertight import (
    GRID,
    check_solids,
    degenerate_faces,
    edge_uses,
    grid_cells,
    near_vertices,
    vertex_fans,
    weld,
)
from geoscene.support.graphs import components
from geoscene.typing import Float, Ints

SEAMS = (1e-2, 1e-2, 3e-2)
"""Sizes of the beads that join bodies of a building which only touch each other, metres, one attempt after
another."""

_TOLERANCE = 2e-3
"""Metres by which surfaces of a union may move where that removes short edges."""

_MERGE = 15
"""Grid steps; vertices of a union that are closer are merged, which leaves none within a millimetre."""

_MOVES = np.array([move for move in itertools.product((-1, 0, 1), repeat=3) if any(move)])
"""Grid steps by which a vertex can move at once."""


def unite(
    buildings: Sequence[ShellTriangles], cuts: Sequence[Sequence[ShellTriangles]]
) -> list[tuple[ShellTriangles, str] | None]:
    """Union of each building's closed shells, with a note if beads were added; None if it is no solid.

    Faces keep their piece and surface.

    cuts : for each building the closed shells that are cut out of it, each with the piece of its faces
    """
    unions = [_Union.of(*each) for each in zip(buildings, cuts, strict=True)]
    drafts = [(union, *union.triangles()) for union in unions if union is not None]
    owner = np.repeat(np.arange(len(drafts)), [len(corners) for _, corners, _ in drafts])
    corners = np.concatenate([np.empty((0, 3, 3)), *(corners for _, corners, _ in drafts)])
    fine = check_solids(corners, owner, n=len(drafts)).ok
    made = (
        (union.result(corners, run), "") if ok else _mend(union)
        for (union, corners, run), ok in zip(drafts, fine, strict=True)
    )
    return [None if union is None else next(made) for union in unions]


@dataclass(frozen=True, slots=True)
class _Union:
    """The union of the pieces of a building.

    body   : manifold relative to the origin
    pieces : (k,) their numbers
    first  : id of the first piece's first surface; each piece has 4
    origin : (3,) metres
    """

    body: Any
    pieces: Ints
    first: int
    origin: Float

    @classmethod
    def of(cls, shells: ShellTriangles, cuts: Sequence[ShellTriangles]) -> _Union | None:
        """Union of closed shells minus the cuts; None if one of them or the result is not manifold."""
        pieces = np.unique(shells.piece)
        first = m3.Manifold.reserve_ids(4 * len(pieces))
        # boolean operations lose digits far from the origin, so coordinates are relative to a corner
        origin = to_grid(shells.corners.reshape(-1, 3).min(axis=0))
        bodies, hollows = (
            [
                _manifold(one, first=first + 4 * int(np.searchsorted(pieces, one.piece[0])), origin=origin)
                for one in some
            ]
            for some in ([shells.take(shells.piece == piece) for piece in pieces], cuts)
        )
        if any(body is None for body in (*bodies, *hollows)):
            return None
        body = m3.Manifold.batch_boolean(bodies, m3.OpType.Add)
        if hollows:
            body = m3.Manifold.batch_boolean([body, *hollows], m3.OpType.Subtract)
        return cls(body, pieces, first, origin) if _is_solid(body) else None

    def joined(self, beads: Sequence[Any]) -> _Union | None:
        """The union with further bodies; None if it is no manifold."""
        body = m3.Manifold.batch_boolean([self.body, *beads], m3.OpType.Add)
        return replace(self, body=body) if _is_solid(body) else None

    def triangles(self, *, tolerance: float = 0.0) -> tuple[Float, Ints]:
        """Corners (m, 3, 3) of the body's triangles, repaired on the grid, and their ids minus ``first``.

        tolerance : metres by which surfaces may move where that removes short edges
        """
        body = self.body.simplify(tolerance) if tolerance else self.body
        mesh = body.to_mesh64()
        faces = mesh.tri_verts.astype(np.int64)
        run = np.repeat(np.asarray(mesh.run_original_id, np.int64), np.diff(mesh.run_index) // 3) - self.first
        points = to_grid(mesh.vert_properties[:, :3])
        ids, where = weld(points, np.zeros(len(points), np.int64))
        points = points[where]
        return _without_slivers(*repair(points, merged_vertices(points)[ids[faces]], run=run))

    def result(self, corners: Float, run: Ints) -> ShellTriangles:
        """Triangles with their pieces and surfaces; those of beads are walls of the first piece."""
        known = (run >= 0) & (run < 4 * len(self.pieces))
        piece = self.pieces[np.where(known, run // 4, 0)]
        return ShellTriangles(
            to_grid(corners + self.origin), piece, np.where(known, run % 4, WALL).astype(np.uint8)
        )


def _without_slivers(corners: Float, run: Ints) -> tuple[Float, Ints]:
    """Triangles (m, 3, 3) and their ids without shells that are thinner than surfaces may move.

    Rounding leaves such shells, bodies and cavities, where walls of pieces nearly coincide.
    """
    ids, _ = weld(corners.reshape(-1, 3), np.zeros(3 * len(corners), np.int64))
    faces = ids.reshape(-1, 3)
    n = ids.max(initial=-1) + 1
    links = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    shell = components(*links, count=n)[faces[:, 0]]
    a, b, c = corners.transpose(1, 0, 2)
    volume = np.bincount(shell, weights=np.vecdot(a, np.cross(b, c)) / 6)
    area = np.bincount(shell, weights=np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    thick = (np.abs(volume) > _TOLERANCE * area / 2)[shell]
    return corners[thick], run[thick]


def _mend(union: _Union) -> tuple[ShellTriangles, str] | None:
    """A union with a fault, its faces parted, simplified, or with beads where it touches itself.

    None if that does not help.
    """
    note = ""
    for reach in (*SEAMS, None):
        for tolerance in (0.0, _TOLERANCE):
            corners, run = union.triangles(tolerance=tolerance)
            fine = _without_faults(corners)
            if fine is not None:
                return union.result(fine, run), note
        seams = _seams(corners)
        if reach is None or not seams:
            break
        joined = union.joined([_bead(points, reach=reach) for points in seams])
        if joined is None:
            break
        union = joined
        note = f"{len(seams)} places where bodies only touched, joined by beads of {1e3 * reach:.0f} mm"
    return None


def _is_solid(body: Any) -> bool:
    return body.status() == m3.Error.NoError and not body.is_empty()


def _without_faults(corners: Float) -> Float | None:
    """Triangles (m, 3, 3), with close faces parted, if they bound a solid without faults, else None."""
    owner = np.zeros(len(corners), np.int64)
    found = check_solids(corners, owner, n=1)
    if found.valid[0] and not found.ok[0]:
        corners = part(corners)
        found = check_solids(corners, owner, n=1)
    return corners if found.ok[0] else None


def _manifold(shell: ShellTriangles, *, first: int, origin: Float) -> Any:
    """A closed shell as a manifold whose faces have the id ``first`` plus surface; None if it is no solid."""
    order = np.argsort(shell.surface, kind="stable")
    corners, surface = shell.corners[order].reshape(-1, 3) - origin, shell.surface[order]
    ids, where = weld(corners, np.zeros(len(corners), np.int64))
    kinds, starts = np.unique(surface, return_index=True)
    mesh = m3.Mesh64(
        vert_properties=np.ascontiguousarray(corners[where]),
        tri_verts=np.ascontiguousarray(ids.reshape(-1, 3).astype(np.uint64)),
        run_index=(3 * np.r_[starts, len(surface)]).astype(np.uint64),
        run_original_id=first + kinds.astype(np.uint32),
    )
    body = m3.Manifold(mesh)
    return body if _is_solid(body) else None


def merged_vertices(points: Float) -> Ints:
    """For each point (n,) the first of those that a chain of steps shorter than 1.5 mm connects with it."""
    n = len(points)
    pairs = near_vertices(grid_cells(points), np.zeros(n, np.int64), steps=_MERGE)
    if not len(pairs):
        return np.arange(n)
    cluster = components(*pairs.T, count=n)
    first = np.unique(cluster, return_index=True)[1]
    out: Ints = first[cluster]
    return out


def repair(points: Float, faces: Ints, *, run: Ints) -> tuple[Float, Ints]:
    """Corners (m, 3, 3) and ids of triangles, without those that rounding has made degenerate.

    Faces with two equal corners are removed; faces with three collinear corners are merged into the neighbour
    at their longest edge. A closed surface stays closed.
    """
    distinct = (faces != np.roll(faces, -1, axis=1)).all(axis=1)
    faces, run = _cancel(faces[distinct], run[distinct])
    for _ in range(64):
        flat = np.flatnonzero(degenerate_faces(points, faces))
        if not len(flat):
            break
        faces, run = _cancel(*_split_flat_face(points, faces, run=run, flat=int(flat[0])))
    return points[faces], run


def _cancel(faces: Ints, run: Ints) -> tuple[Ints, Ints]:
    """Faces without pairs that have the same three vertices in opposite order and so enclose no volume."""
    turned = np.take_along_axis(faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    low, high = np.sort(turned[:, 1:], axis=1).T
    size = faces.max(initial=0) + 1
    _, edge = np.unique(low * size + high, return_inverse=True)
    _, triple = np.unique(edge * size + turned[:, 0], return_inverse=True)
    sided, last = np.unique((2 * triple + (turned[:, 1] == low))[::-1], return_index=True)
    opposite = last[np.isin(sided ^ 1, sided)]
    keep = np.ones(len(faces), np.bool_)
    keep[len(faces) - 1 - opposite] = False
    return faces[keep], run[keep]


def _split_flat_face(points: Float, faces: Ints, *, run: Ints, flat: int) -> tuple[Ints, Ints]:
    """Faces without the collinear face ``flat``: its middle corner splits the face at its longest edge."""
    corners = faces[flat]
    length = np.linalg.norm(points[np.roll(corners, -1)] - points[corners], axis=1)
    k = int(np.argmax(length))
    a, b, middle = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
    other = np.flatnonzero(((faces == b) & (np.roll(faces, -1, axis=1) == a)).any(axis=1))
    if not len(other):
        return np.delete(faces, flat, axis=0), np.delete(run, flat)
    beyond = int(other[0])
    apex = int(faces[beyond][(faces[beyond] != a) & (faces[beyond] != b)][0])
    out, runs = faces.copy(), run.copy()
    out[beyond] = (b, middle, apex)
    out[flat] = (middle, a, apex)
    runs[flat] = run[beyond]
    return out, runs


def _seams(corners: Float) -> list[Float]:
    """Points (k, 3) of each place where a surface touches itself.

    These are the ends of edges of more than two triangles and vertices of several fans; if there are no such
    edges, also what else two faces have in common.
    """
    flat = corners.reshape(-1, 3)
    ids, where = weld(flat, np.zeros(len(flat), np.int64))
    faces, points = ids.reshape(-1, 3), flat[where]
    edge, uses, _ = edge_uses(faces)
    crowded = np.flatnonzero(uses > 2)
    half = np.full(len(uses), -1)
    half[edge[::-1]] = np.arange(len(edge))[::-1]
    face, k = half[crowded] // 3, half[crowded] % 3
    edges = np.stack([faces[face, k], faces[face, (k + 1) % 3]], axis=1)
    alone = np.setdiff1d(vertex_fans(faces), edges)
    if len(edges):
        return [*points[edges], *points[alone[:, None]]]
    pair = intersecting_faces(grid_cells(points), faces, owner=np.zeros(len(faces), np.int64))
    return [*points[alone[:, None]], *_contacts(points[faces[pair[:, 0]]], points[faces[pair[:, 1]]])]


def _contacts(first: Float, second: Float) -> list[Float]:
    """Points (k, 3) that pairs of triangles (n, 3, 3) have in common, or nearly so: corners and piercings."""
    found = []
    for one, two in ((first, second), (second, first)):
        axes = plan_axes(two)[:, None]
        normal = np.cross(two[:, 1] - two[:, 0], two[:, 2] - two[:, 0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        away = np.einsum("nij,nj->ni", one - two[:, :1], normal)
        beyond = np.roll(away, -1, axis=1)
        crosses = away * beyond < 0
        share = np.divide(away, away - beyond, out=np.zeros_like(away), where=crosses)
        piercing = one + share[..., None] * (np.roll(one, -1, axis=1) - one)
        points = np.concatenate([one, piercing], axis=1)
        shadow = shapely.polygons(np.take_along_axis(two, axes, axis=2))
        aside = shapely.distance(shapely.points(np.take_along_axis(points, axes, axis=2)), shadow[:, None])
        near = np.concatenate([np.abs(away) < _TOLERANCE, crosses], axis=1) & (aside < _TOLERANCE)
        found.append(np.where(near[..., None], points, np.nan))
    common = np.concatenate(found, axis=1)
    return [points[~np.isnan(points[:, 0])] for points in common if not np.isnan(points[:, 0]).all()]


def _bead(points: Float, *, reach: float) -> Any:
    """A convex body around points (k, 3), enlarged by ``reach`` metres on all sides."""
    # rotated, so that its corners lie well off the planes through the points that walls and floors have
    turn = np.array([[0.762, -0.323, 0.561], [0.561, 0.762, -0.323], [-0.323, 0.561, 0.762]])
    star = np.vstack([turn, -turn]) * reach
    return m3.Manifold.hull_points((points[:, None] + star).reshape(-1, 3))


def part(corners: Float) -> Float:
    """Triangles (m, 3, 3) of a closed surface with some vertices moved, so that fewer faces are close.

    Each move is by a grid step, or a diagonal of one, and leaves fewer pairs of close faces.
    """
    ids, first = weld(corners.reshape(-1, 3), np.zeros(3 * len(corners), np.int64))
    faces, cells = ids.reshape(-1, 3), grid_cells(corners.reshape(-1, 3)[first])
    pairs = _close(cells, faces)
    while pairs is not None and len(pairs):
        for vertex, move in _moves(cells, faces, pairs=pairs):
            moved = cells.copy()
            moved[vertex] += move
            left = _close(moved, faces)
            if left is not None and len(left) < len(pairs):
                cells, pairs = moved, left
                break
        else:
            break
    return to_grid(np.asarray(cells * GRID, float))[faces]


def _close(cells: Ints, faces: Ints) -> Ints | None:
    """Pairs (k, 2) of close faces; None if faces cross or touch."""
    pairs, crossing = close_faces(cells, faces, owner=np.zeros(len(faces), np.int64))
    return None if crossing.any() else pairs


def _moves(cells: Ints, faces: Ints, *, pairs: Ints) -> list[tuple[int, Ints]]:
    """Vertices of the closest of pairs (k, 2) of faces and their moves, those that part it most first."""
    same = common_corners(*faces[pairs].transpose(1, 0, 2))
    closest = int(np.argmin(distances(*cells[faces[pairs]].transpose(1, 0, 2, 3), same=same)))
    pair = faces[pairs[closest]]
    vertices = np.repeat(np.setxor1d(*pair), len(_MOVES))
    moves = np.tile(_MOVES, (len(vertices) // len(_MOVES), 1))
    moving = (pair[:, None] == vertices[:, None])[..., None]
    moved = cells[pair][:, None] + moving * moves[:, None]
    apart = distances(*moved, same=np.repeat(same[:, :, [closest]], len(vertices), axis=2))
    order = np.argsort(-apart, kind="stable")
    return list(zip(vertices[order].tolist(), moves[order], strict=True))
