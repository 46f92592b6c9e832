"""Large scenes: tiles are independent of distant features, and killed builds resume."""

import importlib
import importlib.util
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely
from helpers import ROOT
from helpers.programs import ENVIRONMENT, alive, command

from geoscene.classes import Class
from geoscene.export import export_scene
from geoscene.ground import Layers, partition_tile, plan_ground
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.pipeline.plan import make_plan
from geoscene.scene.validate import check_scene
from geoscene.sources import Way, read_osm
from geoscene.support.progress import silent
from geoscene.view import view_scene
from lidar.errors import RouteError
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.simulation.plan import plan_drive
from lidar.traffic.options import TrafficOptions


@pytest.fixture(scope="module")
def make_osm():
    spec = importlib.util.spec_from_file_location("make_osm", ROOT / "benchmarks" / "make_osm.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_osm"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def town(make_osm, tmp_path_factory):
    path = tmp_path_factory.mktemp("town") / "town.osm.pbf"
    make_osm.write_city(make_osm.make_city(150, seed=1), path)
    return path


@pytest.fixture(scope="module")
def scene(town, tmp_path_factory):
    options = BuildOptions(tile_size=100.0, lod=1)
    return build(read_osm(town), tmp_path_factory.mktemp("whole") / "scene", options=options)


def files_of(folder):
    return {p.relative_to(folder): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_synthetic_city_is_reproducible_and_has_the_requested_size(make_osm, town, tmp_path):
    make_osm.write_city(make_osm.make_city(150, seed=1), tmp_path / "again.osm.pbf")
    assert (tmp_path / "again.osm.pbf").read_bytes() == town.read_bytes()
    small, large = (read_osm(town), make_osm.make_city(1500, seed=1))
    assert 150 <= sum("building" in area.tags for area in small.areas) <= 170
    assert 1500 <= large.buildings <= 1520
    assert np.ptp(large.places, axis=0).min() > 2 * 111_195 * (small.bounds[3] - small.bounds[1]) / 2


def test_synthetic_city_builds_without_repairs(scene):
    counts = scene.manifest["counts"]
    assert counts["watertight"] == counts["closed_objects"] >= counts["solids"] == counts["buildings"]
    assert counts["dropped"] == 0
    assert counts["trees"] >= 20
    assert scene.layers["structures"][1] > scene.layers["structures"][0]


@pytest.mark.gate
def test_partition_of_a_tile_ignores_distant_polygons(monkeypatch):
    compared = []
    partition = importlib.import_module("geoscene.ground.partition")
    whole = partition._last_around
    monkeypatch.setattr(
        partition, "_last_around", lambda polygons, xy: compared.append(len(polygons)) or whole(polygons, xy)
    )
    x, y = np.mgrid[0:100, 0:100].reshape(2, -1) * 10.0
    layers = Layers.of(shapely.box(x, y, x + 9.0, y + 9.0), klass=1, material=1, priority=0.0)
    plan = plan_ground((0, 0, 1000, 1000), layers, tile_size=50.0)
    cells = partition_tile(plan, 3, j=4)
    assert len(cells) == 26  # five by five squares and the ground between them
    assert 25 <= sum(compared) <= 49


def build_words(town, out):
    words = command("geoscene", "build", "--osm", town, "--out", out)
    return [*words, "--tile-size", "100", "--lod", "1", "--workers", "2", "--quiet"]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
def test_build_resumes_after_sigkill_with_the_same_bytes(town, scene, tmp_path):
    out = tmp_path / "scene"
    process = subprocess.Popen(
        build_words(town, out), env=ENVIRONMENT, start_new_session=True, stdout=subprocess.DEVNULL
    )
    tiles = tmp_path / "scene.part" / "tiles"
    while process.poll() is None and len(list(tiles.glob("*.npz"))) < 5:
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    deadline = time.monotonic() + 60
    while alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert alive(process.pid) == []  # its workers have exited
    left = {p.name: p.stat().st_mtime_ns for p in tiles.glob("*.npz")}
    assert not out.exists()
    assert 5 <= len(left) < len(scene.tile_indices)
    # a partly written tile and table, and a tile of a build with other options
    (tiles / "0_0.npz.123.part").write_bytes(b"half")
    (tiles / "99_99.npz").write_bytes(b"old")
    (tiles.parent / "features.123.part.gpkg").write_bytes(b"half")

    subprocess.run(build_words(town, out), env=ENVIRONMENT, check=True, stdout=subprocess.DEVNULL)
    assert files_of(out) == files_of(scene.path)
    taken = {name for name, written in left.items() if (out / "tiles" / name).stat().st_mtime_ns == written}
    assert taken  # tiles in the journal are not made again


def test_long_wall_in_range_adds_its_tile(make_osm, town, tmp_path):
    lonlat = make_osm.on_globe(np.array([(-300.0, 0.0), (-60.0, 0.0), (-180.0, 15.0), (-180.0, 265.0)]))
    route = tuple(f"{lat},{lon}" for lon, lat in lonlat[:2].tolist())
    options = BuildOptions(tile_size=100.0, lod=0, along=route, reach=10.0, only=("roads", "barriers"))
    osm = read_osm(town)
    wall = Way("way/999999", {"barrier": "wall"}, np.array([-1, -2]), lonlat[2:])
    without, walled = (
        build(replace(osm, ways=ways), tmp_path / name, options=options)
        for name, ways in (("without", osm.ways), ("walled", [*osm.ways, wall]))
    )
    (home,) = set(walled.tile_indices) - set(without.tile_indices)
    x, y = walled.frame.from_geographic(*lonlat[2:].mean(axis=0))
    assert home == (x // 100, y // 100)
    assert (walled.tile(*home).mesh.klass == Class.WALL).any()


@pytest.mark.gate
def test_bridge_with_an_end_in_range_adds_its_tile(town, tmp_path, monkeypatch):
    monkeypatch.setattr("geoscene.pipeline.reach.OFFSET", 0.0)
    monkeypatch.setattr("geoscene.pipeline.reach._CROWN", 0.0)
    options = BuildOptions(tile_size=50.0, only=("roads",))
    osm = read_osm(town)
    plan, _ = make_plan(osm, options, progress=silent)
    found = 0
    for home, rows in plan.rows["structures"].items():
        square = shapely.box(*np.multiply(home, 50.0), *np.add(home, 1) * 50.0)
        corners = shapely.points(shapely.get_coordinates(plan.structures.polygon[rows]))
        away = shapely.distance(corners, square)
        if away.max() > 2.0:
            end = corners[away.argmax()]
            there = "lon,lat\n{},{}\n".format(*plan.frame.to_geographic(end.x, end.y))
            (tmp_path / "end.csv").write_text(there)
            along = replace(options, along=(str(tmp_path / "end.csv"),), reach=1.0)
            assert home in make_plan(osm, along, progress=silent)[0].chosen
            found += 1
    assert found  # a bridge that sticks out of its tile


def test_drive_on_tiles_along_its_route_gives_the_same_bytes(make_osm, town, tmp_path):
    lonlat = make_osm.on_globe(np.array([(-300.0, 0.0), (-60.0, 0.0)]))
    route = tuple((lat, lon) for lon, lat in lonlat.tolist())
    along = tuple(f"{lat},{lon}" for lat, lon in route)
    options = BuildOptions(tile_size=100.0, lod=1, along=along, reach=100.0)
    part = build(read_osm(town), tmp_path / "part", options=options)
    scene = build(read_osm(town), tmp_path / "whole", options=BuildOptions(tile_size=100.0, lod=1))
    assert len(part.tile_indices) < 0.7 * len(scene.tile_indices)
    assert part.layers == scene.layers
    for i, j in part.tile_indices:
        name = f"tiles/{i}_{j}.npz"
        assert (part.path / name).read_bytes() == (scene.path / name).read_bytes()
    words = DriveOptions(route=route, rig="vlp16", duration=2.0, formats=("pcd",))
    drives = [drive(s, tmp_path / f"{s.path.name}_drive", options=words).path for s in (scene, part)]
    clouds = [{p.relative_to(d): p.read_bytes() for p in d.rglob("*.pcd")} for d in drives]
    assert len(clouds[0]) == 20
    assert clouds[0] == clouds[1]
    assert plan_drive(part, words).limits == []


@pytest.mark.gate
def test_drive_beyond_what_was_built_along_a_route_says_so(make_osm, part, scene):
    lonlat = make_osm.on_globe(np.array([(-300.0, 0.0), (-250.0, 0.0), (250.0, 0.0)]))
    route = tuple((lat, lon) for lon, lat in lonlat.tolist())
    words = DriveOptions(route=route[:2], rig="vlp16", duration=1.0)
    (limit,) = plan_drive(part, words).limits
    assert (limit.name, limit.measured, limit.bound, limit.unit) == ("reach", 100.0, 20.0, "m")
    assert plan_drive(scene, words).limits == []
    near = replace(words, settings=(("reach", "20"),))
    assert plan_drive(part, near).limits == []
    with pytest.raises(RouteError, match="only what lies along the route it was built for"):
        plan_drive(part, replace(words, route=(route[0], route[2])))


@pytest.fixture(scope="module")
def part(make_osm, town, tmp_path_factory):
    lonlat = make_osm.on_globe(np.array([(-300.0, 0.0), (-250.0, 0.0)]))
    along = tuple(f"{lat},{lon}" for lon, lat in lonlat.tolist())
    options = BuildOptions(tile_size=100.0, lod=1, along=along, reach=20.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("geoscene.pipeline.reach.TABLE_MARGIN", 20.0)
        return build(read_osm(town), tmp_path_factory.mktemp("part") / "scene", options=options)


@pytest.mark.gate
def test_tables_along_a_route_hold_what_is_in_reach_with_the_numbers_of_the_whole_scene(scene, part):
    assert part.layers == scene.layers
    assert sum(p.stat().st_size for p in (part.files.features, part.files.road_graph)) < 0.6 * sum(
        p.stat().st_size for p in (scene.files.features, scene.files.road_graph)
    )
    used = set()
    for tile in part.tiles():
        used |= set(tile.mesh.feature.tolist()) | set(tile.instances.feature.tolist())
    for name, (first, stop) in part.layers.items():
        if not part.table_length(name):
            assert used.isdisjoint(range(first, stop))
            continue
        whole, some = scene.features(name), part.features(name)
        rows = np.searchsorted(whole.columns["feature"], some.columns["feature"])
        assert len(rows) == part.table_length(name) <= scene.table_length(name) <= stop - first
        assert set(range(first, stop)) & used <= set(some.columns["feature"].tolist())
        assert shapely.equals_exact(some.geometry, whole.geometry[rows], tolerance=1e-9).all()
        for column in set(some.columns) - {"edge"}:
            np.testing.assert_array_equal(some.columns[column], whole.columns[column][rows])
    assert part.table_length("buildings") < 0.6 * scene.table_length("buildings")


@pytest.mark.gate
def test_edges_of_structures_along_a_route_are_those_of_its_road_graph(part):
    structures, graph = part.features("structures"), part.road_graph()
    roads = part.features("roads")
    assert len(graph) == len(roads)
    for osm_id, edge in zip(structures.columns["osm_id"], structures.columns["edge"], strict=True):
        assert edge < 0 or osm_id in str(graph.osm_id[edge]).split(";")


@pytest.mark.parametrize("name", ["a.city.json", "a.glb", "a.gpkg", "a.geojson", "a.ply"])
def test_scenes_along_a_route_export(part, tmp_path, name):
    assert export_scene(part, tmp_path / name).objects > 0


def test_scenes_along_a_route_have_a_page_and_pass_validation(part, tmp_path):
    assert view_scene(part, tmp_path / "page.html").objects > 0
    report = check_scene(part)
    assert report["solids"] > 0
    assert not report["broken"]


def test_traffic_along_a_route_is_that_of_the_whole_scene(make_osm, town, scene, tmp_path):
    lonlat = make_osm.on_globe(np.array([(-300.0, 0.0), (-60.0, 0.0)]))
    along = tuple(f"{lat},{lon}" for lon, lat in lonlat.tolist())
    options = BuildOptions(tile_size=100.0, lod=1, along=along, reach=100.0)
    part = build(read_osm(town), tmp_path / "part", options=options)
    route = tuple((lat, lon) for lon, lat in lonlat.tolist())
    words = DriveOptions(
        route=route, rig="vlp16", duration=1.0, formats=("pcd",), traffic=TrafficOptions(radius=100.0)
    )
    drives = [drive(s, tmp_path / s.path.name / "drive", options=words).path for s in (scene, part)]
    clouds = [{p.relative_to(d): p.read_bytes() for p in d.rglob("*.pcd")} for d in drives]
    assert clouds[0] == clouds[1]
