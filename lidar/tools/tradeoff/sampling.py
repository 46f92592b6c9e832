"""Sampled frames of sensors, and errors of scanners in them against the reference."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf, nan

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.options import PERCENTS
from lidar.sensors.physics.settings import MOST_RAYS, ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.simulation.plan import DrivePlan, schedule
from lidar.tools.tradeoff.errors import PulseReturns
from lidar.tools.tradeoff.simulate import EXACT, FAST, Bench, chosen_pulses, returns_of, spread_frames
from lidar.tools.tradeoff.variants import noiseless, reference

REFERENCE_RAYS = MOST_RAYS
"""Rays per pulse of the reference."""

_SCREENED, _SCREENS, _COMPARED = 6000, (1, 19, 61), 120
"""Pulses of a frame that are screened, their numbers of rays, and how many of the hardest and of the others
are compared with the reference."""

_PLACE = 200.0
"""Scene metres along each axis that frames of a place are within."""


def places(plan: DrivePlan, sensors: Sequence[Scanner | Camera], *, frames: int) -> list[Bench]:
    """At most ``frames`` of the frames of each sensor, spread over a drive, grouped where they are near.

    Frames in which a scanner does not work are left out.
    """
    jobs = schedule(sensors, plan.trajectory.duration_ns)
    plan = replace(plan, sensors=tuple(sensors), jobs=jobs)
    chosen = {s.name: _spread(plan, s, frames=frames) for s in sensors}
    groups: list[dict[str, list[int]]] = []
    low, high = np.full(2, inf), np.full(2, -inf)
    for k in range(frames):
        now = [(s, chosen[s.name][k]) for s in sensors if k < len(chosen[s.name])]
        if not now:
            continue
        starts = np.array([s.frame_start_ns(frame) for s, frame in now], np.int64)
        xy = plan.trajectory.at(starts).position[:, :2]
        low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
        if not groups or (high - low).max() > _PLACE:
            groups.append({s.name: [] for s in sensors})
            low, high = xy.min(axis=0), xy.max(axis=0)
        for sensor, frame in now:
            groups[-1][sensor.name].append(frame)
    return [
        Bench(plan, (plan.scene,), {name: tuple(numbers) for name, numbers in group.items()})
        for group in groups
    ]


def _spread(plan: DrivePlan, sensor: Scanner | Camera, *, frames: int) -> list[int]:
    """Numbers of frames of a sensor, spread over those in which it works."""
    count = plan.frames[sensor.name]
    if plan.scanning_ns is None or isinstance(sensor, Camera):
        return list(spread_frames(count, frames))
    starts = np.fromiter(map(sensor.frame_start_ns, range(count)), np.int64, count)
    first, last = plan.scanning_ns[:, 0], plan.scanning_ns[:, 1]
    span = np.searchsorted(first, starts, side="right") - 1
    on = np.flatnonzero((span >= 0) & (starts + sensor.period_ns <= last[np.maximum(span, 0)]))
    return [int(on[k]) for k in spread_frames(len(on), frames)]


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


def errors_of(
    bench: Bench, scanner: Scanner, *, settings: Sequence[ScannerSettings]
) -> Iterator[list[SampledError]]:
    """Errors of each of some settings, frame by frame of those that a scanner has in a bench."""
    plain, seed = noiseless(settings[0]), bench.plan.options.seed
    for frame in bench.frames[scanner.name]:
        frame_returns = partial(_returns, bench, scanner, frame=frame)
        count = len(firings(scanner.sensor, frame))
        screened = chosen_pulses(count, _SCREENED, frame=frame, seed=seed)
        looks = [frame_returns(settings=replace(plain, rays=rays), pulses=screened) for rays in _SCREENS]
        rng = np.random.default_rng([seed, frame, 1])
        pulses, weights = _stratify(screened, looks, count=count, rng=rng)
        exact = reference(plain, rays=REFERENCE_RAYS)
        truth = frame_returns(settings=exact, pulses=pulses, backend=EXACT)
        yield [
            sampled_error(frame_returns(settings=noiseless(one), pulses=pulses), exact=truth, weights=weights)
            for one in settings
        ]


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
    pulses: NDArray[np.int64], looks: Sequence[PulseReturns], *, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Float]:
    """Pulses to compare of some that were cast with different rays, and weights (count,) by row of a pulse.

    Those on which these casts differ most are taken, with weight 1; others at random, for all others.
    """
    first, *others = looks
    apart = np.zeros(count)
    for other in others:
        _, a, b = np.intersect1d(first.key, other.key, assume_unique=True, return_indices=True)
        np.maximum.at(apart, first.key[a] // 256, np.abs(first.range[a] - other.range[b]))
        apart[np.setxor1d(first.key, other.key) // 256] = inf
    order = pulses[np.argsort(-apart[pulses], kind="stable")]
    hard, easy = order[:_COMPARED], rng.permutation(order[_COMPARED:])[:_COMPARED]
    weights = np.ones(count)
    if len(easy):
        weights[easy] = (len(order) - len(hard)) / len(easy)
    return np.sort(np.concatenate([hard, easy])), weights


def range_figures(frames: Sequence[SampledError]) -> dict[str, float]:
    """Metres that shares of the returns of frames do not exceed, by name, such as ``range_99.9_m``.

    NaN without returns; and `lost`.
    """
    ranges = np.concatenate([f.range for f in frames])
    order = np.argsort(ranges)
    below = np.cumsum(np.concatenate([f.weight for f in frames])[order])
    ranges = ranges[order]
    found = {f"range_{p:g}_m": _quantile(ranges, below, share=p / 100) for p in PERCENTS}
    return found | {"lost": lost(frames)}


def lost(frames: Sequence[SampledError]) -> float:
    """Missed and extra returns of frames over the returns of the reference; NaN without these."""
    missed, extra, returns = np.sum([(f.missed, f.extra, f.returns) for f in frames], axis=0).tolist()
    return float((missed + extra) / returns) if returns else nan


def _quantile(values: Float, below: Float, *, share: float) -> float:
    """The value that a share of a weight does not exceed; ``below`` is the weight up to each value.

    NaN without values.
    """
    if not len(values) or below[-1] <= 0:
        return nan
    return float(values[min(int(np.searchsorted(below, share * below[-1])), len(values) - 1)])
