"""The trajectory that places a map's points: the true one, or as measured, refined by registration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geoscene.support.progress import Progress
from geoscene.typing import Ints
from lidar.dataset.formats import format_of
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import Stream, labelled_clouds
from lidar.errors import DatasetError, InputError
from lidar.geometry.poses import Trajectory
from lidar.geometry.time_scales import posix_ns
from lidar.geometry.trajectory_tum import write_tum
from lidar.tools.maps.aligned_motion import aligned_motion
from lidar.tools.maps.measured_poses import (
    fixes_along,
    fixes_of,
    measured_motion,
    motion_along,
    poses_by_fixes,
    trajectory_in,
    trajectory_of,
)
from lidar.tools.maps.pose_graph import fit_poses

_STEP_NS = 100_000_000  # between poses by an inertial unit, and those that are compared with the truth


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Root mean squares of the errors of measured poses.

    horizontal_m, vertical_m : true metres
    yaw_deg                  : degrees
    """

    horizontal_m: float
    vertical_m: float
    yaw_deg: float


def measured_trajectory(
    dataset: Dataset, poses: str, *, refine: bool, progress: Progress
) -> Trajectory | None:
    """The vehicle's trajectory as measured; None for the true one.

    poses  : truth, RECEIVER, RECEIVER+UNIT (a receiver and an inertial unit) or FILE.tum
    refine : by aligning the clouds of the scanner with the most points

    Raises InputError for names that the dataset lacks and files that are no trajectories, DatasetError for
    data that cannot be used, and MissingExtraError where `refine` needs a package that is not installed.
    """
    if poses == "truth":
        return None
    clouds = _best_clouds(dataset) if refine else None
    if poses.lower().endswith(".tum"):
        given = trajectory_in(dataset, Path(poses))
        if clouds is None:
            return given
        fixes, motion = fixes_along(given), motion_along(given, _times(clouds))
    else:
        receiver, unit = _names(dataset, poses)
        fixes = fixes_of(dataset, receiver)
        if clouds is None and not unit:
            placed = poses_by_fixes(fixes, fixes.time_ns)
            return trajectory_of(placed, fixes.time_ns, frame=dataset.frame, scale=fixes.scale)
        time_ns = _times(clouds) if clouds else _even_times(dataset.sample_times(unit))
        motion = measured_motion(dataset, fixes, unit=unit, time_ns=time_ns)
    if clouds:
        motion = aligned_motion(clouds, motion, progress=progress)
    return trajectory_of(fit_poses(motion, fixes), motion.time_ns, frame=dataset.frame, scale=fixes.scale)


def pose_errors(found: Trajectory, true: Trajectory) -> PoseErrors:
    """Errors of a trajectory, every 0.1 s of the time that it shares with the true one."""
    first, last = max(found.time_ns[0], true.time_ns[0]), min(found.time_ns[-1], true.time_ns[-1])
    time_ns = _even_times(np.array([first, last]))
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


def _names(dataset: Dataset, poses: str) -> tuple[str, str]:
    """The receiver and the inertial unit, or an empty name, of RECEIVER or RECEIVER+UNIT."""
    receiver, _, unit = poses.partition("+")
    receivers, units = dataset.sensors("gnss"), dataset.sensors("imu")
    if receiver not in receivers or (unit and unit not in units) or poses.endswith("+"):
        known = [*receivers, *(f"{one}+{other}" for one in receivers for other in units), "FILE.tum"]
        raise InputError(f"`poses` {poses}: unknown; of {dataset.path} there are truth, {', '.join(known)}")
    return receiver, unit


def _best_clouds(dataset: Dataset) -> Stream:
    """The clouds with times of the scanner whose first frame has the most points."""
    streams = [labelled_clouds(dataset, name) for name in dataset.sensors("lidar")]
    found = [one for one in streams if one is not None and len(one.frames) > 1]
    if not found:
        raise DatasetError(
            f"{dataset.path}: no clouds in the sensor frame with times in it, which `refine` aligns;"
            " drive with `formats` pcd"
        )
    return max(found, key=lambda one: format_of(one.files[0]).count(one.files[0]))


def _times(clouds: Stream) -> Ints:
    """Starts of the frames and the end of the last one, nanoseconds since the drive's start."""
    return np.append(clouds.time_ns, clouds.time_ns[-1] + round(1e9 / float(clouds.sensor["rate_hz"])))


def _even_times(time_ns: Ints) -> Ints:
    """Times every `_STEP_NS` from the first of some to the last, and the last."""
    return np.unique(np.append(np.arange(time_ns[0], time_ns[-1], _STEP_NS), time_ns[-1]))
