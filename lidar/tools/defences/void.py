"""Missing ground returns: hidden objects and removed returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.sensors.physics.intensity import apparent_of_code
from lidar.sensors.physics.link import amplitude
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Gaps, Verdict, greatest

_NEAREST, _BRIGHT = 3.0, 12.0
"""Metres from which on the ground is looked at, and up to which its brightness is measured."""
_CERTAIN = 1.7
"""Power over the threshold from which the ground is detected: four standard deviations of typical noise."""


@dataclass(frozen=True)
class Void(Defence):
    """Ground without returns that nothing nearer hides (Hau et al. 2022; fake shadows: Cao et al. 2023)."""

    sector: float = parameter(1.0, "azimuth of the cells of the ground", unit="degrees", low=0.2, high=10)
    least: float = parameter(1.8, "area of a void", unit="m^2", low=0, high=1000)
    reach: float = parameter(30.0, "distance up to which the ground is looked at", unit="m", low=5, high=100)
    half: float = parameter(6.0, "area of a void that has suspicion 0.5", unit="m^2", low=0.1, high=1000)

    def judge(self, window: Window) -> Verdict:
        """Judge the last frame."""
        frame = window.frame
        pulse, place, empty = ground_pulses(frame, reach=self.reach)
        if not len(pulse):
            return Verdict(None, None, 0.0)
        gaps = self._voids(frame.firings.ring[pulse].astype(np.int64), place, empty=empty)
        return Verdict(None, None, greatest(gaps.suspicion), gaps)

    def _voids(self, ring: NDArray[np.int64], place: Float, *, empty: NDArray[np.bool_]) -> Gaps:
        """Connected cells of ring and sector in which every pulse lacks its return.

        A cell is as long as the distance between the rings on the ground.
        """
        from scipy import ndimage  # noqa: PLC0415  (0.1 s)

        count = round(360 / self.sector)
        turn = np.degrees(np.arctan2(place[:, 1], place[:, 0])) + 180
        shape = int(ring.max()) + 1, count
        cell = ring * count + np.minimum((turn / 360 * count).astype(np.int64), count - 1)
        size = shape[0] * count
        fired = np.bincount(cell, minlength=size)
        lost = np.bincount(cell, weights=empty, minlength=size)
        void = ((fired > 0) & (lost == fired)).reshape(shape)
        away = np.hypot(*place.T)
        mean = np.bincount(ring, weights=away, minlength=shape[0]) / np.maximum(np.bincount(ring), 1)
        length = np.clip(np.abs(np.gradient(mean)) if shape[0] > 1 else np.ones(1), 0.1, 3.0)
        area = np.broadcast_to((length * mean * 2 * np.pi / count)[:, None], shape)
        total = np.stack([np.bincount(cell, weights=c, minlength=size) for c in place.T])
        middle: Float = (total / np.maximum(fired, 1)).reshape(2, *shape)
        label, most = ndimage.label(void, structure=np.ones((3, 3)))
        whole = ndimage.sum_labels(area, label, np.arange(1, most + 1))
        large = 1 + np.flatnonzero(whole >= self.least)
        center = np.array([ndimage.mean(axis, label, large) for axis in middle]).T.reshape(-1, 2)
        radius = [
            np.linalg.norm(middle[:, label == k].T - center[row], axis=1).max() for row, k in enumerate(large)
        ]
        whole = whole[large - 1]
        return Gaps(center, np.array(radius) + 0.5, whole / (whole + self.half))


def ground_pulses(frame: Observation, *, reach: float) -> tuple[NDArray[np.intp], Float, NDArray[np.bool_]]:
    """Pulses (k,), their ground points (k, 2), and whether they lack a return at the ground or before it.

    Pulses that a nearer return stops are left out: they tell nothing of the ground.
    """
    fired = frame.firings
    expected = frame.surface.hit(fired.direction, reach=reach)
    level = np.hypot(*fired.direction[:, :2].T)
    bright = _reflectance(frame)
    power = amplitude(
        bright * np.abs(fired.direction[:, 2]),
        expected,
        reference_reflectance=frame.sensor.reference_reflectance,
        reference_range=frame.sensor.reference_range,
        falloff=frame.sensor.falloff,
    )
    nearest = np.full(len(fired), np.inf)
    known = frame.pulse >= 0
    np.minimum.at(nearest, frame.pulse[known], frame.distance[known])
    near = np.flatnonzero((expected * level > _NEAREST) & np.isfinite(expected) & (power > _CERTAIN))
    room = 0.5 + 0.15 * expected[near]
    stopped = nearest[near] < expected[near] - room
    chosen, room = near[~stopped], room[~stopped]
    empty = nearest[chosen] > expected[chosen] + room
    return chosen, fired.direction[chosen, :2] * expected[chosen, None], empty


def _reflectance(frame: Observation) -> float:
    """Reflectance of the ground near the vehicle, from the intensity of its returns; 0.1 without."""
    rows = np.flatnonzero(frame.ground & (frame.distance < _BRIGHT))
    if len(rows) < 20:
        return 0.1
    code = apparent_of_code(frame.intensity[rows], diffuse_code=frame.sensor.diffuse_code)
    return float(np.median(code / np.maximum(np.abs(frame.direction[rows, 2]), 1e-3)))
