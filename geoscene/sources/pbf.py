"""Texts of PBF files that are too long for libosmium, which refuses the whole file."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

_LARGEST_BLOCK = 2**25
"""Bytes of an unpacked block at most, by the format's description."""

_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
"""Wire types of Protocol Buffers."""


def rewrite_texts(path: Path, out: Path, *, changed: Callable[[bytes], bytes]) -> None:
    """Write a PBF file with other texts (keys, values, roles, names of users) to ``out``.

    changed : text that replaces a given one; both are UTF-8

    Raises ValueError for a damaged file, and for blocks that are packed by another method than zlib.
    """
    with path.open("rb") as file, out.open("wb") as target:
        while size := file.read(4):
            header = file.read(int.from_bytes(size, "big"))
            found = {number: value for number, value, _ in _fields(header)}
            blob = file.read(int.from_bytes(found[3], "little"))
            if found[1] == b"OSMData":
                block = _unpacked(blob)
                if (new := _with_texts(block, changed)) != block:
                    blob = _field(2, len(new)) + _field(3, zlib.compress(new, 1))
                    header = _field(1, found[1]) + _field(3, len(blob))
            target.write(len(header).to_bytes(4, "big") + header + blob)


def _unpacked(blob: bytes) -> bytes:
    """The block in a blob."""
    found = {number: value for number, value, _ in _fields(blob)}
    if 1 in found:
        return found[1]
    if 3 not in found:
        raise ValueError("blocks that are packed by another method than zlib")
    block = zlib.decompressobj().decompress(found[3], _LARGEST_BLOCK + 1)
    if len(block) > _LARGEST_BLOCK:
        raise ValueError("a block that is larger than the format allows")
    return block


def _with_texts(block: bytes, changed: Callable[[bytes], bytes]) -> bytes:
    """A block with other texts in its table, which is its first field."""
    parts = []
    for number, value, whole in _fields(block):
        if number != 1:
            parts.append(whole)
            continue
        texts = b"".join(_field(1, changed(text)) for _, text, _ in _fields(value))
        parts.append(_field(1, texts))
    return b"".join(parts)


def _fields(message: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Number, value and bytes of each field of a message; values of numbers are little-endian."""
    at = 0
    while at < len(message):
        start = at
        key, at = _varint(message, at)
        kind = key & 7
        if kind == _VARINT:
            number, at = _varint(message, at)
            value = number.to_bytes(10, "little")
        else:
            size, at = _varint(message, at) if kind == _BYTES else ({_EIGHT: 8, _FOUR: 4}[kind], at)
            value, at = message[at : at + size], at + size
        if at > len(message):
            raise ValueError("a block that ends too early")
        yield key >> 3, value, message[start:at]


def _varint(message: bytes, at: int) -> tuple[int, int]:
    """The number at a place of a message, and the place after it."""
    number = shift = 0
    while True:
        byte = message[at]
        number |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return number, at
        if shift > 63:
            raise ValueError("a number that is too large")


def _field(number: int, value: bytes | int) -> bytes:
    """A field of a message."""
    if isinstance(value, int):
        return _packed(number << 3 | _VARINT) + _packed(value)
    return _packed(number << 3 | _BYTES) + _packed(len(value)) + value


def _packed(number: int) -> bytes:
    """A number as a varint."""
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes((*found, number))
