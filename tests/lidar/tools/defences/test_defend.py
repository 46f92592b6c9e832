"""Defences on recorded drives: files, scores, what they read, and data that lack what a defence needs."""

import csv
import json
import shutil

import numpy as np
import pytest
from helpers.programs import run_program

from geoscene.errors import GeosceneError
from lidar.dataset.formats import FORMATS, read_table
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.defences.calibration import read_calibration
from lidar.tools.defences.defend import calibrate, defend
from lidar.tools.defences.observation import SEEN, read_scans
from lidar.tools.defences.registry import DEFENCES, DETECTOR, read_defences
from lidar.tools.defences.returns import Physics
from lidar.tools.detection.learned import read_detector
from lidar.tools.integrity.watermark import WatermarkKey
from lidar.tools.sign import sign_dataset

RIG = """
name = "small"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
firing_jitter_ns = 10.0
[[camera]]
name = "front"
translation = [1.6, 0.0, 1.5]
width = 160
height = 90
fov_deg = 90.0
rate_hz = 10.0
images = ["rgb"]
[[gnss]]
name = "gnss"
translation = [0.0, 0.0, 1.6]
rate_hz = 10.0
[[imu]]
name = "imu"
translation = [0.0, 0.0, 0.6]
rate_hz = 100.0
"""
BARE = RIG.partition("[[camera]]")[0]


CALIBRATION = read_calibration()
ALL = read_defences(["all"])
UNSIGNED = [name for name in DEFENCES if name != "watermark"]


def driven(scene, folder, rig, **options):
    (folder / "rig.toml").write_text(rig)
    options |= {"route": "random", "rig": str(folder / "rig.toml"), "duration": 0.5, "seed": 3}
    drive(scene, folder / "drive", options=DriveOptions(workers=1, **options))
    return folder / "drive"


@pytest.fixture(scope="module")
def plain(scene, tmp_path_factory):
    return driven(scene, tmp_path_factory.mktemp("plain"), RIG)


@pytest.fixture(scope="module")
def attacked(plain, tmp_path_factory):
    out = tmp_path_factory.mktemp("attacked") / "drive"
    stages = read_stages(["inject:device=sun_2020,shape=object,range=8,distance=6,start=0.2"]).stages
    apply_stages(plain, out, options=ApplyOptions(stages))
    return out


def test_every_defence_is_calibrated_by_the_program():
    calibration = read_calibration()
    for name in DEFENCES:
        assert 0 <= calibration.threshold(name, "frames") <= 1


def test_a_verdict_has_a_row_for_each_return_and_scores_against_the_truth(attacked, tmp_path):
    dataset = open_dataset(attacked)
    found = defend([dataset], ALL, calibration=CALIBRATION, rule="max", out=tmp_path / "out")
    assert set(found.seconds) == {*UNSIGNED, DETECTOR}
    document = json.loads((tmp_path / "out" / "defend.json").read_text())
    assert set(document["defences"]) == {*UNSIGNED, "fused"}
    with (tmp_path / "out" / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 * (1 + len(UNSIGNED))
    assert [row["attacked"] for row in rows if row["defence"] == "fused"] == ["0", "0", "1", "1", "1"]
    truth = np.load(dataset.paths.truth("top", 3))["origin"]
    with np.load(tmp_path / "out" / "drive" / "top" / "000003.npz") as file:
        assert {len(file[name]) for name in file.files if not name.endswith("_gaps")} == {len(truth)}
    assert found.scores["occlusion", "returns"].attacked == sum(
        (np.load(dataset.paths.truth("top", k))["origin"] > 0).sum() for k in range(5)
    )
    again = defend([dataset], ALL, calibration=CALIBRATION, rule="max", out=tmp_path / "b")
    for path in (tmp_path / "out").rglob("*.[cp]*"):
        assert path.read_bytes() == (tmp_path / "b" / path.relative_to(tmp_path / "out")).read_bytes()
    assert {k: v.auc for k, v in again.scores.items() if v.attacked}.keys() == {
        k for k, v in found.scores.items() if v.attacked
    }


@pytest.mark.full
def test_defences_see_no_ground_truth(attacked, tmp_path):
    """The verdicts are the same without truth files and with other labels."""
    blind = tmp_path / "blind"
    shutil.copytree(attacked, blind)
    shutil.rmtree(blind / "top" / "truth")
    (scans,) = read_scans(open_dataset(attacked))
    for path in sorted((blind / "top" / "pcd").iterdir()):
        table = read_table(path)
        rng = np.random.default_rng(1)
        changed = {
            name: column if name in SEEN else rng.permutation(column) for name, column in table.items()
        }
        FORMATS["pcd"].write(path, changed)
    judged = [
        defend(
            [open_dataset(folder)],
            ALL,
            calibration=CALIBRATION,
            out=tmp_path / name,
        )
        for folder, name in ((attacked, "seeing"), (blind, "unseeing"))
    ]
    assert (
        judged[0].scores["physics", "returns"].attacked > judged[1].scores["physics", "returns"].attacked == 0
    )
    for k in scans.frames:
        one, other = (
            np.load(next((tmp_path / name).rglob(f"{k:06d}.npz"))) for name in ("seeing", "unseeing")
        )
        assert one.files == other.files
        assert all((one[name] == other[name]).all() for name in one.files)


def test_the_watermark_tells_injected_returns_apart(plain, tmp_path):
    (tmp_path / "key").write_text("00112233445566778899aabbccddeeff")
    mark = WatermarkKey(bytes.fromhex("00112233445566778899aabbccddeeff"))
    sign_dataset(plain, tmp_path / "signed", watermark=mark)
    stages = read_stages(["insert:distance=7,start=0.2"]).stages
    apply_stages(tmp_path / "signed", tmp_path / "forged", options=ApplyOptions(stages))
    chosen = read_defences([f"watermark:key={tmp_path / 'key'}"])
    found = defend([open_dataset(tmp_path / "forged")], chosen, calibration=CALIBRATION)
    scores = found.scores["watermark", "returns"]
    assert scores.attacked > 100
    assert scores.auc[0] > 0.999
    assert found.scores["watermark", "frames"].auc[0] == 1
    with pytest.raises(InputError, match="watermark: needs clouds with a watermark"):
        defend([open_dataset(plain)], chosen, calibration=CALIBRATION)
    with pytest.raises(InputError, match="watermark: needs the key of the watermark"):
        defend([open_dataset(tmp_path / "signed")], read_defences(["watermark"]), calibration=CALIBRATION)


def test_data_that_lack_what_a_defence_needs_are_refused_and_all_leaves_it_out(scene, tmp_path):
    bare = open_dataset(driven(scene, tmp_path, BARE))
    for name, lack in (("overlay", "colour images"), ("navigation", "GNSS")):
        with pytest.raises(InputError, match=f"{name}: needs .*{lack}"):
            defend([bare], read_defences([name]), calibration=CALIBRATION, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    found = defend([bare], ALL, calibration=CALIBRATION)
    assert set(found.seconds) == {*UNSIGNED, DETECTOR} - {"overlay", "navigation"}
    (tmp_path / "rig.toml").write_text(BARE + "# changed\n")
    with pytest.raises(InputError, match="has changed"):
        read_scans(bare)


def test_clouds_without_ring_and_time_are_refused(scene, tmp_path):
    with pytest.raises(DatasetError, match="drive again with `formats` pcd"):
        read_scans(open_dataset(driven(scene, tmp_path, BARE, formats=("kitti",))))


@pytest.mark.full
def test_calibration_takes_genuine_data_alone(plain, attacked, tmp_path):
    made = calibrate([open_dataset(plain)], read_defences(["physics", "shadow"]), out=tmp_path / "c.toml")
    read = read_calibration(tmp_path / "c.toml")
    assert read.tails.keys() == made.tails.keys()
    assert {level: joint.count for level, joint in read.joint.items()} == {
        level: joint.count for level, joint in made.joint.items()
    }
    for level, joint in made.joint.items():
        assert joint.defences == ("physics", "shadow")
        assert (read.joint[level].suspicion == joint.suspicion).all()
    with pytest.raises(DatasetError, match="was attacked"):
        calibrate([open_dataset(attacked)], read_defences(["physics"]), out=tmp_path / "d.toml")
    assert not (tmp_path / "d.toml").exists()


@pytest.mark.full
def test_verdicts_are_written_whole_or_not_at_all_and_never_into_the_data(attacked, tmp_path, monkeypatch):
    dataset, chosen = open_dataset(attacked), read_defences(["physics"])
    before = sorted(attacked.rglob("*"))
    for inside in (attacked, attacked / "verdicts"):
        with pytest.raises(InputError, match="give a directory outside of"):
            defend([dataset], chosen, calibration=CALIBRATION, out=inside, overwrite=True)
    judge, seen = Physics.judge, []

    def judge_or_fail(self, frames, **given):
        seen.append(frames)
        if len(seen) == 3:
            raise OSError("the disk is gone")
        return judge(self, frames, **given)

    monkeypatch.setattr(Physics, "judge", judge_or_fail)
    with pytest.raises(OSError, match="the disk is gone"):
        defend([dataset], chosen, calibration=CALIBRATION, out=tmp_path / "out")
    assert sorted(attacked.rglob("*")) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.full
def test_new_verdicts_replace_former_ones_whole(attacked, tmp_path):
    dataset, both, out = open_dataset(attacked), read_defences(["physics", "overlay"]), tmp_path / "out"
    defend([dataset], both, calibration=CALIBRATION, out=out)
    assert list(out.rglob("overlay/*.png"))
    (out / "notes.txt").write_text("mine")
    renamed = tmp_path / "renamed"
    shutil.copytree(attacked, renamed)
    chosen = read_defences(["physics"])
    defend([open_dataset(renamed)], chosen, calibration=CALIBRATION, out=out, overwrite=True)
    defend([open_dataset(renamed)], chosen, calibration=CALIBRATION, out=tmp_path / "fresh")
    found, fresh = (
        {path.relative_to(folder).as_posix() for path in folder.rglob("*")}
        for folder in (out, tmp_path / "fresh")
    )
    assert found == fresh | {"notes.txt"}
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(GeosceneError, match=r"exists and holds no defend.json; give another folder"):
        defend([dataset], chosen, calibration=CALIBRATION, out=tmp_path / "mine", overwrite=True)


def test_the_map_of_another_place_is_refused(attacked, scene, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(attacked, elsewhere)
    document = json.loads((elsewhere / "dataset.json").read_text())
    document["frame"]["origin"][0] += 1000.0
    (elsewhere / "dataset.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"is in another frame \(CRS and origin\) than .*elsewhere"):
        defend(
            [open_dataset(elsewhere)],
            read_defences(["map"]),
            calibration=CALIBRATION,
            scene=scene,
            out=tmp_path / "out",
        )
    assert not (tmp_path / "out").exists()


@pytest.mark.full
def test_all_leaves_the_map_out_where_the_scene_is_gone(attacked, scene, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(attacked, moved)
    document = json.loads((moved / "dataset.json").read_text())
    document["scene"]["path"] = "gone"
    (moved / "dataset.json").write_text(json.dumps(document))
    chosen, lone = read_defences(["all"]), read_defences(["map"])
    found = defend([open_dataset(moved)], chosen, calibration=CALIBRATION)
    assert {*UNSIGNED, DETECTOR} - set(found.seconds) == {"map"}
    with pytest.raises(InputError, match=r"defence map: needs the scene .*gone.*, which is missing"):
        defend([open_dataset(moved)], lone, calibration=CALIBRATION)
    assert defend([open_dataset(moved)], lone, calibration=CALIBRATION, scene=scene).frames == 5


def test_what_fog_takes_is_no_attack(plain, tmp_path):
    physics, fog = read_defences(["physics"]), "weather:kind=fog,amount=50,sensor=top"
    for name, attacks, expected in (
        ("foggy", (), "00000"),
        ("removed", ("remove:start=0.2,stop=0.4",), "00110"),
    ):
        apply_stages(plain, tmp_path / name, options=ApplyOptions(read_stages([fog, *attacks]).stages))
        dataset = open_dataset(tmp_path / name)
        assert len(np.load(dataset.paths.truth("top", 0))["removed"]) > 100
        defend([dataset], physics, calibration=CALIBRATION, out=tmp_path / "verdicts", overwrite=True)
        with (tmp_path / "verdicts" / "frames.csv").open() as file:
            assert "".join(row["attacked"] for row in csv.DictReader(file)) == expected
    calibrate([open_dataset(tmp_path / "foggy")], physics, out=tmp_path / "foggy.toml")
    with pytest.raises(DatasetError, match="was attacked"):
        calibrate([open_dataset(tmp_path / "removed")], physics, out=tmp_path / "removed.toml")


def test_names_of_defences_have_any_case_and_their_values_keep_it(attacked, tmp_path):
    (tmp_path / "Secret.KEY").write_text("00112233445566778899aabbccddeeff")
    refused = run_program(
        "lidar", "defend", attacked, "--defence", f"Physics,watermark:key={tmp_path / 'Secret.KEY'}", "-q"
    )
    assert "watermark: needs clouds with a watermark" in refused.stderr


def test_a_file_that_is_no_calibration_says_why(tmp_path):
    (tmp_path / "c.toml").write_text('note = "x"')
    with pytest.raises(InputError, match=r"no calibration of defences \(defence is missing\)"):
        read_calibration(tmp_path / "c.toml")
    with pytest.raises(InputError, match=r"nowhere.toml: is missing; lidar defend --calibrate"):
        read_calibration(tmp_path / "nowhere.toml")


def test_the_program_judges_lists_and_refuses(attacked, tmp_path):
    listed = json.loads(run_program("lidar", "defences", "--json").stdout)
    assert [row["name"] for row in listed["defences"]] == list(DEFENCES)
    words = ("lidar", "defend", attacked, "--defence", "occlusion:cell=0.5,physics", "-q")
    found = json.loads(run_program(*words, "--json", "-o", tmp_path / "out").stdout)
    assert found["defences"]["occlusion"]["returns"]["attacked"] > 0
    assert "fused" in found["defences"]
    assert json.loads((tmp_path / "out" / "defend.json").read_text())["options"][0]["cell"] == 0.5
    for extra, message in {
        ("--defence", "oclusion"): "is occlusion meant",
        ("--defence", "physics", "-o", str(tmp_path / "out")): "is not empty",
        ("--defence", "physics", "--fuse", "mean"): "harmonic, max, fisher, none",
        ("--defence", "physics", "--calibrate"): "give --out",
        ("--defence", "physics", "--calibrate", "--fuse", "max"): "leave out",
        ("--defence", "physics", "--calibration", str(attacked / "dataset.json")): "no calibration",
    }.items():
        refused = run_program("lidar", "defend", attacked, *extra, "-q")
        assert refused.returncode == 2, extra
        assert message in refused.stderr
        assert refused.stderr.count("\n") == 1


def test_thresholds_are_of_the_same_detector(plain, tmp_path):
    out = tmp_path / "learned.toml"
    words = ("--defence", "shadow", "--detector", "learned")
    assert run_program("lidar", "defend", plain, *words, "--calibrate", "-o", out).returncode == 0
    made = read_calibration(out, detector=read_detector("learned"))
    assert made.detector.startswith("model ")
    assert run_program("lidar", "defend", plain, *words, "--calibration", out).returncode == 0
    wrong = run_program("lidar", "defend", plain, "--defence", "shadow", "--calibration", out)
    assert wrong.returncode == 2
    assert wrong.stderr.count("\n") == 1
    assert "--calibrate" in wrong.stderr


@pytest.mark.full
def test_boxes_are_those_of_the_chosen_detector(plain):
    dataset, learned = open_dataset(plain), read_detector("learned")
    (rules,), (other,) = read_scans(dataset), read_scans(dataset, detector=learned)
    np.testing.assert_array_equal(other.frame(0).objects.centre, learned.detect(rules.frame(0)).centre)
    assert len(other.frame(0).members) == len(other.frame(0).objects)
