"""Scenes in object storage: fetched tile by tile, published whole or not at all."""

import shutil
import sys

import fsspec
import pytest
from helpers.programs import run_program
from helpers.scenes import same_files

from geoscene.errors import InputError, MissingExtraError, SceneFormatError, StorageError
from geoscene.scene import open_scene
from geoscene.scene.layout import changed_files
from geoscene.support.storage import StoredFolder, cache_folder, publish, url_of

pytestmark = [pytest.mark.filterwarnings("default"), pytest.mark.usefixtures("home")]
BOX = "--bbox=24.9425,60.1665,24.9465,60.1690"


@pytest.fixture
def memory():
    """The file system of memory:// URLs, empty."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    return system


@pytest.mark.parametrize(
    ("given", "url"),
    [
        ("s3://bucket/scene", "s3://bucket/scene"),
        ("s3:/bucket/scene/", "s3://bucket/scene"),
        ("file:/tmp/scene", "file:///tmp/scene"),
        ("file:///tmp/scene", "file:///tmp/scene"),
        ("scene", ""),
        ("/a/s3/b", ""),
        ("C:/scene", ""),
    ],
)
def test_urls_are_recognised_as_paths_of_pathlib_too(given, url):
    assert url_of(given) == url


@pytest.mark.usefixtures("memory")
@pytest.mark.parametrize("place", ["memory://bucket/scene", "file://{tmp}/there/scene"])
def test_published_scene_is_fetched_as_it_was(place, scene, tmp_path):
    url = place.format(tmp=tmp_path)
    StoredFolder(url).publish(scene.path, last="scene.json")
    opened = open_scene(url)
    assert opened.location == url
    for tile in opened.tiles():
        assert len(tile.mesh)
    _ = opened.features("buildings"), opened.road_graph(), opened.shapes(), opened.files.problems
    same_files(scene.path, opened.path)
    assert not changed_files(opened)


@pytest.mark.usefixtures("memory")
def test_only_files_that_are_read_are_fetched(scene):
    StoredFolder("memory://bucket/scene").publish(scene.path, last="scene.json")
    opened = open_scene("memory://bucket/scene")
    assert {path.name for path in opened.path.iterdir()} == {"scene.json", "tiles.json"}
    i, j = opened.tile_indices[1]
    opened.tile(i, j)
    assert [path.name for path in (opened.path / "tiles").iterdir()] == [f"{i}_{j}.npz"]


def test_tile_of_another_build_is_refused(scene, memory):
    StoredFolder("memory://bucket/scene").publish(scene.path, last="scene.json")
    i, j = scene.tile_indices[0]
    memory.pipe_file(f"/bucket/scene/tiles/{i}_{j}.npz", b"other")
    opened = open_scene("memory://bucket/scene")
    with pytest.raises(StorageError, match=f"{i}_{j}.npz: differs from what the build wrote"):
        opened.tile(i, j)
    assert not opened.path.joinpath("tiles", f"{i}_{j}.npz").exists()


@pytest.mark.usefixtures("memory")
def test_interrupted_upload_is_no_scene_and_is_completed(scene, monkeypatch):
    stored, put = StoredFolder("memory://bucket/scene"), StoredFolder._put
    sent = []

    def failing(self, name, path):
        if len(sent) > 4:
            raise StorageError("the connection is lost")
        sent.append(name)
        put(self, name, path)

    monkeypatch.setattr(StoredFolder, "_put", failing)
    with pytest.raises(StorageError, match="lost"):
        stored.publish(scene.path, last="scene.json")
    assert "scene.json" not in stored.listed()
    with pytest.raises(StorageError, match="is not there"):
        open_scene(stored.url)
    again = []
    monkeypatch.setattr(
        StoredFolder, "_put", lambda self, name, path: (again.append(name), put(self, name, path))[1]
    )
    stored.publish(scene.path, last="scene.json")
    assert not set(again) & set(sent)
    assert again[-1] == "scene.json"
    assert set(stored.listed()) == {p.relative_to(scene.path).as_posix() for p in scene.path.rglob("*.*")}


def test_file_of_an_interrupted_upload_that_the_next_one_lacks_is_removed(
    scene, memory, tmp_path, monkeypatch
):
    folder = tmp_path / "scene"
    shutil.copytree(scene.path, folder)
    (folder / "tiles" / "99_99.npz").write_bytes(b"of other options")
    put = StoredFolder._put
    monkeypatch.setattr(
        StoredFolder,
        "_put",
        lambda self, name, path: put(self, name, path) if name != "scene.json" else 1 / 0,
    )
    with pytest.raises(ZeroDivisionError):
        StoredFolder("memory://bucket/scene").publish(folder, last="scene.json")
    monkeypatch.setattr(StoredFolder, "_put", put)
    memory.pipe_file("/bucket/scene/notes.txt", b"of others")
    StoredFolder("memory://bucket/scene").publish(scene.path, last="scene.json")
    names = set(StoredFolder("memory://bucket/scene").listed())
    assert "tiles/99_99.npz" not in names
    assert {"scene.json", "notes.txt"} <= names
    assert "scene.json.part" not in names


def test_build_into_a_bucket_has_the_bytes_of_a_local_one(s3, tmp_path):
    assert (
        run_program("geoscene", "build", "--demo", BOX, "--workers=1", "-o", tmp_path / "scene").returncode
        == 0
    )
    words = ("build", "--demo", BOX, "--workers=1", "-o", "s3://bucket/scenes/scene")
    done = run_program("geoscene", *words)
    assert done.returncode == 0, done.stderr
    assert "lidar drive s3://bucket/scenes/scene" in done.stdout
    s3.get("bucket/scenes/scene", str(tmp_path / "fetched"), recursive=True)
    same_files(tmp_path / "scene", tmp_path / "fetched")
    assert not list((cache_folder() / "spool").iterdir())
    again = run_program("geoscene", *words)
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
    assert "s3://bucket/scenes/scene: holds scene.json; set --overwrite" in again.stderr
    other = run_program("geoscene", *words, "--lod", "1", "--overwrite")
    assert other.returncode == 0, other.stderr
    assert '"lod": 1' in run_program("geoscene", "info", "s3://bucket/scenes/scene", "--json").stdout
    assert run_program("geoscene", "validate", "s3://bucket/scenes/scene").returncode == 0
    glb = run_program("geoscene", "export", "s3://bucket/scenes/scene", "-o", tmp_path / "scene.glb")
    assert glb.returncode == 0, glb.stderr


def test_folder_of_others_is_refused(memory):
    memory.pipe_file("/bucket/data/notes.txt", b"of others")
    with (
        pytest.raises(InputError, match=r"memory://bucket/data: is not empty and holds no scene\.json"),
        publish("memory://bucket/data", last="scene.json", replaces=True),
    ):
        pass


@pytest.mark.usefixtures("s3")
def test_bucket_that_is_not_there_is_one_line():
    done = run_program("geoscene", "build", "--demo", BOX, "-o", "s3://missing/scene")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "geoscene: s3://missing/scene: is not there" in done.stderr
    assert "s3://missing/scene" in run_program("geoscene", "info", "s3://missing/scene").stderr


def test_server_that_does_not_answer_is_one_line(s3, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    s3.clear_instance_cache()
    done = run_program("geoscene", "info", "s3://bucket/scene")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "geoscene: s3://bucket/scene: cannot be reached" in done.stderr


def test_missing_credentials_are_one_line(s3, monkeypatch):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    s3.clear_instance_cache()
    done = run_program("geoscene", "build", "--demo", BOX, "-o", "s3://bucket/scene")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "credentials" in done.stderr


def test_missing_packages_are_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    for name in ("s3", "gs"):
        monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, name, raising=False)
    with pytest.raises(MissingExtraError, match=r"s3://.*pip install 'geoscene\[cloud\]'"):
        open_scene("s3://bucket/scene")
    with pytest.raises(MissingExtraError, match="pip install gcsfs"):
        open_scene("gs://bucket/scene")
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[cloud\]"):
        open_scene("s3://bucket/scene")


def test_unknown_storage_names_those_that_are_known():
    with pytest.raises(InputError, match="there are s3://, gs:// and file://"):
        open_scene("nowhere://bucket/scene")


@pytest.mark.parametrize(
    "words", [("geoscene", "build", "--demo"), ("lidar", "drive", "scene", "--route=random")]
)
def test_url_without_a_folder_is_refused_before_any_work(words, tmp_path):
    done = run_program(*words, "-o", "s3://", cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "s3://: names no folder" in done.stderr
    assert not list(tmp_path.iterdir())


def test_local_folders_are_written_as_they_are(tmp_path):
    with publish(tmp_path / "scene", last="scene.json", replaces=False) as folder:
        assert folder == tmp_path / "scene"
    with pytest.raises(SceneFormatError, match="no such scene directory"):
        open_scene(tmp_path / "scene")


@pytest.mark.parametrize(
    "words",
    [
        ("geoscene", "export", "scene", "-o", "s3://bucket/city.glb"),
        ("geoscene", "view", "scene", "-o", "s3://bucket/page.html"),
        ("lidar", "map", "drive", "-o", "s3://bucket/map.laz"),
        ("lidar", "sweep", "grid.toml", "-o", "s3://bucket/drives"),
    ],
)
def test_outputs_that_are_not_published_are_refused(words, tmp_path):
    done = run_program(*words, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert f"--out {words[-1]}: only geoscene build and lidar drive write to object storage" in done.stderr
    assert not list(tmp_path.iterdir())
