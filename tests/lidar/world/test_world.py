"""The scene around a vehicle: tiles, instances and actors as rays intersect them."""

import json

import numpy as np
import pytest
import trimesh

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.geometry.mesh import WALL, Mesh, ShapeInstances, concatenate
from geoscene.scene import SceneFiles, open_scene
from geoscene.scene.layout import SCHEMA, manifest_digest
from geoscene.scene.tile_files import Tile, write_shapes, write_tile
from lidar.errors import InputError
from lidar.geometry.poses import Poses
from lidar.raycast import ALL
from lidar.raycast.embree import EmbreeScene
from lidar.raycast.scene import Float64Scene
from lidar.world.settings import WorldSettings, origin_limit
from lidar.world.surfaces import FOLIAGE, GLASS, OPEN
from lidar.world.tiles import load_tile
from lidar.world.world import World

TILE = 100.0
DOWN = np.array([[0.0, 0.0, -1.0]])


def ground(origin):
    corners = np.array([[0, 0, 0], [TILE, 0, 0], [TILE, TILE, 0], [0, TILE, 0]], float)
    return Mesh.of(
        corners - [TILE / 2, TILE / 2, 0], [[0, 1, 2], [0, 2, 3]], klass=Class.TERRAIN, feature=origin
    )


def box(size, at, **columns):
    solid = trimesh.creation.box(size)
    return Mesh.of(solid.vertices + at, solid.faces, closed=True, **columns)


def tile(i, j, rank):
    """Ground, a house of 20 m with a glass front to the south, and a tree scaled by 1.5."""
    house = box([10, 10, 20], [20.0, 20.0, 10.0], klass=Class.BUILDING, feature=100 + rank, surface=WALL)
    material = house.material.copy()
    material[house.normals()[:, 1] < -0.5] = materials()["glass"].code
    house.material[:] = material
    parts = [ground(rank), house]
    mesh = Mesh(
        np.concatenate([m.vertices for m in parts]),
        np.concatenate([parts[0].faces, parts[1].faces + 4]),
        *(
            np.concatenate([getattr(m, name) for m in parts])
            for name in ("feature", "klass", "material", "surface", "color", "closed")
        ),
    )
    tree = np.zeros((1, 3, 4))
    tree[0, :, :3] = np.eye(3) * 1.5
    tree[0, :, 3] = [-20, -20, 0]
    copies = ShapeInstances(np.zeros(1, np.int32), tree, np.array([1000 + rank], np.int32))
    return Tile(np.array([(i + 0.5) * TILE, (j + 0.5) * TILE, 0.0]), mesh, copies)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Six tiles in a row and one above, from x = -200 to 400."""
    folder = tmp_path_factory.mktemp("scene")
    files = SceneFiles(folder)
    files.tiles.mkdir()
    indices = [(i, 0) for i in range(-2, 4)] + [(0, 1)]
    for rank, (i, j) in enumerate(indices):
        write_tile(files.tile(i, j), tile(i, j, rank))
    crown = box([4, 4, 4], [0, 0, 4.0], klass=Class.TREE_CROWN, material=materials()["foliage"].code)
    write_shapes(files.shapes, {"tree": crown})
    manifest = {
        "schema": SCHEMA,
        "frame": Frame.at(2.0, 48.0).to_json(),
        "bounds": [-200, 0, 400, 200],
        "tile_size": TILE,
        "tiles": [(i, j, 1) for i, j in indices],
        "layers": {},
    }
    files.manifest.write_text(json.dumps(manifest | {"digest": manifest_digest(manifest)}))
    return open_scene(folder)


def test_rays_hit_the_faces_of_the_tiles_and_lookup_returns_their_attributes(scene):
    world = World.load(scene)
    above = np.array([[50.0, 50, 30], [70, 70, 30], [30, 30, 30], [-170, 30, 30], [450, 50, 30]])
    hits = world.caster.cast(above, np.repeat(DOWN, 5, 0), normals=True)
    np.testing.assert_allclose(hits.range, [30, 10, 21, 21, np.inf])
    found = world.lookup(hits)
    kinds = [Class.TERRAIN, Class.BUILDING, Class.TREE_CROWN, Class.TREE_CROWN, Class.UNLABELED]
    assert found.klass.tolist() == kinds
    assert found.feature.tolist() == [2, 102, 1002, 1000, -1]
    assert found.surface.tolist() == [0, WALL, 0, 0, 0]
    np.testing.assert_allclose(hits.normal, [[0, 0, 1]] * 4 + [[0, 0, 0]])


def test_a_world_in_float64_has_the_same_hits(scene):
    above = np.array([[50.0, 50, 30], [70, 70, 30], [30, 30, 30], [450, 50, 30]])
    down = np.repeat(DOWN, 4, 0)
    exact = World.load(scene, backend="float64")
    assert not isinstance(exact.caster.scene, EmbreeScene)
    hits, usual = exact.caster.cast(above, down), World.load(scene).caster.cast(above, down)
    np.testing.assert_allclose(hits.range, usual.range, atol=1e-9)
    assert exact.lookup(hits).feature.tolist() == [2, 102, 1002, -1]


def test_masks_look_through_glass_and_foliage(scene):
    world = World.load(scene)
    into_house = world.caster.cast([70, 0, 5], [[0.0, 1, 0]])
    assert into_house.range == pytest.approx(65)
    assert world.lookup(into_house).material.tolist() == [materials()["glass"].code]
    assert world.caster.cast([70, 0, 5], [[0.0, 1, 0]], mask=ALL & ~GLASS).range == pytest.approx(75)
    assert world.caster.cast([30, 30, 30], DOWN, mask=ALL & ~FOLIAGE).range == pytest.approx(30)


def test_a_region_loads_only_its_own_tiles(scene):
    world = World.load(scene, region=(110, 50, 120, 60), margin=10)
    down = world.caster.cast(
        [[150.0, 50, 30], [50, 50, 30], [250, 50, 30], [-150, 50, 30], [350, 50, 30]], [[0, 0, -1.0]] * 5
    )
    assert np.isfinite(down.range).tolist() == [True, True, False, False, False]
    with pytest.raises(InputError, match="no tile of"):
        World.load(scene, region=(5000, 0, 5010, 10))


def test_away_from_the_scene_there_is_nothing_to_hit(scene):
    """As for an aircraft that turns beyond the area that it surveys."""
    world = World(scene, margin=10)
    for x, hit in ((115.0, True), (5000.0, False), (115.0, True)):
        world.follow((x - 5, 50, x + 5, 60))
        assert world.caster.occluded([[x, 55.0, 30.0]], DOWN).item() == hit
        assert world.has_tiles == hit


def test_hits_do_not_depend_on_earlier_regions(scene):
    rng = np.random.default_rng(1)
    way = rng.normal(size=(20_000, 3))
    eye = np.array([155.0, 52.0, 3.0])
    region = (eye[0], eye[1], eye[0], eye[1])
    roamed = World.load(scene, region=(-150, 50, -150, 50), margin=30)
    for x in (-50.0, 50.0, 390.0, 60.0):
        roamed.follow((x, 50, x, 50))
    roamed.follow(region)
    fresh = World.load(scene, region=region, margin=30)
    one, two = (world.caster.cast(eye, way, normals=True) for world in (roamed, fresh))
    for name in one.__slots__:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    for name in ("feature", "klass", "material"):
        np.testing.assert_array_equal(getattr(roamed.lookup(one), name), getattr(fresh.lookup(two), name))
    assert (one.instance >= 0).any()
    assert len(set(roamed.lookup(one).feature.tolist())) > 4


def test_following_keeps_only_the_tiles_around(scene):
    world = World.load(scene, region=(-150, 50, -150, 50), margin=30)
    for x in np.arange(-150, 350, 20.0):
        world.follow((x, 50, x, 50))
        assert len(world.caster.scene.parts) <= 2 * 4
        assert world.caster.cast([x, 50, 3], DOWN).range == pytest.approx(3)


def test_worlds_read_the_tiles_of_an_open_scene_once(scene, monkeypatch):
    ranks = []

    def load(scene, rank, **given):
        ranks.append(rank)
        return load_tile(scene, rank, **given)

    monkeypatch.setattr("lidar.world.world.load_tile", load)
    opened = open_scene(scene.path)
    for x in (110.0, 150.0, 180.0):
        World.load(opened, region=(x, 50, x, 60))
    assert len(ranks) == len(set(ranks)) > 1
    World.load(opened, region=(110, 50, 110, 60), settings=WorldSettings(trees=False))
    World.load(open_scene(scene.path), region=(110, 50, 110, 60))  # which may be another by now
    assert len(ranks) > len(set(ranks))


@pytest.mark.parametrize(("settings", "x"), [({}, 40960.0), ({"origin": "scene"}, 0.0)])
def test_ranges_stay_exact_over_long_drives(tmp_path, settings, x):
    files = SceneFiles(tmp_path)
    files.tiles.mkdir()
    indices = [(0, 0), (400, 7)]
    for rank, (i, j) in enumerate(indices):
        write_tile(files.tile(i, j), tile(i, j, rank))
    write_shapes(files.shapes, {"tree": box([4, 4, 4], [0, 0, 4.0])})
    manifest = {
        "schema": SCHEMA,
        "frame": Frame.at(2.0, 48.0).to_json(),
        "bounds": [0, 0, 40100, 800],
        "tile_size": TILE,
        "tiles": [(i, j, 1) for i, j in indices],
        "layers": {},
    }
    files.manifest.write_text(json.dumps(manifest | {"digest": manifest_digest(manifest)}))
    world = World.load(open_scene(tmp_path), region=(50, 50, 50, 50), settings=WorldSettings(**settings))
    world.follow((40050, 750, 40050, 750))
    assert world.caster.origin[0] == x
    hits = world.caster.cast([40070.0, 700, 5], [[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(hits.range, 65, rtol=0, atol=1e-9)
    assert world.lookup(hits).feature.tolist() == [101]


def test_rays_intersect_actors_at_their_pose_at_the_ray_time(scene):
    car = box([4, 2, 1.5], [0, 0, 0.75], klass=Class.CAR, feature=7)
    world = World.load(scene, actors=[car])
    before = world.caster.cast([150.0, 50, 1], [[-1.0, 0, 0]] * 5)
    drive = np.tile(np.eye(3, 4), (1, 11, 1, 1))
    drive[0, :, :, 3] = [120, 50, 0]
    drive[0, :, 0, 3] += np.linspace(0, 10, 11)
    world.place_actors(np.zeros(1, np.int32), drive, feature=np.array([5000], np.int32))
    time = np.array([0, 0.25, 0.5, 0.75, 1])
    poses = Poses(np.array([[150.0, 50, 1]]), np.eye(3)[None], np.ones((1, 3)))
    hits = world.caster.cast_posed(
        poses, np.zeros(5, int), directions=np.tile([[-1.0, 0, 0]], (5, 1)), time=time
    )
    np.testing.assert_allclose(hits.range, 30 - 10 * time - 2)
    found = world.lookup(hits)
    assert set(found.feature.tolist()) == {5000}
    assert set(found.klass.tolist()) == {Class.CAR}
    tree = world.lookup(world.caster.cast([30, 30, 30], DOWN))
    assert tree.feature.tolist() == [1002]
    world.place_actors(np.empty(0, np.int32), np.empty((0, 3, 4)), feature=np.empty(0, np.int32))
    np.testing.assert_array_equal(world.caster.cast([150.0, 50, 1], [[-1.0, 0, 0]] * 5).range, before.range)


def test_only_bodies_that_are_placed_are_prepared_for_rays(scene):
    bodies = [box([4, 2, height], [0, 0, height / 2], klass=Class.CAR) for height in (1.0, 2.0, 3.0)]
    world = World.load(scene, actors=bodies)
    assert world.caster.instances[1].shapes == ()
    here = np.tile(np.eye(3, 4), (2, 1, 1))
    here[:, :, 3] = [[150, 50, 0], [170, 50, 0]]
    world.place_actors(np.array([2, 0], np.int32), here, feature=np.array([8, 9], np.int32))
    assert len(world.caster.instances[1].shapes) == 2
    hits = world.caster.cast([[150.0, 50, 10], [170, 50, 10]], np.repeat(DOWN, 2, axis=0))
    np.testing.assert_allclose(hits.range, [7, 9])
    assert world.lookup(hits).feature.tolist() == [8, 9]


@pytest.mark.parametrize("number", [-1, 1])
def test_a_body_that_the_world_does_not_have_is_refused(scene, number):
    world = World.load(scene, actors=[box([4, 2, 1.5], [0, 0, 0.75], klass=Class.CAR)])
    with pytest.raises(InputError, match="beyond the 1 shapes"):
        world.place_actors(np.array([number], np.int32), np.eye(3, 4)[None], feature=np.array([9], np.int32))


def test_actors_stay_when_another_region_is_loaded(scene):
    car = box([4, 2, 1.5], [0, 0, 0.75], klass=Class.CAR)
    world = World.load(scene, region=(50, 50, 50, 50), margin=10, actors=[car])
    here = np.eye(3, 4)[None].copy()
    here[0, :, 3] = [150, 50, 0]
    world.place_actors(np.zeros(1, np.int32), here, feature=np.array([9], np.int32))
    for x in (150.0, 250.0, 150.0):
        world.follow((x, 50, x, 50))
        hits = world.caster.cast([150, 50, 10], DOWN)
        assert hits.range == pytest.approx(8.5)
        assert world.lookup(hits).feature.tolist() == [9]


def test_the_origin_of_the_scene_and_the_float64_backend_give_the_same_hits(scene):
    region = (150, 50, 160, 60)
    rng = np.random.default_rng(3)
    eye, way = np.array([150.0, 50.0, 5.0]), rng.normal(size=(2000, 3))
    near = World.load(scene, region=region, margin=100)
    for options in ({"settings": WorldSettings(origin="scene")}, {"backend": "float64"}):
        other = World.load(scene, region=region, margin=100, **options)
        one, two = near.caster.cast(eye, way), other.caster.cast(eye, way)
        np.testing.assert_allclose(two.range, one.range, atol=1e-9)
        np.testing.assert_array_equal(other.lookup(two).feature, near.lookup(one).feature)
    assert type(other.caster.scene) is Float64Scene


def test_tiles_beyond_the_reach_are_not_loaded(scene):
    region = (50.0, 50.0, 50.0, 50.0)
    whole, part = (
        World.load(scene, region=region, margin=300, settings=WorldSettings(reach=reach))
        for reach in (np.inf, 10)
    )
    assert (whole.margin, whole.reach, part.margin, part.reach) == (300, np.inf, 10, 10)
    far = [[250.0, 50, 30]]
    assert np.isfinite(whole.caster.cast(far[0], DOWN).range).all()
    assert np.isinf(part.caster.cast(far[0], DOWN).range).all()


@pytest.mark.parametrize(
    ("name", "klass"), [("trees", Class.TREE_CROWN), ("furniture", Class.POLE), ("barriers", Class.WALL)]
)
def test_classes_of_settings_are_left_out_of_tiles(tmp_path, name, klass):
    files = SceneFiles(tmp_path)
    files.tiles.mkdir()
    parts = [ground(0), box([1, 1, 6], [30, 30, 3.0], klass=klass, feature=55)]
    copies = ShapeInstances(np.zeros(1, np.int32), np.array([np.eye(3, 4)]), np.array([77], np.int32))
    write_tile(files.tile(0, 0), Tile(np.full(3, TILE / 2) * [1, 1, 0], concatenate(parts), copies))
    write_shapes(files.shapes, {"thing": box([4, 4, 4], [0, 0, 4.0], klass=klass)})
    manifest = {
        "schema": SCHEMA,
        "frame": Frame.at(2.0, 48.0).to_json(),
        "bounds": [0, 0, 100, 100],
        "tile_size": TILE,
        "tiles": [(0, 0, 1)],
        "layers": {},
    }
    files.manifest.write_text(json.dumps(manifest | {"digest": manifest_digest(manifest)}))
    scene = open_scene(tmp_path)
    above = np.array([[50, 50, 30.0], [80, 80, 30.0]])
    for chosen, features in (({}, [77, 55]), ({name: False}, [0, 0])):
        world = World.load(scene, settings=WorldSettings(**chosen))
        assert world.lookup(world.caster.cast(above, np.repeat(DOWN, 2, 0))).feature.tolist() == features


def test_rays_far_from_the_origin_of_the_scene_are_told():
    assert origin_limit(np.array([[9000.0, 4000.0, 100.0]])) == []
    (limit,) = origin_limit(np.array([[0.0, 0.0, 0.0], [48_000.0, -36_000.0, 0.0]]))
    assert (limit.measured, limit.bound, limit.unit) == (60.0, 10.0, "km")
    assert "14.3 mm" in limit.advice


def test_what_lies_under_a_roof_is_neither_wet_nor_under_snow(tmp_path):
    """Two slabs of ground side by side, one under a bridge; its deck is open, as is the ground beside it."""
    deck = box([20, 60, 1], [30.0, 30.0, 6.0], klass=Class.BRIDGE, feature=2)
    corners = [(x, y) for x in (20.0, 40.0) for y in (0.0, 60.0)]
    sheltered = Mesh.of(
        np.array([[x, y, 0.0] for x, y in corners]), [[0, 2, 3], [0, 3, 1]], klass=Class.ROAD, feature=1
    )
    beside = Mesh.of(
        np.array([[x + 30, y, 0.0] for x, y in corners]), [[0, 2, 3], [0, 3, 1]], klass=Class.ROAD, feature=3
    )
    (tmp_path / "tiles").mkdir()
    files = SceneFiles(tmp_path)
    whole = concatenate([sheltered, deck, beside])
    none = ShapeInstances(np.empty(0, np.int32), np.empty((0, 3, 4)), np.empty(0, np.int32))
    write_tile(files.tile(0, 0), Tile(np.zeros(3), whole, none))
    write_shapes(files.shapes, {})
    manifest = {
        "schema": SCHEMA,
        "frame": Frame.at(2.0, 48.0).to_json(),
        "bounds": [0, 0, 100, 100],
        "tile_size": TILE,
        "tiles": [(0, 0, 1)],
        "layers": {},
    }
    files.manifest.write_text(json.dumps(manifest | {"digest": manifest_digest(manifest)}))
    scene = open_scene(tmp_path)
    start = np.array([[30.0, 30, 3], [30, 30, 20], [55, 30, 3]])
    for settings, is_open in (
        (WorldSettings(), [False] * 3),
        (WorldSettings(wetness=0.5), [False, True, True]),
        (WorldSettings(snow=0.5), [False, True, True]),
    ):
        found = World.load(scene, settings=settings)
        hits = found.caster.cast(start, np.repeat(DOWN, 3, 0))
        assert found.lookup(hits).feature.tolist() == [1, 2, 3]
        assert ((found.lookup(hits).material & OPEN) > 0).tolist() == is_open
        code = found.faces.packed[hits.face + found.faces.start[hits.instance]] & OPEN
        assert (code > 0).tolist() == is_open
    with pytest.raises(InputError, match=r"wetness = 2 is not within 0 to 1; snow = -1 is not within"):
        WorldSettings(wetness=2, snow=-1)
