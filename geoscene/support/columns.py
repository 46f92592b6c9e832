"""Tables: frozen dataclasses whose arrays are columns of one length."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray


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


def row_blocks(count: int, size: int, *, overlap: int = 0) -> Iterator[slice]:
    """Slices of ``size`` rows, and ``overlap`` of the next, that cover ``count``; an empty one for none."""
    for first in range(0, max(count, 1), size):
        yield slice(first, min(first + size + overlap, count))
