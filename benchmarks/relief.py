"""Cost of relief: scans and an image with facades in depth, and with rough ground, too, against planes.

    python benchmarks/relief.py SCENE X Y

SCENE was built with --relief; X and Y are a place on a street, scene metres. The sides alternate; medians of
CPU time.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from geoscene.scene import open_scene
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.scanner import load_sensor
from lidar.sensors.rig.specs import CameraSpec
from lidar.world.settings import WorldSettings
from lidar.world.world import World

ROUNDS = 5
SUN = np.array([0.5, -0.6, 0.7]) / np.linalg.norm([0.5, -0.6, 0.7])


def standing(x: float, y: float) -> Trajectory:
    """A vehicle that stands for a second."""
    t = np.arange(0, 10**9 + 1, 10**7, dtype=np.int64)
    quat = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    return Trajectory(t, np.tile([x, y, 0.0], (len(t), 1)), quat, np.zeros((len(t), 3)), np.ones(len(t)))


def image(world: World, x: float, y: float) -> None:
    """One image of 960 x 600 pixels along the street."""
    camera = CameraSpec("c", Mount(), 960, 600, 700.0, 700.0, 479.5, 299.5)
    poses = Poses(np.array([[x, y, 2.0]]), OPTICAL[None], np.ones((1, 3)))
    render(camera, poses, world=world, sun=SUN, settings=CameraSettings())


def main(folder: str, x: float, y: float) -> None:
    """Print the medians of each task and their ratio."""
    scene = open_scene(Path(folder))
    worlds = {mode: World.load(scene, settings=WorldSettings(relief=mode)) for mode in ("off", "scene")}
    worlds["walls"] = World.load(scene)
    worlds["walls"].caster.refiners = [worlds["walls"].walls]
    tasks: dict[str, Callable[[World], object]] = {
        name: lambda world, name=name: scan(
            load_sensor(name), Mount((0.0, 0.0, 1.9)), trajectory=standing(x, y), world=world, frame=0
        )
        for name in ("vlp16", "hdl64e_s2")
    }
    tasks["image"] = partial(image, x=x, y=y)
    for name, task in tasks.items():
        seconds: dict[str, list[float]] = {mode: [] for mode in worlds}
        for _ in range(ROUNDS + 1):
            for mode, world in worlds.items():
                start = time.process_time()
                task(world)
                seconds[mode].append(time.process_time() - start)
        median = {mode: float(np.median(values[1:])) for mode, values in seconds.items()}
        ratios = ", ".join(f"{mode} {value / median['off']:.2f}" for mode, value in median.items())
        print(f"{name}: off {1e3 * median['off']:.1f} ms; ratios {ratios}")


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3]))
