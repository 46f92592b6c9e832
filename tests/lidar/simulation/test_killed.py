"""Drives, maps and signatures that are killed, fail or are made by two processes at once."""

import importlib
import json
import os
import shutil
import signal
from dataclasses import replace
from functools import partial

import pytest
from helpers import ROOT
from helpers.scenes import names_in, same_files

from geoscene.errors import NotWrittenError
from geoscene.support.files import exclusive
from lidar.dataset.derived import copy_folder
from lidar.dataset.layout import open_dataset, remove_dataset
from lidar.errors import LidarError
from lidar.options.drive import DriveOptions
from lidar.simulation import drive as pipeline
from lidar.simulation.drive import drive
from lidar.tools.integrity.keys import read_signer
from lidar.tools.maps import aggregate as maps
from lidar.tools.sign import sign_dataset

BENCHMARKS = ROOT / "benchmarks"
OPTIONS = DriveOptions(rig="vlp16", duration=0.3, seed=3, formats=("pcd",))


@pytest.fixture
def forked(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("forked")


@pytest.fixture(scope="module")
def dataset(scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("drive") / "data"
    drive(scene, out, options=OPTIONS)
    return open_dataset(out)


@pytest.fixture
def copy(dataset, tmp_path):
    shutil.copytree(dataset.path, tmp_path / "data")
    return open_dataset(tmp_path / "data")


@pytest.fixture
def key(tmp_path_factory):
    path = tmp_path_factory.mktemp("key") / "key"
    path.write_text("5f" * 32)
    return read_signer(path)


@pytest.mark.parametrize("number", [2, 3, 4, 6, 9])
def test_a_drive_that_is_killed_while_it_begins_can_be_resumed(forked, scene, dataset, number, tmp_path):
    out = tmp_path / "data"
    work = partial(drive, scene, out, options=OPTIONS)
    assert forked.run(work, within=tmp_path, die_at=number).code == -signal.SIGKILL
    assert forked.run(work, within=tmp_path).code == 0
    same_files(out, dataset.path)
    assert names_in(tmp_path) == ["data"]


@pytest.mark.parametrize("number", [4, 5, 6, 12])
def test_a_drive_that_is_killed_while_it_is_deleted_counts_as_not_finished(forked, copy, number, tmp_path):
    work = partial(remove_dataset, copy.path)
    assert forked.run(work, within=tmp_path, die_at=number).code == -signal.SIGKILL
    finished = json.loads(copy.paths.manifest.read_text())["frames_done"] == copy.frames
    assert finished == (number == 4)  # the rename of the manifest


def test_a_drive_that_fails_before_its_first_frame_keeps_the_files_of_others(scene, copy, monkeypatch):
    (copy.path / "notes.txt").write_text("mine")

    def failing(*_, **__):
        raise LidarError("a failure")

    monkeypatch.setattr(pipeline, "record_all", failing)
    with pytest.raises(LidarError, match="a failure"):
        drive(scene, copy.path, options=OPTIONS, overwrite=True)
    assert [path.name for path in copy.path.rglob("*") if path.is_file()] == ["notes.txt"]


def test_a_drive_that_another_process_records_is_not_deleted(scene, dataset, copy):
    child = os.fork()
    if child == 0:
        with exclusive(copy.path):
            signal.pause()
    try:
        while not copy.path.with_name("data.lock").exists():
            pass
        with pytest.raises(ValueError, match="another process is writing it"):
            drive(scene, copy.path, options=replace(OPTIONS, seed=4), overwrite=True)
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    same_files(copy.path, dataset.path)


@pytest.mark.gate
def test_a_map_appears_after_the_files_beside_it(dataset, tmp_path, monkeypatch):
    write = maps.write_map_provenance

    def checked(given, out):
        assert not out.exists()
        write(given, out)

    monkeypatch.setattr(maps, "write_map_provenance", checked)
    maps.aggregate(dataset, tmp_path / "map.laz")
    assert names_in(tmp_path) == ["map.laz", "map.laz.provenance.json"]


def test_signing_that_was_killed_begins_again(forked, dataset, copy, key, tmp_path):
    work = partial(sign_dataset, copy.path, None, signer=key)
    whole = tmp_path / "whole"
    shutil.copytree(dataset.path, whole)
    changes = forked.run(partial(sign_dataset, whole, None, signer=key), within=whole).changes
    for number in range(1, changes + 1):
        assert forked.run(work, within=copy.path, die_at=number).code == -signal.SIGKILL
        assert not copy.paths.chain.exists()
    work()
    same_files(copy.path, whole)


def test_a_drive_is_deleted_by_whoever_comes_after_a_kill(forked, dataset, copy, tmp_path):
    """The file that names the sensors' folders goes after what is in them."""
    changes = forked.run(partial(remove_dataset, copy.path), within=tmp_path).changes
    shutil.copytree(dataset.path, copy.path, dirs_exist_ok=True)
    for number in range(changes, 0, -4):
        ended = forked.run(partial(remove_dataset, copy.path), within=tmp_path, die_at=number)
        assert ended.code == -signal.SIGKILL
        remove_dataset(copy.path)
        assert not copy.path.exists() or names_in(copy.path) == []
        shutil.copytree(dataset.path, copy.path, dirs_exist_ok=True)


@pytest.mark.gate
def test_a_file_that_cannot_be_copied_is_named_in_one_line(copy, tmp_path):
    (copy.path / "lidar_top" / "pcd" / "000001.pcd").unlink()
    (copy.path / "lidar_top" / "pcd" / "000001.pcd").symlink_to(tmp_path / "gone")
    with pytest.raises(NotWrittenError, match=r"000001\.pcd: cannot be copied \(.*No such file") as error:
        copy_folder(copy.path, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300
