"""Columns of long paths, block by block: only a block of their rows is in memory at once.

Results that are longer than a block are arrays of `lidar.geometry.poses.room`, in files for long paths. Their
bytes are those of the same functions on whole columns.
"""

from __future__ import annotations

import math
import mmap
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.geometry import poses
from lidar.geometry.poses import blocks_of, release, room

Table = TypeVar("Table", bound=Columns)

_TRUNCATE = 4.0  # standard deviations at which Gaussian filters end


def rowwise(
    function: Callable[..., NDArray[Any]],
    *columns: NDArray[Any],
    reach: int = 0,
    looked_up: Sequence[NDArray[Any]] = (),
) -> NDArray[Any]:
    """The rows (n, ...) that a function returns for columns (n, ...).

    reach     : rows before and after a row on which its result depends
    looked_up : other arrays that the function reads, near rows that follow each other
    """
    n = len(columns[0])
    if n <= poses.BLOCK_POSES:
        return function(*columns)
    out: NDArray[Any] | None = None
    for rows in blocks_of(n):
        around = slice(max(rows.start - reach, 0), min(rows.stop + reach, n))
        part = function(*(column[around] for column in columns))
        out = room((n, *part.shape[1:]), part.dtype) if out is None else out
        out[rows] = part[rows.start - around.start :][: rows.stop - rows.start]
        release(out, *columns, *looked_up)
    return np.asarray(out)


def fill(out: NDArray[Any], values: NDArray[Any]) -> None:
    """Copy values (n, ...) to an array of the same length."""
    for rows in blocks_of(len(out)):
        out[rows] = values[rows]
        release(out, values)


def join(count: int, tables: Iterable[Table]) -> Table:
    """All ``count`` rows of one or more tables that come in order; the tables may be blocks of rows."""
    columns: dict[str, NDArray[Any]] = {}
    first = 0
    for table in tables:
        for name, values in table.columns().items():
            if name not in columns:
                columns[name] = room((count, *values.shape[1:]), values.dtype)
            fill(columns[name][first : first + len(table)], values)
        first += len(table)
    return replace(table, **columns)


def gather(blocks: Iterable[Float]) -> Float:
    """The rows (n, c) of blocks of rows, in a file if there are several."""
    with tempfile.TemporaryFile() as file:
        for block in blocks:
            file.write(block.data)
        if file.tell() == block.nbytes:
            return block
        file.flush()
        return np.frombuffer(mmap.mmap(file.fileno(), 0)).reshape(-1, block.shape[1])


def even(count: int, step: float) -> Float:
    """Multiples (count,) of a step, from 0 on."""
    out = room((count,))
    for rows in blocks_of(count):
        out[rows] = step * np.arange(rows.start, rows.stop)
        release(out)
    return out


def sums(steps: Float) -> Float:
    """Running sums (n,) of a column (n,)."""
    total = 0.0

    def further(part: Float) -> Float:
        nonlocal total
        out: Float = np.cumsum(np.concatenate([[total], part]))[1:]
        total = float(out[-1])
        return out

    return rowwise(further, steps)


def lowest_ahead(column: Float) -> Float:
    """The minimum (n,) of each row of a column (n,) and all rows after it."""
    out, lowest = room((len(column),)), np.inf
    for rows in reversed([*blocks_of(len(column))]):
        out[rows] = np.minimum(np.minimum.accumulate(column[rows][::-1])[::-1], lowest)
        lowest = float(out[rows.start])
        release(out, column)
    return out


def interpolate(at: Float, s: Float, *, column: Float) -> Float:
    """Values (k,) at rising places (k,) of a column (n,) known at rising places s (n,)."""

    def near(part: Float) -> Float:
        low, high = np.searchsorted(s, part[[0, -1]], side="right")
        rows = slice(max(int(low) - 2, 0), int(high) + 2)
        return np.interp(part, s[rows], column[rows])

    return rowwise(near, at, looked_up=(s, column))


def smooth(column: Float, sigma: float, *, mode: str = "reflect") -> Float:
    """A column (n,) after a Gaussian filter; parameters as of ``scipy.ndimage.gaussian_filter1d``."""
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415  (slow to import)

    reach = math.ceil(_TRUNCATE * sigma) + 1
    return rowwise(lambda part: gaussian_filter1d(part, sigma, mode=mode), column, reach=reach)


def extend(column: Float, spare: int) -> Float:
    """A column (n,) with ``spare`` more rows at both ends, mirrored at the first and the last value."""
    if len(column) <= max(2 * spare, poses.BLOCK_POSES):
        return np.pad(column, spare, mode="reflect", reflect_type="odd")
    out = room((len(column) + 2 * spare,))
    out[:spare] = np.pad(column[: spare + 1], spare, mode="reflect", reflect_type="odd")[:spare]
    out[-spare:] = np.pad(column[-spare - 1 :], spare, mode="reflect", reflect_type="odd")[-spare:]
    fill(out[spare:-spare], column)
    return out


def gaps(line: Float) -> Float:
    """Distances in plan (n - 1,) between the points (n, 2 or 3) of a line."""
    steps = rowwise(
        lambda part: np.hypot(*np.diff(part[:, :2], axis=0, append=part[-1:, :2]).T), line, reach=1
    )
    return steps[:-1]


def mean_gap(line: Float) -> float:
    """Mean distance in plan between the points (n, 2 or 3) of a line."""
    steps = gaps(line)
    mean = float(np.mean(steps))
    release(steps)
    return mean


def headings(line: Float) -> Float:
    """Unwrapped heading (n,) at each point of a line (n, 2 or 3), radians."""
    wrapped = rowwise(lambda part: np.arctan2(*np.gradient(part[:, :2], axis=0).T[::-1]), line, reach=1)
    return rowwise(np.add, wrapped, sums(rowwise(_whole_turns, wrapped, reach=1)))


def _whole_turns(angle: Float) -> Float:
    """Radians (n,) that ``np.unwrap`` adds to each angle (n,) and all after it."""
    change = np.diff(angle, prepend=angle[0])
    smallest = np.mod(change + np.pi, 2 * np.pi) - np.pi
    smallest[(smallest == -np.pi) & (change > 0)] = np.pi
    return np.where(np.abs(change) < np.pi, 0.0, smallest - change)


def curvatures(line: Float) -> Float:
    """Curvature (n,) at each point of a line (n, 2 or 3): see `geoscene.geometry.polylines.curvatures`."""
    return rowwise(polylines.curvatures, line, reach=2)
