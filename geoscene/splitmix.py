"""SplitMix64: random bits that are a function of a counter (Steele, Lea and Flood 2014)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GOLDEN = np.uint64(0x9E3779B97F4A7C15)
"""Increment of the counter: 2^64 over the golden ratio, odd."""


def mix(counter: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """64 random bits for each counter, modulo 2^64: the finaliser of SplitMix64."""
    counter = (counter ^ (counter >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    counter = (counter ^ (counter >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return counter ^ (counter >> np.uint64(31))
