"""Signal heads: which junction they serve, and what they show while traffic drives."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.roadgrids import grid, road_graph
from helpers.traffic import CAR
from hypothesis import given
from hypothesis import strategies as st

from lidar.geometry.poses import Trajectory
from lidar.traffic.junctions import AMBER as CLEARING
from lidar.traffic.junctions import is_green, junction_plan, signal_group, zone_at
from lidar.traffic.lanes import lanes_of
from lidar.traffic.signal_heads import (
    AMBER,
    AMBER_S,
    GREEN,
    RED,
    SignalHeads,
    SignalStates,
    find_served_heads,
    signal_states,
)
from lidar.traffic.simulation import ego_motion, green_windows


def signalised(graph, *, before):
    """The graph with signals on every arm of its junctions, metres before their middles."""
    m = len(graph)
    return replace(
        graph,
        signals=np.full(len(graph.node_id), True),
        control_edge=np.arange(m, dtype=np.int32),
        control_offset=graph.length - before,
        control_kind=np.full(m, "traffic_signals"),
    )


def courses(graph):
    step = np.stack([line[-1, :2] - line[0, :2] for line in graph.geometry])
    return np.arctan2(step[:, 1], step[:, 0])


def beside(graph, *, before, aside):
    """Places and headings of heads to the right of the end of each edge, that face its traffic."""
    course = courses(graph)
    end = np.stack([line[-1] for line in graph.geometry])
    along = np.column_stack([np.cos(course), np.sin(course), np.zeros(len(graph))])
    right = np.column_stack([np.sin(course), -np.cos(course), np.zeros(len(graph))])
    return end - before * along + aside * right, course + np.pi


@pytest.mark.full
@given(
    st.floats(0.0, 25.0), st.floats(2.0, 8.0), st.floats(-0.4, 0.4), st.floats(0.0, 6.3), st.integers(0, 99)
)
def test_a_head_serves_the_junction_ahead_of_the_traffic_it_faces(before, aside, off, turn, seed):
    graph = signalised(grid(3, 3, 120.0), before=before)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    lines = np.empty(len(graph), object)
    lines[:] = [np.column_stack([line[:, :2] @ rotation, line[:, 2]]) for line in graph.geometry]
    nodes = np.column_stack([graph.node_xyz[:, :2] @ rotation, graph.node_xyz[:, 2]])
    graph = replace(graph, geometry=lines, node_xyz=nodes)
    plan = junction_plan(graph, lanes_of(graph), seed=seed)
    place, heading = beside(graph, before=before, aside=aside)
    zone, group = find_served_heads(place, heading + off, graph=graph, plan=plan)
    course, junction = courses(graph), zone_at(plan.zones, graph.node_xyz[graph.head, :2])
    crossing = junction >= 0  # corners of the grid are bends of one street
    np.testing.assert_array_equal(zone[crossing], junction[crossing])
    expected = [
        signal_group(plan, int(z), heading=float(c)) for z, c in zip(junction, course, strict=True) if z >= 0
    ]
    assert group[crossing].tolist() == expected
    assert (zone[~crossing] == -1).all()


def test_signals_of_a_crossing_far_from_junctions_stop_nobody_and_rest_in_green():
    graph = grid(3, 3, 200.0)
    far = replace(
        graph,
        control_edge=np.arange(len(graph), dtype=np.int32),
        control_offset=graph.length / 2,
        control_kind=np.full(len(graph), "traffic_signals"),
    )
    plan = junction_plan(far, lanes_of(far), seed=1)
    place, heading = beside(far, before=100.0, aside=4.0)
    zone, group = find_served_heads(place, heading, graph=far, plan=plan)
    assert (zone == -1).all()
    states = SignalStates(SignalHeads(np.arange(len(far)), place, heading, zone, group), plan.signals)
    assert {state for s in np.arange(0.0, 60.0, 5.0) for state in states.at(s).tolist()} == {GREEN}


def test_an_edge_that_ends_between_the_signal_and_the_junction_is_followed_straight_on():
    # The middle node is where an attribute of the road changes, 6 m before the junction.
    nodes = [(0, 0), (94, 0), (100, 0), (200, 0), (100, 100)]
    graph = road_graph(nodes, [(0, 1), (1, 2), (2, 3), (2, 4)])
    edge = int(np.flatnonzero((graph.tail == 0) & (graph.head == 1))[0])
    graph = replace(
        graph,
        signals=np.array([False, False, True, False, False]),
        control_edge=np.array([edge], np.int32),
        control_offset=np.array([92.0]),
        control_kind=np.array(["traffic_signals"]),
    )
    plan = junction_plan(graph, lanes_of(graph), seed=1)
    zone, group = find_served_heads(np.array([[92.0, -4.0, 0.0]]), np.array([np.pi]), graph=graph, plan=plan)
    z = int(zone_at(plan.zones, np.array([[100.0, 0.0]]))[0])
    assert (zone[0], group[0]) == (z, signal_group(plan, z, heading=0.0))


def test_a_head_beside_a_road_without_mapped_signals_serves_the_junction_at_hand():
    graph = replace(grid(3, 3, 120.0), signals=np.full(9, True))
    plan = junction_plan(graph, lanes_of(graph), seed=1)
    place = np.array([[112.0, 115.0, 0.0], [60.0, 120.0, 0.0]])
    zone, group = find_served_heads(place, np.array([np.pi, np.pi]), graph=graph, plan=plan)
    z = int(zone_at(plan.zones, np.array([[120.0, 120.0]]))[0])
    assert (zone[0], group[0]) == (z, signal_group(plan, z, heading=0.0))
    assert zone[1] == -1  # 50 m away


@pytest.mark.full
@given(st.integers(0, 99), st.floats(0.0, 500.0))
def test_crossing_streets_never_both_show_green_or_amber(seed, time_s):
    graph = signalised(grid(3, 3, 120.0), before=8.0)
    plan = junction_plan(graph, lanes_of(graph), seed=seed)
    place, heading = beside(graph, before=8.0, aside=4.0)
    zone, group = find_served_heads(place, heading, graph=graph, plan=plan)
    heads = SignalHeads(np.arange(len(graph), dtype=np.int32), place, heading, zone, group)
    state = SignalStates(heads, plan.signals).at(time_s)
    for z in np.unique(zone[zone >= 0]).tolist():
        first, second = (state[(zone == z) & (group == g)] for g in (0, 1))
        assert (first == RED).all() or (second == RED).all()
        for g, shown in ((0, first), (1, second)):
            assert ((shown == GREEN) == is_green(z, g, time_s, plan.signals)).all()


def test_each_head_goes_from_green_over_amber_of_three_seconds_to_red():
    graph = signalised(grid(3, 3, 120.0), before=8.0)
    plan = junction_plan(graph, lanes_of(graph), seed=4)
    place, heading = beside(graph, before=8.0, aside=4.0)
    heads = SignalHeads(
        np.arange(len(graph), dtype=np.int32),
        place,
        heading,
        *find_served_heads(place, heading, graph=graph, plan=plan),
    )
    step = 0.1
    shown = np.stack([SignalStates(heads, plan.signals).at(t) for t in np.arange(0.0, 60.0, step)])
    shown = shown[:, heads.zone >= 0]
    after = np.roll(shown, -1, axis=0)
    assert set(zip(shown.ravel().tolist(), after.ravel().tolist(), strict=True)) == {
        (GREEN, GREEN), (GREEN, AMBER), (AMBER, AMBER), (AMBER, RED), (RED, RED), (RED, GREEN),
    }  # fmt: skip
    np.testing.assert_allclose((shown == AMBER).sum(axis=0) * step, AMBER_S, atol=0.11)
    np.testing.assert_allclose((shown == GREEN).sum(axis=0) * step, 30.0 - CLEARING, atol=0.11)


def test_a_vehicle_on_a_fixed_way_meets_green_heads():
    graph = signalised(grid(3, 3, 120.0), before=8.0)
    plan = junction_plan(graph, lanes_of(graph), seed=2)
    time_ns = np.arange(0, 25 * 10**9, 10**8)
    x = 10.0 * time_ns * 1e-9
    ego = Trajectory(
        time_ns,
        np.column_stack([x, np.full(len(x), 118.0), np.zeros(len(x))]),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(x), 1)),
        np.tile([10.0, 0.0, 0.0], (len(x), 1)),
        np.ones(len(x)),
    )
    signals = plan.signals._replace(window=green_windows(plan, ego_motion(ego, CAR, graph=graph)))
    place, heading = beside(graph, before=8.0, aside=4.0)
    zone, group = find_served_heads(place, heading, graph=graph, plan=plan)
    heads = SignalHeads(np.arange(len(graph), dtype=np.int32), place, heading, zone, group)
    middle = int(zone_at(plan.zones, np.array([[120.0, 120.0]]))[0])
    ahead = (zone == middle) & (np.abs(np.cos(heading) + 1) < 0.1)
    across = (zone == middle) & (np.abs(np.cos(heading)) < 0.1)
    assert ahead.sum() == 1
    state = SignalStates(heads, signals).at(11.0)  # 10 m before the middle
    assert (state[ahead] == GREEN).all()
    assert (state[across] == RED).all()


@pytest.mark.parametrize("side", ["right", "left"])
def test_heads_of_a_real_map_serve_junctions_with_both_groups(scene, side):
    states = signal_states(scene, None, seed=1, side=side, vehicle=CAR)
    heads = states.heads
    assert len(heads) >= 20
    assert (np.diff(heads.feature) > 0).all()
    served = heads.zone >= 0
    assert served.mean() > 0.5
    assert set(heads.group[served].tolist()) == {0, 1}
    assert (heads.group[~served] == -1).all()
