"""Clouds of a dataset in its export CRS, the returns that a map is made of, and the poses that place them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import Transformer

from geoscene.classes import Class
from geoscene.errors import reason_of
from lidar.dataset.formats import FORMATS, Format, format_of
from lidar.dataset.formats.table import Table, placed_returns, rows
from lidar.dataset.ground_truth import read_truth
from lidar.dataset.layout import Dataset, read_rows, reading_file
from lidar.dataset.recorded import cloud_points, mount_of
from lidar.errors import DatasetError, InputError
from lidar.geometry.flight_lines import flight_columns
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import gps_seconds, posix_ns
from lidar.geometry.trajectory_files import read_tum, write_tum
from lidar.options.maps import MapOptions, classes_of
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.patterns.beams import frame_ns
from lidar.tools.maps.colors import ImageColors

_STEP_DEG = 1e-3
"""Degrees between points of a region's edges, about 100 m: edges are straight in longitude and latitude."""
_ROUNDING = 1e-6
"""Seconds, of GPS times as floating-point numbers."""
_STEP_NS = 100_000_000  # between poses that are compared with the truth
_FARTHEST = 1e6  # metres from the scene's origin

COLUMNS = (
    *("x", "y", "z", "intensity", "gps_time", "ring", "label", "instance", "echo", "echoes", "source"),
    "frame",
)
"""Columns of a map's points, besides their colours."""

_SAMPLE = 12  # frames from which the range of heights for the colours is estimated


class Selection:
    """The returns of a dataset that options ask for.

    trajectory : that places the returns; those of times outside it have no place
    """

    def __init__(
        self, dataset: Dataset, options: MapOptions, *, trajectory: Trajectory | None = None
    ) -> None:
        self._dataset = dataset
        self._options = options
        self._without = classes_of(options.without)
        self._only = classes_of(options.only, option="only")
        self._region = _region(dataset, options)
        self._origins = [int(Origin[name.upper()]) for name in options.origin]
        self._begin = float(gps_seconds(dataset.start, np.zeros(1, np.int64))[0])
        self._placed = None if trajectory is None else trajectory.time_ns[[0, -1]] * 1e-9

    def may_hold(self, start_ns: int, period_ns: int) -> bool:
        """Whether a frame that lasts from ``start_ns`` can have returns within the time of the options."""
        if self._options.time is None:
            return True
        first, last = (seconds * 1e9 for seconds in self._options.time)
        return start_ns < last and start_ns + period_ns > first

    def unwanted(
        self, table: Table, *, name: str, frame: int, row: int
    ) -> Iterable[tuple[str, NDArray[Any]]]:
        """Masks (n,) of the returns to leave out, by reason, in the order in which they are counted.

        name, frame : of the scanner's cloud that the table is from
        row         : of the cloud with which the table begins
        """
        options, label = self._options, table["label"]
        if self._placed is not None:
            seconds, (first, last) = table["gps_time"] - self._begin, self._placed
            yield "poses", ~((seconds >= first - _ROUNDING) & (seconds <= last + _ROUNDING))
        if options.time is not None:
            seconds = table["gps_time"] - self._begin
            yield "time", ~((seconds >= options.time[0]) & (seconds < options.time[1]))
        if self._region is not None:
            yield "region", ~shapely.contains_xy(self._region, table["x"], table["y"])
        if self._only:
            yield "only", ~np.isin(label, self._only)
        if self._without:
            yield "without", np.isin(label, self._without)
        if options.echo != "all":
            echo, echoes = table["echo"], table["echoes"]
            kept = {"first": echo == 1, "last": echo == echoes, "single": echoes == 1}
            yield "echo", ~kept[options.echo]
        if self._origins:
            yield "origin", ~np.isin(self._origin(table, name, frame=frame, row=row), self._origins)
        elif not options.noise:
            yield "noise", label == Class.NOISE
        if "imaged" in table:
            yield "image", ~table["imaged"]
        if not options.moving:
            yield "moving", np.isin(table["instance"], self._moving(name, frame))

    def _origin(self, table: Table, name: str, *, frame: int, row: int) -> NDArray[np.uint8]:
        """Origins (n,) of returns by the truth of stages; without one: surfaces, noise of the receiver."""
        truth = read_truth(self._dataset.frame_file(self._dataset.paths.truth(name, frame)))
        if truth is None:
            noise = table["label"] == Class.NOISE
            return np.where(noise, Origin.RECEIVER, Origin.SURFACE).astype(np.uint8)
        found: NDArray[np.uint8] = truth["origin"][row : row + rows(table)]
        if len(found) != rows(table):
            path = self._dataset.paths.truth(name, frame)
            raise DatasetError(f"{path}: is of fewer returns than the cloud; drive again with `overwrite`")
        return found

    def _moving(self, name: str, frame: int) -> list[int]:
        """Instances of the road users near a frame of a scanner that move during the drive."""
        path = self._dataset.frame_file(self._dataset.paths.frame_boxes(name, frame))
        if not path.exists():  # without road users
            return []
        boxes = read_rows(path)
        with reading_file(path):
            return [int(row["instance"]) for row in boxes if {"True": True, "False": False}[row["moving"]]]


def _region(dataset: Dataset, options: MapOptions) -> Any:
    """The region of the options in the export CRS, prepared for queries; None for everything.

    Raises InputError for a file without polygons.
    """
    areas = []
    if options.bounds_deg is not None:
        areas.append(shapely.box(*options.bounds_deg))
    if options.polygon is not None:
        areas.append(_polygons(options.polygon))
    if not areas:
        return None
    area = shapely.segmentize(shapely.intersection_all(areas), _STEP_DEG)
    transformer = Transformer.from_crs("OGC:CRS84", dataset.crs, always_xy=True)
    projected = shapely.transform(area, lambda lonlat: np.column_stack(transformer.transform(*lonlat.T)))
    shapely.prepare(projected)
    return projected


def _polygons(path: Path) -> Any:
    """The union of the polygons of a GeoJSON file (RFC 7946: longitude and latitude on WGS 84)."""
    try:
        geometry = shapely.from_geojson(path.read_text("utf-8-sig"))
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; `polygon` takes a GeoJSON file") from None
    except (OSError, UnicodeDecodeError, shapely.errors.GEOSException) as error:
        raise InputError(f"{path}: not a readable GeoJSON file ({reason_of(error)})") from error
    parts = shapely.get_parts(shapely.get_parts(geometry))
    found = [part for part in parts if part.geom_type == "Polygon" and not part.is_empty]
    if not found:
        raise InputError(f"{path}: no polygons in it; `polygon` takes a GeoJSON file with polygons")
    low, high = (
        np.array([part.bounds for part in found])[:, :2],
        np.array([part.bounds for part in found])[:, 2:],
    )
    if (np.abs([low[:, 0], high[:, 0]]) > 180).any() or (np.abs([low[:, 1], high[:, 1]]) > 90).any():
        raise InputError(f"{path}: not in degrees; GeoJSON has longitude and latitude on WGS 84")
    return shapely.union_all(shapely.make_valid(found))


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Root mean squares of the errors of poses.

    horizontal_m, vertical_m : true metres
    yaw_deg                  : degrees
    """

    horizontal_m: float
    vertical_m: float
    yaw_deg: float


def read_poses(path: Path, dataset: Dataset) -> Trajectory:
    """The vehicle's trajectory in the scene, from a TUM file of true metres from the scene's origin.

    Raises as `lidar.geometry.trajectory_files.read_tum`, and InputError for poses that are not of the drive.
    """
    absolute_ns, position, quat = read_tum(path)
    begin, last = posix_ns(dataset.start), dataset.trajectory().duration_ns
    time_ns = absolute_ns - begin
    if time_ns[0] > last or time_ns[-1] < 0:
        raise InputError(
            f"`poses` {path}: its times are {absolute_ns[0] / 1e9:.3f} to {absolute_ns[-1] / 1e9:.3f}, the"
            f" drive's {begin / 1e9:.3f} to {(begin + last) / 1e9:.3f} (POSIX seconds)"
        )
    scale = float(dataset.frame.scale_at(*position[0, :2]))
    scale = float(dataset.frame.scale_at(*(scale * position[0, :2])))
    if not math.isfinite(scale) or np.abs(position).max() > _FARTHEST:
        raise InputError(f"`poses` {path}: positions beyond {_FARTHEST / 1000:g} km from the scene's origin")
    velocity = np.gradient(position, time_ns * 1e-9, axis=0)
    placed = np.ascontiguousarray(position * [scale, scale, 1.0])
    return Trajectory(time_ns, placed, quat, velocity, np.asarray(dataset.frame.scale_at(*placed[:, :2].T)))


def pose_errors(found: Trajectory, true: Trajectory) -> PoseErrors:
    """Errors of a trajectory, every 0.1 s of the time that it shares with the true one."""
    first, last = max(found.time_ns[0], true.time_ns[0]), min(found.time_ns[-1], true.time_ns[-1])
    time_ns = np.unique(np.append(np.arange(first, last, _STEP_NS), last))
    here, there = found.at(time_ns), true.at(time_ns)
    off = (here.position - there.position) / there.scale
    ahead = np.einsum("nji,nj->ni", there.rotation, here.rotation[:, :, 0])
    yaw = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return PoseErrors(*(float(np.sqrt((v**2).mean())) for v in (np.hypot(*off[:, :2].T), off[:, 2], yaw)))


def write_poses(path: Path, trajectory: Trajectory, *, dataset: Dataset) -> None:
    """Write a trajectory as TUM text: true metres from the scene's origin."""
    position = trajectory.position / [trajectory.scale[0], trajectory.scale[0], 1.0]
    time_ns = posix_ns(dataset.start) + trajectory.time_ns
    write_tum(path, time_ns, position=position, quat_xyzw=trajectory.quat_xyzw)


def _readable(frames: tuple[str, ...]) -> list[Format]:
    """Formats with all columns that maps need, those in the world frame first."""
    needed = {"intensity", "ring", "label", "instance"}
    found = [form for form in FORMATS.values() if needed <= set(form.columns) and form.frame in frames]
    return sorted(found, key=lambda form: form.frame != "world")


class MapClouds:
    """The point clouds of some scanners in the export CRS, in order of frames.

    names      : of the scanners
    selection  : whose frames are read; all of them without it
    trajectory : that places the points, from clouds in the sensor frame; by default the true one
    colors     : of images; tables then have red, green, blue and ``imaged``, whether a camera saw the point
    strips     : tables of surveys have the columns of `flight_columns`, instead of a source for each file

    Raises DatasetError for a dataset without such clouds, and InputError if none is within the selected time.
    """

    def __init__(
        self,
        dataset: Dataset,
        names: Sequence[str],
        *,
        selection: Selection,
        trajectory: Trajectory | None = None,
        colors: ImageColors | None = None,
        strips: bool = False,
    ) -> None:
        self.dataset = dataset
        on = dataset.manifest.get("scanners_on_ns") if strips else None
        self._strips = None if on is None else np.array(on, np.int64).reshape(-1, 2)
        self.geo = Georeference(dataset.frame, dataset.crs)
        self._trajectory, self._colors = trajectory, colors
        self._lidars = dataset.sensors("lidar")
        self._names = list(names)
        self._found: Counter[str] = Counter()
        order = list(self._lidars)
        self._files: list[tuple[int, str, int, Path]] = []
        placed = trajectory is None and colors is None
        forms = _readable(("world", "sensor") if placed else ("sensor",))
        for name in names:
            period = int(frame_ns(self._lidars[name]["rate_hz"]))
            form = next((f for f in forms if any(dataset.files(name, f))), None)
            for frame, path in dataset.files(name, form) if form else ():
                self._found[name] += 1
                if selection.may_hold(self.start_ns(name, frame), period):
                    self._files.append((frame, name, order.index(name), path))
        if not self._found:
            which = f"clouds of {', '.join(names) or 'any scanner'}"
            if not placed:
                what = "poses" if colors is None else "color"
                raise DatasetError(
                    f"{dataset.path}: no {which} in the sensor frame in it, which `{what}` takes;"
                    " drive with `formats` pcd"
                )
            raise DatasetError(f"{dataset.path}: no {which} in it")
        if not self._files:
            raise InputError(f"`time`: {dataset.path} has no frames at that time")
        self._files.sort()

    def __len__(self) -> int:
        return len(self._files)

    def start_ns(self, name: str, frame: int) -> int:
        """Start of a scanner's frame, nanoseconds since the drive's start."""
        sensor = self._lidars[name]
        return int(sensor["time_offset_ns"]) + int(frame * frame_ns(sensor["rate_hz"]))

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the tables but for colours: `COLUMNS`, and those of strips."""
        return COLUMNS if self._strips is None else (*COLUMNS, "scan_angle", "edge")

    def missing(self) -> dict[str, int]:
        """Number of missing frames, by scanner."""
        expected = self.dataset.manifest.get("sensor_frames", {})
        missing = {name: expected.get(name, 0) - self._found[name] for name in self._names}
        return {name: count for name, count in missing.items() if count > 0}

    def tables(self, every: int = 1) -> Iterator[tuple[int, str, int, Table]]:
        """Frame number, scanner, first row and table of every n-th file; several tables for large files."""
        wanted = (*self.columns, *(("red", "green", "blue", "imaged") if self._colors else ()))
        for frame, name, index, path in self._files[::every]:
            row = 0
            for table in self._of_file(path, name, frame=frame):
                count = rows(table)
                if self._strips is None:
                    table["source"] = np.full(count, index, np.uint16)
                elif "scan_angle" not in table:
                    zeros = {"scan_angle": np.zeros(count), "edge": np.zeros(count, np.bool_)}
                    table.update({"source": np.zeros(count, np.uint16), **zeros, **table})
                table["frame"] = np.full(count, frame, np.uint32)
                yield frame, name, row, {column: table[column] for column in wanted}
                row += count

    def _of_file(self, path: Path, name: str, *, frame: int) -> Iterator[Table]:
        if (form := format_of(path)).frame == "world":
            yield from form.read_chunks(path)
        else:
            yield self._placed(cloud_points(path), name, frame=frame)

    def _placed(self, table: Table, name: str, *, frame: int) -> Table:
        if self._trajectory is None:
            self._trajectory = self.dataset.trajectory()
        placed, time_ns = placed_returns(
            table,
            self._trajectory,
            start_ns=self.start_ns(name, frame),
            vehicle_from_sensor=np.array(self._lidars[name]["vehicle_from_sensor"]),
        )
        one = np.ones(len(placed), np.uint8)
        colored: Table = {}
        if self._colors is not None:
            mount = np.array(self._lidars[name]["vehicle_from_sensor"], float)
            start = self.start_ns(name, frame)
            rgb, imaged = self._colors.of(table, name, frame=frame, start_ns=start, mount=mount)
            colored = {"red": rgb[:, 0], "green": rgb[:, 1], "blue": rgb[:, 2], "imaged": imaged}
        survey: Table = {}
        if self._strips is not None:
            survey = flight_columns(
                placed,
                self._trajectory,
                mount=mount_of(self._lidars[name]),
                time_ns=time_ns,
                strips=self._strips,
                edges=np.empty(0, np.int64),  # clouds in the sensor frame do not tell
            )
        return (
            colored
            | survey
            | {
                **dict(zip("xyz", self.geo.points(placed).T, strict=True)),
                "intensity": table["intensity"],
                "gps_time": gps_seconds(self.dataset.start, time_ns),
                "ring": table["ring"],
                "label": table["label"].astype(np.uint8),
                "instance": table["instance"],
                "echo": table.get("echo", one),
                "echoes": table.get("echoes", one),
            }
        )

    def height_range(self) -> tuple[float, float]:
        """1st and 99th percentile of the heights of about `_SAMPLE` frames."""
        every = max(1, len(self) // _SAMPLE)
        z = np.concatenate([table["z"] for *_, table in self.tables(every)] or [np.zeros(0)])
        low, high = np.percentile(z, (1, 99)) if len(z) else (0.0, 1.0)
        return float(low), float(high)
