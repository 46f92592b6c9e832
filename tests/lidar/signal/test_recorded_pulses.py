"""Pulses of recorded clouds, with returns and without."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.sensor_worlds import box, driven, world

from lidar.geometry.attitude import Mount
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.scanner import firings, load_sensor
from lidar.signal.recorded import complete, recorded_pulses

ROAD = box((-60, -60, -1), (60, 60, 0))
WALLS = [box((20, -60, 0), (22, 60, 30)), box((-60, 12, 0), (20, 14, 5))]
PLACE = world(ROAD, *WALLS)
RINGS = ("vlp16", "hdl32e", "hdl64e_s3", "pandar64", "os1_128")
OTHERS = ("avia", "mid360", "lms111", "flash", "fmcw", "hap", "vux1uav")


def recorded(sensor, frame=3):
    mount = Mount((0.0, 0.0, 1.8))
    return scan(sensor, mount, trajectory=driven(), world=PLACE, frame=frame)


def thinned(cloud, share, seed=1):
    return cloud.where(np.random.default_rng(seed).random(len(cloud)) < share)


def spacing(pulses, row):
    """Azimuths between neighbouring pulses of each ring, one of them without a return."""
    azimuth = np.arctan2(pulses.direction[:, 1], pulses.direction[:, 0])
    order = np.lexsort((azimuth, pulses.ring))
    ring = pulses.ring[order]
    added = ~np.isin(order, row)
    return np.diff(azimuth[order])[(ring[1:] == ring[:-1]) & (added[1:] | added[:-1])]


@pytest.mark.parametrize(
    ("name", "share"), [*((name, 0.4) for name in (*RINGS, *OTHERS)), ("vlp16", 1.0), ("avia", 0.0)]
)
def test_the_pulses_of_a_frame_are_those_fired_each_once(name, share):
    sensor = load_sensor(name, start_ns=7_000_123)
    cloud, sent = thinned(recorded(sensor), share), firings(sensor, 3)
    pulses, row = recorded_pulses(cloud, sensor, sent=sent)
    for column in ("time_ns", "ring", "column", "channel"):
        assert np.array_equal(getattr(pulses, column), getattr(sent, column)), column
    np.testing.assert_allclose(pulses.origin, sent.origin, rtol=0, atol=1e-9)
    along = np.einsum("ij,ij->i", pulses.direction, sent.direction)
    np.testing.assert_allclose(along, 1, rtol=0, atol=1e-6)
    assert np.array_equal(pulses.ring[row], cloud.ring)
    assert (np.diff(row) > 0).all()


def test_two_returns_of_a_pulse_stay_one_pulse():
    sensor = load_sensor("vlp16", return_mode="dual")
    cloud, sent = recorded(sensor), firings(sensor, 3)
    twice = replace(cloud, echoes=np.full(len(cloud), 2, np.uint8)).take(np.repeat(np.arange(len(cloud)), 2))
    pulses, row = recorded_pulses(twice, sensor, sent=sent)
    assert len(pulses) == len(sent)
    assert np.array_equal(row[::2], row[1::2])


def test_returns_of_pulses_that_were_not_fired_keep_pulses_of_their_own():
    sensor = load_sensor("vlp16")
    cloud, sent = recorded(sensor), firings(sensor, 3)
    column = cloud.column.copy()
    column[[5, 500]] = 9999
    pulses, row = recorded_pulses(replace(cloud, column=column), sensor, sent=sent)
    assert len(pulses) == len(sent) + 2
    assert (np.diff(row) > 0).all()


@pytest.mark.parametrize("name", RINGS)
@pytest.mark.parametrize("columns", [("x", "y", "z", "intensity"), ("x", "y", "z", "intensity", "ring")])
@pytest.mark.parametrize("share", [pytest.param(1.0, marks=pytest.mark.full), 0.7, 0.1])
def test_gaps_of_azimuth_are_filled_in_steps_of_the_scanner(name, columns, share):
    sensor = load_sensor(name)
    real = thinned(recorded(sensor), share)
    cloud = complete(real, sensor, columns=columns)
    pulses, row = recorded_pulses(cloud, sensor, sent=None)
    assert np.array_equal(np.sort(row), row)
    assert len(np.unique(row)) == len(cloud)
    assert len(pulses) == pytest.approx(len(firings(sensor, 3)), rel=0.01)
    step = 2 * np.pi / np.bincount(firings(sensor, 0).ring)[0]
    if share < 1:
        assert spacing(pulses, row).max() < 1.5 * step
        assert spacing(pulses, row).min() > 0.7 * step
    np.testing.assert_allclose(np.linalg.norm(pulses.direction, axis=1), 1)
    again, _ = recorded_pulses(cloud, sensor, sent=None)
    assert np.array_equal(again.direction, pulses.direction)


def test_added_pulses_lie_among_their_neighbours_in_the_file():
    """Whether files go from ring to ring or from column to column."""
    sensor = load_sensor("vlp16")
    cloud = thinned(recorded(sensor), 0.7)
    by_ring = cloud.take(np.lexsort((cloud.column, cloud.ring)))
    for order in (cloud, by_ring):
        found = complete(order, sensor, columns=("x", "y", "z", "intensity", "ring"))
        pulses, row = recorded_pulses(found, sensor, sent=None)
        added = np.ones(len(pulses), bool)
        added[row] = False
        key = pulses.column.astype(int)
        if order is by_ring:
            key = key + 2000 * pulses.ring.astype(int)
        assert np.mean(np.abs(np.diff(key)) <= 2) > 0.99
        assert added.sum() > 1000


def test_only_spinning_scanners_have_pulses_without_returns_where_directions_are_derived():
    sensor = load_sensor("lms111")
    cloud = thinned(recorded(sensor), 0.5)
    pulses, row = recorded_pulses(complete(cloud, sensor, columns=()), sensor, sent=None)
    assert len(pulses) == len(cloud)
    assert np.array_equal(row, np.arange(len(cloud)))
