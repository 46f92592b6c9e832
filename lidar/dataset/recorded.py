"""Frames of a dataset, as exporters and maps read them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Ints
from lidar.dataset.formats import FORMATS, Format, format_of, read_table
from lidar.dataset.formats.table import PointLabels, Table, deskew, placed_returns
from lidar.dataset.layout import Dataset, frame_numbers, reading_file
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import Mount, quat_from_matrix
from lidar.geometry.poses import Trajectory

_FAR = 1e6
"""Metres from a scanner, beyond the range of any."""

_RINGS = 4096
"""Channels that a scanner has at most; a flash camera counts the rows of its pixels."""

_LATEST_NS = 2**32 - 1
"""Nanoseconds from a frame's start to a point's time, at most."""

_NEEDED = ("x", "y", "z", "intensity", "time_ns", "ring", "label", "instance")
"""Columns that clouds are used by, in formats that keep them."""

_CLASSES = [int(klass) for klass in Class]


@dataclass(frozen=True)
class Stream:
    """The frames of a sensor.

    name    : of the sensor
    sensor  : its entry of ``calibration.json``
    frames  : (n,) int64, their numbers, ascending
    time_ns : (n,) int64, their starts, since the drive's start
    files   : (n,) of each frame
    """

    name: str
    sensor: dict[str, Any]
    frames: Ints
    time_ns: Ints
    files: tuple[Path, ...]

    @property
    def mount(self) -> Mount:
        """Extrinsics of the sensor."""
        return mount_of(self.sensor)


def mount_of(sensor: Mapping[str, Any]) -> Mount:
    """Extrinsics of an entry of ``calibration.json``."""
    matrix = np.array(sensor["vehicle_from_sensor"], float)
    return Mount(tuple(matrix[:3, 3].tolist()), tuple(quat_from_matrix(matrix[:3, :3]).tolist()))


def labelled_clouds(dataset: Dataset, name: str) -> Stream | None:
    """A scanner's clouds in the sensor frame with times and labels; None if there are none.

    Raises DatasetError for frames without a time.
    """
    streams = (clouds_in(dataset, name, form=form) for form in labelled_formats())
    return next((stream for stream in streams if stream is not None), None)


def all_clouds(dataset: Dataset) -> list[Stream]:
    """The clouds in the sensor frame with times and labels of all scanners that have some.

    Raises DatasetError if there are none, or for frames without a time.
    """
    streams = [labelled_clouds(dataset, name) for name in dataset.sensors("lidar")]
    if not (found := [stream for stream in streams if stream is not None]):
        raise no_clouds(dataset)
    return found


def all_images(dataset: Dataset) -> list[Stream]:
    """The colour images of all cameras that have some; raises as `color_images`."""
    streams = (color_images(dataset, name) for name in dataset.sensors("camera"))
    return [stream for stream in streams if stream is not None]


def no_clouds(dataset: Dataset, *, of: str = "", formats: Sequence[Format] = ()) -> DatasetError:
    """The error of a dataset without clouds in the sensor frame.

    of      : scanners or kind of the clouds
    formats : that would do; by default those with times and labels
    """
    first, *others = (form.name for form in formats or labelled_formats())
    also = f" (or {', '.join(others)})" if others else ""
    return DatasetError(
        f"{dataset.path}: no clouds{of} in the sensor frame; drive with --format {first}{also}"
    )


def scanner_clouds(dataset: Dataset, name: str = "") -> Stream:
    """A scanner's clouds in the sensor frame with times and labels; of the first that has some by default.

    Raises InputError for an unknown scanner, and DatasetError if there are no such clouds.
    """
    lidars = dataset.sensors("lidar")
    if name and name not in lidars:
        known = f"there are {', '.join(lidars)}" if lidars else "there is none"
        raise InputError(f"`sensor` {name}: no scanner in {dataset.path}; {known}")
    for one in [name] if name else lidars:
        if (clouds := labelled_clouds(dataset, one)) is not None:
            return clouds
    raise no_clouds(dataset, of=f" of {name}" if name else "")


def instance_clouds(dataset: Dataset, name: str) -> Stream:
    """A scanner's clouds in the sensor frame with times, labels and instances.

    Raises DatasetError if there are no such clouds.
    """
    clouds = labelled_clouds(dataset, name)
    if clouds is None or "instance" not in cloud_points(clouds.files[0]):
        raise DatasetError(
            f"{dataset.path}: {name} has no clouds with labels and instances; drive again with `formats` pcd"
        )
    return clouds


def frames_within(clouds: Stream, limits: tuple[int, float], *, every: int = 1) -> Stream:
    """Each n-th of the frames of a stream from the first of ``limits`` up to, not including, the second.

    Raises InputError if there are none.
    """
    first, end = limits
    rows = np.flatnonzero((clouds.frames >= first) & (clouds.frames < end))[::every]
    if not len(rows):
        low, high = clouds.frames[[0, -1]]
        last = "" if end == float("inf") else f"{end:.0f}"
        raise InputError(
            f"`frames` {first}:{last}: {clouds.name} has frames {low} to {high}, and none of these"
        )
    files = tuple(clouds.files[row] for row in rows.tolist())
    return replace(clouds, frames=clouds.frames[rows], time_ns=clouds.time_ns[rows], files=files)


def clouds_in(dataset: Dataset, name: str, *, form: Format) -> Stream | None:
    """A scanner's clouds in a format; None if there are none.

    Raises DatasetError for frames without a time.
    """
    found = list(dataset.files(name, form))
    return _stream(dataset, name, found=found) if found else None


def color_images(dataset: Dataset, name: str) -> Stream | None:
    """A camera's colour images; None if there are none.

    Raises DatasetError for frames without a time and a camera without intrinsics.
    """
    camera = dataset.sensors()[name]
    with reading_file(dataset.paths.calibration):
        if not np.isfinite(np.array(camera["K"], float).reshape(3, 3)).all():
            raise ValueError("intrinsics are not finite")
        _ = int(camera["width"]), int(camera["height"]), str(camera["model"]), list(camera["distortion"])
    return _images(dataset, name, kind="rgb")


def _images(dataset: Dataset, name: str, *, kind: str) -> Stream | None:
    """A camera's images of a kind; None if there are none."""
    first = dataset.frame_file(dataset.paths.image(name, 0, kind=kind))
    numbers = frame_numbers(first.parent, ".png").tolist()
    found = [(frame, dataset.paths.image(name, frame, kind=kind)) for frame in numbers]
    return _stream(dataset, name, found=found) if found else None


@dataclass(frozen=True)
class Images:
    """Images of a camera to look at; ``kind`` is ``rgb`` or ``depth``."""

    stream: Stream
    kind: str


def images_of(dataset: Dataset, name: str) -> Images | None:
    """A camera's colour images, or its depth images if it has none; None without either.

    Raises DatasetError for frames without a time.
    """
    for kind in ("rgb", "depth"):
        if (stream := _images(dataset, name, kind=kind)) is not None:
            return Images(stream, kind)
    return None


def labelled_formats() -> list[Format]:
    """Formats that keep points in the sensor frame with times and labels."""
    needed = {"time_ns", "label", "ring"}
    return [form for form in FORMATS.values() if form.frame == "sensor" and needed <= set(form.columns)]


def _stream(dataset: Dataset, name: str, *, found: Iterable[tuple[int, Path]]) -> Stream:
    numbers, files = zip(*found, strict=True)
    frames, time_ns = np.array(numbers, np.int64), dataset.sample_times(name)
    if frames[-1] >= len(time_ns):
        stamps = dataset.paths.timestamps(name)
        raise DatasetError(f"{stamps}: has no time of frame {frames[-1]}; drive again with `overwrite`")
    return Stream(name, dataset.sensors()[name], frames, time_ns[frames], files)


def cloud_points(path: Path) -> Table:
    """The points of a recorded cloud in the sensor frame.

    Raises FormatError or DatasetError for a damaged file.
    """
    with reading_file(path):
        table = read_table(path)
        if lacks := [name for name in format_of(path).columns if name in _NEEDED and name not in table]:
            raise ValueError(f"lacks {', '.join(lacks)}")
        lengths = [table[name] for name in ("intensity", "range") if name in table]
        near = all((np.abs(table[name]) < _FAR).all() for name in "xyz")
        near = near and all(((column >= 0) & (column < _FAR)).all() for column in lengths)
        time_ns = table.get("time_ns", np.zeros(1))
        if not (near and ((time_ns >= 0) & (time_ns <= _LATEST_NS)).all()):
            raise ValueError("points that no scanner measures")
        if "ring" in table and table["ring"].max(initial=0) >= _RINGS:
            raise ValueError(f"ring {table['ring'].max()}, more than a scanner has")
        if "label" in table and not np.isin(table["label"], _CLASSES).all():
            raise ValueError("labels of no class")
    return table


def still_points(clouds: Stream, trajectory: Trajectory, *, row: int) -> Table:
    """The points of a cloud without the ego vehicle's motion, in the frame of the sensor at its start.

    row : of the stream

    Raises as `cloud_points`.
    """
    table, start_ns, mount = cloud_points(clouds.files[row]), int(clouds.time_ns[row]), clouds.mount
    placed, _ = placed_returns(table, trajectory, start_ns=start_ns, vehicle_from_sensor=mount.matrix)
    still = deskew(placed, trajectory, mount=mount, time_ns=start_ns)
    return table | dict(zip("xyz", still.T, strict=True))


def recorded_labels(table: Table, boxes: Iterable[Mapping[str, Any]] = ()) -> PointLabels:
    """The labels of a recorded cloud's points.

    boxes : rows of the frame's 3D boxes, which give the numbers of road users and whether they move
    """
    road_user, moving = np.zeros(len(table["label"]), np.int64), np.zeros(len(table["label"]), bool)
    for box in boxes:
        on = table["instance"] == box["instance"]
        road_user[on], moving[on] = box["id"] + 1, box["moving"]
    return PointLabels(table["label"].astype(np.int64), road_user, moving)


def nearest(times: NDArray[np.int64], wanted: NDArray[np.int64]) -> Ints:
    """Index of the nearest of increasing ``times`` to each target; of equally near ones the earlier."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    if len(times) == 1:
        return np.zeros(len(wanted), np.int64)
    index: Ints = after - (wanted - times[after - 1] <= times[after] - wanted)
    return index
