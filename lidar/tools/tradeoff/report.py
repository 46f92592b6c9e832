"""The report of a comparison of settings: recommendations, terminal tables, plots, HTML page and JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import Any

from geoscene.drawing.charts import Axes, ChartPoint, scatter
from geoscene.drawing.report import Column, Page, ReportTable, levels, metres, share, size, table_of
from geoscene.support.files import write_atomically, write_json
from lidar.tools.tradeoff.compare import DriveTradeoff
from lidar.tools.tradeoff.errors import LOST, ErrorEstimate, Kind, SensorComparison, VariantRow

TARGETS: dict[Kind, tuple[float, ...]] = {"scanner": (0.001, 0.01, 0.1), "camera": (1.0, 3.0, 10.0)}
"""Errors for which a setting is recommended: metres at 99.9 %, and levels of 255 rms."""

_ENOUGH = 10_000
"""Pulses from which an error at 99.9 % is that of ten or more."""

_RANKED: dict[Kind, str] = {
    "scanner": "range error at 99.9 %",
    "camera": "rms difference of colours, levels of 255",
}

NOISE = (
    "Random effects and the sensor's own imperfections are off in both: the error of a setting is not noise."
    " Alone: only this setting differs from the reference. Combined, the other errors: only this setting"
    " differs from what you asked for."
)

_SCANNER_ERRORS: dict[str, tuple[str, Callable[[float], str]]] = {
    "range rms": ("range_rms_m", metres),
    "99 %": ("range_99_m", metres),
    "99.9 % (95 % interval)": ("range_99.9_m", metres),
    "max": ("range_max_m", metres),
    "missed": ("missed", share),
    "extra": ("extra", share),
    "class": ("class_changes", share),
    "Chamfer": ("chamfer_m", metres),
    "Hausdorff 99.9 %": ("hausdorff_99.9_m", metres),
}

_CAMERA_ERRORS: dict[str, tuple[str, Callable[[float], str]]] = {
    "RGB rms (95 % interval)": ("rgb_rms", lambda value: size_of(value, "camera")),
    "99.9 %": ("rgb_99.9", lambda value: f"{value:.0f}"),
    "max": ("rgb_max", lambda value: f"{value:.0f}"),
    "depth rms": ("depth_rms_m", metres),
    "depth 99.9 %": ("depth_99.9_m", metres),
    "depth max": ("depth_max_m", metres),
    "with/without": ("depth_missing", share),
    "class": ("class_changes", share),
}


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
    return _front(comparison, lambda row: ranked_error(comparison, row))


def _front(comparison: SensorComparison, error_of: Callable[[VariantRow], float]) -> list[VariantRow]:
    """Choices with finite errors of which no other is both cheaper and errs as little, the cheapest first."""
    best: list[VariantRow] = []
    ranked = [(row.cost["cpu_s"].value, error_of(row), row) for row in comparison.rows if row.choice]
    for _, error, row in sorted(ranked, key=lambda r: r[:2]):
        if error < (error_of(best[-1]) if best else inf):
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


def columns_of(comparison: SensorComparison) -> list[Column[VariantRow]]:
    """Columns of the table of a sensor."""
    kind, tail = comparison.kind, comparison.tail

    def error(row: VariantRow, *, name: str, text: Callable[[float], str]) -> str:
        return row.error[name].to_text(text) if name == tail else text(row.error[name].value)

    def alone(row: VariantRow) -> str:
        return size_of(row.alone[tail].value, kind) if row.alone else ""

    return [
        Column("setting", lambda row: row.label),
        *(
            Column(head, partial(error, name=name, text=text))
            for head, (name, text) in (_SCANNER_ERRORS if kind == "scanner" else _CAMERA_ERRORS).items()
        ),
        Column("alone 99.9 %" if kind == "scanner" else "alone RGB rms", alone),
        Column("CPU s/s", lambda row: row.cost["cpu_s"].to_text(lambda v: f"{v:.3g}")),
        Column("memory", lambda row: size(row.cost["memory_bytes"].value)),
        Column("bytes/s", lambda row: size(row.cost["bytes"].value)),
        Column("note", lambda row: row.note),
    ]


def headline(comparison: SensorComparison) -> str:
    """The sensor and the size of the sample."""
    samples = "pulses" if comparison.kind == "scanner" else "pixels"
    return f"{comparison.sensor}: {comparison.samples:,} {samples} of {comparison.frames} frames"


def sensor_table(comparison: SensorComparison) -> ReportTable:
    """The table of a sensor."""
    return table_of(columns_of(comparison), comparison.rows, title=headline(comparison))


def georeferencing_text(found: DriveTradeoff) -> str:
    """Error of the affine map of georeferencing; empty if it was not compared."""
    if not found.georeferencing:
        return ""
    worst = found.georeferencing["max_m"]
    if worst == 0:
        return "Georeferencing: the affine map has no effect here; `exact` gives the same coordinates."
    return f"Georeferencing: the affine map is within {metres(worst)} of the full projection (`exact`)."


def to_text(found: DriveTradeoff) -> str:
    """Tables and recommendations."""
    parts = []
    for comparison in found.comparisons:
        parts.append(sensor_table(comparison).to_text())
        parts.append("\n".join([reference_text(comparison), *recommendations(comparison)]))
    return "\n\n".join(filter(None, [*parts, georeferencing_text(found), NOISE]))


def document(found: DriveTradeoff) -> dict[str, Any]:
    """The contents of ``tradeoff.json``."""
    plan = found.plan
    return {
        "schema": 1,
        "scene": {"path": str(plan.scene.path), "fingerprint": plan.scene.manifest.get("fingerprint", "")},
        "rig": plan.rig.name,
        "seed": plan.options.seed,
        "fidelity": plan.options.fidelity,
        "settings": [list(pair) for pair in plan.options.settings],
        "duration_s": plan.trajectory.duration_ns / 1e9,
        "sensors": [_sensor_json(c) for c in found.comparisons],
        "georeferencing": found.georeferencing,
        "note": NOISE,
    }


def _sensor_json(comparison: SensorComparison) -> dict[str, Any]:
    return {
        "sensor": comparison.sensor,
        "kind": comparison.kind,
        "samples": comparison.samples,
        "frames": comparison.frames,
        "reference": comparison.reference,
        "reference_residual": _json_of(comparison.residual),
        "rows": [
            {
                "setting": row.label,
                "error": _json_of(row.error),
                "alone": _json_of(row.alone),
                "cost": _json_of(row.cost),
                "note": row.note,
            }
            for row in comparison.rows
        ],
        "pareto": [row.label for row in pareto(comparison)],
        "recommendations": recommendations(comparison),
    }


def _json_of(figures: Mapping[str, ErrorEstimate]) -> dict[str, Any]:
    return {name: figure.to_json() for name, figure in figures.items()}


def write_report(found: DriveTradeoff, out: Path) -> None:
    """Write ``tradeoff.json``, ``tradeoff.html`` and a plot for each sensor into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    scene = found.plan.scene
    page = Page(f"Speed against accuracy: {scene.manifest['name'] or scene.location}")
    for comparison in found.comparisons:
        picture = pareto_plot(comparison)
        page.paragraph(reference_text(comparison))
        page.points(recommendations(comparison))
        page.table(sensor_table(comparison))
        page.picture(picture, alt="error against cost")
        write_atomically(out / f"pareto_{comparison.sensor.split()[0]}.png", picture)
    page.paragraph(georeferencing_text(found))
    page.paragraph(NOISE)
    write_atomically(out / "tradeoff.html", page.encoded())
    write_json(out / "tradeoff.json", document(found))


def pareto_plot(comparison: SensorComparison) -> bytes:
    """A PNG: error against CPU time.

    Settings that miss or add too many returns are not drawn, see `ranked_error`. The line joins the best by
    the estimates that are drawn.
    """

    def drawn_error(row: VariantRow) -> float:
        kept = isfinite(ranked_error(comparison, row))
        return row.error[comparison.tail].value if kept else inf

    kind, best = comparison.kind, _front(comparison, drawn_error)
    choices = [row for row in comparison.rows if row.choice]
    drawn = [row for row in choices if isfinite(drawn_error(row))]
    points = []
    for row in drawn:
        cost, error = row.cost["cpu_s"], row.error[comparison.tail]
        name = row.label.partition(" (")[0]
        cpu, interval = (cost.low, cost.high), (error.low, error.high)
        points.append(ChartPoint(name, cost.value, error.value, row in best, cpu, interval))
    hidden = len(choices) - len(drawn)
    left_out = f"; not drawn, as they miss or add returns: {hidden}" if hidden else ""
    axes = Axes(
        headline(comparison) + left_out,
        "CPU s per simulated second",
        _RANKED[kind],
        lambda value: size_of(value, kind),
    )
    return scatter(points, axes)
