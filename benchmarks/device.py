"""Rates of the devices that cast rays: rays, scans, images and whole drives, and how many hits differ.

    python benchmarks/device.py SCENE [--drive SECONDS] [--rays N]

Measures the CPU with Embree and every device of Warp on this machine, by turns, near the start of a random
drive: medians of wall time, as a GPU has no CPU time. ``copies`` is the rate at which the rays and hits of a
cast alone can be copied to the device and back: no cast can be faster. Hits are compared with those of the
float64 backend, byte for byte, and those of Embree, by face; images with that backend's, by levels of sRGB.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import SceneFormatError, need
from geoscene.scene import Scene, open_scene
from lidar import DriveOptions, drive
from lidar.geometry.attitude import OPTICAL, Mount
from lidar.geometry.poses import Poses
from lidar.raycast.device import WARP_CPU, device
from lidar.raycast.hits import Hits
from lidar.sensors.camera.render import render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.laser.scan import scan
from lidar.sensors.rig.scanner import load_sensor
from lidar.sensors.rig.specs import CameraSpec
from lidar.simulation.plan import plan_drive
from lidar.world.settings import WorldSettings
from lidar.world.world import World

ROUNDS = 5
COPIED = 24 + 24, 8 + 4 + 4 + 4
"""Bytes of a ray to the device, with its origin, and of a hit back."""
SUN = np.array([0.5, -0.6, 0.7]) / np.linalg.norm([0.5, -0.6, 0.7])
MARGIN = 130.0


def seconds(tasks: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median wall time of each task, by turns, after one uncounted turn."""
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for turn in range(ROUNDS + 1):
        for name, task in tasks.items():
            began = time.perf_counter()
            task()
            if turn:
                times[name].append(time.perf_counter() - began)
    return {name: statistics.median(all_times) for name, all_times in times.items()}


def rays_of(shape: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """About that many unit directions: of a scanner's rings, the pixels of an image, or at random."""
    if shape == "rings":
        up = np.radians(np.linspace(-25, 10, 64))[:, None]
        turn = np.linspace(0, 2 * np.pi, count // 64)[None]
        way = [np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up) + 0 * turn]
    elif shape == "pixels":
        v, u = np.mgrid[-0.5:0.5:400j, -0.8 : 0.8 : (count // 400) * 1j]
        way = [np.ones_like(u), u, v]
    else:
        way = list(rng.normal(size=(3, count)))
    rows = np.stack([axis.ravel() for axis in way], axis=1)
    return np.ascontiguousarray(rows / np.linalg.norm(rows, axis=1)[:, None])


def copies(name: str, count: int) -> float:
    """Seconds in which rays travel to a device and their hits back."""
    there, back = (np.zeros(count * size, np.uint8) for size in COPIED)
    on, byte = device(name), need("warp", "gpu").uint8

    def task() -> None:
        on.upload(there)
        on.empty(len(back), byte).numpy()

    return seconds({"copies": task})["copies"]


def differences(found: Hits, expected: Hits) -> str:
    """How many hits differ in a byte, and in the face."""
    columns = zip(found.columns().values(), expected.columns().values(), strict=True)
    rows = np.logical_or.reduce(
        [a.view(f"V{a.itemsize}") != b.view(f"V{b.itemsize}") for a, b in columns if a.ndim == 1]
    )
    return f"{int(rows.sum())} of {len(rows):,}"


def casting(worlds: dict[str, World], exact: World, *, eye: np.ndarray, count: int) -> None:
    """Print the rates of first hits and shadow rays."""
    limits = {name: count / copies(name, count) / 1e6 for name in worlds if name != "cpu"}
    for shape in ("rings", "pixels", "random"):
        way = rays_of(shape, count, np.random.default_rng(1))
        threads = os.cpu_count() or 1
        cast = {n: partial(w.caster.cast, eye, way, far=MARGIN, threads=threads) for n, w in worlds.items()}
        shadow = {
            n: partial(w.caster.occluded, eye, way, far=MARGIN, threads=threads) for n, w in worlds.items()
        }
        rates, shadows = seconds(cast), seconds(shadow)
        truth = exact.caster.cast(eye, way, far=MARGIN, threads=threads)
        embree = worlds["cpu"].caster.cast(eye, way, far=MARGIN, threads=threads)
        other = int(((truth.face != embree.face) | (truth.instance != embree.instance)).sum())
        print(f"\n{shape}, {len(way):,} rays; Embree hits another face than float64 for {other}")
        for name, world in worlds.items():
            rate, blocked = (len(way) / taken[name] / 1e6 for taken in (rates, shadows))
            line = f"  {name:10} {rate:8.2f} million first hits/s {blocked:8.2f} million shadow rays/s"
            if name in limits:
                line += f"; copies {limits[name]:.0f} million/s; differ from float64: "
                line += differences(world.caster.cast(eye, way, far=MARGIN), truth)
            print(line)


def sensors(worlds: dict[str, World], exact: World, *, options: DriveOptions, scene: Scene) -> None:
    """Print the rates of whole scans and images, and how many pixels differ from the float64 backend's."""
    trajectory = plan_drive(scene, options).trajectory
    x, y, z = trajectory.position[0]
    camera = CameraSpec("c", Mount(), 960, 600, 700.0, 700.0, 479.5, 299.5)
    poses = Poses(np.array([[x, y, z + 2.0]]), OPTICAL[None], np.ones((1, 3)))
    mount = Mount((0.0, 0.0, 1.8))
    tasks: dict[str, Callable[[World], Any]] = {
        "VLP-16 scans": lambda w: scan(load_sensor("vlp16"), mount, trajectory=trajectory, world=w, frame=0),
        "HDL-64E scans": lambda w: scan(
            load_sensor("hdl64e_s3"), mount, trajectory=trajectory, world=w, frame=0
        ),
        "images 960 x 600": lambda w: render(camera, poses, world=w, sun=SUN, settings=CameraSettings()),
    }
    for title, task in tasks.items():
        taken = seconds({name: partial(task, world) for name, world in worlds.items()})
        print(f"\n{title}: " + ", ".join(f"{name} {1 / taken[name]:.2f}/s" for name in worlds))
    image = tasks["images 960 x 600"]
    truth = np.asarray(image(exact).rgb, int)
    for name, world in worlds.items():
        apart = np.abs(image(world).rgb - truth).max(axis=2)
        share, most = np.mean(apart > 1), apart.max()
        print(f"  {name}: {share:.4%} of the pixels differ by more than a level, by {most} at most")


def has_colors(scene: Scene) -> bool:
    """Whether cameras can record a scene."""
    try:
        scene.require("colors")
    except SceneFormatError:
        return False
    return True


def main() -> None:
    """Measure the devices of this machine."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("--drive", type=float, default=2.0, help="seconds of the whole drives")
    parser.add_argument("--rays", type=int, default=1_000_000, help="in a cast")
    parser.add_argument("--devices", nargs="*", help="of Warp; by default warp-cpu and all CUDA devices")
    given = parser.parse_args()
    device(WARP_CPU)  # which prepares Warp
    wp = need("warp", "gpu")
    names = given.devices or [WARP_CPU, *(f"cuda:{k}" for k in range(wp.get_cuda_device_count()))]
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Warp {wp.config.version}")
    for name in names:
        there = device(name).warp_device
        memory = "" if there.is_cpu else f", sm_{there.arch}, {there.total_memory / 2**30:.0f} GiB"
        print(f"  {name}: {there.name}{memory}")
    scene = open_scene(given.scene)
    options = DriveOptions(route="random", duration=given.drive, rig="vlp16", formats=("pcd",))
    eye = plan_drive(scene, options).trajectory.position[0] + [0.0, 0.0, 2.0]
    region = (eye[0], eye[1], eye[0], eye[1])
    worlds = {}
    for name in ("cpu", *names):
        began = time.perf_counter()
        worlds[name] = World.load(scene, region=region, margin=MARGIN, settings=WorldSettings(device=name))
        worlds[name].caster.cast(eye, np.eye(3))
        print(f"  {name}: {time.perf_counter() - began:.1f} s to load the world and the kernels")
    exact = World.load(scene, region=region, margin=MARGIN, backend="float64")
    casting(worlds, exact, eye=eye, count=given.rays)
    sensors(worlds, exact, options=options, scene=scene)
    for rig in ("vlp16", "kitti") if has_colors(scene) else ("vlp16",):
        for name in worlds:
            chosen = DriveOptions(
                route="random", duration=given.drive, rig=rig, formats=("pcd",), device=name
            )
            with tempfile.TemporaryDirectory() as out:
                began = time.perf_counter()
                drive(scene, Path(out) / "drive", options=chosen)
                print(
                    f"\ndrive of {given.drive:g} s, {rig}, {name}: {time.perf_counter() - began:.1f} s",
                    end="",
                )
    print()


if __name__ == "__main__":
    main()
