"""The report of a comparison: terminal table, Pareto plot, HTML page and JSON."""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from geoscene.drawing.charts import (
    Axes,
    ChartPoint,
    html_page,
    html_picture,
    html_table,
    print_lines,
    print_table,
    scatter,
)
from geoscene.drawing.figures import metres, share, size
from geoscene.support.files import write_atomically, write_json
from lidar.tools.tradeoff.comparison import Kind, Listing, SensorComparison, VariantRow
from lidar.tools.tradeoff.engine import DriveTradeoff
from lidar.tools.tradeoff.errors import ErrorEstimate
from lidar.tools.tradeoff.words import (
    candidates,
    pareto,
    reached,
    recommendations,
    residual_text,
    size_of,
    tail_text,
)

_RANKED: dict[Kind, str] = {
    "scanner": "range error at 99.9 %",
    "camera": "rms difference of colours, levels of 255",
}

NOISE = (
    "Random effects and the sensor's own imperfections are off in both: the error of a setting is not noise."
    " 'alone' is the reference with only this setting changed."
)


def heads(kind: Kind) -> tuple[str, ...]:
    """Headings of the table of a kind of sensor."""
    errors = {
        "scanner": (
            *("range rms", "99 %", "99.9 % (95 % interval)", "max", "missed", "extra", "class"),
            *("Chamfer", "Hausdorff 99.9 %"),
        ),
        "camera": (
            *("RGB rms (95 % interval)", "99.9 %", "max", "depth rms", "99.9 %", "max", "with/without"),
            "class",
        ),
    }
    alone = {"scanner": "alone 99.9 %", "camera": "alone RGB rms"}
    return ("setting", *errors[kind], alone[kind], "CPU s/s", "memory", "bytes/s", "note")


def cells(row: VariantRow, comparison: SensorComparison) -> list[str]:
    """Texts of a row of the table."""
    e, c, kind = row.error, row.cost, comparison.kind
    tail = e[comparison.tail]
    interval = f"{size_of(tail.value, kind)} ({size_of(tail.low, kind)} to {size_of(tail.high, kind)})"
    errors = {
        "scanner": lambda: [
            *(metres(e[name].value) for name in ("range_rms_m", "range_99_m")),
            interval,
            metres(e["range_max_m"].value),
            *(share(e[name].value) for name in ("missed", "extra", "class_changes")),
            *(metres(e[name].value) for name in ("chamfer_m", "hausdorff_99.9_m")),
        ],
        "camera": lambda: [
            interval,
            *(f"{e[name].value:.0f}" for name in ("rgb_99.9", "rgb_max")),
            *(metres(e[name].value) for name in ("depth_rms_m", "depth_99.9_m", "depth_max_m")),
            *(share(e[name].value) for name in ("depth_missing", "class_changes")),
        ],
    }
    return [
        row.label,
        *errors[kind](),
        size_of(row.alone[comparison.tail].value, kind) if row.alone else "",
        _with_interval(c["cpu_s"]),
        size(c["memory_bytes"].value),
        size(c["bytes"].value),
        row.note,
    ]


HEADINGS = {
    "rms_m": "rms",
    "99.9_m": "99.9 %",
    "max_m": "max",
    "back_max_m": "back, max",
    "bound_m": "bound",
    "height_max_m": "height, max",
    "scale_ppm": "scale",
    "per_point_bytes": "bytes/point",
    "share": "points",
    "bytes": "size",
    "write_s": "write",
    "read_s": "read",
    "thin_s": "thin",
}
"""Headings of figures of listings, by name."""


def figure(name: str, value: float) -> str:
    """A figure of a listing in the unit that its name ends in."""
    unit = name.rpartition("_")[2]
    texts: dict[str, Callable[[float], str]] = {
        "m": metres,
        "ppm": lambda v: f"{v:+.3g} ppm",
        "bytes": lambda v: size(v) if v >= 1000 else f"{v:.3g} B",
        "share": share,
        "s": lambda v: f"{v:.2g} s",
    }
    return texts[unit](value)


def table_of(listing: Listing) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of a listing; figures that a row lacks are empty."""
    names = [name for name in HEADINGS if any(name in r.figures for r in listing.records)]
    rows = [
        [r.label, *(figure(n, r.figures[n]) if n in r.figures else "" for n in names), r.note]
        for r in listing.records
    ]
    return [listing.name, *(HEADINGS[n] for n in names), "note"], rows


def _with_interval(cost: ErrorEstimate) -> str:
    return f"{cost.value:.3g} ({cost.low:.3g} to {cost.high:.3g})"


def headline(comparison: SensorComparison) -> str:
    """What was compared."""
    what = "pulses" if comparison.kind == "scanner" else "pixels"
    return f"{comparison.sensor}: {comparison.samples:,} {what} of {comparison.frames} frames"


def georeferencing_text(found: DriveTradeoff) -> str:
    """Error of the affine map of georeferencing; empty if it was not compared."""
    if not found.georeferencing:
        return ""
    worst = found.georeferencing["max_m"]
    if worst == 0:
        return "Georeferencing: the affine map has no effect here; `exact` gives the same coordinates."
    return f"Georeferencing: the affine map is within {metres(worst)} of the full projection (`exact`)."


def print_tables(found: DriveTradeoff) -> None:
    """Print the tables and recommendations."""
    for comparison in found.comparisons:
        rows = [cells(row, comparison) for row in comparison.rows]
        print_table(heads(comparison.kind), rows, title=headline(comparison))
        print_lines([residual_text(comparison), tail_text(comparison), *recommendations(comparison)])
    for listing in found.listings:
        print_table(*table_of(listing), title=listing.title)
        print_lines([listing.note])
    print_lines([georeferencing_text(found), NOISE])


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
        "tables": [
            {
                "name": listing.name,
                "title": listing.title,
                "note": listing.note,
                "rows": [{"row": r.label, **r.figures, "note": r.note} for r in listing.records],
            }
            for listing in found.listings
        ],
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


def _json_of(figures: dict[str, ErrorEstimate]) -> dict[str, Any]:
    return {name: figure.to_json() for name, figure in figures.items()}


def write_report(found: DriveTradeoff, out: Path) -> None:
    """Write ``tradeoff.json``, ``tradeoff.html`` and a plot for each sensor into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    plots = []
    for comparison in found.comparisons:
        plots.append(pareto_plot(comparison))
        write_atomically(out / f"pareto_{comparison.sensor.split()[0]}.png", plots[-1])
    write_atomically(out / "tradeoff.html", _page(found, plots))
    write_json(out / "tradeoff.json", document(found))


def pareto_plot(comparison: SensorComparison) -> bytes:
    """A PNG: error against CPU time.

    Settings that miss or add too many returns are not drawn, see `words.reached`.
    """
    kind, best = comparison.kind, pareto(comparison)
    points, hidden = [], 0
    for row in candidates(comparison):
        hidden += not math.isfinite(reached(comparison, row))
        cost, error = row.cost["cpu_s"], row.error[comparison.tail]
        if math.isfinite(reached(comparison, row)):
            name = row.label.partition(" (")[0]
            cpu, away = (cost.low, cost.high), (error.low, error.high)
            points.append(ChartPoint(name, cost.value, error.value, row in best, cpu, away))
    left_out = f"; {hidden} settings that miss or add returns are not drawn" if hidden else ""
    axes = Axes(
        headline(comparison) + left_out,
        "CPU s per simulated second",
        _RANKED[kind],
        lambda value: size_of(value, kind),
    )
    return scatter(points, axes)


def _page(found: DriveTradeoff, plots: Sequence[bytes]) -> bytes:
    """A self-contained HTML page."""
    parts = []
    for comparison, plot in zip(found.comparisons, plots, strict=True):
        said = "".join(f"<li>{html.escape(text)}</li>" for text in recommendations(comparison))
        rows = [cells(row, comparison) for row in comparison.rows]
        parts.append(
            f"<h2>{html.escape(headline(comparison))}</h2><p>{html.escape(residual_text(comparison))}"
            f" {html.escape(tail_text(comparison))}</p>"
            f"<ul>{said}</ul>{html_table(heads(comparison.kind), rows)}"
            f"{html_picture(plot, alt='error against cost')}"
        )
    for listing in found.listings:
        title, note = html.escape(listing.title), html.escape(listing.note)
        parts.append(f"<h2>{title}</h2><p>{note}</p>{html_table(*table_of(listing))}")
    parts += [f"<p>{html.escape(text)}</p>" for text in (georeferencing_text(found), NOISE)]
    scene = found.plan.scene
    return html_page(f"Speed against accuracy: {scene.manifest['name'] or scene.location}", "".join(parts))
