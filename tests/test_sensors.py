"""Scanners: when and where they fire."""

import numpy as np
import pytest

from lidar.sensors.preset import firings, load_sensor


def azimuth_deg(direction):
    """Clockwise from forward, as Velodyne counts."""
    return np.degrees(np.arctan2(-direction[:, 1], direction[:, 0])) % 360


def test_vlp16_turns_by_the_published_step():
    """Anchor: 0.199066 degrees a block at 10 Hz."""
    f = firings(load_sensor("vlp16"), 0)
    of_one_laser = azimuth_deg(f.direction[f.channel == 3])[:1000]
    assert np.diff(of_one_laser) == pytest.approx(0.199066, abs=1e-5)


@pytest.mark.parametrize(
    ("elevation", "azimuth", "reach", "point"),
    [(-15, 0, 10, (9.65926, 0, -2.58819)), (15, 90, 20, (0, -19.31852, 5.17638))],
)
def test_vlp16_points_lie_where_the_manual_says(elevation, azimuth, reach, point):
    f = firings(load_sensor("vlp16"), 0)
    step = np.radians(0.199066)
    of_it = f.channel == {-15: 0, 15: 15}[elevation]
    near = np.argmin(np.abs(azimuth_deg(f.direction[of_it]) - azimuth))
    found = reach * f.direction[of_it][near]
    # The grid of azimuths is free, so the nearest firing is within half a step.
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
    assert len(f) in (28928, 28944)


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


def test_order_puts_neighbours_together():
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
    # The blind sector takes its share of the turn.
    assert f.time_ns[-1] - f.time_ns[0] == pytest.approx(period_ns * (beams - 1) * step_deg / 360, abs=1)


def test_the_sick_scanner_halves_its_step_at_half_the_rate():
    assert len(firings(load_sensor("lms111", rate_hz=25), 0)) == 1081
