"""Drives to an accuracy or within a budget of time: numbers of rays are picked, and errors are checked."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geoscene.scene import Scene
from geoscene.support.files import exclusive, write_json
from geoscene.support.progress import Progress, silent
from lidar.dataset.journal import forget_frames
from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import DatasetError, InputError
from lidar.options.accuracy import AccuracyOptions, read_accuracy, read_budget
from lidar.options.drive import DriveOptions
from lidar.parameters import value_text
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.specs import load_rig
from lidar.simulation import drive as pipeline
from lidar.simulation.plan import DrivePlan, plan_drive, sensors_of
from lidar.tools.tradeoff.errors import ErrorEstimate
from lidar.tools.tradeoff.pick import (
    PERCENT,
    Kind,
    Pick,
    SensorErrors,
    kinds_of,
    label_of,
    ladders_of,
    stated,
)

_CHECKED = 10
"""Frames of each sensor that are checked after a drive."""


@dataclass(frozen=True, slots=True)
class SpotCheck:
    """Errors that a drive has reached in a sample of its frames.

    reached : errors of the kinds that are stated
    errors  : all figures of each sensor, with intervals by resampling frames
    frames  : number of frames, by sensor
    """

    reached: SensorErrors
    errors: dict[str, dict[str, ErrorEstimate]]
    frames: dict[str, int]

    def to_text(self) -> str:
        """The errors, in one line."""
        count = max(self.frames.values(), default=0)
        return f"spot check of {count} frames: {self.reached.to_text('are')}"

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        every = {
            name: {"frames": self.frames[name]} | {figure: error.to_json() for figure, error in of.items()}
            for name, of in self.errors.items()
        }
        return self.reached.to_json("reached") | {"spot_check": every}


@dataclass(frozen=True, slots=True)
class CheckedDrive:
    """A finished drive with the settings that were picked for it and the errors that it reached.

    wanted  : accuracy and budget
    pick    : None if nothing was to be picked
    reached : None if no check was asked for
    """

    summary: pipeline.DriveSummary
    wanted: AccuracyOptions
    pick: Pick | None
    reached: SpotCheck | None

    def accuracy(self) -> dict[str, Any]:
        """Settings, expected and reached errors, and costs on this machine."""
        document = self.pick.to_json() | self.pick.costs() if self.pick else {}
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
        ahead = self.pick.cost.planning[0] if self.pick and self.pick.cost else 0.0
        return ahead + self.summary.planning

    def to_text(self) -> str:
        """The errors that were reached, in one line; empty without a check."""
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
                how = "; the same command with --resume records it again with the next finer setting"
                lines.append(
                    f"the accuracy of {asked.text} is missed on this drive: {', '.join(worse.values())}"
                    + how * bool(self.pick)
                )
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
    """The pick for a drive, or None if none is wanted: of the dataset that is resumed, or by a sample.

    out : of a drive that may have begun

    Raises InputError (also as RouteError, RigError) if no settings reach the accuracy or budget, and for
    settings that contradict it.
    """
    if not wanted.picks:
        return None
    free = _free(options, wanted)
    before = _picked_before(out, wanted) if out else None
    if wanted.resume:
        if before is None:
            raise InputError(
                f"`resume`: there is no drive with `accuracy` {wanted.accuracy} in the output; leave it out"
            )
        return _finer(*before, options=options, wanted=wanted, free=free)
    if before:
        return before[0]
    from lidar.tools.tradeoff.search import pick_by_sample  # noqa: PLC0415  (0.1 s)

    return pick_by_sample(scene, options, wanted=wanted, free=free, progress=progress)


def spot_check(
    plan: DrivePlan, *, percent: float, kinds: tuple[str, ...], progress: Progress = silent
) -> SpotCheck:
    """Errors of a sample of frames of a drive's sensors, without random effects and stages.

    percent : of the returns or pixels with a depth for which errors are stated
    kinds   : of errors that are stated; sensors that have none of these are not checked
    """
    from lidar.tools.tradeoff.sample import DriveSample, sensors_with  # noqa: PLC0415  (0.1 s)

    own = plan.options.recording_settings
    sensors = sensors_with(plan.sensors, kinds=kinds)
    errors: dict[str, dict[str, ErrorEstimate]] = {}
    frames: dict[str, int] = {}
    for kind, settings in ((Scanner, own.scanner), (Camera, own.camera)):
        of_kind = [sensor for sensor in sensors if isinstance(sensor, kind)]
        sample = DriveSample(plan, of_kind, settings=[settings], other=True, progress=progress)
        sample.grow(_CHECKED)
        errors |= sample.figures(0)
        frames |= sample.counts
    return SpotCheck(stated(errors, percent=percent, kinds=kinds), errors, frames)


def _free(options: DriveOptions, wanted: AccuracyOptions) -> tuple[Kind, ...]:
    """Kinds of sensors for which settings may be picked.

    Raises InputError for settings that contradict the accuracy, and for errors that no sensor has.
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
    names: dict[Kind, tuple[str, ...]] = {
        "scanners": ("rays", "footprint", "stretch"),
        "cameras": ("supersample", "edge_rays"),
    }
    if any(isinstance(s, Camera) and s.spec.exposure_ns for s in sensors):
        names["cameras"] = ("supersample", "blur")
    held = {
        kind: [(name, value) for name, value in options.settings if name in of] for kind, of in names.items()
    }
    has: dict[Kind, bool] = {"scanners": scanning, "cameras": "rgb" in images}
    here = [kind for kind, there in has.items() if there]
    picks = {"scanners": asked is None or bool(asked.metres), "cameras": asked is None or bool(asked.levels)}
    if asked is None and not here:
        raise InputError(
            f"`rig` {options.rig}: has no scanner and no camera of colours, whose rays are picked"
        )
    free = tuple(kind for kind in here if picks[kind] and not held[kind])
    taken = [held[kind][0] for kind in here if picks[kind] and held[kind]]
    if taken and (asked or not free):
        (name, value), asker = taken[0], "accuracy" if asked else "budget"
        why = {
            "stretch": "picks rays, and more than one has no stretch",
        }.get(name, "picks it")
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
    """Drive as `lidar.simulation.drive.drive` does, with the picked settings, and check a sample of frames.

    The recipe holds the picked settings, so that a drive is resumed with it, also on another machine.

    Raises InputError (also as RouteError, RigError, DatasetError) for what cannot be driven or written.
    """
    found: list[SpotCheck] = []
    notes = pick.to_json() if pick else {}
    percent = pick.expected.percent if pick else PERCENT
    kinds = kinds_of(read_accuracy(wanted.accuracy) if wanted.accuracy else None)

    def check(plan: DrivePlan) -> dict[str, Any]:
        found.append(spot_check(plan, percent=percent, kinds=kinds, progress=progress))
        return {"accuracy": notes | found[0].to_json()}

    plan, kept = None, {"accuracy": notes} if notes else {}
    if pick:
        more = tuple((name, value_text(value)) for name, value in pick.settings.items())
        options = replace(options, settings=(*options.settings, *more))
        plan = replace(pick.plan, options=options) if pick.plan else None
        if pick.again:
            plan = plan_drive(scene, options, progress=progress)
            _reopen(Path(out), plan.manifest() | kept, sensors=pick.again)
    summary = pipeline.drive(
        scene,
        out,
        options=options,
        overwrite=overwrite,
        progress=progress,
        notes=kept,
        check=check if wanted.checks else None,
        plan=plan,
        live=live,
    )
    return CheckedDrive(summary, wanted, pick, found[0] if found else None)


def _picked_before(out: Path, wanted: AccuracyOptions) -> tuple[Pick, SensorErrors] | None:
    """The pick for a dataset that was begun for the same accuracy and budget, and the errors it reached.

    The errors are none until the drive is finished and checked.
    """
    if not Paths(out).manifest.exists():
        return None
    notes = open_dataset(out).manifest.get("accuracy", {})
    if notes.get("asked") != wanted.request:
        return None
    try:
        settings = {str(name): _number(value) for name, value in notes["picked"].items()}
        picked = Pick(notes["asked"], settings, SensorErrors.from_json(notes, "expected"))
        return picked, SensorErrors.from_json(notes, "reached")
    except (AttributeError, KeyError, TypeError, ValueError):
        raise DatasetError(
            f"{Paths(out).manifest}: damaged (accuracy); set `overwrite` to drive again"
        ) from None


def _finer(
    before: Pick,
    reached: SensorErrors,
    *,
    options: DriveOptions,
    wanted: AccuracyOptions,
    free: Sequence[Kind],
) -> Pick:
    """The next finer pick for the sensors of a drive that missed its accuracy; the one before if none did.

    Raises InputError if there is nothing finer.
    """
    missed = reached.beyond(read_accuracy(wanted.accuracy))
    settings, again = dict(before.settings), dict[str, str]()
    for kind, ladder in ladders_of(options, sensors_of(load_rig(options.rig), options), free=free).items():
        own = [sensor.name for sensor in ladder.sensors if sensor.name in missed]
        if not own or kind not in free:
            continue
        rows = list(map(ladder.values, range(len(ladder.rows))))
        names = {name for row in rows for name in row}
        at = {name: value for name, value in before.settings.items() if name in names}
        if at not in rows[:-1]:
            raise InputError(f"`resume`: nothing is finer than {label_of(at)}, which {', '.join(own)} had")
        settings = {name: value for name, value in settings.items() if name not in names}
        settings |= rows[rows.index(at) + 1]
        again |= {sensor.name: missed.get(sensor.name, sensor.name) for sensor in ladder.sensors}
    if missed and not again:
        raise InputError(f"`resume`: no setting makes it better: {', '.join(missed.values())}")
    return Pick(wanted.request, settings, SensorErrors(reached.percent), again=again) if again else before


def _reopen(out: Path, manifest: Mapping[str, Any], *, sensors: Collection[str]) -> None:
    """Make a finished dataset one that is resumed with another recipe, without frames of some sensors.

    If this is killed, the dataset states an unfinished drive of the former or the new recipe, whose frames
    in the journal are as that one records them.
    """
    paths = Paths(out)
    with exclusive(out):
        write_json(paths.manifest, open_dataset(out).manifest | {"frames_done": 0})
        forget_frames(paths.journal, sensors)
        write_json(paths.manifest, dict(manifest) | {"frames_done": 0})


def _number(value: object) -> float:
    """A number of a JSON document; raises TypeError for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return value
