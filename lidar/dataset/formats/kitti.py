"""KITTI's and SemanticKITTI's files: a scanner's folder is a sequence that their loaders read.

velodyne/000000.bin, labels/000000.label, calib.txt, times.txt, poses.txt: Geiger et al. 2012 (odometry) and
Behley et al. 2019. Rows are in the same order in both files of a frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import class_codes
from geoscene.files import write_atomically
from geoscene.typing import Float
from lidar.dataset.formats.table import Table
from lidar.errors import FormatError

# What moves has a number of its own: car, bicyclist, person, motorcyclist, bus, truck, other vehicle. A
# bicycle or motorcycle that moves has a rider.
_MOVING = {10: 252, 11: 253, 31: 253, 30: 254, 15: 255, 13: 257, 18: 258, 20: 259}


def write_velodyne(path: Path, table: Table) -> None:
    """Write x, y, z (metres, sensor frame) and reflectance (0 to 1) as little-endian float32."""
    columns = [table["x"], table["y"], table["z"], table["intensity"] / np.float32(255)]
    write_atomically(path, np.stack(columns, axis=1).astype("<f4").tobytes())


def read_velodyne(path: Path) -> NDArray[np.float32]:
    """The rows (n, 4) that `write_velodyne` wrote.

    Raises FormatError for a file whose length is no multiple of 16 bytes.
    """
    data = path.read_bytes()
    if len(data) % 16:
        raise FormatError(f"{path}: {len(data)} bytes are no rows of four float32")
    return np.frombuffer(data, "<f4").reshape(-1, 4).astype(np.float32)


def semantic_kitti_labels(
    klass: NDArray[np.integer], thing: NDArray[np.integer], *, moving: NDArray[np.bool_]
) -> NDArray[np.uint32]:
    """SemanticKITTI's labels (n,): its class in the lower 16 bits, the instance in the upper.

    klass  : (n,) `geoscene.classes.Class`
    thing  : (n,) number of the road user, from 1 on; 0 for all else, which has no instances there
    moving : (n,) whether that road user moves at some time of the drive
    """
    still = class_codes().semantic_kitti.astype(np.uint32)
    moves = still.copy()
    for code, other in _MOVING.items():
        moves[still == code] = other
    code = np.where(moving, moves[klass], still[klass])
    number = np.where(thing < 1 << 16, thing, 0).astype(np.uint32)
    labels: NDArray[np.uint32] = (code | number << 16).astype(np.uint32)
    return labels


def write_labels(path: Path, labels: NDArray[np.uint32]) -> None:
    """Write labels as little-endian uint32."""
    write_atomically(path, labels.astype("<u4").tobytes())


def write_calibration(path: Path, projections: Sequence[ArrayLike], *, camera_from_lidar: Float) -> None:
    """Write ``calib.txt``: P0 to P3, and the way from scanner to the first camera as Tr.

    projections : (3, 4) each, from the first camera's frame to the pixels of each camera. Loaders want four:
                  the first stands for those that are not there, and a fifth is left out
    """
    four = [*projections[:4], *[projections[0]] * (4 - len(projections))]
    named = [*((f"P{k}", projection) for k, projection in enumerate(four)), ("Tr", camera_from_lidar)]
    lines = [
        f"{name}: " + " ".join(f"{v:.12e}" for v in np.asarray(matrix, float)[:3].ravel())
        for name, matrix in named
    ]
    write_atomically(path, ("\n".join(lines) + "\n").encode("ascii"))


def write_times(path: Path, time_ns: NDArray[np.integer]) -> None:
    """Write ``times.txt``: seconds since the first frame."""
    lines = [f"{(int(t) - int(time_ns[0])) * 1e-9:.9e}\n" for t in time_ns]
    write_atomically(path, "".join(lines).encode("ascii"))


def write_poses(path: Path, world_from_lidar: Float, *, camera_from_lidar: Float) -> None:
    """Write ``poses.txt``: the camera of each frame in that of the first; its first row is the identity.

    world_from_lidar : (n, 4, 4)
    """
    world_from_camera = world_from_lidar @ np.linalg.inv(camera_from_lidar)
    poses = np.linalg.inv(world_from_camera[0]) @ world_from_camera
    lines = [" ".join(f"{v:.12e}" for v in pose[:3].ravel()) + "\n" for pose in poses]
    write_atomically(path, "".join(lines).encode("ascii"))
