"""Returns that cannot be, that lie apart from others, whose ranges scatter, or that bear no watermark."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial import cKDTree

from geoscene.typing import Bools, Float
from lidar.parameters import parameter
from lidar.sensors.physics.detector import signal_sigma
from lidar.sensors.physics.link import apparent_of_code
from lidar.tools.defences.defence import Defence, Gaps, Verdict, Window, greatest, of_returns
from lidar.tools.defences.observation import Observation
from lidar.tools.integrity.keys import read_secret
from lidar.tools.integrity.tampering import NOISE, FrameVerdict, frame_verdict
from lidar.tools.integrity.watermark import STEP, WatermarkCells
from lidar.tools.integrity.watermark import WatermarkKey as Mark

_ON_STEP = 0.02
"""Steps by which a range that is a multiple of the range step may be off."""
_BY_CHANCE = 2 * _ON_STEP
"""Share of ranges without a step that are as near to one."""
_WEAK, _BRIGHT = 0.9, 0.2
"""Suspicions of returns that are weaker than the threshold, and brighter than a white target."""

_BINS = 24
_NEAREST, _FARTHEST = 1.0, 200.0  # metres, of the bins of range

_OF_MEDIAN = 1 / 0.6745
"""Standard deviation of a Gaussian over the median of its magnitude."""

_WINDOW = 9
"""Neighbours along a ring of which the median counts."""


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
                (frame.range < sensor.min_range - 1e-3).astype(float),
                (frame.range > sensor.max_range + 1e-3).astype(float),
                _WEAK * _off_quantum(frame),
                _WEAK * _too_weak(frame),
                _BRIGHT * (frame.apparent > self.brightness),
            ],
            axis=0,
        )
        return of_returns(frame, returns)


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
    code = frame.intensity + 0.5  # codes are rounded
    power = frame.power(apparent_of_code(code, diffuse_code=frame.sensor.diffuse_code), frame.range)
    weak: Bools = power < 0.98
    # Without a threshold there are about as many returns just under it as just over it.
    under, over = (((power >= low) & (power < 2 * low)).sum() for low in (0.49, 0.98))
    return weak if over > 20 * under else np.zeros(len(frame), bool)


@dataclass(frozen=True)
class StatisticalDefence(Defence):
    """Returns farther from their neighbours than others at their range are (Charron et al. 2018)."""

    neighbours: int = parameter(6, "nearest returns of which the mean distance counts", low=1, high=50)
    half: float = parameter(6.0, "ratio to the median at that range that has suspicion 0.5", low=1, high=100)

    def judge(self, window: Window) -> Verdict:
        """Judge the returns of the last frame."""
        frame = window.frame
        n = len(frame)
        if n <= self.neighbours:
            return Verdict(np.zeros(n), np.zeros(len(frame.objects)), 0.0)
        away, _ = cKDTree(frame.xyz).query(frame.xyz, k=self.neighbours + 1)
        ratio = away[:, 1:].mean(axis=1) / _typical(away[:, 1:].mean(axis=1), frame.distance)
        excess = np.maximum(ratio - 1, 0)
        returns = excess / (excess + self.half - 1 + 1e-9)
        return of_returns(frame, returns)


def _typical(spacing: Float, distance: Float) -> Float:
    """Median spacing (n,) of returns at about the same range."""
    edges = np.geomspace(_NEAREST, _FARTHEST, _BINS + 1)
    rows = np.clip(np.searchsorted(edges, distance) - 1, 0, _BINS - 1)
    median = np.array(
        [np.median(spacing[rows == k]) if (rows == k).sum() > 20 else np.nan for k in range(_BINS)]
    )
    known = np.flatnonzero(np.isfinite(median))
    if not len(known):
        return np.full(len(spacing), max(float(np.median(spacing)), 1e-3))
    filled: Float = np.interp(np.arange(_BINS), known, median[known])
    return np.maximum(filled[rows], 1e-3)


@dataclass(frozen=True)
class Timing(Defence):
    """Ranges that scatter more than the scanner's noise, which fires its pulses at random times."""

    needs: ClassVar[frozenset[str]] = frozenset({"firing_jitter"})

    half: float = parameter(8.0, "scatter over the range noise that has suspicion 0.5", low=1, high=1e4)
    fewest: int = parameter(8, "returns of an object that are judged", low=1, high=1000)

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
        return _half_at(_OF_MEDIAN * off, self.half)


def _noise(frame: Observation) -> Float:
    """Standard deviation (n,) in metres of ranges, by the data sheet and the power that intensities imply."""
    sensor = frame.sensor
    power = frame.power(frame.apparent, frame.range)
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


@dataclass(frozen=True)
class WatermarkDefence(Defence):
    """Returns without the watermark that was embedded with a key (Changalvala and Malik 2019)."""

    needs: ClassVar[frozenset[str]] = frozenset({"watermark"})

    key: str = parameter("", "file with the key")
    step: float = parameter(STEP, "step with which it was embedded", unit="m", low=1e-4, high=1)
    noise: float = parameter(NOISE, "standard deviation of noise since", unit="m", low=0, high=1)
    false_alarms: float = parameter(
        0.01, "blocks a cloud above suspicion 0.5 without tampering", low=1e-9, high=100
    )

    def __post_init__(self) -> None:
        """Validate the parameters; the key must be readable."""
        super().__post_init__()
        if self.key:
            read_secret(Path(self.key))

    @property
    def lacks(self) -> str:
        """The key, if it was not given."""
        return "" if self.key else "needs the key of the watermark: watermark:key=FILE"

    def judge(self, window: Window) -> Verdict:
        """Judge the returns of the last frame; the frame by its block with most wrong bits for its size."""
        frame = window.frame
        cells = WatermarkCells(frame.sensor.name, frame.number, frame.ring, frame.column, frame.echo)
        mark = Mark(read_secret(Path(self.key)), self.step)
        found = frame_verdict(mark, frame.xyz, cells=cells, noise=self.noise, false_alarms=self.false_alarms)
        returns = np.where(found.forged, np.maximum(found.suspicion, 0.5), np.minimum(found.suspicion, 0.5))
        ratio = (found.blocks.wrong / found.blocks.least).max(initial=0.0)
        return replace(of_returns(frame, returns), frame=float(ratio / (1 + ratio)), gaps=_gaps(found))


def _gaps(found: FrameVerdict) -> Gaps:
    """The places of removed returns."""
    gone = [place for place in found.places if place.kind == "removed"]
    low = np.array([place.low[:2] for place in gone]).reshape(-1, 2)
    high = np.array([place.high[:2] for place in gone]).reshape(-1, 2)
    return Gaps((low + high) / 2, np.linalg.norm(high - low, axis=1) / 2, np.ones(len(gone)))
