"""The ego vehicle in traffic: signals, stop signs, gaps and smooth motion."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from helpers.roadgrids import grid, road_graph
from helpers.traffic import CAR, Plane, boxes_at, tracks, with_speed

from lidar.motion.motion import drive_path, poses_along
from lidar.motion.path import plan_path
from lidar.motion.route import RouteOptions, plan_route
from lidar.motion.speed_profile import motion_within
from lidar.traffic.ego import ego_trip
from lidar.traffic.ego_drive import drive_with_signals
from lidar.traffic.junctions import AMBER, is_green, junction_plan, signal_group, zone_at
from lidar.traffic.lanes import STEP, lanes_of
from lidar.traffic.simulation import simulate_ego, simulate_trips
from lidar.traffic.simulation_kernel import STEP_S
from lidar.traffic.surroundings import surroundings_of
from lidar.traffic.sweep import rectangles
from lidar.traffic.trips import vehicle_trips

BOUNDS = (-30.0, -30.0, 300.0, 300.0)


def city(*, signalised, **columns):
    graph = grid(4, 4, 90.0, speed=13.9)
    return replace(graph, signals=np.full(len(graph.node_id), signalised), **columns)


def path_on(graph, seed, seconds):
    return plan_path(
        plan_route(graph, Plane(), spec="random", options=RouteOptions(seed=seed, duration=seconds)),
        CAR,
        frame=Plane(),
    )


def middle_of(ego, times):
    at = ego.at((times * 1e9).astype(np.int64))
    forward = at.rotation[:, :2, 0]
    return at.position[:, :2] + CAR.middle * forward, np.arctan2(forward[:, 1], forward[:, 0])


def speed_of(ego):
    return np.hypot(*ego.velocity[:, :2].T)


def check_gentle(ego):
    speed = speed_of(ego)
    change = np.diff(speed) * 100.0
    assert change.max() <= CAR.acceleration + 1e-3
    assert change.min() >= -CAR.deceleration - 1e-3
    assert np.abs(np.diff(change)).max() * 100.0 <= CAR.jerk + 1e-2


def check_enters_on_green(ego, graph, seed, *, until):
    plan = junction_plan(graph, lanes_of(graph), seed=seed)
    times = np.arange(0.0, until, STEP_S)
    middle, heading = middle_of(ego, times)
    front = middle + CAR.length / 2 * np.column_stack([np.cos(heading), np.sin(heading)])
    zone = zone_at(plan.zones, front)
    entries = np.flatnonzero((np.diff(zone) != 0) & (zone[1:] >= 0)) + 1
    assert len(entries) >= 2
    for k in entries[times[entries] > 5.0]:
        group = signal_group(plan, int(zone[k]), heading=float(heading[k]))
        ago = np.arange(0.0, AMBER, 0.5)  # entered on green, or slightly later (smoothing)
        assert any(is_green(int(zone[k]), group, float(times[k] - a), plan.signals) for a in ago)


@pytest.mark.full
@pytest.mark.parametrize("at_speed", [False, True])
@pytest.mark.parametrize("seed", [1, 3, 4])
def test_the_ego_enters_no_junction_on_red(seed, at_speed):
    graph = city(signalised=True)
    path = path_on(graph, seed, 95.0)
    ego = drive_with_signals(path, CAR, graph=graph, seed=seed, duration=80.0, at_speed=at_speed)
    assert (speed_of(ego)[0] > 1.0) == at_speed
    check_enters_on_green(ego, graph, seed, until=80.0)
    check_gentle(ego)
    assert (speed_of(ego)[500:-500] < 0.05).any()  # it had to wait


@pytest.mark.parametrize("gap", [25.0, pytest.param(26.0, marks=pytest.mark.full)])
def test_the_ego_waits_between_junctions_that_are_close_and_goes_on(gap):
    graph = grid(6, 6, gap, speed=13.9)
    graph = replace(graph, signals=np.full(len(graph.node_id), True))
    path = path_on(graph, 1, 300.0)
    ego = drive_with_signals(path, CAR, graph=graph, seed=1, duration=250.0)
    check_enters_on_green(ego, graph, 1, until=250.0)
    moving = np.flatnonzero(speed_of(ego) > 0.05)
    assert np.diff(moving).max() < 60_00  # a cycle of the signals, at 100 Hz
    assert moving[-1] > 200_00


def test_the_ego_stops_at_stop_signs_and_continues():
    graph = city(signalised=False)
    edges = np.arange(len(graph), dtype=np.int32)
    signs = replace(
        graph,
        control_edge=edges,
        control_offset=graph.length - 6.0,
        control_kind=np.full(len(graph), "stop"),
    )
    path = path_on(graph, 4, 90.0)
    ego = drive_with_signals(path, CAR, graph=signs, seed=1, duration=90.0)
    plan = junction_plan(graph, lanes_of(graph), seed=1)
    times = np.arange(0.0, 90.0, STEP_S)
    middle, _ = middle_of(ego, times)
    zone = zone_at(plan.zones, middle)
    speed = np.interp(times, ego.time_ns * 1e-9, speed_of(ego))
    entries = np.flatnonzero((np.diff(zone) != 0) & (zone[1:] >= 0)) + 1
    assert len(entries) >= 3
    for k in entries[times[entries] > 8.0]:
        assert speed[max(k - 60, 0) : k].min() < 0.15
    check_gentle(ego)
    free = drive_with_signals(path, CAR, graph=graph, seed=1, duration=90.0)
    assert speed_of(free)[300:-500].min() > 1.0  # without signs it does not stop


@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(k, marks=pytest.mark.full) for k in range(3, 9))])
def test_the_ego_keeps_its_distance_from_a_slow_leader(seed):
    graph = road_graph([(0.0, 0.0), (600.0, 0.0)], [(0, 1)], twoway=False, width=4.0)
    lanes = lanes_of(graph, bounds=(-30.0, -30.0, 700.0, 30.0))
    path = path_on(graph, seed, 60.0)
    free = drive_path(path, CAR, duration=60.0)
    trips = vehicle_trips(
        lanes, surroundings_of(lanes, free, radius=400.0, scale=1.0), seed=seed, density=10.0
    )
    leader, *others = [
        with_speed(t, np.minimum(t.course.desired_speed, 4.0)) for t in trips if t.appear_s == 0.0
    ]
    ahead = middle_of(free, np.zeros(1))[0][0, 0] + 60.0
    leader = replace(leader, begin=round((ahead - leader.course.path.xyz[0, 0]) / STEP))
    slow = [leader, *(t for t in others if t.course.path.xyz[0, 0] + t.begin * STEP > ahead + 30.0)]
    plan = junction_plan(graph, lanes, seed=1)
    travelled = simulate_ego(ego_trip(path, CAR), slow, graph=graph, plan=plan, seconds=60.0, radius=600.0)
    motion = motion_within(
        path, CAR, time_s=np.arange(len(travelled)) * STEP_S, max_distance=np.minimum(travelled, path.length)
    )
    ego = poses_along(path, CAR, motion=motion)
    flow = simulate_trips(slow, graph, plan=plan, ego=ego, vehicle=CAR, radius=600.0, obeys_signals=True)
    # Trips without room at the first step never appear; those that do stay to the end of the drive or street.
    for trip in np.unique(flow.trip):
        rows = flow.trip == trip
        start, end = slow[trip].course.path.xyz[[0, -1], 0]
        at_end = start + flow.travelled[rows].max() > end - 5.0
        assert at_end or flow.step[rows].max() == flow.step.max()
    check_gentle(ego)
    rows = flow.trip == 0
    tail = leader.course.path.xyz[0, 0] + flow.travelled[rows] - leader.length / 2
    middle, _ = middle_of(ego, flow.step[rows] * STEP_S)
    gap = tail - middle[:, 0] - CAR.length / 2
    assert gap.min() > 1.5
    assert gap[300:].max() < 25.0  # it has caught up and follows
    assert speed_of(ego)[4000:5000].mean() == pytest.approx(4.0, abs=1.0)


@pytest.mark.parametrize(
    ("seed", "signalised"), [(1, True), (2, False), pytest.param(3, True, marks=pytest.mark.full)]
)
def test_in_traffic_the_ego_touches_no_road_user_and_none_is_removed(seed, signalised):
    graph = city(signalised=signalised)
    lanes = lanes_of(graph, bounds=BOUNDS)
    plan = junction_plan(graph, lanes, seed=seed)
    path = path_on(graph, seed, 40.0)
    alone = drive_path(path, CAR, duration=40.0)
    trips = vehicle_trips(
        lanes, surroundings_of(lanes, alone, radius=300.0, scale=1.0), seed=seed, density=20.0
    )
    travelled = simulate_ego(ego_trip(path, CAR), trips, graph=graph, plan=plan, seconds=40.0, radius=300.0)
    motion = motion_within(
        path, CAR, time_s=np.arange(len(travelled)) * STEP_S, max_distance=np.minimum(travelled, path.length)
    )
    ego = poses_along(path, CAR, motion=motion)
    check_gentle(ego)
    flow = simulate_trips(trips, graph, plan=plan, ego=ego, vehicle=CAR, radius=300.0, obeys_signals=True)
    poses = tracks(trips, flow)
    times = np.arange(len(poses)) * STEP_S
    own = rectangles(*middle_of(ego, times), length=CAR.length, width=CAR.width)
    for mine, moment in zip(own[::2], poses[::2], strict=True):
        if np.isfinite(moment).any():
            assert not shapely.intersects(mine, boxes_at(trips, moment)).any()
    assert travelled[-1] > 50.0  # it makes progress
    assert STEP < travelled[-1] <= path.length + STEP


@pytest.mark.parametrize("signalised", [False, True])
def test_a_drive_without_a_duration_ends_a_second_after_its_arrival(signalised):
    graph = city(signalised=signalised)
    for seed in (1, 2):
        path = path_on(graph, seed, 30.0)
        ego = drive_with_signals(path, CAR, graph=graph, seed=seed)
        standing = np.flatnonzero(speed_of(ego) > 0.01)[-1]
        assert (ego.duration_ns - ego.time_ns[standing]) * 1e-9 == pytest.approx(1.0, abs=0.02)
        assert np.hypot(*(ego.position[-1] - path.position[-1])[:2]) < 0.2
        check_gentle(ego)
