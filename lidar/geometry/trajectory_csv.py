"""A trajectory as CSV: ``trajectory.csv`` of a dataset, beside the manifest that holds its frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.files import write_blocks
from lidar.errors import DatasetError
from lidar.geometry.poses import Trajectory, blocks_of

MANIFEST = "dataset.json"
"""Name of a dataset's manifest; its key ``frame`` is the frame of the trajectory beside it."""

_LARGEST = 1e15  # nanoseconds of eleven days
_TRAJECTORY = ("time_ns", "x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "scale")


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as CSV; `read_trajectory` returns exactly the same numbers."""
    write_blocks(path, _rows(trajectory))


def _rows(trajectory: Trajectory) -> Iterator[dict[str, NDArray[Any]]]:
    """Columns of the file, block by block."""
    for rows in blocks_of(len(trajectory)):
        t = trajectory
        columns = [
            t.time_ns[rows],
            *t.position[rows].T,
            *t.quat_xyzw[rows].T,
            *t.velocity[rows].T,
            t.scale[rows],
        ]
        yield dict(zip(_TRAJECTORY, columns, strict=True))
        trajectory.release()


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory that `write_trajectory` wrote.

    Raises DatasetError if the file is missing or damaged.
    """
    try:
        names, *rows = path.read_text("utf-8").splitlines()
        values = np.loadtxt(rows, delimiter=",", ndmin=2) if rows else np.empty((0, 0))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable trajectory ({error})") from error
    if tuple(names.split(",")) != _TRAJECTORY:
        raise DatasetError(f"{path}: columns {names}; expected {','.join(_TRAJECTORY)}")
    if values.shape[1:] != (len(_TRAJECTORY),):
        raise DatasetError(f"{path}: no rows")
    time, quat, scale = values[:, 0], values[:, 4:8], values[:, 11]
    if not (np.abs(values) < _LARGEST).all():
        raise DatasetError(f"{path}: a row holds no pose")
    unit = np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-3
    if not (unit & (scale > 0)).all() or (np.diff(time) <= 0).any():
        raise DatasetError(f"{path}: a row holds no pose, or times do not increase")
    return Trajectory(time.astype(np.int64), values[:, 1:4], quat, values[:, 8:11], scale)
