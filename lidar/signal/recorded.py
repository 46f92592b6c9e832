"""Stages on recorded point clouds, whose returns serve as the echoes of their pulses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.physics.echoes import Echoes, TracedEchoes, number_echoes, select_reported, trace
from lidar.sensors.physics.intensity import apparent_of_code, reflectivity_code
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.range_error import quantise
from lidar.sensors.rig.patterns.beams import Firings, T
from lidar.sensors.rig.scanner import Sensor
from lidar.signal.recorded_pulses import recorded_pulses
from lidar.signal.registry import Stages
from lidar.signal.run import Altered, altered_cloud, altered_echoes, link_truth, trace_unaltered
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses

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
