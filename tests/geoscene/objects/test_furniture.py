"""Street furniture stands beside the road and faces the traffic it addresses; barriers leave roads open."""

import manifold3d
import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

from geoscene.classes import Class, materials
from geoscene.export.objects import expand
from geoscene.geometry.frames import Frame
from geoscene.geometry.watertight import validate_mesh
from geoscene.ground import Layers, building_pads, plan_ground
from geoscene.objects.barriers import barrier_meshes, open_barriers, read_barriers
from geoscene.objects.furniture import furniture_instances, read_furniture, shape_of
from geoscene.objects.shapes import shapes
from geoscene.sources import read_osm
from geoscene.sources.data import Area, OsmData, TaggedNode, Way
from geoscene.structures.contact import OPENING

FRAME = Frame.at(9.0, 50.0)
EXTENT = (-100.0, -100.0, 100.0, 100.0)
EAST, NORTH, WEST, SOUTH = 0.0, np.pi / 2, np.pi, -np.pi / 2


def lonlat(xy):
    return np.column_stack(FRAME.to_geographic(*np.asarray(xy, float).reshape(-1, 2).T))


def node(number, xy, **tags):
    lon, lat = lonlat(xy)[0]
    return TaggedNode(f"node/{number}", tags, lon, lat)


def way(number, xy, nodes=None, **tags):
    nodes = np.arange(len(xy)) + 1000 * number if nodes is None else np.array(nodes)
    return Way(f"way/{number}", tags, nodes, lonlat(xy))


def osm_of(*features):
    kinds = {kind: [f for f in features if isinstance(f, kind)] for kind in (Way, Area, TaggedNode)}
    return OsmData((8.9, 49.9, 9.1, 50.1), kinds[Way], kinds[Area], kinds[TaggedNode], [])


def plan_with(roads=(), houses=(), mouths=()):
    road = Layers.of(list(roads), klass=Class.ROAD, material=1, priority=130.0)
    mouth = Layers.of(list(mouths), klass=Class.TUNNEL, material=1, priority=OPENING)
    return plan_ground(EXTENT, Layers.concatenate([road, building_pads(list(houses)), mouth]))


STREET = shapely.box(-100, -3, 100, 3)
"""A street from west to east, six metres wide."""


def street(**tags):
    return way(1, [(-100, 0), (20, 0), (100, 0)], nodes=[1, 2, 3], highway="residential", **tags)


def read(*features, roads=(STREET,), houses=(), **options):
    return read_furniture(osm_of(*features), FRAME, plan=plan_with(roads, houses), **options)


def facing(table):
    return np.column_stack([np.cos(table.heading), np.sin(table.heading)])


def test_signals_on_a_two_way_street_stand_on_both_sides_facing_their_traffic():
    table, problems = read(street(), node(2, (20, 0), highway="traffic_signals"))
    np.testing.assert_allclose(
        table.xy, [(20, -3.5), (20, 3.5)], atol=0.26
    )  # right of eastbound, of westbound
    np.testing.assert_allclose(facing(table), [(-1, 0), (1, 0)], atol=1e-6)
    assert table.place_source.tolist() == ["roadside", "roadside"]
    assert problems == []


@pytest.mark.parametrize(
    ("tags", "way_tags", "left_hand", "place", "heading"),
    [
        ({"direction": "forward"}, {}, False, (20, -3.5), WEST),
        ({"direction": "backward"}, {}, False, (20, 3.5), EAST),
        ({"traffic_signals:direction": "forward"}, {}, True, (20, 3.5), WEST),
        ({}, {"oneway": "yes"}, False, (20, -3.5), WEST),
        ({}, {"oneway": "-1"}, False, (20, 3.5), EAST),
    ],
)
def test_direction_oneway_and_side_decide_where_a_signal_stands(tags, way_tags, left_hand, place, heading):
    signal = node(2, (20, 0), highway="traffic_signals", **tags)
    table, _ = read(street(**way_tags), signal, left_hand=left_hand)
    assert len(table) == 1
    np.testing.assert_allclose(table.xy[0], place, atol=0.26)
    assert np.cos(table.heading[0] - heading) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("tags", "left_hand", "place", "heading"),
    [
        ({"traffic_sign:direction": "forward"}, False, (20, -3.5), WEST),
        ({"traffic_sign:direction": "backward"}, True, (20, -3.5), EAST),
        ({"direction": "90"}, False, (20, 3.5), EAST),  # seen by traffic that comes from the east
        ({"direction": "E"}, True, (20, -3.5), EAST),
    ],
)
def test_a_sign_on_a_node_of_the_road_stands_beside_the_traffic_it_faces(tags, left_hand, place, heading):
    table, _ = read(street(), node(2, (20, 0), traffic_sign="maxspeed", **tags), left_hand=left_hand)
    np.testing.assert_allclose(table.xy, [place], atol=0.26)
    np.testing.assert_allclose(np.cos(table.heading - heading), 1.0, atol=1e-6)
    assert (table.place_source[0], table.heading_source[0]) == ("roadside", "direction")
    np.testing.assert_allclose(table.moved, 3.5, atol=0.26)


@pytest.mark.parametrize(("left_hand", "headings"), [(False, (EAST, WEST)), (True, (WEST, EAST))])
def test_a_sign_mapped_on_the_carriageway_moves_to_the_kerb_and_faces_its_traffic(left_hand, headings):
    signs = [node(7, (0, 1), traffic_sign="maxspeed"), node(8, (9, -2), traffic_sign="hazard")]
    table, problems = read(street(), *signs, left_hand=left_hand)
    np.testing.assert_allclose(table.xy, [(0, 3.5), (9, -3.5)], atol=0.26)
    np.testing.assert_allclose(np.cos(table.heading - headings), 1.0, atol=1e-6)
    assert table.place_source.tolist() == ["moved", "moved"]
    np.testing.assert_allclose(table.moved, [2.5, 1.5], atol=0.26)
    assert problems == []


@pytest.mark.parametrize("kind", ["stop", "give_way"])
def test_a_stop_sign_without_direction_addresses_the_traffic_towards_the_nearer_junction(kind):
    cross = way(2, [(30, -100), (30, 0), (30, 100)], nodes=[8, 9, 10], highway="residential")
    main = way(1, [(-100, 0), (20, 0), (30, 0), (100, 0)], nodes=[1, 2, 9, 3], highway="residential")
    table, _ = read(main, cross, node(2, (20, 0), highway=kind))
    np.testing.assert_allclose(table.xy, [(20, -3.5)], atol=0.26)
    np.testing.assert_allclose(facing(table), [(-1, 0)], atol=1e-6)


@pytest.mark.parametrize(
    "tags",
    [{"highway": "street_lamp"}, {"power": "pole"}, {"man_made": "flagpole"}, {"barrier": "bollard"}],
)
def test_poles_and_bollards_mapped_on_the_carriageway_move_beside_it(tags):
    table, problems = read(
        street(), node(7, (0, 2), **tags), node(2, (20, 0), **tags), node(9, (0, 9), **tags)
    )
    assert (np.abs(table.xy[:2, 1]) > 3.2).all()
    assert (table.moved[:2] < 4.0).all()
    assert table.place_source.tolist() == ["moved", "moved", "node"]
    assert table.moved[2] == 0
    assert problems == []


def test_bollard_on_a_footway_is_not_moved():
    path = way(3, [(0, 5), (0, 50)], nodes=[20, 21], highway="footway")
    table, _ = read(street(), path, node(21, (0, 50), barrier="bollard"))
    np.testing.assert_allclose(table.xy, [(0, 50)], atol=1e-6)


def test_no_object_stands_between_the_rails_of_a_track():
    rails = Layers.of(
        [shapely.box(-100, y - 0.036, 100, y + 0.036) for y in (9.2, 10.8)],
        klass=Class.RAIL,
        material=1,
        priority=175.0,
    )
    plan = plan_ground(EXTENT, rails)
    table, _ = read_furniture(osm_of(node(7, (0, 10), highway="street_lamp")), FRAME, plan=plan)
    assert 1.5 < abs(table.xy[0, 1] - 10) < 3.0


def test_furniture_without_a_clear_place_is_reported():
    everywhere = shapely.box(*EXTENT)
    bridge = way(4, [(-100, 50), (0, 50), (100, 50)], nodes=[30, 31, 32], highway="primary", bridge="yes")
    signals = [node(k, xy, highway="traffic_signals") for k, xy in ((2, (20, 0)), (31, (0, 50)))]
    table, problems = read(street(), bridge, node(7, (0, 1), power="pole"), *signals, roads=[everywhere])
    assert len(table) == 0
    assert {(p.osm_id, p.action, p.reason) for p in problems} == {
        ("node/7", "dropped", "on-carriageway"),
        ("node/2", "dropped", "no-roadside"),
        ("node/31", "dropped", "on-bridge-or-in-tunnel"),
    }


def test_underground_hydrant_has_no_pillar():
    hydrant = {"emergency": "fire_hydrant", "fire_hydrant:type": "underground"}
    table, problems = read(node(7, (0, 9), **hydrant))
    assert (len(table), problems) == (0, [])


def test_signals_at_a_junction_stand_at_corners_off_both_streets():
    cross = shapely.box(17, -100, 23, 100)
    table, _ = read(street(), node(2, (20, 0), highway="traffic_signals"), roads=[STREET, cross])
    assert len(table) == 2
    for spot in shapely.points(table.xy):
        assert 0.2 < spot.distance(shapely.union(STREET, cross)) < 1.0


def test_lamp_beside_a_road_keeps_its_position_and_faces_the_road():
    lamps = [node(7, (0, 5), highway="street_lamp"), node(8, (0, -5), highway="street_lamp", direction="E")]
    table, _ = read(street(), *lamps)
    np.testing.assert_allclose(table.xy, [(0, 5), (0, -5)], atol=1e-6)
    np.testing.assert_allclose(facing(table), [(0, -1), (1, 0)], atol=1e-4)
    assert table.heading_source.tolist() == ["road", "direction"]
    lit = expand(furniture_instances(table), list(shapes().values()))
    arm = lit.vertices[lit.faces[: len(shapes()["street_lamp"])]].reshape(-1, 3)
    assert arm[:, 1].min() < 4.0  # over the street, south of the mast


def test_a_sign_on_the_right_faces_oncoming_traffic():
    table, _ = read(
        street(), node(7, (0, -5), traffic_sign="maxspeed"), node(8, (0, 5), traffic_sign="hazard")
    )
    np.testing.assert_allclose(facing(table), [(-1, 0), (1, 0)], atol=1e-6)
    assert table.shape.tolist() == ["sign_round", "sign_triangle"]


def test_height_tags_scale_the_shape():
    table, problems = read(
        node(7, (0, 5), highway="street_lamp", height="12"),
        node(8, (9, 5), highway="street_lamp", height="very"),
    )
    mesh = expand(furniture_instances(table, height=lambda x, y: 0 * x * y + 40.0), list(shapes().values()))
    assert mesh.vertices[:, 2].max() == pytest.approx(52.0)
    assert table.height_source.tolist() == ["height", "default"]
    assert [(p.osm_id, p.reason) for p in problems] == [("node/8", "unusable-height")]


def test_furniture_indoors_or_off_the_ground_is_left_out():
    house = shapely.box(40, 40, 60, 60)
    table, problems = read(
        node(4, (50, 50), amenity="bench"),
        node(5, (0, 9), highway="street_lamp", tunnel="yes"),
        node(6, (0, 9), highway="street_lamp", layer="1"),
        node(7, (500, 9), highway="street_lamp"),
        node(8, (0, 9), amenity="bench"),
        houses=[house],
    )
    assert table.osm_id.tolist() == ["node/8"]
    assert [(p.osm_id, p.reason) for p in problems] == [("node/4", "in-building")]


@pytest.mark.parametrize(
    ("tags", "shape"),
    [
        ({"traffic_sign": "stop"}, "sign_stop"),
        ({"traffic_sign": "DE:206"}, "sign_rectangle"),
        ({"barrier": "bollard"}, "bollard"),
        ({"power": "pole"}, "utility_pole"),
        ({"amenity": "cafe"}, None),
        ({}, None),
    ],
)
def test_tags_choose_the_shape(tags, shape):
    assert shape_of(tags) == shape


def volume(mesh):
    part = manifold3d.Manifold(manifold3d.Mesh64(mesh.vertices, mesh.faces.astype(np.uint64)))
    assert part.status() == manifold3d.Error.NoError
    return part.volume()


def opened(osm, frame, plan):
    barriers, problems = read_barriers(osm, frame, extent=plan.extent)
    barriers, more = open_barriers(barriers, plan)
    return barriers, problems + more


def solids(*features, roads=(), houses=(), height=None):
    barriers, problems = opened(osm_of(*features), FRAME, plan_with(roads, houses))
    return barriers, barrier_meshes(barriers, height=height), problems


def test_wall_is_a_solid_of_the_mapped_length_width_and_height():
    wall = way(1, [(-20, 0), (20, 0)], barrier="wall", height="2.2", width="0.5", material="brick")
    barriers, [mesh], problems = solids(wall)
    assert volume(mesh) == pytest.approx(40 * 0.5 * (2.2 + 0.3), rel=1e-6)
    assert mesh.vertices[:, 2].max() == pytest.approx(2.2)
    assert set(mesh.klass) == {Class.WALL}
    assert set(mesh.material) == {materials()["brick"].code}
    assert (barriers.height_source[0], barriers.width_source[0], problems) == ("height", "width", [])


def test_a_closed_fence_is_one_ring_with_a_gate():
    ring = [(0, 0), (30, 0), (30, 20), (0, 20), (0, 0)]
    fence = way(1, ring, nodes=[1, 2, 3, 4, 1], barrier="fence")
    _, [closed], _ = solids(fence)
    assert volume(closed) == pytest.approx(100 * 0.05 * 1.8, rel=0.02)
    _, [open_], _ = solids(fence, node(2, (30, 0), barrier="gate", width="4"))
    assert volume(open_) == pytest.approx(96 * 0.05 * 1.8, rel=0.02)


def test_no_two_vertices_of_a_barrier_are_within_a_millimetre():
    corners = [(-20, 10), (0, 9.5), (0.0004, 9.5003), (20, 10), (20.0006, 20), (20.0002, 20.0005), (-20, 21)]
    hedge = Area("way/1", {"barrier": "hedge"}, shapely.Polygon(lonlat(corners)), None)
    corner = shapely.Polygon([(-30, 0), (-0.0003, 9.5), (-30, 12)])
    _, [mesh], _ = solids(hedge, houses=[corner])
    assert validate_mesh(mesh).ok.all()
    assert not cKDTree(mesh.vertices).query_pairs(1.5e-3)


def test_a_barrier_is_open_where_a_road_passes_and_ends_at_houses():
    hedge = way(1, [(-40, 50), (-40, -50)], barrier="hedge", height="1")
    house = shapely.box(-45, 30, -35, 60)
    barriers, [mesh], problems = solids(hedge, roads=[STREET], houses=[house])
    assert volume(mesh) == pytest.approx((100 - 6 - 20) * 0.8 * 1.3, rel=2e-3)
    assert [(p.osm_id, p.reason) for p in problems] == [("way/1", "across-road")]
    assert len(shapely.get_parts(barriers.polygon[0])) == 2


def test_a_barrier_is_open_over_the_mouth_of_a_tunnel():
    wall = way(1, [(-20, 0), (20, 0)], barrier="wall", height="2.2", width="0.5")
    barriers, problems = opened(osm_of(wall), FRAME, plan_with(mouths=[shapely.box(-4, -10, 5, 10)]))
    assert barriers.polygon[0].area == pytest.approx((40 - 9) * 0.5)
    assert [p.reason for p in problems] == ["across-road"]


def test_a_barrier_follows_the_ground():
    def hill(x, y):
        return 10 + 0.3 * np.asarray(x) + 0 * np.asarray(y)

    _, [mesh], _ = solids(way(1, [(-20, 0), (20, 0)], barrier="wall"), height=hill)
    above = mesh.vertices[:, 2] - hill(mesh.vertices[:, 0], mesh.vertices[:, 1])
    assert sorted(set(np.round(above, 9))) == [-0.3, 1.8]
    assert volume(mesh) == pytest.approx(40 * 0.25 * 2.1, rel=1e-6)


def test_a_hedge_mapped_as_an_area_with_an_unusable_height():
    area = Area(
        "way/9",
        {"barrier": "hedge", "height": "-3"},
        shapely.transform(shapely.box(0, 0, 9, 4), lonlat),
        None,
    )
    barriers, [mesh], problems = solids(area)
    assert volume(mesh) == pytest.approx(36 * 1.8, rel=1e-6)
    assert barriers.width_source[0] == "area"
    assert [(p.osm_id, p.reason) for p in problems] == [("way/9", "unusable-height")]


def ground_of(shape, number=9, kind="way", **tags):
    return Area(f"{kind}/{number}", tags, shapely.transform(shape, lonlat), None)


YARD = shapely.box(0, 0, 30, 20)


@pytest.mark.parametrize("around", [{"leisure": "playground"}, {"landuse": "meadow"}, {"natural": "wood"}])
@pytest.mark.parametrize("kind", ["fence", "hedge", "wall", "retaining_wall"])
@pytest.mark.parametrize("source", ["way", "relation"])
def test_a_barrier_around_an_area_of_another_kind_is_a_line(source, kind, around):
    tags = {"barrier": kind, "width": "0.5", "height": "2", **around}
    area = ground_of(YARD, kind=source, **tags)
    line = way(9, shapely.get_coordinates(YARD.exterior), **tags)
    _, [mesh], problems = solids(*([area, line] if source == "way" else [area]))
    assert volume(mesh) == pytest.approx(100 * 0.5 * 2.3, rel=0.02)
    assert problems == []


def test_an_area_of_a_barrier_alone_is_filled_and_a_fence_around_another_is_not():
    for tags in (
        {"barrier": "hedge", "area": "yes"},
        {"barrier": "hedge", "area": "yes", "landuse": "grass"},
    ):
        _, [mesh], _ = solids(ground_of(YARD, **tags))
        assert volume(mesh) == pytest.approx(600 * 1.8)
    _, [mesh], _ = solids(ground_of(YARD, kind="relation", type="multipolygon", barrier="wall"))
    assert volume(mesh) == pytest.approx(600 * 2.1)
    _, [mesh], _ = solids(ground_of(YARD, barrier="fence", area="yes", leisure="pitch"))
    assert volume(mesh) == pytest.approx(100 * 0.05 * 1.8, rel=0.02)


def test_a_fence_around_a_multipolygon_is_open_at_gates_and_not_doubled_by_its_members():
    area = ground_of(YARD, kind="relation", barrier="fence", leisure="pitch", type="multipolygon")
    member = way(1, [(0, 0), (30, 0)], barrier="wall")
    _, [wall, fence], _ = solids(area, member, node(5, (30, 10), barrier="gate", width="4"))
    assert volume(wall) == pytest.approx(30 * 0.25 * 2.1, rel=1e-3)
    assert volume(fence) == pytest.approx((100 - 30 - 4) * 0.05 * 1.8, rel=0.02)


@pytest.mark.parametrize(
    ("tags", "low", "high"),
    [
        ({"min_height": "12", "height": "1.2"}, 12.0, 13.2),
        ({"min_height": "12 m", "height": "13.2"}, 12.0, 13.2),
        ({"min_height": "12"}, 12.0, 13.5),
        ({"min_height": "12", "layer": "1", "level": "4", "est_height": "2"}, 12.0, 14.0),
        ({"min_height": "40", "height": "41"}, 40.0, 41.0),
        ({"min_height": "0.3", "height": "2"}, 0.3, 2.0),
        ({"min_height": "0"}, -0.3, 1.5),
    ],
)
def test_a_barrier_on_a_roof_begins_at_its_min_height(tags, low, high):
    def hill(x, y):
        return 5.0 + 0.0 * np.asarray(x + y)

    barriers, [mesh], problems = solids(
        way(1, [(-10, 0), (10, 0)], barrier="fence", width="0.5", **tags),
        houses=[shapely.box(-20, -20, 20, 20)] if low > 1 else [],
        height=hill,
    )
    assert (mesh.vertices[:, 2].min() - 5, mesh.vertices[:, 2].max() - 5) == pytest.approx((low, high))
    assert volume(mesh) == pytest.approx(20 * 0.5 * (high - low))
    assert (barriers.min_height[0], barriers.height[0]) == pytest.approx((max(low, 0), high))
    assert problems == []


def test_a_barrier_on_a_roof_is_level_above_the_lowest_ground_below_it():
    def hill(x, y):
        return 0.1 * np.asarray(x) + 0.0 * np.asarray(y)

    _, [mesh], _ = solids(way(1, [(0, 0), (20, 0)], barrier="fence", min_height="12"), height=hill)
    assert set(np.round(mesh.vertices[:, 2], 6)) == {12.0, 13.5}


@pytest.mark.parametrize(
    "tags", [{"level": "3"}, {"layer": "1"}, {"location": "roof"}, {"indoor": "yes"}, {"layer": "-1"}]
)
def test_a_barrier_off_the_ground_without_a_height_is_left_out_and_listed(tags):
    [(key, value)] = tags.items()
    barriers, problems = read_barriers(
        osm_of(way(1, [(0, 0), (20, 0)], barrier="fence", **tags)), FRAME, extent=EXTENT
    )
    assert len(barriers) == 0
    found = [(p.osm_id, p.action, p.reason, p.detail) for p in problems]
    assert found == [("way/1", "dropped", "off-ground", f"{key}={value}")]


def test_a_barrier_is_estimated_to_be_as_high_and_wide_as_its_tags_say():
    barriers, _, _ = solids(way(1, [(0, 0), (20, 0)], barrier="wall", est_height="3", est_width="1"))
    assert (barriers.height[0], barriers.polygon[0].area) == pytest.approx((3.0, 20.0))
    assert (barriers.height_source[0], barriers.width_source[0]) == ("est_height", "est_width")


def test_furniture_on_roofs_and_storeys_is_left_out_and_listed():
    table, problems = read(
        node(1, (0, 9), amenity="bench", min_height="12"),
        node(2, (0, 9), amenity="bench", level="3"),
        node(3, (0, 9), amenity="bench", level="0"),
        node(4, (0, 9), traffic_sign="stop", min_height="2.2"),
    )
    assert set(table.osm_id) == {"node/3", "node/4"}
    assert [(p.osm_id, p.reason) for p in problems] == [("node/1", "off-ground"), ("node/2", "off-ground")]


@pytest.mark.shared
@pytest.mark.parametrize("name", ["helsinki_center.osm.pbf", "monaco.osm.pbf"])
def test_every_barrier_of_a_real_place_is_closed(shared_osm, name):
    osm = read_osm(shared_osm(name))
    west, south, east, north = osm.bounds
    frame = Frame.at((west + east) / 2, (south + north) / 2)
    x, y = frame.from_geographic([west, east], [south, north])
    plan = plan_ground((x.min(), y.min(), x.max(), y.max()), Layers.empty())
    barriers, _ = opened(osm, frame, plan)
    assert len(barriers) > 50
    assert all(volume(mesh) > 0 for mesh in barrier_meshes(barriers))
