"""Extremes of time: days, rates that do not divide each other, years 1980 to 2100, leap seconds."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from fractions import Fraction
from functools import partial

import numpy as np

from lidar.geometry.attitude import Mount
from lidar.geometry.time_scales import GPS_EPOCH, LEAPS, gps_seconds, leap_seconds
from lidar.sensors.navigation.gnss import epochs
from lidar.sensors.rig.patterns.beams import frame_window_ns
from lidar.sensors.rig.specs import GnssSpec
from lidar.tools.selftest.case import ExtremeCase

_DAY = 86_400
_RATES = (0.1, 0.3, 1.0, 3.0, 7.0, 9.97, 10.0, 12.5, 19.98, 23.976, 29.97, 59.94, 70.0, 99.9)
_MOUNT = Mount((0.0, 0.0, 1.5), (0.0, 0.0, 0.0, 1.0))


def frame_starts(count: int) -> float:
    """Largest error in nanoseconds of the starts of a day's frames."""
    worst, rng = Fraction(0), np.random.default_rng(1)
    for rate in _RATES:
        exact = Fraction(str(rate))
        for frame in rng.integers(0, int(_DAY * exact) + 1, count // len(_RATES)).tolist():
            start, _ = frame_window_ns(frame, rate, start_ns=0)
            worst = max(worst, abs(frame * 10**9 / exact - start))
    return float(worst)


def epoch_times(count: int) -> float:
    """Largest error in nanoseconds of the epochs of a day of receivers."""
    worst = Fraction(0)
    for rate in _RATES:
        at = epochs(GnssSpec("gnss", _MOUNT, rate_hz=rate), _DAY * 10**9)
        for row in np.linspace(0, len(at) - 1, count // len(_RATES)).astype(int).tolist():
            worst = max(worst, abs(row * 10**9 / Fraction(str(rate)) - int(at[row])))
    return float(worst)


def gps_times(count: int) -> float:
    """Largest error in microseconds of GPS times of the years 1980 to 2100."""
    worst, rng, span = 0.0, np.random.default_rng(2), (datetime(2101, 1, 1, tzinfo=UTC) - GPS_EPOCH).days
    for day, second in rng.integers(0, (span, _DAY), (count, 2)).tolist():
        start = GPS_EPOCH + timedelta(days=day, seconds=second)
        exact = day * _DAY + second + leap_seconds(start)
        worst = max(worst, abs(float(gps_seconds(start, np.zeros(1, np.int64))[0]) + 1e9 - exact))
    return worst * 1e6


def lost_leap_seconds(count: int) -> float:
    """Leap seconds across which GPS time does not pass two seconds from 23:59:59 to 00:00:00."""
    zero = np.zeros(1, np.int64)
    steps = [gps_seconds(t, zero)[0] - gps_seconds(t - timedelta(seconds=1), zero)[0] for t in LEAPS[:count]]
    return float(np.count_nonzero(np.array(steps) != 2.0))


_FLOOR = "times are whole nanoseconds"

_case = partial(ExtremeCase, group="time")
_day = partial(_case, bound=1, unit="ns", quick=1300, full=130_000)

CASES = (
    _day("starts of the frames of 24 h", frame_starts, _FLOOR, of="frames"),
    _day("epochs of a receiver in 24 h", epoch_times, _FLOOR, of="epochs"),
    _case(
        "GPS time from 1980 to 2100",
        gps_times,
        "doubles of LAS, less 1e9 s",
        bound=0.5,
        unit="µs",
        of="moments",
        quick=2000,
        full=100_000,
    ),
    _case(
        "leap seconds that GPS time does not count",
        lost_leap_seconds,
        "drives across one are refused",
        unit="leap seconds",
        of="leap seconds",
        quick=len(LEAPS),
        full=len(LEAPS),
    ),
)
"""Extremes of time."""
