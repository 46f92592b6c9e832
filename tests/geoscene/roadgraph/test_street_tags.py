"""Tags of streets: lanes one by one, placement, directions, limits, lists of values, and signals."""

import numpy as np
import pytest
import shapely

from geoscene.geometry.frames import Frame
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.roadgraph import RoadOptions, build_road_graph, profile
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.lanes import graph_lanes
from geoscene.roadgraph.markings import _offsets, painted_stretches
from geoscene.roadgraph.surfaces import SurfaceOptions, road_surfaces
from geoscene.roadgraph.tags import drivable, read_street
from geoscene.sources.data import OsmData, TaggedNode, Way
from lidar.motion.route import lane_route
from lidar.traffic.lanes import lanes_of, random_lanes

FRAME = Frame.at(10.0, 50.0)
ROAD = {"highway": "secondary"}
LANE = 3.25
PLACES = {1: (-100.0, 0.0), 2: (0.0, 0.0), 3: (100.0, 0.0), 4: (0.0, 100.0), 5: (0.0, -100.0)}
LINE = (1, 2, 3)


def extract(*ways, points=()):
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in PLACES.items()}
    return OsmData(
        bounds=(9.998, 49.998, 10.002, 50.002),
        ways=[
            Way(f"way/{k}", tags, np.array(nodes), np.array([lonlat[n] for n in nodes]))
            for k, (tags, nodes) in enumerate(ways)
        ],
        areas=[],
        points=[TaggedNode(f"node/{n}", tags, *lonlat[n]) for n, tags in points],
        relations=[],
    )


def graph_of(*ways, left_hand=False, points=()):
    return build_road_graph(extract(*ways, points=points), FRAME, options=RoadOptions(left_hand=left_hand))


def driven(graph, *, left_hand=False, edge=0):
    """Metres left of the mapped line, as seen along it, that a car drives on an edge, in its middle."""
    side = "left" if left_hand else "right"
    line = lane_route(graph, [edge], ends=(0.0, float(graph.length[edge])), side=side).line
    return float(np.interp(50.0, *line[np.argsort(line[:, 0])].T[:2]))


@pytest.mark.parametrize("left_hand", [False, True])
@pytest.mark.parametrize(
    "tags",
    [
        {"oneway": "yes", "oneway:bus": "no", "lanes:forward": "2", "lanes:backward": "1"},
        {"oneway": "yes", "oneway:psv": "no", "lanes:forward": "2"},
        {"oneway": "yes", "lanes:bus:backward": "1"},
        {"oneway": "yes", "busway:left": "opposite_lane"},
        {"oneway": "-1", "oneway:bus": "no", "lanes:forward": "1", "lanes:backward": "2"},
        {"oneway": "-1", "lanes:psv:forward": "1"},
    ],
)
def test_a_bus_lane_against_a_one_way_street_is_no_lane_for_cars(tags, left_hand):
    graph, problems = graph_of((ROAD | {"lanes": "3"} | tags, LINE), left_hand=left_hand)
    assert not problems
    assert len(graph) == 1
    assert (graph.lanes[0], graph.contraflow[0], graph.width[0]) == (2.0, 1.0, 3 * LANE)
    layout = graph_lanes(graph, left_hand=left_hand)
    assert (layout.own[0], layout.other[0]) == (2, 1)
    assert layout.closed[0].tolist() == [False, False, True]
    along = 1 if tags["oneway"] == "yes" else -1
    kept = 1 if left_hand else -1
    assert driven(graph, left_hand=left_hand) == pytest.approx(along * kept * LANE, abs=1e-3)


def paint_of(tags, *, left_hand=False):
    osm = extract((ROAD | {"sidewalk": "both"} | tags, LINE))
    roads = read_carriageways(osm, FRAME, sidewalks="mapped", left_hand=left_hand)
    stretches = painted_stretches(roads, left_hand=left_hand)
    _, aside, style, kind = _offsets(roads, stretches, left_hand=left_hand)
    return sorted(zip(aside.tolist(), style.tolist(), kind.tolist(), strict=True))


def test_a_bus_lane_against_a_one_way_street_is_painted_apart():
    tags = {"oneway": "yes", "oneway:bus": "no", "lanes": "3", "lanes:forward": "2", "lanes:backward": "1"}
    (broken, solid) = paint_of(tags)
    assert broken == (pytest.approx(-LANE / 2), 1, "")
    assert solid == (pytest.approx(LANE / 2), 0, "")
    osm = extract((ROAD | tags, LINE))
    rows = road_surfaces(osm, build_road_graph(osm, FRAME)[0], frame=FRAME)
    words = shapely.get_coordinates(shapely.centroid(rows.polygon[rows.source == "busway/default"]))
    assert len(words)
    assert words[:, 1].mean() == pytest.approx(LANE, abs=0.05)
    assert np.abs(words[:, 1] - LANE).max() < LANE / 2


@pytest.mark.parametrize(
    ("lists", "left_hand", "place"),
    [
        ({"bus:lanes": "yes|yes|designated", "vehicle:lanes": "yes|yes|no"}, False, 0.0),
        ({"psv:lanes": "||designated"}, False, 0.0),
        ({"access:lanes": "yes|yes|no"}, False, 0.0),
        ({"motor_vehicle:lanes": "yes|no|no"}, False, LANE),
        ({"bus:lanes": "designated|yes|yes"}, False, -LANE),
        ({"lanes:bus": "1"}, False, 0.0),
        ({"busway": "lane"}, False, 0.0),
        ({"bus:lanes": "designated|yes|yes", "vehicle:lanes": "no|yes|yes"}, True, 0.0),
        ({"lanes:psv": "1"}, True, 0.0),
        ({"vehicle:lanes": "yes|yes|no"}, True, LANE),
    ],
)
def test_cars_keep_out_of_lanes_that_are_not_for_them(lists, left_hand, place):
    graph, problems = graph_of((ROAD | {"oneway": "yes", "lanes": "3"} | lists, LINE), left_hand=left_hand)
    assert not problems
    assert driven(graph, left_hand=left_hand) == pytest.approx(place, abs=1e-3)
    lanes = lanes_of(graph, side="left" if left_hand else "right")
    layout = graph_lanes(graph, left_hand=left_hand)
    rng = np.random.default_rng(1)
    inside = np.ones(len(graph), bool)
    for lane in range(3):
        _, picked = random_lanes(
            lanes, rng, edge=0, lane=lane, metres=50.0, inside=inside, width=1.8, any_kind=False
        )
        assert picked == [lane]  # where a drive begins is up to its caller
    assert layout.closed[0].any()


def test_traffic_leaves_lanes_that_become_bus_lanes():
    bus = {"oneway": "yes", "lanes": "3", "bus:lanes": "yes|yes|designated"}
    graph, _ = graph_of((ROAD | {"oneway": "yes", "lanes": "3"}, (1, 2)), (ROAD | bus, (2, 3)))
    lanes, rng = lanes_of(graph), np.random.default_rng(1)
    inside = np.ones(len(graph), bool)
    for lane, wanted in ((0, 1), (1, 1), (2, 2)):
        _, picked = random_lanes(lanes, rng, edge=0, lane=lane, metres=150.0, inside=inside, width=1.8)
        assert picked == [lane, wanted]
    _, picked = random_lanes(
        lanes, rng, edge=0, lane=0, metres=150.0, inside=inside, width=0.6, any_kind=True
    )
    assert picked == [0, 0]


def test_bus_lanes_of_both_directions_are_their_outer_ones():
    both = {"lanes": "4", "bus:lanes:forward": "yes|designated", "bus:lanes:backward": "yes|designated"}
    graph, problems = graph_of((ROAD | both, LINE))
    assert not problems
    assert graph.lane_kinds.tolist() == ["driving|bus"] * 2
    assert driven(graph) == pytest.approx(-LANE / 2, abs=1e-3)
    assert driven(graph, edge=1) == pytest.approx(LANE / 2, abs=1e-3)


def test_cycle_lanes_among_the_lanes_are_not_driven_on():
    lists = {
        "oneway": "yes",
        "lanes": "3",
        "access:lanes": "yes|yes|no|yes",
        "bicycle:lanes": "yes|yes|designated|yes",
        "width:lanes": "3.5|3.5|1.5|3",
        "turn:lanes": "through|through|through|right",
        "cycleway:right": "lane",
    }
    graph, problems = graph_of((ROAD | lists, LINE))
    assert not problems
    assert graph.lane_kinds.tolist() == ["driving|driving|biking|driving"]
    assert graph.lanes.tolist() == [3.0]
    assert graph.width.tolist() == [11.5]
    assert driven(graph) == pytest.approx(-5.75 + 1.5, abs=1e-3)
    fourfold = paint_of(lists)
    assert [place for place, *_ in fourfold] == pytest.approx([-2.75, -1.25, 2.25])
    assert [kind for *_, kind in fourfold] == ["cycleway", "cycleway", ""]


LEFT, RIGHT = 1.5 * LANE, -1.5 * LANE


@pytest.mark.parametrize(
    ("tags", "left_hand", "middle"),
    [
        # three lanes one way: the middle of the carriageway, left of the line
        ({"oneway": "yes", "lanes": "3", "placement": "left_of:1"}, False, RIGHT),
        ({"oneway": "yes", "lanes": "3", "placement": "right_of:3"}, False, LEFT),
        ({"oneway": "yes", "lanes": "3", "placement": "middle_of:1"}, False, -LANE),
        ({"oneway": "yes", "lanes": "3", "placement": "middle_of:2"}, False, 0.0),
        ({"oneway": "yes", "lanes": "3", "placement": "right_of:1"}, False, -LANE / 2),
        ({"oneway": "yes", "lanes": "3", "placement": "left_of:1"}, True, RIGHT),
        ({"oneway": "yes", "lanes": "3", "placement": "right_of:3"}, True, LEFT),
        ({"oneway": "yes", "lanes": "3", "placement:forward": "left_of:1"}, False, RIGHT),
        ({"oneway": "-1", "lanes": "3", "placement": "left_of:1"}, False, LEFT),
        ({"oneway": "-1", "lanes": "3", "placement:backward": "right_of:3"}, False, RIGHT),
        # two lanes ahead, one back
        ({"lanes": "3", "lanes:forward": "2", "placement:forward": "left_of:1"}, False, -LANE / 2),
        ({"lanes": "3", "lanes:forward": "2", "placement": "right_of:2"}, False, LEFT),
        ({"lanes": "3", "lanes:forward": "2", "placement:backward": "left_of:1"}, False, -LANE / 2),
        ({"lanes": "3", "lanes:forward": "2", "placement:backward": "right_of:1"}, False, RIGHT),
        ({"lanes": "3", "lanes:forward": "2", "placement:forward": "left_of:1"}, True, RIGHT),
        ({"lanes": "3", "lanes:forward": "2", "placement:backward": "right_of:1"}, True, LANE / 2),
        ({"oneway": "yes", "lanes": "2", "width:lanes": "3|4", "placement": "right_of:1"}, False, -0.5),
    ],
)
def test_placement_says_where_the_line_of_a_way_lies(tags, left_hand, middle):
    osm = extract((ROAD | tags, LINE))
    graph, problems = graph_of((ROAD | tags, LINE), left_hand=left_hand)
    assert not problems
    for line in graph.geometry:
        np.testing.assert_allclose(line[:, 1], middle, atol=0.01)
    roads = read_carriageways(osm, FRAME, sidewalks="mapped", left_hand=left_hand)
    np.testing.assert_allclose(shapely.get_coordinates(roads.line[0])[:, 1], middle, atol=0.01)
    rows = road_surfaces(
        osm, graph, frame=FRAME, options=SurfaceOptions(left_hand=left_hand, sidewalks="mapped")
    )
    road = shapely.union_all(rows.polygon[(rows.priority >= 130) & (rows.priority < 150)])
    half = graph.width[0] / 2
    assert road.bounds[1::2] == pytest.approx((middle - half, middle + half), abs=0.01)
    assert (rows.edge[rows.priority == 170] >= 0).all()
    high = profile(graph, lambda x, _y: 0.05 * x)
    np.testing.assert_allclose(high.geometry[0][:, 1], middle, atol=0.01)


@pytest.mark.parametrize(
    "tags",
    [
        {"placement": "transition", "placement:start": "left_of:1", "placement:end": "right_of:3"},
        {"placement:start": "left_of:1", "placement:end": "right_of:3"},
    ],
)
def test_a_transition_moves_from_one_place_to_the_other(tags):
    graph, problems = graph_of((ROAD | {"oneway": "yes", "lanes": "3"} | tags, LINE))
    assert not problems
    np.testing.assert_allclose(graph.geometry[0][:, 1], [RIGHT, 0.0, LEFT], atol=0.02)


def test_a_transition_leads_from_the_place_before_to_the_place_after():
    road = ROAD | {"oneway": "yes", "lanes": "3"}
    before, between = road | {"placement": "left_of:1"}, road | {"placement": "transition"}
    graph, problems = graph_of((before, (1, 2)), (between, (2, 3)))
    assert not problems
    found = {str(name): line for name, line in zip(graph.osm_id, graph.geometry, strict=True)}
    np.testing.assert_allclose(found["way/0"][:, 1], RIGHT, atol=1e-6)
    np.testing.assert_allclose(found["way/1"][:, 1], [RIGHT, 0.0], atol=0.2)
    # The way after a reversed one is seen the other way round.
    turned, _ = graph_of((road | {"oneway": "-1", "placement": "left_of:1"}, (2, 1)), (between, (2, 3)))
    found = {str(name): line for name, line in zip(turned.osm_id, turned.geometry, strict=True)}
    np.testing.assert_allclose(found["way/1"][0, 1], RIGHT, atol=0.2)


def test_lanes_in_line_stay_in_line_where_a_lane_is_added():
    one, two = {"lanes": "1", "placement": "left_of:1"}, {"lanes": "2", "placement": "left_of:1"}
    road = ROAD | {"oneway": "yes"}
    graph, _ = graph_of((road | one, (1, 2)), (road | two | {"turn:lanes": "through|"}, (2, 3)))
    line = lane_route(graph, [0, 1], ends=(0.0, 100.0)).line
    assert line[0, 1] == pytest.approx(-LANE / 2, abs=0.01)
    assert line[-1, 1] == pytest.approx(-1.5 * LANE, abs=0.01)


@pytest.mark.parametrize("value", ["left_of:4", "left_of:0", "above:1", "left_of", "right_of:x"])
def test_a_placement_that_cannot_be_is_reported(value):
    graph, problems = graph_of((ROAD | {"oneway": "yes", "lanes": "3", "placement": value}, LINE))
    assert [(p.action, p.reason) for p in problems] == [("repaired", "unreadable-tag")]
    assert value in problems[0].detail
    np.testing.assert_allclose(graph.geometry[0][:, 1], 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("tags", "width", "middles"),
    [
        ({"oneway": "yes", "lanes": "3", "width:lanes": "3|3|2.5"}, 8.5, [2.75, -0.25, -3.0]),
        ({"oneway": "yes", "width:lanes": "3|3|2.5"}, 8.5, [2.75, -0.25, -3.0]),
        ({"oneway": "yes", "lanes": "2", "width:lanes": "3|"}, 6.25, [1.625, -1.5]),
        ({"oneway": "-1", "lanes": "2", "width:lanes": "3|4"}, 7.0, [2.0, -1.5]),
        ({"oneway": "yes", "lanes": "2", "width:lanes": "3|4", "width": "9"}, 9.0, [2.0, -1.5]),
        ({"lanes": "3", "lanes:forward": "2", "width:lanes:forward": "3|4"}, 10.25, [0.375, -3.125]),
        ({"lanes": "2", "width:lanes:forward": "3", "width:lanes:backward": "4"}, 7.0, [-2.0]),
        ({"lanes": "2", "width:lanes": "4|3"}, 7.0, [-2.0]),
        ({"lanes": "2", "width:lanes": "12'|10'"}, 22 * 0.3048, [-1.8288]),
    ],
)
def test_lanes_have_their_mapped_widths(tags, width, middles):
    graph, problems = graph_of((ROAD | tags, LINE))
    assert not problems
    assert graph.width[0] == pytest.approx(width)
    layout = graph_lanes(graph, left_hand=False).take([0])
    lanes = [-layout.offsets(k, body_width=1.0, clearance=0.0)[0] for k in range(int(layout.own[0]))]
    assert lanes[::-1] == pytest.approx(middles)


def test_widths_of_lanes_that_are_not_there_are_reported():
    for value in ("3|3", "3|x|3", "3|99|3"):
        graph, problems = graph_of((ROAD | {"oneway": "yes", "lanes": "3", "width:lanes": value}, LINE))
        assert [p.reason for p in problems] == ["unreadable-tag"]
        assert graph.width[0] == pytest.approx({"3|3": 9.75}.get(value, 9.25))


@pytest.mark.parametrize("value", ["F", "maybe", "yes please"])
def test_an_unreadable_direction_is_reported(value):
    graph, problems = graph_of((ROAD | {"oneway": value}, LINE))
    assert len(graph) == 2
    assert [(p.reason, p.detail) for p in problems] == [("unreadable-tag", f"oneway={value}")]


def test_directions_are_read_in_any_case_and_for_cars_first():
    assert len(graph_of((ROAD | {"oneway": "Yes"}, LINE))[0]) == 1
    assert len(graph_of((ROAD | {"oneway": "yes", "oneway:motor_vehicle": "no"}, LINE))[0]) == 2
    assert len(graph_of((ROAD | {"oneway": "no", "oneway:motorcar": "yes"}, LINE))[0]) == 1
    motorway, problems = graph_of(({"highway": "motorway", "oneway": "F"}, LINE))
    assert len(motorway) == 1
    assert len(problems) == 1


@pytest.mark.parametrize(
    ("tags", "kmh", "source"),
    [
        ({"maxspeed": "none"}, 130, "maxspeed"),
        ({"maxspeed:lanes": "100|80|60"}, 100, "maxspeed"),
        ({"maxspeed:lanes": "none|80"}, 130, "maxspeed"),
        ({"maxspeed:lanes": "|40 mph"}, 64.37376, "maxspeed"),
        ({"maxspeed": "70", "maxspeed:lanes": "100|80"}, 70, "maxspeed"),
        ({"maxspeed:lanes:forward": "60|50"}, 60, "maxspeed"),
        ({"zone:maxspeed": "DE:30"}, 30, "zone"),
        ({"zone:maxspeed": "30"}, 30, "zone"),
        ({"zone:maxspeed": "DE:zone:20"}, 20, "zone"),
        ({"zone:maxspeed": "GB:20"}, 32.18688, "zone"),
        ({"source:maxspeed": "DE:urban"}, 50, "zone"),
        ({"source:maxspeed": "FR:zone30"}, 30, "zone"),
        ({"maxspeed:type": "GB:nsl_single", "maxspeed": "national"}, 96.56064, "zone"),
        ({"maxspeed:type": "AT:rural"}, 100, "zone"),
        ({"maxspeed": "walk"}, 7, "maxspeed"),
        ({"maxspeed": "DE:walk"}, 7, "zone"),
        ({"maxspeed": "25 mph"}, 40.2336, "maxspeed"),
        ({"source:maxspeed": "sign"}, 50, "default"),
    ],
)
def test_limits_are_read_from_the_tags_that_mappers_use(tags, kmh, source):
    graph, problems = graph_of((ROAD | tags, LINE))
    assert graph.speed[0] * 3.6 == pytest.approx(kmh)
    assert graph.speed_source[0] == source
    assert not problems


@pytest.mark.parametrize(
    "tags",
    [
        {"maxspeed": "signals"},
        {"maxspeed": "fast"},
        {"maxspeed": "national"},
        {"maxspeed:type": "XX:nowhere"},
        {"maxspeed:lanes": "a|b"},
        {"zone:maxspeed": "slow"},
        {"maxspeed:backward": "slow"},
    ],
)
def test_limits_without_a_number_are_reported(tags):
    graph, problems = graph_of((ROAD | tags, LINE))
    assert graph.speed[0] * 3.6 == pytest.approx(50)
    assert [p.reason for p in problems] == ["unreadable-tag"]
    assert next(iter(tags.items()))[1] in problems[0].detail


@pytest.mark.parametrize(
    ("tags", "expected", "taken"),
    [
        ({"highway": "tertiary;residential"}, {"highway": "tertiary"}, "tertiary"),
        ({"highway": "residential; tertiary"}, {"highway": "tertiary"}, "tertiary"),
        ({"highway": "footway;service"}, {"highway": "service"}, "service"),
        ({"lanes": "2;3"}, {"lanes": (1.0, 1.0)}, "2"),
        ({"maxspeed": "50;30"}, {"speed": (30 / 3.6, 30 / 3.6)}, "30 km/h"),
        ({"oneway": "yes;no"}, {"direction": 1}, "yes"),
        ({"oneway": "yes; no"}, {"direction": 1}, "yes"),
    ],
)
def test_of_several_values_one_is_taken_and_reported(tags, expected, taken):
    tags = ROAD | tags
    assert drivable(tags)
    street, remarks = read_street(tags)
    for name, value in expected.items():
        assert getattr(street, name) == pytest.approx(value) if name == "speed" else value
    assert [reason for reason, _ in remarks] == ["several-values"]
    assert remarks[0][1].endswith(f": {taken} is taken")


def test_of_several_surfaces_the_first_is_taken_and_reported():
    tags = ROAD | {"surface": "gravel;asphalt"}
    _, problems = graph_of((tags, LINE))
    assert [p.detail for p in problems] == ["surface=gravel;asphalt: gravel is taken"]
    roads = read_carriageways(extract((tags, LINE)), FRAME, sidewalks="mapped", left_hand=False)
    assert roads.material.tolist() == ["gravel"]


def test_a_list_of_no_known_classes_is_no_road():
    assert not drivable({"highway": "footway;path"})
    assert not drivable({"highway": "track;path"})
    assert drivable({"highway": "track;path"}, private=True)


@pytest.mark.parametrize("kind", ["traffic_signals", "stop", "give_way"])
@pytest.mark.parametrize(("oneway", "direction"), [("-1", "forward"), ("yes", "backward")])
def test_a_control_against_a_one_way_street_controls_its_traffic(kind, oneway, direction):
    tags = {"highway": kind, f"{kind}:direction": direction}
    ways = ((ROAD | {"oneway": oneway}, (1, 2, 3)), (ROAD, (4, 3)), (ROAD, (1, 5)))
    graph, problems = graph_of(*ways, points=[(2, tags)])
    assert graph.control_kind.tolist() == [kind]
    assert graph.oneway[graph.control_edge[0]]
    assert [(p.osm_id, p.action, p.reason) for p in problems] == [("node/2", "repaired", "direction")]


def test_a_control_at_the_first_node_of_a_way_for_those_who_leave_it_is_reported():
    tags = {"highway": "stop", "direction": "forward"}
    graph, problems = graph_of((ROAD, LINE), points=[(1, tags)])
    assert not len(graph.control_kind)
    assert [(p.osm_id, p.action, p.reason) for p in problems] == [("node/1", "dropped", "direction")]


def test_a_node_of_two_kinds_controls_by_both():
    graph, _ = graph_of((ROAD, LINE), points=[(2, {"highway": "crossing;traffic_signals"})])
    assert sorted(graph.control_kind.tolist()) == ["crossing"] * 2 + ["traffic_signals"] * 2


def test_inclines_of_maps_without_heights_are_reported(tmp_path):
    steep, up, path = (
        (ROAD | {"incline": "10%"}, (1, 2)),
        (ROAD | {"incline": "up"}, (2, 3)),
        ({"highway": "footway", "incline": "12%"}, (2, 4)),
    )
    osm = extract(steep, up, path, ({"highway": "service", "incline": "-8 %"}, (2, 5)))
    build(osm, tmp_path / "scene", options=BuildOptions(relief="off"))
    rows = [
        line for line in (tmp_path / "scene" / "problems.csv").read_text().splitlines() if "incline" in line
    ]
    assert [row.split(",")[0] for row in rows] == ["way/0", "way/3"]
    assert "incline=10%" in rows[0]
