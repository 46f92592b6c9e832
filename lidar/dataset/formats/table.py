"""Point tables: dicts of named columns of equal length, which all point-cloud formats read and write.

x, y, z    float32 (sensor frame) or float64 (scene or projected coordinates), metres
intensity  float32, calibrated reflectivity, 0 to 255
time_ns    uint32, nanoseconds after the frame's start (or int64, after the drive's start, in maps)
ring       uint16, channel: rank of the beam's elevation, 0 lowest
column     uint32, firing block (azimuth step) within the frame
range      float32, metres
label      uint16, `geoscene.classes.Class`
instance   int32, feature number in the scene, -1 for none
incidence  float32, radians between beam and surface normal
true_range float32, metres, before noise and quantisation; 0 for a false return
echo, echoes  uint8, number of the echo (from 1) and number of echoes of its pulse
velocity   float32, m/s along the beam, positive away; FMCW scanners only
gps_time   float64, adjusted standard GPS time in seconds; in the world frame
source     uint16, number of the scanner; in maps
frame      uint32, number of the scanner's frame; in maps
red, green, blue  uint8
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import row_blocks
from geoscene.support.files import append, atomic_file, spool
from geoscene.typing import Float
from lidar.errors import FormatError, LidarError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory
from lidar.sensors.laser.cloud import Cloud

Table = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class FrameInfo:
    """The frame that a cloud is of, for formats that state it.

    sensor   : name
    frame    : number
    start_ns : since the drive's start
    pose     : (4, 4) export CRS from the sensor at the frame's start, rigid; None if it is not known
    """

    sensor: str = ""
    frame: int = 0
    start_ns: int = 0
    pose: Float | None = None


CACHED_ROWS = 1 << 15
"""Rows of records that stay in the processor's cache while they are filled, a column after another."""

NO_FRAME = FrameInfo()
"""Of clouds that are of no drive."""


def cloud_table(cloud: Cloud) -> Table:
    """The table of a cloud, in the sensor frame, with the types of files."""
    return {
        **dict(zip("xyz", cloud.xyz.T, strict=True)),
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


def table_cloud(table: Table, *, start_ns: int = 0) -> Cloud:
    """The cloud of a table in the sensor frame.

    Of columns that the table lacks, ``range`` is the distance from the sensor's origin, ``true_range`` is the
    range, ``instance`` is -1, ``echo`` and ``echoes`` are 1, and all others are 0.
    """
    xyz = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float32)
    n = len(xyz)

    def column(name: str, kind: type[np.generic], *, default: float = 0.0) -> NDArray[Any]:
        return table[name].astype(kind) if name in table else np.full(n, default, kind)

    distance = table["range"] if "range" in table else np.linalg.norm(xyz.astype(np.float64), axis=1)
    return Cloud(
        start_ns=start_ns,
        xyz=xyz,
        time_ns=column("time_ns", np.int32),
        ring=column("ring", np.uint16),
        column=column("column", np.int32),
        range=distance.astype(np.float64),
        intensity=column("intensity", np.float32),
        klass=column("label", np.uint8),
        feature=column("instance", np.int32, default=-1),
        incidence=column("incidence", np.float32),
        true_range=table.get("true_range", distance).astype(np.float64),
        echo=column("echo", np.uint8, default=1),
        echoes=column("echoes", np.uint8, default=1),
    )


def rows(table: Table) -> int:
    """Number of points; raises LidarError if columns differ in length."""
    lengths = {name: len(column) for name, column in table.items()}
    if len(set(lengths.values())) > 1:
        raise LidarError(f"columns of a point table differ in length: {lengths}")
    return next(iter(lengths.values()), 0)


def records(table: Table) -> NDArray[np.void]:
    """The table as packed little-endian records, with the columns in order."""
    kinds = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in table.items()])
    out = np.empty(rows(table), kinds)
    fields = [(out[name], column) for name, column in table.items()]
    for block in row_blocks(len(out), CACHED_ROWS):
        for field, column in fields:
            field[block] = column[block]
    return out


def columns_as_rows(table: Table, names: Sequence[str]) -> NDArray[np.float32]:
    """Columns of the table as rows (n, columns) of little-endian float32."""
    out = np.empty((rows(table), len(names)), "<f4")
    for k, name in enumerate(names):
        out[:, k] = table[name]
    return out


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


@dataclass(frozen=True, slots=True)
class PointLabels:
    """Labels of a cloud's points.

    klass     : (n,) `geoscene.classes.Class`
    road_user : (n,) int64, number of the road user hit, from 1; 0 for everything else
    moving    : (n,) whether that road user moves at some time of the drive
    """

    klass: NDArray[np.integer]
    road_user: NDArray[np.integer]
    moving: NDArray[np.bool_]


def read_rows(path: Path, columns: int) -> NDArray[np.float32]:
    """The rows (n, columns) of a file of little-endian float32 without a header.

    Raises FormatError for a file whose length does not fit, or with numbers that are not finite.
    """
    data = path.read_bytes()
    if len(data) % (4 * columns):
        raise FormatError(f"{path}: {len(data)} bytes are not rows of {columns} float32")
    found = np.frombuffer(data, "<f4").reshape(-1, columns).astype(np.float32)
    if len(bad := np.flatnonzero(~np.isfinite(found).all(axis=1))):
        raise FormatError(f"{path}: row {bad[0]} has a number that is not finite, as have {len(bad)} in all")
    return found


def check_column(path: Path, values: NDArray[np.float32], *, name: str, highest: int) -> None:
    """Raise FormatError for values (n,) of a file outside of 0 to ``highest``."""
    if len(bad := np.flatnonzero((values < 0) | (values > highest))):
        raise FormatError(
            f"{path}: row {bad[0]} has {name} {values[bad[0]]:g}, outside of 0 to {highest}, as have"
            f" {len(bad)} in all; scale them"
        )


def number_in_header(path: Path, start: bytes) -> int:
    """The last word, a number from 0, of the line of a text header that begins with ``start``.

    Raises ValueError, IndexError or StopIteration if there is none.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    number = int(next(line for line in head.splitlines() if line.startswith(start)).split()[-1])
    if number < 0:
        raise ValueError(f"{number} points")
    return number


@contextmanager
def counted_file(
    path: Path, convert: Callable[[Table], Table], *, header: Callable[[Table, int], bytes]
) -> Iterator[Callable[[Table], None]]:
    """Yield a function that appends tables to a file whose header states the number of points.

    convert : the table as it is stored
    header  : the header for a stored table and the number of points
    """
    count, last = 0, dict[str, NDArray[Any]]()
    with atomic_file(path) as out, spool(path) as body:

        def write(table: Table) -> None:
            nonlocal count, last
            last = convert(table)
            body.write(records(last).tobytes())
            count += rows(table)

        yield write
        out.write(header(last, count))
        append(out, body)


MOMENTS = {"start": 0.0, "middle": 0.5, "end": 1.0}
"""Moments of a frame to which points can be de-skewed, as fractions of its period."""


def deskew(placed: Float, trajectory: Trajectory, *, mount: Mount, time_ns: int) -> NDArray[np.float32]:
    """Points (n, 3) in the frame that the sensor has at ``time_ns``, from the true poses.

    placed : (n, 3) scene metres: each point at its own time

    The ego vehicle's motion is removed; the motion of other road users is not.
    """
    pose = trajectory.at([time_ns]).mounted(mount.translation, mount.rotation)
    local: NDArray[np.float32] = (((placed - pose.position) / pose.scale) @ pose.rotation[0]).astype(
        np.float32
    )
    return local
