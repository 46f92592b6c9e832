"""Builds on a Dask cluster: the bytes of one process, also when a worker is lost."""

import os
import signal

import pytest
from distributed import Client
from helpers.clusters import two_workers
from helpers.programs import run_program
from helpers.scenes import same_files

from geoscene.errors import InputError
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import demo_path, read_osm
from geoscene.support.cluster import connect

OPTIONS = BuildOptions(name="demo", tile_size=50.0)

pytestmark = pytest.mark.filterwarnings("default:::distributed")


@pytest.fixture(scope="module")
def address():
    """Address of the scheduler of two worker processes."""
    with two_workers() as made:
        yield made


@pytest.fixture(scope="module")
def osm():
    return read_osm(demo_path(), bounds=(24.9405, 60.1662, 24.9465, 60.1690))


def test_build_of_which_a_worker_is_killed_has_the_bytes_of_one_process(address, osm, tmp_path):
    build(osm, tmp_path / "one", options=OPTIONS)
    with Client(address, set_as_default=False) as client:
        victim = next(iter(client.run(os.getpid).values()))
    done = []

    def kill(stage, count, *, total):
        if stage == "tiles" and 0 < count < total and not done:
            done.append(count)
            os.kill(victim, signal.SIGKILL)

    with connect(address) as cluster:
        build(osm, tmp_path / "many", options=OPTIONS, cluster=cluster, progress=kill)
    assert done
    same_files(tmp_path / "one", tmp_path / "many")


def test_rebuild_on_a_cluster_reuses_tiles(address, osm, tmp_path):
    build(osm, tmp_path / "one", options=BuildOptions(lod=1))
    build(osm, tmp_path / "many", options=BuildOptions(lod=2))
    with connect(address) as cluster:
        build(osm, tmp_path / "many", options=BuildOptions(lod=1), cluster=cluster, overwrite=True)
    same_files(tmp_path / "one", tmp_path / "many")


def test_a_worker_that_does_not_see_the_folder_is_named_before_planning(address, osm, tmp_path, monkeypatch):
    monkeypatch.setattr("geoscene.pipeline.build.make_plan", lambda *_, **__: pytest.fail("planned"))
    monkeypatch.setattr("geoscene.support.cluster.file_digest", lambda _: "what this process sees")
    with (
        connect(address) as cluster,
        pytest.raises(InputError, match=r"scene\.part: worker tcp.* does not see"),
    ):
        build(osm, tmp_path / "scene", cluster=cluster)
    assert not list(tmp_path.iterdir())


def test_workers_with_other_sources_are_refused_before_planning(address, osm, tmp_path, monkeypatch):
    monkeypatch.setattr("geoscene.support.cluster.sources_digest", lambda _: "of this process")
    with (
        connect(address) as cluster,
        pytest.raises(InputError, match=r"tcp.* are not those of this program"),
    ):
        build(osm, tmp_path / "scene", cluster=cluster)
    assert not list(tmp_path.iterdir())


def test_program_names_a_scheduler_that_does_not_answer(tmp_path, monkeypatch):
    monkeypatch.setattr("geoscene.support.cluster._SECONDS", 0.5)
    done = run_program(
        "geoscene", "build", "--demo", "-o", tmp_path / "s", "--scheduler", "tcp://127.0.0.1:9"
    )
    assert done.returncode == 2
    assert done.stderr.startswith("geoscene: --scheduler tcp://127.0.0.1:9: no Dask scheduler answers there")
    assert not (tmp_path / "s").exists()
