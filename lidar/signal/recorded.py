"""Stages on recorded point clouds, whose returns serve as the echoes of their pulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.physics.echoes import Echoes, Origin, TracedEchoes, numbered, reported, traced
from lidar.physics.intensity import apparent_of_code, reflectivity_code
from lidar.physics.range_error import quantised
from lidar.rig.scanner import Sensor, firings
from lidar.sensors.cloud import Cloud
from lidar.signal.registry import Stages
from lidar.signal.run import Altered, altered_cloud, altered_echoes, linked
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses

_SEEN = 1 + 1e-9  # power over the threshold that a recorded return had at least
_CODES = 256  # most values of intensities that are whole codes
_ON_STEP = 0.1  # share of the range's step by which rounded coordinates put a range off it


def altered_recording(
    cloud: Cloud, stages: Stages, *, sensor: Sensor, at: Situation, threshold: bool = True
) -> Altered:
    """A recorded cloud after the stages on its echoes and on the cloud itself.

    Each return is one echo, with the power that its intensity and range imply; pulses without a return are
    unknown, so that echo stages add nothing to them. Ranges get no further noise; new ranges and intensities
    have the steps of the recorded ones.

    sensor    : the scanner that recorded the cloud
    threshold : echoes whose power falls to the detection threshold are lost
    """
    pulses, echoes = recorded_echoes(cloud, sensor)
    if threshold:
        least = pulses.apparent(np.full(len(echoes), _SEEN), echoes.range)
        echoes = replace(echoes, apparent=np.maximum(echoes.apparent, least))
    found, result = echoes, cloud
    if stages.at("echoes", at.sensor):
        found = altered_echoes(pulses, echoes, stages=stages, at=at)
        away = found.range + sensor.pattern.range_offset
        keep = (found.source >= 0) | ((away >= sensor.min_range) & (away <= sensor.max_range))
        if threshold:
            keep &= pulses.received(found) > 1
        found = found.where(keep)
        power, (number, count) = pulses.received(found), numbered(found)
        rows = reported(
            found, power, mode=sensor.return_mode, most=sensor.max_echoes, second=sensor.second_strongest
        )
        # A pulse without added echoes has passed the return mode already.
        keep = ~np.isin(found.pulse, found.pulse[found.source < 0])
        keep[rows] = True
        found, numbers = found.where(keep), (number[keep], count[keep])
        result = _cloud(cloud, found, pulses=pulses, before=echoes, numbers=numbers)
    linked_cloud = linked(result, found, first=echoes)
    return Altered(altered_cloud(linked_cloud, stages, at=at), cloud)


def recorded_echoes(cloud: Cloud, sensor: Sensor) -> tuple[Pulses, TracedEchoes]:
    """The pulses of a recorded cloud's returns, and these as their echoes."""
    pulse = _pulse_rows(cloud)
    return _pulses(cloud, sensor, pulse=pulse), _echoes(cloud, sensor, pulse=pulse)


def _pulse_rows(cloud: Cloud) -> NDArray[np.int32]:
    """Pulse (n,) of each return; returns of one pulse follow each other."""
    if cloud.echoes.max(initial=1) == 1:
        return np.arange(len(cloud), dtype=np.int32)
    same = np.ones(len(cloud), bool)
    for column in (cloud.time_ns, cloud.ring, cloud.column):
        same &= np.diff(column.astype(np.int64), prepend=-1) == 0
    return (np.cumsum(~same) - 1).astype(np.int32)


def _pulses(cloud: Cloud, sensor: Sensor, *, pulse: NDArray[np.int32]) -> Pulses:
    first = np.flatnonzero(np.diff(pulse, prepend=-1))
    origin = _origins(cloud, sensor)[first]
    xyz = cloud.xyz[first] - origin
    return Pulses(
        sensor,
        cloud.start_ns + cloud.time_ns[first].astype(np.int64),
        xyz / np.maximum(np.linalg.norm(xyz, axis=1, keepdims=True), 1e-9),
        origin,
        cloud.ring[first],
        cloud.column[first],
        cloud.ring[first],
        np.ones(len(first)),
    )


def _origins(cloud: Cloud, sensor: Sensor) -> Float:
    """Where the beam of each return (n, 3) starts in the sensor frame, by its ring and column."""
    sent = firings(sensor, 0)
    if not sent.origin.any():
        return np.zeros((len(cloud), 3))
    width = int(sent.column.max()) + 1
    row = np.zeros(width * (int(sent.ring.max()) + 1), np.int64)
    row[sent.ring.astype(np.int64) * width + sent.column] = np.arange(len(sent))
    # The first and last firing block of a frame may be incomplete; their neighbours start within 1 mm.
    column = np.clip(cloud.column, min(1, width - 1), max(width - 2, 0))
    ring = np.minimum(cloud.ring, sent.ring.max()).astype(np.int64)
    found: Float = sent.origin[row[ring * width + column]]
    return found


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
    return traced(echoes, Origin.SURFACE, source=np.arange(n))


def _cloud(
    cloud: Cloud,
    echoes: TracedEchoes,
    *,
    pulses: Pulses,
    before: TracedEchoes,
    numbers: tuple[NDArray[np.uint8], NDArray[np.uint8]],
) -> Cloud:
    """The cloud of echoes that are reported; columns of echoes that did not change stay as they are."""
    sensor, first = pulses.sensor, np.flatnonzero(np.diff(before.pulse, prepend=-1))
    is_known = echoes.source >= 0
    row = np.where(is_known, echoes.source, first[echoes.pulse])
    xyz, old = cloud.xyz[row].astype(np.float64), cloud.range[row]
    distance = echoes.range + sensor.pattern.range_offset
    moved = ~is_known | (echoes.range != before.range[row])
    distance = np.where(moved, _stepped(distance, cloud.range, step=sensor.range_quantum), old)
    xyz += (distance - old)[:, None] * pulses.direction[echoes.pulse]
    brighter = ~is_known | (echoes.apparent != before.apparent[row])
    code = _coded(reflectivity_code(echoes.apparent, diffuse_code=sensor.diffuse_code), cloud.intensity)
    number, count = numbers
    return replace(
        cloud,
        xyz=xyz.astype(np.float32),
        time_ns=cloud.time_ns[row],
        ring=cloud.ring[row],
        column=cloud.column[row],
        range=distance,
        intensity=np.where(brighter, code, cloud.intensity[row]),
        klass=echoes.klass,
        feature=echoes.feature,
        incidence=np.where(is_known, cloud.incidence[row], np.float32(0)),
        true_range=np.where(is_known, cloud.true_range[row], 0.0),
        echo=np.where(is_known, cloud.echo[row], number),
        echoes=np.where(is_known, cloud.echoes[row], count),
    )


def _stepped(distance: Float, recorded: Float, *, step: float) -> Float:
    """Ranges (m,), rounded to the sensor's step if recorded ones (n,) are."""
    if not step or not len(recorded):
        return distance
    off = np.abs(recorded / step - np.round(recorded / step))
    return quantised(distance, step) if np.percentile(off, 99) < _ON_STEP else distance


def _coded(intensity: NDArray[np.float32], recorded: NDArray[np.float32]) -> NDArray[np.float32]:
    """Intensities (m,), each the nearest recorded value if there are few of these, as of whole codes."""
    values = np.unique(recorded)
    if not 0 < len(values) <= min(_CODES, len(recorded) // 2):
        return intensity
    return values[np.searchsorted((values[1:] + values[:-1]) / 2, intensity)]
