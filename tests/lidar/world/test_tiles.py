"""What drives use of the relief of a scene: all of it, none, or what plain relief has."""

import gc
import threading
import time
import weakref

import numpy as np
import pytest

from geoscene.classes import Class
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from geoscene.sources.data import OsmData, TaggedNode, Way
from geoscene.uses import RELIEFS
from lidar.errors import InputError
from lidar.options.drive import DriveOptions
from lidar.simulation.plan import plan_drive
from lidar.world.settings import WorldSettings
from lidar.world.tiles import SharedTiles, selected_tile
from lidar.world.world import World

BOX = (24.9405, 60.1655, 24.9440, 60.1675)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """One place with each relief, with flat roofs: parapets of full relief are part of the solids."""
    osm, folder = read_osm(demo_path(), bounds=BOX), tmp_path_factory.mktemp("scenes")
    return {
        relief: build(osm, folder / relief, options=BuildOptions(relief=relief, lod=1, use="lidar"))
        for relief in RELIEFS
    }


def contents(scene, relief):
    """Corners of faces of solids with class and material, and names of shapes with their places."""
    shapes = scene.shapes()
    names = list(shapes)
    faces, copies = set(), []
    for rank in range(len(scene.tile_indices)):
        tile = selected_tile(scene, rank, settings=WorldSettings(relief=relief), shapes=shapes)
        mesh, some = (
            tile.mesh.take(tile.mesh.closed).shifted(tile.origin),
            tile.instances.shifted(tile.origin),
        )
        rows = np.column_stack([mesh.vertices[mesh.faces].reshape(-1, 9), mesh.klass, mesh.material])
        faces |= set(map(tuple, np.round(rows, 4).tolist()))
        copies += [
            (names[shape], *np.round(matrix.ravel(), 4).tolist())
            for shape, matrix in zip(some.shape, some.transform, strict=True)
        ]
        assert tile.relief is not None
        assert len(tile.relief.wall) == len(tile.mesh)
    return faces, sorted(copies)


def test_plain_leaves_out_of_a_full_scene_what_full_adds(scenes):
    everything, wanted = contents(scenes["full"], "scene"), contents(scenes["plain"], "scene")
    assert len(everything[0]) > len(wanted[0]) > 0
    assert len(everything[1]) > len(wanted[1]) > 0
    assert {"bicycle_stand_1", "bicycle_stand_2"} & {name for name, *_ in everything[1]}
    assert contents(scenes["full"], "plain") == wanted
    assert contents(scenes["plain"], "plain") == wanted


def test_off_leaves_out_what_full_adds(scenes):
    assert contents(scenes["full"], "off") == contents(scenes["plain"], "off")


def test_full_is_all_that_a_full_scene_holds(scenes):
    assert contents(scenes["full"], "full") == contents(scenes["full"], "scene")


@pytest.mark.parametrize(
    ("built", "asked"), [("off", "plain"), ("off", "full"), ("off", "mesh"), ("plain", "full")]
)
def test_relief_that_a_scene_does_not_hold_is_refused(scenes, built, asked):
    scene = scenes[built]
    message = f"`relief` {asked}: .*{built} was built with relief {built}; build it again with `relief`"
    with pytest.raises(InputError, match=message):
        World(scene, settings=WorldSettings(relief=asked))
    with pytest.raises(InputError, match=message):
        plan_drive(scene, DriveOptions(route="random", rig="vlp16", relief=asked))


def test_the_option_is_short_for_the_setting_and_in_no_other_way_part_of_the_recipe(scenes):
    scene, given = scenes["full"], {"route": "random", "rig": "vlp16"}
    short = DriveOptions(relief="plain", **given)
    assert short == DriveOptions(settings=(("relief", "plain"),), **given)
    assert short.recording_settings.world.relief == "plain"
    assert short.recipe(scene)["settings"] == [["relief", "plain"]]
    assert "relief" not in DriveOptions(**given).recipe(scene)
    with pytest.raises(InputError, match="`settings` relief is given, too"):
        DriveOptions(relief="plain", settings=(("relief", "off"),), **given)
    with pytest.raises(InputError, match="relief = 'rough' is none of scene, off, plain, full, mesh"):
        DriveOptions(relief="rough", **given)


class _Value:
    pass


@pytest.mark.full
def test_a_tile_is_loaded_again_only_when_no_one_holds_it():
    shared = SharedTiles()
    held = shared.get("a", _Value)
    assert shared.get("a", _Value) is held
    shared.keep([held])
    known = weakref.ref(held)
    del held
    gc.collect()
    assert shared.get("a", _Value) is known()
    shared.keep([])
    gc.collect()
    assert known() is None


def test_threads_load_a_tile_once():
    shared = SharedTiles()
    made = []

    def make():
        time.sleep(0.05)
        made.append(_Value())
        return made[-1]

    threads = [threading.Thread(target=shared.get, args=("a", make)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1


@pytest.mark.full
def test_leaves_let_rays_pass_and_limbs_do_not(tmp_path):
    """A crown holds leaf clusters and limbs; only the faces of clusters have leaves behind them."""
    road = Way("way/1", {"highway": "residential"}, np.arange(2), np.array([[11.0, 50.0], [11.001, 50.0]]))
    tree = TaggedNode("node/9", {"natural": "tree"}, 11.0005, 50.0002)
    osm = OsmData((11.0, 49.9995, 11.001, 50.0005), [road], [], [tree], [])
    scene = build(osm, tmp_path / "scene", options=BuildOptions(relief="plain"))
    world = World.load(scene)
    faces = world.faces
    klass, leaves = (faces.packed >> 8) & 255, faces.leaves[(faces.packed >> 16) & 255]
    assert (leaves[klass == Class.TREE_CROWN] > 1.0).sum() > 1000
    assert (leaves[klass == Class.TREE_CROWN] > 0).all()
    assert (leaves[klass == Class.TRUNK] == 0).all()
