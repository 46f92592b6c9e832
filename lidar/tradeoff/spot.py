"""Check of a recorded drive: a sample of its pulses, simulated again and compared with the exact end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from geoscene.charts import metres
from geoscene.progress import Progress, silent
from lidar.plan import DrivePlan
from lidar.rig.devices import Scanner
from lidar.tradeoff.errors import Estimate
from lidar.tradeoff.sampling import RangeError, SampledError, errors_of, places, range_error

_FRAMES = 10
"""Frames of each scanner that are checked."""


@dataclass(frozen=True, slots=True)
class SpotCheck:
    """Errors that a drive has reached.

    percent : of the returns for which errors are stated
    errors  : of each scanner, by its name
    frames  : checked of each scanner
    """

    percent: float
    errors: dict[str, RangeError]
    frames: dict[str, int]

    @property
    def reached(self) -> dict[str, Estimate]:
        """Range error of each scanner, metres."""
        return {name: error.range_m[self.percent] for name, error in self.errors.items()}

    def to_text(self) -> str:
        """What was reached, in one line."""
        found = ", ".join(f"{name} {error_text(error)}" for name, error in self.reached.items())
        count = max(self.frames.values(), default=0)
        return f"spot check of {count} frames: range errors at {self.percent:g} % are {found or 'unknown'}"

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        reached = {name: error.to_json() for name, error in self.reached.items()}
        every = {name: {"frames": self.frames[name]} | error.to_json() for name, error in self.errors.items()}
        return {"percent": self.percent, "reached_error_m": reached, "spot_check": every}


def error_text(error: Estimate) -> str:
    """An error with its interval."""
    return f"{metres(error.value)} ({metres(error.low)} to {metres(error.high)})"


def spot_check(plan: DrivePlan, *, percent: float, progress: Progress = silent) -> SpotCheck:
    """Range errors of a sample of frames of a drive's scanners, without random effects and stages.

    Frames are spread over the drive. The same drive has the same sample.
    """
    settings = plan.options.contents().scanner
    found: dict[str, list[SampledError]] = {s.name: [] for s in plan.sensors if isinstance(s, Scanner)}
    total = _FRAMES * len(found)
    for bench in places(plan, frames=_FRAMES):
        for scanner in (s for s in bench.plan.sensors if isinstance(s, Scanner)):
            for (error,) in errors_of(bench, scanner, settings=[settings]):
                found[scanner.name].append(error)
                progress("checking errors", sum(map(len, found.values())), total=total)
    errors = {name: range_error(frames) for name, frames in found.items() if frames}
    return SpotCheck(percent, errors, {name: len(found[name]) for name in errors})
