"""Echoes of the surfaces that the pulses of a frame hit, also behind glass and in mirrors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.raycast import Hits
from lidar.raycast.hits import own_faces
from lidar.sensors.laser.foliage import Foliage
from lidar.sensors.laser.rays import MovingSensor, PulseRays, beam_of
from lidar.sensors.laser.reflection import EchoCollector, SurfaceOptics, glossy_codes
from lidar.sensors.physics.echoes import Echoes, by_pulse, join, merge
from lidar.sensors.physics.fresnel import pane_reflection, reflect, surface_reflection
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.scanner import Sensor
from lidar.world.world import World

_MAX_PANES = 4  # panes that a ray may pass
_CLEAR = 1e-3  # metres beyond a surface at which the next ray starts
_BATCH = 1 << 15  # rays per batch, so that their columns stay in the processor's cache


def surface_echoes(
    pulses: Firings,
    mount: Mount,
    *,
    sensor: Sensor,
    trajectory: Trajectory,
    world: World,
    time: NDArray[np.float32] | None,
    settings: ScannerSettings,
    seed: int,
    frame: int,
    threads: int,
) -> Echoes:
    """The echoes of pulses that a moving sensor fires, within its maximum range, sorted by pulse and range.

    time        : (n,) ray times of the pulses; None in a static world
    seed, frame : of random reflectances, leaves, and turns of each pulse's rays about its axis
    """
    rays, turn = settings.rays, np.empty(0)
    if rays > 1:
        turn = 2 * np.pi * generator(seed, sensor.name, frame, "footprint").random(len(pulses))
    beam = beam_of(rays, divergence=sensor.divergence, aperture=sensor.aperture, turn=turn)
    far = min(sensor.max_range - sensor.pattern.range_offset, world.reach)
    separation = sensor.echo_separation
    batch = max(_BATCH // rays, 1)
    optics = SurfaceOptics(world, sensor.wavelength_nm, settings=settings, seed=seed)
    moving = MovingSensor(pulses, mount, trajectory=trajectory, beam=beam, batch=batch)
    collector = EchoCollector(optics, beam, separation=separation, pulses=len(pulses))
    foliage = None
    if settings.foliage:
        leaf_seed = int(generator(seed, sensor.name, frame, "foliage").integers(2**63))
        foliage = Foliage(world.caster, world.faces, far, leaf_seed)
    footprint = beam.footprint
    beyond: list[Echoes] = []
    for number, first in enumerate(range(0, len(pulses), batch)):
        cast = moving.rays(number)
        moments = None if time is None else np.repeat(time[first : first + batch], rays)
        hits = world.caster.cast_posed(
            cast.poses,
            cast.index,
            directions=cast.direction,
            offsets=cast.origin,
            far=far,
            time=moments,
            order=cast.order,
            precision=settings.precision,
            retrace=settings.retrace,
            footprint=footprint,
            threads=threads,
        )
        pierced = None if foliage is None else foliage.pierce(hits, cast, first=first * rays, time=moments)
        glossy = collector.take(hits, first)
        if len(glossy):
            pulse, ray = np.divmod(glossy, np.int32(rays))
            skip = np.zeros(len(glossy))
            if pierced is not None:
                through = np.isin(glossy, pierced)
                skip[through] = hits.range[glossy[through]] - _CLEAR
            beyond += _beyond(
                cast.take(glossy),
                pulse + np.int32(first),
                power=np.full(len(ray), 1 / rays),
                optics=optics,
                far=far,
                time=None if moments is None else moments[glossy],
                skip=skip,
            )
    echoes, surfaces = collector.echoes()
    if not len(surfaces):
        return echoes
    return by_pulse(echoes, merge(join(surfaces, *beyond), separation, gap=beam.gap))


def _beyond(
    rays: PulseRays,
    pulse: NDArray[np.int32],
    *,
    power: Float,
    optics: SurfaceOptics,
    far: float,
    time: NDArray[np.float32] | None,
    skip: Float,
) -> list[Echoes]:
    """Surfaces that rays hit after glass or water: behind the pane, and in the mirror.

    pulse, power : (n,) of each ray; time as in `surface_echoes`
    skip         : (n,) metres from each ray's start that it has passed through foliage

    Light takes the mirrored path twice, so that its power is proportional to the square of the reflected
    share. The echo appears on the ray's own direction, as far behind the mirror as the surface is in front,
    and is labelled noise.
    """
    world = optics.world
    pose = rays.poses.take(rays.index)
    start, direction = pose.place(rays.origin), pose.directions(rays.direction)
    start, travelled = start + skip[:, None] * direction, skip
    glass, water = glossy_codes()
    found, behind = [], np.full(len(pulse), -1, np.int32)
    for layer in range(_MAX_PANES):
        hits = _cast(world, start, direction=direction, behind=behind, far=far, time=time)
        surface, material = optics.at(hits)
        if layer:  # the collector has the first surface
            found.append(_along(surface, hits, pulse=pulse, power=power, travelled=travelled, klass=None))
        is_glossy = (hits.face >= 0) & np.isin(material, (glass, water)) & (travelled + hits.range < far)
        if not is_glossy.any():
            break
        hits, pulse, power = hits.take(is_glossy), pulse[is_glossy], power[is_glossy]
        start, direction, material = start[is_glossy], direction[is_glossy], material[is_glossy]
        travelled, time = travelled[is_glossy], None if time is None else time[is_glossy]
        cosine = np.minimum(np.abs(hits.cosine).astype(np.float64), 1.0)
        mirror = np.where(material == glass, pane_reflection(cosine), surface_reflection(cosine))
        travelled = travelled + hits.range
        place = start + hits.range[:, None] * direction
        if not layer:
            ghosts = world.caster.cast(
                place, reflect(direction, hits.normal), near=_CLEAR, far=far, time=time, on=own_faces(hits)
            )
            found.append(
                _along(
                    optics.at(ghosts)[0],
                    ghosts,
                    pulse=pulse,
                    power=power * mirror**2,
                    travelled=travelled,
                    klass=Class.NOISE,
                )
            )
        through = material == glass
        start, direction = (place + _CLEAR * direction)[through], direction[through]
        power = (power * (1 - mirror) ** 2)[through]
        pulse, travelled = pulse[through], travelled[through] + _CLEAR
        time = None if time is None else time[through]
        behind = world.walls.panes(hits.take(through))
        if not through.any():
            break
    return [part.take(part.range <= far) for part in found]


def _cast(
    world: World,
    start: Float,
    *,
    direction: Float,
    behind: NDArray[np.int32],
    far: float,
    time: NDArray[np.float32] | None,
) -> Hits:
    """First hits of rays; those that have passed the pane ``behind`` (n,; -1 for none) hit the room there."""
    hits = world.caster.cast(start, direction, far=far, time=time, normals=True)
    row = np.flatnonzero(behind >= 0)
    if len(row):
        rooms = world.walls.rooms(behind[row], start[row], direction[row])
        for column, new in zip(hits.columns().values(), rooms.columns().values(), strict=True):
            column[row] = new
    return hits


def _along(
    surface: Echoes,
    hits: Hits,
    *,
    pulse: NDArray[np.int32],
    power: Float,
    travelled: Float,
    klass: Class | None,
) -> Echoes:
    """The surfaces that were hit, with range and power along the whole path."""
    hit = np.flatnonzero(hits.face >= 0)
    distance = (travelled + hits.range)[hit]
    labels = surface.klass[hit] if klass is None else np.full(len(hit), klass, np.uint8)
    return Echoes(
        pulse[hit],
        distance,
        (surface.apparent * power)[hit],
        surface.feature[hit],
        labels,
        surface.cosine[hit],
        distance,
        np.zeros(len(hit), bool),
    )
