"""A building is the same closed solid in every format with solids."""

import json

import numpy as np
import pyproj
import pytest
import trimesh
from helpers.export_worlds import NAMES, SOLID_VOLUMES, write_world

from geoscene.classes import Class
from geoscene.export import export_scene
from geoscene.geometry.mesh import Mesh
from geoscene.geometry.watertight import validate_mesh
from geoscene.options import ExportOptions

STEPS = {
    "cityjson": 1e-5,
    "glb": 1e-5,  # float32 at the size of an object
    "3dtiles": 2e-5,  # float32 at the size of a tile
    "obj": 1e-4,
    "ply": 1e-12,
    "stl": 2e-5,
}
SUFFIX = {"cityjson": ".city.json", "geoparquet": ".parquet", "3dtiles": ""}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("scene") / "world")


@pytest.fixture(scope="module")
def exported(scene, tmp_path_factory):
    """Path of the scene in a format; written on first use."""
    folder, done = tmp_path_factory.mktemp("out"), {}

    def path(kind):
        if kind not in done:
            out = folder / f"world{SUFFIX.get(kind, '.' + kind)}"
            done[kind] = export_scene(scene, out, options=ExportOptions(kind=kind))
        return done[kind].path

    return path


def _scene_points(scene, easting, northing, z):
    return np.column_stack([easting - scene.frame.origin[0], northing - scene.frame.origin[1], z])


def _cityjson(path, scene):
    document = json.loads(path.read_text())
    points = (
        np.array(document["vertices"]) * document["transform"]["scale"] + document["transform"]["translate"]
    )
    points = _scene_points(scene, *points.T)
    out = {}
    for name, told in document["CityObjects"].items():
        for geometry in told["geometry"]:
            if told["type"] in ("Building", "BuildingPart"):
                assert geometry["type"] == "Solid"
                faces = [face[0] for shell in geometry["boundaries"] for face in shell]
                out.setdefault(told.get("parents", [name])[0], []).extend(faces)
    return {name: (points, np.array(faces)) for name, faces in out.items()}


def _parts(pieces):
    """Triangles (n, 3, 3) without shared vertices."""
    soup = np.concatenate(pieces)
    return soup.reshape(-1, 3), np.arange(len(soup) * 3).reshape(-1, 3)


def _glb(path, scene):
    east, north = scene.frame.origin
    loaded = trimesh.load(path, process=False)
    found = {}
    for node in loaded.graph.nodes_geometry:
        name = next((n for n in NAMES if node.startswith(n)), None)
        if name:
            transform, geometry = loaded.graph[node]
            mesh = loaded.geometry[geometry]
            x, up, south = (mesh.vertices @ transform[:3, :3].T + transform[:3, 3]).T
            points = np.column_stack([x - east, -south - north, up])
            found.setdefault(name, []).append(points[mesh.faces])
    return {name: _parts(parts) for name, parts in found.items()}


def _tiles(path, scene):
    tileset = json.loads((path / "tileset.json").read_text())
    matrix = np.array(tileset["root"]["transform"]).reshape(4, 4).T
    to_crs = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    found = {}
    for file in sorted((path / "content").glob("*[0-9].glb")):
        loaded = trimesh.load(file, process=False)
        for node in loaded.graph.nodes_geometry:
            transform, geometry = loaded.graph[node]
            mesh = loaded.geometry[geometry]
            if "buildings" not in node + geometry:
                continue
            x, up, south = (mesh.vertices @ transform[:3, :3].T + transform[:3, 3]).T
            earth = np.column_stack([x, -south, up, np.ones(len(x))]) @ matrix.T
            lon, lat, height = to_crs.transform(*earth[:, :3].T)
            points = np.column_stack([*scene.frame.from_geographic(lon, lat), height])
            rows = mesh.vertex_attributes["_FEATURE_ID_0"].ravel().astype(int)[mesh.faces[:, 0]]
            features = _features_in(file)
            for row in np.unique(rows):
                name = NAMES[features[row]]
                found.setdefault(name, []).append(points[mesh.faces[rows == row]])
    return {name: _parts(parts) for name, parts in found.items()}


def _features_in(file):
    """Feature numbers in a tile's property table of buildings."""
    data = file.read_bytes()
    size = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + size])
    tables = document["extensions"]["EXT_structural_metadata"]["propertyTables"]
    table = next(t for t in tables if t["name"] == "buildings")
    view = document["bufferViews"][table["properties"]["feature"]["values"]]
    start = 28 + size + view["byteOffset"]
    return np.frombuffer(data[start : start + view["byteLength"]], "<i4")


def _obj(path, _):
    vertices, found, name = [], {}, None
    for line in path.read_text().splitlines():
        word, *rest = line.split(" ")
        if word == "v":
            vertices.append([float(v) for v in rest])
        elif word == "o":
            name = rest[0]
        elif word == "f" and name in NAMES:
            found.setdefault(name, []).append([int(v) - 1 for v in rest])
    return {name: (np.array(vertices), np.array(faces)) for name, faces in found.items()}


def _ply(path, _):
    mesh = trimesh.load(path, process=False)
    rows = mesh.metadata["_ply_raw"]["face"]["data"]
    feature, closed = np.asarray(rows["feature"]).ravel(), np.asarray(rows["closed"]).ravel() == 1
    return {n: (mesh.vertices, mesh.faces[closed & (feature == k)]) for k, n in enumerate(NAMES)}


def _stl(path, _):
    """Triangles by building; STL has no names, so they are assigned by position."""
    soup = trimesh.load(path, process=False).triangles
    places = (12.5, -20.25), (-70, 60), (60, 60), (-30.5, -60.25)
    middles = dict(zip(NAMES, places, strict=True))
    away = np.array([np.abs(soup.mean(axis=1)[:, :2] - m).max(axis=1) for m in middles.values()])
    tall = soup[:, :, 2].max(axis=1) >= 0
    return {
        name: _parts([soup[(away.argmin(axis=0) == k) & (away.min(axis=0) < 15) & tall]])
        for k, name in enumerate(middles)
    }


def _read(kind, path, scene):
    readers = {"cityjson": _cityjson, "glb": _glb, "3dtiles": _tiles, "obj": _obj, "ply": _ply, "stl": _stl}
    return readers[kind](path, scene)


@pytest.mark.parametrize("kind", STEPS)
def test_building_is_the_same_closed_solid_in_every_format(kind, exported, scene):
    found = _read(kind, exported(kind), scene)
    assert set(found) == set(NAMES)
    truth = {}
    for tile in scene.tiles():
        for feature in np.unique(tile.mesh.feature[tile.mesh.klass == Class.BUILDING]):
            mesh = tile.mesh.take(tile.mesh.closed & (tile.mesh.feature == feature)).shifted(tile.origin)
            truth[NAMES[feature]] = mesh
    for name, (points, faces) in found.items():
        mesh = Mesh.of(points, faces, feature=0, closed=True).take(np.arange(len(faces)))
        verdict = validate_mesh(mesh)
        assert verdict.ok.all(), (name, verdict.fault(0))
        wanted = truth[name]
        assert len(mesh) == len(wanted)
        area = np.linalg.norm(np.ptp(wanted.vertices, axis=0)) ** 2 * 6
        np.testing.assert_allclose(verdict.volume, validate_mesh(wanted).volume, atol=STEPS[kind] * area)
        np.testing.assert_allclose(mesh.vertices.min(axis=0), wanted.vertices.min(axis=0), atol=STEPS[kind])
        np.testing.assert_allclose(mesh.vertices.max(axis=0), wanted.vertices.max(axis=0), atol=STEPS[kind])
    for name, volume in zip(NAMES, SOLID_VOLUMES, strict=False):
        points, faces = found[name]
        verdict = validate_mesh(Mesh.of(points, faces, feature=0, closed=True))
        np.testing.assert_allclose(verdict.volume, volume, rtol=1e-4)


@pytest.mark.full
@pytest.mark.parametrize("kind", [*STEPS, "gpkg", "geoparquet", "geojson"])
def test_exports_are_reproducible(kind, exported, scene, tmp_path):
    first = exported(kind)
    again = export_scene(scene, tmp_path / first.name, options=ExportOptions(kind=kind)).path
    files = sorted(p for p in first.rglob("*") if p.is_file()) if first.is_dir() else [first]
    assert files
    for file in files:
        other = again / file.relative_to(first) if first.is_dir() else again
        assert other.read_bytes() == file.read_bytes()
    assert not list(tmp_path.rglob("*.part*"))


def test_cityjson_of_a_frame_without_a_code_is_in_utm_and_closed(tmp_path):
    scene = write_world(tmp_path / "scene", crs="local")
    summary = export_scene(scene, tmp_path / "a.city.json")
    assert summary.crs == "EPSG:32633"
    assert "EPSG:32633" in summary.notes[0]
    document = json.loads(summary.path.read_text())
    assert document["metadata"]["referenceSystem"] == "https://www.opengis.net/def/crs/EPSG/0/32633"
    transform = document["transform"]
    points = np.array(document["vertices"]) * transform["scale"] + transform["translate"]
    x, y = scene.frame.from_crs(points[:, 0], points[:, 1], crs="EPSG:32633")
    faces = np.array([face[0] for face in document["CityObjects"]["way/1"]["geometry"][0]["boundaries"][0]])
    mesh = Mesh.of(np.column_stack([x, y, points[:, 2]]), faces, feature=0, closed=True)
    verdict = validate_mesh(mesh)
    assert verdict.ok.all()
    np.testing.assert_allclose(verdict.volume, SOLID_VOLUMES[0], rtol=1e-6)


@pytest.mark.full
def test_every_solid_of_a_real_place_is_still_closed_after_ply(demo_scene, tmp_path):
    scene = demo_scene("utm")
    mesh = trimesh.load(export_scene(scene, tmp_path / "a.ply").path, process=False)
    rows = mesh.metadata["_ply_raw"]["face"]["data"]
    closed = np.asarray(rows["closed"]).ravel() == 1
    feature = np.asarray(rows["feature"]).ravel()[closed]
    verdict = validate_mesh(Mesh.of(mesh.vertices, mesh.faces[closed], feature=feature, closed=True))
    assert (verdict.closed & verdict.oriented & verdict.positive & (verdict.degenerate == 0)).all()
    assert verdict.ok[: scene.manifest["counts"]["solids"]].all()  # lamps are made of bodies that overlap
    assert len(verdict) >= scene.manifest["counts"]["solids"] > 20


@pytest.mark.full
def test_an_stl_has_every_tree(demo_scene, tmp_path):
    scene = demo_scene("local")
    summary = export_scene(scene, tmp_path / "a.stl", options=ExportOptions(layers=("trees",)))
    first, end = scene.layers["trees"]
    assert summary.solids == end - first > 10
    assert summary.notes == ()


@pytest.mark.full
def test_every_solid_of_a_real_place_is_still_closed_after_cityjson(demo_scene, tmp_path):
    scene = demo_scene("local")
    document = json.loads(export_scene(scene, tmp_path / "a.city.json").path.read_text())
    points = np.array(document["vertices"]) * document["transform"]["scale"]
    solids = [
        solid
        for told in document["CityObjects"].values()
        for geometry in told["geometry"]
        for solid in {"Solid": [geometry["boundaries"]], "MultiSolid": geometry["boundaries"]}.get(
            geometry["type"], []
        )
    ]
    faces = [np.array([face[0] for shell in solid for face in shell]) for solid in solids]
    feature = np.repeat(np.arange(len(faces)), [len(f) for f in faces])
    mesh = Mesh.of(points, np.concatenate(faces), feature=feature, closed=True)
    verdict = validate_mesh(mesh, grid=document["transform"]["scale"][0])
    assert (verdict.closed & verdict.oriented & verdict.positive & (verdict.degenerate == 0)).all()
    assert len(verdict) >= scene.manifest["counts"]["solids"] > 20
