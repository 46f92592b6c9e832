"""Settings that were picked for a drive, and the errors and costs to expect of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lidar.simulation.plan import DrivePlan
from lidar.tools.tradeoff.errors import ErrorEstimate
from lidar.tools.tradeoff.sensor_errors import SensorErrors

PERCENT = 99.9
"""Percent of the returns whose error is stated where no accuracy says another."""


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
    """Numbers of rays that were picked for a drive.

    asked    : accuracy and budget, as text
    settings : that were picked, by name
    expected : errors of the drive, by a sample of its frames
    plan     : of the drive, with its own settings; None where an earlier run had picked
    cost     : None likewise
    """

    asked: dict[str, str]
    settings: dict[str, int]
    expected: SensorErrors
    plan: DrivePlan | None = None
    cost: PickCost | None = None

    def to_json(self) -> dict[str, Any]:
        """The entry ``accuracy`` of ``dataset.json``, without figures of this machine."""
        return {"asked": self.asked, "picked": self.settings} | self.expected.to_json("expected")

    @property
    def label(self) -> str:
        """The settings, as in ``rays=7``; empty if none was to be picked."""
        return " ".join(f"{name}={value}" for name, value in self.settings.items())

    def to_text(self) -> str:
        """The settings, and the errors and costs to expect, in one line."""
        words = self.label or "nothing, as no setting changes depths"
        text = f"picked {words}: {self.expected.to_text('should be')}"
        if self.cost is None:
            return f"{text}; as picked before for this dataset"
        cost = self.cost
        count = f"{cost.threads} worker{'s' * (cost.threads > 1)}"
        return (
            f"{text}; it takes {cost.cpu_s.value:.3g} CPU s per simulated second, which is"
            f" {cost.speed:.2g} x real time with {count}, planning ({cost.planning[1]:.2g} CPU s) and loading"
            f" ({cost.loading:.2g}) included"
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
