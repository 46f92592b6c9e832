"""All clouds of a dataset as one, in the export CRS, frame by frame so that memory stays bounded."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes
from geoscene.progress import Progress, silent
from lidar.dataset.formats.clouds import CLOUD_READERS, placed_returns
from lidar.dataset.formats.las import LasInfo, LasWriter, gps_seconds, read_las
from lidar.dataset.formats.pcd import encode_pcd
from lidar.dataset.formats.ply import ply_header, ply_table
from lidar.dataset.formats.table import Table, records, rows
from lidar.dataset.layout import Dataset
from lidar.errors import DatasetError, InputError
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Trajectory
from lidar.maps.colors import distinct, ramp
from lidar.rig.patterns.beams import frame_ns

COLORS = ("class", "height", "intensity", "sensor")
"""What the colours of a map may show."""

_COLUMNS = ("x", "y", "z", "intensity", "gps_time", "ring", "label", "instance", "source")
_SUFFIXES = (".las", ".laz", ".ply", ".pcd")
_BUCKET = 64.0  # metres: side of the squares that voxels are gathered in
_SHRINK_AT = 64 * 2**20  # bytes of a square's points beyond which they are thinned
_SAMPLE = 12  # frames that the colour ramp of heights is taken from


@dataclass(frozen=True, slots=True)
class MapSummary:
    """What a map holds.

    points_in : returns read
    points    : points written
    noise     : returns left out because nothing is there
    frames    : frames read
    missing   : frames of the drive that are not there, by scanner
    path      : the file
    """

    points_in: int
    points: int
    noise: int
    frames: int
    missing: dict[str, int]
    path: Path


def aggregate(
    dataset: Dataset,
    out: Path,
    *,
    voxel: float | None = None,
    color: str = "class",
    sensors: Sequence[str] = (),
    noise: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> MapSummary:
    """Write the map of a dataset as LAS, LAZ, PLY or PCD, by the suffix of ``out``.

    LAS, LAZ and PLY hold easting, northing and height in the dataset's export CRS; PCD, whose readers take
    float32 alone, the same less the whole-metre offset that its comment line states.

    voxel   : side in metres of cubes that keep the return nearest to their centre; all returns by default
    color   : what red, green and blue show
    sensors : names of the scanners to take; all by default
    noise   : keep returns of class NOISE: false alarms and mirror images
    overwrite : replace what is there

    Raises InputError for options that cannot be and DatasetError where there are no clouds.
    """
    if out.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{out}: maps are written as {', '.join(_SUFFIXES)}")
    if color not in COLORS:
        raise InputError(f"`color` {color}: one of {', '.join(COLORS)}")
    if voxel is not None and not (np.isfinite(voxel) and voxel > 0):
        raise InputError(f"`voxel` {voxel}: give a positive number of metres")
    if out.exists() and not overwrite:
        raise InputError(f"{out}: is there already; set `overwrite` to replace it")
    lidars = dataset.lidars
    if unknown := sorted(set(sensors) - set(lidars)):
        raise InputError(f"no scanner {', '.join(unknown)} in {dataset.path}; there are {', '.join(lidars)}")
    chosen = [name for name in lidars if not sensors or name in sensors]
    source = _Source(dataset, chosen)
    limits = source.height_range() if color == "height" else (0.0, 0.0)

    read = dropped = 0
    frames: set[int] = set()

    def tables() -> Iterator[Table]:
        nonlocal read, dropped
        for k, (frame, table) in enumerate(source.tables()):
            read += rows(table)
            frames.add(frame)
            progress("reading clouds", k + 1, total=len(source))
            real = table["label"] != Class.NOISE
            if not noise and not real.all():
                dropped += int(np.count_nonzero(~real))
                table = {name: column[real] for name, column in table.items()}  # noqa: PLW2901
            yield table

    stream = tables() if voxel is None else _voxels(tables(), voxel, out=out, offset=source.geo.offset)
    written = _write(out, (_colored(t, color, limits=limits) for t in stream), source=source)
    return MapSummary(read, written, dropped, len(frames), source.missing(), out)


class _Source:
    """The clouds of chosen scanners, in the export CRS, in order of frames."""

    def __init__(self, dataset: Dataset, names: Sequence[str]) -> None:
        self.dataset = dataset
        self.geo = Georeference(dataset.frame, dataset.crs)
        self._trajectory: Trajectory | None = None
        self._lidars = dataset.lidars
        self._names = list(names)
        order = list(self._lidars)
        self._files: list[tuple[int, str, int, str, Path]] = []
        for name in names:
            kinds = [k for k in ("laz", "las", "pcd", "ply", "csv") if any(dataset.files(name, k))]
            if kinds:
                files = dataset.files(name, kinds[0])
                self._files += [(frame, name, order.index(name), kinds[0], path) for frame, path in files]
        if not self._files:
            raise DatasetError(f"{dataset.path}: no clouds of {', '.join(names) or 'any scanner'} in it")
        self._files.sort()

    def __len__(self) -> int:
        return len(self._files)

    def missing(self) -> dict[str, int]:
        """Frames that the drive was to have and that are not there, by scanner."""
        wanted = self.dataset.manifest.get("sensor_frames", {})
        there = Counter(name for _, name, *_ in self._files)
        short = {name: wanted.get(name, 0) - there[name] for name in self._names}
        return {name: count for name, count in short.items() if count > 0}

    def tables(self, every: int = 1) -> Iterator[tuple[int, Table]]:
        for frame, name, index, kind, path in self._files[::every]:
            if kind in ("laz", "las"):
                for table in read_las(path):
                    yield (
                        frame,
                        {k: table[k] for k in _COLUMNS if k in table and k != "source"}
                        | {"source": np.full(rows(table), index, np.uint16)},
                    )
            else:
                yield frame, self._placed(CLOUD_READERS[kind](path), name, index=index, frame=frame)

    def _placed(self, table: Table, name: str, *, index: int, frame: int) -> Table:
        if self._trajectory is None:
            self._trajectory = self.dataset.trajectory()
        sensor = self._lidars[name]
        start = int(sensor["time_offset_ns"]) + int(frame * frame_ns(sensor["rate_hz"]))
        mount = np.array(sensor["vehicle_from_sensor"])
        placed, time_ns = placed_returns(table, self._trajectory, start_ns=start, vehicle_from_sensor=mount)
        world = self.geo.points(placed)
        return {
            "x": world[:, 0],
            "y": world[:, 1],
            "z": world[:, 2],
            "intensity": table["intensity"],
            "gps_time": gps_seconds(self.dataset.start, time_ns),
            "ring": table["ring"],
            "label": table["label"].astype(np.uint8),
            "instance": table["instance"],
            "source": np.full(len(world), index, np.uint16),
        }

    def height_range(self) -> tuple[float, float]:
        """1st and 99th percentile of the heights of a dozen frames."""
        every = max(1, len(self) // _SAMPLE)
        z = np.concatenate([table["z"] for _, table in self.tables(every)] or [np.zeros(1)])
        low, high = np.percentile(z, (1, 99)) if len(z) else (0.0, 1.0)
        return float(low), float(high)


def _colored(table: Table, color: str, *, limits: tuple[float, float]) -> Table:
    if color == "class":
        rgb = class_codes().color[table["label"]]
    elif color == "height":
        rgb = ramp(table["z"], limits[0], high=limits[1])
    elif color == "intensity":
        rgb = ramp(table["intensity"], 0.0, high=100.0)
    else:
        rgb = distinct(table["source"])
    return table | {"red": rgb[:, 0], "green": rgb[:, 1], "blue": rgb[:, 2]}


def _nearest_to_centre(data: NDArray[np.void], voxel: float) -> NDArray[np.void]:
    """Of the records in each voxel the one nearest to its centre; of equals the earliest in time."""
    xyz = np.column_stack([data[k] for k in "xyz"])
    cell = np.floor(xyz / voxel)
    away = ((xyz - (cell + 0.5) * voxel) ** 2).sum(axis=1)
    order = np.lexsort((data["gps_time"], away, cell[:, 0], cell[:, 1], cell[:, 2]))
    sorted_cells = cell[order]
    first = np.ones(len(order), bool)
    first[1:] = (sorted_cells[1:] != sorted_cells[:-1]).any(axis=1)
    return data[order[first]]


def _voxels(
    tables: Iterator[Table], voxel: float, *, out: Path, offset: tuple[float, float, float]
) -> Iterator[Table]:
    """Thinned tables: points are gathered in squares on disk first, so that memory holds one square."""
    folder = out.with_name(f"{out.name}.{os.getpid()}.voxels")
    folder.mkdir(parents=True)
    side = max(1.0, np.ceil(_BUCKET / voxel)) * voxel  # whole voxels, so that none is cut by a square's edge
    kinds: np.dtype[np.void] | None = None
    limits: dict[Path, int] = {}  # size at which a square's file is thinned in place
    try:
        for table in tables:
            data = records(table)
            kinds = data.dtype
            for axis, shift in zip("xyz", offset, strict=True):
                data[axis] -= shift
            data = _nearest_to_centre(data, voxel)
            squares = np.floor(np.column_stack([data["x"], data["y"]]) / side).astype(np.int64)
            keys, inverse = np.unique(squares, axis=0, return_inverse=True)
            for k, (i, j) in enumerate(keys):
                path = folder / f"{i}_{j}"
                merged = data[inverse.ravel() == k]
                with path.open("ab") as file:
                    file.write(merged.tobytes())
                if path.stat().st_size > limits.get(path, _SHRINK_AT):
                    path.write_bytes(_nearest_to_centre(np.fromfile(path, kinds), voxel).tobytes())
                    limits[path] = max(_SHRINK_AT, 2 * path.stat().st_size)
        for path in sorted(folder.iterdir(), key=lambda p: tuple(map(int, p.name.split("_")))):
            merged = _nearest_to_centre(np.fromfile(path, kinds or np.dtype([])), voxel)
            table = {name: merged[name].copy() for name in merged.dtype.names or ()}
            for axis, shift in zip("xyz", offset, strict=True):
                table[axis] += shift
            yield table
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(out: Path, tables: Iterator[Table], *, source: _Source) -> int:
    suffix = out.suffix.lower()
    out.parent.mkdir(parents=True, exist_ok=True)
    if suffix in (".las", ".laz"):
        return _write_las(out, tables, source=source)
    return _write_raw(out, tables, source=source, kind="ply" if suffix == ".ply" else "pcd")


def _write_las(out: Path, tables: Iterator[Table], *, source: _Source) -> int:
    dataset = source.dataset
    info = LasInfo(dataset.crs, source.geo.offset, dataset.start)
    count = 0
    with LasWriter(out, info, columns=(*_COLUMNS, "red", "green", "blue")) as writer:
        for table in tables:
            writer.write(table)
            count += rows(table)
    return count


def _write_raw(out: Path, tables: Iterator[Table], *, source: _Source, kind: Literal["ply", "pcd"]) -> int:
    """Write PLY or PCD: points first to a temporary file, then header and points to the real one."""
    body = out.with_name(f"{out.name}.{os.getpid()}.body")
    whole = out.with_name(f"{out.name}.{os.getpid()}.part")
    offset = source.geo.offset
    count = 0
    last: Table | None = None
    try:
        with body.open("wb") as file:
            for table in tables:
                last = ply_table(table) if kind == "ply" else _pcd_table(table, offset)
                file.write(records(last).tobytes())
                count += rows(table)
        empty = {name: column[:0] for name, column in (last or {}).items()}
        name = source.dataset.crs.name
        if kind == "ply":
            header = ply_header(empty, count, comments=(f"crs {name}",))
        else:
            note = f"add {offset[0]:.0f} {offset[1]:.0f} {offset[2]:.0f} for {name}"
            text = encode_pcd(empty, comment=note).decode("ascii")
            header = text.replace("WIDTH 0", f"WIDTH {count}").replace("POINTS 0", f"POINTS {count}").encode()
        with whole.open("wb") as file, body.open("rb") as points:
            file.write(header)
            shutil.copyfileobj(points, file)
        whole.replace(out)
    finally:
        body.unlink(missing_ok=True)
        whole.unlink(missing_ok=True)
    return count


def _pcd_table(table: Table, offset: tuple[float, float, float]) -> Table:
    shifted = {k: (table[k] - s).astype(np.float32) for k, s in zip("xyz", offset, strict=True)}
    rgb = (
        table["red"].astype(np.uint32) << 16
        | table["green"].astype(np.uint32) << 8
        | table["blue"].astype(np.uint32)
    )
    rest = {k: v for k, v in table.items() if k not in ("x", "y", "z", "red", "green", "blue")}
    return shifted | {"rgb": rgb.view(np.float32)} | rest
