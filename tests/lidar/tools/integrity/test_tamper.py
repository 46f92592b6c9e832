"""Replaced files and shifted time stamps: what changes, what a hash chain says, and bad input."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from helpers.programs import run_program

from lidar.dataset.formats import read_cloud
from lidar.dataset.layout import open_dataset
from lidar.dataset.truth_files import read_truth
from lidar.errors import InputError
from lidar.options import ApplyOptions, DriveOptions
from lidar.sensors.camera.png import read_png
from lidar.sensors.camera.render import CameraImage
from lidar.signal.registry import number_stages, read_stage, read_stages
from lidar.signal.run import image_past
from lidar.signal.weather.setting import read_weather
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.earlier_stages import read_past
from lidar.tools.integrity.keys import Hmac
from lidar.tools.sign import sign_dataset
from lidar.tools.tamper import TRUTH, read_replacement, read_shift, tamper
from lidar.tools.verify import verify_dataset

SMALL_RIG = """
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
"""
KEY = Hmac(b"fedcba9876543210")


@pytest.fixture(scope="module")
def signed(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("signed") / "a"
    drive(scene, out, options=DriveOptions(rig="vlp16", duration=0.5, workers=1, formats=("pcd", "laz")))
    sign_dataset(out, None, signer=KEY)
    return out


def changed(folder, other):
    paths = [path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file()]
    return [
        p.as_posix()
        for p in paths
        if p.name != TRUTH and (folder / p).read_bytes() != (other / p).read_bytes()
    ]


def test_replaced_frames_hold_others_and_are_named(signed, tmp_path):
    out = tmp_path / "b"
    done = tamper(signed, out, replacements=[read_replacement("lidar_top:2-3=0")])
    assert done.files == 4
    files = [f"lidar_top/{kind}/{k:06d}.{kind}" for kind in ("laz", "pcd") for k in (2, 3)]
    assert changed(out, signed) == files
    for kind in ("laz", "pcd"):
        for k in (2, 3):
            copy = (out / f"lidar_top/{kind}/{k:06d}.{kind}").read_bytes()
            assert copy == (signed / f"lidar_top/{kind}/{k - 2:06d}.{kind}").read_bytes()
    with (out / TRUTH).open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(row["file"] for row in rows) == files
    found = {f.place: f.detail for f in verify_dataset(out, signer=KEY).chain.findings}
    assert found == {name: f"holds frame {int(name[-10:-4]) - 2}" for name in files}


def test_a_frozen_sensor_repeats_one_frame(signed, tmp_path):
    out = tmp_path / "b"
    tamper(signed, out, replacements=[read_replacement("lidar_top:1-4=0")], freeze=True)
    first = (out / "lidar_top/pcd/000000.pcd").read_bytes()
    assert all((out / f"lidar_top/pcd/{k:06d}.pcd").read_bytes() == first for k in range(5))


def test_shifted_time_stamps_are_later_and_named(signed, tmp_path):
    out = tmp_path / "b"
    tamper(signed, out, shifts=[read_shift("lidar_top=0.05")])
    assert changed(out, signed) == ["lidar_top/timestamps.csv"]
    before, after = (open_dataset(path).sample_times("lidar_top") for path in (signed, out))
    assert (after - before == 50_000_000).all()
    stamp = (out / "lidar_top/timestamps.csv").read_text().splitlines()[1].split(",")
    assert stamp[2].endswith(".050000000Z")
    (finding,) = verify_dataset(out, signer=KEY).chain.findings
    assert (finding.what, finding.place) == ("changed", "lidar_top/timestamps.csv")


SNOW = number_stages(read_stage(one.table()) for one in read_weather("snow=10"))
BLIND = read_stages(["camera_blind:power=30"]).stages


@pytest.fixture(scope="module")
def seen(scene, tmp_path_factory):
    """A clear drive with a camera, and the same one in snow before a lamp."""
    folder = tmp_path_factory.mktemp("seen")
    rig = folder / "small.toml"
    rig.write_text(SMALL_RIG)
    options = DriveOptions(rig=str(rig), duration=0.5, workers=1, formats=("pcd", "nuscenes"))
    options = replace(options, labels=("nuscenes",))
    for name, stages in (("clear", ()), ("snowy", (*SNOW, *BLIND))):
        drive(scene, folder / name, options=replace(options, stages=stages))
    return folder / "clear", folder / "snowy"


@pytest.mark.parametrize("by", ["snowy", "clear"])
def test_the_truth_of_stages_goes_along_with_replaced_frames(seen, tmp_path, by):
    clear, snowy = seen
    other = {"snowy": snowy, "clear": clear}[by]
    out = tmp_path / "b"
    tamper(snowy, out, replacements=[read_replacement("top:3=1"), read_replacement("front:1=0")], by=other)
    before, after = (unstaged(folder, frame) for folder, frame in ((other, 1), (out, 3)))
    assert before == after
    assert unstaged(out, 2) == unstaged(snowy, 2)
    pictures = [image_without_stages(folder, frame) for folder, frame in ((other, 0), (out, 1))]
    np.testing.assert_array_equal(*pictures)


def test_stages_can_act_on_replaced_frames(seen, tmp_path):
    clear, snowy = seen
    for dataset, by in ((snowy, ""), (snowy, clear), (clear, snowy)):
        out = tmp_path / f"{dataset.name} by {by and by.name}"
        tamper(dataset, out, replacements=[read_replacement("top:2-3=0")], by=by)
        again = out.with_name(f"{out.name} again")
        apply_stages(out, again, options=ApplyOptions(read_stages(["dropped_packets:loss=0.3"]).stages))
        source = by or dataset
        assert unstaged(again, 2) == unstaged(out, 2) == unstaged(source, 0)
    assert not (tmp_path / "clear by snowy/top/truth/000001.npz").exists()


def unstaged(folder, frame):
    """Places of the returns that the scanner measured, without stages."""
    cloud = read_cloud(folder / f"top/pcd/{frame:06d}.pcd")
    past = read_past(folder / f"top/truth/{frame:06d}.npz", cloud)
    return past.original.xyz.tobytes()


def image_without_stages(folder, frame):
    rgb = read_png(folder / f"front/rgb/{frame:06d}.png")
    nothing = np.empty(0)
    truth = read_truth(folder / f"front/truth/{frame:06d}.npz")
    return image_past(CameraImage(rgb, nothing, nothing, nothing), truth).rgb


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ([], "give --replace, --shift or both"),
        (["--replace", "lidar_top"], "--replace lidar_top: give SENSOR:FIRST-LAST=SOURCE"),
        (["--replace", "lidar_top:3-2=0"], "--replace lidar_top:3-2=0: frame 2 is before frame 3"),
        (["--replace", "top:1=0"], "--replace: no sensor 'top'; there are lidar_top"),
        (["--replace", "lidar_top:9=0"], "has no frame 9 of lidar_top"),
        (["--replace", "lidar_top:1=9"], "000009.laz is missing; give other frames or another --by"),
        (["--shift", "lidar_top=soon"], "--shift lidar_top=soon: give SENSOR=SECONDS"),
        (["--shift", "lidar_top=-1"], "--shift: lidar_top would begin 1 s before the drive's start"),
        (["--shift", "lidar_top=1", "--shift", "lidar_top=2"], "--shift: lidar_top is given twice"),
        (
            ["--replace", "lidar_top:0-1=1", "--replace", "lidar_top:1=0"],
            "--replace: frame 1 of lidar_top is given twice",
        ),
        (["--shift", "gnss=1"], "--shift: no scanner, camera or inertial unit 'gnss'"),
        (["--replace", "lidar_top:1=0", "--by", "none"], "none: no dataset.json in it"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(signed, tmp_path, monkeypatch, options, says):
    monkeypatch.chdir(tmp_path)
    done = run_program("lidar", "tamper", signed, *options, "-o", "out")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert says in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["a=.", "a=1.2.3", "=1", "a=1e9", ""])
def test_times_that_are_none_are_refused(text):
    with pytest.raises(InputError, match="give SENSOR=SECONDS"):
        read_shift(text)
