"""Drives from object storage to object storage, with the bytes of local ones."""

import json

import pytest
from helpers.programs import run_program
from helpers.scenes import same_files

from geoscene.storage import Stored, cache_folder
from lidar.dataset.layout import open_dataset

pytestmark = pytest.mark.filterwarnings("default")
OPTIONS = ("--route=random", "--duration=1", "--rig=vlp16", "--format=laz", "--traffic=on")


def lidar(*words):
    done = run_program("lidar", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_drive_and_map_through_a_bucket_have_the_bytes_of_local_ones(s3, scene, tmp_path):
    Stored("s3://bucket/scene").publish(scene.path, last="scene.json")
    lidar("drive", scene.path, *OPTIONS, "-o", tmp_path / "drive")
    drive = ("drive", "s3://bucket/scene", *OPTIONS, "-o", "s3://bucket/drives/one")
    assert "next: lidar map s3://bucket/drives/one" in lidar(*drive)
    s3.get("bucket/drives/one", str(tmp_path / "fetched"), recursive=True)
    documents = [json.loads((tmp_path / name / "dataset.json").read_text()) for name in ("drive", "fetched")]
    assert [d["scene"].pop("path") for d in documents] == [str(scene.path), "s3://bucket/scene"]
    assert documents[0] == documents[1]
    for name in ("drive", "fetched"):
        (tmp_path / name / "dataset.json").unlink()
    same_files(tmp_path / "drive", tmp_path / "fetched")
    assert open_dataset("s3://bucket/drives/one").scene_path.name == "scene"

    first = Stored("s3://bucket/drives/one").listed()
    assert "recorded before" in lidar(*drive)
    assert {n: row["LastModified"] for n, row in Stored("s3://bucket/drives/one").listed().items()} == {
        n: row["LastModified"] for n, row in first.items()
    }
    lidar("drive", "s3://bucket/scene", *OPTIONS, "-o", tmp_path / "local")
    lidar("map", "s3://bucket/drives/one", "-o", tmp_path / "stored.laz")
    lidar("map", tmp_path / "local", "-o", tmp_path / "local.laz")
    assert (tmp_path / "stored.laz").read_bytes() == (tmp_path / "local.laz").read_bytes()


def test_drive_with_other_options_is_refused_and_replaced_on_request(s3, scene, tmp_path):
    drive = ("drive", scene.path, "--route=random", "--rig=vlp16", "-o", "s3://bucket/one")
    lidar(*drive, "--duration=1")
    s3.pipe_file("bucket/one/notes.txt", b"of others")
    done = run_program("lidar", *drive, "--duration=0.3")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "lidar: s3://bucket/one: holds a drive made with other options: duration" in done.stderr
    assert not list((cache_folder() / "spool").iterdir())
    lidar(*drive, "--duration=0.3", "--overwrite")
    lidar("drive", scene.path, "--route=random", "--rig=vlp16", "-o", tmp_path / "one", "--duration=0.3")
    s3.rm_file("bucket/one/notes.txt")
    s3.get("bucket/one", str(tmp_path / "fetched"), recursive=True)
    same_files(tmp_path / "one", tmp_path / "fetched")


def test_dataset_whose_upload_was_interrupted_is_no_dataset(s3, scene, monkeypatch):
    put = Stored._put
    monkeypatch.setattr(
        Stored, "_put", lambda self, name, path: put(self, name, path) if "laz" in name else 1 / 0
    )
    words = ("drive", scene.path, *OPTIONS, "-o", "s3://bucket/one")
    with pytest.raises(ZeroDivisionError):
        run_program("lidar", *words)
    assert run_program("lidar", "map", "s3://bucket/one", "-o", "x.laz").stderr.startswith(
        "lidar: s3://bucket/one: is not there"
    )
    monkeypatch.setattr(Stored, "_put", put)
    assert "recorded before" in lidar(*words)
    assert "dataset.json.part" not in Stored("s3://bucket/one").listed()
    assert s3.exists("bucket/one/dataset.json")
