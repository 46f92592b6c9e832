"""The stage ``weather``: what lasers and cameras get through the air."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lidar.parameters import parameter
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.physics.echoes import TracedEchoes
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses
from lidar.signal.weather.air import through_air
from lidar.signal.weather.camera import add_weather
from lidar.signal.weather.fields import amounts, field_of, rays_of
from lidar.signal.weather.glass import dazzle, through_glass
from lidar.signal.weather.media import Medium, medium_of
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
