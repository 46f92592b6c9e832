"""The choice among the candidates of a profile, by an accuracy or a budget of time."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from geoscene.drawing.figures import metres
from lidar.errors import InputError
from lidar.options import AccuracyTarget
from lidar.tools.tradeoff.errors import ErrorEstimate
from lidar.tools.tradeoff.sensor_errors import error_text
from lidar.tools.tradeoff.words import levels

if TYPE_CHECKING:
    from lidar.tools.tradeoff.profile import Candidate, Profile

Kind = Literal["scanners", "cameras"]


@dataclass(frozen=True, slots=True)
class Choice:
    """A candidate for the scanners and one for the cameras of a rig; None without such.

    picked : the kinds of which a candidate was picked, not given
    """

    scanners: Candidate | None
    cameras: Candidate | None
    picked: tuple[Kind, ...] = ()

    @property
    def parts(self) -> tuple[Candidate, ...]:
        """Both, or the one that there is."""
        return tuple(part for part in (self.scanners, self.cameras) if part is not None)

    @property
    def cpu_s(self) -> ErrorEstimate:
        """CPU seconds per simulated second of all sensors."""
        return sum((part.cpu_s for part in self.parts), ErrorEstimate(0.0, 0.0, 0.0))

    @property
    def errors(self) -> dict[str, dict[str, ErrorEstimate]]:
        """Figures of each sensor."""
        return {name: figures for part in self.parts for name, figures in part.errors.items()}

    @property
    def settings(self) -> dict[str, int]:
        """Values of the settings that were picked."""
        chosen = [part for kind in self.picked if (part := getattr(self, kind)) is not None]
        return {name: value for part in chosen for name, value in part.settings.items()}

    @property
    def label(self) -> str:
        """The same as text."""
        return _label(self.settings)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a choice is made by.

    accuracy : asked for; None for none
    pace     : simulated seconds to be recorded per second; 0 for any
    budget   : of which the pace is what planning and loading leave, as text
    workers  : that record
    given    : values of rays, supersample and blur of the drive, which hold where nothing is picked
    free     : kinds of sensors for which may be picked
    """

    accuracy: AccuracyTarget | None = None
    pace: float = 0.0
    budget: str = ""
    workers: int = 1
    given: Mapping[str, int] = field(default_factory=dict)
    free: tuple[Kind, ...] = ("scanners", "cameras")


def choice(profile: Profile, wanted: Wanted) -> Choice:
    """The cheapest candidates that reach an accuracy, or the last within a budget.

    Errors count by the upper end of their intervals, and so do costs. The order of candidates is the same on
    all machines, and so is what an accuracy alone picks. Within a budget what is cheaper to raise next is
    raised, the rays of scanners or those of cameras.

    Raises InputError, which names the nearest, if there is none.
    """
    begin = _given(profile, wanted.given)
    if wanted.accuracy is None:
        return _affordable(profile, wanted, begin=begin)
    chosen = _accurate(profile, wanted.accuracy, begin=begin)
    if slowest(chosen, wanted.workers) >= wanted.pace:
        return chosen
    best = _affordable(profile, wanted, begin=replace(begin, picked=chosen.picked))
    worse = [_worst_text(best, figure) for figure, _ in _limits(wanted.accuracy)]
    raise InputError(
        f"`accuracy` {wanted.accuracy.text} takes {chosen.label}, simulated at"
        f" {slowest(chosen, wanted.workers):.2g} x real time with {workers_text(wanted.workers)}, and"
        f" `budget` {wanted.budget} allows {best.label}, with errors of {', '.join(filter(None, worse))}"
    )


def _given(profile: Profile, given: Mapping[str, int]) -> Choice:
    """The candidates of the drive's own settings, the first where it has none of those."""

    def own(candidates: Sequence[Candidate]) -> Candidate | None:
        same = [c for c in candidates if all(given.get(name) == value for name, value in c.settings.items())]
        return (*same, *candidates, None)[0]

    return Choice(own(profile.scanners), own(profile.cameras))


def _limits(accuracy: AccuracyTarget) -> list[tuple[str, float]]:
    """Figures of errors, and what they must not exceed."""
    lengths = [(f"{kind}_{accuracy.percent:g}_m", accuracy.metres) for kind in ("range", "depth")]
    return lengths * bool(accuracy.metres) + [("rgb_rms", accuracy.levels)] * bool(accuracy.levels)


def _accurate(profile: Profile, accuracy: AccuracyTarget, *, begin: Choice) -> Choice:
    """The first candidates whose errors are within an accuracy; depths do not depend on the candidate."""
    chosen = begin
    kinds: dict[str, Kind] = {"range": "scanners", "rgb": "cameras", "depth": "cameras"}
    for figure, limit in _limits(accuracy):
        kind = kinds[figure.partition("_")[0]]
        candidates = [c for c in getattr(profile, kind) if any(figure in of for of in c.errors.values())]
        enough = [c for c in candidates if worst(c, figure).high <= limit]
        if candidates and not enough:
            raise InputError(_out_of_reach(candidates, accuracy, figure=figure))
        if enough and kind == "scanners":
            chosen = replace(chosen, scanners=enough[0], picked=(*chosen.picked, kind))
        elif enough and figure == "rgb_rms":
            chosen = replace(chosen, cameras=enough[0], picked=(*chosen.picked, kind))
    return chosen


def _affordable(profile: Profile, wanted: Wanted, *, begin: Choice) -> Choice:
    """The last candidates within a budget, of the kinds that are free."""
    every: dict[Kind, tuple[Candidate, ...]] = {"scanners": profile.scanners, "cameras": profile.cameras}
    may = wanted.free if wanted.accuracy is None else begin.picked
    free = [kind for kind in every if kind in may and every[kind]]
    at = dict.fromkeys(free, 0)

    def chosen(rows: Mapping[Kind, int]) -> Choice:
        parts = {kind: every[kind][row] for kind, row in rows.items()}
        return replace(
            begin,
            scanners=parts.get("scanners", begin.scanners),
            cameras=parts.get("cameras", begin.cameras),
            picked=tuple(free),
        )

    if slowest(chosen(at), wanted.workers) < wanted.pace:
        first = chosen(at)
        raise InputError(
            f"`budget` {wanted.budget}: even {first.label or 'the drive as asked'} is simulated at"
            f" {slowest(first, wanted.workers):.2g} x real time with {workers_text(wanted.workers)};"
            " give more time"
        )
    while True:
        next_rows = [at | {kind: at[kind] + 1} for kind in free if at[kind] + 1 < len(every[kind])]
        dearer = sorted(next_rows, key=lambda rows: chosen(rows).cpu_s.high)
        if not dearer or slowest(chosen(dearer[0]), wanted.workers) < wanted.pace:
            return chosen(at)
        at = dearer[0]


def _out_of_reach(candidates: Sequence[Candidate], accuracy: AccuracyTarget, *, figure: str) -> str:
    """The message of an accuracy that no candidate reaches, with the nearest."""
    best = min(candidates, key=lambda c: worst(c, figure).high)
    error = worst(best, figure)
    if figure == "rgb_rms":
        return (
            f"`accuracy` {accuracy.text}: no number of rays is sure to reach {levels(accuracy.levels)};"
            f" {_label(best.settings)} comes nearest with {error_text(error, size=levels)}: give"
            f" {levels(_up(error.high))} or more"
        )
    ranges = figure.startswith("range")
    what, of = ("number of rays", "returns") if ranges else ("image of depths", "pixels")
    subject = _label(best.settings) if ranges else f"that of {_where(best, figure)}"
    length = accuracy.text.split("@")[0].split(",")[0]
    return (
        f"`accuracy` {accuracy.text}: no {what} is sure to reach {metres(accuracy.metres)} at"
        f" {accuracy.percent:g} % of the {of}; {subject} comes nearest with {error_text(error)}: give"
        f" {metres(_up(error.high))} or more, or a smaller share, as in"
        f" {length}@{_smaller(accuracy.percent):g}"
    )


def _up(value: float) -> float:
    """A value rounded up to two digits."""
    step = 10.0 ** (math.floor(math.log10(value)) - 1)
    return math.ceil(value / step * (1 - 1e-9)) * step


def _smaller(percent: float) -> float:
    return 99.0 if percent > 99 else 95.0 if percent > 95 else 90.0 if percent > 90 else 50.0


def worst(candidate: Candidate, figure: str) -> ErrorEstimate:
    """A figure of the sensor with the largest upper end."""
    return max((of[figure] for of in candidate.errors.values() if figure in of), key=lambda error: error.high)


def _where(candidate: Candidate, figure: str) -> str:
    """The sensor of `worst`."""
    found = {sensor: of[figure].high for sensor, of in candidate.errors.items() if figure in of}
    return max(found, key=lambda sensor: found[sensor])


def _worst_text(chosen: Choice, figure: str) -> str:
    errors = [of[figure] for of in chosen.errors.values() if figure in of]
    if not errors:
        return ""
    return error_text(max(errors, key=lambda e: e.high), size=levels if figure == "rgb_rms" else metres)


def _label(settings: Mapping[str, int]) -> str:
    return " ".join(f"{name}={value}" for name, value in settings.items())


def speed(cost: ErrorEstimate, workers: int) -> float:
    """Simulated seconds per second of wall time at a cost, if all workers are always busy."""
    return threads(workers) / cost.value


def slowest(chosen: Choice, workers: int) -> float:
    """Simulated seconds per second by the upper end of the cost."""
    return threads(workers) / chosen.cpu_s.high


def threads(workers: int) -> int:
    """Threads that work at a time."""
    return min(workers, os.cpu_count() or 1)


def workers_text(workers: int) -> str:
    """A number of workers in words."""
    count = threads(workers)
    return f"{count} worker{'s' * (count > 1)}"
