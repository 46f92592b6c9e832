"""Scanners with a grid of pixels that measure all at once (flash) or row by row."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import Firings, blocks, frame_ns, frozen, unit_vectors
from lidar.toml_table import Table


@dataclass(frozen=True)
class Flash:
    """A grid of pixels behind a lens, row by row from the top, each from left to right.

    columns, rows : pixels
    width, height : radians, field of view between the outer pixels' outer edges
    rectilinear   : pixels evenly spaced on a plane (a lens without distortion), else in angle
    row_ns        : nanoseconds from one row to the next; 0 if all pixels measure at once
    """

    columns: int
    rows: int
    width: float
    height: float
    rectilinear: bool
    row_ns: int
    range_offset: float = 0.0

    @functools.cached_property
    def _grid(self) -> tuple[Float, Float, NDArray[np.uint16], NDArray[np.int32], NDArray[np.uint16]]:
        """Direction, origin, ring, column and channel."""
        u = (np.arange(self.columns) + 0.5) / self.columns * 2 - 1
        v = (np.arange(self.rows) + 0.5) / self.rows * 2 - 1
        if self.rectilinear:
            left = np.broadcast_to(-u * np.tan(self.width / 2), (self.rows, self.columns))
            up = np.broadcast_to((-v * np.tan(self.height / 2))[:, None], (self.rows, self.columns))
            direction = np.stack([np.ones_like(left), left, up], axis=2)
            direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        else:
            azimuth, elevation = np.meshgrid(-u * self.width / 2, -v * self.height / 2)
            direction = unit_vectors(azimuth, elevation)
        n = self.rows * self.columns
        ring = np.repeat(np.arange(self.rows, dtype=np.uint16)[::-1], self.columns)
        column = np.tile(np.arange(self.columns, dtype=np.int32), self.rows)
        return (
            frozen(direction.reshape(-1, 3)),
            frozen(np.zeros((n, 3))),
            frozen(ring),
            frozen(column),
            frozen(np.arange(n).astype(np.uint16)),
        )

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``."""
        direction, origin, ring, column, channel = self._grid
        start = blocks(frame, rate_hz, block_ns=frame_ns(rate_hz), start_ns=start_ns).time_ns[0]
        time = start + np.repeat(np.arange(self.rows, dtype=np.int64) * self.row_ns, self.columns)
        return Firings(time, direction, origin, ring, column, channel, np.arange(len(time), dtype=np.int32))


def read_flash(table: Table, rate_hz: float) -> Flash:
    """The pattern that a ``[flash]`` table describes.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    columns, rows = (table.integer(key, low=1, high=1 << 14) for key in ("columns", "rows"))
    if columns * rows > 1 << 16:
        raise table.error("columns", f"{columns} x {rows} pixels are over 65536")
    rectilinear = table.text("lens", "rectilinear", among=("rectilinear", "angular")) == "rectilinear"
    fov = table.numbers("fov_deg", count=2)
    if min(fov) <= 0 or max(fov) > (170 if rectilinear else 360):
        raise table.error("fov_deg", "width and height must be over 0 and at most 170 degrees (angular: 360)")
    row_us = table.number("row_us", 0.0, low=0.0)
    if row_us * rows > 1e6 / rate_hz:
        raise table.error("row_us", f"{rows} rows take longer than a frame")
    table.close()
    width, height = np.radians(fov)
    return Flash(columns, rows, float(width), float(height), rectilinear, round(row_us * 1000))
