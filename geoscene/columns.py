"""Tables: frozen dataclasses whose fields are columns of one length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Columns:
    """A table; each field of a subclass is a column."""

    def __len__(self) -> int:
        """Number of rows."""
        return len(getattr(self, fields(self)[0].name))

    def take(self, rows: NDArray[np.bool_] | NDArray[np.integer[Any]] | int) -> Self:
        """The chosen rows, in the given order."""
        return type(self)(*(getattr(self, f.name)[rows] for f in fields(self)))

    @classmethod
    def concatenate(cls, tables: Sequence[Self]) -> Self:
        """All rows of one or more tables, in order."""
        return cls(*(np.concatenate([getattr(table, f.name) for table in tables]) for f in fields(cls)))
