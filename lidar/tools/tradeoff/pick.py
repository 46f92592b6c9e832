"""Settings of rays to choose from for a drive, those that were picked, their errors and costs."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from geoscene.drawing.report import levels, metres, share
from lidar.options.accuracy import AccuracyTarget
from lidar.options.drive import DriveOptions
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.simulation.plan import DrivePlan, least_tolerance
from lidar.tools.tradeoff.errors import LOST, ErrorEstimate
from lidar.tools.tradeoff.variants import setting_text

Kind = Literal["scanners", "cameras"]

SCANNERS = (
    ("rays", 1, 1.0),
    ("rays", 7, 2.1),
    ("footprint", 0.1, 3.1),
    ("footprint", 0.03, 3.9),
    ("footprint", 0.01, 5.8),
    ("footprint", 0.003, 10.0),
    ("footprint", 0.001, 16.0),
    ("rays", 217, 54.0),
)
"""Rays per pulse, and tolerances of footprints in metres, to choose from, with their costs.

Costs are CPU time to record over that with one ray, about: medians of a VLP-16 in three places. Poses,
precision and the second trace are none of the choice, as they save a few percent at most.
"""

CAMERAS = ((1, 1), (1, 2), (1, 3), (2, 4), (2, 6), (3, 6), (4, 8), (8, 16))
"""Rays along each side of a pixel, and of one at an edge, to choose from.

Images without shadows or detail are none of the choice, as they save a quarter and err by 9 levels and more.
"""

_AT_EDGES = 0.12
"""Share of the pixels that are at edges, about, with the cost of finding them."""

EXPOSED = ((1, 5), (2, 9), (3, 17))
"""Rays along each side of a pixel, and moments, to choose from if the exposure of a camera takes time."""

PERCENT = 99.9
"""Percent of the returns whose error is stated where no accuracy says another."""


@dataclass(frozen=True, slots=True)
class Row:
    """Settings of a kind of sensors.

    settings : names and values; empty if none is to be picked, and the drive's own hold
    cost     : CPU time over that of one ray, about
    """

    settings: tuple[tuple[str, float], ...] = ()
    cost: float = 1.0


@dataclass(frozen=True, slots=True)
class Ladder:
    """Settings to choose from for the scanners or the cameras of a rig, the cheapest first.

    sensors : all of the kind
    """

    kind: Kind
    sensors: tuple[Scanner | Camera, ...]
    rows: tuple[Row, ...]

    def values(self, row: int) -> dict[str, float]:
        """The settings of a row, by name."""
        return dict(self.rows[row].settings)


def ladders_of(
    options: DriveOptions, sensors: Sequence[Scanner | Camera], *, free: Sequence[Kind]
) -> dict[Kind, Ladder]:
    """Ladders of the kinds of sensors of a drive; settings are picked for those in ``free``.

    The settings of the drive's fidelity level are among the rows. Tolerances of footprints are not below what
    noise and steps of ranges hide.
    """
    settings = options.recording_settings
    found: dict[Kind, Ladder] = {}
    if scanners := tuple(s for s in sensors if isinstance(s, Scanner)):
        least = max(least_tolerance(scanner, options).metres for scanner in scanners)
        found["scanners"] = Ladder("scanners", scanners, _scanner_rows(settings.scanner.rays, least=least))
    if cameras := tuple(s for s in sensors if isinstance(s, Camera)):
        blurred = any(s.spec.exposure_ns for s in cameras)
        found["cameras"] = Ladder("cameras", cameras, _camera_rows(settings.camera, blurred=blurred))
    return {kind: one if kind in free else replace(one, rows=(Row(),)) for kind, one in found.items()}


def _scanner_rows(own: int, *, least: float) -> tuple[Row, ...]:
    """Rows of scanners; ``own`` rays are of the drive, ``least`` is the smallest tolerance in metres."""
    rows = [
        Row(((name, value),), cost) for name, value, cost in SCANNERS if name != "footprint" or value >= least
    ]
    if all(row.settings != (("rays", own),) for row in rows):
        rows.append(Row((("rays", own),), 0.75 + 0.25 * own))
    return tuple(sorted(rows, key=lambda row: row.cost))


def _camera_rows(own: CameraSettings, *, blurred: bool) -> tuple[Row, ...]:
    """Rows of cameras, whose exposure may take time."""
    if blurred:
        shots = {*EXPOSED, (own.supersample, own.blur)}
        rows = [
            Row((("supersample", side), ("blur", moments)), float(side**2 * moments))
            for side, moments in shots
        ]
    else:
        pairs = {*CAMERAS, (own.supersample, own.edge_rays)}
        rows = [
            Row((("supersample", side), ("edge_rays", at_edges)), _pixel_cost(side, at_edges))
            for side, at_edges in pairs
        ]
    return tuple(sorted(rows, key=lambda row: (row.cost, row.settings)))


def _pixel_cost(side: int, at_edges: int) -> float:
    """CPU time of an image over that of one ray per pixel, about; of rays along sides of pixels."""
    return side**2 + (_AT_EDGES * at_edges**2 if at_edges > side else 0.0)


def settings_of_rows(ladders: Mapping[Kind, Ladder], rows: Mapping[Kind, int]) -> dict[str, float]:
    """Values of all settings that are picked, by name."""
    return {name: value for kind, row in rows.items() for name, value in ladders[kind].values(row).items()}


def label_of(settings: Mapping[str, float]) -> str:
    """Settings as text, as in ``rays=7`` or ``footprint=3cm``."""
    return " ".join(setting_text(*one) for one in settings.items())


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Errors by name of the sensor; of some sensors, or none, of each kind.

    percent : of the returns or pixels for which ranges and depths are stated
    ranges  : of scanners, metres
    depths  : of cameras, metres
    colours : of cameras, levels of 255, rms
    lost    : of scanners, missed and extra returns over all, where they are more than `errors.LOST`
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

    def beyond(self, asked: AccuracyTarget) -> dict[str, str]:
        """Description of the errors that exceed a target, by sensor."""
        lengths = {name: e for name, e in (self.ranges | self.depths).items() if e.value > asked.metres > 0}
        colours = {name: e for name, e in self.colours.items() if e.value > asked.levels > 0}
        found = {name: f"{name} has {error.to_text(levels)}" for name, error in colours.items()}
        return found | {name: f"{name} has {error.to_text()}" for name, error in lengths.items()}


_KEYS = {"ranges": "error_m", "depths": "depth_error_m", "colours": "error_levels", "lost": "lost"}


def _list_all(errors: Mapping[str, ErrorEstimate], *, size: Callable[[float], str] = metres) -> str:
    return ", ".join(f"{error.to_text(size)} for {name}" for name, error in errors.items())


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


@dataclass(frozen=True, slots=True)
class PickCost:
    """Costs of a drive with the settings that were picked for it.

    cpu_s    : CPU seconds per simulated second to record it
    planning : seconds that planning took, and CPU seconds of these
    loading  : CPU seconds to load tiles along it
    duration : simulated seconds
    threads  : that record at a time
    """

    cpu_s: ErrorEstimate
    planning: tuple[float, float]
    loading: float
    duration: float
    threads: int

    @property
    def speed(self) -> float:
        """Simulated seconds per second, with planning and loading."""
        overhead = (self.planning[1] + self.loading) / self.duration
        return 1 / (self.cpu_s.value / self.threads + overhead)


@dataclass(frozen=True, slots=True)
class Pick:
    """Settings of rays that were picked for a drive.

    asked    : accuracy and budget, as text
    settings : that were picked, by name: numbers of rays, metres of footprints
    expected : errors of the drive, by a sample of its frames
    plan     : of the drive, with its own settings; None where an earlier run had picked
    cost     : None likewise
    again    : sensors of a finished drive that are recorded again, with why; the others keep their files
    """

    asked: dict[str, str]
    settings: dict[str, float]
    expected: SensorErrors
    plan: DrivePlan | None = None
    cost: PickCost | None = None
    again: dict[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """The entry ``accuracy`` of ``dataset.json``, without figures of this machine."""
        return {"asked": self.asked, "picked": self.settings} | self.expected.to_json("expected")

    @property
    def label(self) -> str:
        """The settings, as in ``rays=7``; empty if none was to be picked."""
        return label_of(self.settings)

    def to_text(self) -> str:
        """The settings, and the errors and costs to expect, in one line."""
        if self.again:
            return f"picked {self.label}, the next finer; recorded again: {', '.join(self.again.values())}"
        words = self.label or "nothing, as no setting changes depths"
        known = any(getattr(self.expected, kind) for kind in _KEYS)
        text = f"picked {words}" + f": {self.expected.to_text('should be')}" * known
        if self.cost is None:
            return f"{text}; as picked before for this dataset"
        cost = self.cost
        return (
            f"{text}; it takes {cost.cpu_s.value:.3g} CPU s per simulated second, which is"
            f" {cost.speed:.2g} x real time with {workers_text(cost.threads)}, planning"
            f" ({cost.planning[1]:.2g} CPU s) and loading ({cost.loading:.2g}) included"
        )

    def costs(self) -> dict[str, Any]:
        """Figures of this machine; empty where an earlier run had picked."""
        if self.cost is None:
            return {}
        return {
            "expected_cpu_s": self.cost.cpu_s.to_json(),
            "expected_speed": round(self.cost.speed, 3),
            "planning_cpu_s": round(self.cost.planning[1], 3),
            "expected_loading_cpu_s": round(self.cost.loading, 3),
        }


def workers_text(threads: int) -> str:
    """A number of workers as text."""
    return f"{threads} worker{'s' * (threads > 1)}"
