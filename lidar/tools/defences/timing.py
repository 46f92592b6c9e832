"""Returns whose ranges scatter, as those of prepared pulses do where the scanner fires at random times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.sensors.physics.intensity import apparent_of_code
from lidar.sensors.physics.link import amplitude
from lidar.sensors.physics.range_error import signal_sigma
from lidar.tools.defences.defence import Defence, Window
from lidar.tools.defences.observation import Observation
from lidar.tools.defences.verdict import Verdict, greatest

_OF_MEDIAN = 1 / 0.6745
"""Standard deviation of a Gaussian over the median of its magnitude."""

_WINDOW = 9
"""Neighbours along a ring of which the median counts."""


@dataclass(frozen=True)
class Timing(Defence):
    """Ranges that scatter more than the scanner's noise, which fires its pulses at random times."""

    half: float = parameter(8.0, "scatter over the range noise that has suspicion 0.5", low=1, high=1e4)
    fewest: int = parameter(8, "returns of an object that are judged", low=1, high=1000)

    needs = frozenset({"firing_jitter"})

    def judge(self, window: Window) -> Verdict:
        """Judge the returns and objects of the last frame."""
        frame = window.frame
        noise = _noise(frame)
        returns, objects = np.zeros(len(frame)), np.zeros(len(frame.objects))
        rows, off = _off_neighbours(frame, np.arange(len(frame)), noise=noise)
        returns[rows] = self._suspicion(median_filter(off, _WINDOW, mode="nearest"))
        for k, members in enumerate(frame.members):
            _, off = _off_neighbours(frame, members, noise=noise)
            if len(off) >= self.fewest:
                objects[k] = self._suspicion(np.median(off, keepdims=True))[0]
        return Verdict(returns, objects, greatest(objects))

    def _suspicion(self, off: Float) -> Float:
        scatter = _OF_MEDIAN * off
        squared: Float = scatter**2 / (scatter**2 + self.half**2)
        return squared


def _noise(frame: Observation) -> Float:
    """Standard deviation (n,) in metres of ranges, by the data sheet and the power that intensities imply."""
    sensor = frame.sensor
    power = amplitude(
        apparent_of_code(frame.intensity, diffuse_code=sensor.diffuse_code),
        frame.range,
        reference_reflectance=sensor.reference_reflectance,
        reference_range=sensor.reference_range,
        falloff=sensor.falloff,
    )
    sigma: Float = np.hypot(sensor.range_sigma, signal_sigma(np.maximum(power, 1.0), sensor.weak_sigma))
    return np.maximum(sigma, sensor.range_quantum)


def _off_neighbours(
    frame: Observation, rows: NDArray[np.intp], *, noise: Float
) -> tuple[NDArray[np.intp], Float]:
    """Rows (k,) between two others of their ring, and how far their ranges are off the line between these.

    In standard deviations of what noise alone gives.
    """
    pulse = frame.ring[rows] * (frame.column.max(initial=0) + 1) + frame.column[rows]
    rows = rows[np.unique(pulse, return_index=True)[1]]
    left, middle, right = rows[:-2], rows[1:-1], rows[2:]
    width = frame.column[right] - frame.column[left]
    inside = (frame.ring[left] == frame.ring[right]) & (width > 0)
    left, middle, right, width = left[inside], middle[inside], right[inside], width[inside]
    share = (frame.column[middle] - frame.column[left]) / width
    off = np.abs(frame.range[middle] - (1 - share) * frame.range[left] - share * frame.range[right])
    sigma = np.sqrt(noise[middle] ** 2 + ((1 - share) * noise[left]) ** 2 + (share * noise[right]) ** 2)
    return middle, off / sigma
