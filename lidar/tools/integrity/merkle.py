"""Digests of clouds by block, Merkle trees over them (RFC 9162), and chains of frames.

Every digest is SHA-256; those of blocks are cut to 16 bytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Ints
from lidar.tools.integrity.blocks import SECTORS, sectors

BLOCK_BYTES = 16
"""Bytes of a block's digest: finding another block with the same one takes 2^128 trials."""

START = bytes(32)
"""What a chain's first link follows."""


@dataclass(frozen=True)
class BlockDigests:
    """Digests of the blocks of a cloud, in order of their numbers.

    block  : (b,) ring times `SECTORS` plus sector
    digest : (b, 16) uint8
    """

    block: Ints
    digest: NDArray[np.uint8]

    @property
    def root(self) -> bytes:
        """Root of the Merkle tree over the blocks."""
        numbers = self.block.astype("<u4")
        return merkle_root(
            number.tobytes() + row.tobytes() for number, row in zip(numbers, self.digest, strict=True)
        )

    def changed(self, other: BlockDigests) -> Ints:
        """Blocks (k,) that differ from those of another cloud, or are in one of both."""
        own = dict(zip(self.block.tolist(), map(bytes, self.digest), strict=True))
        others = dict(zip(other.block.tolist(), map(bytes, other.digest), strict=True))
        numbers = sorted(own.keys() | others.keys())
        return np.array([number for number in numbers if own.get(number) != others.get(number)], np.int64)


def block_digests(table: Mapping[str, NDArray[Any]], *, rate_hz: float = 0.0) -> BlockDigests:
    """Digests of the blocks of a cloud's table, of all its columns.

    Rows are put in order of block, column, echo and time, so that their order in a file is free; numbers are
    taken as they are, little-endian.

    rate_hz : of the scanner; a table with ``gps_time``, which is in the world frame, is cut into 36 parts
              of a turn by time instead of azimuth
    """
    rows = len(table["x"])
    ring = table.get("ring", np.zeros(rows, np.uint16)).astype(np.int64)
    if "gps_time" in table:
        part = np.nan_to_num(np.abs(table["gps_time"])) % 1e6 * rate_hz * SECTORS % SECTORS
        block = ring * SECTORS + np.minimum(part.astype(np.int64), SECTORS - 1)
    else:
        block = ring * SECTORS + sectors(np.column_stack([table["x"], table["y"]]))
    within = [table[name] for name in ("gps_time", "time_ns", "echo", "column") if name in table]
    order = np.lexsort((*within, block))
    kinds = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in table.items()])
    records = np.empty(rows, kinds)
    for name, column in table.items():
        records[name] = column[order]
    numbers, first = np.unique(block[order], return_index=True)
    data, head = memoryview(records.tobytes()), repr(kinds.descr).encode()
    ends = [*first[1:].tolist(), rows][: len(numbers)]
    out = np.empty((len(numbers), BLOCK_BYTES), np.uint8)
    for k, (begin, end) in enumerate(zip(first.tolist(), ends, strict=True)):
        digest = hashlib.sha256(head)
        digest.update(data[begin * kinds.itemsize : end * kinds.itemsize])
        out[k] = np.frombuffer(digest.digest()[:BLOCK_BYTES], np.uint8)
    return BlockDigests(numbers, out)


def merkle_root(leaves: Iterable[bytes]) -> bytes:
    """Root of the tree over leaves in order; leaves and nodes are hashed apart."""
    level = [hashlib.sha256(b"\x00" + leaf).digest() for leaf in leaves]
    if not level:
        return hashlib.sha256().digest()
    while len(level) > 1:
        pairs = zip(level[::2], level[1::2], strict=False)
        odd = level[-1:] if len(level) % 2 else []
        level = [hashlib.sha256(b"\x01" + left + right).digest() for left, right in pairs] + odd
    return level[0]


def file_leaf(name: str, sha256: bytes, *, blocks: BlockDigests | None) -> bytes:
    """Leaf of a file in its frame's tree: name, digest of the bytes and root of the blocks."""
    root = b"" if blocks is None else blocks.root
    return len(name.encode()).to_bytes(4, "little") + name.encode() + sha256 + root


def link(former: bytes, *, sensor: str, frame: int, time_ns: int, root: bytes) -> bytes:
    """A frame's link of the chain of its sensor: digest of the link before, the frame's time and its root."""
    text = f"{sensor}\n{frame}\n{time_ns}\n".encode()
    return hashlib.sha256(former + text + root).digest()


def signed_message(heads: Mapping[str, tuple[int, bytes]], tables: Mapping[str, bytes]) -> bytes:
    """The signed message: root over the last links of all sensors and the digests of all other files.

    heads  : number of frames and last link, by sensor
    tables : digest by path
    """
    lines: Sequence[bytes] = [
        *(f"sensor {name} {frames} ".encode() + head for name, (frames, head) in sorted(heads.items())),
        *(f"file {name} ".encode() + sha256 for name, sha256 in sorted(tables.items())),
    ]
    return b"lidar integrity 1 " + merkle_root(lines)
