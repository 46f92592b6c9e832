"""Rasters and tables of a scene: positions, heights, classes, attributes and CRS."""

from __future__ import annotations

import json
import re
import sqlite3
import subprocess
import xml.etree.ElementTree as ET
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import geopandas
import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from helpers.export_worlds import NAMES, SLOPE, SOLID_VOLUMES, TREES, write_world
from helpers.roadgrids import road_graph
from helpers.scenes import restated
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from geoscene.classes import Class, class_codes
from geoscene.errors import InputError, MissingExtraError
from geoscene.export import KINDS, export_scene, kind_of
from geoscene.export.raster import RasterGrid, _cells_on_disk, draw_triangles
from geoscene.options import ExportOptions
from geoscene.roadgraph import write_graphml
from geoscene.scene import SceneFiles
from geoscene.support import files


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_world(tmp_path_factory.mktemp("scene") / "world")


def _raster(scene, tmp_path, **options):
    with rasterio.open(
        export_scene(scene, tmp_path / "a.tif", options=ExportOptions(**options)).path
    ) as raster:
        x, y = np.meshgrid(np.arange(raster.width) + 0.5, np.arange(raster.height) + 0.5)
        told = raster.transform
        east, north = told.c + told.a * x, told.f + told.e * y
        place = east - scene.frame.origin[0], north - scene.frame.origin[1]
        return raster.read(1), *place, raster.profile, raster.tags(ns="IMAGE_STRUCTURE")


def test_terrain_model_is_the_ground_below_all_objects(scene, tmp_path):
    height, x, _, profile, layout = _raster(scene, tmp_path, model="terrain", resolution=0.5)
    assert height.shape == (400, 400)
    np.testing.assert_allclose(height, SLOPE * x, atol=1e-5)
    assert profile["crs"].to_epsg() == 32633
    assert profile["tiled"]
    assert layout["LAYOUT"] == "COG"


def test_surface_model_includes_roofs(scene, tmp_path):
    height, x, y, _, _ = _raster(scene, tmp_path, model="surface", resolution=0.5)
    box = (np.abs(x - 12.5) < 5) & (np.abs(y + 20.25) < 10)
    assert box.sum() == 20 * 39  # two more rows lie on the edge
    assert (height[box] == 30).all()
    field = (x > 60) & (y < -85)
    np.testing.assert_allclose(height[field], SLOPE * x[field], atol=1e-5)
    tree_x, tree_y, tall = TREES[2]
    crown = np.hypot(x - tree_x, y - tree_y) < 1
    assert (height[crown] > 0.8 * tall).all()


def test_class_map_has_the_classes_visible_from_above(scene, tmp_path):
    klass, x, y, profile, _ = _raster(scene, tmp_path, model="classes", resolution=1.0)
    box = (np.abs(x - 12.5) < 5) & (np.abs(y + 20.25) < 10)
    assert set(klass[box]) == {Class.BUILDING}
    road = (np.abs(y) < 4) & (x > 50)
    assert set(klass[road]) == {Class.ROAD}
    assert set(klass[(x > 60) & (y < -85)]) == {Class.TERRAIN}
    assert Class.TREE_CROWN in klass
    assert profile["nodata"] == 0
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.colormap(1)[Class.ROAD][:3] == (128, 64, 128)
        assert raster.tags(1)["class_14"] == "building"


@pytest.mark.parametrize("resolution", [0, -1, np.nan, np.inf, 1e-4])
def test_invalid_resolution_is_refused(scene, tmp_path, resolution):
    with pytest.raises(InputError, match="`resolution`"):
        export_scene(scene, tmp_path / "a.tif", options=ExportOptions(resolution=resolution))
    assert list(tmp_path.iterdir()) == []


triangles = st.lists(
    st.tuples(*[st.tuples(*[st.integers(-40, 200).map(lambda v: v / 8)] * 3)] * 3), min_size=1, max_size=6
)


@pytest.mark.full
@settings(max_examples=60, deadline=None)
@given(triangles)
def test_cell_has_the_height_of_the_highest_triangle_at_its_centre(corners):
    corners = np.array(corners, float)
    height, labels = np.full((20, 20), np.nan, np.float32), np.zeros((20, 20), np.uint8)
    draw_triangles(corners, np.arange(1, len(corners) + 1, dtype=np.uint8), height, labels)
    x, y = np.meshgrid(np.arange(20) + 0.5, np.arange(20) + 0.5)
    middles = shapely.points(x, y)
    wanted = np.full((20, 20), -np.inf)
    for a, b, c in corners:
        triangle = shapely.Polygon([a[:2], b[:2], c[:2]])
        normal = np.cross(b - a, c - a)
        if triangle.area < 1e-9:
            continue
        z = a[2] - ((x - a[0]) * normal[0] + (y - a[1]) * normal[1]) / normal[2]
        wanted = np.where(shapely.intersects(triangle, middles), np.maximum(wanted, z), wanted)
    assert (np.isfinite(height) == np.isfinite(wanted)).all()
    drawn = np.isfinite(height)
    np.testing.assert_allclose(height[drawn], wanted[drawn], rtol=1e-5, atol=1e-4)
    assert ((labels > 0) == drawn).all()


@pytest.mark.full
def test_a_geopackage_has_every_layer_with_its_columns(scene, tmp_path):
    path = export_scene(scene, tmp_path / "a.gpkg").path
    assert pyogrio.list_layers(path)[:, 0].tolist() == [
        *scene.layers,
        "layer_styles",
        "building_solids",
    ]
    plan = geopandas.read_file(path, layer="buildings")
    assert plan.crs.to_epsg() == 32633
    assert plan["osm_id"].tolist() == list(NAMES)
    assert plan["name"][0] == "Rathaus «Süd»"
    assert np.isnan(plan["levels"][0])
    moved = geopandas.read_file(
        export_scene(scene, tmp_path / "b.gpkg", options=ExportOptions(crs="EPSG:25833")).path, layer="roads"
    )
    assert moved.crs.to_epsg() == 25833


def test_a_geopackage_is_drawn_in_the_colours_of_its_classes(scene, tmp_path):
    path = export_scene(scene, tmp_path / "a.gpkg").path
    with closing(sqlite3.connect(path)) as db:
        kinds = db.execute("SELECT data_type FROM gpkg_contents WHERE table_name = 'layer_styles'").fetchall()
        assert kinds == [("attributes",)]
    styles = pyogrio.read_dataframe(path, layer="layer_styles").set_index("f_table_name")
    assert set(styles.index) == set(scene.layers)
    assert styles["useAsDefault"].all()
    assert set(styles["f_geometry_column"]) == {"geom"}  # by which, and empty texts, QGIS finds them
    assert set(styles["f_table_catalog"]) == set(styles["f_table_schema"]) == {""}
    assert styles["update_time"].nunique() == 1
    by_class = set()
    for name, text in styles["styleQML"].items():
        qml = ET.fromstring(text)  # noqa: S314  (our own text)
        table = geopandas.read_file(path, layer=name)
        codes = {"Point": "0", "LineString": "1", "Polygon": "2"}
        assert qml.findtext("layerGeometryType") == codes[table.geom_type[0].removeprefix("Multi")]
        symbols = {symbol.get("name"): symbol for symbol in qml.iter("symbol")}
        categories = {node.get("value"): symbols[node.get("symbol")] for node in qml.iter("category")}
        if (column := qml.find("renderer-v2").get("attr")) is not None:
            assert set(categories) == set(table[column])
            by_class.add(name)
        for value, symbol in categories.items():
            color = next(o.get("value") for o in symbol.iter("Option") if o.get("name") == "color")
            wanted = class_codes().color[Class[value.upper()]].tolist()
            assert list(map(int, color.split(","))) == [*wanted, 255]
    assert by_class == {"road_surfaces"}


@pytest.mark.full
@pytest.mark.parametrize("crs", ["utm", "local"])
def test_a_geopackage_has_valid_geometry_and_the_volumes_of_solids_without_geometry(crs, tmp_path):
    scene = write_world(tmp_path / "scene", crs=crs)
    path = export_scene(scene, tmp_path / "a.gpkg").path
    for layer, kind in pyogrio.list_layers(path):
        table = geopandas.read_file(path, layer=layer)
        assert layer in ("building_solids", "layer_styles") if kind is None else table.geometry.is_valid.all()
    assert table["osm_id"].tolist() == list(NAMES)
    wanted = np.array(SOLID_VOLUMES) / scene.frame.scale(13.35, 52.51) ** 2
    np.testing.assert_allclose(table["volume"][:3], wanted, rtol=1e-5)
    assert table["faces"][:3].tolist() == [12, 24, 24]
    assert table[["bottom", "top"]].to_numpy().tolist() == [[0, 30], [1, 11], [0, 20], [2, 140]]


def test_geojson_follows_rfc_7946(scene, tmp_path):
    path = export_scene(scene, tmp_path / "a.geojson").path
    document = json.loads(path.read_text())
    kinds = [f["properties"]["kind"] for f in document["features"]]
    assert {kind: kinds.count(kind) for kind in kinds} == {n: b - a for n, (a, b) in scene.layers.items()}
    hedge = next(f for f in document["features"] if f["properties"]["kind"] == "barriers")
    assert hedge["properties"]["barriers_kind"] == "hedge"
    first = document["features"][0]
    assert first["properties"]["height_source"] == "tag"
    assert "levels" not in first["properties"]
    footprint = shapely.from_geojson(json.dumps(first["geometry"]))
    assert footprint.exterior.is_ccw
    x, y = scene.frame.from_geographic(*shapely.get_coordinates(footprint).T)
    assert (min(x), max(x), min(y), max(y)) == pytest.approx((0, 20, -30, 0), abs=1e-3)


@pytest.mark.parametrize(("crs", "lon"), [("utm", 180.0), ("local", -179.9995), ("local", 179.9999)])
def test_geometry_in_degrees_is_cut_at_the_antimeridian(crs, lon, tmp_path):
    """RFC 7946, section 3.1.9; areas and lengths are those of the scene."""
    scene = write_world(tmp_path / "scene", crs=crs, at=(lon, -16.8))
    export_scene(scene, tmp_path / "a.geojson")
    for suffix in ("gpkg", "parquet"):
        export_scene(scene, tmp_path / f"a.{suffix}", options=ExportOptions(crs="EPSG:4326"))
    document = json.loads((tmp_path / "a.geojson").read_text())
    geojson = [shapely.from_geojson(json.dumps(f["geometry"])) for f in document["features"]]
    layers = [geopandas.read_file(tmp_path / "a.gpkg", layer=name) for name in scene.layers]
    assert all(len(set(table.geom_type)) == 1 for table in layers)
    gpkg = [geometry for table in layers for geometry in table.geometry]
    own = [geometry for name in scene.layers for geometry in scene.features(name).geometry]
    cut = 0
    for found in (geojson, gpkg, geopandas.read_parquet(tmp_path / "a.parquet").geometry):
        for geometry, plan in zip(found, own, strict=True):
            assert geometry.is_valid
            assert geometry.has_z == plan.has_z
            assert np.abs(shapely.get_coordinates(geometry)[:, 0]).max() <= 180
            for part in shapely.get_parts(geometry):
                assert np.ptp(shapely.get_coordinates(part)[:, 0]) < 0.01
            back = shapely.transform(geometry, lambda c: np.column_stack(scene.frame.from_geographic(*c.T)))
            assert back.area == pytest.approx(plan.area, rel=1e-4)
            assert plan.area or back.length == pytest.approx(plan.length, rel=1e-4)
            cut += len(np.unique(np.sign(shapely.get_coordinates(geometry)[:, 0]))) > 1
    assert cut >= 6


def test_a_geoparquet_table_holds_all_layers(scene, tmp_path):
    table = geopandas.read_parquet(export_scene(scene, tmp_path / "a.parquet").path)
    assert table.crs == scene.frame.crs
    assert table["kind"].value_counts().to_dict() == {n: b - a for n, (a, b) in scene.layers.items()}
    assert table["barriers_kind"].dropna().tolist() == ["hedge"]
    assert table["feature"].tolist() == list(range(len(table)))
    assert table.loc[table["kind"] == "trees", "height"].tolist() == [h for _, _, h in TREES]
    boxes = parquet.read_table(tmp_path / "a.parquet", columns=["bbox"])["bbox"].to_pylist()
    np.testing.assert_array_equal([list(box.values()) for box in boxes], table.bounds.to_numpy())
    x, y = scene.frame.origin
    some = geopandas.read_parquet(tmp_path / "a.parquet", bbox=(x + 5, y - 25, x + 6, y - 24))
    assert some["osm_id"].tolist() == ["way/1"]


def test_selected_layer_is_exported_and_unknown_layers_are_refused(scene, tmp_path):
    summary = export_scene(scene, tmp_path / "a.geojson", options=ExportOptions(layers=("trees",)))
    assert summary.objects == len(TREES)
    with pytest.raises(InputError, match=r"no layer tress; this scene has .*trees"):
        export_scene(scene, tmp_path / "b.geojson", options=ExportOptions(layers=("tress",)))
    with pytest.raises(InputError, match="no layer building_solids"):
        export_scene(scene, tmp_path / "b.geojson", options=ExportOptions(layers=("building_solids",)))
    with pytest.raises(InputError, match=r"no layer tress; this scene has .*terrain"):
        export_scene(scene, tmp_path / "b.glb", options=ExportOptions(layers=("tress",)))


@pytest.mark.parametrize(
    ("name", "kind"),
    [(f"Some.Name{s}", k) for k, told in KINDS.items() for s in told.suffixes] + [("A.GLB", "glb")],
)
def test_suffix_selects_the_format(tmp_path, name, kind):
    assert kind_of(tmp_path / name) == kind


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        *((f"a{KINDS[kind].suffixes[0]}", {"layers": ("roads",)}, "`layers` roads: no faces")
          for kind in ("cityjson", "glb", "obj", "ply", "stl", "geotiff")),
        ("tiles", {"kind": "3dtiles", "layers": ("roads",)}, "`layers` roads: no faces"),
        ("a.stl", {"layers": ("roads", "terrain")}, "`layers` roads, terrain has no solids"),
        ("a.tif", {"layers": ("buildings",), "model": "terrain"}, "no faces of the terrain model"),
        ("a.gpkg", {"layers": ("structures",)}, "`layers` structures: no features"),
        ("a.geojson", {"layers": ("structures",)}, "`layers` structures: no features"),
        ("a.obj", {"kind": "stl"}, "another format than `kind` stl, which is .stl"),
        ("a.glb", {"kind": "3dtiles"}, "another format than `kind` 3dtiles, which is a folder"),
    ],
)  # fmt: skip
def test_exports_without_contents_or_with_the_name_of_others_are_refused(
    scene, tmp_path, name, options, words
):
    stop = max(stop for _, stop in scene.layers.values())
    layers = {name: list(rows) for name, rows in scene.layers.items()} | {"structures": [stop, stop]}
    scene = replace(scene, manifest=scene.manifest | {"layers": layers})
    with pytest.raises(InputError, match=re.escape(words)):
        export_scene(scene, tmp_path / name, options=ExportOptions(**options))
    assert list(tmp_path.iterdir()) == []


def test_invalid_options_are_refused_before_writing(scene, tmp_path):
    with pytest.raises(InputError, match="unknown suffix"):
        export_scene(scene, tmp_path / "a.json")
    with pytest.raises(InputError, match="`kind` 'dwg'"):
        export_scene(scene, tmp_path / "a", options=ExportOptions(kind="dwg"))
    with pytest.raises(InputError, match=r"`resolution` does not go with PLY, which takes `layers`"):
        export_scene(scene, tmp_path / "a.ply", options=ExportOptions(resolution=1))
    with pytest.raises(InputError, match="EPSG:99999"):
        export_scene(scene, tmp_path / "a.gpkg", options=ExportOptions(crs="EPSG:99999"))
    with pytest.raises(InputError, match="projected CRS"):
        export_scene(scene, tmp_path / "a.city.json", options=ExportOptions(crs="EPSG:4326"))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "a.ply").write_text("mine")
    with pytest.raises(InputError, match="`overwrite`"):
        export_scene(scene, tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_text() == "mine"
    assert export_scene(scene, tmp_path / "a.ply", overwrite=True).bytes > 1000


def test_the_library_of_materials_of_another_mesh_is_not_replaced_unasked(scene, tmp_path):
    (tmp_path / "a.mtl").write_text("mine")
    with pytest.raises(InputError, match=r"a\.mtl: exists; set `overwrite`"):
        export_scene(scene, tmp_path / "a.obj")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
    assert export_scene(scene, tmp_path / "a.obj", overwrite=True).files == 2


def test_warnings_of_netconvert_are_notes_one_of_each_kind(monkeypatch, scene, tmp_path):
    warnings = [
        "Warning: Edge '-1' has a grade of 16.77%.",
        "Warning: Found sharp turn with radius 8.94 at the start of edge '-108'.",
        "Warning: Edge '20' has a grade of 31.00%.",
        "Success.",
    ]

    def convert(command, **_options):
        Path(command[command.index("--output-file") + 1]).write_text("<net/>")
        return subprocess.CompletedProcess(command, 0, "", "\n".join(warnings))

    monkeypatch.setattr("geoscene.export.opendrive.need", lambda *_: SimpleNamespace(SUMO_HOME="/none"))
    monkeypatch.setattr("geoscene.export.opendrive.subprocess.run", convert)
    summary = export_scene(scene, tmp_path / "a.net.xml")
    assert summary.notes[-2:] == (
        "netconvert: Edge '-1' has a grade of 16.77%. (2 warnings of this kind)",
        "netconvert: Found sharp turn with radius 8.94 at the start of edge '-108'.",
    )


def test_sumo_gets_both_directions_of_streets_of_one_lane(monkeypatch, scene, tmp_path):
    graph = road_graph([(0, 0), (100, 0), (200, 50)], [(0, 1), (1, 2)], lanes=0.5, width=4.0)
    path = tmp_path / "scene"
    write_world(path)
    write_graphml(graph, scene.frame, path=SceneFiles(path).road_graph)
    narrow = restated(path)
    written = []

    def convert(command, **_options):
        file = command[command.index("--opendrive-files") + 1]
        written.append(ET.parse(file).getroot())  # noqa: S314  (our own file)
        Path(command[command.index("--output-file") + 1]).write_text("<net/>")
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr("geoscene.export.opendrive.need", lambda *_: SimpleNamespace(SUMO_HOME="/none"))
    monkeypatch.setattr("geoscene.export.opendrive.subprocess.run", convert)
    export_scene(narrow, tmp_path / "a.net.xml")
    for road in written[0].iter("road"):
        lanes = {
            e.get("id"): (e.get("type"), e.find("width")) for e in road.iter("lane") if e.get("id") != "0"
        }
        assert {kind for kind, _ in lanes.values()} == {"driving"}
        assert {float(width.get("a")) for _, width in lanes.values()} == {2.0}
        if road.get("junction") == "-1":
            assert set(lanes) == {"1", "-1"}
    turns = {(e.get("incomingRoad"), link.get("from")) for e in written[0].iter("connection") for link in e}
    assert turns == {("1", "-1"), ("2", "1")}


def test_missing_sumo_error_names_the_extra(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "sumo", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[sumo\]"):
        export_scene(scene, tmp_path / "a.net.xml")


def test_failed_write_keeps_the_old_file(tmp_path):
    (tmp_path / "a").write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), files.atomic_file(tmp_path / "a") as out:
        out.write(bytes(1 // 0))
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_bytes() == b"old"


def test_the_time_in_a_geopackage_has_milliseconds(scene, tmp_path):
    path = export_scene(scene, tmp_path / "a.gpkg").path
    with closing(sqlite3.connect(path)) as db:
        times = [row[0] for row in db.execute("SELECT last_change FROM gpkg_contents")]
    assert set(times) == {"2000-01-01T00:00:00.000Z"}


def test_cells_on_disk_have_their_space_before_they_are_mapped(tmp_path):
    grid = RasterGrid(0.0, 0.0, 1.0, 700, 1300)
    cells = _cells_on_disk(tmp_path / "cells", grid, value=np.float32(np.nan))
    assert cells.shape == (1300, 700)
    assert np.isnan(cells).all()
    stat = (tmp_path / "cells").stat()
    assert stat.st_blocks * 512 >= stat.st_size == 4 * 700 * 1300
