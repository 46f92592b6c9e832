"""A drive shows each recorded frame in a viewer of Rerun, and writes the same bytes as without one."""

import filecmp
import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from helpers.drives import small_seed
from helpers.programs import run_program
from PIL import Image

from lidar.dataset.layout import open_dataset, read_rows
from lidar.dataset.recorded import scanner_clouds, still_points
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive

ROAD_USERS = ("--traffic", "vehicles=60,parked=0.8,pedestrians=30,cyclists=5")


class Archetypes(ModuleType):
    """Stands for `rerun`: each archetype is a record of its arguments, and streams keep what is logged."""

    streams: ClassVar = []

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)

        def archetype(*values, **named):
            made = SimpleNamespace(kind=name, values=values, **named)
            made.compress = lambda **_: made
            return made

        for constant in ("RIGHT_HAND_Z_UP", "RDF", "XYXY"):
            setattr(archetype, constant, SimpleNamespace(kind=constant))
        return archetype

    @staticmethod
    def spawn(recording):  # noqa: ARG004
        raise RuntimeError("no display")


class Stream:
    """Keeps what is logged: (place, seconds, archetype)."""

    def __init__(self, name):  # noqa: ARG002
        self.logged, self.time, self.file = [], None, None
        Archetypes.streams.append(self)

    def save(self, path):
        self.file = Path(path)
        self.file.write_bytes(b"begun")

    def set_time(self, timeline, *, duration):  # noqa: ARG002
        self.time = duration.astype("timedelta64[ns]").astype(int)

    def log(self, place, archetype, *, static=False):
        self.logged.append((place, None if static else self.time, archetype))

    def send_blueprint(self, blueprint):
        assert blueprint.kind == "Blueprint"

    def disconnect(self):
        self.file.write_bytes(b"whole")


@pytest.fixture
def viewer(monkeypatch):
    """A stand-in for rerun."""
    stand_in = Archetypes("rerun")
    stand_in.RecordingStream = Stream
    Archetypes.streams.clear()
    monkeypatch.setitem(sys.modules, "rerun", stand_in)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", stand_in)
    return stand_in


def same_files(one, other):
    """Whether two folders have the same files with the same bytes."""
    names = sorted(p.relative_to(one) for p in one.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(other) for p in other.rglob("*") if p.is_file())
    return filecmp.cmpfiles(one, other, names, shallow=False)[0] == names


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Words of a drive of two sweeps of a scanner with small images."""
    rig = small_seed(tmp_path_factory.mktemp("rig"))
    return ("--route", "random", "--duration", 0.2, "--seed", 3, "--rig", rig, "--format", "pcd", "-q")


@pytest.fixture(scope="module")
def plain(scene, short, tmp_path_factory):
    """A drive that nobody watches."""
    out = tmp_path_factory.mktemp("plain") / "drive"
    done = run_program("lidar", "drive", scene.path, *short, *ROAD_USERS, "-o", out)
    assert done.returncode == 0, done.stderr
    return out


@pytest.mark.full
@pytest.mark.usefixtures("viewer")
def test_what_is_shown_is_what_is_recorded(scene, short, plain, tmp_path):
    watched = tmp_path / "drive"
    done = run_program(
        "lidar", "drive", scene.path, *short, *ROAD_USERS, "-o", watched, "--live", tmp_path / "live.rrd"
    )
    assert done.returncode == 0, done.stderr
    assert same_files(watched, plain)
    assert (tmp_path / "live.rrd").read_bytes() == b"whole"
    (stream,) = Archetypes.streams
    dataset = open_dataset(watched)
    clouds, trajectory = scanner_clouds(dataset, "lidar_top"), dataset.trajectory()
    shown = {
        time: points
        for place, time, points in stream.logged
        if points.kind == "Points3D" and place.endswith("top")
    }
    assert sorted(shown) == clouds.time_ns.tolist()
    for row, time in enumerate(clouds.time_ns.tolist()):
        table = still_points(clouds, trajectory, row=row)
        (points,) = shown[time].values
        assert np.abs(points - np.column_stack([table[axis] for axis in "xyz"])).max() < 1e-5
        assert (shown[time].class_ids == table["label"]).all()
    images = [one for one in stream.logged if one[2].kind == "Image"]
    times = dataset.sample_times("camera_front")
    assert sorted(time for _, time, _ in images) == times.tolist()
    for place, time, image in images:
        assert place == "scene/vehicle/camera_front/rgb"
        frame = int(np.flatnonzero(times == time)[0])
        with Image.open(dataset.paths.image("camera_front", frame, kind="rgb")) as recorded:
            assert (image.values[0] == np.asarray(recorded)).all()
    for place, time, boxes in stream.logged:
        if boxes.kind == "Boxes3D":
            frame = int(np.flatnonzero(clouds.time_ns == time)[0])
            rows = read_rows(dataset.paths.frame_boxes("lidar_top", frame))
            rows = [row for row in rows if int(row["points"])]
            assert place == "scene/road_users"
            assert rows
            assert np.allclose(boxes.centers, [[float(row[k]) for k in "xyz"] for row in rows])
            assert np.allclose(boxes.half_sizes[:, 0] * 2, [float(row["length"]) for row in rows])
        if place == "scene/vehicle":
            assert np.allclose(boxes.translation, trajectory.at([time]).position[0])


@pytest.mark.usefixtures("viewer")
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("a.txt",), "ends with .rrd"),
        (("a.rrd", "b.rrd"), "one file"),
        (("taken.rrd",), "--overwrite"),
        ((), "write a file instead"),
    ],
)
def test_what_cannot_be_shown_ends_with_a_line_before_the_drive(scene, short, tmp_path, words, told):
    (tmp_path / "taken.rrd").write_bytes(b"")
    run = run_program(
        "lidar", "drive", scene.path.resolve(), *short, "-o", "out", "--live", *words, cwd=tmp_path
    )
    assert run.returncode in (1, 2)
    assert told in run.stderr
    assert run.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["taken.rrd"]


def test_without_rerun_the_extra_is_named(scene, short, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    run = run_program("lidar", "drive", scene.path, *short, "-o", tmp_path / "out", "--live")
    assert run.returncode == 2
    assert "geoscene[live]" in run.stderr
    assert not list(tmp_path.iterdir())


def test_frames_of_a_cluster_are_not_shown(scene, tmp_path):
    options = DriveOptions(route="random", duration=0.3, rig="vlp16", scheduler="tcp://127.0.0.1:1")
    with pytest.raises(ValueError, match="leave out `scheduler`"):
        drive(scene, tmp_path / "out", options=options, live=lambda _: print)


@pytest.mark.usefixtures("viewer")
def test_a_failed_drive_leaves_no_file(scene, short, tmp_path, monkeypatch):
    monkeypatch.setattr(Stream, "set_time", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    run = run_program(
        "lidar", "drive", scene.path, *short, "-o", tmp_path / "out", "--live", tmp_path / "a.rrd"
    )
    assert run.returncode != 0
    assert not list(tmp_path.glob("*.rrd"))


def test_rerun_reads_the_file(scene, short, plain, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk (extra live), 500 MB")
    watched, file = tmp_path / "drive", tmp_path / "live.rrd"
    done = run_program("lidar", "drive", scene.path, *short, *ROAD_USERS, "-o", watched, "--live", file)
    assert done.returncode == 0, done.stderr
    assert same_files(watched, plain)
    rerun = [shutil.which("rerun") or sys.executable, *([] if shutil.which("rerun") else ["-m", "rerun_cli"])]
    subprocess.run([*rerun, "rrd", "verify", file], check=True, capture_output=True)
    listed = subprocess.run([*rerun, "rrd", "print", file], check=True, capture_output=True, text=True).stdout
    rows = Counter()
    for count, place in re.findall(r"with (\d+) rows .*? - (/[^ ]*) - ", listed):
        rows[place] += int(count)
    dataset = open_dataset(watched)
    assert rows["/scene/vehicle/lidar_top"] == 1 + len(dataset.sample_times("lidar_top")), "and the mount"
    assert rows["/scene/vehicle/camera_front/rgb"] == len(dataset.sample_times("camera_front"))
    assert rows["/scene/road_users"] == len(dataset.sample_times("lidar_top"))
