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
from lidar.raycast.memory import inlined
from lidar.raycast.rays import share
from lidar.relief.lines import direction_of, origin_of
from lidar.relief.roughness import BLOCK, KINDS, kinds_of, roughness

_DEPTH, _SLOPE, _WAVE_SLOPE = 6, 7, 8
"""Columns of `Roughness.kinds`."""

_LEAST, _LEAST_GRAINS, _LEAST_WAVES = 5e-4, 2e-3, 5e-3
"""Metres along the plane that a step covers at least: among joints, on grains (6 cm and more), and on waves
(10 cm and more); dips shorter than that can be missed."""

_STEPS = 4096
_NARROWINGS = 60
"""Steps towards the surface at most, and narrowings of the step that crosses it."""

_DIFFERENCE = 1e-3
"""Metres to both sides over which the slope of joints is measured, so that normals in them point upwards."""

_CLOSE = 1e-8
"""Metres from the surface at which a crossing is found."""

_OVER = 1e-3
"""Metres above the plane at which a ray from below it goes on: shadow rays keep as far off surfaces."""


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
def _cell(field: Any, step: float, x: float, y: float) -> Any:
    """Heights of a periodic field at the corners of the cell of a place, and the place in it, 0 to 1."""
    n = field.shape[0]
    u, v = x / step, y / step
    fu, fv = np.floor(u), np.floor(v)
    i, j = np.int64(fu) & (n - 1), np.int64(fv) & (n - 1)
    k, m = (i + 1) & (n - 1), (j + 1) & (n - 1)
    corners = (
        np.float64(field[i, j]),
        np.float64(field[k, j]),
        np.float64(field[i, m]),
        np.float64(field[k, m]),
    )
    return corners, u - fu, v - fv


@inlined
def _at(field: Any, step: float, x: float, y: float) -> Any:
    """Height of a periodic field at a place, bilinear between its nodes."""
    (a, b, c, d), u, v = _cell(field, step, x, y)
    return (a * (1.0 - u) + b * u) * (1.0 - v) + (c * (1.0 - u) + d * u) * v


@inlined
def _slope_at(field: Any, step: float, x: float, y: float) -> Any:
    """Slopes of `_at` along x and y."""
    (a, b, c, d), u, v = _cell(field, step, x, y)
    return ((b - a) * (1.0 - v) + (d - c) * v) / step, ((c - a) * (1.0 - u) + (d - b) * u) / step


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
def _waves(rough: Any, k: int, x: float, y: float) -> Any:
    """Height of the waves alone, of which grains and joints only take away."""
    return rough.kinds[k, 0] * _at(rough.road, rough.step[0], x, y)


@njit(cache=True, nogil=True, error_model="numpy")
def _height(rough: Any, k: int, x: float, y: float) -> Any:
    kinds = rough.kinds
    h = _waves(rough, k, x, y)
    if kinds[k, 1] > 0.0:
        h += kinds[k, 1] * _at(rough.grain, rough.step[1], x, y)
    if kinds[k, 2] > 0.0:
        h += _joint(kinds[k, 2], kinds[k, 3], kinds[k, 4], kinds[k, 5], x, y)
    return h


@njit(cache=True, nogil=True, error_model="numpy")
def _slopes(rough: Any, k: int, x: float, y: float) -> Any:
    """Slopes of `_height` along x and y."""
    kinds = rough.kinds
    p, q = _slope_at(rough.road, rough.step[0], x, y)
    sx, sy = kinds[k, 0] * p, kinds[k, 0] * q
    if kinds[k, 1] > 0.0:
        p, q = _slope_at(rough.grain, rough.step[1], x, y)
        sx, sy = sx + kinds[k, 1] * p, sy + kinds[k, 1] * q
    if kinds[k, 2] > 0.0:
        length, width, joint, deep = kinds[k, 2], kinds[k, 3], kinds[k, 4], kinds[k, 5]
        d = _DIFFERENCE
        p = _joint(length, width, joint, deep, x + d, y) - _joint(length, width, joint, deep, x - d, y)
        q = _joint(length, width, joint, deep, x, y + d) - _joint(length, width, joint, deep, x, y - d)
        sx, sy = sx + p / (2.0 * d), sy + q / (2.0 * d)
    return sx, sy


@njit(cache=True, nogil=True, error_model="numpy")
def _heights(rough: Any, k: int, xy: Any, out: Any) -> None:
    for i in range(len(out)):
        out[i] = _height(rough, k, xy[i, 0], xy[i, 1])


@inlined
def _gap(rough: Any, k: int, place: Any, way: Any, t: float, whole: bool) -> Any:  # noqa: FBT001
    """Metres of a ray above the surface, or above its waves alone, at a parameter."""
    x, y = place[0] + t * way[0], place[1] + t * way[1]
    h = _height(rough, k, x, y) if whole else _waves(rough, k, x, y)
    return place[2] + t * way[2] - h


@njit(cache=True, nogil=True, error_model="numpy")
def _narrowed(rough: Any, k: int, place: Any, way: Any, low: Any, high: Any, whole: bool) -> Any:  # noqa: FBT001
    """The crossing between two parameters with the gaps there, by false position (Illinois)."""
    (a, above), (b, below) = low, high
    side = 0
    for _ in range(_NARROWINGS):
        t = (a * below - b * above) / (below - above)
        if not a < t < b:
            return b if t >= b else a
        gap = _gap(rough, k, place, way, t, whole)
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


@njit(cache=True, nogil=True, error_model="numpy")
def _march(
    rough: Any,
    k: int,
    place: Any,
    way: Any,
    start: float,
    end: float,
    least: float,
    whole: bool,  # noqa: FBT001
) -> Any:
    """Ray parameter of the first crossing from above of the surface, or of its waves alone; inf without one.

    Steps are so short that the greatest slope cannot reach the ray within them, but for those of ``least``
    metres.
    """
    dx, dy, dz = way
    across = np.sqrt(dx * dx + dy * dy)
    closing = across * rough.kinds[k, _SLOPE if whole else _WAVE_SLOPE] + abs(dz)
    shortest = least / max(across, abs(dz))
    t, gap = start, _gap(rough, k, place, way, start, whole)
    if gap <= 0.0:
        return t
    for _ in range(_STEPS):
        ahead = min(t + max(gap / closing, shortest), end)
        there = _gap(rough, k, place, way, ahead, whole)
        if there <= 0.0:
            return _narrowed(rough, k, place, way, (t, gap), (ahead, there), whole)
        if ahead >= end:
            return np.inf
        t, gap = ahead, there
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def _descent(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """The only crossing of the waves by a ray that falls faster than they can, by Newton's method."""
    low, high, t, factor = start, end, start, rough.kinds[k, 0]
    for _ in range(_NARROWINGS):
        x, y = place[0] + t * way[0], place[1] + t * way[1]
        gap = place[2] + t * way[2] - _waves(rough, k, x, y)
        if abs(gap) < _CLOSE or (gap <= 0.0 and t <= start):
            return t
        if gap > 0.0:
            low = t
        else:
            high = t
        p, q = _slope_at(rough.road, rough.step[0], x, y)
        t -= gap / (way[2] - factor * (p * way[0] + q * way[1]))
        if not low < t < high:
            t = 0.5 * (low + high)
    return t


@inlined
def _border(x: float, way: float, cell: float) -> Any:
    """Parameter from a coordinate to the border of its block."""
    if way == 0.0:
        return np.inf
    return ((cell + (1.0 if way > 0.0 else 0.0)) * BLOCK - x) / way


@njit(cache=True, nogil=True, error_model="numpy")
def _among_grains(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """The first crossing of a surface with grains after one of its waves; blocks below the ray are passed."""
    dx, dy, dz = way
    across, n = np.sqrt(dx * dx + dy * dy), rough.highest.shape[0]
    closing = across * rough.kinds[k, _WAVE_SLOPE] + abs(dz)
    t, gap = start, _gap(rough, k, place, way, start, False)
    for _ in range(_STEPS):
        x, y = place[0] + t * dx, place[1] + t * dy
        i, j = np.floor(x / BLOCK), np.floor(y / BLOCK)
        step = min(_border(x, dx, i), _border(y, dy, j)) + 1e-9 / max(across, abs(dz))
        ahead = min(t + max(step, 0.0), end)
        there = _gap(rough, k, place, way, ahead, False)
        top = rough.kinds[k, 1] * np.float64(rough.highest[np.int64(i) & (n - 1), np.int64(j) & (n - 1)])
        if 0.5 * (gap + there - closing * (ahead - t)) <= top:
            found = _march(rough, k, place, way, t, ahead, _LEAST_GRAINS, True)
            if found < np.inf:
                return found
        if ahead >= end:
            return np.inf
        t, gap = ahead, there
    return t


@njit(cache=True, nogil=True, error_model="numpy")
def _crossing(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """Ray parameter of the first crossing from above between two parameters; inf without one.

    place : x, y and height above the plane at parameter 0
    way   : change of each per parameter

    The waves lie above grains and joints and are much flatter, so the way down to them takes few steps.
    """
    kinds = rough.kinds
    if -way[2] > kinds[k, _WAVE_SLOPE] * np.sqrt(way[0] * way[0] + way[1] * way[1]):
        t = _descent(rough, k, place, way, start, end)
    else:
        t = _march(rough, k, place, way, start, end, _LEAST_WAVES, False)
    if t == np.inf:
        return t
    if kinds[k, 1] > 0.0:
        return _among_grains(rough, k, place, way, t, end)
    if kinds[k, 2] > 0.0:
        x, y = place[0] + t * way[0], place[1] + t * way[1]
        if _joint(kinds[k, 2], kinds[k, 3], kinds[k, 4], kinds[k, 5], x, y) < 0.0:
            return _march(rough, k, place, way, t, end, _LEAST, True)
    return t


@inlined
def _on_plane(plane: Any, f: int, origin: Any, direction: Any) -> Any:
    """A ray relative to the plane of a face: x, y and height at parameter 0, and their changes."""
    a, b, c = plane[f, 0], plane[f, 1], plane[f, 2]
    x, y, z = origin
    dx, dy, dz = direction
    return (x, y, z - (a * x + b * y + c)), (dx, dy, dz - (a * dx + b * dy))


@inlined
def _write(
    tables: Any, rough: Any, t: float, f: int, place: Any, direction: Any, columns: Any, i: int
) -> None:
    """Write a hit with the normal of the surface there."""
    distance, face, instance, cosine, normal = columns
    sx, sy = _slopes(rough, tables.kind[f], place[0], place[1])
    nx, ny = -tables.plane[f, 0] - sx, -tables.plane[f, 1] - sy
    size = np.sqrt(nx * nx + ny * ny + 1.0)
    dx, dy, dz = direction
    across = -(dx * nx + dy * ny + dz) / (size * np.sqrt(dx * dx + dy * dy + dz * dz))
    distance[i], face[i], instance[i] = t, f, -1
    # A ray that grazes the edge of a dip may seem to come from behind.
    cosine[i] = max(across, 1e-3)
    if len(normal) > 0:
        normal[i, 0], normal[i, 1], normal[i, 2] = nx / size, ny / size, 1.0 / size


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
    s = min(_crossing(rough, k, (x, y, z), way, t, end), end)
    if s > rays.far[i if len(rays.far) > 1 else 0]:
        distance[i], face[i], instance[i], cosine[i] = np.inf, -1, -1, 0.0
        if len(normal) > 0:
            normal[i, 0], normal[i, 1], normal[i, 2] = 0.0, 0.0, 0.0
        return
    _write(tables, rough, s, f, (x + s * way[0], y + s * way[1]), direction, columns, i)


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
    end = near + ((_OVER - z) / way[2] if way[2] > 0.0 else (-depth - z) / min(way[2], -1e-12))
    s = _crossing(rough, k, place, way, near, max(end, near))
    if s == np.inf and way[2] > 0.0:
        return end
    s = min(s, end)
    if not s > rays.far[i if len(rays.far) > 1 else 0]:
        _write(tables, rough, s, f, (place[0] + s * way[0], place[1] + s * way[1]), direction, columns, i)
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _leave(tables: Any, rough: Any, rays: Any, on: Any, columns: Any, at: Any) -> None:
    """Fill ``at``: 0 for a ray that starts above its plane, inf for one that stays below it."""
    for i in range(len(on)):
        if on[i] >= 0:
            at[i] = _leave_one(tables, rough, rays, on[i], i, columns)
