"""Road surfaces have the width of their roads, join without gaps, and carry the road markings."""

from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

import geoscene
from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.carriageways import read_carriageways
from geoscene.roadgraph.surface_rows import GRID, SurfaceRows
from geoscene.roadgraph.surfaces import SurfaceOptions, carriageway_boxes, road_surfaces
from geoscene.sources import read_osm
from geoscene.sources.data import OsmData, TaggedNode, Way

FRAME = Frame.at(10.0, 50.0)
DEMO = Path(geoscene.__file__).parent / "demo" / "helsinki.osm.pbf"
PAINT = materials()["lane_paint"].code


def surfaces_of(places, ways, points=(), **options):
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in places.items()}
    osm = OsmData(
        bounds=(9.9, 49.9, 10.1, 50.1),
        ways=[
            Way(f"way/{100 + k}", tags, np.array(nodes, np.int64), np.array([lonlat[n] for n in nodes]))
            for k, (tags, nodes) in enumerate(ways)
        ],
        areas=[],
        points=[TaggedNode(f"node/{n}", tags, *lonlat[n]) for n, tags in points],
        relations=[],
    )
    graph, _ = build_road_graph(osm, FRAME)
    return road_surfaces(osm, graph, frame=FRAME, options=SurfaceOptions(**options))


def visible(rows, klass):
    """Visible area of a class where the polygon of higher priority covers others."""
    own = shapely.union_all(rows.polygon[rows.klass == klass])
    over = rows.priority > rows.priority[rows.klass == klass].max(initial=-1)
    return shapely.difference(own, shapely.union_all(rows.polygon[over]))


STREET = {"highway": "residential", "width": "6", "sidewalk": "no"}
CROSS = {1: (0, 0), 2: (100, 0), 3: (0, 100), 4: (-100, 0), 5: (0, -100)}


def test_straight_street_has_the_area_of_its_tagged_width():
    rows = surfaces_of({1: (0, 0), 2: (100, 0)}, [(STREET | {"sidewalk": "left"}, [1, 2])])
    assert shapely.area(rows.polygon[rows.klass == Class.ROAD]).sum() == pytest.approx(600, abs=0.1)
    assert visible(rows, Class.SIDEWALK).area == pytest.approx(200, abs=0.1)
    assert visible(rows, Class.KERB).area == pytest.approx(15, abs=0.1)
    assert visible(rows, Class.SIDEWALK).bounds[1] == pytest.approx(3.15, abs=1e-3)  # north is the left
    assert set(rows.source[rows.klass == Class.SIDEWALK]) == {"sidewalk/default"}


def test_corners_are_rounded_with_the_radius_of_their_class():
    rows = surfaces_of(CROSS, [(STREET, [2, 1, 4]), (STREET, [3, 1, 5])])
    road = shapely.union_all(rows.polygon[rows.klass == Class.ROAD])
    plain = 2 * 200 * 6 - 36
    # Each corner adds a square of the radius (4 m) without its quarter disc, drawn with 6 chords.
    disc = 24 / 2 * 16 * np.sin(2 * np.pi / 24)
    assert road.area == pytest.approx(plain + 4 * 16 - disc, abs=0.1)
    assert road.geom_type == "Polygon"
    assert not road.interiors


def test_sidewalk_continues_around_corners():
    both = STREET | {"sidewalk": "both"}
    rows = surfaces_of(CROSS, [(both, [2, 1, 4]), (both, [3, 1, 5])])
    walk = visible(rows, Class.SIDEWALK)
    assert len(walk.geoms) == 4  # one round each block, none across the road
    assert min(part.area for part in walk.geoms) > 2 * 90 * 2


@pytest.mark.parametrize("angle_deg", [15, 40, 90, 140, 175])
def test_road_segments_join_without_gaps(angle_deg):
    a = np.radians(angle_deg)
    places = {1: (0, 0), 2: (80, 0), 3: (80 * np.cos(a), 80 * np.sin(a)), 4: (-80, 1)}
    wide = STREET | {"width": "9", "name": "other"}
    rows = surfaces_of(places, [(STREET, [1, 2]), (wide, [1, 3]), (STREET, [4, 1])])
    road = shapely.union_all(rows.polygon[rows.klass == Class.ROAD])
    assert road.geom_type == "Polygon"
    assert not road.interiors
    assert shapely.union_all([shapely.LineString([places[1], places[k]]) for k in (2, 3, 4)]).within(
        road.buffer(0.01)
    )


def test_lines_are_painted_between_lanes_but_not_across_junctions():
    main = {"highway": "primary", "lanes": "4", "width": "14", "sidewalk": "both"}
    rows = surfaces_of(CROSS, [(main, [2, 1, 4]), (STREET, [3, 1, 5])])
    paint = rows.polygon[rows.klass == Class.LANE_MARKING]
    assert len(paint)
    lines = shapely.union_all(paint)
    assert lines.distance(shapely.Point(0, 0)) > 7
    ys = np.unique(np.round(shapely.get_coordinates(shapely.centroid(paint))[:, 1], 1))
    np.testing.assert_allclose(ys, [-3.5, 0, 3.5], atol=0.05)
    solid = paint[np.abs(shapely.get_coordinates(shapely.centroid(paint))[:, 1]) < 0.1]
    assert shapely.area(solid).max() > 0.12 * 70
    dashes = paint[np.abs(shapely.get_coordinates(shapely.centroid(paint))[:, 1]) > 0.1]
    np.testing.assert_allclose(shapely.area(dashes), 3 * 0.12, atol=0.01)


def test_driveway_does_not_interrupt_lane_markings():
    main = {"highway": "primary", "lanes": "2", "width": "7", "sidewalk": "both"}
    rows = surfaces_of(CROSS, [(main, [2, 1, 4]), ({"highway": "service"}, [1, 3])])
    lines = shapely.union_all(rows.polygon[rows.klass == Class.LANE_MARKING])
    assert lines.buffer(0.1).covers(shapely.LineString([(-95, 0), (95, 0)]))


@pytest.mark.parametrize(("left_hand", "side"), [(False, -1), (True, 1)])
def test_stop_lines_cross_only_the_lanes_that_stop(left_hand, side):
    street = STREET | {"width": "8", "lanes": "2"}
    ways = [(street, [2, 1]), (street, [1, 4]), (street | {"highway": "primary"}, [3, 1, 5])]
    rows = surfaces_of(CROSS, ways, [(1, {"highway": "stop"})], left_hand=left_hand)
    stop = rows.polygon[rows.source == "control/default"]
    middle = shapely.get_coordinates(shapely.centroid(stop))
    assert len(stop) == 2  # the side streets stop
    west = middle[middle[:, 0] < 0][0]  # who comes from the west drives east
    assert -15 < west[0] < -5
    assert np.sign(west[1]) == side


def test_zebra_spans_the_width_of_its_road():
    places = {1: (0, 0), 2: (100, 0), 3: (50, -8), 4: (50, 8), 5: (50, 0)}
    crossing = {"highway": "footway", "footway": "crossing", "crossing": "zebra"}
    rows = surfaces_of(places, [(STREET, [1, 5, 2]), (crossing, [3, 5, 4])])
    strip = rows.polygon[(rows.klass == Class.CROSSING) & (rows.material != PAINT)]
    stripes = rows.polygon[(rows.klass == Class.CROSSING) & (rows.material == PAINT)]
    assert [round(s.area, 2) for s in strip] == [18.0]  # 6 m of road by 3 m
    assert len(stripes) == 6
    assert strip[0].buffer(1e-3).covers(shapely.union_all(stripes))
    np.testing.assert_allclose(shapely.area(stripes), 1.5, atol=1e-3)


@pytest.mark.parametrize(
    ("tags", "painted"),
    [({"crossing": "unmarked"}, 0), ({"crossing": "traffic_signals"}, 2), ({"crossing": "uncontrolled"}, 6)],
)
def test_a_crossing_node_is_painted_as_it_is_tagged(tags, painted):
    places = {1: (0, 0), 2: (100, 0), 5: (50, 0)}
    rows = surfaces_of(places, [(STREET, [1, 5, 2])], [(5, {"highway": "crossing"} | tags)])
    assert ((rows.klass == Class.CROSSING) & (rows.material == PAINT)).sum() == painted


def test_bridges_and_tunnels_add_no_road_surface_on_the_ground():
    places = {1: (0, 0), 2: (100, 0), 3: (50, -50), 4: (50, 50), 5: (0, 200), 6: (100, 200)}
    ways = [
        (STREET, [1, 2]),
        (STREET | {"bridge": "yes", "layer": "2"}, [3, 4]),
        (STREET | {"tunnel": "yes"}, [5, 6]),
    ]
    rows = surfaces_of(places, ways)
    assert set(rows.osm_id) == {"way/100"}
    assert (rows.place == 0).all()
    deck = rows.raised.take(rows.raised.place == 1)
    assert set(deck.level) == {2}
    assert (deck.edge >= 0).all()
    assert {Class.ROAD, Class.BRIDGE} == set(deck.klass)
    assert set(rows.raised.osm_id[rows.raised.place == 2]) == {"way/102"}


def test_sidewalks_are_assumed_in_towns_except_beside_a_mapped_footway():
    plain = {"highway": "residential", "width": "6"}
    places = {1: (0, 0), 2: (100, 0), 3: (0, 5.5), 4: (100, 5.5)}
    footway = {"highway": "footway", "footway": "sidewalk"}
    guessed = surfaces_of(places, [(plain, [1, 2]), (footway, [3, 4])])
    band = guessed.polygon[(guessed.klass == Class.SIDEWALK) & (guessed.osm_id == "way/100")]
    assert visible(guessed, Class.KERB).area == pytest.approx(15, abs=0.1)  # the south side alone
    assert shapely.union_all(band).bounds[1] == pytest.approx(-5.15, abs=0.01)
    mapped = surfaces_of(places, [(plain, [1, 2])], sidewalks="mapped")
    fast = surfaces_of(places, [(plain | {"maxspeed": "100"}, [1, 2])])
    for rows in (mapped, fast):
        assert set(rows.klass) == {Class.ROAD}


def test_surface_tag_decides_the_material():
    rows = surfaces_of({1: (0, 0), 2: (50, 0)}, [(STREET | {"surface": "sett"}, [1, 2])])
    assert set(rows.material) == {materials()["stone"].code}
    assert set(rows.source) == {"width/surface"}


def test_track_has_two_rails_one_gauge_apart():
    rows = surfaces_of({1: (0, 0), 2: (50, 0)}, [({"railway": "rail", "gauge": "1000"}, [1, 2])])
    assert set(rows.klass) == {Class.RAIL}
    ys = np.sort(shapely.get_coordinates(shapely.centroid(rows.polygon))[:, 1])
    np.testing.assert_allclose(ys, [-0.536, 0.536], atol=1e-3)


def check_rows(rows):
    assert shapely.is_valid(rows.polygon).all()
    assert (shapely.get_type_id(rows.polygon) == shapely.GeometryType.POLYGON).all()
    xy = shapely.get_coordinates(rows.polygon) * 1e4
    assert np.abs(xy - np.round(xy)).max(initial=0) < 1e-3
    assert ((rows.priority >= 100) & (rows.priority < 200)).all()
    assert all("/" in source for source in set(rows.source))


@st.composite
def networks(draw):
    """Random streets between a few nodes, some of them at the same position."""
    places = {n: (draw(st.integers(-60, 60)), draw(st.integers(-60, 60))) for n in range(8)}
    tags = st.fixed_dictionaries(
        {
            "highway": st.sampled_from(
                ["primary", "residential", "service", "footway", "track", "motorway_link"]
            )
        },
        optional={
            "lanes": st.sampled_from(["1", "2", "3", "5"]),
            "oneway": st.just("yes"),
            "sidewalk": st.sampled_from(["left", "both", "no"]),
            "bridge": st.just("yes"),
            "footway": st.just("crossing"),
        },
    )
    way = st.tuples(tags, st.lists(st.integers(0, 7), min_size=2, max_size=6))
    ways = draw(st.lists(way, min_size=1, max_size=6))
    kinds = st.sampled_from(["crossing", "stop", "traffic_signals", "give_way"])
    return places, ways, [(n, {"highway": draw(kinds)}) for n in range(4)]


_ROAD_AND_BACK = {0: (33, 38), 3: (53, 6), 5: (20, -31)}
_LOOP = {0: (0, 0), 2: (1, 0), 3: (1, 0), 5: (0, -1)}


def test_shapes_that_rounding_would_break_are_valid_on_the_grid():
    hourglass = shapely.Polygon([(0, 0), (4, 0), (2.00003, 2), (4, 4), (0, 4), (2.00002, 2)])
    square = shapely.box(0.00004, 0, 1, 1)
    rows = SurfaceRows.of(
        np.array([hourglass, square, None]), klass=Class.ROAD, material="asphalt", priority=1.0
    )
    assert shapely.is_valid(rows.polygon).all()
    assert shapely.area(rows.polygon).sum() == pytest.approx(9.0, abs=1e-3)
    xy = shapely.get_coordinates(rows.polygon) / GRID
    np.testing.assert_allclose(xy, np.round(xy), atol=1e-6)


_TWO_NODES_AT_ONE_PLACE = {0: (1, 1), 3: (1, 0), 5: (1, 1), 6: (-1, 0)}
_SHARP_LOOP = {0: (0, 1), 1: (1, 0), 3: (2, 0), 4: (2, 0), 5: (-2, 2)}


@pytest.mark.full
@example((_ROAD_AND_BACK, [({"highway": "primary", "lanes": "3"}, [0, 3, 0, 5])], []))
@example(({0: (0, 9), 3: (-6, 10), 5: (12, -16)}, [({"highway": "primary"}, [0, 3, 5, 3])], []))
@example(
    (
        _LOOP,
        [({"highway": "residential", "lanes": "5"}, [0, 3, 5, 0, 3]), ({"highway": "primary"}, [2, 0])],
        [],
    )
)
@example(
    (
        _TWO_NODES_AT_ONE_PLACE,
        [({"highway": "residential", "lanes": "1"}, [5, 0, 3, 0]), ({"highway": "residential"}, [5, 6])],
        [],
    )
)
@example((_SHARP_LOOP, [({"highway": "track"}, [0, 3, 5, 0, 3]), ({"highway": "primary"}, [4, 1, 0])], []))
@settings(max_examples=50, deadline=None)
@given(networks())
def test_road_polygons_are_valid_and_cover_their_centre_lines(network):
    places, ways, points = network
    rows = surfaces_of(places, ways, points)
    check_rows(rows)
    check_rows(rows.raised)
    roads = [
        shapely.LineString([places[n] for n in nodes])
        for tags, nodes in ways
        if tags["highway"] != "footway" and "bridge" not in tags
    ]
    # Grown one by one: GEOS may return an invalid polygon for the buffer of a union with slivers at its rim.
    covered = shapely.union_all(shapely.buffer(rows.polygon[rows.klass == Class.ROAD], 0.01))
    assert shapely.length(shapely.difference(shapely.union_all(roads), covered)) < 0.05


@pytest.mark.shared
@pytest.mark.parametrize("name", ["monaco.osm.pbf", "norfolk_odu_roads.osm.gz", "berlin_neukoelln.osm.gz"])
def test_road_surfaces_of_real_places_are_valid_and_reproducible(shared_osm, name):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    graph, _ = build_road_graph(osm, frame)
    rows = road_surfaces(osm, graph, frame=frame)
    check_rows(rows)
    check_rows(rows.raised)
    again = road_surfaces(osm, graph, frame=frame)
    assert shapely.equals_exact(rows.polygon, again.polygon, 0.0).all()
    ground = ~graph.bridge & ~graph.tunnel & (graph.layer_source != "level")
    lines = [shapely.LineString(graph.geometry[e][:, :2]) for e in np.flatnonzero(ground)]
    road = shapely.union_all(rows.polygon[rows.klass == Class.ROAD])
    outside = shapely.length(shapely.difference(shapely.union_all(lines), shapely.buffer(road, 0.01)))
    assert outside < 1e-3 * shapely.length(np.array(lines)).sum()


@pytest.mark.full
def test_surfaces_near_an_area_have_the_shapes_and_numbers_of_all_surfaces():
    osm = read_osm(DEMO)
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    graph, _ = build_road_graph(osm, frame)
    square = shapely.box(-100, -100, 100, 100)
    whole, some = (road_surfaces(osm, graph, frame=frame, area=area) for area in (None, square))
    assert 0 < len(some) < 0.9 * len(whole)
    assert some.count == whole.count
    at = np.flatnonzero(np.isin(whole.number, some.number))
    np.testing.assert_array_equal(whole.number[at], some.number)
    assert shapely.equals_identical(whole.polygon[at], some.polygon).all()
    left = np.setdiff1d(np.arange(len(whole)), at)
    assert not shapely.intersects(whole.polygon[left], square).any()
    assert shapely.equals_identical(whole.raised.polygon, some.raised.polygon).all()


@pytest.mark.full
def test_boxes_cover_the_surfaces_of_carriageways_and_junctions():
    osm = read_osm(DEMO)
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    graph, _ = build_road_graph(osm, frame)
    roads = read_carriageways(osm, frame, sidewalks="urban", left_hand=False)
    rows = road_surfaces(osm, graph, frame=frame)
    cover = shapely.union_all(shapely.box(*carriageway_boxes(roads).T))
    shapely.prepare(cover)
    own = np.isin(rows.klass, (Class.ROAD, Class.KERB, Class.SIDEWALK)) & np.isin(rows.osm_id, roads.osm_id)
    assert own.sum() > 500
    assert shapely.covers(cover, rows.polygon[own]).all()
