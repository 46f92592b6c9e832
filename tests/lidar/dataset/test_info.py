"""Descriptions of recorded data: figures against the files, gaps and missing frames, and damaged metadata."""

import csv
import json
import shutil
from collections import Counter

import numpy as np
import pytest
from helpers.programs import run_program

from geoscene.classes import Class
from geoscene.support.files import write_json
from lidar.dataset.formats import read_cloud
from lidar.dataset.layout import open_dataset
from lidar.dataset.layouts import EXPORTERS
from lidar.errors import DatasetError
from lidar.options.drive import DriveOptions
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.info import describe
from lidar.traffic.options import TrafficOptions

STAGES = read_stages(["dropped_packets:loss=0.1", "weather:kind=fog"]).stages


@pytest.fixture(scope="module")
def driven(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("driven") / "drive"
    options = DriveOptions(
        rig="vlp16",
        duration=0.5,
        seed=3,
        formats=("pcd", "laz"),
        workers=1,
        traffic=TrafficOptions(vehicles=30, parked=0.5),
        stages=STAGES,
    )
    drive(scene, out, options=options)
    return out


@pytest.fixture
def copy(driven, tmp_path):
    return shutil.copytree(driven, tmp_path / "copy")


def test_a_camera_that_looks_ahead_has_no_rotation_on_the_vehicle(scene, tmp_path):
    drive(scene, tmp_path / "d", options=DriveOptions(rig="seed", duration=0.1, workers=1))
    mounts = {name: row["mount"] for name, row in describe(tmp_path / "d")["sensors"].items()}
    assert (
        mounts["camera_front"]
        == mounts["lidar_front"]
        == {
            "xyz_m": [3.6, 0.0, 0.5],
            "roll_pitch_yaw_deg": [0, 0, 0],
        }
    )


def test_the_figures_are_those_of_the_files(driven, scene):
    found = describe(driven)
    clouds = [read_cloud(path) for path in sorted(driven.glob("lidar_top/pcd/*.pcd"))]
    top = found["sensors"]["lidar_top"]
    assert top["points"] == found["points"] == sum(map(len, clouds))
    sizes = [len(cloud) for cloud in clouds]
    assert top["points_per_frame"] == {
        "fewest": min(sizes),
        "median": float(np.median(sizes)),
        "most": max(sizes),
    }
    assert (top["frames"], top["missing"]["count"], top["gaps"]["count"]) == (5, 0, 0)
    assert top["measured_hz"] == top["rate_hz"] == 10
    assert top["mount"]["roll_pitch_yaw_deg"] == [0, 0, 0]
    with (driven / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert found["extent"]["west"] == pytest.approx(min(float(row["lon"]) for row in rows))
    assert found["extent"]["north"] == pytest.approx(max(float(row["lat"]) for row in rows))
    files = [path for path in driven.rglob("*") if path.is_file()]
    assert found["size"]["files"] == len(files)
    assert found["size"]["bytes"] == sum(path.stat().st_size for path in files)
    assert found["size"]["kinds"]["laz"]["files"] == 5
    assert [(stage["group"], stage["name"]) for stage in found["stages"]] == [
        ("stage", "dropped_packets"),
        ("weather", "weather"),
    ]
    assert found["scene"]["digest"] == scene.manifest["digest"]
    assert found["checksums"]["files"] == len(files) - 1
    assert "classes" not in found


def test_all_clouds_are_read_for_the_points_by_class(driven):
    found = describe(driven, full=True)
    counts = Counter()
    for path in driven.glob("lidar_top/pcd/*.pcd"):
        counts.update(Class(code).name.lower() for code in read_cloud(path).klass.tolist())
    assert found["classes"] == {"lidar_top": dict(counts)}
    with (driven / "boxes.csv").open() as file:
        users = {(row["class"], row["id"]) for row in csv.DictReader(file)}
    assert found["road_users"] == Counter(klass for klass, _ in users)


def test_missing_frames_and_gaps_are_listed(copy):
    (copy / "lidar_top/laz/000003.laz").unlink()
    table = copy / "lidar_top/timestamps.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:3], *lines[4:]]) + "\n")
    top = describe(copy)["sensors"]["lidar_top"]
    assert top["missing"] == {"count": 1, "first": [3]}
    assert top["gaps"] == {"count": 1, "longest_s": 0.2, "first": [[0.1, 0.3]]}
    text = run_program("lidar", "info", copy).stdout
    assert "lidar_top: frames without all their files: 3" in text
    assert "lidar_top: gaps, the longest of 0.2 s: 0.1 to 0.3 s" in text


def test_an_extent_over_the_antimeridian_is_narrow(copy):
    table = copy / "poses.csv"
    with table.open() as file:
        rows = list(csv.DictReader(file))
    for row, lon in zip(rows, (179.9998, 179.9999, -180.0, -179.9999, -179.9998), strict=True):
        row["lon"] = lon
    with table.open("w") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    extent = describe(copy)["extent"]
    assert (extent["west"], extent["east"]) == (pytest.approx(179.9998), pytest.approx(-179.9998))


def test_an_unfinished_drive_is_called_so(copy):
    manifest = open_dataset(copy).manifest
    del manifest["points"]
    write_json(copy / "dataset.json", manifest | {"frames_done": 0})
    for path in copy.glob("lidar_top/*/000004*"):
        path.unlink()
    found = describe(copy)
    assert not found["finished"]
    assert found["sensors"]["lidar_top"]["missing"] == {"count": 1, "first": [4]}
    assert "not finished" in run_program("lidar", "info", copy).stdout


def test_folders_of_kitti_and_nuscenes_are_described(driven, tmp_path):
    for name in ("kitti", "nuscenes"):
        EXPORTERS[name].export(open_dataset(driven), tmp_path / name)
        found = describe(tmp_path / name)
        assert found["points"] == describe(driven)["points"]
        assert found["provenance"]["licence"] == "ODbL-1.0"
        assert "OpenStreetMap" in run_program("lidar", "info", tmp_path / name).stdout
    (tmp_path / "kitti/sequences/00/velodyne/000001.bin").write_bytes(b"123")
    assert "000001.bin" in run_program("lidar", "info", tmp_path / "kitti").stdout


def test_text_and_json_say_the_same(driven):
    text = run_program("lidar", "info", driven, "--full").stdout
    document = json.loads(run_program("lidar", "info", driven, "--full", "--json").stdout)
    assert document == json.loads(json.dumps(describe(driven, full=True)))
    for words in (
        f"{document['points']:,}",
        document["attribution"],
        document["scene"]["digest"],
        "dropped_packets: ",
        "Velodyne VLP-16",
        *document["classes"]["lidar_top"],
    ):
        assert words in text


@pytest.mark.parametrize(
    "words",
    [
        ("info",),
        ("apply", "--stage", "dropped_packets", "-o", "x"),
        ("denoise", "--method", "dror", "-o", "x"),
        ("detect", "--to", "kitti", "-o", "x"),
    ],
)
def test_other_folders_are_named_with_the_command_for_them(scene, tmp_path, words):
    command, *options = words
    (tmp_path / "drives").mkdir()
    (tmp_path / "drives/sweep.json").write_text("{}")
    for folder, message in (
        (scene.path, "is a scene; geoscene info describes it"),
        (tmp_path / "drives", "holds the drives of a sweep"),
        (tmp_path / "none", "is not there"),
        (scene.path / "scene.json", "is a file"),
        (tmp_path, "no dataset.json"),
    ):
        done = run_program("lidar", command, folder, *options, cwd=tmp_path)
        assert (done.returncode, done.stdout) == (2, "")
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(k, v) for k in ("duration_ns", "length_m", "seed", "scene") for v in ("x", None, 1e999, [])],
        *[("recipe", {"stages": v}) for v in ([{"nam": 1}], 5, [[]])],
        ("recipe", {"traffic": "x"}),
        ("recipe", {"settings": [["relief"]]}),
        ("sources", 5),
        ("sources", ["x"]),
        ("derived_from", [3]),
        ("versions", [1]),
        ("limits", 7),
    ],
)
def test_damaged_metadata_are_one_clear_line(copy, name, value):
    if (name, value) in (("duration_ns", 1e999), ("length_m", 1e999)):
        pytest.skip("an infinite length is a number")
    document = open_dataset(copy).manifest
    write_json(copy / "dataset.json", document | {name: value})
    done = run_program("lidar", "info", copy)
    assert (done.returncode, done.stdout) == (2, "")
    assert "dataset.json: damaged" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("rate", [0, -1, "x", None, 1e999])
def test_a_sensor_without_a_rate_is_refused(copy, rate):
    document = json.loads((copy / "calibration.json").read_text())
    document["sensors"]["lidar_top"]["rate_hz"] = rate
    write_json(copy / "calibration.json", document)
    with pytest.raises(DatasetError, match=r"calibration\.json: damaged"):
        describe(copy)


@pytest.mark.parametrize("column", ["lat", "x", "qw"])
def test_a_pose_that_is_no_number_is_told_with_its_line(copy, column):
    path = copy / "poses.csv"
    names, *lines = path.read_text().splitlines()
    values = dict(zip(names.split(","), lines[2].split(","), strict=True)) | {column: "nan"}
    lines[2] = ",".join(values.values())
    path.write_text("\n".join([names, *lines]) + "\n")
    done = run_program("lidar", "info", copy)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"poses.csv: damaged (line 4: {column} is nan, not a finite number)" in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_box_that_has_lost_its_class_is_damage(copy):
    path = copy / "boxes.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], ",".join(lines[2].split(",")[:2])]) + "\n")
    with pytest.raises(DatasetError, match=r"boxes\.csv: damaged"):
        describe(copy, full=True)


@pytest.mark.parametrize("rows", [0, 1])
@pytest.mark.parametrize("name", ["poses.csv", "lidar_top/timestamps.csv"])
def test_tables_that_have_lost_their_rows_are_damaged(copy, name, rows):
    lines = (copy / name).read_text().splitlines(keepends=True)
    (copy / name).write_text("".join(lines[:rows]))
    done = run_program("lidar", "info", copy)
    assert (done.returncode, done.stdout) == (2, "")
    assert name in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("name", ["../outside", "/outside", "a/b", "..", "", "a\nb"])
def test_names_of_sensors_do_not_lead_out_of_a_dataset(copy, name, tmp_path):
    document = json.loads((copy / "calibration.json").read_text())
    document["sensors"] = {name: document["sensors"]["lidar_top"]}
    write_json(copy / "calibration.json", document)
    with pytest.raises(DatasetError, match=r"calibration\.json: damaged.*none of a folder"):
        open_dataset(copy).sensors()
    done = run_program("lidar", "apply", copy, "--stage", "dropped_packets", "-o", tmp_path / "out")
    assert done.returncode == 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["copy"]
