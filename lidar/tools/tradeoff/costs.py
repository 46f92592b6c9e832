"""CPU time, bytes and peak memory of the variants of a sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from geoscene.support.progress import Progress
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.tools.tradeoff.errors import ErrorEstimate, median
from lidar.tools.tradeoff.memory import Task, peaks
from lidar.tools.tradeoff.simulate import FAST, Bench
from lidar.tools.tradeoff.variants import S, SettingVariant
from lidar.world.world import World


def costs(
    bench: Bench,
    sensor: Scanner | Camera,
    *,
    variants: Sequence[SettingVariant[S]],
    frame_cost: Callable[[int, World, SettingVariant[S]], tuple[float, int]],
    repetitions: int,
    progress: Progress,
) -> list[dict[str, ErrorEstimate]]:
    """CPU seconds and bytes per simulated second and peak memory of variants.

    frame_cost : CPU seconds and bytes of a whole frame

    Repetitions are interleaved: each times one frame with every variant before the next one begins.
    """
    frames, rate = bench.frames[sensor.name], 1e9 / sensor.period_ns
    seconds: list[list[float]] = [[] for _ in variants]
    sizes: list[list[float]] = [[] for _ in variants]
    for k in range(-1, repetitions):  # the first one only warms up, with the settings as asked
        frame = frames[k % len(frames)]
        for i, variant in enumerate(variants if k >= 0 else variants[:1]):
            progress(
                f"timing {sensor.name}", max(k, 0) * len(variants) + i, total=repetitions * len(variants)
            )
            world = bench.world(
                sensor,
                frame,
                backend=FAST,
                scene=variant.scene,
                traffic=variant.traffic,
                settings=variant.world,
            )
            spent, size = frame_cost(frame, world, variant)
            if k >= 0:
                seconds[i].append(spent * rate)
                sizes[i].append(size * rate)
    progress(f"memory of {sensor.name}", 0, total=0)
    memory = peaks([_task(bench, sensor, variant=variant) for variant in variants])
    seed = bench.plan.options.seed
    return [
        {
            "cpu_s": median(seconds[i], seed=seed),
            "bytes": median(sizes[i], seed=seed),
            "memory_bytes": median([memory[i]], seed=seed),
        }
        for i in range(len(variants))
    ]


def _task(bench: Bench, sensor: Scanner | Camera, *, variant: SettingVariant[S]) -> Task:
    plan = bench.plan
    frame = bench.frames[sensor.name][0]
    start = sensor.frame_start_ns(frame)
    xy = plan.trajectory.at(np.array([start, start + sensor.period_ns])).position[:, :2]
    (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return Task(
        bench.scenes[variant.scene].path,
        sensor,
        variant.used,
        plan.trajectory,
        plan.actors if variant.traffic else None,
        frame,
        region=(x0, y0, x1, y1),
        margin=plan.max_range,
        world=variant.world,
        resolution=variant.resolution,
        sun=bench.sun(start),
    )
