"""The grid cells that a body covers along its path, with the stations at which it covers them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.support.columns import Columns
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.traffic.lanes import STEP, ActorPath

CELL_SIZE = 0.3
"""Side of a cell in metres. Bodies that share no cell do not touch: a body covers all cells whose centre is
within half a diagonal of it."""
_MANY = 1 << 30  # cells along a side of the grid: 322,000 km
_SPARE = 0.05 + CELL_SIZE * math.sqrt(0.5)


@dataclass(frozen=True, slots=True)
class SweptCells(Columns):
    """Cells that a body covers along its path, in the order of ``first``.

    cell : (q,) int64, the cell's row, column and level as one number
    first  : (q,) int32, station at which the body begins to cover it
    last   : (q,) int32, station until which it covers it
    leave  : (q,) int32, rows of the above in the order of ``last``
    """

    cell: NDArray[np.int64]
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    leave: NDArray[np.int32]

    @classmethod
    def empty(cls) -> SweptCells:
        """No cells."""
        none = np.empty(0, np.int32)
        return cls(np.empty(0, np.int64), none, none, none)


def sweep(
    xy: Float, heading: Float, *, length: float, width: float, level: NDArray[np.int64], scale: float
) -> SweptCells:
    """The cells that a body covers along a path.

    xy, heading : (n, 2) and (n,) of its middle
    level : (n,) 0 or 1: bridges and tunnels have cells of their own
    scale : scene metres per true metre
    """
    # a body between two stations lies within both, grown by half a step
    half = np.array([length / 2 + STEP / 2, width / 2]) * scale + _SPARE
    most = int(math.ceil(2 * half[0] / CELL_SIZE) + 2) * int(math.ceil(2 * half[1] / CELL_SIZE) + 2)
    cell, first, last, count = _cover(xy, heading, half, level, most)
    cell, first, last = cell[:count], first[:count], last[:count]
    return SweptCells(cell, first, last, np.argsort(last, kind="stable").astype(np.int32))


def body_poses(path: ActorPath, axle: float) -> tuple[Float, Float]:
    """Centre (n, 2) and heading (n,) of a body at each station, with both axles on the path."""
    reach = axle / 2 / STEP
    rows = np.arange(len(path), dtype=float)
    ends = [np.stack([_extend(path.xyz[:, c], rows + s * reach) for c in (0, 1)], axis=1) for s in (1, -1)]
    d = ends[0] - ends[1]
    return (ends[0] + ends[1]) / 2, np.unwrap(np.arctan2(d[:, 1], d[:, 0]))


def _extend(values: Float, rows: Float) -> Float:
    """Values at fractional rows, linearly extrapolated beyond the ends."""
    n = len(values)
    low = np.clip(np.floor(rows).astype(int), 0, n - 2)
    out: Float = values[low] + (rows - low) * (values[low + 1] - values[low])
    return out


def rectangles(xy: Float, heading: Float, *, length: ArrayLike, width: ArrayLike) -> NDArray[np.object_]:
    """Outlines (n,) in plan of boxes about points (n, 2); length and width one number or (n,)."""
    forward = np.column_stack([np.cos(heading), np.sin(heading)]) * np.reshape(length, (-1, 1)) / 2
    left = np.column_stack([-np.sin(heading), np.cos(heading)]) * np.reshape(width, (-1, 1)) / 2
    corners = [xy + a * forward + b * left for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    boxes: NDArray[np.object_] = shapely.polygons(np.stack(corners, axis=1))
    return boxes


@njit(cache=True, nogil=True)
def cells_under(x: float, y: float, heading: float, half: Any, level: int, out: Any) -> int:
    """Fill ``out`` with the cells whose middle lies in a rectangle; return their number."""
    c, s, hl, hw = math.cos(heading), math.sin(heading), half[0], half[1]
    ex, ey = abs(c) * hl + abs(s) * hw, abs(s) * hl + abs(c) * hw
    n = 0
    for j in range(math.ceil((y - ey) / CELL_SIZE - 0.5), math.floor((y + ey) / CELL_SIZE - 0.5) + 1):
        for i in range(math.ceil((x - ex) / CELL_SIZE - 0.5), math.floor((x + ex) / CELL_SIZE - 0.5) + 1):
            dx, dy = (i + 0.5) * CELL_SIZE - x, (j + 0.5) * CELL_SIZE - y
            if abs(dx * c + dy * s) <= hl and abs(dy * c - dx * s) <= hw:
                out[n] = (level * _MANY + j + _MANY // 2) * _MANY + i + _MANY // 2
                n += 1
    return n


@njit(cache=True, nogil=True)
def _cover(xy: Any, heading: Any, half: Any, level: Any, most: int) -> Any:
    """Cells with their first and last stations, by first station."""
    n = len(xy)
    cell = np.empty(most + 64 * n, np.int64)
    first, last = np.empty(len(cell), np.int32), np.empty(len(cell), np.int32)
    under, before = np.empty(most, np.int64), np.empty(most, np.int64)  # ascending, as `cells_under` goes
    row, row_before = np.empty(most, np.int64), np.empty(most, np.int64)
    count = known = 0
    for k in range(n):
        found = cells_under(xy[k, 0], xy[k, 1], heading[k], half, level[k], under)
        if count + found > len(cell):
            cell = np.concatenate((cell, np.empty_like(cell)))
            first, last = np.concatenate((first, first)), np.concatenate((last, last))
        b = 0
        for m in range(found):
            p = under[m]
            while b < known and before[b] < p:
                b += 1
            if b < known and before[b] == p:
                row[m] = row_before[b]
            else:
                cell[count], first[count], row[m] = p, k, count
                count += 1
            last[row[m]] = k
        under, before, row, row_before, known = before, under, row_before, row, found
    return cell, first, last, count
