"""Drives have bounded speed, acceleration, jerk and curvature, from rest to rest."""

import subprocess
import sys

import numpy as np
import pytest
from helpers.roadgrids import grid, road_graph
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.geometry.frames import Frame
from lidar.errors import InputError
from lidar.geometry.attitude import body_rates, euler_from_quat, matrix_from_quat
from lidar.motion.motion import drive_path, motion_along, speed_limits
from lidar.motion.path import plan_path
from lidar.motion.route import RouteOptions, free_route, lane_route, plan_route
from lidar.motion.vehicle import ROADS, load_vehicle, vehicle_on

FRAME = Frame.at(-76.3, 36.88)
CAR = load_vehicle("car")


def straight(length, limit=13.9, grade=0.0):
    return free_route([[0.0, 0, 0], [length, 0, grade * length]], limit=limit)


def assert_gentle(trajectory, vehicle, *, rests=True):
    """Bounds on what a passenger and a bystander measure, from positions and attitudes alone."""
    t = trajectory.time_ns * 1e-9
    dt = np.diff(t)
    velocity = trajectory.velocity
    moved = np.diff(trajectory.position, axis=0) / dt[:, None]
    k = trajectory.scale[:-1, None]
    true = moved / np.column_stack([k, k, np.ones_like(k)])
    np.testing.assert_allclose(true, 0.5 * (velocity[1:] + velocity[:-1]), atol=0.03)
    speed = np.linalg.norm(velocity, axis=1)
    if rests:
        assert speed[0] == 0.0
        assert speed[-1] == 0.0
    R = matrix_from_quat(trajectory.quat_xyzw)
    level = np.column_stack([R[:, 0, 0], R[:, 1, 0]])
    forward = (velocity[:, :2] * level).sum(axis=1) / np.linalg.norm(level, axis=1)
    sideways = (velocity[:, 1] * level[:, 0] - velocity[:, 0] * level[:, 1]) / np.linalg.norm(level, axis=1)
    assert np.abs(sideways).max() < 1e-6  # no side slip at the rear axle
    along = np.where(forward < 0, -1.0, 1.0) * speed
    rate = np.diff(np.abs(along)) / dt
    assert rate.max() <= vehicle.acceleration * 1.001
    assert rate.min() >= -vehicle.deceleration * 1.001
    assert np.abs(np.diff(rate) / dt[1:]).max() <= vehicle.jerk * 1.01
    yaw = np.unwrap(euler_from_quat(trajectory.quat_xyzw)[:, 2])
    yaw_rate = np.diff(yaw) / dt
    middle = 0.5 * (speed[1:] + speed[:-1])
    assert np.abs(yaw_rate * middle).max() <= vehicle.lateral_acceleration * 1.02
    moving = middle > 0.2
    assert np.abs(yaw_rate[moving] / middle[moving]).max() <= 1.02 / vehicle.turning_radius
    np.testing.assert_allclose(np.linalg.norm(trajectory.quat_xyzw, axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("road", ["wet", "snow", "ice"])
def test_drives_on_slippery_roads_keep_to_the_limits_that_the_grip_leaves(road):
    car = vehicle_on(CAR, ROADS[road])
    graph = grid(4, 4, 90.0, speed=13.9)
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=2, duration=60))
    trajectory = drive_path(plan_path(route, car, frame=FRAME), car)
    assert_gentle(trajectory, car)
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    assert speed.max() <= 13.9 * ROADS[road].pace * 1.001


@pytest.mark.full
@given(st.integers(0, 2**32 - 1), st.sampled_from(["car", "van", "robot"]), st.sampled_from([None, 60.0]))
@settings(max_examples=12, deadline=None)
def test_a_drive_through_town_is_gentle(seed, name, duration):
    vehicle = load_vehicle(name)
    route = plan_route(grid(4, 4), FRAME, spec="random", options=RouteOptions(seed=seed, length=600.0))
    path = plan_path(route, vehicle, frame=FRAME)
    trajectory = drive_path(path, vehicle, duration=duration)
    assert_gentle(trajectory, vehicle)
    if duration is None:
        np.testing.assert_allclose(trajectory.position[[0, -1]], path.position[[0, -1]], atol=1e-6)
    else:
        assert trajectory.duration_ns == round(duration * 1e9)


@pytest.mark.full
@given(st.integers(0, 2**32 - 1), st.sampled_from(["car", "van", "robot"]), st.floats(0.5, 40.0))
@settings(max_examples=12, deadline=None)
def test_a_drive_that_starts_at_speed_is_gentle_too(seed, name, duration):
    vehicle = load_vehicle(name)
    route = plan_route(grid(4, 4), FRAME, spec="random", options=RouteOptions(seed=seed, length=600.0))
    path = plan_path(route, vehicle, frame=FRAME)
    trajectory = drive_path(path, vehicle, duration=duration, at_speed=True)
    assert_gentle(trajectory, vehicle, rests=False)
    motion = motion_along(path, vehicle, duration=duration, at_speed=True)
    assert (motion.speed <= np.interp(motion.s, path.s, speed_limits(path, vehicle)) + 1e-6).all()
    assert motion.time_ns[-1] == pytest.approx(duration * 1e9, abs=5.1e6)


def test_a_drive_from_speed_to_speed_stays_at_the_speed_limit():
    path = plan_path(straight(1000.0), CAR, frame=FRAME)
    trajectory = drive_path(path, CAR, duration=30.0, at_speed=True)
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    np.testing.assert_allclose(speed, 13.9, rtol=3e-3)
    assert np.ptp(trajectory.position[:, 0]) == pytest.approx(30.0 * 13.9, rel=3e-3)
    whole = drive_path(path, CAR, at_speed=True)  # but where the path ends it stops
    assert whole.velocity[-1] == pytest.approx(0.0)
    assert whole.position[-1, 0] == pytest.approx(1000.0, abs=1e-3)


def test_a_drive_that_starts_at_speed_before_a_bend_is_slow_enough_for_it():
    corner = free_route([[0.0, 0, 0], [12.0, 0, 0], [12.0, 100.0, 0]], limit=13.9)
    trajectory = drive_path(plan_path(corner, CAR, frame=FRAME), CAR, at_speed=True)
    assert 2.0 < np.linalg.norm(trajectory.velocity[0]) < 8.0
    bent = slice(0, len(trajectory.time_ns) // 2)
    yaw = np.unwrap(euler_from_quat(trajectory.quat_xyzw)[:, 2])
    across = np.gradient(yaw, 0.01) * np.linalg.norm(trajectory.velocity, axis=1)
    assert np.abs(across[bent]).max() <= 1.02 * CAR.lateral_acceleration


@pytest.mark.full
@given(
    st.lists(st.tuples(st.floats(0.3, 200.0), st.floats(0.5, 40.0)), min_size=1, max_size=6),
    st.floats(-0.12, 0.12),
)
@settings(max_examples=30, deadline=None)
def test_speed_stays_within_any_limits(stretches, grade):
    ends = np.cumsum([0.0, *(length for length, _ in stretches)])
    line = np.column_stack([ends, np.zeros(len(ends)), grade * ends])
    route = free_route(line)
    limits = np.array([limit for _, limit in stretches])
    route = type(route)(
        **{name: getattr(route, name) for name in ("line", "edge", "free", "turns", "edges", "side")},
        limit=np.append(limits, limits[-1]),
    )
    if ends[-1] < 2.0:
        return
    path = plan_path(route, CAR, frame=FRAME)
    motion = motion_along(path, CAR)
    trajectory = drive_path(path, CAR)
    assert_gentle(trajectory, CAR)
    x = trajectory.position[:, 0]
    posted = limits[np.clip(np.searchsorted(ends, x, side="right") - 1, 0, len(limits) - 1)]
    near = np.abs(x[:, None] - ends[None, 1:-1]).min(axis=1, initial=np.inf) < 0.6  # half a row of the line
    assert (motion.speed[~near] <= posted[~near] + 1e-6).all()


def test_on_an_open_road_the_limit_is_reached_and_held():
    motion = motion_along(plan_path(straight(1000.0), CAR, frame=FRAME), CAR)
    assert motion.speed.max() == pytest.approx(13.9, rel=3e-3)
    held = (motion.speed > 13.85).mean()
    # time at the limit if acceleration and braking were at their bounds throughout: the jerk costs little
    # more
    ideal = 1000.0 / 13.9 + 13.9 / 2 / 2.0 + 13.9 / 2 / 2.5
    assert motion.time_ns[-1] / 1e9 < ideal + 4.0
    assert held > 0.75


def test_the_tightest_bend_is_driven_slowly_and_the_body_leans_outwards():
    corner = free_route([[0.0, 0, 0], [100.0, 0, 0], [100.0, 100.0, 0]], limit=13.9)
    path = plan_path(corner, CAR, frame=FRAME)
    trajectory = drive_path(path, CAR)
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    rates = body_rates(trajectory.time_ns * 1e-9, trajectory.quat_xyzw)
    turn = int(np.argmax(rates[:, 2]))
    assert speed[turn] < 4.0
    roll = euler_from_quat(trajectory.quat_xyzw)[:, 0]
    assert roll[turn] == pytest.approx(CAR.roll_gradient * speed[turn] * rates[turn, 2], rel=0.05)
    assert roll[turn] > 0  # a left turn: the left side rises


def test_braking_dips_the_nose_and_a_hill_lifts_it():
    trajectory = drive_path(plan_path(straight(300.0), CAR, frame=FRAME), CAR)
    pitch = euler_from_quat(trajectory.quat_xyzw)[:, 1]
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    change = np.gradient(speed, 0.01)
    assert pitch[np.argmin(change)] == pytest.approx(CAR.pitch_gradient * 2.45, rel=0.02)
    assert pitch[np.argmax(change)] == pytest.approx(-CAR.pitch_gradient * 1.96, rel=0.02)
    uphill = drive_path(plan_path(straight(300.0, grade=0.1), CAR, frame=FRAME), CAR)
    steady = np.abs(np.gradient(np.linalg.norm(uphill.velocity, axis=1))) < 1e-9
    steady &= np.abs(uphill.position[:, 0] - 150.0) < 50.0
    np.testing.assert_allclose(euler_from_quat(uphill.quat_xyzw)[steady, 1], -np.arctan(0.1), atol=1e-4)
    assert steady.sum() > 100


def test_a_turn_at_a_dead_end_has_five_stops_and_one_reverse_leg():
    graph = road_graph([(0, 0), (60, 0)], [(0, 1)])
    path = plan_path(lane_route(graph, [0, 1], ends=(0.0, 60.0)), CAR, frame=FRAME)
    trajectory = drive_path(path, CAR)
    assert_gentle(trajectory, CAR)
    R = matrix_from_quat(trajectory.quat_xyzw)
    forward = (trajectory.velocity * R[:, :, 0]).sum(axis=1)
    assert forward.min() < -0.5
    standing = np.abs(forward) < 1e-12
    stops = np.flatnonzero(np.diff(standing.astype(int)) == 1)
    assert len(stops) == 5


def test_a_drive_of_given_duration_ends_at_rest_and_slows_only_to_stop():
    path = plan_path(straight(2000.0), CAR, frame=FRAME)
    trajectory = drive_path(path, CAR, duration=30.0)
    assert trajectory.duration_ns == 30_000_000_000
    whole = drive_path(path, CAR)
    at_speed = np.interp(30e9, whole.time_ns, whole.position[:, 0])
    assert at_speed - 60.0 < trajectory.position[-1, 0] < at_speed
    assert drive_path(path, CAR, duration=1e4).duration_ns == whole.duration_ns


def test_true_speed_is_kept_where_the_projection_stretches():
    frame = Frame.at(-78.467838, -0.180653, crs="EPSG:32717")  # scale 1.00058 at Quito
    path = plan_path(straight(1000.0), CAR, frame=frame)
    trajectory = drive_path(path, CAR)
    assert trajectory.scale[0] == pytest.approx(1.000584, abs=1e-5)
    held = np.linalg.norm(trajectory.velocity, axis=1) > 13.899
    moved = np.diff(trajectory.position[held][:, 0]) / 0.01
    np.testing.assert_allclose(moved[5:-5], 13.9 * 1.000584, rtol=1e-4)


def test_bad_options_are_refused():
    path = plan_path(straight(50.0), CAR, frame=FRAME)
    with pytest.raises(InputError, match="must be positive"):
        drive_path(path, CAR, duration=-1.0)


def test_over_a_crest_the_wheels_stay_on_the_ground():
    x = np.arange(0.0, 401.0, 4.0)
    hill = free_route(
        np.column_stack([x, np.zeros(len(x)), 20.0 * np.exp(-(((x - 200.0) / 25.0) ** 2))]), limit=25.0
    )
    trajectory = drive_path(plan_path(hill, CAR, frame=FRAME), CAR)
    lift = np.gradient(trajectory.velocity[:, 2], 0.01)
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    at_top = np.argmin(np.abs(trajectory.position[:, 0] - 200.0))
    assert speed[at_top] == pytest.approx(np.sqrt(0.98 * 2.5 / (2 * 20.0 / 25.0**2)), rel=0.1)
    assert np.abs(lift).max() < 1.1 * CAR.lateral_acceleration


def test_planning_a_drive_loads_no_splines_and_no_spatial_searches():
    """These modules take a second to import, longer than planning takes."""
    code = "import sys, lidar.motion.motion, lidar.motion.replay, lidar.simulation.drive; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not {"scipy.interpolate", "scipy.spatial", "scipy.optimize"} & set(loaded.split())
