"""Cloud-optimised LAZ (COPC 1.0, https://copc.io): an octree of samples, read in part.

Each node holds at most one point in each of 128³ cells of its cube; the points that are left go to its
children, whose cells are half as wide. Any set of levels is a sample of the map, and no point is in two
nodes. The root cube begins at the least coordinates, and its side is the largest extent: copclib takes it
from there, others from the record of COPC. Coordinates are integer counts here, so that it is exact which
cube holds a point.

Points are sorted on disk: memory is bounded, whatever the size of the map.
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.support.files import atomic_file, naming
from lidar.dataset.formats.las import Encoder, LasInfo, compressor_errors, count, read, read_chunks
from lidar.dataset.formats.table import Table

__all__ = ["count", "open_map", "read", "read_chunks"]

_GRID_BITS = 7
"""A node has 2^7 cells along each axis."""

_LEAF = 50_000
"""Points up to which a node keeps all of its cube: LAZ compresses less in small chunks."""

_ROOM = 500_000
"""Points of a cube that are kept in memory; more go to a file."""

_CHUNK = 1_000_000
"""Points of a file that are read at a time."""

_HEADER, _VLR, _INFO = 375, 54, 160
"""Bytes of the header of LAS 1.4, of that of a variable-length record, and of COPC's record."""

_ENTRY = np.dtype([("key", "<i4", 4), ("offset", "<u8"), ("size", "<i4"), ("points", "<i4")])
"""A node in the hierarchy: level, x, y and z; place, bytes and points of its chunk."""

Key = tuple[int, int, int, int]


@contextmanager
def open_map(path: Path, info: LasInfo, *, columns: tuple[str, ...]) -> Iterator[Callable[[Table], None]]:
    """Yield a function that appends tables to a map; columns as in `las.open_las`, and a colour."""
    encoder = Encoder(path, info, columns=(*columns, "red", "green", "blue"))
    path.parent.mkdir(parents=True, exist_ok=True)
    with naming(path), _Bucket(path.parent, encoder.layout.kinds) as root:
        yield lambda table: root.append(encoder.records(table))
        with atomic_file(path) as file, compressor_errors(path):
            _write(file, root, encoder=encoder)


class _Bucket:
    """Point records in order; in memory as long as they are few, then in an unnamed file."""

    def __init__(self, folder: Path, kinds: np.dtype[np.void]) -> None:
        self._folder, self.kinds = folder, kinds
        self._parts: list[NDArray[np.void]] = []
        self._file: IO[bytes] | None = None
        self._in_memory, self.count = 0, 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._parts.clear()
        if self._file is not None:
            self._file.close()

    def append(self, records: NDArray[np.void]) -> None:
        """Append records."""
        if not len(records):
            return
        self._parts.append(records)
        self._in_memory, self.count = self._in_memory + len(records), self.count + len(records)
        if self._in_memory > _ROOM:
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 - closed at the exit
            for part in self._parts:
                self._file.write(np.ascontiguousarray(part).data)
            self._parts, self._in_memory = [], 0

    def chunks(self) -> Iterator[NDArray[np.void]]:
        """The records, some at a time."""
        if self._file is not None:
            self._file.seek(0)
            while data := self._file.read(_CHUNK * self.kinds.itemsize):
                yield np.frombuffer(data, self.kinds)
        if self._parts:
            yield np.concatenate(self._parts)

    def children(self) -> list[_Bucket]:
        """Eight empty buckets."""
        return [_Bucket(self._folder, self.kinds) for _ in range(8)]


class _Facts:
    """Facts of all points, which the header states.

    low, high : (3,) least and greatest counts of coordinates
    gps       : least and greatest GPS time
    by_return : (16,) points by the number of their return
    """

    def __init__(self, points: _Bucket) -> None:
        low, high, gps = [], [], []
        self.by_return = np.zeros(16, np.uint64)
        for chunk in points.chunks():
            low.append([chunk[axis].min() for axis in "XYZ"])
            high.append([chunk[axis].max() for axis in "XYZ"])
            gps += [chunk["gps_time"].min(), chunk["gps_time"].max()]
            self.by_return += np.bincount(chunk["bit_fields"] & 15, minlength=16).astype(np.uint64)
        self.low = np.min(low or [[0, 0, 0]], axis=0).astype(np.int64)
        self.high = np.max(high or [[0, 0, 0]], axis=0).astype(np.int64)
        self.gps = (float(min(gps, default=0.0)), float(max(gps, default=0.0)))

    @property
    def side(self) -> int:
        """The root cube's side, counts."""
        return max(1, int((self.high - self.low).max()))


def _nodes(points: _Bucket, key: Key, *, low: NDArray[np.int64], side: int) -> Iterator[tuple[Key, Any]]:
    """Keys and point records of a node and of all below it; the bucket is closed.

    low  : (3,) least corner of the root cube, counts
    side : of the root cube, counts
    """
    depth = key[0] + _GRID_BITS
    with points, ExitStack() as stack:
        if points.count <= _LEAF or side < 1 << depth:
            yield key, np.concatenate([np.empty(0, points.kinds), *points.chunks()])
            return
        children = [stack.enter_context(child) for child in points.children()]
        taken, sample = np.zeros(1 << 3 * _GRID_BITS, np.bool_), []
        for chunk in points.chunks():
            octant = np.empty(len(chunk), np.int8)
            _sample(chunk["X"], chunk["Y"], chunk["Z"], low, side, depth, taken, octant)
            sample.append(chunk.take(np.flatnonzero(octant < 0)))  # records: far faster than by a mask
            for number, child in enumerate(children):
                child.append(chunk.take(np.flatnonzero(octant == number)))
        points.__exit__()
        yield key, np.concatenate(sample)
        level, *place = key
        for number, child in enumerate(children):
            if child.count:
                x, y, z = (2 * at + (number >> axis & 1) for axis, at in enumerate(place))
                yield from _nodes(child, (level + 1, x, y, z), low=low, side=side)


@njit(cache=True, nogil=True)
def _sample(  # noqa: PLR0917 - compiled
    x: Any, y: Any, z: Any, low: Any, side: int, depth: int, taken: Any, octant: Any
) -> None:
    """Fill ``octant``: -1 for the first point in a cell that is not taken, else the child, x its lowest bit.

    depth : the root cube has 2^depth cells along each axis; points on its upper faces are in the last ones
    """
    last, cells, half = (1 << depth) - 1, (1 << _GRID_BITS) - 1, _GRID_BITS - 1
    for k in range(len(x)):
        i = min(((np.int64(x[k]) - low[0]) << depth) // side, last) & cells
        j = min(((np.int64(y[k]) - low[1]) << depth) // side, last) & cells
        m = min(((np.int64(z[k]) - low[2]) << depth) // side, last) & cells
        cell = (m << _GRID_BITS | j) << _GRID_BITS | i
        if taken[cell]:
            octant[k] = i >> half | j >> half << 1 | m >> half << 2
        else:
            taken[cell] = True
            octant[k] = -1


def _write(file: IO[bytes], points: _Bucket, *, encoder: Encoder) -> None:
    """Write the whole file. Byte offsets are those of LAS 1.4 R15 (table 3) and of COPC 1.0."""
    import lazrs  # noqa: PLC0415

    facts, header, count = _Facts(points), encoder.layout.header, points.count
    laz = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    start = bytearray(encoder.layout.start)
    records = _record("copc", 1, data=bytes(_INFO)), _record("laszip encoded", 22204, data=laz.record_data())
    start[_HEADER:_HEADER] = records[0]
    start += records[1]
    struct.pack_into("<II", start, 96, len(start), struct.unpack_from("<I", start, 100)[0] + 2)
    start[104] |= 128  # compressed
    scale, offset = header.scales, header.offsets
    if count:
        bounds = np.stack([facts.high, facts.low], axis=1) * scale[:, None] + offset[:, None]
        start[179:227] = bounds.astype("<f8").tobytes()
        start[247:375] = np.array([count, *facts.by_return[1:]], "<u8").tobytes()
    file.write(start)

    compressor = lazrs.LasZipCompressor(file, laz)
    keys: list[Key] = []
    for key, node in _nodes(points, (0, 0, 0, 0), low=facts.low, side=facts.side):
        if keys:
            compressor.finish_current_chunk()
        keys.append(key)
        compressor.compress_many(np.frombuffer(node.tobytes(), np.uint8))
    compressor.done()
    entries = _hierarchy(file, laz, keys=keys, start=len(start))
    end = file.seek(0, 2)
    file.write(_record("copc", 1000, data=entries.tobytes(), extended=True))

    centre = (facts.low + facts.side / 2) * scale + offset
    width = float(facts.side * scale[0])
    place = end + 60, entries.nbytes
    file.seek(_HEADER + _VLR)
    file.write(struct.pack("<5d2Q2d", *centre, width / 2, width / (1 << _GRID_BITS), *place, *facts.gps))
    file.seek(235)
    file.write(struct.pack("<QI", end, 1))


def _record(user: str, number: int, *, data: bytes, extended: bool = False) -> bytes:
    """A variable-length record."""
    layout = "<H16sHQ32s" if extended else "<H16sHH32s"
    return struct.pack(layout, 0, user.encode(), number, len(data), b"") + data


def _hierarchy(file: IO[bytes], laz: Any, *, keys: list[Key], start: int) -> NDArray[np.void]:
    """The entries (n,) of all nodes, on one page; without points that of an empty root."""
    import lazrs  # noqa: PLC0415

    entries = np.zeros(len(keys), _ENTRY)
    entries["key"] = keys
    file.seek(start)
    chunks = np.array(lazrs.read_chunk_table(file, laz), np.int64)
    if chunks[:, 0].any():
        entries["points"], entries["size"] = chunks.T
        ends = start + 8 + np.cumsum(entries["size"], dtype=np.int64)  # after the place of the chunk table
        entries["offset"] = ends - entries["size"]
    return entries
