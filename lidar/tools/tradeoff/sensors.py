"""Errors and costs of the settings of a scanner or a camera: CPU time, bytes and peak memory."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.processes import peak_memory
from geoscene.support.progress import Progress
from geoscene.typing import Ints
from lidar.dataset.formats.table import cloud_table, records
from lidar.dataset.png import depth_to_counts, encode_png, feature_to_image
from lidar.options.accuracy import TradeoffOptions
from lidar.sensors.camera.render import CameraImage
from lidar.sensors.laser.scan import report
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.tools.tradeoff.bench import (
    BLOCK,
    EXACT,
    FAST,
    Bench,
    Pixels,
    blocks_of_frame,
    chosen_pulses,
    image,
    image_error,
    pixels,
    returns_of,
    swept,
)
from lidar.tools.tradeoff.errors import (
    IMAGE_STATISTICS,
    STATISTICS,
    ErrorEstimate,
    Kind,
    PulseReturns,
    SensorComparison,
    Statistic,
    VariantRow,
    estimates,
    frame_error,
    median,
)
from lidar.tools.tradeoff.variants import (
    MODELS,
    OF_EMBREE,
    Basis,
    SettingVariant,
    camera_reference,
    coarser,
    next_step,
    noiseless,
    scanner_reference,
    variants_of,
    without_each,
)
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings
from lidar.world.world import World


@dataclass(frozen=True)
class FrameSample:
    """Some pulses or pixels of a frame of a sensor, to be simulated with different settings.

    size    : number of pulses or pixels
    measure : simulates them in a world with settings: `PulseReturns` or `Pixels`; the last argument is
              `SettingVariant.resolution`
    error   : differences of a measurement from the reference, with the same last argument
    equal   : whether two measurements are the same
    """

    bench: Bench
    sensor: Scanner | Camera
    frame: int
    size: int
    measure: Callable[[World, Any, int], Any]
    error: Callable[[Any, Any, int], Any]
    equal: Callable[[Any, Any], bool]
    _known: dict[tuple[tuple[str, object], ...], Any] = field(default_factory=dict)

    def exact(self, basis: Basis, settings: Any) -> Any:
        """The measurement with settings of a reference, in the whole world."""
        return self._simulate(basis.variant(), settings, world=WHOLE, backend=EXACT)

    def combined(self, variant: SettingVariant) -> Any:
        """The measurement with the user's settings, changed as in a variant."""
        if variant.changes not in self._known:
            self._known[variant.changes] = self._simulate(
                variant, variant.used, world=variant.world, backend=FAST
            )
        return self._known[variant.changes]

    def alone(self, variant: SettingVariant) -> Any:
        """The measurement with the reference's settings, changed as in a variant."""
        backend = FAST if variant.names <= OF_EMBREE else EXACT
        return self._simulate(variant, variant.alone, world=variant.alone_world, backend=backend)

    def _simulate(self, variant: SettingVariant, settings: Any, *, world: WorldSettings, backend: str) -> Any:
        scene, traffic = variant.scene, variant.traffic
        around = self.bench.world(
            self.sensor, self.frame, backend=backend, scene=scene, traffic=traffic, settings=world
        )
        return self.measure(around, settings, variant.resolution)


@dataclass(frozen=True)
class Method:
    """Functions that compare the settings of a sensor.

    name       : of the sensor, with its preset or size
    reference  : what errors are measured against, in words
    basis      : settings that variants start from
    second     : settings of a reference with another number of rays
    samples    : of a frame: the sample on which settings are compared, and the one for "alone"
    statistics : figures of differences, by name
    """

    kind: Kind
    name: str
    reference: str
    basis: Basis
    second: Any
    samples: Callable[[int], tuple[FrameSample, FrameSample]]
    statistics: Mapping[str, Statistic]


def compare_sensor(
    bench: Bench,
    sensor: Scanner | Camera,
    *,
    compared: TradeoffOptions,
    scenes: Sequence[str],
    progress: Progress,
) -> SensorComparison:
    """The comparison of the settings of a sensor; ``scenes`` are labels of the scenes after the first."""
    if isinstance(sensor, Scanner):
        method = scanner_method(bench, sensor, compared=compared)
    else:
        method = camera_method(bench, sensor, compared=compared)
    basis, frames = method.basis, bench.frames[sensor.name]
    traffic = bench.plan.actors is not None
    variants = variants_of(basis, compared=compared.compare, scenes=scenes, traffic=traffic)
    combined: list[list[Any]] = [[] for _ in variants]
    alone: list[list[Any]] = [[] for _ in variants]
    idle = [{change: True for change, _ in without_each(basis, variant)} for variant in variants]
    residual: list[Any] = []
    size = 0
    for k, frame in enumerate(frames):
        sample, part = method.samples(frame)
        truth = sample.exact(basis, basis.exact)
        truth_of_part = truth if part is sample else part.exact(basis, basis.exact)
        residual.append(sample.error(sample.exact(basis, method.second), truth, 1))
        size += sample.size
        for i, variant in enumerate(variants):
            progress(f"comparing {sensor.name}", k * len(variants) + i, total=len(frames) * len(variants))
            found, factor = sample.combined(variant), variant.resolution
            combined[i].append(sample.error(found, truth, factor))
            for change, rest in without_each(basis, variant):
                idle[i][change] &= sample.equal(found, sample.combined(rest))
            if len(variant.changes) == 1:
                alone[i].append(part.error(part.alone(variant), truth_of_part, factor))
    spent = costs(bench, sensor, variants=variants, repetitions=compared.repetitions, progress=progress)
    figures = partial(estimates, seed=bench.plan.options.seed, statistics=method.statistics)
    rows = []
    for i, variant in enumerate(variants):
        note, choice = _note(variant, [change for change, same in idle[i].items() if same])
        label = variant.label or f"as asked ({basis.label})"
        rows.append(VariantRow(label, figures(combined[i]), figures(alone[i]), spent[i], note, choice))
    name, reference = method.name, method.reference
    return SensorComparison(name, reference, figures(residual), tuple(rows), size, len(frames), method.kind)


def _note(variant: SettingVariant, idle: Sequence[str]) -> tuple[str, bool]:
    """The note of a variant, and whether it can be recommended.

    idle : changes without an effect on the sample; they may have a rare one of unknown size, or save nothing
    """
    notes = [f"no effect on what was sampled: {', '.join(idle)}"] if idle else []
    notes += ["changes what is modelled"] if variant.names & MODELS else []
    return "; ".join(notes), variant.choice and not idle


def scanner_method(bench: Bench, scanner: Scanner, *, compared: TradeoffOptions) -> Method:
    """Compare pulses at random, by ranges and points of their returns."""
    settings, rays = bench.plan.options.recording_settings, compared.reference_rays
    exact = scanner_reference(settings.scanner, rays=rays)
    per_frame = -(-compared.pulses // len(bench.frames[scanner.name]))

    def samples(frame: int) -> tuple[FrameSample, FrameSample]:
        count = len(firings(scanner.sensor, frame))
        pulses = chosen_pulses(count, per_frame, frame=frame, seed=bench.plan.options.seed)
        sample = FrameSample(
            bench,
            scanner,
            frame,
            len(pulses),
            measure=lambda world, one, _: returns_of(
                bench.plan, scanner, frame=frame, world=world, settings=one, pulses=pulses
            ),
            error=lambda found, truth, _: frame_error(found, truth),
            equal=PulseReturns.equals,
        )
        return sample, sample

    return Method(
        "scanner",
        f"{scanner.name} ({scanner.spec.preset})",
        f"float64 ray casting, {rays} rays per pulse, a pose for every firing; 1.5 times as many rays",
        Basis(noiseless(settings.scanner), exact, settings.world, bench.plan.scene.relief),
        second=exact.changed(rays=next_step(rays)),
        samples=samples,
        statistics=STATISTICS,
    )


def camera_method(bench: Bench, camera: Camera, *, compared: TradeoffOptions) -> Method:
    """Compare blocks of pixels, spread evenly over the image; every fourth of them alone."""
    settings = bench.plan.options.recording_settings
    exact = camera_reference(settings.camera, exposed=camera.spec.exposure_ns > 0)
    per_frame = -(-compared.pixels // (len(bench.frames[camera.name]) * BLOCK**2))
    rays = exact.supersample**2 * exact.moments(camera.spec)

    def samples(frame: int) -> tuple[FrameSample, FrameSample]:
        blocks = blocks_of_frame(camera.spec, per_frame, frame=frame, seed=bench.plan.options.seed)
        shot = bench.shot(camera, frame)

        def sample(of: Ints) -> FrameSample:
            return FrameSample(
                bench,
                camera,
                frame,
                len(of) * BLOCK**2,
                measure=lambda world, one, factor: pixels(
                    shot, of, world=world, settings=one, resolution=factor
                ),
                error=lambda found, truth, factor: image_error(found.enlarged(factor), truth),
                equal=Pixels.equals,
            )

        return sample(blocks), sample(blocks[::4])

    return Method(
        "camera",
        f"{camera.name} ({camera.spec.width} x {camera.spec.height} pixels)",
        f"float64 ray casting, {rays} rays per pixel, shadows and detail; about half as many rays",
        Basis(replace(settings.camera, camera_noise=False), exact, settings.world, bench.plan.scene.relief),
        second=coarser(exact),
        samples=samples,
        statistics=IMAGE_STATISTICS,
    )


def costs(
    bench: Bench,
    sensor: Scanner | Camera,
    *,
    variants: Sequence[SettingVariant],
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


def frame_cost(
    bench: Bench, sensor: Scanner | Camera, *, variant: SettingVariant, frame: int
) -> tuple[float, int]:
    """CPU seconds of a whole frame as a drive simulates it, and the bytes of its points or images."""
    scene, traffic = variant.scene, variant.traffic
    world = bench.world(sensor, frame, backend=FAST, scene=scene, traffic=traffic, settings=variant.world)
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


def peaks(bench: Bench, sensor: Scanner | Camera, *, variants: Sequence[SettingVariant]) -> list[int]:
    """Bytes by which a frame of each variant, with its world, raises the peak memory of a new process."""
    first = bench.frames[sensor.name][:1]
    bench = replace(bench, frames={sensor.name: first}, _worlds={})
    method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
    context = multiprocessing.get_context(method)
    if method == "forkserver":
        context.set_forkserver_preload([__name__])  # imported once, not by each process
    with ProcessPoolExecutor(1, mp_context=context, max_tasks_per_child=1) as pool:
        return list(pool.map(partial(_growth, bench=bench, sensor=sensor), variants))


def _growth(variant: SettingVariant, *, bench: Bench, sensor: Scanner | Camera) -> int:
    before = peak_memory()
    frame_cost(bench, sensor, variant=variant, frame=bench.frames[sensor.name][0])
    return peak_memory() - before
