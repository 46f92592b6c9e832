"""The clouds of a dataset in its export CRS, frame after frame, and the trajectory that places them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.typing import Ints
from lidar.dataset.formats import FORMATS, Format, format_of
from lidar.dataset.formats.table import Table, placed_returns, rows
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import cloud_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import gps_seconds, posix_ns
from lidar.geometry.trajectory_files import read_tum, write_tum
from lidar.sensors.rig.patterns.beams import frame_ns
from lidar.tools.maps.image_colors import ImageColors
from lidar.tools.maps.selection import Selection

_STEP_NS = 100_000_000  # between poses that are compared with the truth
_FARTHEST = 1e6  # metres from the scene's origin
COLUMNS = (
    *("x", "y", "z", "intensity", "gps_time", "ring", "label", "instance", "echo", "echoes", "source"),
    "frame",
)
"""Columns of a map's points, besides their colours."""

_SAMPLE = 12  # frames from which the range of heights for the colours is estimated


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

    Raises as `lidar.geometry.trajectory_tum.read_tum`, and InputError for poses that are not of the drive.
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
    time_ns = _even_times(first, last)
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


def _even_times(first: int, last: int) -> Ints:
    """Times every `_STEP_NS` from the first to the last, and the last."""
    return np.unique(np.append(np.arange(first, last, _STEP_NS), last))


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
    ) -> None:
        self.dataset = dataset
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

    def missing(self) -> dict[str, int]:
        """Number of missing frames, by scanner."""
        expected = self.dataset.manifest.get("sensor_frames", {})
        missing = {name: expected.get(name, 0) - self._found[name] for name in self._names}
        return {name: count for name, count in missing.items() if count > 0}

    def tables(self, every: int = 1) -> Iterator[tuple[int, str, int, Table]]:
        """Frame number, scanner, first row and table of every n-th file; several tables for large files."""
        wanted = COLUMNS if self._colors is None else (*COLUMNS, "red", "green", "blue", "imaged")
        for frame, name, index, path in self._files[::every]:
            row = 0
            for table in self._of_file(path, name, frame=frame):
                count = rows(table)
                table["source"] = np.full(count, index, np.uint16)
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
        return colored | {
            **dict(zip("xyz", self.geo.points(placed).T, strict=True)),
            "intensity": table["intensity"],
            "gps_time": gps_seconds(self.dataset.start, time_ns),
            "ring": table["ring"],
            "label": table["label"].astype(np.uint8),
            "instance": table["instance"],
            "echo": table.get("echo", one),
            "echoes": table.get("echoes", one),
        }

    def height_range(self) -> tuple[float, float]:
        """1st and 99th percentile of the heights of about `_SAMPLE` frames."""
        every = max(1, len(self) // _SAMPLE)
        z = np.concatenate([table["z"] for *_, table in self.tables(every)] or [np.zeros(0)])
        low, high = np.percentile(z, (1, 99)) if len(z) else (0.0, 1.0)
        return float(low), float(high)
