"""Echoes of pulses: merging of surfaces, numbering, and the return modes of scanners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.columns import Columns
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.memory import inline
from lidar.sensors.physics.origin import Origin


class Gap(NamedTuple):
    """Widest gap between neighbouring rays of a beam, across it.

    start  : metres where the beam starts
    spread : radians by which the gap widens
    """

    start: float = 0.0
    spread: float = 0.0


AXIS_ONLY = Gap()
"""Of a beam of one ray."""


_MODES = ("strongest", "first", "last", "dual", "all")
_STRONGEST, _FIRST, _LAST, _DUAL, _ALL = range(5)
_GRAZING = 1e-3  # least cosine of incidence at which surfaces count as slanted
_FAINT = 1e-3  # share of the brightest surface's power below which a surface is negligible


@dataclass(frozen=True, slots=True)
class Echoes(Columns):
    """Surfaces or echoes, one row each, sorted by pulse.

    pulse    : (m,) int32, row of the pulse
    range    : (m,) float64, metres from the beam's start, along the beam's axis
    apparent : (m,) float64, apparent reflectance: that of the Lambertian target at normal incidence, as large
               as the beam, that returns the same power in clear air
    feature, klass, cosine : (m,) of the surface, as in `laser.cloud.Cloud`; cosine of the incidence
    true_range : (m,) float64, metres to the surface that feature and class are of
    axis       : (m,) bool, the axis of the beam intersects that surface
    """

    pulse: NDArray[np.int32]
    range: Float
    apparent: Float
    feature: NDArray[np.int32]
    klass: NDArray[np.uint8]
    cosine: Float
    true_range: Float
    axis: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class TracedEchoes(Echoes):
    """Echoes with their ground truth, as stages change them.

    origin : (m,) uint8, `Origin`
    source : (m,) int32, row of the unaltered echo that this one is, or was moved from; -1 for an added echo
    """

    origin: NDArray[np.uint8]
    source: NDArray[np.int32]


def trace(echoes: Echoes, origin: Origin, *, source: NDArray[np.integer]) -> TracedEchoes:
    """Echoes with an origin and their sources (m,)."""
    added: list[Any] = [np.full(len(echoes), origin, np.uint8), source.astype(np.int32)]
    return TracedEchoes(*echoes.columns().values(), *added)


def artificial_echoes(
    pulse: NDArray[np.integer],
    distance: Float,
    *,
    apparent: Float,
    klass: Class = Class.NOISE,
    feature: int = -1,
) -> Echoes:
    """Echoes (k,) of no surface of the scene, with true range 0."""
    n = len(pulse)
    features, classes = np.full(n, feature, np.int32), np.full(n, klass, np.uint8)
    beside = np.zeros(n, bool)
    return Echoes(
        pulse.astype(np.int32), distance, apparent, features, classes, np.ones(n), np.zeros(n), beside
    )


EchoesT = TypeVar("EchoesT", bound=Echoes)


def join(first: EchoesT, *others: EchoesT) -> EchoesT:
    """All rows, sorted by pulse and range."""
    together = (first, *(other for other in others if len(other)))
    if len(together) == 1:
        return first
    both = type(first).concatenate(together)
    return both.take(np.lexsort((both.range, both.pulse)))


def merge(surfaces: EchoesT, separation: float, *, gap: Gap = AXIS_ONLY) -> EchoesT:
    """The echoes of pulses that hit these surfaces.

    Consecutive surfaces of a pulse within ``separation`` metres give one echo, with the sum of their power at
    their mean range, weighted by received power. Slanted surfaces may be further apart: by the depth of both
    within the ``gap`` between neighbouring rays, as one surface, or by half that of the more slanted one, as
    ground that ends at a wall. Its other columns are those of the surface on the beam's axis, if that is
    among them and returns power (water and panes may not), else of the surface that returns most.
    """
    if not len(surfaces):
        return surfaces
    starts = np.flatnonzero(np.diff(surfaces.pulse, prepend=-1, append=-1)).astype(np.int64)
    m = len(surfaces)
    bearer, place, power = np.empty(m, np.int64), np.empty(m), np.empty(m)
    columns = surfaces.range, surfaces.apparent, surfaces.axis, surfaces.cosine
    count = _merge(starts, columns, separation, gap, bearer, place, power)
    return replace(surfaces.take(bearer[:count]), range=place[:count], apparent=power[:count])


def by_pulse(first: EchoesT, other: EchoesT) -> EchoesT:
    """All rows, sorted by pulse; no pulse may be in both."""
    both = type(first).concatenate((first, other))
    return both.take(np.argsort(both.pulse, kind="stable"))


def mix(echoes: EchoesT, is_new: NDArray[np.bool_], *, pulses: int, separation: float) -> EchoesT:
    """Echoes in any order, sorted by pulse and range, and merged as by `merge` where a pulse has new ones.

    Echoes of pulses without new ones stay as they are, in the order in which they come. An echo of several
    has the columns of the one that sends back most, whatever is on the beam's axis.

    is_new : (m,)
    pulses : number of pulses
    """
    m = len(echoes)
    if not is_new.any() and np.all(echoes.pulse[1:] >= echoes.pulse[:-1]):
        return echoes
    bearer, place, power = np.empty(m, np.int64), np.empty(m), np.empty(m)
    columns = echoes.pulse, echoes.range, echoes.apparent, is_new
    count = _mix(columns, pulses, separation, bearer, place, power)
    return replace(echoes.take(bearer[:count]), range=place[:count], apparent=power[:count])


@inline
def insert(row: Any, size: Any, new: Any, distance: Any) -> None:
    """Insert the number ``new`` into the first ``size`` entries of ``row``, which are sorted by distance."""
    j = size
    while j > 0 and distance[row[j - 1]] > distance[new]:
        row[j] = row[j - 1]
        j -= 1
    row[j] = new


@inline
def depth_of(distance: Any, cosine: Any, gap: Any) -> Any:
    """Metres along the beam between neighbouring rays on a surface at this distance and cosine of incidence.

    gap : (2,) as `Gap`
    """
    return (gap[0] + gap[1] * distance) * np.sqrt(1 - cosine * cosine) / max(cosine, _GRAZING)


@inline
def gather(
    row: Any,
    size: Any,
    distance: Any,
    apparent: Any,
    axis: Any,
    depth: Any,
    separation: Any,
    count: Any,
    bearer: Any,
    place: Any,
    power: Any,
) -> Any:
    """Append the echoes of a pulse to ``bearer``, ``place`` and ``power``; return the new number of echoes.

    row      : numbers of its ``size`` surfaces, sorted by range
    distance, apparent, axis, depth : of surfaces, by number; depth as of `depth_of`
    count    : number of echoes so far
    bearer   : number of the surface that describes each echo
    place, power : range and apparent reflectance of each echo
    """
    total = moment = most = central = 0.0
    first, best, middle = 0, row[0], row[0]
    for i in range(size):
        s = row[i]
        r = max(distance[s], 1e-3)
        received = apparent[s] / (r * r)
        if received > most:
            best, most = s, received
        if axis[s]:
            middle, central = s, received
        total += received
        moment += received * distance[s]
        ends = i == size - 1
        if not ends:
            here, next_ = depth[s], depth[row[i + 1]]
            between = max(min(here, next_), 0.5 * max(here, next_))
            ends = distance[row[i + 1]] - distance[s] > separation + between
        if ends:
            bearer[count] = middle if central > _FAINT * most else best
            if i == first or not total > 0.0:
                place[count], power[count] = distance[best], apparent[best]
            else:
                mean = moment / total
                place[count], power[count] = mean, total * mean * mean
            count += 1
            total = moment = most = central = 0.0
            first = i + 1
            best = middle = row[min(i + 1, size - 1)]
    return count


@njit(cache=True, nogil=True)
def _merge(starts: Any, columns: Any, separation: Any, gap: Any, bearer: Any, place: Any, power: Any) -> Any:
    """Fill the columns of the echoes and return their number."""
    distance, apparent, axis, cosine = columns
    depth = np.empty(len(distance))
    for i in range(len(distance)):
        depth[i] = depth_of(distance[i], cosine[i], gap)
    count = 0
    row = np.empty(256, np.int64)
    for p in range(len(starts) - 1):
        first, size = starts[p], starts[p + 1] - starts[p]
        if size > len(row):
            row = np.empty(2 * size, np.int64)
        for i in range(size):
            insert(row, i, first + i, distance)
        count = gather(row, size, distance, apparent, axis, depth, separation, count, bearer, place, power)
    return count


@njit(cache=True, nogil=True)
def _mix(columns: Any, pulses: Any, separation: Any, bearer: Any, place: Any, power: Any) -> Any:
    """Fill the columns of the echoes, pulse by pulse, and return their number."""
    pulse, distance, apparent, is_new = columns
    first = np.zeros(pulses + 1, np.int64)
    changed = np.zeros(pulses, np.bool_)
    for i in range(len(pulse)):
        first[pulse[i] + 1] += 1
        changed[pulse[i]] |= is_new[i]
    for p in range(pulses):
        first[p + 1] += first[p]
    rows = np.empty(len(pulse), np.int64)
    free = first[:-1].copy()
    for i in range(len(pulse)):
        rows[free[pulse[i]]] = i
        free[pulse[i]] += 1
    nowhere, flat = np.zeros(len(pulse), np.bool_), np.zeros(len(pulse))
    row = np.empty(256, np.int64)
    count = 0
    for p in range(pulses):
        size = first[p + 1] - first[p]
        if not changed[p] or size == 1:
            for k in range(first[p], first[p + 1]):
                i = rows[k]
                bearer[count], place[count], power[count] = i, distance[i], apparent[i]
                count += 1
            continue
        if size > len(row):
            row = np.empty(2 * size, np.int64)
        for k in range(size):
            insert(row, k, rows[first[p] + k], distance)
        count = gather(row, size, distance, apparent, nowhere, flat, separation, count, bearer, place, power)
    return count


def number_echoes(echoes: Echoes) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Number of each echo in its pulse, from 1, and echoes of the pulse; rows sorted by pulse and range."""
    number, count = np.empty(len(echoes), np.uint8), np.empty(len(echoes), np.uint8)
    _number(echoes.pulse, number, count)
    return number, count


@njit(cache=True, nogil=True)
def _number(pulse: Any, number: Any, count: Any) -> None:
    """Fill ``number`` and ``count``, see `number_echoes`."""
    start = 0
    for i in range(len(pulse)):
        if i and pulse[i] != pulse[i - 1]:
            start = i
        number[i] = i - start + 1
        for k in range(start, i + 1) if i + 1 == len(pulse) or pulse[i + 1] != pulse[i] else range(0):
            count[k] = i - start + 1


def select_reported(
    echoes: Echoes, amplitude: Float, *, mode: str, most: int, second: bool = False
) -> NDArray[np.int64]:
    """Rows that a sensor reports in a return mode; rows sorted by pulse and range.

    mode   : ``strongest`` (the nearer of equals), ``first``, ``last``, ``dual`` (strongest and last), ``all``
    most   : maximum number of echoes per pulse in ``all``
    second : in ``dual``, report the second strongest too where the strongest echo is the last
    """
    rows = np.empty(len(echoes), np.int64)
    count = _select_reported(echoes.pulse, amplitude, _MODES.index(mode), most, second, rows)
    return rows[:count]


@njit(cache=True, nogil=True)
def _select_reported(pulse: Any, amplitude: Any, mode: Any, most: Any, second: Any, rows: Any) -> Any:
    """Fill ``rows`` with the reported rows and return their number."""
    count, stop = 0, 0
    while stop < len(pulse):
        start = stop
        stop += 1
        while stop < len(pulse) and pulse[stop] == pulse[start]:
            stop += 1
        best, next_best = start, -1
        for i in range(start + 1, stop):
            if amplitude[i] > amplitude[best]:
                best, next_best = i, best
            elif next_best < 0 or amplitude[i] > amplitude[next_best]:
                next_best = i
        for i in range(start, stop):
            last = i == stop - 1
            if (
                (mode == _STRONGEST and i == best)
                or (mode == _FIRST and i == start)
                or (mode == _LAST and last)
                or (mode == _DUAL and (i == best or last or (second and best == stop - 1 and i == next_best)))
                or (mode == _ALL and i - start < most)
            ):
                rows[count] = i
                count += 1
    return count
