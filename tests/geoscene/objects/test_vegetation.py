"""Trees have the mapped sizes, avoid roads and buildings, and do not depend on the tiles built."""

import manifold3d
import numpy as np
import pytest
import shapely

from geoscene.classes import Class, materials
from geoscene.export.objects import expand
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import Mesh
from geoscene.ground import Layers, building_pads, plan_ground
from geoscene.objects.shapes import LEAF_AREA_DENSITY, place, shapes
from geoscene.objects.vegetation import clear_of, read_trees, tree_instances
from geoscene.sources.data import OsmData, TaggedNode, Way

FRAME = Frame.at(11.0, 50.0)


def osm_of(trees=(), ways=()):
    points = [
        TaggedNode(f"node/{k}", {"natural": "tree", **tags}, *lonlat)
        for k, (lonlat, tags) in enumerate(trees)
    ]
    return OsmData((10.9, 49.9, 11.1, 50.1), list(ways), [], points, [])


def lonlat_of(*xy):
    return np.column_stack(FRAME.to_geographic(*np.array(xy, float).T))


def wood_plan(extent=(-100, -100, 200, 100), **options):
    road = Layers.of([shapely.box(-200, -3, 300, 3)], klass=Class.ROAD, material=1, priority=100.0)
    wood = Layers.of(
        [shapely.box(-150, -150, 120, 80)],
        klass=Class.FOREST_FLOOR,
        material=9,
        priority=24.0,
        osm_id="way/9",
    )
    house = building_pads([shapely.box(30, 30, 60, 60)])
    return plan_ground(extent, Layers.concatenate([wood, road, house]), **options)


@pytest.mark.parametrize("name", shapes())
def test_every_shape_is_made_of_closed_solids_facing_outward(name):
    shape = shapes()[name]
    part = manifold3d.Manifold(
        manifold3d.Mesh(shape.vertices.astype(np.float32), shape.faces.astype(np.uint32))
    )
    assert part.status() == manifold3d.Error.NoError
    assert all(piece.volume() > 0 for piece in part.decompose())
    assert shape.closed.all()
    assert len(shape) <= 100


@pytest.mark.parametrize("name", ["crown_broadleaved", "crown_needleleaved", "crown_palm", "trunk"])
def test_scalable_shapes_have_unit_size(name):
    low, high = shapes()[name].vertices.min(axis=0), shapes()[name].vertices.max(axis=0)
    assert low[2] == 0.0
    assert high[2] == 1.0
    assert np.abs([low[:2], high[:2]]).max() == pytest.approx(0.5, abs=0.06)


def test_only_crowns_and_hedges_have_a_leaf_area_density():
    leafy = {name for name, shape in shapes().items() if (shape.klass == Class.TREE_CROWN).any()}
    assert leafy | {"hedge"} == set(LEAF_AREA_DENSITY)


def test_a_sign_faces_its_heading():
    """The retro-reflecting side faces the heading."""
    sign = expand(place("sign_round", np.zeros((1, 3)), heading=np.radians(120)), list(shapes().values()))
    front = sign.material == materials()["retroreflector"].code
    normal = sign.normals()[front].mean(axis=0)
    np.testing.assert_allclose(normal, [np.cos(np.radians(120)), np.sin(np.radians(120)), 0], atol=1e-12)


def test_a_tree_is_as_high_and_wide_as_its_tags_say():
    trees, problems = read_trees(osm_of([((11.0, 50.0), {"height": "21 m", "diameter_crown": "9"})]), FRAME)
    mesh = expand(tree_instances(trees, height=lambda x, y: 0 * x * y + 300.0), list(shapes().values()))
    assert problems == []
    crown = mesh.vertices[mesh.faces[mesh.klass == Class.TREE_CROWN]].reshape(-1, 3)
    assert crown[:, 2].max() == pytest.approx(321.0)
    assert np.ptp(crown[:, 0]) == pytest.approx(9.0, rel=0.05)
    trunk = mesh.vertices[mesh.faces[mesh.klass == Class.TRUNK]].reshape(-1, 3)
    assert trunk[:, 2].min() < 300.0 < crown[:, 2].min() < trunk[:, 2].max()


def test_missing_sizes_are_derived_from_known_ones_with_their_source():
    tags = [
        {},
        {"diameter_crown": "8"},
        {"circumference": "1.5"},
        {"circumference": "150"},
        {"height": "tall"},
    ]
    trees, problems = read_trees(osm_of([((11.0, 50.0), t) for t in tags]), FRAME)
    sources = ["default", "diameter_crown", "circumference", "circumference", "default"]
    assert trees.height_source.tolist() == sources
    assert trees.height[2] == trees.height[3] == pytest.approx(1.5 / np.pi / 0.0284)
    assert {(p.osm_id, p.reason) for p in problems} == {
        ("node/3", "circumference-in-centimetres"),
        ("node/4", "unusable-height"),
    }


@pytest.mark.parametrize(
    ("tags", "height", "trunk", "source", "reasons"),
    [
        ({"est_height": "9", "diameter": "40"}, 9, 0.4, "est_height", ["diameter-in-centimetres"]),
        ({"est_height": "30 ft", "diameter": "40 cm"}, 9.144, 0.4, "est_height", []),
        ({"height": "15", "est_height": "9", "diameter": "0.5"}, 15, 0.5, "height", []),
        ({"height": "high", "est_height": "9 m"}, 9, 9 * 0.0284, "est_height", ["unusable-height"]),
        ({"diameter": "0.3 m"}, 0.3 / 0.0284, 0.3, "diameter", []),
        ({"diameter": "350 mm"}, 0.35 / 0.0284, 0.35, "diameter", []),
        ({"diameter": "350"}, 0.35 / 0.0284, 0.35, "diameter", ["diameter-in-millimetres"]),
        ({"height": "10", "diameter": "12''"}, 10, 0.3048, "height", []),
        ({"height": "10", "circumference": "94 cm"}, 10, 0.94 / np.pi, "height", []),
        ({"height": "10", "circumference": "1.2", "diameter": "90"}, 10, 1.2 / np.pi, "height", []),
        ({"height": "10", "circumference": "940 mm"}, 10, 0.94 / np.pi, "height", []),
        ({"height": "10", "diameter": "thick"}, 10, 0.284, "height", ["unusable-diameter"]),
    ],
)
def test_heights_and_trunks_are_read_in_the_units_of_mappers(tags, height, trunk, source, reasons):
    trees, problems = read_trees(osm_of([((11.0, 50.0), tags)]), FRAME)
    assert (trees.height[0], trees.trunk[0]) == pytest.approx((height, trunk))
    assert trees.height_source[0] == source
    assert [p.reason for p in problems] == reasons


def test_trees_on_roofs_are_left_out_and_listed():
    tags = [{"min_height": "12"}, {"level": "2"}, {"location": "roof"}, {"level": "0;1"}, {"min_height": "0"}]
    row = Way("way/5", {"natural": "tree_row", "level": "1"}, np.arange(2), lonlat_of((0, -40), (0, 40)))
    trees, problems = read_trees(osm_of([((11.0, 50.0), t) for t in tags], [row]), FRAME)
    assert trees.osm_id.tolist() == ["node/3", "node/4"]
    assert [(p.osm_id, p.reason) for p in problems] == [
        (name, "off-ground") for name in ("node/0", "node/1", "node/2", "way/5")
    ]


def test_the_genus_decides_the_form():
    tags = [
        {"genus": "Picea"},
        {"species": "Phoenix canariensis"},
        {"leaf_type": "needleleaved"},
        {"genus": "Tilia"},
    ]
    trees, _ = read_trees(osm_of([((11.0, 50.0), t) for t in tags]), FRAME)
    assert trees.form.tolist() == ["needleleaved", "palm", "needleleaved", "broadleaved"]
    crowns = tree_instances(trees).shape[4:]
    names = ["crown_needleleaved", "crown_palm", "crown_needleleaved", "crown_broadleaved"]
    assert crowns.tolist() == [list(shapes()).index(name) for name in names]


def test_tree_row_has_trees_at_both_ends_and_none_on_a_crossing_road():
    row = Way("way/5", {"natural": "tree_row"}, np.arange(2), lonlat_of((0, -40), (0, 40)))
    trees, _ = read_trees(osm_of(ways=[row]), FRAME, spacing=8.0)
    np.testing.assert_allclose(trees.xy[:, 1], np.linspace(-40, 40, 11), atol=1e-6)
    left, problems = clear_of(wood_plan(), trees)
    assert len(left) == 10
    assert [(p.osm_id, p.reason) for p in problems] == [("way/5", "on-road")]


def test_a_mapped_tree_in_a_building_is_dropped_and_one_on_a_road_moves_beside_it():
    places = lonlat_of((45, 45), (10, 1), (10, 50))
    trees, _ = read_trees(osm_of([(tuple(p), {}) for p in places]), FRAME)
    left, problems = clear_of(wood_plan(), trees)
    assert left.osm_id.tolist() == ["node/1", "node/2"]
    np.testing.assert_allclose(left.xy, [(10, 3.5), (10, 50)], atol=0.26)
    assert left.place_source.tolist() == ["moved", "node"]
    np.testing.assert_allclose(left.moved, [2.5, 0.0], atol=0.26)
    assert [(p.osm_id, p.action, p.reason) for p in problems] == [("node/0", "dropped", "in-building")]


def test_expanded_instances_are_transformed_shapes():
    copies = place(["bench", "bollard"], np.array([[1.0, 2, 3], [4, 5, 6]]), feature=[7, 8])
    mesh = expand(copies, list(shapes().values()))
    assert isinstance(mesh, Mesh)
    bollard = mesh.take(mesh.feature == 8)
    np.testing.assert_allclose(bollard.vertices, shapes()["bollard"].shifted((4, 5, 6)).vertices)
    assert len(mesh) == len(shapes()["bench"]) + len(shapes()["bollard"])
