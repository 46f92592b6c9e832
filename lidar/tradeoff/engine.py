"""Errors and costs of the settings of a drive, on the user's own scene, route and rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from lidar.errors import InputError
from lidar.geometry.georeference import Georeference
from lidar.options import DriveOptions, TradeoffOptions
from lidar.physics.settings import ScannerSettings
from lidar.plan import DrivePlan, plan_drive, schedule
from lidar.rig.devices import Scanner
from lidar.rig.scanner import firings
from lidar.tradeoff.errors import (
    Estimate,
    FrameError,
    Returns,
    estimates,
    frame_error,
    median,
    percentile,
)
from lidar.tradeoff.memory import Task, peaks
from lidar.tradeoff.simulate import EXACT, FAST, Bench, bench_of, chosen_pulses, frame_cost, returns_of
from lidar.tradeoff.variants import (
    MODELS,
    OF_EMBREE,
    SCANNER_VALUES,
    WORLD_VALUES,
    Variant,
    next_step,
    noiseless,
    reference,
    scanner_variants,
)
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings

COMPARED = (*SCANNER_VALUES, *WORLD_VALUES, "scene", "traffic", "georeferencing")
"""Names that `TradeoffOptions.compare` may hold."""


@dataclass(frozen=True, slots=True)
class Row:
    """A measured variant.

    error : of the user's settings with this one changed, against the exact end; see `errors.STATISTICS`
    alone : of the exact end with this one changed; empty for the user's own settings
    cost  : CPU seconds (``cpu_s``) and bytes (``bytes``) per simulated second, peak memory (``memory_bytes``)
    note  : what the figures do not say, such as that a setting has no effect
    """

    label: str
    error: dict[str, Estimate]
    alone: dict[str, Estimate]
    cost: dict[str, Estimate]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The rows of a sensor.

    sensor    : name on the rig, with its preset
    reference : of the exact end, in words
    residual  : difference between the reference and one with more rays: its own uncertainty
    rows      : the user's own settings come first
    pulses    : number of pulses compared
    frames    : number of frames that they are from
    """

    sensor: str
    reference: str
    residual: dict[str, Estimate]
    rows: tuple[Row, ...]
    pulses: int
    frames: int

    @property
    def uncertainty(self) -> float:
        """Metres at 99.9 % by which the reference may be off."""
        return self.residual["range_99.9_m"].value


@dataclass(frozen=True, slots=True)
class Tradeoff:
    """Comparisons of all scanners of a rig on a drive.

    georeferencing : metres between the affine map and the full projection; empty where not compared
    """

    plan: DrivePlan
    comparisons: tuple[Comparison, ...]
    georeferencing: dict[str, float]


def tradeoff(
    scene: Scene,
    options: DriveOptions,
    *,
    compared: TradeoffOptions = TradeoffOptions(),
    others: Sequence[Scene] = (),
    progress: Progress = silent,
) -> Tradeoff:
    """Errors and costs of settings on a drive; the drive is planned once, in the first scene.

    others : further scenes of the same place, in the same frame

    Raises InputError (also as RouteError, RigError) for what cannot be driven or compared.
    """
    _check(compared.compare)
    plan = plan_drive(scene, options, progress=progress)
    for other in others:
        if other.frame.to_json() != scene.frame.to_json():
            raise InputError(f"{other.path}: has another frame than {scene.path}; build both with one `crs`")
    sensors = [s for s in plan.sensors if isinstance(s, Scanner)]
    plan = replace(plan, sensors=tuple(sensors), jobs=schedule(sensors, plan.trajectory.duration_ns))
    if not plan.jobs:
        raise InputError(f"`rig` {options.rig}: no scanner has a frame in this drive")
    bench = bench_of(plan, others, frames=compared.frames)
    found = tuple(
        _compared(bench, scanner, compared=compared, progress=progress)
        for scanner in sensors
        if bench.frames[scanner.name]
    )
    geo = _georeferencing(bench) if not compared.compare or "georeferencing" in compared.compare else {}
    return Tradeoff(plan, found, geo)


def _check(names: Sequence[str]) -> None:
    if unknown := sorted(set(names) - set(COMPARED)):
        raise InputError(f"`compare` {','.join(unknown)}: unknown; there are {', '.join(COMPARED)}")


def _compared(bench: Bench, scanner: Scanner, *, compared: TradeoffOptions, progress: Progress) -> Comparison:
    """The comparison of one scanner."""
    plan, settings = bench.plan, bench.plan.options.contents().scanner
    near = plan.options.contents().world
    rays = compared.reference_rays
    exact = reference(settings, rays=rays)
    labels = [scene_label(bench.scenes[0], other) for other in bench.scenes[1:]]
    variants = scanner_variants(
        settings,
        rays=rays,
        world=near,
        compared=compared.compare,
        scenes=labels,
        traffic=plan.actors is not None,
    )
    frames = bench.frames[scanner.name]
    per_frame = -(-compared.pulses // len(frames))
    rows_of = {
        f: chosen_pulses(len(firings(scanner.sensor, f)), per_frame, frame=f, seed=plan.options.seed)
        for f in frames
    }
    errors = {name: _Sums(variants) for name in ("used", "alone")}
    residual: list[FrameError] = []
    same = np.ones(len(variants), bool)
    for k, frame in enumerate(frames):
        progress(f"comparing {scanner.name}", k, total=len(frames))
        look = _Look(bench, scanner, frame, rows_of[frame])
        truth = look.returns(exact, backend=EXACT)
        finer = look.returns(replace(exact, rays=next_step(rays)), backend=EXACT)
        residual.append(frame_error(truth, finer))
        base = look.returns(noiseless(settings), backend=FAST, world=near)
        for i, variant in enumerate(variants):
            where: dict[str, Any] = {"scene": variant.scene, "traffic": variant.traffic}
            used = look.returns(variant.used, backend=FAST, world=variant.world, **where)
            errors["used"].add(i, frame_error(used, truth))
            same[i] &= np.array_equal(used.key, base.key) and np.array_equal(used.xyz, base.xyz)
            if variant.setting:
                backend = FAST if variant.setting in OF_EMBREE else EXACT
                alone = look.returns(variant.alone, backend=backend, world=variant.alone_world, **where)
                errors["alone"].add(i, frame_error(alone, truth))
    costs = _costs(bench, scanner, variants=variants, repetitions=compared.repetitions, progress=progress)
    seed = plan.options.seed
    rows = tuple(
        Row(
            variant.label,
            estimates(errors["used"].frames[i], seed=seed),
            estimates(errors["alone"].frames[i], seed=seed) if variant.setting else {},
            costs[i],
            _note(variant, same=bool(same[i])),
        )
        for i, variant in enumerate(variants)
    )
    return Comparison(
        f"{scanner.name} ({scanner.spec.preset})",
        f"float64 ray casting, {rays} rays per pulse, a pose for every firing",
        estimates(residual, seed=seed),
        rows,
        sum(len(r) for r in rows_of.values()),
        len(frames),
    )


class _Sums:
    """Errors of all frames, by variant."""

    def __init__(self, variants: Sequence[Variant]) -> None:
        self.frames: list[list[FrameError]] = [[] for _ in variants]

    def add(self, variant: int, error: FrameError) -> None:
        """Add a frame of a variant."""
        self.frames[variant].append(error)


@dataclass(frozen=True, slots=True)
class _Look:
    """Some pulses of a frame, to be cast with different settings."""

    bench: Bench
    scanner: Scanner
    frame: int
    pulses: NDArray[np.int64]

    def returns(
        self,
        settings: ScannerSettings,
        *,
        backend: str,
        scene: int = 0,
        traffic: bool = True,
        world: WorldSettings = WHOLE,
    ) -> Returns:
        """The returns of these pulses."""
        around = self.bench.world(
            self.scanner, self.frame, backend=backend, scene=scene, traffic=traffic, settings=world
        )
        return returns_of(
            self.bench.plan,
            self.scanner,
            frame=self.frame,
            world=around,
            settings=settings,
            pulses=self.pulses,
        )


def _note(variant: Variant, *, same: bool) -> str:
    """What the figures of a row do not say."""
    if not variant.setting:
        return ""
    if same:
        return "no effect with the other settings as asked"
    return "changes what is modelled" if variant.setting in MODELS else ""


def _costs(
    bench: Bench,
    scanner: Scanner,
    *,
    variants: Sequence[Variant],
    repetitions: int,
    progress: Progress,
) -> list[dict[str, Estimate]]:
    """CPU seconds and bytes per simulated second and peak memory of variants.

    Repetitions are interleaved: each times one frame with every variant before the next one begins.
    """
    plan, frames = bench.plan, bench.frames[scanner.name]
    rate = scanner.sensor.rate_hz
    seconds: list[list[float]] = [[] for _ in variants]
    sizes: list[list[float]] = [[] for _ in variants]
    for k in range(-1, repetitions):  # the first one only warms up
        frame = frames[k % len(frames)]
        progress(f"timing {scanner.name}", k + 1, total=repetitions + 1)
        for i, variant in enumerate(variants):
            world = bench.world(scanner, frame, backend=FAST, scene=variant.scene, traffic=variant.traffic)
            spent, size = frame_cost(plan, scanner, frame=frame, world=world, settings=variant.used)
            if k >= 0:
                seconds[i].append(spent * rate)
                sizes[i].append(size * rate)
    progress(f"memory of {scanner.name}", 0, total=0)
    memory = peaks([_task(bench, scanner, variant=variant) for variant in variants])
    seed = plan.options.seed
    return [
        {
            "cpu_s": median(seconds[i], seed=seed),
            "bytes": median(sizes[i], seed=seed),
            "memory_bytes": median([memory[i]], seed=seed),
        }
        for i in range(len(variants))
    ]


def _task(bench: Bench, scanner: Scanner, *, variant: Variant) -> Task:
    plan = bench.plan
    frame = bench.frames[scanner.name][0]
    start = scanner.frame_start_ns(frame)
    xy = plan.trajectory.at(np.array([start, start + scanner.period_ns])).position[:, :2]
    (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    return Task(
        bench.scenes[variant.scene].path,
        scanner,
        variant.used,
        plan.trajectory,
        plan.actors if variant.traffic else None,
        frame,
        (x0, y0, x1, y1),
        plan.max_range,
        variant.world,
    )


def _georeferencing(bench: Bench) -> dict[str, float]:
    """Metres between the affine map and the full projection, on returns of the sampled frames."""
    plan = bench.plan
    scanner = next(s for s in plan.sensors if isinstance(s, Scanner) and bench.frames[s.name])
    affine, full = (Georeference(plan.scene.frame, plan.geo.crs, exact=exact) for exact in (False, True))
    away = []
    for frame in bench.frames[scanner.name]:
        rows = np.arange(0, len(firings(scanner.sensor, frame)), 8)
        settings = noiseless(plan.options.contents().scanner)
        found = _Look(bench, scanner, frame, rows).returns(replace(settings, rays=1), backend=FAST)
        away.append(np.linalg.norm(affine.points(found.xyz) - full.points(found.xyz), axis=1))
    every = np.concatenate(away)
    return {"99.9_m": percentile(every, 0.999), "max_m": percentile(every, 1.0)}


def scene_label(first: Scene, other: Scene) -> str:
    """What distinguishes a scene from the first: the build options that differ, or else its folder."""
    a, b = (_flat(scene.manifest.get("options", {})) for scene in (first, other))
    differ = [f"{k}={b.get(k)}" for k in sorted(a.keys() | b.keys()) if a.get(k) != b.get(k)]
    return ",".join(differ) or other.path.name


def _flat(options: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in options.items()}
