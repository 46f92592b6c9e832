"""Checksums: any change of any file is named, other programs read them, and provenance goes with the data."""

import hashlib
import json
import os
import shutil
import subprocess

import pytest
from helpers.programs import run_program
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lidar.dataset.checksums import (
    CHECKSUMS,
    add_to_checksums,
    folder_digest,
    read_checksums,
    write_checksums,
)
from lidar.dataset.layout import open_dataset
from lidar.dataset.layouts import EXPORTERS
from lidar.errors import DatasetError
from lidar.options.data import ApplyOptions
from lidar.options.drive import DriveOptions
from lidar.signal.registry import read_stages
from lidar.simulation.drive import drive
from lidar.tools.apply import apply_stages
from lidar.tools.denoise.denoise import denoise
from lidar.tools.denoise.filters import read_methods
from lidar.tools.integrity.keys import Hmac
from lidar.tools.integrity.watermark import WatermarkKey
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.sign import sign_dataset
from lidar.tools.verify import verify_dataset

KEY, MARK = Hmac(b"fedcba9876543210"), WatermarkKey(b"0123456789abcdef")
OPTIONS = DriveOptions(rig="vlp16", duration=0.3, seed=3, formats=("pcd", "kitti"), workers=1)
LOSSY = ApplyOptions(stages=read_stages(["dropped_packets:loss=0.1"]).stages)


@pytest.fixture(scope="module")
def driven(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("driven") / "drive"
    drive(scene, out, options=OPTIONS)
    return out


@pytest.fixture(scope="module")
def signed(driven, tmp_path_factory):
    """A dataset with all kinds of files: truth of stages, and a signature."""
    folder = tmp_path_factory.mktemp("signed")
    apply_stages(driven, folder / "lossy", options=LOSSY)
    sign_dataset(folder / "lossy", folder / "signed", watermark=MARK, signer=KEY)
    return folder / "signed"


@pytest.fixture
def copy(signed, tmp_path):
    return shutil.copytree(signed, tmp_path / "copy")


def named(folder):
    return {finding.place: finding.what for finding in verify_dataset(folder).checksums.findings}


def names_in(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_flipped_byte_of_any_file_is_named(copy, data):
    files = sorted(path for path in copy.rglob("*") if path.is_file() and path.stat().st_size)
    path = data.draw(st.sampled_from([*files, copy / CHECKSUMS]))
    before = path.read_bytes()
    after = bytearray(before)
    after[data.draw(st.integers(0, len(before) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(after)
    found = named(copy)
    path.write_bytes(before)
    name = path.relative_to(copy).as_posix()
    assert found[name] == "changed"
    assert name == CHECKSUMS or set(found) == {name}
    assert verify_dataset(copy).intact


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_missing_and_an_added_file_are_named(copy, data):
    path = data.draw(st.sampled_from(sorted(copy / name for name in names_in(copy))))
    moved = path.with_name(f"{path.name}.{data.draw(st.sampled_from(['bak', 'part', '0']))}")
    path.rename(moved)
    found = named(copy)
    moved.rename(path)
    name = path.relative_to(copy).as_posix()
    assert found[name] == "missing"
    assert name == CHECKSUMS or found == {name: "missing", moved.relative_to(copy).as_posix(): "added"}


def test_sha256sum_reads_the_checksums_and_finds_the_same_damage(copy):
    check = ["sha256sum", "--check", "--strict", "--quiet", CHECKSUMS]
    assert subprocess.run(check, cwd=copy, check=False).returncode == 0
    (copy / "poses.csv").write_bytes(b"none")
    done = subprocess.run(check, cwd=copy, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == ["poses.csv: FAILED"]


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(names=st.sets(st.binary(min_size=1, max_size=9).filter(lambda n: not {0, 47} & {*n}), min_size=1))
def test_checksums_hold_file_names_of_any_bytes(tmp_path, names):
    folder = tmp_path / "names"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    names -= {b".", b"..", CHECKSUMS.encode()}
    for name in names:
        (folder / os.fsdecode(name)).write_bytes(name)
    write_checksums(folder)
    stated = read_checksums(folder / CHECKSUMS)
    assert stated.intact
    assert stated.sha256 == {os.fsdecode(name): hashlib.sha256(name).digest() for name in names}
    done = subprocess.run(["sha256sum", "-c", "--status", CHECKSUMS], cwd=folder, check=False)
    assert done.returncode == 0 or not names


def test_a_link_in_the_place_of_a_file_and_a_pipe_are_named(copy, tmp_path):
    (copy / "poses.csv").rename(tmp_path / "poses.csv")
    (copy / "poses.csv").symlink_to(tmp_path / "gone.csv")
    os.mkfifo(copy / "pipe")
    (copy / "frames.csv").unlink(missing_ok=True)
    os.mkfifo(copy / "frames.csv")
    found = named(copy)
    assert found["poses.csv"] == "changed"
    assert found["pipe"] == "added"


def test_a_resumed_drive_has_the_checksums_of_an_uninterrupted_one(scene, driven, tmp_path):
    again = shutil.copytree(driven, tmp_path / "again")
    (again / CHECKSUMS).unlink()
    manifest = json.loads((again / "dataset.json").read_text())
    (again / "dataset.json").write_text(json.dumps(manifest | {"frames_done": 0}))
    (again / "lidar_top/pcd/000001.pcd").unlink()
    with pytest.raises(DatasetError, match="was not finished; the same lidar drive command resumes it"):
        verify_dataset(again)
    drive(scene, again, options=OPTIONS)
    assert (again / CHECKSUMS).read_bytes() == (driven / CHECKSUMS).read_bytes()
    assert verify_dataset(again).intact
    assert set(read_checksums(again / CHECKSUMS).sha256) == names_in(driven) - {CHECKSUMS}


def test_files_of_others_beside_a_drive_are_not_in_its_checksums(scene, driven, tmp_path):
    again = shutil.copytree(driven, tmp_path / "again")
    (again / "notes.txt").write_text("mine")
    drive(scene, again, options=OPTIONS)
    assert (again / CHECKSUMS).read_bytes() == (driven / CHECKSUMS).read_bytes()
    assert named(again) == {"notes.txt": "added"}


@pytest.mark.full
def test_what_is_made_from_a_dataset_names_it_and_has_its_sources(driven, signed, tmp_path):
    first = folder_digest(driven)
    assert first == read_checksums(driven / CHECKSUMS).digest
    manifest = open_dataset(driven).manifest
    assert manifest["licence"] == "ODbL-1.0"
    assert "OpenStreetMap" in manifest["sources"][0]["attribution"]
    assert len(manifest["scene"]["digest"]) == 20
    assert manifest["versions"]["numpy"]

    steps = open_dataset(signed).manifest["derived_from"]
    assert [step["by"] for step in steps] == ["lidar apply", "lidar sign"]
    assert steps[0]["from"] == first
    assert steps[1]["from"] == folder_digest(signed.with_name("lossy"))

    denoise(driven, read_methods(["dror"]), out=tmp_path / "clean")
    assert open_dataset(tmp_path / "clean").manifest["derived_from"] == [
        {"by": "lidar denoise", "from": first}
    ]
    for name in ("sources", "licence", "attribution", "scene", "versions", "seed"):
        assert open_dataset(tmp_path / "clean").manifest[name] == manifest[name]

    aggregate(open_dataset(driven), tmp_path / "map.ply")
    known = json.loads((tmp_path / "map.ply.provenance.json").read_text())
    assert known["attribution"] == manifest["attribution"]
    assert known["derived_from"] == [{"by": "lidar map", "from": first}]

    EXPORTERS["kitti"].export(open_dataset(driven), tmp_path / "kitti")
    known = json.loads((tmp_path / "kitti/provenance.json").read_text())
    assert known["sources"] == manifest["sources"]
    assert known["derived_from"] == [{"by": "lidar convert --to kitti", "from": first}]
    apply_stages(tmp_path / "kitti", tmp_path / "lossy", options=LOSSY)
    known = json.loads((tmp_path / "lossy/provenance.json").read_text())
    assert [step["by"] for step in known["derived_from"]] == ["lidar convert --to kitti", "lidar apply"]
    assert known["derived_from"][1]["from"] == folder_digest(tmp_path / "kitti")
    assert known["attribution"] == manifest["attribution"]
    for folder in ("clean", "kitti", "lossy"):
        assert verify_dataset(tmp_path / folder).intact


def test_a_signature_joins_the_checksums_without_hiding_damage(driven, tmp_path):
    copy = shutil.copytree(driven, tmp_path / "copy")
    (copy / "poses.csv").write_text((copy / "poses.csv").read_text() + "\n")
    (copy / "gnss.csv").unlink()
    sign_dataset(copy, None, signer=KEY)
    assert named(copy) == {"poses.csv": "changed", "gnss.csv": "missing"}
    (copy / "integrity/chain.json").write_text("{}")
    assert "integrity/chain.json" in named(copy)
    (copy / CHECKSUMS).unlink()
    add_to_checksums(copy, below="integrity", known={})
    assert not (copy / CHECKSUMS).exists()


def test_verify_prints_a_line_for_each_file_and_exits_with_1(copy):
    assert run_program("lidar", "verify", copy).returncode == 0
    (copy / "poses.csv").unlink()
    (copy / "notes.txt").write_text("mine")
    done = run_program("lidar", "verify", copy)
    assert done.returncode == 1
    assert done.stdout.splitlines()[:2] == ["notes.txt: added", "poses.csv: missing"]
    document = json.loads(run_program("lidar", "verify", copy, "--json").stdout)
    assert [f["place"] for f in document["checksums"]["findings"]] == ["notes.txt", "poses.csv"]
    (copy / CHECKSUMS).unlink()
    done = run_program("lidar", "verify", copy)
    assert (done.returncode, done.stdout.split(": ")[0]) == (1, CHECKSUMS)


def test_verify_of_another_folder_says_what_it_is(scene, driven, tmp_path):
    (tmp_path / "empty").mkdir()
    for folder, words in (
        (scene.path, "is a scene; geoscene validate checks it"),
        (tmp_path / "none", "is not there"),
        (tmp_path / "empty", f"has no {CHECKSUMS}"),
        (driven / "dataset.json", "is a file"),
    ):
        done = run_program("lidar", "verify", folder)
        assert (done.returncode, done.stdout) == (2, "")
        assert words in done.stderr
        assert done.stderr.count("\n") == 1


def test_checksums_of_a_dataset_in_storage_are_compared(driven, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    shutil.copytree(driven, tmp_path / "store")
    url = f"file://{tmp_path}/store"
    assert run_program("lidar", "verify", url).returncode == 0
    (tmp_path / "store/lidar_top/pcd/000000.pcd").write_bytes(b"cut")
    done = run_program("lidar", "verify", url)
    assert (done.returncode, done.stdout.splitlines()[0]) == (1, "lidar_top/pcd/000000.pcd: changed")


def test_findings_are_counted_in_words(copy):
    (copy / "poses.csv").write_bytes(b"none")
    assert verify_dataset(copy).to_text("a")[-1].endswith(": 1 finding")
    (copy / "trajectory.csv").unlink()
    assert verify_dataset(copy).to_text("a")[-1].endswith(": 2 findings")
