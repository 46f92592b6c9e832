"""Routes follow streets, turn restrictions and the driving side."""

import dataclasses
import json
from itertools import combinations

import numpy as np
import pytest
import shapely
from helpers.roadgrids import grid, road_graph
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import InputError
from geoscene.geometry.frames import Frame
from geoscene.roadgraph import build_road_graph
from geoscene.roadgraph.routing import turn_table, turns_back
from geoscene.sources import read_osm
from lidar.errors import RouteError
from lidar.motion.random_route import random_edges
from lidar.motion.route import RouteOptions, lane_route, plan_route

FRAME = Frame.at(-76.3, 36.88)


def lat_lon(x, y):
    lon, lat = FRAME.to_geographic(x, y)
    return float(lat), float(lon)


def follows(graph, edges):
    before, after = turn_table(graph)
    allowed = set(zip(before.tolist(), after.tolist(), strict=True))
    return all(pair in allowed for pair in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True))


@given(st.integers(0, 2**32 - 1), st.integers(2, 5), st.integers(2, 5))
@settings(max_examples=25, deadline=None)
def test_a_random_drive_follows_streets_without_needless_turns_back(seed, columns, rows):
    graph = grid(columns, rows)
    edges, _ = random_edges(graph, seed=seed, seconds=300.0)
    assert follows(graph, edges)
    assert not turns_back(graph, edges[:-1], after=edges[1:]).any()
    assert graph.travel_time[edges].sum() >= 300.0
    assert np.array_equal(edges, random_edges(graph, seed=seed, seconds=300.0)[0])


def test_other_seeds_give_other_routes():
    graph = grid(5, 5)
    drives = {tuple(random_edges(graph, seed=seed, metres=2000.0)[0].tolist()) for seed in range(10)}
    assert len(drives) == 10


@pytest.mark.full
def test_seeds_start_anywhere_on_the_streets_and_end_anywhere():
    """Starts are uniform by length on all streets that lead on: also on the spur, from its end."""
    nodes = [(0, 0), (100, 0), (100, 100), (0, 100), (100, 200)]
    graph = road_graph(nodes, [(0, 1), (1, 2), (2, 3), (3, 0), (2, 4)])
    drives = [random_edges(graph, seed=seed, metres=300.0) for seed in range(800)]
    first = np.array([edges[0] for edges, _ in drives])
    start, stop = np.array([ends for _, ends in drives]).T
    into_spur = (graph.tail == 2) & (graph.head == 4)  # without turning round it leads nowhere
    count = np.bincount(first, minlength=len(graph))
    assert count[into_spur].sum() == 0
    expected = 800 / np.count_nonzero(~into_spur)
    assert ((count[~into_spur] - expected) ** 2 / expected).sum() < 30  # chi-square, 8 degrees: p = 0.0002
    quarters = np.histogram(start, bins=4, range=(0, 90))[0]
    assert ((quarters - 200) ** 2 / 200).sum() < 20
    assert stop.min() < 15
    assert stop.max() > 95
    for edges, (begin, end) in drives:
        assert follows(graph, edges)
        assert graph.length[edges].sum() - begin - (graph.length[edges[-1]] - end) >= 300.0


@pytest.mark.full
@given(st.integers(0, 2**64 - 1))
@settings(max_examples=20, deadline=None)
def test_seeds_that_follow_each_other_start_far_apart(seed):
    """Eight starts on 2.4 km of streets, all on other blocks."""
    graph = grid(4, 4)
    places = []
    for k in range(8):
        edges, (begin, _) = random_edges(graph, seed=seed + k, metres=300.0)
        line = shapely.LineString(graph.geometry[edges[0]][:, :2])
        places.append(line.interpolate(begin))
    gaps = [one.distance(other) for one, other in combinations(places, 2)]
    assert min(gaps) > 20.0


OTHERS = [
    {"highway": "service"},
    pytest.param({"highway": "track"}, marks=pytest.mark.full),
    pytest.param({"highway": "living_street"}, marks=pytest.mark.full),
    {"tunnel": True},
    {"width": 1.5},
]


@pytest.mark.parametrize("other", OTHERS)
def test_random_drives_start_and_end_on_public_streets_in_the_open(other):
    """One street of the block is of another kind; where all are, drives start there all the same."""
    nodes, pairs = [(0, 0), (100, 0), (100, 100), (0, 100)], [(0, 1), (1, 2), (2, 3), (3, 0)]
    ((name, value),) = other.items()
    plain = road_graph(nodes, pairs)
    for count in (2, len(plain)):
        column = getattr(plain, name).copy().astype(object)
        column[:count] = value
        typed = np.str_ if name == "highway" else getattr(plain, name).dtype
        graph = dataclasses.replace(plain, **{name: column.astype(typed)})
        walks = [random_edges(graph, seed=s, metres=150.0, body_width=1.8)[0] for s in range(50)]
        first, last = ({int(walk[k]) for walk in walks} for k in (0, -1))
        allowed = set(range(len(plain) if count == len(plain) else 2, len(plain))) or set(range(len(plain)))
        assert first == allowed
        assert last <= allowed


def test_random_drives_do_not_start_below_roofs():
    graph = grid(3, 3)
    roofs = shapely.STRtree([shapely.box(-10, -10, 190, 30), shapely.box(60, 90, 90, 110)])
    for seed in range(60):
        edges, (begin, _) = random_edges(graph, seed=seed, metres=300.0, roofs=roofs)
        place = shapely.LineString(graph.geometry[edges[0]][:, :2]).interpolate(begin)
        assert not len(roofs.query(place, predicate="intersects"))
    everywhere = shapely.STRtree([shapely.box(-1000, -1000, 1000, 1000)])
    assert len(random_edges(graph, seed=1, metres=300.0, roofs=everywhere)[0])


@pytest.mark.full
def test_a_random_drive_starts_where_the_map_is_left_after_it():
    """Two kilometres of one-way street, of which the route needs one."""
    nodes = [(100 * k, 0) for k in range(21)]
    graph = road_graph(nodes, [(k, k + 1) for k in range(20)], twoway=False)
    starts = []
    for seed in range(200):
        edges, (begin, end) = random_edges(graph, seed=seed, metres=1000.0)
        starts.append(100 * int(edges[0]) + begin)
        assert 100 * int(edges[-1]) + end - starts[-1] >= 1000.0
    assert min(starts) < 50
    assert 950 < max(starts) <= 1000


def test_a_random_drive_prefers_new_streets():
    graph = grid(5, 5)
    seen = []
    for seed in range(20):
        edges, _ = random_edges(graph, seed=seed, metres=2500.0)
        streets = np.minimum(edges, graph.twin[edges])
        seen.append(len(set(streets.tolist())) / len(streets))
    assert np.mean(seen) > 0.83  # a walk that prefers nothing sees 0.78


def test_a_village_of_one_dead_end_street_is_driven_up_and_down():
    graph = road_graph([(0, 0), (150, 0), (300, 0)], [(0, 1), (1, 2)])
    route = plan_route(graph, FRAME, spec="random", options=RouteOptions(seed=3, length=1500.0))
    assert len(route.turns) >= 3
    ends = route.line[route.turns][:, 0]
    assert np.all(np.minimum(abs(ends), abs(ends - 300)) < 1.0)  # it turns at the ends only


def test_one_way_streets_that_lead_out_of_the_map_are_driven_to_their_end():
    graph = road_graph([(0, 0), (100, 0), (200, 0)], [(0, 1), (1, 2)], twoway=False)
    assert random_edges(graph, seed=0, seconds=600.0)[0].tolist() == [0, 1]


def test_a_map_without_streets_has_no_route():
    graph = grid().take(np.zeros(len(grid()), bool))
    with pytest.raises(RouteError, match="no drivable streets"):
        plan_route(graph, FRAME, spec="random")


@pytest.mark.parametrize(("side", "sign"), [("right", -1.0), ("left", 1.0)])
def test_the_vehicle_keeps_to_its_side(side, sign):
    graph = grid(2, 2, width=7.0)
    route = lane_route(graph, [0], ends=(10.0, 90.0), side=side)  # east along y = 0
    np.testing.assert_allclose(route.line[:, 1], sign * 1.75, atol=1e-9)
    np.testing.assert_allclose(route.line[[0, -1], 0], [10.0, 90.0])


@pytest.mark.parametrize(
    ("width", "lanes", "twoway", "offset"),
    [
        (7.0, 1.0, True, 1.75),  # one lane each way
        (14.0, 2.0, True, 5.25),  # two each way: the outer one
        (10.5, 3.0, False, 3.5),  # three one way: the outer one
        (3.5, 1.0, False, 0.0),  # one lane: its middle
        (4.0, 0.5, True, 0.89),  # one lane for both directions: aside as far as the body stays on it
        (1.5, 0.5, True, 0.0),  # narrower than the body
    ],
)
def test_the_lane_is_the_outer_one_inside_the_carriageway(width, lanes, twoway, offset):
    graph = road_graph([(0, 0), (100, 0)], [(0, 1)], width=width, lanes=lanes, twoway=twoway)
    route = lane_route(graph, [0], ends=(0.0, 100.0))
    np.testing.assert_allclose(-route.line[:, 1], offset, atol=0.011)


def test_waypoints_are_joined_by_the_fastest_route():
    graph = grid(3, 2)
    south = np.array([line[:, 1].max() == 0 for line in graph.geometry])
    graph = dataclasses.replace(graph, speed=np.where(south, 2.0, graph.speed))
    route = plan_route(graph, FRAME, spec=[lat_lon(0, 50), lat_lon(200, 50)])
    assert route.line[:, 1].max() > 90.0  # by the northern street
    assert route.line[:, 1].min() > 40.0
    np.testing.assert_allclose(route.line[[0, -1], 1], 50.0, atol=0.01)


def test_waypoints_may_lie_on_one_street():
    route = plan_route(grid(2, 2), FRAME, spec=[lat_lon(80, 2), lat_lon(20, -1)])
    assert len(route.edges) == 1
    np.testing.assert_allclose(route.line[[0, -1], 0], [80.0, 20.0], atol=0.01)
    assert (route.line[:, 1] > 1.0).all()  # westward, on the northern side


def test_of_a_tunnel_and_a_street_above_it_a_waypoint_is_on_the_street():
    nodes = [(0, 0), (200, 0), (0, 3), (200, 3), (0, 60), (200, 60)]
    graph = road_graph(nodes, [(0, 1), (2, 3), (4, 5)])
    graph = dataclasses.replace(graph, tunnel=np.repeat([True, False, True], 2))
    above = plan_route(graph, FRAME, spec=[lat_lon(20, 0), lat_lon(180, 0)])
    assert not graph.tunnel[above.edges].any()
    far = plan_route(graph, FRAME, spec=[lat_lon(20, 60), lat_lon(180, 60)])
    assert graph.tunnel[far.edges].all()


def test_streets_that_are_not_connected_are_named_as_the_reason():
    graph = road_graph([(0, 0), (200, 0), (0, 100), (200, 100)], [(0, 1), (2, 3)])
    with pytest.raises(
        RouteError, match=r"waypoint 2 .* the streets at the two are not connected within the scene"
    ):
        plan_route(graph, FRAME, spec=[lat_lon(50, 0), lat_lon(50, 100)])


def test_swapped_latitudes_and_longitudes_are_named_as_the_reason():
    swapped = [lat_lon(50, 0)[::-1], lat_lon(200, 50)[::-1]]
    with pytest.raises(RouteError, match=r"look swapped: write LAT,LON"):
        plan_route(grid(3, 2), FRAME, spec=swapped)
    east = Frame.at(139.7, 35.6)  # longitudes over 90 are no latitudes at all
    lon, lat = east.to_geographic([0.0, 50.0], [0.0, 0.0])
    with pytest.raises(RouteError, match=r"within 180; latitude and longitude look swapped"):
        plan_route(grid(3, 2), east, spec=list(zip(lon, lat, strict=True)))
    with pytest.raises(RouteError, match=r"m from the nearest drivable street, more than 50 m$"):
        plan_route(grid(3, 2), FRAME, spec=[lat_lon(50, 0), lat_lon(50, 5000)])


def test_waypoints_respect_one_way_streets_and_forbidden_turns():
    # a square driven counter-clockwise only: to go one street back, the vehicle goes three round
    graph = road_graph(
        [(0, 0), (100, 0), (100, 100), (0, 100)], [(0, 1), (1, 2), (2, 3), (3, 0)], twoway=False
    )
    route = plan_route(graph, FRAME, spec=[lat_lon(50, 0), lat_lon(0, 50)])
    assert route.edges.tolist() == [0, 1, 2, 3]
    back = plan_route(graph, FRAME, spec=[lat_lon(50, 0), lat_lon(30, 0)])
    assert back.edges.tolist() == [0, 1, 2, 3, 0]
    banned = dataclasses.replace(
        graph,
        turn_from=np.array([1], np.int32),
        turn_via=np.array([2], np.int32),
        turn_to=np.array([2], np.int32),
        turn_kind=np.array(["no_left_turn"]),
    )
    with pytest.raises(RouteError, match=r"waypoint 2 .* cannot be reached from waypoint 1"):
        plan_route(banned, FRAME, spec=[lat_lon(50, 0), lat_lon(0, 50)])


def chained(graph, *chains):
    """The graph with chains of edges forbidden."""
    edges = np.fromiter((np.array(chain, np.int32) for chain in chains), object)
    return dataclasses.replace(graph, chain_edges=edges, chain_kind=np.full(len(chains), "no_u_turn"))


def drives_along(edges, chain):
    return any(np.array_equal(edges[k : k + len(chain)], chain) for k in range(len(edges)))


def test_random_drives_take_no_turn_that_is_forbidden_via_a_way():
    graph = grid(3, 3)
    drives = [random_edges(graph, seed=seed, metres=3000.0)[0] for seed in range(6)]
    chains = [drive[k : k + 3] for drive in drives for k in (1, 9)]
    assert all(any(drives_along(drive, chain) for drive in drives) for chain in chains)
    bound = chained(graph, *chains)
    for seed in range(6):
        drive, _ = random_edges(bound, seed=seed, metres=3000.0)
        assert follows(bound, drive)
        assert graph.length[drive].sum() >= 2900.0
        assert not any(drives_along(drive, chain) for chain in chains)


@pytest.mark.parametrize("between", [[], [(100, 50)], [(100, 25), (100, 75)]])
def test_waypoints_take_no_turn_that_is_forbidden_via_a_way(between):
    graph = grid(3, 2)
    places = [lat_lon(*xy) for xy in [(50, 0), *between, (150, 100)]]
    free = plan_route(graph, FRAME, spec=[lat_lon(50, 0), lat_lon(100, 50), lat_lon(150, 100)])
    assert len(free.edges) == 3
    bound = chained(graph, free.edges)
    route = plan_route(bound, FRAME, spec=places)
    assert not drives_along(route.edges, free.edges)
    passed = shapely.distance(
        shapely.LineString(route.line[:, :2]), shapely.points(np.reshape(between, (-1, 2)))
    )
    assert (passed < 4.0).all()


def test_an_error_names_three_waypoints_off_the_streets_and_counts_the_rest():
    said = r"^waypoint 1 .*; waypoint 2 .*; waypoint 3 .*; and so are 37 more$"
    with pytest.raises(RouteError, match=said):
        plan_route(grid(2, 2), FRAME, spec=[(36.5, -76.0)] * 40)


def test_a_waypoint_off_the_streets_is_named_with_its_distance():
    with pytest.raises(RouteError, match=r"waypoint 2 \(36\.\d+, -76\.\d+\) is 200 m from the nearest"):
        plan_route(grid(2, 2), FRAME, spec=[lat_lon(50, 0), lat_lon(300, 50)])


GPX = """<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1" version="1.1" creator="t">
<trk><trkseg>{}</trkseg></trk></gpx>"""


def noisy_track(rng, corners, step=8.0, noise=3.0):
    corners = np.asarray(corners, float)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    at = np.arange(0.0, s[-1], step)
    xy = np.stack([np.interp(at, s, corners[:, k]) for k in range(2)], axis=1)
    return xy + rng.normal(0, noise, xy.shape)


def test_a_noisy_gpx_track_is_matched_to_the_streets_it_was_driven_on(tmp_path):
    graph = grid(5, 5)
    rng = np.random.default_rng(5)
    corners = [(20, 0), (200, 0), (200, 200), (100, 200), (100, 300), (270, 300)]
    track = noisy_track(rng, corners)
    points = "\n".join('<trkpt lat="{:.8f}" lon="{:.8f}"/>'.format(*lat_lon(*p)) for p in track)
    path = tmp_path / "drive.gpx"
    path.write_text(GPX.format(points))
    route = plan_route(graph, FRAME, spec=str(path))
    nodes = [tuple(graph.node_xyz[n, :2].astype(int).tolist()) for n in graph.head[route.edges[:-1]]]
    assert nodes == [
        (100, 0), (200, 0), (200, 100), (200, 200), (100, 200), (100, 300), (200, 300)
    ]  # fmt: skip


def test_a_geojson_line_and_points_are_read(tmp_path):
    graph = grid(3, 3)
    lonlat = [list(reversed(lat_lon(*p))) for p in [(50, 0), (100, 50)]]
    line = tmp_path / "line.geojson"
    line.write_text(json.dumps({"type": "LineString", "coordinates": lonlat}))
    points = tmp_path / "points.geojson"
    feature = [{"type": "Feature", "geometry": {"type": "Point", "coordinates": p}} for p in lonlat]
    points.write_text(json.dumps({"type": "FeatureCollection", "features": feature}))
    one, two = (plan_route(graph, FRAME, spec=p) for p in (line, points))
    np.testing.assert_array_equal(one.line, two.line)
    assert len(one.edges) == 2


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("<gpx><wpt lat='x' lon='1'/></gpx>", InputError, "readable lat and lon"),
        ("<gpx>", InputError, "not readable as GPX"),
        ("hello", InputError, "neither GPX"),
        ('{"type": "Point", "coordinates": [1, 2]}', RouteError, "1 points"),
        ('{"type": "LineString", "coordinates": [[1, 200], [1, 2]]}', InputError, "not longitudes"),
    ],
)
def test_a_bad_file_is_refused_with_a_reason(tmp_path, text, error, words):
    path = tmp_path / "route"
    path.write_text(text)
    with pytest.raises(error, match=words):
        plan_route(grid(), FRAME, spec=path)
    with pytest.raises(RouteError, match="does not exist"):
        plan_route(grid(), FRAME, spec=tmp_path / "none.gpx")


@pytest.mark.shared
@pytest.mark.parametrize("name", ["norfolk_odu_roads.osm.gz", "helsinki_center.osm.pbf"])
def test_a_random_drive_through_a_real_city_is_lawful(shared_osm, name):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    graph, _ = build_road_graph(osm, Frame.at((west + east) / 2, (south + north) / 2))
    for seed in range(5):
        edges, _ = random_edges(graph, seed=seed, seconds=900.0)
        assert follows(graph, edges)
        assert graph.travel_time[edges].sum() >= 900.0
        assert not turns_back(graph, edges[:-1], after=edges[1:]).any()
