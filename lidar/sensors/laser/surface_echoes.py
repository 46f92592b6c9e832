"""Echoes of the surfaces that the pulses of a frame hit, also in foliage, behind glass and in mirrors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Bools, Float, Ints
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator, uniform_of
from lidar.raycast import Caster, Hits
from lidar.raycast.hits import own_faces
from lidar.sensors.laser.footprints import Watch, adaptive_echoes
from lidar.sensors.laser.rays import BeamSample, MovingSensor, PulseRays, beam_of, equal_rays
from lidar.sensors.laser.reflection import EchoCollector, SurfaceOptics
from lidar.sensors.physics.echoes import Echoes, by_pulse, join, merge
from lidar.sensors.physics.reflect import pane_reflection, reflect, surface_reflection
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.patterns.beams import Firings, chosen
from lidar.sensors.rig.scanner import Sensor
from lidar.world.surfaces import SurfaceFaces
from lidar.world.world import World

PROJECTION = 0.5
"""Projected area per leaf area, for leaves of uniformly distributed orientation (Ross 1981)."""

_MAX_CROSSINGS = 24  # crown surfaces that a ray may cross; after that it ends on a leaf
_BEHIND = 2e-4  # metres beyond the surface of a crown at which the next ray starts


@dataclass(frozen=True, slots=True)
class Foliage:
    """Extinction of rays in crowns and hedges.

    caster, faces : of the world
    far           : maximum range, metres
    seed          : of the random optical depths
    """

    caster: Caster
    faces: SurfaceFaces
    far: float
    seed: int

    def pierce(
        self, hits: Hits, rays: PulseRays, *, first: int, time: NDArray[np.float32] | None
    ) -> NDArray[np.int64]:
        """Move hits on foliage to the leaf hit or to the surface behind, in place; return their rows.

        first : number of the first ray; the same number and seed give the same leaf
        time  : (n,) ray times, or None

        Beer-Lambert law: a share exp(-G a L) of rays passes L metres of foliage with leaf area density a,
        where G is `PROJECTION`. Each ray draws the optical depth at which it ends on a leaf. The orientation
        of leaves is uniformly distributed, so that the cosine c of the incidence has the density 2c.
        """
        rows = np.flatnonzero(self._kind(hits))
        if not len(rows):
            return rows
        through = rays.take(rows)
        poses = through.poses.take(through.index)
        start, direction = poses.place(through.origin), poses.directions(through.direction)
        depth = -np.log(uniform_of(first + rows, self.seed))
        cosine = np.sqrt(uniform_of(first + rows, ~self.seed)).astype(np.float32)
        passage = _Passage(hits, rows, depth=depth, cosine=cosine)
        found = Hits(hits.range[rows], hits.face[rows], hits.instance[rows], hits.cosine[rows], hits.normal)
        active = np.arange(len(rows))
        for _ in range(_MAX_CROSSINGS):
            active, at = passage.advance(active, found, kind=self._kind(found), leaves=self.faces.leaves)
            if not len(active):
                break
            ray_time = None if time is None else time[rows[active]]
            begin = at + _BEHIND
            origin, ahead = start[active] + begin[:, None] * direction[active], direction[active]
            found = self.caster.cast(origin, ahead, time=ray_time)
            found.range[:] += begin
        passage.end(active)
        lost = rows[hits.range[rows] > self.far]
        hits.range[lost], hits.face[lost], hits.instance[lost], hits.cosine[lost] = np.inf, -1, -1, 0.0
        return rows

    def _kind(self, hits: Hits) -> NDArray[np.int64]:
        """Kind of foliage (n,) of the surfaces hit; 0 for none."""
        attributes: NDArray[np.int64] = self.faces.packed[hits.face + self.faces.start[hits.instance]]
        return (attributes >> 16) & 255


class _Passage:
    """Passage of rays through foliage; their end points are written to ``hits``.

    rows   : (k,) rows of the hits
    depth  : (k,) optical depth at which each ray ends on a leaf
    cosine : (k,) of the incidence on that leaf
    """

    def __init__(
        self, hits: Hits, rows: NDArray[np.int64], *, depth: Float, cosine: NDArray[np.float32]
    ) -> None:
        self._hits, self._rows, self._left, self._cosine = hits, rows, depth, cosine
        self._dense, self._at = np.zeros(len(rows)), np.zeros(len(rows))
        self._crown = np.full((2, len(rows)), -1, np.int32)

    def advance(
        self, active: NDArray[np.int64], found: Hits, *, kind: NDArray[np.int64], leaves: Float
    ) -> tuple[NDArray[np.int64], Float]:
        """Advance rays to the surfaces they hit; return those that cross them, and the ranges there.

        kind   : kind of foliage of each surface
        leaves : leaf area density by kind, m2/m3
        """
        own = PROJECTION * leaves[kind]
        enters = found.cosine > 0
        # A ray that leaves a crown has been inside, even if it started there.
        dense = np.maximum(self._dense[active], np.where(enters, 0.0, own))
        dense[found.face < 0] = 0.0  # crowns are closed: a ray that never leaves one has grazed its edge
        lost = np.where(
            dense > 0, dense * (np.where(found.face < 0, 0.0, found.range) - self._at[active]), 0.0
        )
        leaf = lost > self._left[active]
        inside = ~enters & (self._crown[0, active] < 0) & (own > 0)
        self._crown[:, active[inside]] = found.face[inside], found.instance[inside]
        ended = active[leaf]
        self._write(ended, self._at[ended] + self._left[ended] / dense[leaf])
        solid = ~leaf & (kind == 0)
        rows, hits = self._rows[active[solid]], self._hits
        hits.range[rows], hits.cosine[rows] = found.range[solid], found.cosine[solid]
        hits.face[rows], hits.instance[rows] = found.face[solid], found.instance[solid]
        cross = ~leaf & (kind > 0)
        crossing = active[cross]
        self._left[crossing] -= lost[cross]
        self._dense[crossing] = np.maximum(dense[cross] + np.where(enters, own, -own)[cross], 0.0)
        self._at[crossing] = found.range[cross]
        entered = active[cross & enters]
        self._crown[:, entered] = found.face[cross & enters], found.instance[cross & enters]
        return crossing, found.range[cross]

    def end(self, active: NDArray[np.int64]) -> None:
        """End rays on a leaf at their present range."""
        self._write(active, self._at[active])

    def _write(self, ended: NDArray[np.int64], distance: Float) -> None:
        """Write hits on leaves of the crown that was entered last."""
        rows, hits = self._rows[ended], self._hits
        hits.range[rows], hits.cosine[rows] = distance, self._cosine[ended]
        hits.face[rows], hits.instance[rows] = self._crown[:, ended]


_MAX_PANES = 4  # panes that a ray may pass
_CLEAR = 1e-3  # metres beyond a surface at which the next ray starts
_BATCH = 1 << 15  # rays per batch, so that their columns stay in the processor's cache


class SentPulses(NamedTuple):
    """Pulses of a frame that are cast.

    firings : their times, origins and directions
    turn    : (n,) radians by which the rays of each pulse are turned about its axis; empty for one ray
    time    : (n,) ray times; None in a static world
    """

    firings: Firings
    turn: Float
    time: NDArray[np.float32] | None = None

    def take(self, keep: Bools) -> SentPulses:
        """Some of them, in the same order."""
        turn = self.turn[keep] if len(self.turn) else self.turn
        return SentPulses(chosen(self.firings, keep), turn, None if self.time is None else self.time[keep])


def surface_echoes(
    pulses: SentPulses,
    mount: Mount,
    *,
    sensor: Sensor,
    trajectory: Trajectory,
    world: World,
    settings: ScannerSettings,
    seed: int,
    frame: int,
    threads: int,
) -> Echoes:
    """The echoes of pulses that a moving sensor fires, within its maximum range, sorted by pulse and range.

    seed, frame : of random reflectances and leaves
    """
    foliage = None
    far = min(sensor.max_range - sensor.pattern.range_offset, world.reach)
    if settings.foliage:
        leaf_seed = int(generator(seed, sensor.name, frame, "foliage").integers(2**63))
        foliage = Foliage(world.caster, world.faces, far, leaf_seed)
    optics = SurfaceOptics(world, sensor.wavelength_nm, settings=settings, seed=seed)
    tracer = _Tracer(pulses, mount, sensor, trajectory, optics, foliage, far, threads)
    if settings.footprint:
        return adaptive_echoes(tracer.echoes, pulses.firings, faces=world.faces, tolerance=settings.footprint)
    return tracer.echoes(equal_rays(settings.rays))


@dataclass(frozen=True, slots=True)
class _Tracer:
    """Casts beams of pulses of a frame; fields as the parameters of `surface_echoes`.

    foliage : None if rays end on crowns
    far     : metres
    """

    pulses: SentPulses
    mount: Mount
    sensor: Sensor
    trajectory: Trajectory
    optics: SurfaceOptics
    foliage: Foliage | None
    far: float
    threads: int

    def echoes(self, sample: BeamSample, *, rows: Ints | None = None, watch: Watch | None = None) -> Echoes:
        """Echoes of the pulses in ``rows``, ascending, or of all, sorted by pulse and range.

        watch : takes the hits of all rays
        """
        pulses, turn, time = self.pulses
        if rows is not None:
            pulses, turn, time = self.pulses.take(np.isin(np.arange(len(pulses)), rows))
        sensor, settings = self.sensor, self.optics.settings
        beam = beam_of(sample, divergence=sensor.divergence, aperture=sensor.aperture, turn=turn)
        rays, batch = beam.rays, max(_BATCH // beam.rays, 1)
        moving = MovingSensor(pulses, self.mount, trajectory=self.trajectory, beam=beam, batch=batch)
        collector = EchoCollector(self.optics, beam, separation=sensor.echo_separation, pulses=len(pulses))
        beyond: list[Echoes] = []
        for number, first in enumerate(range(0, len(pulses), batch)):
            cast = moving.rays(number)
            moments = None if time is None else np.repeat(time[first : first + batch], rays)
            hits = self.optics.world.caster.cast_posed(
                cast.poses,
                cast.index,
                directions=cast.direction,
                offsets=cast.origin,
                far=self.far,
                time=moments,
                order=cast.order,
                precision=settings.precision,
                retrace=settings.retrace,
                footprint=beam.footprint,
                threads=self.threads,
            )
            pierced = None
            if self.foliage is not None:
                pierced = self.foliage.pierce(hits, cast, first=first * rays, time=moments)
            if watch is not None:
                watch(hits, first)
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
                    power=sample.power[ray],
                    optics=self.optics,
                    far=self.far,
                    time=None if moments is None else moments[glossy],
                    skip=skip,
                )
        echoes, surfaces = collector.echoes()
        if len(surfaces):
            echoes = by_pulse(echoes, merge(join(surfaces, *beyond), sensor.echo_separation, gap=beam.gap))
        return echoes if rows is None else replace(echoes, pulse=rows[echoes.pulse].astype(np.int32))


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
    found, behind = [], np.full(len(pulse), -1, np.int32)
    for layer in range(_MAX_PANES):
        hits = _cast(world, start, direction=direction, behind=behind, far=far, time=time)
        surfaces, row, is_water = optics.at(hits)
        if layer:  # the collector has the first surface
            found.append(_along(surfaces, pulse=pulse, power=power, travelled=travelled))
        is_near = (travelled + hits.range)[row] < far
        row, is_water = row[is_near], is_water[is_near]
        if not len(row):
            break
        hits, pulse, power = hits.take(row), pulse[row], power[row]
        start, direction, travelled = start[row], direction[row], travelled[row]
        time = None if time is None else time[row]
        cosine = np.minimum(np.abs(hits.cosine).astype(np.float64), 1.0)
        mirror = np.where(is_water, surface_reflection(cosine), pane_reflection(cosine))
        travelled = travelled + hits.range
        place = start + hits.range[:, None] * direction
        if not layer:
            ghosts = world.caster.cast(
                place, reflect(direction, hits.normal), near=_CLEAR, far=far, time=time, on=own_faces(hits)
            )
            seen = _along(optics.at(ghosts)[0], pulse=pulse, power=power * mirror**2, travelled=travelled)
            found.append(replace(seen, klass=np.full(len(seen), Class.NOISE, np.uint8)))
        through = ~is_water
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


def _along(surfaces: Echoes, *, pulse: NDArray[np.int32], power: Float, travelled: Float) -> Echoes:
    """Surfaces of rays, by their row, with range and power along the whole path."""
    ray = surfaces.pulse
    distance = travelled[ray] + surfaces.range
    return replace(
        surfaces,
        pulse=pulse[ray],
        range=distance,
        apparent=surfaces.apparent * power[ray],
        true_range=distance,
        axis=np.zeros(len(ray), bool),
    )
