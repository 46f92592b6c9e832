"""Growth of time and memory: buildings, triangles, rays, frames, road users and workers."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from make_osm import make_city, write_city

from bench.casting import SENSORS, street
from bench.drives import world_of
from bench.growth import Curve
from bench.maps import build_command
from bench.measure import MOST_PROCESSES, Spent, alone, command, measured
from bench.measure import Case as Work
from bench.scenes import Setup, boxes_on_hills
from geoscene.options import BuildOptions
from geoscene.pipeline import build
from geoscene.sources import read_osm
from lidar.physics.settings import ScannerSettings
from lidar.pipeline import drive
from lidar.plan import plan_drive
from lidar.raycast import Caster
from lidar.sensors.scan import scan
from lidar.settings import settings_of
from lidar.world.actor_shapes import catalogue
from lidar.world.world import World

Prepared = Callable[[], object]


def growth(setup: Setup) -> Iterator[Curve]:
    """All curves; memory is that of processes of their own."""
    sizes = setup.sizes or ((25, 50, 100) if setup.quick else (500, 1000, 2000, 4000))
    cities = {n: setup.folder / f"city_{n}.osm.pbf" for n in sizes}
    for count, path in cities.items():
        write_city(make_city(count, seed=0), path)
    yield from _alone(
        setup,
        "building",
        {float(n): (_building, path, setup.folder / "grown") for n, path in cities.items()},
        size="buildings",
        note="map to scene of a synthetic city, LoD 2, one process, without imports and compilation",
    )
    triangles = (6e4, 1.2e5, 2.4e5) if setup.quick else (1e5, 2e5, 4e5, 8e5, 1.6e6)
    yield from _alone(
        setup,
        "tree of triangles",
        {n: (_tree, n) for n in triangles},
        size="triangles",
        note="Embree's tree and the tables of a caster over a synthetic city; Embree builds on all cores",
    )
    yield _rays_into_triangles(setup, triangles)
    _ = setup.scene  # built here, not in the processes that are measured
    yield from _alone(
        setup,
        "scanning",
        {float(n): (_scan, setup, n) for n in (1, 7, 19, 37, 61)},
        size="rays per pulse",
        note=f"five VLP-16 frames in {setup.town}",
    )
    seconds = (1.0, 2.0, 4.0) if setup.quick else (5.0, 10.0, 20.0, 40.0)
    yield from _alone(
        setup,
        "driving",
        {10 * s: (_drive, setup, s) for s in seconds},
        size="frames",
        note="a VLP-16 to PCD, from planning to files, one worker, without imports and compilation",
    )
    yield _road_users(setup)
    yield from _workers(setup, cities[sizes[-1]], seconds=seconds[-1])


def _alone(
    setup: Setup,
    name: str,
    tasks: dict[float, tuple[Any, ...]],
    *,
    size: str,
    note: str,
) -> Iterator[Curve]:
    """Curves of CPU time and memory of work in processes of its own, all sizes by turns."""
    spent = [
        (x, alone(*task)) for _ in range(min(setup.repetitions, MOST_PROCESSES)) for x, task in tasks.items()
    ]
    x = tuple(x for x, _ in spent)
    yield Curve(name, size, "CPU s", x, tuple(s.cpu_s for _, s in spent), note)
    yield Curve(name, size, "bytes", x, tuple(float(s.peak_bytes) for _, s in spent), note)


def _building(city: Path, out: Path) -> Prepared:
    small = city.with_name("warm.osm.pbf")
    write_city(make_city(20, seed=1), small)
    build(read_osm(small), out, overwrite=True)

    def work() -> None:
        shutil.rmtree(out)
        build(read_osm(city), out, options=BuildOptions(), overwrite=True)

    return work


def _tree(triangles: float) -> Prepared:
    vertices, faces = boxes_on_hills(triangles)
    Caster(*boxes_on_hills(100.0)).cast([0.0, 0.0, 99.0], [[0.0, 0.0, -1.0]])
    return lambda: Caster(vertices, faces).cast([0.0, 0.0, 99.0], [[0.0, 0.0, -1.0]])


def _rays_into_triangles(setup: Setup, triangles: Sequence[float]) -> Curve:
    """CPU time of ten VLP-16 frames against triangles, by turns in this process."""
    casters = {round(n): Caster(*boxes_on_hills(n)) for n in triangles}
    directions, index = SENSORS["VLP-16"]()
    (poses,) = street(1, int(index.max()) + 1)

    def frames(count: int) -> None:
        for _ in range(10):
            casters[count].cast_posed(poses, index, directions=directions)

    note = "ten VLP-16 frames in a tree of so many triangles"
    return _by_turns(setup, "rays", tuple(casters), frames, size="triangles", note=note)


def _scan(setup: Setup, rays: int) -> Prepared:
    plan = setup.plan("VLP-16", seconds=0.5)
    world, (scanner,) = world_of(plan), plan.sensors
    mount = scanner.spec.mount

    def frames(settings: ScannerSettings, count: int) -> None:
        for k in range(count):
            scan(scanner.sensor, mount, trajectory=plan.trajectory, world=world, frame=k, settings=settings)

    for warm in (1, 7):  # one ray and several take different ways
        frames(settings_of("standard", [("rays", str(warm))]).lidar, 1)
    return partial(frames, settings_of("standard", [("rays", str(rays))]).lidar, 5)


def _by_turns(
    setup: Setup, name: str, sizes: Sequence[int], work: Callable[[int], object], *, size: str, note: str
) -> Curve:
    case = Work("growth", name, 1, "", {str(n): partial(work, n) for n in sizes})
    found = measured(case, repetitions=setup.repetitions)
    pairs = [(float(n), s.cpu_s) for n in sizes for s in found.spent[str(n)]]
    return Curve(name, size, "CPU s", *zip(*pairs, strict=True), note)


def _drive(setup: Setup, seconds: float, workers: int = 1) -> Prepared:
    out = setup.folder / "grown_drive"
    drive(setup.scene, out, options=setup.options("VLP-16", seconds=0.5), overwrite=True)
    options = setup.options("VLP-16", seconds=seconds, workers=workers)
    return lambda: drive(setup.scene, out, options=options, overwrite=True)


def _road_users(setup: Setup) -> Curve:
    """CPU time to place road users in the world of a frame; 70 % stand still."""
    shapes = [shape.mesh for shape in catalogue().values()]
    plan = plan_drive(setup.scene, setup.options("VLP-16", seconds=0.5))
    x, y = plan.trajectory.position[0, :2].tolist()
    world = World.load(setup.scene, region=(x - 1, y - 1, x + 1, y + 1), margin=200.0, actors=shapes)

    def place(count: int) -> None:
        rng = np.random.default_rng(1)
        shape = rng.integers(0, len(shapes), count).astype(np.int32)
        transform = np.tile(np.eye(3, 4), (count, 3, 1, 1))
        transform[:, :, :2, 3] = rng.uniform(-200, 200, (count, 1, 2)) + np.array([x, y])
        transform[rng.random(count) >= 0.7, :, 0, 3] += np.array([0.0, 0.5, 1.0])
        for _ in range(10):
            world.place_actors(shape, transform, feature=np.arange(count, dtype=np.int32) + 10**6)

    return _by_turns(
        setup, "placing", (100, 200, 400, 800), place, size="road users", note="ten frames, 111 shapes"
    )


def _workers(setup: Setup, city: Path, *, seconds: float) -> Iterator[Curve]:
    """Wall time and memory of builds and drives by one and two workers."""

    def built(workers: int) -> Spent:
        return command(build_command(city, setup.folder / "grown", "--workers", str(workers)))

    def driven(workers: int) -> Spent:
        return alone(_drive, setup, seconds, workers)

    for name, work in (("building", built), ("driving", driven)):
        repetitions = range(min(setup.repetitions, MOST_PROCESSES))
        spent = [(float(n), work(n)) for _ in repetitions for n in (1, 2)]
        x = tuple(n for n, _ in spent)
        note = "the largest city or drive above; with -1, two workers would be twice as fast"
        yield Curve(name, "workers", "wall s", x, tuple(s.wall_s for _, s in spent), note)
        yield Curve(name, "workers", "bytes", x, tuple(float(s.peak_bytes) for _, s in spent), note)
