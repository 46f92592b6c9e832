"""An attacker's device: its place, its line of sight to the sensor, its limits, and the pulses it reaches."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.columns import Columns
from geoscene.support.digests import recipe_digest
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.parameters import parameter
from lidar.raycast.geometry import ALL
from lidar.sensors.physics.detector import METRES_PER_NS
from lidar.sensors.physics.echoes import TracedEchoes, artificial_echoes, join, number_echoes, trace
from lidar.sensors.physics.link import amplitude
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.scanner import Sensor, firings
from lidar.signal.registry import Stages
from lidar.signal.situation import Situation, degrees_of, point_of
from lidar.signal.stage import POSES, Pulses, Stage, added_echoes, pulses_of
from lidar.world.surfaces import GLASS
from lidar.world.world import World

POWER_AT = 10.0
"""Metres from the sensor at which the parameter ``power`` holds."""

RANGE_SIGMA, RANGE_SIGMA_PER_DEGREE = 0.05, 0.0067
"""Standard deviation in metres of an injected range, and its growth per degree of azimuth from the attacker.

A fit to Jin et al. 2023: 90 % of the errors below 0.102 m within 6 degrees, about 0.25 m at 15 degrees.
"""

_KNOTS = 11  # moments of a frame at which the direction to a fixed attacker is computed
_PER_FRAME = 100.0  # metres by which a vehicle moves within a frame, at most
_BESIDE = np.radians(1.5)  # angle around the attacker within which recorded returns tell what is in between
_FOUND_BEFORE = 1.0  # metres before the attacker at which such a return blocks its light
_NOT_IN_SCENES = [Class.UNLABELED, *(k for k in Class if Class.CAR <= k <= Class.MOTORCYCLIST)]  # road users


@dataclass(frozen=True, slots=True)
class SpoofingDevice:
    """Limits of hardware that was built.

    points : most pulses a frame
    width  : most degrees of azimuth
    rise   : most degrees of elevation
    """

    points: int
    width: float
    rise: float


DEVICES = {
    "cao_2019": SpoofingDevice(60, 8.0, 180.0),
    "sun_2020": SpoofingDevice(200, 10.0, 180.0),
    "pla_2023": SpoofingDevice(4200, 30.0, 30.0),
    "pra_2023": SpoofingDevice(1 << 31, 45.0, 180.0),
    "any": SpoofingDevice(1 << 31, 360.0, 180.0),
}
"""Devices of published attacks, and one without limits.

Cao et al. 2019 and Sun et al. 2020: points and width as Sun et al. 2020 state them. Jin et al. 2023
(PLA-LiDAR): 4200 points, 30 by 30 degrees. Cao et al. 2023 (physical removal): a sector of 45 degrees, no
number of points.
"""


@dataclass(frozen=True, slots=True)
class Aim(Columns):
    """The pulses that a device reaches in a frame.

    row      : (k,) int64, rows of `Pulses`
    azimuth  : (k,) degrees from the attacker to the left
    distance : (k,) metres from the sensor to the attacker
    power    : (k,) most power that arrives over the detection threshold
    """

    row: NDArray[np.int64]
    azimuth: Float
    distance: Float
    power: Float


@dataclass(frozen=True)
class Attacker(Stage):
    """A device that sends light into a scanner, from a place in its line of sight.

    A fixed one has a ``place``; without it the device moves along with the sensor, at a bearing, a distance
    and a height from it.
    """

    place: str = parameter(
        "", "LAT,LON,HEIGHT: degrees, and metres above the ground there; empty: moves along"
    )
    bearing: float = parameter(
        0.0, "without place: bearing from forward to the left", unit="degrees", low=-360, high=360
    )
    distance: float = parameter(10.0, "without place: distance from the sensor", unit="m", low=0.5, high=500)
    height: float = parameter(0.0, "without place: height above the sensor", unit="m", low=-50, high=50)
    device: str = parameter("pla_2023", "hardware, which limits points and angles", among=(*DEVICES,))
    points: int = parameter(0, "most pulses a frame; 0: all that the device can", low=0, high=10_000_000)
    width: float = parameter(
        0.0, "sector of azimuth around the device; 0: all that it can", unit="degrees", low=0, high=360
    )
    power: float = parameter(
        1000.0, "received power over the detection threshold from 10 m away", low=0, high=1e9
    )
    reach: float = parameter(110.0, "greatest distance from the sensor", unit="m", low=0.5, high=500)
    start: float = parameter(0.0, "time since the drive's start from which it attacks", unit="s", low=0)
    stop: float = parameter(
        inf, "time since the drive's start until which it attacks", unit="s", low=0, endless="never"
    )

    def __post_init__(self) -> None:
        """Validate the parameters, also against the device's limits."""
        super().__post_init__()
        if self.place:
            degrees_of(self.place)
        elif self.distance > self.reach:
            raise InputError(f"distance = {self.distance:g} is over reach = {self.reach:g}")
        limits = DEVICES[self.device]
        for name, most in (("points", limits.points), ("width", limits.width)):
            if getattr(self, name) > most:
                raise InputError(
                    f"{name} = {getattr(self, name):g} is over the {most:g} of {self.device}"
                    " (device = any has no limits)"
                )

    @property
    def requires(self) -> tuple[str, ...]:
        """Poses, for a fixed device."""
        return (POSES,) if self.place else ()

    def aim(self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation) -> Aim | None:
        """Pulses that the device can answer; None without line of sight, beyond its range or view."""
        if not len(pulses) or not self.may_reach(at):
            return None
        towards = self.towards(pulses.time_ns, at=at)
        distance = np.linalg.norm(towards, axis=1)
        away = np.degrees(np.arctan2(pulses.direction[:, 1], pulses.direction[:, 0]))
        bearing = np.degrees(np.arctan2(towards[:, 1], towards[:, 0]))
        azimuth = (away - bearing + 180) % 360 - 180
        nearest = int(np.argmin(np.abs(azimuth)))
        if distance[nearest] > self.reach or not self._in_sight(
            pulses, echoes, at=at, row=nearest, towards=towards[nearest]
        ):
            return None
        limits = DEVICES[self.device]
        rise = np.degrees(
            np.arcsin(np.clip(pulses.direction[:, 2], -1, 1)) - np.arcsin(towards[:, 2] / distance)
        )
        row = np.flatnonzero(
            (np.abs(azimuth) <= (self.width or limits.width) / 2)
            & (np.abs(rise) <= limits.rise / 2)
            & (distance <= self.reach)
        )
        if not len(row):
            return None
        clear = 1.0 if at.clearness is None else at.clearness(nearest, float(distance[nearest]))
        power = self.power * clear * (POWER_AT / distance[row]) ** 2
        return Aim(row, azimuth[row], distance[row], power)

    def may_reach(self, at: Situation) -> bool:
        """Whether the device is active at the time of a frame and near enough to the sensor."""
        if not self.start <= at.start_ns * 1e-9 < self.stop:
            return False
        if not self.place:
            return True
        away = self.towards(np.array([at.start_ns], np.int64), at=at)
        return float(np.linalg.norm(away)) <= self.reach + _PER_FRAME

    @property
    def budget(self) -> int:
        """Maximum number of pulses per frame."""
        return self.points or DEVICES[self.device].points

    def spent(self, aim: Aim, *, rng: np.random.Generator) -> Aim:
        """As many of the pulses as the budget allows, drawn at random."""
        if len(aim.row) <= self.budget:
            return aim
        chosen = np.zeros(len(aim.row), bool)
        chosen[rng.choice(len(aim.row), self.budget, replace=False)] = True
        return aim.where(chosen)

    def towards(self, time_ns: NDArray[np.int64], *, at: Situation) -> Float:
        """Vectors (n, 3) from the sensor to the device at times (n,), metres in the sensor frame."""
        if not self.place:
            angle = np.radians(self.bearing)
            level = np.sqrt(max(self.distance**2 - self.height**2, 0.25))
            return np.tile([level * np.cos(angle), level * np.sin(angle), self.height], (len(time_ns), 1))
        if at.poses is None or at.geo is None:
            raise InputError("`place` needs a dataset with poses; give `bearing` and `distance` instead")
        point = point_of(self.place, geo=at.geo, at=at)
        knots = np.unique(np.linspace(time_ns[0], time_ns[-1], _KNOTS).astype(np.int64))
        vectors = in_body(at.poses(knots), point=point)
        return np.stack([np.interp(time_ns, knots, column) for column in vectors.T], axis=1)

    def _in_sight(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, row: int, towards: Float
    ) -> bool:
        """Whether light from the device reaches the sensor when it fires a pulse (row) towards it.

        In recorded data whose scene is there, rays tell what of the scene is in between, and returns beside
        the device which road users are; without the scene, returns tell all.
        """
        away = float(np.linalg.norm(towards))
        if at.world is not None and at.poses is not None:
            start, stop = pulses.sensor.window_ns(int(at.frame))
            moment = np.array([(pulses.time_ns[row] - start) / (stop - start)])
            return not _test_occlusion(
                at.world, at.poses(pulses.time_ns[[row]]), towards=towards, moment=moment
            )
        beside = np.flatnonzero(pulses.direction @ (towards / away) > np.cos(_BESIDE))
        found = np.isin(echoes.pulse, beside)
        hidden = found.any() and bool(echoes.range[found].max() <= away - _FOUND_BEFORE)
        if at.surroundings is None or at.poses is None:
            return not hidden
        pose = at.poses(pulses.time_ns[[row]])
        world = at.surroundings(np.concatenate([pose.position, pose.place(towards[None])]))
        if _test_occlusion(world, pose, towards=towards):
            return False
        return not (hidden and bool(np.isin(echoes.klass[found], _NOT_IN_SCENES).any()))


def _test_occlusion(world: World, pose: Poses, *, towards: Float, moment: Float | None = None) -> bool:
    """Whether anything but glass is between a sensor at a pose and a device.

    towards : (3,) from the sensor to the device, metres in the sensor frame
    moment  : (1,) time of the ray within those of the world's motion, 0 to 1
    """
    away = float(np.linalg.norm(towards))
    hidden = world.caster.occluded(
        pose.position,
        pose.directions((towards / away)[None]),
        near=min(0.05, away / 2),
        far=max(away - 0.05, away / 2),
        mask=ALL & ~GLASS,
        time=moment,
    )
    return bool(hidden[0])


@dataclass(frozen=True)
class TimedAttacker(Attacker):
    """A device that answers each pulse after a time of its own choice."""

    jitter: float = parameter(
        RANGE_SIGMA, "standard deviation of a range ahead of the device", unit="m", low=0, high=100
    )
    jitter_per_degree: float = parameter(
        RANGE_SIGMA_PER_DEGREE, "growth of it per degree of azimuth", unit="m", low=0, high=10
    )

    def errors(self, aim: Aim, *, rng: np.random.Generator) -> Float:
        """Errors (k,) of the distances at which the pulses of a frame seem to come from, metres."""
        sigma = self.jitter + self.jitter_per_degree * np.abs(aim.azimuth)
        return sigma * rng.standard_normal(len(aim.row))


@dataclass(frozen=True)
class SynchronisedAttacker(TimedAttacker):
    """An attacker's device that knows when the sensor fires and answers each pulse.

    It cannot know a random delay or code of each pulse: see `lidar.sensors.physics.detector`.
    """

    frame_jitter: float = parameter(
        0.2, "standard deviation of the azimuth from frame to frame", unit="degrees", low=0, high=30
    )
    sync: float = parameter(
        0.0, "standard deviation of the synchronisation from frame to frame", unit="ns", low=0, high=1e6
    )

    def errors(self, aim: Aim, *, rng: np.random.Generator) -> Float:
        """Errors as of any device that answers, and of the synchronisation."""
        own = super().errors(aim, rng=rng)
        error: Float = own + METRES_PER_NS * self.sync * rng.standard_normal()
        return error


def checked_digest(file: str, *, known: str) -> str:
    """Digest of a file's bytes, empty without a file; raises InputError if another one is known."""
    found = recipe_digest(Path(file).read_bytes()) if file else ""
    if known and found != known:
        raise InputError(f"{file}: has changed since the drive (digest {found}, was {known})")
    return found


def in_body(poses: Poses, *, point: Float) -> Float:
    """A point of the scene (3,) in the axes of a body, true metres, at each of its poses (n, 3)."""
    found: Float = np.einsum("nji,nj->ni", poses.rotation, (point - poses.position) / poses.scale)
    return found


def power_of(pulses: Pulses, apparent: Float, *, distance: Float) -> Float:
    """Power (k,) over the detection threshold of apparent reflectances (k,) at distances (k,) in metres."""
    sensor = pulses.sensor
    return amplitude(sensor, apparent, distance=distance + sensor.pattern.range_offset)


def sent_back(
    pulses: Pulses,
    echoes: TracedEchoes,
    *,
    row: NDArray[np.int64],
    distance: Float,
    power: Float,
    origin: Origin,
) -> TracedEchoes:
    """Echoes together with an attacker's pulses.

    Those that seem nearer than the sensor's least range are not reported, but take the place of others as
    `crowded_out` says; those beyond its greatest one are not received.

    row      : (k,) pulses
    distance : (k,) metres at which they seem to come from, from the beam's start
    power    : (k,) received over the detection threshold
    """
    sensor = pulses.sensor
    away = distance + sensor.pattern.range_offset
    near = away < sensor.min_range
    heard = ~near & (away <= sensor.max_range)
    apparent = pulses.apparent(power[heard], distance[heard])
    found = join(echoes, added_echoes(row[heard], distance[heard], apparent=apparent, origin=origin))
    return found.where(~crowded_out(pulses, found, row=row[near], power=power[near]))


def crowded_out(
    pulses: Pulses, echoes: TracedEchoes, *, row: NDArray[np.int64], power: Float
) -> NDArray[np.bool_]:
    """Mask (m,) of echoes that are not reported as the sensor chooses a nearer one, which it then discards.

    The sensor applies its least range after its return mode (Cao et al. 2023). An echo of the attacker is
    the first of its pulse, never the last.

    row, power : (k,) pulses with such an echo, and its power over the detection threshold
    """
    strength = np.zeros(len(pulses))
    np.maximum.at(strength, row, power)
    sensor, received = pulses.sensor, pulses.received(echoes)
    strongest = np.zeros(len(pulses))
    np.maximum.at(strongest, echoes.pulse, received)
    hit = (strength > 1)[echoes.pulse]
    beaten = hit & (strength > strongest)[echoes.pulse]
    number, count = number_echoes(echoes)
    return {
        "strongest": beaten,
        "first": hit,
        "last": np.zeros(len(echoes), bool),
        "dual": beaten & (number < count),
        "all": hit & (number >= sensor.max_echoes),
    }[sensor.return_mode]


Seen = tuple[Pulses, TracedEchoes, Situation]
"""Pulses of a frame, the echoes that are known without rays, and where it is taken."""


def check_sight(stages: Stages, frames: Iterable[tuple[Situation, Callable[[], Seen]]]) -> None:
    """Raise InputError for a device that is in the line of sight of a scanner in none of the frames.

    frames : where each is taken, without its world, and what it sees, which is asked for near the device
    """
    waiting = [named for named in stages.stages if isinstance(named.stage, Attacker)]
    rest = iter(frames)
    while waiting and (frame := next(rest, None)):
        where, seen = frame
        near = [
            named
            for named in waiting
            if named.sensor in ("", where.sensor) and cast("Attacker", named.stage).may_reach(where)
        ]
        if near:
            pulses, echoes, at = seen()
            for named in near:
                if cast("Attacker", named.stage).aim(pulses, echoes, at=at) is not None:
                    waiting.remove(named)
    for named in waiting:
        reach = cast("Attacker", named.stage).reach
        raise InputError(
            f"attack {named.name}: its device is in the line of sight of no scanner within {reach:g} m in any"
            " frame; move it, or change its reach, start or stop"
        )


def sent_only(sensor: Sensor, at: Situation) -> Seen:
    """Pulses of a drive's frame without echoes, and the situation with the world between."""
    none = artificial_echoes(np.empty(0, np.int32), np.empty(0), apparent=np.empty(0))
    nothing = trace(none, Origin.SURFACE, source=np.empty(0, np.int32))
    return pulses_of(sensor, firings(sensor, int(at.frame))), nothing, at
