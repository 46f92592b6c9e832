"""Measurements of GNSS receivers and inertial units, with the ground truth, and their typical errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float


@dataclass(frozen=True, slots=True)
class Errors:
    """Standard deviations of a receiver's errors along each horizontal axis, and up.

    white, bias, blocked : (horizontal, vertical) metres: of w, of b, and of m where the whole sky is blocked,
               see `lidar.sensors.navigation.gnss`
    tau      : seconds, correlation time of b
    speed    : m/s along each axis, white
    quality  : fix quality in NMEA sentences
    """

    white: tuple[float, float]
    bias: tuple[float, float]
    tau: float
    blocked: tuple[float, float]
    speed: float
    quality: int


STATES = {
    "none": Errors((np.nan, np.nan), (0.0, 0.0), 1.0, (0.0, 0.0), np.nan, 0),
    "single": Errors((0.3, 0.6), (1.5, 2.5), 600.0, (7.5, 15.0), 0.05, 1),
    "sbas": Errors((0.2, 0.4), (0.6, 1.0), 300.0, (7.5, 15.0), 0.05, 2),
    "float": Errors((0.05, 0.10), (0.25, 0.4), 200.0, (0.5, 1.0), 0.03, 5),
    "fixed": Errors((0.008, 0.015), (0.006, 0.010), 100.0, (0.02, 0.04), 0.02, 4),
    "ideal": Errors((0.0, 0.0), (0.0, 0.0), 1.0, (0.0, 0.0), 0.0, 1),
}
"""Typical magnitudes, not those of one product; ``blocked`` models street canyons."""
NAMES = tuple(STATES)


@dataclass(frozen=True, slots=True)
class Fixes(Columns):
    """Measurements of a receiver and ground truth, one row per epoch; measurements without a fix are NaN.

    time_ns   : (n,) int64, since the drive's start
    state     : (n,) int8, row of `NAMES`
    quality   : (n,) int8, as in NMEA: 0 none, 1 single, 2 differential, 4 fixed, 5 float
    satellites : (n,) int8, used
    dop       : (n, 3) dilution of precision, horizontal, vertical, in position
    lonlath   : (n, 3) degrees, degrees, metres, measured
    speed     : (n,) m/s over ground, measured
    course    : (n,) radians clockwise from true north, measured; held at standstill
    error     : (n, 3) metres east, north, up: measured minus true
    true_lonlath : (n, 3) of the antenna
    true_velocity : (n, 3) m/s true east, north, up, of the antenna
    used      : (n, k) bool, satellites used
    names     : (k,) of the satellites, such as G01
    """

    time_ns: NDArray[np.int64]
    state: NDArray[np.int8]
    quality: NDArray[np.int8]
    satellites: NDArray[np.int8]
    dop: Float
    lonlath: Float
    speed: Float
    course: Float
    error: Float
    true_lonlath: Float
    true_velocity: Float
    used: NDArray[np.bool_]
    names: NDArray[np.str_]

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns by name; the satellites' names hold for all rows."""
        return {name: column for name, column in Columns.columns(self).items() if name != "names"}


@dataclass(frozen=True, slots=True)
class Inertial(Columns):
    """Measurements of a unit and ground truth, in its own axes, one row per time.

    time_ns     : (n,) int64, since the drive's start
    gyro, accel : (n, 3) rad/s and m/s^2, measured
    true_gyro, true_accel : (n, 3) without noise and bias
    """

    time_ns: NDArray[np.int64]
    gyro: Float
    accel: Float
    true_gyro: Float
    true_accel: Float


def fix_variances(fixes: Fixes) -> Float:
    """Variances (n, 3), m^2 east, north, up, as a receiver states them: 0 without a fix.

    Those of the noise and of the slow error of the fix's state under an open sky, times the square of the
    dilution of precision where that exceeds 1. Multipath, of which a receiver does not know, is not in them.
    """
    states = [STATES[name] for name in NAMES]
    sizes = np.nan_to_num([np.hypot(state.white, state.bias) for state in states])[fixes.state]
    dop = np.nan_to_num(np.maximum(fixes.dop[:, :2], 1.0), nan=1.0)
    return np.asarray((sizes * dop)[:, [0, 0, 1]] ** 2, float)
