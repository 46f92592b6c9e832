"""Bridges carry roads at the right height, tunnels are passable, and all structures are closed solids."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geoscene.buildings import build_solids, read_buildings
from geoscene.classes import Class
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import FLOOR, ROOF, Mesh, concatenate
from geoscene.geometry.watertight import validate_mesh
from geoscene.ground import ground_tile, plan_ground
from geoscene.ground.layers import Layers
from geoscene.ground.terrain import open_terrain
from geoscene.roadgraph import build_road_graph, find_obstacles, graded_ground, profile
from geoscene.roadgraph.surfaces import road_surfaces
from geoscene.sources import read_osm
from geoscene.sources.data import Area, OsmData, Way
from geoscene.structures import (
    StructureOptions,
    buildings_over,
    find_openings,
    ground_below,
    opening_layers,
    read_structures,
    structure_meshes,
    within_extent,
)
from geoscene.structures.layered import (
    PRECISION,
    LayerTriangulation,
    cut_plan,
    half_edges,
    raise_shell,
    without_slivers,
)
from geoscene.structures.verges import Clearances, without_ground_roads

FRAME = Frame.at(10.0, 50.0)
SIZES = StructureOptions()


def flat(x, y):
    return 0.0 * (x + y)


def lonlat(xy):
    return np.column_stack(FRAME.to_geographic(*np.asarray(xy, float).T))


def town(places, ways, areas=()):
    where = {n: lonlat([xy])[0] for n, xy in places.items()}
    return OsmData(
        bounds=(9.9, 49.9, 10.1, 50.1),
        ways=[
            Way(f"way/{100 + k}", tags, np.array(nodes, np.int64), np.array([where[n] for n in nodes]))
            for k, (tags, nodes) in enumerate(ways)
        ],
        areas=list(areas),
        points=[],
        relations=[],
    )


class Town:
    """A map with its road graph, ground and structures."""

    def __init__(self, osm, frame=FRAME, ground=flat):
        graph, _ = build_road_graph(osm, frame)
        self.graph = profile(graph, ground, obstacles=find_obstacles(osm, frame))
        graded = graded_ground(self.graph, ground)
        surfaces = road_surfaces(osm, self.graph, frame=frame)
        self.ground_rows = surfaces
        self.table, self.problems = read_structures(surfaces, self.graph, osm=osm, frame=frame, height=graded)
        self.height = ground_below(self.table, graded)
        self.openings = find_openings(self.table, self.height, graph=self.graph)
        self.meshes = structure_meshes(self.table, height=self.height, openings=self.openings)

    def mesh(self, *, only=None):
        chosen = range(len(self.meshes)) if only is None else np.flatnonzero(only)
        return numbered([self.meshes[k] for k in chosen])

    def centre_lines(self, kind, step=2.0):
        """Points (n, 3) on centre lines of edges of a kind, at least 0.5 m from their ends."""
        once = (self.graph.twin < 0) | (self.graph.twin > np.arange(len(self.graph)))
        points = []
        for edge in np.flatnonzero(getattr(self.graph, kind) & once):
            line = self.graph.geometry[edge]
            along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
            at = np.arange(0.5, along[-1] - 0.5, step)
            points.append(np.column_stack([np.interp(at, along, column) for column in line.T]))
        return np.concatenate(points)


def numbered(meshes):
    return concatenate(
        [
            Mesh.of(m.vertices, m.faces, feature=k, klass=m.klass, material=m.material, closed=m.closed)
            for k, m in enumerate(meshes)
        ]
    )


def moved(points, *offset):
    return points + np.array(offset, float)


def hits(mesh, points):
    """Intersections of vertical lines through points with the mesh: (point (h,), z (h,), face (h,))."""
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lying = np.flatnonzero(np.abs(normal[:, 2]) > 1e-9)
    tree = shapely.STRtree(shapely.polygons(corners[lying, :, :2]))
    point, found = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    face = lying[found]
    away = points[point, :2] - corners[face, 0, :2]
    z = corners[face, 0, 2] - (away * normal[face, :2]).sum(axis=1) / normal[face, 2]
    return point, z, face


def first_below(mesh, points):
    """Height (n,) and class (n,) of the first hit of rays straight down from points."""
    point, z, face = hits(mesh, points)
    under = z <= points[point, 2]
    point, z, face = point[under], z[under], face[under]
    order = np.lexsort([z, point])
    last = np.append(np.diff(point[order]) > 0, True)
    height, klass = np.full(len(points), -np.inf), np.zeros(len(points), int)
    height[point[order[last]]] = z[order[last]]
    klass[point[order[last]]] = mesh.klass[face[order[last]]]
    return height, klass


def first_above(mesh, points):
    """Height (n,) of the first hit of rays straight up from points."""
    return -first_below(
        Mesh.of(mesh.vertices * [1, 1, -1], mesh.faces, klass=mesh.klass), points * [1, 1, -1]
    )[0]


def crosses(mesh, start, end):
    """Whether the segment from start to end (3,) intersects a face (Moeller and Trumbore 1997)."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    way = np.asarray(end, float) - start
    p = np.cross(way, c - a)
    det = ((b - a) * p).sum(axis=1)
    met = np.abs(det) > 1e-12
    a, b, c, p, det = a[met], b[met], c[met], p[met], det[met]
    s = start - a
    u = (s * p).sum(axis=1) / det
    q = np.cross(s, b - a)
    v = (way * q).sum(axis=1) / det
    t = ((c - a) * q).sum(axis=1) / det
    return bool(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < 1)).any())


ROAD = {"highway": "secondary", "sidewalk": "no"}
BRIDGE = ROAD | {"bridge": "yes", "layer": "1"}
TUNNEL = ROAD | {"tunnel": "yes", "layer": "-1"}
PLACES = {1: (-400, 0), 2: (-60, 0), 3: (60, 0), 4: (400, 0), 5: (0, -300), 6: (0, 300)}
OVER = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4]), (ROAD, [5, 6])]
UNDER = [(ROAD, [1, 2]), (TUNNEL, [2, 3]), (ROAD, [3, 4])]


@pytest.fixture(scope="module")
def bridge():
    return Town(town(PLACES, OVER))


@pytest.fixture(scope="module")
def tunnel():
    return Town(town(PLACES, UNDER))


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_random_parts_above_and_below_a_slab_form_one_closed_solid(size, seed):
    rng = np.random.default_rng(seed)
    lines = np.array(
        [shapely.LineString(rng.uniform(0, size, (2, 2))) for _ in range(size)] + [shapely.Point(0, 0)],
        object,
    )
    plan = cut_plan(shapely.box(0, 0, size, size), lines[:-1])
    slab = np.ones(len(plan.faces), bool)
    solid = np.column_stack([rng.random(len(slab)) < 0.4, slab, rng.random(len(slab)) < 0.4])
    levels = np.cumsum(rng.uniform(0.2, 1.0, (len(plan.xy), 4)), axis=1)
    shell = raise_shell(plan, levels, solid=solid)
    verdict = validate_mesh(Mesh.of(shell.vertices, shell.faces, feature=0, closed=True))
    assert verdict.ok.all(), verdict.fault(0)


@pytest.mark.parametrize("offset", range(5))
def test_a_corner_that_is_no_thicker_than_rounding_makes_no_walls_that_cross(offset):
    ring = (np.array([(0, 0), (1, -1), (29, -28), (1614, 1640)]) + offset) * PRECISION
    plan = cut_plan(shapely.Polygon(ring), np.empty(0, object))
    deck = 1.8 - 0.005 * np.hypot(*(plan.xy - plan.xy[0]).T)
    shell = raise_shell(plan, np.column_stack([deck - 0.8, deck]), solid=np.ones((len(plan.faces), 1), bool))
    verdict = validate_mesh(Mesh.of(shell.vertices, shell.faces, feature=0, closed=True))
    assert verdict.ok.all(), verdict.fault(0)


def test_a_thin_triangle_with_its_short_side_at_the_border_leaves_no_slit():
    rim = [(0, 0), (-2, 1), (-1179, 622), (-500, 1500), (900, 1200), (800, -300), (209, -112)]
    tip = len(rim)
    faces = np.array([(k, tip, (k + 1) % tip) for k in range(tip)])
    plan = without_slivers(LayerTriangulation(np.array([*rim, (213, -105)]) * PRECISION, faces))
    start, _, _, other = half_edges(plan)
    assert len(plan.faces) == tip - 1
    assert tip not in start[other < 0]


def test_shell_volume_is_that_of_the_solid_layers():
    plan = LayerTriangulation(np.array([[0, 0], [2, 0], [2, 2], [0, 2.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    levels = np.tile([0.0, 1.0, 3.0], (4, 1))
    shell = raise_shell(plan, levels, solid=np.array([[True, True], [True, False]]))
    verdict = validate_mesh(Mesh.of(shell.vertices, shell.faces, feature=0, closed=True))
    assert verdict.ok.all()
    assert verdict.volume[0] == pytest.approx(4 * 1 + 2 * 2)
    assert set(plan.xy[:, 0]) == {0.0, 2.0}


def test_deck_height_is_that_of_the_road_graph(bridge):
    points = bridge.centre_lines("bridge")
    z, klass = first_below(bridge.mesh(), moved(points, 0, 0, 2))
    np.testing.assert_allclose(z, points[:, 2], atol=1e-3)
    assert set(klass) <= {Class.ROAD, Class.LANE_MARKING}


def test_a_deck_is_level_across_and_has_its_thickness(bridge):
    mesh, points = bridge.mesh(), bridge.centre_lines("bridge")
    aside = moved(points, 0, 2.5, 0)
    np.testing.assert_allclose(first_below(mesh, moved(aside, 0, 0, 2))[0], points[:, 2], atol=0.01)
    soffit = first_above(mesh, moved(points, 0, 0, -3))
    on_piers = np.isinf(soffit) | (soffit > points[:, 2] - 0.1)
    np.testing.assert_allclose(soffit[~on_piers], points[~on_piers, 2] - SIZES.deck, atol=0.01)
    assert on_piers.mean() < 0.2


def test_parapets_stand_on_both_sides_and_not_across(bridge):
    mesh = bridge.mesh()
    deck = bridge.centre_lines("bridge")[30]
    for side in (-1, 1):
        assert crosses(mesh, moved(deck, 0, 0, 0.5), moved(deck, 0, 20.0 * side, 0.5))
    for a, b in pairwise(bridge.centre_lines("bridge")):
        assert not crosses(mesh, moved(a, 0, 0, 0.3), moved(b, 0, 0, 0.3))
    nodes = bridge.graph.node_xyz[np.isin(bridge.graph.node_id, [2, 3])]
    for node in nodes:
        onto = moved(node, -3.0 * np.sign(node[0]), 0, 0.5)
        assert not crosses(mesh, moved(node, 3.0 * np.sign(node[0]), 0, 0.5), onto)


def test_piers_avoid_the_road_below(bridge):
    piers = shapely.union_all(bridge.table.pier)
    assert len(bridge.table.pier[0].geoms) + len(bridge.table.pier[1].geoms) >= 2
    below = shapely.LineString([(0, -300), (0, 300)]).buffer(3.25)
    assert piers.distance(below) > 0.3
    foot = shapely.get_coordinates(shapely.centroid(shapely.get_parts(piers)))
    low = bridge.mesh().vertices[:, 2].min()
    assert low < bridge.height(*foot.T).min()  # they reach into the ground


@pytest.mark.parametrize(("gap", "stands"), [(0.9, False), (1.1, True)])
def test_a_bridge_has_piers_where_it_is_more_than_a_metre_above_the_ground(gap, stands):
    def dip(x, y):
        return np.where(np.abs(x) < 50, -(SIZES.deck + gap), 0.0) + 0 * y

    low = Town(town(PLACES, OVER[:3]), ground=dip)
    np.testing.assert_allclose(low.centre_lines("bridge")[:, 2], 0.0, atol=0.01)
    assert (not shapely.is_empty(low.table.pier).all()) == stands


def test_ground_stays_below_a_bridge(bridge):
    points = bridge.centre_lines("bridge")
    ground = bridge.height(points[:, 0], points[:, 1])
    assert (ground < points[:, 2]).all()
    middle = np.abs(points[:, 0]) < 5
    assert np.abs(ground[middle]).max() < 0.2
    ends = np.array([[-60.0, 0], [60.0, 0]])
    node = bridge.graph.node_xyz[np.isin(bridge.graph.node_id, [2, 3]), 2]
    np.testing.assert_allclose(bridge.height(*ends.T), node, atol=0.02)


def test_a_tunnel_has_a_floor_and_a_ceiling(tunnel):
    mesh, points = tunnel.mesh(), tunnel.centre_lines("tunnel")
    z, klass = first_below(mesh, moved(points, 0, 0, 2))
    np.testing.assert_allclose(z, points[:, 2], atol=1e-3)
    assert set(klass) <= {Class.ROAD, Class.LANE_MARKING}
    np.testing.assert_allclose(
        first_above(mesh, moved(points, 0, 0, 2)), points[:, 2] + SIZES.headroom, atol=1e-3
    )


def test_a_tunnel_is_open_from_mouth_to_mouth_and_walled(tunnel):
    mesh, points = tunnel.mesh(), tunnel.centre_lines("tunnel")
    for a, b in pairwise(points):
        assert not crosses(mesh, moved(a, 0, 0, 1), moved(b, 0, 0, 1))
        for side in (-1, 1):
            assert crosses(mesh, moved(a, 0, 0, 1), moved(a, 0.1, 15.0 * side, 1))
    first, last = points[0], points[-1]
    assert not crosses(mesh, moved(first, -10, 0, 1), moved(first, 0, 0, 1))
    assert not crosses(mesh, moved(last, 0, 0, 1), moved(last, 10, 0, 1))


def test_the_ground_is_open_over_the_mouths_and_closed_over_the_middle(tunnel):
    opening = shapely.union_all([shape for shape in tunnel.openings if shape is not None])
    assert opening.covers(shapely.LineString([(-59.9, 0), (-55, 0)]))
    assert opening.covers(shapely.LineString([(55, 0), (59.9, 0)]))
    assert not opening.intersects(shapely.Point(0, 0))
    # The way in lies in a cutting, and where the ground is closed the roof is under it.
    assert tunnel.height(np.array([-61.0]), np.array([0.0]))[0] < -2.0
    roof = first_below(tunnel.mesh(), np.array([[0.0, 0.0, 1.0]]))[0]
    assert -2.0 < roof[0] < 0.0


def test_tunnel_shell_reaches_the_ground_around_an_opening(tunnel):
    opening = shapely.union_all([shape for shape in tunnel.openings if shape is not None])
    rim = shapely.get_coordinates(shapely.segmentize(shapely.boundary(opening), 1.0))
    mouth = np.abs(np.abs(rim[:, 0]) - 60) < 0.2
    points = np.column_stack([rim, np.full(len(rim), 10.0)])[~mouth]
    top, _ = first_below(tunnel.mesh(), points)
    assert (top > tunnel.height(points[:, 0], points[:, 1])).all()


def test_a_road_that_forks_on_its_bridge_has_one_deck_there():
    places = {1: (-200, 0), 2: (-100, 0), 3: (0, 0), 4: (100, 12), 5: (100, -12), 6: (200, 24), 7: (200, -24)}
    ways = [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (BRIDGE | {"oneway": "yes"}, [3, 4]), (BRIDGE, [3, 5]),
            (ROAD, [4, 6]), (ROAD, [5, 7])]  # fmt: skip
    fork = Town(town(places, ways))
    mesh, points = fork.mesh(), fork.centre_lines("bridge", 1.0)
    assert validate_mesh(mesh).ok.all()
    z, klass = first_below(mesh, moved(points, 0, 0, 1.5))
    np.testing.assert_allclose(z, points[:, 2], atol=0.02)
    assert Class.BRIDGE not in klass  # no parapet stands in the way
    apart = shapely.intersection(fork.table.polygon[:, None], fork.table.polygon[None])
    assert shapely.area(apart[~np.eye(len(apart), dtype=bool)]).max() < 0.1


def test_building_is_raised_over_a_tunnel_that_crosses_it(tunnel):
    outline = lonlat([(-58, -15), (-40, -15), (-40, 15), (-58, 15)])
    house = Area(
        "way/900",
        {"building": "yes", "building:levels": "6"},
        shapely.MultiPolygon([shapely.Polygon(outline)]),
        np.empty(0, np.int64),
    )
    buildings, _ = read_buildings(town(PLACES, UNDER, [house]), FRAME)
    base = np.full(buildings.count, -4.0)
    over, problems = buildings_over(buildings, base, foot=base, table=tunnel.table)
    assert [p.reason for p in problems] == ["over-tunnel"]
    solid, _ = build_solids(over, base=base)
    assert validate_mesh(solid).ok.all()
    points = tunnel.centre_lines("tunnel")
    inside = (points[:, 0] > -57) & (points[:, 0] < -41)
    for a, b in pairwise(points[inside]):
        assert not crosses(solid, moved(a, 0, 0, 1), moved(b, 0, 0, 1))
    assert crosses(build_solids(buildings, base=base)[0], points[0] + [-5, 0, 1], points[0] + [10, 0, 1])
    assert solid.vertices[:, 2].max() == pytest.approx(base[0] + buildings.height[0], abs=1e-3)


PART = {"building:part": "yes"}


def test_part_below_a_bridge_stays_where_another_part_stands_over_it(bridge):
    points = bridge.centre_lines("bridge")
    x = float(points[points[:, 2] > 4.0][0, 0])
    low, high = ([(x + a, -15), (x + a + 6, -15), (x + a + 6, 15), (x + a, 15)] for a in (0, 6))
    whole = [low[0], high[1], high[2], low[3]]
    areas = [
        Area(f"way/90{k}", tags | {"height": height}, shapely.Polygon(lonlat(corners)), np.empty(0, int))
        for k, (corners, tags, height) in enumerate(
            [(whole, {"building": "yes"}, "20"), (low, PART, "1"), (high, PART, "20")]
        )
    ]
    buildings, _ = read_buildings(town(PLACES, OVER, areas), FRAME)
    over, _ = buildings_over(buildings, np.zeros(1), foot=np.zeros(1), table=bridge.table)
    solid, _ = build_solids(over, base=np.zeros(1))
    assert validate_mesh(solid).ok.all()
    below, beside = np.array([x + 3.1, 0.2, 0.5]), np.array([x + 9.1, 0.2, 0.5])
    assert crosses(solid, below, moved(below, 0, 0, 1))
    assert not crosses(solid, beside, moved(beside, 0, 0, 4))


def test_building_over_a_tunnel_keeps_its_roof(tunnel):
    outline = shapely.Polygon(lonlat([(-58, -15), (-40, -15), (-40, 15), (-58, 15)]))
    house = Area(
        "way/900", {"building": "yes", "height": "15", "roof:shape": "gabled"}, outline, np.empty(0, int)
    )
    buildings, _ = read_buildings(town(PLACES, UNDER, [house]), FRAME)
    base = np.full(1, -4.0)
    over, _ = buildings_over(buildings, base, foot=base, table=tunnel.table)
    [(solid, problems), (whole, _)] = [build_solids(table, base=base) for table in (over, buildings)]
    assert problems == []
    assert validate_mesh(solid).ok.all()
    assert validate_mesh(solid).volume < validate_mesh(whole).volume - 500
    roofs = [mesh.take(mesh.surface == ROOF) for mesh in (solid, whole)]
    assert {tuple(n) for n in np.round(roofs[0].normals(), 3)} == {
        tuple(n) for n in np.round(roofs[1].normals(), 3)
    }
    assert (solid.surface == FLOOR).sum() > 2


def test_foundation_of_a_building_above_a_tunnel_stays_out_of_the_tunnel(tunnel):
    outline = lonlat([(-58, -15), (-40, -15), (-40, 15), (-58, 15)])
    house = Area("way/900", {"building": "yes", "height": "9"}, shapely.Polygon(outline), np.empty(0, int))
    buildings, _ = read_buildings(town(PLACES, UNDER, [house]), FRAME)
    points = tunnel.centre_lines("tunnel")
    base = np.full(1, points[:, 2].max() + 20.0)
    assert buildings_over(buildings, base, foot=base, table=tunnel.table)[1] == []
    foot = np.full(1, points[:, 2].min() - 1.0)
    over, problems = buildings_over(buildings, base, foot=foot, table=tunnel.table)
    assert [p.reason for p in problems] == ["over-tunnel"]
    solid, _ = build_solids(over, base=base, foot=foot)
    assert validate_mesh(solid).ok.all()
    assert solid.vertices[:, 2].min() == pytest.approx(foot[0], abs=1e-3)
    inside = points[(points[:, 0] > -57) & (points[:, 0] < -41)]
    for a, b in pairwise(inside):
        assert not crosses(solid, moved(a, 0, 0, 1), moved(b, 0, 0, 1))


def test_building_over_two_crossing_tunnels_is_raised_over_the_upper_one():
    places = {
        1: (-400, 0),
        2: (-90, 0),
        3: (90, 0),
        4: (400, 0),
        5: (0, -600),
        6: (0, -250),
        7: (0, 250),
        8: (0, 600),
    }
    upper, lower = ({"highway": "primary", "tunnel": "yes", "layer": layer} for layer in ("-1", "-2"))
    ways = [(ROAD, [5, 6]), (lower, [6, 7]), (ROAD, [7, 8]), (ROAD, [1, 2]), (upper, [2, 3]), (ROAD, [3, 4])]
    both = Town(town(places, ways))
    points = both.centre_lines("tunnel")
    near = points[np.abs(points[:, :2]).max(axis=1) < 14]
    assert np.ptp(near[:, 2]) > SIZES.headroom
    outline = lonlat([(-15, -15), (15, -15), (15, 15), (-15, 15)])
    house = Area("way/900", {"building": "yes", "height": "40"}, shapely.Polygon(outline), np.empty(0, int))
    buildings, _ = read_buildings(town(places, ways, [house]), FRAME)
    base = np.full(1, near[:, 2].min() - 1)
    solid, _ = build_solids(buildings_over(buildings, base, foot=base, table=both.table)[0], base=base)
    assert validate_mesh(solid).ok.all()
    for along in (near[np.abs(near[:, 0]) < 0.1], near[np.abs(near[:, 1]) < 0.1]):
        for up in (0.3, 4.5):
            assert not crosses(solid, moved(along[0], 0, 0, up), moved(along[-1], 0, 0, up))


def test_building_over_a_road_bridge_leaves_headroom_and_one_beside_it_is_unchanged(bridge):
    points = bridge.centre_lines("bridge")
    high = points[points[:, 2] > 2.0]
    x = float(high[0, 0])
    across = lonlat([(x, -15), (x + 12, -15), (x + 12, 15), (x, 15)])
    beside = lonlat([(x, 3.5), (x + 12, 3.5), (x + 12, 15), (x, 15)])
    base = np.zeros(1)
    for outline, through in ((across, True), (beside, False)):
        house = Area(
            "way/900", {"building": "yes", "height": "20"}, shapely.Polygon(outline), np.empty(0, int)
        )
        buildings, _ = read_buildings(town(PLACES, OVER, [house]), FRAME)
        over, problems = buildings_over(buildings, base, foot=base, table=bridge.table)
        assert [p.reason for p in problems] == (["over-bridge"] if through else [])
        solid, _ = build_solids(over, base=base)
        assert validate_mesh(solid).ok.all()
        lane = points[(points[:, 0] > x - 5) & (points[:, 0] < x + 17)]
        for up in (0.5, 4.0):
            assert not crosses(solid, moved(lane[0], 0, 0, up), moved(lane[-1], 0, 0, up))
        assert crosses(solid, np.array([x - 5, 10, 1.0]), np.array([x + 17, 10, 1.0]))


def test_a_track_over_a_road_lies_on_a_deck_that_clears_the_road_and_stands_on_the_ground():
    places = PLACES | {7: (-90, 20), 8: (-30, 20), 9: (30, 20), 10: (90, 20)}
    track = {"railway": "rail"}
    ways = [
        (ROAD, [5, 6]),
        (track, [7, 8]),
        (track | {"bridge": "yes", "layer": "1"}, [8, 9]),
        (track, [9, 10]),
    ]
    rail = Town(town(places, ways))
    mesh = rail.mesh()
    assert validate_mesh(mesh).ok.all()
    line = np.concatenate(list(rail.table.line))
    middle = line[np.abs(line[:, 0]) < 6, 2]
    assert (middle >= SIZES.headroom + SIZES.deck - 1e-6).all()
    slope = np.abs(np.diff(line[:, 2]) / np.diff(line[:, 0]))
    assert slope.max() <= 0.025 + 1e-9  # trains climb no ramps
    xy = np.array([[x, 20.0 + y] for x in (-20.0, 0.0, 20.0) for y in (-0.76, 0.0, 0.76)])
    z, klass = first_below(mesh, np.column_stack([xy, np.full(len(xy), 50.0)]))
    assert (z > SIZES.headroom).all()
    assert klass.reshape(3, 3).tolist() == [[Class.RAIL, Class.BRIDGE, Class.RAIL]] * 3
    foot = mesh.vertices[mesh.vertices[:, 2] < 0, 0]
    assert foot.min() < -28  # an abutment at either end
    assert foot.max() > 28
    assert [p.reason for p in rail.problems] == ["no-ramp"]


def test_a_footbridge_clears_the_road_and_its_parapets_are_railings():
    places = PLACES | {7: (-80, 20), 8: (80, 20)}
    ways = [(ROAD, [5, 6]), ({"highway": "footway", "bridge": "yes", "layer": "1"}, [7, 8])]
    walk = Town(town(places, ways))
    line = np.concatenate(list(walk.table.line))
    assert line[:, 2].max() >= SIZES.headroom + SIZES.slab - 1e-6
    assert line[np.abs(line[:, 0]) > 79, 2] == pytest.approx(0.0, abs=0.01)
    z, klass = first_below(walk.mesh(), np.array([[0.0, 20.0, 50.0]]))
    assert z[0] >= SIZES.headroom + SIZES.slab - 1e-6
    assert klass[0] == Class.SIDEWALK
    assert set(walk.table.rise) == {SIZES.railing}


def test_a_footbridge_clears_a_railway_by_its_underside():
    places = PLACES | {7: (-80, 20), 8: (80, 20)}
    walk = {"highway": "footway", "bridge": "yes", "layer": "1"}
    made = Town(town(places, [({"railway": "rail"}, [5, 6]), (walk, [7, 8])]))
    line = np.concatenate(list(made.table.line))
    over = np.abs(line[:, 0]) < 1
    assert over.any()
    assert line[over, 2] - SIZES.slab == pytest.approx(5.7, abs=0.01)  # that of an overhead line


def test_a_footbridge_passes_below_the_deck_of_a_road_bridge():
    places = PLACES | {7: (20, -77), 8: (20, 80)}
    walk = {"highway": "footway", "bridge": "yes", "layer": "1"}
    ways = [OVER[0], (BRIDGE | {"layer": "2"}, [2, 3]), *OVER[2:], (walk, [7, 8])]
    made = Town(town(places, ways), ground=lambda x, y: 4.0 * (np.abs(y) > 50) + 0 * x)
    line = np.concatenate([z for z, edge in zip(made.table.line, made.table.edge, strict=True) if edge < 0])
    road = made.centre_lines("bridge")
    soffit = np.interp(20.0, road[:, 0], road[:, 2]) - SIZES.deck
    below = np.abs(line[:, 1]) < 3
    assert below.any()
    assert line[below, 2] == pytest.approx(soffit - SIZES.passage, abs=0.05)


def test_a_footway_on_a_road_bridge_is_as_high_as_the_road():
    places = PLACES | {7: (-60, 6), 8: (60, 6)}
    ways = [*OVER, ({"highway": "footway", "bridge": "yes", "layer": "1"}, [7, 8])]
    both = Town(town(places, ways))
    road = both.centre_lines("bridge")
    z, klass = first_below(both.mesh(), moved(road, 0, 6.0, 2))
    np.testing.assert_allclose(z, road[:, 2], atol=0.05)
    assert (klass == Class.SIDEWALK).mean() > 0.9


@pytest.mark.full
@pytest.mark.parametrize("angle_deg", [3, 19, 31])
def test_no_two_vertices_of_a_structure_are_within_a_millimetre(angle_deg):
    turn = np.radians(angle_deg)
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    places = {node: tuple(np.array(xy) @ turned) for node, xy in PLACES.items()}
    fork = {7: tuple(np.array([0.0, 0.4]) @ turned), 8: tuple(np.array([60.0, 25.0]) @ turned)}
    for ways in (
        [(ROAD, [1, 2]), (BRIDGE, [2, 7, 3]), (BRIDGE, [7, 8]), (ROAD, [3, 4]), (ROAD, [5, 6])],
        [(ROAD, [1, 2]), (TUNNEL, [2, 7, 3]), (TUNNEL, [7, 8]), (ROAD, [3, 4])],
    ):
        for mesh in Town(town(places | fork, ways)).meshes:
            assert validate_mesh(mesh).ok.all()
            assert not cKDTree(mesh.vertices).query_pairs(1.5e-3)


def test_pieces_of_a_long_bridge_join_without_gaps():
    long = Town(
        town(
            {1: (-600, 0), 2: (-300, 0), 3: (300, 40), 4: (600, 40)},
            [(ROAD, [1, 2]), (BRIDGE, [2, 3]), (ROAD, [3, 4])],
        )
    )
    assert len(long.table) >= 8
    boxes = shapely.bounds(long.table.polygon)
    assert (np.hypot(boxes[:, 2] - boxes[:, 0], boxes[:, 3] - boxes[:, 1]) < 110).all()
    points = long.centre_lines("bridge", 0.37)
    z, _ = first_below(long.mesh(), moved(points, 0, 0, 2))
    np.testing.assert_allclose(z, points[:, 2], atol=0.01)  # no crack between pieces


def test_every_default_size_has_a_source(bridge, tunnel):
    for table in (bridge.table, tunnel.table):
        assert set(table.body_source) == set(table.rise_source) == {"default"}
    assert bridge.table.pier_spacing.max() <= SIZES.pier_spacing
    assert set(bridge.table.osm_id) == {"way/101"}
    assert set(tunnel.table.osm_id) == {"way/101"}


def lane(town, name, aside=0.0, step=2.0, ends=0.5):
    """Points (n, 3) along a way, some metres to its left."""
    edge = int(np.flatnonzero(town.graph.osm_id == name)[0])
    line = town.graph.geometry[edge]
    along = np.append(0.0, np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T)))
    at = np.arange(ends, along[-1] - ends, step)
    points = np.column_stack([np.interp(at, along, column) for column in line.T])
    way = np.gradient(points[:, :2], axis=0)
    way /= np.hypot(*way.T)[:, None]
    return points + aside * np.column_stack([-way[:, 1], way[:, 0], 0 * at])


def blocked(mesh, points, up=1.0):
    """Number of segments between consecutive points that intersect a solid."""
    return sum(crosses(mesh, moved(a, 0, 0, up), moved(b, 0, 0, up)) for a, b in pairwise(points))


def test_forking_tunnels_share_one_tube_without_walls_across_lanes():
    # A branch rises beside the street that goes on down; they overlap for 60 m.
    places = {1: (-400, 0), 2: (-120, 0), 3: (0, 0), 4: (160, 0), 5: (160, 20), 6: (500, 0), 7: (500, 80)}
    branch = TUNNEL | {"oneway": "yes", "width": "5"}
    ways = [
        (ROAD, [1, 2]),
        (TUNNEL, [2, 3]),
        (TUNNEL, [3, 4]),
        (branch, [3, 5]),
        (ROAD, [4, 6]),
        (ROAD, [5, 7]),
    ]

    def hill(x, y):
        return 12 * np.exp(-(((x - 60) / 90) ** 2)) + np.where((x > 120) & (y > 8), 10.0, -6.0 * (x > 120))

    fork = Town(town(places, ways), ground=hill)
    mesh = fork.mesh()
    assert validate_mesh(mesh).ok.all()
    left, right = lane(fork, "way/103"), lane(fork, "way/102")
    assert np.abs(left[-20:, 2] - right[-20:, 2]).min() > 2.0  # they do part
    street = [lane(fork, "way/102", aside, ends=3.0) for aside in (-1.7, 0.0, 1.7)]
    for points in (left, *street, *(lane(fork, "way/101", aside) for aside in (-1.7, 0.0, 1.7))):
        assert blocked(mesh, points) == 0
        z, _ = first_below(mesh, moved(points, 0, 0, 1.5))
        np.testing.assert_allclose(z, points[:, 2], atol=0.05)
        assert (first_above(mesh, moved(points, 0, 0, 0.3)) > points[:, 2] + 4.5).all()


@pytest.mark.parametrize(
    "arms_deg",
    [(-144, 39, 87), *(pytest.param(arms, marks=pytest.mark.full) for arms in ((7, 58, 77), (-84, 92, -9)))],
)
def test_tunnels_that_meet_at_any_angle_leave_no_wall_at_the_bend(arms_deg):
    places, ways = {1: (0.0, 0.0)}, []
    for k, arm in enumerate(np.radians(arms_deg)):
        for n, far in ((10, 120), (20, 420)):
            places[n + k] = (far * np.cos(arm), far * np.sin(arm))
        ways += [(TUNNEL, [1, 10 + k]), (ROAD, [10 + k, 20 + k])]
    meeting = Town(town(places, ways))
    mesh = meeting.mesh()
    assert validate_mesh(mesh).ok.all()
    for k in range(len(arms_deg)):
        for aside in (-1.5, 0.0, 1.5):
            assert blocked(mesh, lane(meeting, f"way/{100 + 2 * k}", aside, step=1.0, ends=0.05)) == 0


@pytest.mark.full
@settings(max_examples=12, deadline=None)
@given(st.floats(0, 180), st.sampled_from([120.0, 160.0, 200.0]))
def test_pieces_of_a_straight_tunnel_cover_all_of_it(angle_deg, length):
    way = np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    places = {k: tuple(way * at) for k, at in enumerate((-400, 0, length, length + 400), start=1)}
    straight = Town(town(places, [(ROAD, [1, 2]), (TUNNEL, [2, 3]), (ROAD, [3, 4])]))
    assert len(straight.table) >= 2
    whole = shapely.LineString([(0, 0), way * length]).buffer(float(straight.table.half[0]), cap_style="flat")
    covered = shapely.union_all(straight.table.polygon)
    assert covered.symmetric_difference(whole).area < 0.5


@pytest.mark.full
def test_adjacent_carriageways_are_divided_midway():
    # On maps they overlap by two metres; the northern one is two metres higher.
    places = dict(enumerate(
        [(x, y) for y in (0.0, 5.0) for x in (-300, -60, 60, 300)], start=1))  # fmt: skip
    width, upper = {"width": "7", "oneway": "yes"}, {"layer": "2"}
    ways = [(ROAD | width, [1, 2]), (BRIDGE | width, [2, 3]), (ROAD | width, [3, 4]),
            (ROAD | width, [5, 6]), (BRIDGE | width | upper, [6, 7]), (ROAD | width, [7, 8])]  # fmt: skip
    both = Town(town(places, ways), ground=lambda x, y: 0.4 * np.clip(y, 0, 5) + 0 * x)
    mesh = both.mesh()
    assert validate_mesh(mesh).ok.all()
    one, two = both.table.polygon[both.table.level == 1], both.table.polygon[both.table.level == 2]
    assert shapely.union_all(one).intersection(shapely.union_all(two)).area < 0.1
    for name in ("way/101", "way/104"):
        for aside in (-1.7, 0.0, 1.7):
            points = lane(both, name, aside, ends=8.0)
            assert blocked(mesh, points) == 0
            z, _ = first_below(mesh, moved(points, 0, 0, 1.5))
            np.testing.assert_allclose(z, points[:, 2], atol=0.02)


@pytest.mark.parametrize(("z", "whole"), [(6.0, True), (4.2, True), (3.0, False)])
def test_a_deck_is_whole_across_a_road_if_a_car_passes_below(z, whole):
    graph = Town(town({1: (-200, -200), 2: (200, 200)}, [(ROAD, [1, 2])])).graph
    line = np.array([[-30.0, 0.0, z], [30.0, 0.0, z]])
    deck = shapely.box(-30, -4, 30, 4)
    (left,) = without_ground_roads(
        np.array([deck], object),
        np.fromiter([line], object),
        around=np.fromiter([line], object),
        foot=np.array([False]),
        ends=np.fromiter([line[:, :2]], object),
        sizes=Clearances(np.array([4.0]), np.array([SIZES.headroom]), np.array([SIZES.deck])),
        graph=graph,
        headroom=SIZES.headroom,
    )
    assert (left.area == pytest.approx(deck.area)) == whole


def ground_mesh(town, extent):
    """The ground of a map, cut along lines 10 m apart, with the openings of its structures."""
    bare = Layers.of([shapely.box(*extent)], klass=Class.GRASS, material=7, priority=1.0)
    layers = Layers.concatenate([bare, opening_layers(town.table, town.openings)])
    plan = plan_ground(extent, layers, lines=10.0)
    return concatenate([ground_tile(plan, int(i), j=int(j), height=town.height) for i, j in plan.tiles])


def test_ground_on_a_steep_slope_stays_below_a_low_deck():
    hill = Town(town(PLACES, OVER[:3]), ground=lambda x, y: 0.6 * (y - 4.0) + 0 * x)
    extent = (-120.0, -40.0, 120.0, 40.0)
    points = np.concatenate([lane(hill, "way/101", aside) for aside in (-2.5, 0.0, 2.5)])
    assert (0.6 * (points[:, 1] - 4.0) > points[:, 2]).any()  # it would stand over the deck
    top, klass = first_below(concatenate([hill.mesh(), ground_mesh(hill, extent)]), moved(points, 0, 0, 20))
    np.testing.assert_allclose(top, points[:, 2], atol=0.02)
    assert set(klass) <= {Class.ROAD, Class.LANE_MARKING}


def test_structures_end_at_the_extent(bridge, tunnel):
    extent = (-55.0, -100.0, 20.0, 100.0)
    for whole in (bridge, tunnel):
        cut = within_extent(whole.table, extent)
        openings = find_openings(cut, whole.height, graph=whole.graph)
        meshes = structure_meshes(cut, height=whole.height, openings=openings)
        solid = numbered(meshes)
        assert validate_mesh(solid).ok.all()
        assert solid.vertices[:, 0].min() == pytest.approx(-55.0, abs=2e-3)
        assert solid.vertices[:, 0].max() == pytest.approx(20.0, abs=2e-3)
        kept = shapely.intersection(shapely.union_all(whole.table.polygon), shapely.box(*extent))
        assert shapely.union_all(cut.polygon).symmetric_difference(kept).area < 0.1
        points = whole.centre_lines("bridge" if whole is bridge else "tunnel")
        inside = points[(points[:, 0] > -54) & (points[:, 0] < 19)]
        assert blocked(solid, [moved(inside[0], -5, 0, 0), *inside, moved(inside[-1], 5, 0, 0)]) == 0
    everything = within_extent(bridge.table, (-1e3, -1e3, 1e3, 1e3))
    assert all(a.equals(b) for a, b in zip(everything.polygon, bridge.table.polygon, strict=True))
    assert len(within_extent(bridge.table, (100.0, 0.0, 200.0, 50.0))) == 0


def test_a_foot_tunnel_passes_under_a_road_tunnel_of_a_higher_layer_and_joins_one_at_its_node():
    places = PLACES | {7: (0, -60), 8: (0, 60), 9: (30, 40)}
    walk = {"highway": "footway", "tunnel": "yes"}
    road = [(ROAD, [1, 2]), (TUNNEL, [2, 10, 3]), (ROAD, [3, 4])]
    places[10] = (30, 0)
    under = Town(town(places, [*road, (walk | {"layer": "-2"}, [7, 8])]))
    foot = np.concatenate(
        [line for line, edge in zip(under.table.line, under.table.edge, strict=True) if edge < 0]
    )
    at = np.abs(foot[:, 1]) < 4.0
    carriageway = lane(under, "way/101")
    z = float(np.interp(0.0, carriageway[:, 0], carriageway[:, 2]))
    assert (foot[at, 2] + SIZES.passage < z).all()
    assert blocked(under.mesh(), carriageway) == 0
    joined = Town(town(places, [*road, (walk | {"layer": "-2"}, [10, 9])]))
    carriageway = lane(joined, "way/101")
    ends = np.concatenate(
        [line[[0, -1]] for line, edge in zip(joined.table.line, joined.table.edge, strict=True) if edge < 0]
    )
    z = float(np.interp(30.0, carriageway[:, 0], carriageway[:, 2]))
    assert ends[np.abs(ends[:, 1]) < 0.1, 2] == pytest.approx(z, abs=0.01)


def roofs(made):
    """Centres (n, 3) of upward faces of class TUNNEL."""
    mesh = made.mesh()
    corner = mesh.vertices[mesh.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    up = (normal[:, 2] > 0.7 * np.linalg.norm(normal, axis=1)) & (mesh.klass == Class.TUNNEL)
    return corner[up].mean(axis=1)


def test_a_foot_tunnel_goes_down_from_the_street_and_stays_below_even_to_a_dead_end():
    places = {1: (-300, 0), 2: (-200, 0), 3: (200, 0)}
    walk = {"highway": "footway"}
    under = Town(town(places, [(walk, [1, 2]), (walk | {"tunnel": "yes", "layer": "-1"}, [2, 3])]))
    line = np.concatenate([z for z, edge in zip(under.table.line, under.table.edge, strict=True) if edge < 0])
    mouth = np.abs(line[:, 0] + 200) < 1
    assert line[mouth, 2] == pytest.approx(0.0, abs=0.01)
    slope = np.abs(np.diff(line[:, 2]) / np.maximum(np.diff(line[:, 0]), 0.1))
    assert slope.max() < 0.125
    top = roofs(under)
    assert (top[top[:, 0] > -160, 2] < -0.05).all()  # 4 m down take a ramp of 33 m
    assert (line[line[:, 0] > -160, 2] < -(SIZES.passage + SIZES.roof)).all()
    assert not any(o is not None and o.bounds[2] > -155 for o in under.openings)


@pytest.mark.parametrize(("house", "level"), [((-30, -20, 30, 20), True), ((300, 300, 320, 320), False)])
def test_a_tunnel_of_no_layer_is_level_within_a_house_and_else_below_the_ground(house, level):
    corners = np.array(
        [(house[0], house[1]), (house[2], house[1]), (house[2], house[3]), (house[0], house[3])]
    )
    shape = shapely.MultiPolygon([shapely.Polygon(lonlat(corners.tolist()))])
    places = {1: (-90, 0), 2: (-25, 0), 3: (25, 0), 4: (90, 0)}
    walk = {"highway": "footway"}
    ways = [(walk, [1, 2]), (walk | {"tunnel": "yes"}, [2, 3]), (walk, [3, 4])]
    made = Town(town(places, ways, areas=[Area("way/9", {"building": "yes"}, shape, None)]))
    lowest = min(z[:, 2].min() for z in made.table.line)
    assert (lowest == pytest.approx(0.0, abs=0.01)) == level


def test_building_undersides_over_a_tunnel_are_rounded_to_equal_heights():
    places = {1: (-500, 0), 2: (-130, 0), 3: (-20, 0), 4: (25, 0), 5: (130, 0), 6: (500, 0)}
    ways = [(ROAD, [1, 2]), (TUNNEL, [2, 3]), (TUNNEL, [3, 4]), (TUNNEL, [4, 5]), (ROAD, [5, 6])]
    boxes = [(-110, -20, 110, 20), (-110, -20, -30, 20), (-30, -20, 40, 20), (40, -20, 110, 20)]
    tags = [
        {"building": "train_station", "height": "20"},
        *({"building:part": "yes", "height": h} for h in "987"),
    ]
    station = [
        Area(
            f"way/{900 + k}", tag, shapely.Polygon(lonlat(shapely.box(*b).exterior.coords)), np.empty(0, int)
        )
        for k, (b, tag) in enumerate(zip(boxes, tags, strict=True))
    ]
    line = Town(town(places, ways))
    buildings, _ = read_buildings(town(places, ways, station), FRAME)
    base = np.full(buildings.count, line.centre_lines("tunnel")[:, 2].min() - 1.0)
    over, problems = buildings_over(buildings, base, foot=base, table=line.table)
    assert [p.reason for p in problems] == ["over-tunnel"]
    steps = np.array([top for _, top in over.passages[0]]) / 0.05
    assert len(steps) >= 4
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    solid, _ = build_solids(over, base=base)
    assert validate_mesh(solid).ok.all()
    points = line.centre_lines("tunnel")
    inside = points[np.abs(points[:, 0]) < 105]
    for up in (0.3, 4.6):
        assert blocked(solid, inside, up) == 0


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "bounds", "dem"),
    [
        ("portland_central_roads.osm.pbf", (-122.6883, 45.5217, -122.6803, 45.5273), None),
        ("baltimore_harbor.osm.pbf", (-76.5922, 39.2620, -76.5840, 39.2670), None),
        ("monaco.osm.pbf", (7.4205, 43.7320, 7.4305, 43.7395), "N43E007.hgt.zip"),
    ],
)
def test_bridges_and_tunnels_of_real_places_are_passable(shared_osm, shared_dem, name, bounds, dem):
    osm = read_osm(shared_osm(name), bounds=bounds)
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    ground = flat
    if dem:
        ground = open_terrain(
            [shared_dem(dem)], frame, bounds=(-1500, -1500, 1500, 1500), outside="nearest"
        ).height
    real = Town(osm, frame, ground)
    mesh = real.mesh()
    verdict = validate_mesh(mesh)
    assert len(verdict) == len(real.table) > 10
    assert verdict.ok.all()
    for kind in ("bridge", "tunnel"):
        if not getattr(real.graph, kind).any():
            continue
        points = real.centre_lines(kind)
        z, _ = first_below(mesh, moved(points, 0, 0, 2))
        # Two of Monaco's tunnels fork and part in height while their carriageways still overlap.
        assert (np.abs(z - points[:, 2]) < 0.02).mean() > (0.995 if dem else 0.999)
        if kind == "tunnel":
            above = first_above(mesh, moved(points, 0, 0, 2))
            assert (np.abs(above - points[:, 2] - SIZES.headroom) < 0.02).mean() > 0.98
