"""Spoofed satellite positions, as steps, slow drifts that a filter may follow, or smooth curves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf

import numpy as np

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.sensors.navigation.measurements import Fixes
from lidar.sensors.navigation.satellite_visibility import E2, A
from lidar.signal.situation import Situation
from lidar.signal.stage import Stage


@dataclass(frozen=True)
class GnssSpoof(Stage):
    """A receiver is led away from its place by counterfeit satellite signals.

    Budget: an offset in metres, reached within a time; a slow drift passes the tests of a filter that a step
    fails (Shen et al. 2020). Speed and course agree with the drift, as a spoofer's signals do. Fixes that the
    receiver does not have are not made up.
    """

    kind: str = parameter("ramp", "step, ramp (constant drift) or smooth", among=("step", "ramp", "smooth"))
    east: float = parameter(0.0, "shift to the east in the end", unit="m", low=-1e5, high=1e5)
    north: float = parameter(0.0, "shift to the north in the end", unit="m", low=-1e5, high=1e5)
    left: float = parameter(
        3.0, "shift to the left of the driven direction in the end", unit="m", low=-1e5, high=1e5
    )
    ahead: float = parameter(0.0, "shift along the driven direction in the end", unit="m", low=-1e5, high=1e5)
    up: float = parameter(0.0, "shift upwards in the end", unit="m", low=-1e4, high=1e4)
    start: float = parameter(5.0, "time since the drive's start at which it begins", unit="s", low=0)
    ramp: float = parameter(
        20.0, "time until the whole offset is reached; not of a step", unit="s", low=0.1, high=1e6
    )
    stop: float = parameter(
        inf, "time since the drive's start at which it ends at once", unit="s", low=0, endless="never"
    )

    def fixes(self, fixes: Fixes, *, at: Situation, rng: np.random.Generator) -> Fixes:
        """The fixes with the offset."""
        del at, rng
        time = fixes.time_ns / 1e9
        share, rate = self._share(time), self._share(time, derivative=True)
        course = _held(fixes.course)
        sin, cos = np.sin(course), np.cos(course)
        whole = np.column_stack(
            [
                self.east + self.ahead * sin - self.left * cos,
                self.north + self.ahead * cos + self.left * sin,
                np.full(len(fixes), self.up),
            ]
        )
        lat = np.radians(fixes.lonlath[:, 1])
        w = np.sqrt(1 - E2 * np.sin(lat) ** 2)
        per_metre = np.column_stack(
            [
                np.degrees(w / (A * np.cos(lat))),
                np.degrees(w**3 / (A * (1 - E2))),
                np.ones(len(fixes)),
            ]
        )
        east = fixes.speed * np.sin(fixes.course) + rate * whole[:, 0]
        north = fixes.speed * np.cos(fixes.course) + rate * whole[:, 1]
        drifts = rate != 0
        return replace(
            fixes,
            lonlath=fixes.lonlath + share[:, None] * whole * per_metre,
            speed=np.where(drifts, np.hypot(east, north), fixes.speed),
            course=np.where(drifts, np.arctan2(east, north) % (2 * np.pi), fixes.course),
        )

    def _share(self, time: Float, *, derivative: bool = False) -> Float:
        """Share (n,) of the whole offset at times in seconds, or its derivative per second."""
        t = np.clip((time - self.start) / self.ramp, 0, 1)
        inside = (t > 0) & (t < 1)
        if self.kind == "step":
            share, rate = (time >= self.start).astype(float), np.zeros(len(time))
        elif self.kind == "ramp":
            share, rate = t, inside / self.ramp
        else:  # velocity and acceleration begin and end at zero
            share = t**3 * (10 - 15 * t + 6 * t**2)
            rate = 30 * t**2 * (1 - t) ** 2 / self.ramp
        found: Float = np.where(time < self.stop, rate if derivative else share, 0.0)
        return found


def _held(course: Float) -> Float:
    """Courses (n,) with NaN replaced by the last known value; north before the first."""
    last = np.maximum.accumulate(np.where(np.isnan(course), -1, np.arange(len(course))))
    return np.where(last < 0, 0.0, course[np.maximum(last, 0)])
