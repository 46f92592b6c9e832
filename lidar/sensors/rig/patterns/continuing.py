"""Patterns that run on across frames: wedge prisms, formulas, lists of directions, lines of aircraft."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import (
    Firings,
    Pattern,
    blocks,
    frame_window_ns,
    from_origin,
    numbers,
    unit_vectors,
)
from lidar.toml_table import Table


@dataclass(frozen=True, eq=False)
class Prisms(Pattern):
    """Beams along the prisms' common axis that fire simultaneously.

    incident : (b, 3) unit vectors of the beams before the prisms, which stand along +y
    wedge    : (k,) radians, angle between the faces of each prism; positive if the inclined face comes first
    index    : (k,) refractive index
    turn_hz  : (k,) revolutions per second; the sign gives the direction
    pulse_hz : pulses per second of each beam
    """

    incident: Float
    wedge: Float
    index: Float
    turn_hz: Float
    pulse_hz: Fraction

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; the prisms' rotation continues across frames."""
        block = blocks(frame, rate_hz, block_ns=10**9 / self.pulse_hz, start_ns=start_ns)
        seconds = (block.first + np.arange(len(block))) / float(self.pulse_hz)
        beams = len(self.incident)
        phase = 2 * np.pi * np.mod(np.multiply.outer(seconds, self.turn_hz), 1.0)
        direction = np.empty((len(block) * beams, 3))
        faces = np.stack([np.sin(self.wedge), np.cos(self.wedge), self.index], axis=1)
        _steer(self.incident, faces, np.sin(phase), np.cos(phase), direction)
        column, channel = numbers(len(block), beams)
        return from_origin(np.repeat(block.time_ns, beams), direction, column=column, channel=channel)


@njit(cache=True, nogil=True)
def _steer(incident: Any, faces: Any, sine: Any, cosine: Any, direction: Any) -> None:
    """Fill ``direction`` with the beams behind the prisms, in sensor axes.

    faces : (k, 3) sine and cosine of the wedge angle, refractive index
    """
    ray = 0
    for i in range(len(sine)):
        for beam in range(len(incident)):
            x, y, z = incident[beam]
            for k in range(len(faces)):
                side, up, n = faces[k]
                nx, ny, nz = side * sine[i, k], -up, side * cosine[i, k]
                if side > 0:
                    x, y, z = _refract(x, y, z, nx, ny, nz, 1 / n)
                    x, y, z = _refract(x, y, z, 0.0, -1.0, 0.0, n)
                else:
                    x, y, z = _refract(x, y, z, 0.0, -1.0, 0.0, 1 / n)
                    x, y, z = _refract(x, y, z, nx, ny, nz, n)
            # The prisms' axis y is forward, their x is up.
            direction[ray, 0], direction[ray, 1], direction[ray, 2] = y, z, x
            ray += 1


@njit(cache=True, nogil=True)
def _refract(x: Any, y: Any, z: Any, nx: Any, ny: Any, nz: Any, ratio: Any) -> Any:
    """Unit vector behind a boundary by Snell's law; ``ratio`` of the indices before and behind."""
    c = -(x * nx + y * ny + z * nz)
    s2 = ratio * ratio * (1 - c * c)
    along = ratio * c - np.sqrt(1 - s2)
    return ratio * x + along * nx, ratio * y + along * ny, ratio * z + along * nz


def read_prisms(table: Table) -> Prisms:
    """The pattern that a ``[prism]`` table describes.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    wedge = np.radians(table.numbers("wedge_deg"))
    k = len(wedge)
    x = np.array(table.numbers("incident_x", (0.0,)))
    if (np.abs(x) >= 1).any():
        raise table.error("incident_x", "components of unit vectors are within -1 to 1")
    pattern = Prisms(
        incident=np.stack([x, np.sqrt(1 - x * x), 0 * x], axis=1),
        wedge=wedge,
        index=np.array(table.numbers("index", count=k, spread=True)),
        turn_hz=np.array(table.numbers("turn_hz", count=k)),
        pulse_hz=Fraction(str(table.number("pulse_hz", low=1e-3, high=1e7))),
    )
    if (pattern.index < 1).any():
        raise table.error("index", "indices of refraction are 1 or more")
    if not np.isfinite(pattern.fire(0, 10.0, start_ns=0).direction).all():
        raise table.error("wedge_deg", "beams are totally reflected within these prisms")
    table.close()
    return pattern


@dataclass(frozen=True, eq=False)
class SweepPattern(Pattern):
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
class Listed(Pattern):
    """A list of directions that repeats.

    after_ns : (n,) int64 nanoseconds after the start of the list, in increasing order
    azimuth, elevation : (n,) radians, counter-clockwise from forward, and up
    period_ns : nanoseconds from one start of the list to the next
    """

    after_ns: NDArray[np.int64]
    azimuth: Float
    elevation: Float
    period_ns: int

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
        rows = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1, 2), ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise table.error("file", f"{path} cannot be read: {reason_of(error)}") from error
    after = np.round(rows[:, 0] * 1e9).astype(np.int64)
    period_ns = round(table.number("period_s", above=0.0) * 1e9)
    if len(after) == 0 or (np.diff(after) < 0).any() or after[0] < 0 or after[-1] >= period_ns:
        raise table.error("file", f"the times of {path} do not rise from 0 to less than period_s")
    table.close()
    return Listed(after, np.radians(rows[:, 1]), np.radians(90 - rows[:, 2]), period_ns)


LAWS = ("polygon", "zigzag", "sine", "conical")
"""Laws of motion of the mirror."""


@dataclass(frozen=True)
class LinePattern(Pattern):
    """One beam that points down (-z) and is deflected to the left and right of the flight line (x).

    polygon  : right to left, repeatedly: theta = t (frac(L s) - 1/2), t the turn; no pulses beyond the half
               angle
    zigzag   : back and forth at a constant rate: theta = a tri(L s / 2)
    sine     : theta = a sin(pi L s)
    conical  : a circle: (sin a cos(2 pi L s), sin a sin(2 pi L s), -cos a)

    law        : of `LAWS`
    half_angle : radians, a
    turn       : radians, angle of one line of the polygon
    line_hz    : lines per second, L
    pulse_hz   : pulses per second
    """

    law: str
    half_angle: float
    turn: float
    line_hz: float
    pulse_hz: Fraction

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; the mirror's motion continues across frames."""
        block = blocks(frame, rate_hz, block_ns=10**9 / self.pulse_hz, start_ns=start_ns)
        seconds = (block.first + np.arange(len(block))) / float(self.pulse_hz)
        swing = self.line_hz * seconds
        direction = self._directions(swing)
        fired = np.flatnonzero(-direction[:, 2] >= np.cos(self.half_angle) - 1e-12).astype(np.int32)
        channel = np.zeros(len(fired), np.uint16)
        return from_origin(block.time_ns[fired], direction[fired], column=fired, channel=channel)

    def _directions(self, swing: Float) -> Float:
        """Unit vectors (n, 3) after ``swing`` (n,) lines."""
        a = self.half_angle
        if self.law == "conical":
            turn = 2 * np.pi * np.mod(swing, 1.0)
            down = np.full(len(swing), -np.cos(a))
            return np.stack([np.sin(a) * np.cos(turn), np.sin(a) * np.sin(turn), down], axis=1)
        if self.law == "polygon":
            theta = self.turn * (np.mod(swing, 1.0) - 0.5)
        elif self.law == "zigzag":
            theta = a * (1 - 4 * np.abs(np.mod(swing / 2 + 0.25, 1.0) - 0.5))
        else:
            theta = a * np.sin(np.pi * np.mod(swing, 2.0))
        return np.stack([np.zeros(len(swing)), np.sin(theta), -np.cos(theta)], axis=1)


def read_line(table: Table) -> LinePattern:
    """The pattern that a ``[line]`` table describes.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    law = table.text("law", among=LAWS)
    half = table.number("half_angle_deg", above=0.0, high=180.0)
    turn = table.number("turn_deg", 2 * half, low=2 * half, high=360.0) if law == "polygon" else 2 * half
    pattern = LinePattern(
        law=law,
        half_angle=float(np.radians(half)),
        turn=float(np.radians(turn)),
        line_hz=table.number("line_hz", above=0.0, high=1e5),
        pulse_hz=Fraction(str(table.number("pulse_hz", low=1e-3, high=1e7))),
    )
    table.close()
    return pattern
