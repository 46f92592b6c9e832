"""Archives of arrays, and TOML, that may be damaged or hostile: they raise errors and reserve no memory."""

from __future__ import annotations

import functools
import threading
import tomllib
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

DAMAGED_ARCHIVE = (
    *(zipfile.BadZipFile, zlib.error, KeyError, ValueError, SyntaxError, EOFError, OSError),
    *(NotImplementedError, RuntimeError),
)
"""What `read_arrays` raises for a damaged file."""

_PARSING = threading.Lock()
"""NumPy parses headers as Python, which fails now and then in CPython 3.11 if two threads do so."""


_LONGEST = 10_000
"""Bytes of a header at most, as NumPy has it."""


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file by name; none of objects.

    Members must be as long as their headers state, before memory is reserved for them: `numpy.load` reserves
    what a header states.

    Raises one of `DAMAGED_ARCHIVE` for a damaged file.
    """
    with zipfile.ZipFile(source) as archive:
        entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
        return {entry.filename.removesuffix(".npy"): _array(archive, entry) for entry in entries}


def array_header(member: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, whether it is stored by columns, and type of the array in a member of an .npz file."""
    version = np.lib.format.read_magic(member)
    size = member.read(2 if version == (1, 0) else 4)
    return _parse(version, size + member.read(min(int.from_bytes(size, "little"), _LONGEST)))


@functools.lru_cache(maxsize=4096)  # columns of one table have one header
def _parse(version: tuple[int, int], header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with _PARSING:
        shape, by_columns, kind = read(BytesIO(header))
    return shape, by_columns, kind


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(entry) as member:
        shape, by_columns, kind = array_header(member)
        if kind.hasobject:
            raise ValueError(f"{entry.filename}: holds objects, not numbers")
        count = 1
        for side in shape:  # whole numbers of Python do not overflow
            count *= side
        if min(shape, default=0) < 0 or member.tell() + count * kind.itemsize != entry.file_size:
            raise ValueError(f"{entry.filename}: states {count} values, which it does not hold")
        data: NDArray[Any] = np.frombuffer(bytearray(member.read()), kind, count)
    return data.reshape(shape, order="F" if by_columns else "C")


def read_toml(text: str) -> dict[str, Any]:
    """The document of a TOML text.

    Raises `tomllib.TOMLDecodeError`, also for a text that nests too deeply and for endless numbers.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError:
        raise tomllib.TOMLDecodeError("arrays or tables nest too deeply") from None
    except ValueError as error:  # of numbers
        raise tomllib.TOMLDecodeError(str(error)) from None
