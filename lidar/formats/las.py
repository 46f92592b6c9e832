"""LAS 1.4 and LAZ through laspy: world coordinates, CRS as WKT, ASPRS classes, GPS time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from geoscene.classes import class_codes
from lidar.errors import FormatError
from lidar.formats.table import Table, rows

SCALE = 0.001
"""Metres per count of a coordinate; a point is at most half of this off along each axis."""

INTENSITY_UNIT = 257.0
"""LAS intensity (16 bits) per unit of calibrated reflectivity (0 to 255)."""

GPS_EPOCH = datetime(1980, 1, 6, tzinfo=UTC)
LEAP_SECONDS = 18
"""GPS minus UTC since 2017-01-01 (IERS Bulletin C 52); none has been announced since."""

_EXTRA = {
    "ring": ("uint16", "beam, 0 = lowest elevation"),
    "label": ("uint8", "geoscene class"),
    "instance": ("int32", "feature in the scene"),
    "range": ("float32", "metres, as reported"),
    "incidence": ("float32", "rad, beam to normal"),
}


def gps_seconds(start: datetime, time_ns: NDArray[np.integer]) -> NDArray[np.float64]:
    """Adjusted standard GPS time (seconds since 1980-01-06 minus 1e9) of nanoseconds after a UTC start."""
    base = (start - GPS_EPOCH).total_seconds() + LEAP_SECONDS - 1e9
    return base + np.asarray(time_ns, np.float64) * 1e-9


@dataclass(frozen=True, slots=True)
class LasInfo:
    """What every file of a dataset shares.

    crs     : of the coordinates; written as WKT
    offset  : (3,) whole metres near the data
    created : date in the header; the drive's, so that the same drive is the same bytes
    """

    crs: CRS
    offset: tuple[float, float, float]
    created: datetime


class LasWriter:
    """A LAS or LAZ file that takes tables one after the other and appears under its name when closed whole.

    Tables need x, y, z (projected, float64) and label; they may have gps_time, intensity, ring, instance,
    range, incidence, echo, echoes, source (point source id), red, green, blue.
    """

    def __init__(self, path: Path, info: LasInfo, columns: tuple[str, ...]) -> None:
        import laspy  # noqa: PLC0415  (0.4 s)

        colour = "red" in columns
        header = laspy.LasHeader(version="1.4", point_format=7 if colour else 6)
        header.scales = np.full(3, SCALE)
        header.offsets = np.asarray(info.offset, float)
        header.add_crs(info.crs)
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
        header.creation_date = info.created.date()
        header.system_identifier = "simulated"
        header.generating_software = "geoscene lidar"
        extra = [
            laspy.ExtraBytesParams(name=n, type=kind, description=text)
            for n, (kind, text) in _EXTRA.items()
            if n in columns
        ]
        header.add_extra_dims(extra)
        self.path = path
        self._columns = columns
        self._laspy: Any = laspy
        self._header = header
        self._part = path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")
        self._writer = laspy.open(
            self._part, mode="w", header=header, do_compress=path.suffix.lower() == ".laz"
        )

    def write(self, table: Table) -> None:
        """Append a table."""
        record = self._laspy.ScaleAwarePointRecord.zeros(rows(table), header=self._header)
        record.x, record.y, record.z = table["x"], table["y"], table["z"]
        record.classification = class_codes().asprs[table["label"]].astype(np.uint8)
        one = np.ones(rows(table), np.uint8)
        record.return_number = table.get("echo", one)
        record.number_of_returns = table.get("echoes", one)
        if "intensity" in table:
            record.intensity = np.clip(np.rint(table["intensity"] * INTENSITY_UNIT), 0, 65535).astype(
                np.uint16
            )
        if "gps_time" in table:
            record.gps_time = table["gps_time"]
        if "source" in table:
            record.point_source_id = table["source"]
        for name in _EXTRA:
            if name in self._columns:
                record[name] = table[name]
        for name in ("red", "green", "blue"):
            if name in self._columns:
                record[name] = table[name].astype(np.uint16) * 257
        self._writer.write_points(record)

    def close(self) -> None:
        """Finish the file and move it to its name."""
        self._writer.close()
        self._part.replace(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._writer.dest.close()
            self._part.unlink(missing_ok=True)


def write_las(path: Path, table: Table, info: LasInfo) -> None:
    """Write one table as LAS or LAZ, by the suffix."""
    with LasWriter(path, info, tuple(table)) as writer:
        writer.write(table)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import laspy  # noqa: PLC0415
    import lazrs  # noqa: PLC0415

    try:
        with laspy.open(path) as reader:
            yield reader
    except (laspy.errors.LaspyException, lazrs.LazrsError, OSError, ValueError) as error:
        raise FormatError(f"{path}: not a readable LAS or LAZ file ({error})") from error


def read_las(path: Path, *, chunk: int = 1_000_000) -> Iterator[Table]:
    """The tables of a LAS or LAZ file, ``chunk`` points at a time, coordinates in its CRS.

    Raises FormatError for a file that laspy cannot read.
    """
    with _opened(path) as reader:
        for points in reader.chunk_iterator(chunk):
            table: Table = {axis: np.asarray(points[axis], np.float64) for axis in ("x", "y", "z")}
            table["intensity"] = (np.asarray(points.intensity) / INTENSITY_UNIT).astype(np.float32)
            table["gps_time"] = np.asarray(points.gps_time)
            table["classification"] = np.asarray(points.classification)
            table["echo"] = np.asarray(points.return_number)
            table["echoes"] = np.asarray(points.number_of_returns)
            table["source"] = np.asarray(points.point_source_id)
            for name in (*_EXTRA, "red", "green", "blue"):
                if name in points.array.dtype.names:
                    table[name] = np.asarray(points[name])
            yield table


def read_crs(path: Path) -> CRS | None:
    """The CRS a LAS or LAZ file states, if any."""
    with _opened(path) as reader:
        crs: CRS | None = reader.header.parse_crs()
        return crs
