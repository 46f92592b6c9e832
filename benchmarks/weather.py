"""What rain, fog and snow take from a scanner's clouds, add to them, and cost per frame.

    python benchmarks/weather.py SCENE [--frames 10] [--repetitions 5] [--fidelity standard] [--json]

Prints the table of docs/measurements/weather.md. Frames of a random drive are simulated in turn in clear
air and in each weather, in one thread: the rays, the echoes, the detector and the truth, without writing
files. The cost is the CPU time of the thread over that of the same frame in clear air with the threshold
on, the median over frames and repetitions.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.scene import open_scene
from lidar.options.drive import DriveOptions
from lidar.sensors.laser.scan import cast, measure
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.devices import Scanner
from lidar.signal.run import altered_sweep
from lidar.signal.truth import Altered, cloud_truth
from lidar.signal.weather.setting import read_weather
from lidar.simulation.frame_loop import chunks
from lidar.simulation.plan import DrivePlan, plan_drive
from lidar.simulation.recording import Recording
from lidar.simulation.situations import situation_of
from lidar.world.world import Worlds

SENSORS = {"vlp16": "VLP-16", "hdl64e_s2": "HDL-64E S2"}
RIG = """
name = "one_scanner"
vehicle = "car"
source = "scanner position of KITTI"

[[lidar]]
name = "top"
preset = "{preset}"
translation = [0.76, 0.0, 1.73]
rate_hz = 10.0
"""
WEATHER = (
    *("rain=2mm/h", "rain=10mm/h", "rain=50mm/h"),
    *("snow=0.5mm/h", "snow=2mm/h", "snow=5mm/h"),
    *("fog=500m", "fog=200m", "fog=50m"),
)


class Side:
    """Frames of the scanner of a plan, with the stages of some options."""

    def __init__(self, plan: DrivePlan, options: DriveOptions) -> None:
        self.recording: Recording = replace(plan, options=options).recording(Path("unwritten"))
        self.scanner = next(sensor for sensor in plan.sensors if isinstance(sensor, Scanner))
        self._worlds = Worlds(plan.scene, plan.max_range, settings=self.recording.settings.world)
        _, region = next(iter(chunks(plan.jobs, plan.trajectory)))
        self._worlds.follow(region)

    def frame(self, frame: int) -> Altered | None:
        """A frame; None in clear air."""
        scanner, settings = self.scanner, self.recording.settings
        world = self._worlds.during(*scanner.sensor.window_ns(frame))
        sweep = cast(
            scanner.sensor,
            scanner.spec.mount,
            trajectory=self.recording.trajectory,
            world=world,
            frame=frame,
            seed=settings.seed,
            settings=settings.scanner,
        )
        if not settings.stages.at("echoes", scanner.name):
            measure(sweep)
            return None
        at = situation_of(self.recording, scanner, frame=frame, world=world)
        return altered_sweep(sweep, settings.stages, at=at)


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU milliseconds of this thread, and the result."""
    began = time.thread_time()
    result = work()
    return 1000 * (time.thread_time() - began), result


def figures(altered: Altered) -> dict[str, float]:
    """Returns of a frame: without the air, lost or hidden in it, false, and of these before a surface."""
    false = altered.cloud.origin == Origin.WEATHER
    return {
        "original": len(altered.original),
        "lost": len(cloud_truth(altered, start_ns=0)["removed"]),
        "false": int(false.sum()),
        "hiding": int((false & (altered.cloud.hidden >= 0)).sum()),
    }


def rows(
    scene_path: Path, rig: Path, *, frames: int, repetitions: int, fidelity: str
) -> list[dict[str, Any]]:
    """One row for clear air, and one for each weather."""
    scene = open_scene(scene_path)
    options = DriveOptions(
        "random", 0.1 * frames, rig=str(rig), fidelity=fidelity, settings=(("link", "on"),)
    )
    plan = plan_drive(scene, options)
    clear = Side(plan, options)
    sides = {word: Side(plan, replace(options, weather=read_weather(word))) for word in WEATHER}
    clear_ms: list[float] = []
    added: dict[str, list[float]] = {word: [] for word in WEATHER}
    found: dict[str, list[Altered]] = {word: [] for word in WEATHER}
    for side in (clear, *sides.values()):
        side.frame(0)  # compile, and fill caches
    for repetition in range(repetitions):
        for frame in range(frames):
            for word, side in sides.items():
                before, _ = timed(lambda frame=frame: clear.frame(frame))
                spent, altered = timed(lambda side=side, frame=frame: side.frame(frame))
                clear_ms.append(before)
                added[word].append(spent - before)
                if repetition == 0:
                    found[word].append(altered)
    table: list[dict[str, Any]] = [{"weather": "clear", "ms": float(np.median(clear_ms))}]
    for word, clouds in found.items():
        mean = {
            name: float(np.mean([figures(one)[name] for one in clouds]))
            for name in ("original", "lost", "false", "hiding")
        }
        ranges = np.concatenate([one.cloud.range[one.cloud.origin == Origin.WEATHER] for one in clouds])
        quantiles = np.quantile(ranges, (0.1, 0.5, 0.9)).tolist() if len(ranges) else None
        table.append({"weather": word, **mean, "ranges": quantiles, "ms": float(np.median(added[word]))})
    return table


def _line(row: dict[str, Any]) -> str:
    kind, _, amount = row["weather"].partition("=")
    unit = "mm/h" if amount.endswith("mm/h") else "m"
    ranges = " to ".join(f"{r:.1f}" for r in row["ranges"][::2]) if row["ranges"] else ""
    cells = (
        f"{kind} {amount.removesuffix(unit)} {unit}",
        f"{row['original']:,.0f}",
        f"{row['lost'] / row['original']:.1%}".replace("%", " %"),
        f"{row['false']:,.0f}",
        f"{row['hiding']:,.0f}",
        ranges,
        f"{row['ms']:.1f}",
    )
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--sensors", nargs="+", default=list(SENSORS))
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--fidelity", default="standard")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    how = {"frames": given.frames, "repetitions": given.repetitions, "fidelity": given.fidelity}
    tables = {}
    with tempfile.TemporaryDirectory() as folder:
        for sensor in given.sensors:
            rig = Path(folder) / f"{sensor}.toml"
            rig.write_text(RIG.format(preset=sensor), "utf-8")
            tables[sensor] = rows(given.scene, rig, **how)
    if given.json:
        print(json.dumps(tables, indent=1))
        return
    print(
        "| weather | returns without the air | lost or hidden in it | false returns | of these hide a surface"
        " | range of 80 % of them, m | added ms a frame |\n|---|---|---|---|---|---|---|"
    )
    for sensor, table in tables.items():
        print(f"| **{SENSORS.get(sensor, sensor)}**, clear | | | | | | clear: {table[0]['ms']:.1f} |")
        print("\n".join(map(_line, table[1:])))


if __name__ == "__main__":
    main()
