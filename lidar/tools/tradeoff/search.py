"""Settings of rays for a drive, by an accuracy or a budget of time: a search over a sample of its frames."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.drawing.report import levels, metres
from geoscene.scene import Scene
from geoscene.support.progress import Progress
from lidar.errors import InputError
from lidar.options.accuracy import AccuracyOptions, AccuracyTarget, read_accuracy, read_budget
from lidar.options.drive import DriveOptions
from lidar.parameters import value_text
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.settings import RecordingSettings
from lidar.simulation.frame_loop import chunks, record_frame
from lidar.simulation.plan import DrivePlan, plan_drive
from lidar.tools.tradeoff.bench import spread_frames
from lidar.tools.tradeoff.errors import ErrorEstimate, median
from lidar.tools.tradeoff.pick import (
    PERCENT,
    Kind,
    Ladder,
    Pick,
    PickCost,
    kinds_of,
    label_of,
    ladders_of,
    settings_of_rows,
    stated,
    workers_text,
)
from lidar.tools.tradeoff.sample import DriveSample, sensors_with
from lidar.world.world import Worlds

SAMPLES = (6, 12, 24)
"""Frames of the sample, which grows until it answers."""

_DEARER, _DEAREST = 1.5, 3.0
"""Times the cost of the first row that is within an accuracy by its estimate. A row of so much that is
surely within it is taken at once; the last of so much is taken in the end."""

_CHEAP = 30.0
"""Cost up to which rows are tried first, and dearer ones only if none of these is within the accuracy."""

_TIMINGS = 3
"""Frames of each sensor that are timed."""


@dataclass(frozen=True, slots=True)
class DriveCost:
    """CPU seconds per simulated second to record, and CPU seconds to load the tiles around the vehicle."""

    record: ErrorEstimate
    load: float


@dataclass
class Search:
    """Errors and costs of the rows of ladders on a planned drive, measured as they are asked for.

    kinds : of errors that are measured, see `sample.sensors_with`
    """

    plan: DrivePlan
    ladders: dict[Kind, Ladder]
    kinds: tuple[str, ...]
    progress: Progress
    _samples: dict[Kind, DriveSample] = field(default_factory=dict)
    _costs: dict[tuple[Kind, int], DriveCost] = field(default_factory=dict)

    def sample(self, kind: Kind) -> DriveSample:
        """The sample of a kind of sensors, of all rows of its ladder."""
        if kind not in self._samples:
            ladder, own = self.ladders[kind], self.plan.options.recording_settings
            rows = [self._changed(own, kind=kind, row=row) for row in range(len(ladder.rows))]
            sensors = sensors_with(ladder.sensors, kinds=self.kinds)
            self._samples[kind] = DriveSample(self.plan, sensors, settings=rows, progress=self.progress)
        return self._samples[kind]

    def _changed(self, own: RecordingSettings, *, kind: Kind, row: int) -> ScannerSettings | CameraSettings:
        """The drive's settings of a kind of sensors with those of a row."""
        values: dict[str, Any] = self.ladders[kind].values(row)
        return own.scanner.changed(**values) if kind == "scanners" else replace(own.camera, **values)

    def errors(self, rows: Mapping[Kind, int]) -> dict[str, dict[str, ErrorEstimate]]:
        """Figures of each sensor, from the sample as far as it has grown, or the smallest."""
        found: dict[str, dict[str, ErrorEstimate]] = {}
        for kind, row in rows.items():
            sample = self.sample(kind)
            sample.grow(SAMPLES[0], rows=[row])
            found |= sample.figures(row)
        return found

    def cost(self, rows: Mapping[Kind, int]) -> DriveCost:
        """Costs of all sensors."""
        for pair in rows.items():
            if pair not in self._costs:
                self._costs[pair] = self._measure_cost(*pair)
        parts = [self._costs[pair] for pair in rows.items()]
        record = sum((part.record for part in parts), ErrorEstimate(0.0, 0.0, 0.0))
        return DriveCost(record, max(part.load for part in parts))

    def _measure_cost(self, kind: Kind, row: int) -> DriveCost:
        """The cost of frames that are recorded, files and all, with a row of a ladder."""
        ladder = self.ladders[kind]
        more = tuple((name, value_text(value)) for name, value in ladder.values(row).items())
        options = replace(self.plan.options, settings=(*self.plan.options.settings, *more))
        plan = replace(self.plan, options=options)
        seconds, load = [0.0] * _TIMINGS, 0.0
        warm = any(known == kind for known, _ in self._costs)
        with tempfile.TemporaryDirectory() as folder:
            recording = plan.recording(Path(folder))
            for number, sensor in enumerate(ladder.sensors):
                frames = spread_frames(plan.frames[sensor.name], _TIMINGS)
                worlds = Worlds(
                    plan.scene, plan.max_range, actors=plan.actors, settings=recording.settings.world
                )
                for k in range(_TIMINGS if frames else 0):
                    self.progress(
                        "measuring costs", number * _TIMINGS + k, total=_TIMINGS * len(ladder.sensors)
                    )
                    frame = frames[k % len(frames)]
                    load = max(load, _follow(worlds, plan, sensor=sensor, frame=frame))
                    if not warm:  # kernels are loaded or compiled
                        record_frame(recording, sensor, frame=frame, worlds=worlds)
                        warm = True
                    began = time.process_time()
                    record_frame(recording, sensor, frame=frame, worlds=worlds)
                    seconds[k] += (time.process_time() - began) * 1e9 / sensor.period_ns
        return DriveCost(median(seconds, seed=0), load)


def _follow(worlds: Worlds, plan: DrivePlan, *, sensor: Scanner | Camera, frame: int) -> float:
    """Load the world around the vehicle during a frame; CPU seconds that it took."""
    start = sensor.frame_start_ns(frame)
    xy = plan.trajectory.at(np.array([start, start + sensor.period_ns])).position[:, :2]
    (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
    began = time.process_time()
    worlds.follow((x0, y0, x1, y1))
    worlds.during(start, start + sensor.period_ns)
    return time.process_time() - began


def find_accurate(search: Search, accuracy: AccuracyTarget) -> dict[Kind, int]:
    """The first row of each ladder with which errors are within an accuracy, by the end of their intervals.

    The sample grows until some row is that costs little more than the first row whose errors are within it by
    their estimates, or all intervals begin beyond the accuracy. If the largest sample does not decide, the
    last row of at most `_DEAREST` times the cost of that first row is taken, or a cheaper one that is sure.
    The order of the rows is the same on all machines, and so are the sample and the rows.

    Raises InputError, which names the nearest, if there is none.
    """
    limits: dict[Kind, dict[str, float]] = {"scanners": {}, "cameras": {}}
    if accuracy.metres:
        limits["scanners"][f"range_{accuracy.percent:g}_m"] = accuracy.metres
        limits["cameras"][f"depth_{accuracy.percent:g}_m"] = accuracy.metres
    if accuracy.levels:
        limits["cameras"]["rgb_rms"] = accuracy.levels
    rows: dict[Kind, int] = dict.fromkeys(search.ladders, 0)
    for kind in search.ladders:
        if limits[kind] and search.sample(kind).counts:
            rows[kind] = _first_within(search, kind, limits=limits[kind], accuracy=accuracy)
    return rows


def _first_within(
    search: Search, kind: Kind, *, limits: Mapping[str, float], accuracy: AccuracyTarget
) -> int:
    """The first row of a ladder whose errors are within limits, by name; see `find_accurate`."""
    sample, ladder = search.sample(kind), search.ladders[kind]
    costs = [row.cost for row in ladder.rows]
    cheap = sum(cost <= max(_CHEAP, costs[0]) for cost in costs)
    first, last = 0, cheap  # rows that may be the one
    for frames in SAMPLES:
        sample.grow(frames, rows=range(first, last))
        every = [sample.figures(row) for row in range(first, last)]
        if last < len(costs) and _first(every, limits, end="value") == len(every):
            sample.grow(frames, rows=range(last, len(costs)))
            every += [sample.figures(row) for row in range(last, len(costs))]
            last = len(costs)
        sure, likely, least = (first + _first(every, limits, end=end) for end in ("high", "value", "low"))
        if sure < last and costs[sure] <= _DEARER * costs[likely]:
            return sure
        if sample.complete or least == last:
            break
        first, last = least, min(sure + 1, last)
    if likely < last:
        most = _DEAREST * costs[likely]
        return max(row for row in range(likely, min(sure + 1, last)) if costs[row] <= most)
    worst = [_worst(errors, limits, end="value") for errors in every]
    best = min(range(len(worst)), key=lambda row: worst[row][0])
    _, figure, error = worst[best]
    label = label_of(ladder.values(first + best))
    raise InputError(_out_of_reach(accuracy, error, figure=figure, label=label))


def _first(
    every: Sequence[Mapping[str, Mapping[str, ErrorEstimate]]], limits: Mapping[str, float], *, end: str
) -> int:
    """The first row all of whose errors are within limits by one end of their intervals, or their number.

    end : ``low``, ``value`` or ``high`` of the estimates
    """
    within = (row for row, errors in enumerate(every) if _worst(errors, limits, end=end)[0] <= 1)
    return next(within, len(every))


def _worst(
    errors: Mapping[str, Mapping[str, ErrorEstimate]], limits: Mapping[str, float], *, end: str
) -> tuple[float, str, ErrorEstimate]:
    """The largest error of any sensor over its limit, with its name and estimate; ``end`` as of `_first`."""
    found = [
        (getattr(figures[name], end) / limit, name, figures[name])
        for figures in errors.values()
        for name, limit in limits.items()
        if name in figures
    ]
    return max(found, key=lambda one: one[0], default=(0.0, "", ErrorEstimate(0.0, 0.0, 0.0)))


def _out_of_reach(accuracy: AccuracyTarget, error: ErrorEstimate, *, figure: str, label: str) -> str:
    """The message of an accuracy that no row reaches, with the nearest."""
    if figure == "rgb_rms":
        return (
            f"`accuracy` {accuracy.text}: no number of rays reaches {levels(accuracy.levels)};"
            f" {label} comes nearest with {error.to_text(levels)}: give"
            f" {levels(_round_up(error.value))} or more"
        )
    what, of = ("number of rays", "returns") if figure.startswith("range") else ("image", "depths")
    nearest = f"{label} comes" if label and figure.startswith("range") else "it comes"
    length, smaller = accuracy.text.split("@")[0].split(",")[0], _smaller(accuracy.percent)
    return (
        f"`accuracy` {accuracy.text}: no {what} reaches {metres(accuracy.metres)} at"
        f" {accuracy.percent:g} % of the {of}; {nearest} nearest with {error.to_text()}: give"
        f" {metres(_round_up(error.value))} or more, or a smaller share, as in {length}@{smaller:g}"
    )


def _round_up(value: float) -> float:
    """A value rounded up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / step * (1 - 1e-9)) * step


def _smaller(percent: float) -> float:
    return 99.0 if percent > 99 else 95.0 if percent > 95 else 90.0 if percent > 90 else 50.0


def find_affordable(search: Search, *, budget: str, pace: float, workers: int) -> dict[Kind, int]:
    """The last rows of the ladders that are recorded at a pace, by the upper ends of their costs.

    What is cheaper to raise next is raised, the rays of scanners or those of cameras.

    pace : simulated seconds per second that planning and loading leave of the budget

    Raises InputError if not even the first rows are.
    """
    rows: dict[Kind, int] = dict.fromkeys(search.ladders, 0)
    if slowest(search.cost(rows).record, workers) < pace:
        label = label_of(settings_of_rows(search.ladders, rows)) or "the drive as asked"
        speed = slowest(search.cost(rows).record, workers)
        raise InputError(
            f"`budget` {budget}: even {label} is simulated at {speed:.2g} x real time with"
            f" {workers_text(threads(workers))}; give more time"
        )
    while True:
        raised = [
            rows | {kind: rows[kind] + 1}
            for kind, ladder in search.ladders.items()
            if rows[kind] + 1 < len(ladder.rows)
        ]
        dearer = sorted(raised, key=lambda one: search.cost(one).record.high)
        if not dearer or slowest(search.cost(dearer[0]).record, workers) < pace:
            return rows
        rows = dearer[0]


def slowest(cost: ErrorEstimate, workers: int) -> float:
    """Simulated seconds per second at the upper end of a cost, if all workers are always busy."""
    return threads(workers) / cost.high


def threads(workers: int) -> int:
    """Number of threads that work at a time."""
    return min(workers, os.cpu_count() or 1)


def pick_by_sample(
    scene: Scene, options: DriveOptions, *, wanted: AccuracyOptions, free: Sequence[Kind], progress: Progress
) -> Pick:
    """The pick for a drive, by errors and costs in a sample of its own frames.

    free : kinds of sensors for which settings may be picked

    Raises InputError (also as RouteError, RigError) if no settings reach the accuracy or budget.
    """
    began, cpu_began = time.perf_counter(), time.process_time()
    plan = plan_drive(scene, options, progress=progress)
    planning = time.perf_counter() - began, time.process_time() - cpu_began
    asked = read_accuracy(wanted.accuracy) if wanted.accuracy else None
    search = Search(plan, ladders_of(options, plan.sensors, free=free), kinds_of(asked), progress)
    rows = dict.fromkeys(search.ladders, 0) if asked is None else find_accurate(search, asked)
    duration = plan.trajectory.duration_ns / 1e9
    loading = search.cost(rows).load * sum(1 for _ in chunks(plan.jobs, plan.trajectory))
    workers = options.workers
    if wanted.budget:
        pace = pace_of(wanted.budget, duration=duration, planning=planning[1], loading=loading)
        if asked is None:
            rows = find_affordable(search, budget=wanted.budget, pace=pace, workers=workers)
        elif slowest(search.cost(rows).record, workers) < pace:
            best = find_affordable(search, budget=wanted.budget, pace=pace, workers=workers)
            raise InputError(_over_budget(search, rows, best=best, asked=asked, wanted=wanted))
    expected = stated(search.errors(rows), percent=asked.percent if asked else PERCENT, kinds=kinds_of(asked))
    cost = PickCost(search.cost(rows).record, planning, loading, duration, threads(workers))
    return Pick(wanted.request, settings_of_rows(search.ladders, rows), expected, plan, cost)


def pace_of(budget: str, *, duration: float, planning: float, loading: float) -> float:
    """Simulated seconds that are to be recorded per second, so that a budget holds for the whole drive.

    duration : simulated seconds of the drive
    planning, loading : CPU seconds
    """
    left = 1 / read_budget(budget) - (planning + loading) / duration
    if left <= 0:
        raise InputError(
            f"`budget` {budget}: allows {duration / read_budget(budget):.2g} s for a drive of"
            f" {duration:.3g} s, and planning took {planning:.2g} CPU s and loading takes {loading:.2g}; give"
            " more time"
        )
    return 1 / left


def _over_budget(
    search: Search,
    rows: Mapping[Kind, int],
    *,
    best: Mapping[Kind, int],
    asked: AccuracyTarget,
    wanted: AccuracyOptions,
) -> str:
    """The message of rows that take more time than the budget has; ``best`` are the last within it."""
    errors = stated(search.errors(best), percent=asked.percent, kinds=kinds_of(asked))
    needed, allowed = (label_of(settings_of_rows(search.ladders, of)) for of in (rows, best))
    workers = search.plan.options.workers
    return (
        f"`accuracy` {asked.text} takes {needed}, simulated at"
        f" {slowest(search.cost(rows).record, workers):.2g} x real time with"
        f" {workers_text(threads(workers))}, and `budget` {wanted.budget} allows {allowed}, with which"
        f" {errors.to_text('should be')}"
    )
