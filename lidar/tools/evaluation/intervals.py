"""Intervals of statistics of correlated samples, by a bootstrap of blocks longer than they correlate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float
from lidar.geometry.random_streams import generator

RESAMPLES = 1000
FEWEST = 5
"""Blocks in a series, below which no interval is stated."""

_WINDOW = 5.0
"""Correlation times up to which correlations are summed (Sokal 1997)."""

_ENDS = (2.5, 97.5)


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
    count = -(-n // size)
    inside = np.arange(size)
    found = np.empty((RESAMPLES, 3))
    for k in range(RESAMPLES):
        first = rng.integers(0, n - size + 1, count)
        series = errors[(first[:, None] + inside).ravel()[:n]]
        found[k] = np.sqrt(np.mean(series**2)), series.mean(), np.median(series)
    return found
