"""Archives of arrays, compressed files and TOML that may be damaged or hostile.

They raise errors, reserve no memory for what they only state, and are unpacked to a limit.
"""

from __future__ import annotations

import bz2
import functools
import gzip
import os
import threading
import tomllib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, BytesIO, RawIOBase
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


VARIABLE = "GEOSCENE_UNPACK_RATIO"
"""Environment variable with the greatest ratio of a file's size unpacked and packed."""

_RATIO = 50.0
"""The ratio by default: extracts of maps are unpacked to 20 times their size at most, tiles to 5 times."""

_ALWAYS = 2**26
"""Bytes to which any file may be unpacked."""


class TooLargeError(ValueError):
    """A file that would be unpacked to far more than its size."""


def unpacked_limit(packed: int) -> float:
    """Bytes to which a file of some bytes may be unpacked.

    Raises TooLargeError for a value of `VARIABLE` that is no ratio.
    """
    text = os.environ.get(VARIABLE, "")
    try:
        ratio = float(text or _RATIO)
    except ValueError:
        ratio = 0.0
    if not ratio >= 1:
        raise TooLargeError(f"{VARIABLE}={text}: give a ratio of 1 or more, such as 200, or inf")
    return max(_ALWAYS, packed * ratio)


def _too_large(packed: int) -> TooLargeError:
    return TooLargeError(
        f"is unpacked to more than {unpacked_limit(packed) / 2**20:.0f} MiB from {packed / 2**20:.1f} MiB,"
        f" as files made to fill the memory are; set {VARIABLE} to a greater ratio if that is right"
    )


class _Limited(RawIOBase):
    """An unpacked stream that ends with TooLargeError beyond a number of bytes."""

    def __init__(self, file: IO[bytes], packed: int) -> None:
        self._file, self._packed, self._left = file, packed, unpacked_limit(packed)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        data = self._file.read(len(buffer))
        buffer[: len(data)] = data
        self._left -= len(data)
        if self._left < 0:
            raise _too_large(self._packed)
        return len(data)


@contextmanager
def open_unpacked(path: Path, packing: str) -> Iterator[IO[bytes]]:
    """Yield the bytes of a file that is packed by ``.gz`` or ``.bz2``, or not at all (empty).

    Reading beyond `unpacked_limit` raises TooLargeError; damage raises the errors of gzip and bz2.
    """
    with path.open("rb") as raw:
        if not packing:
            yield raw
            return
        unpack: Any = {".gz": gzip.open, ".bz2": bz2.open}[packing]
        with unpack(raw, "rb") as file, BufferedReader(_Limited(file, path.stat().st_size)) as limited:
            yield limited


def read_arrays(source: Path | IO[bytes]) -> dict[str, NDArray[Any]]:
    """The arrays of an .npz file by name; none of objects.

    Members must be as long as their headers state, before memory is reserved for them: `numpy.load` reserves
    what a header states.

    Raises one of `DAMAGED_ARCHIVE` for a damaged file.
    """
    with zipfile.ZipFile(source) as archive:
        entries = [entry for entry in archive.infolist() if entry.filename.endswith(".npy")]
        packed = sum(entry.compress_size for entry in entries)
        if sum(entry.file_size for entry in entries) > unpacked_limit(packed):
            raise _too_large(packed)
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
