"""A trajectory as CSV: ``trajectory.csv`` of a dataset, beside the manifest that holds its frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.files import write_columns
from lidar.errors import DatasetError
from lidar.geometry.poses import Trajectory

MANIFEST = "dataset.json"
"""Name of a dataset's manifest; its key ``frame`` is the frame of the trajectory beside it."""

_TRAJECTORY = ("time_ns", "x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "scale")


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as CSV; `read_trajectory` returns exactly the same numbers."""
    t = trajectory
    columns = [t.time_ns, *t.position.T, *t.quat_xyzw.T, *t.velocity.T, t.scale]
    write_columns(path, dict(zip(_TRAJECTORY, columns, strict=True)))


def read_trajectory(path: Path) -> Trajectory:
    """The trajectory that `write_trajectory` wrote.

    Raises DatasetError if the file is missing or damaged.
    """
    try:
        with path.open(encoding="utf-8") as file:
            names = tuple(file.readline().strip().split(","))
            values = np.loadtxt(file, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a readable trajectory ({error})") from error
    if names != _TRAJECTORY:
        raise DatasetError(f"{path}: columns {', '.join(names)}; expected {', '.join(_TRAJECTORY)}")
    return Trajectory(
        values[:, 0].astype(np.int64), values[:, 1:4], values[:, 4:8], values[:, 8:11], values[:, 11]
    )
