"""Drives through maps without a scene: the same bytes as from whole scenes, built once, grown, repaired."""

import json
import shutil
import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import shapely
from helpers.programs import ENVIRONMENT, command
from helpers.scenes import same_files

from geoscene.errors import InputError as SceneInputError
from geoscene.errors import MissingExtraError, NetworkError
from geoscene.options import BuildOptions, CloudOptions
from geoscene.pipeline import tiles
from geoscene.pipeline.build import build
from geoscene.scene import open_scene
from geoscene.scene.layout import changed_files
from geoscene.sources import Servers, read_osm
from lidar.dataset.layout import open_dataset
from lidar.errors import InputError, RouteError
from lidar.options.drive import DriveOptions
from lidar.options.place import PlaceOptions
from lidar.simulation import scene_cache
from lidar.simulation.drive import drive
from lidar.simulation.scene_cache import _stretches
from lidar.simulation.scene_source import open_scene_or_map
from lidar.traffic.options import TrafficOptions

RIG = """
name = "one scanner"
vehicle = "car"

[[lidar]]
name = "lidar_top"
preset = "vlp16"
translation = [1.0, 0.0, 1.9]
"""

SEEING_RIG = (
    RIG
    + """
[[camera]]
name = "front"
translation = [1.5, 0.0, 1.4]
width = 96
height = 64
fov_deg = 80.0
rate_hz = 10.0

[[gnss]]
name = "gnss"
"""
)
STEP = 0.0045  # degrees of latitude: 500 m
WEST, SOUTH = 9.5, 47.1
STREETS = 9  # from south to north: 4 km


def osm_of(streets=STREETS, *, roads=True):
    """A map of a long avenue with cross streets, and buildings along them, as OSM XML."""
    nodes, ways = [], []

    def node(east, north):
        nodes.append((len(nodes) + 1, WEST + east / 75_700, SOUTH + north / 111_195))
        return len(nodes)

    def way(refs, **tags):
        body = "".join(f'<nd ref="{n}"/>' for n in refs)
        body += "".join(f'<tag k="{k.replace("__", ":")}" v="{v}"/>' for k, v in tags.items())
        ways.append(f'<way id="{len(ways) + 1}" version="1">{body}</way>')

    crossings = [node(0, 500 * k) for k in range(streets)]
    if roads:
        way(crossings, highway="secondary", maxspeed="50", width="8")
    for k, crossing in enumerate(crossings):
        if roads:
            ends = node(-150, 500 * k), node(150, 500 * k)
            way((ends[0], crossing, ends[1]), highway="residential", width="6")
        for east in (-60, 30):
            x, y = east, 500 * k + 40
            ring = [node(x, y), node(x + 20, y), node(x + 20, y + 15), node(x, y + 15)]
            way([*ring, ring[0]], building="yes", height=str(6 + k))
    points = "".join(f'<node id="{n}" version="1" lon="{x:.7f}" lat="{y:.7f}"/>' for n, x, y in nodes)
    return f'<osm version="0.6">{points}{"".join(ways)}</osm>'


def at(north, east=0):
    return SOUTH + north / 111_195, WEST + east / 75_700


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Map file, rig file and whole scene."""
    folder = tmp_path_factory.mktemp("town")
    (folder / "town.osm").write_text(osm_of())
    (folder / "rig.toml").write_text(RIG)
    (folder / "seeing.toml").write_text(SEEING_RIG)
    build(read_osm(folder / "town.osm"), folder / "whole", options=BuildOptions(name="town"))
    return folder


@pytest.fixture(scope="module")
def south(town):
    return DriveOptions(
        route=[at(20), at(180)], rig=str(town / "rig.toml"), duration=0.5, formats=("pcd",), workers=1
    )


def opened(town, options, cache, **place):
    return open_scene_or_map(town / "town.osm", options, place=PlaceOptions(scene_cache=cache, **place))


@pytest.fixture(scope="module")
def cached(town, south, tmp_path_factory):
    """A cache with the scene of the drive in the south."""
    cache = tmp_path_factory.mktemp("cache")
    opened(town, south, cache)
    return cache


def same_drives(a, b):
    """Assert that two datasets are the same but for the scene that they name."""
    documents = []
    for folder in (a, b):
        document = json.loads((folder / "dataset.json").read_text())
        del document["scene"]
        document["recipe"].pop("map", None)
        documents.append(document)
        (folder / "dataset.json").unlink()
        (folder / "checksums.sha256").unlink()  # of dataset.json, too
    assert documents[0] == documents[1]
    same_files(a, b)


@pytest.mark.parametrize("kind", ["waypoints", "random", "traffic", "satellites and sun"])
def test_drives_of_a_map_have_the_bytes_of_drives_in_its_whole_scene(kind, town, south, tmp_path):
    options = {
        "waypoints": south,
        "random": replace(south, route="random", seed=5),
        "traffic": replace(south, traffic=TrafficOptions(vehicles=60, radius=100)),
        "satellites and sun": replace(south, rig=str(town / "seeing.toml")),
    }[kind]
    whole = open_scene(town / "whole")
    found = opened(town, options, tmp_path / "cache")
    assert 0 < found.built < len(whole.tile_indices)
    assert len(found.scene.road_graph()) == len(whole.road_graph())
    assert found.scene.table_length("buildings") < whole.table_length("buildings")
    drive(whole, tmp_path / "a", options=options)
    drive(found.scene, tmp_path / "b", options=options)
    same_drives(tmp_path / "a", tmp_path / "b")


@pytest.mark.full
def test_flights_of_a_map_have_the_bytes_of_flights_in_its_whole_scene(town, tmp_path):
    south, north = at(400, -60), at(900, 60)
    survey = f"{south[1]},{south[0]},{north[1]},{north[0]}"
    options = DriveOptions(rig="drone", survey=survey, turns=True, duration=0.5, formats=("pcd",))
    found = opened(town, options, tmp_path / "cache")
    whole = open_scene(town / "whole")
    assert 0 < found.built < len(whole.tile_indices)
    drive(whole, tmp_path / "a", options=options)
    drive(found.scene, tmp_path / "b", options=options)
    same_drives(tmp_path / "a", tmp_path / "b")


@pytest.mark.full
def test_the_same_drive_again_reads_no_map_and_builds_nothing(town, south, tmp_path, monkeypatch):
    first = opened(town, south, tmp_path)
    monkeypatch.delattr(scene_cache, "read_osm")
    monkeypatch.delattr(scene_cache, "needed_area")
    again = opened(town, south, tmp_path)
    assert again.built == 0
    assert again.scene.path == first.scene.path


@pytest.mark.full
def test_a_scene_grows_by_the_tiles_that_another_drive_needs(town, south, tmp_path, monkeypatch):
    first = opened(town, south, tmp_path / "cache")
    before = {p.name: p.read_bytes() for p in first.scene.files.tiles.iterdir()}
    made = []
    build_tile = tiles.build_tile
    monkeypatch.setattr(
        tiles,
        "build_tile",
        lambda *args, tile, **more: made.append(tile) or build_tile(*args, tile=tile, **more),
    )
    north = replace(south, route=[at(3020), at(3180)])
    second = opened(town, north, tmp_path / "cache")
    assert second.scene.path == first.scene.path
    assert second.built == len(made) > 0
    assert set(second.scene.tile_indices) == set(first.scene.tile_indices) | set(made)
    for name, data in before.items():
        assert (second.scene.files.tiles / name).read_bytes() == data
    assert changed_files(second.scene) == []
    # The scene that was opened before is still good for its drive, and the grown one for both.
    whole = open_scene(town / "whole")
    for number, (options, scene) in enumerate(
        [(south, first.scene), (south, second.scene), (north, second.scene)]
    ):
        drive(whole, tmp_path / f"a{number}", options=options)
        drive(scene, tmp_path / f"b{number}", options=options)
        same_drives(tmp_path / f"a{number}", tmp_path / f"b{number}")
    assert opened(town, south, tmp_path / "cache").built == 0


@pytest.mark.parametrize(
    "harm",
    [
        lambda files: files.manifest.unlink(),
        lambda files: files.manifest.write_text(files.manifest.read_text()[:500]),
        lambda files: files.features.write_bytes(files.features.read_bytes()[:5000]),
        lambda files: files.road_graph.unlink(),
        lambda files: next(files.tiles.iterdir()).unlink(),
        lambda files: next(files.tiles.iterdir()).write_bytes(b"PK"),
        lambda files: files.tile_reports.write_text("{}"),
        lambda files: shutil.rmtree(files.tiles),
        lambda files: shutil.move(files.folder, files.folder.with_name("scene.new")),
    ],
)
def test_damaged_and_half_scenes_of_the_cache_are_built_again(harm, town, south, cached, tmp_path):
    shutil.copytree(cached, tmp_path / "cache")
    (good,) = cached.glob("*/scene")
    (copy,) = (tmp_path / "cache").glob("*/scene")
    harm(open_scene(copy).files)
    assert opened(town, south, tmp_path / "cache").scene.path == copy
    same_files(copy, good)
    assert sorted(p.name for p in copy.parent.iterdir()) == ["drives", "scene"]


@pytest.mark.full
def test_scenes_are_built_by_several_processes_that_start_anew_if_libraries_have_threads(
    town, south, tmp_path
):
    drive(open_scene(town / "whole"), tmp_path / "threads", options=south)
    alone = opened(town, south, tmp_path / "one").scene
    together = opened(town, replace(south, workers=2), tmp_path / "two").scene
    same_files(alone.path, together.path)


@pytest.mark.full
def test_a_program_that_is_killed_while_a_scene_grows_leaves_a_cache_that_works(
    town, south, tmp_path, monkeypatch
):
    north = replace(south, route=[at(3020), at(3180)])
    opened(town, south, tmp_path / "cache")
    replaced = Path.replace

    def killed(path, target):
        if path.name == "scene.json" and path.parent.name == "scene.new":
            raise KeyboardInterrupt
        return replaced(path, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        opened(town, north, tmp_path / "cache")
    monkeypatch.undo()
    for number, options in enumerate((north, south, north)):
        scene = opened(town, options, tmp_path / "cache").scene
        assert changed_files(scene) == []
        drive(open_scene(town / "whole"), tmp_path / f"a{number}", options=options)
        drive(scene, tmp_path / f"b{number}", options=options)
        same_drives(tmp_path / f"a{number}", tmp_path / f"b{number}")
    assert opened(town, south, tmp_path / "cache").built == 0


@pytest.mark.full
def test_a_build_that_is_interrupted_is_resumed(town, south, tmp_path, monkeypatch):
    build_tile = tiles.build_tile
    made = []

    def stopping(*args, tile, **more):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(tile)
        return build_tile(*args, tile=tile, **more)

    monkeypatch.setattr(tiles, "build_tile", stopping)
    with pytest.raises(KeyboardInterrupt):
        opened(town, south, tmp_path / "cache")
    monkeypatch.setattr(
        tiles,
        "build_tile",
        lambda *args, tile, **more: made.append(tile) or build_tile(*args, tile=tile, **more),
    )
    found = opened(town, south, tmp_path / "cache")
    assert sorted(made) == found.scene.tile_indices  # each once
    assert sorted(p.name for p in found.scene.path.parent.iterdir()) == ["drives", "scene"]


@pytest.mark.full
def test_other_options_and_contents_have_scenes_of_their_own(town, south, tmp_path):
    cache = tmp_path / "cache"
    plain = opened(town, south, cache).scene
    assert opened(town, south, cache, lod=1).scene.path != plain.path
    shutil.copy(town / "town.osm", tmp_path / "copy.osm")
    copy = open_scene_or_map(tmp_path / "copy.osm", south, place=PlaceOptions(scene_cache=cache))
    assert copy.scene.path == plain.path
    (tmp_path / "copy.osm").write_text(osm_of().replace('v="8"', 'v="9"'))
    other = open_scene_or_map(tmp_path / "copy.osm", south, place=PlaceOptions(scene_cache=cache))
    assert other.scene.path != plain.path


def test_a_map_is_built_with_the_relief_of_the_drive(town, south, tmp_path):
    plain, off, full = (
        opened(town, replace(south, relief=relief), tmp_path / "cache") for relief in ("", "off", "full")
    )
    assert [found.scene.relief for found in (plain, off, full)] == ["plain", "off", "full"]
    assert len({found.scene.path for found in (plain, off, full)}) == 3
    again = opened(town, replace(south, relief="mesh"), tmp_path / "cache")
    assert (again.built, again.scene.path) == (0, plain.scene.path)


def test_point_clouds_are_for_maps(town, south):
    with pytest.raises(InputError, match="`cloud`: is for maps"):
        open_scene_or_map(town / "whole", south, clouds=CloudOptions(cloud=("a.laz",)))


@pytest.mark.full
def test_datasets_name_the_map_and_the_options_of_its_scene(town, south, tmp_path):
    found = opened(town, south, tmp_path / "cache", lod=1)
    drive(found.scene, tmp_path / "d", options=south)
    document = open_dataset(tmp_path / "d").manifest
    named = document["recipe"]["map"]
    assert named["digest"] == read_osm(town / "town.osm").digest
    assert named["sources"] == [{"kind": "osm", "from": "town.osm"}]
    assert named["options"]["lod"] == 1
    assert "OpenStreetMap" in document["attribution"]


def program(town, out, cache, *words):
    return command(
        "lidar", "drive", town / "town.osm", "--rig", town / "rig.toml", "--duration", "0.5",
        "--scene-cache", cache, "-o", out, *words,
    )  # fmt: skip


@pytest.mark.full
def test_programs_share_the_cache_without_harm(town, south, tmp_path):
    cache = tmp_path / "cache"
    routes = [[at(20), at(180)], [at(2020), at(2180)], [at(20), at(180)]]
    words = [["--route", *(f"{lat},{lon}" for lat, lon in route)] for route in routes]
    running = [
        subprocess.Popen(program(town, tmp_path / f"d{k}", cache, *w), env=ENVIRONMENT)
        for k, w in enumerate(words)
    ]
    assert [process.wait(timeout=300) for process in running] == [0, 0, 0]
    (folder,) = (p for p in cache.iterdir() if p.is_dir())
    assert changed_files(open_scene(folder / "scene")) == []
    for k, route in enumerate(routes):
        drive(
            open_scene(town / "whole"),
            tmp_path / f"w{k}",
            options=replace(south, route=route, formats=("pcd", "laz")),
        )
        same_drives(tmp_path / f"w{k}", tmp_path / f"d{k}")


@pytest.mark.full
def test_the_program_says_what_it_built(town, tmp_path):
    route = [f"{lat},{lon}" for lat, lon in (at(20), at(180))]
    first, second = (
        subprocess.run(
            program(town, tmp_path / name, tmp_path / "cache", "--route", *route),
            env=ENVIRONMENT, check=True, capture_output=True, text=True,
        ).stdout.splitlines()
        for name in ("a", "b")
    )  # fmt: skip
    tiles = first[0].split()[-3]
    assert f": {tiles} of {tiles} tiles built" in first[0]
    assert second[0].endswith(f"{tiles} tiles, built before")


def test_errors_are_one_line_and_leave_nothing(town, south, tmp_path):
    cache = tmp_path / "cache"
    (tmp_path / "text.osm").write_text("no map")
    (tmp_path / "bare.osm").write_text(osm_of(2, roads=False))
    place = PlaceOptions(scene_cache=cache)
    with pytest.raises(SceneInputError, match=r"text\.osm: not an OpenStreetMap file"):
        open_scene_or_map(tmp_path / "text.osm", south, place=place)
    with pytest.raises(RouteError, match="no drivable roads"):
        open_scene_or_map(tmp_path / "bare.osm", replace(south, route="random"), place=place)
    with pytest.raises(RouteError):
        opened(town, replace(south, route=[at(20), at(90_000)]), cache)
    with pytest.raises(InputError, match="`scene_crs` EPSG:4326"):
        opened(town, south, cache, scene_crs="EPSG:4326")
    with pytest.raises(SceneInputError, match="`lod` 7"):
        opened(town, south, cache, lod=7)
    with pytest.raises((InputError, MissingExtraError), match=r"cuda:99|geoscene\[gpu\]"):
        opened(town, replace(south, device="cuda:99"), cache)
    with pytest.raises(InputError, match="`lod`: is for maps"):
        open_scene_or_map(town / "whole", south, place=PlaceOptions(lod=1))
    with pytest.raises(InputError, match="`place` NAME"):
        open_scene_or_map(None, south, place=place)
    with pytest.raises(InputError, match="no such scene or map"):
        open_scene_or_map(town / "nowhere.osm.pbf", south, place=place)
    assert list(cache.iterdir()) == []


def test_a_place_without_a_network_is_one_line(south, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{probe.getsockname()[1]}"
    with pytest.raises(NetworkError, match=r"Connection refused.*give a map file instead of `place`"):
        open_scene_or_map(
            None, south, place=PlaceOptions(place="Nowhere"), servers=Servers(nominatim=url, wait=0.0)
        )


def test_stretches_are_the_longest_runs_within_a_box():
    points = shapely.get_coordinates(
        shapely.segmentize(shapely.linestrings([[0, 0], [100, 0], [100, 30]]), 10)
    )
    runs = list(_stretches(points, 45.0))
    inside = [set(range(run.start, run.stop)) for run in runs]
    for k in range(len(points)):
        for stop in range(k + 1, len(points) + 1):
            part = points[k:stop]
            if (part.max(axis=0) - part.min(axis=0)).max() <= 45.0:
                assert any(set(range(k, stop)) <= run for run in inside)
    assert all((points[run].max(axis=0) - points[run].min(axis=0)).max() <= 45.0 for run in runs)
