"""Effects of weather on roads: friction, and visibility above them."""

from __future__ import annotations

import math
from collections.abc import Iterable

from lidar.motion.road_conditions import DRY_GRIP, SNOW_GRIP, WET_GRIP, RoadConditions
from lidar.signal.weather.media import CONTRAST, medium_of
from lidar.signal.weather.setting import WeatherSetting

_GREEN_NM = 550.0
"""Wavelength of visibilities, nanometres."""


def road_conditions(weather: Iterable[WeatherSetting], *, wetness: float, snow: float) -> RoadConditions:
    """Grip of wet and snowy ground, and the visibility in all weather that is everywhere, at its worst.

    wetness : share of the ground that is soaked, see `lidar.world.settings.WorldSettings`
    snow    : share of it that is under snow

    Weather of a place, and plumes behind vehicles, do not lower the visibility.
    """
    extinction = sum(
        max(_extinction(setting, amount) for amount in _amounts(setting))
        for setting in weather
        if setting.kind != "clear" and setting.medium != "plumes"
        if not (setting.radius or setting.polygon)
    )
    grip = (1 - snow) * (DRY_GRIP + wetness * (WET_GRIP - DRY_GRIP)) + snow * SNOW_GRIP
    return RoadConditions(grip, CONTRAST / extinction if extinction else math.inf)


def _amounts(setting: WeatherSetting) -> list[float]:
    return [setting.amount] if setting.amount_to < 0 else [setting.amount, setting.amount_to]


def _extinction(setting: WeatherSetting, amount: float) -> float:
    """Extinction coefficient of visible light, 1/m."""
    return medium_of(setting.kind, amount, wavelength_nm=_GREEN_NM, medium=setting.medium).extinction
