"""Rays where the footprint of a pulse needs them: few for all pulses, more until echoes move no more."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float, Ints
from lidar.raycast import Hits
from lidar.sensors.laser.rays import BeamSample, equal_rays, probe
from lidar.sensors.physics.echoes import Echoes
from lidar.sensors.rig.patterns.beams import Firings
from lidar.world.surfaces import SurfaceFaces

Watch = Callable[[Hits, int], None]
"""Takes the hits of the rays of consecutive pulses, and the number of the first of these."""


class Cast(Protocol):
    """Casts rays of the pulses in ``rows``, ascending, or of all, and returns their echoes.

    Echoes are sorted by pulse; ``watch`` takes the hits of the rays.
    """

    def __call__(self, sample: BeamSample, *, rows: Ints | None = None, watch: Watch | None = None) -> Echoes:
        """The echoes."""


COUNTS = (31, 127, 499)
"""Rays of the pulses that are cast again, in turn."""

_EVEN = 3.0
"""Tolerances by which rays of `probe` may be off a plane on one material: their mean is off by less."""

_ERROR = 0.3
"""Error of the share of a disc that n rays find, rms, is this times n^-3/4: measured with straight edges of
any place and direction, for `bundle`."""

_SURE = 4.0
"""Times that error by which the shares of two echoes differ for the stronger to be known."""


def adaptive_echoes(cast: Cast, pulses: Firings, *, faces: SurfaceFaces, tolerance: float) -> Echoes:
    """Echoes of pulses, each with as many rays as its footprint needs, sorted by pulse and range.

    All pulses have the rays of `probe`. Those whose rays do not lie on one plane within the tolerance, and
    those that the same laser fires beside them, are cast again with each of `COUNTS` rays, until their
    strongest echo moves by no more than the tolerance and surely is the strongest.

    faces     : of the world
    tolerance : of ranges, metres
    """
    sample, rough = probe(), np.zeros(len(pulses), np.bool_)
    fit = np.linalg.pinv(np.column_stack([np.ones(len(sample.place)), sample.place]))

    def watch(hits: Hits, first: int) -> None:
        part = rough[first : first + len(hits.range) // len(sample.place)]
        _find_rough((hits.range, hits.face, hits.instance), faces, sample.place, fit, tolerance, part)

    echoes = cast(sample, watch=watch)
    rough |= beside(pulses, rough)
    kept, open_ = [echoes.where(~rough[echoes.pulse])], rough
    before = _strongest(echoes, len(pulses), rays=len(sample.place))
    for rays in COUNTS:
        rows = np.flatnonzero(open_)
        if not len(rows):
            break
        echoes = cast(equal_rays(rays), rows=rows)
        now = _strongest(echoes, len(pulses), rays=rays)
        open_ = np.zeros(len(pulses), np.bool_)
        if rays != COUNTS[-1]:
            open_[rows] = now.differs(before, rows, tolerance=tolerance)
        kept.append(echoes.where(~open_[echoes.pulse]))
        before = now
    together = Echoes.concatenate(kept)
    return together.take(np.argsort(together.pulse, kind="stable"))


class _Strongest(NamedTuple):
    """The strongest echo of each pulse.

    range : (n,) metres, infinite without an echo
    sure  : (n,) it surely is the strongest
    """

    range: Float
    sure: Bools

    def differs(self, other: _Strongest, rows: Ints, *, tolerance: float) -> Bools:
        """Whether echoes of pulses in ``rows`` (k,) are unsure, or over ``tolerance`` from others."""
        here, there = self.range[rows], other.range[rows]
        near = (np.isinf(here) & np.isinf(there)) | (
            np.abs(here - np.where(np.isinf(here), 0, there)) <= tolerance
        )
        found: Bools = ~(near & self.sure[rows])
        return found


def _strongest(echoes: Echoes, count: int, *, rays: int) -> _Strongest:
    """The strongest echoes of ``count`` pulses that were cast with so many rays each."""
    found = _Strongest(np.full(count, np.inf), np.ones(count, np.bool_))
    within = _SURE * _ERROR * rays**-0.75
    _find_strongest(echoes.pulse, echoes.range, echoes.apparent, within, found.range, found.sure)
    return found


@njit(cache=True, nogil=True)
def _find_strongest(pulse: Any, away: Any, apparent: Any, within: Any, distance: Any, sure: Any) -> None:
    """Fill the columns of `_Strongest`; ``pulse`` ascends."""
    i = 0
    while i < len(pulse):
        p, best, second = pulse[i], -1.0, 0.0
        while i < len(pulse) and pulse[i] == p:
            r = max(away[i], 1e-3)
            power = apparent[i] / (r * r)
            if power > best:
                best, second, distance[p] = power, max(best, 0.0), away[i]
            else:
                second = max(second, power)
            i += 1
        sure[p] = second == 0.0 or best - second >= within * (best + second)


@njit(cache=True, nogil=True, error_model="numpy")
def _find_rough(hits: Any, faces: Any, place: Any, fit: Any, tolerance: Any, rough: Any) -> None:
    """Fill ``rough``: whether the rays of pulses do not lie on one plane within a tolerance.

    The inverse range of a plane is linear over the footprint. On one material, which sends back as much of
    each ray, rays may be `_EVEN` tolerances off.

    fit : (3, rays), by which values at the places give the constant and the slopes of the nearest plane
    """
    distance, face, instance = hits
    starts, packed, own = faces.start, faces.packed, len(faces.start) - 1
    rays = len(place)
    for p in range(len(rough)):
        first = p * rays
        size, a, b, c = 0, 0.0, 0.0, 0.0
        for k in range(rays):
            r = distance[first + k]
            if r < np.inf:
                size += 1
                a, b, c = a + fit[0, k] / r, b + fit[1, k] / r, c + fit[2, k] / r
        if size < rays:
            rough[p] = size > 0
            continue
        low, high = np.inf, -np.inf
        for k in range(rays):
            on_plane = a + b * place[k, 0] + c * place[k, 1]
            off = distance[first + k] - 1.0 / on_plane if on_plane > 0.0 else np.inf
            low, high = min(low, off), max(high, off)
        rough[p] = not high - low <= tolerance
        if rough[p] and high - low <= _EVEN * tolerance:
            material, alike = -1, 0
            for i in range(first, first + rays):
                copy = instance[i]
                found = packed[face[i] + starts[copy if copy >= 0 else own]] & 255
                alike += 1 if material < 0 or found == material else 0
                material = found
            rough[p] = alike < rays


def beside(pulses: Firings, some: Bools) -> Bools:
    """Whether pulses (n,) are fired right before or after some of them by the same laser."""
    order = np.lexsort((pulses.time_ns, pulses.ring))
    same = pulses.ring[order[1:]] == pulses.ring[order[:-1]]
    ordered, found = some[order], np.zeros(len(some), np.bool_)
    found[order[1:]] |= same & ordered[:-1]
    found[order[:-1]] |= same & ordered[1:]
    return found
