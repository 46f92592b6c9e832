"""Recommendations in words, and figures as people read them."""

from __future__ import annotations

from lidar.tradeoff.engine import Comparison, Row

TARGETS = (0.001, 0.01, 0.1)
"""Metres at 99.9 % for which a setting is recommended."""


def metres(value: float) -> str:
    """A length with a unit that fits it."""
    for unit, size in (("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("µm", 1e-6)):
        if abs(value) >= size:
            return f"{value / size:.3g} {unit}"
    return "0" if value == 0 else f"{value * 1e9:.2g} nm"


def share(value: float) -> str:
    """A share in percent."""
    return "0" if value == 0 else f"{100 * value:.2g} %"


def size(value: float) -> str:
    """Bytes in decimal units."""
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(value) >= one:
            return f"{value / one:.3g} {unit}"
    return f"{value:.0f} B"


def candidates(comparison: Comparison) -> list[Row]:
    """Rows that are choices for a drive in this world: not those of another model, scene or traffic."""
    return [
        row
        for row in comparison.rows
        if not row.label.startswith(("scene=", "traffic=")) and not row.note.startswith("changes")
    ]


def pareto(comparison: Comparison) -> list[Row]:
    """Choices of which no other is both cheaper and at least as exact, the cheapest first."""
    best: list[Row] = []
    for row in sorted(candidates(comparison), key=lambda r: (r.cost["cpu_s"].value, _worst(r))):
        if not best or _worst(row) < _worst(best[-1]):
            best.append(row)
    return best


def recommendation(comparison: Comparison, target: float) -> str:
    """The cheapest setting that reaches a range error in metres at 99.9 %, or that none does."""
    rows = pareto(comparison)
    wanted = f"For {metres(target)} at 99.9 %"
    fit = [row for row in rows if row.error["range_99.9_m"].value <= target]
    if fit:
        row = fit[0]
        cost, error = row.cost["cpu_s"], row.error["range_99.9_m"]
        what = f"the one {row.label}" if row.label.startswith("as asked") else row.label
        text = (
            f"{wanted} the cheapest setting is {what}; it costs {cost.value:.3g} CPU s per simulated second"
            f" ({cost.low:.3g} to {cost.high:.3g}) and errs by {metres(error.value)}"
            f" ({metres(error.low)} to {metres(error.high)})."
        )
        if comparison.uncertainty > target:
            text += f" The reference is certain to {metres(comparison.uncertainty)} only."
        return text
    nearest = min(rows, key=_worst)
    return (
        f"{wanted} no setting that was compared is enough; {nearest.label} comes nearest with"
        f" {metres(_worst(nearest))}, at {nearest.cost['cpu_s'].value:.3g} CPU s per simulated second."
    )


def recommendations(comparison: Comparison) -> list[str]:
    """A sentence for each of `TARGETS`."""
    return [recommendation(comparison, target) for target in TARGETS]


def residual_text(comparison: Comparison) -> str:
    """How far the reference has converged."""
    gap = comparison.residual
    return (
        f"Reference: {comparison.reference}; half as many rays more change ranges by"
        f" {metres(gap['range_rms_m'].value)} rms and {metres(comparison.uncertainty)} at 99.9 %: errors"
        " below that cannot be told from the reference's own."
    )


def _worst(row: Row) -> float:
    return row.error["range_99.9_m"].value
