"""KITTI's calib.txt, times.txt and poses.txt: with them a scanner's folder is a sequence of KITTI's loaders.

Geiger et al. 2012 (odometry) and Behley et al. 2019 (SemanticKITTI).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.files import write_lines
from geoscene.typing import Float
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.mounts import OPTICAL, Mount
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.rig.camera_model import intrinsic_matrix
from lidar.sensors.rig.specs import Rig


def write_sequence(
    folder: Path, rig: Rig, *, mount: Mount, trajectory: Trajectory, time_ns: NDArray[np.int64]
) -> None:
    """Write calib.txt, times.txt and poses.txt of a scanner into its folder.

    mount   : of the scanner
    time_ns : (n,) starts of its frames

    The cameras are the rig's first four; without one, a camera at the scanner that faces its x axis.
    """
    cameras = [(intrinsic_matrix(camera), camera.mount) for camera in rig.cameras[:4]]
    first = cameras[0][1] if cameras else looking_ahead(mount)
    projections = [projection(K, own, reference=first) for K, own in cameras] or [np.eye(3, 4)]
    camera_from_lidar = np.linalg.inv(first.matrix) @ mount.matrix
    write_calibration(folder / "calib.txt", projections, camera_from_lidar=camera_from_lidar)
    if len(time_ns):
        write_times(folder / "times.txt", time_ns)
        write_poses(folder / "poses.txt", trajectory.at(time_ns).mounted(first.translation, first.rotation))


def looking_ahead(mount: Mount) -> Mount:
    """Extrinsics of a camera at a sensor's origin whose optical axis is the sensor's x axis."""
    return Mount(mount.translation, tuple(quat_from_matrix(mount.rotation @ OPTICAL).tolist()))


def projection(K: Float, mount: Mount, *, reference: Mount) -> Float:
    """Projection (3, 4) from the frame of a reference camera to the pixels of a camera with intrinsics K."""
    return np.asarray(K @ (np.linalg.inv(mount.matrix) @ reference.matrix)[:3], float)


def write_calibration(path: Path, projections: Sequence[ArrayLike], *, camera_from_lidar: Float) -> None:
    """Write ``calib.txt``: projections P0 to P3, and Tr, the transformation from scanner to first camera.

    projections : (3, 4) each, from the first camera's frame to the pixels of each camera. Loaders need four:
                  the first is repeated for missing ones, a fifth is left out
    """
    four = [*projections[:4], *[projections[0]] * (4 - len(projections))]
    named = [*((f"P{k}", projection) for k, projection in enumerate(four)), ("Tr", camera_from_lidar)]
    write_lines(path, (f"{name}: {numbers(np.asarray(matrix)[:3])}" for name, matrix in named))


def write_times(path: Path, time_ns: NDArray[np.integer]) -> None:
    """Write ``times.txt``: seconds since the first frame."""
    write_lines(path, (f"{(int(t) - int(time_ns[0])) * 1e-9:.9e}" for t in time_ns))


def write_poses(path: Path, camera: Poses) -> None:
    """Write ``poses.txt``: the poses of the first camera at each frame relative to the first frame."""
    world_from_camera = camera.matrices()
    poses = np.linalg.inv(world_from_camera[0]) @ world_from_camera
    write_lines(path, (numbers(pose[:3]) for pose in poses))


def numbers(values: ArrayLike) -> str:
    """Numbers of any shape as KITTI writes them, separated by spaces."""
    return " ".join(f"{value:.12e}" for value in np.asarray(values, float).ravel())
