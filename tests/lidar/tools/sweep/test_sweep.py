"""Sweeps: grids of drives, their table, resuming, and drives that fail."""

import csv
import json
import os
import signal

import pytest
from helpers.programs import run_program
from helpers.rasters import write_slope
from helpers.scenes import same_files

import geoscene.support.processes
import lidar.simulation.drive
from geoscene.pipeline.build import build
from geoscene.scene import open_scene
from lidar.dataset.layout import open_dataset
from lidar.errors import InputError
from lidar.tools.sweep import sweep
from lidar.tools.sweep.grid import read_grid

NOWHERE = '["0,0", "0,0.001"]'


def written(path, scene, *, grid="seed = [1, 2]", drive="", table="[grid]"):
    """A file with a grid of short drives through a scene."""
    common = 'route = "random"' * ("route" not in grid + drive)
    path.write_text(
        f'[drive]\nrig = "vlp16"\nduration = 0.3\nformat = ["pcd"]\n{common}\n{drive}\n'
        f'{table}\nscene = ["{scene.path}"]\n{grid}\n',
        "utf-8",
    )
    return path


@pytest.fixture(scope="module")
def recorded(scene, tmp_path_factory):
    """A grid of four drives, recorded by one process."""
    folder = tmp_path_factory.mktemp("sweep")
    file = written(folder / "grid.toml", scene, grid='seed = [1, 2]\nset = [[], ["rays=3"]]')
    return file, sweep(file, folder / "out")


def test_every_combination_is_a_dataset_with_its_row_in_both_tables(recorded):
    _, summary = recorded
    rows = json.loads((summary.path / "sweep.json").read_text())["drives"]
    with (summary.path / "sweep.csv").open() as file:
        assert [row["name"] for row in csv.DictReader(file)] == [row["name"] for row in rows]
    assert [row["options"]["seed"] for row in rows] == ["1", "1", "2", "2"]
    assert [row["options"]["set"] for row in rows] == ["", "rays=3"] * 2
    for row in rows:
        recipe = open_dataset(summary.path / row["name"]).manifest["recipe"]
        assert (row["state"], row["frames"]) == ("done", 3)
        assert str(recipe["seed"]) == row["options"]["seed"]
        assert recipe["settings"] == ([["rays", "3"]] if row["options"]["set"] else [])
    assert len({row["digest"] for row in rows}) == 4


@pytest.mark.full
def test_bytes_do_not_depend_on_the_number_of_processes(recorded, tmp_path):
    file, summary = recorded
    sweep(file, tmp_path / "out", workers=2)
    same_files(summary.path, tmp_path / "out")


@pytest.mark.full
def test_repeated_sweep_keeps_finished_drives_and_mends_the_others(scene, tmp_path):
    file = written(tmp_path / "grid.toml", scene)
    first = sweep(file, tmp_path / "out")
    clouds = sorted((tmp_path / "out").glob("*/*/pcd/*.pcd"))
    bytes_before = [path.read_bytes() for path in clouds]
    times = [path.stat().st_mtime_ns for path in clouds]
    clouds[0].write_bytes(b"")
    again = sweep(written(file, scene, grid="seed = [1, 2, 3]"), tmp_path / "out")
    assert again.rows[:2] == first.rows
    assert [row.state for row in again.rows] == ["done"] * 3
    assert [path.read_bytes() for path in clouds] == bytes_before
    assert [path.stat().st_mtime_ns for path in clouds][1:] == times[1:]


@pytest.mark.full
def test_unchanged_drives_are_kept_without_planning_them(scene, tmp_path, monkeypatch):
    file, log = written(tmp_path / "grid.toml", scene), tmp_path / "planned"
    plan_drive = lidar.simulation.drive.plan_drive

    def noted(*given, **more):
        with log.open("a") as lines:
            lines.write("planned\n")
        return plan_drive(*given, **more)

    first = sweep(file, tmp_path / "out")
    trajectory = tmp_path / "out" / first.rows[0].name / "trajectory.csv"
    before = trajectory.read_bytes()
    monkeypatch.setattr(lidar.simulation.drive, "plan_drive", noted)
    monkeypatch.setattr(
        geoscene.support.processes, "threads_of_libraries", lambda: 0
    )  # forked workers have it too
    assert sweep(file, tmp_path / "out").rows == first.rows
    assert not log.exists()
    trajectory.write_bytes(before[:100])
    assert sweep(file, tmp_path / "out").rows == first.rows
    assert log.read_text().count("planned") == 1
    assert trajectory.read_bytes() == before
    other = written(file, scene, drive='fidelity = "survey"')
    assert [row.state for row in sweep(other, tmp_path / "out").rows] == ["failed"] * 2
    again = sweep(other, tmp_path / "out", overwrite=True)
    assert [row.state for row in again.rows] == ["done"] * 2
    assert again.rows[0].digest != first.rows[0].digest


def test_a_failed_drive_is_a_row_and_the_others_go_on(scene, tmp_path):
    file = written(tmp_path / "grid.toml", scene, grid=f'route = [{NOWHERE}, "random"]')
    done = run_program("lidar", "sweep", file, "-o", tmp_path / "out")
    failed, kept = json.loads((tmp_path / "out" / "sweep.json").read_text())["drives"]
    assert (failed["state"], kept["state"]) == ("failed", "done")
    assert failed["error"]
    assert done.returncode == 1
    assert f"{failed['name']}: {failed['error']}" in done.stderr
    assert "1 of 2 drives" in done.stdout


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grid": "seed = [1, -1]"}, "drive .*seed--1.*seed"),
        ({"grid": "colour = [1]"}, "colour"),
        ({"grid": 'rig = ["vlp16"]'}, "rig is in both"),
        ({"grid": "seed = 1"}, "seed in the grid: give a list"),
        ({"grid": "seed = []"}, "seed in the grid: give a list"),
        ({"grid": "seed = [1, 1]"}, "seed-1 is in it twice"),
        ({"grid": 'set = ["beams=3"]'}, "beams"),
        ({"grid": "workers = [1, 2]"}, "workers is an option of lidar sweep"),
        ({"grid": 'route = ["absent.gpx"]'}, "absent.gpx: no such file"),
        ({"grid": "seed = [1", "table": "[grid]"}, "damaged"),
        ({"grid": "seed = [1]", "table": "[grids]"}, "unknown grids"),
        ({"grid": 'vehicle = ["spaceship"]'}, "spaceship"),
        ({"grid": 'stage = ["dropped_packets:sensor=rear"]'}, "rear"),
    ],
)
def test_errors_of_the_grid_are_found_before_the_first_drive(scene, tmp_path, changes, message):
    file = written(tmp_path / "grid.toml", scene, **changes)
    with pytest.raises(InputError, match=message):
        sweep(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_scene_that_is_not_there_is_found_before_the_first_drive(scene, tmp_path):
    file = written(tmp_path / "grid.toml", scene)
    file.write_text(file.read_text().replace("scene = [", f'scene = ["{tmp_path}/absent", '))
    with pytest.raises(InputError, match="absent"):
        sweep(file, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_of_other_files_is_refused(scene, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    file = written(tmp_path / "grid.toml", scene)
    with pytest.raises(InputError, match="no sweep"):
        sweep(file, tmp_path)
    assert not (tmp_path / "sweep.json").exists()


@pytest.mark.full
def test_names_are_readable_stable_and_differ(scene, tmp_path):
    grid = 'route = ["random", ["60.1662,24.9413", "60.1655,24.9405"]]\ntraffic = [false, true]'
    names = [drive.name for drive in read_grid(written(tmp_path / "grid.toml", scene, grid=grid))]
    assert len(set(names)) == 4
    assert names[0].endswith("route-random_traffic-off")
    more = grid.replace('["random",', '["random", ["60.1655,24.9405", "60.1662,24.9413"],')
    assert set(names) < {d.name for d in read_grid(written(tmp_path / "grid.toml", scene, grid=more))}


def test_several_grids_make_one_job(scene, tmp_path):
    file = written(tmp_path / "grid.toml", scene, table="[[grid]]")
    text = f'[[grid]]\nscene = ["{scene.path}"]\nfidelity = ["survey"]\n'
    file.write_text(file.read_text() + text)
    drives = read_grid(file)
    assert [drive.options.seed for drive in drives] == [1, 2, 0]
    assert [drive.options.fidelity for drive in drives] == ["standard", "standard", "survey"]


def write_street(path):
    """A map of one street."""
    nodes = "".join(f'<node id="{k}" lat="60.16{k}" lon="24.94"/>' for k in range(1, 6))
    refs = "".join(f'<nd ref="{k}"/>' for k in range(1, 6))
    house = "".join(
        f'<node id="{k}" lat="{lat}" lon="{lon}"/>'
        for k, (lat, lon) in enumerate([(60.162, 24.9405), (60.162, 24.9408), (60.1622, 24.9408)], 21)
    )
    way = f'<way id="9">{refs}<tag k="highway" v="residential"/></way>'
    corners = "".join(f'<nd ref="{k}"/>' for k in (21, 22, 23, 21))
    way += f'<way id="8">{corners}<tag k="building" v="yes"/></way>'
    path.write_text(f'<osm version="0.6">{nodes}{house}{way}</osm>', "utf-8")


MAPS = """
[drive]
route = "random"
rig = "vlp16"
duration = 0.2
[[map]]
name = "whole"
osm = "{osm}"
[[map]]
name = "blocks"
osm = ["{osm}"]
lod = 0
only = ["buildings", "roads"]
[grid]
scene = ["whole", "blocks"]
seed = [1, 2]
"""


def test_maps_are_built_once_with_their_options_and_shared(tmp_path, monkeypatch):
    write_street(tmp_path / "street.osm")
    file = tmp_path / "grid.toml"
    file.write_text(MAPS.format(osm=tmp_path / "street.osm"))
    first = sweep(file, tmp_path / "out")
    assert [row.state for row in first.rows] == ["done"] * 4, first.rows
    assert [row.name for row in first.rows][::2] == ["whole_seed-1", "blocks_seed-1"]
    options = [open_scene(tmp_path / "out" / "scenes" / n).manifest["options"] for n in ("whole", "blocks")]
    assert [(o["lod"], o["name"]) for o in options] == [(2, "whole"), (0, "blocks")]
    assert options[1]["only"] == ["buildings", "roads"]
    built = []

    def build_again(*arguments, **options):
        built.append(arguments[1].name)
        return build(*arguments, **options)

    monkeypatch.setattr("lidar.tools.sweep.grid.build", build_again)
    assert sweep(file, tmp_path / "out").rows == first.rows
    assert not built
    scene = open_scene(tmp_path / "out" / "scenes" / "whole")
    tile = scene.files.tile(*scene.tile_indices[0])
    before = tile.read_bytes()
    tile.write_bytes(b"damaged")
    file.write_text(file.read_text().replace("lod = 0", "lod = 1"))
    again = sweep(file, tmp_path / "out", overwrite=True)
    assert built == ["whole", "blocks"]
    assert tile.read_bytes() == before
    assert again.rows[:2] == first.rows[:2]


@pytest.mark.full
def test_a_map_that_cannot_be_built_fails_its_drives_and_the_others_go_on(tmp_path):
    write_street(tmp_path / "street.osm")
    far = write_slope(tmp_path / "far.tif", (10.0, 50.0, 10.01, 50.01))
    file = tmp_path / "grid.toml"
    file.write_text(MAPS.format(osm=tmp_path / "street.osm").replace("lod = 0", f'dem = ["{far}"]'))
    done = run_program("lidar", "sweep", file, "-o", tmp_path / "out")
    rows = json.loads((tmp_path / "out" / "sweep.json").read_text())["drives"]
    assert [row["state"] for row in rows] == ["done", "done", "failed", "failed"]
    assert {row["error"].partition(": ")[0] for row in rows[2:]} == {"map blocks"}
    assert "far.tif" in rows[2]["error"]
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == f"lidar: blocks_seed-1 and 1 more: {rows[2]['error']}"
    assert "Traceback" not in done.stderr
    assert "2 of 4 drives" in done.stdout


def test_public_elevation_tiles_of_a_map_are_fetched_once(tmp_path, monkeypatch):
    write_street(tmp_path / "street.osm")
    file = tmp_path / "grid.toml"
    file.write_text(MAPS.format(osm=tmp_path / "street.osm").replace("lod = 0", 'dem = ["tiles"]'))
    fetched = []

    def fetch(osm, *, crs, **_):
        fetched.append(crs)
        return write_slope(tmp_path / "slope.tif", osm.bounds, rise=20.0)

    monkeypatch.setattr("geoscene.sources.elevation.fetch_elevation", fetch)
    maps = {drive.map.name: drive.map for drive in read_grid(file)}
    scenes = [open_scene(maps[name].built(tmp_path / "scenes")) for name in ("whole", "blocks", "blocks")]
    assert fetched == ["local"]
    assert [scene.manifest["terrain"]["vertical"] for scene in scenes[:2]] == ["flat", "orthometric"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("lod = 0", "lod = 7"), "map blocks: .*lod"),
        (("lod = 0", "colour = 7"), "map blocks: .*colour"),
        (("lod = 0", 'dem = ["absent.tif"]'), r"map blocks: absent\.tif: no such file"),
        (("lod = 0", 'dem = ["tiles", "a.tif"]'), "map blocks: tiles: no such file"),
        (("lod = 0", 'along = ["absent.gpx"]'), r"map blocks: absent\.gpx: no such file"),
        (("lod = 0", "bbox = [1, 2]"), "map blocks: bbox: give"),
        (('name = "blocks"', 'name = "whole"'), "two maps are named whole"),
        (('name = "blocks"', 'name = "../x"'), "map 2: give it a name"),
        (('osm = ["', 'osms = ["'), r"map blocks: give it a map: .* \(there is osms\)"),
        (("street.osm", "absent.osm"), "map whole: .*absent.osm: no such file"),
    ],
)
def test_errors_of_maps_are_found_before_the_first_build(tmp_path, changes, message):
    write_street(tmp_path / "street.osm")
    (tmp_path / "grid.toml").write_text(MAPS.format(osm=tmp_path / "street.osm").replace(*changes))
    with pytest.raises(InputError, match=message):
        sweep(tmp_path / "grid.toml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.full
def test_a_map_is_built_into_a_scene_that_is_kept(tmp_path):
    write_street(tmp_path / "street.osm")
    text = '[drive]\nroute = "random"\nrig = "vlp16"\nduration = 0.2\n[grid]\nscene = ["{}"]\nseed = [1]\n'
    (tmp_path / "grid.toml").write_text(text.format(tmp_path / "street.osm"), "utf-8")
    first = sweep(tmp_path / "grid.toml", tmp_path / "out")
    assert [row.state for row in first.rows] == ["done"], first.rows
    scene = open_scene(tmp_path / "out" / "scenes" / "street")
    tile = scene.files.tile(*scene.tile_indices[0])
    before = tile.read_bytes()
    assert sweep(tmp_path / "grid.toml", tmp_path / "out").rows == first.rows
    assert tile.read_bytes() == before


@pytest.mark.full
def test_a_drive_that_kills_its_process_is_a_row_and_the_others_go_on(scene, tmp_path, monkeypatch):
    recorded = lidar.simulation.drive.drive

    def deadly(scene, out, *, options, **more):
        if options.seed == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return recorded(scene, out, options=options, **more)

    monkeypatch.setattr(lidar.simulation.drive, "drive", deadly)
    monkeypatch.setattr(
        geoscene.support.processes, "threads_of_libraries", lambda: 0
    )  # forked workers have both
    rows = sweep(written(tmp_path / "grid.toml", scene), tmp_path / "out").rows
    assert [row.state for row in rows] == ["failed", "done"]
    assert "killed by signal 9" in rows[0].error
