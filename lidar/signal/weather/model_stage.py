"""The stage ``weather_model``: published models of weather on point clouds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geoscene.classes import Class
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.cloud import TracedCloud
from lidar.sensors.physics.origin import Origin
from lidar.signal.situation import Situation
from lidar.signal.weather.camera import add_weather
from lidar.signal.weather.hahner import hahner_fog, hahner_snow
from lidar.signal.weather.lisa import LOST, SCATTERED, Lidar, RemainingReturns, goodin, lisa
from lidar.signal.weather.media import medium_of
from lidar.signal.weather.setting import WeatherSetting

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
