"""Point clouds of KITTI and point labels of SemanticKITTI.

velodyne/000000.bin and labels/000000.label: Geiger et al. 2012 (odometry) and Behley et al. 2019. Rows are in
the same order in both files of a frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import class_codes
from geoscene.support.files import write_atomically
from geoscene.typing import Ints
from lidar.dataset.formats.table import PointLabels, Table, check_column, columns_as_rows, read_rows

# Moving road users have codes of their own: car, bicyclist, person, motorcyclist, bus, truck, other vehicle.
_MOVING = {10: 252, 31: 253, 30: 254, 32: 255, 13: 257, 18: 258, 20: 259}


def write(path: Path, table: Table) -> None:
    """Write x, y, z (metres, sensor frame) and reflectance (0 to 1) as little-endian float32."""
    reflectance = table["intensity"].astype(np.float32, copy=False) / np.float32(255)
    columns = {axis: table[axis] for axis in "xyz"} | {"reflectance": reflectance}
    write_atomically(path, columns_as_rows(columns, tuple(columns)))


def read(path: Path) -> Table:
    """The table x, y, z and intensity (0 to 255) of a file, all float32.

    Raises FormatError for a file whose length is not a multiple of 16 bytes, and for reflectances outside of
    0 to 1.
    """
    x, y, z, reflectance = read_rows(path, 4).T
    check_column(path, reflectance, name="reflectance", highest=1)
    return {"x": x, "y": y, "z": z, "intensity": reflectance * np.float32(255)}


def laser_order(table: Table) -> Ints:
    """Rows (n,) of a table with rings in the order of KITTI's recordings.

    Lasers follow each other from the top ring down, the points of each by azimuth from forward (the x axis),
    counter-clockwise. Points of the same azimuth, as echoes of a pulse, keep their order.
    """
    azimuth = np.remainder(np.arctan2(table["y"], table["x"]), 2 * np.pi)
    return np.lexsort((azimuth, -table["ring"].astype(np.int64)))


def count(path: Path) -> int:
    """Number of points of a file."""
    return path.stat().st_size // 16


def semantic_kitti_labels(labels: PointLabels) -> NDArray[np.uint32]:
    """SemanticKITTI's labels (n,): its class in the lower 16 bits, the road user's number in the upper."""
    still = class_codes().semantic_kitti.astype(np.uint32)
    moves = still.copy()
    for code, other in _MOVING.items():
        moves[still == code] = other
    code = np.where(labels.moving, moves[labels.klass], still[labels.klass])
    number = np.where(labels.road_user < 1 << 16, labels.road_user, 0).astype(np.uint32)
    codes: NDArray[np.uint32] = (code | number << 16).astype(np.uint32)
    return codes


def read_labels(path: Path) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Numbers (n,) of road users, 0 for none, and whether they move, from SemanticKITTI's labels."""
    codes = np.fromfile(path, "<u4")
    return (codes >> 16).astype(np.int64), np.isin(codes & 0xFFFF, list(_MOVING.values()))


def write_labels(path: Path, labels: PointLabels) -> None:
    """Write SemanticKITTI's labels as little-endian uint32."""
    write_atomically(path, semantic_kitti_labels(labels).astype("<u4"))
