"""Digests of clouds by block, Merkle trees over them (RFC 9162), chains of frames, and their files.

Every digest is SHA-256; those of blocks are cut to 16 bytes. Other bytes of a file never mean the same.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.typing import Ints
from lidar.errors import FormatError

SECTORS = 36
"""Sectors of a turn, 10 degrees each."""

BLOCK_BYTES = 16
"""Bytes of a block's digest: finding another block with the same one takes 2^128 trials."""

START = bytes(32)
"""What a chain's first link follows."""

_BLOCK = np.dtype([("block", "<u4"), ("digest", "u1", BLOCK_BYTES)])
_HEADER = "frame,time_ns,root,link"


def block_of(xyz: NDArray[np.floating], ring: NDArray[np.integer]) -> Ints:
    """Block (n,) of points in the sensor frame: ring times `SECTORS` plus sector.

    Sectors count from 0 at -180 degrees, to the left.
    """
    turn = np.arctan2(xyz[:, 1].astype(np.float64), xyz[:, 0].astype(np.float64)) / (2 * np.pi) + 0.5
    return ring.astype(np.int64) * SECTORS + np.minimum((turn * SECTORS).astype(np.int64), SECTORS - 1)


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
        block = block_of(np.column_stack([table["x"], table["y"]]), ring)
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


@dataclass(frozen=True)
class FrameDigests:
    """Digests of the files of a frame.

    sha256 : by path
    blocks : of point clouds, by path
    """

    sha256: dict[str, bytes]
    blocks: dict[str, BlockDigests]

    @property
    def root(self) -> bytes:
        """Root of the Merkle tree over the files."""
        return merkle_root(
            file_leaf(name, sha256, blocks=self.blocks.get(name))
            for name, sha256 in sorted(self.sha256.items())
        )

    def to_bytes(self) -> bytes:
        """A line of JSON, with name, digest and number of blocks of each file, and then all blocks."""
        names = sorted(self.sha256)
        blocks = [self.blocks.get(name) for name in names]
        counts = [None if own is None else len(own.block) for own in blocks]
        rows = [[name, self.sha256[name].hex(), count] for name, count in zip(names, counts, strict=True)]
        out = json.dumps(rows, ensure_ascii=False).encode() + b"\n"
        for own in blocks:
            if own is not None:
                records = np.empty(len(own.block), _BLOCK)
                records["block"], records["digest"] = own.block, own.digest
                out += records.tobytes()
        return out


def frame_file(folder: Path, sensor: str, *, frame: int) -> Path:
    """File of the digests of a frame, in the folder ``integrity``."""
    return folder / sensor / f"{frame:06d}.digests"


def read_digests(path: Path) -> FrameDigests:
    """The signed digests of a frame.

    Raises FormatError for a file that is missing or damaged.
    """
    try:
        data = path.read_bytes()
        found = _digests(data)
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise FormatError(f"{path}: damaged ({reason_of(error)})") from None
    if found.to_bytes() != data:
        raise FormatError(f"{path}: damaged (bytes that are not of digests)")
    return found


def _digests(data: bytes) -> FrameDigests:
    head, _, body = data.partition(b"\n")
    sha256, blocks, at = dict[str, bytes](), dict[str, BlockDigests](), 0
    for name, digest, count in json.loads(head):
        sha256[str(name)] = bytes.fromhex(digest)
        if count is not None:
            records = np.frombuffer(body, _BLOCK, int(count), at)
            at += records.nbytes
            blocks[str(name)] = BlockDigests(records["block"].astype(np.int64), records["digest"])
    return FrameDigests(sha256, blocks)


@dataclass(frozen=True, slots=True)
class Link:
    """A link of the chain of a sensor.

    root : of the frame's files
    link : digest of the link before and of this frame
    """

    frame: int
    time_ns: int
    root: bytes
    link: bytes


def links_bytes(links: Sequence[Link]) -> bytes:
    """The table of the links of a sensor, CSV with a header."""
    rows = [f"{own.frame},{own.time_ns},{own.root.hex()},{own.link.hex()}" for own in links]
    return ("\n".join([_HEADER, *rows]) + "\n").encode()


def read_links(path: Path) -> list[Link]:
    """The links of a sensor.

    Raises FormatError for a file that is missing or damaged.
    """
    try:
        data = path.read_bytes()
        cells = [line.split(",") for line in data.decode("ascii").splitlines()[1:]]
        links = [Link(int(a), int(b), bytes.fromhex(c), bytes.fromhex(d)) for a, b, c, d in cells]
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: damaged ({reason_of(error)})") from None
    if links_bytes(links) != data:
        raise FormatError(f"{path}: damaged (bytes that are not of a list of frames)")
    return links
