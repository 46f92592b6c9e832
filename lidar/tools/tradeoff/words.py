"""Recommendations in words."""

from __future__ import annotations

from math import inf

from geoscene.drawing.figures import metres, share
from lidar.tools.tradeoff.comparison import Kind, SensorComparison, VariantRow

TARGETS: dict[Kind, tuple[float, ...]] = {"scanner": (0.001, 0.01, 0.1), "camera": (1.0, 3.0, 10.0)}
"""Errors for which a setting is recommended: metres at 99.9 %, and levels of 255 rms."""

LOST = 0.001
"""Share of missed and extra returns beyond which a setting does not keep any error at 99.9 %."""


_ENOUGH = 10_000
"""Pulses from which an error at 99.9 % is that of ten or more."""


def levels(value: float) -> str:
    """A difference of colours, of 255."""
    text = f"{value:.3g}"
    return f"{text} level{'' if text == '1' else 's'}"


def size_of(error: float, kind: Kind) -> str:
    """An error by which settings are ranked."""
    return metres(error) if kind == "scanner" else levels(error)


def candidates(comparison: SensorComparison) -> list[VariantRow]:
    """Rows that are choices for a drive in this world: not those of another model, scene or traffic."""
    return [row for row in comparison.rows if row.choice]


def pareto(comparison: SensorComparison) -> list[VariantRow]:
    """Choices of which no other is both cheaper and at least as exact (see `reached`), the cheapest first.

    Settings that miss or add more than `LOST` of the returns are left out.
    """
    best: list[VariantRow] = []
    ranked = [(row.cost["cpu_s"].value, reached(comparison, row), row) for row in candidates(comparison)]
    for _, error, row in sorted(ranked, key=lambda r: r[:2]):
        if error < (reached(comparison, best[-1]) if best else inf):
            best.append(row)
    return best


def reached(comparison: SensorComparison, row: VariantRow) -> float:
    """The error by which a row is ranked: the upper end of its interval.

    inf if more than `LOST` of the returns are missed or extra.
    """
    if "missed" in row.error and row.error["missed"].value + row.error["extra"].value > LOST:
        return inf
    return row.error[comparison.tail].high


def recommendation(comparison: SensorComparison, target: float) -> str:
    """The cheapest setting that is sure to reach an error (see `TARGETS`), or that none is."""
    kind, rows = comparison.kind, pareto(comparison)
    wanted = f"For {size_of(target, kind)} {'at 99.9 %' if kind == 'scanner' else 'rms'}"
    fit = [row for row in rows if reached(comparison, row) <= target]
    if fit:
        row = fit[0]
        cost, error = row.cost["cpu_s"], row.error[comparison.tail]
        what = f"the one {row.label}" if row.label.startswith("as asked") else row.label
        text = (
            f"{wanted} the cheapest setting is {what}; it costs {cost.value:.3g} CPU s per simulated second"
            f" ({cost.low:.3g} to {cost.high:.3g}) and errs by {size_of(error.value, kind)}, by"
            f" {size_of(error.high, kind)} at the upper end of the 95 % interval."
        )
        if comparison.uncertainty > target:
            text += f" The reference is certain to {size_of(comparison.uncertainty, kind)} only."
        return text
    text = f"{wanted} no setting that was compared is sure to be enough"
    if not rows:
        return f"{text}: all miss or add more than {share(LOST)} of the returns."
    nearest = rows[-1]
    error = nearest.error[comparison.tail]
    return (
        f"{text}; {nearest.label} comes nearest with {size_of(error.value, kind)},"
        f" {size_of(error.high, kind)} at the upper end of the 95 % interval, at"
        f" {nearest.cost['cpu_s'].value:.3g} CPU s per simulated second."
    )


def recommendations(comparison: SensorComparison) -> list[str]:
    """A sentence for each of `TARGETS`."""
    return [recommendation(comparison, target) for target in TARGETS[comparison.kind]]


def tail_text(comparison: SensorComparison) -> str:
    """That the errors at 99.9 % are those of a few pulses; empty for enough of them."""
    if comparison.kind != "scanner" or comparison.samples >= _ENOUGH:
        return ""
    largest = -(-comparison.samples // 1000)
    which = "the largest error" if largest == 1 else f"the {largest} largest errors"
    return (
        f"Of {comparison.samples:,} pulses, 99.9 % tells no more than {which}, and its interval is too"
        f" narrow: compare {_ENOUGH:,} (`pulses`)."
    )


def residual_text(comparison: SensorComparison) -> str:
    """How far the reference has converged."""
    gap = comparison.residual
    if comparison.kind == "scanner":
        change = (
            f"ranges by {metres(gap['range_rms_m'].value)} rms and {metres(comparison.uncertainty)} at 99.9 %"
        )
    else:
        change = f"colours by {levels(comparison.uncertainty)} rms"
    return (
        f"Reference: {comparison.reference} change {change}: errors below that cannot be told from the"
        " reference's own."
    )
