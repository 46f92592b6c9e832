"""Pulses of one frame of a scanner as columns, and the clock of its firing blocks."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.columns import Columns
from geoscene.typing import Float

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Firings(Columns):
    """The pulses of one frame in the order they are fired. Arrays may be shared between frames: do not write.

    time_ns   : (n,) int64, nanoseconds since the drive's start
    direction : (n, 3) float64, unit vectors in the sensor frame (x forward, y left, z up) at the pulse's time
    origin    : (n, 3) float64, metres, where the beam starts in the sensor frame
    ring      : (n,) uint16, rank of the beam's elevation, 0 lowest
    column    : (n,) int32, firing block within the frame
    channel   : (n,) uint16, number of the laser
    order     : (n,) int32, permutation in which neighbouring rays have similar directions
    """

    time_ns: NDArray[np.int64]
    direction: Float
    origin: Float
    ring: NDArray[np.uint16]
    column: NDArray[np.int32]
    channel: NDArray[np.uint16]
    order: NDArray[np.int32]


def from_origin(
    time_ns: NDArray[np.int64], direction: Float, *, column: NDArray[np.int32], channel: NDArray[np.uint16]
) -> Firings:
    """Pulses (n,) that start at the sensor's origin, fired in order of direction; channels are rings."""
    order = np.arange(len(time_ns), dtype=np.int32)
    return Firings(time_ns, direction, np.zeros_like(direction), channel, column, channel, order)


def unit_vectors(azimuth: Float, elevation: Float) -> Float:
    """Unit vectors (..., 3) of angles in radians, counter-clockwise from forward, and up."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


class Pattern(Protocol):
    """Firing pattern of a scanner."""

    @property
    def range_offset(self) -> float:
        """Metres that the sensor adds to the distance from the beam's start."""

    @property
    def tail_ns(self) -> int:
        """Maximum delay of the last pulse after the end of its frame, nanoseconds."""

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of frame ``frame``; frame 0 starts at ``start_ns``."""


@dataclass(frozen=True, slots=True)
class Blocks(Columns):
    """The firing blocks that start within one frame.

    first   : number of the first block, counted from the start of frame 0
    phase   : time from the frame's start to that block, in frames (0 to 1)
    step    : time from block to block, in frames
    time_ns : (n,) int64, start of each block
    """

    first: int
    phase: float
    step: float
    time_ns: NDArray[np.int64]


def frame_ns(rate_hz: float) -> Fraction:
    """Exact duration of a frame in nanoseconds."""
    return 10**9 / Fraction(rate_hz).limit_denominator(10**6)


def blocks(frame: int, rate_hz: float, *, block_ns: Fraction, start_ns: int) -> Blocks:
    """The blocks within one frame of a clock with the period ``block_ns``.

    The clock runs on across frames, as in real instruments: if a frame is not a multiple of a block, the
    phase of the blocks shifts from frame to frame, and some frames have one block more.
    """
    period = frame_ns(rate_hz)
    first, stop = (-(-frame_edge // block_ns) for frame_edge in (frame * period, (frame + 1) * period))
    time = start_ns + _nearest_multiples(block_ns, first, stop=stop)
    return Blocks(first, float((first * block_ns - frame * period) / period), float(block_ns / period), time)


def _nearest_multiples(period: Fraction, first: int, *, stop: int) -> NDArray[np.int64]:
    """The multiples ``first`` to ``stop`` of a period, rounded to whole numbers, halves up."""
    step, unit = 2 * period.numerator, 2 * period.denominator
    whole, rest = divmod(step * first + period.denominator, unit)
    if step * (stop - first) + unit < 1 << 63:
        return whole + (step * np.arange(stop - first, dtype=np.int64) + rest) // unit
    return np.array([whole + (step * k + rest) // unit for k in range(stop - first)], np.int64)


def ranks(elevation: Float) -> NDArray[np.uint16]:
    """Rank of each elevation (n,), 0 lowest; equal elevations keep their order."""
    rank = np.empty(len(elevation), np.uint16)
    rank[np.argsort(elevation, kind="stable")] = np.arange(len(elevation))
    return rank


def frozen(array: NDArray[T]) -> NDArray[T]:
    """The same array, made read-only because frames share it."""
    array.flags.writeable = False
    return array


def numbers(count: int, lasers: int) -> tuple[NDArray[np.int32], NDArray[np.uint16]]:
    """Block and laser of each pulse, where ``lasers`` pulses are fired in each of ``count`` blocks."""
    block = np.repeat(np.arange(count, dtype=np.int32), lasers)
    return block, np.tile(np.arange(lasers, dtype=np.uint16), count)
