"""Speed profiles under a maximum distance at each time: smooth, and never ahead of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.errors import InputError
from lidar.motion.motion import motion_along, poses_along, speed_limits
from lidar.motion.path import plan_path
from lidar.motion.route import Route
from lidar.motion.speed_profile import motion_within
from lidar.motion.vehicle import load_vehicle

CAR = load_vehicle("car")


class Plane:
    """A frame in which a metre is a metre."""

    def scale_at(self, x, y):
        return np.ones(np.broadcast_shapes(np.shape(x), np.shape(y)))


def bent(length=300.0, speed=13.9):
    """A street that bends by 60 degrees halfway."""
    half, turn = length / 2, np.radians(60.0)
    line = np.array([[0, 0, 0], [half, 0, 0], [half * (1 + np.cos(turn)), half * np.sin(turn), 0]], float)
    route = Route(
        line,
        np.full(3, -1, np.int32),
        np.full(3, speed),
        np.zeros(3, bool),
        np.empty(0, np.int64),
        np.empty(0, np.int32),
    )
    return plan_path(route, CAR, frame=Plane())


PATH = bent()


def jerks(motion):
    return np.diff(motion.speed, 2) * 1e4


@pytest.mark.full
@settings(max_examples=6, deadline=None)
@given(stops=st.lists(st.tuples(st.floats(5.0, 280.0), st.floats(3.0, 90.0)), max_size=4))
def test_any_held_up_drive_is_gentle_and_stays_behind_its_bound(stops):
    """Each stop is a position that must not be passed before a time."""
    time_s = np.arange(0.0, 150.0, 0.1)
    free = motion_along(PATH, CAR)
    reach = np.interp(time_s, free.time_ns * 1e-9, free.s)
    for place, until in stops:
        reach = np.minimum(reach, np.where(time_s < until, place, np.inf))
    reach = np.maximum.accumulate(np.minimum(reach, PATH.length))
    motion = motion_within(PATH, CAR, time_s=time_s, max_distance=reach)
    at = motion.time_ns * 1e-9
    assert (motion.s <= np.interp(at, time_s, reach) + 1e-6).all()
    assert (np.diff(motion.s) >= -1e-9).all()
    assert (motion.speed >= 0.0).all()
    assert motion.speed[[0, -1]] == pytest.approx([0.0, 0.0], abs=2e-3)
    change = np.diff(motion.speed) * 100.0
    assert change.max() <= CAR.acceleration + 1e-6
    assert change.min() >= -CAR.deceleration - 1e-6
    assert np.abs(jerks(motion)).max() <= CAR.jerk + 1e-6
    limit = np.interp(motion.s, PATH.s, speed_limits(PATH, CAR))
    assert (motion.speed <= 1.01 * limit + 0.02).all()
    assert motion.s[-1] == pytest.approx(PATH.length, abs=0.1)


def test_without_hold_ups_the_drive_is_about_as_fast_as_on_an_empty_road():
    free = motion_along(PATH, CAR)
    time_s = np.arange(0.0, 120.0, 0.1)
    motion = motion_within(PATH, CAR, time_s=time_s, max_distance=np.where(time_s > 0, PATH.length, 0.0))
    assert motion.time_ns[-1] < 1.05 * free.time_ns[-1]


@pytest.mark.full
def test_a_long_drive_through_many_bends_is_about_as_fast_as_on_an_empty_road():
    turns = np.cumsum(np.tile([70.0, -70.0, -50.0, 50.0], 6))
    steps = np.column_stack([np.cos(np.radians(turns)), np.sin(np.radians(turns)), np.zeros(len(turns))])
    line = np.concatenate([np.zeros((1, 3)), np.cumsum(60.0 * steps, axis=0)])
    n = len(line)
    route = Route(
        line,
        np.full(n, -1, np.int32),
        np.full(n, 13.9),
        np.zeros(n, bool),
        np.empty(0, np.int64),
        np.empty(0, np.int32),
    )
    path = plan_path(route, CAR, frame=Plane())
    free = motion_along(path, CAR)
    time_s = np.arange(0.0, 2.0 * free.time_ns[-1] * 1e-9, 0.1)
    reach = np.interp(time_s, free.time_ns * 1e-9, free.s)
    motion = motion_within(path, CAR, time_s=time_s, max_distance=reach)
    assert motion.time_ns[-1] < 1.1 * free.time_ns[-1]
    assert motion.s[-1] == pytest.approx(path.length, abs=0.1)


def test_speed_and_velocity_are_the_derivatives_of_distance_and_position():
    time_s = np.arange(0.0, 60.0, 0.1)
    motion = motion_within(PATH, CAR, time_s=time_s, max_distance=np.clip(6.0 * (time_s - 2.0), 0.0, 120.0))
    np.testing.assert_allclose(np.gradient(motion.s, 0.01)[2:-2], motion.speed[2:-2], atol=2e-3)
    there = poses_along(PATH, CAR, motion=motion)
    np.testing.assert_allclose(
        np.gradient(there.position, 0.01, axis=0)[2:-2], there.velocity[2:-2], atol=2e-2
    )


def test_decreasing_distances_are_refused():
    with pytest.raises(InputError, match="must not decrease"):
        motion_within(PATH, CAR, time_s=np.array([0.0, 1.0, 2.0]), max_distance=np.array([0.0, 5.0, 4.0]))


@settings(max_examples=10, deadline=None)
@given(stops=st.lists(st.tuples(st.floats(30.0, 280.0), st.floats(3.0, 30.0)), max_size=3))
def test_a_drive_that_starts_at_speed_ends_at_speed_behind_its_bound(stops):
    time_s = np.arange(0.0, 18.0, 0.1)
    free = motion_along(PATH, CAR, at_speed=True)
    reach = np.interp(time_s, free.time_ns * 1e-9, free.s - free.s[0])
    for place, until in stops:
        reach = np.minimum(reach, np.where(time_s < until, place, np.inf))
    reach = np.maximum.accumulate(reach)
    motion = motion_within(PATH, CAR, time_s=time_s, max_distance=reach, at_speed=True)
    at = motion.time_ns * 1e-9
    assert (motion.s <= np.interp(at, time_s, reach) + 0.1).all()
    assert (np.diff(motion.s) >= -1e-9).all()
    change = np.diff(motion.speed) * 100.0
    assert change.max() <= CAR.acceleration + 1e-6
    assert change.min() >= -CAR.deceleration - 1e-6
    assert np.abs(jerks(motion)).max() <= CAR.jerk + 1e-6
    limit = np.interp(motion.s, PATH.s, speed_limits(PATH, CAR))
    assert (motion.speed <= 1.01 * limit + 0.02).all()
    if not stops:
        assert motion.speed[0] > 0.9 * 13.9
        assert motion.speed[-1] > 0.8 * np.interp(at[-1], free.time_ns * 1e-9, free.speed)
        assert motion.s[-1] > 0.93 * reach[-1]
