"""What comes back from what rays hit: reflectance, and the echoes of each pulse."""

from __future__ import annotations

import functools
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.typing import Float
from lidar.physics.echoes import Echoes, gather, insert
from lidar.physics.fresnel import glint
from lidar.physics.reflect import INCIDENCE_LAWS, RETRO, apparent, reflectance_table, sent_back
from lidar.physics.settings import ScannerSettings
from lidar.random_streams import normal_of
from lidar.raycast import Hits
from lidar.world.world import Faces, World


@functools.cache
def shiny_codes() -> tuple[int, int]:
    """Material codes of glass and water."""
    known = materials()
    return known["glass"].code, known["water"].code


@functools.lru_cache(maxsize=8)
def _factors(low: int, high: int, *, spread: float, seed: int) -> Float:
    """Factors of the reflectance of features ``low`` to ``high``."""
    factors: Float = np.exp(spread * normal_of(np.arange(low, high + 1), seed))
    return factors


class Optics(NamedTuple):
    """How surfaces send light back, for compiled code.

    reflectance, specular : (256,) by material code
    factor : (k,) of the reflectance, by feature number less ``low``; empty for none
    law    : row of `INCIDENCE_LAWS`
    shiny  : (256,) bool, by material code: rays go on where they meet it
    """

    reflectance: Float
    specular: Float
    factor: Float
    low: int
    law: int
    shiny: NDArray[np.bool_]


class Look:
    """Surfaces of a world as a receiver sees them.

    world         : what is seen
    wavelength_nm : of the light
    settings, seed : how surfaces differ and how they send light back
    """

    def __init__(self, world: World, wavelength_nm: float, *, settings: ScannerSettings, seed: int) -> None:
        self.world, self.settings = world, settings
        self.faces: Faces = world.faces
        reflectance, specular = reflectance_table(wavelength_nm)
        shiny = np.zeros(256, np.bool_)
        shiny[list(shiny_codes())] = settings.mirrors
        factor = np.empty(0)
        if settings.spread:
            factor = _factors(self.faces.low, self.faces.high, spread=settings.spread, seed=seed)
        law = INCIDENCE_LAWS.index(settings.law)
        self.optics = Optics(reflectance, specular, factor, self.faces.low, law, shiny)

    def at(self, hits: Hits) -> tuple[Echoes, NDArray[np.uint8]]:
        """Rows for hits, numbered from 0 and all on the axis, and their materials."""
        found, optics = self.world.lookup(hits), self.optics
        cosine = np.minimum(np.abs(hits.cosine).astype(np.float64), 1.0)
        rho = optics.reflectance[found.material]
        if len(optics.factor):
            one_off = rho * optics.factor[np.maximum(found.feature - optics.low, 0)]
            rho = np.where(rho > RETRO, one_off, np.minimum(one_off, RETRO))
        back = apparent(rho, cosine, specular=optics.specular[found.material], law=self.settings.law)
        if self.settings.mirrors:
            water = np.flatnonzero(found.material == shiny_codes()[1])
            back[water] = glint(cosine[water])
        n = len(hits.range)
        number, axis = np.arange(n, dtype=np.int32), np.ones(n, bool)
        rows = Echoes(number, hits.range, back, found.feature, found.klass, cosine, hits.range, axis)
        return rows, found.material


class Receiver:
    """Collects the echoes of pulses, some pulses at a time, in order.

    look       : the surfaces
    share      : (rays,) of a pulse's power, by ray
    separation : metres, surfaces closer than this are one echo
    pulses     : of which there are so many in all
    """

    def __init__(self, look: Look, share: Float, *, separation: float, pulses: int) -> None:
        self._look, self._share, self._separation = look, share, separation
        self._columns, self._open, self._count = _columns(pulses), np.empty(pulses, np.bool_), 0

    def take(self, hits: Hits, first: int) -> NDArray[np.int32]:
        """Take the hits of the rays of pulses from number ``first`` on; the rays that met glass or water.

        Pulses with such rays are kept apart, with their surfaces as they are.
        """
        n = len(hits.range)
        self._make_room(n)
        start, shiny = self._count, np.empty((2, n if self._look.settings.mirrors else 0), np.int32)
        echoes = self._columns.take(slice(start, start + n))
        count, met = _receive(
            (hits.range, hits.face, hits.instance, hits.cosine),
            first,
            self._share,
            self._look.faces,
            self._look.optics,
            self._separation,
            tuple(getattr(echoes, f.name) for f in fields(Echoes)),
            self._open[start : start + n],
            shiny,
        )
        self._count += count
        ray, row = shiny[:, :met]
        if met:
            wet = self._look.faces.what[_place(self._look.faces, hits, ray=ray)] & 255 == shiny_codes()[1]
            echoes.apparent[row[wet]] = (
                glint(echoes.cosine[row[wet]]) * self._share[ray[wet] % len(self._share)]
            )
        shining: NDArray[np.int32] = ray
        return shining

    def echoes(self) -> tuple[Echoes, Echoes]:
        """The echoes of the pulses that met neither glass nor water, and the surfaces of those that did."""
        together, kept = self._columns.take(slice(self._count)), self._open[: self._count]
        return together.where(~kept), together.take(kept)

    def _make_room(self, rows: int) -> None:
        """See that there are columns for so many more echoes."""
        if self._count + rows <= len(self._open):
            return
        old, flags, size = self._columns, self._open, 2 * len(self._open) + rows
        self._columns, self._open = _columns(size), np.empty(size, np.bool_)
        for name in (f.name for f in fields(Echoes)):
            getattr(self._columns, name)[: self._count] = getattr(old, name)[: self._count]
        self._open[: self._count] = flags[: self._count]


def _columns(n: int) -> Echoes:
    """Columns yet to be filled."""
    distance, apparent, cosine, true = (np.empty(n) for _ in range(4))
    number, feature = np.empty(n, np.int32), np.empty(n, np.int32)
    klass, axis = np.empty(n, np.uint8), np.empty(n, np.bool_)
    return Echoes(number, distance, apparent, feature, klass, cosine, true, axis)


def _place(faces: Faces, hits: Hits, *, ray: NDArray[np.int32]) -> NDArray[np.int64]:
    place: NDArray[np.int64] = hits.face[ray] + faces.start[hits.instance[ray]]
    return place


@njit(cache=True, nogil=True, error_model="numpy")
def _receive(
    hits: Any,
    pulse: Any,
    share: Any,
    faces: Any,
    optics: Any,
    separation: Any,
    out: Any,
    opened: Any,
    shiny: Any,
) -> Any:
    """Fill ``out`` with echoes; the number of them and of rays that met something shiny."""
    distance, face, instance, cosine = hits
    rays = len(share)
    # Fields of a tuple that are read in a loop cost a reference count each time.
    starts, named, whats, own = faces.start, faces.named, faces.what, len(faces.start) - 1
    reflectance, specular, factor, glossy = optics.reflectance, optics.specular, optics.factor, optics.shiny
    low, law, spread = optics.low, optics.law, len(optics.factor) > 0
    numbers, ranges, apparents, features, classes, cosines, trues, axes = out
    back, away, slant = np.empty(rays), np.empty(rays), np.empty(rays)
    axis = np.zeros(rays, np.bool_)
    axis[0] = True
    what = np.empty(rays, np.int64)
    row, bearer = np.empty(rays, np.int64), np.empty(rays, np.int64)
    place, power = np.empty(rays), np.empty(rays)
    count = met = 0
    for first in range(0, len(distance), rays):
        size, whole, number = 0, True, pulse + first // rays
        for k in range(rays):
            i = first + k
            if face[i] < 0:
                continue
            copy = instance[i]
            surface = whats[face[i] + starts[copy if copy >= 0 else own]]
            if copy >= 0:
                surface = (np.int64(named[copy]) << 32) | (surface & 0xFFFFFFFF)
            material = surface & 255
            rho = reflectance[material]
            if spread:
                one_off = rho * factor[max((surface >> 32) - low, 0)]
                rho = one_off if rho > RETRO else min(one_off, RETRO)
            c = min(abs(np.float64(cosine[i])), 1.0)
            what[k], slant[k], away[k] = surface, c, distance[i]
            back[k] = sent_back(rho, c, specular[material], law) * share[k]
            insert(row, size, k, away)
            size += 1
            whole &= not glossy[material]
        if size == 0:
            continue
        if whole:
            echoes = gather(row, size, away, back, axis, separation, 0, bearer, place, power)
        else:
            echoes = size
            for j in range(size):
                k = row[j]
                bearer[j], place[j], power[j] = k, away[k], back[k]
                if glossy[what[k] & 255]:
                    shiny[0, met], shiny[1, met] = first + k, count + j
                    met += 1
        for j in range(echoes):
            k = bearer[j]
            numbers[count], ranges[count], apparents[count] = number, place[j], power[j]
            features[count], classes[count] = what[k] >> 32, (what[k] >> 8) & 255
            cosines[count], trues[count], axes[count] = slant[k], away[k], axis[k]
            opened[count] = not whole
            count += 1
    return count, met
