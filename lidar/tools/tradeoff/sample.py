"""Errors of the sensors of a drive in a sample of its frames, against the exact reference."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from math import inf, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.dataset.png import counts_to_depth, depth_to_counts
from lidar.errors import InputError
from lidar.options.accuracy import PERCENTS
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import MOST_RAYS, ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.simulation.frame_loop import chunks
from lidar.simulation.plan import DrivePlan
from lidar.tools.tradeoff.bench import (
    EXACT,
    FAST,
    Bench,
    Pixels,
    blocks_of_frame,
    chosen_pulses,
    image_error,
    pixels,
    returns_of,
)
from lidar.tools.tradeoff.errors import (
    IMAGE_STATISTICS,
    RESAMPLES,
    ErrorEstimate,
    ImageError,
    PulseReturns,
    percentile,
    resample,
    with_intervals,
)
from lidar.tools.tradeoff.variants import camera_reference, noiseless, scanner_reference

_SCREENED, _SCREENS = 6000, (1, 19)
"""Pulses of a frame that are screened, and their numbers of rays."""

_HARD, _EASY = 120, 240
"""Pulses compared with the reference: of those on which the screens differ most, and of the others."""

_EASY_RAYS = 217
"""Rays of the reference of the others."""

_BLOCKS, _FEWEST = 48, 12
"""Blocks of pixels of a frame that are compared, of all cameras, and of each at least."""

_GOLDEN = 0.6180339887498949
"""Multiples of it, modulo 1, are evenly spread, however many there are."""


class DriveSample:
    """Errors that settings of some sensors make in a sample of the frames of a drive.

    The sample is empty at first and grows; its frames are spread evenly over the drive. The same drive has
    the same sample.

    settings : of the sensors, which are scanners or cameras alone
    other    : whether it takes other frames than a small sample of the same drive without this
    """

    def __init__(
        self,
        plan: DrivePlan,
        sensors: Sequence[Scanner | Camera],
        *,
        settings: Sequence[Any],
        other: bool = False,
        progress: Progress,
    ) -> None:
        self.settings = settings
        self._plan, self._sensors, self._progress = plan, sensors, progress
        order = slice(None, None, -1 if other else 1)
        self._frames = {
            sensor.name: _spread_evenly(_working_frames(plan, sensor))[order] for sensor in sensors
        }
        self._truths: dict[tuple[str, int], ScannerTruth | CameraTruth] = {}
        self._errors: dict[tuple[str, int, int], Any] = {}  # by sensor, frame and row
        self._size = 0
        self._blocks = max(_FEWEST, _BLOCKS // max(len(sensors), 1))
        if idle := [name for name, frames in self._frames.items() if not len(frames)]:
            raise InputError(
                f"`rig`: {', '.join(idle)} has no frame in this drive, whose errors could be measured"
            )

    @property
    def counts(self) -> dict[str, int]:
        """Number of frames in the sample, by sensor."""
        return {name: min(self._size, len(frames)) for name, frames in self._frames.items()}

    @property
    def complete(self) -> bool:
        """Whether all frames of the drive are in the sample."""
        return all(len(frames) <= self._size for frames in self._frames.values())

    def grow(self, frames: int, rows: Sequence[int] | None = None) -> None:
        """Add frames until the sample has ``frames`` of each sensor, or all that there are.

        rows : numbers of the settings whose errors are measured in all of them; all by default
        """
        self._size = max(self._size, frames)
        wanted = range(len(self.settings)) if rows is None else rows
        chosen = {name: set(of[: self._size].tolist()) for name, of in self._frames.items()}
        jobs = [job for job in self._plan.jobs if job.frame in chosen.get(job.sensor.name, ())]
        jobs = [job for job in jobs if self._missing(job.sensor, frame=job.frame, rows=wanted)]
        done = 0
        for run, _ in chunks(jobs, self._plan.trajectory):
            numbers = {sensor.name: list[int]() for sensor in self._sensors}
            for job in run:
                numbers[job.sensor.name].append(job.frame)
            bench = Bench(
                self._plan, (self._plan.scene,), {name: tuple(of) for name, of in numbers.items() if of}
            )
            for job in run:
                self._progress("measuring errors", done, total=len(jobs))
                self._measure(bench, job.sensor, frame=job.frame, rows=wanted)
                done += 1
        self._progress("measuring errors", done, total=len(jobs))

    def figures(self, row: int) -> dict[str, dict[str, ErrorEstimate]]:
        """Figures of the errors of one of the settings, by sensor, with 95 % intervals.

        They are those of `range_estimates` and `image_figures`, the latter by resampling frames. They have
        been measured in all frames of the sample.
        """
        found = {}
        for sensor in self._sensors:
            every = self._frames[sensor.name]
            frames = [self._errors[sensor.name, frame, row] for frame in every[: self._size].tolist()]
            if isinstance(sensor, Scanner):
                found[sensor.name] = range_estimates(frames, complete=len(frames) == len(every))
            else:
                found[sensor.name] = resample(frames, seed=0, figures=partial(image_figures, camera=sensor))
        return found

    def _missing(self, sensor: Scanner | Camera, *, frame: int, rows: Sequence[int]) -> list[int]:
        """Those of some settings whose errors in a frame have not been measured."""
        return [row for row in rows if (sensor.name, frame, row) not in self._errors]

    def _measure(self, bench: Bench, sensor: Scanner | Camera, *, frame: int, rows: Sequence[int]) -> None:
        """Measure errors of some of the settings in a frame."""
        key = sensor.name, frame
        if key not in self._truths:
            self._truths[key] = (
                scanner_truth(bench, sensor, frame=frame, settings=self.settings[0])
                if isinstance(sensor, Scanner)
                else camera_truth(bench, sensor, frame=frame, settings=self.settings[0], blocks=self._blocks)
            )
        truth = self._truths[key]
        for row in self._missing(sensor, frame=frame, rows=rows):
            self._errors[sensor.name, frame, row] = truth.error(bench, self.settings[row])


def sensors_with(sensors: Sequence[Scanner | Camera], *, kinds: Collection[str]) -> list[Scanner | Camera]:
    """Sensors that have errors of some kinds: ranges, depths, colours."""
    images = {image for kind, image in (("colours", "rgb"), ("depths", "depth")) if kind in kinds}
    return [
        sensor
        for sensor in sensors
        if ("ranges" in kinds if isinstance(sensor, Scanner) else images & set(sensor.spec.images))
    ]


def _working_frames(plan: DrivePlan, sensor: Scanner | Camera) -> Ints:
    """Numbers of the frames of a sensor in which it works."""
    count = plan.frames[sensor.name]
    frames = np.arange(count)
    if plan.scanning_ns is None or isinstance(sensor, Camera):
        return frames
    starts = np.fromiter(map(sensor.frame_start_ns, range(count)), np.int64, count)
    first, last = plan.scanning_ns[:, 0], plan.scanning_ns[:, 1]
    span = np.searchsorted(first, starts, side="right") - 1
    return frames[(span >= 0) & (starts + sensor.period_ns <= last[np.maximum(span, 0)])]


def _spread_evenly(frames: Ints) -> Ints:
    """The frames in an order of which any successive ones are spread evenly over the drive."""
    return frames[np.argsort((np.arange(len(frames)) * _GOLDEN + 0.5) % 1.0, kind="stable")]


@dataclass(frozen=True, slots=True)
class SampledError:
    """Differences of some pulses of a frame from the reference, with weights by which they stand for all.

    range   : (m,) metres, absolute, of returns that both have
    weight  : (m,) number of returns for which each stands
    missed, extra, returns : numbers of returns that only the reference has, only the other, and all of the
                             reference
    """

    range: Float
    weight: Float
    missed: float
    extra: float
    returns: float


def sampled_error(found: PulseReturns, *, exact: PulseReturns, weights: Float) -> SampledError:
    """Differences between the returns of the same pulses; ``weights`` are by row of a pulse in its frame."""
    _, a, b = np.intersect1d(found.key, exact.key, assume_unique=True, return_indices=True)
    of_found, of_exact = (weights[returns.key // 256] for returns in (found, exact))
    total, both = float(of_exact.sum()), float(of_exact[b].sum())
    return SampledError(
        np.abs(found.range[a] - exact.range[b]),
        of_exact[b],
        missed=total - both,
        extra=float(of_found.sum()) - both,
        returns=total,
    )


@dataclass(frozen=True, slots=True)
class ScannerTruth:
    """Some pulses of a frame of a scanner and their true returns.

    pulses  : (k,) ascending rows of the frame's pulses
    weights : by row of a pulse in its frame, as of `SampledError`
    """

    scanner: Scanner
    frame: int
    pulses: NDArray[np.int64]
    weights: Float
    returns: PulseReturns

    def error(self, bench: Bench, settings: ScannerSettings) -> SampledError:
        """Errors that settings make."""
        found = _returns(
            bench, self.scanner, frame=self.frame, settings=noiseless(settings), pulses=self.pulses
        )
        return sampled_error(found, exact=self.returns, weights=self.weights)


def scanner_truth(bench: Bench, scanner: Scanner, *, frame: int, settings: ScannerSettings) -> ScannerTruth:
    """Pulses of a frame on which errors are likely, and some others, with returns of very many rays."""
    plain, seed = noiseless(settings), bench.plan.options.seed
    frame_returns = partial(_returns, bench, scanner, frame=frame)
    count = len(firings(scanner.sensor, frame))
    screened = chosen_pulses(count, _SCREENED, frame=frame, seed=seed)
    casts = [frame_returns(settings=plain.changed(rays=rays), pulses=screened) for rays in _SCREENS]
    rng = np.random.default_rng([seed, frame, 1])
    hard, easy = _stratify(screened, casts, count=count, rng=rng)
    weights = np.ones(count)
    weights[easy] = (len(screened) - len(hard)) / max(len(easy), 1)
    parts = [
        frame_returns(settings=scanner_reference(plain, rays=rays), pulses=pulses, backend=EXACT)
        for pulses, rays in ((hard, MOST_RAYS), (easy, min(_EASY_RAYS, MOST_RAYS)))
    ]
    columns = ([getattr(part, f.name) for part in parts] for f in fields(PulseReturns))
    returns = PulseReturns(*(np.concatenate(column) for column in columns))
    return ScannerTruth(scanner, frame, np.sort(np.concatenate([hard, easy])), weights, returns)


def _returns(
    bench: Bench,
    scanner: Scanner,
    *,
    frame: int,
    settings: ScannerSettings,
    pulses: NDArray[np.int64],
    backend: str = FAST,
) -> PulseReturns:
    """Returns of some pulses of a frame; of the reference's backend, in the whole world."""
    near = bench.plan.options.recording_settings.world
    around = near if backend == FAST else replace(near, origin="near", reach=inf)
    return returns_of(
        bench.plan,
        scanner,
        frame=frame,
        world=bench.world(scanner, frame, backend=backend, settings=around),
        settings=settings,
        pulses=pulses,
        threads=os.cpu_count() or 1,
    )


def _stratify(
    pulses: NDArray[np.int64], casts: Sequence[PulseReturns], *, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of pulses that were cast with different rays, those on which these casts differ most, and some others.

    The latter are chosen at random. Both are ascending.

    count : pulses of the frame
    """
    first, *others = casts
    apart = np.zeros(count)
    for other in others:
        _, a, b = np.intersect1d(first.key, other.key, assume_unique=True, return_indices=True)
        np.maximum.at(apart, first.key[a] // 256, np.abs(first.range[a] - other.range[b]))
        apart[np.setxor1d(first.key, other.key) // 256] = inf
    order = pulses[np.argsort(-apart[pulses], kind="stable")]
    return np.sort(order[:_HARD]), np.sort(rng.permutation(order[_HARD:])[:_EASY])


def range_estimates(frames: Sequence[SampledError], *, complete: bool) -> dict[str, ErrorEstimate]:
    """Metres that shares of the returns of frames do not exceed, by name, such as ``range_99.9_m``.

    Also ``lost``, missed and extra returns over those of the reference. With 95 % intervals by resampling
    pulses, and the frames of a sample; not those without returns.

    complete : whether these are all frames of the drive, so that none but the pulses are a sample
    """
    if not frames:
        return {}
    rng = np.random.default_rng(0)
    ranges, weight = (np.concatenate([getattr(f, name) for f in frames]) for name in ("range", "weight"))
    of = np.repeat(np.arange(len(frames)), [len(f.range) for f in frames])
    order = np.argsort(ranges)
    ranges, weight, of = ranges[order], weight[order], of[order]
    lost = np.array([(f.missed + f.extra, f.returns) for f in frames])
    times = rng.multinomial(len(frames), np.full(len(frames), 1 / len(frames)), size=RESAMPLES)
    resampled = []
    for one in times:
        drawn = weight * rng.poisson(1.0, len(weight)) * (1 if complete else one[of])
        resampled.append(_weighted_figures(ranges, drawn, lost=one @ lost))
    return with_intervals(_weighted_figures(ranges, weight, lost=lost.sum(axis=0)), resampled)


def _weighted_figures(ranges: Float, weight: Float, *, lost: Float) -> dict[str, float]:
    """Figures of ascending errors; ``lost`` (2,) has missed and extra returns, and all of the reference."""
    below, (some, returns) = np.cumsum(weight), lost.tolist()
    found = {f"range_{p:g}_m": _quantile(ranges, below, share=p / 100) for p in PERCENTS}
    return found | {"lost": some / returns if returns else nan}


def _quantile(values: Float, below: Float, *, share: float) -> float:
    """The value that a share of a weight does not exceed; ``below`` is the weight up to each value.

    NaN without values.
    """
    if not len(values) or below[-1] <= 0:
        return nan
    return float(values[min(int(np.searchsorted(below, share * below[-1])), len(values) - 1)])


@dataclass(frozen=True, slots=True)
class CameraTruth:
    """Blocks of pixels of a frame of a camera and their true colours and depths; blocks as of `pixels`."""

    camera: Camera
    frame: int
    blocks: Ints
    exact: Pixels

    def error(self, bench: Bench, settings: CameraSettings) -> ImageError:
        """Errors that settings make; depths are those of the files."""
        near = bench.plan.options.recording_settings.world
        world = bench.world(self.camera, self.frame, backend=FAST, settings=near)
        found = pixels(
            bench.shot(self.camera, self.frame),
            self.blocks,
            world=world,
            settings=replace(settings, camera_noise=False),
        )
        return image_error(replace(found, depth=counts_to_depth(depth_to_counts(found.depth))), self.exact)


def camera_truth(
    bench: Bench, camera: Camera, *, frame: int, settings: CameraSettings, blocks: int
) -> CameraTruth:
    """Blocks of a frame with colours and depths of very many rays."""
    near = bench.plan.options.recording_settings.world
    chosen = blocks_of_frame(camera.spec, blocks, frame=frame, seed=bench.plan.options.seed)
    whole = bench.world(camera, frame, backend=EXACT, settings=replace(near, origin="near", reach=inf))
    exact = camera_reference(settings, exposed=camera.spec.exposure_ns > 0)
    return CameraTruth(
        camera, frame, chosen, pixels(bench.shot(camera, frame), chosen, world=whole, settings=exact)
    )


def image_figures(frames: Sequence[ImageError], *, camera: Camera) -> dict[str, float]:
    """Rms of colours (``rgb_rms``) and metres that depths of shares of the pixels do not exceed.

    Of those images that the camera writes; NaN without a depth.
    """
    kinds, found = camera.spec.images, {}
    if "rgb" in kinds:
        found["rgb_rms"] = IMAGE_STATISTICS["rgb_rms"](frames)
    if "depth" in kinds:
        depth = np.concatenate([f.depth for f in frames])
        found |= {f"depth_{p:g}_m": percentile(depth, p / 100) if len(depth) else nan for p in PERCENTS}
    return found
