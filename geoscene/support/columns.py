"""Tables: frozen dataclasses whose arrays are columns of one length, and tables as CSV, block by block."""

from __future__ import annotations

import csv
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.files import atomic_path

BLOCK_ROWS = 1 << 16
"""Rows of a table that are formatted at once."""


@dataclass(frozen=True, slots=True)
class Columns:
    """A table; each array of a subclass is a column, other fields hold for all rows."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns().values())))

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns by name."""
        kind: Any = type(self)
        values = {name: getattr(self, name) for name in _fields_of(kind)}
        return {name: column for name, column in values.items() if isinstance(column, np.ndarray)}

    def take(self, rows: ArrayLike | slice) -> Self:
        """The chosen rows, in the given order; those of a slice are views."""
        if isinstance(rows, slice):
            return replace(self, **{name: column[rows] for name, column in self.columns().items()})
        index = np.asarray(rows)
        if index.dtype == np.bool_:  # a mask is searched once, not for each column
            index = np.flatnonzero(index)
        return replace(self, **{name: column.take(index, axis=0) for name, column in self.columns().items()})

    def where(self, keep: NDArray[np.bool_]) -> Self:
        """The rows at which a mask is true; the same object if that is all."""
        return self if keep.all() else self.take(keep)

    @classmethod
    def concatenate(cls, tables: Sequence[Self]) -> Self:
        """Rows of one or more tables, in order; fields that are not columns are the first table's."""
        names = tables[0].columns()
        joined = {name: np.concatenate([getattr(table, name) for table in tables]) for name in names}
        return replace(tables[0], **joined)


@functools.cache
def _fields_of(table: type[Any]) -> tuple[str, ...]:
    """Names of the fields of a table; `dataclasses.fields` takes as long as an operation on a column."""
    return tuple(field.name for field in fields(table))


def nth(sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Position (n,) of each row in its group, given the sizes of groups."""
    return np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)


def squares_between(
    low: NDArray[np.int64], high: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows (k, 2) of the squares of a grid from those at one corner of boxes (n, 2) to the other.

    Returns also the box (k,) of each.
    """
    span = high - low + 1
    box = np.repeat(np.arange(len(low)), span.prod(axis=1))
    down, across = np.divmod(nth(span.prod(axis=1)), span[box, 0])
    return low[box] + np.stack([across, down], axis=1), box


def row_blocks(count: int, size: int, *, overlap: int = 0) -> Iterator[slice]:
    """Slices of ``size`` rows, and ``overlap`` of the next, that cover ``count``; an empty one for none."""
    for first in range(0, max(count, 1), size):
        yield slice(first, min(first + size + overlap, count))


def write_columns(path: Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> None:
    """Write columns as CSV with a header; floats as the shortest text that reads back the same value."""
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    most = max((len(array) for array in arrays.values()), default=0)
    write_blocks(path, ({name: array[rows] for name, array in arrays.items()} for rows in table_blocks(most)))


def table_blocks(count: int) -> Iterator[slice]:
    """Slices of the rows of a table, of which one at a time is in memory; see `write_blocks`."""
    return row_blocks(count, BLOCK_ROWS)


def write_blocks(path: Path, blocks: Iterable[Mapping[str, Sequence[Any] | NDArray[Any]]]) -> None:
    """Write a table that comes in blocks of rows as CSV, as `write_columns` does; memory holds one block."""
    with atomic_path(path) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for number, columns in enumerate(blocks):
            if not number:
                writer.writerow(columns)
            writer.writerows(zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True))
