"""The folder of a page holds the whole scene as a tree of files, coarse above, and nothing else."""

import json
import re
from base64 import b64decode
from zlib import decompress

import numpy as np
import pytest
from helpers.scenes import same_files
from helpers.view_tiles import unpack_tile

from geoscene.errors import InputError
from geoscene.options import BuildOptions, ViewOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from geoscene.view import view_scene
from geoscene.view.looks import read_looks
from geoscene.view.tiles import STEP

BOX = (24.9405, 60.1655, 24.9475, 60.1690)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    osm = read_osm(demo_path(), bounds=BOX)
    return build(
        osm, tmp_path_factory.mktemp("streamed") / "demo", options=BuildOptions(name="demo", tile_size=50.0)
    )


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "page"
    summary = view_scene(scene, out)
    assert summary.faces == scene.manifest["counts"]["faces"]
    assert summary.files == len(list(out.rglob("*.*")))
    assert summary.bytes == sum(file.stat().st_size for file in out.rglob("*.*"))
    return out


@pytest.fixture(scope="module")
def head(folder):
    text = (folder / "index.html").read_text("utf-8")
    return json.loads(re.search(r'id="head">([^<]*)<', text)[1])


def node(folder, number):
    """Header and contents of a node's file."""
    text = (folder / "nodes" / f"{number}.js").read_text("utf-8")
    told = re.fullmatch(r'geosceneNode\((\d+),(\{.*\}),"([A-Za-z0-9+/=]*)"\);\n', text)
    assert int(told[1]) == number
    header = json.loads(told[2])
    return header, unpack_tile(header, b64decode(told[3]))[0]


def triangles(tile):
    """Corners of the faces in quantisation steps with feature and colour, sorted."""
    mesh = tile.mesh
    corners = np.rint((mesh.vertices + tile.origin) / STEP).astype(np.int64)[mesh.faces].reshape(-1, 9)
    table = np.column_stack([corners, mesh.feature, mesh.color])
    return table[np.lexsort(table.T)]


def test_the_leaves_of_the_tree_are_the_tiles_of_the_scene(scene, folder, head):
    leaves = [k for k, row in enumerate(head["nodes"]) if not row[7:]]
    assert len(leaves) == len(scene.tile_indices) > 20
    looks = read_looks(scene)
    found = sorted(triangles(node(folder, k)[1]).tolist() for k in leaves)
    assert found == sorted(triangles(looks.dressed(tile)).tolist() for tile in scene.tiles())
    assert sum(len(node(folder, k)[1].instances) for k in leaves) == scene.manifest["counts"]["instances"]


def test_every_node_is_reached_once_and_is_coarser_than_its_children(folder, head):
    nodes = head["nodes"]
    seen = []

    def walk(number):
        seen.append(number)
        *box, error = nodes[number][:7]
        for child in nodes[number][7:]:
            assert nodes[child][6] < error
            assert np.all(np.array(nodes[child][:3]) >= box[:3])
            assert np.all(np.array(nodes[child][3:6]) <= box[3:])
            walk(child)

    assert 1 <= len(head["roots"]) <= 4
    for root in head["roots"]:
        walk(root)
    assert sorted(seen) == list(range(len(nodes)))
    assert {file.name for file in (folder / "nodes").iterdir()} == {f"{k}.js" for k in seen}


def test_coarse_nodes_have_fewer_faces_within_their_error(folder, head):
    for root in head["roots"]:
        error = head["nodes"][root][6]
        coarse = node(folder, root)[1]
        below = [node(folder, child)[1] for child in head["nodes"][root][7:]]
        assert 0 < len(coarse.mesh) < sum(len(tile.mesh) for tile in below)
        fine = np.concatenate([tile.mesh.vertices + tile.origin for tile in below])
        from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

        apart, _ = cKDTree(fine).query(coarse.mesh.vertices + coarse.origin)
        assert apart.max() <= 2 * STEP  # vertices of the scene, quantised
        assert error > 0


def test_boxes_of_features_hold_their_triangles(scene, folder):
    parts = re.findall(r'"([A-Za-z0-9+/=]*)"', (folder / "attributes.js").read_text("utf-8"))
    values = np.frombuffer(decompress(b64decode(parts[1]), 31), "<i4").reshape(7, -1)
    low, high = values[1:4].T / 100, values[4:].T / 100
    points = [(t.mesh.feature, t.mesh.vertices[t.mesh.faces] + t.origin) for t in scene.tiles()]
    feature, corners = (np.concatenate(column) for column in zip(*points, strict=True))
    for row, number in enumerate(values[0].tolist()):
        own = corners[feature == number].reshape(-1, 3)
        if len(own):
            assert np.all(own >= low[row] - 1e-6)
            assert np.all(own <= high[row] + 1e-6)
    solid = np.isin(values[0], np.arange(*scene.layers["buildings"]))
    for row in np.flatnonzero(solid):
        own = corners[feature == values[0, row]].reshape(-1, 3)
        assert np.allclose([own.min(axis=0), own.max(axis=0)], [low[row], high[row]], atol=0.011)


def test_the_folder_is_reproducible_and_replaced_only_with_overwrite(scene, folder, tmp_path):
    again = tmp_path / "page"
    view_scene(scene, again)
    same_files(folder, again)
    with pytest.raises(InputError, match="overwrite"):
        view_scene(scene, again)
    (again / "nodes" / "0.js").write_text("old")
    (again / "mine.txt").write_text("kept")
    view_scene(scene, again, overwrite=True)
    assert (again / "mine.txt").read_text() == "kept"
    (again / "mine.txt").unlink()
    same_files(folder, again)
    other = tmp_path / "other"
    other.mkdir()
    (other / "index.html").write_text("of another program")
    with pytest.raises(InputError, match="holds no"):
        view_scene(scene, other, overwrite=True)
    assert [file.name for file in other.iterdir()] == ["index.html"]


def test_the_page_loads_scripts_of_its_own_folder_alone(folder):
    text = (folder / "index.html").read_text("utf-8")
    assert "default-src 'none'; script-src 'unsafe-inline' 'self' file:;" in text
    assert not [word for word in ("fetch(", "XMLHttpRequest", "WebSocket", "import(", "url(") if word in text]


def test_bounds_and_layers_apply_to_the_folder(scene, tmp_path):
    x, y = scene.tile_size * 0.25, scene.tile_size * 0.25
    lon, lat = scene.frame.to_geographic([x, x + 10], [y, y + 10])
    options = ViewOptions(bounds_deg=(lon[0], lat[0], lon[1], lat[1]), layers=("ground", "buildings"))
    summary = view_scene(scene, tmp_path / "part", options=options)
    assert 0 < summary.faces < len(scene.tile(0, 0).mesh)
    assert "1 of the scene's" in summary.notes[0]
    assert "layers left out" in summary.notes[1]
