"""Rates with confidence intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

_Z = 1.959964
"""Standard normal deviate of a two-sided interval of 95 %."""


@dataclass(frozen=True, slots=True)
class Rate:
    """A share with its 95 % interval; nan without trials.

    hits, count : of the trials
    blocks      : independent ones among them
    """

    hits: int
    count: int
    blocks: int
    share: float
    low: float
    high: float

    def to_text(self) -> str:
        """As ``83 % (66 to 93 %)``; a dash without trials."""
        if not self.count:
            return "–"
        return f"{100 * self.share:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f} %)"


def rate(hits: int, count: int, *, blocks: int) -> Rate:
    """A share with Wilson's interval.

    Frames that follow each other are no independent trials: the interval is that of ``blocks`` trials with
    the same share.
    """
    if not count:
        return Rate(0, 0, 0, math.nan, math.nan, math.nan)
    trials, share = min(max(blocks, 1), count), hits / count
    centre = (share + _Z**2 / (2 * trials)) / (1 + _Z**2 / trials)
    half = _Z * math.sqrt(share * (1 - share) / trials + _Z**2 / (4 * trials**2)) / (1 + _Z**2 / trials)
    return Rate(hits, count, trials, share, max(centre - half, 0.0), min(centre + half, 1.0))
