"""How a scanner distinguishes its own pulses from others: random delays and pulse codes."""

from __future__ import annotations

import numpy as np

from geoscene.typing import Bools, Float
from lidar.sensors.rig.scanner import Sensor

METRES_PER_NS = 0.299792458 / 2
"""Range per nanosecond of delay."""


def shift_by_delay(sensor: Sensor, count: int, *, rng: np.random.Generator) -> Float:
    """Metres (count,) by which prepared pulses seem off, as the sensor fires its own at random times.

    Uniform over c J / 2 of the sensor's greatest delay J, around 0: the mean delay is known to all.
    """
    if not sensor.firing_jitter_ns:
        return np.zeros(count)
    return METRES_PER_NS * sensor.firing_jitter_ns * rng.uniform(-0.5, 0.5, count)


def has_code(sensor: Sensor, count: int, *, rng: np.random.Generator) -> Bools:
    """Mask (count,) of pulses from elsewhere that have the code of the sensor's pulse by chance."""
    if not sensor.code_bits:
        return np.ones(count, bool)
    return rng.random(count) < 0.5**sensor.code_bits
