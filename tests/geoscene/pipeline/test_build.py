"""Built scenes are complete, watertight, georeferenced and reproducible."""

import json
import multiprocessing
import shutil
from dataclasses import replace

import geopandas
import numpy as np
import pytest
import shapely
from helpers import DEMO_BOX
from helpers.programs import run_program
from helpers.scenes import restated, same_files

import geoscene.pipeline.tiles
from geoscene.classes import Class
from geoscene.errors import InputError, SceneFormatError, SourceNotFoundError
from geoscene.export import export_scene
from geoscene.geometry.mesh import concatenate
from geoscene.geometry.watertight import validate_mesh
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.pipeline.plan import make_plan
from geoscene.scene import open_scene
from geoscene.scene.tile_files import Tile, write_tile
from geoscene.scene.validate import check_scene
from geoscene.sources import OsmData, demo_path, read_osm
from geoscene.sources.data import Way
from geoscene.view import view_scene


@pytest.fixture(scope="module")
def osm():
    return read_osm(demo_path(), bounds=DEMO_BOX)


@pytest.fixture(scope="module")
def plan(osm):
    return make_plan(osm, BuildOptions(), progress=lambda *_, **__: None)[0]


def test_every_solid_is_closed_oriented_and_of_positive_volume(scene):
    report = check_scene(scene)
    assert report["broken"] == []
    counts = scene.manifest["counts"]
    assert report["solids"] == counts["closed_objects"] == counts["watertight"] > counts["solids"] > 20
    assert report["volume"] > 1e5


@pytest.mark.full
def test_check_scene_reports_a_broken_solid(scene, tmp_path):
    shutil.copytree(scene.path, tmp_path / "broken")
    broken = open_scene(tmp_path / "broken")
    i, j = next(k for k in broken.tile_indices if broken.tile(*k).mesh.closed.any())
    tile = broken.tile(i, j)
    keep = np.ones(len(tile.mesh), bool)
    keep[np.flatnonzero(tile.mesh.closed)[5]] = False
    write_tile(broken.path / "tiles" / f"{i}_{j}.npz", Tile(tile.origin, tile.mesh.take(keep)))
    assert check_scene(broken)["changed"] == [f"tiles/{i}_{j}.npz"]
    report = check_scene(restated(broken.path))
    assert report["changed"] == []
    assert [row["fault"] for row in report["broken"]] == ["not-closed"]
    assert report["broken"][0]["osm_id"].startswith(("way/", "relation/"))


def test_check_scene_reports_broken_surfaces(scene, tmp_path):
    assert check_scene(scene)["broken_surfaces"] == []
    shutil.copytree(scene.path, tmp_path / "broken")
    broken = open_scene(tmp_path / "broken")
    i, j = broken.tile_indices[0]
    tile = broken.tile(i, j)
    mesh = tile.mesh
    row = np.flatnonzero(~mesh.closed & (mesh.klass == Class.ROAD))[0]
    a, b, c = mesh.vertices[mesh.faces[row]]
    for corners, fault in (
        ([a, b, (a + b) / 2], "degenerate-faces"),
        ([a, b, b + np.array([0.0, 0.0, 4e-4])], "vertices-within-1-mm"),
        ([a, b, c + np.array([0.0, 0.0, 3.0])], "non-manifold-edges"),
    ):
        extra = replace(
            mesh.take(np.array([row])), vertices=np.array(corners), faces=np.array([[0, 1, 2]], np.int32)
        )
        with_extra = replace(tile, mesh=concatenate([mesh, extra]), relief=None)
        write_tile(broken.files.tile(i, j), with_extra)
        [told] = check_scene(restated(broken.path))["broken_surfaces"]
        assert (told["tile"], told["fault"]) == ([i, j], fault)
        assert told["feature"] == mesh.feature[row]


def test_ground_covers_the_extent_exactly_once(scene):
    xmin, ymin, xmax, ymax = scene.bounds
    area = water = 0.0
    for tile in scene.tiles():
        ground = ~tile.mesh.closed
        a, b, c = (tile.mesh.vertices[tile.mesh.faces[ground, k]][:, :2] for k in range(3))
        u, v = b - a, c - a
        parts = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
        area += float(parts.sum())
        water += float(parts[tile.mesh.klass[ground] == Class.WATER].sum())
    open_area = scene.manifest["ground"]["open_area"]
    assert scene.manifest["ground"]["water_area"] == pytest.approx(water, abs=1e-6)
    assert area + open_area == pytest.approx((xmax - xmin) * (ymax - ymin), rel=1e-6)


def test_ground_triangles_meet_edge_to_edge_over_all_tiles(scene):
    ground = concatenate([t.mesh.take(~t.mesh.closed).shifted(t.origin) for t in scene.tiles()])
    _, number = np.unique(
        np.round(ground.vertices[:, :2] * 2**13).astype(np.int64), axis=0, return_inverse=True
    )
    corners = number.ravel()[ground.faces]
    edges = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert set(count.tolist()) <= {1, 2}
    where = np.zeros((number.max() + 1, 2))
    where[number.ravel()] = ground.vertices[:, :2]
    xmin, ymin, xmax, ymax = scene.bounds
    p, q = where[unique[count == 1, 0]], where[unique[count == 1, 1]]
    on_rim = np.zeros(len(p), bool)
    for axis, value in ((0, xmin), (0, xmax), (1, ymin), (1, ymax)):
        on_rim |= (np.abs(p[:, axis] - value) < 1e-3) & (np.abs(q[:, axis] - value) < 1e-3)
    # The ground is open at tunnel mouths.
    structures = geopandas.read_file(scene.path / "features.gpkg", layer="structures")
    tunnels = structures.geometry[structures.kind == "tunnel"].union_all().buffer(0.01)
    at = shapely.points(*scene.frame.to_projected(*((p + q) / 2).T))
    assert (on_rim | shapely.within(at, tunnels)).all()


def test_footprints_in_the_geopackage_match_openstreetmap(scene, osm):
    layer = geopandas.read_file(scene.path / "features.gpkg", layer="buildings").to_crs(4326)
    mapped = {area.osm_id: area.geometry for area in osm.areas}
    shares = []
    for osm_id, footprint in zip(layer.osm_id, layer.geometry, strict=True):
        there = mapped[osm_id]
        shares.append(there.intersection(footprint).area / there.union(footprint).area)
    assert np.median(shares) > 0.9999


def test_face_features_are_rows_of_the_geopackage(scene):
    start, stop = scene.layers["buildings"]
    layer = geopandas.read_file(scene.path / "features.gpkg", layer="buildings")
    assert layer.feature.tolist() == list(range(start, stop))
    for tile in scene.tiles():
        mesh = tile.mesh
        built = mesh.klass == Class.BUILDING
        assert ((mesh.feature[built] >= start) & (mesh.feature[built] < stop)).all()
        assert mesh.closed[built].all()
        for feature in np.unique(mesh.feature[built])[:3]:
            corners = mesh.vertices[mesh.faces[mesh.feature == feature]] + tile.origin
            row = layer.iloc[int(feature)]
            assert corners[..., 2].max() == pytest.approx(row.base + row.height, abs=0.01)


def test_every_building_height_has_a_source(scene):
    layer = geopandas.read_file(scene.path / "features.gpkg", layer="buildings")
    assert (layer.height > 0).all()
    assert (layer.height_source != "").all()
    assert scene.manifest["heights"] == layer.height_source.value_counts().sort_index().to_dict()
    guessed = layer.height_source.str.startswith("inferred")
    if guessed.any() and (layer.height_source == "tag").any():
        assert layer.height_sigma[guessed].min() > layer.height_sigma[layer.height_source == "tag"].max()


def test_number_of_workers_does_not_change_the_bytes(osm, scene, tmp_path):
    again = build(osm, tmp_path / "again", options=BuildOptions(name="demo"), workers=2)
    same_files(scene.path, again.path)


@pytest.mark.full
def test_spawned_workers_give_the_same_bytes(tmp_path, monkeypatch):
    spawn = multiprocessing.get_context("spawn")
    monkeypatch.setattr("geoscene.support.processes.multiprocessing.get_context", lambda: spawn)
    # With a bridge, the height function of the ground must be pickled for the workers.
    slope = np.linspace(60.1655, 60.1690, 4)
    lonlat = {n: (24.9405 + 0.002 * k, lat) for k in range(2) for n, lat in enumerate(slope, start=4 * k)}
    lonlat |= {8: (24.9385, 60.167), 9: (24.9400, 60.167), 10: (24.9410, 60.167), 11: (24.9440, 60.167)}
    road = {"highway": "residential"}
    ways = [
        (road, [0, 1, 2, 3]),
        (road, [8, 9]),
        (road | {"bridge": "yes", "layer": "1"}, [9, 10]),
        (road, [10, 11]),
    ]
    osm = OsmData(
        bounds=(24.9380, 60.1650, 24.9450, 60.1695),
        ways=[
            Way(f"way/{k}", tags, np.array(nodes, np.int64), np.array([lonlat[n] for n in nodes]))
            for k, (tags, nodes) in enumerate(ways)
        ],
        areas=[],
        points=[],
        relations=[],
    )
    alone = build(osm, tmp_path / "alone", options=BuildOptions(name="bridge"))
    assert alone.manifest["counts"]["closed_objects"] > 0
    same_files(alone.path, build(osm, tmp_path / "both", options=BuildOptions(name="bridge"), workers=2).path)


@pytest.mark.full
def test_interrupted_build_resumes_with_the_same_bytes(osm, scene, tmp_path, monkeypatch):
    made = []
    whole = geoscene.pipeline.tiles.build_tile

    def dying(*args, **options):
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(args)
        return whole(*args, **options)

    monkeypatch.setattr(geoscene.pipeline.tiles, "build_tile", dying)
    with pytest.raises(KeyboardInterrupt):
        build(osm, tmp_path / "scene", options=BuildOptions(name="demo"))
    assert not (tmp_path / "scene").exists()
    monkeypatch.setattr(
        geoscene.pipeline.tiles, "build_tile", lambda *a, **o: made.append(a) or whole(*a, **o)
    )
    again = build(osm, tmp_path / "scene", options=BuildOptions(name="demo"))
    assert len(made) == len(scene.tile_indices)  # no tile is built twice
    same_files(scene.path, again.path)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


@pytest.mark.full
def test_rebuild_reuses_no_tile_of_another_schema(osm, scene, tmp_path, monkeypatch):
    shutil.copytree(scene.path, tmp_path / "scene")
    made, whole = [], geoscene.pipeline.tiles.build_tile
    monkeypatch.setattr(
        geoscene.pipeline.tiles, "build_tile", lambda *a, **o: made.append(a) or whole(*a, **o)
    )
    monkeypatch.setattr("geoscene.pipeline.build.SCHEMA", 99)
    build(osm, tmp_path / "scene", options=BuildOptions(name="demo"), overwrite=True)
    assert len(made) == len(scene.tile_indices)


@pytest.mark.full
def test_tiles_along_a_route_equal_those_of_the_whole_scene(osm, scene, tmp_path):
    along = ("60.1665,24.9420", "60.1668,24.9425")
    part = build(osm, tmp_path / "part", options=BuildOptions(name="demo", along=along, reach=20.0))
    assert 0 < len(part.tile_indices) < len(scene.tile_indices)
    for i, j in part.tile_indices:
        name = f"tiles/{i}_{j}.npz"
        assert (part.path / name).read_bytes() == (scene.path / name).read_bytes()


@pytest.mark.full
def test_scene_for_gis_has_the_tables_and_no_tiles(osm, scene, tmp_path):
    part = build(osm, tmp_path / "gis", options=BuildOptions(name="demo", use="gis"))
    assert part.files.road_graph.read_bytes() == scene.files.road_graph.read_bytes()
    for name in scene.layers:
        if not scene.table_length(name):
            continue
        mine, theirs = part.features(name), scene.features(name)
        assert shapely.equals_exact(mine.geometry, theirs.geometry).all()
        for column, values in theirs.columns.items():
            same = (mine.columns[column] == values) | (values != values)  # noqa: PLR0124 (NaN)
            # roofs that had to be replaced are known where they are built
            assert same.mean() > 0.9 if column.startswith("roof_") else same.all(), (name, column)
    assert part.manifest["left_out"]["tiles"] == len(scene.tile_indices)
    assert list(part.files.tiles.iterdir()) == []
    assert export_scene(part, tmp_path / "a.gpkg").objects > 0
    assert export_scene(part, tmp_path / "a.xodr").objects > 0
    for name in ("a.glb", "a.city.json", "a.tif"):
        with pytest.raises(SceneFormatError, match="no tiles"):
            export_scene(part, tmp_path / name)
        assert not (tmp_path / name).exists()
    done = run_program("lidar", "drive", part.path, "--route", "random", "-o", tmp_path / "drive", "-q")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "no tiles" in done.stderr
    assert not (tmp_path / "drive").exists()


def test_scene_for_a_map_has_tables_in_plan(osm, scene, tmp_path):
    part = build(osm, tmp_path / "map", options=BuildOptions(name="demo", use="map"))
    assert part.files.road_graph.read_bytes() == scene.files.road_graph.read_bytes()
    for name in scene.layers:
        kept = name not in ("building_parts", "structures", "wires")
        assert part.table_length(name) == (scene.table_length(name) if kept else 0)
    assert part.manifest["left_out"]["tiles"] == len(scene.tile_indices)
    assert part.manifest["left_out"]["bytes"] > 0
    for name in ("a.gpkg", "a.xodr"):
        assert export_scene(part, tmp_path / name).objects > 0
    with pytest.raises(SceneFormatError, match=r"no tiles; build it again without --for"):
        export_scene(part, tmp_path / "a.glb")


@pytest.mark.parametrize("use", ["lidar", "camera"])
def test_scene_for_sensors_is_not_exported_or_shown(use, osm, tmp_path):
    part = build(osm, tmp_path / use, options=BuildOptions(name="demo", use=use, only=("buildings",)))
    for call in (
        lambda: export_scene(part, tmp_path / "a.glb"),
        lambda: export_scene(part, tmp_path / "a.gpkg"),
        lambda: view_scene(part, tmp_path / "a.html"),
    ):
        with pytest.raises(SceneFormatError, match=f"built for {use}, has no .*without --for"):
            call()
    done = run_program("geoscene", "info", part.path)
    assert f"for {use}" in done.stdout
    assert "attributes of features" in done.stdout


@pytest.mark.full
def test_only_selected_kinds_are_built(osm, tmp_path):
    scene = build(osm, tmp_path / "s", options=BuildOptions(only=("buildings",)))
    counts = scene.manifest["counts"]
    assert counts["solids"] > 20
    assert counts["trees"] == counts["furniture"] == counts["barriers"] == counts["road_edges"] == 0
    ground = scene.manifest["ground"]
    assert ground["area"] + ground["open_area"] == pytest.approx(ground["extent_area"], rel=1e-6)


def test_scene_is_replaced_only_with_overwrite(osm, scene, tmp_path):
    with pytest.raises(SceneFormatError, match="`overwrite`"):
        build(osm, scene.path)
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "a.txt").write_text("dear")
    with pytest.raises(SceneFormatError, match="not a scene"):
        build(osm, tmp_path / "letters", overwrite=True)
    assert (tmp_path / "letters" / "a.txt").exists()


@pytest.mark.full
def test_failed_build_leaves_no_files(osm, tmp_path, monkeypatch):
    monkeypatch.setattr("geoscene.pipeline.tiles.ground_tile", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        build(osm, tmp_path / "half")
    assert list(tmp_path.iterdir()) == []


def test_a_building_that_fails_in_a_tile_is_dropped_alone(osm, scene, tmp_path, monkeypatch):
    whole = geoscene.pipeline.tiles.build_solids
    victim = str(scene.features("buildings").columns["osm_id"][7])

    def failing(buildings, **options):
        if victim in buildings.osm_id:
            raise ZeroDivisionError
        return whole(buildings, **options)

    monkeypatch.setattr(geoscene.pipeline.tiles, "build_solids", failing)
    counts = build(osm, tmp_path / "s", options=BuildOptions(name="demo"), workers=1).manifest["counts"]
    rows = (tmp_path / "s" / "problems.csv").read_text("utf-8").splitlines()
    assert [row for row in rows if victim in row and "no-solid" in row] == [
        f"{victim},building,dropped,no-solid,ZeroDivisionError"
    ]
    before = scene.manifest["counts"]
    assert (counts["buildings"], counts["solids"]) == (before["buildings"], before["solids"] - 1)


@pytest.mark.parametrize(
    ("layer", "kind", "make"),
    [
        ("trees", "tree", "tree_instances"),
        ("furniture", "furniture", "furniture_instances"),
        ("barriers", "barrier", "barrier_meshes"),
    ],
)
def test_an_object_that_fails_in_a_tile_is_dropped_alone(plan, monkeypatch, layer, kind, make):
    table = getattr(plan, layer)
    tile, rows = max(plan.rows[layer].items(), key=lambda item: len(item[1]))
    victim, whole = str(table.osm_id[rows[-1]]), getattr(geoscene.pipeline.tiles, make)
    before = geoscene.pipeline.tiles.make_ground(plan, tile)

    def failing(some, **options):
        if victim in some.osm_id:
            raise ZeroDivisionError
        return whole(some, **options)

    monkeypatch.setattr(geoscene.pipeline.tiles, make, failing)
    after = geoscene.pipeline.tiles.make_ground(plan, tile)
    lost = {(p.osm_id, p.kind, p.action, p.reason, p.detail) for p in after.problems}
    assert lost == {(victim, kind, "dropped", "unexpected-error", "ZeroDivisionError")}
    gone = table.feature[rows[table.osm_id[rows] == victim]]
    if layer == "barriers":
        assert set(before.mesh.feature) - set(after.mesh.feature) == set(gone)
    else:
        lost = np.isin(before.instances.feature, gone).sum()
        assert len(after.instances) == len(before.instances) - lost


def test_map_without_features_is_refused(tmp_path):
    with pytest.raises(SourceNotFoundError, match="no features"):
        build(OsmData((24.9, 60.1, 24.91, 60.11), [], [], [], []), tmp_path / "x")


@pytest.mark.parametrize(
    "change", [{"lod": 3}, {"tile_size": 10.5}, {"tile_size": 1e6}, {"dem_tolerance": 1.0}]
)
def test_invalid_build_options_are_refused(change):
    with pytest.raises(InputError, match="`"):
        BuildOptions(**change)


def test_error_names_the_fault_of_a_damaged_scene(tmp_path):
    with pytest.raises(SceneFormatError, match="no such scene"):
        open_scene(tmp_path / "nowhere")
    (tmp_path / "scene.json").write_text("{")
    with pytest.raises(SceneFormatError, match="damaged"):
        open_scene(tmp_path)
    (tmp_path / "scene.json").write_text(json.dumps({"schema": 99}))
    with pytest.raises(SceneFormatError, match=r"schema version 99.*a newer version wrote it: upgrade"):
        open_scene(tmp_path)


SMALL = [
    "berlin_siegessaeule.osm.gz",
    "berlin_neukoelln.osm.gz",
    "singapore_bayfront.osm.pbf",
    "oslo_skoyen.osm.pbf",
    "st_petersburg_galernaya.osm.gz",
    "norfolk_east_28th_buildings.osm.gz",
]


@pytest.mark.shared
@pytest.mark.parametrize("name", SMALL)
def test_real_places_build_watertight(name, shared_osm, tmp_path):
    scene = build(read_osm(shared_osm(name)), tmp_path / "s")
    counts = scene.manifest["counts"]
    assert counts["solids"] == counts["buildings"] - counts["dropped"]
    assert counts["watertight"] == counts["closed_objects"] >= counts["solids"]
    meshes = [tile.mesh for tile in scene.tiles()]
    assert all(validate_mesh(mesh).ok.all() for mesh in meshes)
    ground = scene.manifest["ground"]
    assert ground["area"] + ground["open_area"] == pytest.approx(ground["extent_area"], rel=1e-6)
