"""CPU time per frame to place moving actors in a scene's world, milliseconds.

python benchmarks/actors.py SCENE --actors 230 470
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geoscene.scene import open_scene
from lidar.world.actor_shapes import catalogue
from lidar.world.world import World

_REACH = 200.0  # metres around the centre of the scene
_FIRST = 10**6  # feature number of the first actor


def driving(count: int, frame: int, still: float) -> NDArray[np.float64]:
    """Transforms (count, 3, 3, 4) of actors that move 1 m per frame or, a share of them, stand still."""
    rng = np.random.default_rng(1)
    out = np.tile(np.eye(3, 4), (count, 3, 1, 1))
    out[:, :, :2, 3] = rng.uniform(-_REACH, _REACH, (count, 1, 2))
    goes = rng.random(count) >= still
    out[goes, :, 0, 3] += frame + np.array([0.0, 0.5, 1.0])
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--actors", type=int, nargs="+", default=[230, 470])
    parser.add_argument("--frames", type=int, default=20)
    options = parser.parse_args()
    shapes = [shape.mesh for shape in catalogue().values()]
    scene = open_scene(options.scene)
    x, y = ((scene.bounds[k] + scene.bounds[k + 2]) / 2 for k in (0, 1))
    world = World.load(scene, region=(x - 1, y - 1, x + 1, y + 1), margin=_REACH, actors=shapes)
    print("actors  ms per frame")
    for count in options.actors:
        shape = np.random.default_rng(2).integers(0, len(shapes), count).astype(np.int32)
        feature = np.arange(_FIRST, _FIRST + count, dtype=np.int32)
        spent = []
        for frame in range(options.frames):
            transform = driving(count, frame, 0.7)
            transform[:, :, :2, 3] += (x, y)
            began = time.thread_time()
            world.place_actors(shape, transform, feature=feature)
            spent.append(time.thread_time() - began)
        print(f"{count:6} {1e3 * statistics.median(spent):11.2f}")


if __name__ == "__main__":
    main()
