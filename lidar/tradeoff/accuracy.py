"""Drives to an accuracy or within a budget of time: the number of rays is picked by a stored profile."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geoscene.charts import metres
from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from lidar import pipeline
from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options import Accuracy, AccuracyOptions, DriveOptions, read_accuracy, read_budget
from lidar.plan import DrivePlan
from lidar.tradeoff.errors import Estimate
from lidar.tradeoff.profile import Candidate, Profile, profile_of
from lidar.tradeoff.spot import SpotCheck, error_text, spot_check

PICKED = "rays"
"""The setting that is picked."""

_PERCENT = 99.9
"""Percent of the returns whose error is stated where no accuracy says another."""


@dataclass(frozen=True, slots=True)
class Pick:
    """A number of rays that was picked for a drive.

    asked     : accuracy and budget, as text
    rays      : per pulse
    percent   : of the returns for which errors are stated
    expected  : range error by scanner, metres, of the profile's places
    candidate : of the profile; None where an earlier run had picked
    profile   : by which it was picked; None likewise
    """

    asked: dict[str, str]
    rays: int
    percent: float
    expected: dict[str, Estimate]
    candidate: Candidate | None = None
    profile: Profile | None = None

    def to_json(self) -> dict[str, Any]:
        """All that does not depend on the machine."""
        expected = {name: error.to_json() for name, error in self.expected.items()}
        return {
            "asked": self.asked,
            "picked": {PICKED: self.rays},
            "percent": self.percent,
            "expected_error_m": expected,
        }

    @property
    def settings(self) -> tuple[tuple[str, str], ...]:
        """The picked setting as of `DriveOptions.settings`."""
        return ((PICKED, str(self.rays)),)

    def to_text(self, workers: int) -> str:
        """What was picked and what to expect of it."""
        found = ", ".join(f"{name} {error_text(error)}" for name, error in self.expected.items())
        text = f"picked {PICKED}={self.rays}: expect range errors at {self.percent:g} % of {found}"
        if self.candidate is None:
            return f"{text}; as picked before for this dataset"
        cost = self.candidate.cpu_s
        return (
            f"{text}, and {cost.value:.3g} CPU s per simulated second, which is"
            f" {speed(self.candidate, workers):.2g} x real time with {workers_text(workers)}"
        )


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
        document = self.pick.to_json() if self.pick else {}
        if self.pick and self.pick.candidate and self.pick.profile:
            cost = self.pick.candidate.cpu_s
            document |= {
                "expected_cpu_s": cost.to_json(),
                "expected_speed": round(threads(workers) / cost.value, 3),
                "profile": str(self.pick.profile.path),
                "profile_made": self.pick.profile.made,
            }
        if self.pick and self.speed:
            document["speed"] = round(self.speed, 3)
        return document | (self.reached.to_json() if self.reached else {})

    @property
    def speed(self) -> float | None:
        """Simulated seconds per second in which frames were recorded; None for a drive that was resumed."""
        if self.summary.resumed or not self.summary.recording:
            return None
        return self.summary.duration / self.summary.recording

    def to_text(self) -> str:
        """What was reached, in one line; empty without a check."""
        if self.reached is None:
            return ""
        pace = f"; recorded at {self.speed:.2g} x real time" if self.speed else ""
        return self.reached.to_text() + pace * bool(self.pick)

    def missed(self) -> list[str]:
        """That the accuracy or the budget is missed, a line for each."""
        lines = []
        if self.wanted.accuracy and self.reached is not None:
            asked = read_accuracy(self.wanted.accuracy)
            worse = [
                f"{name} has {error_text(error)}"
                for name, error in self.reached.reached.items()
                if error.value > asked.metres
            ]
            if worse:
                goal = f"{asked.text.split('@')[0]} at {asked.percent:g} %"
                lines.append(f"the accuracy of {goal} is missed on this drive: {', '.join(worse)}")
        if self.wanted.budget and self.speed and self.speed < read_budget(self.wanted.budget):
            lines.append(
                f"the budget of {self.wanted.budget} is missed: recorded at {self.speed:.2g} x real time;"
                " was the machine busy?"
            )
        return lines


def picked(
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
    asker = "accuracy" if wanted.accuracy else "budget"
    for name, value in options.settings:
        if name in (PICKED, "stretch"):
            why = "picks it" if name == PICKED else f"picks {PICKED}, and more than one has no stretch"
            raise InputError(f"`settings` {name}={value}: `{asker}` {why}; leave one of them out")
    if wanted.budget and options.scheduler:
        raise InputError("`budget` is for this machine, and `scheduler` for others; leave one of them out")
    if before := _picked_before(out, wanted) if out else None:
        return before
    profile = profile_of(scene, options, folder=wanted.profile_cache, progress=progress)
    candidate = choice(profile, wanted, workers=options.workers)
    percent = read_accuracy(wanted.accuracy).percent if wanted.accuracy else _PERCENT
    expected = {name: error.range_m[percent] for name, error in candidate.errors.items()}
    return Pick(_asked(wanted), candidate.rays, percent, expected, candidate=candidate, profile=profile)


def driven(
    scene: Scene,
    out: str | Path,
    *,
    options: DriveOptions,
    wanted: AccuracyOptions,
    pick: Pick | None,
    overwrite: bool = False,
    progress: Progress = silent,
) -> CheckedDrive:
    """Drive as `lidar.pipeline.drive` does, with what was picked, and check a sample of the frames.

    The recipe holds what was picked, so that a drive is resumed with it, also on another machine.

    Raises InputError (also as RouteError, RigError, DatasetError) for what cannot be driven or written.
    """
    found: list[SpotCheck] = []
    notes = pick.to_json() if pick else {}

    def check(plan: DrivePlan) -> dict[str, Any]:
        found.append(spot_check(plan, percent=pick.percent if pick else _PERCENT, progress=progress))
        return {"accuracy": notes | found[0].to_json()}

    if pick:
        options = replace(options, settings=(*options.settings, *pick.settings))
    summary = pipeline.drive(
        scene,
        out,
        options=options,
        overwrite=overwrite,
        progress=progress,
        notes={"accuracy": notes} if notes else {},
        check=check if wanted.checks else None,
    )
    return CheckedDrive(summary, wanted, pick, found[0] if found else None)


def _asked(wanted: AccuracyOptions) -> dict[str, str]:
    texts = {"accuracy": wanted.accuracy.strip(), "budget": wanted.budget.strip()}
    return {name: text for name, text in texts.items() if text}


def _picked_before(out: Path, wanted: AccuracyOptions) -> Pick | None:
    """What was picked for a dataset that was begun for the same accuracy and budget."""
    if not Paths(out).manifest.exists():
        return None
    notes = open_dataset(out).manifest.get("accuracy", {})
    if notes.get("asked") != _asked(wanted):
        return None
    try:
        expected = {
            name: Estimate(**{key: float(figures[key]) for key in ("value", "low", "high")})
            for name, figures in notes["expected_error_m"].items()
        }
        return Pick(notes["asked"], int(notes["picked"][PICKED]), float(notes["percent"]), expected)
    except (KeyError, TypeError, ValueError):
        raise DatasetError(
            f"{Paths(out).manifest}: damaged (accuracy); set `overwrite` to drive again"
        ) from None


def choice(profile: Profile, wanted: AccuracyOptions, *, workers: int) -> Candidate:
    """The candidate to take: the first that reaches an accuracy, or the last within a budget.

    Errors count by the upper end of their intervals, and so do costs. The order of candidates is the same on
    all machines, and so is what an accuracy alone picks.

    Raises InputError, which names the nearest, if there is none.
    """
    asked = read_accuracy(wanted.accuracy) if wanted.accuracy else None
    limit = read_budget(wanted.budget) if wanted.budget else 0.0
    affordable = [c for c in profile.candidates if slowest(c, workers) >= limit]
    if not affordable:
        first = profile.candidates[0]
        raise InputError(
            f"`budget` {wanted.budget}: even {_rays(first)} is simulated at"
            f" {slowest(first, workers):.2g} x real time with {workers_text(workers)}; give more time"
        )
    if asked is None:
        return affordable[-1]
    enough = [c for c in profile.candidates if worst(c, asked.percent).high <= asked.metres]
    if not enough:
        raise InputError(_out_of_reach(profile, asked))
    if enough[0].rays > affordable[-1].rays:
        best = worst(affordable[-1], asked.percent)
        raise InputError(
            f"`accuracy` {wanted.accuracy} takes {_rays(enough[0])}, simulated at"
            f" {slowest(enough[0], workers):.2g} x real time with {workers_text(workers)}, and `budget`"
            f" {wanted.budget} allows {_rays(affordable[-1])}, with errors of {error_text(best)}"
        )
    return enough[0]


def _out_of_reach(profile: Profile, asked: Accuracy) -> str:
    """That an accuracy is not reached, and what is."""
    best = min(profile.candidates, key=lambda c: worst(c, asked.percent).high)
    error = worst(best, asked.percent)
    return (
        f"`accuracy` {asked.text}: no number of rays is sure to reach it at {asked.percent:g} % of the"
        f" returns; {_rays(best)} errs by {error_text(error)}: give {metres(error.high)} or more, or a"
        f" smaller share, as in {asked.text.split('@')[0]}@{_smaller(asked.percent):g}"
    )


def _smaller(percent: float) -> float:
    return 99.0 if percent > 99 else 95.0 if percent > 95 else 90.0 if percent > 90 else 50.0


def worst(candidate: Candidate, percent: float) -> Estimate:
    """The range error of the scanner with the largest upper end."""
    return max((e.range_m[percent] for e in candidate.errors.values()), key=lambda error: error.high)


def speed(candidate: Candidate, workers: int) -> float:
    """Simulated seconds per second that a cost stands for, if no worker waits for others."""
    return threads(workers) / candidate.cpu_s.value


def slowest(candidate: Candidate, workers: int) -> float:
    """Simulated seconds per second by the upper end of the cost."""
    return threads(workers) / candidate.cpu_s.high


def threads(workers: int) -> int:
    """Threads that work at a time."""
    return min(workers, os.cpu_count() or 1)


def workers_text(workers: int) -> str:
    """A number of workers in words."""
    count = threads(workers)
    return f"{count} worker{'s' * (count > 1)}"


def _rays(candidate: Candidate) -> str:
    return f"{PICKED}={candidate.rays}"
