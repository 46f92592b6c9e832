"""Growth of time and memory: buildings, triangles, rays, frames, road users and workers."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from make_osm import make_city, write_city

from bench.casting import SENSORS, street
from bench.drives import world_of
from bench.growth import Curve
from bench.maps import built
from bench.measure import MOST_PROCESSES, Spent, alone, measured
from bench.measure import Case as Work
from bench.scenes import Setup, boxes_on_hills
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import read_osm
from lidar.raycast import Caster
from lidar.sensors.laser.scan import scan
from lidar.sensors.physics.settings import ScannerSettings
from lidar.settings import settings_of
from lidar.simulation.drive import drive
from lidar.simulation.plan import plan_drive
from lidar.world.actor_shapes import catalogue
from lidar.world.world import World

Prepared = Callable[[], object]

ENOUGH_S = 10.0
"""CPU seconds after which a size is not repeated."""

_SIZES: dict[str, tuple[Sequence[int], Sequence[int], Sequence[int]]] = {
    "buildings": ((25, 50, 100), (100, 300, 1000, 3000, 10_000), (30_000, 100_000)),
    "triangles": (
        (60_000, 120_000, 240_000),
        (40_000, 120_000, 400_000, 1_200_000, 4_000_000),
        (12_000_000,),
    ),
    "rays per pulse": ((1, 7, 19), (1, 7, 19, 61, 217), ()),
    "frames": ((10, 20, 40), (5, 15, 50, 150, 500), (2000,)),
    "road users": ((30, 100, 300), (30, 100, 300, 1000, 3000), (10_000,)),
}
"""Sizes of quick and of whole runs, and those that full runs add."""

_RATE = 10
"""Frames per second of the VLP-16."""


def sizes(setup: Setup, what: str) -> tuple[int, ...]:
    """The sizes of a curve of the run, growing."""
    if what == "buildings" and setup.buildings:
        return tuple(sorted(set(setup.buildings)))
    quick, whole, more = _SIZES[what]
    return tuple(quick if setup.quick else (*whole, *(more if setup.full else ())))


def growth(setup: Setup) -> Iterator[Curve]:
    """All curves; memory is that of processes of their own."""
    cities = {n: setup.folder / f"city_{n}.osm.pbf" for n in sizes(setup, "buildings")}
    for count, path in cities.items():
        write_city(make_city(count, seed=0), path)
    yield from _alone(
        setup,
        "building",
        {n: (_building, path, setup.folder / "grown") for n, path in cities.items()},
        size="buildings",
        note="map to scene of a synthetic city, LoD 2, one process, without imports and compilation",
    )
    yield from _alone(
        setup,
        "tree of triangles",
        {n: (_tree, n) for n in sizes(setup, "triangles")},
        size="triangles",
        note="Embree's tree and the tables of a caster over a synthetic city, on one core",
    )
    yield _rays_into_triangles(setup)
    _ = setup.scene  # built here, not in the processes that are measured
    yield from _alone(
        setup,
        "scanning",
        {n: (_scan, setup, n) for n in sizes(setup, "rays per pulse")},
        size="rays per pulse",
        note=f"five VLP-16 frames in {setup.town}",
    )
    yield from _alone(
        setup,
        "driving",
        {n: (_drive, setup, n) for n in sizes(setup, "frames")},
        size="frames",
        note="a VLP-16 to PCD, from planning to files, one worker, without imports and compilation",
    )
    yield _road_users(setup)
    yield from _workers(setup, cities)


def _alone(
    setup: Setup,
    name: str,
    tasks: dict[int, tuple[Any, ...]],
    *,
    size: str,
    note: str,
) -> Iterator[Curve]:
    """Curves of CPU time and memory of work in processes of its own, all sizes by turns."""
    x, spent = _processes(setup, {n: partial(alone, *task) for n, task in tasks.items()})
    yield Curve(name, size, "CPU s", x, tuple(s.cpu_s for s in spent), note)
    yield Curve(name, size, "bytes", x, tuple(float(s.peak_bytes) for s in spent), note)


def _processes(setup: Setup, tasks: dict[int, Callable[[], Spent]]) -> tuple[tuple[float, ...], list[Spent]]:
    """Sizes and costs of tasks in processes, by turns; one that took `ENOUGH_S` is not repeated."""
    spent: dict[int, list[Spent]] = {n: [] for n in tasks}
    for _ in range(min(setup.repetitions, MOST_PROCESSES)):
        for n, task in tasks.items():
            if sum(s.cpu_s for s in spent[n]) < ENOUGH_S:
                spent[n].append(task())
    return tuple(float(n) for n in spent for _ in spent[n]), [s for costs in spent.values() for s in costs]


def _building(city: Path, out: Path) -> Prepared:
    small = city.with_name("warm.osm.pbf")
    write_city(make_city(20, seed=1), small)
    build(read_osm(small), out, overwrite=True)

    def work() -> None:
        shutil.rmtree(out)
        build(read_osm(city), out, options=BuildOptions(), overwrite=True)

    return work


def _tree(triangles: int) -> Prepared:
    vertices, faces = boxes_on_hills(triangles)
    Caster(*boxes_on_hills(100.0)).cast([0.0, 0.0, 99.0], [[0.0, 0.0, -1.0]])
    return lambda: Caster(vertices, faces).cast([0.0, 0.0, 99.0], [[0.0, 0.0, -1.0]])


def _rays_into_triangles(setup: Setup) -> Curve:
    """CPU time of 100 VLP-16 frames against triangles, by turns in this process."""
    casters = {n: Caster(*boxes_on_hills(n)) for n in sizes(setup, "triangles")}
    directions, index = SENSORS["VLP-16"]()
    (poses,) = street(1, int(index.max()) + 1)

    def frames(count: int) -> None:
        for _ in range(100):
            casters[count].cast_posed(poses, index, directions=directions)

    note = "100 VLP-16 frames in a tree of so many triangles"
    return _by_turns(setup, "rays", tuple(casters), frames, size="triangles", note=note)


def _scan(setup: Setup, rays: int) -> Prepared:
    plan = setup.plan("VLP-16", seconds=0.5)
    world, (scanner,) = world_of(plan), plan.sensors
    mount = scanner.spec.mount

    def frames(settings: ScannerSettings, count: int) -> None:
        for k in range(count):
            scan(scanner.sensor, mount, trajectory=plan.trajectory, world=world, frame=k, settings=settings)

    for warm in (1, 7):  # one ray and several take different ways
        frames(settings_of("standard", [("rays", str(warm))])[0], 1)
    return partial(frames, settings_of("standard", [("rays", str(rays))])[0], 5)


def _by_turns(
    setup: Setup, name: str, counts: Sequence[int], work: Callable[[int], object], *, size: str, note: str
) -> Curve:
    case = Work("growth", name, 1, "", {str(n): partial(work, n) for n in counts})
    found = measured(case, repetitions=setup.repetitions)
    pairs = [(float(n), s.cpu_s) for n in counts for s in found.spent[str(n)]]
    return Curve(name, size, "CPU s", *zip(*pairs, strict=True), note)


def _drive(setup: Setup, frames: int, workers: int = 1) -> Prepared:
    out = setup.folder / "grown_drive"
    drive(setup.scene, out, options=setup.options("VLP-16", seconds=0.5), overwrite=True)
    options = setup.options("VLP-16", seconds=frames / _RATE, workers=workers)
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

    note = f"ten frames, {len(shapes)} shapes"
    return _by_turns(setup, "placing", sizes(setup, "road users"), place, size="road users", note=note)


def _bounded(counts: Iterable[int], most: int) -> int:
    """The greatest size up to a bound, or else the smallest."""
    found = sorted(counts)
    return max((n for n in found if n <= most), default=found[0])


def _workers(setup: Setup, cities: dict[int, Path]) -> Iterator[Curve]:
    """Wall time and memory of builds and drives by one, two, four ... workers, at most one a core."""
    counts = [1, 2, *(2**k for k in range(2, 10) if 2**k <= len(os.sched_getaffinity(0)))]
    buildings, frames = _bounded(cities, 3000), _bounded(sizes(setup, "frames"), 500)

    def built_by(workers: int) -> Spent:
        return built(cities[buildings], setup.folder / "grown", workers=workers)

    def driven(workers: int) -> Spent:
        return alone(_drive, setup, frames, workers)

    for name, work, size in (
        ("building", built_by, f"{buildings:,} buildings"),
        ("driving", driven, f"{frames} frames"),
    ):
        x, spent = _processes(setup, {n: partial(work, n) for n in counts})
        note = f"{size}; with -1, twice as many workers would take half the time"
        yield Curve(name, "workers", "wall s", x, tuple(s.wall_s for s in spent), note)
        yield Curve(name, "workers", "bytes", x, tuple(float(s.peak_bytes) for s in spent), note)
