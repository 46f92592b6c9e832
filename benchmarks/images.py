"""Cost of an image by the relief of the scene and the rays at edges.

    python benchmarks/images.py OFF PLAIN FULL

The arguments are one place built with each value of --relief. Three places of a random drive, 1600 x 900
pixels, one thread; the sides alternate; medians of CPU time.
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict

import numpy as np

from geoscene.options import RELIEFS
from geoscene.scene import open_scene
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.options.drive import DriveOptions
from lidar.sensors.camera.light import sun_direction
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.specs import CameraSpec
from lidar.simulation.plan import plan_drive
from lidar.world.world import World

ROUNDS = 3
CAMERA = CameraSpec("c", Mount(), 1600, 900, 1266.0, 1266.0, 799.5, 449.5)


def main(folders: list[str]) -> None:
    """Print the median of each side at each place, and the mean over places."""
    scenes = dict(zip(RELIEFS, map(open_scene, folders), strict=True))
    plan = plan_drive(scenes["off"], DriveOptions(route="random", duration=12.0, rig="seed", seed=1))
    (left, low, _), (right, high, _) = (
        fold(plan.trajectory.position, axis=0).tolist() for fold in (np.min, np.max)
    )
    worlds = {
        relief: World.load(scene, region=(left, low, right, high), margin=200.0)
        for relief, scene in scenes.items()
    }
    sun = sun_direction(scenes["off"].frame, plan.start)
    seconds: dict[tuple[str, int], list[list[float]]] = defaultdict(lambda: [[], [], []])
    for lap in range(ROUNDS + 1):
        for k, time_s in enumerate((1, 5, 9)):
            at = plan.trajectory.at([time_s * 10**9])
            pose = Poses(at.position + np.array([0.0, 0.0, 1.6]), at.rotation @ OPTICAL, at.scale)
            for relief, world in worlds.items():
                for rays in (1, 2):
                    start = time.process_time()
                    render(CAMERA, pose, world=world, sun=sun, settings=CameraSettings(edge_rays=rays))
                    if lap:  # the first compiles
                        seconds[relief, rays][k].append(time.process_time() - start)
    for (relief, rays), places in seconds.items():
        medians = [float(np.median(place)) for place in places]
        each = ", ".join(f"{median:.2f}" for median in medians)
        print(f"relief={relief} edge_rays={rays}: {np.mean(medians):.2f} s ({each})")


if __name__ == "__main__":
    main(sys.argv[1:])
