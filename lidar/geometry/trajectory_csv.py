"""Trajectories as CSV: ``trajectory.csv`` of a dataset, whose manifest holds the frame."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

import numpy as np

from geoscene.support.csv_tables import write_columns
from lidar.errors import DatasetError, InputError
from lidar.geometry.poses import Trajectory

MANIFEST = "dataset.json"
"""Name of a dataset's manifest; its key ``frame`` is the frame of the trajectory beside it."""

_LARGEST = 1e15  # nanoseconds of eleven days
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
        with path.open(encoding="utf-8") as lines:
            return _parse(path, lines)
    except DatasetError:
        raise
    except (OSError, ValueError, InputError) as error:
        raise DatasetError(f"{path}: not a readable trajectory ({error})") from error


def _parse(path: Path, lines: TextIO) -> Trajectory:
    """The trajectory in a file; raises DatasetError for other columns and rows that hold no pose."""
    names = next(lines, "").rstrip("\n")
    if tuple(names.split(",")) != _TRAJECTORY:
        raise DatasetError(f"{path}: columns {names}; expected {','.join(_TRAJECTORY)}")
    rows = [*lines]
    if not rows:
        raise DatasetError(f"{path}: no rows")
    values = np.loadtxt(rows, delimiter=",", ndmin=2)
    if values.shape != (len(rows), len(_TRAJECTORY)):
        raise DatasetError(f"{path}: rows and columns disagree")
    time, quat, scale = values[:, 0], values[:, 4:8], values[:, 11]
    finite = bool((np.abs(values) < _LARGEST).all())
    if not (finite and (np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-3).all() and (scale > 0).all()):
        raise DatasetError(f"{path}: a row holds no pose")
    return Trajectory(
        time.astype(np.int64), values[:, 1:4].copy(), quat.copy(), values[:, 8:11].copy(), scale.copy()
    )
