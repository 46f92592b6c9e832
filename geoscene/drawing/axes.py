"""Axes of charts: their ends, their ticks, and where values lie along them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

_STEPS = (1, 2, 5)
_POWERS = range(-12, 16)
_SHORT = 4
"""Ratio of the ends of a logarithmic axis below which its ticks are those of a linear one."""


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis from ``low`` to ``high``, linear or logarithmic; ``low`` is positive on a logarithmic one.

    step : between the ticks of a linear one; 0 for one that fits
    """

    low: float
    high: float
    log: bool = False
    step: float = 0.0

    def share(self, value: float) -> float:
        """Where a value lies, from 0 (low) to 1 (high); values beyond the ends are moved to them."""
        low, high, value = self.low, self.high, min(max(value, self.low), self.high)
        if self.log:
            low, high, value = map(math.log10, (low, high, value))
        return (value - low) / (high - low)

    def ticks(self, parts: int = 5) -> list[float]:
        """Values to mark: multiples of 1, 2 or 5 times a power of ten; on a long logarithmic axis powers.

        parts : of a linear axis between ticks, at most
        """
        if not self.log or self.high / self.low < _SHORT:
            step = self.step or _step((self.high - self.low) / parts)
            first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
            return [float(f"{k * step:.12g}") for k in range(first, last + 1)]
        steps = _STEPS if self.high / self.low <= 100 else (1,)
        every = (m * 10.0**k for k in _POWERS for m in steps)
        return [v for v in every if self.low * (1 - 1e-9) <= v <= self.high * (1 + 1e-9)]


def log_axis(values: Iterable[float]) -> Axis:
    """The logarithmic axis between 1, 2 or 5 times powers of ten around the positive ones of some values."""
    known = [v for v in values if v > 0] or [1.0]
    marks = [m * 10.0**k for k in _POWERS for m in _STEPS]
    low = max((m for m in marks if m <= min(known)), default=marks[0])
    high = min((m for m in marks if m >= max(known) and m > low), default=marks[-1])
    return Axis(low, high, log=True)


def linear_axis(values: Iterable[float], *, parts: int = 5) -> Axis:
    """The linear axis between ticks around some values and 0, with about ``parts`` between ticks."""
    known = [0.0, *values]
    low, high = min(known), max(known)
    step = _step((high - low) / parts or 1 / parts)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return Axis(first * step, max(last, first + 1) * step, step=step)


def _step(length: float) -> float:
    """The least of 1, 2 and 5 times a power of ten that is not below a length."""
    return min(m * 10.0**k for k in _POWERS for m in _STEPS if m * 10.0**k >= length * (1 - 1e-9))
