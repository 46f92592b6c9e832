"""LZF, the compression of PCD: the format of Lehmann's LibLZF, which PCL carries.

A control byte below 32 precedes that many literal bytes, and one. A greater one repeats earlier bytes: its
upper three bits are the length less 2 (7: the next byte is added), the lower five and the next byte the
distance less 1.
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit

_LITERALS = 32
_FARTHEST = 1 << 13
_LONGEST = 2 + 7 + 255
_HASH_BITS = 16

GREATEST_RATIO = _LONGEST // 3 + 1
"""Bytes that a byte of compressed data stands for, at most."""


def compress(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Compress bytes; the same bytes give the same result."""
    room = np.empty(len(data) + len(data) // _LITERALS + 2, np.uint8)
    return room[: _compress(data, room, np.full(1 << _HASH_BITS, -1, np.int64))]


def decompress(data: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """The ``size`` bytes that were compressed.

    Raises ValueError for damaged data.
    """
    if size > len(data) * GREATEST_RATIO:
        raise ValueError(f"{len(data)} compressed bytes cannot hold {size}")
    out = np.empty(size, np.uint8)
    if not _decompress(data, out):
        raise ValueError("compressed bytes that do not decode to the stated size")
    return out


@njit(cache=True, nogil=True)
def _hash(data: Any, at: Any) -> Any:
    """Hash of three bytes."""
    word = np.uint32(data[at]) << 16 | np.uint32(data[at + 1]) << 8 | np.uint32(data[at + 2])
    return np.int64((np.uint32(word) * np.uint32(2654435761)) & np.uint32(0xFFFFFFFF)) >> (32 - _HASH_BITS)


@njit(cache=True, nogil=True)
def _compress(data: Any, out: Any, latest: Any) -> int:  # noqa: PLR0917 - compiled
    """Compress into ``out``; return the number of bytes.

    latest : position of the latest three bytes of each hash, -1 for none
    """
    n = len(data)
    at, end, control, literals = 0, 1, 0, 0
    while at < n:
        length = 0
        if at + 2 < n:
            key = _hash(data, at)
            past = latest[key]
            latest[key] = at
            if past >= 0 and at - past <= _FARTHEST:
                limit = min(n - at, _LONGEST)
                while length < limit and data[past + length] == data[at + length]:
                    length += 1
        if length < 3:
            out[end] = data[at]
            at, end, literals = at + 1, end + 1, literals + 1
            if literals == _LITERALS:
                out[control] = literals - 1
                control, end, literals = end, end + 1, 0
            continue
        if literals:
            out[control] = literals - 1
        else:  # the byte kept for the control of literals is not needed
            end -= 1
        away, more = at - past - 1, length - 2
        out[end] = away >> 8 | min(more, 7) << 5
        end += 1
        if more >= 7:
            out[end] = more - 7
            end += 1
        out[end] = away & 255
        control, end, literals = end + 1, end + 2, 0
        at += length
        for inner in (at - 2, at - 1):
            if inner + 2 < n:
                latest[_hash(data, inner)] = inner
    if literals:
        out[control] = literals - 1
        return end
    return end - 1


@njit(cache=True, nogil=True)
def _decompress(data: Any, out: Any) -> bool:
    """Fill ``out``; return whether the data are whole and of its size."""
    at, end, n, size = 0, 0, len(data), len(out)
    while at < n:
        control = int(data[at])
        at += 1
        if control < _LITERALS:
            run = control + 1
            if at + run > n or end + run > size:
                return False
            for k in range(run):
                out[end + k] = data[at + k]
            at, end = at + run, end + run
            continue
        run = (control >> 5) + 2
        if run == 9:
            if at >= n:
                return False
            run += int(data[at])
            at += 1
        if at >= n:
            return False
        past = end - ((control & 31) << 8 | int(data[at])) - 1
        at += 1
        if past < 0 or end + run > size:
            return False
        for k in range(run):
            out[end + k] = out[past + k]
        end += run
    return end == size
