"""What the rays of a frame meet, as far as a receiver sees it."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from lidar.physics.echoes import Echoes, joined
from lidar.physics.effects import Effects
from lidar.physics.fresnel import glint, mirrored, pane_reflection, surface_reflection
from lidar.physics.random import normal_of
from lidar.physics.reflect import RETRO, apparent, reflectance_table
from lidar.raycast import Hits
from lidar.sensors.motion import Rays
from lidar.world import World

Float = NDArray[np.float64]

_PANES = 4  # panes a ray may pass one after another
_CLEAR = 1e-3  # metres, how far beyond a surface the next ray starts


@functools.cache
def _codes() -> tuple[int, int]:
    """Material codes of glass and water."""
    known = materials()
    return known["glass"].code, known["water"].code


def met(
    rays: Rays,
    world: World,
    *,
    far: float,
    wavelength_nm: float,
    time: NDArray[np.float32] | None,
    effects: Effects,
    seed: int,
    threads: int = 1,
) -> Echoes:
    """The surfaces that rays meet within ``far`` metres, sorted by pulse.

    time : (n,) ray times for things that move, or None
    """
    hits = world.caster.cast_posed(
        rays.poses,
        rays.index,
        rays.direction,
        offsets=rays.origin,
        far=far,
        time=time,
        order=rays.order,
        threads=threads,
    )
    row = np.flatnonzero(hits.face >= 0).astype(np.int32)
    look = _Look(world, wavelength_nm, effects, seed)
    first, material = look.at(_rows(hits, row))
    pulse, ray = np.divmod(row, np.int32(rays.per_pulse))
    surfaces = Echoes(
        pulse,
        first.range,
        first.apparent * rays.share[ray] if rays.per_pulse > 1 else first.apparent,
        first.feature,
        first.klass,
        first.cosine,
        first.true_range,
        ray == 0,
    )
    if effects.mirrors:
        shiny = row[np.isin(material, _codes())]
        return joined(surfaces, *_beyond(rays, shiny, look, far, None if time is None else time[shiny]))
    return surfaces


class _Look:
    """Surfaces as the receiver sees them."""

    def __init__(self, world: World, wavelength_nm: float, effects: Effects, seed: int) -> None:
        self.world, self.effects, self.seed = world, effects, seed
        self.reflectance, self.specular = reflectance_table(wavelength_nm)

    def _spread(self, feature: NDArray[np.int32]) -> Float:
        """Factor of each feature's reflectance."""
        if not len(feature):
            return np.ones(0)
        first = int(feature.min())
        every = np.arange(first, int(feature.max()) + 1)
        factor: Float = np.exp(self.effects.spread * normal_of(every, self.seed))[feature - first]
        return factor

    def at(self, hits: Hits) -> tuple[Echoes, NDArray[np.uint8]]:
        """Rows for hits, numbered from 0 and all on the axis, and their materials."""
        found = self.world.lookup(hits)
        cosine = np.minimum(np.abs(hits.cosine).astype(np.float64), 1.0)
        rho = self.reflectance[found.material]
        if self.effects.spread:
            one_off = rho * self._spread(found.feature)
            rho = np.where(rho > RETRO, one_off, np.minimum(one_off, RETRO))
        back = apparent(rho, cosine, specular=self.specular[found.material], law=self.effects.law)
        if self.effects.mirrors:
            water = np.flatnonzero(found.material == _codes()[1])
            back[water] = glint(cosine[water])
        n = len(hits.range)
        rows = Echoes(
            np.arange(n, dtype=np.int32),
            hits.range,
            back,
            found.feature,
            found.klass,
            cosine,
            hits.range,
            np.ones(n, bool),
        )
        return rows, found.material


def _beyond(
    rays: Rays, row: NDArray[np.int32], look: _Look, far: float, time: NDArray[np.float32] | None
) -> list[Echoes]:
    """What rays meet that have met glass or water: behind it, and by way of the mirror image.

    The mirrored path is taken twice, so its power goes with the square of the reflected share; its echo
    appears on the ray's own direction, as far behind the mirror as the thing is before it, and is labelled
    noise.
    """
    caster = look.world.caster
    pose = rays.poses.take(rays.index[row])
    start, way = pose.place(rays.origin[row]), pose.directions(rays.direction[row])
    pulse, sub = np.divmod(row, np.int32(rays.per_pulse))
    power = rays.share[sub]
    travelled = np.zeros(len(row))
    glass, water = _codes()
    found = []
    for layer in range(_PANES):
        hits = caster.cast(start, way, far=far, time=time, normals=True)
        surface, material = look.at(hits)
        if layer:  # the first surface is there already
            found.append(_along(surface, hits, pulse, power, travelled, klass=None))
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
                _along(look.at(ghosts)[0], ghosts, pulse, power * mirror**2, travelled, klass=Class.NOISE)
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
    pulse: NDArray[np.int32],
    power: Float,
    travelled: Float,
    *,
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


def _rows(hits: Hits, rows: NDArray[np.int32] | NDArray[np.bool_]) -> Hits:
    """Chosen rows, without a copy if that is all in order."""
    if len(rows) == len(hits.range) and rows.dtype != np.bool_:
        return hits
    normal = hits.normal[rows] if len(hits.normal) else hits.normal
    return Hits(hits.range[rows], hits.face[rows], hits.instance[rows], hits.cosine[rows], normal)
