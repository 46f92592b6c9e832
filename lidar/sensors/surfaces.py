"""What the pulses of a frame meet, as far as a receiver sees it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.geometry.mounts import Mount
from lidar.geometry.poses import Trajectory
from lidar.physics.echoes import Echoes, joined, merged
from lidar.physics.fresnel import mirrored, pane_reflection, surface_reflection
from lidar.physics.settings import ScannerSettings
from lidar.raycast import Hits
from lidar.rig.patterns.beams import Firings
from lidar.sensors.foliage import Leaves
from lidar.sensors.motion import Beam, Carrier, Rays
from lidar.sensors.receive import Look, Receiver, shiny_codes
from lidar.world.world import World

_PANES = 4  # panes a ray may pass one after another
_CLEAR = 1e-3  # metres, how far beyond a surface the next ray starts
_BATCH = 1 << 15  # rays worked on at a time, so that their columns stay in the processor's cache


def met(
    pulses: Firings,
    mount: Mount,
    *,
    trajectory: Trajectory,
    world: World,
    beam: Beam,
    far: float,
    wavelength_nm: float,
    separation: float,
    time: NDArray[np.float32] | None,
    settings: ScannerSettings,
    seed: int,
    leaf_seed: int = 0,
    threads: int = 1,
) -> Echoes:
    """The echoes of pulses that a moving sensor fires, from within ``far`` metres, sorted by pulse and range.

    beam       : how pulses are spread over rays
    separation : metres, surfaces closer than this are one echo
    time       : (n,) ray times of the pulses, for things that move, or None
    leaf_seed  : of the leaves that rays meet, with ``foliage``
    """
    rays = len(beam)
    batch = max(_BATCH // rays, 1)
    look = Look(world, wavelength_nm, settings=settings, seed=seed)
    carrier = Carrier(pulses, mount, trajectory=trajectory, beam=beam, batch=batch)
    receiver = Receiver(look, beam.share, separation=separation, pulses=len(pulses))
    leaves = Leaves(world.caster, world.faces, far, leaf_seed) if settings.foliage else None
    beyond: list[Echoes] = []
    for number, first in enumerate(range(0, len(pulses), batch)):
        cast = carrier.rays(number)
        moments = None if time is None else np.repeat(time[first : first + batch], rays)
        hits = world.caster.cast_posed(
            cast.poses,
            cast.index,
            directions=cast.direction,
            offsets=cast.origin,
            far=far,
            time=moments,
            order=cast.order,
            threads=threads,
        )
        pierced = None if leaves is None else leaves.pierce(hits, cast, first=first * rays, time=moments)
        shiny = receiver.take(hits, first)
        if len(shiny):
            pulse, ray = np.divmod(shiny, np.int32(rays))
            later = None if moments is None else moments[shiny]
            skip = np.zeros(len(shiny))
            if pierced is not None:
                among = np.isin(shiny, pierced)
                skip[among] = hits.range[shiny[among]] - _CLEAR
            beyond += _beyond(
                cast.take(shiny),
                pulse + np.int32(first),
                power=beam.share[ray],
                look=look,
                far=far,
                time=later,
                skip=skip,
            )
    echoes, surfaces = receiver.echoes()
    if not len(surfaces):
        return echoes
    return _by_pulse(echoes, merged(joined(surfaces, *beyond), separation))


def _by_pulse(one: Echoes, other: Echoes) -> Echoes:
    """All rows by pulse; no pulse is in both."""
    both = Echoes(*(np.concatenate([getattr(e, f.name) for e in (one, other)]) for f in fields(Echoes)))
    return both.take(np.argsort(both.pulse, kind="stable"))


def _beyond(
    rays: Rays,
    pulse: NDArray[np.int32],
    *,
    power: Float,
    look: Look,
    far: float,
    time: NDArray[np.float32] | None,
    skip: Float,
) -> list[Echoes]:
    """What rays meet that have met glass or water: behind it, and by way of the mirror image.

    pulse, power : (n,) of each ray; time as in `met`
    skip         : (n,) metres from each ray's start that it has passed among leaves

    The mirrored path is taken twice, so its power goes with the square of the reflected share; its echo
    appears on the ray's own direction, as far behind the mirror as the thing is before it, and is labelled
    noise.
    """
    caster = look.world.caster
    pose = rays.poses.take(rays.index)
    start, way = pose.place(rays.origin), pose.directions(rays.direction)
    start, travelled = start + skip[:, None] * way, skip
    glass, water = shiny_codes()
    found = []
    for layer in range(_PANES):
        hits = caster.cast(start, way, far=far, time=time, normals=True)
        surface, material = look.at(hits)
        if layer:  # the first surface is there already
            found.append(_along(surface, hits, pulse=pulse, power=power, travelled=travelled, klass=None))
        shiny = (hits.face >= 0) & np.isin(material, (glass, water)) & (travelled + hits.range < far)
        if not shiny.any():
            break
        hits, pulse, power, travelled = _rows(hits, shiny), pulse[shiny], power[shiny], travelled[shiny]
        start, way, material = start[shiny], way[shiny], material[shiny]
        time = None if time is None else time[shiny]
        cosine = np.minimum(np.abs(hits.cosine).astype(np.float64), 1.0)
        mirror = np.where(material == glass, pane_reflection(cosine), surface_reflection(cosine))
        travelled = travelled + hits.range
        place = start + hits.range[:, None] * way
        if not layer:
            back = mirrored(way, hits.normal)
            ghosts = caster.cast(place, back, near=_CLEAR, far=far, time=time)
            found.append(
                _along(
                    look.at(ghosts)[0],
                    ghosts,
                    pulse=pulse,
                    power=power * mirror**2,
                    travelled=travelled,
                    klass=Class.NOISE,
                )
            )
        through = material == glass
        start, way = (place + _CLEAR * way)[through], way[through]
        power = (power * (1 - mirror) ** 2)[through]
        pulse, travelled = pulse[through], travelled[through] + _CLEAR
        time = None if time is None else time[through]
        if not through.any():
            break
    return [part.take(part.range <= far) for part in found]


def _along(
    surface: Echoes,
    hits: Hits,
    *,
    pulse: NDArray[np.int32],
    power: Float,
    travelled: Float,
    klass: Class | None,
) -> Echoes:
    """The rows that were hit, at the ranges and with the power in which the receiver sees them."""
    seen = np.flatnonzero(hits.face >= 0)
    distance = (travelled + hits.range)[seen]
    labels = surface.klass[seen] if klass is None else np.full(len(seen), klass, np.uint8)
    return Echoes(
        pulse[seen],
        distance,
        (surface.apparent * power)[seen],
        surface.feature[seen],
        labels,
        surface.cosine[seen],
        distance,
        np.zeros(len(seen), bool),
    )


def _rows(hits: Hits, rows: NDArray[np.bool_]) -> Hits:
    """The rows of a mask."""
    normal = hits.normal[rows] if len(hits.normal) else hits.normal
    return Hits(hits.range[rows], hits.face[rows], hits.instance[rows], hits.cosine[rows], normal)
