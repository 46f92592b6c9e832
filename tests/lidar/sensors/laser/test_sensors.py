"""Firing times and directions of scanners."""

import math
import tomllib
from fractions import Fraction
from importlib import resources

import numpy as np
import pytest
from helpers.sensor_worlds import driven, plate, world

from lidar.geometry.attitude import Mount
from lidar.sensors.laser.doppler import radial_velocity
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.patterns.beams import blocks, frame_window_ns
from lidar.sensors.rig.patterns.repeating import Scan2d
from lidar.sensors.rig.scanner import firings, load_sensor, sensor_names


def azimuth_deg(direction):
    """Azimuth clockwise from forward, as in Velodyne's data."""
    return np.degrees(np.arctan2(-direction[:, 1], direction[:, 0])) % 360


@pytest.mark.parametrize("first", [0, 10**6, 10**9])
@pytest.mark.parametrize(
    "period_ns", ["55296", "20000/11", "10000000000000000000/5500000000307839", "333333333333/123456789"]
)
def test_clocks_of_any_period_are_exact_at_any_time(period_ns, first):
    period = Fraction(period_ns)
    frame = math.ceil(first * period / 10**9)
    block = blocks(frame, 1.0, block_ns=period, start_ns=5)
    number = block.first + np.array([0, 1, 7, len(block) - 1])
    exact = [5 + math.floor(int(k) * period + Fraction(1, 2)) for k in number]
    assert block.time_ns[number - block.first].tolist() == exact


def test_vlp16_turns_by_the_published_step():
    """Anchor: 0.199066 degrees a block at 10 Hz."""
    f = firings(load_sensor("vlp16"), 0)
    of_one_laser = azimuth_deg(f.direction[f.channel == 3])[:1000]
    assert np.diff(of_one_laser) == pytest.approx(0.199066, abs=1e-5)


@pytest.mark.parametrize(
    ("elevation", "azimuth", "reach", "point"),
    [(-15, 0, 10, (9.65926, 0, -2.58819)), (15, 90, 20, (0, -19.31852, 5.17638))],
)
def test_vlp16_points_agree_with_the_manual(elevation, azimuth, reach, point):
    f = firings(load_sensor("vlp16"), 0)
    step = np.radians(0.199066)
    of_it = f.channel == {-15: 0, 15: 15}[elevation]
    near = np.argmin(np.abs(azimuth_deg(f.direction[of_it]) - azimuth))
    found = reach * f.direction[of_it][near]
    # Azimuths start anywhere, so the nearest firing is within half a step.
    assert np.abs(found - point).max() < reach * step / 2 + 1e-5
    assert found[2] == pytest.approx(point[2], abs=1e-5)
    assert np.hypot(*found[:2]) == pytest.approx(np.hypot(*point[:2]), abs=1e-5)


def test_vlp16_beams_cross_the_axis_at_the_manuals_heights():
    f = firings(load_sensor("vlp16"), 0)
    height = {int(c): z for c, z in zip(f.channel[:16], f.origin[:16, 2] * 1000, strict=True)}
    assert height[15] == pytest.approx(-11.2, abs=0.05)
    assert height[7] == pytest.approx(-5.1, abs=0.06)
    assert not f.origin[:, :2].any()


def test_vlp16_fires_its_lasers_one_after_another():
    f = firings(load_sensor("vlp16"), 0)
    assert (np.diff(f.time_ns[:16]) == 2304).all()
    assert f.time_ns[16] - f.time_ns[0] == 55296
    assert 28928 <= len(f) <= 28944


def test_revolutions_follow_each_other_without_gap_and_do_not_repeat():
    sensor = load_sensor("vlp16", start_ns=12345)
    frames = [firings(sensor, k) for k in range(5)]
    first = np.concatenate([f.time_ns[f.channel == 0] for f in frames])
    assert first[0] == 12345
    assert (np.diff(first) == 55296).all()
    starts = [azimuth_deg(f.direction[:1])[0] for f in frames]
    assert len(set(np.round(starts, 4))) == 5
    for k, f in enumerate(frames):
        assert 0 <= f.time_ns[0] - sensor.frame_start_ns(k) < 55296


def test_rings_rank_elevations():
    f = firings(load_sensor("vlp16"), 3)
    elevation = np.arcsin(f.direction[:, 2])
    for ring in range(15):
        assert elevation[f.ring == ring].max() < elevation[f.ring == ring + 1].min()


def test_order_sorts_firings_by_direction():
    f = firings(load_sensor("vlp16"), 0)
    assert sorted(f.order) == list(range(len(f)))
    d = f.direction[f.order]
    turn = np.arccos(np.clip(np.einsum("ij,ij->i", d[1:], d[:-1]), -1, 1))
    assert np.count_nonzero(turn > np.radians(0.21)) <= 15


@pytest.mark.parametrize(
    ("name", "beams", "step_deg", "period_ns"),
    [("utm30lx", 1081, 0.25, 25_000_000), ("lms111", 541, 0.5, 20_000_000)],
)
def test_2d_scanners_sweep_their_sector_counter_clockwise(name, beams, step_deg, period_ns):
    f = firings(load_sensor(name), 2)
    angle = np.degrees(np.unwrap(np.arctan2(f.direction[:, 1], f.direction[:, 0])))
    assert len(f) == beams
    assert np.diff(angle) == pytest.approx(step_deg)
    assert angle[0] == pytest.approx(-135)
    assert f.time_ns[0] == 2 * period_ns
    # The blind sector shortens the part of the revolution with returns.
    assert f.time_ns[-1] - f.time_ns[0] == pytest.approx(period_ns * (beams - 1) * step_deg / 360, abs=1)


def test_a_2d_scanner_of_a_full_circle_fires_each_direction_once():
    f = Scan2d(720, -np.pi, np.pi).fire(1, 25.0, start_ns=0)
    assert len(f.time_ns) == len(f.direction) == len(f.column) == 720
    assert 40_000_000 <= f.time_ns.min() <= f.time_ns.max() < 80_000_000
    assert len(np.unique(np.round(f.direction, 9), axis=0)) == 720


def test_the_sick_scanner_halves_its_step_at_half_the_rate():
    assert len(firings(load_sensor("lms111", rate_hz=25), 0)) == 1081


@pytest.mark.full
def test_every_preset_fires_unit_vectors_in_time_order_over_its_frame():
    for name in sensor_names():
        sensor = load_sensor(name)
        frames = [firings(sensor, k) for k in (0, 7)]
        for f in frames:
            np.testing.assert_allclose(np.linalg.norm(f.direction, axis=1), 1.0, atol=1e-12, err_msg=name)
            np.testing.assert_array_equal(np.sort(f.order), np.arange(len(f)), name)
            assert (np.diff(f.column[f.channel == f.channel[0]]) > 0).all(), name


@pytest.mark.full
@pytest.mark.parametrize("name", sensor_names())
def test_pulses_are_fired_within_their_frame_and_none_is_lost_between_frames(name):
    """Blocks are longer than the rest of a frame: their pulses after its end are the next frame's."""
    rates = tomllib.loads((resources.files("lidar.sensors.rig") / "sensors" / f"{name}.toml").read_text())[
        "rates_hz"
    ]
    for rate_hz in rates:
        sensor = load_sensor(name, rate_hz=rate_hz, start_ns=3)
        frames = [firings(sensor, k) for k in range(4)]
        for k, f in enumerate(frames):
            start, stop = sensor.window_ns(k)
            assert start == sensor.frame_start_ns(k)
            assert stop == sensor.frame_start_ns(k + 1)
            assert f.time_ns.min() >= start
            assert f.time_ns.max() < stop
            assert f.column.min() == 0 or sensor.kind == "line"
        if sensor.kind != "spinning":
            continue
        times = np.concatenate([f.time_ns for f in frames])
        channels = np.concatenate([f.channel for f in frames])
        for channel in range(len(sensor.pattern.elevation)):
            assert np.ptp(np.diff(times[channels == channel])) <= 1


def test_pulses_of_frames_that_are_no_whole_nanoseconds_long_are_rounded_into_their_frame():
    """At 15 Hz, frame 1 starts at 66,666,666.7 ns: the pulse at 66,666,666.4 ns is not frame 0's."""
    window = frame_window_ns(1, 15.0, start_ns=0)
    assert window == (66_666_666, 133_333_333)
    period = Fraction(666_666_664, 10)
    before, after = (blocks(k, 15.0, block_ns=period, start_ns=0).time_ns for k in (0, 1))
    assert before.tolist() == [0]
    assert after.tolist() == [66_666_666]


@pytest.mark.parametrize(
    ("name", "points"),
    {
        "vlp16": 28_928,
        "vlp32c": 57_856,
        "hdl32e": 69_440,
        "hdl64e_s3": 111_104,
        "vls128": 240_128,
        "pandar64": 115_200,
        "xt32": 64_000,
        "rs32": 57_632,
        "helios32": 57_568,
        "rs16": 28_816,
        "rs128": 230_400,
        "bpearl": 57_632,
        "ot128": 230_400,
        "hdl64e_s2": 133_312,
        "os1_128": 131_072,
        "mid360": 20_000,
        "hap": 45_200,
        "avia": 24_000,
        "mid40": 10_000,
    }.items(),
)
def test_a_turn_has_the_published_number_of_points(name, points):
    """A revolution is no whole number of blocks, so the azimuths shift and sizes differ by up to a block."""
    sensor = load_sensor(name)
    sizes = {len(firings(sensor, k)) for k in range(6)}
    lasers = int(firings(sensor, 0).channel.max()) + 1 if sensor.kind == "spinning" else 0
    assert {abs(size - points) <= lasers for size in sizes} == {True}


@pytest.mark.parametrize(
    ("column", "row", "reach", "point"),
    [(0, 0, 10.0, (-9.31481, 0.68451, 3.60606)), (256, 63, 25.0, (-1.83412, 24.93229, -0.08592))],
)
def test_os1_points_agree_with_the_makers_code(column, row, reach, point):
    sensor = load_sensor("os1_128")
    f = firings(sensor, 4)
    k = np.flatnonzero((f.column == column) & (f.channel == row))[0]
    found = f.origin[k] + (reach - sensor.pattern.range_offset) * f.direction[k]
    assert found == pytest.approx(point, abs=5e-5)


def test_ouster_columns_are_locked_to_the_encoder():
    sensor = load_sensor("os1_128")
    assert np.array_equal(firings(sensor, 0).direction, firings(sensor, 9).direction)
    assert len(np.unique(firings(sensor, 3).column)) == 1024


def test_hdl32e_beams_cross_the_axis_at_the_published_heights():
    f = firings(load_sensor("hdl32e"), 0)
    published = [17.17, 4.76, 16.27, 4.07, 15.4, 3.38, 14.54, 2.7, 13.71, 2.02, 12.89, 1.35, 12.09, 0.67]
    # The published heights come from rounded angles.
    assert f.origin[:14, 2] * 1000 == pytest.approx(published, abs=0.09)


@pytest.mark.full
def test_hdl64e_beams_start_beside_the_axis():
    """Alternately 2.6 cm to the left and to the right of the axis, looking along the beam."""
    f = firings(load_sensor("hdl64e_s3"), 0)
    level = f.direction[:, :2] / np.linalg.norm(f.direction[:, :2], axis=1, keepdims=True)
    left = -level[:, 1] * f.origin[:, 0] + level[:, 0] * f.origin[:, 1]
    assert left == pytest.approx(np.where(f.channel % 2 == 0, 0.026, -0.026), abs=1e-12)
    assert np.einsum("ij,ij->i", level, f.origin[:, :2]) == pytest.approx(0, abs=1e-12)


def test_lasers_of_a_group_fire_together():
    vls = firings(load_sensor("vls128"), 0)
    assert len(np.unique(vls.time_ns[:128])) == 16
    assert vls.time_ns[64] - vls.time_ns[56] == 2 * 2665  # a slot of maintenance after the eighth group
    assert len(np.unique(firings(load_sensor("vlp32c"), 0).time_ns[:32])) == 16


@pytest.mark.parametrize(("name", "degrees"), [("mid40", 19.16), ("mid70", 35.19)])
def test_prisms_deflect_up_to_the_computed_angle(name, degrees):
    sensor = load_sensor(name)
    forward = np.concatenate([firings(sensor, k).direction[:, 0] for k in range(10)])
    assert np.degrees(np.arccos(forward.min())) == pytest.approx(degrees, abs=0.05)


def test_avia_fills_its_field_of_view_upright():
    sensor = load_sensor("avia")
    d = np.concatenate([firings(sensor, k).direction for k in range(20)])
    assert 2 * np.degrees(np.arcsin(d[:, 2]).max()) == pytest.approx(76.95, abs=0.5)
    assert 2 * np.degrees(np.arctan2(d[:, 1], d[:, 0]).max()) == pytest.approx(70.5, abs=0.5)
    assert len(np.unique(firings(sensor, 0).channel)) == 6


def covered(sensor, frames):
    """Share of the field of view's cells of one degree that frames 0 to n hit."""
    d = np.concatenate([firings(sensor, k).direction for k in range(frames)])
    az = np.degrees(np.arctan2(d[:, 1], d[:, 0])).astype(int)
    el = np.floor(np.degrees(np.arcsin(d[:, 2]))).astype(int)
    return len(np.unique(az * 1000 + el))


@pytest.mark.parametrize("name", ["mid360", "hap", "avia", "mid40", "mid70"])
def test_patterns_that_do_not_repeat_cover_more_with_time(name):
    sensor = load_sensor(name)
    once, five, ten = (covered(sensor, n) for n in (1, 5, 10))
    assert once < five <= ten
    assert not np.array_equal(firings(sensor, 0).direction, firings(sensor, 1).direction)


def test_mid360_stays_in_its_field_of_view_and_is_marked_approximate():
    sensor = load_sensor("mid360")
    elevation = np.degrees(np.arcsin(firings(sensor, 0).direction[:, 2]))
    assert elevation.min() == pytest.approx(-7, abs=0.1)
    assert elevation.max() == pytest.approx(52, abs=0.1)
    assert "approximate" in sensor.note


def test_hap_stays_in_its_field_of_view_and_is_marked_approximate():
    sensor = load_sensor("hap")
    x, y, z = firings(sensor, 0).direction.T
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arcsin(z))
    assert [azimuth.min(), azimuth.max()] == pytest.approx([-60, 60], abs=0.1)
    assert [elevation.min(), elevation.max()] == pytest.approx([-12.5, 12.5], abs=0.1)
    assert "approximate" in sensor.note


def test_all_pixels_of_a_flash_fire_at_one_time():
    f = firings(load_sensor("flash"), 3)
    assert np.ptp(f.time_ns) == 0
    assert len(f) == 128 * 32
    assert np.ptp(firings(load_sensor("fmcw"), 3).time_ns) > 0


@pytest.mark.parametrize(("name", "millimetres"), [("lms511", 151), ("lms511_sr", 343)])
def test_the_lms511_footprint_at_30_m_is_the_manuals(name, millimetres):
    sensor = load_sensor(name)
    assert sensor.footprint(30.0)[0] * 1000 == pytest.approx(millimetres, abs=1)


def test_airborne_footprint_and_spacing():
    """500 m and 0.25 mrad: 0.125 m. In-line spacing at nadir h 2 a L / P, swath 2 h tan a."""
    sensor = load_sensor("vq780i")
    assert sensor.footprint(500.0)[0] == pytest.approx(0.125)
    f = firings(sensor, 0)
    left = 500 * f.direction[:, 1] / -f.direction[:, 2]
    assert np.ptp(left) == pytest.approx(2 * 500 * np.tan(np.radians(30)), rel=1e-3)
    nadir = np.argmin(np.abs(left[:4000]))
    step = 500 * 2 * np.radians(30) * 100 / 500_000
    assert left[nadir + 1] - left[nadir] == pytest.approx(step, rel=0.01)


def test_an_oscillating_mirror_scans_both_ways_and_a_polygon_one_way():
    swing = np.arcsin(firings(load_sensor("altm3100"), 0).direction[:, 1])
    assert np.degrees(np.abs(swing).max()) == pytest.approx(25, abs=0.05)
    assert np.mean(np.diff(swing) > 0) == pytest.approx(0.5, abs=0.1)
    d = firings(load_sensor("vux1uav"), 0).direction
    turn = np.degrees(np.arctan2(d[:, 1], -d[:, 2]))
    assert np.abs(turn).max() == pytest.approx(165, abs=0.1)
    assert np.count_nonzero(np.diff(turn) < 0) == 9  # ten lines in a tenth of a second


def test_a_list_of_directions_repeats(tmp_path):
    rows = ["Time/s,Azimuth/deg,Zenith/deg", *(f"{k / 1000},{k * 10},{90 - k}" for k in range(30))]
    (tmp_path / "pattern.csv").write_text("\n".join(rows))
    text = """
        kind = "table"
        maker = "me"
        model = "list"
        wavelength_nm = 905.0
        rates_hz = [50.0]
        min_range = 0.1
        max_range = 50.0
        range_sigma = 0.01
        reference_range = 30.0
        reference_reflectance = 0.1
        divergence_mrad = 1.0
        pulse_ns = 5.0
        [table]
        file = "pattern.csv"
        period_s = 0.03
    """
    (tmp_path / "list.toml").write_text(text)
    sensor = load_sensor(tmp_path / "list.toml")
    time = np.concatenate([firings(sensor, k).time_ns for k in range(6)])
    assert (np.diff(time) == 1_000_000).all()
    assert len(time) == 120
    second = firings(sensor, 1)  # 20 to 40 ms: the last ten rows, then the first ten
    elevation = np.degrees(np.arcsin(second.direction[:, 2]))
    assert elevation == pytest.approx([*range(20, 30), *range(10)])


@pytest.mark.full
def test_radial_velocity_is_negative_on_approach():
    """At 10 m/s towards a wall it is -10 m/s times the cosine of the angle to the direction of travel."""
    sensor, mount, drive = load_sensor("fmcw"), Mount((2.0, 0.0, 0.0)), driven((10.0, 0.0, 0.0))
    cloud = scan(sensor, mount, trajectory=drive, world=world(plate(60.0, feature=5)), frame=0)
    ahead = cloud.xyz[:, 0] / np.linalg.norm(cloud.xyz, axis=1)
    assert radial_velocity(cloud, mount, trajectory=drive) == pytest.approx(-10 * ahead, abs=1e-4)
    fleeing = np.tile([12.0, 0.0, 0.0], (len(cloud), 1))
    assert radial_velocity(cloud, mount, trajectory=drive, moving=fleeing) == pytest.approx(
        2 * ahead, abs=1e-4
    )


def test_radial_velocity_counts_the_lever_arm_of_a_turning_vehicle():
    mount, drive = Mount((0.0, 2.0, 0.0)), driven(yaw_rate=0.5, start=(0, 0, 0))
    cloud = scan(load_sensor("fmcw"), mount, trajectory=drive, world=world(plate(60.0)), frame=0)
    level = cloud.xyz[np.argmin(np.abs(cloud.xyz[:, 1]) + np.abs(cloud.xyz[:, 2]))]
    found = radial_velocity(cloud, mount, trajectory=drive)[np.argmin(np.abs(cloud.xyz - level).sum(axis=1))]
    # 2 m to the left of the axis of a left turn the sensor goes backwards at 1 m/s.
    assert found == pytest.approx(1.0, abs=0.01)
