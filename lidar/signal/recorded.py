"""Stages on recorded point clouds, whose returns serve as the echoes of their pulses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.physics.detector import quantise
from lidar.sensors.physics.echoes import Echoes, TracedEchoes, number_echoes, select_reported, trace
from lidar.sensors.physics.link import apparent_of_code, reflectivity_code
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.patterns.beams import Firings, T, unit_vectors
from lidar.sensors.rig.scanner import Sensor, firings
from lidar.signal.registry import Stages
from lidar.signal.run import altered_cloud, altered_echoes, link_truth
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, pulses_of
from lidar.signal.truth import Altered, trace_unaltered

_SEEN = 1 + 1e-9  # power over the threshold that a recorded return had at least
_CODES = 256  # most values of intensities that are whole codes
_ON_STEP = 0.1  # share of the range's step by which rounded coordinates put a range off it


def altered_recording(
    cloud: Cloud,
    stages: Stages,
    *,
    sensor: Sensor,
    at: Situation,
    sent: Firings | None,
    threshold: bool = True,
) -> Altered:
    """A recorded cloud after the stages on its echoes and on the cloud itself.

    Each return is one echo, with the power that its intensity and range imply; pulses without a return have
    none. Ranges get no further noise; new ranges and intensities have the steps of the recorded ones.

    sensor    : the scanner that recorded the cloud
    sent      : the pulses that it fired, by ring and column; None if these are derived from directions. The
        pulses without a return then fill the gaps of azimuth in each ring; only spinning scanners have any
    threshold : echoes whose power falls to the detection threshold are lost
    """
    if not stages.at("echoes", at.sensor) or (sent is not None and not len(sent)):
        return Altered(altered_cloud(trace_unaltered(cloud).cloud, stages, at=at), cloud)
    pulses, echoes = recorded_echoes(cloud, sensor, sent=sent)
    if threshold:
        least = pulses.apparent(np.full(len(echoes), _SEEN), echoes.range)
        echoes = replace(echoes, apparent=np.maximum(echoes.apparent, least))
    found = altered_echoes(pulses, echoes, stages=stages, at=at)
    away = found.range + sensor.pattern.range_offset
    keep = (found.source >= 0) | ((away >= sensor.min_range) & (away <= sensor.max_range))
    if threshold:
        keep &= pulses.received(found) > 1
    found = found.where(keep)
    power, (number, count) = pulses.received(found), number_echoes(found)
    rows = select_reported(
        found, power, mode=sensor.return_mode, most=sensor.max_echoes, second=sensor.second_strongest
    )
    # A pulse without added echoes has passed the return mode already.
    keep = ~np.isin(found.pulse, found.pulse[found.source < 0])
    keep[rows] = True
    found, numbers = found.where(keep), (number[keep], count[keep])
    result = _cloud(cloud, found, pulses=pulses, before=echoes, numbers=numbers)
    linked_cloud = link_truth(result, found, first=echoes)
    return Altered(altered_cloud(linked_cloud, stages, at=at), cloud)


def recorded_echoes(cloud: Cloud, sensor: Sensor, *, sent: Firings | None) -> tuple[Pulses, TracedEchoes]:
    """The pulses of a recorded frame, and its returns as their echoes; ``sent`` as of `altered_recording`."""
    pulses, pulse = recorded_pulses(cloud, sensor, sent=sent)
    return pulses, _echoes(cloud, sensor, pulse=pulse)


def _echoes(cloud: Cloud, sensor: Sensor, *, pulse: NDArray[np.int32]) -> TracedEchoes:
    n, offset = len(cloud), sensor.pattern.range_offset
    echoes = Echoes(
        pulse,
        cloud.range - offset,
        apparent_of_code(cloud.intensity, diffuse_code=sensor.diffuse_code),
        cloud.feature,
        cloud.klass,
        np.cos(cloud.incidence.astype(np.float64)),
        cloud.true_range - offset,
        np.ones(n, bool),
    )
    return trace(echoes, Origin.SURFACE, source=np.arange(n))


def _cloud(
    cloud: Cloud,
    echoes: TracedEchoes,
    *,
    pulses: Pulses,
    before: TracedEchoes,
    numbers: tuple[NDArray[np.uint8], NDArray[np.uint8]],
) -> Cloud:
    """The cloud of echoes that are reported; columns of echoes that did not change stay as they are."""
    sensor, is_known = pulses.sensor, echoes.source >= 0
    first = np.full(len(pulses), len(cloud))  # past the last one for pulses without a return
    first[before.pulse[::-1]] = np.arange(len(cloud))[::-1]
    row = np.where(is_known, echoes.source, first[echoes.pulse])
    direction = pulses.direction[echoes.pulse]
    near = pulses.origin[echoes.pulse] - sensor.pattern.range_offset * direction
    xyz = np.where((row < len(cloud))[:, None], _at(cloud.xyz, row), near).astype(np.float64)
    old = _at(cloud.range, row)
    distance = echoes.range + sensor.pattern.range_offset
    moved = ~is_known | (echoes.range != _at(before.range, row))
    distance = np.where(moved, _step(distance, cloud.range, step=sensor.range_quantum), old)
    xyz += (distance - old)[:, None] * direction
    brighter = ~is_known | (echoes.apparent != _at(before.apparent, row))
    code = _encode(reflectivity_code(echoes.apparent, diffuse_code=sensor.diffuse_code), cloud.intensity)
    number, count = numbers
    return replace(
        cloud,
        xyz=xyz.astype(np.float32),
        time_ns=(pulses.time_ns[echoes.pulse] - cloud.start_ns).astype(np.int32),
        ring=pulses.ring[echoes.pulse],
        column=pulses.column[echoes.pulse],
        range=distance,
        intensity=np.where(brighter, code, _at(cloud.intensity, row)),
        klass=echoes.klass,
        feature=echoes.feature,
        incidence=np.where(is_known, _at(cloud.incidence, row), np.float32(0)),
        true_range=np.where(is_known, _at(cloud.true_range, row), 0.0),
        echo=np.where(is_known, _at(cloud.echo, row), number),
        echoes=np.where(is_known, _at(cloud.echoes, row), count),
    )


def _at(column: NDArray[T], row: NDArray[np.integer]) -> NDArray[T]:
    """Rows of a column; 0 for the one past the last."""
    padded: NDArray[T] = np.concatenate([column, np.zeros((1, *column.shape[1:]), column.dtype)])
    found: NDArray[T] = padded[row]
    return found


def _step(distance: Float, recorded: Float, *, step: float) -> Float:
    """Ranges (m,), rounded to the sensor's step if recorded ones (n,) are."""
    if not step or not len(recorded):
        return distance
    off = np.abs(recorded / step - np.round(recorded / step))
    return quantise(distance, step) if np.percentile(off, 99) < _ON_STEP else distance


def _encode(intensity: NDArray[np.float32], recorded: NDArray[np.float32]) -> NDArray[np.float32]:
    """Intensities (m,), rounded to the nearest recorded value if these are few (integer codes)."""
    values = np.unique(recorded)
    if not 0 < len(values) <= min(_CODES, len(recorded) // 2):
        return intensity
    return values[np.searchsorted((values[1:] + values[:-1]) / 2, intensity)]


Rows = NDArray[np.int64]

_SAME_RING = 0.5
"""Share of neighbouring rows of one ring over which a file goes ring by ring."""


def recorded_pulses(
    cloud: Cloud, sensor: Sensor, *, sent: Firings | None
) -> tuple[Pulses, NDArray[np.int32]]:
    """All pulses of a frame, and the row (n,) of the pulse of each return, ascending.

    Pulses with a return have its direction; the others have that of the firing pattern.

    sent : as of `lidar.signal.recorded.altered_recording`
    """
    number = _pulse_numbers(cloud)
    first = np.flatnonzero(np.diff(number, prepend=-1))
    nominal = firings(sensor, 0) if sent is None else sent
    fired = _find_pulse(nominal, ring=cloud.ring[first], column=cloud.column[first])
    returned = _select_returned(cloud, sensor, first=first, nominal=nominal, fired=fired)
    if sent is None:
        empty, place = _in_gaps(returned, nominal, start_ns=cloud.start_ns)
        order = np.concatenate([np.arange(len(first)), place])
    else:
        rest = np.ones(len(sent), bool)
        rest[fired[fired >= 0]] = False
        empty = pulses_of(sensor, sent.where(rest))
        order = np.concatenate([np.maximum.accumulate(fired), np.flatnonzero(rest)])
    rows = np.argsort(order, kind="stable")
    rank = np.empty(len(rows), np.int32)
    rank[rows] = np.arange(len(rows))
    return Pulses.concatenate((returned, empty)).take(rows), rank[number]


def _pulse_numbers(cloud: Cloud) -> Rows:
    """Number (n,) of each return's pulse among those with returns; returns of one pulse follow each other."""
    if cloud.echoes.max(initial=1) == 1:
        return np.arange(len(cloud))
    same = np.ones(len(cloud), bool)
    for column in (cloud.time_ns, cloud.ring, cloud.column):
        same &= np.diff(column.astype(np.int64), prepend=-1) == 0
    return np.cumsum(~same) - 1


def _find_pulse(sent: Firings, *, ring: NDArray[Any], column: NDArray[Any]) -> Rows:
    """Row (k,) in ``sent`` of the pulses of a ring and a column; -1 for those that are not fired."""
    width, height = (int(part.max(initial=0)) + 1 for part in (sent.column, sent.ring))
    row = np.full((width, height), -1)
    row[sent.column, sent.ring] = np.arange(len(sent))
    is_known = (column >= 0) & (column < width) & (ring < height)
    return np.where(is_known, row[np.where(is_known, column, 0), np.where(is_known, ring, 0)], -1)


def _select_returned(cloud: Cloud, sensor: Sensor, *, first: Rows, nominal: Firings, fired: Rows) -> Pulses:
    """The pulses with returns, in the order of these.

    first : (k,) first return of each
    fired : (k,) its row in ``nominal``, or -1
    """
    ring, column = cloud.ring[first], cloud.column[first]
    origin = _origins(nominal, ring=ring, column=column, fired=fired)
    xyz = cloud.xyz[first] - origin
    return Pulses(
        sensor,
        cloud.start_ns + cloud.time_ns[first].astype(np.int64),
        xyz / np.maximum(np.linalg.norm(xyz, axis=1, keepdims=True), 1e-9),
        origin,
        ring,
        column,
        _channels(nominal, ring=ring, fired=fired),
        np.ones(len(first)),
    )


def _origins(nominal: Firings, *, ring: NDArray[Any], column: NDArray[Any], fired: Rows) -> Float:
    """Origins (k, 3) of the beams of rings and columns, metres, sensor frame."""
    if not nominal.origin.any():
        return np.zeros((len(ring), 3))
    # The first and last block of a frame may lack a pulse; that of the next block starts within 1 mm.
    width = int(nominal.column.max()) + 1
    inner = np.clip(column, min(1, width - 1), max(width - 2, 0))
    lower = np.minimum(ring, nominal.ring.max())
    found: Float = nominal.origin[np.where(fired >= 0, fired, _find_pulse(nominal, ring=lower, column=inner))]
    return found


def _channels(nominal: Firings, *, ring: NDArray[Any], fired: Rows) -> NDArray[np.uint16]:
    """Laser of each pulse (k,); of one that is not fired, a laser of its ring."""
    channel = np.zeros(int(nominal.ring.max(initial=0)) + 1, np.uint16)
    channel[nominal.ring] = nominal.channel
    known: NDArray[np.uint16] = np.where(
        fired >= 0, nominal.channel[fired], channel[np.minimum(ring, len(channel) - 1)]
    )
    return known


def _in_gaps(returned: Pulses, nominal: Firings, *, start_ns: int) -> tuple[Pulses, Float]:
    """The pulses without a return of a spinning scanner, and their places (k,) among the rows of the others.

    They fill the gaps of azimuth between the returns of each ring, in steps of the scanner. A ring without
    returns has all pulses of the data sheet. With the others they are no more than are fired in a turn. Of
    scanners of other kinds none are known.
    """
    nothing = np.empty(0, np.int64)
    if returned.sensor.kind != "spinning":
        return pulses_of(returned.sensor, nominal.take(nothing)), np.empty(0)
    azimuth = _azimuth(returned.direction)
    by_ring = np.lexsort((azimuth, returned.ring))
    ring = returned.ring[by_ring].astype(np.int64)
    count = np.bincount(nominal.ring)
    starts = np.flatnonzero(np.diff(ring, prepend=-1))
    following = np.arange(1, len(ring) + 1)
    following[np.append(starts[1:], len(ring))[: len(starts)] - 1] = starts
    left, right = by_ring, by_ring[following]
    gap = (azimuth[right] - azimuth[left]) % (2 * np.pi)
    gap[left == right] = 2 * np.pi
    missing = np.maximum(np.rint(gap * count[np.minimum(ring, len(count) - 1)] / (2 * np.pi)) - 1, 0)
    of = np.repeat(np.arange(len(ring)), missing.astype(np.int64))
    before = np.concatenate([[0], np.cumsum(missing)[:-1]]) if len(missing) else np.empty(0)
    share = (np.arange(len(of)) - before[of] + 1) / (missing[of] + 1)
    bare = np.flatnonzero(~np.isin(nominal.ring, ring))
    on_ring = np.concatenate([ring[of], nominal.ring[bare].astype(np.int64)])
    turned = np.concatenate([azimuth[left][of] + share * gap[of], _azimuth(nominal.direction[bare])])
    column, time_ns = nearest_columns(nominal, (turned + np.pi) % (2 * np.pi) - np.pi)
    fired = _find_pulse(nominal, ring=on_ring, column=column)
    pulses = Pulses(
        returned.sensor,
        start_ns + time_ns,
        unit_vectors(turned, _elevations(returned, nominal)[np.minimum(on_ring, len(count) - 1)]),
        _origins(nominal, ring=on_ring, column=column, fired=fired),
        on_ring.astype(np.uint16),
        column,
        _channels(nominal, ring=on_ring, fired=fired),
        np.ones(len(on_ring)),
    )
    free = _free(pulses, returned, most=len(nominal) - len(returned))
    goes_by_ring = len(returned) > 1 and np.mean(np.diff(returned.ring) == 0) > _SAME_RING
    if not goes_by_ring:
        return pulses.take(free), _beside(returned.column, column[free])
    # Rows run on across a gap, unless the turn begins in it.
    across = (right - left)[of]
    low, high = np.full(int(ring.max()) + 1, len(ring)), np.zeros(int(ring.max()) + 1, np.int64)
    np.minimum.at(low, ring, by_ring)
    np.maximum.at(high, ring, by_ring)
    is_start = np.abs(across) > (high - low)[ring[of]] / 2
    place = np.where(is_start, high[ring[of]] + share, left[of] + share * across)
    width = int(nominal.column.max()) + 1
    order = returned.ring.astype(np.int64) * width + returned.column
    place = np.concatenate([place, _beside(order, (on_ring * width + column)[len(of) :])])
    return pulses.take(free), place[free]


def _free(candidates: Pulses, returned: Pulses, *, most: int) -> Rows:
    """At most so many rows of candidates, ascending: those farthest from the directions of all returns.

    Rings that are derived from directions are wrong where clouds are compensated for the vehicle's motion, so
    that candidates lie among returns of other rings.
    """
    if len(candidates) <= most or not len(returned):
        return np.arange(len(candidates))
    from scipy.spatial import cKDTree  # noqa: PLC0415  (0.1 s)

    away, _ = cKDTree(returned.direction).query(candidates.direction)
    return np.sort(np.argsort(-away, kind="stable")[: max(most, 0)])


def _azimuth(direction: NDArray[np.floating]) -> Float:
    """Radians (n,) from the x axis, counter-clockwise."""
    x, y, _ = direction.T.astype(np.float64)
    found: Float = np.arctan2(y, x)
    return found


def _elevations(returned: Pulses, nominal: Firings) -> Float:
    """Elevation of each ring in radians: the median of its returns, or that of the data sheet."""
    found = np.zeros(int(nominal.ring.max()) + 1)
    found[nominal.ring] = np.arcsin(nominal.direction[:, 2])
    up = np.arcsin(returned.direction[:, 2])
    for ring in np.unique(returned.ring[returned.ring < len(found)]):
        found[ring] = np.median(up[returned.ring == ring])
    return found


def _beside(known: NDArray[np.integer], wanted: NDArray[np.integer]) -> Float:
    """Place (k,) among rows (n,): after the one with the nearest number."""
    if not len(known):
        return np.zeros(len(wanted))
    place: Float = nearest(known, wanted) + np.float64(0.5)
    return place


def complete(cloud: Cloud, sensor: Sensor, *, columns: tuple[str, ...]) -> Cloud:
    """A cloud with ring, column and time, derived from the points' directions if its format lacks them."""
    if "column" in columns:
        return cloud
    pulses = firings(sensor, 0)
    ring = cloud.ring if "ring" in columns else _nearest_rings(pulses, cloud.xyz)
    column, time_ns = nearest_columns(pulses, _azimuth(cloud.xyz))
    return replace(cloud, ring=ring, column=column, time_ns=time_ns.astype(np.int32))


def _nearest_rings(nominal: Firings, xyz: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Ring (n,) whose beam passes nearest to each point."""
    count, level = np.bincount(nominal.ring), np.hypot(xyz[:, 0], xyz[:, 1]).astype(np.float64)
    flat = nominal.direction * [1, 1, 0] / np.linalg.norm(nominal.direction[:, :2], axis=1)[:, None]
    ahead = np.bincount(nominal.ring, np.einsum("ij,ij->i", nominal.origin, flat)) / count
    above = np.bincount(nominal.ring, nominal.origin[:, 2]) / count
    rise = np.bincount(nominal.ring, nominal.direction[:, 2]) / count
    nearest_ring, least = np.zeros(len(xyz), np.uint16), np.full(len(xyz), np.inf)
    for ring, up in enumerate(rise):
        away = np.abs((xyz[:, 2] - above[ring]) * np.sqrt(1 - up * up) - (level - ahead[ring]) * up)
        closer = away < least
        nearest_ring[closer], least[closer] = ring, away[closer]
    return nearest_ring


def nearest_columns(
    nominal: Firings, azimuth: NDArray[np.floating]
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Column (n,) of the lowest ring that is nearest to each azimuth, and its time after the first."""
    bottom = nominal.take(np.flatnonzero(nominal.ring == 0))
    row = nearest(_azimuth(bottom.direction), azimuth, period=2 * np.pi)
    return bottom.column[row], bottom.time_ns[row] - bottom.time_ns[0]


def nearest(known: NDArray[Any], wanted: NDArray[Any], *, period: float = 0.0) -> Rows:
    """Index (n,) of the nearest of known values; with a period, of angles."""
    order = np.argsort(known)
    values = known[order]
    if period:
        values = np.concatenate([values[-1:] - period, values, values[:1] + period])
        order = np.concatenate([order[-1:], order, order[:1]])
    right = np.clip(np.searchsorted(values, wanted), 1, len(values) - 1)
    found: Rows = order[np.where(wanted - values[right - 1] < values[right] - wanted, right - 1, right)]
    return found
