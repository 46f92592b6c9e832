"""Subject driving: rays alone, scans or images alone, and whole drives with files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypedDict

import numpy as np

from bench.measure import Case
from bench.scenes import RIGS, Setup
from geoscene.typing import Ints
from lidar.geometry.poses import Poses
from lidar.geometry.random_streams import generator
from lidar.sensors.camera.light import sun_direction
from lidar.sensors.camera.render import render
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.camera_model import exposure_times
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.patterns.beams import Firings
from lidar.sensors.rig.scanner import firings
from lidar.simulation.drive import drive
from lidar.simulation.plan import DrivePlan
from lidar.world.world import World

Work = Callable[[], object]


class Shared(TypedDict):
    """What two cases of a rig share, see `Case`."""

    amount: float
    unit: str
    simulated_s: float


def driving(setup: Setup) -> Iterator[Case]:
    """Each rig along the same random route: in memory, and as a dataset."""
    for rig in RIGS:
        camera = not RIGS[rig]
        seconds = (0.2 if camera else 1.0) if setup.quick else (1.0 if camera else 5.0)
        plan = setup.plan(rig, seconds=seconds)
        shared: Shared = {
            "amount": sum(map(_samples, plan.sensors, plan.frames.values())) / 1e6,
            "unit": "M pixels" if camera else "M pulses",
            "simulated_s": plan.trajectory.duration_ns / 1e9,
        }
        yield Case(
            "driving",
            f"{rig} in memory, {setup.town}, {seconds:g} s",
            sides=_image_sides(plan) if camera else _scan_sides(plan),
            note="in memory, one thread; rays alone: the same world, without beams, columns, light and noise",
            **shared,
        )
        if camera:
            yield Case(
                "driving",
                f"{rig} in memory, depth and labels, {setup.town}, {seconds:g} s",
                sides=_image_sides(plan, images=("depth", "semantic", "instance")),
                note="in memory, one thread, without colour; rays alone: the same world, without labels",
                **shared,
            )
        yield Case(
            "driving",
            f"{rig} to files, {setup.town}, {seconds:g} s",
            sides={f"{n} worker{'s'[: n > 1]}": _driven(setup, rig, seconds, workers=n) for n in (2, 1)},
            note="to files: planning, loading, simulation, PCD or PNG, without imports; the same bytes by one"
            " and two workers",
            clock="wall",
            **shared,
        )


def _driven(setup: Setup, rig: str, seconds: float, *, workers: int) -> Work:
    options = setup.options(rig, seconds=seconds, workers=workers)
    return lambda: drive(setup.scene, setup.folder / "drive", options=options, overwrite=True)


def _samples(sensor: Scanner | Camera, frames: int) -> int:
    """Pulses or pixels of all frames of a sensor."""
    if isinstance(sensor, Camera):
        return sensor.spec.width * sensor.spec.height * frames
    return sum(len(firings(sensor.sensor, frame)) for frame in range(frames))


def world_of(plan: DrivePlan) -> World:
    """All that the sensors of a drive can reach."""
    xy = plan.trajectory.position[:, :2]
    (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return World.load(plan.scene, region=(x0, y0, x1, y1), margin=plan.max_range)


def _scan_sides(plan: DrivePlan) -> dict[str, Work]:
    world, (scanner,) = world_of(plan), plan.sensors
    frames = range(plan.frames[scanner.name])
    mount = scanner.spec.mount

    def scans() -> None:
        for frame in frames:
            scan(scanner.sensor, mount, trajectory=plan.trajectory, world=world, frame=frame)

    rays = [_posed(plan, scanner, firings(scanner.sensor, frame)) for frame in frames]

    def casts() -> None:
        for poses, index, fired in rays:
            world.caster.cast_posed(
                poses, index, directions=fired.direction, far=scanner.max_range, order=fired.order
            )

    return {"lidar": scans, "rays alone": casts}


def _posed(plan: DrivePlan, scanner: Scanner, fired: Firings) -> tuple[Poses, Ints, Firings]:
    """Poses of a scanner at its firing times, and the pose of each pulse."""
    times, index = np.unique(fired.time_ns, return_inverse=True)
    mount = scanner.spec.mount
    return plan.trajectory.at(times).mounted(mount.translation, mount.rotation), index, fired


def _image_sides(plan: DrivePlan, *, images: tuple[str, ...] = ()) -> dict[str, Work]:
    """Images of the kinds that the rig asks for, or of others, and their rays alone."""
    world, (camera,) = world_of(plan), plan.sensors
    spec, settings = camera.spec, plan.options.recording_settings
    spec = replace(spec, images=images or spec.images)
    x, y = plan.trajectory.position[0, :2].tolist()
    sun = sun_direction(plan.scene.frame, plan.start, at=(x, y))

    def rendered() -> None:
        for frame in range(plan.frames[camera.name]):
            times = exposure_times(spec, camera.frame_start_ns(frame), samples=settings.camera.moments(spec))
            render(
                spec,
                plan.trajectory.at(times).mounted(spec.mount.translation, spec.mount.rotation),
                world=world,
                sun=sun,
                times=None,
                random=generator(0, camera.name, frame, "image"),
                settings=settings.camera,
            )

    u, v = np.meshgrid(np.arange(spec.width) + 0.5 - spec.cx, np.arange(spec.height) + 0.5 - spec.cy)
    way = np.stack([u / spec.fx, v / spec.fy, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    index = np.zeros(len(way), np.int64)

    def casts() -> None:
        for frame in range(plan.frames[camera.name]):
            pose = plan.trajectory.at([camera.frame_start_ns(frame)])
            pose = pose.mounted(spec.mount.translation, spec.mount.rotation)
            world.caster.cast_posed(pose, index, directions=way, far=camera.max_range)

    return {"lidar": rendered, "rays alone": casts}
