"""Longitudinal profiles are smooth, bridges have clearance, and tunnels run below the ground."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array, diags_array

from geoscene.geometry.frames import Frame
from geoscene.ground.terrain import open_terrain
from geoscene.pipeline.build import road_metres
from geoscene.roadgraph import (
    ProfileOptions,
    build_road_graph,
    find_obstacles,
    graded_ground,
    profile,
    quadratic,
)
from geoscene.roadgraph.quadratic import Bounds, interior_point
from geoscene.roadgraph.stations import find_crossings, place_stations
from geoscene.sources import read_osm
from geoscene.sources.data import OsmData, Way

FRAME = Frame.at(10.0, 50.0)
OPTIONS = ProfileOptions()
HIGH = OPTIONS.clearance + OPTIONS.deck


def flat(x, y):
    return 0 * (x + y)


def town(places, ways):
    lonlat = {n: np.array(FRAME.to_geographic(*xy)) for n, xy in places.items()}
    return OsmData(
        bounds=(9.9, 49.9, 10.1, 50.1),
        ways=[
            Way(f"way/{100 + k}", tags, np.array(nodes, np.int64), np.array([lonlat[n] for n in nodes]))
            for k, (tags, nodes) in enumerate(ways)
        ],
        areas=[],
        points=[],
        relations=[],
    )


def graph_of(places, ways):
    return build_road_graph(town(places, ways), FRAME)[0]


def heights(graph):
    """Stations of a graph, and their heights."""
    stations = place_stations(graph, spacing=1e9)
    z = np.zeros(len(stations.xy))
    z[stations.row] = np.concatenate([graph.geometry[e][:, 2] for e in np.unique(stations.edge)])
    return stations, z


def clearances(graph):
    stations, z = heights(graph)
    upper, over, lower, under, _ = find_crossings(graph, stations)
    found = []
    for edge, along in ((upper, over), (lower, under)):
        i, j, share = stations.at(edge, along)
        found.append(z[i] * (1 - share) + z[j] * share)
    return found[0] - found[1]


def steps_beyond(graph, ground):
    """Changes of gradient between stations, less those of the ground where the road lies on it."""
    stations, z = heights(graph)
    terrain = np.asarray(ground(*stations.xy.T), float)
    a, b, _, edge = stations.segments
    aloft = np.zeros(len(z), bool)
    structure = graph.bridge[edge] | graph.tunnel[edge]
    aloft[a[structure]] = aloft[b[structure]] = True
    p, q, r, before, after = stations.triples
    step, own = ((h[r] - h[q]) / after - (h[q] - h[p]) / before for h in (z, terrain))
    return np.abs(step) - np.where(aloft[p] | aloft[q] | aloft[r], 0.0, np.abs(own))


ROAD = {"highway": "secondary"}
BRIDGE = ROAD | {"bridge": "yes", "layer": "1"}
TUNNEL = ROAD | {"tunnel": "yes", "layer": "-1"}
OVER = {1: (-400, 0), 2: (-60, 0), 3: (60, 0), 4: (400, 0), 5: (0, -300), 6: (0, 300)}


def test_a_bridge_clears_the_road_below_and_comes_down_again():
    graph = profile(graph_of(OVER, [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]), flat)
    assert clearances(graph).min() >= HIGH - 0.01
    assert np.abs(graph.node_xyz[np.isin(graph.node_id, [1, 4]), 2]).max() < 0.05
    assert steps_beyond(graph, flat).max() <= OPTIONS.step + 1e-3
    below = [line for line, name in zip(graph.geometry, graph.osm_id, strict=True) if name == "way/103"]
    assert np.abs(np.concatenate(below)[:, 2]).max() < 0.5  # it is the bridge that gives way
    top = max(line[:, 2].max() for line in graph.geometry)
    assert top < HIGH + 1.0


def test_a_tunnel_dives_under_the_road_above_and_stays_under_the_ground():
    places = OVER | {2: (-150, 0), 3: (150, 0)}
    graph = profile(
        graph_of(places, [(ROAD, [1, 2]), (TUNNEL, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]), flat
    )
    assert clearances(graph).min() >= HIGH - 0.01
    bore = graph.geometry[np.flatnonzero(graph.tunnel)[0]]
    assert (bore[1:-1, 2] < 0).all()
    assert np.interp(0, bore[:, 0], bore[:, 2]) < -HIGH + 0.5


def test_three_levels_of_roads_clear_each_other():
    places = OVER | {7: (-300, -300), 8: (300, 300)}
    ways = [
        (ROAD | {"bridge": "yes", "layer": "1"}, [1, 4]),
        (ROAD, [5, 6]),
        (ROAD | {"bridge": "yes", "layer": "2"}, [7, 8]),
    ]
    graph = profile(graph_of(places, ways), flat)
    assert len(clearances(graph)) == 3
    assert clearances(graph).min() >= HIGH - 0.01
    assert max(line[:, 2].max() for line in graph.geometry) >= 2 * HIGH - 0.02


def test_stacked_bridges_whose_lines_never_cross_keep_their_clearance():
    places = dict(enumerate(
        [(x, y) for y in (0.0, 2.0) for x in (-600, -150, 150, 600)], start=1))  # fmt: skip
    upper = BRIDGE | {"layer": "2"}
    ways = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6]), (upper, [6, 7]), (ROAD, [7, 8])]
    graph = profile(graph_of(places, ways), flat)
    low, high = (graph.geometry[int(np.flatnonzero(graph.osm_id == f"way/{w}")[0])] for w in (101, 104))
    at = np.linspace(-140, 140, 57)
    apart = np.interp(at, *high[np.argsort(high[:, 0])][:, [0, 2]].T)
    apart -= np.interp(at, *low[np.argsort(low[:, 0])][:, [0, 2]].T)
    assert apart.min() > HIGH - 0.05


def test_branches_are_equally_high_at_a_fork_and_separate_beyond_it():
    places = {1: (-500, 0), 2: (-100, 0), 3: (0, 0), 4: (250, 25), 5: (250, -25), 6: (600, 60), 7: (600, -60)}
    way = {"oneway": "yes", "lanes": "2"}
    ways = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (BRIDGE | way, [3, 4]), (BRIDGE | way | {"layer": "2"}, [3, 5]),
            (ROAD | way, [4, 6]), (ROAD | way, [5, 7])]  # fmt: skip

    def ground(x, y):
        return np.where((x > 200) & (y < 0), 12.0, np.where(x > 200, -8.0, 0.0)) + 0.0 * y

    graph = profile(graph_of(places, ways), ground)
    one, two = (graph.geometry[int(np.flatnonzero(graph.osm_id == f"way/{w}")[0])] for w in (102, 103))
    at = np.arange(0.0, 250.0, 2.0)
    apart = np.abs(np.interp(at, one[:, 0], one[:, 2]) - np.interp(at, two[:, 0], two[:, 2]))
    overlap = 0.2 * at < graph.width[graph.osm_id == "way/102"][0] - 1.0
    assert overlap.sum() > 10
    assert apart[overlap].max() < 0.2
    assert apart[at > 240].max() > 5.0
    assert steps_beyond(graph, ground).max() < OPTIONS.step + 2e-3


@pytest.mark.parametrize("angle_deg", [30, 45])
def test_a_bridge_that_crosses_at_an_angle_clears_all_of_the_road_below(angle_deg):
    c, s = 300 * np.cos(np.radians(angle_deg)), 300 * np.sin(np.radians(angle_deg))
    places = {1: (-600, 0), 2: (-160, 0), 3: (160, 0), 4: (600, 0), 5: (-c, -s), 6: (c, s)}

    def slope(x, y):
        return 0.15 * y + 0.0 * x

    ways = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]
    graph = profile(graph_of(places, ways), slope)
    over = graph.geometry[int(np.flatnonzero(graph.osm_id == "way/101")[0])]
    under = graph.geometry[int(np.flatnonzero(graph.osm_id == "way/103")[0])]
    # The places of the lower road, level across, that lie straight under the upper one's middle.
    reach = float(graph.width[graph.osm_id == "way/103"][0]) / 2 / np.sin(np.radians(angle_deg))
    at = np.linspace(-reach, reach, 21)
    along = at * np.cos(np.radians(angle_deg))
    way = under[np.argsort(under[:, 0])]
    low = np.interp(along * np.cos(np.radians(angle_deg)), way[:, 0], way[:, 2])
    high = np.interp(at, *over[np.argsort(over[:, 0])][:, [0, 2]].T)
    assert (high - low).min() > HIGH - 0.1


def test_a_bridge_clears_railways_and_rivers():
    osm = town(OVER, [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), ({"railway": "rail"}, [5, 6])])
    graph, _ = build_road_graph(osm, FRAME)
    low, high = (profile(graph, flat, obstacles=o) for o in (None, find_obstacles(osm, FRAME)))
    middle = [
        float(np.interp(0, line[:, 0], line[:, 2]))
        for g in (low, high)
        for line in [g.geometry[np.flatnonzero(g.bridge)[0]]]
    ]
    assert middle[0] < 2
    assert middle[1] >= 5.7 + OPTIONS.deck - 0.01


def test_roads_on_level_ground_without_structures_stay_level():
    graph = graph_of(OVER, [(ROAD, [1, 2, 3, 4])])
    same = profile(graph, lambda x, y: 7.0 + flat(x, y))
    for one, two in zip(graph.geometry, same.geometry, strict=True):
        np.testing.assert_allclose(two, one + [0, 0, 7.0], atol=1e-6)  # noqa: RUF005  (a sum of arrays)


def test_on_the_ground_a_road_follows_the_terrain():
    def hills(x, y):
        return 20 * np.sin(x / 120) + 0.02 * y

    graph = profile(graph_of(OVER, [(ROAD, [1, 4]), (ROAD, [5, 6])]), hills)
    for line in graph.geometry:
        assert np.diff(line[:, 0] + line[:, 1] * 1e-6).size > 10  # stations between the ends
        np.testing.assert_allclose(line[:, 2], hills(line[:, 0], line[:, 1]), atol=0.3)
    assert steps_beyond(graph, hills).max() <= OPTIONS.step + 1e-3


def named(graph, way):
    """Line of the first edge of a way."""
    return graph.geometry[int(np.flatnonzero(graph.osm_id == f"way/{way}")[0])]


@pytest.mark.parametrize("kind", [BRIDGE, TUNNEL])
def test_streets_stay_on_the_ground_where_a_ramp_between_them_is_too_short(kind):
    places = {
        1: (0, -300),
        2: (0, 0),
        3: (0, 300),
        4: (25, 0),
        5: (90, 0),
        6: (300, 0),
        7: (55, -300),
        8: (55, 300),
    }
    ways = [(ROAD, [1, 2, 3]), (ROAD, [2, 4]), (kind, [4, 5]), (ROAD, [5, 6]), (ROAD, [7, 8])]
    graph = profile(graph_of(places, ways), flat)
    along, _, high = named(graph, 101).T
    steepest = np.abs(np.diff(high) / np.diff(along)).max()
    assert OPTIONS.slope < steepest <= OPTIONS.steepest + 1e-3
    assert clearances(graph).min() > HIGH - 0.3
    assert np.abs(named(graph, 100)[:, 2]).max() < 0.3
    assert np.abs(named(graph, 104)[:, 2]).max() < 1.5  # the street that is crossed gives way a little


def test_a_ramp_that_leaves_a_bridge_falls_to_the_first_junction_on_the_ground():
    places = OVER | {2: (-200, 0), 3: (200, 0), 7: (0, 20), 8: (100, 160), 9: (100, 400)}
    ways = [
        (ROAD, [1, 2]),
        (BRIDGE, [2, 7, 3]),
        (ROAD, [3, 4]),
        (ROAD, [5, 6]),
        (ROAD, [7, 8]),
        (ROAD, [8, 9]),
    ]
    ways += [(ROAD, [8, 6])]
    graph = profile(graph_of(places | {5: (40, -300), 6: (40, 300)}, ways), flat)
    ramp = named(graph, 104)[:, 2]
    assert ramp[0] > 2.0
    assert abs(ramp[-1]) < 0.3


def test_no_road_is_steeper_than_the_steepest_streets_there_are():
    def ridge(x, y):
        return np.maximum(60 - 0.6 * np.abs(x), 0.0) + 0 * y

    graph = profile(graph_of({1: (-300, 0), 2: (300, 0)}, [(ROAD, [1, 2])]), ridge)
    along, _, height = graph.geometry[0].T
    assert np.abs(np.diff(height) / np.diff(along)).max() <= OPTIONS.steepest + 0.01
    assert height.max() > 30.0


def test_steep_metres_are_counted():
    def cliff(x, y):
        return np.where(x > 0, 0.3 * x, 0.1 * x) + 0 * y

    graph = profile(graph_of(OVER, [(ROAD | {"oneway": "yes"}, [1, 4])]), cliff)
    everywhere = (-1e4, -1e4, 1e4, 1e4)
    assert road_metres(graph, everywhere)[1] == pytest.approx(400, abs=25)
    assert road_metres(graph, (-1e4, -1e4, 100, 1e4))[1] == pytest.approx(100, abs=25)
    assert road_metres(profile(graph, lambda x, y: 0.15 * x + 0 * y), everywhere)[1] == 0


def test_a_carriageway_of_two_directions_counts_once_and_within_the_extent_only():
    streets = [graph_of(OVER, [(ROAD | {"oneway": way}, [1, 4])]) for way in ("yes", "no")]
    xmin, ymin, xmax, ymax = shapely.total_bounds(shapely.linestrings(streets[0].geometry[0][:, :2]))
    for graph in streets:
        whole = float(graph.length[0])
        assert road_metres(graph, (-1e4, -1e4, 1e4, 1e4))[0] == pytest.approx(whole, rel=1e-9)
        half = (xmin - 1, ymin - 1, (xmin + xmax) / 2, ymax + 1)
        assert road_metres(graph, half)[0] == pytest.approx(whole / 2, rel=0.01)
        assert road_metres(graph, (xmax + 1, ymin, xmax + 2, ymax + 1)) == (0.0, 0.0)


def test_both_edges_of_a_street_have_the_same_heights():
    graph = profile(graph_of(OVER, [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]), flat)
    for edge, twin in enumerate(graph.twin):
        np.testing.assert_array_equal(graph.geometry[edge], graph.geometry[twin][::-1])
        np.testing.assert_array_equal(graph.geometry[edge][0], graph.node_xyz[graph.tail[edge]])


@pytest.mark.full
@settings(max_examples=20, deadline=None)
@given(st.floats(-0.06, 0.06), st.floats(60, 200), st.floats(30, 150), st.sampled_from([BRIDGE, TUNNEL]))
def test_the_ground_is_built_up_and_cut_down_to_the_road(slope, half, angle_deg, kind):
    def ground(x, y):
        return slope * y + 0 * x

    c, s = np.cos(np.radians(angle_deg)) * 400, np.sin(np.radians(angle_deg)) * 400
    places = {1: (-500, 0), 2: (-half, 0), 3: (half, 0), 4: (500, 0), 5: (-c, -s), 6: (c, s)}
    graph = profile(
        graph_of(places, [(ROAD, [1, 2]), (kind, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]), ground
    )
    assert clearances(graph).min() >= HIGH - 0.02
    graded = graded_ground(graph, ground)
    line = graph.geometry[np.flatnonzero(graph.osm_id == "way/100")[0]]
    for side in (-2.0, 0.0, 2.0):
        np.testing.assert_allclose(graded(line[:, 0], line[:, 1] + side), line[:, 2], atol=0.05)
    far = np.array([[-300.0, 100.0], [300.0, -60.0]])
    np.testing.assert_allclose(graded(*far.T), ground(*far.T))
    # No cliff: over the batter the ground passes evenly from the road to the terrain.
    across = np.linspace(-30, 30, 601)
    cut = graded(np.full(601, line[-1, 0] - 1.0), across)
    rise = abs(float(line[-1, 2]) - ground(0.0, 0.0))
    assert np.abs(np.diff(cut)).max() < 0.1 * (1.5 * (rise + 1.0) / 8.0 + abs(slope) + 0.05)


def test_level_ground_is_graded_to_ramps_alone_with_the_same_heights():
    places = {1: (-3000, 0), 2: (-30, 0), 3: (30, 0), 4: (3000, 0), 5: (0, -400), 6: (0, 400)}
    graph = profile(
        graph_of(places, [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]), flat
    )
    whole, near = graded_ground(graph, flat), graded_ground(graph, flat, level=True)
    x, y = np.random.default_rng(1).uniform([[-3000], [-20]], [[3000], [20]], (2, 20_000))
    z = whole(x, y)
    assert z.max() > 2.0
    np.testing.assert_allclose(near(x, y), z, atol=2e-6)
    assert len(near.keywords["roads"].start) < len(whole.keywords["roads"].start)


def test_level_ground_without_ramps_stays_level():
    graph = profile(graph_of({1: (-50, 0), 2: (50, 0)}, [(ROAD, [1, 2])]), flat)
    assert not graded_ground(graph, flat, level=True)(np.zeros(5), np.arange(5.0)).any()


def sloping_street(along, across, *, off=0.0):
    """A street and a side street on a plane, or ``off`` metres above it, and the plane."""

    def ground(x, y):
        return along * np.asarray(x) + across * np.asarray(y)

    graph = graph_of({1: (-80, 0), 2: (80, 0), 3: (0, 60)}, [(ROAD, [1, 2]), (ROAD, [1, 3])])
    graph = profile(graph, ground)
    raised = np.fromiter([np.add(line, (0.0, 0.0, off)) for line in graph.geometry], object)
    return replace(graph, geometry=raised), ground


@pytest.mark.full
@settings(max_examples=30, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-3.0, 3.0))
def test_surveyed_ground_that_is_graded_again_stays_as_it_is(along, across, off):
    graph, ground = sloping_street(along, across, off=off)
    x, y = np.random.default_rng(2).uniform((-100, -40), (100, 70), (3000, 2)).T
    once = graded_ground(graph, ground, surveyed=True)
    twice = graded_ground(graph, once, surveyed=True)
    np.testing.assert_allclose(twice(x, y), once(x, y), atol=1e-9)


def test_surveyed_ground_is_kept_beyond_the_shoulder_where_other_ground_is_blended():
    graph, ground = sloping_street(0.02, 0.15)
    edge = graph.width.max() / 2 + 2.5
    beside = np.linspace(1.45 * edge, 20.0, 30)  # from where a slope of 1 to 2 meets the plane
    x = np.full(30, 40.0)
    kept = graded_ground(graph, ground, surveyed=True)(x, -beside)
    np.testing.assert_allclose(kept, ground(x, -beside), atol=1e-6)
    blended = graded_ground(graph, ground)(x, -beside)
    assert np.abs(blended - ground(x, -beside)).max() > 0.2


def test_roads_on_surveyed_ground_lie_at_their_edges_below_the_crown():
    def crowned(x, y):
        return 5.0 + 0.01 * np.asarray(x) + 0.025 * np.maximum(3.5 - np.abs(y), 0.0)

    graph = graph_of({1: (-60, 0), 2: (60, 0)}, [(ROAD | {"width": "7"}, [1, 2])])
    middle, edges = (
        profile(graph, crowned, options=ProfileOptions(edges=e)).geometry[0] for e in (False, True)
    )
    np.testing.assert_allclose(middle[:, 2] - 5.0 - 0.01 * middle[:, 0], 0.0875, atol=0.01)
    np.testing.assert_allclose(edges[:, 2] - 5.0 - 0.01 * edges[:, 0], 0.025, atol=0.01)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 12), st.integers(1, 12))
def test_interior_point_solver_finds_the_constrained_minimum(seed, n, k):
    rng = np.random.default_rng(seed)
    cost = csr_array(diags_array(rng.uniform(0.5, 5, n)))
    pull, a, b = rng.normal(size=n), rng.normal(size=(k, n)), rng.normal(size=k)
    weight = 10.0 ** rng.uniform(0, 4, k)
    z = interior_point(cost, pull, bounds=Bounds(csr_array(a), b, weight), start=np.zeros(n))
    # At the minimum the slope of cost and penalties together is 0.
    slope = cost @ z - pull + a.T @ (weight * np.minimum(a @ z - b, 0))
    scale = 1 + np.abs(pull).max() + np.abs(a.T * weight).max()
    assert np.abs(slope).max() < 1e-3 * scale


def test_heights_that_are_not_settled_are_said(caplog, monkeypatch):
    monkeypatch.setattr(quadratic, "_ROUNDS", 2)
    bounds = Bounds(csr_array([[1.0]]), np.array([50.0]), np.array([1e4]))
    interior_point(csr_array([[1.0]]), np.zeros(1), bounds=bounds, start=np.zeros(1))
    assert "heights of streets are not settled after 2 iterations" in caplog.text


@pytest.mark.shared
def test_roads_of_monaco_are_smooth_and_clear_each_other(shared_osm, shared_dem):
    osm = read_osm(shared_osm("monaco.osm.pbf"))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    flat_graph, _ = build_road_graph(osm, frame)
    xy = np.concatenate([line[:, :2] for line in flat_graph.geometry])
    terrain = open_terrain([shared_dem("N43E007.hgt.zip")], frame, bounds=(*xy.min(axis=0), *xy.max(axis=0)))
    graph = profile(flat_graph, terrain.height)
    assert len(clearances(graph)) > 50
    assert clearances(graph).min() >= HIGH - 0.01
    steps = steps_beyond(graph, terrain.height)
    # A few ramps are too short for what they must climb.
    assert (steps > OPTIONS.step + 1e-3).mean() < 0.005
    stations, z = heights(graph)
    a, _, _, edge = stations.segments
    ground = terrain.height(*stations.xy.T)
    inside = np.unique(a[graph.tunnel[edge]])
    assert (z[inside] <= ground[inside] + 0.05).mean() > 0.99


def test_heights_do_not_depend_on_the_number_of_threads_of_linear_algebra():
    code = """
import hashlib
import numpy as np
from scipy.sparse import diags_array, eye_array
from geoscene.roadgraph.quadratic import Bounds, interior_point

count = 30_000
rng = np.random.default_rng(2)
cost = (diags_array([-1.0, 2.1, -1.0], offsets=[-1, 0, 1], shape=(count, count))).tocsc()
bounds = Bounds(eye_array(count).tocsr(), rng.normal(0, 1, count), np.full(count, 1e6))
z = interior_point(cost, rng.normal(0, 1, count), bounds=bounds, start=np.zeros(count))
print(hashlib.sha256(z.tobytes()).hexdigest())
"""
    digests = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "OPENBLAS_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "2", "4")
    }
    assert len(digests) == 1
