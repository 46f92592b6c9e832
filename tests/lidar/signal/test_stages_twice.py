"""Stages on data that stages have changed before: the truth goes back to what the sensor first measured."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.formats import FORMATS, read_cloud
from lidar.dataset.layout import open_dataset
from lidar.errors import DatasetError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.sensors.physics.origin import Origin
from lidar.signal.registry import read_stages
from lidar.signal.weather.setting import read_weather
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.denoise.denoise import denoise
from lidar.tools.denoise.filters import read_methods

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
rate_hz = 5.0
"""
SNOW = read_weather("snow=10")
WALL = "inject:shape=wall,device=any,points=2000,distance=8,width=60"
SHIFT = "move:bearing=10,distance=8,long=6,wide=2,high=4"
BOX = "bearing=10,distance=8,long=6,wide=6,high=4"


def stages(*texts):
    return read_stages(texts).stages


@pytest.fixture(scope="module")
def options(tmp_path_factory):
    rig = tmp_path_factory.mktemp("rig") / "small.toml"
    rig.write_text(RIG)
    return DriveOptions(rig=str(rig), duration=0.4, seed=7, formats=("pcd", "kitti", "nuscenes"), workers=1)


@pytest.fixture(scope="module")
def plain(scene, options, tmp_path_factory):
    out = tmp_path_factory.mktemp("plain") / "a"
    drive(scene, out, options=options)
    return out


@pytest.fixture(scope="module")
def snowy(plain, tmp_path_factory):
    out = tmp_path_factory.mktemp("snowy") / "a"
    apply_stages(plain, out, options=ApplyOptions(SNOW))
    return out


NAMING = ("dataset.json", "provenance.json", "checksums.sha256")
"""Files that state options and parents of a dataset, and the digest of what states them."""


def files(folder):
    """Hash of every file but the manifest and truth files, by name."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in NAMING)
    named = {p.relative_to(folder): p for p in paths}
    return {
        str(name): hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in named.items()
        if "truth" not in name.parts
    }


def truth_of(folder, frame, sensor="top"):
    with np.load(folder / sensor / "truth" / f"{frame:06d}.npz") as file:
        return {name: file[name] for name in file.files}


def clouds(folder):
    for frame, path in enumerate(sorted((folder / "top" / "pcd").glob("*.pcd"))):
        yield frame, read_cloud(path)


def assert_same_truth(one, other):
    """Removed columns have the precision of the files."""
    assert one.keys() == other.keys()
    for name, column in one.items():
        if column.dtype.kind == "f":
            assert np.allclose(column, other[name], rtol=1e-6, atol=1e-6), name
        else:
            assert np.array_equal(column, other[name]), name


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (["dropped_packets:loss=0.2"], ["dropped_packets:loss=0.2"]),
        ([f"delete:{BOX}"], [f"insert:{BOX}"]),
        ([f"insert:{BOX}"], ["insert:bearing=10,distance=5,long=3,wide=3,high=4"]),
        ([f"insert:{BOX}"], [f"move:{BOX}"]),
        ([f"move:{BOX}"], ["false_weather:share=0.5"]),
        (["perturb:bound=0.2,share=0.3"], ["false_weather:share=0.3", "dropped_packets:loss=0.3"]),
        ([WALL], ["dropped_packets:loss=0.2", "perturb:bound=0.1,share=0.2"]),
        (["cover_glass:transmission=0.9"], ["lost_rows:loss=0.5,rows=4"]),
        (["lost_rows:loss=0.3,rows=4"], ["lost_rows:loss=0.3,rows=4"]),
        (["gnss_spoof:left=5,start=0"], ["gnss_spoof:left=-8,start=0.1"]),
    ],
)
def test_two_runs_give_what_one_with_both_gives(plain, tmp_path, first, second):
    """Where the first ones act before the others also in one run: data byte for byte, and the truth."""
    apply_stages(plain, tmp_path / "once", options=ApplyOptions(stages(*first, *second)))
    apply_stages(plain, tmp_path / "half", options=ApplyOptions(stages(*first)))
    apply_stages(tmp_path / "half", tmp_path / "twice", options=ApplyOptions(stages(*second)))
    made, expected = files(tmp_path / "twice"), files(tmp_path / "once")
    assert made.keys() == expected.keys()
    differing = [name for name in expected if made[name] != expected[name]]
    for name in differing:  # files keep ranges in single precision, which are then changed again
        one, two = (FORMATS["pcd"].read(tmp_path / k / name) for k in ("once", "twice"))
        assert [column for column in one if not np.array_equal(one[column], two[column])] == ["range"]
        np.testing.assert_array_max_ulp(one["range"], two["range"])
    changed = sorted(p.relative_to(tmp_path) for p in (tmp_path / "once").rglob("truth/*.npz"))
    for path in changed:
        sensor, frame = path.parts[1], int(path.stem)
        assert_same_truth(*(truth_of(tmp_path / k, frame, sensor) for k in ("twice", "once")))
    for path in (tmp_path / "once").glob("*.truth.csv"):
        assert (tmp_path / "twice" / path.name).read_text() == path.read_text()
    listed = [json.loads((tmp_path / k / "dataset.json").read_text())["recipe"] for k in ("once", "twice")]
    assert listed[0] == listed[1]


@pytest.mark.full
def test_truth_of_attacks_on_weather_goes_back_to_the_surfaces(plain, snowy, tmp_path):
    """Injected returns in front of flakes hide the surfaces that the flakes hid."""
    apply_stages(snowy, tmp_path / "a", options=ApplyOptions(stages(WALL, SHIFT)))
    seen = set()
    by_flakes = chained = 0
    for frame, original in clouds(plain):
        truth, before = truth_of(tmp_path / "a", frame), truth_of(snowy, frame)
        name = f"top/pcd/{frame:06d}.pcd"
        cloud, between = read_cloud(tmp_path / "a" / name), read_cloud(snowy / name)
        row = np.full(len(original), -1)  # in the snowy cloud, where ranges are off that merged with flakes
        row[before["source"][before["source"] >= 0]] = np.flatnonzero(before["source"] >= 0)
        origin, source, hidden = truth["origin"], truth["source"], truth["hidden"]
        kept = (source >= 0) & (origin != Origin.MOVED)
        rows = np.concatenate([source[kept], truth["removed"]])
        assert np.array_equal(np.sort(rows), np.arange(len(original)))
        assert np.array_equal(cloud.xyz[kept], between.xyz[row[source[kept]]])
        gone = row[truth["removed"]]
        assert np.array_equal(truth["removed_xyz"][gone < 0], original.xyz[truth["removed"][gone < 0]])
        assert np.array_equal(truth["removed_xyz"][gone >= 0], between.xyz[gone[gone >= 0]])
        assert np.array_equal(cloud.feature[source >= 0], original.feature[source[source >= 0]])
        hides = (hidden >= 0) & (origin != Origin.MOVED)
        assert np.array_equal(cloud.ring[hides], original.ring[hidden[hides]])
        assert np.array_equal(cloud.column[hides], original.column[hidden[hides]])
        assert np.isin(hidden[hides], truth["removed"]).all()
        flakes = before["hidden"][(before["origin"] == Origin.WEATHER) & (before["hidden"] >= 0)]
        by_flakes += np.isin(hidden[origin == Origin.WEATHER], flakes).sum()
        chained += np.isin(hidden[origin == Origin.INJECTED], flakes).sum()
        seen |= set(np.unique(origin).tolist())
    assert seen == {Origin.SURFACE, Origin.WEATHER, Origin.INJECTED, Origin.MOVED}
    assert by_flakes > 100
    assert chained > 20


@pytest.mark.full
def test_an_attack_in_a_second_run_is_that_of_one_run_but_for_what_the_detector_did(plain, snowy, tmp_path):
    """Before the detector, echoes that it dropped in the first run are not there in the second."""
    apply_stages(plain, tmp_path / "once", options=ApplyOptions((*SNOW, *stages(WALL))))
    apply_stages(snowy, tmp_path / "twice", options=ApplyOptions(stages(WALL)))
    for frame, _ in clouds(plain):
        one, two = (truth_of(tmp_path / k, frame) for k in ("once", "twice"))
        for kind in (Origin.SURFACE, Origin.INJECTED):
            counts = [np.count_nonzero(t["origin"] == kind) for t in (one, two)]
            assert abs(counts[0] - counts[1]) <= 0.08 * counts[0], (kind, counts)
        assert np.setxor1d(one["removed"], two["removed"]).size <= 0.03 * len(one["removed"])


@pytest.mark.full
def test_a_drive_in_weather_can_be_attacked(scene, options, tmp_path):
    drive(scene, tmp_path / "drive", options=replace(options, stages=SNOW))
    apply_stages(tmp_path / "drive", tmp_path / "a", options=ApplyOptions(stages(f"insert:{BOX}")))
    for frame, _ in clouds(tmp_path / "a"):
        truth, before = truth_of(tmp_path / "a", frame), truth_of(tmp_path / "drive", frame)
        rows, all_rows = (
            np.concatenate([t["source"][t["source"] >= 0], t["removed"]]) for t in (truth, before)
        )
        assert np.array_equal(np.sort(rows), np.sort(all_rows))
        covered = truth["hidden"][truth["origin"] == Origin.INJECTED]
        assert np.isin(covered, np.append(before["source"], before["hidden"])).all()
    recipe = open_dataset(tmp_path / "a").manifest["recipe"]
    assert [table["name"] for table in recipe["stages"]] == ["weather"]
    assert [(table["name"], table["seed"]) for table in recipe["applied_stages"]] == [("insert", 7)]


@pytest.mark.full
def test_stages_without_an_effect_change_nothing_on_top_of_others(snowy, tmp_path):
    idle = stages("cover_glass:transmission=1", "dropped_packets:loss=0")
    apply_stages(snowy, tmp_path / "a", options=ApplyOptions(idle))
    assert files(tmp_path / "a") == files(snowy)
    for frame, _ in clouds(snowy):
        assert_same_truth(truth_of(tmp_path / "a", frame), truth_of(snowy, frame))


@pytest.mark.full
def test_replayed_clouds_are_those_without_stages(snowy, tmp_path):
    """`Situation.earlier` gives the clouds before the first stage."""
    replay = stages("replay:device=any,distance=5,width=360,seconds=0.1")
    apply_stages(snowy, tmp_path / "a", options=ApplyOptions(replay))
    truth = truth_of(tmp_path / "a", 2)
    assert np.count_nonzero(truth["origin"] == Origin.REPLAYED) > 100


@pytest.mark.full
@pytest.mark.parametrize(("folder", "name"), [("velodyne", "kitti"), ("nuscenes", "nuscenes")])
def test_clouds_of_others_twice(plain, tmp_path, folder, name):
    shutil.copytree(plain / "top" / folder, tmp_path / "in" / folder)
    first, second = ["dropped_packets:loss=0.2"], ["dropped_packets:loss=0.2", f"insert:{BOX}"]

    def apply(source, out, *texts):
        chosen = ApplyOptions(stages(*texts), sensor="vlp16")
        apply_stages(tmp_path / source, tmp_path / out, options=chosen)

    apply("in", "once", *first, *second)
    apply("in", "half", *first)
    apply("half", "twice", *second)
    assert files(tmp_path / "twice") == files(tmp_path / "once")
    for path in sorted((tmp_path / "once" / "truth" / folder).iterdir()):
        cloud = read_cloud(next((tmp_path / "in" / folder).glob(f"{path.stem}.*")), name)
        pair = [np.load(tmp_path / k / "truth" / folder / path.name) for k in ("twice", "once")]
        for part in ("origin", "source", "hidden", "removed", "removed_xyz"):
            assert np.array_equal(pair[0][part], pair[1][part]), part
        assert np.array_equal(pair[0]["removed_xyz"], cloud.xyz[pair[0]["removed"]])
    listed = json.loads((tmp_path / "twice" / "truth" / "stages.json").read_text())["stages"]
    assert [(row["name"], row["seed"]) for row in listed] == [
        ("dropped_packets", 0),
        ("dropped_packets", 0),
        ("insert", 0),
    ]


@pytest.mark.full
def test_filtered_weather_can_be_attacked(plain, snowy, tmp_path):
    """Rows that the filter removed stay listed; of them no columns are known."""
    denoise(snowy, read_methods(["dror"]), out=tmp_path / "clean")
    apply_stages(tmp_path / "clean", tmp_path / "a", options=ApplyOptions(stages(f"delete:{BOX}")))
    for frame, original in clouds(plain):
        truth, before = truth_of(tmp_path / "a", frame), truth_of(tmp_path / "clean", frame)
        assert np.array_equal(truth["filtered"], before["filtered"])
        assert len(truth["removed"]) == len(truth["removed_xyz"])
        assert truth["removed"].max() < len(original)
        assert set(before["removed"]) <= set(truth["removed"])


@pytest.mark.full
def test_a_filtered_clear_drive_keeps_a_whole_truth(plain, tmp_path):
    denoise(plain, read_methods(["dror"]), out=tmp_path / "clean")
    assert truth_of(tmp_path / "clean", 0)["removed_xyz"].shape == (0, 3)
    apply_stages(tmp_path / "clean", tmp_path / "a", options=ApplyOptions(stages(f"delete:{BOX}")))


def test_without_the_truth_of_earlier_stages_none_are_applied(snowy, tmp_path):
    shutil.copytree(snowy, tmp_path / "data")
    path = tmp_path / "data" / "top" / "truth" / "000002.npz"
    whole = path.read_bytes()
    path.unlink()
    wanted = ApplyOptions(stages(f"delete:{BOX}"))
    with pytest.raises(DatasetError, match=r"000002\.npz: missing; without the truth of earlier stages"):
        apply_stages(tmp_path / "data", tmp_path / "out", options=wanted)
    path.write_bytes(whole[:-100])
    done = run_program(
        "lidar", "apply", tmp_path / "data", "--stage", f"delete:{BOX}", "-o", tmp_path / "out"
    )
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "000002.npz" in done.stderr
    path.write_bytes((tmp_path / "data" / "top" / "truth" / "000001.npz").read_bytes())
    with pytest.raises(DatasetError, match=r"000002\.npz"):
        apply_stages(tmp_path / "data", tmp_path / "out", options=wanted)
    assert {p.name for p in tmp_path.iterdir()} == {"data"}
