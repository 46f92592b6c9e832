"""Drives and sweeps on a Dask cluster: the bytes of one process, also when workers are lost."""

import os
import signal
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from distributed import Client
from helpers.clusters import two_workers
from helpers.programs import run_program
from helpers.scenes import same_files

import geoscene.support.cluster
from geoscene.errors import InputError, MissingExtraError
from geoscene.support.cluster import connect
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.tools.sweep import sweep
from lidar.traffic.options import TrafficOptions

OPTIONS = DriveOptions(
    rig="vlp16",
    duration=3.0,
    seed=3,
    formats=("pcd", "laz"),
    settings=(("reach", "30"),),
    traffic=TrafficOptions(),
)

pytestmark = pytest.mark.filterwarnings("default:::distributed")


@pytest.fixture(scope="module")
def cluster():
    """Address of the scheduler of two worker processes."""
    with two_workers() as made:
        yield made


def pids(address):
    """Processes of the workers."""
    with Client(address, set_as_default=False) as client:
        return list(client.run(os.getpid).values())


class Killer:
    """A progress callback that kills a worker once, when some steps of a stage are done."""

    def __init__(self, address, stage):
        self.victim, self.stage, self.killed = pids(address)[0], stage, False

    def __call__(self, stage, done, *, total):
        if stage == self.stage and 0 < done < total and not self.killed:
            self.killed = True
            os.kill(self.victim, signal.SIGKILL)


def test_drive_of_which_a_worker_is_killed_has_the_bytes_of_one_process(cluster, scene, tmp_path):
    drive(scene, tmp_path / "one", options=OPTIONS)
    killer = Killer(cluster, "driving")
    summary = drive(scene, tmp_path / "many", options=replace(OPTIONS, scheduler=cluster), progress=killer)
    assert killer.killed
    assert summary.stages["scan"] > 0
    same_files(tmp_path / "one", tmp_path / "many")


def test_drive_begun_by_one_process_is_finished_by_a_cluster(cluster, scene, tmp_path):
    options = replace(OPTIONS, duration=1.0)
    drive(scene, tmp_path / "one", options=options)
    drive(scene, tmp_path / "many", options=options)
    for path in sorted((tmp_path / "many").glob("*/pcd/*.pcd"))[3:]:
        path.unlink()
    assert drive(scene, tmp_path / "many", options=replace(options, scheduler=cluster)).resumed == 3
    same_files(tmp_path / "one", tmp_path / "many")


def test_sweep_of_which_a_worker_is_killed_has_the_bytes_of_one_process(cluster, scene, tmp_path):
    file = tmp_path / "grid.toml"
    file.write_text(
        f'[drive]\nroute = "random"\nrig = "vlp16"\nduration = 0.5\n'
        f'[grid]\nscene = ["{scene.path}"]\nseed = [1, 2, 3, 4]\n'
    )
    sweep(file, tmp_path / "one")
    killer = Killer(cluster, "drives")
    done = sweep(file, tmp_path / "many", scheduler=cluster, progress=killer)
    assert killer.killed
    assert [row.state for row in done.rows] == ["done"] * 4
    same_files(tmp_path / "one", tmp_path / "many")


def test_a_worker_that_sees_other_files_is_named_before_the_start(cluster, tmp_path):
    with connect(cluster) as connection, pytest.raises(InputError, match="/proc/self/stat: worker tcp"):
        connection.check(tmp_path, inputs=[Path("/proc/self/stat")])
    assert not list(tmp_path.iterdir())


def test_errors_of_tasks_are_raised_as_they_are(cluster):
    with connect(cluster) as connection, pytest.raises(ValueError, match="invalid literal"):
        list(connection.run_tasks(int, ["1", "x"]))


@pytest.mark.full
def test_a_scheduler_that_does_not_answer_is_one_line(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(geoscene.support.cluster, "_SECONDS", 0.5)
    words = (
        "drive",
        scene.path,
        "--route",
        "random",
        "-o",
        tmp_path / "d",
        "--scheduler",
        "tcp://127.0.0.1:9",
    )
    done = run_program("lidar", *words)
    assert done.returncode == 2
    assert done.stderr.startswith("lidar: --scheduler tcp://127.0.0.1:9: no Dask scheduler answers there")
    assert not (tmp_path / "d").exists()


def test_missing_dask_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        suppress(KeyError),
        pytest.raises(MissingExtraError, match=r"geoscene\[cluster\]"),
        connect("tcp://x:1"),
    ):
        pass
