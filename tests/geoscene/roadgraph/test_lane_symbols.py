"""Arrows, bicycles, BUS and limits lie on the lanes that their tags name, and point where traffic goes."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.lane_uses import NO_USES, read_lane_uses
from geoscene.roadgraph.surfaces import SurfaceOptions, road_surfaces
from geoscene.roadgraph.symbols import _STROKES, ARROW, arrow, bicycle, word
from geoscene.roadgraph.tags import read_street
from geoscene.sources.data import OsmData, Way

FRAME = Frame.at(10.0, 50.0)
PAINT = materials()["lane_paint"].code
TURNS = ("left", "slight_left", "sharp_left", "through", "right", "slight_right", "sharp_right", "reverse")
ROAD = {"highway": "primary", "sidewalk": "both"}
SIDE_STREET = {"highway": "residential", "sidewalk": "both"}
PLACES = {1: (0, 0), 2: (120, 0), 3: (0, 100), 4: (-120, 0)}


def paint(tags, *, left_hand=False, nodes=(4, 1), others=()):
    """Polygons of a road's own symbols and lines by the tag they are from; the road ends at a junction."""
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in PLACES.items()}
    ways = [(ROAD | tags, nodes), (SIDE_STREET, [1, 3]), (ROAD, [1, 2]), *others]
    osm = OsmData(
        bounds=(9.9, 49.9, 10.1, 50.1),
        ways=[
            Way(f"way/{k}", tags, np.array(own), np.array([lonlat[n] for n in own]))
            for k, (tags, own) in enumerate(ways)
        ],
        areas=[],
        points=[],
        relations=[],
    )
    graph, problems = build_road_graph(osm, FRAME)
    rows = road_surfaces(osm, graph, frame=FRAME, options=SurfaceOptions(left_hand=left_hand))
    own = (rows.osm_id == "way/0") & (rows.klass == Class.LANE_MARKING)
    assert (rows.material[own] == PAINT).all()
    kind = [source.split("/")[0] for source in rows.source[own].tolist()]
    return {name: rows.polygon[own][np.array(kind) == name] for name in set(kind)}, problems


def middles(shapes):
    return shapely.get_coordinates(shapely.centroid(shapes))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.sampled_from(TURNS), min_size=1, max_size=3, unique=True), st.booleans())
def test_arrows_are_one_piece_that_fits_a_narrow_lane(turns, left_hand):
    shape = arrow(tuple(turns), left_hand=left_hand)
    assert shape.geom_type == "Polygon"
    assert shape.is_valid
    low, right, high, left = shape.bounds
    assert low >= 0
    assert 0.75 * ARROW < high <= ARROW + 0.1
    assert max(left, -right) < 1.25
    assert (left > 0.4) == any("left" in t or (t == "reverse" and not left_hand) for t in turns)
    assert (-right > 0.4) == any("right" in t or (t == "reverse" and left_hand) for t in turns)


def test_left_and_right_arrows_mirror_each_other():
    for name in ("", "slight_", "sharp_"):
        mirrored = shapely.transform(arrow((f"{name}right",)), lambda uv: uv * [1, -1])
        assert shapely.symmetric_difference(mirrored, arrow((f"{name}left",))).area < 1e-9


def test_letters_are_as_tall_as_each_other_and_apart():
    for letter in _STROKES:
        shape = word(letter)
        assert shape.is_valid
        assert shape.bounds[2] == pytest.approx(1.9, abs=0.12)
    assert shapely.get_num_geometries(word("BUS")) == 3
    assert word("30").bounds[3] == pytest.approx(-word("30").bounds[1], abs=0.05)


def test_a_bicycle_fits_a_cycle_lane():
    across = bicycle().bounds[3] - bicycle().bounds[1]
    assert across < 1.3
    assert bicycle(chevrons=True).bounds[2] > bicycle().bounds[2] + 1.0


@pytest.mark.parametrize("left_hand", [False, True])
def test_arrows_lie_on_their_lanes_before_the_junction(left_hand):
    tags = {"oneway": "yes", "lanes": "3", "turn:lanes": "left|through|right"}
    found, problems = paint(tags, left_hand=left_hand)
    arrows = found["turn"]
    assert len(arrows) == 9  # three rows
    x, y = middles(arrows).T
    assert x.max() < -6
    assert (x > -70).all()
    first = arrows[np.argsort(-x)[:3]]
    first = first[np.argsort(-middles(first)[:, 1])]  # from the left lane to the right one
    heads = np.array([shape.bounds[1] + shape.bounds[3] for shape in first]) / 2
    np.testing.assert_allclose(heads, [3.5 + 0.44, 0, -3.5 - 0.44], atol=0.1)
    assert not problems
    assert (np.diff(np.sort(np.unique(np.round(y, 1)))) > 0.5).sum() == 2


def test_arrows_against_the_way_point_against_it():
    tags = {"lanes": "3", "lanes:backward": "2", "lanes:forward": "1", "turn:lanes:backward": "left|through"}
    found, _ = paint(tags, nodes=(1, 4))
    arrows = found["turn"]
    assert (middles(arrows)[:, 1] < 0.3).all()  # traffic to the east keeps to the south
    for shape in arrows:
        xy = shapely.get_coordinates(shape)
        assert np.ptp(xy[xy[:, 0] < shape.bounds[0] + 1, 1]) < 0.2  # the stem comes first


def test_arrows_that_do_not_fit_the_lanes_are_reported_and_not_painted():
    found, problems = paint({"oneway": "yes", "lanes": "2", "turn:lanes": "left|through|right"})
    assert "turn" not in found
    assert [p.detail for p in problems] == [
        "turn:lanes=left|through|right: arrows of 3 lanes where there are 2"
    ]


def test_symbols_keep_clear_of_stop_lines_and_of_each_other():
    tags = {"oneway": "yes", "lanes": "2", "turn:lanes": "left|through", "busway:right": "lane"}
    found, _ = paint(tags | {"maxspeed": "30", "source:maxspeed": "markings", "cycleway": "shared_lane"})
    shapes = np.concatenate([found[name] for name in ("turn", "maxspeed")])
    words = shapely.union_all(found["busway"][shapely.area(found["busway"]) < 2])
    every = [*shapes, *shapely.get_parts(words)]
    tree = shapely.STRtree(every)
    a, b = tree.query(every, predicate="intersects")
    assert (a == b).all()
    # BUS is on the right lane, the limit on the left one.
    assert shapely.centroid(words).y < 0
    assert (middles(found["maxspeed"])[:, 1] > 0).all()


@pytest.mark.parametrize(("left_hand", "side"), [(False, -1), (True, 1)])
def test_cycle_lanes_of_one_way_streets_are_where_traffic_keeps_to(left_hand, side):
    found, _ = paint({"oneway": "yes", "cycleway": "lane"}, left_hand=left_hand)
    lines = found["cycleway"][shapely.length(found["cycleway"]) > 50]
    assert len(lines) == 1
    width = 4.0 + 1.6
    assert middles(lines)[0, 1] == pytest.approx(side * (width / 2 - 1.6), abs=0.01)
    marks = shapely.union_all(found["cycleway"][shapely.length(found["cycleway"]) < 50])
    assert shapely.centroid(marks).y == pytest.approx(side * (width / 2 - 0.8), abs=0.1)


@pytest.mark.parametrize("left_hand", [False, True])
def test_arrows_do_not_lie_on_cycle_lanes(left_hand):
    tags = {"lanes": "4", "turn:lanes:forward": "left|through;right", "cycleway:both": "lane"}
    found, _ = paint(tags, left_hand=left_hand)
    width = 4 * 3.5 + 2 * 1.6
    cycle_line = width / 2 - 1.6
    assert len(found["turn"]) == 6
    reach = [max(abs(shape.bounds[1]), abs(shape.bounds[3])) for shape in found["turn"]]
    assert max(reach) < cycle_line


def test_advisory_cycle_lanes_have_broken_lines():
    found, _ = paint({"cycleway:both": "lane", "cycleway:both:lane": "advisory"})
    assert np.median(shapely.area(found["cycleway"])) == pytest.approx(0.12, abs=0.01)


def test_lanes_for_buses_have_wide_solid_borders():
    found, _ = paint({"oneway": "yes", "lanes": "3", "bus:lanes": "||designated"})
    line = found["busway"][np.argmax(shapely.area(found["busway"]))]
    assert middles([line])[0, 1] == pytest.approx(-1.75, abs=0.01)
    assert line.bounds[3] - line.bounds[1] == pytest.approx(0.25, abs=0.001)


def test_limits_of_zones_are_painted_where_the_zone_begins():
    zone = {"highway": "residential", "maxspeed": "30", "maxspeed:type": "DE:zone30", "sidewalk": "both"}
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in (PLACES | {5: (240, 0)}).items()}
    ways = [({"highway": "primary"}, [4, 1]), (zone, [1, 2]), (zone, [2, 5]), (zone, [2, 3])]
    osm = OsmData(
        (9.9, 49.9, 10.1, 50.1),
        [Way(f"way/{k}", t, np.array(n), np.array([lonlat[i] for i in n])) for k, (t, n) in enumerate(ways)],
        [], [], [],
    )  # fmt: skip
    graph, _ = build_road_graph(osm, FRAME)
    rows = road_surfaces(osm, graph, frame=FRAME)
    limits = rows.polygon[rows.source == "maxspeed/default"]
    assert len(limits) == 2  # 3 and 0, for traffic from the primary road
    assert (middles(limits)[:, 0] < 60).all()
    assert (middles(limits)[:, 1] < 0).all()


@pytest.mark.parametrize(
    "tags",
    [
        {"highway": "service", "cycleway": "lane"},
        {"highway": "residential", "surface": "gravel", "cycleway": "lane"},
        {"lane_markings": "no", "lanes": "2", "turn:lanes": "left|through", "oneway": "yes"},
    ],
)
def test_roads_without_paint_have_no_symbols(tags):
    found, _ = paint(tags)
    assert not {"cycleway", "turn"} & set(found)


@pytest.mark.parametrize(
    "text", ["left|", "||", "left;through|nonsense", "|" * 40, ";;", "left|through|right|x"]
)
def test_odd_values_of_turn_lanes_are_read_or_reported(text):
    tags = {"highway": "primary", "oneway": "yes", "lanes": "2", "turn:lanes": text}
    street, unread = read_street(tags)
    uses = read_lane_uses(tags, street)
    assert len(unread) == (text.count("|") != 1)
    assert all(turn in TURNS for lane in uses.turns[0] for turn in lane)
    assert read_lane_uses({}, read_street({"highway": "primary"})[0]) == NO_USES
