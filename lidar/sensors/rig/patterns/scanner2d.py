"""Scanners that rotate one beam in a plane."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import Firings, blocks, frame_ns, frozen
from lidar.toml_table import Table


@dataclass(frozen=True)
class Scan2d:
    """A beam that rotates counter-clockwise (from above) in the sensor's x-y plane and fires in a sector.

    steps : firing positions per revolution
    first, last : radians, the sector's ends, counter-clockwise from forward; both fire
    """

    steps: int
    first: float
    last: float
    range_offset: float = 0.0

    @functools.cached_property
    def _beams(self) -> tuple[Float, Float, NDArray[np.int32], NDArray[np.uint16]]:
        """Direction, origin, column and zeros of the sector."""
        count = int(np.floor((self.last - self.first) / (2 * np.pi) * self.steps + 1e-6)) + 1
        count = min(count, self.steps)  # of a full circle the last is the next revolution's first
        angle = self.first + np.arange(count) * (2 * np.pi / self.steps)
        direction = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
        return (
            frozen(direction),
            frozen(np.zeros((count, 3))),
            frozen(np.arange(count, dtype=np.int32)),
            frozen(np.zeros(count, np.uint16)),
        )

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of revolution ``frame``, which starts with the first pulse of the sector."""
        direction, origin, column, zero = self._beams
        time = blocks(frame, rate_hz, block_ns=frame_ns(rate_hz) / self.steps, start_ns=start_ns).time_ns[
            : len(column)
        ]
        return Firings(time, direction, origin, zero, column, zero, column)


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
