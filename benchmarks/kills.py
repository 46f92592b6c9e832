"""Builds and drives, killed at random moments and repeated: differences, leftovers, slow interruptions.

    python benchmarks/kills.py --count 50

Builds with two workers and drives with two threads are ended by SIGKILL, SIGINT (to the whole process group,
as Ctrl-C) or SIGTERM. The same command is repeated until it succeeds, and its files are compared with those
of an uninterrupted run. An exit code or message that a kill does not explain, another file beside the
output and an interruption that takes more than two seconds are faults, too.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BOX = "--bbox=24.9425,60.1665,24.9445,60.1680"
_KILLS = (signal.SIGKILL, signal.SIGINT, signal.SIGTERM)
_PROMPT_S = 2.0


def _commands(folder: Path) -> dict[str, list[str]]:
    """Commands that lack only their output, by name."""
    build = [sys.executable, "-m", "geoscene.cli", "build", "--demo", BOX, "--tile-size", "50"]
    build += ["--workers", "2", "--name", "demo", "--quiet", "--overwrite"]
    drive = [sys.executable, "-m", "lidar.cli", "drive", str(folder / "reference-build"), "--quiet"]
    drive += ["--route", "random", "--duration", "3", "--traffic", "on", "--format", "pcd,laz"]
    return {"build": build, "drive": drive}


def _changed(reference: Path, out: Path) -> list[str]:
    """Names of files that differ between two folders."""
    names = {
        path.relative_to(root) for root in (reference, out) for path in root.rglob("*") if path.is_file()
    }
    return [str(name) for name in sorted(names) if not _same(reference / name, out / name)]


def _same(one: Path, two: Path) -> bool:
    return one.is_file() and two.is_file() and one.read_bytes() == two.read_bytes()


def _ended_at_random(words: list[str], rng: random.Random, *, seconds: float) -> tuple[str, float, int, str]:
    """Start a command and end it at a random moment: the signal, the time it took, exit code and message."""
    kill = rng.choice(_KILLS)
    process = subprocess.Popen(
        words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    time.sleep(rng.uniform(0.1, 1.0) * seconds)
    done, asked = process.poll() is not None, time.monotonic()
    with contextlib.suppress(ProcessLookupError):
        (os.killpg if kill == signal.SIGINT else os.kill)(process.pid, kill)
    _, errors = process.communicate(timeout=600)
    return "" if done else kill.name, time.monotonic() - asked, process.returncode, errors


def killed_runs(options: argparse.Namespace, folder: Path) -> int:
    """Kill commands until ``options.count`` kills; returns the number of faults."""
    rng, faults, kills, slowest = random.Random(options.seed), 0, 0, 0.0
    seconds = {}
    commands = _commands(folder)
    for name, words in commands.items():
        started = time.monotonic()
        subprocess.run(
            [*words, "-o", str(folder / f"reference-{name}")], check=True, stdout=subprocess.DEVNULL
        )
        seconds[name] = time.monotonic() - started
    expected = {f"reference-{name}" for name in commands}
    while kills < options.count:
        name = rng.choice(list(commands))
        out = folder / name
        words = [*commands[name], "-o", str(out)]
        while True:
            end = kills < options.count and rng.random() < 0.75
            if end:
                kill, took, code, errors = _ended_at_random(words, rng, seconds=seconds[name])
            else:
                done = subprocess.run(words, check=False, capture_output=True, text=True)
                kill, took, code, errors = "", 0.0, done.returncode, done.stderr
            kills += bool(kill)
            slowest = max(slowest, took if kill == "SIGINT" else 0.0)
            wrong = "Traceback" in errors or code not in ({0, 130, -9, -15, -2} if kill else {0})
            slow = kill == "SIGINT" and took > _PROMPT_S
            if wrong or slow:
                faults += 1
                print(f"{name}, {kill}: code {code} after {took:.1f} s: {errors[-300:]}", flush=True)
            if code == 0:
                break
        changed = _changed(folder / f"reference-{name}", out)
        left = {path.name for path in folder.iterdir()} - expected - set(commands)
        faults += bool(changed or left)
        print(f"{kills} kills, {faults} faults {name} {changed[:9]} {sorted(left)}", flush=True)
        if name == "drive" or rng.random() < 0.8:  # else the next build replaces it
            shutil.rmtree(out)
    print(f"slowest interruption {slowest:.1f} s")
    return faults


def main() -> int:
    """Run the kills; exit code 1 if something went wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        return int(killed_runs(options, Path(folder)) > 0)


if __name__ == "__main__":
    sys.exit(main())
