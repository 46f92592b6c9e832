"""One frame of a scanner in the world."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory
from lidar.physics.echoes import Echoes, joined, numbered, reported
from lidar.physics.effects import PLAIN, Effects
from lidar.physics.intensity import reflectivity_code
from lidar.physics.returns import detected, false_echoes, measured_range, received
from lidar.random_streams import generator
from lidar.rig.patterns.beams import Firings
from lidar.rig.scanner import Sensor, firings
from lidar.sensors.cloud import Cloud
from lidar.sensors.motion import beam_of
from lidar.sensors.surfaces import met
from lidar.world.world import World


def scan(
    sensor: Sensor,
    mount: Mount,
    *,
    trajectory: Trajectory,
    world: World,
    frame: int,
    seed: int = 0,
    effects: Effects = PLAIN,
    threads: int = 1,
) -> Cloud:
    """What the sensor reports in frame ``frame`` of the drive, in the order it was fired.

    Actors of the world are where their ray times say, which run from 0 to 1 over `Sensor.window_ns`. The same
    seed, sensor name and frame give the same cloud, whatever was scanned before.

    Raises BackendError if the ray engine does not work here.
    """
    pulses = firings(sensor, frame)
    if not effects.motion:
        pulses = replace(pulses, time_ns=np.full_like(pulses.time_ns, pulses.time_ns[0]))
    offset = sensor.pattern.range_offset
    bent = pulses
    if effects.angle_noise:
        bent = _unsteady(pulses, sensor, rng=generator(seed, sensor.name, frame, "angle"))
    echoes = met(
        bent,
        mount,
        trajectory=trajectory,
        world=world,
        beam=beam_of(effects.rays, divergence=sensor.divergence, aperture=sensor.aperture),
        far=sensor.max_range - offset,
        wavelength_nm=sensor.wavelength_nm,
        separation=sensor.echo_separation,
        time=_ray_time(sensor, frame, pulses=pulses) if _moving(world) else None,
        effects=effects,
        seed=seed,
        leaf_seed=int(generator(seed, sensor.name, frame, "foliage").integers(2**63)),
        threads=threads,
    )
    echoes = echoes.where(echoes.range + offset >= sensor.min_range)
    if effects.link or effects.detection:
        echoes = detected(
            sensor, echoes, effects=effects, rng=generator(seed, sensor.name, frame, "detection")
        )
    false = false_echoes(sensor, pulses, echoes=echoes, effects=effects, seed=seed, frame=frame)
    echoes = joined(echoes, *false)
    number, count = numbered(echoes)
    if effects.rays > 1 or effects.mirrors or false:
        power = received(sensor, echoes, effects=effects)
        rows = reported(
            echoes, power, mode=sensor.return_mode, most=sensor.max_echoes, second=sensor.second_strongest
        )
        echoes, number, count = echoes.take(rows), number[rows], np.minimum(count[rows], sensor.max_echoes)
    distance = measured_range(sensor, pulses, echoes=echoes, effects=effects, seed=seed, frame=frame)
    keep = (distance >= sensor.min_range) & (distance <= sensor.max_range)
    echoes, distance, number, count = echoes.where(keep), distance[keep], number[keep], count[keep]
    return _cloud(
        sensor, pulses, echoes=echoes, distance=distance, number=number, count=count, effects=effects
    )


def _cloud(
    sensor: Sensor,
    pulses: Firings,
    *,
    echoes: Echoes,
    distance: Float,
    number: NDArray[np.uint8],
    count: NDArray[np.uint8],
    effects: Effects,
) -> Cloud:
    pulse, offset, start = echoes.pulse, sensor.pattern.range_offset, int(pulses.time_ns[0])
    n = len(pulse)
    xyz, time = np.empty((n, 3), np.float32), np.empty(n, np.int32)
    _place(pulse, distance - offset, pulses.origin, pulses.direction, pulses.time_ns, xyz, time)
    code = reflectivity_code(echoes.apparent, diffuse_code=sensor.diffuse_code, whole=effects.quantise)
    real = echoes.true_range > 0
    return Cloud(
        start_ns=start,
        xyz=xyz,
        time_ns=time,
        ring=pulses.ring[pulse],
        column=pulses.column[pulse],
        range=distance,
        intensity=code,
        klass=echoes.klass,
        feature=echoes.feature,
        incidence=np.arccos(echoes.cosine).astype(np.float32),
        true_range=np.where(real, echoes.true_range + offset, 0.0),
        echo=number,
        echoes=count,
    )


@njit(cache=True, nogil=True)
def _place(pulse: Any, reach: Any, origin: Any, direction: Any, time_ns: Any, xyz: Any, time: Any) -> None:
    """Fill ``xyz`` and ``time`` of returns."""
    for i in range(len(pulse)):
        p = pulse[i]
        xyz[i, 0] = origin[p, 0] + reach[i] * direction[p, 0]
        xyz[i, 1] = origin[p, 1] + reach[i] * direction[p, 1]
        xyz[i, 2] = origin[p, 2] + reach[i] * direction[p, 2]
        time[i] = time_ns[p] - time_ns[0]


def _unsteady(pulses: Firings, sensor: Sensor, *, rng: np.random.Generator) -> Firings:
    """The pulses where they really go, which is not quite where the sensor says."""
    bent = pulses.direction + sensor.angle_sigma * rng.standard_normal((len(pulses), 3))
    return replace(pulses, direction=bent / np.linalg.norm(bent, axis=1, keepdims=True))


def _moving(world: World) -> bool:
    """Whether anything in the world moves during a frame."""
    return any(group.transform.ndim == 4 for group in world.caster.instances)


def _ray_time(sensor: Sensor, frame: int, *, pulses: Firings) -> NDArray[np.float32]:
    """Ray times of the pulses, 0 to 1 over the frame's window."""
    start, stop = sensor.window_ns(frame)
    share: NDArray[np.float32] = ((pulses.time_ns - start) / (stop - start)).astype(np.float32)
    return share
