"""Trees of forests are functions of the ground of their tile and are not stored."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.export import export_scene
from geoscene.export.triangles import estimate_obj
from geoscene.export.vector import solids
from geoscene.geometry.mesh import Mesh
from geoscene.ground import Layers, building_pads, ground_tile, plan_ground, tile_box
from geoscene.objects.forests import Forests, forest_instances, forest_tree_count, forest_trees
from geoscene.objects.shapes import shapes
from geoscene.options import BuildOptions, ExportOptions
from geoscene.pipeline.build import build
from geoscene.scene.tile_files import read_tile
from geoscene.scene.validate import check_scene
from geoscene.sources import read_osm
from geoscene.sources.data import Area, OsmData
from geoscene.view import view_scene
from lidar.world.ground import ground_heights
from lidar.world.settings import WorldSettings
from lidar.world.world import World

NONE = Forests(np.empty(0, np.int64), np.empty(0))


def wood_plan(size):
    """A wood cut by a road, with a house in it, beside a needle-leaved one."""
    road = Layers.of([shapely.box(-200, -3, 300, 3)], klass=Class.ROAD, material=1, priority=100.0)
    woods = Layers.of(
        [shapely.box(-150, -150, 119, 80), shapely.box(130, 20, 190, 80)],
        klass=Class.FOREST_FLOOR, material=9, priority=24.0, osm_id=["way/9", "way/10"], feature=[5, 7],
    )  # fmt: skip
    house = building_pads([shapely.box(31, 31, 60, 60)])
    return plan_ground((-100, -100, 200, 100), Layers.concatenate([woods, road, house]), tile_size=size)


def hill(x, y):
    return 20 + np.asarray(x) / 4 - np.asarray(y) / 8


def all_trees(size, forests=NONE):
    """Columns x, y, z, height, needle-leaved, feature of all trees of the woods, sorted."""
    plan, parts = wood_plan(size), []
    for i, j in plan.tiles.tolist():
        ground = ground_tile(plan, i, j=j, height=hill)
        trees, z = forest_trees(ground, forests, box=tile_box(plan, i, j=j))
        assert forest_tree_count(ground, forests, box=tile_box(plan, i, j=j)) == len(z)
        parts.append(
            np.column_stack([trees.xy, z, trees.height, trees.form == "needleleaved", trees.feature])
        )
    table = np.concatenate(parts)
    return table[np.lexsort(table.T)]


def test_forests_have_the_tree_density_and_leave_roads_and_buildings_free():
    x, y, z, *_ = all_trees(400.0).T
    assert ((x < 118.5) | (x > 130.5)).all()
    assert (y < 79.5).all()
    assert (np.abs(y) > 3.5).all()
    assert not ((x > 30.5) & (x < 60.5) & (y > 30.5) & (y < 60.5)).any()
    area = 218 * 179 - 218 * 7 - 30 * 30 + 59 * 59
    assert len(x) == pytest.approx(area * 0.02, rel=0.05)
    np.testing.assert_allclose(z, hill(x, y), atol=1e-9)


def test_forest_trees_depend_on_the_seed_and_not_on_the_tiles():
    np.testing.assert_allclose(all_trees(50.0), all_trees(170.0), rtol=0, atol=1e-9)
    other = all_trees(50.0, replace(NONE, seed=1))
    assert not np.isin(all_trees(50.0)[:, 0], other[:, 0]).any()


def test_the_leaf_type_of_a_forest_decides_the_forms_of_its_trees():
    outline = shapely.box(0, 0, 1, 1)
    kinds = {"way/9": {"leaf_type": "mixed"}, "way/10": {"wood": "coniferous"}}
    areas = [Area(name, tags, outline, ()) for name, tags in kinds.items()]
    forests = Forests.of(wood_plan(400.0).layers, OsmData((0, 0, 1, 1), [], areas, [], []))
    document = forests.to_json()
    assert document == {"trees_per_m2": 0.02, "seed": 0, "needleleaved_share": {"5": 0.5, "7": 1.0}}
    assert Forests.from_json(document).to_json() == document
    *_, needled, feature = all_trees(400.0, forests).T
    assert needled[feature == 7].all()
    assert needled[feature == 5].mean() == pytest.approx(0.5, abs=0.1)


def test_needle_leaved_trees_have_narrower_crowns():
    plan = wood_plan(400.0)
    ground = ground_tile(plan, 0, j=0, height=hill)
    forests = Forests(np.array([5, 7]), np.array([0.0, 1.0]))
    trees, _ = forest_trees(ground, forests, box=tile_box(plan, 0, j=0))
    needled = trees.form == "needleleaved"
    assert set(trees.feature[needled].tolist()) == {7}
    share = trees.crown / trees.height
    assert share[needled].max() == pytest.approx(0.4)
    assert share[~needled].max() == pytest.approx(0.67)


def test_a_tile_without_forest_has_no_trees():
    assert len(forest_instances(Mesh.empty(), NONE, box=(0, 0, 100, 100))) == 0
    assert forest_tree_count(Mesh.empty(), NONE, box=(0, 0, 100, 100)) == 0


@pytest.fixture(scope="module")
def osm(tmp_path_factory):
    """A wood of 300 x 240 m around a clearing, and a house."""
    rings = {
        "outer": [(60.0, 24.0), (60.0, 24.0054), (60.0022, 24.0054), (60.0022, 24.0)],
        "inner": [(60.0008, 24.002), (60.0008, 24.003), (60.0012, 24.003), (60.0012, 24.002)],
        "house": [(60.0009, 24.0023), (60.0009, 24.0026), (60.0011, 24.0026), (60.0011, 24.0023)],
    }
    nodes, ways = [], []
    count = itertools.count(1)
    for k, (name, ring) in enumerate(rings.items(), 1):
        own = [(next(count), lat, lon) for lat, lon in ring]
        nodes += [f'<node id="{n}" version="1" lat="{lat}" lon="{lon}"/>' for n, lat, lon in own]
        refs = "".join(f'<nd ref="{n}"/>' for n, *_ in [*own, own[0]])
        tags = '<tag k="building" v="yes"/><tag k="height" v="5"/>' if name == "house" else ""
        ways.append(f'<way id="{k}" version="1">{refs}{tags}</way>')
    members = "".join(f'<member type="way" ref="{k}" role="{r}"/>' for k, r in ((1, "outer"), (2, "inner")))
    tags = '<tag k="type" v="multipolygon"/><tag k="natural" v="wood"/><tag k="leaf_type" v="mixed"/>'
    relation = f'<relation id="1" version="1">{members}{tags}</relation>'
    path = tmp_path_factory.mktemp("wood") / "map.osm"
    path.write_text(f'<osm version="0.6">{"".join([*nodes, *ways, relation])}</osm>')
    return read_osm(path)


@pytest.fixture(scope="module")
def scene(osm, tmp_path_factory):
    return build(osm, tmp_path_factory.mktemp("scene") / "scene", options=BuildOptions(tile_size=100.0))


def rows(instances, origin=(0, 0, 0)):
    moved = instances.shifted(origin)
    table = np.column_stack([moved.shape, moved.feature, moved.transform.reshape(-1, 12)])
    return table[np.lexsort(table.T)]


def test_files_of_tiles_have_no_forest_trees_and_readers_place_them(scene):
    assert all(len(read_tile(scene.files.tile(*index)).instances) == 0 for index in scene.tile_indices)
    placed = sum(len(tile.instances) for tile in scene.tiles())
    assert placed == scene.manifest["counts"]["instances"] == 2 * scene.manifest["counts"]["forest_trees"]
    xmin, ymin, xmax, ymax = scene.bounds
    assert placed / 2 == pytest.approx(0.02 * (xmax - xmin) * (ymax - ymin), rel=0.15)


def test_trees_of_forests_are_not_made_where_only_the_ground_is_read(osm, scene, tmp_path, monkeypatch):
    def refuse(*_args, **_options):
        raise AssertionError("trees are made")

    for name in ("forest_instances", "forest_trees"):
        monkeypatch.setattr(f"geoscene.objects.forests.{name}", refuse)
    monkeypatch.setattr("geoscene.scene.tile_files.forest_instances", refuse)
    again = build(osm, tmp_path / "again", options=BuildOptions(tile_size=100.0))
    assert again.manifest["counts"] == scene.manifest["counts"]
    assert check_scene(scene)["broken"] == []
    assert len(solids(scene).columns["volume"]) == 1
    assert np.isfinite(ground_heights(scene, np.array([[-100.0, -100.0, 0.0]]))).all()
    with pytest.raises(AssertionError, match="trees are made"):
        next(scene.tiles())


@pytest.mark.full
def test_rays_views_and_exports_meet_the_same_trees(scene, tmp_path):
    crowns = [rows(tile.instances, tile.origin) for tile in scene.tiles()]
    world = World.load(scene)
    still = world.caster.instances[0]
    assert len(still.shape) == sum(map(len, crowns))
    shapes_of_crowns = {name: k for k, name in enumerate(shapes()) if name.startswith("crown_")}
    table = np.concatenate(crowns)
    tops = table[np.isin(table[:, 0], list(shapes_of_crowns.values()))]
    above = tops[:, [5, 9, 13]] + [0, 0, 100.0]
    hits = world.caster.cast(above, np.broadcast_to([0.0, 0.0, -1.0], above.shape))
    assert (world.lookup(hits).klass == Class.TREE_CROWN).all()
    glb = export_scene(scene, tmp_path / "a.glb", options=ExportOptions())
    assert glb.objects >= len(table)
    assert view_scene(scene, tmp_path / "a.html").path.stat().st_size > 12 * len(table) / 4


@pytest.mark.full
def test_an_obj_that_would_be_too_large_is_refused_with_its_size(scene, tmp_path):
    out = tmp_path / "a.obj"
    written = export_scene(scene, out).path.stat().st_size
    options = ExportOptions(size_limit=0.8 * written / 1e6)
    with pytest.raises(InputError, match=r"would have about .* MB, more than `size_limit` .*\.glb") as raised:
        export_scene(scene, out, options=options, overwrite=True)
    assert out.stat().st_size == written
    size, copies = estimate_obj(scene, None)
    assert size == pytest.approx(written, rel=0.05)
    assert f"{copies:,} trees" in str(raised.value)
    assert copies == sum(len(tile.instances) for tile in scene.tiles())


@pytest.mark.full
@pytest.mark.parametrize("trees", [True, False])
def test_settings_of_worlds_leave_out_forests_and_keep_them_without_single_trees(scene, trees):
    single = sum(len(tile.instances) for tile in scene.tiles(forests=False)) if trees else 0
    forest = sum(len(tile.instances) for tile in scene.tiles()) - sum(
        len(tile.instances) for tile in scene.tiles(forests=False)
    )
    for forests, count in ((True, single + forest), (False, single)):
        world = World.load(scene, settings=WorldSettings(forests=forests, trees=trees))
        assert len(world.caster.instances[0]) == count
    assert forest > 0


@pytest.mark.full
def test_a_rebuild_with_the_same_ground_places_the_same_trees(osm, scene, tmp_path):
    options = BuildOptions(tile_size=100.0, lod=1)
    build(osm, tmp_path / "a", options=BuildOptions(tile_size=100.0))
    again = build(osm, tmp_path / "a", options=options, overwrite=True)
    for index in scene.tile_indices:
        np.testing.assert_array_equal(rows(again.tile(*index).instances), rows(scene.tile(*index).instances))
    assert again.manifest["counts"]["instances"] == scene.manifest["counts"]["instances"]


def test_without_trees_among_the_kinds_forests_have_none(osm, tmp_path):
    scene = build(osm, tmp_path / "a", options=BuildOptions(only=("landcover",)))
    assert scene.manifest["forests"] is None
    assert scene.manifest["counts"]["instances"] == 0
    assert math.isclose(
        scene.manifest["ground"]["area"], np.prod(np.array(scene.bounds[2:]) - scene.bounds[:2])
    )
