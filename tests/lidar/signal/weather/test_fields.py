"""Weather over time and place, plumes, spray, the cover glass and the sun."""

import functools
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, world

from geoscene.geometry.frames import Frame
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Poses
from lidar.sensors.laser.scan import cast
from lidar.sensors.physics.echoes import trace
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.settings import LEVELS, ScannerSettings
from lidar.sensors.rig.scanner import load_sensor
from lidar.signal.registry import NamedStage, Stages, number_stages
from lidar.signal.run import altered_sweep
from lidar.signal.situation import Situation
from lidar.signal.stage import POSES, ROAD_USERS, pulses_of
from lidar.signal.weather.fields import Field, WeatherBeams, _add_spray, amounts, plume_pattern
from lidar.signal.weather.glass import glare_noise, through_glass
from lidar.signal.weather.media import medium_of, rain
from lidar.signal.weather.setting import read_weather
from lidar.signal.weather.stage import Weather, through_air

GEO = Frame.at(7.0, 50.0)
SENSOR = load_sensor("vlp16")
ROOM = world(box((-90, -90, -1), (90, 90, 0)), box((30, -80, 0), (35, 80, 20), feature=8))


def poses(time_ns):
    n = len(time_ns)
    return Poses(np.tile([0.0, 0, 1.9], (n, 1)), np.tile(np.eye(3), (n, 1, 1)), np.ones((n, 3)))


SITUATION = Situation("vlp16", 0, poses=poses, geo=GEO, utc=datetime(2024, 6, 21, 11, 30, tzinfo=UTC))


LINK = ScannerSettings(link=True)


def sweep_of(detector=LINK):
    still = driven((0.0, 0.0, 0.0), start=(0, 0, 0))
    return cast(SENSOR, Mount((0, 0, 1.9)), frame=0, seed=5, settings=detector, trajectory=still, world=ROOM)


SWEEP = sweep_of()


def altered(settings, *, sweep=SWEEP, at=SITUATION):
    return altered_sweep(sweep, Stages(number_stages(settings), 3), at=at)


def weather(*args, **values):
    return NamedStage("weather", Weather(*args, **values))


def degrees(*corners):
    return ", ".join(f"{lon} {lat}" for lon, lat in (map(float, GEO.to_geographic(*xy)) for xy in corners))


def test_a_bank_of_fog_loses_only_what_is_seen_through_it():
    north = degrees((-500, 20), (500, 20), (500, 500), (-500, 500))
    found = altered([weather(kind="fog", amount=10.0, polygon=north)])
    y = found.original.xyz[:, 1]
    kept = np.isin(np.arange(len(y)), found.cloud.source)
    assert kept[y < 19].all()
    assert not kept[y > 45].any()
    unchanged = found.cloud.source[found.cloud.xyz[:, 1] < 19]
    np.testing.assert_array_equal(
        found.cloud.intensity[found.cloud.xyz[:, 1] < 19], found.original.intensity[unchanged]
    )


@pytest.mark.full
def test_weather_elsewhere_and_at_other_times_changes_nothing():
    far = dict(zip(("longitude", "latitude"), map(float, GEO.to_geographic(5000, 0)), strict=True))
    setting = weather(kind="rain", amount=100.0, radius=300.0, **far)
    for some in (setting, weather(kind="fog", amount=10.0, start=5.0)):
        found = altered([some])
        np.testing.assert_array_equal(found.cloud.intensity, found.original.intensity)


def test_a_place_that_holds_all_is_everywhere():
    here = dict(zip(("longitude", "latitude"), map(float, GEO.to_geographic(0, 0)), strict=True))
    for kind, amount in (("fog", 100.0), ("rain", 80.0)):
        wide, everywhere = (
            altered([weather(kind=kind, amount=amount, **place)])
            for place in ({"radius": 5000.0, **here}, {})
        )
        np.testing.assert_array_equal(wide.cloud.xyz, everywhere.cloud.xyz)


def test_an_even_field_gives_what_even_air_does():
    """The general path against the one for even air: extinction, soft target and particles."""
    sensor = replace(load_sensor("hdl64e_s2"), min_range=2.0)
    sweep = cast(
        sensor, Mount((0, 0, 1.9)), frame=0, seed=5, settings=ScannerSettings(link=True),
        trajectory=driven((0.0, 0, 0), start=(0, 0, 0)), world=ROOM,
    )  # fmt: skip
    pulses = pulses_of(sensor, sweep.sent)
    at = replace(SITUATION, sensor="hdl64e_s2")
    echoes = trace(sweep.echoes, Origin.SURFACE, source=np.arange(len(sweep.echoes)))
    field = Field((-400.0, -400.0), np.ones((401, 401)), 0.0, np.inf)
    for medium in (medium_of("fog", 40, wavelength_nm=905, medium="kim"), rain(100, 905.0)):
        even, general = (
            through_air(
                pulses, echoes, medium=medium, field=where, lens=0.02, at=at, rng=np.random.default_rng(0)
            )
            for where in (None, field)
        )
        m = len(echoes)
        np.testing.assert_allclose(general.apparent[:m], even.apparent[:m], rtol=1e-9)
        assert len(general) - m == pytest.approx(len(even) - m, rel=0.02)
        np.testing.assert_allclose(np.median(general.range[m:]), np.median(even.range[m:]), atol=0.3)
        np.testing.assert_allclose(
            np.median(pulses.received(general)[m:]), np.median(pulses.received(even)[m:]), rtol=0.15
        )


def test_the_column_of_a_field_is_its_integral():
    y, x = np.indices((201, 201)) * 2.0 - 200
    field = Field((-200.0, -200.0), np.exp(-np.hypot(x, y) / 40), 0.0, np.inf)
    rays = WeatherBeams(np.zeros((1, 3)), np.array([[0.6, 0.8, 0.0]]))
    here, column = amounts(field, rays, pulse=np.zeros(1, np.int64), distance=np.array([120.0]))
    assert column[0] == pytest.approx(40 * (1 - np.exp(-3)), rel=0.01)
    assert here[0] == pytest.approx(np.exp(-3), rel=0.05)


def test_plumes_of_dust_drift_with_the_wind():
    setting = weather(kind="dust", amount=20.0, wind=4.0, wind_from=270.0)
    options = {"seed": 1, "count": 301}
    first = plume_pattern(setting.stage, 0.0, corner=(0.0, 0.0), **options)
    later = plume_pattern(setting.stage, 5.0, corner=(20.0, 0.0), **options)
    np.testing.assert_allclose(later, first, atol=1e-9)
    assert np.mean(first > 0) == pytest.approx(0.4, abs=0.12)
    assert np.mean(first[first > 0]) == pytest.approx(1, abs=0.25)


def test_dust_in_plumes_gives_returns_within_them_and_hides_less_than_even_dust():
    sweep = replace(SWEEP, sensor=replace(SENSOR, reference_range=150.0))
    plumes, even = (
        altered([weather(kind="dust", amount=10.0, medium=medium)], sweep=sweep)
        for medium in ("plumes", "even")
    )
    kept = [np.sum(found.cloud.source >= 0) for found in (plumes, even)]
    assert len(plumes.original) > kept[0] > kept[1]
    dust = plumes.cloud.origin == Origin.WEATHER
    assert dust.any()
    assert np.ptp(plumes.cloud.range[dust]) > 5


def test_spray_is_behind_the_vehicle_and_grows_with_speed():
    share = [np.zeros((101, 101)) for _ in range(2)]
    for one, speed in zip(share, (20.0, 30.0), strict=True):
        _add_spray(one, corner=(-100.0, -100.0), place=np.zeros(2), velocity=np.array([speed, 0.0]))
    x = np.nonzero(share[1])[1]
    assert (x * 2 - 100).max() <= -1.5
    assert (x * 2 - 100).min() >= -1.5 - 4 * 30
    assert share[1].max() > 1.5 * share[0].max() > 0
    row = share[1][50]
    behind = row[:49][row[:49] > 0]
    assert np.all(np.diff(behind) > 0)


CAR = box((15, -0.9, 0.3), (19.5, 0.9, 1.5), feature=9)
BEHIND_A_CAR = world(box((-90, -90, -1), (90, 90, 0)), CAR)


def moving(speed, *, seed=0):
    """A car 15 m ahead that moves at a speed in m/s."""
    transform = np.tile(np.eye(3, 4), (1, 2, 1, 1))
    transform[0, 0, :, 3] = (17.25, 0, 0)
    transform[0, 1, :, 3] = (17.25 + speed * 0.1, 0, 0)
    caster = SimpleNamespace(instances=(SimpleNamespace(transform=transform),))
    return replace(SITUATION, world=SimpleNamespace(caster=caster, span_ns=(0, 10**8)), seed=seed)


@functools.cache
def sweep_behind_a_car():
    return cast(
        load_sensor("hdl64e_s2"), Mount((0, 0, 1.9)), frame=0, seed=5, settings=LINK, world=BEHIND_A_CAR,
        trajectory=driven((0.0, 0.0, 0.0), start=(0, 0, 0)),
    )  # fmt: skip


def spray_returns(kmh, *, seed):
    """Positions (k, 3) of returns from spray of 1 mm of water behind a car, above the ground."""
    sweep = sweep_behind_a_car()
    at = replace(moving(kmh / 3.6, seed=seed), sensor="hdl64e_s2")
    cloud = altered(read_weather("spray=1mm"), sweep=sweep, at=at).cloud
    return cloud.xyz[cloud.origin == Origin.WEATHER] + [0, 0, 1.9]


@pytest.mark.full
def test_a_scanner_15_m_behind_a_car_sees_its_spray_on_a_motorway_and_none_in_town():
    fast, slower = ([spray_returns(kmh, seed=k) for k in range(4)] for kmh in (100, 70))
    between = [np.sum((xyz[:, 0] > 1) & (xyz[:, 0] < 15.5) & (np.abs(xyz[:, 1]) < 2.5)) for xyz in fast]
    assert np.median(between) > 100
    assert np.mean([len(xyz) for xyz in fast]) > 3 * np.mean([len(xyz) for xyz in slower])
    assert max(xyz[:, 2].max(initial=0) for xyz in fast) < 3
    assert not len(spray_returns(30, seed=0))


@pytest.mark.parametrize("text", ["spray", "dust", "rain=5,radius=100", "clear,sunlight=100000"])
def test_what_needs_poses_says_so(text):
    with pytest.raises(InputError, match="need"):
        altered(read_weather(text), at=Situation("vlp16", 0))


# Cover glass


def dimming(drops=0.0, dirt=0.0, second=0.0):
    pulses = pulses_of(SENSOR, SWEEP.sent)
    echoes = trace(SWEEP.echoes, Origin.SURFACE, source=np.arange(len(SWEEP.echoes)))
    at = replace(SITUATION, start_ns=int(second * 1e9))
    return through_glass(pulses, echoes, drops=drops, dirt=dirt, at=at).apparent / echoes.apparent


def test_drops_on_the_glass_dim_their_share_of_beams():
    for share in (0.05, 0.3):
        found = dimming(drops=share)
        assert set(np.round(found, 9)) == {0.3, 1.0}
        assert np.mean(found < 1) == pytest.approx(share, rel=0.3)
    np.testing.assert_array_equal(dimming(drops=0.1), dimming(drops=0.1, second=1.0))
    assert np.any(dimming(drops=0.1) != dimming(drops=0.1, second=3.0))


def test_dirt_on_the_glass_dims_all_beams_on_both_ways():
    np.testing.assert_allclose(dimming(dirt=0.2), 0.64)


# Sun


def test_the_noise_of_glare_falls_with_the_angle_to_the_sun():
    pulses = pulses_of(SENSOR, SWEEP.sent)
    sun = np.array([np.cos(np.radians(3)), 0, np.sin(np.radians(3))])
    noise = glare_noise(pulses, sun=sun, sunlight=100_000.0)
    angle = np.degrees(np.arccos(pulses.direction @ sun))
    order = np.argsort(angle)
    assert np.all(np.diff(noise[order]) <= 1e-9)
    away = 10.0
    expected = SENSOR.noise_ratio * np.sqrt(1 + 100_000 * 105 / away**2 / 20_000)
    assert np.interp(away, angle[order], noise[order]) == pytest.approx(expected, rel=0.02)
    assert glare_noise(pulses, sun=np.zeros(3), sunlight=1e5) is None


def test_glare_loses_returns_near_the_sun_and_adds_false_ones():
    survey = sweep_of(replace(LEVELS["survey"], rays=1, bias=False))
    low = replace(SITUATION, utc=datetime(2024, 6, 21, 4, 30, tzinfo=UTC))
    found = altered(read_weather("clear,sunlight=120000"), sweep=survey, at=low)
    assert np.any(found.cloud.origin == Origin.RECEIVER)
    night = replace(SITUATION, utc=datetime(2024, 6, 21, 23, 30, tzinfo=UTC))
    dark = altered(read_weather("clear,sunlight=120000"), sweep=survey, at=night)
    np.testing.assert_array_equal(dark.cloud.source, np.arange(len(dark.original)))


def test_needs_are_checked_before_a_drive_begins():
    stages = Stages(read_weather("spray"))
    with pytest.raises(InputError, match="weather needs road users"):
        stages.check({"lidar_top": "lidar"}, known=(POSES,))
    stages.check({"lidar_top": "lidar"}, known=(POSES, ROAD_USERS))
    passing = Stages(read_weather("rain=5,model=lisa,end=20"))
    with pytest.raises(InputError, match="weather_model needs poses and time"):
        passing.check({"velodyne": "lidar"})
    Stages(read_weather("rain=5,fog=100")).check({"lidar_top": "lidar"})
