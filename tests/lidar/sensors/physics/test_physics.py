"""Physics of returns against published and computed values."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import materials
from lidar.errors import InputError
from lidar.geometry.random_streams import generator, normal_of
from lidar.sensors.laser.rays import bundle
from lidar.sensors.physics.detector import quantise, signal_sigma, stretch_sigma, walk
from lidar.sensors.physics.echoes import Echoes, join, merge, mix, number_echoes, select_reported
from lidar.sensors.physics.link import (
    amplitude,
    apparent_of,
    daylight_noise,
    detection_probability,
    false_alarm_probability,
    reflectivity_code,
    transmission,
)
from lidar.sensors.physics.reflect import (
    INCIDENCE_LAWS,
    WATER,
    covered_reflectance,
    film,
    fresnel,
    glint,
    pane_reflection,
    reflect,
    reflectance_table,
    sent_back,
    surface_reflection,
    through_water,
)
from lidar.sensors.physics.settings import LEVELS, PLAIN, ScannerSettings
from lidar.sensors.rig.scanner import WEAK_SIGMA, load_sensor
from lidar.settings import settings_of

OS0 = replace(load_sensor("os0_128"), reference_reflectance=0.8, reference_range=50.0, falloff=2.0)


@pytest.mark.parametrize(
    ("angle_deg", "s", "p"),
    [
        (0, 0.0200, 0.0200),
        (45, 0.0522, 0.0027),
        (60, 0.1137, 0.0044),
        (85, 0.6722, 0.4930),
        (53.06, 0.0770, 0.0),
    ],
)
def test_water_reflects_by_fresnels_equations(angle_deg, s, p):
    found = fresnel(np.cos(np.radians(angle_deg)), WATER)
    assert found[0] == pytest.approx(s, abs=2e-4)
    assert found[1] == pytest.approx(p, abs=2e-4)


@pytest.mark.parametrize(
    ("angle_deg", "share"), [(0, 0.0769), (30, 0.0793), (45, 0.0927), (60, 0.1519), (80, 0.5415)]
)
def test_a_pane_reflects_with_both_faces(angle_deg, share):
    assert pane_reflection(np.cos(np.radians(angle_deg))) == pytest.approx(share, abs=2e-4)


@pytest.mark.parametrize(("angle_deg", "expected"), [(0, 0.0962), (60, (0.0794 + 0.0992) / 2)])
def test_a_film_of_water_takes_the_published_share(angle_deg, expected):
    """Anchors of Hahner et al. 2022: diffuse reflectance 0.1 under a film."""
    assert 0.1 * film(np.cos(np.radians(angle_deg)), 0.1) == pytest.approx(expected, abs=2e-4)


def test_a_film_passes_no_grazing_light():
    assert film(0.0, 0.3) == pytest.approx(0, abs=1e-12)


def test_water_absorbs_infrared():
    assert through_water(905.0, 1e-3) > 0.99
    assert through_water(1550.0, 1e-3) == pytest.approx(0.46, abs=0.03)


def test_wet_and_snowy_ground_by_wavelength():
    known = {m.name: m.code for m in materials().values()}
    asphalt, snow = known["asphalt"], known["snow"]
    for nm in (905.0, 1550.0):
        dry, _ = reflectance_table(nm)
        bare = covered_reflectance(nm, wetness=0.0, snow=0.0)
        assert np.array_equal(bare.open, dry)
        assert not bare.film.any()
        deep = covered_reflectance(nm, wetness=1.0, snow=1.0)
        assert deep.open[asphalt] == dry[snow]
        assert not deep.film.any()
    near, far = (covered_reflectance(nm, wetness=1.0, snow=0.0).film for nm in (905.0, 1550.0))
    assert near[asphalt] == pytest.approx(0.4 * 0.17, rel=0.02)
    assert far[asphalt] < 0.65 * near[asphalt]  # water absorbs there, though dry asphalt is brighter
    assert near[known["car_paint"]] == pytest.approx(
        reflectance_table(905.0)[0][known["car_paint"]], rel=0.02
    )


@given(st.floats(0.0, 1.0), st.sampled_from([1.33, 1.5]))
def test_no_surface_reflects_more_than_it_receives(cosine, index):
    for share in (surface_reflection(cosine, index), pane_reflection(cosine, index)):
        assert -1e-12 <= share <= 1 + 1e-12


def test_glint_is_bright_below_and_zero_to_the_side():
    """At 3 m/s the slope variance is 0.01836: R / (4 m) = 0.0200 / 0.0734."""
    assert glint(1.0) == pytest.approx(0.0200 / (4 * (0.003 + 0.00512 * 3)), rel=0.01)
    assert glint(np.cos(np.radians(45.0))) < 1e-9


def test_a_mirror_keeps_length_and_angle():
    rng = np.random.default_rng(1)
    d, n = rng.normal(size=(2, 50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    m = reflect(d, n)
    assert np.linalg.norm(m, axis=1) == pytest.approx(np.linalg.norm(d, axis=1))
    assert np.einsum("ij,ij->i", m, n) == pytest.approx(-np.einsum("ij,ij->i", d, n))
    assert reflect(m, n) == pytest.approx(d)


def test_maximum_range_is_proportional_to_the_root_of_reflectance():
    """From the figure of the 80 % target, that of the 10 % one: 50 m -> 17.7 m; data sheet 120 -> 42.4 m."""
    for rho, cosine in ((0.1, 1.0), (0.8, 0.5), (0.3, 0.2)):
        longest = 50.0 * np.sqrt(rho * cosine / 0.8)
        at = amplitude(OS0, rho * cosine, distance=[0.999 * longest, 1.001 * longest])
        assert at[0] > 1 > at[1]
    longest = 120 * np.sqrt(0.1 / 0.8)
    assert longest == pytest.approx(42.4, abs=0.05)
    assert amplitude(replace(OS0, reference_range=120.0), 0.1, distance=longest) == pytest.approx(1.0)


def test_air_attenuates_out_and_back():
    assert transmission(30.0, 0.01) == pytest.approx(np.exp(-0.6))


@given(st.floats(1e-3, 1e3), st.floats(0.1, 500.0))
def test_apparent_reflectance_in_clear_air_is_the_true_one(rho, distance):
    assert apparent_of(OS0, amplitude(OS0, rho, distance=distance), distance=distance) == pytest.approx(rho)


@pytest.mark.parametrize(("rho", "half", "most"), [(0.8, 50.0, 45.0), (0.1, 20.0, 15.0)])
def test_detection_follows_the_data_sheet_of_the_os0(rho, half, most):
    """Ranges of 50 % and 90 % detection, given in steps of 5 m, of targets of 80 % and 10 %."""
    os0 = load_sensor("os0_128")

    def seen(distance):
        power = amplitude(os0, rho, distance=distance)
        return detection_probability(power, os0.noise_ratio, signal_noise=os0.signal_noise)

    assert seen(half) == pytest.approx(0.5, abs=0.01)
    distance = np.arange(1.0, 60.0, 0.05)
    assert distance[np.argmin(np.abs(seen(distance) - 0.9))] == pytest.approx(most, abs=3.0)


@pytest.mark.parametrize(("snr", "centimetres"), [(12, 10.0), (100, 3.0), (1e6, 1.5)])
def test_range_noise_follows_the_data_sheet_of_the_os1(snr, centimetres):
    os1 = load_sensor("os1_128")
    sigma = np.hypot(os1.range_sigma, signal_sigma(snr / 12, os1.weak_sigma))
    assert 100 * sigma == pytest.approx(centimetres, rel=0.02)


def test_false_alarms_are_as_rare_as_computed():
    """2.4e-8 a gate and 1.9e-5 a shot of 800 gates of 0.3 m."""
    assert false_alarm_probability(0.183, 0.3) == pytest.approx(2.4e-8, rel=0.05)
    assert false_alarm_probability(0.183, 240.0) == pytest.approx(1.9e-5, rel=0.05)
    assert false_alarm_probability(daylight_noise(0.183, 100_000), 240.0) > 0.1
    assert daylight_noise(0.18, 20_000) == pytest.approx(0.18 * np.sqrt(2))


@pytest.mark.parametrize(("snr", "millimetres"), [(1, 63.6), (10, 20.1), (100, 6.4)])
def test_range_noise_falls_with_signal(snr, millimetres):
    assert signal_sigma(snr, WEAK_SIGMA) * 1000 == pytest.approx(millimetres, abs=0.05)


def test_a_slanted_surface_stretches_the_pulse():
    """30 m, 3 mrad, 80 degrees: 0.51 m deep, 0.13 m of deviation."""
    sigma = stretch_sigma(30.0, np.cos(np.radians(80)), divergence=3e-3)
    assert 4 * sigma == pytest.approx(0.51, abs=0.005)
    assert sigma == pytest.approx(0.13, abs=0.005)
    assert stretch_sigma(30.0, 1.0, divergence=3e-3) == 0


@pytest.mark.parametrize("quantum", [0.001, 0.002, 0.0025, 0.004, 0.005, 0.007])
def test_quantisation_rounds_and_its_error_is_uniform(quantum):
    x = np.random.default_rng(0).uniform(1, 100, 20_000)
    q = quantise(x, quantum)
    assert np.abs(q - x).max() <= quantum / 2 * (1 + 1e-9)
    assert np.abs(q / quantum - np.round(q / quantum)).max() < 1e-6
    assert np.std(q - x) == pytest.approx(quantum / np.sqrt(12), rel=0.02)
    assert quantise(x, 0.0) is x


def test_range_walk_shortens_the_range_of_bright_echoes():
    assert walk([0.5, 1.0, 10.0, 100.0]) == pytest.approx([0, 0, -0.005, -0.010])


def test_materials_reflect_by_wavelength():
    at_905, _ = reflectance_table(905.0)
    at_1550, _ = reflectance_table(1550.0)
    grass, snow = materials()["grass"].code, materials()["snow"].code
    assert at_905[grass] == pytest.approx(0.509)
    assert at_1550[grass] == pytest.approx(0.243)
    assert at_905[snow] > 10 * at_1550[snow]
    between, _ = reflectance_table((905 + 1064) / 2)
    assert between[grass] == pytest.approx((0.509 + 0.525) / 2)


@pytest.mark.parametrize("law", ["lambert", "phong", "oren-nayar"])
def test_incidence_laws_fall_from_the_reflectance_to_zero(law):
    back = [sent_back(0.2, cosine, 0.0, INCIDENCE_LAWS.index(law)) for cosine in (1.0, 0.0)]
    assert back[0] == pytest.approx(0.2, rel=0.15)  # Oren-Nayar loses some light to roughness
    assert back[1] == pytest.approx(0.0, abs=1e-12)


def test_phong_at_normal_incidence_does_not_depend_on_the_specular_share():
    for share in (0.0, 0.3, 1.0):
        assert sent_back(0.4, 1.0, share, INCIDENCE_LAWS.index("phong")) == pytest.approx(0.4)
    at_45 = sent_back(0.4, np.sqrt(0.5), 0.3, INCIDENCE_LAWS.index("phong"))
    assert at_45 == pytest.approx(0.4 * 0.7 * np.sqrt(0.5), rel=1e-6)


def test_retro_reflectors_are_flat_to_30_degrees_and_fall_to_40_percent_at_45():
    angle = np.radians([0, 29, 45, 90])
    back = [sent_back(220.0, cosine, 0.0, 0) for cosine in np.cos(angle)]
    assert back == pytest.approx([220, 220, 88, 0], abs=1e-9)


def test_codes_are_linear_to_white_and_logarithmic_above():
    code = reflectivity_code(np.array([0.0, 0.1, 1.0, np.sqrt(1000.0), 1000.0, 1e6]))
    assert code == pytest.approx([0, 10, 100, 177.5, 255, 255])
    assert reflectivity_code(np.array([0.123]), whole=True) == 12
    assert reflectivity_code(np.array([1.0]), diffuse_code=110.0) == pytest.approx(110)


@pytest.mark.parametrize("rays", [1, 7, 19, 37, 61, 217])
def test_bundles_are_centred_and_as_wide_as_the_beam(rays):
    place = bundle(rays)
    assert len(place) == rays
    assert not place[0].any()
    assert place.mean(axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert np.linalg.norm(place, axis=1).max() < 1.05
    if rays > 1:  # mean square radius of a Gaussian beam within its 1/e^2 radius
        square = 0.5 * (1 - 3 * np.exp(-2)) / (1 - np.exp(-2))
        assert np.mean(np.sum(place**2, axis=1)) == pytest.approx(square, rel=0.06)


def surfaces(rows):
    """Echoes from (pulse, range, apparent, axis)."""
    pulse, distance, power, axis = (np.array(c) for c in zip(*rows, strict=True))
    n = len(pulse)
    return Echoes(
        pulse.astype(np.int32),
        distance.astype(float),
        power.astype(float),
        np.arange(n, dtype=np.int32),
        np.zeros(n, np.uint8),
        np.ones(n),
        distance.astype(float),
        axis.astype(bool),
    )


def test_close_surfaces_merge_into_one_echo_and_distant_ones_give_two():
    """5 ns resolve 0.75 m: 10.0 and 10.4 m merge, 10 and 12 m do not."""
    close = merge(surfaces([(0, 10.0, 0.5, True), (0, 10.4, 0.5, False)]), 0.75)
    assert len(close) == 1
    assert 10.0 < close.range[0] < 10.2  # the nearer is brighter by the square of the ranges
    apart = merge(surfaces([(0, 12.0, 0.5, True), (0, 10.0, 0.5, False)]), 0.75)
    assert apart.range == pytest.approx([10.0, 12.0])


def test_the_range_changes_monotonically_as_an_edge_crosses_the_beam():
    at = [
        merge(surfaces([(0, 10.0, 1 - w, w < 0.5), (0, 10.4, w, w >= 0.5)]), 0.75).range[0]
        for w in np.linspace(0, 1, 21)
    ]
    assert at[0] == pytest.approx(10.0)
    assert at[-1] == pytest.approx(10.4)
    assert (np.diff(at) > 0).all()


def test_an_echo_has_the_label_on_the_beams_axis_else_of_the_brightest():
    rows = [(0, 10.0, 0.2, True), (0, 10.1, 0.5, False), (1, 8.0, 0.1, False), (1, 8.2, 0.6, False)]
    echoes = merge(surfaces(rows), 0.75)
    assert echoes.feature.tolist() == [0, 3]
    assert echoes.true_range.tolist() == [10.0, 8.2]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 4), st.floats(0.5, 30.0), st.floats(0.01, 1.0)), min_size=1, max_size=60
    ),
    st.sampled_from([0.0, 0.6, 3.0]),
)
def test_merging_keeps_power_and_separates_echoes(rows, separation):
    given_rows = surfaces([(p, r, a, False) for p, r, a in sorted(rows, key=lambda row: row[0])])
    echoes = merge(given_rows, separation)
    power = np.bincount(given_rows.pulse, given_rows.apparent / given_rows.range**2)
    kept = np.bincount(echoes.pulse, echoes.apparent / echoes.range**2, minlength=len(power))
    assert kept == pytest.approx(power)
    number, count = number_echoes(echoes)
    same = np.diff(echoes.pulse) == 0
    assert (np.diff(echoes.range)[same] > 0).all() or separation == 0
    assert (number <= count).all()
    assert number.max() == count.max()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 4), st.floats(0.5, 30.0), st.floats(0.01, 1.0), st.booleans()),
        min_size=1,
        max_size=60,
    ),
    st.sampled_from([0.0, 0.6, 3.0]),
)
def test_pulses_with_new_echoes_are_merged_and_others_stay_as_they_are(rows, separation):
    echoes = surfaces([(p, r, a, False) for p, r, a, _ in rows])
    is_new = np.array([new for *_, new in rows], bool)
    found = mix(echoes, is_new, pulses=6, separation=separation)
    assert np.all(np.diff(found.pulse) >= 0)
    for p in range(5):
        own, of = found.where(found.pulse == p), echoes.where(echoes.pulse == p)
        if is_new[echoes.pulse == p].any():
            of = merge(of.take(np.argsort(of.range, kind="stable")), separation)
        for name, column in of.columns().items():
            np.testing.assert_array_equal(own.columns()[name], column, err_msg=name)


def test_return_modes_select_the_echoes_that_they_name():
    echoes = surfaces(
        [(0, 5, 0.1, True), (0, 10, 0.9, False), (0, 20, 0.2, False), (3, 7, 0.5, True), (3, 9, 0.5, False)]
    )
    power = np.array([0.1, 0.9, 0.2, 0.5, 0.5])

    def chosen(mode, **options):
        return select_reported(echoes, power, mode=mode, most=options.pop("most", 5), **options).tolist()

    assert chosen("strongest") == [1, 3]  # of equal echoes the nearer one
    assert chosen("first") == [0, 3]
    assert chosen("last") == [2, 4]
    assert chosen("dual") == [1, 2, 3, 4]
    assert chosen("all") == [0, 1, 2, 3, 4]
    assert chosen("all", most=2) == [0, 1, 3, 4]


def test_dual_mode_with_one_echo_that_is_strongest_and_last():
    echoes = surfaces([(0, 5, 0.1, True), (0, 10, 0.9, False)])
    power = np.array([0.1, 0.9])
    assert select_reported(echoes, power, mode="dual", most=2).tolist() == [1]
    assert select_reported(echoes, power, mode="dual", most=2, second=True).tolist() == [0, 1]


def test_empty_echoes_are_accepted():
    empty = surfaces([(0, 1, 1, True)]).take(np.empty(0, np.int64))
    assert len(merge(empty, 1.0)) == 0
    assert len(number_echoes(empty)[0]) == 0
    for mode in ("strongest", "first", "last", "dual", "all"):
        assert len(select_reported(empty, np.empty(0), mode=mode, most=3, second=True)) == 0
    assert len(join(empty, empty)) == 0


def test_random_numbers_depend_on_their_key_alone():
    a = generator(1, "lidar_top", 5, "noise").random(4)
    assert np.array_equal(a, generator(1, "lidar_top", 5, "noise").random(4))
    others = [(2, "lidar_top", 5), (1, "lidar_front", 5), (1, "lidar_top", 6)]
    assert all(not np.array_equal(a, generator(*key, "noise").random(4)) for key in others)


def test_normals_of_numbers_are_normal_and_independent():
    z = normal_of(np.arange(100_000), seed=3)
    assert z.mean() == pytest.approx(0, abs=0.02)
    assert z.std() == pytest.approx(1, abs=0.02)
    assert np.corrcoef(z[1:], z[:-1])[0, 1] == pytest.approx(0, abs=0.02)
    assert np.array_equal(normal_of(np.array([7, -1], np.int32), 3)[:1], z[7:8])
    assert not np.array_equal(normal_of(np.arange(10), 4), z[:10])


def test_levels_and_settings():
    assert settings_of("standard")[0] == PLAIN == ScannerSettings()
    assert settings_of("survey")[0] == LEVELS["survey"]
    chosen = settings_of("survey", [("rays", "7"), ("mirrors", "off"), ("spread", "0.1")])[0]
    assert (chosen.rays, chosen.mirrors, chosen.spread, chosen.bias) == (7, False, 0.1, True)
    for level, values, word in [
        ("best", {}, "known are standard, survey"),
        ("standard", {"ray": "7"}, "rays"),
        ("standard", {"rays": "1000"}, "1 to 999"),
        ("standard", {"rays": "x"}, "whole number"),
        ("standard", {"bias": "maybe"}, "on or off"),
        ("standard", {"spread": "-1"}, "at least 0"),
        ("standard", {"law": "cosine"}, "lambert"),
    ]:
        with pytest.raises(InputError, match=word):
            settings_of(level, values.items())
