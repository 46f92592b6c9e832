"""The report of a comparison of builds: terminal table, plot, HTML page, JSON, recommendations in words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from geoscene.drawing.charts import Axes, ChartPoint, scatter
from geoscene.drawing.report import Column, Page, ReportTable, metres, share, size, table_of
from geoscene.support.files import write_atomically, write_json
from geoscene.tradeoff.engine import BuildRow, BuildTradeoff

TARGETS = (0.01, 0.1, 1.0)
"""Metres (rms) of the surface model for which a setting is recommended."""

SAVING = 0.1
"""Share of the CPU time of the full scene that a recommended setting saves: less may be chance."""


def _cpu_text(row: BuildRow) -> str:
    """CPU seconds, with the range of repetitions."""
    cpu = [cost.cpu_s for cost in row.costs]
    spread = f" ({min(cpu):.3g} to {max(cpu):.3g})" if len(cpu) > 1 else ""
    return f"{row.cost.cpu_s:.3g}{spread}"


def _missing_text(row: BuildRow) -> str:
    """Objects that are missing, and the note."""
    lost = [f"{n:,} {name}" for name, n in row.missing.items()]
    return "; ".join(filter(None, (f"without {', '.join(lost)}" if lost else "", row.note)))


def _error_column(head: str, name: str, *, text: Callable[[float], str]) -> Column[BuildRow]:
    return Column(head, lambda row: text(row.error[name]) if row.error else "")


_COLUMNS: tuple[Column[BuildRow], ...] = (
    Column("setting", lambda row: row.label),
    _error_column("height rms", "height_rms_m", text=metres),
    _error_column("99 %", "height_99_m", text=metres),
    _error_column("max", "height_max_m", text=metres),
    _error_column("other height", "cells", text=share),
    _error_column("other class", "classes", text=share),
    _error_column("volume", "volume", text=share),
    _error_column("footprints", "area", text=share),
    Column("CPU s", _cpu_text),
    Column("memory", lambda row: size(row.cost.memory_bytes)),
    Column("bytes", lambda row: size(row.cost.bytes)),
    Column("missing, note", _missing_text),
)


def build_table(found: BuildTradeoff) -> ReportTable:
    """The table of all builds."""
    return table_of(_COLUMNS, found.rows, title=headline(found))


def headline(found: BuildTradeoff) -> str:
    """The place and the size of the cells that are compared."""
    return f"{found.name}: surface models of {metres(found.resolution)} cells against the full scene"


def pareto(found: BuildTradeoff) -> list[BuildRow]:
    """Builds for all uses of which no other is both cheaper and at least as exact, the cheapest first."""
    best: list[BuildRow] = []
    shown = [row for row in found.rows if not row.label.startswith("for=")]
    for row in sorted(shown, key=lambda r: (r.cost.cpu_s, r.error["height_rms_m"])):
        if not best or row.error["height_rms_m"] < best[-1].error["height_rms_m"]:
            best.append(row)
    return best


def recommendations(found: BuildTradeoff) -> list[str]:
    """A sentence for each of `TARGETS`, and one for scenes for drives."""
    full, best = found.rows[0], pareto(found)
    most = (1 - SAVING) * full.cost.cpu_s
    said = []
    for target in TARGETS:
        row = next(row for row in best if row.error["height_rms_m"] <= target)
        wanted = f"For a surface model within {metres(target)} rms"
        if row.cost.cpu_s > most:
            said.append(f"{wanted} no setting that was compared saves {share(SAVING)} of the CPU time.")
            continue
        lost = f", without {', '.join(row.missing)}" if row.missing else ""
        said.append(
            f"{wanted} the cheapest setting is {row.label}: {_saving(row, full)};"
            f" it errs by {metres(row.error['height_rms_m'])} rms, {metres(row.error['height_99_m'])} at"
            f" 99 %{lost}."
        )
    return said + [
        f"For drives with laser scanners {row.label} has no error: {_saving(row, full)}."
        for row in found.rows
        if row.label == "for=lidar"
    ]


def _saving(row: BuildRow, full: BuildRow) -> str:
    return (
        f"{row.cost.cpu_s:.3g} instead of {full.cost.cpu_s:.3g} CPU s,"
        f" {size(row.cost.bytes)} instead of {size(full.cost.bytes)}"
    )


def to_text(found: BuildTradeoff) -> str:
    """The table and the recommendations."""
    return "\n\n".join([build_table(found).to_text(), "\n".join(recommendations(found))])


def document(found: BuildTradeoff) -> dict[str, Any]:
    """The contents of ``tradeoff.json``."""
    rows = [
        {
            "setting": row.label,
            "error": row.error,
            "missing": row.missing,
            "cost": asdict(row.cost),
            "costs": [asdict(cost) for cost in row.costs],
            "note": row.note,
        }
        for row in found.rows
    ]
    return {
        "schema": 1,
        "name": found.name,
        "resolution_m": found.resolution,
        "rows": rows,
        "pareto": [row.label for row in pareto(found)],
        "recommendations": recommendations(found),
    }


def plot(found: BuildTradeoff) -> bytes:
    """A PNG: error of the surface model against CPU time."""
    best = [row.label for row in pareto(found)]
    points = [
        ChartPoint(row.label, row.cost.cpu_s, row.error["height_rms_m"], row.label in best)
        for row in found.rows
        if row.error
    ]
    return scatter(points, Axes(headline(found), "CPU s of the build", "height error, rms", metres))


def write_report(found: BuildTradeoff, out: Path) -> None:
    """Write ``tradeoff.json``, ``tradeoff.html`` and ``pareto.png`` into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    picture = plot(found)
    page = Page(f"Cost against accuracy: {found.name}")
    page.points(recommendations(found))
    page.table(build_table(found))
    page.picture(picture, alt="error against cost")
    write_atomically(out / "pareto.png", picture)
    write_atomically(out / "tradeoff.html", page.encoded())
    write_json(out / "tradeoff.json", document(found))
