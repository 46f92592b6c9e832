"""The stage on the echoes of a frame, and its consistency."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, world
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.special import erfc

from geoscene.classes import Class
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.laser.scan import cast
from lidar.sensors.physics.origin import Origin
from lidar.sensors.physics.settings import LEVELS, ScannerSettings
from lidar.sensors.rig.scanner import load_sensor
from lidar.signal.recorded import altered_recording
from lidar.signal.registry import Stages
from lidar.signal.run import altered_sweep
from lidar.signal.situation import Situation
from lidar.signal.weather.backscatter import (
    _strongest_gate,
    drawn_particles,
    notice,
    particles,
    response_ranges,
    soft_target,
    strength,
)
from lidar.signal.weather.fields import Field
from lidar.signal.weather.media import fog_extinction, medium_of, rain, snow
from lidar.signal.weather.setting import read_weather

ROOM = world(
    box((-40, -30, -1), (40, 30, 0), feature=7, klass=Class.ROAD, material="asphalt"),
    box((12, -20, 0), (15, 25, 9), feature=8),
)
DRIVE = {"trajectory": driven((10.0, 0.0, 0.0), start=(-20, -10, 0)), "world": ROOM}
LINK = ScannerSettings(link=True)
KINDS = ["rain=40", "snow=3", "fog=60", "dust=15,medium=even"]


def sweep_of(detector=LINK, *, sensor="vlp16", **options):
    options.setdefault("return_mode", "strongest")
    return cast(
        load_sensor(sensor, **options), Mount((1.2, 0, 1.9)), frame=2, seed=5, settings=detector, **DRIVE
    )


def altered(sweep, text, *, seed=3):
    stages = Stages(read_weather(text), seed)
    return altered_sweep(sweep, stages, at=Situation(sweep.sensor.name, sweep.frame))


SWEEP = sweep_of()
SURVEY = sweep_of(replace(LEVELS["survey"], rays=1))


def assert_same(cloud, other):
    for name, column in cloud.columns().items():
        if name in Cloud.__dataclass_fields__:
            np.testing.assert_array_equal(column, other.columns()[name], err_msg=name)


@pytest.mark.parametrize("text", ["rain=0", "snow=0", "clear", "rain=50,start=5", "fog=20,start=1,end=2"])
def test_without_extinction_the_cloud_is_the_clear_one(text):
    for sweep in (SWEEP, SURVEY):
        found = altered(sweep, text)
        assert_same(found.original, found.cloud)
        np.testing.assert_array_equal(found.cloud.source, np.arange(len(found.original)))


@pytest.mark.full
@pytest.mark.parametrize("text", KINDS)
def test_the_same_seed_gives_the_same_cloud(text):
    first, again, other = (altered(SURVEY, text, seed=seed) for seed in (3, 3, 4))
    assert_same(first.cloud, again.cloud)
    if text.startswith("snow"):
        assert len(first.cloud) != len(other.cloud) or (first.cloud.range != other.cloud.range).any()


@given(
    st.sampled_from(["rain", "snow", "fog", "dust"]),
    st.floats(0, 1),
    st.integers(0, 99),
    st.sampled_from([SWEEP, SURVEY]),
)
@settings(max_examples=25, deadline=None)
def test_returns_are_kept_lost_or_scattered_and_scattered_ones_lie_before_the_surface(
    kind, amount, seed, sweep
):
    low, high = {"rain": (0, 200), "snow": (0, 20), "fog": (10, 1000), "dust": (5, 200)}[kind]
    text = f"{kind}={low + amount * (high - low)}" + (",medium=even" if kind == "dust" else "")
    found = altered(sweep, text, seed=seed)
    cloud, original = found.cloud, found.original
    kept, hidden = cloud.source[cloud.source >= 0], cloud.hidden[cloud.hidden >= 0]
    assert len(np.unique(np.concatenate((kept, hidden)))) == len(kept) + len(hidden)
    lost = np.setdiff1d(np.arange(len(original)), np.concatenate((kept, hidden)))
    assert len(kept) + len(hidden) + len(lost) == len(original)
    # What is kept has its range, and no more intensity than in clear air.
    stays = cloud.source >= 0
    np.testing.assert_allclose(cloud.true_range[stays], original.true_range[kept])
    scattered = cloud.origin == Origin.WEATHER
    assert np.all((cloud.source[scattered] < 0) & (cloud.klass[scattered] == Class.NOISE))
    hides = scattered & (cloud.hidden >= 0)
    behind = cloud.hidden[hides]
    noise = 0.5  # metres, of weak echoes in the survey level
    assert np.all(cloud.range[hides] < original.range[behind] + noise)
    for column in ("time_ns", "ring", "column"):
        np.testing.assert_array_equal(
            getattr(cloud, column)[hides], getattr(original, column)[behind], err_msg=column
        )
    # Beams start some centimetres beside the sensor's origin.
    angle = np.arccos(np.clip(np.sum(unit(cloud.xyz[hides]) * unit(original.xyz[behind]), axis=1), -1, 1))
    assert np.all(angle * cloud.range[hides] < 0.1)


def unit(xyz):
    xyz = xyz.astype(float)
    return xyz / np.linalg.norm(xyz, axis=1, keepdims=True)


@pytest.mark.parametrize("reflectance", [0.1, 0.5])
def test_the_range_of_detection_is_the_root_of_the_link_equation(reflectance):
    sensor = SWEEP.sensor

    def seen(alpha):
        def excess(r):
            clear = reflectance / sensor.reference_reflectance * (sensor.reference_range / r) ** 2
            return np.log(clear) - 2 * alpha * r

        return brentq(excess, 0.5, 1000)

    visibilities = np.array([2000.0, 500, 200, 100, 50])
    ranges = [seen(fog_extinction(v, sensor.wavelength_nm)) for v in visibilities]
    assert np.all(np.diff(ranges) < 0)
    # The stage loses the echoes beyond that range and keeps those before it.
    for visibility, reach in zip(visibilities, ranges, strict=True):
        echoes = SWEEP.echoes
        flat = replace(echoes, apparent=np.full(len(echoes), reflectance))
        found = altered(replace(SWEEP, echoes=flat), f"fog={visibility}")
        kept = found.cloud.source[found.cloud.source >= 0]
        far = np.setdiff1d(np.flatnonzero(found.original.range > reach * 1.001), kept)
        assert len(far) == np.sum(found.original.range > reach * 1.001)
        near = found.original.range < reach * 0.999
        hidden = found.cloud.hidden[found.cloud.hidden >= 0]
        assert set(np.flatnonzero(near)) <= set(kept) | set(hidden)


def test_dense_fog_is_a_ring_around_the_sensor():
    found = altered(sweep_of(sensor="hdl64e_s2"), "fog=30").cloud
    ring = found.range[found.origin == Origin.WEATHER]
    assert len(ring) > 50_000
    assert ring.min() > 0.9
    assert np.quantile(ring, 0.9) < 2  # the rest is the receiver's noise on the slope of the echo
    assert found.intensity[found.origin == Origin.WEATHER].max() < 5


@pytest.mark.parametrize("detector", [LINK, replace(LEVELS["survey"], rays=1)])
def test_fog_gives_a_vlp16_false_returns_within_metres_below_some_40_m_of_visibility(detector):
    """As fog chambers show: clutter around the sensor in dense fog, none from 100 m on.

    Bijelic, Gruber and Ritter 2018; Heinzler et al. 2019; Li et al. 2020: a VLP-16, and its larger sisters.
    """
    sweep = sweep_of(detector)
    ranges = {}
    for visibility in (20, 30, 150, 300):
        cloud = altered(sweep, f"fog={visibility}").cloud
        ranges[visibility] = cloud.range[cloud.origin == Origin.WEATHER]
    assert len(ranges[20]) > 0.8 * len(sweep.firings)
    assert len(ranges[30]) > 0.5 * len(sweep.firings)
    assert max(len(ranges[150]), len(ranges[300])) < 0.002 * len(sweep.firings)
    for near in (ranges[20], ranges[30]):
        low, high = np.quantile(near, (0.02, 0.98))
        assert 0.9 < low < high < 6
        assert high - low > 0.5  # no ring without a width


@given(st.floats(0.3, 3), st.floats(0.05, 0.5), st.integers(1, 25), st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_the_echo_of_fog_is_the_strongest_of_noisy_gates(most, fall, gates, seed):
    noise = 0.18
    response = most * np.exp(-fall * 0.3 * np.arange(gates))[None]
    counts = response[0] >= most / 2
    power, weight = _strongest_gate(response, noise)
    noisy = response[0, counts] + noise * np.random.default_rng(seed).standard_normal((20_000, counts.sum()))
    # A single echo of that power passes the threshold as often, and is seen in the same gates.
    passes = (noisy.max(axis=1) > 1).mean()
    single = 0.5 * erfc((1 - power[0]) / noise / np.sqrt(2))
    assert single == pytest.approx(passes, abs=0.02 if power < 1 else 0.25)
    assert (single > 0.5) == (passes > 0.5) or passes == pytest.approx(0.5, abs=0.02)
    mean = (weight[0] / weight.sum()) @ np.arange(gates)
    assert mean == pytest.approx(np.mean(noisy.argmax(axis=1)), abs=0.5 + 0.15 * counts.sum())


@given(st.integers(0, 1000), st.floats(0.3, 1.2))
@settings(max_examples=50, deadline=None)
def test_particles_that_are_left_out_are_part_of_no_echo_that_is_noticed(seed, least):
    rng, n, separation = np.random.default_rng(seed), 60, 1.0
    found = np.sort(rng.integers(0, 10, n)), rng.uniform(1, 8, n), rng.uniform(0, 0.6, n)
    kept = notice(found, least=least, separation=separation)
    for p in range(10):
        of = found[0] == p
        order = np.flatnonzero(of)[np.argsort(found[1][of])]
        for first in range(len(order)):
            for last in range(first, min(first + 3, len(order))):  # neighbours within the separation
                rows = order[first : last + 1]
                chain = np.all(np.diff(found[1][rows]) <= separation)
                if chain and found[2][rows].sum() > least:
                    assert np.isin(found[1][rows], kept[1]).all()


def test_fog_that_is_even_around_the_sensor_sends_back_what_fog_everywhere_does(monkeypatch):
    everywhere = altered(SWEEP, "fog=30").cloud
    full = Field((0.0, 0.0), np.ones((1, 1)), 0.0, np.inf, 1.0)
    monkeypatch.setattr("lidar.signal.weather.stage.field_of", lambda *_, **__: full)
    stages = Stages(read_weather("fog=30"), 3)
    at = Situation(SWEEP.sensor.name, SWEEP.frame, poses=DRIVE["trajectory"].at)
    here = altered_sweep(SWEEP, stages, at=at).cloud
    np.testing.assert_array_equal(here.origin, everywhere.origin)
    np.testing.assert_allclose(here.range, everywhere.range)


def test_a_smaller_lens_sees_more_of_what_is_near():
    dust = [
        np.sum(altered(SWEEP, f"snow=2,lens={lens}").cloud.origin == Origin.WEATHER) for lens in (60, 30, 0)
    ]
    assert 0 < dust[0] < dust[1] < dust[2]
    sensor, distance = SWEEP.sensor, np.array([5.0, 50.0])
    ratio = strength(sensor, distance, lens=0.03) / strength(sensor, distance, lens=0.0)
    focus = 0.03 / np.sqrt(0.003 * 0.0012)
    np.testing.assert_allclose(ratio, 1 / (1 + (focus / distance) ** 2))


def test_snow_returns_thin_out_with_range_and_are_dim():
    found = altered(sweep_of(sensor="hdl64e_s2"), "snow=2").cloud
    flakes = found.origin == Origin.WEATHER
    near, middle, far = (np.sum(flakes & (found.range > a) & (found.range <= a + 4)) for a in (2, 6, 10))
    assert near > middle > far > 0
    assert found.intensity[flakes].mean() < 0.2 * found.intensity[found.source >= 0].mean()


def test_more_weather_loses_more_returns():
    for kind, amounts in {"rain": (5, 50, 200), "snow": (0.5, 3, 15), "fog": (500, 150, 40)}.items():
        kept = [np.sum(altered(SURVEY, f"{kind}={a}").cloud.source >= 0) for a in amounts]
        assert np.all(np.diff(kept) < 0), kind


@pytest.mark.parametrize("mode", ["strongest", "last", "dual"])
def test_return_modes_choose_among_surfaces_and_flakes(mode):
    found = altered(sweep_of(sensor="vlp16", return_mode=mode), "snow=4")
    flakes = found.cloud.origin == Origin.WEATHER
    behind = np.sum(found.cloud.hidden[flakes] >= 0)
    if mode == "last":
        assert behind == np.sum(np.isin(found.cloud.hidden, lost_ranges(found)))
    else:
        assert flakes.sum() > 0


def lost_ranges(found):
    """Rows of the original that the extinction alone would lose."""
    kept = found.cloud.source[found.cloud.source >= 0]
    return np.setdiff1d(np.arange(len(found.original)), kept)


@pytest.mark.parametrize("medium", [rain(50, 905.0), snow(5, 905.0)])
def test_drawn_and_undrawn_particles_send_back_what_the_medium_does(medium):
    sensor = load_sensor("hdl64e_s2")
    some, rest, distance = particles(sensor, medium, most=1e9)
    pulses = 300_000
    _, place, power = drawn_particles(some, np.full(pulses, np.inf), rng=np.random.default_rng(0))
    edges = np.array([2.0, 4, 8, 16, 32])
    drawn = np.histogram(place, edges, weights=power)[0] / pulses
    step = distance[1] - distance[0]
    clear = np.pi * strength(sensor, distance) * step
    undrawn = np.histogram(distance, edges, weights=clear * rest)[0]
    whole = np.histogram(distance, edges, weights=clear * medium.backscatter)[0]
    np.testing.assert_allclose(drawn + undrawn, whole, rtol=0.05)
    assert drawn[0] > 0.3 * whole[0]


def test_a_pulse_of_no_length_sees_the_lidar_equation():
    sensor = replace(load_sensor("vlp16"), pulse_ns=2.0)
    medium = medium_of("fog", 100, wavelength_nm=903, medium="kim")
    distance = response_ranges(sensor)
    soft = soft_target(
        sensor, medium.extinction, backscatter=np.full(len(distance), medium.backscatter), distance=distance
    )
    length = 0.299792458 * sensor.pulse_ns / 2
    place = soft.place[-1, :1]
    white = strength(sensor, place) * np.exp(-2 * medium.extinction * place)
    assert soft.power[-1] == pytest.approx(np.pi * medium.backscatter * length * white[0], rel=0.05)


@pytest.mark.parametrize("weather", ["snow=5", "fog=20", "rain=25"])
def test_weather_on_recorded_clouds_is_that_of_the_drive(weather):
    """Where the sensor saw sky, too."""
    simulated = altered(SWEEP, weather)
    original = simulated.original
    stages = Stages(read_weather(weather), 3)
    at = Situation(SWEEP.sensor.name, 2)
    found = altered_recording(original, stages, sensor=SWEEP.sensor, at=at, sent=SWEEP.firings).cloud
    cloud = simulated.cloud
    for origin in (Origin.SURFACE, Origin.WEATHER):
        counts = [np.sum(one.origin == origin) for one in (found, cloud)]
        assert counts[0] == pytest.approx(counts[1], rel=0.005, abs=20)
    known = places(original)
    weather_before_sky = [
        np.sum(one.origin[~np.isin(places(one), known)] == Origin.WEATHER) for one in (found, cloud)
    ]
    assert weather_before_sky[0] == pytest.approx(weather_before_sky[1], rel=0.05, abs=20)
    if weather == "snow=5":
        assert weather_before_sky[0] > 1000


def places(cloud):
    return cloud.column.astype(int) * 1000 + cloud.ring
