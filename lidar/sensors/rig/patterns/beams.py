"""Pulses of one frame of a scanner as columns, and the clock of its firing blocks."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
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


def chosen(pulses: Firings, keep: NDArray[np.bool_]) -> Firings:
    """Some of the pulses, in the same order."""
    kept, order = pulses.take(keep), pulses.order[keep[pulses.order]]
    rank = np.cumsum(keep, dtype=np.int32) - 1
    return replace(kept, order=rank[order])


def unit_vectors(azimuth: Float, elevation: Float) -> Float:
    """Unit vectors (..., 3) of angles in radians, counter-clockwise from forward, and up."""
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


class Pattern:
    """Firing pattern of a scanner.

    range_offset : metres that the sensor adds to the distance from the beam's start
    """

    range_offset: float = 0.0

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses that are fired within `frame_window_ns` of frame ``frame``."""
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Blocks(Columns):
    """Successive firing blocks.

    first   : number of the first block, counted from the start of frame 0
    phase   : time from the frame's start to that block, in frames; negative if it starts before the frame
    step    : time from block to block, in frames
    time_ns : (n,) int64, start of each block
    """

    first: int
    phase: float
    step: float
    time_ns: NDArray[np.int64]


@functools.lru_cache(maxsize=64)
def frame_ns(rate_hz: float) -> Fraction:
    """Exact duration of a frame in nanoseconds."""
    return 10**9 / Fraction(rate_hz).limit_denominator(10**6)


def frame_window_ns(frame: int, rate_hz: float, *, start_ns: int) -> tuple[int, int]:
    """Start of a frame and of the next one in whole nanoseconds; frame 0 starts at ``start_ns``."""
    period = frame_ns(rate_hz)
    return start_ns + int(frame * period), start_ns + int((frame + 1) * period)


def blocks(
    frame: int, rate_hz: float, *, block_ns: Fraction, start_ns: int, delays_ns: tuple[int, int] = (0, 0)
) -> Blocks:
    """The blocks of a clock with the period ``block_ns`` that have a pulse within one frame.

    delays_ns : of the first and of the last pulse of a block after the block's start

    The clock runs on across frames, as in real instruments: if a frame is not a multiple of a block, the
    phase of the blocks shifts from frame to frame, and some frames have one block more.
    """
    period = frame_ns(rate_hz)
    start, stop = frame_window_ns(frame, rate_hz, start_ns=0)
    half = Fraction(1, 2)  # a time within half a nanosecond of the frame's start is rounded to it
    first, end = (
        -(-(edge - delay - half) // block_ns)
        for edge, delay in zip((start, stop), delays_ns[::-1], strict=True)
    )
    time = start_ns + _nearest_multiples(block_ns, first, stop=end)
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
