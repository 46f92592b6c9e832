"""SplitMix64: random numbers that are a function of a counter (Steele, Lea and Flood 2014)."""

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


def uniform_at(
    column: NDArray[np.int64], row: NDArray[np.int64], *, count: int, seed: int = 0
) -> NDArray[np.float64]:
    """Uniform random numbers (count, n) in [0, 1) determined by (seed, column, row) of squares (n,)."""
    with np.errstate(over="ignore"):
        state = mix(column.astype(np.uint64) + GOLDEN * np.uint64(seed + 1))
        state = mix(state ^ (row.astype(np.uint64) * GOLDEN))
        draws = [mix(state + GOLDEN * np.uint64(k + 1)) >> np.uint64(11) for k in range(count)]
    return np.stack(draws) * 2.0**-53


def number_of(osm_id: str) -> int:
    """The number of an OSM id, by which guesses are drawn."""
    digits = "".join(c for c in osm_id if c.isdigit())
    return int(digits[-18:] or 0)
