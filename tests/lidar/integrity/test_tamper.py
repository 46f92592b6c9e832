"""Replaced files and shifted time stamps: what changes, what a hash chain says, and bad input."""

import csv

import pytest
from helpers.programs import run_program

from lidar.dataset.layout import open_dataset
from lidar.errors import InputError
from lidar.integrity.keys import Hmac
from lidar.options import DriveOptions
from lidar.pipeline import drive
from lidar.sign import sign_dataset
from lidar.tamper import TRUTH, read_replacement, read_shift, tamper
from lidar.verify import verify_dataset

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
