"""The report of a comparison of settings: terminal tables, plots, HTML page and JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geoscene.drawing.charts import Axes, ChartPoint, scatter
from geoscene.drawing.figures import metres, share, size
from geoscene.drawing.report import Column, Page, ReportTable, table_of
from geoscene.support.files import write_atomically, write_json
from lidar.tools.tradeoff.compare import DriveTradeoff
from lidar.tools.tradeoff.comparison import (
    Kind,
    SensorComparison,
    VariantRow,
    pareto,
    ranked_error,
    recommendations,
    reference_text,
    size_of,
)
from lidar.tools.tradeoff.errors import ErrorEstimate

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


def columns_of(comparison: SensorComparison) -> list[Column[VariantRow]]:
    """Columns of the table of a sensor."""
    kind, tail = comparison.kind, comparison.tail

    def alone(row: VariantRow) -> str:
        return size_of(row.alone[tail].value, kind) if row.alone else ""

    return [
        Column("setting", lambda row: row.label),
        *(
            _error_column(head, name, text=text, interval=name == tail)
            for head, (name, text) in (_SCANNER_ERRORS if kind == "scanner" else _CAMERA_ERRORS).items()
        ),
        Column("alone 99.9 %" if kind == "scanner" else "alone RGB rms", alone),
        Column("CPU s/s", lambda row: _with_interval(row.cost["cpu_s"], text=lambda v: f"{v:.3g}")),
        Column("memory", lambda row: size(row.cost["memory_bytes"].value)),
        Column("bytes/s", lambda row: size(row.cost["bytes"].value)),
        Column("note", lambda row: row.note),
    ]


def _error_column(
    head: str, name: str, *, text: Callable[[float], str], interval: bool
) -> Column[VariantRow]:
    """The column of a figure of combined errors, with its interval where settings are ranked by it."""
    if interval:
        return Column(head, lambda row: _with_interval(row.error[name], text=text))
    return Column(head, lambda row: text(row.error[name].value))


def _with_interval(figure: ErrorEstimate, *, text: Callable[[float], str]) -> str:
    return f"{text(figure.value)} ({text(figure.low)} to {text(figure.high)})"


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

    Settings that miss or add too many returns are not drawn, see `comparison.ranked_error`.
    """
    kind, best = comparison.kind, pareto(comparison)
    choices = [row for row in comparison.rows if row.choice]
    drawn = [row for row in choices if math.isfinite(ranked_error(comparison, row))]
    points = []
    for row in drawn:
        cost, error = row.cost["cpu_s"], row.error[comparison.tail]
        name = row.label.partition(" (")[0]
        cpu, interval = (cost.low, cost.high), (error.low, error.high)
        points.append(ChartPoint(name, cost.value, error.value, row in best, cpu, interval))
    hidden = len(choices) - len(drawn)
    left_out = f"; {hidden} settings that miss or add returns are not drawn" if hidden else ""
    axes = Axes(
        headline(comparison) + left_out,
        "CPU s per simulated second",
        _RANKED[kind],
        lambda value: size_of(value, kind),
    )
    return scatter(points, axes)
