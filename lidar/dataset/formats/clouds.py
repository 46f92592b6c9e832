"""Clouds in the sensor frame, read from any format and put into the scene."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.dataset.formats.pcd import read_pcd
from lidar.dataset.formats.ply import read_ply
from lidar.dataset.formats.table import Table
from lidar.dataset.formats.text import read_csv
from lidar.geometry.poses import Trajectory

CLOUD_READERS: dict[str, Callable[[Path], Table]] = {"pcd": read_pcd, "ply": read_ply, "csv": read_csv}
"""By format, which is the suffix too."""


def placed_returns(
    table: Table, trajectory: Trajectory, *, start_ns: int, vehicle_from_sensor: Float
) -> tuple[Float, NDArray[np.int64]]:
    """Scene coordinates (n, 3) of a frame's returns, and their times (n,) in nanoseconds of the drive.

    start_ns            : the frame's start
    vehicle_from_sensor : (4, 4) the mount
    """
    time_ns = start_ns + table["time_ns"].astype(np.int64)
    points = np.column_stack([table[axis] for axis in "xyz"])
    mount = vehicle_from_sensor
    world = trajectory.place(points, time_ns, translation=mount[:3, 3], rotation=mount[:3, :3])
    return world, time_ns
