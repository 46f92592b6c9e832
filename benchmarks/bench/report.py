"""The report of a run: tables in the terminal and as Markdown, an HTML page with plots, and JSON."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table as Grid

from bench.growth import Curve
from bench.measure import Result, Summary
from geoscene.support.files import write_atomically, write_json

_INK, _GREY, _LINE, _DOT = (30, 32, 38), (205, 208, 214), (200, 60, 40), (60, 110, 180)

READING = (
    "Figures are medians of repetitions by turns, with the smallest and greatest in brackets; rates are per"
    " second of CPU time of all threads, or of wall time to compare workers and programs. A ratio is the"
    " rate of the first side over that of another, both measured in this run, repetition by repetition."
)


@dataclass
class Run:
    """What a run measured, and on which machine.

    machine  : see `bench.machine.described`
    options  : of the command
    notes    : what was left out, and warnings
    seconds  : that each subject took
    """

    machine: dict[str, Any]
    options: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def took(self) -> str:
        """The time of the run in words."""
        parts = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in self.seconds.items())
        return f"{sum(self.seconds.values()) / 60:.1f} minutes: {parts}"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the report: title, sentence, column heads and rows of texts."""

    title: str
    text: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(run: Run) -> list[Table]:
    """All tables: one per subject, and the growth curves."""
    found = []
    for subject in dict.fromkeys(result.case.subject for result in run.results):
        chosen = [result for result in run.results if result.case.subject == subject]
        notes = dict.fromkeys(result.case.note for result in chosen if result.case.note)
        rows = [row for result in chosen for row in _rows(result)]
        text = "; ".join(notes) + "."
        keep = len(_HEADS) if any(row[-1] for row in rows) else -1  # without memory: no empty column
        found.append(Table(subject.capitalize(), text, _HEADS[:keep], tuple(row[:keep] for row in rows)))
    if run.curves:
        rows = [_curve_row(curve) for curve in run.curves]
        found.append(Table("Growth", _GROWTH, _GROWTH_HEADS, tuple(rows)))
    return found


_HEADS = ("case", "side", "rate", "ratio", "wall s", "CPU s", "peak memory")
_GROWTH_HEADS = ("work", "sizes", "cost", "exponent (95 %)", "last step", "what")
_GROWTH = (
    "Cost grows as size to the power of the exponent: least squares through the logarithms of the sizes'"
    " medians, or of all repetitions where there are two sizes; with its standard error and, in brackets, its"
    " 95 % interval. Sizes too small for a cost are left out. The last step is the exponent between the two"
    " greatest sizes, where fixed costs count least. Memory is the growth of a process of its own, or of"
    " workers the sum of all processes."
)


def _rows(result: Result) -> list[tuple[str, ...]]:
    case, rows = result.case, []
    for k, (side, spent) in enumerate(result.spent.items()):
        rate = f"{_figures(result.rate(side))} {case.unit}/{'CPU ' * (case.clock == 'cpu')}s"
        if case.simulated_s:
            rate += f", {case.simulated_s / Summary.of([s.wall_s for s in spent]).median:.3g} x real time"
        peak = max(s.peak_bytes for s in spent)
        rows.append(
            (
                "" if k else case.name,
                side,
                rate,
                _figures(result.ratio(side)) if k else "",
                _figures(Summary.of([s.wall_s for s in spent])),
                _figures(Summary.of([s.cpu_s for s in spent])),
                f"{peak / 2**20:.0f} MiB" if peak else "",
            )
        )
    return rows


def _figures(summary: Summary) -> str:
    middle, low, high = (f"{value:.3g}" for value in (summary.median, summary.low, summary.high))
    return middle if low == high else f"{middle} ({low} to {high})"


def _curve_row(curve: Curve) -> tuple[str, ...]:
    points = curve.medians()
    (x0, y0), (x1, y1) = points[0], points[-1]
    unit, share = ("MiB", 2.0**20) if curve.cost == "bytes" else (curve.cost, 1.0)
    return (
        curve.name,
        f"{x0:,.0f} to {x1:,.0f} {curve.size}",
        f"{y0 / share:.3g} to {y1 / share:.3g} {unit}",
        exponent_text(curve),
        "" if curve.last_exponent is None else f"{curve.last_exponent:.2f}",
        curve.note,
    )


def exponent_text(curve: Curve) -> str:
    """The exponent of a curve with its standard error and interval."""
    b = curve.exponent
    if b is None:
        return "none: too few sizes with a cost"
    if math.isnan(b.error):
        return f"{b.value:.2f}"
    return f"{b.value:.2f} ± {b.error:.2f} ({b.low:.2f} to {b.high:.2f})"


def machine_text(machine: dict[str, Any]) -> str:
    """The machine in one sentence."""
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    return (
        f"{machine['cpu']}, {machine['cores']} cores ({machine['usable_cores']} usable),"
        f" {machine['memory_bytes'] / 2**30:.0f} GiB, {machine['system']}, Python {machine['python']},"
        f" geoscene {machine['geoscene']}, {libraries}; load average {machine['load']} at the start;"
        f" {machine['time']}; machine {machine['machine']}"
    )


def print_table(table: Table) -> None:
    """Print a table to the terminal."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=200)
    grid = Grid(*table.heads, title=table.title)
    for row in table.rows:
        grid.add_row(*row)
    console.print(grid)


def document(run: Run) -> dict[str, Any]:
    """The contents of ``bench.json``."""
    return {
        "schema": 1,
        "machine": run.machine,
        "options": run.options,
        "notes": run.notes,
        "seconds": run.seconds,
        "cases": [_case_json(result) for result in run.results],
        "curves": [_curve_json(curve) for curve in run.curves],
    }


def _case_json(result: Result) -> dict[str, Any]:
    case = result.case
    names = list(result.spent)
    return {
        "subject": case.subject,
        "name": case.name,
        "amount": case.amount,
        "unit": case.unit,
        "clock": case.clock,
        "simulated_s": case.simulated_s,
        "note": case.note,
        "sides": {
            name: {
                "wall_s": [s.wall_s for s in spent],
                "cpu_s": [s.cpu_s for s in spent],
                "peak_bytes": [s.peak_bytes for s in spent],
                "rate": _json_of(result.rate(name)),
                "ratio": _json_of(result.ratio(name)) if name != names[0] else None,
            }
            for name, spent in result.spent.items()
        },
    }


def _json_of(summary: Summary) -> dict[str, float]:
    return {"median": summary.median, "low": summary.low, "high": summary.high}


_FIT = ("value", "error", "low", "high")


def _curve_json(curve: Curve) -> dict[str, Any]:
    b = curve.exponent
    fit = None if b is None else {name: _number(getattr(b, name)) for name in _FIT}
    return {
        "name": curve.name,
        "size": curve.size,
        "cost": curve.cost,
        "x": list(curve.x),
        "y": list(curve.y),
        "exponent": fit,
        "last_exponent": curve.last_exponent,
        "note": curve.note,
    }


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value


def write_report(run: Run, out: Path) -> None:
    """Write ``bench.json``, ``bench.md`` and ``bench.html`` into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    write_json(out / "bench.json", document(run))
    write_atomically(out / "bench.md", markdown(run).encode())
    write_atomically(out / "bench.html", _page(run).encode())


def markdown(run: Run) -> str:
    """The report as Markdown."""
    lines = ["# Benchmark", "", f"{machine_text(run.machine)}. Took {run.took}.", ""]
    lines += [f"- {note}" for note in run.notes] + [""] * bool(run.notes)
    lines += [READING, ""]
    for table in tables(run):
        lines += [f"## {table.title}", "", table.text, ""]
        lines += [f"| {' | '.join(table.heads)} |", "|" + "---|" * len(table.heads)]
        lines += [f"| {' | '.join(row)} |" for row in table.rows] + [""]
    return "\n".join(lines)


_STYLE = (
    "body{font:15px system-ui,sans-serif;margin:2em;color:#1e2026}"
    "table{border-collapse:collapse;margin:1em 0}"
    "td,th{border-bottom:1px solid #cdd0d6;padding:.3em .6em;text-align:left;vertical-align:top}"
    "img{max-width:100%;margin:0 1em 1em 0}p{max-width:60em}"
)


def _page(run: Run) -> str:
    """A self-contained HTML page."""
    parts = [f"<p>{html.escape(f'{machine_text(run.machine)}. Took {run.took}.')}</p>"]
    parts += [f"<p><strong>{html.escape(note)}</strong></p>" for note in run.notes]
    parts.append(f"<p>{html.escape(READING)}</p>")
    for table in tables(run):
        head = "".join(f"<th>{html.escape(text)}</th>" for text in table.heads)
        body = "".join(
            "<tr>" + "".join(f"<td>{html.escape(text)}</td>" for text in row) + "</tr>" for row in table.rows
        )
        parts.append(
            f"<h2>{html.escape(table.title)}</h2><p>{html.escape(table.text)}</p>"
            f"<table><tr>{head}</tr>{body}</table>"
        )
        pictures = (
            [curve_plot(curve) for curve in run.curves]
            if table.heads[0] == "work"
            else [ratio_plot([r for r in run.results if r.case.subject.capitalize() == table.title])]
        )
        parts += [
            f'<img alt="{html.escape(table.title)}" src="data:image/png;base64,{_base64(picture)}">'
            for picture in pictures
        ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Benchmark</title>'
        f"<style>{_STYLE}</style><h1>Benchmark</h1>{''.join(parts)}</html>\n"
    )


def _base64(picture: Image.Image) -> str:
    file = io.BytesIO()
    picture.save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


def _scale(values: Sequence[float], *, ends: tuple[float, float]) -> tuple[Any, list[float]]:
    """A function from values to pixels between two ends on a logarithmic axis, and the values to mark."""
    low, high = math.log10(min(values)), math.log10(max(values))
    room = max(0.05 * (high - low), 0.05)
    low, high = low - room, high + room
    marks = [
        m * 10.0**k
        for k in range(math.floor(low), math.ceil(high) + 1)
        for m in ((1, 2, 5) if high - low < 2.5 else (1,))
        if low <= math.log10(m * 10.0**k) <= high
    ]
    if len(marks) < 2:
        marks = [min(values), max(values)]
    start, end = ends
    return lambda v: start + (end - start) * (math.log10(v) - low) / (high - low), marks


def curve_plot(curve: Curve, *, width: int = 560, height: int = 400) -> Image.Image:
    """A cost against a size, both logarithmic, with the fitted power law."""
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=13)
    said: dict[str, Any] = {"fill": _INK, "font": font}
    unit, share = ("MiB", 2.0**20) if curve.cost == "bytes" else (curve.cost, 1.0)
    pen.text((10, 8), f"{curve.name}: exponent {exponent_text(curve)}", **said)
    points = [(x, y / share) for x, y in zip(curve.x, curve.y, strict=True) if y > 0]
    if not points:
        return picture
    b, x = curve.exponent, [x for x, _ in points]
    line = [(end, b.at(end) / share) for end in (min(x), max(x))] if b else []
    left, right, top, bottom = 70, width - 20, 50, height - 50
    across, columns = _scale(x, ends=(left, right))
    up, rows = _scale([y for _, y in points + line], ends=(bottom, top))
    for value in columns:
        pen.line((across(value), top, across(value), bottom), fill=_GREY)
        pen.text((across(value), bottom + 6), f"{value:,.4g}", **said, anchor="mt")
    for value in rows:
        pen.line((left, up(value), right, up(value)), fill=_GREY)
        pen.text((left - 6, up(value)), f"{value:,.4g}", **said, anchor="rm")
    pen.text(((left + right) / 2, height - 8), curve.size, **said, anchor="ms")
    pen.text((10, top - 8), unit, **said, anchor="ls")
    if line:
        pen.line([(across(x), up(y)) for x, y in line], fill=_LINE, width=2)
    for x, y in points:
        pen.ellipse((across(x) - 4, up(y) - 4, across(x) + 4, up(y) + 4), fill=_DOT)
    return picture


def ratio_plot(results: Sequence[Result], *, width: int = 1100) -> Image.Image:
    """Our rate over that of each reference, with smallest and greatest, on a logarithmic axis."""
    bars = [
        (f"{r.case.name}: {first} / {side}", r.ratio(side))
        for r in results
        for first, *others in [list(r.spent)]
        for side in others
    ]
    height, left, right = 60 + 22 * len(bars), 460, width - 60
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=13)
    said: dict[str, Any] = {"fill": _INK, "font": font}
    if not bars:
        return picture
    across, marks = _scale([1.0, *(v for _, s in bars for v in (s.low, s.high))], ends=(left, right))
    for value in marks:
        pen.line((across(value), 30, across(value), height - 10), fill=_GREY)
        pen.text((across(value), 24), f"{value:g}", **said, anchor="ms")
    pen.line((across(1.0), 30, across(1.0), height - 10), fill=_INK, width=2)
    pen.text((10, 24), "ratio of rates", **said, anchor="ls")
    for k, (name, ratio) in enumerate(bars):
        v = 46 + 22 * k
        pen.text((left - 12, v), name, **said, anchor="rm")
        pen.line((across(ratio.low), v, across(ratio.high), v), fill=_DOT, width=3)
        u = across(ratio.median)
        pen.ellipse((u - 5, v - 5, u + 5, v + 5), fill=_LINE if ratio.median < 1 else _DOT)
        place, text = (across(ratio.high) + 10, v), f"{ratio.median:.3g}"
        pen.rectangle(pen.textbbox(place, text, font=font, anchor="lm"), fill=(255, 255, 255))
        pen.text(place, text, **said, anchor="lm")
    return picture
