"""Reflectance of the surfaces that rays hit, and the echoes of each pulse."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.geometry.random_streams import normal_of
from lidar.raycast import Hits
from lidar.sensors.laser.rays import Beam
from lidar.sensors.physics.echoes import AXIS_ONLY, Echoes, Gap, depth_of, gather, insert
from lidar.sensors.physics.reflect import (
    INCIDENCE_LAWS,
    RETRO,
    covered_reflectance,
    film,
    glint,
    reflectance_table,
    sent_back,
)
from lidar.sensors.physics.settings import ScannerSettings
from lidar.world.surfaces import OPEN, SurfaceFaces
from lidar.world.world import World


@functools.cache
def glossy_codes() -> tuple[int, int]:
    """Material codes of glass and water."""
    known = materials()
    return known["glass"].code, known["water"].code


@functools.lru_cache(maxsize=8)
def _factors(low: int, high: int, *, spread: float, seed: int) -> Float:
    """Log-normal factors of the reflectance of features ``low`` to ``high``."""
    return np.exp(spread * normal_of(np.arange(low, high + 1), seed))


class ReflectionTables(NamedTuple):
    """Reflection properties by material and feature, for compiled code.

    reflectance, specular : (256,) by material code
    film, soaked : (256,) of wet surfaces, as in `lidar.sensors.physics.reflect.CoveredReflectance`
    factor : (k,) of the reflectance, by feature number minus ``low``; empty if there is no spread
    law    : index in `INCIDENCE_LAWS`
    glossy : (256,) bool, by material code: rays are mirrored or pass through
    """

    reflectance: Float
    specular: Float
    film: Float
    soaked: Float
    factor: Float
    low: int
    law: int
    glossy: NDArray[np.bool_]


class SurfaceOptics:
    """Reflection of a scanner's light by the surfaces of a world.

    settings : incidence law, spread of the reflectance, and whether glass and water mirror
    seed    : of the spread
    """

    def __init__(self, world: World, wavelength_nm: float, *, settings: ScannerSettings, seed: int) -> None:
        self.world, self.settings = world, settings
        self.faces: SurfaceFaces = world.faces
        reflectance, specular = reflectance_table(wavelength_nm)
        films = soaked = np.zeros(256)
        wetness, snow = world.settings.wetness, world.settings.snow
        if wetness or snow:
            covered = covered_reflectance(wavelength_nm, wetness=wetness, snow=snow)
            reflectance = _with_open(reflectance, covered.open)
            films, soaked = _with_open(films, covered.film), _with_open(soaked, covered.soaked)
            specular = _with_open(specular, (1 - snow) * specular)
        glossy = np.zeros(256, np.bool_)
        glossy[list(glossy_codes())] = settings.mirrors
        factor = np.empty(0)
        if settings.spread:
            factor = _factors(self.faces.low, self.faces.high, spread=settings.spread, seed=seed)
        law = INCIDENCE_LAWS.index(settings.law)
        low = self.faces.low
        self.tables = ReflectionTables(reflectance, specular, films, soaked, factor, low, law, glossy)

    def at(self, hits: Hits) -> tuple[Echoes, NDArray[np.int32], NDArray[np.bool_]]:
        """Surfaces of hits, with the hit's row as pulse, all on the axis; glass and water as of `fill`."""
        n = len(hits.range)
        found, apart = _columns(n), np.empty(n, np.bool_)
        count, row, is_water = self.fill(
            found, hits, first=0, power=np.ones(1), separation=0.0, gap=AXIS_ONLY, apart=apart
        )
        return found.take(slice(count)), row, is_water

    def fill(
        self,
        echoes: Echoes,
        hits: Hits,
        *,
        first: int,
        power: Float,
        separation: float,
        gap: Gap,
        apart: NDArray[np.bool_],
    ) -> tuple[int, NDArray[np.int32], NDArray[np.bool_]]:
        """Fill columns with the echoes of the pulses from number ``first`` on, and return their number.

        ``power`` (rays,) is the share of each ray of a pulse.
        Also returned are the rays (k,) that hit glass or water, and whether they hit water. The surfaces of
        pulses with such rays are marked in ``apart`` and not merged into echoes.
        """
        glossy = np.empty((2, len(hits.range) if self.settings.mirrors else 0), np.int32)
        count, found = _receive(
            (hits.range, hits.face, hits.instance, hits.cosine),
            first,
            power,
            self.faces,
            self.tables,
            separation,
            gap,
            tuple(echoes.columns().values()),
            apart,
            glossy,
        )
        ray, row = glossy[:, :found]
        surface = self.faces.packed[hits.face[ray] + self.faces.start[hits.instance[ray]]]
        is_water: NDArray[np.bool_] = surface & 255 == glossy_codes()[1]
        wet = row[is_water]
        echoes.apparent[wet] = glint(echoes.cosine[wet]) * power[ray[is_water] % len(power)]
        return count, ray, is_water


def _with_open(plain: Float, covered: Float) -> Float:
    """Table by material code; codes from `OPEN` on hold the values of covered materials."""
    return np.concatenate([plain[:OPEN], covered[:OPEN]])


class EchoCollector:
    """Collects the echoes of consecutive pulses, batch after batch.

    beam       : of the pulses
    separation : metres; surfaces closer than this give one echo
    pulses     : number of pulses in all
    """

    def __init__(self, optics: SurfaceOptics, beam: Beam, *, separation: float, pulses: int) -> None:
        self._optics, self._beam, self._separation, self._gap = optics, beam, separation, beam.gap
        self._columns, self._glossy, self._count = _columns(pulses), np.empty(pulses, np.bool_), 0

    def take(self, hits: Hits, first: int) -> NDArray[np.int32]:
        """Add the hits of the pulses from number ``first`` on; return the rays that hit glass or water.

        The surfaces of pulses with such rays are collected apart and not yet merged into echoes.
        """
        self._make_room(len(hits.range))
        part = slice(self._count, self._count + len(hits.range))
        count, ray, _ = self._optics.fill(
            self._columns.take(part),
            hits,
            first=first,
            power=self._beam.sample.power,
            separation=self._separation,
            gap=self._gap,
            apart=self._glossy[part],
        )
        self._count += count
        return ray

    def echoes(self) -> tuple[Echoes, Echoes]:
        """Echoes of pulses that hit neither glass nor water, and surfaces of the others."""
        together, kept = self._columns.take(slice(self._count)), self._glossy[: self._count]
        return together.where(~kept), together.take(kept)

    def _make_room(self, rows: int) -> None:
        """Grow the columns so that ``rows`` more echoes fit."""
        if self._count + rows <= len(self._glossy):
            return
        more = len(self._glossy) + rows
        self._columns = Echoes.concatenate([self._columns, _columns(more)])
        self._glossy = np.append(self._glossy, np.empty(more, np.bool_))


def _columns(n: int) -> Echoes:
    """Uninitialised columns."""
    distance, apparent, cosine, true = (np.empty(n) for _ in range(4))
    number, feature = np.empty(n, np.int32), np.empty(n, np.int32)
    klass, axis = np.empty(n, np.uint8), np.empty(n, np.bool_)
    return Echoes(number, distance, apparent, feature, klass, cosine, true, axis)


@njit(cache=True, nogil=True, error_model="numpy")
def _receive(
    hits: Any,
    pulse: Any,
    shares: Any,
    faces: Any,
    tables: Any,
    separation: Any,
    gap: Any,
    out: Any,
    apart: Any,
    glossy: Any,
) -> Any:
    """Fill ``out`` with echoes; return their number and that of rays that hit glass or water."""
    distance, face, instance, cosine = hits
    # Fields of a tuple that are read in a loop cost a reference count each time.
    starts, named, packed, own = faces.start, faces.named, faces.packed, len(faces.start) - 1
    reflectance, specular, factor, mirrors = tables.reflectance, tables.specular, tables.factor, tables.glossy
    films, soaked = tables.film, tables.soaked
    low, law, spread, rays = tables.low, tables.law, len(tables.factor) > 0, len(shares)
    numbers, ranges, apparents, features, classes, cosines, trues, axes = out
    back, away, slant, depth = np.empty(rays), np.empty(rays), np.empty(rays), np.empty(rays)
    axis = np.zeros(rays, np.bool_)
    axis[0] = True
    surfaces = np.empty(rays, np.int64)
    row, bearer = np.empty(rays, np.int64), np.empty(rays, np.int64)
    place, power = np.empty(rays), np.empty(rays)
    count = found = 0
    for first in range(0, len(distance), rays):
        size, plain, number = 0, True, pulse + first // rays
        for k in range(rays):
            i = first + k
            if face[i] < 0:
                continue
            copy = instance[i]
            surface = packed[face[i] + starts[copy if copy >= 0 else own]]
            if copy >= 0:
                surface = (np.int64(named[copy]) << 32) | (surface & 0xFFFFFFFF)
            material = surface & 255
            rho = reflectance[material]
            c = min(abs(np.float64(cosine[i])), 1.0)
            if films[material] > 0.0:
                rho += films[material] * film(c, soaked[material])
            if spread:
                one_off = rho * factor[max((surface >> 32) - low, 0)]
                rho = one_off if rho > RETRO else min(one_off, RETRO)
            surfaces[k], slant[k], away[k] = surface, c, distance[i]
            depth[k] = depth_of(distance[i], c, gap)
            back[k] = sent_back(rho, c, specular[material], law) * shares[k]
            insert(row, size, k, away)
            size += 1
            plain &= not mirrors[material]
        if size == 0:
            continue
        if plain:
            echoes = gather(row, size, away, back, axis, depth, separation, 0, bearer, place, power)
        else:
            echoes = size
            for j in range(size):
                k = row[j]
                bearer[j], place[j], power[j] = k, away[k], back[k]
                if mirrors[surfaces[k] & 255]:
                    glossy[0, found], glossy[1, found] = first + k, count + j
                    found += 1
        for j in range(echoes):
            k = bearer[j]
            numbers[count], ranges[count], apparents[count] = number, place[j], power[j]
            features[count], classes[count] = surfaces[k] >> 32, (surfaces[k] >> 8) & 255
            cosines[count], trues[count], axes[count] = slant[k], away[k], axis[k]
            apart[count] = not plain
            count += 1
    return count, found
