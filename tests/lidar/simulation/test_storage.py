"""Drives from object storage to object storage, with the bytes of local ones."""

import json

import pytest
from helpers.programs import run_program
from helpers.scenes import same_files

from geoscene.support.storage import StoredFolder, cache_folder
from lidar.dataset.layout import open_dataset

pytestmark = pytest.mark.filterwarnings("default")
OPTIONS = ("--route=random", "--duration=1", "--rig=vlp16", "--format=laz", "--traffic=on")


def lidar(*words):
    done = run_program("lidar", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_drive_and_map_through_a_bucket_have_the_bytes_of_local_ones(s3, scene, tmp_path):
    StoredFolder("s3://bucket/scene").publish(scene.path, last="scene.json")
    lidar("drive", scene.path, *OPTIONS, "-o", tmp_path / "drive")
    drive = ("drive", "s3://bucket/scene", *OPTIONS, "-o", "s3://bucket/drives/one")
    assert "next: lidar map s3://bucket/drives/one" in lidar(*drive)
    s3.get("bucket/drives/one", str(tmp_path / "fetched"), recursive=True)
    documents = [json.loads((tmp_path / name / "dataset.json").read_text()) for name in ("drive", "fetched")]
    assert [d["scene"].pop("path") for d in documents] == [str(scene.path), "s3://bucket/scene"]
    assert documents[0] == documents[1]
    for name in ("drive", "fetched"):
        (tmp_path / name / "dataset.json").unlink()
        (tmp_path / name / "checksums.sha256").unlink()  # of dataset.json, too
    same_files(tmp_path / "drive", tmp_path / "fetched")
    assert open_dataset("s3://bucket/drives/one").scene_path.name == "scene"

    first = StoredFolder("s3://bucket/drives/one").listed()
    assert "recorded before" in lidar(*drive)
    assert {n: row["LastModified"] for n, row in StoredFolder("s3://bucket/drives/one").listed().items()} == {
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
    put = StoredFolder._put
    monkeypatch.setattr(
        StoredFolder, "_put", lambda self, name, path: put(self, name, path) if "laz" in name else 1 / 0
    )
    words = ("drive", scene.path, *OPTIONS, "-o", "s3://bucket/one")
    with pytest.raises(ZeroDivisionError):
        run_program("lidar", *words)
    assert run_program("lidar", "map", "s3://bucket/one", "-o", "x.laz").stderr.startswith(
        "lidar: s3://bucket/one: is not there"
    )
    monkeypatch.setattr(StoredFolder, "_put", put)
    assert "recorded before" in lidar(*words)
    assert "dataset.json.part" not in StoredFolder("s3://bucket/one").listed()
    assert s3.exists("bucket/one/dataset.json")


RIG = """
name = "three"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
[[lidar]]
name = "rear"
preset = "vlp16"
translation = [-1.2, 0.0, 1.9]
[[camera]]
name = "front"
translation = [1.5, 0.2, 1.7]
width = 32
height = 18
fov_deg = 80.0
rate_hz = 10.0
images = ["rgb", "depth"]
"""


@pytest.fixture
def stored(s3, scene, tmp_path):  # noqa: ARG001
    """A local dataset of two scanners and a camera, and its URL."""
    (tmp_path / "three.toml").write_text(RIG)
    words = (
        "--route=random",
        "--duration=0.3",
        "--format=laz,kitti",
        "--labels=semantickitti",
        "--traffic=on",
    )
    lidar("drive", scene.path, *words, "--rig", tmp_path / "three.toml", "-o", tmp_path / "drive")
    StoredFolder("s3://bucket/drive").publish(tmp_path / "drive", last="dataset.json")
    return tmp_path / "drive", "s3://bucket/drive"


def fetched_folders():
    """Folders of frames in the cache, and their files."""
    found = {}
    for path in sorted((cache_folder() / "datasets").rglob("*")):
        place = path.relative_to(cache_folder() / "datasets").parts[1:]
        if path.is_file() and len(place) > 2:
            found.setdefault("/".join(place[:-1]), []).append(place[-1])
    return found


def test_commands_fetch_the_frames_that_they_read(stored, tmp_path):
    local, url = stored
    lidar("convert", url, "--to", "tum", "-o", tmp_path / "tum")
    assert not fetched_folders()
    lidar("map", url, "--sensor", "rear", "-o", tmp_path / "stored.laz")
    assert {name: len(files) for name, files in fetched_folders().items()} == {"rear/laz": 3, "rear/boxes": 3}
    lidar("map", local, "--sensor", "rear", "-o", tmp_path / "local.laz")
    assert (tmp_path / "stored.laz").read_bytes() == (tmp_path / "local.laz").read_bytes()
    lidar("convert", url, "--to", "kitti", "-o", tmp_path / "stored")
    lidar("convert", local, "--to", "kitti", "-o", tmp_path / "local")
    same_files(tmp_path / "stored", tmp_path / "local")
    new = {"top/velodyne", "top/labels", "front/rgb"}
    assert set(fetched_folders()) == {"rear/laz", "rear/boxes"} | new
    lidar("convert", url, "--to", "las", "-o", tmp_path / "stored_las")
    lidar("convert", local, "--to", "las", "-o", tmp_path / "local_las")
    same_files(tmp_path / "stored_las", tmp_path / "local_las")
    for words in (("apply", "--stage", "dropped_packets"), ("denoise", "--method", "dror")):
        lidar(*words, url, "-o", tmp_path / f"stored_{words[0]}")
        lidar(*words, local, "-o", tmp_path / f"local_{words[0]}")
        same_files(tmp_path / f"stored_{words[0]}", tmp_path / f"local_{words[0]}")


def test_frames_that_changed_in_storage_are_fetched_again(s3, stored, tmp_path):
    local, url = stored
    lidar("map", url, "-o", tmp_path / "first.laz")
    s3.rm_file("bucket/drive/top/laz/000001.laz")
    s3.put_file(str(local / "top" / "laz" / "000000.laz"), "bucket/drive/top/laz/000002.laz")
    (local / "top" / "laz" / "000001.laz").unlink()
    (local / "top" / "laz" / "000002.laz").write_bytes((local / "top" / "laz" / "000000.laz").read_bytes())
    for name, source in (("stored", url), ("local", local)):
        assert run_program("lidar", "map", source, "-o", tmp_path / f"{name}.laz").returncode == 0
    assert (tmp_path / "stored.laz").read_bytes() == (tmp_path / "local.laz").read_bytes()
