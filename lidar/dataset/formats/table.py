"""Point tables: named columns of equal length, the common ground of all cloud formats.

A table is a plain dict. Names used here, with units and frames:

x, y, z    float32 (sensor frame) or float64 (scene or projected coordinates), metres
intensity  float32, calibrated reflectivity, 0 to 255
time_ns    uint32, nanoseconds after the frame's start (or int64, after the drive's start, in maps)
ring       uint16, rank of the beam's elevation
column     uint32, firing block within the frame
range      float32, metres
label      uint16, `geoscene.classes.Class`
instance   int32, feature number in the scene, -1 for none
incidence  float32, radians
true_range float32, metres, before noise and quantisation; 0 for a return of nothing
echo, echoes  uint8
velocity   float32, m/s along the beam, positive away; of scanners that measure it
red, green, blue  uint8
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidar.errors import LidarError
from lidar.sensors.cloud import Cloud

Table = dict[str, NDArray[Any]]


def cloud_table(cloud: Cloud) -> Table:
    """The table of one frame's returns, sensor frame, as files carry it."""
    return {
        "x": cloud.xyz[:, 0],
        "y": cloud.xyz[:, 1],
        "z": cloud.xyz[:, 2],
        "intensity": cloud.intensity,
        "time_ns": cloud.time_ns.astype(np.uint32),
        "ring": cloud.ring,
        "column": cloud.column.astype(np.uint32),
        "range": cloud.range.astype(np.float32),
        "label": cloud.klass.astype(np.uint16),
        "instance": cloud.feature,
        "incidence": cloud.incidence,
        "true_range": cloud.true_range.astype(np.float32),
        "echo": cloud.echo,
        "echoes": cloud.echoes,
    }


def rows(table: Table) -> int:
    """Number of points; raises LidarError if columns disagree."""
    lengths = {name: len(column) for name, column in table.items()}
    if len(set(lengths.values())) > 1:
        raise LidarError(f"columns of a point table disagree in length: {lengths}")
    return next(iter(lengths.values()), 0)


def records(table: Table) -> NDArray[np.void]:
    """The table as packed little-endian records, columns in order."""
    kinds = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in table.items()])
    out = np.empty(rows(table), kinds)
    for name, column in table.items():
        out[name] = column
    return out
