"""Blocks of a cloud, a ring by 10 degrees, and the number of wrong bits from which one is tampered with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float, Ints

SECTORS = 36
"""Sectors of a turn, 10 degrees each."""


def sectors(xyz: NDArray[np.floating]) -> Ints:
    """Sector (n,) of points in the sensor frame, from 0 at -180 degrees, to the left."""
    turn = np.arctan2(xyz[:, 1].astype(np.float64), xyz[:, 0].astype(np.float64)) / (2 * np.pi) + 0.5
    return np.minimum((turn * SECTORS).astype(np.int64), SECTORS - 1)


def block_of(xyz: NDArray[np.floating], ring: NDArray[np.integer]) -> Ints:
    """Block (n,) of points in the sensor frame: ring times `SECTORS` plus sector."""
    return ring.astype(np.int64) * SECTORS + sectors(xyz)


@dataclass(frozen=True)
class BlockTest:
    """Which blocks of a frame have more wrong bits than noise explains.

    block  : (b,) number, see `block_of`
    bits   : (b,) bits in it
    wrong  : (b,) wrong ones, or of coordinates off the lattice
    least  : (b,) wrong bits from which a block is tampered with
    chance : (b,) probability that noise alone makes as many: the block's false-alarm rate
    """

    block: Ints
    bits: Ints
    wrong: Ints
    least: Ints
    chance: Float

    @property
    def tampered(self) -> Ints:
        """The blocks (k,) with at least as many wrong bits."""
        return self.block[self.wrong >= self.least]


def block_test(block: Ints, wrong: NDArray[np.bool_], *, error_rate: float, false_alarms: float) -> BlockTest:
    """The test of a frame's blocks.

    block        : (n,) of each return
    wrong        : (n, k) bits that count as wrong, k of each return
    error_rate   : share of bits that noise makes wrong
    false_alarms : blocks a frame that may be reported without tampering, on average at most
    """
    numbers, row = np.unique(block, return_inverse=True)
    bits = wrong.shape[1] * np.bincount(row, minlength=len(numbers))
    count = np.bincount(row, weights=wrong.sum(axis=1), minlength=len(numbers)).astype(np.int64)
    least, chance = _thresholds(bits, error_rate=error_rate, chance=false_alarms / max(len(numbers), 1))
    return BlockTest(numbers, bits, count, least, chance)


def _thresholds(bits: Ints, *, error_rate: float, chance: float) -> tuple[Ints, Float]:
    """Least number of wrong bits that noise exceeds with at most a probability, and that probability."""
    from scipy.special import bdtrc  # noqa: PLC0415  (0.2 s)

    sizes, row = np.unique(bits, return_inverse=True)
    least, found = np.zeros(len(sizes), np.int64), np.ones(len(sizes))
    pending = np.ones(len(sizes), bool)
    k = 0
    while pending.any():
        k += 1
        tail = np.where(k <= sizes, bdtrc(k - 1, np.maximum(sizes, k), error_rate), 0.0)
        done = pending & (tail <= chance)
        least[done], found[done] = k, tail[done]
        pending &= ~done
    return least[row], found[row]
