"""What weather makes of roads: their grip, and the visibility above them."""

from __future__ import annotations

import math
from collections.abc import Iterable

from lidar.planning.road_conditions import DRY_GRIP, SNOW_GRIP, WET_GRIP, RoadConditions
from lidar.weather.media import CONTRAST, medium_of
from lidar.weather.setting import WeatherSetting

_WET, _SNOWED = {"rain": 1.0, "spray": 1.0}, {"snow": 1.0}
"""Wetness and share of snow of the roads, by kind of weather; 0 of others."""
_GREEN_NM = 550.0
"""Wavelength of visibilities, nanometres."""


def road_conditions(weather: Iterable[WeatherSetting]) -> RoadConditions:
    """Grip and visibility of all weather that is everywhere, at its worst: one state for a whole drive.

    Weather of a place, and plumes behind vehicles, change neither.
    """
    wet = snowed = extinction = 0.0
    for setting in weather:
        if setting.radius or setting.polygon:
            continue
        wet = max(wet, _given(setting.wetness, _WET.get(setting.kind, 0.0)))
        snowed = max(snowed, _given(setting.snow_cover, _SNOWED.get(setting.kind, 0.0)))
        if setting.kind != "clear" and setting.medium != "plumes":
            extinction += max(_extinction(setting, amount) for amount in _amounts(setting))
    grip = (1 - snowed) * (DRY_GRIP + wet * (WET_GRIP - DRY_GRIP)) + snowed * SNOW_GRIP
    return RoadConditions(grip, CONTRAST / extinction if extinction else math.inf)


def _given(value: float, default: float) -> float:
    return default if value < 0 else value


def _amounts(setting: WeatherSetting) -> list[float]:
    return [setting.amount] if setting.amount_to < 0 else [setting.amount, setting.amount_to]


def _extinction(setting: WeatherSetting, amount: float) -> float:
    """1/m of visible light."""
    return medium_of(setting.kind, amount, wavelength_nm=_GREEN_NM, medium=setting.medium).extinction
