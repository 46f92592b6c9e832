"""Stages on recorded point clouds, whose returns serve as the echoes of their pulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lidar.physics.echoes import Echoes, Origin, TracedEchoes, numbered, reported, traced
from lidar.physics.intensity import apparent_of_code, reflectivity_code
from lidar.rig.scanner import Sensor
from lidar.sensors.cloud import Cloud
from lidar.signal.registry import Stages
from lidar.signal.run import Altered, altered_cloud, altered_echoes, linked
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses

_SEEN = 1 + 1e-9  # power over the threshold that a recorded return had at least


def altered_recording(
    cloud: Cloud, stages: Stages, *, sensor: Sensor, at: Situation, threshold: bool = True
) -> Altered:
    """A recorded cloud after the stages on its echoes and on the cloud itself.

    Each return is one echo, with the power that its intensity and range imply; pulses without a return are
    unknown, so that echo stages add nothing to them. Ranges get no further noise.

    sensor    : the scanner that recorded the cloud
    threshold : echoes whose power falls to the detection threshold are lost
    """
    pulse = _pulse_rows(cloud)
    pulses, echoes = _pulses(cloud, sensor, pulse=pulse), _echoes(cloud, sensor, pulse=pulse)
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
        result = _cloud(cloud, found, sensor=sensor, before=echoes, numbers=numbers)
    linked_cloud = linked(result, found, first=echoes)
    return Altered(altered_cloud(linked_cloud, stages, at=at), cloud)


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
    xyz = cloud.xyz[first].astype(np.float64)
    return Pulses(
        sensor,
        cloud.start_ns + cloud.time_ns[first].astype(np.int64),
        xyz / np.maximum(np.linalg.norm(xyz, axis=1, keepdims=True), 1e-9),
        np.zeros((len(first), 3)),
        cloud.ring[first],
        cloud.column[first],
        cloud.ring[first],
        np.ones(len(first)),
    )


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
    sensor: Sensor,
    before: TracedEchoes,
    numbers: tuple[NDArray[np.uint8], NDArray[np.uint8]],
) -> Cloud:
    """The cloud of echoes that are reported; columns of echoes that did not change stay as they are."""
    first = np.flatnonzero(np.diff(before.pulse, prepend=-1))
    is_known = echoes.source >= 0
    row = np.where(is_known, echoes.source, first[echoes.pulse])
    xyz, old = cloud.xyz[row].astype(np.float64), cloud.range[row]
    distance = echoes.range + sensor.pattern.range_offset
    moved = ~is_known | (echoes.range != before.range[row])
    length = np.linalg.norm(xyz[moved], axis=1, keepdims=True)
    xyz[moved] *= 1 + (distance - old)[moved, None] / np.maximum(length, 1e-9)
    brighter = ~is_known | (echoes.apparent != before.apparent[row])
    code = reflectivity_code(echoes.apparent, diffuse_code=sensor.diffuse_code)
    number, count = numbers
    return replace(
        cloud,
        xyz=xyz.astype(np.float32),
        time_ns=cloud.time_ns[row],
        ring=cloud.ring[row],
        column=cloud.column[row],
        range=np.where(moved, distance, old),
        intensity=np.where(brighter, code, cloud.intensity[row]),
        klass=echoes.klass,
        feature=echoes.feature,
        incidence=np.where(is_known, cloud.incidence[row], np.float32(0)),
        true_range=np.where(is_known, cloud.true_range[row], 0.0),
        echo=np.where(is_known, cloud.echo[row], number),
        echoes=np.where(is_known, cloud.echoes[row], count),
    )
