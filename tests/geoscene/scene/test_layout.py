"""File names of a scene are defined in one module; damaged scenes are refused by the name of the file."""

import ast
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import ROOT
from helpers.export_worlds import write_world
from helpers.programs import run_program
from helpers.scenes import restated

from geoscene.errors import SceneFormatError
from geoscene.scene import SceneFiles, layout, open_scene
from geoscene.scene.layout import changed_files, using
from geoscene.scene.tile_files import read_tile, write_tile


def test_scene_file_names_occur_only_in_the_layout_module():
    files = SceneFiles(Path())
    named = [files.manifest, files.features, files.road_graph, files.problems, files.shapes]
    names = {str(path) for path in [*named, files.tile_reports, files.tile_journal]}
    spelled = []
    for folder in ("geoscene", "lidar", "examples", "benchmarks"):
        for module in (ROOT / folder).rglob("*.py"):
            if module.samefile(layout.__file__):
                continue
            text = module.read_text("utf-8")
            if not any(name in text for name in names):
                continue
            tree = ast.parse(text)
            found = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)} & names
            spelled += [f"{module}: {name}" for name in found]
    assert not spelled


def test_features_are_read_in_scene_or_projected_metres_or_without_geometry(tmp_path):
    scene = write_world(tmp_path / "scene")
    near, far = (scene.features("roads", geometry=kind) for kind in ("scene", "projected"))
    east, north = scene.frame.origin
    x, y, *_ = near.geometry[0].coords[0]
    assert far.geometry[0].coords[0][:2] == pytest.approx((x + east, y + north))
    bare = scene.features("roads", geometry="none")
    assert list(bare.geometry) == [None] * len(near)
    assert set(bare.columns) == set(scene.schema("roads").columns)
    assert list(scene.features("roads", rows=range(1, 3)).columns["feature"]) == list(
        near.columns["feature"][1:3]
    )
    assert len(scene.road_graph()) == len(near)


@pytest.fixture
def copied(scene, tmp_path):
    shutil.copytree(scene.path, tmp_path / "scene")
    return tmp_path / "scene"


def used(path):
    """Everything that a scene holds, read."""
    scene = open_scene(path)
    list(scene.tiles()), scene.shapes(), scene.road_graph()
    for layer, (start, stop) in scene.layers.items():
        if stop > start:
            scene.features(layer), scene.schema(layer)


FILES = ["scene.json", "features.gpkg", "roads.graphml", "shapes.npz", "tiles"]


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("damage", ["empty", "cut", "zeros", "text", "missing"])
def test_damaged_files_give_one_line_that_names_them(copied, name, damage):
    path = next((copied / name).iterdir()) if name == "tiles" else copied / name
    data = path.read_bytes()
    middle = len(data) // 2
    path.unlink()
    if damage != "missing":
        holed = data[: middle // 2] + bytes(middle) + data[middle // 2 + middle :]
        changed = {"zeros": holed, "empty": b"", "cut": data[:middle], "text": b"hello"}
        path.write_bytes(
            changed.get(damage, data[: middle // 2] + bytes(middle) + data[middle // 2 + middle :])
        )
    with pytest.raises(SceneFormatError) as raised:
        used(copied)
    text = str(raised.value)
    assert "\n" not in text
    assert path.name in text


@pytest.mark.parametrize("name", ["shapes.npz", "tiles"])
def test_columns_that_do_not_fit_their_mesh_name_the_file(copied, name):
    path = next((copied / name).iterdir()) if name == "tiles" else copied / name
    with np.load(path) as file:
        arrays = dict(file)
    column = next(key for key in arrays if key.endswith("surface"))
    for damaged in (np.tile(arrays[column], 2), arrays[column][:, None], arrays[column][0]):
        np.savez(path, **(arrays | {column: damaged}))
        restated(copied)
        with pytest.raises(SceneFormatError, match=path.name):
            used(copied)


@pytest.mark.parametrize("what", ["swapped", "shifted", "features", "roads", "reports"])
def test_files_of_other_places_and_scenes_are_refused(copied, what, tmp_path):
    tiles = sorted((copied / "tiles").iterdir())
    foreign = write_world(tmp_path / "other").path
    if what == "swapped":
        changed, data = tiles[:2], [tiles[1].read_bytes(), tiles[0].read_bytes()]
    elif what == "shifted":
        tile = read_tile(tiles[0])
        write_tile(tmp_path / "a.npz", replace(tile, origin=tile.origin + np.array([5.0, 0.0, 0.0])))
        changed, data = tiles[:1], [(tmp_path / "a.npz").read_bytes()]
    else:
        names = {"features": "features.gpkg", "roads": "roads.graphml", "reports": "tiles.json"}
        changed, data = [copied / names[what]], [(foreign / names[what]).read_bytes()]
    for path, content in zip(changed, data, strict=True):
        path.write_bytes(content)
    assert set(changed) <= set(changed_files(open_scene(copied)))
    with pytest.raises(SceneFormatError, match=f"{changed[0].name}: differs from what the build wrote"):
        used(copied)
    done = run_program("geoscene", "validate", copied)
    assert done.returncode == 1
    assert all(f"{path}: differs from what the build wrote" in done.stdout for path in changed)
    assert not done.stderr


def test_a_geopackage_that_a_program_has_only_opened_is_the_same(copied):
    path = copied / "features.gpkg"
    before = path.read_bytes()
    with closing(sqlite3.connect(path)) as database:  # as QGIS does
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("PRAGMA journal_mode=DELETE")
    assert path.read_bytes() != before
    assert changed_files(open_scene(copied)) == []
    used(copied)
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE mine (a)")
    assert changed_files(open_scene(copied)) == [path]


def test_unexpected_error_is_explained_by_a_changed_file(copied):
    with pytest.raises(ZeroDivisionError), using(open_scene(copied)):
        _ = 1 / 0
    tile = next((copied / "tiles").iterdir())
    tile.write_bytes(b"")
    assert changed_files(open_scene(copied)) == [tile]
    message = rf"{tile.name}: differs from what the build wrote"
    with pytest.raises(SceneFormatError, match=message), using(open_scene(copied)):
        _ = 1 / 0


@pytest.mark.parametrize(("old", "new"), [('"tile_size": 250', '"tile_size": 251'), ('"digest"', '"other"')])
def test_edited_manifest_is_refused(copied, old, new):
    path = copied / "scene.json"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SceneFormatError, match=r"scene\.json: differs"):
        open_scene(copied)
