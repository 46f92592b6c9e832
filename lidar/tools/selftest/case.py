"""A case of the selftest: measurement, number of samples, and bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ExtremeCase:
    """A row of the table of extremes.

    group   : rays, places, footprints, time, statistics or scale
    name    : the case in words
    bound   : the largest value that may be measured
    unit    : of bound and measurement; what is counted if the bound is 0
    measure : the largest value found in a number of samples; the same number gives the same value
    of      : what the samples are
    quick, full : numbers of samples of a quick and of a full run
    limit   : what limits the case
    """

    group: str
    name: str
    bound: float
    unit: str
    measure: Callable[[int], float]
    of: str
    quick: int
    full: int
    limit: str
