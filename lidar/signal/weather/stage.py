"""The stages ``weather``, what lasers and cameras get through the air, and ``weather_model``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.cloud import TracedCloud
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.sensors.physics.origin import Origin
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, added_echoes
from lidar.signal.weather.backscatter import (
    Found,
    drawn_particles,
    even_echo,
    least_power,
    notice,
    pulse_shape,
    scattering,
    strength,
)
from lidar.signal.weather.camera import add_weather
from lidar.signal.weather.fields import Field, WeatherBeams, amounts, field_of, rays_of, strongest_response
from lidar.signal.weather.glass import dazzle, through_glass
from lidar.signal.weather.media import Medium, medium_of
from lidar.signal.weather.models import (
    LOST,
    SCATTERED,
    Lidar,
    RemainingReturns,
    goodin,
    hahner_fog,
    hahner_snow,
    lisa,
)
from lidar.signal.weather.setting import WeatherSetting


@dataclass(frozen=True)
class Weather(WeatherSetting):
    """Rain, fog, snow, dust or spray: dims echoes, and sends back echoes of its own."""

    model: str = parameter("physical", "the model; others are stage weather_model", among=("physical",))

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes that reach the receiver."""
        sensor, amount = pulses.sensor, self.amount_at(at.start_ns / 1e9)
        if amount is None:
            return echoes
        medium = self._medium(sensor.wavelength_nm, amount=amount)
        if medium.extinction > 0:
            field = field_of(self, sensor.max_range, at=at)
            lens = self.lens / 1000
            echoes = through_air(pulses, echoes, medium=medium, field=field, lens=lens, at=at, rng=rng)
        if self.drops or self.dirt:
            echoes = through_glass(pulses, echoes, drops=self.drops, dirt=self.dirt, at=at)
        if self.sunlight:
            echoes = dazzle(pulses, echoes, sunlight=self.sunlight, at=at, rng=rng)
        return echoes

    def clearness(self, pulses: Pulses, row: int, *, distance: float, at: Situation) -> float:
        """Share of light that passes the medium from a distance along a pulse to the sensor."""
        amount = self.amount_at(at.start_ns / 1e9)
        if amount is None:
            return 1.0
        medium = self._medium(pulses.sensor.wavelength_nm, amount=amount)
        column = distance
        if medium.extinction > 0 and (field := field_of(self, pulses.sensor.max_range, at=at)) is not None:
            one = slice(row, row + 1)
            way = rays_of(pulses.origin[one], pulses.direction[one], time_ns=pulses.time_ns[one], at=at)
            column = float(amounts(field, way, pulse=np.zeros(1, int), distance=np.array([distance]))[1][0])
        return math.exp(-medium.extinction * column)

    def image(self, frame: CameraImage, *, at: Situation, rng: np.random.Generator) -> CameraImage:
        """The image that the camera takes."""
        return add_weather(frame, self, at=at, rng=rng)

    def _medium(self, wavelength_nm: float, *, amount: float) -> Medium:
        return medium_of(self.kind, amount, wavelength_nm=wavelength_nm, medium=self.medium)


_WHITE = 100.0  # intensity code of a white target
_NM = 905.0  # wavelength of the scanners that the models were made for
_MAX_RANGE = {"lisa": 200.0, "goodin": 100.0}


@dataclass(frozen=True)
class WeatherModel(WeatherSetting):
    """Rain, fog or snow on point clouds by a published model, with the constants of its paper."""

    model: str = parameter("lisa", "the model", among=("lisa", "goodin", "hahner_fog", "hahner_snow"))
    max_range: float = parameter(
        0.0,
        "lisa, goodin: distance at which a 90 % target is just seen; 0: the paper's",
        unit="m",
        low=0,
        high=1e4,
    )
    last: bool = parameter(default=False, meaning="lisa: report the last return, not the strongest")
    fall_speed: float = parameter(1.6, "hahner_snow: fall speed of flakes", unit="m/s", low=0.1, high=10)

    def __post_init__(self) -> None:
        """Validate the parameters; models on clouds are alike everywhere and have no cover glass."""
        super().__post_init__()
        given = [n for n in ("radius", "polygon", "drops", "dirt", "sunlight") if getattr(self, n)]
        if given:
            raise InputError(f"{given[0]} needs model physical; {self.model} has no such thing")
        if self.medium in ("stallabrass", "itu-dry", "itu-wet") and self.model == "hahner_snow":
            raise InputError(f"medium = {self.medium!r} has no flakes, which model hahner_snow needs")

    def cloud(self, cloud: TracedCloud, *, at: Situation, rng: np.random.Generator) -> TracedCloud:
        """The cloud in the weather."""
        amount = self.amount_at(at.start_ns / 1e9)
        if amount is None or not len(cloud) or (amount <= 0 and self.kind in ("rain", "snow")):
            return cloud
        distance = np.maximum(cloud.range, 1e-3)
        code = cloud.intensity.astype(np.float64)
        if self.model == "hahner_fog":
            alpha = medium_of("fog", amount, wavelength_nm=_NM, medium=self.medium).extinction
            return _change(cloud, hahner_fog(distance, code, extinction=alpha, rng=rng), white=1.0)
        if self.model == "hahner_snow":
            azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]).astype(np.float64)
            found = hahner_snow(
                distance,
                code,
                azimuth=azimuth,
                ring=cloud.ring,
                rate=amount,
                rng=rng,
                fall_speed=self.fall_speed,
                medium=self.medium,
            )
            return _change(cloud, found, white=1.0)
        return _change(cloud, self._dimmed(distance, code / _WHITE, amount=amount, rng=rng), white=_WHITE)

    def image(self, frame: CameraImage, *, at: Situation, rng: np.random.Generator) -> CameraImage:
        """The image that a camera takes in this weather, by the physical model: these have no cameras."""
        return add_weather(frame, self, at=at, rng=rng)

    def _dimmed(
        self, distance: Float, reflectance: Float, *, amount: float, rng: np.random.Generator
    ) -> RemainingReturns:
        """The returns by the models that take reflectances."""
        max_range = self.max_range or _MAX_RANGE[self.model]
        if self.model == "goodin":
            return goodin(distance, reflectance, rate=amount, rng=rng, max_range=max_range)
        return lisa(
            distance,
            reflectance,
            kind=self.kind,
            rate=amount,
            extinction=medium_of(self.kind, amount, wavelength_nm=_NM, medium=self.medium).extinction,
            rng=rng,
            lidar=Lidar(max_range=max_range, last=self.last),
        )


def _change(cloud: TracedCloud, found: RemainingReturns, *, white: float) -> TracedCloud:
    """A cloud with the returns of a model; ``white``: intensity code of its reflectance 1."""
    hit = found.state == SCATTERED
    xyz, old = cloud.xyz.astype(np.float64), cloud.range
    length = np.maximum(np.linalg.norm(xyz, axis=1), 1e-9)
    xyz *= (1 + (found.range - old) / length)[:, None]
    moved = found.range != old
    changed = replace(
        cloud,
        xyz=np.where(moved[:, None], xyz, cloud.xyz).astype(np.float32),
        range=found.range,
        intensity=np.clip(found.reflectance * white, 0, 255).astype(np.float32),
        klass=np.where(hit, Class.NOISE, cloud.klass).astype(np.uint8),
        feature=np.where(hit, -1, cloud.feature).astype(np.int32),
        incidence=np.where(hit, 0, cloud.incidence).astype(np.float32),
        true_range=np.where(hit, 0.0, cloud.true_range),
        origin=np.where(hit, Origin.WEATHER, cloud.origin).astype(np.uint8),
        source=np.where(hit, -1, cloud.source).astype(np.int32),
        hidden=np.where(hit, np.where(cloud.source >= 0, cloud.source, cloud.hidden), cloud.hidden).astype(
            np.int32
        ),
    )
    return changed.where(found.state != LOST)


_STEP = 0.25  # metres of range between samples of a field's response
_EVEN = 1e-6  # share of a way on which a medium may differ and be even


def through_air(
    pulses: Pulses,
    echoes: TracedEchoes,
    *,
    medium: Medium,
    field: Field | None,
    lens: float,
    at: Situation,
    rng: np.random.Generator,
) -> TracedEchoes:
    """The echoes that are left, and those of the air, in any order.

    field : where the medium is; None for everywhere
    lens  : diameter of the receiver's lens, metres
    """
    if medium.extinction <= 0 or (field is not None and not field.share.any()):
        return echoes
    sensor, least = pulses.sensor, least_power(pulses.noise)
    some, rest, distance = scattering(sensor, medium, lens=lens)
    end = np.full(len(pulses), np.inf)  # range of the nearest surface
    np.minimum.at(end, echoes.pulse, echoes.range)
    found: Found = np.empty(0, np.int64), np.empty(0), np.empty(0)
    if some is not None:
        found = drawn_particles(some, end, extinction=0.0 if field else medium.extinction, rng=rng)
    if field is None:
        column = echoes.range
        soft = [_even_response(pulses, end, medium=medium, lens=lens, rng=rng)]
    else:
        rays = rays_of(pulses.origin, pulses.direction, time_ns=pulses.time_ns, at=at)
        _, column = amounts(field, rays, pulse=echoes.pulse, distance=echoes.range)
        found = _in_field(found, (field, rays), extinction=medium.extinction, rng=rng)
        near = even_echo(sensor, medium, lens=lens, noise=pulses.noise).end[-1]
        is_even = _is_even((field, rays), np.minimum(end, near))
        soft = [
            _even_response(pulses, np.where(is_even, end, 0.0), medium=medium, lens=lens, rng=rng),
            _field_response(
                pulses,
                (field, rays),
                end=np.where(is_even, 0.0, end),
                medium=medium,
                rest=(distance, rest),
                lens=lens,
            ),
        ]
    single = notice(found, least=least, separation=sensor.echo_separation)
    dimmed = replace(echoes, apparent=echoes.apparent * np.exp(-2 * medium.extinction * column))
    pulse, place, power = (np.concatenate(each) for each in zip(*soft, single, strict=True))
    if not len(pulse):
        return dimmed
    apparent = pulses.apparent(power * pulses.power[pulse], place)
    added = added_echoes(pulse, place, apparent=apparent, origin=Origin.WEATHER)
    return TracedEchoes.concatenate((dimmed, added))


def _in_field(
    found: Found, where: tuple[Field, WeatherBeams], *, extinction: float, rng: np.random.Generator
) -> Found:
    """The particles that are there in a medium that differs from place to place, dimmed by it."""
    pulse, place, power = found
    share, column = amounts(*where, pulse=pulse, distance=place)
    there = rng.random(len(share)) < share
    return pulse[there], place[there], (power * np.exp(-2 * extinction * column))[there]


def _is_even(where: tuple[Field, WeatherBeams], distance: Float) -> NDArray[np.bool_]:
    """Pulses (n,) whose beams go through all of a medium, and no more, up to distances (n,) in metres."""
    if not np.any(where[0].share == 1):
        return np.zeros(len(distance), bool)
    _, column = amounts(*where, pulse=np.arange(len(distance)), distance=distance)
    even: NDArray[np.bool_] = np.abs(column - distance) < _EVEN * distance
    return even


def _even_response(
    pulses: Pulses, end: Float, *, medium: Medium, lens: float, rng: np.random.Generator
) -> Found:
    """The echoes of the soft target of even air that the detector may notice."""
    soft = even_echo(pulses.sensor, medium, lens=lens, noise=pulses.noise)
    row = soft.row(end)
    seen = np.flatnonzero((row >= 0) & (soft.power > least_power(pulses.noise))[row])
    row = row[seen]
    place = np.minimum(soft.places(row, rng.random(len(seen))), end[seen])
    return seen, place, soft.power[row]


def _field_response(
    pulses: Pulses,
    where: tuple[Field, WeatherBeams],
    *,
    end: Float,
    medium: Medium,
    rest: tuple[Float, Float],
    lens: float,
) -> Found:
    """The echoes of the soft target of a medium that differs from place to place, at its maxima."""
    sensor = pulses.sensor
    reach = float(min(sensor.max_range, 300.0))
    distance = _STEP * np.linspace(0.5, int(reach / _STEP) - 0.5, int(reach / _STEP))
    # Beyond the ranges of the response of even air, no particle is seen one by one.
    backscatter = np.interp(distance, *rest, right=medium.backscatter)
    near = sensor.min_range - sensor.pattern.range_offset
    white = pi * backscatter * strength(sensor, distance, lens=lens) * _STEP
    shape = pulse_shape(sensor.pulse_ns, _STEP)
    place, power = strongest_response(
        *where,
        end=end,
        white=white,
        extinction=medium.extinction,
        shape=shape,
        step=_STEP,
        near=near,
        least=least_power(pulses.noise),
    )
    seen = np.flatnonzero(power > least_power(pulses.noise))
    return seen, place[seen], power[seen]
