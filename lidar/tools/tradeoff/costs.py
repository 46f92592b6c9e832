"""CPU time, bytes and peak memory of the variants of a sensor."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.memory import peak_memory
from geoscene.support.progress import Progress
from lidar.dataset.formats.table import cloud_table, records
from lidar.dataset.png import depth_to_counts, encode_png, feature_to_image
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.scan import report
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.tools.tradeoff.bench import FAST, Bench, swept
from lidar.tools.tradeoff.errors import ErrorEstimate, median
from lidar.tools.tradeoff.images import image
from lidar.tools.tradeoff.variants import SettingVariant

Variant = SettingVariant[Any]


def costs(
    bench: Bench,
    sensor: Scanner | Camera,
    *,
    variants: Sequence[Variant],
    repetitions: int,
    progress: Progress,
) -> list[dict[str, ErrorEstimate]]:
    """CPU seconds and bytes per simulated second and peak memory of variants, measured on whole frames.

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
            spent, size = frame_cost(bench, sensor, variant=variant, frame=frame)
            if k >= 0:
                seconds[i].append(spent * rate)
                sizes[i].append(size * rate)
    progress(f"memory of {sensor.name}", 0, total=0)
    memory = peaks(bench, sensor, variants=variants)
    seed = bench.plan.options.seed
    return [
        {
            "cpu_s": median(seconds[i], seed=seed),
            "bytes": median(sizes[i], seed=seed),
            "memory_bytes": median([memory[i]], seed=seed),
        }
        for i in range(len(variants))
    ]


def frame_cost(bench: Bench, sensor: Scanner | Camera, *, variant: Variant, frame: int) -> tuple[float, int]:
    """CPU seconds of a whole frame as a drive simulates it, and the bytes of its points or images."""
    world = bench.world(
        sensor,
        frame,
        backend=FAST,
        scene=variant.scene,
        traffic=variant.traffic,
        settings=variant.world,
    )
    began = time.process_time()
    if isinstance(sensor, Camera):
        shot = bench.shot(sensor, frame)
        size = _encode(image(shot, world=world, settings=variant.used, resolution=variant.resolution), sensor)
    else:
        sweep = swept(bench.plan, sensor, frame=frame, world=world, settings=variant.used)
        size = int(records(cloud_table(report(*sweep))).nbytes)
    return time.process_time() - began, size


def _encode(frame: CameraImage, camera: Camera) -> int:
    """Bytes of the images of a frame as PNG, as a drive writes them; optical flow is left out."""
    images: dict[str, NDArray[np.uint8] | NDArray[np.uint16] | None] = {
        "rgb": frame.rgb,
        "depth": depth_to_counts(frame.depth),
        "semantic": frame.klass,
        "instance": feature_to_image(frame.feature),
    }
    written = (images.get(kind) for kind in camera.spec.images)
    return sum(len(encode_png(pixels)) for pixels in written if pixels is not None)


def peaks(bench: Bench, sensor: Scanner | Camera, *, variants: Sequence[Variant]) -> list[int]:
    """Bytes by which a frame of each variant, with its world, raises the peak memory of a new process."""
    first = bench.frames[sensor.name][:1]
    bench = replace(bench, frames={sensor.name: first}, _worlds={})
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload([__name__])  # imported once, not by each process
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        return list(pool.map(partial(_growth, bench=bench, sensor=sensor), variants))


def _growth(variant: Variant, *, bench: Bench, sensor: Scanner | Camera) -> int:
    before = peak_memory()
    frame_cost(bench, sensor, variant=variant, frame=bench.frames[sensor.name][0])
    return peak_memory() - before
