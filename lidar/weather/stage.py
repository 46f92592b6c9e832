"""The stage ``weather``: what lasers and cameras get through the air."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from lidar.camera.render import Frame
from lidar.physics.echoes import TracedEchoes
from lidar.signal.situation import Situation
from lidar.signal.stage import Pulses, parameter
from lidar.weather.air import through_even_air
from lidar.weather.camera import weathered
from lidar.weather.media import medium_of
from lidar.weather.setting import WeatherSetting


@dataclass(frozen=True)
class Weather(WeatherSetting):
    """Rain, fog, snow, dust or spray: dims echoes, and sends back echoes of its own."""

    settings: ClassVar[tuple[tuple[str, str], ...]] = (("link", "on"),)

    model: str = parameter("physical", "the model; others are stage weather_model", among=("physical",))

    def echoes(
        self, pulses: Pulses, echoes: TracedEchoes, *, at: Situation, rng: np.random.Generator
    ) -> TracedEchoes:
        """The echoes that reach the receiver."""
        amount = self.amount_at(at.start_ns / 1e9)
        if amount is None:
            return echoes
        medium = medium_of(self.kind, amount, wavelength_nm=pulses.sensor.wavelength_nm, medium=self.medium)
        return through_even_air(pulses, echoes, medium=medium, rng=rng)

    def image(self, frame: Frame, *, at: Situation, rng: np.random.Generator) -> Frame:
        """The image that the camera takes."""
        return weathered(frame, self, at=at, rng=rng)
