"""Traffic that enters a roundabout waits for that on it."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.roadgrids import road_graph
from helpers.traffic import CAR

from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.sources.data import OsmData, TaggedNode, Way
from lidar.geometry.poses import Trajectory
from lidar.traffic.junctions import junction_plan
from lidar.traffic.lanes import STEP, lanes_of, path_along_lanes
from lidar.traffic.passages import passages
from lidar.traffic.simulation import simulate_trips
from lidar.traffic.simulation_kernel import STEP_S
from lidar.traffic.trips import DRIVERS, Trip, TripCourse, random_shape

RADIUS, ARM, SPEED = 70.0, 250.0, 8.0
FAR_AWAY = Trajectory(
    np.array([0, int(60e9)]),
    np.array([[900.0, 900.0, 0.0]] * 2),
    np.array([[0.0, 0.0, 0.0, 1.0]] * 2),
    np.zeros((2, 3)),
    np.ones(2),
)


def ring(*, turn):
    """A ring of four nodes, driven counter-clockwise (``turn`` 1) or clockwise (-1), with an arm at each.

    Edges 0 to 3 are the ring's, 4 + 2k leads into node k and 5 + 2k out of it.
    """
    quarters = turn * np.arange(4) * np.pi / 2
    out = np.stack([np.cos(quarters), np.sin(quarters)], axis=1)
    nodes = np.concatenate([RADIUS * out, ARM * out])
    pairs = [(k, (k + 1) % 4) for k in range(4)] + [(4 + k, k) for k in range(4)]
    bends = {}
    for k in range(4):
        angle = quarters[k] + turn * np.linspace(0.0, np.pi / 2, 17)
        bends[k, (k + 1) % 4] = np.stack([RADIUS * np.cos(angle), RADIUS * np.sin(angle), 0 * angle], 1)
    graph = road_graph(nodes, pairs, twoway=[False] * 4 + [True] * 4, bends=bends, speed=SPEED)
    on_ring = np.arange(len(graph)) < 4
    width = np.where(on_ring, 5.0, 7.0)
    return replace(graph, width=width, highway=np.where(on_ring, "residential", "primary"))


def trip(lanes, edges, *, start):
    """A car along edges, from metres on the first one."""
    path = path_along_lanes(
        lanes,
        np.array(edges, np.int32),
        picked=np.zeros(len(edges), np.int8),
        width=1.8,
        radius=5.5,
        scale=1.0,
    )
    course = TripCourse(path, np.full(len(path), SPEED))
    shape = random_shape("sedan", np.random.default_rng(1))
    return Trip(shape, (1.0, 1.0, 1.0), course, DRIVERS["sedan"], int(start / STEP), 0.0, leaves=True)


def slowest(graph, *, side, ahead):
    """Least speeds of a car on the ring and of one that would enter ``ahead`` seconds before it comes."""
    graph = replace(graph, roundabout=np.arange(len(graph)) < 4)
    lanes = lanes_of(graph, side=side)
    quarter = float(graph.length[0])
    on_it = trip(lanes, [0, 1, 2, 3], start=20.0)
    entering = trip(lanes, [6, 1, 9], start=ARM - RADIUS - quarter + 20.0 + ahead * SPEED)
    plan = junction_plan(graph, lanes, seed=1)
    flow = simulate_trips([on_it, entering], graph, plan=plan, ego=FAR_AWAY, vehicle=CAR, radius=2000.0)
    early = (flow.step * STEP_S > 2.0) & (flow.step * STEP_S < 16.0)
    return [float(flow.speed[early & (flow.trip == k)].min()) for k in (0, 1)]


@pytest.mark.parametrize(("side", "turn"), [("right", 1), ("left", -1)])
@pytest.mark.parametrize("ahead", [-0.5, 0.0, 0.5])
def test_who_enters_a_roundabout_waits_for_those_on_it(side, turn, ahead):
    on_it, entering = slowest(ring(turn=turn), side=side, ahead=ahead)
    assert on_it > 0.8 * SPEED
    assert entering < 0.5 * SPEED


def test_a_roundabout_counts_more_than_the_class_of_its_arms():
    graph = ring(turn=1)
    lanes = lanes_of(graph)
    plan = junction_plan(graph, lanes, seed=1)
    around = trip(lanes, [0, 1, 2, 3], start=5.0)
    entering = trip(lanes, [6, 1, 9], start=5.0)
    ranks = {}
    for name, on_ring in (("crossing", False), ("roundabout", True)):
        made = replace(graph, roundabout=(np.arange(len(graph)) < 4) & on_ring)
        ranks[name] = [float(passages(t, made, plan=plan, routes={})[0, 6]) for t in (around, entering)]
    assert ranks["crossing"][0] > ranks["crossing"][1]
    assert ranks["roundabout"][0] < ranks["roundabout"][1]


def test_all_arms_of_a_mini_roundabout_are_equal():
    frame = Frame.at(10.0, 50.0)
    places = {1: (0.0, 0.0), 2: (100.0, 0.0), 3: (0.0, 100.0), 4: (-100.0, 0.0)}
    lonlat = {n: np.array(frame.to_geographic(*xy)) for n, xy in places.items()}
    ways = [
        Way(f"way/{k}", {"highway": kind}, np.array(nodes), np.array([lonlat[n] for n in nodes]))
        for k, (kind, nodes) in enumerate((("primary", (4, 1, 2)), ("residential", (3, 1))))
    ]
    found = {}
    for tags in ({"highway": "mini_roundabout"}, {"highway": "crossing"}):
        points = [TaggedNode("node/1", tags, *lonlat[1])]
        graph, _ = build_road_graph(OsmData((9.9, 49.9, 10.1, 50.1), ways, [], points, []), frame)
        lanes = lanes_of(graph)
        plan = junction_plan(graph, lanes, seed=1)
        into = np.flatnonzero(graph.node_id[graph.head] == 1).tolist()
        out = [int(np.flatnonzero((graph.tail == graph.head[k]) & (graph.twin != k))[0]) for k in into]
        trips = [trip(lanes, [k, after], start=5.0) for k, after in zip(into, out, strict=True)]
        found[tags["highway"]] = {float(passages(t, graph, plan=plan, routes={})[0, 6]) for t in trips}
    assert len(found["mini_roundabout"]) == 1
    assert len(found["crossing"]) > 1
