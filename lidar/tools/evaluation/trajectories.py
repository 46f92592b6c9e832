"""Trajectories as they are compared: their files, poses at the same times, and alignment onto the truth."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.errors import reading
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.dataset.layout import Dataset, open_dataset
from lidar.dataset.recorded import mount_of, nearest
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
GAPS_S = {"interpolated": 1.0, "nearest": 0.01}
"""Seconds between poses of the truth that are interpolated, and between matched poses, at most."""


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
        with source.open(encoding="utf-8-sig") as lines:
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
        return np.loadtxt(source, ndmin=2, encoding="utf-8-sig")


def _read_csv(source: Path, *, truth: Dataset | None) -> Path3D:
    """Poses of ``poses.csv``, or the dataset of ``trajectory.csv``."""
    beside = (source.parent / MANIFEST).is_file()
    if source.name == "trajectory.csv" and beside:
        return true_path(open_dataset(source.parent))
    frame = open_dataset(source.parent) if beside else truth
    with (
        reading(source, FormatError, remedy="give the columns of poses.csv", known=FormatError),
        source.open(newline="", encoding="utf-8-sig") as file,
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


@dataclass(frozen=True, slots=True)
class PosePairs:
    """Poses of an estimate and of the truth at the same times, row by row.

    left_out : poses of the estimate without a counterpart
    """

    estimate: Path3D
    truth: Path3D
    left_out: int

    def __len__(self) -> int:
        return len(self.truth)


@dataclass(frozen=True, slots=True)
class TrajectoryAlignment:
    """Similarity transform from estimate to ground truth: ``scale * rotation @ point + shift``.

    rotation : (3, 3)
    shift    : (3,) metres
    """

    kind: str
    rotation: Float
    shift: Float
    scale: float = 1.0

    def of(self, path: Path3D) -> Path3D:
        """A path moved by it."""
        return path.moved(self.rotation, self.shift, scale=self.scale)


def match_poses(estimate: Path3D, truth: Path3D, *, how: str, gap_s: float | None = None) -> PosePairs:
    """Pair the poses of two paths by time; those of files without times by their number.

    how   : ``interpolated`` takes the truth between its poses at each time of the estimate; ``nearest`` takes
            for each pose of the path with fewer poses the other's nearest in time
    gap_s : see `GAPS_S`

    Raises InputError for paths without common times or of different kinds of time.
    """
    if not estimate.timed and not truth.timed:
        if len(estimate) != len(truth):
            raise InputError(
                f"the estimate has {len(estimate)} poses, the truth {len(truth)}, and neither has times: give"
                " files of equal length, or times"
            )
        return PosePairs(estimate, truth, 0)
    if estimate.timed != truth.timed:
        raise InputError("one trajectory has times and the other none: give both as TUM, or a dataset")
    gap_ns = round(1e9 * (GAPS_S[how] if gap_s is None else gap_s))
    pairs = (_interpolate if how == "interpolated" else _nearest)(estimate, truth, gap_ns=gap_ns)
    if len(pairs) < 2:
        spans = (f"{p.time_ns[0] / 1e9:.3f} to {p.time_ns[-1] / 1e9:.3f}" for p in (estimate, truth))
        raise InputError(
            f"{len(pairs)} poses at common times with a `max_gap` of {gap_ns / 1e9:g} s: those of the"
            f" estimate are {', of the truth '.join(spans)} (seconds since 1970)"
        )
    return pairs


def _interpolate(estimate: Path3D, truth: Path3D, *, gap_ns: int) -> PosePairs:
    knots, at = truth.time_ns, estimate.time_ns
    after = np.clip(np.searchsorted(knots, at), 1, len(knots) - 1)
    inside = (at >= knots[0]) & (at <= knots[-1]) & (knots[after] - knots[after - 1] <= gap_ns)
    kept = estimate.where(inside)
    return PosePairs(kept, truth.at(kept.time_ns), int((~inside).sum()))


def _nearest(estimate: Path3D, truth: Path3D, *, gap_ns: int) -> PosePairs:
    fewer, more = (estimate, truth) if len(estimate) <= len(truth) else (truth, estimate)
    row: Ints = nearest(more.time_ns, fewer.time_ns)
    close = np.abs(more.time_ns[row] - fewer.time_ns) <= gap_ns
    first, second = fewer.where(close), more.take(row[close])
    if fewer is estimate:
        return PosePairs(first, second, int((~close).sum()))
    return PosePairs(second, first, len(estimate) - len(second))


def alignment(pairs: PosePairs, kind: str) -> TrajectoryAlignment:
    """The motion that brings an estimate onto the truth.

    none         : as it is
    origin       : first pose onto first pose
    se3, sim3    : least squares of the positions, with scale for sim3 (Umeyama, IEEE PAMI 13, 1991)
    yaw-position : the same with a turn about z alone, for estimates whose roll and pitch are those of gravity

    Raises InputError for positions on a line or in a point, onto which there are several turns.
    """
    estimate, truth = pairs.estimate, pairs.truth
    if kind == "none":
        return TrajectoryAlignment(kind, np.eye(3), np.zeros(3))
    if kind == "origin":
        turn = truth.rotation[0] @ estimate.rotation[0].T
        return TrajectoryAlignment(kind, turn, truth.position[0] - turn @ estimate.position[0])
    here, there = estimate.position.mean(axis=0), truth.position.mean(axis=0)
    x, y = estimate.position - here, truth.position - there
    if kind == "yaw-position":
        yaw = np.arctan2((x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum(), (x[:, :2] * y[:, :2]).sum())
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return TrajectoryAlignment(kind, turn, there - turn @ here)
    u, d, v = np.linalg.svd(y.T @ x / len(x))
    if d[1] <= 1e-9 * max(d[0], 1e-12):
        raise InputError(
            f"`align` {kind}: the positions are on a line, onto which there are many turns; give origin or"
            " yaw-position"
        )
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(v))])
    turn = u @ flip @ v
    scale = float(np.trace(np.diag(d) @ flip) / (x**2).sum(axis=1).mean()) if kind == "sim3" else 1.0
    return TrajectoryAlignment(kind, turn, there - scale * turn @ here, scale)
