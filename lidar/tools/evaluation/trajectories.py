"""Trajectories as they are compared: files of TUM and KITTI, ``poses.csv``, and the truth of datasets."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.errors import reading
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.dataset.layout import Dataset, open_dataset
from lidar.dataset.recorded import mount_of
from lidar.errors import FormatError, InputError
from lidar.geometry.attitude import matrix_from_quat, quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_files import MANIFEST, read_tum, write_tum

ESTIMATE = "trajectory.tum"
"""Name of the trajectory in folders of estimates."""
_POSES = ("timestamp", "x", "y", "z", "qx", "qy", "qz", "qw")
_OF_ESTIMATE = "poses.csv"
_LARGEST = 1e9
"""Metres: greatest coordinate."""


@dataclass(frozen=True, slots=True)
class Path3D(Columns):
    """Poses of a body at rising times.

    time_ns  : (n,) int64, nanoseconds since 1970; of files without times the number of the pose
    position : (n, 3) float64, true metres
    rotation : (n, 3, 3) float64, from the body's axes to those of the positions
    timed    : whether it has times
    """

    time_ns: Ints
    position: Float
    rotation: Float
    timed: bool = True

    def mounted(self, vehicle_from_sensor: Float) -> Path3D:
        """The path of a sensor mounted (4, 4) on the body."""
        mount = vehicle_from_sensor
        return Path3D(
            self.time_ns,
            self.position + self.rotation @ mount[:3, 3],
            self.rotation @ mount[:3, :3],
            self.timed,
        )

    def moved(self, rotation: Float, shift: Float, *, scale: float = 1.0) -> Path3D:
        """The path turned by a rotation (3, 3) and scaled, then shifted (3,)."""
        position = scale * self.position @ rotation.T + shift
        return Path3D(self.time_ns, position, rotation @ self.rotation, self.timed)

    def at(self, time_ns: Ints) -> Path3D:
        """Poses at times within the path's, positions linear and rotations along great arcs in between."""
        found = self._trajectory().at(time_ns)
        return Path3D(time_ns, found.position, found.rotation, self.timed)

    def distance(self) -> Float:
        """Length (n,) of the way to each pose, metres."""
        steps = np.linalg.norm(np.diff(self.position, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def write(self, path: Path) -> None:
        """Write the path as TUM text."""
        write_tum(path, self.time_ns, position=self.position, quat_xyzw=quat_from_matrix(self.rotation))

    def _trajectory(self) -> Trajectory:
        n = len(self.time_ns)
        quat = quat_from_matrix(self.rotation)
        return Trajectory(self.time_ns, self.position, quat, np.zeros((n, 3)), np.ones(n))


def true_path(dataset: Dataset) -> Path3D:
    """The true poses of a dataset's vehicle: true metres from the scene's origin, as in TUM exports."""
    trajectory = dataset.trajectory()
    shrink = [trajectory.scale[0], trajectory.scale[0], 1.0]
    return Path3D(
        posix_ns(dataset.start) + trajectory.time_ns,
        trajectory.position / shrink,
        matrix_from_quat(trajectory.quat_xyzw),
    )


def read_truth(source: Path) -> tuple[Path3D, Dataset | None]:
    """The trajectory of a dataset or a file, and the dataset if it is one.

    Raises InputError for what is neither, and FormatError or DatasetError for damaged files.
    """
    if source.is_dir() or source.name == MANIFEST:
        dataset = open_dataset(source.parent if source.name == MANIFEST else source)
        return true_path(dataset), dataset
    return read_path(source, truth=None, sensor=""), None


def read_path(source: Path, *, truth: Dataset | None, sensor: str) -> Path3D:
    """The trajectory of a file or a dataset.

    truth  : dataset that it is compared with: it gives the times of poses in KITTI's form, and the scale of
             ``poses.csv``
    sensor : whose poses these are, for the times; the vehicle if empty

    Raises as `read_truth`.
    """
    source = file_of(source)
    if source.is_dir():
        if not (source / MANIFEST).is_file():
            raise InputError(
                f"{source}: neither a dataset, a folder of lidar odometry, nor one of detections"
                " (NNNNNN.txt or results.json)"
            )
        return true_path(open_dataset(source))
    if source.suffix.lower() == ".csv":
        return _read_csv(source, truth=truth)
    words = _first_words(source)
    if len(words) == 12:
        return _read_kitti(source, truth=truth, sensor=sensor)
    if len(words) == 8:
        time_ns, position, quat = read_tum(source)
        return Path3D(time_ns, position, matrix_from_quat(quat))
    raise FormatError(
        f"{source}: no trajectory: its first line has {len(words)} numbers; TUM's have 8 (timestamp tx ty tz"
        " qx qy qz qw), KITTI's 12"
    )


def file_of(source: Path) -> Path:
    """The trajectory in a folder of `lidar.tools.odometry`; any other path as it is."""
    inside = source / ESTIMATE
    return inside if inside.is_file() else source


def _first_words(source: Path) -> list[str]:
    """Words of the first line that is no comment."""
    try:
        with source.open(encoding="utf-8") as lines:
            for line in lines:
                if (words := line.split()) and not words[0].startswith("#"):
                    return words
    except OSError as error:
        raise InputError(f"{source}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise FormatError(f"{source}: not text") from None
    return []


def _read_kitti(source: Path, *, truth: Dataset | None, sensor: str) -> Path3D:
    """Poses of 12 numbers a line, at the times of ``times.txt`` beside them or of a dataset's frames."""
    values = _table(source)
    if values.shape[1:] != (12,) or len(values) < 2:
        raise FormatError(f"{source}: {values.shape} numbers; KITTI's poses are two or more lines of 12")
    matrix = values.reshape(-1, 3, 4)
    turn = matrix[:, :, :3]
    if not (np.abs(values) < _LARGEST).all() or not np.allclose(
        turn @ turn.swapaxes(1, 2), np.eye(3), atol=1e-3
    ):
        raise FormatError(f"{source}: holds matrices that are no rigid transformations")
    position, rotation = matrix[:, :, 3].copy(), matrix_from_quat(quat_from_matrix(turn))
    if truth is None:
        return Path3D(np.arange(len(values)), position, rotation, timed=False)
    frames = truth.sample_times(sensor or next(iter(truth.sensors("lidar", "camera")), ""))
    beside = source.with_name("times.txt")
    if beside.is_file():
        seconds = _table(beside).ravel()
        if len(seconds) != len(values) or not (np.diff(seconds) > 0).all():
            raise FormatError(f"{beside}: {len(seconds)} times for {len(values)} poses, or not rising")
        time_ns = frames[0] + np.round(seconds * 1e9).astype(np.int64)
    elif source.with_name(_OF_ESTIMATE).is_file() and source.with_name(ESTIMATE).is_file():
        found = _read_csv(source.with_name(_OF_ESTIMATE), truth=truth)
        if len(found) != len(values):
            raise FormatError(f"{source}: {len(values)} poses, and {len(found)} in poses.csv beside it")
        return Path3D(found.time_ns, position, rotation)
    elif len(frames) == len(values):
        time_ns = frames
    else:
        raise InputError(
            f"{source}: {len(values)} poses without times; {truth.path} has {len(frames)} frames"
            f" of {sensor or 'its first sensor'}: name the sensor with `sensor`, or put times.txt beside them"
        )
    return Path3D(posix_ns(truth.start) + time_ns, position, rotation)


def _table(source: Path) -> Float:
    with reading(source, FormatError, remedy="give numbers separated by spaces", known=FormatError):
        return np.loadtxt(source, ndmin=2)


def _read_csv(source: Path, *, truth: Dataset | None) -> Path3D:
    """Poses of ``poses.csv``, or the dataset of ``trajectory.csv``."""
    beside = (source.parent / MANIFEST).is_file()
    if source.name == "trajectory.csv" and beside:
        return true_path(open_dataset(source.parent))
    frame = open_dataset(source.parent) if beside else truth
    with (
        reading(source, FormatError, remedy="give the columns of poses.csv", known=FormatError),
        source.open(newline="", encoding="utf-8") as file,
    ):
        rows = list(csv.DictReader(file, strict=True))
        if not rows or any(name not in rows[0] for name in _POSES):
            raise FormatError(f"{source}: lacks rows or columns; poses.csv has {', '.join(_POSES)}")
        stamps = [row["timestamp"].removesuffix("Z") for row in rows]
        time_ns = np.array(stamps, "datetime64[ns]").astype(np.int64)
        values = np.array([[float(row[name]) for name in _POSES[1:]] for row in rows])
    good = (np.abs(values) < _LARGEST).all() and (abs(np.linalg.norm(values[:, 3:], axis=1) - 1) < 1e-3).all()
    if len(rows) < 2 or not good or (np.diff(time_ns) <= 0).any():
        raise FormatError(f"{source}: a trajectory has two or more poses at rising times")
    in_scene = frame is not None and "lon" in rows[0]  # estimates without a place in the world have none
    scale = float(frame.trajectory().scale[0]) if frame and in_scene else 1.0
    return Path3D(time_ns, values[:, :3] / [scale, scale, 1.0], matrix_from_quat(values[:, 3:]))


def sensor_mount(dataset: Dataset, sensor: str) -> Float:
    """The mount (4, 4) of a sensor; the identity for an empty name.

    Raises InputError for an unknown sensor.
    """
    if not sensor:
        return np.eye(4)
    sensors = dataset.sensors()
    if sensor not in sensors:
        raise InputError(f"`sensor` {sensor}: not in {dataset.path}; there are {', '.join(sensors)}")
    return np.asarray(mount_of(sensors[sensor]).matrix, float)
