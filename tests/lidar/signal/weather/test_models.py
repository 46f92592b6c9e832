"""Published models against the figures of their papers."""

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, world
from scipy.integrate import quad
from scipy.optimize import brentq

from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import scan
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.scanner import load_sensor
from lidar.signal.registry import Stages
from lidar.signal.run import altered_cloud
from lidar.signal.situation import Situation
from lidar.signal.truth import Altered, cloud_truth, trace_unaltered
from lidar.signal.weather import models
from lidar.signal.weather.media import rain_extinction
from lidar.signal.weather.models import (
    LOST,
    SCATTERED,
    TARGET,
    Lidar,
    _snow,
    flake_disks,
    fog_response,
    goodin,
    goodin_extinction,
    hahner_fog,
    hahner_snow,
    lisa,
    occupancy,
    particle_count,
    rain_equivalent,
)
from lidar.signal.weather.setting import read_weather

RNG = np.random.default_rng


# LISA


def test_lisas_number_of_drops_in_the_beam():
    found = particle_count(10, np.array([10.0, 30, 100]), lidar=Lidar())
    np.testing.assert_allclose(found, [6.571, 177.4, 6571], rtol=1e-3)


@pytest.mark.full
def test_lisa_draws_only_particles_that_matter_and_no_others():
    """All particles of each beam, as the paper draws them, give the same share and ranges of returns."""
    lidar, rate, reach, n = Lidar(max_range=150.0), 60.0, 20.0, 20_000
    alpha = rain_extinction(rate, 905)
    distance, reflectance = np.full(n, reach), np.full(n, 0.02)
    some = lisa(distance, reflectance, kind="rain", rate=rate, extinction=alpha, rng=RNG(1), lidar=lidar)
    slope = 4.1 * rate**-0.21
    rng, hits = RNG(2), []
    count = particle_count(rate, np.array([reach]), lidar=lidar)[0]
    power = 0.02 * np.exp(-2 * alpha * reach) / reach**2
    for k in rng.poisson(0, n) + np.floor(count + rng.random(n)).astype(int):
        r = reach * np.cbrt(rng.random(k))
        d = 0.05 - np.log(rng.random(k)) / slope
        share = np.minimum((d / 1000 / (r * np.tan(3e-3))) ** 2, 1)
        p = (0.328 / 2.328) ** 2 * np.exp(-2 * alpha * r) * share / r**2 * (r > 1.5)
        best = np.argmax(p) if k else 0
        if k and p[best] > power and p[best] > 0.9 / 150**2:
            hits.append(r[best])
    scattered = some.state == SCATTERED
    assert np.sum(scattered) == pytest.approx(len(hits), abs=5 * np.sqrt(len(hits)))
    assert np.mean(some.range[scattered]) == pytest.approx(np.mean(hits), rel=0.05)


def test_lisa_loses_targets_where_the_link_equation_says():
    alpha = rain_extinction(50, 905)
    reach = brentq(lambda r: 0.5 * np.exp(-2 * alpha * r) / r**2 - 0.9 / 200**2, 1, 300)
    distance = np.array([0.98, 1.02]) * reach
    found = lisa(distance, np.full(2, 0.5), kind="fog", rate=0, extinction=alpha, rng=RNG(0), lidar=Lidar())
    assert found.state.tolist() == [TARGET, LOST]
    np.testing.assert_allclose(found.reflectance, 0.5 * np.exp(-2 * alpha * distance))


def test_lisas_noise_at_the_threshold_is_64_mm():
    n, reach = 40_000, 199.999
    found = lisa(
        np.full(n, reach), np.full(n, 0.9), kind="fog", rate=0, extinction=0, rng=RNG(0), lidar=Lidar()
    )
    assert np.std(found.range) == pytest.approx(0.0636, rel=0.02)


def test_lisas_last_return_is_the_target_where_it_is_seen():
    distance, reflectance = np.full(3000, 15.0), np.full(3000, 0.05)
    options = {"kind": "rain", "rate": 100.0, "extinction": rain_extinction(100, 905)}
    strongest = lisa(distance, reflectance, rng=RNG(0), lidar=Lidar(), **options)
    last = lisa(distance, reflectance, rng=RNG(0), lidar=Lidar(last=True), **options)
    assert np.all(last.state == TARGET)
    assert np.any(strongest.state == SCATTERED)


@pytest.mark.parametrize("last", [False, True])
def test_lisa_loses_returns_of_reflectance_zero(last):
    """They are not replaced by drops, although these are brighter."""
    dark, dim = (
        lisa(
            np.full(3000, 15.0), np.full(3000, reflectance), kind="rain", rate=100, extinction=0.01,
            rng=RNG(0), lidar=Lidar(last=last),
        )
        for reflectance in (0, 1e-9)
    )  # fmt: skip
    assert np.all(dark.state == LOST)
    assert np.any(dim.state == SCATTERED)


# Goodin


def _goodin_reach(reflectance, rate):
    """The range at which the model begins to lose a target, by bisection of the model itself."""

    def seen(r):
        found = goodin(np.array([r]), np.array([reflectance]), rate=rate, rng=RNG(0))
        return float(found.state[0] == TARGET) - 0.5

    return brentq(seen, 1, 200, xtol=1e-3)


def test_goodins_range():
    assert _goodin_reach(0.9, 1e-9) == pytest.approx(100, abs=0.1)
    assert _goodin_reach(0.9, 10) == pytest.approx(30.13, abs=0.02)
    assert _goodin_reach(0.1, 10) == pytest.approx(16.97, abs=0.02)


def test_goodins_extinction_and_noise():
    assert [goodin_extinction(r) for r in (1, 10, 50)] == pytest.approx([1e-2, 3.98e-2, 1.05e-1], rel=5e-3)
    assert 23 < goodin_extinction(10) / rain_extinction(10, 905) < 28
    n = 40_000
    found = goodin(np.full(n, 20.0), np.full(n, 0.9), rate=10, rng=RNG(0))
    assert np.std(found.range) == pytest.approx(0.02 * 20, rel=0.02)


# Hahner, fog


def test_the_response_of_fog():
    _, fog, integral = fog_response(0.06)
    assert fog[-1] == pytest.approx(1.60, abs=0.1)
    assert integral[-1] == pytest.approx(3.816e-9, rel=0.02)


@pytest.mark.parametrize("end", [2.0, 3.0, 4.5])
def test_the_response_of_fog_before_a_near_target_by_quadrature(end):
    target, _, integral = fog_response(0.06)
    row = np.searchsorted(target, end)
    c = 299_792_458.0

    def response(at):
        def share(t):
            r = at - c * t / 2
            if not 0.9 < r < target[row]:
                return 0.0
            return np.sin(np.pi * t / 40e-9) ** 2 * np.exp(-0.12 * r) / r**2 * min((r - 0.9) / 0.1, 1)

        low, high = (max(0.0, 2 * (at - x) / c) for x in (target[row], 0.9))
        return quad(share, low, min(high, 40e-9), limit=200)[0]

    best = max(response(at) for at in np.arange(0.5, target[row] + 6, 0.05))
    assert integral[row] == pytest.approx(best, rel=0.02)


@pytest.mark.parametrize("intensity", [30.0, 200.0])
def test_fog_beats_targets_beyond_the_cross_over(intensity):
    # Codes are whole numbers, which shifts the cross-over by some metres.
    distance = np.arange(10, 60, 0.01)
    ratio = models._BACKSCATTER * 0.06 / np.log(20) / (1e-6 / np.pi) * fog_response(0.06)[2][-1]
    cross = brentq(lambda r: r * r * ratio - np.exp(-0.12 * r), 5, 100)
    assert cross == pytest.approx(35.6, abs=0.5)
    found = hahner_fog(distance, np.full(len(distance), intensity), extinction=0.06, rng=None)
    first = distance[found.state == SCATTERED][0]
    assert first == pytest.approx(cross, abs=3)
    assert np.all(found.state[distance > cross + 3] == SCATTERED)
    assert found.range[-1] == pytest.approx(1.6, abs=0.1)


# Hahner, snow


def test_flakes_cover_the_share_of_the_plane():
    assert occupancy(2.5, 1.6) == pytest.approx(4.340e-6, rel=1e-3)
    assert rain_equivalent(2.5, 1.6) == pytest.approx(34.975, rel=1e-3)
    _, distance, radius = flake_disks(2.5, fall_speed=1.6, medium="gunn-marshall", rng=RNG(0))
    assert np.sum(radius**2) / 80**2 == pytest.approx(4.340e-6, rel=2e-3)
    assert np.all(distance <= 80)
    assert radius.max() <= 0.01
    assert np.median(distance) == pytest.approx(80 / np.sqrt(2), rel=0.02)


def snowed(distance, intensity, *, rate=2.5, n=4000, seed=0):
    return hahner_snow(
        np.full(n, distance),
        np.full(n, intensity),
        azimuth=np.linspace(-np.pi, np.pi, n),
        ring=np.zeros(n, int),
        rate=rate,
        rng=RNG(seed),
    )


@pytest.mark.full
def test_snow_scatters_more_dim_and_far_targets():
    share = [np.mean(snowed(*target).state == SCATTERED) for target in ((10, 50), (60, 50), (60, 2))]
    assert 0 <= share[0] < share[1] < share[2] < 0.2


@pytest.mark.full
def test_snow_returns_lie_near_the_sensor_and_before_the_target():
    found = snowed(60.0, 2.0)
    flakes = found.range[found.state == SCATTERED]
    assert np.all((flakes > 0.8) & (flakes < 60.2))
    assert np.median(flakes) < 10
    kept = found.state == TARGET
    assert np.all(found.range[kept] == 60.0)
    assert np.all(found.reflectance[kept] <= 2.0)
    assert np.mean(found.reflectance[kept]) < 1.999


def test_a_flake_wins_where_it_returns_more_than_what_it_leaves_of_the_target():
    found = np.empty((3, 1))
    beams = np.zeros(1), np.array([30.0]), np.array([20.0])
    for share in (0.3, 0.8):
        # A disk of this share of the beam of 3 mrad, 5 m away, in the middle.
        radius = 5 * np.sin(share * 1.5e-3)
        disks = np.zeros(1), np.array([5.0]), np.array([radius])
        _snow(beams, disks, 1.5e-3, found)
        flake, target = 0.9 * 255 * share / 25, 20 * (1 - share)
        assert found[2, 0] == (SCATTERED if flake > target else TARGET)
        assert found[1, 0] == pytest.approx(max(flake, target), rel=0.01)
    _snow(beams, (np.zeros(1), np.array([0.5]), np.array([0.01])), 1.5e-3, found)
    assert found[2, 0] == LOST


# The stage


ROOM = scan(
    load_sensor("vlp16"),
    Mount((1.2, 0.0, 1.9)),
    trajectory=driven((10.0, 0.0, 0.0), start=(-20, -10, 0)),
    world=world(box((-40, -30, -1), (40, 30, 0), material="asphalt"), box((12, -20, 0), (15, 25, 9))),
    frame=2,
)


def modelled(text, *, seed=0):
    original = ROOM
    stages = Stages(read_weather(text), seed)
    cloud = altered_cloud(trace_unaltered(original).cloud, stages, at=Situation("vlp16", 0))
    return original, cloud


@pytest.mark.parametrize(
    "text",
    [
        "rain=60,model=lisa",
        "snow=5,model=lisa",
        "fog=40,model=lisa",
        "rain=20,model=goodin",
        "fog=50,model=hahner_fog",
        "snow=2.5,model=hahner_snow",
    ],
)
def test_models_keep_lose_or_scatter_each_return(text):
    original, cloud = modelled(text)
    again = modelled(text)[1]
    np.testing.assert_array_equal(cloud.xyz, again.xyz)
    hit = cloud.origin == Origin.WEATHER
    kept, hidden = cloud.source[~hit], cloud.hidden[hit]
    assert np.all(kept >= 0)
    assert np.all(hidden >= 0)
    assert len(np.unique(np.concatenate((kept, hidden)))) == len(cloud) < len(original) + 1
    assert np.all(cloud.range[hit] < original.range[hidden] + 0.2)
    unit = cloud.xyz[hit] / np.linalg.norm(cloud.xyz[hit], axis=1, keepdims=True)
    before = original.xyz[hidden] / np.linalg.norm(original.xyz[hidden], axis=1, keepdims=True)
    assert np.all(np.sum(unit * before, axis=1) > 1 - 1e-5)
    truth = cloud_truth(Altered(cloud, original), start_ns=0)
    assert len(truth["removed"]) + len(kept) == len(original)


@pytest.mark.parametrize("text", ["rain=0,model=lisa", "rain=0,model=goodin", "snow=0,model=hahner_snow"])
def test_models_without_weather_change_nothing(text):
    original, cloud = modelled(text)
    for name, column in original.columns().items():
        np.testing.assert_array_equal(column, cloud.columns()[name])


def test_models_have_no_place_and_no_cover_glass():
    for extra in ("drops=0.1", "longitude=7,latitude=50,radius=50"):
        with pytest.raises(InputError, match="needs model physical"):
            Stages(read_weather(f"rain=5,model=lisa,{extra}"))
