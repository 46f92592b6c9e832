"""Injected returns: points, a wall, or the shape of a road user, by their distances along beams."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.parameters import parameter
from lidar.raycast import Caster
from lidar.sensors.physics.detector import has_code, shift_by_delay
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.signal.attacks.attacker import Aim, SynchronisedAttacker, in_body, power_of, sent_back
from lidar.signal.situation import Situation
from lidar.signal.stage import POSES, Pulses
from lidar.world.actor_shapes import KINDS, catalogue

OBJECTS = tuple(kind for kind in KINDS if kind != "parked_motorcycle")
"""Kinds of road users whose shape a phantom may have."""

USUAL_HEIGHT = 1.73
"""Metres of a sensor above the ground where no return tells it: KITTI's HDL-64E."""

_GROUND_SECTOR = 40.0  # degrees on either side of a phantom where the ground is looked for
_GROUND_RANGE = (4.0, 25.0)  # metres from the sensor, horizontally
_GROUND_SHARE = 20.0  # percentile of the heights of downward beams' returns that counts as ground
_FEWEST = 10  # returns that tell the ground


def ground_below(pulses: Pulses, echoes: TracedEchoes, *, azimuth: float) -> float:
    """Height of the ground in the sensor frame, metres, from echoes around an azimuth (degrees)."""
    way = pulses.direction[echoes.pulse]
    point = pulses.origin[echoes.pulse] + echoes.range[:, None] * way
    level = np.hypot(point[:, 0], point[:, 1])
    off = (np.degrees(np.arctan2(point[:, 1], point[:, 0])) - azimuth + 180) % 360 - 180
    low, high = _GROUND_RANGE
    chosen = (np.abs(off) < _GROUND_SECTOR) & (level > low) & (level < high) & (way[:, 2] < -0.03)
    if np.count_nonzero(chosen) < _FEWEST:
        return -USUAL_HEIGHT
    return float(np.percentile(point[chosen, 2], _GROUND_SHARE))


@cache
def _body(kind: str) -> tuple[Caster, float]:
    """Caster of a kind of road user, in its own frame, and its length in metres."""
    shape = next(shape for shape in catalogue().values() if shape.kind == kind)
    return Caster(shape.mesh.vertices, shape.mesh.faces), shape.length


def _turn(azimuth: float) -> Float:
    """Rotation (3, 3) about the vertical by degrees."""
    c, s = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def object_ranges(
    pulses: Pulses,
    row: NDArray[np.int64],
    *,
    kind: str,
    azimuth: float,
    distance: float,
    ground: float,
    part: tuple[float, float] = (0.0, 1.0),
) -> Float:
    """Range (k,) along beams to a road user seen from behind; infinite for beams that miss it.

    kind     : of `OBJECTS`
    azimuth  : degrees from forward to the left of its middle
    distance : metres from the sensor to its rear
    ground   : height of the ground in the sensor frame, metres
    part     : shares of its width, from the right, between which it can be seen past something in front
    """
    caster, length = _body(kind)
    turn = _turn(azimuth)
    middle = turn @ np.array([distance + length / 2, 0.0, 0.0]) + np.array([0.0, 0.0, ground])
    start = (pulses.origin[row] - middle) @ turn
    way = pulses.direction[row] @ turn
    found = caster.cast(start, way).range
    hit = np.isfinite(found)
    if part != (0.0, 1.0) and hit.any():
        across = start[hit, 1] + found[hit] * way[hit, 1]
        low, high = across.min(), across.max()
        share = (across - low) / max(high - low, 1e-6)
        found[np.flatnonzero(hit)[(share < part[0]) | (share > part[1])]] = np.inf
    return found


def wall_ranges(
    pulses: Pulses,
    row: NDArray[np.int64],
    *,
    azimuth: float,
    distance: float,
    ground: float,
    size: tuple[float, float],
) -> Float:
    """Distance (k,) along beams to an upright wall across an azimuth; infinite where they miss it.

    size : width and height in metres

    Other parameters are those of `object_ranges`.
    """
    turn = _turn(azimuth)
    start, way = pulses.origin[row] @ turn, pulses.direction[row] @ turn
    found = (distance - start[:, 0]) / np.where(way[:, 0] > 1e-6, way[:, 0], np.nan)
    across, up = start[:, 1] + found * way[:, 1], start[:, 2] + found * way[:, 2] - ground
    on = (np.abs(across) <= size[0] / 2) & (up >= 0) & (up <= size[1])
    return np.where(on, found, np.inf)


def far_trace_ranges(
    pulses: Pulses,
    row: NDArray[np.int64],
    *,
    kind: str,
    azimuth: float,
    distance: float,
    ground: float,
    seen_at: float,
) -> Float:
    """Distance (k,) along beams to the few returns of a far road user that are brought near.

    The road user is scanned ``seen_at`` metres away; its returns are shifted along the azimuth to
    ``distance`` and each is put on the beam nearest to it.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415

    everything = np.arange(len(pulses))
    trace = object_ranges(pulses, everything, kind=kind, azimuth=azimuth, distance=seen_at, ground=ground)
    hit = np.flatnonzero(np.isfinite(trace))
    shift = _turn(azimuth) @ np.array([distance - seen_at, 0.0, 0.0])
    point = pulses.origin[hit] + trace[hit, None] * pulses.direction[hit] + shift
    found = np.full(len(row), np.inf)
    if not len(row) or not len(hit):
        return found
    away = point - pulses.origin[row].mean(axis=0)
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    off, beam = cKDTree(pulses.direction[row]).query(away)
    # Points between the outermost beams and the rim of the window are on no beam.
    chosen = off <= 2 * np.median(off) + 1e-9
    along = np.einsum("ij,ij->i", point - pulses.origin[row[beam]], pulses.direction[row[beam]])
    np.minimum.at(found, beam[chosen], along[chosen])
    return found


@dataclass(frozen=True)
class Inject(SynchronisedAttacker):
    """Returns of nothing: random points, a wall, or a road user (Cao 2019, Sun 2020, Jin 2023)."""

    shape: str = parameter(
        "object",
        "random points, a wall, a whole road user, a strip of one, the few returns of a far one",
        among=("random", "wall", "object", "occluded", "far"),
    )
    kind: str = parameter("sedan", "road user that the phantom resembles", among=OBJECTS)
    range: float = parameter(7.0, "distance from the sensor to the phantom", unit="m", low=0.1, high=1000)
    closing: float = parameter(0.0, "speed by which it comes nearer", unit="m/s", low=-100, high=100)
    standing: bool = parameter(
        False, "stays where it was at start, in the scene; else at the same range and bearing"
    )
    offset: float = parameter(
        0.0, "azimuth of the phantom from the device to the left", unit="degrees", low=-180, high=180
    )
    wide: float = parameter(4.0, "width of a wall", unit="m", low=0.1, high=1000)
    high: float = parameter(2.0, "height of a wall", unit="m", low=0.1, high=100)
    deep: float = parameter(
        10.0, "depth behind range over which random points lie", unit="m", low=0, high=1000
    )
    strip: float = parameter(
        0.3, "share of the width of an occluded road user that is seen", low=0.01, high=1
    )
    seen_at: float = parameter(
        40.0, "distance at which a far road user was recorded", unit="m", low=1, high=200
    )
    predicts: bool = parameter(True, "fires before the sensor does, so that phantoms may be nearer than it")
    dimmest: float = parameter(0.3, "least apparent reflectance of a point", low=0, high=1)
    brightest: float = parameter(1.0, "greatest apparent reflectance of a point", low=0, high=1)

    def __post_init__(self) -> None:
        """Validate the parameters, also against each other."""
        super().__post_init__()
        if self.dimmest > self.brightest:
            raise InputError(f"dimmest = {self.dimmest:g} is over brightest = {self.brightest:g}")
        if not self.predicts and not self.place and self.range < self.distance:
            raise InputError(
                f"range = {self.range:g} is nearer than the device at {self.distance:g} m,"
                " which needs predicts = true"
            )

    @property
    def requires(self) -> tuple[str, ...]:
        """Poses, for a fixed device and for a phantom at a fixed place in the scene."""
        return (POSES,) if self.place or self.standing else ()

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes with those of the phantom."""
        aim = self.aim(pulses, echoes, at=at)
        if aim is None:
            return echoes
        distance = self._distances(pulses, echoes, aim=aim, at=at, rng=rng)
        sensor = pulses.sensor
        away = distance + sensor.pattern.range_offset
        usable = (away >= sensor.min_range) & (away <= sensor.max_range)
        if not self.predicts:
            usable &= distance >= aim.distance
        known = np.full(len(pulses), np.inf)
        known[aim.row] = distance
        aim = self.spent(aim.where(usable), rng=rng)
        aim = aim.where(has_code(sensor, len(aim.row), rng=rng))
        distance = known[aim.row] + self.errors(aim, rng=rng)
        distance += shift_by_delay(sensor, len(aim.row), rng=rng)
        reflectance = rng.uniform(self.dimmest, self.brightest, len(aim.row))
        power = np.minimum(power_of(pulses, reflectance, distance=distance), aim.power)
        return sent_back(pulses, echoes, row=aim.row, distance=distance, power=power, origin=Origin.INJECTED)

    def _distances(
        self, pulses: Pulses, echoes: TracedEchoes, *, aim: Aim, at: Situation, rng: np.random.Generator
    ) -> Float:
        """Distance (k,) of the phantom along each beam, metres; infinite where it has none."""
        azimuth, distance = self._place_of_phantom(pulses, aim=aim, at=at)
        azimuth += self.frame_jitter * rng.standard_normal()
        distance -= self.closing * (at.start_ns * 1e-9 - self.start)
        if self.shape == "random":
            return rng.uniform(distance, distance + self.deep, len(aim.row))
        ground = ground_below(pulses, echoes, azimuth=azimuth)
        place = {"azimuth": azimuth, "distance": distance, "ground": ground}
        if self.shape == "wall":
            return wall_ranges(pulses, aim.row, size=(self.wide, self.high), **place)
        if self.shape == "far":
            return far_trace_ranges(pulses, aim.row, kind=self.kind, seen_at=self.seen_at, **place)
        part = (0.0, self.strip) if self.shape == "occluded" else (0.0, 1.0)
        return object_ranges(pulses, aim.row, kind=self.kind, part=part, **place)

    def _place_of_phantom(self, pulses: Pulses, *, aim: Aim, at: Situation) -> tuple[float, float]:
        """Azimuth (degrees) and distance (metres) of the phantom, but for its own motion."""
        if not self.standing:
            way = pulses.direction[aim.row[:1]]
            ahead = np.degrees(np.arctan2(way[:, 1], way[:, 0])) - aim.azimuth[:1]
            return float(ahead[0]) + self.offset, self.range
        assert at.poses is not None  # noqa: S101 - see requires
        first = np.array([round(self.start * 1e9)], np.int64)
        towards = self.towards(first, at=at)[0]
        angle = np.arctan2(towards[1], towards[0]) + np.radians(self.offset)
        point = np.array([[self.range * np.cos(angle), self.range * np.sin(angle), 0.0]])
        now = np.array([pulses.time_ns[aim.row].mean()], np.int64)
        x, y, _ = in_body(at.poses(now), point=at.poses(first).place(point)[0])[0]
        return float(np.degrees(np.arctan2(y, x))), float(np.hypot(x, y))
