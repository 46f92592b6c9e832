"""Range images of the Waymo Open Dataset 2: clouds with a pixel for each pulse, its pose and its label.

A row is a ring, the highest first, a column a step of azimuth on the vehicle, from behind by the left. Angles
of this grid are not those of the pulses: the pose of a pixel, which is the vehicle's at its time, is shifted
by the difference, so that points come out where they were recorded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import class_codes
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import Table
from lidar.dataset.layouts.waymo_parquet import RETURNS, Row
from lidar.dataset.recorded import Stream, cloud_points, recorded_labels
from lidar.geometry.attitude import euler_from_quat, quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.devices import Scanner
from lidar.sensors.rig.scanner import firings

_FINE = 2
"""Columns of a range image for each firing block of a turn: nearly all points have a pixel of their own."""
_EMPTY = -1.0


@dataclass(frozen=True)
class RangeImageGrid:
    """The range images of a scanner.

    number      : from 1, of its name
    stream      : its clouds
    inclination : (h,) radians, rising, of each ring
    width       : columns
    """

    number: int
    stream: Stream
    inclination: Float
    width: int

    def azimuth(self, column: Ints) -> Float:
        """Azimuths (n,) in the sensor frame of columns: they fall from pi to -pi on the vehicle."""
        turn = self.stream.mount.rotation
        return np.asarray(
            ((self.width - column - 0.5) / self.width * 2 - 1) * np.pi - np.arctan2(turn[1, 0], turn[0, 0])
        )

    def column(self, azimuth: Float) -> Ints:
        """Columns (n,) nearest to azimuths in the sensor frame."""
        turn = self.stream.mount.rotation
        ahead = azimuth + np.arctan2(turn[1, 0], turn[0, 0])
        share = np.remainder(ahead / (2 * np.pi) + 0.5, 1.0)
        column: Ints = np.rint(self.width * (1 - share) - 0.5).astype(np.int64) % self.width
        return column


def grid_of(device: Scanner, stream: Stream, *, number: int) -> RangeImageGrid:
    """The grid of a scanner: elevations of its rings, and firing blocks of a turn."""
    sent = firings(device.sensor, 0)
    count = np.bincount(sent.ring)
    x, y, z = sent.direction.T
    inclination = np.bincount(sent.ring, np.arctan2(z, np.hypot(x, y))) / count
    return RangeImageGrid(number, stream, inclination, _FINE * (int(sent.column.max()) + 1))


def pixels(grid: RangeImageGrid, table: Table) -> tuple[Ints, Ints]:
    """Rows (k,) of the points of a cloud that get a pixel, and (k,) its number: image, row and column.

    Of points with the same pixel the first one gets it.
    """
    height = len(grid.inclination)
    azimuth = np.arctan2(table["y"], table["x"]).astype(float)
    image = table.get("echo", np.ones(len(azimuth), np.int64)).astype(np.int64) - 1
    ring = table["ring"].astype(np.int64)
    place = (image * height + height - 1 - ring) * grid.width + grid.column(azimuth)
    fits = np.flatnonzero((image < RETURNS) & (ring < height))
    pixel, first = np.unique(place[fits], return_index=True)
    return fits[first], pixel


def range_images(
    grid: RangeImageGrid, trajectory: Trajectory, *, row: int, boxes: Iterable[Mapping[str, Any]] | None
) -> tuple[dict[str, Row], int]:
    """Range, pose and label images of a frame by component, and the number of points left out.

    row   : of the scanner's stream
    boxes : of the frame, which give the numbers of road users; None for no labels
    """
    stream = grid.stream
    table = cloud_points(stream.files[row])
    total = len(table["x"])
    kept, pixel = pixels(grid, table)
    table = {name: column[kept] for name, column in table.items()}
    size = len(grid.inclination) * grid.width
    points = np.column_stack([table[axis] for axis in "xyz"]).astype(float)
    distance = np.linalg.norm(points, axis=1)
    values = np.full((RETURNS * size, 4), _EMPTY, np.float32)
    values[pixel] = np.column_stack(
        [distance, table["intensity"] / 255, np.zeros_like(distance), np.full_like(distance, _EMPTY)]
    )
    inclination = grid.inclination[table["ring"].astype(np.int64)]
    azimuth = grid.azimuth(pixel % grid.width)
    level = np.cos(inclination)
    ray = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(inclination)])
    poses = trajectory.at(int(stream.time_ns[row]) + table["time_ns"].astype(np.int64))
    off = (points - ray * distance[:, None]) @ stream.mount.rotation.T
    place = poses.position / poses.scale + np.einsum("nij,nj->ni", poses.rotation, off)
    turned = euler_from_quat(quat_from_matrix(poses.rotation))
    pose = np.zeros((RETURNS * size, 6), np.float32)
    pose[pixel] = np.column_stack([turned, place])
    pose[:size] = np.where(values[:size, :1] > 0, pose[:size], pose[size:])
    shape = [len(grid.inclination), grid.width]
    images = {
        "lidar": _images(values, shape=shape),
        "lidar_pose": _images(pose[:size], shape=shape, returns=1),
    }
    if boxes is not None:
        labels = recorded_labels(table, boxes)
        segments = np.zeros((RETURNS * size, 2), np.int32)
        segments[pixel] = np.column_stack([labels.road_user, class_codes().waymo[labels.klass]])
        images["lidar_segmentation"] = _images(segments, shape=shape)
    return images, total - len(kept)


def _images(values: NDArray[Any], *, shape: Sequence[int], returns: int = RETURNS) -> Row:
    """Columns of range images, one after the other in (pixels, channels)."""
    row: Row = {}
    for number, part in enumerate(np.split(values, returns)):
        row[f"range_image_return{number + 1}.values"] = part.ravel()
        row[f"range_image_return{number + 1}.shape"] = [*shape, values.shape[1]]
    return row


def laser_calibration(grid: RangeImageGrid) -> Row:
    """The calibration of a scanner."""
    return {
        "laser_name": grid.number,
        "extrinsic.transform": grid.stream.mount.matrix.ravel(),
        "beam_inclination.min": float(grid.inclination[0]),
        "beam_inclination.max": float(grid.inclination[-1]),
        "beam_inclination.values": grid.inclination,
    }
