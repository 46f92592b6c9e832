"""The lists of compiled functions name functions of the packages and the types that they are called with."""

import json

import pytest

from geoscene.support import kernels

LISTED = kernels.read_kernels()


def test_each_use_of_a_program_is_listed():
    assert all(kernels.read_kernels([use]) for use in ("build", "drive", "cameras", "traffic"))


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
