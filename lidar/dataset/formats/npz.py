"""NPZ: an array a column, as `numpy.load` reads it without pickles."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from geoscene.errors import reason_of
from geoscene.support.files import atomic_file
from geoscene.support.untrusted import DAMAGED_ARCHIVE, array_header, read_arrays
from lidar.dataset.formats.table import Table, rows
from lidar.errors import FormatError


def write(path: Path, table: Table) -> None:
    """Write a table as NPZ, not compressed."""
    rows(table)
    with atomic_file(path) as file:
        np.savez(file, allow_pickle=False, **table)


def read(path: Path) -> Table:
    """The table of an NPZ file.

    Raises FormatError for a file without x, y and z, or with arrays that are no columns of numbers.
    """
    try:
        table = read_arrays(io.BytesIO(path.read_bytes()))
    except DAMAGED_ARCHIVE as error:
        raise FormatError(f"{path}: not a readable NPZ file ({reason_of(error)})") from error
    for name, column in table.items():
        if column.ndim != 1 or column.dtype.kind not in "iuf":
            raise FormatError(
                f"{path}: {name} is no column of numbers ({column.dtype} of shape {column.shape})"
            )
    if lacks := [axis for axis in "xyz" if axis not in table]:
        raise FormatError(f"{path}: has no array {', '.join(lacks)}")
    lengths = {len(column) for column in table.values()}
    if len(lengths) > 1:
        raise FormatError(f"{path}: its arrays differ in length ({', '.join(map(str, sorted(lengths)))})")
    return table


def count(path: Path) -> int:
    """Number of points of a file."""
    try:
        with zipfile.ZipFile(path) as file, file.open("x.npy") as member:
            return array_header(member)[0][0]
    except DAMAGED_ARCHIVE as error:
        raise ValueError(reason_of(error)) from error
