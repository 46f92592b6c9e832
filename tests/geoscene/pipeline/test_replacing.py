"""Outputs that replace others: killed before any change of files, written by two processes, with backups."""

import importlib
import os
import shutil
import signal
import time
from pathlib import Path

import pytest
from helpers import ROOT
from helpers.scenes import names_in

from geoscene.errors import InputError
from geoscene.support.files import (
    atomic_file,
    atomic_folder,
    delete_leftovers,
    exclusive,
    replaced_folder,
    temporary_folder,
)

BENCHMARKS = ROOT / "benchmarks"
OLD = {"mark": "1", "a": "old", "deep/b": "old", "notes.txt": "mine", "deep/mine/c": "mine"}
NEW = {"mark": "2", "b": "new"}
KEPT = {name: text for name, text in OLD.items() if text == "mine"}


@pytest.fixture
def forked(monkeypatch):
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("forked")


@pytest.fixture
def ended():
    """Number of a process that has ended."""
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    return child


def fill(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def files_of(folder):
    return {p.relative_to(folder).as_posix(): p.read_text() for p in folder.rglob("*") if p.is_file()}


def replace(out):
    with atomic_folder(out, mark="mark", names=r"mark|[ab]|deep/b") as folder:
        fill(folder, NEW)


def test_a_folder_is_old_or_new_wherever_its_replacement_is_killed(forked, tmp_path):
    killed = 0
    for number in range(1, 40):
        out = tmp_path / str(number) / "out"
        fill(out, OLD)
        end = forked.run(lambda out=out: replace(out), within=tmp_path, die_at=number)
        if end.code == 0:
            break
        killed += end.code == -signal.SIGKILL
        if out.exists():
            found = files_of(out)
            assert found == OLD or {k: v for k, v in found.items() if v != "mine"} == NEW
        replace(out)
        assert files_of(out) == NEW | KEPT
        assert names_in(out.parent) == ["out"]
    assert killed > 10


def test_only_one_process_writes_a_folder(tmp_path):
    out, ready = tmp_path / "out", tmp_path / "ready"

    def hold():
        with exclusive(out):
            ready.touch()
            time.sleep(60)

    child = os.fork()
    if child == 0:
        hold()
        os._exit(0)
    try:
        while not ready.exists():
            time.sleep(0.01)
        with pytest.raises(InputError, match="another process is writing it"):
            replace(out)
        assert not out.exists()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    replace(out)
    assert files_of(out) == NEW
    assert names_in(tmp_path) == ["out", "ready"]


@pytest.mark.parametrize("place", [".", ".."])
def test_the_current_directory_is_not_replaced(place, tmp_path, monkeypatch):
    here = tmp_path / "out" / "in"
    fill(tmp_path / "out", OLD)
    fill(here, {"mark": "1"})
    monkeypatch.chdir(here)
    with pytest.raises(InputError, match="current directory"):
        replace(Path(place))
    assert names_in(tmp_path) == ["out"]


def test_a_file_is_not_replaced_by_a_folder(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(InputError, match="is a file"), replaced_folder(tmp_path / "out", own=lambda _: bool):
        pass
    assert files_of(tmp_path) == {"out": "mine"}


def test_leftovers_of_processes_that_ended_are_deleted_and_no_other_files(ended, tmp_path):
    gone = [f"map.laz.{ended}.part", f"map.dsm.{ended}.part.tif", f"map.laz.voxels.{ended}.part/square"]
    kept = [
        f"map.laz.{os.getpid()}.part",
        f"map2.laz.{ended}.part",
        "map.part",
        "map.laz.old",
        "map.1.partial",
    ]
    fill(tmp_path, dict.fromkeys([*gone, *kept], ""))
    with exclusive(tmp_path / "map.laz"):
        assert files_of(tmp_path).keys() == {*kept, "map.laz.lock"}
    fill(tmp_path / "deep", dict.fromkeys([*gone, *kept], ""))
    delete_leftovers(tmp_path / "deep")
    assert files_of(tmp_path / "deep").keys() == {*kept} - {f"map2.laz.{ended}.part"}


def test_a_file_that_was_killed_while_it_was_written_is_cleared_up_by_the_next(forked, tmp_path):
    def write():
        path = tmp_path / "a.bin"
        with exclusive(path), temporary_folder(path, "more") as folder, atomic_file(path) as file:
            (folder / "b").touch()
            file.write(b"half")
            os.kill(os.getpid(), signal.SIGKILL)

    assert forked.run(write, within=tmp_path).code == -signal.SIGKILL
    assert not (tmp_path / "a.bin").exists()
    assert len(names_in(tmp_path)) == 3  # file, folder and lock
    with exclusive(tmp_path / "a.bin"):
        pass
    assert names_in(tmp_path) == []


def test_a_backup_beside_a_folder_is_not_touched(tmp_path):
    fill(tmp_path / "out", OLD)
    for name in ("out.old", "out.part", "out.new"):
        shutil.copytree(tmp_path / "out", tmp_path / name)
    replace(tmp_path / "out")
    assert all(files_of(tmp_path / name) == OLD for name in ("out.old", "out.part", "out.new"))
