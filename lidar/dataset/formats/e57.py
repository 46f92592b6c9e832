"""E57 (ASTM E2807), as survey programs read it: a scan with its pose for each frame, or one scan for a map.

Points of a frame are relative to the scanner's pose at the frame's start, in metres of the export CRS and
without the vehicle's motion: a pose times its points gives the coordinates of LAS files.
``coordinateMetadata`` is the CRS as WKT. Rings are rows and firing blocks columns. What E57 has no field
for is in the extension ``geoscene``.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geoscene.errors import need
from geoscene.support.files import atomic_path, not_written
from geoscene.typing import Float
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import NO_FRAME, FrameInfo, Table, rows
from lidar.errors import FormatError
from lidar.geometry.time_scales import gps_seconds

EXTENSION = "geoscene", "urn:geoscene:e57:1"
"""Prefix and name of the namespace of columns that E57 has no field for."""

_ADJUSTED = 1e9
"""Seconds by which GPS time, which E57 states, exceeds the adjusted GPS time of LAS."""

_CAPACITY = 500_000
"""Points that the library is given at a time."""

_AXES = ("cartesianX", "cartesianY", "cartesianZ")
_BYTE, _SHORT, _INT, _WORD = (0, 255), (0, 2**16 - 1), (-(2**31), 2**31 - 1), (0, 2**32 - 1)


@dataclass(frozen=True, slots=True)
class _Field:
    """E57 field of a column.

    name   : of the E57 field
    kind   : type of the column
    limits : of integers
    first  : what is subtracted: E57 counts returns from 0
    """

    name: str
    kind: type[np.generic]
    limits: tuple[int, int] | None = None
    first: int = 0


def _own(name: str) -> str:
    return f"{EXTENSION[0]}:{name}"


_FIELDS = {
    "intensity": _Field("intensity", np.float32),
    "gps_time": _Field("timeStamp", np.float64),
    "ring": _Field("rowIndex", np.uint16, _SHORT),
    "column": _Field("columnIndex", np.uint32, _WORD),
    "echo": _Field("returnIndex", np.uint8, _BYTE, first=1),
    "echoes": _Field("returnCount", np.uint8, _BYTE),
    **{name: _Field(f"color{name.capitalize()}", np.uint8, _BYTE) for name in ("red", "green", "blue")},
    "label": _Field(_own("label"), np.uint16, _SHORT),
    "instance": _Field(_own("instance"), np.int32, _INT),
    "source": _Field(_own("source"), np.uint16, _SHORT),
    **{n: _Field(_own(n), np.float32) for n in ("range", "incidence", "true_range", "velocity")},
}


def _library() -> Any:
    return need("pye57", "e57").libe57


class _Scan:
    """A scan that tables are appended to; what sums it up is entered at the end.

    pose  : (4, 4) export CRS from the points' coordinates
    scale : metres per count of coordinates; 0 for float32
    start : adjusted GPS time that time stamps are relative to, seconds
    """

    def __init__(
        self, image: Any, columns: tuple[str, ...], *, pose: Float, scale: float, start: float
    ) -> None:
        e57 = _library()
        self._image, self._pose, self._start = image, pose, start
        self.count, self._digest = 0, hashlib.sha256()
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._rows, self._columns = [2**32, 0], [2**32, 0]
        self.fields = {name: field for name, field in _FIELDS.items() if name in columns}
        prototype, self.node = e57.StructureNode(image), e57.StructureNode(image)
        for axis in _AXES:
            counted = e57.ScaledIntegerNode(image, 0, *_INT, scale, 0.0) if scale else None
            prototype.set(axis, counted or e57.FloatNode(image, 0.0, e57.E57_SINGLE))
        for field in self.fields.values():
            single = e57.E57_DOUBLE if field.kind is np.float64 else e57.E57_SINGLE
            number = e57.IntegerNode(image, field.limits[0], *field.limits) if field.limits else None
            prototype.set(field.name, number or e57.FloatNode(image, 0.0, single))
        points = e57.CompressedVectorNode(image, prototype, e57.VectorNode(image, True))
        self.node.set("points", points)
        image.root()["data3D"].append(self.node)
        self._buffers = {name: np.empty(_CAPACITY, np.float64) for name in _AXES}
        for field in self.fields.values():
            kind = np.dtype(field.kind)
            stored = np.longlong if kind.kind in "iu" and kind.itemsize == 4 else kind
            self._buffers[field.name] = np.empty(_CAPACITY, stored)
        self._writer = points.writer(_buffers(image, self._buffers))

    def append(self, table: Table) -> None:
        """Append points in the export CRS."""
        for start in range(0, rows(table), _CAPACITY):
            self._append({name: column[start : start + _CAPACITY] for name, column in table.items()})

    def _append(self, table: Table) -> None:
        n = rows(table)
        world = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)
        local = (world - self._pose[:3, 3]) @ self._pose[:3, :3]
        for name, column in zip(_AXES, local.T, strict=True):
            self._buffers[name][:n] = column
        for name, field in self.fields.items():
            column = table[name] - self._start if name == "gps_time" else table[name]
            self._buffers[field.name][:n] = column - column.dtype.type(field.first) if field.first else column
        for buffer in self._buffers.values():
            self._digest.update(buffer[:n].data)
        self._low, self._high = (
            np.minimum(self._low, local.min(axis=0)),
            np.maximum(self._high, local.max(axis=0)),
        )
        for name, bounds in (("ring", self._rows), ("column", self._columns)):
            if name in table:
                bounds[:] = min(bounds[0], int(table[name].min())), max(bounds[1], int(table[name].max()))
        self._writer.write(n)
        self.count += n

    def close(self, *, name: str, about: str) -> uuid.UUID:
        """Enter name, pose, time and bounds of the scan; return its identifier, a hash of its content."""
        self._writer.close()
        identity = uuid.uuid5(uuid.NAMESPACE_URL, f"{EXTENSION[1]} {name} {about} {self._digest.hexdigest()}")
        x, y, z, w = Rotation.from_matrix(self._pose[:3, :3]).as_quat(canonical=True).tolist()
        translation = dict(zip("xyz", self._pose[:3, 3].tolist(), strict=True))
        entries: dict[str, Any] = {
            "guid": f"{{{identity}}}",
            "name": name,
            "description": about,
            "pose": {"rotation": {"w": w, "x": x, "y": y, "z": z}, "translation": translation},
            "acquisitionStart": _date_time(self._start),
        }
        if self.count:
            bounds = zip("xyz", self._low.tolist(), self._high.tolist(), strict=True)
            edges = [limits for axis, *ends in bounds for limits in _limits(axis, ends).items()]
            entries["cartesianBounds"] = dict(edges)
            if {"ring", "column"} <= self.fields.keys():
                entries["indexBounds"] = _limits("row", self._rows) | _limits("column", self._columns)
        entries["intensityLimits"] = _limits("intensity", (0.0, 255.0))
        if "red" in self.fields:
            colors = [_limits(f"color{name}", _BYTE) for name in ("Red", "Green", "Blue")]
            entries["colorLimits"] = colors[0] | colors[1] | colors[2]
        _enter(self._image, self.node, entries=entries)
        return identity


def _limits(name: str, ends: Sequence[float]) -> dict[str, float]:
    return {f"{name}Minimum": ends[0], f"{name}Maximum": ends[1]}


def _date_time(adjusted_gps: float) -> dict[str, float]:
    """E57's entries of a time in adjusted GPS seconds."""
    return {"dateTimeValue": adjusted_gps + _ADJUSTED, "isAtomicClockReferenced": 1}


def _enter(image: Any, node: Any, *, entries: dict[str, Any]) -> None:
    """Set entries of a structure: texts, numbers, and structures as dictionaries."""
    e57 = _library()
    for name, value in entries.items():
        if isinstance(value, dict):
            child = e57.StructureNode(image)
            _enter(image, child, entries=value)
        elif isinstance(value, str):
            child = e57.StringNode(image, value)
        elif isinstance(value, int):
            child = e57.IntegerNode(image, value, *_WORD)
        else:
            child = e57.FloatNode(image, value)
        node.set(name, child)


def _buffers(image: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """The arrays as places that the library copies points from or to; it does not own them.

    pye57 takes arrays of NumPy's int64 (type character l) for ones of 32 bits, but longlong (q) as they are.
    """
    e57 = _library()
    out = e57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        out.append(e57.SourceDestBuffer(image, name, array, len(array), True, True))
    return out


@contextmanager
def _written(path: Path, info: LasInfo) -> Iterator[tuple[Any, list[uuid.UUID]]]:
    """Yield an E57 file to write and a list for the identifiers of its scans."""
    e57 = _library()
    identities: list[uuid.UUID] = []
    with atomic_path(path) as part:
        try:
            image = e57.ImageFile(str(part), "w")
        except e57.E57Exception as error:
            raise not_written(path, error) from error
        try:
            image.extensionsAdd("", e57.E57_V1_0_URI)
            image.extensionsAdd(*EXTENSION)
            root = image.root()
            _enter(image, root, entries={"formatName": "ASTM E57 3D Imaging Data File"})
            root.set("versionMajor", e57.IntegerNode(image, e57.E57_FORMAT_MAJOR))
            root.set("versionMinor", e57.IntegerNode(image, e57.E57_FORMAT_MINOR))
            created = float(gps_seconds(info.created, np.zeros(1, np.int64))[0])
            about = {"coordinateMetadata": info.crs.to_wkt(), "creationDateTime": _date_time(created)}
            _enter(image, root, entries=about)
            root.set("data3D", e57.VectorNode(image, True))
            yield image, identities
            whole = uuid.uuid5(uuid.NAMESPACE_URL, f"{EXTENSION[1]} {' '.join(map(str, identities))}")
            _enter(image, root, entries={"guid": f"{{{whole}}}"})
            image.close()
        except e57.E57Exception as error:
            raise not_written(path, error) from error
        finally:
            if image.isOpen():
                image.cancel()


def write(path: Path, table: Table, *, info: LasInfo, frame: FrameInfo = NO_FRAME) -> None:
    """Write a frame as one scan, points in the export CRS; its pose is that of ``frame``."""
    pose = np.eye(4)
    pose[:3, 3] = info.offset
    start = float(gps_seconds(info.created, np.array([frame.start_ns]))[0])
    with _written(path, info) as (image, identities):
        scan = _Scan(
            image, tuple(table), pose=pose if frame.pose is None else frame.pose, scale=0.0, start=start
        )
        scan.append(table)
        name = f"{frame.sensor} {frame.frame:06d}".strip()
        identities.append(scan.close(name=name, about="simulated lidar frame"))


@contextmanager
def open_map(path: Path, info: LasInfo, *, columns: tuple[str, ...]) -> Iterator[Callable[[Table], None]]:
    """Yield a function that appends tables to a map: one scan, relative to the offset of LAS files."""
    pose = np.eye(4)
    pose[:3, 3] = info.offset
    start = float(gps_seconds(info.created, np.zeros(1, np.int64))[0])
    with _written(path, info) as (image, identities):
        scan = _Scan(image, columns, pose=pose, scale=info.scale, start=start)
        yield scan.append
        identities.append(scan.close(name="map", about="simulated lidar map"))


@contextmanager
def _scans(path: Path) -> Iterator[tuple[Any, Any]]:
    """Yield an opened E57 file and its scans.

    Raises FormatError for a damaged file.
    """
    e57 = _library()
    image = None
    try:
        image = e57.ImageFile(str(path), "r")
        yield image, image.root()["data3D"]
    except (e57.E57Exception, RuntimeError, ValueError, KeyError, TypeError) as error:
        text = " ".join(str(error).partition("****")[0].split())[:120]
        raise FormatError(f"{path}: not a readable E57 file ({text})") from error
    finally:
        if image is not None:
            image.close()


def read(path: Path) -> Table:
    """The table of a file in the export CRS; of several scans the columns that all of them have.

    Raises FormatError for a damaged file, and one without Cartesian coordinates.
    """
    tables = list(read_chunks(path))
    names = [name for name in tables[0] if all(name in table for table in tables)]
    return {name: np.concatenate([table[name] for table in tables]) for name in names}


def read_chunks(path: Path) -> Iterator[Table]:
    """The tables of a file, a scan at a time; see `read`."""
    size = path.stat().st_size
    with _scans(path) as (image, scans):
        if not len(scans):
            raise FormatError(f"{path}: has no scan")
        for index in range(len(scans)):
            yield _table(image, scans[index], size=size)


def count(path: Path) -> int:
    """Number of points of a file, which its XML states."""
    with _scans(path) as (_, scans):
        return sum(int(scans[index]["points"].childCount()) for index in range(len(scans)))


def _table(image: Any, scan: Any, *, size: int) -> Table:
    """The table of a scan, without points that it marks as invalid."""
    e57 = _library()
    points = scan["points"]
    prototype, n = e57.StructureNode(points.prototype()), int(points.childCount())
    names = {prototype.get(index).elementName() for index in range(prototype.childCount())}
    if lacks := [axis for axis in _AXES if axis not in names]:
        raise ValueError(f"a scan has no {', '.join(lacks)}")
    if n > size:
        raise ValueError(f"states {n} points, and has {size} bytes")
    invalid = "cartesianInvalidState"
    fields = {name: field for name, field in _FIELDS.items() if field.name in names}
    arrays: dict[str, NDArray[Any]] = {name: np.zeros(n, np.float64) for name in _AXES}
    arrays |= {
        field.name: np.zeros(n, np.longlong if field.limits else field.kind) for field in fields.values()
    }
    if invalid in names:
        arrays[invalid] = np.zeros(n, np.longlong)
    if n:
        reader = points.reader(_buffers(image, arrays))
        if (found := reader.read()) != n:
            raise ValueError(f"states {n} points, and holds {found}")
        reader.close()
    local = np.column_stack([arrays[axis] for axis in _AXES])
    turn, place = _pose(scan)
    world = local @ turn.T + place
    table: Table = dict(zip("xyz", world.T.copy(), strict=True))
    for name, field in fields.items():
        table[name] = (arrays[field.name] + field.first).astype(field.kind)
    if "gps_time" in table and scan.isDefined("acquisitionStart"):
        table["gps_time"] += scan["acquisitionStart"]["dateTimeValue"].value() - _ADJUSTED
    if invalid in arrays:
        table = {name: column[arrays[invalid] == 0] for name, column in table.items()}
    return table


def _pose(scan: Any) -> tuple[Float, Float]:
    """Rotation (3, 3) and translation (3,) of a scan; none where the file states none."""
    turn, place = np.eye(3), np.zeros(3)
    if scan.isDefined("pose/rotation"):
        turned = scan["pose"]["rotation"]
        turn = Rotation.from_quat([turned[k].value() for k in "xyzw"]).as_matrix()
    if scan.isDefined("pose/translation"):
        place = np.array([scan["pose"]["translation"][k].value() for k in "xyz"])
    return turn, place
