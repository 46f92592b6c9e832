"""Drives to an accuracy or within a budget of time: numbers of rays are picked by a stored profile."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geoscene.scene import Scene
from geoscene.support.progress import Progress, silent
from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options import AccuracyOptions, DriveOptions, read_accuracy, read_budget
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.specs import load_rig
from lidar.simulation import drive as pipeline
from lidar.simulation import frame_loop
from lidar.simulation.plan import DrivePlan, plan_drive, sensors_of
from lidar.tools.tradeoff.choice import Choice, Kind, Wanted, choice, speed, workers_text
from lidar.tools.tradeoff.sensor_errors import SensorErrors, kinds_of, stated

if TYPE_CHECKING:
    from lidar.tools.tradeoff.profile import Profile
    from lidar.tools.tradeoff.spot import SpotCheck

_PERCENT = 99.9
"""Percent of the returns whose error is stated where no accuracy says another."""


@dataclass(frozen=True, slots=True)
class Planned:
    """The plan of a drive within a budget of time.

    seconds : that planning took
    cpu_s   : CPU seconds of these
    loading : CPU seconds to load tiles along it, as expected
    """

    plan: DrivePlan
    seconds: float
    cpu_s: float
    loading: float

    @property
    def overhead(self) -> float:
        """Seconds per simulated second beside recording, if no other program takes time."""
        return (self.cpu_s + self.loading) / (self.plan.trajectory.duration_ns / 1e9)


@dataclass(frozen=True, slots=True)
class Pick:
    """Numbers of rays that were picked for a drive.

    asked    : accuracy and budget, as text
    settings : that were picked, by name
    expected : errors of the next drive in the scene, or of this one if the profile is of it
    chosen   : from the profile; None where an earlier run had picked
    profile  : by which it was picked; None likewise
    planned  : the drive with these settings, if there is a budget; None likewise
    """

    asked: dict[str, str]
    settings: dict[str, int]
    expected: SensorErrors
    chosen: Choice | None = None
    profile: Profile | None = None
    planned: Planned | None = None

    def to_json(self) -> dict[str, Any]:
        """The entry ``accuracy`` of ``dataset.json``, without figures of this machine."""
        return {"asked": self.asked, "picked": self.settings} | self.expected.to_json("expected")

    @property
    def label(self) -> str:
        """The settings, as in ``rays=7``; empty if none was to be picked."""
        return " ".join(f"{name}={value}" for name, value in self.settings.items())

    def to_text(self, workers: int) -> str:
        """What was picked and what to expect of it."""
        words = self.label or "nothing, as no setting changes depths"
        text = f"picked {words}: {self.expected.to_text('should be')}"
        if self.chosen is None or self.profile is None:
            return f"{text}; as picked before for this dataset"
        whose = "the next drive" if self.profile.drives > 1 else "this drive"
        cost = self.chosen.cpu_s
        text = (
            f"{text} (95 % intervals for {whose}); it takes {cost.value:.3g} CPU s per simulated second,"
            f" which is {speed(cost, workers):.2g} x real time with {workers_text(workers)}"
        )
        if self.planned is None:
            return text
        return (
            f"{text}; with planning ({self.planned.cpu_s:.2g} CPU s) and loading ({self.planned.loading:.2g})"
            f" {self._whole_speed(workers):.2g} x real time"
        )

    def _whole_speed(self, workers: int) -> float:
        """Simulated seconds per second, with planning and loading."""
        assert self.chosen is not None  # noqa: S101 - only then there is a speed
        overhead = self.planned.overhead if self.planned else 0.0
        return 1 / (1 / speed(self.chosen.cpu_s, workers) + overhead)

    def costs(self, workers: int) -> dict[str, Any]:
        """What depends on the machine; empty where an earlier run had picked."""
        if self.chosen is None or self.profile is None:
            return {}
        planned = self.planned and {
            "planning_cpu_s": round(self.planned.cpu_s, 3),
            "expected_loading_cpu_s": round(self.planned.loading, 3),
        }
        return {
            "expected_cpu_s": self.chosen.cpu_s.to_json(),
            "expected_speed": round(self._whole_speed(workers), 3),
            **(planned or {}),
            "profile": str(self.profile.path),
            "profile_made": self.profile.made,
            "profile_drives": self.profile.drives,
        }


@dataclass(frozen=True, slots=True)
class CheckedDrive:
    """A finished drive, what was picked for it, and the errors that it reached.

    wanted  : accuracy and budget
    pick    : None if nothing was to be picked
    reached : None if no check was asked for
    """

    summary: pipeline.DriveSummary
    wanted: AccuracyOptions
    pick: Pick | None
    reached: SpotCheck | None

    def accuracy(self, workers: int) -> dict[str, Any]:
        """What was picked, expected and reached, with the costs on this machine."""
        document = self.pick.to_json() | self.pick.costs(workers) if self.pick else {}
        if self.pick and self.speed:
            document["speed"] = round(self.speed, 3)
        return document | (self.reached.to_json() if self.reached else {})

    @property
    def speed(self) -> float | None:
        """Simulated seconds per second of planning and recording; None for a drive that was resumed."""
        if self.summary.resumed or not self.summary.recording:
            return None
        return self.summary.duration / (self.planning + self.summary.recording)

    @property
    def planning(self) -> float:
        """Seconds in which the drive was planned."""
        ahead = self.pick.planned.seconds if self.pick and self.pick.planned else 0.0
        return ahead + self.summary.planning

    def to_text(self) -> str:
        """What was reached, in one line; empty without a check."""
        if self.reached is None:
            return ""
        pace = f"; planned and recorded at {self.speed:.2g} x real time" if self.speed else ""
        return self.reached.to_text() + pace * bool(self.pick)

    def missed(self) -> list[str]:
        """Warnings, a line for each, that the accuracy or the budget was missed."""
        lines = []
        if self.wanted.accuracy and self.reached is not None:
            asked = read_accuracy(self.wanted.accuracy)
            if worse := self.reached.reached.beyond(asked):
                lines.append(f"the accuracy of {asked.text} is missed on this drive: {', '.join(worse)}")
        if self.wanted.budget and self.speed and self.speed < read_budget(self.wanted.budget):
            summary = self.summary
            lines.append(
                f"the budget of {self.wanted.budget} is missed: {summary.duration:.3g} s took"
                f" {self.planning:.2g} s to plan and {summary.recording:.2g} s to record, {self.speed:.2g} x"
                " real time; was the machine busy?"
            )
        return lines


def pick_settings(
    scene: Scene,
    options: DriveOptions,
    *,
    wanted: AccuracyOptions,
    out: Path | None = None,
    progress: Progress = silent,
) -> Pick | None:
    """The pick for a drive: of the dataset that is resumed, or by the profile; None if none is wanted.

    out : of a drive that may have begun

    Raises InputError (also as RouteError, RigError) if nothing reaches what is wanted, and for settings that
    contradict it.
    """
    if not wanted.picks:
        return None
    free = _free(options, wanted)
    if before := _picked_before(out, wanted) if out else None:
        return before
    from lidar.tools.tradeoff.profile import profile_of  # noqa: PLC0415  (0.1 s)

    profile = profile_of(scene, options, folder=wanted.profile_cache, progress=progress)
    asked = read_accuracy(wanted.accuracy) if wanted.accuracy else None
    settings = options.recording_settings
    given = {
        "rays": settings.scanner.rays,
        "supersample": settings.camera.supersample,
        "blur": settings.camera.blur,
    }
    by = Wanted(asked, workers=options.workers, given=given, free=free)
    planned = None
    if wanted.budget:
        planned = _plan(scene, options, profile=profile, progress=progress)
        by = replace(by, budget=wanted.budget, pace=pace_of(planned, wanted.budget))
    chosen = choice(profile, by)
    percent = asked.percent if asked else _PERCENT
    expected = stated(chosen.errors, percent=percent, kinds=kinds_of(asked))
    return Pick(_request(wanted), chosen.settings, expected, chosen, profile, planned)


def _plan(scene: Scene, options: DriveOptions, *, profile: Profile, progress: Progress) -> Planned:
    """The plan of a drive, and what it and loading cost."""
    began, cpu_began = time.perf_counter(), time.process_time()
    plan = plan_drive(scene, options, progress=progress)
    seconds, cpu_s = time.perf_counter() - began, time.process_time() - cpu_began
    chunks = sum(1 for _ in frame_loop.chunks(plan.jobs, plan.trajectory))
    return Planned(plan, seconds, cpu_s=cpu_s, loading=chunks * profile.load_s.high)


def pace_of(planned: Planned, budget: str) -> float:
    """Simulated seconds that are to be recorded per second, so that a budget holds for all."""
    left = 1 / read_budget(budget) - planned.overhead
    if left <= 0:
        duration = planned.plan.trajectory.duration_ns / 1e9
        raise InputError(
            f"`budget` {budget}: allows {duration / read_budget(budget):.2g} s for a drive of"
            f" {duration:.3g} s, and planning took {planned.cpu_s:.2g} CPU s and loading takes"
            f" {planned.loading:.2g}; give more time"
        )
    return 1 / left


def _free(options: DriveOptions, wanted: AccuracyOptions) -> tuple[Kind, ...]:
    """Kinds of sensors for which settings may be picked.

    Raises InputError for settings that contradict what is wanted, and for errors that no sensor has.
    """
    sensors = sensors_of(load_rig(options.rig), options)
    images = {image for s in sensors if isinstance(s, Camera) for image in s.spec.images}
    scanning = any(isinstance(s, Scanner) for s in sensors)
    asked = read_accuracy(wanted.accuracy) if wanted.accuracy else None
    if asked and asked.metres and not (scanning or "depth" in images):
        raise InputError(
            f"`accuracy` {asked.text}: no sensor of rig {options.rig} measures lengths; ask for levels of"
            " colours, as in 3levels"
        )
    if asked and asked.levels and "rgb" not in images:
        raise InputError(
            f"`accuracy` {asked.text}: no sensor of rig {options.rig} has colours; ask for a length, as in"
            " 1cm"
        )
    if wanted.budget and options.scheduler:
        raise InputError("`budget` is for this machine, and `scheduler` for others; leave one of them out")
    names: dict[Kind, tuple[str, ...]] = {"scanners": ("rays", "stretch"), "cameras": ("supersample",)}
    if any(isinstance(s, Camera) and s.spec.exposure_ns for s in sensors):
        names["cameras"] += ("blur",)
    held = {
        kind: [(name, value) for name, value in options.settings if name in of] for kind, of in names.items()
    }
    has: dict[Kind, bool] = {"scanners": scanning, "cameras": "rgb" in images}
    here = [kind for kind, there in has.items() if there]
    picks = {"scanners": asked is None or bool(asked.metres), "cameras": asked is None or bool(asked.levels)}
    free = tuple(kind for kind in here if picks[kind] and not held[kind])
    taken = [held[kind][0] for kind in here if picks[kind] and held[kind]]
    if taken and (asked or not free):
        (name, value), asker = taken[0], "accuracy" if asked else "budget"
        why = "picks rays, and more than one has no stretch" if name == "stretch" else "picks it"
        raise InputError(f"`settings` {name}={value}: `{asker}` {why}; leave one of them out")
    return free


def driven(
    scene: Scene,
    out: str | Path,
    *,
    options: DriveOptions,
    wanted: AccuracyOptions,
    pick: Pick | None,
    overwrite: bool = False,
    progress: Progress = silent,
    live: pipeline.Live | None = None,
) -> CheckedDrive:
    """Drive as `lidar.simulation.drive.drive` does, with what was picked, and check a sample of the frames.

    The recipe holds what was picked, so that a drive is resumed with it, also on another machine.

    Raises InputError (also as RouteError, RigError, DatasetError) for what cannot be driven or written.
    """
    found: list[SpotCheck] = []
    notes = pick.to_json() if pick else {}
    percent = pick.expected.percent if pick else _PERCENT
    kinds = kinds_of(read_accuracy(wanted.accuracy) if wanted.accuracy else None)

    def check(plan: DrivePlan) -> dict[str, Any]:
        from lidar.tools.tradeoff.spot import spot_check  # noqa: PLC0415  (0.1 s)

        found.append(spot_check(plan, percent=percent, kinds=kinds, progress=progress))
        return {"accuracy": notes | found[0].to_json()}

    plan = None
    if pick:
        more = tuple((name, str(value)) for name, value in pick.settings.items())
        options = replace(options, settings=(*options.settings, *more))
        plan = replace(pick.planned.plan, options=options) if pick.planned else None
    summary = pipeline.drive(
        scene,
        out,
        options=options,
        overwrite=overwrite,
        progress=progress,
        notes={"accuracy": notes} if notes else {},
        check=check if wanted.checks else None,
        plan=plan,
        live=live,
    )
    return CheckedDrive(summary, wanted, pick, found[0] if found else None)


def _request(wanted: AccuracyOptions) -> dict[str, str]:
    texts = {"accuracy": wanted.accuracy.strip(), "budget": wanted.budget.strip()}
    return {name: text for name, text in texts.items() if text}


def _picked_before(out: Path, wanted: AccuracyOptions) -> Pick | None:
    """What was picked for a dataset that was begun for the same accuracy and budget."""
    if not Paths(out).manifest.exists():
        return None
    notes = open_dataset(out).manifest.get("accuracy", {})
    if notes.get("asked") != _request(wanted):
        return None
    try:
        settings = {str(name): int(value) for name, value in notes["picked"].items()}
        return Pick(notes["asked"], settings, SensorErrors.from_json(notes, "expected"))
    except (AttributeError, KeyError, TypeError, ValueError):
        raise DatasetError(
            f"{Paths(out).manifest}: damaged (accuracy); set `overwrite` to drive again"
        ) from None
