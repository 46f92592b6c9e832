"""Rays of a sensor that moves while it fires, which sample the cross-sections of its beams."""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import KNOT_NS, Poses, Trajectory
from lidar.sensors.physics.echoes import Gap
from lidar.sensors.physics.settings import MOST_RAYS
from lidar.sensors.rig.patterns.beams import Firings

INSIDE = 1 - math.exp(-2)
"""Share of a Gaussian beam's power within its 1/e^2 radius, which rays sample."""

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@functools.cache
def bundle(rays: int) -> Float:
    """Positions (rays, 2) on the unit disc of rays of equal power, the axis first; their mean is the axis.

    They sample a Gaussian beam within its 1/e^2 radius. Ray k lies in the middle of the ring with the k-th
    of equal parts of the power, a golden angle on from the ray before (Vogel 1979): rays seldom lie in line,
    so that wires and edges of any direction cover few at once.

    Raises InputError for a number that is not from 1 to `MOST_RAYS`.
    """
    if not 1 <= rays <= MOST_RAYS:
        raise InputError(f"`rays` {rays}: give 1 to {MOST_RAYS}")
    ray = np.arange(1, rays)
    radius = np.sqrt(-0.5 * np.log1p(-INSIDE * (ray + 0.5) / rays))
    angle = ray * _GOLDEN_ANGLE
    place = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), place - place.mean(axis=0)]) if rays > 1 else np.zeros((1, 2))


class BeamSample(NamedTuple):
    """Rays that sample a beam.

    place : (rays, 2) on the unit disc, the beam's axis first
    power : (rays,) share of the pulse's power that each ray has
    gap   : widest gap between neighbours in projection on any line, on the unit disc
    """

    place: Float
    power: Float
    gap: float


@functools.cache
def equal_rays(rays: int) -> BeamSample:
    """The rays of `bundle`, of equal power."""
    place = bundle(rays)
    return BeamSample(place, np.full(rays, 1.0 / rays), _widest_gap(place))


@functools.cache
def probe() -> BeamSample:
    """Seven rays: the axis, and six at the rim, where a beam first meets what stands beside a surface.

    Their powers are such that a plane at any angle has the mean range of a Gaussian beam, to third order.
    """
    angle = np.arange(6) * math.pi / 3
    place = np.concatenate([np.zeros((1, 2)), np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    rim = float((bundle(MOST_RAYS) ** 2).sum(axis=1).mean())
    return BeamSample(place, np.append(1.0 - rim, np.full(6, rim / 6)), _widest_gap(place))


def _widest_gap(place: Float) -> float:
    angle = np.linspace(0, math.pi, 720, endpoint=False)
    across = np.sort(place @ np.stack([np.cos(angle), np.sin(angle)]), axis=0)
    return float(np.diff(across, axis=0).max(initial=0.0))


_UNIFORM = 0.5 * math.sqrt(3.0)
"""Width of a uniform profile with the standard deviation of a Gaussian one, in widths of that at 1/e^2."""


@dataclass(frozen=True, slots=True)
class Beam:
    """Rays that sample the cross-section of each pulse.

    sample : its rays
    spread : (2,) radians, half angles of the beam to the left and up
    size   : (2,) metres, half of the beam's width and height where it starts
    turn   : (n,) radians by which its rays are turned for each pulse; empty for one ray
    """

    sample: BeamSample
    spread: Float
    size: Float
    turn: Float

    @property
    def rays(self) -> int:
        """Number of rays per pulse."""
        return len(self.sample.place)

    @property
    def gap(self) -> Gap:
        """Widest gap between neighbouring rays, in the wider direction of the beam."""
        share = self.sample.gap
        return Gap(share * float(self.size.max()), share * float(self.spread.max()))

    @property
    def footprint(self) -> tuple[float, float]:
        """Height of the beam, metres, at its start, and its growth per metre.

        Relief below the size of the footprint has no effect on the range of a pulse, whatever the number of
        its rays. A Gaussian profile spreads as far as a uniform one of 0.87 of its width at 1/e^2.
        """
        return 2.0 * _UNIFORM * float(self.size[1]), 2.0 * _UNIFORM * float(self.spread[1])


def beam_of(
    sample: BeamSample, *, divergence: tuple[float, float], aperture: tuple[float, float], turn: Float
) -> Beam:
    """The beam of a scanner.

    divergence : (2,) radians, full 1/e^2 angles, horizontal and vertical
    aperture   : (2,) metres, size of the beam at its start
    turn       : (n,) as in `Beam`
    """
    return Beam(sample, np.divide(divergence, 2), np.divide(aperture, 2), turn)


@dataclass(frozen=True, slots=True)
class PulseRays:
    """Rays of consecutive pulses, pulse by pulse; the first ray of each pulse is the axis of its beam.

    poses     : of the sensor
    index     : (n,) int64, each ray's row of ``poses``
    direction : (n, 3) float64, unit vectors in the sensor frame of that pose
    origin    : (n, 3) float64, metres, in the same frame
    order     : (n,) int64, permutation in which neighbouring rays have similar directions
    """

    poses: Poses
    index: NDArray[np.int64]
    direction: Float
    origin: Float
    order: NDArray[np.int64]

    def take(self, rows: NDArray[np.integer]) -> PulseRays:
        """Selected rays, without an ``order``."""
        none = np.empty(0, np.int64)
        return PulseRays(self.poses, self.index[rows], self.direction[rows], self.origin[rows], none)


class _Scratch(threading.local):
    """Columns that a thread reuses: allocating memory takes longer than filling it."""

    def __init__(self) -> None:
        self._grow(0)

    def _grow(self, n: int) -> None:
        self._columns = np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.int64)

    def columns(self, n: int) -> tuple[NDArray[np.int64], Float, Float, NDArray[np.int64]]:
        """Uninitialised columns of n rays: index, direction, origin and order."""
        if len(self._columns[0]) < n:
            self._grow(n)
        index, direction, origin, order = self._columns
        return index[:n], direction[:n], origin[:n], order[:n]


_scratch = _Scratch()


class MovingSensor:
    """A sensor that moves while it fires; its rays come in batches of pulses.

    Poses are sampled every `KNOT_NS`. The direction and origin of a ray include the motion from its pose to
    the pulse's own time, interpolated linearly as in `Trajectory.place`.

    firings : the pulses
    batch   : maximum number of pulses per batch
    """

    def __init__(
        self, firings: Firings, mount: Mount, *, trajectory: Trajectory, beam: Beam, batch: int
    ) -> None:
        first, last = (int(t) // KNOT_NS for t in (firings.time_ns.min(), firings.time_ns.max()))
        knots = trajectory.at(KNOT_NS * np.arange(first, last + 2, dtype=np.int64))
        self.poses = knots.mounted(mount.translation, mount.rotation)
        back = self.poses.rotation[:-1].transpose(0, 2, 1)
        step = (self.poses.position[1:] - self.poses.position[:-1]) / self.poses.scale[:-1]
        self._turn = back @ self.poses.rotation[1:] - np.eye(3)
        self._shift = np.einsum("nij,nj->ni", back, step)
        self._firings, self._beam, self._batch = firings, beam, batch
        self._start_ns = first * KNOT_NS
        self._order = np.empty(len(firings), np.int64)
        _batches(firings.order, batch, self._order)

    def rays(self, batch: int) -> PulseRays:
        """The rays of a batch, by its number; valid until this thread requests another batch."""
        part = slice(batch * self._batch, (batch + 1) * self._batch)
        fired, beam = self._firings, self._beam
        work = self._order[part]
        n = len(work) * beam.rays
        out = PulseRays(self.poses, *_scratch.columns(n))
        _fill(
            fired.time_ns[part],
            self._start_ns,
            fired.direction[part],
            fired.origin[part],
            work - part.start,
            (self._turn, self._shift),
            (beam.sample.place, beam.spread, beam.size, beam.turn[part]),
            (out.index, out.direction, out.origin, out.order),
        )
        return out


@njit(cache=True, nogil=True)
def _batches(order: Any, size: int, out: Any) -> None:
    """Fill ``out`` with the order of the pulses, batch after batch."""
    batches = -(-len(order) // size)
    place = size * np.arange(batches)
    for i in range(len(order)):
        batch = order[i] // size
        out[place[batch]] = order[i]
        place[batch] += 1


@njit(cache=True, nogil=True)
def _fill(
    time: Any, start: int, directions: Any, origins: Any, work: Any, motion: Any, beam: Any, out: Any
) -> None:
    """Fill ``out``: pose, direction, origin and order of every ray."""
    turn, shift = motion
    place, spread, size, turned = beam
    rays = len(place)
    index, direction, origin, order = out
    i = 0
    for pulse in range(len(time)):
        k = (time[pulse] - start) // KNOT_NS
        w = (time[pulse] - start - k * KNOT_NS) / KNOT_NS
        a00, a01, a02 = turn[k, 0, 0], turn[k, 0, 1], turn[k, 0, 2]
        a10, a11, a12 = turn[k, 1, 0], turn[k, 1, 1], turn[k, 1, 2]
        a20, a21, a22 = turn[k, 2, 0], turn[k, 2, 1], turn[k, 2, 2]
        sx, sy, sz = shift[k, 0], shift[k, 1], shift[k, 2]
        x, y, z = directions[pulse, 0], directions[pulse, 1], directions[pulse, 2]
        ox, oy, oz = origins[pulse, 0], origins[pulse, 1], origins[pulse, 2]
        # Axes across the beam: horizontal, to the left (lx, ly), and upwards (ux, uy, uz).
        lx, ly, ux, uy, uz = 0.0, 1.0, 0.0, 0.0, 0.0
        c, s = 1.0, 0.0
        if rays > 1:
            c, s = np.cos(turned[pulse]), np.sin(turned[pulse])
            level = np.sqrt(x * x + y * y)
            if level > 1e-9:  # else the beam is along the spin axis, and any horizontal axis will do
                lx, ly = -y / level, x / level
            ux, uy, uz = -z * ly, z * lx, x * ly - y * lx
        for ray in range(rays):
            e, f = c * place[ray, 0] - s * place[ray, 1], s * place[ray, 0] + c * place[ray, 1]
            a, b = e * spread[0], f * spread[1]
            dx, dy, dz = x + a * lx + b * ux, y + a * ly + b * uy, z + b * uz
            a, b = e * size[0], f * size[1]
            px, py, pz = ox + a * lx + b * ux, oy + a * ly + b * uy, oz + b * uz
            vx = dx + w * (a00 * dx + a01 * dy + a02 * dz)
            vy = dy + w * (a10 * dx + a11 * dy + a12 * dz)
            vz = dz + w * (a20 * dx + a21 * dy + a22 * dz)
            scale = 1 / np.sqrt(vx * vx + vy * vy + vz * vz)
            direction[i, 0], direction[i, 1], direction[i, 2] = vx * scale, vy * scale, vz * scale
            origin[i, 0] = px + w * (a00 * px + a01 * py + a02 * pz + sx)
            origin[i, 1] = py + w * (a10 * px + a11 * py + a12 * pz + sy)
            origin[i, 2] = pz + w * (a20 * px + a21 * py + a22 * pz + sz)
            index[i] = k
            order[i] = work[pulse] * rays + ray
            i += 1
