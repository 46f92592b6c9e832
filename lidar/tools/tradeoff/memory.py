"""Peak memory of a simulation, measured in a process of its own."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from geoscene.scene import open_scene
from geoscene.support.memory import peak_memory
from geoscene.typing import Float
from lidar.dataset.formats.table import cloud_table
from lidar.geometry.poses import Trajectory
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.laser.scan import scan
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.tools.tradeoff.images import Shot, encode_images, image
from lidar.world.actors import Actors, actor_shapes, actor_transforms
from lidar.world.settings import WorldSettings
from lidar.world.world import Region, World


@dataclass(frozen=True, slots=True)
class Task:
    """One frame of a sensor, from loading the world on.

    region     : of the vehicle, scene metres
    margin     : metres around it that are loaded, at most the reach of the settings of the world
    resolution : pixels of a camera's side that are one pixel of the image
    sun        : (3,) direction towards the sun
    """

    scene: Path
    sensor: Scanner | Camera
    settings: ScannerSettings | CameraSettings
    trajectory: Trajectory
    actors: Actors | None
    frame: int
    region: Region
    margin: float
    world: WorldSettings
    resolution: int
    sun: Float


def peaks(tasks: list[Task]) -> list[int]:
    """Bytes by which the peak memory of a new process grows with each task, in the order of the tasks."""
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload([__name__])  # imported once, not by each process
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        return list(pool.map(_growth, tasks))


def _growth(task: Task) -> int:
    before = peak_memory()
    actors = task.actors
    world = World.load(
        open_scene(task.scene),
        region=task.region,
        margin=task.margin,
        actors=() if actors is None else actor_shapes(actors),
        settings=task.world,
    )
    sensor, frame = task.sensor, task.frame
    start = sensor.frame_start_ns(frame)
    if actors is not None:
        x0, y0, x1, y1 = task.region
        around = (x0 - task.margin, y0 - task.margin, x1 + task.margin, y1 + task.margin)
        end = start + sensor.period_ns
        shape, transform, feature = actor_transforms(actors, start, end_ns=end, region=around)
        world.place_actors(shape, transform, feature=feature)
    if isinstance(sensor, Camera) and isinstance(task.settings, CameraSettings):
        shot = Shot(sensor, frame, task.trajectory, task.sun)
        encode_images(image(shot, world=world, settings=task.settings, resolution=task.resolution), sensor)
    elif isinstance(sensor, Scanner) and isinstance(task.settings, ScannerSettings):
        cloud_table(
            scan(
                sensor.sensor,
                sensor.spec.mount,
                trajectory=task.trajectory,
                world=world,
                frame=frame,
                settings=task.settings,
            )
        )
    return peak_memory() - before
