"""Speed of whole drives as multiples of real time, by rig and fidelity level, with the share of each stage.

    python benchmarks/drives.py SCENE [--seconds 6] [--survey-seconds 1.5] [--workers 2] [--json]

Each row is a drive of `lidar.pipeline.drive` along the same random route with clouds as PCD and images as
PNG, after an uncounted drive that compiles the kernels. ``x real time`` is simulated seconds per second of
wall time, including route planning and loading of tiles but not imports. Shares are of the time of all
threads.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

from geoscene.scene import Scene, open_scene
from lidar.options import DriveOptions
from lidar.pipeline import drive

RIGS = {"VLP-16": "vlp16", "HDL-64E": "hdl64e_s3", "OS1-128": "os1_128", "nuScenes": ""}
"""Sensor preset of each rig of one scanner; the nuScenes rig has a scanner and six cameras."""

LEVELS = ("standard", "survey")


def rig_of(sensor: str, folder: Path) -> str:
    """A rig of one scanner on a car's roof, as a file."""
    if not sensor:
        return "nuscenes"
    path = folder / f"{sensor}.toml"
    path.write_text(
        f'name = "{sensor}"\nvehicle = "car"\n\n[[lidar]]\nname = "lidar_top"\npreset = "{sensor}"\n'
        "translation = [0.95, 0.0, 1.73]\n"
    )
    return str(path)


def measured(
    scene: Scene, rig: str, level: str, seconds: float, workers: int, folder: Path
) -> dict[str, Any]:
    """Figures of one drive."""
    options = DriveOptions(
        route="random", duration=seconds, seed=2, rig=rig, formats=("pcd",), fidelity=level, workers=workers
    )
    began, spent = time.perf_counter(), time.process_time()
    summary = drive(scene, folder / "drive", options=options, overwrite=True)
    wall, cpu = time.perf_counter() - began, time.process_time() - spent
    total = sum(summary.stages.values())
    shares = {name: part / total for name, part in sorted(summary.stages.items(), key=lambda s: -s[1])}
    return {"seconds": seconds, "wall": wall, "cpu": cpu, "real_time": seconds / wall, "shares": shares}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--survey-seconds", type=float, default=1.5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    scene = open_scene(arguments.scene)
    if not arguments.json:
        print("| rig | fidelity | s driven | x real time | core s per s driven | stages |")
        print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for title, sensor in RIGS.items():
            rig = rig_of(sensor, folder)
            for level in LEVELS:
                seconds = arguments.survey_seconds if level == "survey" else arguments.seconds
                measured(scene, rig, level, 0.3, arguments.workers, folder)
                row = measured(scene, rig, level, seconds, arguments.workers, folder)
                if arguments.json:
                    print(json.dumps({"rig": title, "fidelity": level} | row), flush=True)
                    continue
                stages = ", ".join(
                    f"{stage} {100 * share:.0f} %" for stage, share in row["shares"].items() if share >= 0.01
                )
                print(
                    f"| {title} | {level} | {seconds:g} | {row['real_time']:.2f} |"
                    f" {row['cpu'] / seconds:.2f} | {stages} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
