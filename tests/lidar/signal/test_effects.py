"""What a run says of each stage: counts that agree with the truth, and stages that never act."""

import json

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.layout import open_dataset
from lidar.errors import InputError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.sensors.physics.origin import Origin
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages

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
[[gnss]]
name = "roof"
translation = [0.0, 0.0, 1.6]
rate_hz = 5.0
"""
BOX = "bearing=10,distance=8,long=6,wide=6,high=4"


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    rig = tmp_path_factory.mktemp("rig") / "small.toml"
    rig.write_text(RIG)
    return DriveOptions(rig=str(rig), duration=0.4, seed=3, formats=("pcd", "kitti"), workers=1)


@pytest.fixture(scope="module")
def plain(scene, options, tmp_path_factory):
    out = tmp_path_factory.mktemp("plain") / "a"
    assert drive(scene, out, options=options).effects == {}
    return out


def truths(folder):
    return [np.load(path) for path in sorted(folder.glob("top/truth/*.npz"))]


@pytest.mark.full
@pytest.mark.parametrize(
    "stage",
    [f"insert:{BOX},replaces=false", f"delete:{BOX}", "perturb:share=0.2", "dropped_packets:loss=0.3"],
)
def test_counts_of_returns_are_those_of_the_truth(plain, tmp_path, stage):
    done = apply_stages(plain, tmp_path / "a", options=ApplyOptions(read_stages([stage]).stages))
    ((name, counts),) = done.effects.items()
    assert name == stage.partition(":")[0]
    found = truths(tmp_path / "a")
    moved = sum(np.count_nonzero(t["origin"] == Origin.MOVED) for t in found)
    assert counts["returns added"] == sum(np.count_nonzero(t["source"] < 0) for t in found)
    assert counts["returns removed"] == sum(len(t["removed"]) for t in found) - moved
    assert counts["returns changed"] == moved
    assert sum(counts.values()) > 0


def test_every_seam_is_counted_and_stages_of_one_name_apart(plain, tmp_path):
    texts = [
        "inject:shape=wall,device=any,points=500,distance=8,width=60",
        "camera_blind",
        "camera_blind:start=0.2",
    ]
    texts += ["gnss_spoof:kind=step,start=0.1,stop=0.3"]
    done = apply_stages(plain, tmp_path / "a", options=ApplyOptions(read_stages(texts).stages))
    assert done.effects["inject"]["echoes added"] > 100
    assert done.effects["camera_blind"] == {"images changed": 2}
    assert done.effects["camera_blind 2"] == {"images changed": 1}
    assert done.effects["gnss_spoof"] == {"fixes changed": 1}


@pytest.mark.full
def test_a_drive_counts_as_recorded_data_do(scene, options, plain, tmp_path):
    texts = [f"delete:{BOX}", "lost_rows:loss=0.3,rows=4", "gnss_spoof:left=5,start=0"]
    stages = read_stages(texts).stages
    rig = {name: getattr(options, name) for name in ("rig", "duration", "seed", "formats")}
    driven = drive(scene, tmp_path / "driven", options=DriveOptions(**rig, stages=stages, workers=2))
    applied = apply_stages(plain, tmp_path / "applied", options=ApplyOptions(stages))
    assert driven.effects == applied.effects


def test_weather_of_another_place_is_said_to_change_nothing(plain, tmp_path):
    table = '[[weather]]\nkind = "fog"\namount = 50.0\nlongitude = 100.0\nlatitude = 0.0\nradius = 50.0\n'
    (tmp_path / "far.toml").write_text(table)
    done = run_program(
        "lidar", "apply", plain, "--weather", tmp_path / "far.toml", "-o", tmp_path / "a", "-q"
    )
    assert "stage weather: changed nothing; check when and where it acts" in done.stdout
    (tmp_path / "near.toml").write_text(table.split("longitude", maxsplit=1)[0])
    shown = run_program(
        "lidar", "apply", plain, "--weather", tmp_path / "near.toml", "-o", tmp_path / "b", "-q", "--json"
    )
    assert json.loads(shown.stdout)["effects"]["weather"]["echoes changed"] > 1000


@pytest.mark.full
@pytest.mark.parametrize("stage", ["delete:start=0.35", "camera_blind:start=0.3", "gnss_spoof:start=5"])
def test_stages_that_start_after_the_last_measurement_are_refused(scene, options, plain, tmp_path, stage):
    """The last cloud is of 0.3 s, the last image of 0.2 s."""
    stages = read_stages([stage]).stages
    with pytest.raises(InputError, match=r"start = [0-9.]+ s is after the last measurement, at 0\.[234] s"):
        apply_stages(plain, tmp_path / "a", options=ApplyOptions(stages))
    rig = {name: getattr(options, name) for name in ("rig", "duration", "seed", "formats")}
    with pytest.raises(InputError, match="is after the last measurement"):
        drive(scene, tmp_path / "b", options=DriveOptions(**rig, stages=stages))
    assert not list(tmp_path.iterdir())


def test_clouds_of_kitti_have_no_later_time(plain, tmp_path):
    clouds = open_dataset(plain).path / "top"
    with pytest.raises(
        InputError, match=r"start = 0.1 s is after the last measurement, at 0 s \(clouds of KITTI"
    ):
        apply_stages(clouds, tmp_path / "a", options=ApplyOptions(read_stages(["delete:start=0.1"]).stages))
    done = apply_stages(clouds, tmp_path / "a", options=ApplyOptions(read_stages([f"delete:{BOX}"]).stages))
    assert done.effects["delete"]["returns removed"] == done.points_in - done.points > 0
