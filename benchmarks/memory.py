"""Memory along a long route: tiles are loaded and released around the vehicle, and memory must not grow.

    python benchmarks/memory.py SCENE [--km 20] [--reach 120] [--json]

Follows a random route through the scene. Every 100 m it loads the tiles around the vehicle, as a drive does,
and casts 28,800 rays in all directions from 1.9 m above the road. Resident memory is that of this process;
the route is planned in another one.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.scene import open_scene
from lidar.world.world import World

STEP = 100.0
"""Metres between the positions from which rays are cast."""


def _route(scene_path: Path, km: float, queue: multiprocessing.Queue[NDArray[np.float64]]) -> None:
    from lidar.motion.route import RouteOptions, plan_route  # noqa: PLC0415

    scene = open_scene(scene_path)
    queue.put(
        plan_route(
            scene.road_graph(), scene.frame, spec="random", options=RouteOptions(seed=1, length=1000 * km)
        ).line
    )


def resident() -> float:
    """Resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def all_round() -> NDArray[np.float64]:
    """Directions (28800, 3) of a VLP-16's revolution."""
    azimuth = np.repeat(np.linspace(0, 2 * np.pi, 1800, endpoint=False), 16)
    elevation = np.tile(np.radians(np.arange(-15, 17, 2)), 1800)
    flat = np.cos(elevation)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--km", type=float, default=20.0)
    parser.add_argument("--reach", type=float, default=120.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    planner = context.Process(target=_route, args=(arguments.scene, arguments.km, queue))
    planner.start()
    line = queue.get()
    planner.join()

    scene = open_scene(arguments.scene)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    stops = np.arange(0.0, along[-1], STEP)
    places = np.column_stack([np.interp(stops, along, line[:, k]) for k in range(3)])
    rays, world = all_round(), None
    began = time.process_time()
    if not arguments.json:
        print(
            "| km | resident MiB | loaded triangles | hits | CPU s since the start |\n|---|---|---|---|---|"
        )
    for k, (x, y, z) in enumerate(places.tolist()):
        region = (x - STEP, y - STEP, x + STEP, y + STEP)
        if world is None:
            world = World.load(scene, region=region, margin=arguments.reach)
        else:
            world.follow(region)
        hits = world.caster.cast(np.full((len(rays), 3), (x, y, z + 1.9)), rays, far=arguments.reach)
        if k % 10 == 0:
            row = {
                "km": float(stops[k] / 1000),
                "resident_mib": resident(),
                "triangles": len(world.faces.packed),
                "hits": int((hits.face >= 0).sum()),
                "cpu_seconds": time.process_time() - began,
            }
            if arguments.json:
                print(json.dumps(row), flush=True)
            elif k % 20 == 0:
                print(
                    f"| {row['km']:.0f} | {row['resident_mib']:.0f} | {row['triangles']:,} |"
                    f" {row['hits']:,} | {row['cpu_seconds']:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
