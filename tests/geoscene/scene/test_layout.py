"""File names of a scene are defined in one module."""

import ast
from pathlib import Path

import pytest
from helpers.export_worlds import write_world

from geoscene.scene import SceneFiles, layout

REPOSITORY = Path(__file__).parents[3]


def test_scene_file_names_occur_only_in_the_layout_module():
    files = SceneFiles(Path())
    named = [files.manifest, files.features, files.road_graph, files.problems, files.shapes]
    names = {str(path) for path in [*named, files.tile_reports, files.tile_journal]}
    spelled = []
    for folder in ("geoscene", "lidar", "examples", "benchmarks"):
        for module in (REPOSITORY / folder).rglob("*.py"):
            if module.samefile(layout.__file__):
                continue
            tree = ast.parse(module.read_text("utf-8"))
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
