"""Aggregated maps: all point clouds of a dataset as one, in its export CRS, in bounded memory."""

from __future__ import annotations

import os
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes
from geoscene.progress import Progress, silent
from lidar.dataset.formats import FORMATS, Format, format_of, map_suffixes
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table, placed_returns, records, rows
from lidar.dataset.layout import Dataset, read_rows, reading_file
from lidar.dataset.recorded import cloud_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Trajectory
from lidar.maps.colors import distinct, ramp
from lidar.options import MapOptions, classes_of
from lidar.rig.patterns.beams import frame_ns
from lidar.time_scales import gps_seconds

_COLUMNS = ("x", "y", "z", "intensity", "gps_time", "ring", "label", "instance", "source")
_BUCKET = 64.0  # metres: side of the squares into which points are sorted before they are thinned
_SHRINK_AT = 64 * 2**20  # bytes of a square's points beyond which they are thinned
_SAMPLE = 12  # frames from which the range of heights for the colours is estimated


def _readable() -> list[Format]:
    """Formats with all columns that maps need, those in the world frame first."""
    needed = {"intensity", "ring", "label", "instance"}
    found = [form for form in FORMATS.values() if needed <= set(form.columns)]
    return sorted(found, key=lambda form: form.frame != "world")


@dataclass(frozen=True, slots=True)
class MapSummary:
    """Numbers of points and frames of a map.

    points_in : returns read
    points    : points written
    noise     : returns of class NOISE that were left out
    moving    : returns of road users that move during the drive, left out
    without   : returns of the classes to leave out
    frames    : frames read
    missing   : number of missing frames, by scanner
    path      : the file
    """

    points_in: int
    points: int
    noise: int
    moving: int
    without: int
    frames: int
    missing: dict[str, int]
    path: Path


def aggregate(
    dataset: Dataset,
    out: str | Path,
    *,
    options: MapOptions = MapOptions(),
    overwrite: bool = False,
    progress: Progress = silent,
) -> MapSummary:
    """Write the map of a dataset in the format of the suffix of ``out`` (see `map_suffixes`).

    LAS, LAZ, COPC, E57 and PLY hold easting, northing and height in the dataset's export CRS. PCD, whose
    readers take float32, holds the same minus the whole-metre offset that its comment line states.

    overwrite : replace an existing file

    Raises InputError for an unknown scanner or suffix, and DatasetError for a dataset without clouds.
    """
    out = Path(out)
    if not out.name.lower().endswith(tuple(map_suffixes())) or not format_of(out).maps:
        raise InputError(f"{out}: maps are written as {', '.join(map_suffixes())}")
    format_of(out).require()
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    lidars = dataset.sensors("lidar")
    if unknown := sorted(set(options.sensors) - set(lidars)):
        raise InputError(f"no scanner {', '.join(unknown)} in {dataset.path}; there are {', '.join(lidars)}")
    chosen = [name for name in lidars if not options.sensors or name in options.sensors]
    source = _Source(dataset, chosen)
    limits = source.height_range() if options.color == "height" else (0.0, 0.0)

    read = 0
    dropped = Counter[str]()
    unwanted = classes_of(options.without)
    frames: set[int] = set()

    def tables() -> Iterator[Table]:
        nonlocal read
        for k, (frame, name, table) in enumerate(source.tables()):
            read += rows(table)
            frames.add(frame)
            progress("reading clouds", k + 1, total=len(source))
            left = {
                "without": np.isin(table["label"], unwanted),
                "noise": (table["label"] == Class.NOISE) & (not options.noise),
                "moving": np.isin(table["instance"], [] if options.moving else source.moving(name, frame)),
            }
            keep = np.ones(rows(table), bool)
            for reason, rows_left in left.items():
                dropped[reason] += int(np.count_nonzero(keep & rows_left))
                keep &= ~rows_left
            yield table if keep.all() else {column: values[keep] for column, values in table.items()}

    stream = tables()
    if options.voxel is not None:
        stream = _voxels(stream, options.voxel, out=out, offset=source.geo.offset)
    written = _write(out, (_colored(t, options.color, limits=limits) for t in stream), source=source)
    reasons = dropped["noise"], dropped["moving"], dropped["without"]
    return MapSummary(read, written, *reasons, len(frames), source.missing(), out)


class _Source:
    """The point clouds of some scanners in the export CRS, in order of frames."""

    def __init__(self, dataset: Dataset, names: Sequence[str]) -> None:
        self.dataset = dataset
        self.geo = Georeference(dataset.frame, dataset.crs)
        self._trajectory: Trajectory | None = None
        self._lidars = dataset.sensors("lidar")
        self._names = list(names)
        order = list(self._lidars)
        self._files: list[tuple[int, str, int, Path]] = []
        for name in names:
            form = next((f for f in _readable() if any(dataset.files(name, f))), None)
            if form:
                files = dataset.files(name, form)
                self._files += [(frame, name, order.index(name), path) for frame, path in files]
        if not self._files:
            raise DatasetError(f"{dataset.path}: no clouds of {', '.join(names) or 'any scanner'} in it")
        self._files.sort()

    def __len__(self) -> int:
        return len(self._files)

    def missing(self) -> dict[str, int]:
        """Number of missing frames, by scanner."""
        expected = self.dataset.manifest.get("sensor_frames", {})
        found = Counter(name for _, name, *_ in self._files)
        missing = {name: expected.get(name, 0) - found[name] for name in self._names}
        return {name: count for name, count in missing.items() if count > 0}

    def moving(self, name: str, frame: int) -> list[int]:
        """Instances of the road users near a frame of a scanner that move during the drive."""
        path = self.dataset.frame_file(self.dataset.paths.frame_boxes(name, frame))
        if not path.exists():  # without road users
            return []
        boxes = read_rows(path)
        with reading_file(path):
            return [int(row["instance"]) for row in boxes if {"True": True, "False": False}[row["moving"]]]

    def tables(self, every: int = 1) -> Iterator[tuple[int, str, Table]]:
        """Frame number, scanner and table of every n-th file; several tables for large files."""
        for frame, name, index, path in self._files[::every]:
            if (form := format_of(path)).frame == "world":
                for table in form.read_chunks(path):
                    yield (
                        frame,
                        name,
                        {k: table[k] for k in _COLUMNS if k in table and k != "source"}
                        | {"source": np.full(rows(table), index, np.uint16)},
                    )
            else:
                yield frame, name, self._placed(cloud_points(path), name, index=index, frame=frame)

    def _placed(self, table: Table, name: str, *, index: int, frame: int) -> Table:
        if self._trajectory is None:
            self._trajectory = self.dataset.trajectory()
        sensor = self._lidars[name]
        start = int(sensor["time_offset_ns"]) + int(frame * frame_ns(sensor["rate_hz"]))
        mount = np.array(sensor["vehicle_from_sensor"])
        placed, time_ns = placed_returns(table, self._trajectory, start_ns=start, vehicle_from_sensor=mount)
        world = self.geo.points(placed)
        return {
            **dict(zip("xyz", world.T, strict=True)),
            "intensity": table["intensity"],
            "gps_time": gps_seconds(self.dataset.start, time_ns),
            "ring": table["ring"],
            "label": table["label"].astype(np.uint8),
            "instance": table["instance"],
            "source": np.full(len(world), index, np.uint16),
        }

    def height_range(self) -> tuple[float, float]:
        """1st and 99th percentile of the heights of about `_SAMPLE` frames."""
        every = max(1, len(self) // _SAMPLE)
        z = np.concatenate([table["z"] for _, _, table in self.tables(every)] or [np.zeros(1)])
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


def nearest_to_centre(data: NDArray[np.void], voxel: float) -> NDArray[np.void]:
    """The record nearest to the centre of each voxel; of equally near ones the earliest."""
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
    """Tables with one point per voxel. Points are sorted into squares on disk first."""
    folder = out.with_name(f"{out.name}.{os.getpid()}.voxels")
    folder.mkdir(parents=True)
    side = (
        max(1.0, np.ceil(_BUCKET / voxel)) * voxel
    )  # a multiple of the voxel, so that no voxel spans two squares
    kinds: np.dtype[np.void] | None = None
    limits: dict[Path, int] = {}  # bytes at which a square's file is thinned
    try:
        for table in tables:
            data = records(table)
            kinds = data.dtype
            for axis, shift in zip("xyz", offset, strict=True):
                data[axis] -= shift
            data = nearest_to_centre(data, voxel)
            squares = np.floor(np.column_stack([data["x"], data["y"]]) / side).astype(np.int64)
            keys, inverse = np.unique(squares, axis=0, return_inverse=True)
            for k, (i, j) in enumerate(keys):
                path = folder / f"{i}_{j}"
                merged = data[inverse.ravel() == k]
                with path.open("ab") as file:
                    file.write(merged.tobytes())
                if path.stat().st_size > limits.get(path, _SHRINK_AT):
                    path.write_bytes(nearest_to_centre(np.fromfile(path, kinds), voxel).tobytes())
                    limits[path] = max(_SHRINK_AT, 2 * path.stat().st_size)
        for path in sorted(folder.iterdir(), key=lambda p: tuple(map(int, p.name.split("_")))):
            merged = nearest_to_centre(np.fromfile(path, kinds or np.dtype([])), voxel)
            table = {name: merged[name].copy() for name in merged.dtype.names or ()}
            for axis, shift in zip("xyz", offset, strict=True):
                table[axis] += shift
            yield table
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _write(out: Path, tables: Iterator[Table], *, source: _Source) -> int:
    """Write tables as a map; return the number of points."""
    info = LasInfo(source.dataset.crs, source.geo.offset, source.dataset.start)
    out.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with format_of(out).open_map(out, info=info, columns=(*_COLUMNS, "red", "green", "blue")) as append:
        for table in tables:
            append(table)
            count += rows(table)
    return count
