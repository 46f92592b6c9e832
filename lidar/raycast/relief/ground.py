"""Hits on rough ground: the first crossing of a ray with the height function of its face."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.mesh import Mesh
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.columns import RayColumns
from lidar.raycast.hits import Hits
from lidar.raycast.memory import inline
from lidar.raycast.planes import OVER, beyond_plane, direction_of, origin_of
from lidar.raycast.rays import share
from lidar.raycast.relief.crossing import (
    COLUMNS,
    DEPTH,
    DX,
    DY,
    END,
    FIELD_SLOPE,
    FOUND,
    GAIN,
    LANES,
    LENGTH,
    SIDE,
    SLOPE_X,
    SLOPE_Y,
    begin,
    descend,
    follow,
    height,
    joints,
    level_of,
)
from lidar.raycast.relief.roughness import kinds_of, roughness


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
    """Refines hits on rough ground; see `lidar.raycast.hits`.

    Rays with a footprint meet the mean of the surface over it: heights whose cells, in powers of two, are
    nearest to half of its length along the ground. Scattered rays near the border of two such levels take
    either, by chance.

    tables : of the loaded tiles, with scene coordinates
    """

    def __init__(self, tables: GroundTables) -> None:
        self.tables = tables
        self._rough = roughness()

    def refine(self, rays: RayColumns, hits: Hits, *, threads: int) -> None:
        """Change hits on rough ground in place, as `lidar.raycast.hits.Refiner.refine` describes."""
        columns = hits.range, hits.face, hits.instance, hits.cosine, hits.normal
        tables, rough = self.tables, self._rough

        def work(low: int, high: int) -> int:
            _refine(tables, rough, rays, low, high, columns)
            return -1

        share(work, rays, threads=threads)

    def leave(self, rays: RayColumns, on: NDArray[np.int32], hits: Hits) -> Float:
        """Follow rays that start below the plane of a face, as `lidar.raycast.hits.Refiner.leave` says."""
        at = np.zeros(len(on))
        columns = hits.range, hits.face, hits.instance, hits.cosine, hits.normal
        _leave(self.tables, self._rough, rays, on, columns, at)
        return at


@inline
def _on_plane(plane: Any, f: int, origin: Any, direction: Any) -> Any:
    """A ray relative to the plane of a face: x, y and height at parameter 0, and their changes."""
    a, b, c = plane[f, 0], plane[f, 1], plane[f, 2]
    x, y, z = origin
    dx, dy, dz = direction
    return (x, y, z - (a * x + b * y + c)), (dx, dy, dz - (a * dx + b * dy))


@inline
def _length(direction: Any) -> Any:
    """Length of a vector."""
    return np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)


@inline
def _put(tables: Any, rays: Any, i: int, f: int, columns: Any, lanes: Any, n: int) -> None:
    """Write the hit of a lane on a face; beyond the end of the ray it is a miss."""
    distance, face, instance, cosine, normal = columns
    t = min(lanes[n, FOUND], lanes[n, END])
    if t > rays.far[i if len(rays.far) > 1 else 0]:
        distance[i], face[i], instance[i], cosine[i] = np.inf, -1, -1, 0.0
        if len(normal) > 0:
            normal[i, 0], normal[i, 1], normal[i, 2] = 0.0, 0.0, 0.0
        return
    sx, sy = lanes[n, SLOPE_X], lanes[n, SLOPE_Y]
    nx, ny = -tables.plane[f, 0] - sx, -tables.plane[f, 1] - sy
    size = np.sqrt(nx * nx + ny * ny + 1.0)
    falls = (sx * lanes[n, DX] + sy * lanes[n, DY]) * lanes[n, SIDE] - lanes[n, GAIN]
    distance[i] = t
    # A ray that grazes the edge of a dip may seem to come from behind.
    cosine[i] = max(falls / (size * lanes[n, LENGTH]), 1e-3)
    if len(normal) > 0:
        z = 1.0 / size
        normal[i, 0], normal[i, 1], normal[i, 2] = nx * z, ny * z, z


@inline
def _enter(tables: Any, rough: Any, rays: Any, i: int, columns: Any, lanes: Any, n: int) -> Any:
    """Put a ray that hits a rough face into a lane; 1 if it does so, else 0."""
    distance, face, instance, cosine, _ = columns
    f = face[i]
    if f < 0 or instance[i] >= 0 or cosine[i] <= 0.0:
        return 0
    k = tables.kind[f]
    if k < 0:
        return 0
    direction = direction_of(rays, i)
    place, way = _on_plane(tables.plane, f, origin_of(rays, i), direction)
    if not way[2] < 0.0:
        return 0
    t = distance[i]
    length, (start, growth) = _length(direction), rays.footprint
    patch = (start + growth * t * length) / cosine[i]
    x, y = place[0] + t * way[0], place[1] + t * way[1]
    level = level_of(patch, rays.scattered, x, y)
    # The height counts from the hit on the face, so that no ray slips between it and the plane.
    end = t - rough.kinds[k, DEPTH] / way[2]
    begin(rough, k, level, (place[0], place[1], -t * way[2]), way, (t, end), lanes, n)
    descend(rough, lanes, n)
    lanes[n, LENGTH] = length
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(tables: Any, rough: Any, rays: Any, low: int, high: int, columns: Any) -> None:
    """Refine the hits ``low`` to ``high`` in the order of work."""
    order, face = rays.order, columns[1]
    lanes, active, ray = np.empty((LANES, COLUMNS)), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    j = low
    while j < high:
        count = 0
        while j < high and count < LANES:
            i = order[j] if len(order) > 0 else j
            ray[count] = i
            count += _enter(tables, rough, rays, i, columns, lanes, count)
            j += 1
        follow(rough, lanes, active, count)
        for n in range(count):
            _put(tables, rays, ray[n], face[ray[n]], columns, lanes, n)


@inline
def _enter_below(tables: Any, rough: Any, rays: Any, f: int, i: int, lanes: Any, n: int) -> Any:
    """Put a ray that starts between the surface and the plane of a face into a lane.

    Returns 1 if it does so, else 0, and the parameter at which a ray without a lane has crossed the plane.
    A ray that starts on the mean over a footprint may start below the surface: it starts just above it.
    One that starts closer above the plane than rays go on from it, on a peak or off a shallow dip, goes on
    from there, too: it would meet the plane in float32.
    """
    k = tables.kind[f] if f >= 0 else -1
    if k < 0:
        return 0, 0.0
    direction = direction_of(rays, i)
    (x, y, z), way = _on_plane(tables.plane, f, origin_of(rays, i), direction)
    near, depth, length = rays.near, rough.kinds[k, DEPTH], _length(direction)
    below = z + near * way[2]
    if below >= OVER or below < -2.0 * depth or (below >= 0.0 and way[2] <= 0.0):
        return 0, 0.0
    px, py, slope = x + near * way[0], y + near * way[1], rough.kinds[k, FIELD_SLOPE]
    if below >= 0.0 or (
        way[2] > slope * np.sqrt(way[0] ** 2 + way[1] ** 2)
        and (rough.kinds[k, 1] <= 0.0 or joints(rough, k, px, py) >= 0.0)
    ):
        return 0, near - below / way[2] + beyond_plane(way[2], length)
    surface = height(rough, k, px, py)
    lift = surface + OVER - below if below < surface else 0.0
    # The ray itself, which goes on from there, crosses the plane after the lifted one.
    end = near + (-below / way[2] if way[2] > 0.0 else (-depth - below - lift) / min(way[2], -1e-12))
    begin(rough, k, 0, (x, y, z + lift), way, (near, max(end, near)), lanes, n)
    lanes[n, LENGTH] = length
    return 1, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _leave(tables: Any, rough: Any, rays: Any, on: Any, columns: Any, at: Any) -> None:
    """Fill ``at``: 0 for a ray that starts above its plane, inf for one that stays below it."""
    lanes, active, ray = np.empty((LANES, COLUMNS)), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    i = 0
    while i < len(on):
        count = 0
        while i < len(on) and count < LANES:
            ray[count] = i
            entered, at[i] = _enter_below(tables, rough, rays, on[i], i, lanes, count)
            count += entered
            i += 1
        follow(rough, lanes, active, count)
        for n in range(count):
            j = ray[n]
            if lanes[n, FOUND] == np.inf and lanes[n, GAIN] > 0.0:
                at[j] = lanes[n, END] + beyond_plane(lanes[n, GAIN], lanes[n, LENGTH])
                continue
            at[j] = np.inf
            if not min(lanes[n, FOUND], lanes[n, END]) > rays.far[j if len(rays.far) > 1 else 0]:
                columns[1][j] = on[j]
                _put(tables, rays, j, on[j], columns, lanes, n)
