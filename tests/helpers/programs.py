"""Runs the programs of the checkout under test, in this process or in one of their own."""

import contextlib
import io
import logging
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from unittest.mock import patch

import pytest

from helpers import ROOT

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}
"""Environment of processes that import this checkout, even if another version is installed."""
SMALL_FILES = ENVIRONMENT | {"PYTHONDONTWRITEBYTECODE": "1"}
"""The same for processes with a limit on the size of files, which would cut compiled modules off."""


def command(name, *words):
    """Arguments of a process that runs the program ``name``."""
    return [sys.executable, "-m", name, *map(str, words)]


def run_process(name, *words, env=ENVIRONMENT, **options):
    """The completed process of the program ``name``, with its output as text; options of `subprocess.run`."""
    return subprocess.run(
        command(name, *words), env=env, capture_output=True, text=True, check=False, **options
    )


def run_program(name, *words, cwd="."):
    """What `run_process` returns, without starting a process, which takes a second to import the program."""
    main = import_module(f"{name}.cli").main
    arguments = [name, *map(str, words)]
    out, errors = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd),
        patch.object(sys, "argv", arguments),
        patch.object(logging.getLogger(), "handlers", []),
        # threads of Dask clusters in this process log at any time
        patch.object(logging.getLogger("distributed"), "propagate", False),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(errors),
        pytest.raises(SystemExit) as end,
    ):
        main()
    return subprocess.CompletedProcess(arguments, end.value.code, out.getvalue(), errors.getvalue())


def alive(group):
    """Running processes of a process group."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, mine = (entry / "stat").read_text().rsplit(")", 1)[1].split()[:3]
            except OSError:
                continue
            if int(mine) == group and state != "Z":
                found.append(int(entry.name))
    return found
