"""NPZ: an array a column, as `numpy.load` reads it without pickles."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from geoscene.files import atomic_file
from lidar.dataset.formats.table import Table, rows
from lidar.errors import FormatError

_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, KeyError, ValueError, SyntaxError, EOFError, OSError),
    *(NotImplementedError, RuntimeError),
)
"""What damaged archives and headers of arrays raise."""


def write(path: Path, table: Table) -> None:
    """Write a table as NPZ, not compressed."""
    rows(table)
    with atomic_file(path) as file:
        np.savez(file, allow_pickle=False, **table)


def read(path: Path) -> Table:
    """The table of an NPZ file.

    Raises FormatError for a file without x, y and z, or with arrays that are no columns of numbers.
    """
    data = io.BytesIO(path.read_bytes())
    try:
        with zipfile.ZipFile(data) as file:
            names = [entry for entry in file.infolist() if entry.filename.endswith(".npy")]
            table = {entry.filename.removesuffix(".npy"): _column(file, entry) for entry in names}
    except _DAMAGE as error:
        raise FormatError(f"{path}: not a readable NPZ file ({error})") from error
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
            return _shape(member)[0][0]
    except _DAMAGE as error:
        raise ValueError(str(error)) from error


def _shape(member: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of the array in a file of an archive."""
    version = np.lib.format.read_magic(member)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = header(member)
    return shape, kind


def _column(file: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """A column of numbers; raises ValueError for anything else."""
    with file.open(entry) as member:
        shape, kind = _shape(member)
        if len(shape) != 1 or kind.kind not in "iuf":
            raise ValueError(f"{entry.filename}: {kind} of shape {shape} is no column of numbers")
        # Readers allocate what the header states.
        if member.tell() + shape[0] * kind.itemsize != entry.file_size:
            raise ValueError(f"{entry.filename}: states {shape[0]} numbers, which it does not hold")
        return np.frombuffer(member.read(), kind)
