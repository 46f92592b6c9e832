"""Errors of the sensors of a drive, expected or reached: as text and as JSON."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from geoscene.drawing.figures import levels, metres, share
from lidar.options import AccuracyTarget
from lidar.tools.tradeoff.comparison import LOST
from lidar.tools.tradeoff.errors import ErrorEstimate


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Errors by name of the sensor; of some sensors, or none, of each kind.

    percent : of the returns or pixels for which ranges and depths are stated
    ranges  : of scanners, metres
    depths  : of cameras, metres
    colours : of cameras, levels of 255, rms
    lost    : of scanners, missed and extra returns over all, where they are more than `comparison.LOST`
    """

    percent: float
    ranges: dict[str, ErrorEstimate] = field(default_factory=dict)
    depths: dict[str, ErrorEstimate] = field(default_factory=dict)
    colours: dict[str, ErrorEstimate] = field(default_factory=dict)
    lost: dict[str, ErrorEstimate] = field(default_factory=dict)

    def to_json(self, prefix: str) -> dict[str, Any]:
        """The errors that there are, such as ``expected_error_m``, for a prefix."""
        found: dict[str, Any] = {"percent": self.percent}
        for kind, name in _KEYS.items():
            if errors := getattr(self, kind):
                found[f"{prefix}_{name}"] = {sensor: error.to_json() for sensor, error in errors.items()}
        return found

    @classmethod
    def from_json(cls, document: Mapping[str, Any], prefix: str) -> SensorErrors:
        """The errors of `to_json`; raises KeyError, TypeError or ValueError for others."""
        every = {
            kind: {
                sensor: ErrorEstimate.from_json(error)
                for sensor, error in document.get(f"{prefix}_{name}", {}).items()
            }
            for kind, name in _KEYS.items()
        }
        return cls(float(document["percent"]), **every)

    def to_text(self, are: str) -> str:
        """All of them, in one line; ``are`` is the verb: are, or should be."""
        below = f"{self.percent:g} % of the"
        texts = [
            f"{below} range errors {are} below {_list_all(self.ranges)}" if self.ranges else "",
            f"{below} depth errors {are} below {_list_all(self.depths)}" if self.depths else "",
            f"colour errors (rms) {are} {_list_all(self.colours, size=levels)}" if self.colours else "",
            f"missed and extra returns {are} {_list_all(self.lost, size=share)}" if self.lost else "",
        ]
        return ", ".join(filter(None, texts)) or "no errors are known"

    def beyond(self, asked: AccuracyTarget) -> list[str]:
        """Description of the errors that exceed a target."""
        lengths = {name: e for name, e in (self.ranges | self.depths).items() if e.value > asked.metres > 0}
        colours = {name: e for name, e in self.colours.items() if e.value > asked.levels > 0}
        return [
            *(f"{name} has {error_text(error)}" for name, error in lengths.items()),
            *(f"{name} has {error_text(error, size=levels)}" for name, error in colours.items()),
        ]


_KEYS = {"ranges": "error_m", "depths": "depth_error_m", "colours": "error_levels", "lost": "lost"}


def error_text(error: ErrorEstimate, *, size: Callable[[float], str] = metres) -> str:
    """An error with its interval."""
    return f"{size(error.value)} ({size(error.low)} to {size(error.high)})"


def _list_all(errors: Mapping[str, ErrorEstimate], *, size: Callable[[float], str] = metres) -> str:
    return ", ".join(f"{error_text(error, size=size)} for {name}" for name, error in errors.items())


def stated(
    errors: Mapping[str, Mapping[str, ErrorEstimate]], *, percent: float, kinds: Collection[str]
) -> SensorErrors:
    """Of all figures of sensors, by their names, those of some kinds: ranges, depths and colours."""
    names = {"ranges": f"range_{percent:g}_m", "depths": f"depth_{percent:g}_m", "colours": "rgb_rms"}
    found = {
        kind: {sensor: figures[name] for sensor, figures in errors.items() if name in figures}
        for kind, name in names.items()
        if kind in kinds
    }
    lost = {sensor: errors[sensor]["lost"] for sensor in found.get("ranges", {}) if "lost" in errors[sensor]}
    return SensorErrors(percent, **found, lost={s: share for s, share in lost.items() if share.value > LOST})


def kinds_of(asked: AccuracyTarget | None) -> tuple[str, ...]:
    """Kinds of errors that are stated for an accuracy, or for a drive for which none was asked."""
    if asked is None:
        return ("ranges", "colours")
    return (("ranges", "depths") if asked.metres else ()) + (("colours",) if asked.levels else ())
