"""Hits on rough ground: the first crossing of a ray with the height function of its face."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from geoscene.mesh import Mesh
from geoscene.typing import Float
from lidar.raycast.columns import Rays
from lidar.raycast.hits import Hits
from lidar.raycast.memory import called, inlined
from lidar.raycast.rays import share
from lidar.relief.lines import beyond_plane, direction_of, origin_of
from lidar.relief.roughness import BLOCK, KINDS, NODES, STEP, kinds_of, roughness

_DEPTH, _SLOPE = 5, 6
"""Columns of `Roughness.kinds`."""

_LEAST = 5e-4
"""Metres along the plane that a step among joints covers at least; dips shorter than that can be missed."""

_STEPS = 4096
_NARROWINGS = 60
"""Steps towards the surface at most, and narrowings of the step that crosses it."""

_PAST = 1e-7
"""Cells by which a step goes past the border of a cell."""

_DIFFERENCE = 1e-3
"""Metres to both sides over which the slope of joints is measured, so that normals in them point upwards."""

_CLOSE = 1e-8
"""Metres from the surface at which a crossing is found."""


class GroundTables(NamedTuple):
    """Rough faces of loaded tiles.

    kind  : (m,) int8, row of `Roughness.kinds` of each face, -1 for faces without roughness
    plane : (m, 3) float64, a, b, c of the plane z = a x + b y + c, scene metres
    """

    kind: NDArray[np.int8]
    plane: Float


def ground_tables(mesh: Mesh, *, origin: Float) -> GroundTables:
    """The tables of a tile with its origin (3,) in scene metres."""
    kind = kinds_of(mesh)
    plane = np.zeros((len(mesh), 3))
    rows = np.flatnonzero(kind >= 0)
    if len(rows):
        part = mesh.take(rows)
        normal = part.normals()
        corner = part.vertices[part.faces[:, 0]] + origin
        plane[rows, :2] = -normal[:, :2] / normal[:, 2:]
        plane[rows, 2] = corner[:, 2] - (plane[rows, :2] * corner[:, :2]).sum(axis=1)
    return GroundTables(kind, plane)


def joined_ground(tables: Mapping[int, GroundTables], *, count: int) -> GroundTables:
    """The tables of several tiles, by the number of each one's first face; ``count`` faces in all."""
    kind, plane = np.full(count, -1, np.int8), np.zeros((count, 3))
    for first, table in tables.items():
        kind[first : first + len(table.kind)] = table.kind
        plane[first : first + len(table.kind)] = table.plane
    return GroundTables(kind, plane)


class GroundRefiner:
    """Refines hits on rough ground; see `lidar.raycast.refine`.

    tables : of the loaded tiles, with scene coordinates
    """

    def __init__(self, tables: GroundTables) -> None:
        self.tables = tables
        self._rough = roughness()

    def refine(self, rays: Rays, hits: Hits, *, threads: int) -> None:
        """Change hits on rough ground in place, as `lidar.raycast.refine.Refiner.refine` describes."""
        columns = hits.range, hits.face, hits.instance, hits.cosine, hits.normal
        tables, rough = self.tables, self._rough

        def work(low: int, high: int) -> int:
            _refine(tables, rough, rays, low, high, columns)
            return -1

        share(work, rays, threads=threads)

    def leave(self, rays: Rays, on: NDArray[np.int32], hits: Hits) -> Float:
        """Follow rays that start below the plane of a face, as `lidar.raycast.refine.Refiner.leave` says."""
        at = np.zeros(len(on))
        columns = hits.range, hits.face, hits.instance, hits.cosine, hits.normal
        _leave(self.tables, self._rough, rays, on, columns, at)
        return at


def heights(kind: str, xy: Float) -> Float:
    """Heights (n,) of a kind of ground at places (n, 2), scene metres, relative to the plane: 0 or less."""
    out = np.empty(len(xy))
    _heights(roughness(), list(KINDS).index(kind), np.ascontiguousarray(xy, np.float64), out)
    return out


@inlined
def _cell(rough: Any, f: int, u: float, v: float) -> Any:
    """Block of a place in cells, the place in its cell, and the surface there, a + p u + q v + r u v."""
    field = rough.field
    fu, fv = np.floor(u), np.floor(v)
    last = np.uint64(NODES - 1)
    i, j = np.uint64(np.int64(fu)) & last, np.uint64(np.int64(fv)) & last
    k, m = (i + np.uint64(1)) & last, (j + np.uint64(1)) & last
    row, next_row = i * np.uint64(NODES), k * np.uint64(NODES)
    a = np.float64(field[f, row + j])
    p, q = np.float64(field[f, next_row + j]) - a, np.float64(field[f, row + m]) - a
    r = np.float64(field[f, next_row + m]) - a - p - q
    block = (i >> np.uint64(1)) * np.uint64(NODES // BLOCK) + (j >> np.uint64(1))
    return block, u - fu, v - fv, a, p, q, r


@inlined
def _joint(length: float, width: float, joint: float, deep: float, x: float, y: float) -> Any:
    """Height among stones in stretcher bond: 0 on top, ``-deep`` in the middle of joints."""
    row = np.floor(y / width)
    v = y - row * width
    u = x + (0.5 * length if np.int64(row) & 1 else 0.0)
    u -= np.floor(u / length) * length
    edge = min(u, length - u, v, width - v)
    return -deep * max(1.0 - 2.0 * edge / joint, 0.0)


@inlined
def _joints(rough: Any, k: int, x: float, y: float) -> Any:
    """Height of a kind with stones above its waves."""
    kinds = rough.kinds
    return _joint(kinds[k, 1], kinds[k, 2], kinds[k, 3], kinds[k, 4], x, y)


@called
def _height(rough: Any, k: int, x: float, y: float) -> Any:
    _, u, v, a, p, q, r = _cell(rough, rough.number[k], x / STEP, y / STEP)
    h = rough.kinds[k, 0] * (a + p * u + q * v + r * u * v)
    return h + _joints(rough, k, x, y) if rough.kinds[k, 1] > 0.0 else h


@inlined
def _slopes(rough: Any, k: int, x: float, y: float) -> Any:
    """Slopes of `_height` along x and y."""
    _, u, v, _, p, q, r = _cell(rough, rough.number[k], x / STEP, y / STEP)
    factor = rough.kinds[k, 0] / STEP
    sx, sy = factor * (p + r * v), factor * (q + r * u)
    if rough.kinds[k, 1] > 0.0 and _joints(rough, k, x, y) < 0.0:
        d = _DIFFERENCE
        sx += (_joints(rough, k, x + d, y) - _joints(rough, k, x - d, y)) / (2.0 * d)
        sy += (_joints(rough, k, x, y + d) - _joints(rough, k, x, y - d)) / (2.0 * d)
    return sx, sy


@njit(cache=True, nogil=True, error_model="numpy")
def _heights(rough: Any, k: int, xy: Any, out: Any) -> None:
    for i in range(len(out)):
        out[i] = _height(rough, k, xy[i, 0], xy[i, 1])


@inlined
def _gap(rough: Any, k: int, place: Any, way: Any, t: float) -> Any:
    """Metres of a ray above the surface at a parameter."""
    return place[2] + t * way[2] - _height(rough, k, place[0] + t * way[0], place[1] + t * way[1])


@called
def _narrowed(rough: Any, k: int, place: Any, way: Any, low: Any, high: Any) -> Any:
    """The crossing between two parameters with the gaps there, by false position (Illinois)."""
    (a, above), (b, below) = low, high
    side = 0
    for _ in range(_NARROWINGS):
        t = (a * below - b * above) / (below - above)
        if not a < t < b:
            return b if t >= b else a
        gap = _gap(rough, k, place, way, t)
        if gap > 0.0:
            a, above = t, gap
            if gap < _CLOSE:
                return a
            if side > 0:
                below *= 0.5
            side = 1
        else:
            b, below = t, gap
            if side < 0:
                above *= 0.5
            side = -1
    return a


@called
def _among_joints(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """Ray parameter of the first crossing of the surface by a ray that is below the top of the stones.

    Steps are so short that the greatest slope cannot reach the ray within them, but for those of `_LEAST`
    metres.
    """
    dx, dy, dz = way
    across = np.sqrt(dx * dx + dy * dy)
    closing = across * rough.kinds[k, _SLOPE] + abs(dz)
    shortest = _LEAST / max(across, abs(dz))
    t, gap = start, _gap(rough, k, place, way, start)
    if gap <= 0.0:
        return t
    for _ in range(_STEPS):
        ahead = min(t + max(gap / closing, shortest), end)
        there = _gap(rough, k, place, way, ahead)
        if there <= 0.0:
            return _narrowed(rough, k, place, way, (t, gap), (ahead, there))
        if ahead >= end:
            return np.inf
        t, gap = ahead, there
    return t


@called
def _in_joint(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """`_crossing` of a ray that is below the top of the stones at ``start``."""
    t = _among_joints(rough, k, place, way, start, end)
    sx, sy = 0.0, 0.0
    if t < np.inf:
        sx, sy = _slopes(rough, k, place[0] + t * way[0], place[1] + t * way[1])
    return t, sx, sy


@inlined
def _inverse(way: float) -> Any:
    """One over a change; for none a number so great that no border is reached."""
    return 1.0 / way if way != 0.0 else 1e300


@inlined
def _in_cell(gap: float, falls: float, bend: float) -> Any:
    """Least parameter at which gap + falls t + bend t^2 is zero, ``gap`` above 0; inf for none."""
    under = falls * falls - 4.0 * bend * gap
    if under < 0.0:
        return np.inf
    over = np.sqrt(under) - falls
    return 2.0 * gap / over if over > 0.0 else np.inf


@inlined
def _on_field(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """Ray parameter of the first crossing of the field of a kind from above (inf: none), and its slopes.

    A step goes as far as no place ahead of the ray's block can rise to the ray (a cone step, after Dummer
    2006). Within a cell the surface is bilinear, and the crossing the root of a quadratic equation.
    """
    f, factor = rough.number[k], rough.kinds[k, 0]
    scale = 1.0 / factor
    x, y, z = place[0] / STEP, place[1] / STEP, place[2] * scale
    dx, dy, dz = way[0] / STEP, way[1] / STEP, way[2] * scale
    speed = max(abs(dx), abs(dy))
    towards = (2 if dx < 0.0 else 0) + (1 if dy < 0.0 else 0)
    end_x, end_y = (1.0 if dx >= 0.0 else 0.0), (1.0 if dy >= 0.0 else 0.0)
    over_x, over_y = _inverse(dx), _inverse(dy)
    unit, past, t = rough.unit[f] * speed, _PAST / speed, start
    u, v, p, q, r = 0.0, 0.0, 0.0, 0.0, 0.0
    found = np.inf
    for _ in range(_STEPS):
        block, u, v, a, p, q, r = _cell(rough, f, x + t * dx, y + t * dy)
        gap = z + t * dz - (a + p * u + q * v + r * u * v)
        if gap <= 0.0:
            found = t
            break
        closing = unit * np.float64(rough.steep[f, towards, block]) - dz
        if closing <= 0.0:
            break
        step, border = gap / closing, min((end_x - u) * over_x, (end_y - v) * over_y)
        if step < border:
            falls = dz - (p * dx + q * dy + r * (u * dy + v * dx))
            root = _in_cell(gap, falls, -r * dx * dy)
            if root <= border:
                t += root
                if t <= end:
                    found, u, v = t, u + root * dx, v + root * dy
                break
            step = border + past
        t += step
        if t >= end:
            break
    slope = factor / STEP
    return found, slope * (p + r * v), slope * (q + r * u)


@inlined
def _crossing(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """Ray parameter of the first crossing from above between two parameters, and the surface's slopes there.

    place : x, y and height above the plane at parameter 0
    way   : change of each per parameter

    The parameter is inf without a crossing.
    """
    t, sx, sy = _on_field(rough, k, place, way, start, end)
    if rough.kinds[k, 1] > 0.0 and t < np.inf:
        x, y = place[0] + t * way[0], place[1] + t * way[1]
        if _joints(rough, k, x, y) < 0.0:
            return _in_joint(rough, k, place, way, t, end)
    return t, sx, sy


@inlined
def _on_plane(plane: Any, f: int, origin: Any, direction: Any) -> Any:
    """A ray relative to the plane of a face: x, y and height at parameter 0, and their changes."""
    a, b, c = plane[f, 0], plane[f, 1], plane[f, 2]
    x, y, z = origin
    dx, dy, dz = direction
    return (x, y, z - (a * x + b * y + c)), (dx, dy, dz - (a * dx + b * dy))


@inlined
def _write(tables: Any, t: float, f: int, slope: Any, direction: Any, columns: Any, i: int) -> None:
    """Write a hit on a surface with such slopes against the plane."""
    distance, face, instance, cosine, normal = columns
    nx, ny = -tables.plane[f, 0] - slope[0], -tables.plane[f, 1] - slope[1]
    squared = nx * nx + ny * ny + 1.0
    dx, dy, dz = direction
    across = -(dx * nx + dy * ny + dz) / np.sqrt(squared * (dx * dx + dy * dy + dz * dz))
    distance[i], face[i], instance[i] = t, f, -1
    # A ray that grazes the edge of a dip may seem to come from behind.
    cosine[i] = max(across, 1e-3)
    if len(normal) > 0:
        z = 1.0 / np.sqrt(squared)
        normal[i, 0], normal[i, 1], normal[i, 2] = nx * z, ny * z, z


@inlined
def _refine_one(tables: Any, rough: Any, rays: Any, i: int, columns: Any) -> None:
    distance, face, instance, cosine, normal = columns
    f = face[i]
    if f < 0 or instance[i] >= 0 or cosine[i] <= 0.0:
        return
    k = tables.kind[f]
    if k < 0:
        return
    direction = direction_of(rays, i)
    place, way = _on_plane(tables.plane, f, origin_of(rays, i), direction)
    if not way[2] < 0.0:
        return
    t = distance[i]
    # The height counts from the hit on the face, so that no ray slips between it and the plane.
    x, y, z = place[0], place[1], -t * way[2]
    end = t - rough.kinds[k, _DEPTH] / way[2]
    s, sx, sy = _crossing(rough, k, (x, y, z), way, t, end)
    s = min(s, end)
    if s > rays.far[i if len(rays.far) > 1 else 0]:
        distance[i], face[i], instance[i], cosine[i] = np.inf, -1, -1, 0.0
        if len(normal) > 0:
            normal[i, 0], normal[i, 1], normal[i, 2] = 0.0, 0.0, 0.0
        return
    _write(tables, s, f, (sx, sy), direction, columns, i)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(tables: Any, rough: Any, rays: Any, low: int, high: int, columns: Any) -> None:
    """Refine the hits ``low`` to ``high`` in the order of work."""
    order = rays.order
    for j in range(low, high):
        _refine_one(tables, rough, rays, order[j] if len(order) > 0 else j, columns)


@inlined
def _leave_one(tables: Any, rough: Any, rays: Any, f: int, i: int, columns: Any) -> Any:
    """Ray parameter at which a ray that starts below a plane crosses it; 0 and inf as in `_leave`."""
    k = tables.kind[f]
    if k < 0:
        return 0.0
    direction = direction_of(rays, i)
    place, way = _on_plane(tables.plane, f, origin_of(rays, i), direction)
    near = rays.near
    z = place[2] + near * way[2]
    depth = rough.kinds[k, _DEPTH]
    if z >= 0.0 or z < -2.0 * depth:
        return 0.0
    end = near + (-z / way[2] if way[2] > 0.0 else (-depth - z) / min(way[2], -1e-12))
    s, sx, sy = _crossing(rough, k, place, way, near, max(end, near))
    if s == np.inf and way[2] > 0.0:
        return end + beyond_plane(way[2], direction)
    s = min(s, end)
    if not s > rays.far[i if len(rays.far) > 1 else 0]:
        _write(tables, s, f, (sx, sy), direction, columns, i)
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _leave(tables: Any, rough: Any, rays: Any, on: Any, columns: Any, at: Any) -> None:
    """Fill ``at``: 0 for a ray that starts above its plane, inf for one that stays below it."""
    for i in range(len(on)):
        if on[i] >= 0:
            at[i] = _leave_one(tables, rough, rays, on[i], i, columns)
