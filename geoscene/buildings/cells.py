"""Roof surfaces as triangles in plan with a height field: from skeletons, cut along contour lines."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.footprints import Polygons, to_grid
from geoscene.buildings.shells import distinct_corners, lift, triangulate
from geoscene.buildings.skeleton import Skeleton, loops, polygons_of
from geoscene.geometry.watertight import edge_uses, weld
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints

ON_LINE = 1e-3
"""Corners closer to a contour line than this count as on it, which avoids slivers; metres of the field."""


@dataclass(frozen=True, slots=True)
class RoofCells(Columns):
    """Triangles of a footprint in plan and a continuous field, linear on each triangle.

    xy    : (m, 3, 2) metres on the grid, counter-clockwise
    field : (m, 3) metres
    face  : (m,) int64, triangles with the same number lie in one plane
    """

    xy: Float
    field: Float
    face: Ints


def sloped_cells(polygons: Polygons, direction: Float) -> RoofCells:
    """The Delaunay triangles of polygons (n,), each of one face, with the field xy . direction (n, 2)."""
    xy, owner = triangulate(polygons)
    parts = zip(np.split(xy, _ends(owner, len(polygons))[:-1]), direction, strict=True)
    return RoofCells(xy, np.concatenate([np.empty((0, 3)), *(part @ way for part, way in parts)]), owner)


def _ends(owner: Ints, count: int) -> Ints:
    """End (count,) of each owner's rows among rows sorted by owner."""
    return np.searchsorted(owner, np.arange(count), side="right")


def cut(cells: RoofCells, level: float | Float) -> RoofCells:
    """The cells, split along the contour lines of a level, or of one each (m,).

    A face k becomes 2 k below the line and 2 k + 1 above it.
    """
    level = np.broadcast_to(level, len(cells))
    side = cells.field - level[:, None]
    side = np.where(np.abs(side) < ON_LINE, 0.0, side)
    sign = np.sign(side)
    crossed = (sign.min(axis=1) < 0) & (sign.max(axis=1) > 0)
    above = (sign.max(axis=1) > 0).astype(np.int64)
    if not crossed.any():
        return replace(cells, face=2 * cells.face + above)
    whole = RoofCells(cells.xy[~crossed], cells.field[~crossed], (2 * cells.face + above)[~crossed])
    xy, field, sign, face = cells.xy[crossed], cells.field[crossed], sign[crossed], 2 * cells.face[crossed]
    # rotate the corners of each triangle: first comes the one alone on its side, or the one on the line
    on_line = (sign == 0).any(axis=1)
    alone = np.where(
        on_line, np.argmax(sign == 0, axis=1), np.argmax(sign * -np.sign(sign.sum(axis=1))[:, None], axis=1)
    )
    turn = (alone[:, None] + np.arange(3)) % 3
    rows = np.arange(len(xy))[:, None]
    xy, field = xy[rows, turn], field[rows, turn]
    a, b, c = (xy[:, k] for k in range(3))
    fa, fb, fc = (field[:, k] for k in range(3))
    at = level[crossed]

    p = _crossing(b, c, fa=fb, fb=fc, level=at)
    q = _crossing(a, b, fa=fa, fb=fb, level=at)
    r = _crossing(a, c, fa=fa, fb=fc, level=at)
    t, u = on_line, ~on_line
    tip = (np.take_along_axis(sign, turn[:, :1], axis=1)[:, 0] > 0).astype(np.int64)
    first = (np.take_along_axis(sign, turn[:, 1:2], axis=1)[:, 0] > 0).astype(np.int64)
    parts = [
        (a[t], b[t], p[t], fa[t], fb[t], at[t], face[t] + first[t]),
        (a[t], p[t], c[t], fa[t], at[t], fc[t], face[t] + 1 - first[t]),
        (a[u], q[u], r[u], fa[u], at[u], at[u], face[u] + tip[u]),
        (q[u], b[u], c[u], at[u], fb[u], fc[u], face[u] + 1 - tip[u]),
        (q[u], c[u], r[u], at[u], fc[u], at[u], face[u] + 1 - tip[u]),
    ]
    pieces = [RoofCells(np.stack(x[:3], axis=1), np.stack(x[3:6], axis=1), x[6]) for x in parts]
    cut_cells = RoofCells.concatenate([whole, *pieces])
    return cut_cells.take(distinct_corners(cut_cells.xy))


def outlines(xy: Float, face: Ints, *, body: Ints, count: int) -> list[Polygons | None]:
    """For each body (count,) the unions of its triangles of one number, with all vertices on their edges.

    None if the edges do not form valid polygons, as when rounding to the grid has inverted a triangle.

    xy   : (m, 3, 2) triangles
    face : (m,) their numbers
    body : (m,) the body of each, ascending
    """
    ids, _ = weld(lift(xy, np.zeros(len(xy))).reshape(-1, 3), np.repeat(face, 3))
    edge, uses, _ = edge_uses(ids.reshape(-1, 3))
    open_ = np.flatnonzero(uses[edge] == 1)
    row, k = open_ // 3, open_ % 3
    ends = np.stack([ids[open_], ids[3 * row + (k + 1) % 3]], axis=1)
    points, face = xy[row, k], face[row]
    spans = pairwise([0, *_ends(body[row], count).tolist()])
    return [_join(ends[a:b], points[a:b], face=face[a:b]) for a, b in spans]


def _join(ends: Ints, points: Float, *, face: Ints) -> Polygons | None:
    """Polygons of edges between vertices (n, 2), each with its first point and face; None if invalid."""
    onward = {start: (stop, edge) for edge, (start, stop) in enumerate(ends.tolist())}
    if len(onward) < len(ends):
        return None
    rings: list[list[int]] = []
    while onward:
        first = at = next(iter(onward))
        ring = []
        while at in onward:
            at, edge = onward.pop(at)
            ring.append(edge)
        if at != first or len(ring) < 3:
            return None
        rings.append(ring)
    whole = polygons_of(points, rings)
    outer = shapely.is_ccw(shapely.get_exterior_ring(whole))
    of = face[[ring[-1] for ring in rings]]
    shells, owners = whole[outer], of[outer].tolist()
    for number, hole in zip(of[~outer].tolist(), whole[~outer], strict=True):
        inside = [k for k, o in enumerate(owners) if o == number and shells[k].covers(hole)]
        if len(inside) != 1:
            return None
        k = inside[0]
        shells[k] = shapely.Polygon(shells[k].exterior, [*shells[k].interiors, hole.exterior.coords[::-1]])
    return shapely.orient_polygons(shells) if shapely.is_valid(shells).all() else None


def fill(found: list[Polygons | None]) -> list[tuple[Float, Ints] | None]:
    """The triangles (k, 3, 2) of polygons of each body and the polygon of each; None for bodies without."""
    sizes = [0 if polygons is None else len(polygons) for polygons in found]
    first = np.cumsum([0, *sizes])
    xy, owner = triangulate(np.concatenate([np.empty(0, object), *(p for p in found if p is not None)]))
    cuts = np.searchsorted(owner, first)
    return [
        None if polygons is None else (xy[a:b], owner[a:b] - begin)
        for polygons, begin, a, b in zip(found, first[:-1], cuts[:-1], cuts[1:], strict=True)
    ]


def merge(cells: RoofCells, body: Ints, *, count: int) -> list[RoofCells]:
    """The cells of each body, each face triangulated again, which removes the slivers that many cuts leave.

    body : (m,) the body of each triangle, ascending
    """
    found = outlines(cells.xy, cells.face, body=body, count=count)
    out, spans = [], pairwise([0, *_ends(body, count).tolist()])
    for (a, b), polygons, made in zip(spans, found, fill(found), strict=True):
        own = cells.take(slice(a, b))
        if polygons is not None and made is not None and len(np.unique(made[1])) == len(polygons):
            xy, owner = made
            own = RoofCells(xy, _values_at(xy, own.xy.reshape(-1, 2), values=own.field.ravel()), owner)
        out.append(own)
    return out


def _values_at(xy: Float, known: Float, *, values: Float) -> Float:
    """Values (m, 3) at corners (m, 3, 2), each of which is one of the known grid points (n, 2)."""
    # distinct for grid points within 100 km of the origin
    key, wanted = (np.rint(p * 1e4).astype(np.int64) @ np.array([2**31, 1]) for p in (known, xy))
    order = np.argsort(key, kind="stable")
    found: Float = values[order][np.searchsorted(key[order], wanted)]
    return found


def _crossing(a: Float, b: Float, *, fa: Float, fb: Float, level: Float) -> Float:
    """Grid points where the field equals a level (n,) between a and b, the same if a and b are swapped."""
    swap = (a[:, 0] > b[:, 0]) | ((a[:, 0] == b[:, 0]) & (a[:, 1] > b[:, 1]))
    first, last = np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)
    f0, f1 = np.where(swap, fb, fa), np.where(swap, fa, fb)
    span = np.where(f1 == f0, 1.0, f1 - f0)
    part = np.clip((level - f0) / span, 0.0, 1.0)
    return to_grid(first + part[:, None] * (last - first))


def skeleton_cells(skeleton: Skeleton) -> RoofCells:
    """The faces of a skeleton as cells whose field is the distance from their edges."""
    xy = to_grid(skeleton.xy)
    key = np.rint(xy * 1e4).astype(np.int64)
    # nodes at the same grid point take the same height
    _, first, same = np.unique(key, axis=0, return_index=True, return_inverse=True)
    time = skeleton.time[first][same.ravel()]
    rings = _remove_pinches(xy, [_distinct(face, same.ravel()) for face in skeleton.faces])
    polygons = polygons_of(xy, [r for r in rings if len(r) > 2])
    polygons = polygons[shapely.area(polygons) > 0]
    triangles, owner = triangulate(polygons)
    missing = np.setdiff1d(np.arange(len(polygons)), owner)
    if len(missing):
        # ear clipping accepts any ring; whether the shell is closed is checked later
        clipped = [_clip_ears(shapely.get_coordinates(p)[:-1]) for p in polygons[missing]]
        triangles = np.concatenate([triangles, *clipped])
        owner = np.concatenate([owner, np.repeat(missing, [len(c) for c in clipped])])
    return RoofCells(triangles, _values_at(triangles, xy, values=time), owner)


def _remove_pinches(xy: Float, rings: list[list[int]]) -> list[list[int]]:
    """Rings (node numbers) without narrow parts that cross themselves or invert when rounded to the grid.

    If a node of a ring lies within 2 mm of another arc of the same ring, the node is inserted into that arc,
    in the neighbouring ring too, and the ring is split in two.
    """
    for _ in range(8 * len(rings)):
        rings = [r for r in rings if len(r) > 2]
        polygons = polygons_of(xy, rings)
        turned = ~shapely.is_ccw(shapely.get_exterior_ring(polygons))
        crossed = np.flatnonzero(turned | ~shapely.is_valid(polygons))
        found = _nearest_touch(xy, rings[crossed[0]]) if len(crossed) else None
        if found is None:
            break
        node, start, stop = found
        for i, ring in enumerate(rings):
            arcs = list(zip(ring, [*ring[1:], *ring[:1]], strict=True))
            for a, b in ((start, stop), (stop, start)):
                if (a, b) in arcs:
                    at = arcs.index((a, b)) + 1
                    rings[i], *more = loops([*ring[:at], node, *ring[at:]])
                    rings += more
    return rings


def _nearest_touch(xy: Float, ring: list[int]) -> tuple[int, int, int] | None:
    """The node of a ring that is nearest to an arc not ending in it, and the arc's ends, if within 2 mm."""
    start, stop = np.array(ring), np.array([*ring[1:], *ring[:1]])
    line = shapely.linestrings(np.stack([xy[start], xy[stop]], axis=1))
    distance = shapely.distance(shapely.points(xy[start])[:, None], line)
    own = (start[:, None] == start) | (start[:, None] == stop)
    near, arc = np.unravel_index(np.argmin(np.where(own, np.inf, distance)), distance.shape)
    if own.all() or distance[near, arc] > 2 * ON_LINE:
        return None
    return ring[near], int(start[arc]), int(stop[arc])


def _clip_ears(ring: Float) -> Float:
    """Triangles (k, 3, 2) of a ring (n, 2) by ear clipping."""
    from mapbox_earcut import triangulate_float64  # noqa: PLC0415 - rarely needed

    return np.asarray(ring[triangulate_float64(ring, np.array([len(ring)], np.uint32)).reshape(-1, 3)])


def _distinct(face: list[int], same: NDArray[np.integer]) -> list[int]:
    """The nodes of a ring without repetitions of the preceding node."""
    ids = same[face]
    return [node for node, a, b in zip(face, ids, np.roll(ids, 1), strict=True) if a != b]


def raise_gables(skeleton: Skeleton, share: float) -> Skeleton:
    """The skeleton with its hip ends turned into gables (share 1) or half-hips (share below 1).

    A hip end is a triangular face between two faces that share a ridge. Its peak is moved along the ridge
    towards the eave, and the eave is raised by the same share, so that all faces stay plane. Hip ends whose
    ridge would miss the eave, or that have no ridge, are left unchanged.
    """
    xy, time = [tuple(p) for p in skeleton.xy.tolist()], skeleton.time.tolist()
    faces = [list(f) for f in skeleton.faces]
    edges = [(k, f[0], f[1]) for k, f in enumerate(faces[: skeleton.corners]) if len(f) > 2]
    edge_from = {start: k for k, start, _ in edges}
    edge_to = {stop: k for k, _, stop in edges}
    for k in range(skeleton.corners):
        if len(faces[k]) != 3 or faces[k][2] < skeleton.corners:
            continue
        a, b, peak = faces[k]
        if a not in edge_to or b not in edge_from:
            continue
        left, right = faces[edge_to[a]], faces[edge_from[b]]
        if min(len(left), len(right)) < 4 or left[2] != peak or right[-1] != peak:
            continue
        beyond = left[3 % len(left)]
        ridge_end = (
            _ridge_end(xy, time, edge=(a, b), peak=peak, beyond=beyond) if right[-2] == beyond else None
        )
        if ridge_end is None:
            continue
        x, y, height = ridge_end
        new = len(xy)
        for start in (a, b, peak):
            (x0, y0), t0 = xy[start], time[start]
            xy.append((x0 + (x - x0) * share, y0 + (y - y0) * share))
            time.append(height * share if start != peak else t0 + (height - t0) * share)
        if share == 1.0:
            left[2:3], right[-1:], faces[k] = [new], [new], []
        else:
            left[2:3], right[-1:], faces[k] = [new, new + 2], [new + 2, new + 1], [new, new + 1, new + 2]
    return Skeleton(np.array(xy), np.array(time), [f for f in faces if f], skeleton.corners)


def _ridge_end(
    xy: list[tuple[float, ...]], time: list[float], *, edge: tuple[int, int], peak: int, beyond: int
) -> tuple[float, float, float] | None:
    """x, y and height where the ridge from ``beyond`` over ``peak`` intersects an edge, or None."""
    (px, py), (qx, qy) = xy[peak], xy[beyond]
    (ax, ay), (bx, by) = xy[edge[0]], xy[edge[1]]
    dx, dy, ex, ey = px - qx, py - qy, bx - ax, by - ay
    length, turn = math.hypot(dx, dy), ex * dy - ey * dx
    if length < 1e-3 or abs(turn) < 1e-9:
        return None
    steps = (ex * (ay - py) - ey * (ax - px)) / turn  # from the peak, in units of the ridge
    x, y = px + steps * dx, py + steps * dy
    part = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
    rise = time[peak] - time[beyond]
    height = time[peak] + rise * steps
    # an arc steeper than 0.3 is not a ridge
    if steps <= 0 or not 0.05 < part < 0.95 or abs(rise) > 0.3 * length or height <= 0:
        return None
    return x, y, height
