"""Patterns given by a formula (sweep) or by a list of directions (table)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import (
    Firings,
    blocks,
    frame_window_ns,
    from_origin,
    numbers,
    unit_vectors,
)
from lidar.toml_table import Table


@dataclass(frozen=True, eq=False)
class SweepPattern:
    """Beams that fire in turn: elevation as a triangle wave, azimuth at a constant rate or as such a wave.

    elevation = centre + half range * tri(f_e t + line / lines), tri from -1 to 1; azimuth = 2 pi f_a t, or
    centre + half range * tri(f_a t).

    low, high : radians, elevations
    sector    : (2,) radians, lowest and highest azimuth, counter-clockwise; empty for full turns
    lines     : number of beams, which fire one after the other
    """

    azimuth_hz: float
    elevation_hz: float
    low: float
    high: float
    lines: int
    pulse_hz: Fraction
    sector: tuple[float, ...] = ()
    range_offset: float = 0.0

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; the pattern continues across frames."""
        block = blocks(frame, rate_hz, block_ns=10**9 / self.pulse_hz, start_ns=start_ns)
        number = block.first + np.arange(len(block))
        seconds = number / float(self.pulse_hz)
        line = (number % self.lines).astype(np.uint16)
        elevation = _wave(self.elevation_hz * seconds + line / self.lines, self.low, high=self.high)
        azimuth = 2 * np.pi * np.mod(self.azimuth_hz * seconds, 1.0)
        if self.sector:
            azimuth = _wave(self.azimuth_hz * seconds, self.sector[0], high=self.sector[1])
        column, _ = numbers(len(block), 1)
        direction = unit_vectors(azimuth, elevation)
        return from_origin(block.time_ns, direction, column=column, channel=line)


def _wave(turns: Float, low: float, *, high: float) -> Float:
    """Triangle wave from ``high`` at whole turns to ``low`` at half ones."""
    return (low + high) / 2 + (high - low) / 2 * (4 * np.abs(np.mod(turns, 1.0) - 0.5) - 1)


@dataclass(frozen=True, eq=False)
class Listed:
    """A list of directions that repeats.

    after_ns : (n,) int64 nanoseconds after the start of the list, in increasing order
    azimuth, elevation : (n,) radians, counter-clockwise from forward, and up
    period_ns : nanoseconds from one start of the list to the next
    """

    after_ns: NDArray[np.int64]
    azimuth: Float
    elevation: Float
    period_ns: int
    range_offset: float = 0.0

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; the list continues across frames."""
        first, stop = frame_window_ns(frame, rate_hz, start_ns=0)
        rounds = np.arange(first // self.period_ns, stop // self.period_ns + 1, dtype=np.int64)
        time = (rounds[:, None] * self.period_ns + self.after_ns).ravel()
        rows = np.flatnonzero((time >= first) & (time < stop))
        entry = rows % len(self.after_ns)
        column, channel = numbers(len(rows), 1)
        direction = unit_vectors(self.azimuth[entry], self.elevation[entry])
        return from_origin(start_ns + time[rows], direction, column=column, channel=channel)


def read_sweep(table: Table) -> SweepPattern:
    """The pattern that a ``[sweep]`` table describes.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    low, high = np.radians(table.numbers("elevation_deg", count=2))
    if not -np.pi / 2 <= low < high <= np.pi / 2:
        raise table.error("elevation_deg", "give the lowest and the highest elevation, within 90 degrees")
    sector = (
        tuple(np.radians(table.numbers("azimuth_deg", count=2)).tolist()) if table.has("azimuth_deg") else ()
    )
    if sector and not -np.pi <= sector[0] < sector[1] <= np.pi:
        raise table.error("azimuth_deg", "give the lowest and the highest azimuth, within 180 degrees")
    pattern = SweepPattern(
        azimuth_hz=table.number("azimuth_hz"),
        elevation_hz=table.number("elevation_hz"),
        low=float(low),
        high=float(high),
        lines=table.integer("lines", 1, low=1, high=1024),
        pulse_hz=Fraction(str(table.number("pulse_hz", low=1e-3, high=1e7))),
        sector=sector,
    )
    table.close()
    return pattern


def read_listed(table: Table) -> Listed:
    """Firing pattern and period of a ``[table]`` table, read from a CSV file beside the preset.

    The file has a header and the columns time in seconds, azimuth and zenith angle in degrees, as in the
    pattern files of Livox. Raises RigError if it cannot be read or its times do not increase.
    """
    name = table.text("file")
    path = Path(table.path).parent / name
    try:
        rows = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1, 2), ndmin=2)
    except (OSError, ValueError) as error:
        raise table.error("file", f"{path} cannot be read: {error}") from error
    after = np.round(rows[:, 0] * 1e9).astype(np.int64)
    period_ns = round(table.number("period_s", above=0.0) * 1e9)
    if len(after) == 0 or (np.diff(after) < 0).any() or after[0] < 0 or after[-1] >= period_ns:
        raise table.error("file", f"the times of {path} do not rise from 0 to less than period_s")
    table.close()
    return Listed(after, np.radians(rows[:, 1]), np.radians(90 - rows[:, 2]), period_ns)
