"""Errors and costs of the settings of a scanner or a camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Generic, TypeVar

from geoscene.support.progress import Progress
from geoscene.typing import Ints
from lidar.options import TradeoffOptions
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.tools.tradeoff.bench import EXACT, FAST, Bench, chosen_pulses, returns_of
from lidar.tools.tradeoff.comparison import Kind, SensorComparison, VariantRow
from lidar.tools.tradeoff.costs import costs
from lidar.tools.tradeoff.errors import (
    IMAGE_STATISTICS,
    STATISTICS,
    FrameDifferences,
    ImageError,
    PulseReturns,
    estimates,
    frame_error,
)
from lidar.tools.tradeoff.images import BLOCK, Pixels, blocks_of_frame, image_error, pixels
from lidar.tools.tradeoff.variants import (
    MODELS,
    OF_EMBREE,
    Basis,
    S,
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

M = TypeVar("M")
"""Measurement of a sample: returns of pulses, or pixels."""

E = TypeVar("E")
"""Differences of a measurement from the reference."""


@dataclass(frozen=True)
class FrameSample(Generic[S, M, E]):
    """Some pulses or pixels of a frame of a sensor, to be simulated with different settings.

    size    : number of pulses or pixels
    measure : simulates them in a world with settings; the last argument is `SettingVariant.resolution`
    error   : differences of a measurement from the reference, with the same last argument
    equal   : whether two measurements are the same
    """

    bench: Bench
    sensor: Scanner | Camera
    frame: int
    size: int
    measure: Callable[[World, S, int], M]
    error: Callable[[M, M, int], E]
    equal: Callable[[M, M], bool]
    _known: dict[tuple[tuple[str, object], ...], M] = field(default_factory=dict)

    def exact(self, basis: Basis[S], settings: S) -> M:
        """The measurement with settings of a reference, in the whole world."""
        return self._simulate(basis.variant(), settings, world=WHOLE, backend=EXACT)

    def combined(self, variant: SettingVariant[S]) -> M:
        """The measurement with the user's settings, changed as in a variant."""
        if variant.changes not in self._known:
            self._known[variant.changes] = self._simulate(
                variant, variant.used, world=variant.world, backend=FAST
            )
        return self._known[variant.changes]

    def alone(self, variant: SettingVariant[S]) -> M:
        """The measurement with the reference's settings, changed as in a variant."""
        backend = FAST if variant.names <= OF_EMBREE else EXACT
        return self._simulate(variant, variant.alone, world=variant.alone_world, backend=backend)

    def _simulate(self, variant: SettingVariant[S], settings: S, *, world: WorldSettings, backend: str) -> M:
        around = self.bench.world(
            self.sensor,
            self.frame,
            backend=backend,
            scene=variant.scene,
            traffic=variant.traffic,
            settings=world,
        )
        return self.measure(around, settings, variant.resolution)


_Pulses = FrameSample[ScannerSettings, PulseReturns, FrameDifferences]
_Blocks = FrameSample[CameraSettings, Pixels, ImageError]


@dataclass(frozen=True)
class Method(Generic[S, M, E]):
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
    basis: Basis[S]
    second: S
    samples: Callable[[int], tuple[FrameSample[S, M, E], FrameSample[S, M, E]]]
    statistics: Mapping[str, Callable[[Sequence[E]], float]]


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
        return _compare(bench, method, sensor=sensor, compared=compared, scenes=scenes, progress=progress)
    images = camera_method(bench, sensor, compared=compared)
    return _compare(bench, images, sensor=sensor, compared=compared, scenes=scenes, progress=progress)


def scanner_method(
    bench: Bench, scanner: Scanner, *, compared: TradeoffOptions
) -> Method[ScannerSettings, PulseReturns, FrameDifferences]:
    """Compare pulses at random, by ranges and points of their returns."""
    settings, rays = bench.plan.options.recording_settings, compared.reference_rays
    exact = scanner_reference(settings.scanner, rays=rays)
    per_frame = -(-compared.pulses // len(bench.frames[scanner.name]))

    def samples(frame: int) -> tuple[_Pulses, _Pulses]:
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
        second=replace(exact, rays=next_step(rays)),
        samples=samples,
        statistics=STATISTICS,
    )


def camera_method(
    bench: Bench, camera: Camera, *, compared: TradeoffOptions
) -> Method[CameraSettings, Pixels, ImageError]:
    """Compare blocks of pixels, spread evenly over the image; every fourth of them alone."""
    settings = bench.plan.options.recording_settings
    exact = camera_reference(settings.camera, exposed=camera.spec.exposure_ns > 0)
    per_frame = -(-compared.pixels // (len(bench.frames[camera.name]) * BLOCK**2))
    rays = exact.supersample**2 * exact.moments(camera.spec)

    def samples(frame: int) -> tuple[_Blocks, _Blocks]:
        blocks = blocks_of_frame(camera.spec, per_frame, frame=frame, seed=bench.plan.options.seed)
        shot = bench.shot(camera, frame)

        def sample(of: Ints) -> _Blocks:
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


def _compare(
    bench: Bench,
    method: Method[S, M, E],
    *,
    sensor: Scanner | Camera,
    compared: TradeoffOptions,
    scenes: Sequence[str],
    progress: Progress,
) -> SensorComparison:
    """The rows of a sensor."""
    basis, frames = method.basis, bench.frames[sensor.name]
    traffic = bench.plan.actors is not None
    variants = variants_of(basis, compared=compared.compare, scenes=scenes, traffic=traffic)
    combined: list[list[E]] = [[] for _ in variants]
    alone: list[list[E]] = [[] for _ in variants]
    idle = [{change: True for change, _ in without_each(basis, variant)} for variant in variants]
    residual: list[E] = []
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
    return SensorComparison(
        method.name,
        method.reference,
        figures(residual),
        tuple(rows),
        size,
        len(frames),
        method.kind,
    )


def _note(variant: SettingVariant[S], idle: Sequence[str]) -> tuple[str, bool]:
    """The note of a variant, and whether it can be recommended.

    idle : changes without an effect on the sample; they may have a rare one of unknown size, or save nothing
    """
    notes = [f"no effect on what was sampled: {', '.join(idle)}"] if idle else []
    notes += ["changes what is modelled"] if variant.names & MODELS else []
    return "; ".join(notes), variant.choice and not idle
