"""Poses of a vehicle as measured: by the fixes of a receiver, an inertial unit, or a file of poses."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from geoscene.geometry.frames import Frame
from geoscene.typing import Float, Ints
from lidar.dataset.layout import Dataset
from lidar.dataset.navigation_files import read_fixes, read_samples
from lidar.errors import InputError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_tum import read_tum
from lidar.sensors.navigation.gnss import NAMES, STATES

_MOVING = 1.0  # m/s, from which the course tells the heading
_SPEEDS = (0.05, 1.0)  # m/s: standard deviation of a speed, with fixes and between them
_ACROSS = (0.05, 0.3)  # m/s, to the side and up: wheels do not slip, but the body pitches on its suspension
_RATES = (0.002, 0.3)  # rad/s: of an angular rate, of an inertial unit and without one
_GAP_NS = 1_500_000_000  # between fixes, from which speeds between them are uncertain
_WINDOW_NS = 1_000_000_000  # in which courses tell the turn: those of single fixes are noisy
_LEAST_SIGMA = 0.01  # metres, of a position
_FILE_SIGMA = 1.0  # metres, of positions in a file, which states none
_FARTHEST = 1e6  # metres, of positions in a file


@dataclass(frozen=True, slots=True)
class MeasuredPositions:
    """Positions and courses of a vehicle, in true metres: scene coordinates over ``scale`` horizontally.

    time_ns  : (n,) int64, since the drive's start
    position : (n, 3) of the antenna, or of the vehicle
    sigma    : (n, 3) metres, one standard deviation, as typical of the state and the dilution of precision
    yaw      : (n,) heading by the course, radians from the x axis, unwrapped; of slow vehicles the last one
    speed    : (n,) m/s
    lever    : (3,) antenna in the vehicle's frame, metres
    scale    : scene metres per true metre where the vehicle begins
    """

    time_ns: Ints
    position: Float
    sigma: Float
    yaw: Float
    speed: Float
    lever: Float
    scale: float


@dataclass(frozen=True, slots=True)
class RelativeMotion:
    """Motion of a vehicle from each time to the next.

    time_ns : (n + 1,) int64, rising, since the drive's start
    step    : (n, 4, 4) pose at the next time in the vehicle's frame, true metres
    sigma   : (n, 6) one standard deviation of the step's rotation vector and translation, rad and metres
    """

    time_ns: Ints
    step: Float
    sigma: Float

    def poses(self) -> Float:
        """Poses (n + 1, 4, 4) relative to the first."""
        poses = [np.eye(4)]
        for step in self.step:
            poses.append(poses[-1] @ step)
        return np.array(poses)


def fixes_of(dataset: Dataset, receiver: str) -> MeasuredPositions:
    """The fixes of a receiver of a dataset.

    Raises InputError without two fixes while the vehicle moves, and DatasetError for files that are damaged.
    """
    fixes, _ = read_fixes(dataset.paths, receiver, vertical=dataset.frame.vertical)
    on = np.isfinite(fixes.lonlath).all(axis=1) & np.isfinite(fixes.speed)
    time_ns, speed = fixes.time_ns[on], fixes.speed[on]
    moving = speed > _MOVING
    if np.count_nonzero(moving) < 2:
        raise InputError(f"`poses` {receiver}: has no two fixes while the vehicle moves")
    lon, lat, height = fixes.lonlath[on].T
    scale = float(dataset.frame.scale(lon[0], lat[0]))
    course = math.pi / 2 - (fixes.course[on] - dataset.frame.convergence(lon, lat))
    typical = np.array(
        [[math.hypot(STATES[name].white[k], STATES[name].bias[k]) for k in (0, 0, 1)] for name in NAMES]
    )
    sigma = np.fmax(typical[fixes.state[on]], _LEAST_SIGMA) * np.fmax(fixes.dop[on][:, [0, 0, 1]], 1.0)
    x, y = dataset.frame.from_geographic(lon, lat)
    return MeasuredPositions(
        time_ns,
        np.column_stack([x / scale, y / scale, height]),
        sigma,
        np.interp(time_ns, time_ns[moving], np.unwrap(course[moving])),
        speed,
        np.array(dataset.sensors("gnss")[receiver]["vehicle_from_sensor"], float)[:3, 3],
        scale,
    )


def trajectory_in(dataset: Dataset, path: Path) -> Trajectory:
    """The vehicle's trajectory in a TUM file, whose positions are true metres from the scene's origin.

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
    poses = np.tile(np.eye(4), (len(time_ns), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(quat).as_matrix(), position
    return trajectory_of(poses, time_ns, frame=dataset.frame, scale=scale)


def fixes_along(trajectory: Trajectory) -> MeasuredPositions:
    """The poses of a trajectory as if they were fixes."""
    scale = float(trajectory.scale[0])
    turn = Rotation.from_quat(trajectory.quat_xyzw)
    ahead = turn.apply([1.0, 0.0, 0.0])
    return MeasuredPositions(
        trajectory.time_ns,
        trajectory.position / [scale, scale, 1.0],
        np.full((len(ahead), 3), _FILE_SIGMA),
        np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])),
        np.linalg.norm(trajectory.velocity, axis=1),
        np.zeros(3),
        scale,
    )


def motion_along(trajectory: Trajectory, time_ns: Ints) -> RelativeMotion:
    """Motion of a vehicle by its trajectory."""
    poses = trajectory.at(time_ns)
    turn = Rotation.from_matrix(poses.rotation)
    step = np.tile(np.eye(4), (len(time_ns) - 1, 1, 1))
    step[:, :3, :3] = (turn[:-1].inv() * turn[1:]).as_matrix()
    step[:, :3, 3] = turn[:-1].inv().apply(np.diff(poses.position, axis=0) / poses.scale[:1])
    along = np.full(len(step), _SPEEDS[0])
    return RelativeMotion(time_ns, step, _sigma(np.diff(time_ns) * 1e-9, along=along, gyro=True))


def measured_motion(
    dataset: Dataset, fixes: MeasuredPositions, *, unit: str, time_ns: Ints
) -> RelativeMotion:
    """Motion of the vehicle by the speeds of a receiver, and the turns of an inertial unit or of courses.

    unit : name of an inertial unit; empty without one
    """
    seconds = np.diff(time_ns) * 1e-9
    if unit:
        at, angle = _turn(dataset, unit)
        turn = np.diff(np.column_stack([np.interp(time_ns, at, axis) for axis in angle.T]), axis=0)
    else:
        middle, turn = (time_ns[1:] + time_ns[:-1]) / 2, np.zeros((len(seconds), 3))
        before, after = (
            np.interp(middle + side * _WINDOW_NS / 2, fixes.time_ns, fixes.yaw) for side in (-1, 1)
        )
        turn[:, 2] = (after - before) * seconds / (_WINDOW_NS * 1e-9)
    # The antenna's speed is not the rear axle's in a bend.
    rate = turn[:, 2] / seconds
    speed = np.interp((time_ns[1:] + time_ns[:-1]) / 2, fixes.time_ns, fixes.speed)
    speed = np.sqrt(np.maximum(speed**2 - (rate * fixes.lever[0]) ** 2, 0.0)) + rate * fixes.lever[1]
    step = np.tile(np.eye(4), (len(seconds), 1, 1))
    step[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix()
    half = Rotation.from_rotvec(turn / 2).as_matrix()  # a chord has half of the turn of its arc
    step[:, :3, 3] = half[:, :, 0] * (speed * seconds)[:, None]
    row = np.clip(np.searchsorted(fixes.time_ns, time_ns[:-1]), 1, len(fixes.time_ns) - 1)
    known = (fixes.time_ns[row] - fixes.time_ns[row - 1]) < _GAP_NS
    return RelativeMotion(time_ns, step, _sigma(seconds, along=np.where(known, *_SPEEDS), gyro=bool(unit)))


def _turn(dataset: Dataset, unit: str) -> tuple[Ints, Float]:
    """Times (n,) of the samples of an inertial unit, and the angles (n, 3) that it turned about its axes."""
    blocks = list(read_samples(dataset.paths.measurements(unit)))
    at = np.concatenate([block.time_ns for block in blocks])
    mount = np.array(dataset.sensors("imu")[unit]["vehicle_from_sensor"], float)[:3, :3]
    gyro = np.concatenate([block.gyro for block in blocks]) @ mount.T
    angle = np.zeros_like(gyro)
    angle[1:] = np.cumsum((gyro[1:] + gyro[:-1]) / 2 * (np.diff(at) * 1e-9)[:, None], axis=0)
    return at, angle


def _sigma(seconds: Float, *, along: Float, gyro: bool) -> Float:
    """Standard deviations (n, 6) of steps that last some seconds.

    along : (n,) m/s, of the speed
    gyro  : whether the turns are those of an inertial unit
    """
    rates = np.full((len(seconds), 3), _RATES[not gyro])
    return np.column_stack([rates, along, np.tile(_ACROSS, (len(seconds), 1))]) * seconds[:, None]


def poses_by_fixes(fixes: MeasuredPositions, time_ns: NDArray[np.int64]) -> Float:
    """Poses (n, 4, 4) at times by the fixes alone: level, heading along the course, linear in between."""
    poses = np.tile(np.eye(4), (len(time_ns), 1, 1))
    yaw = np.interp(time_ns, fixes.time_ns, fixes.yaw)
    poses[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    for k in range(3):
        poses[:, k, 3] = np.interp(time_ns, fixes.time_ns, fixes.position[:, k])
    poses[:, :3, 3] -= poses[:, :3, :3] @ fixes.lever
    return poses


def trajectory_of(poses: Float, time_ns: Ints, *, frame: Frame, scale: float) -> Trajectory:
    """The trajectory in the scene of poses (n, 4, 4) in true metres, at rising times (n,).

    scale : see `MeasuredPositions`
    """
    place = poses[:, :3, 3]
    position = np.ascontiguousarray(place * [scale, scale, 1.0])
    velocity = np.gradient(place, time_ns * 1e-9, axis=0)
    quat = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return Trajectory(time_ns, position, quat, velocity, np.asarray(frame.scale_at(*position[:, :2].T)))
