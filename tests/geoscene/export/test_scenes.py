"""Semantics, attributes and positions in CityJSON, GLB and 3D Tiles."""

import json
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.export_worlds import SLOPE, TREES, write_world
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import InputError
from geoscene.export import export_scene
from geoscene.export.cityjson import LOD
from geoscene.export.shells import Vertices, manifold_patches
from geoscene.geometry.mesh import Mesh
from geoscene.geometry.watertight import validate_mesh
from geoscene.objects.shapes import shapes
from geoscene.options import ExportOptions


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("scene") / "world")


@pytest.fixture(scope="module")
def city(scene, tmp_path_factory):
    return json.loads(export_scene(scene, tmp_path_factory.mktemp("out") / "a.city.json").path.read_text())


@pytest.fixture(scope="module")
def tiles(scene, tmp_path_factory):
    return export_scene(
        scene, tmp_path_factory.mktemp("out") / "tiles", options=ExportOptions(kind="3dtiles")
    ).path


def _glb(path):
    """JSON and buffer of a binary glTF; asserts that its lengths are right."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    rest, name = struct.unpack_from("<I4s", data, 20 + size)
    assert (rest + 28 + size, name) == (len(data), b"BIN\0")
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def _values(document, buffer, number):
    accessor = document["accessors"][number]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5123: "<u2", 5125: "<u4", 5126: "<f4"}[accessor["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    start = view["byteOffset"] + accessor["byteOffset"]
    values = np.frombuffer(buffer, kind, accessor["count"] * width, start)
    return values.reshape(-1, width).astype(float)


def _texts(document, buffer, *, table, column):
    """The texts of a column of a property table."""
    told = table["properties"][column]
    views = (document["bufferViews"][told[name]] for name in ("values", "stringOffsets"))
    data, offsets = (buffer[v["byteOffset"] : v["byteOffset"] + v["byteLength"]] for v in views)
    cuts = np.frombuffer(offsets, "<u4", table["count"] + 1)
    return [data[a:b].decode() for a, b in pairwise(cuts)]


def _z_up(points):
    return np.column_stack([points[:, 0], -points[:, 2], points[:, 1]])


def _points(path):
    """All points of the meshes and instances of a GLB, x east, y north, z up."""
    document, buffer = _glb(path)
    parents = {c: k for k, node in enumerate(document["nodes"]) for c in node.get("children", [])}
    out = []
    for k, node in enumerate(document["nodes"]):
        if "mesh" not in node:
            continue
        shift, at = np.zeros(3), k
        while at is not None:
            shift = shift + document["nodes"][at].get("translation", [0, 0, 0])
            at = parents.get(at)
        primitive = document["meshes"][node["mesh"]]["primitives"][0]
        points = _values(document, buffer, primitive["attributes"]["POSITION"])
        copies = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if copies is None:
            out.append(points + shift)
            continue
        moves, turns, sizes = (
            _values(document, buffer, copies["attributes"][name])
            for name in ("TRANSLATION", "ROTATION", "SCALE")
        )
        for move, (x, y, z, w), size in zip(moves, turns, sizes, strict=True):
            axis, scaled = np.array([x, y, z]), points * size
            turned = scaled + 2 * np.cross(axis, np.cross(axis, scaled) + w * scaled)
            out.append(turned + move + shift)
    return _z_up(np.concatenate(out))


def test_cityjson_building_surfaces_have_semantic_types(city):
    tower = city["CityObjects"]["relation/4"]
    geometry = tower["geometry"][0]
    assert (tower["type"], geometry["type"], geometry["lod"]) == ("Building", "Solid", LOD[2])
    assert tower["attributes"]["height"] == 140
    assert tower["attributes"]["height_source"] == "tag"
    assert "name" in tower["attributes"]
    names = [s["type"] for s in geometry["semantics"]["surfaces"]]
    points = np.array(city["vertices"]) * city["transform"]["scale"]
    for face, value in zip(geometry["boundaries"][0], geometry["semantics"]["values"][0], strict=True):
        height = points[face[0], 2]
        wanted = (
            "RoofSurface"
            if (height == 140).all()
            else "GroundSurface"
            if (height == 2).all()
            else "WallSurface"
        )
        assert names[value] == wanted
    looks = {m["name"] for m in city["appearance"]["materials"]}
    assert {"roof_tile", "brick", "asphalt"} <= looks


def test_cityjson_bodies_and_cavities_are_separate_shells(city):
    objects = city["CityObjects"]
    pair, hollow = objects["way/2"], objects["way/3"]["geometry"][0]
    assert pair["geometry"] == []
    assert pair["attributes"]["height_source"] == "default"
    for name in pair["children"]:
        assert (objects[name]["type"], objects[name]["parents"]) == ("BuildingPart", ["way/2"])
        assert [len(shell) for shell in objects[name]["geometry"][0]["boundaries"]] == [12]
    assert len(pair["children"]) == 2
    assert hollow["type"] == "Solid"
    assert [len(shell) for shell in hollow["boundaries"]] == [12, 12]
    assert [len(v) for v in hollow["semantics"]["values"]] == [12, 12]
    points = np.array(city["vertices"]) * city["transform"]["scale"]
    outer, inner = (np.array([face[0] for face in shell]) for shell in hollow["boundaries"])
    assert np.ptp(points[outer][..., 2]) == pytest.approx(20)
    verdict = validate_mesh(Mesh.of(points, inner[:, ::-1], feature=0, closed=True))
    np.testing.assert_allclose(verdict.volume, 1000)


# Geometry types that the schema of CityJSON 2.0 lets the kinds have that occur here.
ALLOWED = {
    "Building": {"Solid"},
    "BuildingPart": {"Solid"},
    "PlantCover": {"MultiSolid", "MultiSurface"},
    "Road": {"MultiSurface", "CompositeSurface"},
    "TINRelief": {"CompositeSurface"},
    "SolitaryVegetationObject": {"GeometryInstance"},
}


def test_cityjson_geometry_types_are_allowed_by_the_schema(city):
    for told in city["CityObjects"].values():
        assert {g["type"] for g in told["geometry"]} <= ALLOWED[told["type"]]
    assert {told["type"] for told in city["CityObjects"].values()} == set(ALLOWED)


def test_cityjson_tree_is_at_its_position(city, scene):
    trees = {n: o for n, o in city["CityObjects"].items() if o["type"] == "SolitaryVegetationObject"}
    assert len(trees) == len(TREES)
    templates = city["geometry-templates"]
    corners = np.array(templates["vertices-templates"])
    told = city["transform"]
    found = []
    for tree in trees.values():
        highest = []
        for copy in tree["geometry"]:
            shape = templates["templates"][copy["template"]]
            used = corners[np.unique(shape["boundaries"])]
            matrix = np.array(copy["transformationMatrix"]).reshape(4, 4)
            anchor = np.array(city["vertices"][copy["boundaries"][0]]) * told["scale"] + told["translate"]
            points = used @ matrix[:3, :3].T + matrix[:3, 3] + anchor
            highest.append(points[:, 2].max())
        found.append([*(anchor[:2] - scene.frame.origin), max(highest)])
    wanted = [[x, y, SLOPE * x + height] for x, y, height in TREES]
    np.testing.assert_allclose(sorted(found), sorted(wanted), atol=2e-4)


@pytest.fixture(scope="module")
def town(demo_scene, tmp_path_factory):
    """CityJSON of a real place on several tiles."""
    path = tmp_path_factory.mktemp("out") / "town.city.json"
    return json.loads(export_scene(demo_scene("local"), path).path.read_text())


def test_every_vertex_of_cityjson_is_told_once_also_where_tiles_meet(city, town):
    for document in (city, town):
        vertices = np.array(document["vertices"])
        assert len(np.unique(vertices, axis=0)) == len(vertices)
    assert len({name.split("@")[1] for name in town["CityObjects"] if "@" in name}) > 1


def test_each_composite_surface_of_cityjson_is_one_2_manifold(town):
    surfaces = [
        np.array(geometry["boundaries"])[:, 0]
        for told in town["CityObjects"].values()
        for geometry in told["geometry"]
        if geometry["type"] == "CompositeSurface"
    ]
    assert len(surfaces) > 10
    for faces in surfaces:
        assert not manifold_patches(faces).any()


def test_no_face_of_a_surface_of_cityjson_collapses_at_a_millimetre(town):
    points = np.array(town["vertices"]) * town["transform"]["scale"]
    for told in town["CityObjects"].values():
        for geometry in told["geometry"]:
            if geometry["type"] in ("CompositeSurface", "MultiSurface"):
                corners = points[np.array(geometry["boundaries"])[:, 0]]
                sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
                assert sides.min() > 1e-3
                assert (
                    np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).any(axis=1).all()
                )


def test_patches_are_parted_where_they_touch_in_a_vertex():
    bow_tie = np.array([[0, 1, 2], [0, 3, 4]])
    np.testing.assert_array_equal(manifold_patches(bow_tie), [0, 1])
    strip = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]])
    assert not manifold_patches(strip).any()
    pinched = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [4, 5, 0]])  # comes back to vertex 0
    assert set(manifold_patches(pinched)) == {0, 1}
    ring = np.array(
        [[k, (k + 1) % 6, 6 + k] for k in range(6)]
        + [[6 + k, (k + 1) % 6, 6 + (k + 1) % 6] for k in range(6)]
    )
    assert not manifold_patches(ring).any()


@pytest.mark.full
@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_patches_of_any_part_of_a_surface_are_connected_2_manifolds(size, seed):
    rng = np.random.default_rng(seed)
    corner = np.arange((size + 1) ** 2).reshape(size + 1, size + 1)
    a, b, c, d = (corner[i : size + i, j : size + j].ravel() for i, j in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = rng.permutation(np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))
    faces = faces[: rng.integers(1, len(faces) + 1)]
    patch = manifold_patches(faces)
    assert set(patch) == set(range(patch.max() + 1))
    for k in range(patch.max() + 1):
        assert not manifold_patches(faces[patch == k]).any()


def test_vertices_of_neighbouring_tiles_share_their_numbers():
    vertices = Vertices(250.0)
    one, two = np.array([[0, 0, 0], [0, 1, 0], [5, 5, 5]]), np.array([[0, 1, 0], [9, 9, 9]])
    number, fresh = vertices.add(one, column=0)
    assert number.tolist() == [0, 1, 2]
    assert len(fresh) == 3
    number, fresh = vertices.add(two, column=1)
    assert number.tolist() == [1, 3]
    assert fresh.tolist() == [[9, 9, 9]]
    assert vertices.count == 4
    assert (vertices.low.tolist(), vertices.high.tolist()) == ([0, 0, 0], [9, 9, 9])


def test_vertices_on_the_far_side_of_a_joined_tile_keep_their_numbers():
    vertices = Vertices(250.0)
    whole = np.array([[0, 0, 0], [64, 0, 0]])
    vertices.add(whole, column=0, span=16)
    vertices.add(np.array([[1, 9, 0]]), column=8)
    assert vertices.add(whole[1:], column=16)[0].tolist() == [1]


def test_every_vertex_of_cityjson_is_used_and_every_index_exists(city):
    used = set()

    def walk(value):
        for v in value:
            walk(v) if isinstance(v, list) else used.add(v)

    for told in city["CityObjects"].values():
        for geometry in told["geometry"]:
            walk(geometry["boundaries"])
    assert used == set(range(len(city["vertices"])))
    low, high = np.array(city["vertices"]).min(axis=0), np.array(city["vertices"]).max(axis=0)
    extent = np.array(city["metadata"]["geographicalExtent"]).reshape(2, 3)
    told = city["transform"]
    np.testing.assert_allclose(
        extent, [v * told["scale"] + told["translate"] for v in (low, high)], atol=1e-4
    )


def test_a_glb_node_has_its_name_its_attributes_and_its_row(scene, tmp_path):
    document, buffer = _glb(export_scene(scene, tmp_path / "a.glb").path)
    node = next(n for n in document["nodes"] if n["name"] == "way/1")
    assert node["extras"]["height"] == 30
    assert node["extras"]["height_source"] == "tag"
    primitive = document["meshes"][node["mesh"]]["primitives"][0]
    told = primitive["extensions"]["EXT_mesh_features"]["featureIds"][0]
    rows = _values(document, buffer, primitive["attributes"]["_FEATURE_ID_0"])
    metadata = document["extensions"]["EXT_structural_metadata"]
    table = metadata["propertyTables"][told["propertyTable"]]
    assert table["name"] == "buildings"
    assert np.ptp(rows) == 0
    assert _texts(document, buffer, table=table, column="name")[int(rows[0, 0])] == "Rathaus «Süd»"
    root = document["nodes"][document["scenes"][0]["nodes"][0]]
    east, north = scene.frame.origin
    assert root["translation"] == [east, 0, -north]
    assert root["extras"]["crs"] == "EPSG:32633"


@pytest.mark.full
@pytest.mark.parametrize("kind", ["glb", "3dtiles"])
def test_buildings_and_their_pads_have_rows_of_their_own_with_their_class(demo_scene, tmp_path, kind):
    path = export_scene(demo_scene("local"), tmp_path / "out", options=ExportOptions(kind=kind)).path
    classes = {}
    for file in [path] if kind == "glb" else sorted(path.rglob("*.glb")):
        document, buffer = _glb(file)
        metadata = document.get("extensions", {}).get("EXT_structural_metadata", {"propertyTables": []})
        for table in metadata["propertyTables"]:
            klass, osm_id = (
                _texts(document, buffer, table=table, column=column) for column in ("class", "osm_id")
            )
            assert all(klass)
            if table["name"] == "buildings":
                for name, own in zip(osm_id, klass, strict=True):
                    classes.setdefault(name, set()).add(own)
    both = [name for name, own in classes.items() if own == {"building", "building_pad"}]
    assert len(both) > 0.8 * len(classes) > 10


def test_glb_tree_instances_are_at_tree_positions(scene, tmp_path):
    path = export_scene(scene, tmp_path / "a.glb", options=ExportOptions(layers=("trees",))).path
    document, _ = _glb(path)
    assert document["extensionsRequired"] == ["EXT_mesh_gpu_instancing"]
    points = _points(path) - [*scene.frame.origin, 0]
    for x, y, height in TREES:
        near = np.hypot(*(points[:, :2] - (x, y)).T) < 0.1
        assert points[near, 2].max() == pytest.approx(SLOPE * x + height, abs=1e-4)
        assert points[near, 2].min() == pytest.approx(SLOPE * x + 0.3 * height, abs=1e-4)
    assert len(points) == len(TREES) * sum(len(shapes()[n].vertices) for n in ("trunk", "crown_broadleaved"))


def test_bounding_boxes_of_3d_tiles_contain_their_content_and_errors_decrease(tiles):
    document = json.loads((tiles / "tileset.json").read_text())
    assert document["asset"]["version"] == "1.1"
    contents = []

    def walk(node, boxes, error):
        assert node["geometricError"] < error or node["geometricError"] == error == 0
        boxes = [*boxes, node["boundingVolume"]["box"]]
        if "content" in node:
            contents.append(node["content"]["uri"])
            points = _points(tiles / node["content"]["uri"])
            for box in [*boxes, node["content"]["boundingVolume"]["box"]]:
                middle, half = np.array(box[:3]), np.diag(np.array(box[3:]).reshape(3, 3))
                assert (np.abs(points - middle) <= half).all()
            inner = np.abs(points - middle).max(axis=0)
            np.testing.assert_allclose(inner, half, atol=0.01)
        for child in node.get("children", []):
            walk(child, boxes, node["geometricError"])

    walk(document["root"], [], document["geometricError"] + 1)
    assert sorted(contents) == sorted(p.relative_to(tiles).as_posix() for p in tiles.rglob("*.glb"))
    assert any("copies" in uri for uri in contents)


NODE = {"boundingVolume", "geometricError", "refine", "transform", "content", "children"}


def test_tileset_follows_the_schema_and_parents_contain_their_children(tiles):
    document = json.loads((tiles / "tileset.json").read_text())
    assert set(document) == {"asset", "geometricError", "root"}

    def walk(node, outer):
        assert {"boundingVolume", "geometricError"} <= set(node) <= NODE
        assert node.get("refine", "ADD") == "ADD"
        assert node["geometricError"] >= 0
        assert set(node["boundingVolume"]) == {"box"}
        box = np.array(node["boundingVolume"]["box"])
        assert box.shape == (12,)
        low, high = box[:3] - box[[3, 7, 11]], box[:3] + box[[3, 7, 11]]
        assert (low < high).all()
        if outer:
            assert (low >= outer[0] - 1e-6).all()
            assert (high <= outer[1] + 1e-6).all()
        assert node.get("children") != []  # a leaf has no list of children
        assert "transform" not in node or outer is None
        for child in node.get("children", []):
            walk(child, (low, high))

    walk(document["root"], None)
    matrix = np.array(document["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[3], [0, 0, 0, 1])
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)


def test_points_of_3d_tiles_match_the_projection(scene, tiles):
    import pyproj  # noqa: PLC0415

    document = json.loads((tiles / "tileset.json").read_text())
    matrix = np.array(document["root"]["transform"]).reshape(4, 4).T
    points = np.concatenate([_points(path) for path in sorted(tiles.rglob("*.glb"))])
    earth = points @ matrix[:3, :3].T + matrix[:3, 3]
    lon, lat, height = pyproj.Transformer.from_crs(4978, 4979, always_xy=True).transform(*earth.T)
    x, y = scene.frame.from_geographic(lon, lat)
    found = np.column_stack([x, y, height])
    expected = np.concatenate(
        [scene.tile(*index).mesh.vertices + scene.tile(*index).origin for index in scene.tile_indices]
    )
    gap = np.array([np.linalg.norm(found - point, axis=1).min() for point in expected[::7]])
    assert gap.max() < 2e-3


def test_tables_of_3d_tiles_have_the_stated_number_of_rows(tiles):
    seen = 0
    for path in sorted(tiles.rglob("*.glb")):
        document, buffer = _glb(path)
        views = document["bufferViews"]
        tables = document.get("extensions", {}).get("EXT_structural_metadata", {}).get("propertyTables", [])
        for table in tables:
            for told in table["properties"].values():
                values = views[told["values"]]
                assert values["byteOffset"] + values["byteLength"] <= len(buffer)
                if "stringOffsets" in told:
                    view = views[told["stringOffsets"]]
                    kind = {"UINT8": "u1", "UINT16": "<u2", "UINT32": "<u4", "UINT64": "<u8"}[
                        told.get("stringOffsetType", "UINT32")
                    ]
                    offsets = np.frombuffer(
                        buffer, kind, view["byteLength"] // np.dtype(kind).itemsize, view["byteOffset"]
                    )
                    assert len(offsets) == table["count"] + 1
                    assert (np.diff(offsets.astype(np.int64)) >= 0).all()
                    assert 0 < offsets[-1] == values["byteLength"]
                else:
                    assert values["byteLength"] % table["count"] == 0
                seen += 1
        for mesh in document["meshes"]:
            for primitive in mesh["primitives"]:
                told = primitive.get("extensions", {}).get("EXT_mesh_features", {}).get("featureIds", [])
                for ids in (entry for entry in told if "attribute" in entry):
                    rows = _values(
                        document, buffer, primitive["attributes"][f"_FEATURE_ID_{ids['attribute']}"]
                    )
                    assert 0 <= rows.min() <= rows.max() < tables[ids["propertyTable"]]["count"]
    assert seen > 10


def test_folder_of_another_kind_is_not_replaced(scene, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    with pytest.raises(InputError, match=r"holds no tileset\.json"):
        export_scene(scene, tmp_path / "mine", overwrite=True, options=ExportOptions(kind="3dtiles"))
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years"


def test_a_replaced_tileset_keeps_and_names_the_files_of_others(scene, tmp_path, caplog):
    options, out = ExportOptions(kind="3dtiles"), tmp_path / "tiles"
    export_scene(scene, out, options=options)
    fresh = {path: path.read_bytes() for path in out.rglob("*.*")}
    mine = [out / "style.json", out / "content" / "photo.png"]
    for path in [*mine, out / "content" / "99_-99.glb"]:
        path.write_text(path.name)
    export_scene(scene, out, options=options, overwrite=True)
    assert set(out.rglob("*.*")) == {*fresh, *mine}
    assert {path: path.read_bytes() for path in fresh} == fresh
    assert [path.read_text() for path in mine] == [path.name for path in mine]
    assert all(f"{path}: kept" in caplog.text for path in mine)


def test_a_tileset_that_cannot_be_replaced_stays(scene, tmp_path, monkeypatch):
    options, out, rename = ExportOptions(kind="3dtiles"), tmp_path / "tiles", Path.rename
    export_scene(scene, out, options=options)
    before = {path: path.read_bytes() for path in out.rglob("*.*")}

    def interrupted(path, target):
        if Path(target) == out and path.name.endswith(".new.part"):
            raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        export_scene(scene, out, options=options, overwrite=True)
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == before
    assert [path.name for path in tmp_path.iterdir()] == ["tiles"]


def test_height_offset_is_added_to_heights(scene, tmp_path, tiles):
    low, high = (
        np.array(json.loads((path / "tileset.json").read_text())["root"]["transform"])[12:15]
        for path in (
            tiles,
            export_scene(
                scene, tmp_path / "t", options=ExportOptions(kind="3dtiles", height_offset=39.5)
            ).path,
        )
    )
    assert np.linalg.norm(high - low) == pytest.approx(39.5)
