"""Built-in simulation: gaps, lanes, signals and the ego vehicle."""

import itertools
from dataclasses import fields, replace
from unittest.mock import Mock

import numpy as np
import pytest
import shapely
from helpers.roadgrids import grid, road_graph
from helpers.traffic import CAR, Plane, boxes_at, tracks, with_speed
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.geometry.polylines import curvatures
from lidar.geometry.poses import Trajectory
from lidar.motion.motion import drive_path
from lidar.motion.path import plan_path
from lidar.motion.route import RouteOptions, plan_route
from lidar.motion.vehicle import DRY, ROADS
from lidar.traffic import lanes as traffic_lanes
from lidar.traffic import simulation
from lidar.traffic.ego import ego_motion, ego_trip, green_windows
from lidar.traffic.junctions import AMBER, is_green, junction_plan, signal_group, zone_at
from lidar.traffic.lanes import STEP, lane_shift, lanes_of, random_lanes
from lidar.traffic.simulation import simulate_ego, simulate_trips
from lidar.traffic.simulation_kernel import STEP_S
from lidar.traffic.surroundings import surroundings_of
from lidar.traffic.sweep import rectangles
from lidar.traffic.trips import vehicle_trips


def standing(xy, seconds):
    """An ego that stands at a place."""
    time = np.array([0, int(seconds * 1e9)])
    position = np.array([[*xy, 0.0]] * 2)
    quat = np.array([[0.0, 0.0, 0.0, 1.0]] * 2)
    return Trajectory(time, position, quat, np.zeros((2, 3)), np.ones(2))


def driving(graph, seed, seconds):
    route = plan_route(graph, Plane(), spec="random", options=RouteOptions(seed=seed, duration=seconds))
    return drive_path(plan_path(route, CAR, frame=Plane()), CAR).until(int(seconds * 1e9))


def city(*, signalised, lanes=1.0, width=7.0, streets=4):
    graph = grid(streets, streets, 90.0, lanes=lanes, width=width, speed=13.9)
    return replace(graph, signals=np.full(len(graph.node_id), signalised))


def flow_on(graph, ego, *, seed, density=25.0, radius=400.0, shares=None, road=DRY):
    lanes = lanes_of(graph, bounds=(-30.0, -30.0, 300.0, 300.0))
    plan = junction_plan(graph, lanes, seed=seed)
    area = surroundings_of(lanes, ego, radius=radius, scale=1.0)
    trips = vehicle_trips(lanes, area, seed=seed, density=density, shares=shares, road=road)
    return trips, simulate_trips(trips, graph, plan=plan, ego=ego, vehicle=CAR, radius=radius), plan


def test_traffic_takes_no_turn_that_is_forbidden_via_a_way():
    graph = grid(3, 3)
    everywhere = np.ones(len(graph), bool)

    def drive(lanes, seed):
        rng = np.random.default_rng(seed)
        return random_lanes(
            lanes, rng, edge=seed % len(graph), lane=0, metres=2000.0, inside=everywhere, width=1.8
        )[0]

    chains = {tuple(drive(lanes_of(graph), seed)[k : k + 3]) for seed in range(4) for k in (1, 6)}
    edges = np.fromiter((np.array(chain, np.int32) for chain in chains), object)
    bound = lanes_of(replace(graph, chain_edges=edges, chain_kind=np.full(len(chains), "no_u_turn")))
    drives = [drive(bound, seed) for seed in range(20)]
    for driven in drives:
        assert chains.isdisjoint(zip(driven, driven[1:], driven[2:], strict=False))
    # Two restrictions make a corner a dead end, where paths end; the others continue.
    assert np.mean([len(driven) > 15 for driven in drives]) > 0.9


@pytest.mark.parametrize("side", ["right", "left"])
def test_traffic_goes_where_the_arrows_of_its_lane_point(side, monkeypatch):
    read = Mock(side_effect=traffic_lanes.lanes_into)
    monkeypatch.setattr(traffic_lanes, "lanes_into", read)
    nodes = [(-100, 0), (0, 0), (0, 100), (100, 0), (0, -100)]
    arrows = np.array(["left|left|through;right", *[""] * 7])
    graph = road_graph(nodes, [(0, 1), (1, 2), (1, 3), (1, 4)], lanes=3.0, width=21.0, lane_turns=arrows)
    lanes, inside = lanes_of(graph, side=side), np.ones(len(graph), bool)
    north, east, south = (int(np.flatnonzero((graph.tail == 1) & (graph.head == k))[0]) for k in (2, 3, 4))

    def taken(lane):
        """Edges that follow the first one from a lane, counted from the left."""
        from_kerb = 2 - lane if side == "right" else lane
        drives = [
            random_lanes(
                lanes,
                np.random.default_rng(seed),
                edge=0,
                lane=from_kerb,
                metres=150.0,
                inside=inside,
                width=1.8,
            )[0]
            for seed in range(40)
        ]
        return {edges[1] for edges in drives}

    assert taken(0) == taken(1) == {north}
    assert taken(2) == {east, south}
    assert read.call_count == 1  # for the only edge with arrows, whatever the number of drives


@pytest.fixture(scope="module")
def signalised():
    """Trips, flow and junctions of 70 s of dense traffic in a town with signals; the ego stands outside."""
    return flow_on(city(signalised=True), standing((400.0, 400.0), 70.0), seed=3, radius=600.0)


def overlaps(boxes):
    a, b = shapely.STRtree(boxes).query(boxes, predicate="intersects")
    return int((a < b).sum())


@pytest.mark.full
@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 10_000), signalised=st.booleans(), lanes=st.sampled_from([1.0, 2.0]))
def test_vehicles_do_not_collide_or_jump(seed, signalised, lanes):
    graph = city(signalised=signalised, lanes=lanes, width=7.0 * lanes)
    trips, flow, _ = flow_on(graph, standing((400.0, 400.0), 40.0), seed=seed, density=12.0, radius=600.0)
    assert len(np.unique(flow.trip)) > 15
    assert flow.step.max() * STEP_S > 35
    poses = tracks(trips, flow)
    for moment in poses[::3]:
        assert overlaps(boxes_at(trips, moment)) == 0
    moved = np.hypot(*np.diff(poses[:, :, :2], axis=0).transpose(2, 0, 1))
    assert np.nanmax(moved) < 13.9 * 1.1 * STEP_S + 0.1


@pytest.mark.full
def test_reckless_drivers_do_not_collide():
    """A driver without gap and headway still stops within the cells it has reserved."""
    graph = city(signalised=False)
    ego = standing((400.0, 400.0), 30.0)
    lanes = lanes_of(graph, bounds=(-30.0, -30.0, 300.0, 300.0))
    trips = vehicle_trips(lanes, surroundings_of(lanes, ego, radius=600.0, scale=1.0), seed=9, density=20.0)
    wild = [
        replace(
            with_speed(t, 0 * t.course.desired_speed + 16.0),
            driver=replace(t.driver, headway=0.0, gap=0.0, deceleration=50.0, acceleration=4.0),
        )
        for t in trips
    ]
    flow = simulate_trips(
        wild, graph, plan=junction_plan(graph, lanes, seed=9), ego=ego, vehicle=CAR, radius=600.0
    )
    for moment in tracks(wild, flow)[::2]:
        assert overlaps(boxes_at(wild, moment)) == 0
    assert flow.speed.max() > 14.0


@pytest.mark.full
@pytest.mark.parametrize(("seed", "steps"), [(1, 37), (2, 100)])
def test_the_simulation_does_not_depend_on_its_windows(monkeypatch, seed, steps):
    """Tables of a short window hold the road users of that time; nobody moves otherwise, the ego included."""
    graph, most = city(signalised=True), []
    ego = driving(graph, seed, 90.0)
    route = plan_route(graph, Plane(), spec="random", options=RouteOptions(seed=seed, duration=90.0))
    own = ego_trip(plan_path(route, CAR, frame=Plane()), CAR)
    numbered = simulation.TrafficSimulation._numbered

    def counted(self, rows, tables, *, known):
        most.append(len(rows))
        return numbered(self, rows, tables, known=known)

    monkeypatch.setattr(simulation.TrafficSimulation, "_numbered", counted)
    found = []
    for window in (10_000, steps):
        monkeypatch.setattr(simulation, "_STEPS", window)
        most.clear()
        trips, flow, plan = flow_on(graph, ego, seed=seed, radius=60.0)
        far = simulate_ego(own, trips, graph=graph, plan=plan, seconds=90.0, radius=60.0)
        found.append((flow, far, max(most)))
    (one, alone, everyone), (other, windowed, some) = found
    assert len(np.unique(one.trip)) > 15
    for name in (f.name for f in fields(one)):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    np.testing.assert_array_equal(alone, windowed)
    assert some < 0.7 * everyone


@pytest.mark.full
def test_traffic_on_snow_is_slower_and_brakes_no_harder_than_the_grip_allows(signalised):
    ego, graph, dry = standing((400.0, 400.0), 30.0), city(signalised=True), signalised[1]
    trips, snow, _ = flow_on(graph, ego, seed=3, radius=600.0, road=ROADS["snow"])
    assert snow.speed.mean() < 0.8 * dry.speed[dry.step <= snow.step.max()].mean()
    hardest = min(np.diff(snow.speed[snow.trip == k]).min(initial=0.0) for k in np.unique(snow.trip)) / STEP_S
    assert -0.2 * 9.81 - 1e-6 <= hardest < 0
    assert {trip.driver.hard for trip in trips} == {0.2 * 9.81}


def test_speed_changes_within_the_limits_of_the_vehicle(signalised):
    trips, flow, _ = signalised
    for k in np.unique(flow.trip):
        speed = flow.speed[flow.trip == k]
        change = np.diff(speed) / STEP_S
        assert change.max(initial=0.0) <= trips[k].driver.acceleration + 1e-6
        assert change.min(initial=0.0) >= -trips[k].driver.hard - 1e-6
        travelled = np.diff(flow.travelled[flow.trip == k])
        np.testing.assert_allclose(travelled, (speed[1:] + speed[:-1]) / 2 * STEP_S, atol=0.02)
        assert (travelled >= -1e-9).all()


def test_braking_is_mild_almost_always(signalised):
    _, flow, _ = signalised
    same = np.diff(flow.trip) == 0
    change = np.diff(flow.speed)[same] / STEP_S
    assert (change < -4.0).mean() < 0.01
    assert flow.speed.mean() > 2.0  # traffic still flows


@settings(max_examples=2, deadline=None)
@given(seed=st.integers(0, 1000), signalised=st.booleans())
def test_the_ego_is_never_touched(seed, signalised):
    graph = city(signalised=signalised)
    ego = driving(graph, seed, 20.0)
    trips, flow, _ = flow_on(graph, ego, seed=seed, radius=300.0)
    poses = tracks(trips, flow)
    times = (np.arange(len(poses)) * STEP_S * 1e9).astype(np.int64)
    at = ego.at(times)
    forward = at.rotation[:, :2, 0]
    own = rectangles(
        at.position[:, :2] + CAR.middle * forward,
        np.arctan2(forward[:, 1], forward[:, 0]),
        length=CAR.length,
        width=CAR.width,
    )
    for mine, moment in zip(own, poses, strict=True):
        if np.isfinite(moment).any():
            assert not shapely.intersects(mine, boxes_at(trips, moment)).any()


def test_vehicles_queue_behind_an_ego_that_stands_in_their_lane():
    graph = road_graph([(0.0, 0.0), (400.0, 0.0)], [(0, 1)], speed=13.9)
    trips, flow, _ = flow_on(graph, standing((300.0, -1.75), 60.0), seed=2, density=15.0, radius=400.0)
    poses = tracks(trips, flow)
    last = poses[-1]
    behind = np.isfinite(last[:, 0]) & (last[:, 1] < 0) & (last[:, 0] < 300.0)
    assert behind.sum() >= 2
    nose = max(last[k, 0] + trips[k].length / 2 for k in np.flatnonzero(behind))
    tail = 300.0 - CAR.rear_overhang
    assert 0.8 < tail - nose < 8.0


def longest_rests(flow):
    """Seconds (t,) that each trip stands at most."""
    out = []
    for trip in np.unique(flow.trip):
        mine = flow.trip == trip
        step, moves = flow.step[mine], flow.speed[mine] > 0.05
        out.append(np.diff(np.concatenate([step[:1], step[moves], step[-1:]])).max() * STEP_S)
    return np.array(out)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))])
def test_no_road_user_stands_for_good(seed):
    """Cars, trucks and cyclists in a town of 16 junctions that none can leave, for three minutes."""
    graph, ego = grid(4, 4, 90.0, lanes=1.0, width=7.0, speed=13.9), standing((135.0, 135.0), 180.0)
    lanes = lanes_of(graph, bounds=(-500.0, -500.0, 800.0, 800.0))
    area = surroundings_of(lanes, ego, radius=400.0, scale=1.0)
    shares = {"sedan": 0.6, "cyclist": 0.3, "truck": 0.1}
    trips = vehicle_trips(lanes, area, seed=seed, density=15.0, shares=shares)
    plan = junction_plan(graph, lanes, seed=seed)
    flow = simulate_trips(trips, graph, plan=plan, ego=ego, vehicle=CAR, radius=400.0)
    assert len(np.unique(flow.trip)) > 20
    assert longest_rests(flow).max() < 100.0


@pytest.mark.full
def test_the_gap_to_a_leader_grows_with_speed():
    """At rest bodies are some 2 m apart; on a free road followers keep a second and more."""
    graph = road_graph([(0.0, 0.0), (2000.0, 0.0)], [(0, 1)], twoway=False, width=4.0, speed=13.9)
    trips, flow, _ = flow_on(graph, standing((400.0, 500.0), 40.0), seed=1, density=20.0, radius=1500.0)
    poses = tracks(trips, flow)
    speed = np.full(poses.shape[:2], np.nan)
    speed[flow.step, flow.trip] = flow.speed
    gaps = []
    for moment, v in zip(poses[150:], speed[150:], strict=True):
        there = np.flatnonzero(np.isfinite(moment[:, 0]))
        there = there[np.argsort(moment[there, 0])]
        for a, b in itertools.pairwise(there):
            space = moment[b, 0] - moment[a, 0] - (trips[a].length + trips[b].length) / 2
            gaps.append((v[a], space))
    v, space = np.array(gaps).T
    assert space.min() > 1.0
    fast = v > 8.0
    assert fast.any()
    assert np.percentile(space[fast] / v[fast], 2) > 0.9


def test_no_road_user_enters_a_junction_on_red(signalised):
    trips, flow, plan = signalised
    poses = tracks(trips, flow)
    entered = 0
    for k in np.unique(flow.trip):
        rows = flow.trip == k
        zone = zone_at(plan.zones, trips[k].course.path.xyz[:, :2])
        station = (flow.travelled[rows] + trips[k].length / 2) / STEP
        front = np.minimum(station, len(zone) - 1).astype(int)
        here = zone[front]
        for i in np.flatnonzero((np.diff(here) != 0) & (here[1:] >= 0)):
            z = int(here[i + 1])
            group = signal_group(plan, z, heading=float(trips[k].course.path.heading[front[i]]))
            t = float(flow.step[rows][i + 1]) * STEP_S
            # green now, or it entered on green and is within amber and clearing
            lately = [is_green(z, group, t - ago, plan.signals) for ago in np.arange(0.0, AMBER, 0.5)]
            if i > 20:
                assert any(lately)
                entered += 1
    assert entered > 10
    assert np.isfinite(poses).any()


def test_both_groups_of_signals_have_green_but_never_together():
    graph = city(signalised=True)
    plan = junction_plan(graph, lanes_of(graph), seed=1)
    times = np.arange(0.0, 120.0, 0.25)
    for z in range(len(plan.zones.polygon)):
        green = np.array([[is_green(z, g, float(t), plan.signals) for g in (0, 1)] for t in times])
        assert not green.all(axis=1).any()
        assert (green.mean(axis=0) > 0.3).all()


@pytest.mark.full
def test_traffic_keeps_to_its_side_and_inside_the_carriageway():
    graph = city(signalised=False, lanes=2.0, width=14.0, streets=3)
    road = shapely.union_all([shapely.LineString(line[:, :2]).buffer(7.3) for line in graph.geometry])
    for side, sign in (("right", 1), ("left", -1)):
        lanes = lanes_of(graph, side=side, bounds=(-30.0, -30.0, 300.0, 300.0))
        area = surroundings_of(lanes, standing((400.0, 400.0), 5.0), radius=600.0, scale=1.0)
        trips = vehicle_trips(lanes, area, seed=1, density=10.0, ground=road)
        assert len(trips) > 10
        for trip in trips:
            xy, heading = trip.body()
            assert shapely.covers(road, rectangles(xy, heading, length=trip.length, width=trip.width)).all()
            line = shapely.LineString(graph.geometry[trip.course.path.edge[trip.begin]][:, :2])
            ring = shapely.LinearRing([*line.coords, trip.course.path.xyz[trip.begin, :2]])
            if abs(curvatures(trip.course.path.xyz)[trip.begin]) < 1e-3:
                assert ring.is_ccw == (sign < 0)


def test_lanes_lie_side_by_side():
    graph = road_graph([(0.0, 0.0), (100.0, 0.0)], [(0, 1)], lanes=2.0, width=14.0)
    lanes = lanes_of(graph)
    assert [lane_shift(lanes, 0, lane=k, width=1.8) for k in (0, 1)] == pytest.approx([5.25, 1.75])


@pytest.mark.full
def test_the_same_seed_gives_the_same_traffic():
    graph = city(signalised=True)
    ego = driving(graph, 1, 8.0)
    first, second, other = (flow_on(graph, ego, seed=s, density=8.0, radius=200.0)[1] for s in (7, 7, 8))
    for name in ("trip", "step", "travelled", "speed"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    assert first.travelled.tobytes() != other.travelled.tobytes()


def test_higher_density_gives_more_traffic():
    graph = city(signalised=False)
    ego = standing((135.0, 135.0), 5.0)
    few, many = (len(flow_on(graph, ego, seed=1, density=d)[0]) for d in (5.0, 20.0))
    assert many > 2.5 * few
    assert flow_on(graph, ego, seed=1, density=0.0)[0] == []


def test_signals_are_green_for_the_ego_when_it_comes():
    graph = city(signalised=True)
    ego = driving(graph, 3, 40.0)
    lanes = lanes_of(graph)
    plan = junction_plan(graph, lanes, seed=11)
    signals = plan.signals._replace(window=green_windows(plan, ego_motion(ego, CAR, graph=graph)))
    times = np.arange(0.0, 40.0, 0.1)
    at = ego.at((times * 1e9).astype(np.int64))
    zone = zone_at(plan.zones, at.position[:, :2])
    entries = np.flatnonzero((np.diff(zone) != 0) & (zone[1:] >= 0)) + 1
    assert len(entries) >= 2
    for k in entries:
        forward = at.rotation[k, :2, 0]
        group = signal_group(plan, int(zone[k]), heading=float(np.arctan2(forward[1], forward[0])))
        assert is_green(int(zone[k]), group, float(times[k]), signals)
        assert not is_green(int(zone[k]), 1 - group, float(times[k]), signals)
