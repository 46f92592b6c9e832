"""What a drive tells sensors and stages about its surroundings."""

from types import SimpleNamespace

import numpy as np
import pytest

from lidar.signal.registry import NamedStage, Stages
from lidar.signal.weather.stage import Weather
from lidar.simulation.situations import clouds_during


def recorded(*weather, seed=3):
    """A recording of a drive in weathers."""
    stages = Stages(tuple(NamedStage("weather", one) for one in weather))
    return SimpleNamespace(settings=SimpleNamespace(seed=seed, stages=stages))


def test_clouds_drift_with_the_wind_of_the_weather():
    west = recorded(Weather(kind="rain", wind=8.0, wind_from=270.0))
    drift = np.subtract(clouds_during(west, 10_000_000_000), clouds_during(west, 0))
    assert drift == pytest.approx([80.0, 0.0])
    assert clouds_during(recorded(), 10_000_000_000) == clouds_during(recorded(), 0)


def test_each_seed_has_clouds_of_its_own():
    assert clouds_during(recorded(seed=1), 0) == clouds_during(recorded(seed=1), 0)
    assert clouds_during(recorded(seed=1), 0) != clouds_during(recorded(seed=2), 0)
