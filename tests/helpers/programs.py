"""Runs the programs of the checkout under test in processes of their own."""

import os
import subprocess
import sys
from pathlib import Path

_ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(_ROOT)}
"""Environment of processes that import this checkout, even if another version is installed."""


def command(name, *words):
    """Arguments of a process that runs the program ``name``."""
    return [sys.executable, "-m", f"{name}.cli", *map(str, words)]


def run_program(name, *words, **options):
    """The completed process of the program ``name``, with its output as text; options of `subprocess.run`."""
    return subprocess.run(
        command(name, *words), env=ENVIRONMENT, capture_output=True, text=True, check=False, **options
    )


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
