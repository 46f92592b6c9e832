"""Stages in drives and on recorded data: same bytes, truth files, command line."""

import hashlib
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.formats import FORMATS, read_cloud
from lidar.dataset.layout import open_dataset
from lidar.dataset.png import read_png
from lidar.errors import DatasetError, InputError, LidarError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.parameters import parameter
from lidar.sensors.physics.origin import Origin
from lidar.signal.registry import NamedStage, number_stages, read_stages
from lidar.signal.stage import Stage
from lidar.signal.weather.setting import read_weather
from lidar.simulation import frame_loop
from lidar.simulation.drive import drive
from lidar.simulation.frame_loop import chunks, recording_chunks
from lidar.simulation.plan import plan_drive
from lidar.tools.apply import apply_stages
from lidar.traffic.options import TrafficOptions

RIG = """
name = "small"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
[[camera]]
name = "front"
translation = [3.6, 0.0, 0.8]
width = 64
height = 48
fov_deg = 90.0
rate_hz = 5.0
images = ["rgb", "depth", "instance"]
"""
STAGES = read_stages(["dropped_packets:loss=0.2,burst=3", "lost_rows:loss=0.3,rows=4"]).stages


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    rig = tmp_path_factory.mktemp("rig") / "small.toml"
    rig.write_text(RIG)
    return DriveOptions(
        rig=str(rig),
        duration=0.5,
        seed=3,
        relief="off",
        formats=("pcd", "laz", "kitti", "nuscenes"),
        labels=("semantickitti", "nuscenes"),
        deskew="end",
        traffic=TrafficOptions(),
        workers=1,
    )


@pytest.fixture(scope="module")
def plain(scene, options, tmp_path_factory):
    out = tmp_path_factory.mktemp("plain") / "a"
    drive(scene, out, options=options)
    return out


@pytest.fixture(scope="module")
def altered(scene, options, tmp_path_factory):
    out = tmp_path_factory.mktemp("altered") / "a"
    drive(scene, out, options=replace(options, stages=STAGES))
    return out


NAMING = ("dataset.json", "provenance.json", "checksums.sha256")
"""Files that state options and parents of a dataset, and the digest of what states them."""


def files(folder):
    """Hash of every file but the manifest, by name."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in NAMING)
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in paths}


def program(*words):
    return run_program("lidar", *words)


def test_a_drive_without_stages_has_no_trace_of_them(plain):
    assert not list(plain.rglob("truth"))
    assert "stage" not in (plain / "dataset.json").read_text()


def test_truth_files_complete_the_recorded_clouds(plain, altered):
    lost = 0
    for path in sorted((plain / "top" / "pcd").glob("*.pcd")):
        before, after = read_cloud(path), read_cloud(altered / "top" / "pcd" / path.name)
        with np.load(altered / "top" / "truth" / f"{path.stem}.npz") as truth:
            rows = np.concatenate([truth["source"], truth["removed"]])
            assert np.array_equal(np.sort(rows), np.arange(len(before)))
            assert np.array_equal(after.xyz, before.xyz[truth["source"]])
            assert np.array_equal(truth["removed_xyz"], before.xyz[truth["removed"]])
            assert np.array_equal(truth["removed_time_ns"], before.time_ns[truth["removed"]])
            assert np.array_equal(truth["removed_feature"], before.feature[truth["removed"]])
            assert (truth["origin"] == Origin.SURFACE).all()
            lost += len(truth["removed"])
    assert lost > 1000
    for path in sorted((plain / "front" / "rgb").glob("*.png")):
        image = read_png(altered / "front" / "rgb" / path.name).copy()
        with np.load(altered / "front" / "truth" / f"{path.stem}.npz") as truth:
            image[truth["changed"]] = truth["removed"]
        assert np.array_equal(image, read_png(path))


def test_files_hold_no_column_of_the_truth(plain, altered):
    first = "top/pcd/000000.pcd"
    assert FORMATS["pcd"].read(plain / first).keys() == FORMATS["pcd"].read(altered / first).keys()


@pytest.mark.full
def test_bytes_do_not_depend_on_workers_or_on_a_resumed_drive(scene, options, altered, tmp_path):
    wanted = replace(options, stages=STAGES, workers=3)
    drive(scene, tmp_path / "a", options=wanted)
    assert files(tmp_path / "a") == files(altered)
    for name in ("top/truth/000002.npz", "front/rgb/000001.png"):
        (tmp_path / "a" / name).unlink()
    assert drive(scene, tmp_path / "a", options=wanted).resumed > 0
    assert files(tmp_path / "a") == files(altered)
    with pytest.raises(DatasetError, match="stages"):
        drive(scene, tmp_path / "a", options=options)


@pytest.mark.full
def test_applied_to_the_record_stages_give_the_files_of_the_drive(plain, altered, tmp_path):
    summary = apply_stages(plain, tmp_path / "a", options=ApplyOptions(STAGES))
    made, expected = files(tmp_path / "a"), files(altered)
    del expected["frames.csv"]  # the journal of a drive, which can be resumed
    truth = {name for name in expected if "/truth/" in name}
    assert made.keys() == expected.keys()
    assert [name for name in expected if made[name] != expected[name] and name not in truth] == []
    for name in truth:  # removed columns have the precision of the files
        with np.load(tmp_path / "a" / name) as one, np.load(altered / name) as other:
            assert one.files == other.files
            assert all(np.allclose(one[key], other[key], rtol=1e-6) for key in one.files)
    opened = open_dataset(tmp_path / "a")
    assert opened.manifest["points"] == open_dataset(altered).manifest["points"]
    assert summary.points == sum(opened.manifest["points"].values()) < summary.points_in


def test_no_return_is_added_while_scanners_are_off(plain, tmp_path):
    """As in the turns of surveys from the air."""
    shutil.copytree(plain, tmp_path / "in")
    manifest = json.loads((plain / "dataset.json").read_text())
    manifest["scanners_on_ns"] = [[0, 150_000_000]]
    (tmp_path / "in" / "dataset.json").write_text(json.dumps(manifest))
    snow = read_weather("snow=10")
    stages = number_stages(snow)
    apply_stages(tmp_path / "in", tmp_path / "a", options=ApplyOptions(stages))
    for frame, cloud in enumerate(sorted((tmp_path / "a" / "top" / "pcd").glob("*.pcd"))):
        with np.load(tmp_path / "a" / "top" / "truth" / f"{cloud.stem}.npz") as truth:
            rows = (truth["origin"] == Origin.WEATHER) & (truth["hidden"] < 0)
        added = read_cloud(cloud).time_ns[rows] + 100_000_000 * frame
        assert (len(added) > 50) is (frame < 2)
        assert (added <= 150_000_000).all()


@pytest.mark.full
def test_stages_on_clouds_of_kitti_and_nuscenes(plain, tmp_path):
    for name in ("velodyne", "labels", "nuscenes"):
        target = tmp_path / "in" / name
        target.mkdir(parents=True)
        for path in sorted((plain / "top" / name).iterdir()):
            (target / path.name).write_bytes(path.read_bytes())
    lossy = read_stages(["dropped_packets:loss=0.3"]).stages
    summary = apply_stages(tmp_path / "in", tmp_path / "out", options=ApplyOptions(lossy, sensor="vlp16"))
    assert summary.files == 10
    for folder, suffix in (("velodyne", ".bin"), ("nuscenes", ".pcd.bin")):
        name = f"000001{suffix}"
        before, after = (
            read_cloud(tmp_path / k / folder / name, {"velodyne": "kitti"}.get(folder, folder))
            for k in ("in", "out")
        )
        with np.load(tmp_path / "out" / "truth" / folder / "000001.npz") as truth:
            source, removed = truth["source"], truth["removed"]
            ring, column = truth["removed_ring"], truth["removed_column"]
        assert np.array_equal(after.xyz, before.xyz[source])
        assert len(source) + len(removed) == len(before)
        assert 0.1 < len(removed) / len(before) < 0.5
        real = read_cloud(plain / "top" / "pcd" / "000001.pcd")
        if folder == "nuscenes":
            assert np.array_equal(ring, real.ring[removed])
            assert np.abs(column - real.column[removed]).max() <= 1  # derived from the azimuth
        else:  # directions of compensated points are about those of the pulses
            assert (ring == real.ring[removed]).mean() > 0.8
    labels = [np.fromfile(tmp_path / k / "labels" / "000001.label", "<u4") for k in ("in", "out")]
    with np.load(tmp_path / "out" / "truth" / "velodyne" / "000001.npz") as truth:
        assert np.array_equal(labels[1], labels[0][truth["source"]])
    glass = read_stages(["cover_glass:transmission=0.3"]).stages
    dimmed = apply_stages(tmp_path / "in", tmp_path / "dim", options=ApplyOptions(glass, sensor="vlp16"))
    assert 0 < dimmed.points < dimmed.points_in


def test_stages_refuse_data_without_clouds_or_matching_sensors(plain, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="no velodyne"):
        apply_stages(tmp_path / "empty", tmp_path / "out", options=ApplyOptions(STAGES))
    with pytest.raises(InputError, match="outside of"):
        apply_stages(plain, plain / "out", options=ApplyOptions(STAGES))
    with pytest.raises(InputError, match="has its own sensors"):
        apply_stages(plain, tmp_path / "out", options=ApplyOptions(STAGES, sensor="vlp16"))
    left = ApplyOptions(read_stages(["dropped_packets:sensor=left"]).stages)
    with pytest.raises(InputError, match="no sensor 'left'"):
        apply_stages(plain, tmp_path / "out", options=left)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note").write_text("mine")
    with pytest.raises(DatasetError, match="is not empty"):
        apply_stages(plain, tmp_path / "full", options=ApplyOptions(STAGES))
    assert not (tmp_path / "out").exists()


def test_road_users_are_a_target_only_where_labels_tell_of_them(scene, plain, tmp_path):
    attack = ("--attack", "delete:target=road_user", "-o", tmp_path / "out", "-q")
    (tmp_path / "kitti" / "velodyne").mkdir(parents=True)
    np.ones((5, 4), "<f4").tofile(tmp_path / "kitti" / "velodyne" / "000000.bin")
    shutil.copytree(plain, tmp_path / "alone")
    (tmp_path / "alone" / "boxes.csv").unlink(missing_ok=True)
    for words in (
        ("apply", tmp_path / "kitti"),
        ("apply", tmp_path / "alone"),
        ("drive", scene.path, "--route", "random", "--duration", "0.5"),
    ):
        refused = program(*words, *attack)
        assert refused.returncode == 2
        assert "stage delete needs labelled road users (lidar drive --traffic" in refused.stderr
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("name", "columns"), [("velodyne/000000.bin", 4), ("LIDAR_TOP/a.pcd.bin", 5)])
def test_clouds_with_numbers_that_are_not_finite_name_the_file_and_the_row(name, columns, tmp_path):
    rows = np.ones((9, columns), "<f4")
    rows[4, 2], rows[7, 3] = np.nan, np.inf
    path = tmp_path / "in" / name
    path.parent.mkdir(parents=True)
    rows.tofile(path)
    for words in (
        ("apply", tmp_path / "in", "--weather", "fog=50m"),
        ("denoise", tmp_path / "in", "--method", "dror"),
    ):
        refused = program(*words, "-o", tmp_path / "out", "-q")
        assert refused.returncode == 2
        assert f"{path}: row 4 has a number that is not finite, as have 2 in all" in refused.stderr
        assert refused.stderr.count("\n") == 1
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "name",
    ["top/labels/000001.label", "top/boxes/000001.csv", "front/boxes/000000.csv", "top/pcd/000000.pcd"],
)
def test_damaged_frames_end_in_one_error_that_names_the_file(plain, name, tmp_path):
    shutil.copytree(plain, tmp_path / "data")
    victim = tmp_path / "data" / name
    victim.write_bytes(victim.read_bytes()[:-9] + (b"\n1,2\n" if victim.suffix == ".csv" else b""))
    with pytest.raises(LidarError, match=victim.name):
        apply_stages(tmp_path / "data", tmp_path / "out", options=ApplyOptions(STAGES))


@pytest.mark.parametrize(
    ("key", "value"),
    [("sensor_frames", [1]), ("points", {"top": "x"}), ("seed", None), ("recipe", {"rig": 1})],
)
def test_a_damaged_manifest_ends_in_one_error_that_names_it(plain, key, value, tmp_path):
    shutil.copytree(plain, tmp_path / "data")
    path = tmp_path / "data" / "dataset.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(LidarError, match=r"dataset\.json"):
        apply_stages(tmp_path / "data", tmp_path / "out", options=ApplyOptions(STAGES))


@pytest.mark.parametrize("stage", ["rein", "dropped_packets:los=1", "dropped_packets:loss=2", "none.toml"])
def test_faulty_stages_end_in_one_line_with_nothing_written(scene, plain, tmp_path, stage):
    route = ("--route", "random", "--duration", "0.5")
    for words in (("drive", scene.path, *route), ("apply", plain)):
        result = program(*words, "--stage", stage, "-o", tmp_path / "out", "-q")
        assert result.returncode == 2, result.stderr
        assert result.stderr.count("\n") == 1
        assert result.stderr.startswith("lidar: ")
        assert not (tmp_path / "out").exists()


def test_the_programs_list_and_apply_stages(plain, tmp_path):
    listed = json.loads(program("stages", "--json").stdout)["stages"]
    assert "dropped_packets" in [row["name"] for row in listed]
    assert "dropped_packets" in program("stages").stdout
    file = tmp_path / "stages.toml"
    file.write_text('[[stage]]\nname = "dropped_packets"\nloss = 0.5\n')
    result = program("apply", plain, "--stage", file, "-o", tmp_path / "out", "--json", "-q")
    assert result.returncode == 0, result.stderr
    document = json.loads(result.stdout)
    assert document["points"] < document["points_in"]
    assert Path(document["path"], "top", "truth", "000000.npz").exists()


SEEN = []


@dataclass(frozen=True)
class Watched(Stage):
    """Notes what it is told, and how far the world is along the returns' beams."""

    def cloud(self, cloud, *, at, rng):
        del rng
        far = np.empty(0)
        if at.world is not None:
            time_ns = cloud.start_ns + cloud.time_ns[::50].astype(np.int64)
            poses = at.poses(time_ns)
            beams = cloud.xyz[::50] / np.linalg.norm(cloud.xyz[::50], axis=1, keepdims=True)
            far = at.world.caster.cast(poses.position, poses.directions(beams)).range
        SEEN.append((at, far, cloud.true_range[::50]))
        return cloud


@pytest.mark.full
def test_stages_know_where_and_when_a_frame_is_taken(scene, options, plain, tmp_path):
    """Rays cast from the sensor's poses along the returns meet the world where the returns are from."""
    SEEN.clear()
    watched = (NamedStage("watched", Watched()),)
    alone = replace(options, stages=watched, traffic=None, formats=("pcd",), labels=(), deskew="")
    drive(scene, tmp_path / "a", options=alone)
    assert [at.frame for at, _, _ in SEEN] == list(range(len(SEEN)))
    for at, far, recorded in SEEN:
        assert at.sensor == "top"
        assert at.start_ns == at.frame * 100_000_000
        assert np.median(np.abs(far - recorded)) < 0.02
    SEEN.clear()
    apply_stages(plain, tmp_path / "b", options=ApplyOptions(stages=watched))
    assert all(at.world is None and at.poses is not None and at.utc is not None for at, _, _ in SEEN)
    apply_stages(plain / "top", tmp_path / "c", options=ApplyOptions(stages=watched))
    assert SEEN[-1][0].poses is None


@dataclass(frozen=True)
class Watching(Stage):
    """Notes the cloud of two frames before."""

    back: int = parameter(2, "frames")

    @property
    def lookback(self):
        return 0.2

    def cloud(self, cloud, *, at, rng):
        del rng
        before = at.earlier(self.back)
        FORMER[at.frame] = before
        return cloud


FORMER = {}


@pytest.mark.parametrize("chunk", [pytest.param(200.0, marks=pytest.mark.full), 0.5])
def test_stages_are_given_earlier_clouds_as_they_are_without_stages(
    scene, options, plain, tmp_path, chunk, monkeypatch
):
    """Whichever way a drive is cut into regions; on recorded data from the files."""
    monkeypatch.setattr(frame_loop, "CHUNK", chunk)
    watching = (NamedStage("watching", Watching()),)
    formats = replace(options, stages=watching, formats=("pcd",), labels=(), deskew="")
    FORMER.clear()
    drive(scene, tmp_path / "a", options=formats)
    assert sorted(FORMER) == list(range(5))
    assert FORMER[0] is FORMER[1] is None
    for name in ("top/pcd", "front/rgb"):  # the frame itself is as it was
        for path in sorted((plain / name).iterdir()):
            assert path.read_bytes() == (tmp_path / "a" / name / path.name).read_bytes()
    boxes = "top/boxes/000004.csv"
    assert (plain / boxes).read_bytes() == (tmp_path / "a" / boxes).read_bytes()
    expected = [read_cloud(plain / "top" / "pcd" / f"00000{frame}.pcd") for frame in range(3)]
    driven = [FORMER[frame] for frame in range(2, 5)]
    FORMER.clear()
    apply_stages(plain, tmp_path / "b", options=ApplyOptions(stages=watching))
    applied = [FORMER[frame] for frame in range(2, 5)]
    FORMER.clear()
    apply_stages(plain / "top", tmp_path / "c", options=ApplyOptions(stages=watching))
    loose = [FORMER[frame] for frame in range(2, 5)]
    for before, one, other, third in zip(expected, driven, applied, loose, strict=True):
        assert np.array_equal(one.xyz, before.xyz)
        assert np.array_equal(one.feature, before.feature)
        assert np.array_equal(one.start_ns + one.time_ns, other.start_ns + other.time_ns)
        assert np.array_equal(other.xyz, before.xyz)
        assert len(third) == len(before)


def test_regions_cover_the_places_of_earlier_clouds(scene, options, tmp_path):
    plan = plan_drive(scene, replace(options, traffic=None, stages=(NamedStage("watching", Watching()),)))
    recording = plan.recording(tmp_path / "a")
    late = [job for job in plan.jobs if job.start_ns == 400_000_000]
    [(_, wide)], [(_, box)] = recording_chunks(late, recording), chunks(late, plan.trajectory)
    x, y = plan.trajectory.at(np.linspace(200_000_000, 500_000_000, 9).astype(np.int64)).position[:, :2].T
    assert wide == pytest.approx((x.min(), y.min(), x.max(), y.max()), abs=0.01)
    assert max(abs(a - b) for a, b in zip(wide, box, strict=True)) > 0.5


def test_a_stage_that_looks_back_farther_than_it_says_is_an_error(scene, options, tmp_path):
    far = (NamedStage("watching", Watching(3)),)
    with pytest.raises(LidarError, match="looks back 3 frames of top, more than its `lookback`"):
        drive(scene, tmp_path / "a", options=replace(options, stages=far))


@dataclass(frozen=True)
class Refusing(Stage):
    """Cannot act on the third frame."""

    def cloud(self, cloud, *, at, rng):
        del rng
        if at.frame == 2:
            raise InputError("no such frame")
        return cloud


@pytest.mark.full
def test_a_stage_that_fails_at_a_later_frame_leaves_what_was_there(plain, tmp_path):
    refusing = ApplyOptions(stages=(NamedStage("refusing", Refusing()),))
    for source in (plain, plain / "top"):
        with pytest.raises(InputError, match="no such frame"):
            apply_stages(source, tmp_path / "new", options=refusing)
        assert not list(tmp_path.iterdir())
    shutil.copytree(plain, tmp_path / "old")
    (tmp_path / "old" / "note.txt").write_text("mine")
    before = files(tmp_path / "old")
    with pytest.raises(InputError, match="no such frame"):
        apply_stages(plain, tmp_path / "old", options=refusing, overwrite=True)
    assert files(tmp_path / "old") == before
    apply_stages(plain, tmp_path / "old", options=ApplyOptions(STAGES), overwrite=True)
    apply_stages(plain, tmp_path / "fresh", options=ApplyOptions(STAGES))
    assert files(tmp_path / "old") == files(tmp_path / "fresh") | {"note.txt": before["note.txt"]}
    assert {path.name for path in tmp_path.iterdir()} == {"old", "fresh"}
