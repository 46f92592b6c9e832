"""The road graph has the tags and restrictions of the map, and routes obey them."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import InputError, SceneFormatError
from geoscene.geometry.frames import Frame
from geoscene.roadgraph import (
    RoadOptions,
    build_road_graph,
    find_components,
    graphml,
    main_network,
    read_graphml,
    write_graphml,
)
from geoscene.roadgraph.routing import (
    edge_lines,
    nearest_edge,
    path_line,
    shortest_path,
    turn_states,
    turn_table,
)
from geoscene.roadgraph.speeds import speed_limit
from geoscene.roadgraph.tags import drivable, read_street
from geoscene.sources import read_osm
from geoscene.sources.data import OsmData, Relation, TaggedNode, Way

FRAME = Frame.at(10.0, 50.0)
KMH = 1 / 3.6
LIFT = np.array([0.0, 0.0, 12.3456])


def town(places, ways, points=(), relations=()):
    """A map of nodes at positions in scene metres; ``ways`` are (tags, node ids)."""
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in places.items()}
    lost = np.full(2, np.nan)
    return OsmData(
        bounds=(9.9, 49.9, 10.1, 50.1),
        ways=[
            Way(
                f"way/{100 + k}",
                {"highway": "residential"} | tags,
                np.array(nodes, np.int64),
                np.array([lonlat.get(n, lost) for n in nodes]),
            )
            for k, (tags, nodes) in enumerate(ways)
        ],
        areas=[],
        points=[TaggedNode(f"node/{n}", tags, *lonlat[n]) for n, tags in points],
        relations=[Relation(f"relation/{k}", tags, members) for k, (tags, members) in enumerate(relations)],
    )


def graph_of(*args, **options):
    return build_road_graph(town(*args), FRAME, options=RoadOptions(**options))[0]


CROSS = {1: (0, 0), 2: (100, 0), 3: (0, 100), 4: (-100, 0), 5: (0, -100)}


def edge_between(graph, tail, head):
    rows = np.flatnonzero((graph.node_id[graph.tail] == tail) & (graph.node_id[graph.head] == head))
    assert len(rows) == 1
    return int(rows[0])


def test_nodes_are_only_junctions_ends_and_tag_changes():
    places = {k: (10 * k, 0) for k in range(10)} | {20: (30, 40)}
    graph = graph_of(
        places, [({}, [0, 1, 2, 3, 4]), ({}, [3, 20]), ({}, [4, 5, 6]), ({"bridge": "yes"}, [6, 7, 8])]
    )
    assert set(graph.node_id) == {0, 3, 20, 6, 8}
    joined = edge_between(graph, 3, 6)
    assert graph.osm_id[joined] == "way/100;way/102"
    assert graph.osm_id[graph.twin[joined]] == "way/102;way/100"
    np.testing.assert_allclose(graph.geometry[joined][:, 0], [30, 40, 50, 60], atol=1e-6)
    assert graph.bridge[edge_between(graph, 6, 8)]


def test_the_unsimplified_graph_has_every_node_and_the_same_length():
    places = {k: (10 * k, k % 2) for k in range(6)}
    simple, full = (graph_of(places, [({}, range(6))], simplify=s) for s in (True, False))
    assert len(simple) == 2
    assert len(full) == 10
    assert full.length.sum() == pytest.approx(simple.length.sum(), rel=1e-12)


def test_roads_that_cross_without_a_common_node_do_not_meet():
    places = {1: (-50, 0), 2: (50, 0), 3: (0, -50), 4: (0, 50)}
    graph = graph_of(places, [({}, [1, 2]), ({"bridge": "yes", "layer": "1"}, [3, 4])])
    assert find_components(graph).weak.max() == 1


@pytest.mark.parametrize(
    ("tags", "pairs"),
    [
        ({}, {(1, 2), (2, 1)}),
        ({"oneway": "yes"}, {(1, 2)}),
        ({"oneway": "1"}, {(1, 2)}),
        ({"oneway": "-1"}, {(2, 1)}),
        ({"oneway": "reversible"}, {(1, 2), (2, 1)}),
        ({"junction": "roundabout"}, {(1, 2)}),
        ({"junction": "roundabout", "oneway": "no"}, {(1, 2), (2, 1)}),
        ({"highway": "motorway"}, {(1, 2)}),
        ({"highway": "motorway", "oneway": "no"}, {(1, 2), (2, 1)}),
        ({"motor_vehicle:backward": "no"}, {(1, 2)}),
        ({"access": "private"}, set()),
        ({"access": "no", "motor_vehicle": "yes"}, {(1, 2), (2, 1)}),
        ({"access": "yes", "motorcar": "no"}, set()),
        ({"access": "destination"}, {(1, 2), (2, 1)}),
        ({"highway": "footway"}, set()),
        ({"highway": "service", "area": "yes"}, set()),
    ],
)
def test_tags_decide_the_permitted_directions(tags, pairs):
    graph = graph_of({1: (0, 0), 2: (100, 0)}, [(tags, [1, 2])])
    found = {
        (int(graph.node_id[t]), int(graph.node_id[h])) for t, h in zip(graph.tail, graph.head, strict=True)
    }
    assert found == pairs
    for edge in range(len(graph)):
        line = graph.geometry[edge]
        np.testing.assert_allclose(line[0], graph.node_xyz[graph.tail[edge]], atol=1e-9)
        np.testing.assert_allclose(line[-1], graph.node_xyz[graph.head[edge]], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "kmh", "source"),
    [
        ("50", 50, "maxspeed"),
        ("30 mph", 48.28032, "maxspeed"),
        ("30mph", 48.28032, "maxspeed"),
        ("10 knots", 18.52, "maxspeed"),
        ("50;30", 30, "maxspeed"),
        ("walk", 7, "maxspeed"),
        ("none", 130, "maxspeed"),
        ("DE:urban", 50, "zone"),
        ("DE:rural", 100, "zone"),
        ("RU:urban", 60, "zone"),
        ("GB:nsl_single", 96.56064, "zone"),
        ("DE:zone:30", 30, "zone"),
        ("DE:zone30", 30, "zone"),
    ],
)
def test_speed_limits_as_mappers_write_them(text, kmh, source):
    speed, told = speed_limit(text)
    assert speed * 3.6 == pytest.approx(kmh)
    assert told == source


@pytest.mark.parametrize("text", ["signals", "fast", "", "-5", "0", "XX:nowhere"])
def test_speed_limit_without_a_number_is_ignored(text):
    assert speed_limit(text) is None


def test_a_limit_for_one_direction_binds_that_direction():
    graph = graph_of({1: (0, 0), 2: (9, 0)}, [({"maxspeed": "50", "maxspeed:backward": "30"}, [1, 2])])
    assert graph.speed[edge_between(graph, 1, 2)] == pytest.approx(50 * KMH)
    assert graph.speed[edge_between(graph, 2, 1)] == pytest.approx(30 * KMH)


@pytest.mark.parametrize(
    ("tags", "lanes", "width", "sources"),
    [
        ({"lanes": "2"}, (1, 1), 6.0, ("lanes", "lanes")),
        ({"lanes": "3", "lanes:forward": "2"}, (2, 1), 9.0, ("lanes", "lanes")),
        ({"lanes": "3"}, (1.5, 1.5), 9.0, ("lanes", "lanes")),
        ({"lanes": "3", "oneway": "yes"}, (3, 0), 9.0, ("lanes", "lanes")),
        ({"lanes": "2", "oneway": "-1"}, (0, 2), 6.0, ("lanes", "lanes")),
        ({"lanes": "many"}, (1, 1), 6.0, ("default", "default")),
        ({}, (1, 1), 6.0, ("default", "default")),
        ({"width": "12'6\""}, (1, 1), 3.81, ("default", "width")),
        ({"width": "7,5 m"}, (1, 1), 7.5, ("default", "width")),
        ({"est_width": "5"}, (1, 1), 5.0, ("default", "est_width")),
        ({"width": "500"}, (1, 1), 6.0, ("default", "default")),
        ({"lanes": "2", "parking:both": "lane", "parking:both:orientation": "parallel"}, (1, 1), 10.0,
         ("lanes", "lanes")),
    ],
)  # fmt: skip
def test_lanes_and_width_have_sources(tags, lanes, width, sources):
    street, _ = read_street({"highway": "residential"} | tags)
    assert street.lanes == lanes
    assert street.width == pytest.approx(width)
    assert (street.lanes_source, street.width_source) == sources


@pytest.mark.parametrize(
    ("tags", "layer", "source", "bridge", "tunnel"),
    [
        ({}, 0, "default", False, False),
        ({"bridge": "viaduct"}, 1, "bridge", True, False),
        ({"bridge": "yes", "layer": "2"}, 2, "layer", True, False),
        ({"tunnel": "yes"}, -1, "tunnel", False, True),
        ({"tunnel": "building_passage"}, 0, "default", False, False),
        ({"level": "1"}, 1, "level", False, False),
        ({"bridge": "no", "layer": "x"}, 0, "default", False, False),
    ],
)
def test_tags_decide_layer_bridge_and_tunnel(tags, layer, source, bridge, tunnel):
    street, unread = read_street({"highway": "service"} | tags)
    assert (street.layer, street.layer_source, street.bridge, street.tunnel) == (
        layer,
        source,
        bridge,
        tunnel,
    )
    assert bool(unread) == (tags.get("layer") == "x")


def test_a_gap_in_a_way_is_not_bridged_but_reported():
    places = {1: (0, 0), 2: (10, 0), 4: (30, 0), 5: (40, 0), 6: (0, 50)}
    graph, problems = build_road_graph(
        town(places, [({}, [1, 2, 3, 4, 5]), ({}, [9, 6, 8]), ({"maxspeed": "quick"}, [1, 6])]), FRAME
    )
    assert find_components(graph).weak.max() == 1
    assert {(p.osm_id, p.action, p.reason) for p in problems} == {
        ("way/100", "repaired", "missing-nodes"),
        ("way/101", "dropped", "missing-nodes"),
        ("way/102", "repaired", "unreadable-tag"),
    }


def test_loops_start_and_end_at_a_node():
    places = {1: (0, 0), 2: (50, 0), 3: (50, 50), 4: (-90, 0), 11: (500, 0), 12: (550, 0), 13: (550, 50)}
    graph = graph_of(places, [({}, [4, 1, 2, 3, 1]), ({"oneway": "yes"}, [11, 12, 13, 11])])
    loop = np.flatnonzero(graph.tail == graph.head)
    assert len(loop) == 3  # the lollipop both ways, the lonely ring one way
    for edge in loop:
        assert len(graph.geometry[edge]) == 4


def only(kind, via, way_in, way_out):
    members = (("way", way_in, "from"), ("node", via, "via"), ("way", way_out, "to"))
    return {"type": "restriction", "restriction": kind}, members


ARMS = [({}, [2, 1]), ({}, [1, 3]), ({}, [4, 1]), ({}, [1, 5])]


def test_route_avoids_a_forbidden_turn():
    places = CROSS | {6: (100, 100), 7: (200, 0), 8: (0, 200)}
    ways = [*ARMS, ({}, [3, 6, 2]), ({}, [2, 7]), ({}, [3, 8])]
    free = graph_of(places, ways)
    bound = graph_of(places, ways, (), [only("no_right_turn", 1, 100, 101)])
    start, goal = edge_between(free, 2, 1), edge_between(free, 1, 3)
    short = shortest_path(free, (start, 50.0), goal=(goal, 50.0), either_side=False)
    assert short.edges.tolist() == [start, goal]
    assert short.length == pytest.approx(100, abs=1e-3)
    long = shortest_path(bound, (start, 50.0), goal=(goal, 50.0), either_side=False)
    assert long is None or long.edges.tolist() != [start, goal]
    assert bound.turn_kind.tolist() == ["no_right_turn"]


def test_mandatory_turn_forbids_all_others_unless_cars_are_excepted():
    tags, members = only("only_straight_on", 1, 100, 102)
    bound = graph_of(CROSS, ARMS, (), [(tags, members)])
    before, after = turn_table(bound)
    start = edge_between(bound, 2, 1)
    assert after[before == start].tolist() == [edge_between(bound, 1, 4)]
    free = graph_of(CROSS, ARMS, (), [(tags | {"except": "bus;motorcar"}, members)])
    before, after = turn_table(free)
    assert len(after[before == start]) == 3


def via_ways(kind, way_in, ways, way_out, **tags):
    members = [("way", way_in, "from"), *(("way", way, "via") for way in ways), ("way", way_out, "to")]
    return {"type": "restriction", "restriction": kind} | tags, tuple(members)


# Two carriageways, east at y = 0 and west at y = 20, joined at x = 0 by way 102 and at x = 100 by way 105.
DUAL = {
    1: (-100, 0),
    2: (0, 0),
    3: (100, 0),
    4: (200, 0),
    5: (200, 20),
    6: (100, 20),
    7: (0, 20),
    8: (-100, 20),
}
DUAL |= {9: (0, -190), 10: (0, 190)}
ONE_WAY = {"oneway": "yes"}
CARRIAGEWAYS = [
    (ONE_WAY | {"name": "east"}, [1, 2]),
    (ONE_WAY | {"name": "west"}, [7, 8]),
    ({"name": "link"}, [2, 7]),
    (ONE_WAY | {"name": "east"}, [2, 3, 4]),
    (ONE_WAY | {"name": "west"}, [5, 6, 7]),
    ({"name": "far link"}, [3, 6]),
    ({"name": "south"}, [9, 2]),
    ({"name": "north"}, [7, 10]),
]


def driven_nodes(graph, path):
    return [int(graph.node_id[graph.tail[path.edges[0]]]), *graph.node_id[graph.head[path.edges]].tolist()]


def test_turn_forbidden_via_a_way_applies_only_from_its_first_street():
    bound = graph_of(DUAL, CARRIAGEWAYS, (), [via_ways("no_u_turn", 100, [102], 101)])
    assert [chain.tolist() for chain in bound.chain_edges] == [
        [edge_between(bound, 1, 2), edge_between(bound, 2, 7), edge_between(bound, 7, 8)]
    ]
    assert not len(bound.turn_from)
    home = (edge_between(bound, 7, 8), 50.0)
    from_west = shortest_path(bound, (edge_between(bound, 1, 2), 50.0), goal=home, either_side=False)
    assert driven_nodes(bound, from_west) == [1, 2, 3, 6, 7, 8]
    from_south = shortest_path(bound, (edge_between(bound, 9, 2), 20.0), goal=home, either_side=False)
    assert driven_nodes(bound, from_south) == [9, 2, 7, 8]
    ahead = (edge_between(bound, 7, 10), 50.0)
    onward = shortest_path(bound, (edge_between(bound, 1, 2), 50.0), goal=ahead, either_side=False)
    assert driven_nodes(bound, onward) == [1, 2, 7, 10]


def test_mandatory_turn_via_a_way_forbids_all_others():
    bound = graph_of(DUAL, CARRIAGEWAYS, (), [via_ways("only_straight_on", 106, [102], 107)])
    start = edge_between(bound, 9, 2)
    before, after = turn_table(bound)
    assert after[before == start].tolist() == [edge_between(bound, 2, 7)]
    home = (edge_between(bound, 7, 8), 50.0)
    ahead = (edge_between(bound, 7, 10), 50.0)
    assert driven_nodes(bound, shortest_path(bound, (start, 20.0), goal=ahead, either_side=False)) == [
        9,
        2,
        7,
        10,
    ]
    around = shortest_path(bound, (start, 20.0), goal=home, either_side=False)
    assert driven_nodes(bound, around) == [9, 2, 7, 10, 7, 8]
    others = shortest_path(bound, (edge_between(bound, 1, 2), 50.0), goal=home, either_side=False)
    assert driven_nodes(bound, others) == [1, 2, 7, 8]


def test_restriction_covers_all_its_ways_in_the_simplified_graph():
    places = {k: (10 * k, 0) for k in range(7)} | {20: (20, 50), 30: (30, 50), 50: (60, 50), 60: (60, -50)}
    ways = [
        ({}, [0, 1]),  # 100, joined with 101
        ({}, [1, 2, 3]),  # 101, cut at 2
        ({}, [3, 4]),  # 102
        ({}, [4, 6]),  # 103
        ({}, [2, 20]),
        ({}, [3, 30]),
        ({}, [6, 50]),  # 106
        ({}, [6, 60]),  # 107
    ]
    graph = graph_of(places, ways, (), [via_ways("no_left_turn", 100, [103, 101, 102], 106)])
    assert graph.osm_id[edge_between(graph, 0, 2)] == "way/100;way/101"
    expected = [edge_between(graph, *ends) for ends in ((0, 2), (2, 3), (3, 6), (6, 50))]
    assert [chain.tolist() for chain in graph.chain_edges] == [expected]
    goals = [(edge_between(graph, 6, n), 10.0) for n in (50, 60)]
    left, right = (shortest_path(graph, (expected[0], 5.0), goal=goal, either_side=False) for goal in goals)
    assert driven_nodes(graph, right) == [0, 2, 3, 6, 60]
    assert driven_nodes(graph, left) != [0, 2, 3, 6, 50]


@pytest.mark.parametrize(
    ("tags", "binds"),
    [
        ({"restriction": "no_left_turn"}, True),
        ({"restriction": "no_left_turn", "except": "psv"}, True),
        ({"restriction": "no_left_turn", "except": "bicycle; hgv"}, True),
        ({"restriction": "no_left_turn", "except": "psv; motorcar"}, False),
        ({"restriction": "no_left_turn", "except": "vehicle"}, False),
        ({"restriction:hgv": "no_left_turn"}, False),
        ({"restriction:hgv:conditional": "no_left_turn @ (22:00-06:00)"}, False),
        ({"restriction:bus": "no_left_turn"}, False),
        ({"type": "restriction:hgv", "restriction": "no_left_turn"}, False),
        ({"type": "restriction:motorcar", "restriction": "no_left_turn"}, True),
        ({"restriction:motorcar": "no_left_turn"}, True),
        ({"restriction:motor_vehicle": "no_left_turn"}, True),
        ({"restriction": "no_left_turn", "restriction:motorcar": "none"}, False),
        ({"restriction": "give_way"}, False),
    ],
)
@pytest.mark.parametrize("via", ["node", "way"])
def test_restrictions_for_other_vehicles_do_not_apply_to_cars(tags, binds, via):
    if via == "node":
        world = (CROSS, ARMS)
        members = (("way", 100, "from"), ("node", 1, "via"), ("way", 103, "to"))
    else:
        world = (DUAL, CARRIAGEWAYS)
        members = (("way", 100, "from"), ("way", 102, "via"), ("way", 101, "to"))
    osm = town(*world, (), [({"type": "restriction"} | tags, members)])
    graph, problems = build_road_graph(osm, FRAME)
    assert len(graph.turn_from) + len(graph.chain_edges) == binds
    assert not problems


@pytest.mark.parametrize(
    "tags",
    [
        {"restriction:conditional": "no_left_turn @ (Mo-Fr 07:00-09:00)"},
        {"restriction:motorcar:conditional": "no_left_turn @ (Mo-Fr 07:00-09:00)"},
        {"restriction": "no_left_turn", "hour_on": "07:00", "hour_off": "09:00"},
    ],
)
def test_time_dependent_restriction_is_ignored_and_reported(tags):
    members = (("way", 100, "from"), ("node", 1, "via"), ("way", 103, "to"))
    graph, problems = build_road_graph(
        town(CROSS, ARMS, (), [({"type": "restriction"} | tags, members)]), FRAME
    )
    assert not len(graph.turn_from)
    assert [(p.osm_id, p.kind, p.reason) for p in problems] == [("relation/0", "turn", "conditional")]


def test_restriction_on_ways_that_cannot_be_driven_is_reported():
    relations = [via_ways("no_u_turn", 101, [102], 100), via_ways("no_u_turn", 100, [999], 101)]
    graph, problems = build_road_graph(town(DUAL, CARRIAGEWAYS, (), relations), FRAME)
    assert not len(graph.chain_edges)
    assert [(p.osm_id, p.reason) for p in problems] == [("relation/0", "via-way")]


def obeys(edges, graph, pairs):
    """Whether a drive takes only permitted turns, checked for every part of it."""
    if any(turn not in pairs for turn in pairwise(edges)):
        return False
    only = {}
    for chain, kind in zip(graph.chain_edges, graph.chain_kind, strict=True):
        chain = tuple(chain.tolist())  # noqa: PLW2901
        for at in range(len(edges)):
            if kind.startswith("no_") and edges[at : at + len(chain)] == chain:
                return False
            if kind.startswith("only_"):
                for k in range(1, len(chain)):
                    if edges[at : at + k] == chain[:k] and at + k < len(edges):
                        only.setdefault((at, k), set()).add(chain[k])
    return all(edges[at + k] in onward for (at, k), onward in only.items())


@pytest.mark.full
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_turn_states_allow_exactly_the_legal_drives(data):
    square = {1: (0, 0), 2: (50, 0), 3: (50, 50), 4: (0, 50), 5: (90, 0)}
    base = graph_of(square, [({}, ends) for ends in ([1, 2], [2, 3], [3, 4], [4, 1], [1, 3], [2, 5])])
    before, after = turn_table(base, u_turns=True)
    onward = {e: after[before == e].tolist() for e in range(len(base))}
    chains = []
    for _ in range(data.draw(st.integers(1, 5))):
        chain = [data.draw(st.integers(0, len(base) - 1))]
        for _ in range(data.draw(st.integers(2, 4))):
            chain.append(data.draw(st.sampled_from(onward[chain[-1]])))
        chains.append(np.array(chain, np.int32))
    kinds = data.draw(st.lists(st.sampled_from(["no_u_turn", "only_straight_on"]), min_size=5, max_size=5))
    graph = replace(base, chain_edges=np.fromiter(chains, object), chain_kind=np.array(kinds[: len(chains)]))

    states = turn_states(graph, u_turns=True)
    np.testing.assert_array_equal(states.edge[: len(graph)], np.arange(len(graph)))
    drives = {(edge,): {edge} for edge in range(len(graph))}
    pairs = set(zip(before.tolist(), after.tolist(), strict=True))
    for _ in range(4):
        longer = {}
        for drive, at in drives.items():
            for state in states.after[np.isin(states.before, list(at))].tolist():
                longer.setdefault((*drive, int(states.edge[state])), set()).add(state)
        assert all(len(at) == 1 for at in longer.values())
        expected = {(*d, e) for d in drives for e in onward[d[-1]] if obeys((*d, e), graph, pairs)}
        assert set(longer) == expected
        drives = longer


def test_u_turns_are_allowed_only_at_dead_ends():
    graph = graph_of(CROSS, ARMS)
    before, after = turn_table(graph)
    rounds = before[graph.twin[before] == after]
    assert set(graph.node_id[graph.head[rounds]]) == {2, 3, 4, 5}
    assert len(turn_table(graph, u_turns=True)[0]) == len(before) + 4


def test_a_street_is_entered_on_either_side_and_a_one_way_street_never_driven_backwards():
    places = {1: (0, 0), 2: (100, 0), 3: (100, 100), 4: (0, 100)}
    graph = graph_of(places, [({"oneway": "yes"}, [1, 2, 3, 4, 1])])
    back = shortest_path(graph, (0, 60.0), goal=(0, 40.0))
    assert back.length == pytest.approx(380, abs=0.01)
    two_way = graph_of({1: (0, 0), 2: (100, 0)}, [({}, [1, 2])])
    path = shortest_path(two_way, (0, 60.0), goal=(0, 40.0))
    assert path.length == pytest.approx(20, abs=1e-3)
    np.testing.assert_allclose(path_line(two_way, path)[:, 0], [60, 40], atol=1e-3)


def test_fastest_and_shortest_routes_differ():
    places = {1: (0, 0), 2: (100, 0), 3: (50, 60)}
    slow, fast = {"maxspeed": "5"}, {"maxspeed": "100"}
    graph = graph_of(places, [(slow, [1, 2]), (fast, [1, 3, 2])])
    ends = [nearest_edge(graph, [[x, 0]]) for x in (-5, 105)]
    start, goal = ((int(e[0]), float(o[0])) for e, o, _ in ends)
    by_time = shortest_path(graph, start, goal=goal)
    by_length = shortest_path(graph, start, goal=goal, weight="length")
    assert by_time.length > 150 > by_length.length
    assert by_time.time < by_length.time


def test_signals_and_signs_apply_to_the_right_direction():
    places = CROSS | {7: (80, 0), 8: (-80, 0), 9: (0, 30)}
    ways = [
        ({}, [2, 7, 1]),
        ({}, [1, 9, 3]),
        ({"highway": "primary"}, [4, 8, 1]),
        ({"highway": "primary"}, [1, 5]),
    ]
    points = [
        (1, {"highway": "stop"}),
        (7, {"highway": "stop"}),
        (8, {"highway": "traffic_signals", "traffic_signals:direction": "backward"}),
        (9, {"highway": "crossing", "crossing": "traffic_signals"}),
    ]
    graph = graph_of(places, ways, points)
    told = {
        (int(graph.node_id[graph.tail[e]]), int(graph.node_id[graph.head[e]]), kind, round(float(o)))
        for e, o, kind in zip(graph.control_edge, graph.control_offset, graph.control_kind, strict=True)
    }
    assert told == {
        (2, 1, "stop", 100),  # at the junction: the residential arms stop, the primary ones do not
        (3, 1, "stop", 100),
        (1, 2, "stop", 80),  # 20 m before the end of the road: for those who go there
        (1, 4, "traffic_signals", 80),
        (1, 3, "traffic_signals", 30),
        (3, 1, "traffic_signals", 70),
        (1, 3, "crossing", 30),
        (3, 1, "crossing", 70),
    }
    assert graph.stop[graph.node_id == 1].all()


def test_the_main_network_is_strongly_connected():
    ways = [*ARMS, ({"oneway": "yes"}, [2, 6]), ({}, [7, 8])]
    graph = graph_of(CROSS | {6: (200, 0), 7: (900, 0), 8: (990, 0)}, ways)
    parts = find_components(graph)
    assert (parts.weak.max(), parts.strong.max()) == (1, 2)
    main = main_network(graph)
    assert set(main.node_id) == {1, 2, 3, 4, 5}
    assert find_components(main).largest_strong_share == 1.0
    assert (main.head[main.twin] == main.tail).all()


def test_true_lengths_do_not_depend_on_the_projection():
    osm = town(CROSS, ARMS)
    utm = Frame.at(10.0, 50.0, crs="utm")
    local_length = build_road_graph(osm, FRAME)[0].length
    np.testing.assert_allclose(build_road_graph(osm, utm)[0].length, local_length, rtol=1e-7)


def test_map_without_roads_gives_an_empty_graph_and_a_clear_error():
    graph, problems = build_road_graph(town({}, []), FRAME)
    assert (len(graph), len(graph.node_id), problems) == (0, 0, [])
    assert find_components(graph).largest_strong_share == 0.0
    with pytest.raises(InputError, match="no drivable roads"):
        nearest_edge(graph, [[0, 0]])


@st.composite
def maps(draw):
    """A random map of streets between a few nodes, some with negative ids."""
    ids = draw(st.lists(st.integers(-50, 50), min_size=2, max_size=12, unique=True))
    coordinate = st.integers(-500_000, 500_000).map(lambda mm: mm / 1000)
    places = {n: (draw(coordinate), draw(coordinate)) for n in ids}
    tags = st.sampled_from(
        [{}, {"oneway": "yes"}, {"oneway": "-1"}, {"name": 'Hell & <High> "Water" [ö]'}, {"bridge": "yes"},
         {"lanes": "3", "lanes:forward": "2"}, {"maxspeed": "30 mph"}, {"highway": "service"}]
    )  # fmt: skip
    ways = draw(
        st.lists(
            st.tuples(tags, st.lists(st.sampled_from(ids), min_size=1, max_size=8)), min_size=1, max_size=8
        )
    )
    points = [
        (n, {"highway": draw(st.sampled_from(["stop", "traffic_signals", "crossing"]))}) for n in ids[:2]
    ]
    return town(places, ways, points)


@pytest.mark.full
@settings(max_examples=60, deadline=None)
@given(maps())
def test_every_map_segment_is_in_the_graph_once_per_direction(osm):
    graph, _ = build_road_graph(osm, FRAME)
    full, _ = build_road_graph(osm, FRAME, options=RoadOptions(simplify=False))
    expected = []
    for way in osm.ways:
        street, _ = read_street(way.tags)
        steps = [(a, b) for a, b in pairwise(way.nodes.tolist()) if a != b]
        expected += steps if street.direction >= 0 else []
        expected += [(b, a) for a, b in steps] if street.direction <= 0 else []
    place = {
        tuple(np.round(xyz, 6)): n
        for n, xyz in zip(full.node_id.tolist(), full.node_xyz.tolist(), strict=True)
    }
    if len(place) == len(full.node_id):  # else two nodes share a place, and places do not tell them apart
        walked = [
            (place[tuple(np.round(a, 6))], place[tuple(np.round(b, 6))])
            for line in graph.geometry
            for a, b in pairwise(line.tolist())
        ]
        assert sorted(walked) == sorted(expected)
    two_way = np.flatnonzero(graph.twin >= 0)
    assert (graph.twin[graph.twin[two_way]] == two_way).all()
    assert (graph.oneway == (graph.twin < 0)).all()


@settings(max_examples=60, deadline=None)
@given(maps(), st.booleans())
def test_graphml_round_trip(tmp_path_factory, osm, tall):
    graph, _ = build_road_graph(osm, FRAME)
    if tall:
        lifted = [line + LIFT for line in graph.geometry]
        geometry = np.empty(len(graph), object)
        geometry[:] = lifted
        graph = type(graph)(
            **{f: getattr(graph, f) for f in graph.__dataclass_fields__}
            | {"geometry": geometry, "node_xyz": graph.node_xyz + LIFT}
        )
    path = tmp_path_factory.mktemp("graphml") / "roads.graphml"
    write_graphml(graph, FRAME, path=path)
    first = path.read_bytes()
    back = read_graphml(path, FRAME)
    for name in graph.__dataclass_fields__:
        one, two = getattr(graph, name), getattr(back, name)
        if name == "geometry":
            for a, b in zip(one, two, strict=True):
                np.testing.assert_allclose(a, b, atol=1e-4)
        elif one.dtype.kind == "f":
            np.testing.assert_allclose(one, two, atol=1e-4)
        else:
            assert one.tolist() == two.tolist(), name
    write_graphml(graph, FRAME, path=path)
    assert path.read_bytes() == first


def test_restrictions_via_ways_survive_graphml_and_a_cut(tmp_path):
    relations = [via_ways("no_u_turn", 100, [102], 101), via_ways("only_straight_on", 106, [102], 107)]
    graph = graph_of(DUAL, CARRIAGEWAYS, (), relations)
    write_graphml(graph, FRAME, path=tmp_path / "roads.graphml")
    back = read_graphml(tmp_path / "roads.graphml", FRAME)
    assert [c.tolist() for c in back.chain_edges] == [c.tolist() for c in graph.chain_edges]
    assert back.chain_kind.tolist() == ["no_u_turn", "only_straight_on"]
    link = edge_between(graph, 3, 6)
    cut = graph.take(np.arange(len(graph)) != link)
    assert [c.tolist() for c in cut.chain_edges] == [(c - (c > link)).tolist() for c in graph.chain_edges]
    assert len(graph.take(np.arange(len(graph)) != edge_between(graph, 7, 8)).chain_edges) == 1


def test_lines_of_graphml_are_read_in_blocks(monkeypatch, tmp_path):
    graph = graph_of(DUAL, CARRIAGEWAYS)
    write_graphml(graph, FRAME, path=tmp_path / "roads.graphml")
    whole = read_graphml(tmp_path / "roads.graphml", FRAME)
    sizes = []
    read = shapely.from_wkt
    monkeypatch.setattr(graphml, "_WKT_BLOCK", 3)
    monkeypatch.setattr(shapely, "from_wkt", lambda texts: sizes.append(len(texts)) or read(texts))
    parts = read_graphml(tmp_path / "roads.graphml", FRAME)
    assert sum(sizes) == len(graph) > max(sizes) == 3
    for one, two in zip(whole.geometry, parts.geometry, strict=True):
        np.testing.assert_array_equal(one, two)


def test_osmnx_reads_our_graphml(tmp_path):
    import osmnx as ox  # noqa: PLC0415  (slow to import)

    graph = graph_of(CROSS | {6: (0, 200)}, [*ARMS, ({"name": "A & B"}, [3, 6])])
    write_graphml(graph, FRAME, path=tmp_path / "roads.graphml")
    theirs = ox.load_graphml(tmp_path / "roads.graphml")
    assert len(theirs.edges) == len(graph)
    assert sum(d["length"] for _, _, d in theirs.edges(data=True)) == pytest.approx(
        graph.length.sum(), abs=1e-4
    )
    assert ox.basic_stats(theirs)["streets_per_node_counts"][4] == 1
    timed = ox.add_edge_travel_times(ox.add_edge_speeds(theirs))
    times = sum(d["travel_time"] for _, _, d in timed.edges(data=True))
    assert times == pytest.approx(graph.travel_time.sum(), rel=1e-6)
    assert ox.shortest_path(theirs, 2, 6) == [2, 1, 3, 6]


def test_file_without_a_road_graph_is_refused(tmp_path):
    path = tmp_path / "roads.graphml"
    for text in ("not xml", "<graphml><graph><node id='1'/></graph></graphml>"):
        path.write_text(text)
        with pytest.raises(SceneFormatError, match=r"roads\.graphml: damaged"):
            read_graphml(path, FRAME)


def test_private_roads_are_left_out_by_default():
    assert not drivable({"highway": "service", "access": "private"})
    assert drivable({"highway": "service", "access": "private"}, private=True)
    assert not drivable({"highway": "track"})


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "share"),
    [("monaco.osm.pbf", 0.85), ("norfolk_odu_roads.osm.gz", 0.95), ("liechtenstein.osm.pbf", 0.97)],
)
def test_road_graphs_of_real_places_are_connected(shared_osm, name, share):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    graph, _ = build_road_graph(osm, frame)
    full, _ = build_road_graph(osm, frame, options=RoadOptions(simplify=False))
    # Lines beside the map's (`placement`, five ways in Monaco) are mitred within edges, not between them.
    assert full.length.sum() == pytest.approx(graph.length.sum(), rel=1e-4)
    assert find_components(graph).largest_strong_share > share
    main = main_network(graph)
    rng = np.random.default_rng(0)
    edges, offsets, distance = nearest_edge(main, main.node_xyz[rng.integers(0, len(main.node_id), 20), :2])
    assert distance.max() < 1e-6
    lines = edge_lines(main)
    for (e, o), (g, p) in pairwise(zip(edges.tolist(), offsets.tolist(), strict=True)):
        path = shortest_path(main, (e, o), goal=(g, p))
        if path is None:  # a turn restriction may shut in what one-way streets leave open
            continue
        assert (main.head[path.edges[:-1]] == main.tail[path.edges[1:]]).all()
        plan = np.hypot(*np.diff(path_line(main, path)[:, :2], axis=0).T).sum()
        assert plan == pytest.approx(path.length, rel=1e-5, abs=0.5)  # a step where `placement` begins
    assert len(lines) == len(main)
