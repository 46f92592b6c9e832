"""KITTI's calib.txt, times.txt and poses.txt: with them a scanner's folder is a sequence of KITTI's loaders.

Geiger et al. 2012 (odometry) and Behley et al. 2019 (SemanticKITTI).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.files import write_atomically
from geoscene.typing import Float
from lidar.geometry.mounts import OPTICAL, Mount
from lidar.geometry.poses import Trajectory
from lidar.rig.camera_model import intrinsic_matrix
from lidar.rig.specs import Rig


def write_sequence(
    folder: Path, rig: Rig, *, mount: Mount, trajectory: Trajectory, time_ns: NDArray[np.int64]
) -> None:
    """Write calib.txt, times.txt and poses.txt of a scanner into its folder.

    mount   : of the scanner
    time_ns : (n,) starts of its frames

    The cameras are the rig's first four; without one, a camera at the scanner that looks along its x axis.
    """
    vehicle_from_lidar = mount.matrix
    if rig.cameras:
        first = rig.cameras[0].mount.matrix
        projections = [
            intrinsic_matrix(camera) @ (np.linalg.inv(camera.mount.matrix) @ first)[:3]
            for camera in rig.cameras
        ]
        camera_from_lidar = np.linalg.inv(first) @ vehicle_from_lidar
    else:
        projections = [np.eye(3, 4)]
        camera_from_lidar = np.eye(4)
        camera_from_lidar[:3, :3] = OPTICAL.T
    _write_calibration(folder / "calib.txt", projections, camera_from_lidar=camera_from_lidar)
    if not len(time_ns):
        return
    _write_times(folder / "times.txt", time_ns)
    at = trajectory.at(time_ns).mounted(mount.translation, mount.rotation)
    world_from_lidar = np.tile(np.eye(4), (len(time_ns), 1, 1))
    world_from_lidar[:, :3, :3] = at.rotation
    world_from_lidar[:, :3, 3] = at.position / at.scale[0]  # true metres
    _write_poses(folder / "poses.txt", world_from_lidar, camera_from_lidar=camera_from_lidar)


def _write_calibration(path: Path, projections: Sequence[ArrayLike], *, camera_from_lidar: Float) -> None:
    """Write ``calib.txt``: projections P0 to P3, and Tr, the transformation from scanner to first camera.

    projections : (3, 4) each, from the first camera's frame to the pixels of each camera. Loaders need four:
                  the first is repeated for missing ones, a fifth is left out
    """
    four = [*projections[:4], *[projections[0]] * (4 - len(projections))]
    named = [*((f"P{k}", projection) for k, projection in enumerate(four)), ("Tr", camera_from_lidar)]
    lines = [
        f"{name}: " + " ".join(f"{v:.12e}" for v in np.asarray(matrix, float)[:3].ravel())
        for name, matrix in named
    ]
    write_atomically(path, ("\n".join(lines) + "\n").encode("ascii"))


def _write_times(path: Path, time_ns: NDArray[np.integer]) -> None:
    """Write ``times.txt``: seconds since the first frame."""
    lines = [f"{(int(t) - int(time_ns[0])) * 1e-9:.9e}\n" for t in time_ns]
    write_atomically(path, "".join(lines).encode("ascii"))


def _write_poses(path: Path, world_from_lidar: Float, *, camera_from_lidar: Float) -> None:
    """Write ``poses.txt``: the first camera's pose at each frame relative to the first frame.

    world_from_lidar : (n, 4, 4)
    """
    world_from_camera = world_from_lidar @ np.linalg.inv(camera_from_lidar)
    poses = np.linalg.inv(world_from_camera[0]) @ world_from_camera
    lines = [" ".join(f"{v:.12e}" for v in pose[:3].ravel()) + "\n" for pose in poses]
    write_atomically(path, "".join(lines).encode("ascii"))
