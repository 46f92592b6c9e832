"""Results of a comparison of settings, and the cheapest settings that are exact enough."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
from typing import Literal

from geoscene.drawing.figures import levels, metres, share
from lidar.tools.tradeoff.errors import ErrorEstimate

Kind = Literal["scanner", "camera"]

TAILS: dict[Kind, str] = {"scanner": "range_99.9_m", "camera": "rgb_rms"}
"""The figure of an error by which settings of a kind of sensor are ranked."""

TARGETS: dict[Kind, tuple[float, ...]] = {"scanner": (0.001, 0.01, 0.1), "camera": (1.0, 3.0, 10.0)}
"""Errors for which a setting is recommended: metres at 99.9 %, and levels of 255 rms."""

LOST = 0.001
"""Share of missed and extra returns beyond which a setting does not keep any error at 99.9 %."""

_ENOUGH = 10_000
"""Pulses from which an error at 99.9 % is that of ten or more."""


@dataclass(frozen=True, slots=True)
class VariantRow:
    """A measured variant.

    error  : combined: only this setting differs from what the user asked for; see `errors.STATISTICS` and
             `errors.IMAGE_STATISTICS`
    alone  : only this setting differs from the reference; empty for the user's own settings and combinations
    cost   : CPU seconds (``cpu_s``) and bytes (``bytes``) per simulated second, peak memory
             (``memory_bytes``)
    note   : that changes have no effect on the sample, or change the model
    choice : whether it can be recommended: each change has an effect, and the world stays the same
    """

    label: str
    error: dict[str, ErrorEstimate]
    alone: dict[str, ErrorEstimate]
    cost: dict[str, ErrorEstimate]
    note: str = ""
    choice: bool = True


@dataclass(frozen=True, slots=True)
class SensorComparison:
    """The rows of a sensor.

    sensor    : name on the rig, with its preset or size
    reference : what errors are measured against, in words
    residual  : difference between the reference and one with another number of rays: its own uncertainty
    rows      : the user's own settings come first
    samples   : number of pulses or pixels compared
    frames    : number of frames that they are from
    """

    sensor: str
    reference: str
    residual: dict[str, ErrorEstimate]
    rows: tuple[VariantRow, ...]
    samples: int
    frames: int
    kind: Kind = "scanner"

    @property
    def tail(self) -> str:
        """The figure of an error by which the rows are ranked."""
        return TAILS[self.kind]

    @property
    def uncertainty(self) -> float:
        """Metres or levels (see `tail`) by which the reference may be off."""
        return self.residual[self.tail].value


def size_of(error: float, kind: Kind) -> str:
    """An error by which settings are ranked."""
    return metres(error) if kind == "scanner" else levels(error)


def ranked_error(comparison: SensorComparison, row: VariantRow) -> float:
    """The error by which a row is ranked: the upper end of its interval.

    inf if more than `LOST` of the returns are missed or extra.
    """
    if "missed" in row.error and row.error["missed"].value + row.error["extra"].value > LOST:
        return inf
    return row.error[comparison.tail].high


def pareto(comparison: SensorComparison) -> list[VariantRow]:
    """Choices of which no other is both cheaper and at least as exact, the cheapest first.

    Settings that miss or add more than `LOST` of the returns are left out.
    """
    best: list[VariantRow] = []
    ranked = [
        (row.cost["cpu_s"].value, ranked_error(comparison, row), row) for row in comparison.rows if row.choice
    ]
    for _, error, row in sorted(ranked, key=lambda r: r[:2]):
        if error < (ranked_error(comparison, best[-1]) if best else inf):
            best.append(row)
    return best


def recommendation(comparison: SensorComparison, target: float) -> str:
    """A sentence with the cheapest setting whose interval ends within an error, or the nearest one."""
    kind, rows = comparison.kind, pareto(comparison)
    wanted = f"For {size_of(target, kind)} {'at 99.9 %' if kind == 'scanner' else 'rms'}"
    if not rows:
        return f"{wanted} no setting is enough: all miss or add more than {share(LOST)} of the returns."
    fit = [row for row in rows if ranked_error(comparison, row) <= target]
    row = (fit or rows[-1:])[0]
    cost, error = row.cost["cpu_s"], row.error[comparison.tail]
    verdict = (
        "the cheapest setting is" if fit else "no setting that was compared is sure to be enough; nearest is"
    )
    text = (
        f"{wanted} {verdict} {row.label}: {size_of(error.value, kind)}, {size_of(error.high, kind)} at the"
        f" upper end of the 95 % interval, at {cost.value:.3g} CPU s per simulated second."
    )
    if fit and comparison.uncertainty > target:
        text += f" The reference is certain to {size_of(comparison.uncertainty, kind)} only."
    return text


def recommendations(comparison: SensorComparison) -> list[str]:
    """A sentence for each of `TARGETS`."""
    return [recommendation(comparison, target) for target in TARGETS[comparison.kind]]


def reference_text(comparison: SensorComparison) -> str:
    """Convergence of the reference, with a warning if the sample is too small for errors at 99.9 %."""
    off = size_of(comparison.uncertainty, comparison.kind)
    where = "ranges at 99.9 %" if comparison.kind == "scanner" else "colours (rms)"
    text = (
        f"Reference: {comparison.reference} change {where} by {off}: errors below that cannot be told from"
        " the reference's own."
    )
    if comparison.kind == "scanner" and comparison.samples < _ENOUGH:
        text += (
            f" {comparison.samples:,} pulses are few for errors at 99.9 %, whose intervals are too narrow:"
            f" compare {_ENOUGH:,} (`pulses`)."
        )
    return text
