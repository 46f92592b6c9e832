"""Labelled frames of recorded drives as samples of NumPy arrays, for the training of networks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, SupportsIndex, overload

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import Table
from lidar.dataset.ground_truth import read_boxes
from lidar.dataset.layout import Dataset, DatasetLike, opened_datasets
from lidar.dataset.png import read_png
from lidar.dataset.recorded import Stream, cloud_points, color_images, instance_clouds, nearest, still_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory

Sample = dict[str, Any]

_SHOWN = 7
"""Lines of a description."""

_BOX = (
    *("id", "ego_x", "ego_y", "ego_z", "length", "width", "height", "ego_yaw"),
    *("ego_vx", "ego_vy", "ego_vz", "points", "visibility"),
)
"""Columns of boxes that samples are made of."""


@dataclass(frozen=True)
class _Drive:
    """Sources of the samples of a drive.

    clouds : of the scanner
    images : of each camera
    boxes  : whether it has boxes of road users
    """

    dataset: Dataset
    clouds: Stream
    images: dict[str, Stream]
    boxes: bool


@dataclass(frozen=True)
class TrainingData(Sequence[Any]):
    """Labelled frames of one scanner in one or several drives, as a map-style dataset.

    A ``torch.utils.data.DataLoader`` takes it as it is, with worker processes, too: it has a length, gives
    samples by number, and can be pickled; files are opened when a sample is read. Frames have different
    numbers of points, so give the loader a ``collate_fn``, such as ``list``.

    A sample has these arrays, in metres and the frame of the scanner at the frame's start (x forward, y left,
    z up):

    points      : (n, columns) float32
    label       : (n,) int64, `geoscene.classes.Class` of each point
    instance    : (n,) int64, number of the object that each point lies on, -1 for none
    boxes       : (m, 7) float32, centre x, y, z, length, width, height of road users, and yaw in radians from
                  the x axis to the left; about the scanner's z axis, so that they fit level scanners only
    box_label   : (m,) int64, `Class`
    box_id      : (m,) int64, number of the road user in the drive
    box_instance: (m,) int64, as in ``instance``
    box_velocity: (m, 3) float32, m/s, not relative to the ego vehicle
    box_points  : (m,) int64, points on it
    box_visibility : (m,) float32, share that is not hidden, 0 to 1
    scene_from_sensor : (4, 4) float64, pose of the scanner at the frame's start, scene metres; rigid, without
                  the scale of a projected CRS
    time_ns     : start of the frame, nanoseconds since the drive's start
    frame, drive: number of the frame, and of the drive among the given ones
    image_NAME  : (h, w, 3) uint8, colours of the camera's image that was taken nearest to the frame's start
    NAME_from_sensor : (4, 4) float64, to the camera when it took the image (x right, y down, z forward)
    K_NAME      : (3, 3) float64, its intrinsics

    Build it by `training_data`.

    drives    : what is read
    rows      : (s, 2) drive and row of its clouds, of each sample
    columns   : of ``points``: names of columns of the recorded clouds
    deskewed  : whether points are without the ego vehicle's motion, as if all were measured at the start
    min_points: points on a box from which on it is kept
    transform : of a sample, called last; a function that can be pickled, for worker processes
    """

    drives: tuple[_Drive, ...]
    rows: Ints
    columns: tuple[str, ...]
    deskewed: bool
    min_points: int
    transform: Callable[[Sample], Any] | None
    _trajectories: dict[int, Trajectory] = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        """How many samples there are, of which drives and sensors, in a few lines."""
        numbers = self.rows[:, 0]
        lines = [
            f"TrainingData: {len(self):,} samples; points: {', '.join(self.columns)}"
            + ("" if self.deskewed else "; not de-skewed")
        ]
        for number, drive in enumerate(self.drives):
            count = int((numbers == number).sum())
            sensors = ", ".join([drive.clouds.name, *drive.images])
            boxes = "" if drive.boxes else ", no boxes"
            frames = f"{count:,} of {len(drive.clouds.files):,} frames"
            lines.append(f"  {drive.dataset.path}: {frames} of {sensors}{boxes}")
        if len(lines) > _SHOWN:
            lines[_SHOWN:] = [f"  ... and {len(lines) - _SHOWN} more drives"]
        return "\n".join(lines)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.rows)

    @overload
    def __getitem__(self, index: SupportsIndex) -> Any: ...
    @overload
    def __getitem__(self, index: slice) -> TrainingData: ...
    def __getitem__(self, index: SupportsIndex | slice) -> Any:
        """A sample, after the transform; of a slice the data with these samples.

        Raises IndexError beyond the last one, and DatasetError or FormatError for damaged files.
        """
        if isinstance(index, slice):
            return replace(self, rows=self.rows[index])
        number, row = self.rows[index.__index__()].tolist()
        sample = self._sample(number, row)
        return sample if self.transform is None else self.transform(sample)

    def __getstate__(self) -> dict[str, Any]:
        """State for pickling, without the trajectories, which are read again."""
        return self.__dict__ | {"_trajectories": {}}

    def split(self, share: float) -> tuple[TrainingData, TrainingData]:
        """Two parts of the data, such as for training and validation: the first share of each drive's frames.

        Frames that follow each other are nearly the same, so that random parts would not be independent;
        drives through other places are better still.

        Raises InputError unless 0 < share < 1.
        """
        if not 0 < share < 1:
            raise InputError(f"`share` {share:g}: give a number between 0 and 1")
        drive = self.rows[:, 0]
        early = np.zeros(len(drive), bool)
        for number in range(len(self.drives)):
            own = np.flatnonzero(drive == number)
            early[own[: round(share * len(own))]] = True
        return replace(self, rows=self.rows[early]), replace(self, rows=self.rows[~early])

    def _sample(self, number: int, row: int) -> Sample:
        drive = self.drives[number]
        clouds, trajectory = drive.clouds, self._trajectory(number)
        table = (
            still_points(clouds, trajectory, row=row) if self.deskewed else cloud_points(clouds.files[row])
        )
        time_ns = int(clouds.time_ns[row])
        placed = _pose(trajectory, clouds.mount, time_ns=time_ns)
        return {
            "points": self._points(table, clouds.files[row]),
            "label": table["label"].astype(np.int64),
            "instance": table["instance"].astype(np.int64),
            **self._boxes(drive, row),
            "scene_from_sensor": placed,
            "time_ns": time_ns,
            "frame": int(clouds.frames[row]),
            "drive": number,
            **_images(drive, trajectory, time_ns=time_ns, placed=placed),
        }

    def _trajectory(self, number: int) -> Trajectory:
        if number not in self._trajectories:
            self._trajectories[number] = self.drives[number].dataset.trajectory()
        return self._trajectories[number]

    def _points(self, table: Table, path: Path) -> NDArray[np.float32]:
        if lacks := [name for name in self.columns if name not in table]:
            raise InputError(f"`columns` {', '.join(lacks)}: {path} has {', '.join(table)}")
        return np.column_stack([table[name] for name in self.columns]).astype(np.float32)

    def _boxes(self, drive: _Drive, row: int) -> Sample:
        """The boxes of a cloud, as in a sample."""
        clouds, found = drive.clouds, list[dict[str, Any]]()
        if drive.boxes:
            path = drive.dataset.paths.frame_boxes(clouds.name, int(clouds.frames[row]))
            found = read_boxes(drive.dataset.frame_file(path), (*_BOX, "class", "instance"))
        kept = [box for box in found if box["points"] >= self.min_points]

        def column(*names: str) -> Float:
            return np.array([[box[name] for name in names] for box in kept], float).reshape(-1, len(names))

        mount = clouds.mount
        turn = mount.rotation.T
        centre = (column("ego_x", "ego_y", "ego_z") - mount.translation) @ turn.T
        yaw = column("ego_yaw")[:, 0]
        ahead = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(kept))]) @ turn.T
        yaw = np.arctan2(ahead[:, 1], ahead[:, 0])
        boxes = np.column_stack([centre, column("length", "width", "height"), yaw])
        return {
            "boxes": boxes.astype(np.float32),
            "box_label": np.array([Class[box["class"].upper()] for box in kept], np.int64),
            "box_id": column("id")[:, 0].astype(np.int64),
            "box_instance": column("instance")[:, 0].astype(np.int64),
            "box_velocity": (column("ego_vx", "ego_vy", "ego_vz") @ turn.T).astype(np.float32),
            "box_points": column("points")[:, 0].astype(np.int64),
            "box_visibility": column("visibility")[:, 0].astype(np.float32),
        }


def training_data(
    datasets: DatasetLike | Sequence[DatasetLike],
    *,
    sensor: str = "",
    cameras: Sequence[str] = (),
    columns: Sequence[str] = ("x", "y", "z", "intensity"),
    deskewed: bool = True,
    min_points: int = 1,
    transform: Callable[[Sample], Any] | None = None,
) -> TrainingData:
    """The labelled frames of drives, for training.

    datasets   : what `lidar.drive` wrote, as its directory or opened, or several
    sensor     : name of the scanner; by default the first one of each drive
    cameras    : names of the cameras whose images are read, too
    columns    : of the points: x, y, z, intensity, ring, time_ns, range, incidence, echo, velocity and others
                 that the recorded format keeps
    deskewed   : whether the ego vehicle's motion during a frame is removed
    min_points : points on a box from which on it is kept
    transform  : of a sample, called last

    Raises DatasetError for drives without labelled clouds in the sensor frame (format ``pcd``), and
    InputError for an unknown sensor.
    """
    cameras, columns = ((one,) if isinstance(one, str) else one for one in (cameras, columns))
    drives = tuple(_drive(dataset, sensor, cameras=cameras) for dataset in opened_datasets(datasets))
    rows = [(k, row) for k, drive in enumerate(drives) for row in range(len(drive.clouds.files))]
    numbers = np.array(rows, np.int64).reshape(-1, 2)
    return TrainingData(drives, numbers, tuple(columns), deskewed, min_points, transform)


def _drive(dataset: Dataset, sensor: str, *, cameras: Sequence[str]) -> _Drive:
    """Sources of the samples of a dataset."""
    scanners = dataset.sensors("lidar")
    name = sensor or next(iter(scanners), "")
    if name not in scanners:
        raise InputError(f"`sensor` {name}: no scanner of {dataset.path}, which has {_list(scanners)}")
    clouds = instance_clouds(dataset, name)
    images, known = dict[str, Stream](), dataset.sensors("camera")
    for camera in cameras:
        if camera not in known:
            raise InputError(f"`cameras` {camera}: no camera of {dataset.path}, which has {_list(known)}")
        stream = color_images(dataset, camera)
        if stream is None:
            raise DatasetError(f"{dataset.path}: {camera} has no colour images")
        images[camera] = stream
    boxes = dataset.frame_file(dataset.paths.frame_boxes(name, int(clouds.frames[0]))).exists()
    return _Drive(dataset, clouds, images, boxes)


def _pose(trajectory: Trajectory, mount: Mount, *, time_ns: int) -> Float:
    """Rigid transform (4, 4) from a sensor to the scene."""
    pose = trajectory.at([time_ns]).mounted(mount.translation, mount.rotation)
    matrix: Float = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.rotation[0], pose.position[0]
    return matrix


def _images(drive: _Drive, trajectory: Trajectory, *, time_ns: int, placed: Float) -> Sample:
    """The images of a frame with their calibration, as in a sample.

    placed : (4, 4) pose of the scanner
    """
    found: Sample = {}
    for name, stream in drive.images.items():
        row = int(nearest(stream.time_ns, np.array([time_ns]))[0])
        found[f"image_{name}"] = read_png(stream.files[row])
        camera = _pose(trajectory, stream.mount, time_ns=int(stream.time_ns[row]))
        found[f"{name}_from_sensor"] = np.linalg.inv(camera) @ placed
        found[f"K_{name}"] = np.array(stream.sensor["K"], float).reshape(3, 3)
    return found


def _list(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
