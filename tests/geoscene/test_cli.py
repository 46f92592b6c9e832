"""Both command-line programs: output files, summaries, help, and one-line errors."""

import json
import os
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from helpers.clouds import write_las
from helpers.programs import ENVIRONMENT, SMALL_FILES, command, run_process, run_program

from geoscene.cli import program
from geoscene.sources import demo_path

BOX = "24.9405,60.1655,24.9475,60.1690"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    out = tmp_path_factory.mktemp("cli") / "scene"
    done = run_program("geoscene", "build", "--osm", demo_path(), "--bbox", BOX, "-o", out, "--json")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert json.loads(done.stdout)["counts"]["buildings"] > 20
    return out


def test_info_prints_json_or_text(scene):
    report = json.loads(run_program("geoscene", "info", scene, "--json").stdout)
    counts = report["counts"]
    assert counts["buildings"] == counts["solids"] + counts["dropped"]
    assert report["frame"]["name"].startswith("Local transverse Mercator")
    assert sum(report["heights"].values()) == counts["solids"]
    assert report["extent"]["width_m"] > 300
    text = run_program("geoscene", "info", scene).stdout
    for word in ("frame", "extent", "buildings", "heights", "OpenStreetMap"):
        assert word in text


def test_valid_scene_passes_validate(scene):
    done = run_program("geoscene", "validate", scene, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["broken"] == []


@pytest.mark.full
def test_drive_resumes_and_its_map_is_written(scene, tmp_path):
    words = ["--route=random", "--duration=2", "--rig=vlp16", "--format=pcd,laz", "--seed=5", "--json"]
    done = run_program("lidar", "drive", scene, *words, "-o", tmp_path / "drive")
    assert done.returncode == 0, done.stderr
    first = json.loads(done.stdout)
    assert first["frames"] == 20
    again = json.loads(run_program("lidar", "drive", scene, *words, "-o", tmp_path / "drive").stdout)
    assert again["resumed"] == 20
    assert again["points"] == first["points"] == first["written"] > 10_000
    assert again["written"] == 0
    done = run_program("lidar", "map", tmp_path / "drive", "-o", tmp_path / "m.laz", "--voxel", "0.2")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "m.laz").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("geoscene", ["build", "-o", "x"], "none was given"),
        ("geoscene", ["build", "--demo", "--place", "Rome", "-o", "x"], "--place and --demo"),
        ("geoscene", ["build", "--osm", "nowhere.osm", "-o", "x"], "nowhere.osm"),
        ("geoscene", ["build", "--point", "-91.5,-76.3", "-o", "x"], "-91.5,-76.3"),
        ("geoscene", ["build", "--bbox", "1,2,3", "-o", "x"], "W,S,E,N"),
        ("geoscene", ["build", "--demo", "--crs", "EPSG:4326", "-o", "x"], "EPSG:4326"),
        ("geoscene", ["build", "--demo", "--lod", "9", "-o", "x"], "--lod 9"),
        ("geoscene", ["build", "--demo", "--lod", "1.4", "-o", "x"], "--lod"),
        ("geoscene", ["build", "--demo", "--wrokers", "2", "-o", "x"], "--wrokers"),
        ("geoscene", ["bild"], "bild"),
        ("geoscene", ["build", "--demo", "--dem", "nowhere.tif", "-o", "x"], "nowhere.tif"),
        ("geoscene", ["build", "--demo", "--dem-server", "http://x/", "-o", "x"], "--dem tiles"),
        ("geoscene", ["build", "--demo", "--reach", "nan", "-o", "x"], "--reach nan"),
        (
            "geoscene",
            ["build", "--point", "1,2", "--radius", "nan", "-o", "x"],
            "--radius nan: give a number",
        ),
        ("geoscene", ["build", "--demo", "--along", "nan,nan", "nan,nan", "-o", "x"], "--along nan,nan"),
        ("geoscene", ["info", "nowhere"], "nowhere"),
        ("geoscene", ["validate", "nowhere"], "nowhere"),
        (
            "lidar",
            ["drive", "nowhere", "--route", "random", "--format", "doc", "-o", "x"],
            "format 'doc' is unknown",
        ),
        (
            "lidar",
            ["drive", "nowhere", "--route", "random", "--set", "ray=7", "-o", "x"],
            "--set 'ray' is unknown",
        ),
        ("lidar", ["drive", "nowhere", "--route", "random", "-o", "x"], "nowhere"),
        ("lidar", ["drive", "nowhere", "--seed", "1.5", "-o", "x"], "--seed"),
        ("lidar", ["map", "nowhere", "-o", "x.laz"], "nowhere"),
    ],
)
def test_invalid_input_gives_one_line_and_exit_code_two(tmp_path, name, words, message):
    done = run_program(name, *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--route", "-30.1,-51.2", "-30.2,-51.3"], "-30.1"),
        (["--route", "60.166,24.944"], "two or more"),
        (["--route", "tour.gpx"], "tour.gpx"),
        (["--route", "random", "--rig", "none"], "none"),
        (["--route", "random", "--format", "doc"], "doc"),
        (["--route", "random", "--start", "noon"], "noon"),
        (["--route", "random", "--start", "2016-12-31T23:59:60"], "leap second"),
        (["--route", "random", "--start", "2999-01-01"], "end of 2261"),
        (["--route", "random", "--crs", "EPSG:1"], "EPSG:1"),
    ],
)
def test_invalid_drive_options_give_one_line_and_exit_code_two(scene, tmp_path, words, message):
    done = run_program("lidar", "drive", scene, *words, "-o", "x", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1, done.stderr
    assert message in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "commands"), [("geoscene", ["build", "info", "validate"]), ("lidar", ["drive", "map"])]
)
def test_help_describes_every_command(name, commands):
    assert run_program(name, "--version").stdout.strip() == "0.1.0"
    top = run_program(name, "--help").stdout
    assert "--install-completion" in top
    for word in commands:
        assert word in top
        text = run_program(name, word, "--help").stdout
        assert len(text.splitlines()) > 8


def test_help_lists_sources_of_the_map_first_and_servers_last_among_them():
    text = run_program("geoscene", "build", "--help").stdout
    listed = re.findall(r"^│ [* ] *(--[a-z-]+)|^│ (--[a-z-]+)", text, re.MULTILINE)
    flags = [first or second for first, second in listed]
    order = [flags.index(flag) for flag in ("--osm", "--demo", "--dem-server", "--crs", "--dem", "--out")]
    assert order == sorted(order)
    assert order[0] == 0


def closed_pipe():
    reader, writer = os.pipe()
    os.close(reader)
    return writer


@pytest.mark.parametrize(("name", "words"), [("geoscene", ["info", "--json"]), ("lidar", ["sensors"])])
def test_closed_pipe_ends_the_program_without_a_message(scene, name, words):
    words = [words[0], *([scene] if name == "geoscene" else []), *words[1:]]
    writer = closed_pipe()
    done = subprocess.run(
        command(name, *words), env=ENVIRONMENT, stdout=writer, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.full
def test_suggested_commands_quote_paths_and_new_folders_are_named(tmp_path):
    out = tmp_path / "my scenes" / "it's one"
    done = run_program("geoscene", "build", "--demo", "--bbox", BOX, "-o", out)
    assert done.returncode == 0
    assert done.stderr == f"{out.parent}: this folder does not exist and is made\n"
    words = shlex.split(done.stdout.splitlines()[-1].partition("next: ")[2])
    assert words == ["lidar", "drive", str(out), "--route", "random", "-o", "drive"]


FORMATS = ["tif", "gpkg", "glb", "city.json", "geojson", "parquet", "obj", "ply", "stl"]


@pytest.mark.full
@pytest.mark.parametrize("suffix", [*FORMATS, "html"])
def test_full_disk_gives_one_line_that_names_the_file(scene, tmp_path, suffix):
    """Files of at most 30 kB stand for a full disk; both fail when bytes are written."""
    out = tmp_path / f"x.{suffix}"
    limit = "import resource, runpy, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000));"
    run = "sys.argv = sys.argv[1:]; runpy.run_module('geoscene', run_name='__main__')"
    words = ["view" if suffix == "html" else "export", str(scene), "-o", str(out)]
    done = subprocess.run(
        [sys.executable, "-c", limit + run, "geoscene", *words],
        env=SMALL_FILES, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    written = out.with_suffix(".mtl") if suffix == "obj" else out  # materials come first
    assert done.stderr.startswith(f"geoscene: {written}: ")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("program", "also"), [("geoscene", {"numpy"}), ("lidar", set())])
def test_help_does_not_import_large_libraries(program, also):
    heavy = {"osmnx", "geopandas", "rasterio", "trimesh", "numba", "scipy", "shapely"} | also
    code = f"import sys, {program}.cli; print(sorted({heavy!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_steep_roads_are_told_only_of_terrain_that_has_some():
    none, some = {"road_km": 0.0, "road_km_steep": 0.0}, {"road_km": 2.0, "road_km_steep": 0.1}
    assert program._steep_roads(none, terrain=True) == ""
    assert program._steep_roads(some, terrain=False) == ""
    assert "0.1 km steeper" in program._steep_roads(some, terrain=True)


@pytest.mark.full
def test_a_cloud_that_is_cut_off_is_refused_in_one_line(tmp_path):
    rng = np.random.default_rng(0)
    xyz = np.column_stack([rng.uniform((24.940, 60.165), (24.948, 60.170), (60_000, 2)), rng.random(60_000)])
    path = write_las(tmp_path / "cut.laz", xyz, crs="EPSG:4326")
    path.write_bytes(path.read_bytes()[:100_000])
    words = [
        "build",
        "--osm",
        demo_path(),
        "--bbox",
        BOX,
        "--cloud",
        path,
        "-o",
        tmp_path / "scene",
        "--quiet",
    ]
    done = run_process("geoscene", *words, "--cache", tmp_path)
    assert done.returncode == 1
    assert re.fullmatch(r"geoscene: .*cut\.laz: damaged .*\n", done.stderr)
    assert not (tmp_path / "scene").exists()
