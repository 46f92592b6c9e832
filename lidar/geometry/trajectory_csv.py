"""Trajectories as CSV: ``trajectory.csv`` of a dataset, whose manifest holds the frame."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.csv_tables import write_blocks
from lidar.errors import DatasetError, InputError
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
        with path.open(encoding="utf-8") as lines:
            count = sum(1 for _ in lines) - 1
        with path.open(encoding="utf-8") as lines:
            return Trajectory.gathered(max(count, 1), _parts(path, lines, count=count))
    except DatasetError:
        raise
    except (OSError, ValueError, InputError) as error:
        raise DatasetError(f"{path}: not a readable trajectory ({error})") from error


def _parts(path: Path, lines: Iterator[str], *, count: int) -> Iterator[Trajectory]:
    """The trajectory in blocks of rows; raises DatasetError for other columns and rows that hold no pose."""
    names = next(lines, "").rstrip("\n")
    if tuple(names.split(",")) != _TRAJECTORY:
        raise DatasetError(f"{path}: columns {names}; expected {','.join(_TRAJECTORY)}")
    if count < 1:
        raise DatasetError(f"{path}: no rows")
    for rows in blocks_of(count):
        size = rows.stop - rows.start
        values = np.loadtxt(itertools.islice(lines, size), delimiter=",", ndmin=2)
        if values.shape != (size, len(_TRAJECTORY)):
            raise DatasetError(f"{path}: rows and columns disagree")
        time, quat, scale = values[:, 0], values[:, 4:8], values[:, 11]
        finite = bool((np.abs(values) < _LARGEST).all())
        if not (finite and (np.abs(np.linalg.norm(quat, axis=1) - 1) < 1e-3).all() and (scale > 0).all()):
            raise DatasetError(f"{path}: a row holds no pose")
        yield Trajectory(time.astype(np.int64), values[:, 1:4], quat, values[:, 8:11], scale)
