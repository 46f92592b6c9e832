"""The report of a comparison: terminal table, Pareto plot, HTML page and JSON."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table

from geoscene.files import write_atomically, write_json
from lidar.tradeoff.comparison import Comparison, Kind, Listing, Row
from lidar.tradeoff.engine import Tradeoff
from lidar.tradeoff.errors import Estimate
from lidar.tradeoff.words import (
    candidates,
    metres,
    pareto,
    reached,
    recommendations,
    residual_text,
    share,
    size,
    size_of,
)

_INK, _GREY, _CHOICE, _OTHER = (30, 32, 38), (205, 208, 214), (200, 60, 40), (60, 110, 180)

_RANKED: dict[Kind, str] = {
    "scanner": "range error at 99.9 %",
    "camera": "rms difference of colours, levels of 255",
}

NOISE = (
    "Random effects and the sensor's own imperfections are off in both: the error of a setting is not noise."
    " 'alone' is the exact end with only this setting changed."
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


def cells(row: Row, comparison: Comparison) -> list[str]:
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


def _with_interval(cost: Estimate) -> str:
    return f"{cost.value:.3g} ({cost.low:.3g} to {cost.high:.3g})"


def headline(comparison: Comparison) -> str:
    """What was compared."""
    what = "pulses" if comparison.kind == "scanner" else "pixels"
    return f"{comparison.sensor}: {comparison.samples:,} {what} of {comparison.frames} frames"


def georeferencing_text(found: Tradeoff) -> str:
    """Error of the affine map of georeferencing; empty if it was not compared."""
    if not found.georeferencing:
        return ""
    worst = found.georeferencing["max_m"]
    if worst == 0:
        return "Georeferencing: the affine map has no effect here; `exact` gives the same coordinates."
    return f"Georeferencing: the affine map is within {metres(worst)} of the full projection (`exact`)."


def print_tables(found: Tradeoff) -> None:
    """Print the tables and recommendations."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=240)
    for comparison in found.comparisons:
        table = Table(*heads(comparison.kind), title=headline(comparison))
        for row in comparison.rows:
            table.add_row(*cells(row, comparison))
        console.print(table)
        for text in (residual_text(comparison), *recommendations(comparison)):
            console.print(text, highlight=False)
    for listing in found.listings:
        heading, rows = table_of(listing)
        table = Table(*heading, title=listing.title)
        for cells_of_row in rows:
            table.add_row(*cells_of_row)
        console.print(table)
        console.print(listing.note, highlight=False)
    for text in filter(None, (georeferencing_text(found), NOISE)):
        console.print(text, highlight=False)


def document(found: Tradeoff) -> dict[str, Any]:
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


def _sensor_json(comparison: Comparison) -> dict[str, Any]:
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


def _json_of(figures: dict[str, Estimate]) -> dict[str, Any]:
    return {name: figure.to_json() for name, figure in figures.items()}


def write_report(found: Tradeoff, out: Path) -> None:
    """Write ``tradeoff.json``, ``tradeoff.html`` and a plot for each sensor into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    plots = []
    for comparison in found.comparisons:
        plots.append(_png(pareto_plot(comparison)))
        write_atomically(out / f"pareto_{comparison.sensor.split()[0]}.png", plots[-1])
    write_atomically(out / "tradeoff.html", _page(found, plots).encode())
    write_json(out / "tradeoff.json", document(found))


def _png(pixels: NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


def pareto_plot(comparison: Comparison, *, width: int = 1100, height: int = 700) -> NDArray[np.uint8]:
    """A picture (height, width, 3): error against CPU time, both logarithmic.

    Settings that miss or add too many returns are not drawn, see `words.reached`.
    """
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=15)
    best = pareto(comparison)
    rows = [row for row in candidates(comparison) if math.isfinite(reached(comparison, row))]
    x = [row.cost["cpu_s"] for row in rows]
    y = [row.error[comparison.tail] for row in rows]
    left, right, top, bottom = 90, width - 150, 70, height - 70
    across, up = _scale(x, ends=(left, right)), _scale(y, ends=(bottom, top))
    said: dict[str, Any] = {"fill": _INK, "font": font}
    pen.text((left, 16), headline(comparison), **said)
    pen.text(((left + right) / 2, height - 16), "CPU s per simulated second", **said, anchor="ms")
    pen.text((12, top - 10), _RANKED[comparison.kind], **said, anchor="ls")
    for value in _decades(x):
        pen.line((across(value), top, across(value), bottom), fill=_GREY)
        pen.text((across(value), bottom + 8), f"{value:g}", **said, anchor="mt")
    for value in _decades(y):
        pen.line((left, up(value), right, up(value)), fill=_GREY)
        pen.text((left - 8, up(value)), size_of(value, comparison.kind), **said, anchor="rm")
    places = [(across(row.cost["cpu_s"].value), up(row.error[comparison.tail].value)) for row in best]
    if len(places) > 1:
        pen.line(places, fill=_CHOICE, width=2)
    named: list[tuple[float, float, float, float]] = []
    for row in (*best, *(row for row in rows if row not in best)):
        cost, error = row.cost["cpu_s"], row.error[comparison.tail]
        u, v = across(cost.value), up(error.value)
        color = _CHOICE if row in best else _OTHER
        pen.line((across(cost.low), v, across(cost.high), v), fill=color)
        pen.line((u, up(error.low), u, up(error.high)), fill=color)
        pen.ellipse((u - 4, v - 4, u + 4, v + 4), fill=color)
        name = row.label.partition(" (")[0]
        for x_text, y_text, anchor in ((u + 8, v - 4, "ls"), (u + 8, v + 4, "lt"), (u - 8, v + 4, "rt")):
            box = pen.textbbox((x_text, y_text), name, font=font, anchor=anchor)
            if box[0] < 0 or box[2] > width or any(_overlap(box, other) for other in named):
                continue  # at worst without a name: the table has it
            pen.text((x_text, y_text), name, **said, anchor=anchor)
            named.append(box)
            break
    return np.asarray(picture).copy()


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    """Whether two boxes (left, top, right, bottom) overlap."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _ends(figures: list[Estimate]) -> tuple[float, float]:
    values = [v for f in figures for v in (f.low, f.value, f.high) if v > 0] or [1.0]
    return 10 ** math.floor(math.log10(min(values))), 10 ** math.ceil(math.log10(max(values)) + 1e-9)


def _scale(figures: list[Estimate], *, ends: tuple[float, float]) -> Any:
    """A function from a figure to pixels between two ends; 0 is drawn at the first."""
    start, end = ends
    low, high = (math.log10(v) for v in _ends(figures))
    return lambda v: start + (end - start) * (math.log10(max(v, 10**low)) - low) / max(high - low, 1e-9)


def _decades(figures: list[Estimate]) -> list[float]:
    low, high = _ends(figures)
    return [10.0**k for k in range(round(math.log10(low)), round(math.log10(high)) + 1)]


_STYLE = (
    "body{font:15px system-ui,sans-serif;margin:2em;color:#1e2026}"
    "table{border-collapse:collapse;margin:1em 0}"
    "td,th{border-bottom:1px solid #cdd0d6;padding:.3em .6em;text-align:right;white-space:nowrap}"
    "td:first-child,th:first-child,td:last-child{text-align:left}img{max-width:100%}"
)


def _html_table(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{html.escape(text)}</th>" for text in heading)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def _page(found: Tradeoff, plots: list[bytes]) -> str:
    """A self-contained HTML page."""
    parts = []
    for comparison, plot in zip(found.comparisons, plots, strict=True):
        said = "".join(f"<li>{html.escape(text)}</li>" for text in recommendations(comparison))
        rows = [cells(row, comparison) for row in comparison.rows]
        parts.append(
            f"<h2>{html.escape(headline(comparison))}</h2><p>{html.escape(residual_text(comparison))}</p>"
            f"<ul>{said}</ul>{_html_table(heads(comparison.kind), rows)}"
            f'<img alt="error against cost" src="data:image/png;base64,{base64.b64encode(plot).decode()}">'
        )
    for listing in found.listings:
        title, note = html.escape(listing.title), html.escape(listing.note)
        parts.append(f"<h2>{title}</h2><p>{note}</p>{_html_table(*table_of(listing))}")
    notes = "".join(f"<p>{html.escape(text)}</p>" for text in (georeferencing_text(found), NOISE))
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Speed against accuracy</title>'
        f"<style>{_STYLE}</style><h1>Speed against accuracy: {html.escape(str(found.plan.scene.path))}</h1>"
        f"{''.join(parts)}{notes}</html>\n"
    )
