"""Errors of poses: absolute, relative, and KITTI's over segments; and their intervals by a bootstrap."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.random_streams import generator
from lidar.tools.evaluation.trajectories import PosePairs

RESAMPLES = 1000
FEWEST = 5
"""Blocks in a series, below which no interval is stated."""

_WINDOW = 5.0
"""Correlation times up to which correlations are summed (Sokal 1997)."""

_AT_ONCE = 1_000_000
"""Errors of series that are drawn at a time: 8 MB."""

_ENDS = (2.5, 97.5)
KITTI_LENGTHS = tuple(range(100, 900, 100))
"""Metres of the segments of KITTI's odometry benchmark."""

SHORT_LENGTHS = tuple(range(10, 90, 10))
"""Metres of segments of ways too short for it."""

KITTI_STEP = 10
"""Poses from the start of a segment to that of the next in KITTI's benchmark; 1 for short segments."""

_TOLERANCE = 0.1
"""Share by which the length of a pair of poses may differ from the one that is asked for."""


@dataclass(frozen=True, slots=True)
class Value:
    """A figure with its 95 % interval; None for too few samples."""

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The interval."""
        return None if self.low is None or self.high is None else (self.low, self.high)


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of errors of one unit; of the greatest error no interval can be had by resampling.

    count  : errors
    blocks : of the bootstrap, as many as fit in the series
    """

    rmse: Value
    mean: Value
    median: Value
    max: float
    count: int
    blocks: int


def correlation_time(values: Float) -> float:
    """Integrated autocorrelation time of a series (n,), in samples; 1 for independent ones."""
    n = len(values)
    away = values - values.mean()
    power = float(away @ away)
    if n < 3 or power <= 1e-24 * max(float(values @ values), 1e-300):
        return 1.0
    spectrum = np.abs(np.fft.rfft(away, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[:n] / power
    times = 2 * np.cumsum(correlation) - 1
    inside = np.flatnonzero(np.arange(n) >= _WINDOW * times)
    return float(max(times[inside[0] if len(inside) else n - 1], 1.0))


def block_length(values: Float, *, least: int = 1) -> int:
    """Samples of a block: twice the correlation time, the cube root of the series' length, or ``least``."""
    long: int = max(math.ceil(2 * correlation_time(values)), math.ceil(len(values) ** (1 / 3)), least, 1)
    return int(min(long, len(values)))


def statistics(errors: Float, *, least: int = 1, seed: int = 0) -> Statistics:
    """Statistics of a series of errors (n,) in order, with percentile intervals of moving blocks.

    least : samples that share data, such as those of overlapping segments: blocks are no shorter

    Künsch (Annals of Statistics 17, 1989). With fewer than `FEWEST` blocks there are no intervals.
    """
    n = len(errors)
    plain = [float(np.sqrt((errors**2).mean())), float(errors.mean()), float(np.median(errors))]
    size = block_length(errors, least=least)
    blocks = n // size
    if blocks < FEWEST:
        values = [Value(v) for v in plain]
    else:
        drawn = _resample(errors, size=size, seed=seed)
        low, high = np.percentile(drawn, _ENDS, axis=0)
        values = [Value(v, float(a), float(b)) for v, a, b in zip(plain, low, high, strict=True)]
    rmse, mean, median = values
    return Statistics(rmse, mean, median, float(errors.max()), n, blocks)


def _resample(errors: Float, *, size: int, seed: int) -> Float:
    """Root mean square, mean and median (`RESAMPLES`, 3) of series of blocks drawn with replacement."""
    rng, n = generator(seed, "blocks", len(errors)), len(errors)
    first = rng.integers(0, n - size + 1, (RESAMPLES, -(-n // size)))
    inside = np.arange(size)
    found = np.empty((RESAMPLES, 3))
    at_once = max(_AT_ONCE // n, 1)
    for k in range(0, RESAMPLES, at_once):
        rows = (first[k : k + at_once, :, None] + inside).reshape(-1, first.shape[1] * size)[:, :n]
        series = errors[rows]
        columns = np.sqrt(np.mean(series**2, axis=1)), series.mean(axis=1), np.median(series, axis=1)
        found[k : k + at_once] = np.stack(columns, axis=1)
    return found


@dataclass(frozen=True, slots=True)
class Relative(Columns):
    """Errors of motion between pairs of poses.

    first, last : (k,) rows of the poses
    shift       : (k,) metres, length of the error's translation
    turn        : (k,) radians of its rotation
    """

    first: Ints
    last: Ints
    shift: Float
    turn: Float


@dataclass(frozen=True, slots=True)
class Segments(Columns):
    """Errors of KITTI's benchmark, a row a segment.

    first    : (k,) row of its first pose
    length   : (k,) metres
    shift    : (k,) share of the length, error of the translation
    turn     : (k,) radians per metre
    speed    : (k,) m/s; NaN without times
    """

    first: Ints
    length: Float
    shift: Float
    turn: Float
    speed: Float


def angles(rotation: Float) -> Float:
    """Angles (n,) of rotations (n, 3, 3), radians."""
    quat = quat_from_matrix(rotation)
    return np.asarray(2 * np.arctan2(np.linalg.norm(quat[:, :3], axis=1), np.abs(quat[:, 3])), float)


def absolute(pairs: PosePairs) -> tuple[Float, Float]:
    """Distances (n,) in metres and angles (n,) in radians between the poses of each pair."""
    off = pairs.estimate.position - pairs.truth.position
    turn = pairs.truth.rotation.swapaxes(1, 2) @ pairs.estimate.rotation
    return np.linalg.norm(off, axis=1), angles(turn)


def by_axis(pairs: PosePairs) -> tuple[Float, Float]:
    """Errors (n, 3) forward, left and up, metres, and roll, pitch and yaw (n, 3), radians, in true axes."""
    back = pairs.truth.rotation.swapaxes(1, 2)
    off = np.einsum("nij,nj->ni", back, pairs.estimate.position - pairs.truth.position)
    turn = back @ pairs.estimate.rotation
    roll = np.arctan2(turn[:, 2, 1], turn[:, 2, 2])
    pitch = np.arcsin(np.clip(-turn[:, 2, 0], -1, 1))
    yaw = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    return off, np.column_stack([roll, pitch, yaw])


def over_frames(pairs: PosePairs, count: int) -> Relative:
    """Relative errors of all pairs of poses that are a number of poses apart (Sturm et al. 2012)."""
    first = np.arange(max(len(pairs) - count, 0))
    return _relative(pairs, first=first, last=first + count)


def over_metres(pairs: PosePairs, length: float) -> Relative:
    """Relative errors from each pose to that whose true way from it is nearest to a length.

    Pairs whose way differs by more than a tenth of the length are left out.
    """
    way = pairs.truth.distance()
    first = np.arange(len(way) - 1)
    after = np.searchsorted(way, way[first] + length)
    before = np.searchsorted(way, way[np.maximum(after - 1, 0)])  # of poses at rest the first
    ends = np.stack([np.clip(row, first + 1, len(way) - 1) for row in (before, after)])
    off = np.abs(way[ends] - way[first] - length)
    best = off.argmin(axis=0)
    last, off = ends[best, first], off[best, first]
    good = off <= _TOLERANCE * length
    return _relative(pairs, first=first[good], last=last[good])


def _relative(pairs: PosePairs, *, first: Ints, last: Ints) -> Relative:
    """Errors of the motion between rows of pairs."""
    true = _motion(pairs.truth.position, pairs.truth.rotation, first=first, last=last)
    found = _motion(pairs.estimate.position, pairs.estimate.rotation, first=first, last=last)
    off = np.linalg.norm(found[0] - true[0], axis=1)
    return Relative(first, last, off, angles(true[1].swapaxes(1, 2) @ found[1]))


def _motion(position: Float, rotation: Float, *, first: Ints, last: Ints) -> tuple[Float, Float]:
    """Translations (k, 3) and rotations (k, 3, 3) from poses to others, in the frames of the first."""
    back = rotation[first].swapaxes(1, 2)
    return np.einsum("nij,nj->ni", back, position[last] - position[first]), back @ rotation[last]


def lengths_for(way: float) -> tuple[int, ...]:
    """Lengths of segments for a way: those of KITTI that fit if two do, else the short ones that fit."""
    kitti = tuple(length for length in KITTI_LENGTHS if length < way)
    return kitti if len(kitti) > 1 else tuple(length for length in SHORT_LENGTHS if length < way)


def segments(pairs: PosePairs, lengths: tuple[int, ...]) -> Segments:
    """Errors of segments of the true way, as KITTI's development kit computes them (Geiger et al. 2012).

    A segment ends at the first pose whose way is longer than its length; errors are per metre of it. Speeds
    are those of the true way.
    """
    way, n = pairs.truth.distance(), len(pairs)
    step = KITTI_STEP if lengths[:1] and lengths[0] >= KITTI_LENGTHS[0] else 1
    starts = np.arange(0, n, step)
    parts = []
    for length in lengths:
        last = np.searchsorted(way, way[starts] + length, side="right")
        first, last = starts[last < n], last[last < n]
        found = _relative(pairs, first=first, last=last)
        lasted = (pairs.truth.time_ns[last] - pairs.truth.time_ns[first]) * 1e-9
        speed = length / lasted if pairs.truth.timed else np.full(len(first), np.nan)
        size = np.full(len(first), float(length))
        parts.append(Segments(first, size, found.shift / length, found.turn / length, speed))
    if not parts:
        return Segments(np.empty(0, np.int64), *(np.empty(0),) * 4)
    joined = Segments.concatenate(parts)
    return joined.take(np.lexsort((joined.length, joined.first)))
