"""The folder of a page holds the whole scene as a tree of files, coarse above, and nothing else."""

import json
import re
from base64 import b64decode
from collections import Counter
from dataclasses import replace
from zlib import decompress

import numpy as np
import pytest
import shapely
from helpers.scenes import same_files
from helpers.view_tiles import unpack_tile
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.classes import Class
from geoscene.errors import InputError
from geoscene.geometry.mesh import FLOOR, ROOF, WALL, Mesh, ShapeInstances, concatenate
from geoscene.options import BuildOptions, ViewOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from geoscene.view import view_scene
from geoscene.view.looks import read_looks
from geoscene.view.streamed import coarser_mesh, fewer_instances
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


@pytest.mark.full
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


@pytest.mark.full
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


SQUARE = (0.0, 0.0, 64.0, 64.0)


def terrain(seed, count, box=SQUARE, edge=()):
    """A triangulated surface over a box; ``edge`` are further points (x, y, z) on its sides."""
    rng = np.random.default_rng(seed)
    xmin, ymin, xmax, ymax = box
    inner = rng.uniform((xmin, ymin), (xmax, ymax), (count, 2))
    corners = [(x, y) for x in (xmin, xmax) for y in (ymin, ymax)]
    points = np.vstack([inner, corners, *[[(x, y)] for x, y, _ in edge]])
    z = np.concatenate([rng.uniform(0, 9, count), np.zeros(4), [z for *_, z in edge]])
    triangles = shapely.delaunay_triangles(shapely.MultiPoint(points)).geoms
    lookup = {tuple(p): k for k, p in enumerate(points.tolist())}
    faces = [[lookup[c] for c in list(t.exterior.coords)[2::-1]] for t in triangles]
    area = np.array([shapely.Polygon(points[f]).exterior.is_ccw for f in faces])
    faces = np.array([f if ccw else f[::-1] for f, ccw in zip(faces, area, strict=True)])
    return Mesh.of(np.column_stack([points, z]), faces, feature=np.arange(len(faces)))


def sides(mesh):
    """Directed edges of a mesh by the places of their ends, with how often they occur."""
    corners = [tuple(map(tuple, mesh.vertices[face].tolist())) for face in mesh.faces]
    return Counter(edge for a, b, c in corners for edge in ((a, b), (b, c), (c, a)))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(3, 120), st.sampled_from([0.5, 4.0, 20.0, 100.0]))
def test_vertices_stay_vertices_of_the_surface_within_their_cell(seed, count, cell):
    mesh = terrain(seed, count)
    coarse = coarser_mesh(mesh, cell=cell, box=SQUARE)
    known = {tuple(v) for v in mesh.vertices.tolist()}
    assert {tuple(v) for v in coarse.vertices.tolist()} <= known
    a, b, c = coarse.faces.T
    assert ((a != b) & (b != c) & (c != a)).all()
    cells = np.floor(mesh.vertices / cell)
    for face, number in zip(coarse.faces, coarse.feature, strict=True):
        before = {tuple(row) for row in cells[mesh.faces[number]].tolist()}
        assert {tuple(row) for row in np.floor(coarse.vertices[face] / cell).tolist()} == before


@pytest.mark.full
@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(3, 120),
    st.lists(st.tuples(st.integers(1, 639), st.floats(0, 9)), max_size=30, unique_by=lambda p: p[0]),
    st.sampled_from([1.0, 5.0, 24.0]),
)
def test_neighbours_keep_their_common_side_without_gaps(seed, count, edge, cell):
    points = [(64.0, y / 10, z) for y, z in edge]
    west = coarser_mesh(terrain(seed, count, edge=points), cell=cell, box=SQUARE)
    box = (64.0, 0.0, 128.0, 64.0)
    east = coarser_mesh(terrain(seed + 1, count, box, points), cell=cell, box=box)
    at = [
        {
            edge: n
            for edge, n in sides(mesh).items()
            if edge[0][0] == edge[1][0] == 64.0 and edge[::-1] not in sides(mesh)
        }
        for mesh in (west, east)
    ]
    ends = [sorted({end for edge in side for end in edge}) for side in at]
    assert ends[0] == ends[1]


@pytest.mark.full
def test_a_coarser_cell_gives_fewer_faces_and_keeps_the_outline():
    mesh = terrain(1, 4000)
    counts = []
    for cell in (1.0, 4.0, 16.0):
        coarse = coarser_mesh(mesh, cell=cell, box=SQUARE)
        counts.append(len(coarse))
        covered = shapely.union_all(shapely.polygons(coarse.vertices[coarse.faces][:, :, :2]))
        assert shapely.area(covered) == pytest.approx(64.0**2, rel=0.02)
    assert counts[0] > 2 * counts[1] > 8 * counts[2]


def test_bare_ground_is_coarser_than_what_is_mapped_and_keeps_its_edge_with_it():
    mesh = terrain(2, 3000)
    west = mesh.vertices[mesh.faces][:, :, 0].max(axis=1) < 32.0
    klass = np.where(west, np.uint8(Class.GRASS), np.uint8(Class.TERRAIN))
    half = replace(mesh, klass=klass)
    coarse, all_mapped = (coarser_mesh(m, cell=2.0, box=SQUARE) for m in (half, mesh))
    assert (coarse.klass == Class.GRASS).sum() == len(all_mapped.take(west[all_mapped.feature]))
    assert (coarse.klass == Class.TERRAIN).sum() < 0.3 * len(all_mapped.take(~west[all_mapped.feature]))
    covered = shapely.union_all(shapely.polygons(coarse.vertices[coarse.faces][:, :, :2]))
    assert shapely.area(covered) == pytest.approx(64.0**2, rel=0.02)


def test_solids_keep_walls_and_roofs_but_no_undersides():
    low, high = np.array([10.0, 10.0, 0.0]), np.array([30.0, 25.0, 12.0])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
    quads = {
        FLOOR: [(0, 2, 6, 4)],
        ROOF: [(1, 5, 7, 3)],
        WALL: [(0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5)],
    }
    faces = [(q[0], q[k], q[k + 1]) for side in quads.values() for q in side for k in (1, 2)]
    surface = [side for side, rows in quads.items() for _ in rows for _ in (1, 2)]
    house = Mesh.of(corners, np.array(faces), surface=np.array(surface), closed=True)
    small = house.shifted((0.2, 0.2, 0.2))
    coarse = coarser_mesh(concatenate([house, terrain(3, 50)]), cell=2.0, box=SQUARE)
    solid = coarse.take(coarse.closed)
    assert np.array_equal(solid.vertices, house.vertices)
    assert sorted(set(solid.surface.tolist())) == [WALL, ROOF]
    assert len(solid) == 10
    assert not coarser_mesh(small, cell=100.0, box=SQUARE).closed.any()


def test_fewer_trees_cover_as_much_and_do_not_depend_on_the_others():
    rng = np.random.default_rng(5)
    count = 6000
    matrix = np.zeros((count, 3, 4))
    for axis in range(3):
        matrix[:, axis, axis] = rng.uniform(3, 9, count)
    matrix[:, :2, 3] = rng.uniform(-500, 500, (count, 2))
    trees = ShapeInstances(np.zeros(count, np.int32), matrix, np.arange(count, dtype=np.int32))
    sizes = np.ones((1, 3))
    some = fewer_instances(trees, sizes, cell=2.0, share=0.25, seed=1)
    assert len(some) == pytest.approx(0.25 * count, rel=0.08)

    def covered(copies):
        return (copies.transform[:, 0, 0] * copies.transform[:, 1, 1]).sum()

    assert covered(some) == pytest.approx(covered(trees), rel=0.08)
    assert np.array_equal(some.transform[:, 2], matrix[some.feature, 2])
    half = fewer_instances(trees.take(slice(0, count // 2)), sizes, cell=2.0, share=0.25, seed=1)
    assert half.feature.tolist() == [f for f in some.feature.tolist() if f < count // 2]
    other = fewer_instances(trees, sizes, cell=2.0, share=0.25, seed=2)
    assert len(np.intersect1d(other.feature, some.feature)) < 0.5 * len(some)
    assert len(fewer_instances(trees, sizes, cell=100.0, share=0.25, seed=1)) == 0


@pytest.mark.parametrize(
    ("sides", "remains"),
    [((0.4, 0.4, 30.0), False), ((0.6, 0.6, 30.0), True), ((8.0, 0.1, 0.8), False), ((8.0, 0.1, 1.2), True)],
)
def test_instances_remain_if_two_of_their_sides_are_seen_and_keep_their_height(sides, remains):
    """Of a quarter of masts and of walls, those that remain are twice as wide; half a cell is one metre."""
    count = 40
    matrix = np.tile(np.eye(3, 4), (count, 1, 1))
    matrix[:, 0, 3] = 10.0 * np.arange(count)
    copies = ShapeInstances(np.zeros(count, np.int32), matrix, np.arange(count, dtype=np.int32))
    some = fewer_instances(copies, np.array([sides]), cell=2.0, share=0.25, seed=1)
    assert bool(len(some)) == remains
    assert (some.transform[:, :, :3] == np.diag([2.0, 2.0, 1.0])).all()
