"""When and where a scanner fires in one frame, as columns; and the clock that numbers its firings."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Firings:
    """The pulses of one frame in the order they are fired. Arrays may be shared between frames: do not write.

    time_ns   : (n,) int64, nanoseconds since the drive's start
    direction : (n, 3) float64, unit vectors in the sensor frame (x forward, y left, z up) at the pulse's time
    origin    : (n, 3) float64, metres, where the beam starts in the sensor frame
    ring      : (n,) uint16, rank of the beam's elevation, 0 lowest
    column    : (n,) int32, firing block within the frame
    channel   : (n,) uint16, number of the laser
    order     : (n,) int32, permutation in which neighbouring rays go almost the same way
    """

    time_ns: NDArray[np.int64]
    direction: Float
    origin: Float
    ring: NDArray[np.uint16]
    column: NDArray[np.int32]
    channel: NDArray[np.uint16]
    order: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of pulses."""
        return len(self.time_ns)


class Pattern(Protocol):
    """What every kind of scanner can do."""

    @property
    def range_offset(self) -> float:
        """Metres that the sensor adds to the distance from the beam's start."""

    @property
    def tail_ns(self) -> int:
        """Nanoseconds after the end of its frame by which the last pulse may be late."""

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; ``start_ns`` is the time frame 0 starts."""


@dataclass(frozen=True, slots=True)
class Blocks:
    """The firing blocks that start within one frame.

    first   : number of the first block since frame 0 began
    phase   : time from the frame's start to that block, in frames (0 to 1)
    step    : time from block to block, in frames
    time_ns : (n,) int64, start of each block
    """

    first: int
    phase: float
    step: float
    time_ns: NDArray[np.int64]

    def __len__(self) -> int:
        """Number of blocks."""
        return len(self.time_ns)


def frame_ns(rate_hz: float) -> Fraction:
    """Nanoseconds a frame lasts, exactly."""
    return 10**9 / Fraction(rate_hz).limit_denominator(10**6)


def blocks(frame: int, rate_hz: float, *, block_ns: Fraction, start_ns: int) -> Blocks:
    """The blocks of a clock that ticks every ``block_ns``, whatever the frames do, within one frame.

    The clock is not reset by a frame: where the frame is no multiple of the block, one frame in a few has a
    block more and the grid moves on from frame to frame, as it does in the instruments.
    """
    period = frame_ns(rate_hz)
    first, stop = (-(-frame_edge // block_ns) for frame_edge in (frame * period, (frame + 1) * period))
    number = np.arange(first, stop, dtype=np.int64)
    whole = block_ns.numerator * number
    time = start_ns + (2 * whole + block_ns.denominator) // (2 * block_ns.denominator)
    return Blocks(first, float((first * block_ns - frame * period) / period), float(block_ns / period), time)


def ranks(elevation: Float) -> NDArray[np.uint16]:
    """Rank of each elevation (n,), 0 lowest; equal elevations in the order given."""
    rank = np.empty(len(elevation), np.uint16)
    rank[np.argsort(elevation, kind="stable")] = np.arange(len(elevation))
    return rank


def frozen(array: NDArray[T]) -> NDArray[T]:
    """The same array, made read-only: it is shared between frames."""
    array.flags.writeable = False
    return array


def numbers(count: int, lasers: int) -> tuple[NDArray[np.int32], NDArray[np.uint16]]:
    """Block and laser of each pulse, where ``lasers`` pulses are fired in each of ``count`` blocks."""
    block = np.repeat(np.arange(count, dtype=np.int32), lasers)
    return block, np.tile(np.arange(lasers, dtype=np.uint16), count)
