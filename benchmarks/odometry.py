"""Errors of odometry on drives through several scenes, with and without relief, rain and traffic.

    python benchmarks/odometry.py NAME=SCENE ... -o FOLDER [--duration SECONDS] [--seed N]
                                  [--methods kiss-icp,...] [--weather clear,rain] [--traffic off,on]
                                  [--route random] [--rig FILE.toml] [--format pcd]

Each drive is recorded, estimated by every method, compared with the truth, and deleted.
``FOLDER/results.json`` gets a row an estimate; rows that are there are kept, so that an interrupted run
continues. The table of all rows, in Markdown, is printed at the end: the mean error of segments of 10 m in
percent, with its 95 % interval (`lidar evaluate`). The column ``relief`` is the option that the scene was
built with. Echoes, noise and lost returns are those of the level ``survey``, with one ray a pulse.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

from geoscene.scene import open_scene
from geoscene.support.files import write_atomically

_TRAFFIC = "vehicles=20,parked=0.5,pedestrians=10,cyclists=3"
_RAIN = "rain=10mm/h"
_PHYSICS = ("--fidelity", "survey", "--set", "rays=1", "--set", "stretch=on", "--set", "supersample=1")
_SEGMENT = 10  # metres: on short ways, five blocks of longer ones do not fit, and no interval is told


def cases(given: argparse.Namespace) -> Iterator[dict[str, str]]:
    """The drives that are asked for."""
    weathers, traffics = given.weather.split(","), given.traffic.split(",")
    for (name, scene), weather, traffic in product(given.scenes, weathers, traffics):
        relief = open_scene(scene).manifest["options"]["relief"]
        yield {"place": name, "scene": scene, "relief": relief, "weather": weather, "traffic": traffic}


def record(case: dict[str, str], out: Path, given: argparse.Namespace) -> str:
    """Record a drive; return why it failed, or nothing."""
    words = ["drive", case["scene"], "--route", given.route, "--duration", str(given.duration)]
    words += ["--seed", str(given.seed), "--rig", str(given.rig), "--format", given.format, "-o", str(out)]
    words += [*_PHYSICS, "--overwrite", "--quiet"]
    words += ["--weather", _RAIN] if case["weather"] == "rain" else []
    words += ["--traffic", _TRAFFIC] if case["traffic"] == "on" else []
    return _run(*words)[1]


def measured(drive: Path, method: str) -> dict[str, Any]:
    """Errors of a method on a drive, or why there are none."""
    out = drive.with_name(f"{drive.name}_{method}")
    report, fault = _run("odometry", str(drive), "--method", method, "-o", str(out), "--overwrite", "--json")
    if fault:
        return {"fault": fault}
    words = ("--against", str(drive), "--align", "origin", "--json")  # on a straight road no other is defined
    found, fault = _run("evaluate", str(out / "trajectory.tum"), *words)
    shutil.rmtree(out)
    if fault:
        return {"fault": fault}
    return {
        "way_m": found["way_m"],
        "way_estimate_m": found["way_estimate_m"],
        "ate_m": found["translation"],
        "segments": found["segments"],
        "seconds": report["seconds"],
    }


def _run(*words: str) -> tuple[dict[str, Any], str]:
    """The JSON that a command prints, if any, and the last line of its error."""
    done = subprocess.run(
        [sys.executable, "-m", "lidar", *words], capture_output=True, text=True, check=False, timeout=3600
    )
    if done.returncode:
        return {}, (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
    return (json.loads(done.stdout) if "--json" in words else {}), ""


def _measure(given: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows, those of earlier runs included."""
    given.out.mkdir(parents=True, exist_ok=True)
    path, drive = given.out / "results.json", given.out / "drive"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    for case in cases(given):
        known = {row["method"] for row in rows if case.items() <= row.items()}
        if not (missing := [method for method in given.methods.split(",") if method not in known]):
            continue
        if fault := record(case, drive, given):
            sys.exit(f"{case}: {fault}")
        for method in missing:
            rows.append({**case, "method": method, **measured(drive, method)})
            write_atomically(path, json.dumps(rows, indent=1).encode())
            print(json.dumps({k: v for k, v in rows[-1].items() if k != "segments"}), flush=True)
        shutil.rmtree(drive)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """The errors as a table in Markdown: a row a drive, a column a method."""
    keys = ("place", "relief", "weather", "traffic")
    methods = list(dict.fromkeys(row["method"] for row in rows))
    drives: dict[tuple[str, ...], dict[str, str]] = {}
    for row in rows:
        drives.setdefault(tuple(row[key] for key in keys), {})[row["method"]] = _cell(row)
    head = [*keys, *(f"{method}, %" for method in methods)]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for drive, cells in drives.items():
        lines.append("| " + " | ".join([*drive, *(cells.get(m, "") for m in methods)]) + " |")
    return "\n".join(lines)


def _cell(row: dict[str, Any]) -> str:
    """Error of segments of `_SEGMENT` metres in percent with its interval."""
    if "fault" in row:
        return "failed"
    found = next((one["translation"] for one in row["segments"] if one["length"] == _SEGMENT), None)
    if found is None:
        return "no segment"
    interval = "" if found["low"] is None else f" ({found['low']:.2f} to {found['high']:.2f})"
    return f"{found['value']:.2f}{interval}"


def _named(text: str) -> tuple[str, str]:
    name, _, scene = text.partition("=")
    if not scene:
        raise argparse.ArgumentTypeError(f"{text}: give NAME=SCENE")
    return name, scene


def main() -> None:
    """Measure the scenes of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", type=_named, metavar="NAME=SCENE")
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--route", default="random")
    parser.add_argument("--methods", default="kiss-icp,genz-icp,small_gicp,fused")
    parser.add_argument("--weather", default="clear,rain")
    parser.add_argument("--traffic", default="off,on")
    parser.add_argument("--rig", default=Path(__file__).with_suffix(".toml"))
    parser.add_argument("--format", default="pcd")
    print(table(_measure(parser.parse_args())))


if __name__ == "__main__":
    main()
