"""Scanners that rotate a column of lasers about the vertical axis."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.sensors.rig.patterns.beams import (
    Firings,
    Pattern,
    blocks,
    chosen,
    frame_ns,
    frame_window_ns,
    frozen,
    ranks,
)
from lidar.toml_table import Table


@dataclass(frozen=True, eq=False)
class Spinning(Pattern):
    """A rotating column of lasers. Laser k fires ``fire_ns[k]`` after the start of each block.

    Blocks follow each other without a pause. At the time t of a pulse the encoder's angle is
    ``start + turn * 2 pi t / period``. The beam's azimuth is that angle plus ``azimuth[k]`` (in the
    direction of rotation), its elevation is ``elevation[k]``.

    elevation, azimuth : (k,) radians
    fire_ns  : (k,) nanoseconds
    block_ns : nanoseconds from block to block; 0 if ``columns`` is given
    columns  : blocks per revolution of scanners whose blocks are locked to the encoder, else 0
    turn     : -1 clockwise seen from above, 1 counter-clockwise
    start    : radians, encoder's angle at the start of a frame, counter-clockwise from forward
    forward  : (k,) metres, start of the beam ahead of the axis, along the encoder's angle
    left     : (k,) metres, start of the beam to the left, seen along the beam
    up       : (k,) metres
    range_offset : metres the sensor adds to the distance from the beam's start
    """

    elevation: Float
    azimuth: Float
    fire_ns: NDArray[np.int64]
    block_ns: Fraction
    columns: int
    turn: int
    start: float
    forward: Float
    left: Float
    up: Float
    range_offset: float

    @functools.cached_property
    def _central(self) -> bool:
        """Whether all beams start on the axis."""
        return not (self.forward.any() or self.left.any())

    def _origins(self, encoder: Any, late: Any, *, ahead: Any) -> Float:
        """Start points (blocks * lasers, 3) of the beams."""
        origin = np.empty((len(encoder), len(late), 3))
        x = self.forward * np.cos(late) - self.left * np.sin(ahead)
        y = self.forward * np.sin(late) + self.left * np.cos(ahead)
        _rotate(np.cos(encoder), np.sin(encoder), x, y, self.up, origin)
        return origin.reshape(-1, 3)

    def fire(self, frame: int, rate_hz: float, *, start_ns: int) -> Firings:
        """The pulses of revolution ``frame``; azimuths repeat only if encoder-locked.

        Pulses of one block before and after the end of a frame belong to different frames.
        """
        period = frame_ns(rate_hz)
        block = blocks(
            frame,
            rate_hz,
            block_ns=period / self.columns if self.columns else self.block_ns,
            start_ns=start_ns,
            delays_ns=(int(self.fire_ns.min()), int(self.fire_ns.max())),
        )
        turned = block.phase + block.step * np.arange(len(block), dtype=np.float64)
        encoder = self.start + self.turn * 2 * np.pi * turned
        late = self.turn * (2 * np.pi / float(period)) * self.fire_ns.astype(np.float64)
        ahead = late + self.turn * self.azimuth
        level, up = np.cos(self.elevation), np.sin(self.elevation)
        direction = np.empty((len(block), len(late), 3))
        x, y = level * np.cos(ahead), level * np.sin(ahead)
        _rotate(np.cos(encoder), np.sin(encoder), x, y, up, direction)
        ring, column, channel, order, on_axis = _labels(self, len(block))
        origin = on_axis if self._central else self._origins(encoder, late, ahead=ahead)
        time = (block.time_ns[:, None] + self.fire_ns).ravel()
        pulses = Firings(time, direction.reshape(-1, 3), origin, ring, column, channel, order)
        start, stop = frame_window_ns(frame, rate_hz, start_ns=start_ns)
        during = (time >= start) & (time < stop)
        if during.all():
            return pulses
        first, last = np.flatnonzero(during)[[0, -1]].tolist() if during.any() else (0, -1)
        if not during[first : last + 1].all():
            return chosen(pulses, during)
        among = _order_among(self, len(block), first=first, stop=last + 1)
        return replace(pulses.take(slice(first, last + 1)), order=among)


@functools.lru_cache(maxsize=64)
def _labels(
    pattern: Spinning, count: int
) -> tuple[NDArray[np.uint16], NDArray[np.int32], NDArray[np.uint16], NDArray[np.int32], Float]:
    """Ring, column, channel, ring-major order and start points on the axis, for ``count`` blocks."""
    lasers = len(pattern.elevation)
    rank = ranks(pattern.elevation)
    number = np.arange(count * lasers, dtype=np.int32).reshape(count, lasers)
    return (
        frozen(np.tile(rank, count)),
        frozen(np.repeat(np.arange(count, dtype=np.int32), lasers)),
        frozen(np.tile(np.arange(lasers, dtype=np.uint16), count)),
        frozen(number[:, np.argsort(rank)].T.ravel()),
        frozen(np.tile(np.stack([0 * pattern.up, 0 * pattern.up, pattern.up], axis=1), (count, 1))),
    )


@functools.lru_cache(maxsize=64)
def _order_among(pattern: Spinning, count: int, *, first: int, stop: int) -> NDArray[np.int32]:
    """Ring-major order of the pulses ``first`` to ``stop`` of ``count`` blocks, among themselves."""
    order = _labels(pattern, count)[3]
    return frozen(order[(order >= first) & (order < stop)] - np.int32(first))


@njit(cache=True, nogil=True)
def _rotate(cosine: Any, sine: Any, x: Any, y: Any, z: Any, out: Any) -> None:
    """Fill ``out`` (blocks, lasers, 3) with (x, y, z) of each laser, turned by the angle of each block."""
    for block in range(len(cosine)):
        c, s = cosine[block], sine[block]
        for laser in range(len(x)):
            out[block, laser, 0] = c * x[laser] - s * y[laser]
            out[block, laser, 1] = s * x[laser] + c * y[laser]
            out[block, laser, 2] = z[laser]


def read_spinning(table: Table) -> Spinning:
    """The pattern that a ``[spinning]`` table describes.

    Raises RigError for keys that are missing, unknown or out of bounds.
    """
    elevation = np.radians(table.numbers("elevation_deg"))
    if (np.abs(elevation) >= np.pi / 2).any():
        raise table.error("elevation_deg", "elevations must be within 90 degrees")
    k = len(elevation)
    columns = table.integer("columns", 0, low=0, high=1 << 20)
    block_us = Fraction(str(table.number("block_us", 0.0 if columns else ..., low=0.0)))
    if not columns and block_us <= 0:
        raise table.error("block_us", "is not over 0; give it, or columns for an encoder-locked scanner")
    if columns and block_us:
        raise table.error("block_us", "give block_us or columns, not both")
    fire_us = np.array(table.numbers("fire_us", 0.0, count=k, spread=True, within=1e6))
    up = table.numbers("origin_up", 0.0, count=k, spread=True)
    if table.has("focal_offset"):
        if table.has("origin_up"):
            raise table.error("origin_up", "give origin_up or focal_offset, not both")
        up = tuple(-table.number("focal_offset") * np.tan(elevation))
    pattern = Spinning(
        elevation=elevation,
        azimuth=np.radians(table.numbers("azimuth_offset_deg", 0.0, count=k, spread=True)),
        fire_ns=np.round(fire_us * 1000).astype(np.int64),
        block_ns=block_us * 1000,
        columns=columns,
        turn=-1 if table.flag("clockwise", True) else 1,
        start=float(np.radians(table.number("start_deg", 0.0, low=-360.0, high=360.0))),
        forward=np.array(table.numbers("origin_forward", 0.0, count=k, spread=True)),
        left=np.array(table.numbers("origin_left", 0.0, count=k, spread=True)),
        up=np.array(up),
        range_offset=table.number("range_offset", 0.0),
    )
    table.close()
    return pattern
