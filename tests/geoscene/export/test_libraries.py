"""Scenes as objects of trimesh, Open3D and networkx."""

import sys

import numpy as np
import pytest
from helpers.export_worlds import write_world

from geoscene.errors import MissingExtraError, SceneFormatError
from geoscene.export.libraries import to_networkx, to_open3d, to_trimesh
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene.validate import check_scene
from geoscene.sources import demo_path, read_osm


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    data = read_osm(demo_path(), bounds=(24.944, 60.1668, 24.947, 60.1680))
    return build(data, tmp_path_factory.mktemp("demo") / "scene", options=BuildOptions())


def test_trimesh_mesh_has_the_same_triangles_and_solids(demo):
    found = to_trimesh(demo)
    assert {"road", "building", "tree_crown"} < set(found.geometry)
    buildings = found.geometry["building"]
    feature = buildings.face_attributes["feature"]
    for number in np.unique(feature)[:20]:
        solid = buildings.submesh([np.flatnonzero(feature == number)], append=True)
        solid.merge_vertices()
        assert solid.is_watertight
        assert solid.volume > 0
    assert check_scene(demo)["broken"] == []
    some = to_trimesh(demo, layers=["buildings"]).geometry
    assert np.array_equal(some["building"].faces, buildings.faces)
    assert "road" not in some


def test_osmnx_routes_on_the_graph(demo):
    graph = to_networkx(demo)
    assert len(graph.edges) == len(demo.road_graph())
    length = sum(edge["length"] for _, _, edge in graph.edges(data=True))
    assert length == pytest.approx(demo.road_graph().length.sum(), abs=1)


def test_open3d_mesh_has_the_same_triangles(demo):
    pytest.importorskip("open3d")
    assert {k: len(m.triangle.indices) for k, m in to_open3d(demo).items()} == {
        k: len(m.faces) for k, m in to_trimesh(demo).geometry.items()
    }


def test_error_names_missing_roads_or_the_missing_extra(tmp_path, monkeypatch):
    scene = write_world(tmp_path / "world")
    scene.files.road_graph.unlink(missing_ok=True)
    with pytest.raises(SceneFormatError, match="no roads"):
        to_networkx(scene)
    for module, read in (("trimesh", to_trimesh), ("open3d", to_open3d), ("osmnx", to_networkx)):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match=rf"geoscene\[{module}\]"):
            read(scene)
