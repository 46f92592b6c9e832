"""Speeds and accelerations on wet, snowy and icy roads and in fog, against published figures."""

from dataclasses import replace

import numpy as np
import pytest

from lidar.errors import InputError
from lidar.motion.vehicle import DRY, ROADS, RoadConditions, load_vehicle, vehicle_on
from lidar.options.drive import DriveOptions
from lidar.signal.weather.setting import read_weather
from lidar.traffic.trips import DRIVERS, driver_on

CAR = load_vehicle("car")


def in_weather(text, *more, **options):
    weather = (*read_weather(text), *more)
    return DriveOptions(route="random", weather=weather, road="by-weather", **options).road_conditions()


@pytest.mark.parametrize(("metres", "kmh"), [(31.2, 30), (63.5, 50), (104.9, 70), (184.2, 100), (284.2, 130)])
def test_speed_by_sight_is_that_of_the_stopping_sight_distance(metres, kmh):
    """Speeds and distances of AASHTO's table of stopping sight distances on level roads."""
    assert RoadConditions(visibility=metres).sight_speed * 3.6 == pytest.approx(kmh, rel=0.005)


def test_desired_speeds_are_within_those_measured_on_motorways():
    """Rain takes 2 to 17 % of the speed at free flow, snow 3 to 40 % (FHWA, Road Weather Management)."""
    assert DRY.pace == 1
    assert 0.83 < ROADS["wet"].pace < 0.98
    assert 0.60 < ROADS["snow"].pace < 0.97
    assert ROADS["ice"].pace < ROADS["snow"].pace


@pytest.mark.full
def test_weather_makes_roads_slippery_and_the_air_dim():
    assert in_weather("clear") == DRY
    assert in_weather("rain=10mm/h").grip == ROADS["wet"].grip
    assert in_weather("rain=10mm/h").visibility == pytest.approx(2500, rel=0.3)
    assert in_weather("snow=4mm/h").grip == pytest.approx(ROADS["snow"].grip)
    assert in_weather("snow=2mm/h").grip == pytest.approx((0.2 + 0.85 - 0.3 * 0.25) / 2)
    assert in_weather("snow=2mm/h", settings=(("snow", "0"), ("wetness", "1"))).grip == ROADS["wet"].grip
    assert in_weather("snow=2mm/h").visibility < in_weather("snow=0.5mm/h").visibility
    fog = in_weather("fog=50m")
    assert fog.grip == DRY.grip
    assert fog.visibility == pytest.approx(50, rel=0.02)
    assert in_weather("fog=50m,rain=10mm/h").visibility < fog.visibility
    assert in_weather("rain=10mm/h,wetness=0.5").grip == pytest.approx((0.85 + 0.6) / 2)
    assert in_weather("dust=20m") == DRY
    assert in_weather("fog=50m,longitude=8,latitude=47,radius=100") == DRY
    growing = in_weather("clear", *read_weather("fog=500m,amount_to=50,end=60"))
    assert growing.visibility == pytest.approx(50, rel=0.02)


def test_vehicles_and_drivers_use_the_same_share_of_the_grip():
    car = vehicle_on(CAR, ROADS["snow"])
    assert car.deceleration / CAR.deceleration == pytest.approx(0.2 / 0.85)
    assert car.max_speed == CAR.max_speed
    assert vehicle_on(CAR, in_weather("fog=50m")).max_speed * 3.6 == pytest.approx(42.4, abs=0.5)
    assert vehicle_on(CAR, DRY) is CAR
    drone = load_vehicle("drone")
    assert vehicle_on(drone, ROADS["ice"]) is drone
    sedan = driver_on(DRIVERS["sedan"], ROADS["snow"])
    assert sedan.hard == pytest.approx(0.2 * 9.81)
    assert sedan.deceleration < sedan.hard
    assert driver_on(DRIVERS["sedan"], DRY) is DRIVERS["sedan"]


def test_the_option_names_the_road_and_leaves_the_recipe_of_dry_drives(scene):
    assert "road" not in DriveOptions(route="random").recipe(scene)
    assert DriveOptions(route="random", road="ice").recipe(scene)["road"] == "ice"
    fog = read_weather("fog=50m")
    assert DriveOptions(route="random", weather=fog).road_conditions() == DRY
    by_weather = DriveOptions(route="random", weather=fog, road="by-weather")
    assert by_weather.road_conditions().visibility == pytest.approx(50, rel=0.02)
    as_stage = DriveOptions(route="random", stages=fog, road="by-weather")
    assert as_stage.road_conditions() == by_weather.road_conditions()
    with pytest.raises(
        InputError, match=r"`road` 'muddy' is unknown \(known are dry, by-weather, wet, snow, ice"
    ):
        DriveOptions(route="random", road="muddy")
    with pytest.raises(InputError, match="`road` by-weather: give `weather`"):
        DriveOptions(route="random", road="by-weather")


@pytest.mark.full
def test_slippery_roads_slow_a_drive_down(scene):
    from lidar.simulation.plan import plan_drive  # noqa: PLC0415

    options = DriveOptions(route="random", rig="vlp16", duration=20.0, seed=3)
    metres = {road: plan_drive(scene, replace(options, road=road)).length for road in ("dry", "wet", "snow")}
    assert metres["dry"] > 1.05 * metres["wet"] > 1.05**2 * metres["snow"]
    assert np.isfinite(metres["snow"])
    assert metres["snow"] > 20
