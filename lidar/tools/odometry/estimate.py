"""Result of an odometry method, and its files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geoscene.geometry.frames import Frame
from geoscene.support.columns import write_columns
from geoscene.support.files import write_json
from geoscene.typing import Float, Ints
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.kitti_drive import write_poses
from lidar.geometry.attitude import euler_from_quat, quat_from_matrix
from lidar.geometry.poses import Poses, Trajectory
from lidar.geometry.time_scales import iso_times, posix_ns
from lidar.geometry.trajectory_files import write_tum
from lidar.simulation.metadata import pose_columns

TRAJECTORY, REPORT = "trajectory.tum", "odometry.json"
"""Names of the trajectory, and of the report, which is written last."""

OWN_FILES = frozenset({TRAJECTORY, "trajectory.kitti", "poses.csv", REPORT})
"""Names of all files of an estimate."""


@dataclass(frozen=True)
class MotionEstimate:
    """Estimated poses of a vehicle, with covariances and a report.

    time_ns : (n,) int64, rising, since the drive's start
    poses   : (n, 4, 4) of the vehicle, true metres: in the scene if ``in_scene``, else in the frame that the
              vehicle has at the first
    sigma   : (n, 6) one standard deviation of the rotation (radians about) and position (metres along) the
              axes of the frame that poses are in; None if the method states none
    step_sigma : (n - 1, 6) of the motion from each pose to the next, along the axes of the later one
    quality : (n,) columns by name, such as the number of matches
    report  : what was done
    in_scene : whether poses are georeferenced: scene coordinates over ``scale`` horizontally
    scale   : scene metres per true metre
    """

    time_ns: Ints
    poses: Float
    sigma: Float | None = None
    step_sigma: Float | None = None
    quality: Mapping[str, Ints | Float] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    in_scene: bool = False
    scale: float = 1.0

    def steps(self) -> Float:
        """Motion (n - 1, 4, 4) from each pose to the next, in the vehicle's frame."""
        return np.linalg.inv(self.poses[:-1]) @ self.poses[1:]

    def length(self) -> float:
        """Metres from pose to pose."""
        return float(np.linalg.norm(np.diff(self.poses[:, :3, 3], axis=0), axis=1).sum())


def propagate(poses: Float, step_covariance: Float) -> Float:
    """Standard deviations (n, 6) of poses whose steps have errors that do not depend on each other.

    poses           : (n, 4, 4)
    step_covariance : (n - 1, 6, 6) of small rotations and translations along the axes of the later pose

    The errors of rotations move the later positions (first order; Barfoot and Furgale 2014).
    """
    covariance = np.zeros((6, 6))
    found = [covariance]
    for step, added in zip(np.linalg.inv(poses[:-1]) @ poses[1:], step_covariance, strict=True):
        back = _adjoint(np.linalg.inv(step))
        covariance = back @ covariance @ back.T + added
        found.append(covariance)
    return along_axes(poses, np.array(found))


def along_axes(poses: Float, covariance: Float) -> Float:
    """Standard deviations (n, 6) along the axes that poses (n, 4, 4) are in.

    covariance : (n, 6, 6) of small rotations and translations along the axes of the poses
    """
    out = np.empty((len(poses), 6))
    for half in (0, 3):
        block = covariance[:, half : half + 3, half : half + 3]
        turned = poses[:, :3, :3] @ block @ np.swapaxes(poses[:, :3, :3], 1, 2)
        out[:, half : half + 3] = np.sqrt(np.maximum(np.einsum("nii->ni", turned), 0.0))
    return out


def _adjoint(pose: Float) -> Float:
    """The matrix (6, 6) that takes small rotations and translations to the axes of another frame."""
    turn, (x, y, z) = pose[:3, :3], pose[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = turn
    out[3:, :3] = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ turn
    return out


def begun_at(estimate: MotionEstimate, place: tuple[float, ...], *, frame: Frame) -> MotionEstimate:
    """An estimate whose first pose is a given one.

    place : x, y, z in scene metres, and roll, pitch and yaw in radians as alpha, beta and gamma of poses.csv
    """
    scale = float(frame.scale_at(*place[:2]))
    first = np.eye(4)
    first[:3, :3] = Rotation.from_euler("xyz", place[3:]).as_matrix()
    first[:3, 3] = np.array(place[:3]) / [scale, scale, 1.0]
    moved = first @ np.linalg.inv(estimate.poses[0]) @ estimate.poses
    sigma = estimate.sigma
    if sigma is not None:
        covariance = np.zeros((len(sigma), 6, 6))
        covariance[:, range(6), range(6)] = sigma**2
        turned = np.tile(np.eye(4), (len(sigma), 1, 1))
        turned[:, :3, :3] = first[:3, :3] @ estimate.poses[0, :3, :3].T
        sigma = along_axes(turned, covariance)
    return replace(estimate, poses=moved, sigma=sigma, in_scene=True, scale=scale)


def write_estimate(folder: Path, estimate: MotionEstimate, *, dataset: Dataset) -> None:
    """Write an estimate into a folder: TUM, KITTI, poses.csv, and the report as JSON."""
    poses, quat = estimate.poses, quat_from_matrix(estimate.poses[:, :3, :3])
    position = np.ascontiguousarray(poses[:, :3, 3])
    absolute_ns = posix_ns(dataset.start) + estimate.time_ns
    write_tum(folder / TRAJECTORY, absolute_ns, position=position, quat_xyzw=quat)
    rotation = np.ascontiguousarray(poses[:, :3, :3])
    write_poses(folder / "trajectory.kitti", Poses(position, rotation, np.ones_like(position)))
    write_columns(folder / "poses.csv", _columns(estimate, dataset=dataset))
    write_json(folder / REPORT, estimate.report)


def _columns(estimate: MotionEstimate, *, dataset: Dataset) -> dict[str, Any]:
    """Columns of ``poses.csv``, with standard deviations and what the method counted."""
    position, quat = estimate.poses[:, :3, 3], quat_from_matrix(estimate.poses[:, :3, :3])
    if estimate.in_scene:
        scale = estimate.scale
        trajectory = Trajectory(
            estimate.time_ns,
            position * [scale, scale, 1.0],
            quat,
            np.zeros_like(position),
            np.full(len(quat), scale),
        )
        columns = pose_columns(trajectory, dataset.frame, start=dataset.start, time_ns=estimate.time_ns)
    else:
        columns = {
            "timestamp": iso_times(dataset.start, estimate.time_ns),
            "frame": np.arange(len(position)),
            **dict(zip("xyz", position.T, strict=True)),
            **dict(zip(("alpha", "beta", "gamma"), euler_from_quat(quat).T, strict=True)),
            **dict(zip(("qx", "qy", "qz", "qw"), quat.T, strict=True)),
        }
    columns |= {"time_ns": estimate.time_ns}
    if estimate.sigma is not None:
        names = [f"sigma_{name}" for name in ("alpha", "beta", "gamma", "x", "y", "z")]
        columns |= dict(zip(names, estimate.sigma.T, strict=True))
    return columns | dict(estimate.quality)
