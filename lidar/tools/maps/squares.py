"""Points sorted into squares of the plane, in files beside the map, for maps larger than memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.files import temporary_folder
from lidar.dataset.formats.table import Table, records

Square = tuple[int, int]
"""Column and row of a square: its lower left corner over its side."""


class Squares:
    """Records of points by square; coordinates are less a whole-metre offset, so that borders are exact.

    side : metres
    """

    def __init__(self, folder: Path, side: float, *, offset: tuple[float, float, float]) -> None:
        self.side = side
        self._folder = folder
        self._offset = offset
        self._kinds = np.dtype([])
        self._found: set[Square] = set()

    def path(self, square: Square) -> Path:
        """The file of a square."""
        return self._folder / f"{square[0]}_{square[1]}"

    def records(self, table: Table) -> NDArray[np.void]:
        """Records of a table, less the offset."""
        data = records(table)
        self._kinds = data.dtype
        for axis, shift in zip("xyz", self._offset, strict=True):
            data[axis] -= shift
        return data

    def add(self, data: NDArray[np.void]) -> list[Square]:
        """Append records of `records`; return the squares that they are in."""
        if not len(data):
            return []
        column, row = (np.floor(data[axis] / self.side).astype(np.int64) for axis in "xy")
        order = np.lexsort((row, column))  # stable: points of a square keep their order
        column, row = column[order], row[order]
        begins = np.flatnonzero(np.r_[True, (np.diff(column) != 0) | (np.diff(row) != 0)])
        touched = [(int(column[k]), int(row[k])) for k in begins]
        for square, mine in zip(touched, np.split(order, begins[1:]), strict=True):
            with self.path(square).open("ab") as file:
                file.write(data.take(mine).tobytes())  # records: far faster than by an index
        self._found.update(touched)
        return touched

    def __iter__(self) -> Iterator[Square]:
        """Squares with points, in order."""
        return iter(sorted(self._found))

    def all_of(self, square: Square) -> NDArray[np.void]:
        """Records of a square, on disk until they are used; none of a square without points."""
        if square not in self._found:
            return np.empty(0, self._kinds)
        mapped: NDArray[np.void] = np.memmap(self.path(square), self._kinds, "r")
        return mapped

    def table(self, data: NDArray[Any]) -> Table:
        """The table of records, with the offset again."""
        table = {name: np.array(data[name]) for name in data.dtype.names or ()}
        for axis, shift in zip("xyz", self._offset, strict=True):
            table[axis] += shift
        return table


@contextmanager
def squares_beside(
    out: Path, side: float, *, offset: tuple[float, float, float], what: str
) -> Iterator[Squares]:
    """Yield empty `Squares` in a temporary folder beside a map; ``what`` is part of its name."""
    with temporary_folder(out, what) as folder:
        yield Squares(folder, side, offset=offset)
