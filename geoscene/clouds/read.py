"""Reads point clouds in pieces: LAS, LAZ, COPC and PLY, in any CRS."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError

from geoscene.errors import DamagedFileError, InputError, SourceNotFoundError, reading
from geoscene.geometry.frames import Frame
from geoscene.support.columns import Columns
from geoscene.support.las_files import open_las
from geoscene.support.progress import Progress, silent
from geoscene.typing import Bools, Float

AT_ONCE = 1_000_000
"""Points that are read at once."""

GROUND, VEGETATION, NOISE = (2, 11), (3, 4, 5), (7, 18)
"""Classes of the ASPRS: ground and road surfaces; low, medium and high vegetation; low and high noise."""

_UNITS = {"m": 1.0, "ft": 0.3048, "us-ft": 1200 / 3937}
_REMEDY = "give a LAS, LAZ, COPC or PLY file"
_SUFFIXES = (".las", ".laz", ".ply")

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

SIDE = 128.0
"""Metres of a square: 0.3 million points of an airborne cloud, some ten million of a mobile one."""

_RECORD = np.dtype([("xyz", "<i4", 3), ("klass", "u1"), ("last", "?")])
_STEP = 0.001  # metres of the integer coordinates
_HELD = 4_000_000  # points in memory before they are written
_LOWEST, _HIGHEST = -500.0, 9500.0  # metres of land and of towers on it; other heights are errors
_VOXEL, _FEWEST = 3.0, 4  # points with fewer than this many in the 27 cubes of 3 m around are outliers

Square = tuple[int, int]


class Chunk(NamedTuple):
    """A chunk of a file's points.

    xyz   : (n, 3) float64 in the file's CRS; z in its unit
    klass : (n,) uint8 class of the ASPRS, 0 where the file has none
    last  : (n,) bool, the last return of its pulse; True where the file does not tell
    """

    xyz: Float
    klass: NDArray[np.uint8]
    last: Bools


@dataclass(frozen=True, slots=True)
class SurveyFile:
    """A point cloud on disk.

    crs       : horizontal CRS
    to_metres : metres per unit of z
    vertical  : ``orthometric`` or ``ellipsoidal``
    datum     : the vertical datum in words, and how it is known
    count     : points
    """

    path: Path
    crs: CRS
    to_metres: float
    vertical: str
    datum: str
    count: int

    def chunks(self) -> Iterator[Chunk]:
        """The points in the order of the file; withheld ones and those of class noise have class 7."""
        with reading(self.path, DamagedFileError, remedy=_REMEDY):
            yield from (_las_chunks if self.path.suffix.lower() != ".ply" else _ply_chunks)(self.path)


def open_cloud(path: Path, *, crs: str = "", unit: str = "") -> SurveyFile:
    """The header of a cloud.

    crs  : of the coordinates, where the file states none or a wrong one
    unit : of heights, ``m``, ``ft`` or ``us-ft``; by default that of the vertical CRS, else metres where
           the horizontal CRS is in metres or degrees

    Raises SourceNotFoundError for a missing file, InputError for one that cannot be read, without CRS, with
    a CRS that is unknown, local or geocentric, or whose unit of heights is not known.
    """
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such point cloud")
    if path.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{path}: not one of {', '.join(_SUFFIXES)}; {_REMEDY}")
    if unit and unit not in _UNITS:
        raise InputError(f"`cloud_unit` {unit}: give m, ft or us-ft")
    with reading(path, DamagedFileError, remedy=_REMEDY):
        stated, count = (_ply_header if path.suffix.lower() == ".ply" else _las_header)(path)
    if not count:
        raise InputError(f"{path}: holds no points")
    if crs:
        try:
            stated = CRS.from_user_input(crs)
        except CRSError as error:
            raise InputError(f"`cloud_crs` {crs}: unknown to pyproj; give EPSG:<number>") from error
    if stated is None:
        raise InputError(f"{path}: states no CRS; give it, as with `cloud_crs` EPSG:32618")
    upright = stated.sub_crs_list[1] if stated.is_compound else None
    plane = stated.sub_crs_list[0] if stated.is_compound else stated.to_2d()
    if plane.is_geocentric or not (plane.is_geographic or plane.is_projected):
        raise InputError(f"{path}: CRS {stated.name} is neither projected nor geographic; give `cloud_crs`")
    ellipsoidal = upright is None and len(stated.axis_info) == 3
    if unit:
        factor = _UNITS[unit]
    elif upright is not None or ellipsoidal:
        axis = (upright or stated).axis_info[-1]
        factor = float(axis.unit_conversion_factor)
    elif plane.is_geographic or plane.axis_info[0].unit_conversion_factor == 1.0:
        factor = 1.0
    else:
        name = plane.axis_info[0].unit_name
        raise InputError(
            f"{path}: {plane.name} is in {name}, and no vertical CRS states the unit of heights; say which,"
            " with `cloud_unit` m, ft or us-ft"
        )
    datum = upright.name if upright is not None else f"ellipsoid of {stated.name}" if ellipsoidal else ""
    return SurveyFile(
        path,
        plane,
        factor,
        "ellipsoidal" if ellipsoidal else "orthometric",
        datum or "not stated, taken for heights above a geoid",
        count,
    )


def _las_header(path: Path) -> tuple[CRS | None, int]:
    with open_las(path) as source:
        return source.header.parse_crs(), int(source.header.point_count)


def _las_chunks(path: Path) -> Iterator[Chunk]:
    with open_las(path) as source:
        for points in source.chunk_iterator(AT_ONCE):
            klass = np.asarray(points.classification, np.uint8)
            klass[np.asarray(points.withheld, bool)] = NOISE[0]
            count, number = (np.asarray(points[name]) for name in ("number_of_returns", "return_number"))
            xyz = np.column_stack([points.x, points.y, points.z]).astype(np.float64, copy=False)
            yield Chunk(xyz, klass, number >= count)


class _Ply(NamedTuple):
    """Layout of the vertices of a PLY file: where they begin, how many, their record; ASCII if text."""

    start: int
    vertices: int
    record: np.dtype[Any]
    text: bool
    comments: tuple[str, ...]


def _ply_layout(file: IO[bytes]) -> _Ply:
    """The layout of a PLY file, whose vertices come first; raises ValueError for another one."""
    words: list[list[str]] = []
    while not words or words[-1] != ["end_header"]:
        line = file.readline(4096)
        if not line or (not words and line.strip() != b"ply"):
            raise ValueError("no PLY header")
        words.append(line.decode("ascii", "replace").split())
    kind = next(w[1] for w in words if w[:1] == ["format"])
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}[kind]
    element = [k for k, w in enumerate(words) if w[:1] == ["element"]]
    if not element or words[element[0]][1] != "vertex":
        raise ValueError("the first element is not vertex")
    end = element[1] if len(element) > 1 else len(words)
    fields = [w for w in words[element[0] : end] if w[:1] == ["property"]]
    record = np.dtype([(w[2], order + _PLY_TYPES[w[1]]) for w in fields])
    if not {"x", "y", "z"} <= set(record.names or ()):
        raise ValueError("vertices have no x, y and z")
    comments = tuple(" ".join(w[1:]) for w in words if w[:1] == ["comment"])
    return _Ply(file.tell(), int(words[element[0]][2]), record, kind == "ascii", comments)


def _ply_header(path: Path) -> tuple[CRS | None, int]:
    """CRS of a comment ``crs NAME``, and the number of points."""
    with path.open("rb") as file:
        layout = _ply_layout(file)
    for comment in layout.comments:
        if comment.startswith("crs "):
            try:
                return CRS.from_user_input(comment.removeprefix("crs ")), layout.vertices
            except CRSError:
                return None, layout.vertices
    return None, layout.vertices


def _ply_chunks(path: Path) -> Iterator[Chunk]:
    with path.open("rb") as file:
        layout = _ply_layout(file)
        for first in range(0, layout.vertices, AT_ONCE):
            many = min(AT_ONCE, layout.vertices - first)
            if layout.text:
                rows = np.loadtxt(file, layout.record, max_rows=many, ndmin=1)
            else:
                rows = np.frombuffer(file.read(many * layout.record.itemsize), layout.record)
            if len(rows) < many:
                raise ValueError(f"ends after {first + len(rows)} of {layout.vertices} points")
            names = layout.record.names or ()
            known = next((n for n in ("classification", "scalar_Classification") if n in names), "")
            klass = rows[known].astype(np.uint8) if known else np.zeros(many, np.uint8)
            xyz = np.column_stack([rows[axis].astype(np.float64) for axis in "xyz"])
            yield Chunk(xyz, klass, np.ones(many, np.bool_))


@dataclass(frozen=True, slots=True)
class SurveyPoints(Columns):
    """Points of a survey, as columns.

    xyz   : (n, 3) float64, scene metres
    klass : (n,) uint8 class of the ASPRS, 0 if unknown
    last  : (n,) bool, the last return of its pulse
    """

    xyz: Float
    klass: NDArray[np.uint8]
    last: Bools


@dataclass(frozen=True, slots=True)
class Spool:
    """Points in a folder, one file a square.

    squares : those with points, sorted
    read    : points of all files
    within  : points of each file within the bounds
    noise   : points of class noise, withheld ones, and those at impossible heights
    ground  : points of the classes of ground within the bounds
    vegetation : points of the classes of vegetation within the bounds
    """

    folder: Path
    squares: tuple[Square, ...]
    read: int
    within: tuple[int, ...]
    noise: int
    ground: int
    vegetation: int

    @property
    def outside(self) -> int:
        """Points beyond the bounds."""
        return self.read - sum(self.within)

    def around(self, bounds: Sequence[float], *, shift: tuple[float, float] = (0.0, 0.0)) -> SurveyPoints:
        """The points within bounds (xmin, ymin, xmax, ymax) after a shift in metres is added to all."""
        low = np.floor((np.array(bounds[:2]) - shift) / SIDE).astype(int)
        high = np.floor((np.array(bounds[2:]) - shift) / SIDE).astype(int)
        parts = [np.empty(0, _RECORD)]
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                path = self.folder / f"{i}_{j}.points"
                if path.exists():
                    parts.append(np.fromfile(path, _RECORD))
        rows = np.concatenate(parts)
        xyz = rows["xyz"] * _STEP + (*shift, 0.0)
        inside = ((xyz[:, :2] >= bounds[:2]) & (xyz[:, :2] < bounds[2:])).all(axis=1)
        return SurveyPoints(xyz[inside], rows["klass"][inside], rows["last"][inside])


def spool_clouds(
    clouds: Sequence[SurveyFile],
    frame: Frame,
    *,
    bounds: Sequence[float],
    folder: Path,
    progress: Progress = silent,
) -> Spool:
    """Points of clouds within bounds (xmin, ymin, xmax, ymax; scene metres), sorted into squares.

    Raises InputError for a cloud whose CRS cannot be transformed to the scene's, and if no point lies within
    the bounds.
    """
    held: dict[Square, list[NDArray[np.void]]] = defaultdict(list)
    squares: set[Square] = set()
    waiting = read = noise = ground = plants = 0
    inside = [0] * len(clouds)
    total = sum(cloud.count for cloud in clouds)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k, cloud in enumerate(clouds):
        for chunk in cloud.chunks():
            try:
                x, y = frame.from_crs(chunk.xyz[:, 0], chunk.xyz[:, 1], crs=cloud.crs)
            except ProjError as error:
                raise InputError(
                    f"{cloud.path}: its CRS {cloud.crs.name} cannot be transformed to the scene's ({error})"
                ) from error
            xyz = np.column_stack([x, y, chunk.xyz[:, 2] * cloud.to_metres])
            finite = np.isfinite(xyz).all(axis=1)
            low = np.minimum(low, xyz[finite, :2].min(axis=0, initial=np.inf))
            high = np.maximum(high, xyz[finite, :2].max(axis=0, initial=-np.inf))
            within = finite & ((xyz[:, :2] >= bounds[:2]) & (xyz[:, :2] < bounds[2:])).all(axis=1)
            bad = within & (np.isin(chunk.klass, NOISE) | (xyz[:, 2] < _LOWEST) | (xyz[:, 2] > _HIGHEST))
            keep = within & ~bad
            rows = np.empty(int(keep.sum()), _RECORD)
            rows["xyz"] = np.rint(xyz[keep] / _STEP).astype(np.int64)
            rows["klass"], rows["last"] = chunk.klass[keep], chunk.last[keep]
            for square, some in _by_square(rows):
                held[square].append(some)
                squares.add(square)
            inside[k] += int(within.sum())
            read, noise = read + len(xyz), noise + int(bad.sum())
            ground += int(np.isin(rows["klass"], GROUND).sum())
            plants += int(np.isin(rows["klass"], VEGETATION).sum())
            waiting += len(rows)
            if waiting > _HELD:
                _flush(held, folder)
                waiting = 0
            progress("point cloud", read, total=total)
    _flush(held, folder)
    if not squares:
        raise InputError(_beside(clouds, frame, bounds=bounds, covered=(*low.tolist(), *high.tolist())))
    return Spool(folder, tuple(sorted(squares)), read, tuple(inside), noise, ground, plants)


def without_outliers(points: SurveyPoints) -> SurveyPoints:
    """The points without single ones and small groups far from all others, such as birds and low noise."""
    if not len(points):
        return points
    cell = np.floor(points.xyz / _VOXEL).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    shape = cell.max(axis=0) + 2
    key, owner, count = np.unique(
        np.ravel_multi_index(cell.T, shape), return_inverse=True, return_counts=True
    )
    around = np.zeros(len(key), np.int64)
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            for dz in (-1, 0, 1):
                near = key + (dx * shape[1] + dy) * shape[2] + dz
                at = np.minimum(np.searchsorted(key, near), len(key) - 1)
                around += np.where(key[at] == near, count[at], 0)
    return points.take(around[owner] >= _FEWEST)


def _by_square(rows: NDArray[np.void]) -> list[tuple[Square, NDArray[np.void]]]:
    """The rows of each square, in their order."""
    if not len(rows):
        return []
    square = rows["xyz"][:, :2] // round(SIDE / _STEP)
    low = square.min(axis=0)
    many = square.max(axis=0) - low + 1
    key = np.ravel_multi_index((square - low).T.astype(np.int64), many)
    order = np.argsort(key, kind="stable")
    keys, first = np.unique(key[order], return_index=True)
    squares = np.column_stack(np.unravel_index(keys, many)) + low
    parts = np.split(rows[order], first[1:])
    return [((i, j), part) for (i, j), part in zip(squares.tolist(), parts, strict=True)]


def _flush(held: dict[Square, list[NDArray[np.void]]], folder: Path) -> None:
    """Append the buffered points to the files of the squares."""
    for (i, j), parts in held.items():
        with (folder / f"{i}_{j}.points").open("ab") as file:
            for part in parts:
                file.write(part.tobytes())
    held.clear()


def _beside(
    clouds: Sequence[SurveyFile], frame: Frame, *, bounds: Sequence[float], covered: Sequence[float]
) -> str:
    names = ", ".join(cloud.path.name for cloud in clouds)
    if not np.isfinite(covered).all():
        return f"{names}: no point has a place on Earth; is the CRS right ({clouds[0].crs.name})?"
    return (
        f"{names}: no point within the map, which spans {_degrees(frame, bounds)};"
        f" the cloud spans {_degrees(frame, covered)}; is its CRS right ({clouds[0].crs.name})?"
    )


def _degrees(frame: Frame, bounds: Sequence[float]) -> str:
    xmin, ymin, xmax, ymax = bounds
    lon, lat = frame.to_geographic([xmin, xmax, xmax, xmin], [ymin, ymin, ymax, ymax])
    return f"W {np.min(lon):.5f} S {np.min(lat):.5f} E {np.max(lon):.5f} N {np.max(lat):.5f}"
