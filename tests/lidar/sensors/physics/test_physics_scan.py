"""Each physical setting in the returns of a scanner."""

from dataclasses import replace
from math import erfc

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, plate, world

from geoscene.classes import Class, materials
from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import scan
from lidar.sensors.physics.link import detection_probability
from lidar.sensors.physics.reflect import pane_reflection
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.scanner import firings, load_sensor

HERE = Mount((0.0, 0.0, 0.0))
STILL = driven()


def wall(distance=20.0, **options):
    return world(plate(distance, **options))


def seen(name, scene, settings, *, frame=0, seed=1, **options):
    return scan(
        load_sensor(name, **options),
        HERE,
        trajectory=STILL,
        world=scene,
        frame=frame,
        seed=seed,
        settings=settings,
    )


def test_the_detection_range_follows_the_root_of_reflectance():
    """VLP-16: 10 % at 50 m; a brick wall of 40 % returns up to 100 m * sqrt(cos)."""
    cloud = seen("vlp16", wall(40.0, material="brick"), ScannerSettings(link=True))
    rho = materials()["brick"].reflectance[0]
    longest = 50 * np.sqrt(rho * np.cos(cloud.incidence) / 0.1)
    assert (cloud.range <= longest * (1 + 1e-4)).all()
    plain = seen("vlp16", wall(40.0, material="brick"), ScannerSettings())
    beyond = plain.range > 50 * np.sqrt(rho * np.cos(plain.incidence) / 0.1)
    assert len(plain) - len(cloud) == pytest.approx(np.count_nonzero(beyond), abs=2)
    assert beyond.any()


@pytest.mark.full
def test_detection_follows_the_data_sheet_in_a_scan():
    """The OS0 detects an 80 % target with probability 0.5 at 50 m and a 10 % one at 20 m; here brick."""
    sensor = load_sensor("os0_128")
    reflectance = np.interp(865, (905, 1064, 1550), materials()["brick"].reflectance)
    half = 50 * (reflectance / 0.8) ** (1 / sensor.falloff)
    for share, at in (
        (0.5, 1.0),
        (detection_probability(0.9**-sensor.falloff, 0.183, signal_noise=0.14), 0.9),
    ):
        scene = world(plate(at * half, half=1.5, material="brick"))
        plain, kept = (
            sum(
                len(
                    scan(
                        sensor,
                        HERE,
                        trajectory=STILL,
                        world=scene,
                        frame=k,
                        settings=ScannerSettings(detection=on),
                    )
                )
                for k in range(8)
            )
            for on in (False, True)
        )
        assert plain > 500
        assert kept / plain == pytest.approx(share, abs=0.01 + 3 * np.sqrt(share * (1 - share) / plain))


def test_constant_noise_has_the_presets_deviation():
    cloud = seen("vlp16", wall(), ScannerSettings(range_noise="constant"))
    error = cloud.range - cloud.true_range
    assert error.mean() == pytest.approx(0, abs=5e-4)
    assert error.std() == pytest.approx(0.01, rel=0.05)
    assert np.array_equal(cloud.true_range, seen("vlp16", wall(), ScannerSettings()).range)


def test_noise_of_dim_targets_is_larger():
    for material, rho in (("plaster", 0.75), ("tyre", 0.04)):
        cloud = seen("vlp16", wall(30.0, half=8.0, material=material), ScannerSettings(range_noise="signal"))
        power = rho / 0.1 * (50 / 30) ** 2
        expected = np.hypot(0.01, 0.09 / np.sqrt(2 * power))
        assert np.std(cloud.range - cloud.true_range) == pytest.approx(expected, rel=0.1)


def test_bias_is_constant_for_each_laser():
    first, later = (seen("vlp16", wall(), ScannerSettings(bias=True), frame=k) for k in (0, 4))
    errors = []
    for cloud in (first, later):
        error = cloud.range - cloud.true_range
        assert all(np.ptp(error[cloud.ring == r]) < 1e-9 for r in np.unique(cloud.ring))
        errors.append([error[cloud.ring == r][0] for r in np.unique(cloud.ring)])
    assert errors[0] == pytest.approx(errors[1], abs=1e-9)
    assert 0.001 < np.std(errors[0]) < 0.015


def test_quantisation_gives_whole_steps_and_codes():
    cloud = seen("vlp16", wall(), ScannerSettings(quantise=True))
    assert np.abs(cloud.range / 0.002 - np.round(cloud.range / 0.002)).max() < 1e-6
    assert np.abs(cloud.range - cloud.true_range).max() <= 0.001 + 1e-12
    assert (cloud.intensity == np.round(cloud.intensity)).all()


def test_angle_noise_changes_ranges_but_not_reported_angles():
    scene = wall(20.0, tilt=np.radians(60))
    plain, noisy = (
        scan(
            load_sensor("mid40"),
            HERE,
            trajectory=STILL,
            world=scene,
            frame=0,
            settings=ScannerSettings(angle_noise=on),
        )
        for on in (False, True)
    )
    both = np.intersect1d(plain.time_ns, noisy.time_ns)
    a, b = (c.range[np.isin(c.time_ns, both)] for c in (plain, noisy))
    # 0.1 degrees on a wall at 60 degrees: 20 m * 1.7e-3 * tan(60) = 6 cm
    assert 0.01 < np.std(a - b) < 0.3
    directions = noisy.xyz / np.linalg.norm(noisy.xyz, axis=1, keepdims=True)
    fired = firings(load_sensor("mid40"), 0)
    rows = np.searchsorted(fired.time_ns, noisy.time_ns + noisy.start_ns)
    assert directions == pytest.approx(fired.direction[rows], abs=1e-6)


def test_false_alarms_come_at_the_computed_rate():
    """In bright daylight noise passes the threshold often enough to be counted."""
    lux = 30_000.0
    nothing = world(box((500, 500, 500), (501, 501, 501)))
    cloud = seen("vlp16", nothing, ScannerSettings(false_alarms=True, daylight_lux=lux))
    noise = 0.18 * np.sqrt(1 + lux / 20_000)
    gates = (100.0 - 0.5) / 0.3
    expected = len(firings(load_sensor("vlp16"), 0)) * gates * 0.5 * erfc(1 / (np.sqrt(2) * noise))
    assert len(cloud) == pytest.approx(expected, abs=4 * np.sqrt(expected))
    assert (cloud.klass == Class.NOISE).all()
    assert (cloud.feature == -1).all()
    assert not cloud.true_range.any()


def test_interference_grows_with_the_number_of_other_scanners():
    nothing = world(box((500, 500, 500), (501, 501, 501)))
    few, many = (len(seen("vlp16", nothing, ScannerSettings(interference=m))) for m in (100, 1000))
    pulses = len(firings(load_sensor("vlp16"), 0))
    assert few == pytest.approx(pulses * 100 * 5e-5, rel=0.4)
    assert many == pytest.approx(pulses * (1 - (1 - 5e-5) ** 1000), rel=0.15)


def test_coded_pulses_keep_other_scanners_out():
    nothing = world(box((500, 500, 500), (501, 501, 501)))
    coded = replace(load_sensor("vlp16"), code_bits=3)
    settings = ScannerSettings(interference=1000)
    found = scan(coded, HERE, trajectory=STILL, world=nothing, frame=0, seed=1, settings=settings)
    heard = len(firings(coded, 0)) * (1 - (1 - 5e-5) ** 1000)
    assert len(found) == pytest.approx(heard / 8, rel=0.25)


def edge(depth):
    """A wall whose right half stands ``depth`` metres farther back."""
    return world(
        box((10, 0, -5), (10.1, 20, 5), feature=1),
        box((10 + depth, -20, -5), (10.2 + depth, 20, 5), feature=2),
    )


def test_a_beam_across_a_low_step_gives_one_point_between():
    cloud = seen("vlp16", edge(0.4), ScannerSettings(rays=61))
    x = cloud.xyz[:, 0]
    mixed = (x > 10.02) & (x < 10.38)
    assert mixed.any()
    assert cloud.echoes.max() == 1
    # Its label and true range are those of the surface on the beam's axis.
    on_axis = np.where(cloud.xyz[mixed, 1] > 0, 1, 2)
    assert np.mean(cloud.feature[mixed] == on_axis) > 0.95
    assert not ((seen("vlp16", edge(0.4), ScannerSettings()).xyz[:, 0] - 10.2) ** 2 < 0.18**2).any()


def test_a_beam_across_a_high_step_gives_two_echoes():
    cloud = seen("vlp16", edge(3.0), ScannerSettings(rays=61), return_mode="dual")
    pair = cloud.echoes == 2
    assert pair.any()
    assert set(cloud.echo[pair]) == {1, 2}
    near, far = (cloud.xyz[pair & (cloud.echo == k), 0] for k in (1, 2))
    assert near == pytest.approx(10, abs=0.1)
    assert far == pytest.approx(13, abs=0.1)
    assert ((np.abs(cloud.xyz[:, 0] - 10) < 0.1) | (np.abs(cloud.xyz[:, 0] - 13) < 0.1)).all()


def test_a_footprint_on_a_flat_wall_changes_little():
    clouds = [seen("vlp16", wall(20.0), ScannerSettings(rays=rays)) for rays in (1, 19)]
    near = [c.true_range < 80 for c in clouds]
    off = [(c.range - c.true_range)[n] for c, n in zip(clouds, near, strict=True)]
    code = [c.intensity[n] for c, n in zip(clouds, near, strict=True)]
    assert np.array_equal(clouds[0].time_ns[near[0]], clouds[1].time_ns[near[1]])
    assert not off[0].any()
    assert np.median(np.abs(off[1])) < 0.001
    assert 0.001 < np.abs(off[1]).max() < 0.2  # at an incidence of 75 degrees
    assert code[0] == pytest.approx(code[1], abs=0.5)


def test_glass_transmits_and_reflects():
    """A pane at 5 m, a wall behind it at 15 m and one behind the sensor at -10 m, which appears at 20 m."""
    scene = world(
        plate(5.0, half=2.0, feature=1, material="glass"),
        plate(15.0, feature=2),
        plate(-10.0, feature=3),
    )
    cloud = seen("lms511", scene, ScannerSettings(mirrors=True), return_mode="all")
    ahead = np.abs(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])) < np.radians(5)
    x, feature = cloud.xyz[ahead, 0], cloud.feature[ahead]
    for number, place in ((1, 5.0), (2, 15.0), (3, 20.0)):
        assert x[feature == number] == pytest.approx(place, abs=0.01)
        assert (feature == number).any()
    ghosts = cloud.klass == Class.NOISE
    assert (cloud.feature[ghosts] == 3).all()
    # Two passes through the pane: the wall behind keeps (1 - R)^2 of its code, the ghost R^2.
    rho = materials()["plaster"].reflectance[0] * 100
    middle = np.abs(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])) < np.radians(0.2)
    share = pane_reflection(1.0)
    assert cloud.intensity[middle & (cloud.feature == 2)] == pytest.approx(rho * (1 - share) ** 2, rel=1e-3)
    assert cloud.intensity[middle & (cloud.feature == 3)] == pytest.approx(rho * share**2, rel=1e-3)
    blocked = seen("lms511", scene, ScannerSettings(), return_mode="all")
    assert 3 not in blocked.feature


def pond_before_a_bank():
    return world(
        box((-60, -60, -1), (60, 60, 0), feature=1, klass=Class.WATER, material="water"),
        box((20, -30, 0), (21, 30, 8), feature=2, material="plaster"),
    )


def test_water_mirrors_the_far_bank_and_glints_below():
    pond = pond_before_a_bank()
    mount = Mount((0.0, 0.0, 2.0))
    cloud = scan(
        load_sensor("vlp16"),
        mount,
        trajectory=STILL,
        world=pond,
        frame=0,
        settings=ScannerSettings(mirrors=True, link=True),
    )
    ghosts = cloud.klass == Class.NOISE
    assert ghosts.any()
    assert (cloud.xyz[ghosts, 2] + 2 < 0).all()  # the bank's image lies below the water
    assert not (cloud.klass == Class.WATER).any()  # seen at 15 degrees or less
    down = Mount((0.0, 0.0, 30.0), (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)))
    below = scan(
        load_sensor("mid40"),
        down,
        trajectory=STILL,
        world=pond,
        frame=0,
        settings=ScannerSettings(mirrors=True),
    )
    water = below.klass == Class.WATER
    assert below.intensity[water & (below.incidence < 0.05)].min() > 5 * np.median(
        below.intensity[water & (below.incidence > 0.3)]
    )


@pytest.mark.full
@pytest.mark.parametrize("surface", ["glass", "water"])
def test_rays_of_a_pulse_share_the_power_that_is_mirrored(surface):
    if surface == "glass":
        scene = world(plate(5.0, feature=1, material="glass"), plate(-10.0, feature=2))
    else:
        scene = pond_before_a_bank()
    mirrored = []
    for rays in (1, 7):
        cloud = scan(
            load_sensor("vlp16", return_mode="dual"),
            Mount((0.0, 0.0, 2.0)),
            trajectory=STILL,
            world=scene,
            frame=0,
            seed=1,
            settings=ScannerSettings(mirrors=True, rays=rays),
        )
        ahead = np.abs(np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])) < np.radians(5)
        mirrored.append(cloud.intensity[ahead & (cloud.klass == Class.NOISE) & (cloud.feature == 2)])
    assert len(mirrored[0]) > 10
    assert np.median(mirrored[1]) == pytest.approx(np.median(mirrored[0]), rel=0.05)


def test_a_retro_reflector_saturates_and_blooms():
    sign = world(box((20, -0.5, -0.5), (20.1, 0.5, 0.5), feature=4, material="retroreflector"))
    plain = seen("vlp16", sign, ScannerSettings())
    assert plain.intensity.min() > 200
    bloomed = seen("vlp16", sign, ScannerSettings(blooming=True))
    false = bloomed.klass == Class.NOISE
    assert false.any()
    assert np.abs(bloomed.xyz[false, 0] - 20).max() < 0.2
    beside = np.abs(np.arctan2(np.abs(bloomed.xyz[false, 1]), bloomed.xyz[false, 0]) - np.arctan2(0.5, 20))
    assert np.degrees(beside).max() < 0.31


def test_reflectance_spread_is_constant_for_each_object():
    scene = world(*(box((10, y, -5), (10.1, y + 1, 5), feature=y + 20) for y in range(-20, 20)))
    cloud = seen("vlp16", scene, ScannerSettings(spread=0.2))
    plain = seen("vlp16", scene, ScannerSettings())
    ratio = cloud.intensity / plain.intensity
    each = [ratio[plain.feature == f] for f in np.unique(plain.feature)]
    assert all(np.ptp(r) < 1e-4 for r in each)
    assert np.std(np.log([r[0] for r in each])) == pytest.approx(0.2, rel=0.4)


@pytest.mark.full
def test_thin_wires_return_their_share_of_the_power_in_many_pulses():
    """Upright wires of 2 mm in beams 73 mm wide: few rays of a pulse lie in line with them."""
    wires = []
    for k, angle in enumerate(2 * np.pi * (np.arange(200) + 0.3) / 200):
        x, y = 20 * np.cos(angle), 20 * np.sin(angle)
        wires.append(box((x - 0.001, y - 0.001, -8), (x + 0.001, y + 0.001, 8), feature=k))
    scene = world(*wires)
    rho = 100 * materials()["brick"].reflectance[0]
    share = {rays: seen("vlp16", scene, ScannerSettings(rays=rays)).intensity / rho for rays in (7, 19, 61)}
    total = [power.sum() for power in share.values()]
    assert np.ptp(total) < 0.1 * total[-1]
    assert share[19].max() < 0.25  # three rays in line, and the wire's sides
    assert share[61].max() < 0.15
    assert len(share[7]) < 0.5 * len(share[19]) < 0.4 * len(share[61])


def test_seven_rays_are_nearer_to_many_than_one_ray():
    """Posts before a wall: ranges and classes of the strongest echo, against 61 rays."""
    posts = [box((10, y, -5), (10.05, y + 0.05, 5), klass=Class.POLE) for y in np.arange(-6.0, 6.0, 0.37)]
    scene = world(*posts, plate(14.0))
    clouds = [seen("vlp16", scene, ScannerSettings(rays=rays)) for rays in (1, 7, 61)]
    key = [cloud.column * 16 + cloud.ring.astype(int) for cloud in clouds]
    both = np.intersect1d(np.intersect1d(key[0], key[1]), key[2])
    one, seven, many = (c.where(np.isin(k, both)) for c, k in zip(clouds, key, strict=True))
    off = [np.abs(cloud.range - many.range) for cloud in (one, seven)]
    assert np.count_nonzero(off[1] > 0.1) < 0.7 * np.count_nonzero(off[0] > 0.1)
    wrong = [np.count_nonzero(cloud.klass != many.klass) for cloud in (one, seven)]
    assert wrong[1] < 0.7 * wrong[0]


def test_the_air_dims_intensity():
    """A scanner that assumes clear air codes 40 % at 50 m, with 0.01 1/m, as 40 exp(-1) = 14.7."""
    clear, hazy = (
        seen("vlp16", wall(50.0, material="brick"), ScannerSettings(extinction=a)) for a in (0, 0.01)
    )
    assert np.array_equal(clear.range, hazy.range)
    np.testing.assert_allclose(hazy.intensity, clear.intensity * np.exp(-0.02 * clear.range), rtol=1e-5)


def test_false_alarms_are_not_dimmed_by_the_air():
    nothing = world(box((500, 500, 500), (501, 501, 501)))
    clear, hazy = (
        seen("vlp16", nothing, ScannerSettings(false_alarms=True, daylight_lux=30_000, extinction=a))
        for a in (0, 0.05)
    )
    assert len(clear) > 100
    assert np.array_equal(clear.intensity, hazy.intensity)


def test_fog_attenuates_distant_surfaces_more():
    clear, foggy = (seen("vlp16", wall(40.0), ScannerSettings(link=True, extinction=a)) for a in (0.0, 0.02))
    assert len(foggy) < len(clear)
    assert foggy.range.max() < clear.range.max()


@pytest.mark.full
def test_a_long_footprint_on_level_ground_is_one_echo_with_few_rays():
    """Beams of 3.4 mrad cover 5 to 16 m of ground at 50 to 90 m; rays of two echoes would be 1 m apart."""
    ground = world(box((-200, -200, -3), (200, 200, -1.73)))
    few, many = (
        seen("hdl64e_s3", ground, ScannerSettings(rays=rays), return_mode="dual") for rays in (7, 61)
    )
    assert few.echoes.max() == many.echoes.max() == 1
    key = [cloud.column * 64 + cloud.ring.astype(int) for cloud in (few, many)]
    _, a, b = np.intersect1d(*key, return_indices=True)
    far = (many.range[b] > 50) & (many.range[b] < 90)
    assert np.count_nonzero(far) > 1000
    assert np.abs(few.range[a] - many.range[b])[far].max() < 0.05


@pytest.mark.full
def test_a_wall_at_the_end_of_slanted_ground_keeps_its_echo():
    """Neighbouring rays on the ground are 1 m apart along the beam; a wall 5 m on is an echo of its own."""
    scene = world(box((-60, -60, -3), (25, 60, -1.73), feature=1), box((32, -60, -3), (33, 60, 5), feature=2))
    cloud = seen("hdl64e_s3", scene, ScannerSettings(rays=61), return_mode="dual")
    pairs = cloud.echoes == 2
    assert pairs.any()
    assert set(cloud.feature[pairs & (cloud.echo == 2)]) == {2}
