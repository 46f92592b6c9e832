"""Point-cloud formats and label formats: one module each, and one row each in the registries below.

Modules are imported when a file is read or written, so that a list of the formats costs nothing.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from geoscene.errors import need, reason_of
from geoscene.support.registry import Registry
from lidar.errors import FormatError, InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lidar.dataset.formats.las import LasInfo
    from lidar.dataset.formats.table import FrameInfo, PointLabels, Table
    from lidar.sensors.laser.cloud import Cloud

ALL = (
    *("x", "y", "z", "intensity", "time_ns", "ring", "column", "range", "label", "instance", "incidence"),
    *("true_range", "echo", "echoes", "velocity"),
)
"""Columns of a recorded cloud, see `lidar.dataset.formats.table`; velocity of Doppler scanners only."""

_LAS = (*(name for name in ALL if name not in ("time_ns", "column")), "gps_time")
_E57 = (*(name for name in ALL if name != "time_ns"), "gps_time")


@dataclass(frozen=True, slots=True)
class Format:
    """A point-cloud format: a row of `FORMATS` and a module with ``read``, ``write`` and ``count``.

    name    : by which users choose it
    module  : in this folder
    suffix  : end of its files' names
    frame   : of the points: the sensor's, at each point's own firing time, or the world's (export CRS)
    columns : columns that its files keep
    folder  : of its files, in a sensor's folder; by default its name
    kitti   : a sensor's folder becomes a KITTI sequence: calib.txt, times.txt and poses.txt are added, and
              clouds are de-skewed to their frame's start, as KITTI's are
    maps    : its module has ``open_map``, which writes aggregated maps; it may have that and no ``write``
    framed  : its files state the frame that they are of
    exact   : its files keep all digits of a cloud's columns
    step    : metres between the coordinates that its files can have; 0 for floating-point numbers
    extra   : optional dependency that its module needs: a package and the name of the extra
    """

    name: str
    module: str
    suffix: str
    frame: Literal["sensor", "world"] = "sensor"
    columns: tuple[str, ...] = ALL
    folder: str = ""
    kitti: bool = False
    maps: bool = False
    framed: bool = False
    exact: bool = True
    step: float = 0.0
    extra: str = ""

    def path(self, folder: Path, frame: int) -> Path:
        """File of a frame in a sensor's folder."""
        return folder / (self.folder or self.name) / f"{frame:06d}{self.suffix}"

    def read(self, path: Path) -> Table:
        """The point table of a file.

        Raises FormatError for a file that is not of this format or is damaged.
        """
        table: Table = self._functions().read(path)
        return table

    def require(self) -> None:
        """Raise MissingExtraError if the package that the format needs is not installed."""
        if self.extra:
            need(*self.extra.split())

    def read_chunks(self, path: Path) -> Iterator[Table]:
        """The point tables of a file of the world frame, some points at a time; raises as `read`."""
        tables: Iterator[Table] = self._functions().read_chunks(path)
        return tables

    def write(
        self, path: Path, table: Table, *, info: LasInfo | None = None, frame: FrameInfo | None = None
    ) -> None:
        """Write a point table.

        info  : of the export CRS, which formats of the world frame need
        frame : of which the table is; formats that state no frame ignore it
        """
        given = ({"info": info} if info else {}) | ({"frame": frame} if frame and self.framed else {})
        self._functions().write(path, table, **given)

    def count(self, path: Path) -> int:
        """Number of points of a file, from its header or its size.

        Raises FormatError for a file without a readable header.
        """
        try:
            return int(self._functions().count(path))
        except FormatError:
            raise
        except (OSError, ValueError, IndexError, StopIteration) as error:
            text = reason_of(error)
            raise FormatError(f"{path}: its number of points cannot be read ({text})") from error

    def open_map(self, path: Path, *, info: Any, columns: tuple[str, ...]) -> Any:
        """A context manager that yields a function which appends tables in the world frame to a map."""
        return self._functions().open_map(path, info, columns=columns)

    def _functions(self) -> Any:
        return importlib.import_module(f"{__name__}.{self.module}")


@dataclass(frozen=True, slots=True)
class LabelFormat:
    """A format of label files, a row per point: a row of `LABELS` and a module with ``write_labels``.

    name, module, suffix, folder, kitti : as of `Format`
    """

    name: str
    module: str
    suffix: str
    folder: str
    kitti: bool = False

    def path(self, folder: Path, frame: int) -> Path:
        """File of a frame in a sensor's folder."""
        return folder / self.folder / f"{frame:06d}{self.suffix}"

    def write(self, path: Path, labels: PointLabels) -> None:
        """Write the labels of a cloud's points, in their order."""
        importlib.import_module(f"{__name__}.{self.module}").write_labels(path, labels)


_FORMATS = (
    Format("pcd", "pcd", ".pcd", maps=True),
    Format("pcd-ascii", "pcd_ascii", ".ascii.pcd"),
    Format("ply", "ply", ".ply", maps=True),
    Format("csv", "text", ".csv", exact=False, step=1e-4),
    Format("npz", "npz", ".npz"),
    Format("parquet", "parquet", ".parquet", framed=True, extra="pyarrow gis"),
    Format("laz", "las", ".laz", frame="world", columns=_LAS, maps=True, exact=False, step=1e-3),
    Format("las", "las", ".las", frame="world", columns=_LAS, maps=True, exact=False, step=1e-3),
    Format(
        "e57",
        "e57",
        ".e57",
        frame="world",
        columns=_E57,
        maps=True,
        framed=True,
        exact=False,
        extra="pye57 e57",
    ),
    Format("kitti", "kitti", ".bin", columns=ALL[:4], folder="velodyne", kitti=True),
    Format("nuscenes", "nuscenes", ".pcd.bin", columns=(*ALL[:4], "ring")),
)

FORMATS: Registry[Format] = Registry(
    "format",
    {row.name: row for row in _FORMATS},
    error=InputError,
    removed={"pcd-compressed": "no longer written; use pcd, or npz or parquet, which are compressed"},
)
"""Point-cloud formats by name."""


_MAPS = (
    *(row for row in FORMATS.values() if row.maps),
    Format("copc", "copc", ".copc.laz", frame="world", columns=_LAS, maps=True, step=1e-3),
)

MAPS: Registry[Format] = Registry(
    "format",
    {row.name: row for row in _MAPS},
    error=InputError,
)
"""Formats of aggregated maps by name; COPC sorts points, so that clouds of frames are not written in it."""

_LABELS = (
    LabelFormat("semantickitti", "kitti", ".label", "labels", kitti=True),
    LabelFormat("nuscenes", "nuscenes", "_lidarseg.bin", "lidarseg"),
)

LABELS: Registry[LabelFormat] = Registry(
    "labels",
    {row.name: row for row in _LABELS},
    error=InputError,
)
"""Label formats by name."""


def format_of(path: Path, name: str = "") -> Format:
    """The format of a file: by name, or else the one with the longest suffix that the file's name ends in.

    Raises InputError for an unknown name or suffix.
    """
    if name:
        return MAPS[name] if name in MAPS else FORMATS.find(name)
    known = {**FORMATS, **MAPS}
    found = [row for row in known.values() if path.name.lower().endswith(row.suffix)]
    if not found:
        suffixes = ", ".join(row.suffix for row in known.values())
        raise InputError(f"{path}: no point-cloud format has this suffix; there are {suffixes}")
    return max(found, key=lambda row: len(row.suffix))


def map_suffixes() -> list[str]:
    """Suffixes of the files that aggregated maps can be written to."""
    return [row.suffix for row in MAPS.values()]


def read_table(path: Path, format: str = "") -> Table:  # noqa: A002 - the word that users know
    """The points of a file as a table, in the frame and with the columns of its format.

    format : name in `FORMATS`; by default from the file's suffix

    Raises InputError for an unknown format and FormatError for a damaged file.
    """
    return format_of(path, format).read(path)


def read_cloud(path: str | Path, format: str = "", *, start_ns: int = 0) -> Cloud:  # noqa: A002
    """The cloud of one frame, from a file in the sensor frame, to the precision of its format.

    format   : name in `FORMATS`; by default from the file's suffix
    start_ns : the frame's start; not stored in files

    Columns that the format does not keep are filled in, see `lidar.dataset.formats.table.table_cloud`.

    Raises InputError for a format of the world frame and FormatError for a damaged file.
    """
    from lidar.dataset.formats.table import table_cloud  # noqa: PLC0415

    path = Path(path)
    row = format_of(path, format)
    if row.frame == "world":
        raise InputError(f"{path}: {row.name} files hold points in the world frame; use read_table")
    return table_cloud(row.read(path), start_ns=start_ns)
