"""Machine code of compiled functions is kept as long as what it was made from; lists name real functions."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import config

from geoscene.export import raster
from geoscene.support import compiled, kernels

COUNTED = """
import numpy as np
from numba.core.event import install_recorder
from geoscene.export.raster import draw_triangles

with install_recorder("numba:compile") as events:
    height, labels = np.full((3, 3), np.nan, np.float32), np.zeros((3, 3), np.uint8)
    draw_triangles(np.zeros((1, 3, 3)), np.ones(1, np.uint8), height, labels)
print(len(events.buffer) // 2)
"""

LISTED = kernels.read_kernels()


def compilations(folder):
    """How many functions a new process compiles to draw a triangle, with code kept in a folder."""
    environment = {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": ":".join(sys.path)}
    words = [sys.executable, "-c", COUNTED]
    return int(subprocess.run(words, env=environment, capture_output=True, check=True, text=True).stdout)


def test_a_second_process_compiles_nothing(tmp_path):
    assert compilations(tmp_path) > 0
    assert compilations(tmp_path) == 0


def loaded(name, path, text):
    """A module of the package `lidar` from source text, imported anew."""
    path.write_text(text)
    spec = importlib.util.spec_from_file_location(name, path)
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def made_up_modules(monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield
    for name in ("lidar.made_up_inner", "lidar.made_up_outer"):
        sys.modules.pop(name, None)


INNER = """
from geoscene.support.compiled import njit

FACTOR = 2.0

@njit()
def twice(x):
    return FACTOR * x
"""
OUTER = """
from geoscene.support.compiled import njit
from lidar.made_up_inner import {names}

@njit()
def more(x):
    return {text}
"""


@pytest.mark.usefixtures("made_up_modules")
@pytest.mark.parametrize(("names", "text"), [("twice", "twice(x) + 1"), ("FACTOR", "FACTOR * x")])
def test_code_is_stale_once_an_imported_function_or_number_changes(tmp_path, names, text):
    def stamp(inner):
        loaded("lidar.made_up_inner", tmp_path / "inner.py", inner)
        outer = OUTER.format(names=names, text=text)
        return compiled.digest(loaded("lidar.made_up_outer", tmp_path / "outer.py", outer))

    assert stamp(INNER) == stamp(INNER)
    assert stamp(INNER) != stamp(INNER.replace("2.0", "3.0"))


@pytest.mark.usefixtures("made_up_modules")
def test_an_imported_number_alone_counts_not_the_rest_of_its_module(tmp_path):
    outer = OUTER.format(names="FACTOR", text="FACTOR * x")
    stamps = set()
    for inner in (INNER, INNER + "\n# a remark\n"):
        loaded("lidar.made_up_inner", tmp_path / "inner.py", inner)
        stamps.add(compiled.digest(loaded("lidar.made_up_outer", tmp_path / "outer.py", outer)))
    assert len(stamps) == 1


def test_a_read_only_installation_brings_its_code_to_the_users_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = tmp_path / "made_up.py"
    (tmp_path / "__pycache__").mkdir()
    brought = "made_up.f-1.py311.nbi", "made_up.f-1.py311.1.nbc"
    for name in (*brought, "other.f-1.py311.nbi"):
        (tmp_path / "__pycache__" / name).write_bytes(b"code")
    source.write_text("def f():\n    pass\n")
    locator = compiled._OfUser(raster.draw_triangles.py_func, str(source))
    locator.ensure_cache_path()
    assert sorted(path.name for path in Path(locator.get_cache_path()).iterdir()) == sorted(brought)


def test_code_is_made_for_a_level_of_processors_not_for_one():
    levels = compiled.LEVELS
    assert compiled.level() in (*levels, "")
    assert not compiled.level() or config.CPU_FEATURES == ""
    assert set(levels["x86-64-v3"]) < set(levels["x86-64-v4"])


def test_code_that_is_not_written_yet_is_not_listed(tmp_path, monkeypatch):
    """Another process would read the code of older sources under its name."""
    old, new = (compiled._Files(str(tmp_path), "made_up.f-1.py311", stamp) for stamp in ("old", "new"))
    old.save("ints", "old code")
    write = new._open_for_write

    def full(path):
        if path.endswith(".nbc"):
            raise OSError("no space left")
        return write(path)

    monkeypatch.setattr(new, "_open_for_write", full)
    with pytest.raises(OSError, match="no space left"):
        new.save("ints", "new code")
    assert new.load("ints") is None
    assert old.load("ints") == "old code"


def test_new_code_replaces_that_of_older_sources(tmp_path):
    for stamp in ("old", "new"):
        files = compiled._Files(str(tmp_path), "made_up.f-1.py311", stamp)
        for types in ("ints", "floats"):
            files.save(types, f"{stamp} code for {types}")
    assert files.load("ints") == "new code for ints"
    assert len(list(tmp_path.glob("*.nbc"))) == 2


def test_code_for_a_class_that_was_renamed_is_stale(tmp_path, monkeypatch):
    files = compiled._Files(str(tmp_path), "made_up.f-1.py311", "old")
    with monkeypatch.context() as before:
        former = type("Former", (), {"__module__": __name__})
        before.setattr(sys.modules[__name__], "Former", former, raising=False)
        files.save(former, "old code")
    assert files.load("ints") is None
    files.save("ints", "new code")
    assert files.load("ints") == "new code"


def test_functions_are_compiled_for_calls_from_python_only_where_it_calls_them():
    @compiled.njit()
    def twice(x):
        return 2 * x

    @compiled.njit()
    def more(x):
        return twice(x) + 1

    assert more(3) == 7
    assert not twice.signatures
    assert twice(3.5) == 7.0
    assert len(twice.signatures) == 1


def test_each_use_of_a_program_is_listed():
    assert all(kernels.read_kernels([use]) for use in ("build", "drive", "cameras", "traffic"))


def test_functions_are_listed_for_the_level_of_this_processor_alone(monkeypatch):
    """Packets of rays are as wide as the processor's vectors, and so are the types of what casts them."""
    listed = {}
    for level in compiled.LEVELS:
        monkeypatch.setattr(kernels, "level", lambda level=level: level)
        listed[level] = [
            k.arguments for k in kernels.read_kernels(["drive"]) if k.name.endswith("kernels.cast")
        ]
    assert [len(casts) for casts in listed.values()] == [1, 1]
    assert listed["x86-64-v4"] != listed["x86-64-v3"]


@pytest.mark.parametrize("kernel", LISTED, ids=lambda kernel: kernel.name)
def test_types_are_read_as_they_are_described(kernel):
    assert kernel.function.py_func.__name__ == kernel.name.rpartition(".")[2]
    described = [kernels.describe_type(kind) for kind in kernel.signature]
    assert json.loads(json.dumps(described)) == list(kernel.arguments)


def test_nothing_is_started_or_said_where_nothing_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(kernels.Kernel, "is_missing", lambda _: False)
    monkeypatch.setattr(kernels.subprocess, "Popen", None)
    kernels.compile_ahead("build")
    assert capsys.readouterr() == ("", "")


def test_what_is_missing_is_compiled_and_said(monkeypatch, capsys):
    (smallest,) = kernels.read_kernels(["traffic"])[-1:]
    monkeypatch.setattr(kernels, "read_kernels", lambda _: [smallest])
    monkeypatch.setattr(kernels.Kernel, "is_missing", lambda _: True)
    monkeypatch.setattr(kernels.sys, "argv", ["kernels"])
    kernels.main()
    assert capsys.readouterr().err.startswith("compiling, once; functions: 1\ncompiled in ")
    monkeypatch.undo()
    assert not smallest.is_missing()
