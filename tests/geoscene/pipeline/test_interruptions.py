"""Builds that are interrupted, killed, repeated with other options or meet damaged or foreign files."""

import logging
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import pytest
from helpers.programs import ENVIRONMENT, alive, command, run_program
from helpers.rasters import write_slope
from helpers.scenes import same_files

import geoscene.pipeline.tiles
from geoscene.errors import SceneFormatError, WorkersLostError
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene import SceneFiles
from geoscene.sources import demo_path, read_osm
from geoscene.support.digests import sources_digest
from geoscene.support.processes import run_tasks

SMALL, BOX = (24.9430, 60.1669, 24.9455, 60.1684), (24.9425, 60.1665, 24.9465, 60.1690)
OPTIONS = BuildOptions(name="demo", tile_size=100.0)
IN_PROC = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")


@pytest.fixture(scope="module")
def osm():
    return read_osm(demo_path(), bounds=SMALL)


@pytest.fixture(scope="module")
def whole(osm, tmp_path_factory):
    return build(osm, tmp_path_factory.mktemp("whole") / "scene", options=OPTIONS)


@pytest.fixture(scope="module")
def raster(tmp_path_factory):
    return write_slope(tmp_path_factory.mktemp("dem") / "hill.tif", BOX)


@pytest.fixture(scope="module")
def route(tmp_path_factory):
    path = tmp_path_factory.mktemp("route") / "route.csv"
    path.write_text("lat,lon\n60.1671,24.9432\n60.1682,24.9440\n")
    return path


CHANGES = {
    "crs": "utm",
    "lod": 1,
    "roofs": "flat",
    "relief": "full",
    "dem": "a file",
    "dem_gaps": "nearest",
    "dem_tolerance": 1.0,
    "only": ("buildings", "roads"),
    "along": "a file",
    "reach": 30.0,
    "driving_side": "left",
    "use": "gis",
    "tile_size": 150.0,
    "name": "other",
}


@pytest.mark.gate
def test_every_option_has_a_change():
    assert set(CHANGES) == {f.name for f in fields(BuildOptions)}


@pytest.mark.parametrize("name", CHANGES)
def test_rebuild_with_another_option_has_the_bytes_of_a_fresh_build(
    name, osm, whole, raster, route, tmp_path, monkeypatch
):
    change = {name: CHANGES[name]} | {"dem": {"dem": (str(raster),)}}.get(name, {})
    if name in ("along", "reach"):
        change["along"] = (str(route),)
    if name == "dem_tolerance":
        change["dem"] = (str(raster),)
    options = replace(OPTIONS, **change)
    shutil.copytree(whole.path, tmp_path / "scene")
    made, ground_tile = [], geoscene.pipeline.tiles.ground_tile
    monkeypatch.setattr(
        geoscene.pipeline.tiles, "ground_tile", lambda *a, **o: made.append(a) or ground_tile(*a, **o)
    )
    again = build(osm, tmp_path / "scene", options=options, overwrite=True)
    kept = ("lod", "name", "along", "reach", "use", "roofs")  # no option on which the ground depends
    assert len(made) == (0 if name in kept else len(again.tile_indices))
    same_files(build(osm, tmp_path / "fresh", options=options).path, again.path)


def test_tiles_of_other_sources_are_built_again(osm, whole, tmp_path, monkeypatch):
    shutil.copytree(whole.path, tmp_path / "scene")
    made, ground_tile = [], geoscene.pipeline.tiles.ground_tile
    monkeypatch.setattr(
        geoscene.pipeline.tiles, "ground_tile", lambda *a, **o: made.append(a) or ground_tile(*a, **o)
    )
    build(osm, tmp_path / "scene", options=OPTIONS, overwrite=True)
    assert made == []
    monkeypatch.setattr("geoscene.pipeline.build.sources_digest", lambda _: "of edited modules")
    again = build(osm, tmp_path / "scene", options=OPTIONS, overwrite=True)
    assert len(made) == len(again.tile_indices)


@pytest.mark.gate
@pytest.mark.parametrize(
    ("change", "noticed"),
    [
        ({"walls.py": "HEIGHT = 4\n"}, True),
        ({"tables/sizes.toml": "door = 2.2\n"}, True),
        ({"walls.py": None, "wall.py": "HEIGHT = 3\n"}, True),
        ({"page.js": "x", "__pycache__/walls.pyc": "x"}, False),
    ],
)
def test_digest_of_sources_covers_code_and_tables(change, noticed, tmp_path, monkeypatch):
    monkeypatch.setattr("geoscene.support.digests.resources.files", tmp_path.joinpath)
    files = {"__init__.py": "", "walls.py": "HEIGHT = 3\n", "tables/sizes.toml": "door = 2.1\n"}
    for name, contents in {"before": files, "after": files | change}.items():
        for file, text in contents.items():
            if text is not None:
                path = tmp_path / name / file
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text)
    sources_digest.cache_clear()
    assert (sources_digest("before") != sources_digest("after")) == noticed


def test_elevation_file_with_other_heights_is_noticed(osm, raster, tmp_path):
    dem = tmp_path / "dem.tif"
    shutil.copy(raster, dem)
    options = replace(OPTIONS, dem=(str(dem),))
    build(osm, tmp_path / "scene", options=options)
    before = dem.stat()
    dem.write_bytes(dem.read_bytes()[:-4] + bytes(4))  # another height of the last post
    os.utime(dem, ns=(before.st_atime_ns, before.st_mtime_ns))
    again = build(osm, tmp_path / "scene", options=options, overwrite=True)
    same_files(build(osm, tmp_path / "fresh", options=options).path, again.path)


@pytest.mark.parametrize("lod", [1, 2])
def test_damaged_tile_is_built_again(lod, osm, whole, tmp_path):
    shutil.copytree(whole.path, tmp_path / "scene")
    path = next((tmp_path / "scene" / "tiles").iterdir())
    path.write_bytes(path.read_bytes()[:-200] + bytes(200))
    options = replace(OPTIONS, lod=lod)
    again = build(osm, tmp_path / "scene", options=options, overwrite=True)
    same_files(build(osm, tmp_path / "fresh", options=options).path, again.path)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", '{"keys": 1, "tiles": 2}', '{"keys": {}, "tiles": [1]}']
)
def test_damaged_table_of_tiles_is_ignored(text, osm, whole, tmp_path):
    shutil.copytree(whole.path, tmp_path / "scene")
    (tmp_path / "scene" / "tiles.json").write_text(text)
    same_files(whole.path, build(osm, tmp_path / "scene", options=OPTIONS, overwrite=True).path)


def ended_by(error, osm, path, monkeypatch):
    """A build that an error ends after three tiles."""
    made = []
    build_tile = geoscene.pipeline.tiles.build_tile

    def dying(*args, **options):
        if len(made) == 3:
            raise error
        made.append(args)
        return build_tile(*args, **options)

    monkeypatch.setattr(geoscene.pipeline.tiles, "build_tile", dying)
    with pytest.raises(type(error)):
        build(osm, path, options=OPTIONS)
    monkeypatch.setattr(geoscene.pipeline.tiles, "build_tile", build_tile)


@pytest.mark.gate
def test_resumed_build_replaces_damaged_tiles_and_skips_damaged_lines(osm, whole, tmp_path, monkeypatch):
    ended_by(KeyboardInterrupt(), osm, tmp_path / "scene", monkeypatch)
    files = SceneFiles(tmp_path / "scene.part")
    tiles = sorted(files.tiles.iterdir())
    tiles[0].write_bytes(tiles[1].read_bytes())
    with files.tile_journal.open("ab") as journal:
        journal.write(b'[]\n{"keys": {}}\n\xff\xfe\n{"i": 1')
    same_files(whole.path, build(osm, tmp_path / "scene", options=OPTIONS).path)


def build_words(out, *more):
    box = "--bbox=" + ",".join(map(str, BOX))
    words = command("geoscene", "build", "--demo", box, "-o", out, "--quiet", "--name", "demo")
    return [*words, "--tile-size", "50", "--workers", "2", *more]


def started(out, tiles, *more):
    """A build in a process group of its own that has finished some tiles."""
    process = subprocess.Popen(
        build_words(out, *more), env=ENVIRONMENT, start_new_session=True, stderr=subprocess.PIPE, text=True
    )
    folder = out.with_name(f"{out.name}.part") / "tiles"
    while process.poll() is None and len(list(folder.glob("*.npz"))) < tiles:
        time.sleep(0.01)
    assert process.poll() is None
    return process


@pytest.mark.parametrize("error", ["KeyboardInterrupt", "SystemError('in compiled code')"])
def test_interruption_ends_the_program_without_waiting_for_its_threads(error):
    program = (
        "import signal, threading, time, cyclopts, geoscene.support.console as console\n"
        "app = cyclopts.App(name='geoscene', suppress_keyboard_interrupt=False)\n"
        "@app.default\n"
        "def run():\n"
        "    threading.Thread(target=time.sleep, args=(60,)).start()\n"
        "    try:\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "    except KeyboardInterrupt:\n"
        f"        raise {error}\n"
        "console.main(app, (), usage=())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        timeout=50,
        check=False,
    )
    assert (done.returncode, done.stderr) == (130, "geoscene: interrupted\n")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interruption_that_is_lost_ends_the_program_soon(number, code):
    """As in callbacks of compiled code, whose exceptions are ignored."""
    program = (
        "import contextlib, time, cyclopts, geoscene.support.console as console\n"
        "app = cyclopts.App(name='geoscene', suppress_keyboard_interrupt=False)\n"
        "@app.default\n"
        "def run():\n"
        "    for _ in range(2):\n"
        "        with contextlib.suppress(KeyboardInterrupt):\n"
        "            print('ready', flush=True)\n"
        "            time.sleep(60)\n"
        "console.main(app, (), usage=())\n"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", program], env=ENVIRONMENT, stdout=pipe, stderr=pipe, text=True
    ) as process:
        process.stdout.readline()
        process.send_signal(number)
        process.stdout.readline()
        process.send_signal(number)  # as `timeout` does
        _, errors = process.communicate(timeout=50)
    assert (process.returncode, errors) == (code, "geoscene: interrupted\n")


@IN_PROC
@pytest.mark.parametrize("send", [os.kill, os.killpg])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_interruption_stops_all_processes_at_once_and_keeps_the_journal(send, number, code, tmp_path):
    process = started(tmp_path / "scene", 3)
    send(process.pid, number)
    _, errors = process.communicate(timeout=50)
    assert (process.returncode, errors) == (code, "geoscene: interrupted; repeat the command to resume\n")
    assert alive(process.pid) == []
    assert [path.name for path in tmp_path.iterdir()] == ["scene.part"]
    assert 1 <= len((tmp_path / "scene.part" / "tiles.jsonl").read_text().splitlines()) < 20


@IN_PROC
def test_build_goes_on_without_a_killed_worker(tmp_path):
    process = started(tmp_path / "scene", 3)
    os.kill(max(set(alive(process.pid)) - {process.pid}), signal.SIGKILL)
    _, errors = process.communicate(timeout=100)
    assert process.returncode == 0
    assert errors.count("\n") == 1
    assert "killed by signal 9; the system may be out of memory" in errors
    subprocess.run(build_words(tmp_path / "again"), env=ENVIRONMENT, check=True, stdout=subprocess.DEVNULL)
    same_files(tmp_path / "again", tmp_path / "scene")


@IN_PROC
def test_finished_tiles_are_kept_when_all_workers_are_killed(tmp_path):
    process = started(tmp_path / "scene", 3)
    for worker in set(alive(process.pid)) - {process.pid}:
        os.kill(worker, signal.SIGKILL)
    _, errors = process.communicate(timeout=50)
    assert process.returncode == 1
    assert "--workers" in errors.splitlines()[-1]
    assert "Traceback" not in errors
    assert (tmp_path / "scene.part" / "tiles.jsonl").exists()


def test_partly_written_tiles_of_killed_workers_are_deleted(osm, whole, tmp_path, monkeypatch):
    build_tile = geoscene.pipeline.tiles.build_tile

    def leaving(plan, folder, **options):
        SceneFiles(folder).tile(*options["tile"]).with_suffix(".npz.123.part").write_bytes(b"half")
        return build_tile(plan, folder, **options)

    monkeypatch.setattr(geoscene.pipeline.tiles, "build_tile", leaving)
    same_files(whole.path, build(osm, tmp_path / "scene", options=OPTIONS).path)


@pytest.mark.gate
def test_error_of_a_task_reaches_the_caller():
    with pytest.raises(ZeroDivisionError) as raised:
        list(run_tasks(partial(divmod, 1), [1, 0, 2], workers=2))
    assert "work(task)" in raised.value.__notes__[0]


AFTER_THREADS = """
import io
import laspy
import numpy as np
from geoscene.support.processes import run_tasks, threads_of_libraries

def compressed(points):
    las = laspy.LasData(laspy.LasHeader(point_format=6))
    las.x = las.y = las.z = np.arange(float(points))
    las.write(file := io.BytesIO(), do_compress=True)
    return len(file.getvalue())

if __name__ == "__main__":
    np.ones((600, 600)) @ np.ones((600, 600))  # BLAS, whose threads end before a fork
    print(threads_of_libraries())
    expected = compressed(200_000)
    print(threads_of_libraries() > 0)
    print(list(run_tasks(compressed, [200_000] * 3, workers=2)) == [expected] * 3)
"""


@IN_PROC
def test_workers_started_while_a_library_has_threads_do_not_inherit_its_pool(tmp_path):
    (tmp_path / "main.py").write_text(AFTER_THREADS)
    done = subprocess.run(
        [sys.executable, tmp_path / "main.py"],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert (done.stdout.split(), done.stderr) == (["0", "True", "True"], "")


def test_task_that_kills_every_worker_ends_the_run():
    with pytest.raises(WorkersLostError, match="exit code 3"):
        list(run_tasks(os._exit, [3, 3], workers=2))


def test_second_build_into_the_same_directory_is_refused(tmp_path):
    process = started(tmp_path / "scene", 1)
    process.send_signal(signal.SIGSTOP)
    try:
        done = subprocess.run(
            build_words(tmp_path / "scene"), env=ENVIRONMENT, capture_output=True, text=True, check=False
        )
    finally:
        process.send_signal(signal.SIGCONT)
    process.communicate(timeout=100)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "another process is writing it" in done.stderr
    assert process.returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), MemoryError()])
def test_tiles_are_kept_when_space_or_memory_ends(error, osm, whole, tmp_path, monkeypatch):
    ended_by(error, osm, tmp_path / "scene", monkeypatch)
    assert len(list((tmp_path / "scene.part" / "tiles").iterdir())) == 3
    same_files(whole.path, build(osm, tmp_path / "scene", options=OPTIONS).path)


def test_files_of_others_are_kept_and_named(osm, whole, tmp_path, caplog):
    scene = tmp_path / "scene"
    shutil.copytree(whole.path, scene)
    (scene / "drive").mkdir()
    (scene / "drive" / "dataset.json").write_text("{}")
    (scene / "notes.txt").write_text("mine")
    (scene / "tiles" / "map.png").write_bytes(b"png")
    (scene / "tiles" / "99_99.npz").write_bytes(b"of another build")
    (scene / "features.gpkg-wal").write_bytes(b"of an open GeoPackage")
    with caplog.at_level(logging.WARNING):
        build(osm, scene, options=OPTIONS, overwrite=True)
    assert (scene / "drive" / "dataset.json").read_text() == "{}"
    assert (scene / "notes.txt").read_text() == "mine"
    assert (scene / "tiles" / "map.png").read_bytes() == b"png"
    assert sum("kept" in line for line in caplog.messages) == 3
    for name in ("drive", "notes.txt", "tiles/map.png"):
        assert f"{name}: kept" in caplog.text
        shutil.rmtree(scene / name) if name == "drive" else (scene / name).unlink()
    same_files(whole.path, scene)
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


@pytest.mark.gate
@pytest.mark.parametrize("renamed", [False, True])
def test_replacement_that_was_killed_is_completed(renamed, osm, whole, tmp_path):
    """Killed after the old scene was set aside, before or after the new one got its name."""
    old = tmp_path / "scene.old.part"
    shutil.copytree(whole.path, old)
    (old / "notes.txt").write_text("mine")
    if renamed:
        shutil.copytree(whole.path, tmp_path / "scene")
    build(osm, tmp_path / "scene", options=OPTIONS, overwrite=True)
    assert (tmp_path / "scene" / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_scene_without_its_manifest_can_be_replaced(osm, whole, tmp_path):
    shutil.copytree(whole.path, tmp_path / "scene")
    (tmp_path / "scene" / "scene.json").unlink()
    with pytest.raises(SceneFormatError, match="`overwrite`"):
        build(osm, tmp_path / "scene", options=OPTIONS)
    same_files(whole.path, build(osm, tmp_path / "scene", options=OPTIONS, overwrite=True).path)


def test_scene_behind_a_link_is_replaced(osm, whole, tmp_path):
    shutil.copytree(whole.path, tmp_path / "scene")
    (tmp_path / "link").symlink_to("scene")
    build(osm, tmp_path / "link", options=OPTIONS, overwrite=True)
    assert (tmp_path / "link").is_symlink()
    same_files(whole.path, tmp_path / "scene")


@pytest.mark.gate
@pytest.mark.parametrize("out", [".", "..", "/"])
def test_current_directory_is_refused_before_the_work(out, tmp_path):
    (tmp_path / "inner").mkdir()
    done = run_program("geoscene", "build", "--demo", "-o", out, cwd=tmp_path / "inner")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "cannot be replaced" in done.stderr


@pytest.mark.gate
def test_target_is_checked_before_the_map_is_read(whole):
    done = run_program("geoscene", "build", "--osm", "nowhere.osm", "-o", whole.path)
    assert "--overwrite" in done.stderr


def test_a_backup_beside_a_scene_is_not_touched(osm, whole, tmp_path):
    backup = tmp_path / "scene.old"
    shutil.copytree(whole.path, backup)
    build(osm, tmp_path / "scene", options=OPTIONS)
    build(osm, tmp_path / "scene", options=OPTIONS, overwrite=True)
    same_files(whole.path, backup)
