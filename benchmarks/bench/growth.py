"""Growth of time and memory with the size of the work: exponents of power laws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats


@dataclass(frozen=True, slots=True)
class Exponent:
    """The exponent b of y = a x^b, its standard error and 95 % interval, which are NaN for two points."""

    value: float
    error: float
    low: float
    high: float
    factor: float

    def at(self, x: float) -> float:
        """The fitted value at x."""
        return float(self.factor * x**self.value)


@dataclass(frozen=True, slots=True)
class Curve:
    """A cost against a size.

    name  : what grows
    size  : unit of ``x``
    cost  : unit of ``y``: CPU s, wall s or bytes
    x, y  : (n,) of all repetitions
    note  : what was measured
    """

    name: str
    size: str
    cost: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    note: str = ""

    @property
    def exponent(self) -> Exponent | None:
        """Through the medians of at least three sizes with a cost, or through all costs of two sizes.

        None for fewer sizes. Repetitions of one size say nothing about how straight the line is.
        """
        points = list(zip(self.x, self.y, strict=True))
        if len(set(self.x)) > 2:
            points = [(x, y) for x, y in self.medians() if y > 0]
            if len(points) < 3:
                return None
        return exponent(*zip(*points, strict=True))

    @property
    def last_exponent(self) -> float | None:
        """Between the two greatest sizes, where fixed costs count least; None without two or without cost."""
        (x0, y0), (x1, y1) = ((0.0, 0.0), *self.medians())[-2:]
        return math.log(y1 / y0) / math.log(x1 / x0) if x0 and y0 > 0 and y1 > 0 else None

    def medians(self) -> list[tuple[float, float]]:
        """Each size and the median of its costs."""
        y = np.asarray(self.y)
        return [(x, float(np.median(y[np.asarray(self.x) == x]))) for x in sorted(set(self.x))]


def exponent(x: Sequence[float], y: Sequence[float]) -> Exponent | None:
    """Least-squares line through (log x, log y); None if a value is not positive or all x are equal."""
    if min(y, default=0.0) <= 0 or min(x) <= 0 or len(set(x)) < 2:
        return None
    u, v = np.log(np.asarray(x, float)), np.log(np.asarray(y, float))
    line = stats.linregress(u, v)
    free = len(u) - 2
    error = float(line.stderr) if free else math.nan
    b, half = float(line.slope), float(stats.t.ppf(0.975, free)) * error if free else math.nan
    return Exponent(b, error, b - half, b + half, float(np.exp(line.intercept)))
