"""Returns that the scanner cannot have measured: off its rays, too many a pulse, too weak, at wrong times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Bools, Float
from lidar.parameters import parameter
from lidar.sensors.physics.intensity import apparent_of_code
from lidar.sensors.physics.link import amplitude
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import FEW, Verdict, greatest

_ON_STEP = 0.02
"""Steps by which a range that is a multiple of the range step may be off."""
_BY_CHANCE = 2 * _ON_STEP
"""Share of ranges without a step that are as near to one."""
_WEAK, _BRIGHT = 0.9, 0.2
"""Suspicions of returns that are weaker than the threshold, and brighter than a white target."""


@dataclass(frozen=True)
class Physics(Defence):
    """Returns off the ray grid, at wrong times, too many a pulse, or of a power that cannot be."""

    angle: float = parameter(
        0.02, "deviation from the ray that has suspicion 0.5", unit="degrees", low=1e-4, high=10
    )
    length: float = parameter(0.01, "difference of range and coordinates that has suspicion 0.5", unit="m",
                              low=1e-4, high=10)  # fmt: skip
    brightness: float = parameter(1.5, "power over that of a white Lambertian target which is unusual", low=1)

    def judge(self, window: Window) -> Verdict:
        """Judge the returns of the last frame."""
        frame = window.frame
        fired, sensor = frame.firings, frame.sensor
        known, pulse = frame.pulse >= 0, np.maximum(frame.pulse, 0)
        away = frame.xyz - fired.origin[pulse]
        along = np.einsum("ij,ij->i", away, fired.direction[pulse])
        across = np.linalg.norm(away - along[:, None] * fired.direction[pulse], axis=1)
        # Coordinates are float32, of which the last digit is 6e-8 of the greatest.
        angle = np.maximum(across - 1e-6 * np.abs(along), 0) / np.maximum(along, 1e-3)
        length = np.abs(along + sensor.pattern.range_offset - frame.range)
        late = np.abs(frame.time_ns - fired.time_ns[pulse])
        returns = np.max(
            [
                _half_at(angle, np.radians(self.angle)),
                _half_at(np.maximum(length - 2e-6 * np.abs(along), 0), self.length),
                _half_at(late.astype(float), 1000.0),
                (~known).astype(float),
                (~np.isfinite(along)).astype(float),
                _surplus(frame, pulse).astype(float),
                ((frame.range < sensor.min_range - 1e-3) | (frame.range > sensor.max_range + 1e-3)).astype(
                    float
                ),
                _WEAK * _off_quantum(frame),
                _WEAK * _too_weak(frame),
                _BRIGHT
                * (apparent_of_code(frame.intensity, diffuse_code=sensor.diffuse_code) > self.brightness),
            ],
            axis=0,
        )
        objects = np.array([returns[rows].mean() if len(rows) else 0.0 for rows in frame.members])
        return Verdict(returns, objects, greatest(returns, count=FEW))


def _half_at(value: Float, half: float) -> Float:
    """Suspicion of a deviation: 0 for none, 1/2 at ``half``."""
    squared: Float = value * value / (value * value + half * half)
    return squared


def _surplus(frame: Observation, pulse: NDArray[np.intp]) -> Bools:
    """Returns with the same pulse and echo number as another, or of more echoes than the scanner reports."""
    most = 1 if frame.sensor.return_mode in ("strongest", "first", "last") else frame.sensor.max_echoes
    if frame.sensor.return_mode == "dual":
        most = 2
    count = np.bincount(pulse, minlength=len(frame.firings))
    key = pulse * 256 + np.clip(frame.echo, 0, 255)
    _, same, number = np.unique(key, return_inverse=True, return_counts=True)
    return (count[pulse] > most) | (number[same] > 1)


def _off_quantum(frame: Observation) -> Bools:
    """Returns whose range is no multiple of the range step, where far more are than by chance."""
    step = frame.sensor.range_quantum
    none = np.zeros(len(frame), bool)
    if not step or not len(frame):
        return none
    steps = frame.range / step
    off: Bools = np.abs(steps - np.round(steps)) > _ON_STEP + 1e-7 * steps
    return off if 1 - off.mean() > 5 * _BY_CHANCE else none


def _too_weak(frame: Observation) -> Bools:
    """Returns with a power below the detection threshold, if the frame has such a threshold."""
    sensor = frame.sensor
    apparent = apparent_of_code(frame.intensity + 0.5, diffuse_code=sensor.diffuse_code)  # codes are rounded
    power = amplitude(
        apparent,
        frame.range,
        reference_reflectance=sensor.reference_reflectance,
        reference_range=sensor.reference_range,
        falloff=sensor.falloff,
    )
    weak: Bools = power < 0.98
    # Without a threshold there are about as many returns just under it as just over it.
    under, over = (((power >= low) & (power < 2 * low)).sum() for low in (0.49, 0.98))
    return weak if over > 20 * under else np.zeros(len(frame), bool)
