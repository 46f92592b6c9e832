"""Air under roofs, bridges and in tunnels, on a grid around a place."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.geometry import Geometry

CELL = 1.0
"""Metres on each side of a cell."""

_LEAST = 1.5  # metres of air below a roof, less than any that a sensor passes under
_TOUCHING = 0.05  # metres between two bodies that stand on each other, without air in between
_LEVELS = 1 << 24  # of height, so that a cell's number, a level and a direction are one number
_STEP = (
    1.0  # metres by which the floor differs between neighbouring cells that air passes; as high an opening
)
_UPRIGHT = 1e-6  # vertical part of the normal below which a face is upright
_NEXT = ((0, 1), (1, 0), (1, 1), (1, -1))


@dataclass(frozen=True, slots=True)
class Shelter:
    """Covered air: for each cell of a grid the height interval below the highest roof.

    corner : (2,) scene metres of the corner of the first cell
    roof   : (ny, nx) height of the underside, scene metres; -inf in the open
    way    : (ny, nx) metres through covered air to the open; inf if it lies beyond the grid, NaN in the open
    """

    corner: tuple[float, float]
    roof: Float
    way: Float


def shelter_of(
    parts: Iterable[Geometry], *, origin: Float, corner: tuple[float, float], count: int
) -> Shelter | None:
    """Covered air in a square of ``count`` cells a side; None if nothing is covered.

    parts  : closed bodies and the ground, relative to the origin; undersides face down
    origin : (3,) scene metres
    corner : (2,) scene metres
    """
    cells, heights, facing = [np.empty(0, np.int64)], [np.empty(0)], [np.empty(0, np.bool_)]
    for part in parts:
        cell, height, up = _crossings(part, corner=corner - origin[:2], count=count)
        cells.append(cell)
        heights.append(height)
        facing.append(up)
    cell, up = np.concatenate(cells), np.concatenate(facing)
    height = np.concatenate(heights) + origin[2]
    # From below, and where surfaces touch, the lower body's top first.
    level = np.round(height / _TOUCHING).astype(np.int64) + _LEVELS // 2
    order = np.argsort(2 * (_LEVELS * cell + level) + ~up)
    cell, height, up = cell[order], height[order], up[order]
    covers = np.flatnonzero((cell[1:] == cell[:-1]) & up[:-1] & ~up[1:] & (np.diff(height) > _LEAST))
    roof, top = np.full(count * count, -np.inf), np.full(count * count, -np.inf)
    floor = np.zeros(count * count)
    roof[cell[covers]], floor[cell[covers]] = height[covers + 1], height[covers]  # the highest comes last
    top[cell] = height
    shape = count, count
    way = _way_out(roof.reshape(shape), floor.reshape(shape), top=top.reshape(shape))
    if np.isnan(way).all():
        return None
    return _up_to_walls(
        Shelter(corner, np.where(np.isnan(way), -np.inf, roof.reshape(shape)), way), top.reshape(shape)
    )


def _up_to_walls(shelter: Shelter, top: Float) -> Shelter:
    """Extend covered air to the walls and piers that bound it.

    top : (ny, nx) height of the highest surface
    """
    from scipy.ndimage import maximum_filter, minimum_filter  # noqa: PLC0415  (0.1 s)

    roof = maximum_filter(shelter.roof, 3)
    way = minimum_filter(np.where(np.isnan(shelter.way), np.inf, shelter.way), 3)
    inside = np.isnan(shelter.way) & np.isfinite(roof) & (top > roof)
    return Shelter(shelter.corner, np.where(inside, roof, shelter.roof), np.where(inside, way, shelter.way))


def _crossings(
    part: Geometry, *, corner: Float, count: int
) -> tuple[NDArray[np.int64], Float, NDArray[np.bool_]]:
    """Cells (k,) and heights (k,) where the lines up from their middles cross faces, and if these face up."""
    cell, height, up = np.empty(0, np.int64), np.empty(0), np.empty(0, np.bool_)
    mesh = part.vertices, part.faces, part.planes
    found = _rasterise(mesh, corner, count, (cell, height, up))
    if found:
        cell, height, up = np.empty(found, np.int64), np.empty(found), np.empty(found, np.bool_)
        _rasterise(mesh, corner, count, (cell, height, up))
    return cell, height, up


@njit(cache=True, nogil=True)
def _rasterise(mesh: Any, corner: Float, count: int, columns: Any) -> int:
    """The number of crossings; fill their columns as far as they have room."""
    vertices, faces, planes = mesh
    cell, height, facing = columns
    found = 0
    for k in range(len(faces)):
        nx, ny, nz, offset = planes[k, 0], planes[k, 1], planes[k, 2], planes[k, 3]
        if abs(nz) < _UPRIGHT:
            continue
        ax, ay = (vertices[faces[k, 0], 0] - corner[0]) / CELL, (vertices[faces[k, 0], 1] - corner[1]) / CELL
        bx, by = (vertices[faces[k, 1], 0] - corner[0]) / CELL, (vertices[faces[k, 1], 1] - corner[1]) / CELL
        cx, cy = (vertices[faces[k, 2], 0] - corner[0]) / CELL, (vertices[faces[k, 2], 1] - corner[1]) / CELL
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        first = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
        last = min(int(np.floor(max(ay, by, cy) - 0.5)), count - 1)
        left = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
        right = min(int(np.floor(max(ax, bx, cx) - 0.5)), count - 1)
        for j in range(first, last + 1):
            for i in range(left, right + 1):
                x, y = i + 0.5, j + 0.5
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                if u < 0.0 or v < 0.0 or u + v > 1.0:
                    continue
                if found < len(cell):
                    east, north = corner[0] + CELL * x, corner[1] + CELL * y
                    cell[found] = j * count + i
                    height[found] = (offset - nx * east - ny * north) / nz
                    facing[found] = nz > 0.0
                found += 1
    return found


def _way_out(roof: Float, floor: Float, *, top: Float) -> Float:
    """Metres (ny, nx) through covered air to the open; NaN in the open and in closed hollows of bodies.

    top : height of the highest surface
    """
    from scipy.sparse import coo_array  # noqa: PLC0415  (0.1 s)
    from scipy.sparse.csgraph import connected_components, dijkstra  # noqa: PLC0415

    covered = np.isfinite(roof)
    way = np.full(roof.shape, np.nan)
    number = np.where(covered, np.cumsum(covered).reshape(roof.shape) - 1, -1)
    n = int(covered.sum())
    if not n:
        return way
    ends, open_air = [], np.zeros(roof.shape, np.bool_)
    for dy, dx in _NEXT:
        one, other = _shift(dy, dx)
        joined = covered[one] & covered[other] & (np.abs(floor[one] - floor[other]) < _STEP)
        length = np.full(int(joined.sum()), CELL * np.hypot(dx, dy))
        ends.append(np.stack([number[one][joined], number[other][joined], length]))
        for here, there in ((one, other), (other, one)):
            open_air[here] |= ~covered[there] & (top[there] < roof[here] - _STEP)
    begin, end, length = np.concatenate(ends, axis=1)
    graph = coo_array((length, (begin.astype(np.int64), end.astype(np.int64))), shape=(n, n)).tocsr()
    outside = number[covered & open_air]
    away = np.full(n, np.inf)
    if len(outside):
        away = dijkstra(graph, directed=False, indices=outside, min_only=True)
    # Hollows of bodies have neither a way out nor one beyond the grid.
    _, body = connected_components(graph, directed=False)
    border = np.zeros(roof.shape, np.bool_)
    border[[0, -1]] = border[:, [0, -1]] = True
    reaches = np.isfinite(away) | np.isin(body, body[number[covered & border]])
    way[covered] = np.where(reaches, away, np.nan)
    return way


def _shift(dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of a grid and of its neighbours ``dy`` rows and ``dx`` columns on."""
    rows = slice(0, -dy or None), slice(dy, None)
    columns = (slice(0, -dx or None), slice(dx, None)) if dx >= 0 else (slice(-dx, None), slice(0, dx))
    return (rows[0], columns[0]), (rows[1], columns[1])
