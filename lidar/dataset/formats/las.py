"""LAS 1.4 and LAZ: projected coordinates, CRS as WKT, ASPRS classes, GPS time."""

from __future__ import annotations

import errno
import functools
import io
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

import geoscene.errors
from geoscene.classes import class_codes
from geoscene.support import las_files
from geoscene.support.compiled import njit
from geoscene.support.files import atomic_path
from lidar.dataset.formats import FORMATS
from lidar.dataset.formats.table import Table, rows
from lidar.errors import DamagedFileError, FormatError

SCALE = FORMATS["las"].step
"""Metres per count of a coordinate by default; the rounding error is at most half of it along each axis."""

SCAN_ANGLE_STEP = 0.006
"""Degrees per count of a scan angle in point formats 6 to 10."""

INTENSITY_UNIT = 257.0
"""LAS intensity (16 bits) per unit of calibrated reflectivity (0 to 255)."""

_FULL = 2**20
"""Bytes of free space below which the disk counts as full: the compressor writes in large pieces."""

_EXTRA = {
    "ring": ("uint16", "beam, 0 = lowest elevation"),
    "label": ("uint8", "geoscene class"),
    "instance": ("int32", "feature in the scene"),
    "range": ("float32", "metres, as reported"),
    "incidence": ("float32", "rad, beam to normal"),
    "true_range": ("float32", "metres, without noise"),
    "velocity": ("float32", "m/s along the beam, + away"),
    "frame": ("uint32", "frame of the scanner"),
}


@dataclass(frozen=True, slots=True)
class LasInfo:
    """Properties that all files of a dataset share.

    crs     : of the coordinates; written as WKT
    offset  : (3,) whole metres near the data
    created : date in the header: the drive's, so that the same drive gives the same bytes
    scale   : metres per count of a coordinate
    """

    crs: CRS = field(hash=False)  # its hash takes as long as writing its WKT
    offset: tuple[float, float, float]
    created: datetime
    scale: float = SCALE


@dataclass(frozen=True)
class _Layout:
    """Properties that all files with the same columns share.

    header : laspy's header, with the CRS
    start  : bytes of an uncompressed file without points
    kinds  : data type of a point record
    """

    header: Any
    start: bytes
    kinds: np.dtype[np.void]


@functools.lru_cache(maxsize=16)
def _layout(info: LasInfo, extra: tuple[str, ...], *, colour: bool) -> _Layout:
    import laspy  # noqa: PLC0415  (0.4 s)

    header = laspy.LasHeader(version="1.4", point_format=7 if colour else 6)
    header.scales = np.full(3, info.scale)
    header.offsets = np.asarray(info.offset, float)
    header.add_crs(info.crs)
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.creation_date = info.created.date()
    header.system_identifier = "simulated"
    header.generating_software = "geoscene lidar"
    header.add_extra_dims([laspy.ExtraBytesParams(n, _EXTRA[n][0], _EXTRA[n][1]) for n in extra])
    for one in header.vlrs.get("ExtraBytesVlr"):
        for column in one.extra_bytes_structs:
            column.options &= ~0b110  # no minimum and maximum: laspy writes those of one point
    start = io.BytesIO()
    laspy.LasWriter(start, header, do_compress=False, closefd=False).close()
    return _Layout(header, start.getvalue(), header.point_format.dtype())


class _Uncompressed:
    """A LAS file that points are appended to; numbers and bounds of points are entered at the end.

    Byte offsets are those of the public header block of LAS 1.4 R15 (ASPRS 2019), table 3.
    """

    def __init__(self, path: Path, layout: _Layout) -> None:
        self.dest = path.open("wb")
        self.dest.write(layout.start)
        self._offset, self._scale = layout.header.offsets, layout.header.scales
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._by_return = np.zeros(16, np.int64)

    def write_points(self, points: NDArray[np.void]) -> None:
        """Append points."""
        if not len(points):
            return
        low, high = _add_points(points["X"], points["Y"], points["Z"], points["bit_fields"], self._by_return)
        self._low = np.minimum(self._low, low * self._scale + self._offset)
        self._high = np.maximum(self._high, high * self._scale + self._offset)
        self.dest.write(points.data)

    def close(self) -> None:
        """Enter bounds and numbers of points in the header."""
        if count := int(self._by_return.sum()):
            self.dest.seek(179)
            self.dest.write(np.stack([self._high, self._low], axis=1).astype("<f8").tobytes())
            self.dest.seek(247)
            self.dest.write(np.array([count, *self._by_return[1:]], "<u8").tobytes())
        self.dest.close()


@contextmanager
def compressor_errors(path: Path) -> Iterator[None]:
    """Raise the compressor's errors, which hide their cause, as the OSError behind them."""
    import lazrs  # noqa: PLC0415

    try:
        yield
    except lazrs.LazrsError as error:
        full = shutil.disk_usage(path.parent).free < _FULL
        code = errno.ENOSPC if full else errno.EIO
        raise OSError(code, os.strerror(code), str(path)) from error


class _Compressed:
    """A LAZ file that points are appended to."""

    def __init__(self, path: Path, layout: _Layout) -> None:
        import laspy  # noqa: PLC0415

        self._path = path
        self._header = layout.header
        self._record: Any = laspy.ScaleAwarePointRecord
        self._writer: Any = laspy.open(path, mode="w", header=layout.header, do_compress=True)
        self.dest = self._writer.dest

    def write_points(self, points: NDArray[np.void]) -> None:
        """Append points."""
        h = self._header
        with compressor_errors(self._path):
            self._writer.write_points(
                self._record(points, h.point_format, scales=h.scales, offsets=h.offsets)
            )

    def close(self) -> None:
        """Write the remaining points."""
        with compressor_errors(self._path):
            self._writer.close()


class Encoder:
    """Tables as LAS point records; see `open_las` for their columns."""

    def __init__(self, path: Path, info: LasInfo, *, columns: tuple[str, ...]) -> None:
        self.path = path
        self._info = info
        self._extra = tuple(n for n in _EXTRA if n in columns)
        self._colour = "red" in columns
        self.layout = _layout(info, self._extra, colour=self._colour)

    def records(self, table: Table) -> NDArray[np.void]:
        """The point records of a table.

        Raises FormatError for coordinates too far from the offset to be counted in 32 bits.
        """
        points = np.zeros(rows(table), self.layout.kinds)
        for k, axis in enumerate("xyz"):
            origin_scale = self._info.offset[k], self._info.scale
            if not _count(np.asarray(table[axis], np.float64), *origin_scale, points[axis.upper()]):
                raise FormatError(f"{self.path}: a point lies too far from {self._info.offset} for LAS")
        points["classification"] = class_codes().asprs[table["label"]]
        one = np.ones(1, np.uint8)
        number, echoes = (np.minimum(table.get(name, one), 15) for name in ("echo", "echoes"))
        points["bit_fields"] = number | echoes << 4
        if "intensity" in table:
            points["intensity"] = np.clip(np.rint(table["intensity"] * INTENSITY_UNIT), 0, 65535)
        if "gps_time" in table:
            points["gps_time"] = table["gps_time"]
        if "source" in table:
            points["point_source_id"] = table["source"]
        if "scan_angle" in table:
            points["scan_angle"] = np.rint(table["scan_angle"] / SCAN_ANGLE_STEP)
        if "edge" in table:
            points["classification_flags"] |= table["edge"].astype(np.uint8) << 7
        for name in self._extra:
            points[name] = table[name]
        if self._colour:
            for name in ("red", "green", "blue"):
                points[name] = table[name].astype(np.uint16) * 257
        return points


@contextmanager
def open_las(path: Path, info: LasInfo, *, columns: tuple[str, ...]) -> Iterator[Callable[[Table], None]]:
    """Yield a function that appends tables to a LAS or LAZ file, by the suffix.

    columns : of the tables. They need x, y, z (projected, float64) and label; they may have gps_time,
              intensity, ring, instance, range, incidence, true_range, velocity, frame, echo, echoes (up to
              15), source (point source id), scan_angle (degrees), edge (of a flight line), red, green
              and blue. With scan_angle, a file of one source has its number as file source id
    """
    encoder = Encoder(path, info, columns=columns)
    with atomic_path(path) as part:
        sink = (_Compressed if path.suffix.lower() == ".laz" else _Uncompressed)(part, encoder.layout)
        strips: set[int] = set()

        def append(table: Table) -> None:
            if "scan_angle" in table:
                strips.update(np.unique(table["source"]).tolist())
            sink.write_points(encoder.records(table))

        try:
            yield append
            sink.close()
            if len(strips) == 1:
                _state_file_source(part, *strips)
        finally:
            with suppress(OSError):
                sink.dest.close()


@njit(cache=True, nogil=True)
def _count(coordinate: Any, offset: float, scale: float, counts: Any) -> bool:
    """Fill ``counts`` with multiples of ``scale`` from the offset; return whether all fit 32 bits."""
    fits = True
    for i in range(len(coordinate)):
        count = np.rint((coordinate[i] - offset) / scale)
        fits &= abs(count) < 2.0**31
        counts[i] = np.int32(count)
    return fits


@njit(cache=True, nogil=True)
def _add_points(x: Any, y: Any, z: Any, bits: Any, by_return: Any) -> Any:
    """Add points to the numbers (16,) of points by return; return the least and greatest counts (3,)."""
    low, high = np.array([x[0], y[0], z[0]]), np.array([x[0], y[0], z[0]])
    for i in range(len(x)):
        for k, count in enumerate((x[i], y[i], z[i])):
            low[k] = min(low[k], count)
            high[k] = max(high[k], count)
        by_return[bits[i] & 15] += 1
    return low, high


open_map = open_las


def write(path: Path, table: Table, *, info: LasInfo) -> None:
    """Write one table as LAS or LAZ, by the suffix."""
    with open_las(path, info, columns=tuple(table)) as append:
        append(table)


def _state_file_source(path: Path, number: int) -> None:
    """Enter the file source id in a header, at byte 4 (LAS 1.4 R15, table 3)."""
    with path.open("r+b") as file:
        file.seek(4)
        file.write(number.to_bytes(2, "little"))


def count(path: Path) -> int:
    """Number of points of a file, as its header states it."""
    return las_files.point_count(path)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Yield a reader of a LAS or LAZ file; raises DamagedFileError or FormatError as `read`."""
    try:
        with las_files.open_las(path, parallel=True) as reader:
            yield reader
    except geoscene.errors.DamagedFileError as error:
        raise DamagedFileError(str(error)) from error
    except OSError as error:
        raise FormatError(f"{path}: not a readable LAS or LAZ file ({error.strerror})") from error


def read(path: Path) -> Table:
    """The table of a LAS or LAZ file, coordinates in its CRS.

    Raises DamagedFileError for a damaged file, and FormatError for one that is missing or no file.
    """
    with _opened(path) as reader:
        return _table(reader.read_points(reader.header.point_count))


def read_chunks(path: Path, *, chunk: int = 1_000_000) -> Iterator[Table]:
    """The tables of a LAS or LAZ file, ``chunk`` points at a time; see `read`."""
    with _opened(path) as reader:
        for points in reader.chunk_iterator(chunk):
            yield _table(points)


def _table(points: Any) -> Table:
    table: Table = {axis: np.asarray(points[axis], np.float64) for axis in ("x", "y", "z")}
    table["intensity"] = (np.asarray(points.intensity) / INTENSITY_UNIT).astype(np.float32)
    table["gps_time"] = np.asarray(points.gps_time)
    table["classification"] = np.asarray(points.classification)
    table["echo"] = np.asarray(points.return_number)
    table["echoes"] = np.asarray(points.number_of_returns)
    table["source"] = np.asarray(points.point_source_id)
    angle, edge = np.asarray(points.scan_angle), np.asarray(points.edge_of_flight_line)
    if "scan_angle" in points.array.dtype.names and (angle.any() or edge.any()):
        table |= {"scan_angle": angle * SCAN_ANGLE_STEP, "edge": edge.astype(np.bool_)}
    for name in (*_EXTRA, "red", "green", "blue"):
        if name in points.array.dtype.names:
            table[name] = np.asarray(points[name])
    return table
