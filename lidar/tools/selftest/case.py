"""A case of the selftest: measurement, numbers of samples, and bound."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass

import numpy as np

BATCH = 500_000
"""Rays or samples that are held at a time."""


@dataclass(frozen=True, slots=True)
class ExtremeCase:
    """A row of the table of extremes.

    name    : the case in words
    measure : the largest value found in a number of samples; the same number gives the same value
    limit   : what limits the case
    group   : rays, pulses, places, footprints, time, statistics or scale
    bound   : the largest value that may be measured
    unit    : of bound and measurement; what is counted if the bound is 0
    of      : what the samples are
    quick, full : numbers of samples of a quick and of a full run
    """

    name: str
    measure: Callable[[int], float]
    limit: str = ""
    _: KW_ONLY
    group: str
    bound: float = 0
    unit: str
    of: str
    quick: int
    full: int


def batches(count: int) -> Iterator[tuple[int, int]]:
    """Number and size of each batch of ``count`` samples."""
    for k, start in enumerate(range(0, count, BATCH)):
        yield k, min(BATCH, count - start)


def drawn_batches(count: int, *seed: int) -> Iterator[tuple[np.random.Generator, int]]:
    """Generator of random numbers and size of each batch of ``count`` samples."""
    for k, size in batches(count):
        yield np.random.default_rng([*seed, k]), size
