"""Patterns that are the same in each frame: a beam that rotates in a plane, and a grid of pixels."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from lidar.sensors.rig.patterns.beams import (
    Firings,
    Pattern,
    blocks,
    frame_ns,
    from_origin,
    frozen,
    numbers,
    unit_vectors,
)
from lidar.toml_table import Table


@dataclass(frozen=True)
class Scan2d(Pattern):
    """A beam that rotates counter-clockwise (from above) in the sensor's x-y plane and fires in a sector.

    steps : firing positions per revolution
    first, last : radians, the sector's ends, counter-clockwise from forward; both fire
    """

    steps: int
    first: float
    last: float

    @functools.cached_property
    def _sector(self) -> Firings:
        """The pulses of a revolution, without their times."""
        count = int(np.floor((self.last - self.first) / (2 * np.pi) * self.steps + 1e-6)) + 1
        count = min(count, self.steps)  # of a full circle the last is the next revolution's first
        angle = self.first + np.arange(count) * (2 * np.pi / self.steps)
        direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
        column, channel = numbers(count, 1)
        return _shared(from_origin(np.zeros(count, np.int64), direction, column=column, channel=channel))

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of revolution ``frame``, which starts with the first pulse of the sector."""
        block = blocks(frame, rate_hz, block_ns=frame_ns(rate_hz) / self.steps, start_ns=start_ns)
        return replace(self._sector, time_ns=block.time_ns[: len(self._sector)])


def _shared(pulses: Firings) -> Firings:
    """The same pulses, read-only because frames share them."""
    for column in pulses.columns().values():
        frozen(column)
    return pulses


def read_scan2d(table: Table, rate_hz: float, *, rates_hz: tuple[float, ...]) -> Scan2d:
    """The pattern that a ``[scan2d]`` table describes at one of its rates.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    first, last = table.numbers("sector_deg", count=2)
    if not 0 < last - first <= 360:
        raise table.error("sector_deg", "the second angle must exceed the first, by at most 360")
    step = table.numbers("step_deg", count=len(rates_hz), spread=True)
    if rate_hz not in rates_hz and len(set(step)) > 1:
        known = ", ".join(f"{r:g}" for r in rates_hz)
        raise table.error("step_deg", f"no step is given for {rate_hz:g} Hz; rates are {known}")
    chosen = step[rates_hz.index(rate_hz)] if rate_hz in rates_hz else step[0]
    steps = round(360 / chosen) if chosen > 1e-6 else 0
    if not steps or abs(steps * chosen - 360) > 0.01:
        raise table.error("step_deg", f"{chosen} does not divide 360 degrees")
    table.close()
    return Scan2d(steps, float(np.radians(first)), float(np.radians(last)))


@dataclass(frozen=True)
class Flash(Pattern):
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

    @functools.cached_property
    def _grid(self) -> Firings:
        """The pulses of a frame, at nanoseconds since its start."""
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
        time = np.repeat(np.arange(self.rows, dtype=np.int64) * self.row_ns, self.columns)
        order = np.arange(n, dtype=np.int32)
        channel, direction = order.astype(np.uint16), direction.reshape(-1, 3)
        return _shared(Firings(time, direction, np.zeros((n, 3)), ring, column, channel, order))

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``."""
        start = blocks(frame, rate_hz, block_ns=frame_ns(rate_hz), start_ns=start_ns).time_ns[0]
        return replace(self._grid, time_ns=start + self._grid.time_ns)


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
