"""Drives through scenes built for a use: the same bytes as through whole scenes, or one line that refuses."""

from dataclasses import replace

import pytest
from helpers.programs import run_program

from geoscene.errors import SceneFormatError
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.scene.validate import check_scene
from geoscene.sources import demo_path, read_osm
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.traffic.options import TrafficOptions

BOX = (24.9405, 60.1655, 24.9440, 60.1675)
BUSY = TrafficOptions(vehicles=25.0, cyclists=4.0, pedestrians=40.0, parked=0.7, radius=150.0)
OPTIONS = DriveOptions(rig="vlp16", duration=0.3, seed=3, formats=("pcd",), traffic=BUSY)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Scenes of some blocks of the demo map by their use."""
    folder, osm = tmp_path_factory.mktemp("uses"), read_osm(demo_path(), bounds=BOX)
    return {
        use: build(osm, folder / use, options=BuildOptions(name="demo", use=use))
        for use in ("all", "lidar", "camera")
    }


def recorded(folder):
    """Bytes of the files of a dataset but those that name the scene."""
    names = {"dataset.json", "checksums.sha256", "run.json"}
    files = (p for p in folder.rglob("*") if p.is_file() and p.name not in names)
    return {p.relative_to(folder): p.read_bytes() for p in files}


@pytest.mark.parametrize(
    ("use", "rig"), [("lidar", "vlp16"), pytest.param("camera", "seed", marks=pytest.mark.full)]
)
def test_drive_through_a_scene_for_its_sensors_has_the_bytes_of_the_whole_one(use, rig, scenes, tmp_path):
    options = replace(OPTIONS, rig=rig)
    for name in ("all", use):
        drive(scenes[name], tmp_path / name, options=options)
    whole = recorded(tmp_path / "all")
    assert len(whole) > 4
    assert recorded(tmp_path / use) == whole


def test_scenes_for_sensors_leave_out_what_they_report(scenes):
    whole, bytes_of = scenes["all"], {}
    for use, scene in scenes.items():
        bytes_of[use] = sum(p.stat().st_size for p in scene.path.rglob("*") if p.is_file())
        left_out = scene.manifest["left_out"]
        assert left_out["tiles"] == 0
        rows = [sum(s.table_length(name) for name in s.layers) for s in (whole, scene)]
        assert left_out.get("features", 0) == rows[0] - rows[1]
        assert scene.manifest["counts"]["watertight"] == whole.manifest["counts"]["watertight"]
    assert bytes_of["lidar"] < bytes_of["camera"] < 0.85 * bytes_of["all"]
    for name in ("lidar", "camera"):
        assert check_scene(scenes[name]) == check_scene(whole)
    assert len({tuple(c) for tile in scenes["lidar"].tiles() for c in tile.mesh.color.tolist()}) == 1


def test_cameras_need_colours(scenes, tmp_path):
    with pytest.raises(SceneFormatError, match=r"built for lidar.*without --for"):
        drive(scenes["lidar"], tmp_path / "out", options=replace(OPTIONS, rig="seed"))
    done = run_program(
        "lidar", "drive", scenes["lidar"].path, "--route", "random", "--rig", "seed", "-o", tmp_path / "out"
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "out").exists()
