"""Writes tables as CSV, of which one block of rows at a time is formatted."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import row_blocks
from geoscene.support.files import atomic_path

BLOCK_ROWS = 1 << 16
"""Rows of a table that are formatted at once."""


def write_columns(path: Path, columns: Mapping[str, Sequence[Any] | NDArray[Any]]) -> None:
    """Write columns as CSV with a header; floats as the shortest text that reads back the same value."""
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    most = max((len(array) for array in arrays.values()), default=0)
    write_blocks(
        path,
        ({name: array[rows] for name, array in arrays.items()} for rows in table_blocks(most)),
    )


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
