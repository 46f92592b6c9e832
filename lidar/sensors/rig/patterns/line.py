"""Airborne scanners: a mirror deflects one beam across the flight line."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import Firings, blocks, from_origin
from lidar.toml_table import Table

LAWS = ("polygon", "zigzag", "sine", "conical")
"""Laws of motion of the mirror."""


@dataclass(frozen=True)
class LinePattern:
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
    range_offset: float = 0.0

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
