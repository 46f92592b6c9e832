"""Files of signed digests: of each frame, and of the frames of a sensor. Other bytes never mean the same."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar.errors import FormatError
from lidar.tools.integrity.merkle import BLOCK_BYTES, BlockDigests, file_leaf, merkle_root

_BLOCK = np.dtype([("block", "<u4"), ("digest", "u1", BLOCK_BYTES)])
_HEADER = "frame,time_ns,root,link"


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
        raise FormatError(f"{path}: damaged ({error})") from None
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
        raise FormatError(f"{path}: damaged ({error})") from None
    if links_bytes(links) != data:
        raise FormatError(f"{path}: damaged (bytes that are not of a list of frames)")
    return links
