"""The trajectory that places a map's points: the true one, or one from a TUM file, and its errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.typing import Ints
from lidar.dataset.layout import Dataset
from lidar.errors import InputError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_files import read_tum, write_tum

_STEP_NS = 100_000_000  # between poses that are compared with the truth
_FARTHEST = 1e6  # metres from the scene's origin


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
