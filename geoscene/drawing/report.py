"""Reports: tables of one declaration of columns, as text and HTML, HTML pages, and values with units."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import isnan
from typing import Generic, TypeVar

Row = TypeVar("Row")

_STYLE = (
    "body{font:15px system-ui,sans-serif;margin:2em;color:#1e2026}"
    ".wide{overflow-x:auto;margin:1em 0}table{border-collapse:collapse;font-size:13px}"
    "td,th{border-bottom:1px solid #cdd0d6;padding:.3em .5em;text-align:right;white-space:nowrap}"
    "td:first-child,th:first-child{position:sticky;left:0;background:#fff}"
    "td:first-child,th:first-child{text-align:left;white-space:normal;min-width:12em}"
    "td.text,th.text{text-align:left;white-space:normal}td.text:last-child{min-width:16em}"
    "img{max-width:100%}"
)


@dataclass(frozen=True, slots=True)
class Column(Generic[Row]):
    """A column of a table: its heading, the text of a row in it, and perhaps a shade from 0 to 1."""

    head: str
    text: Callable[[Row], str]
    shade: Callable[[Row], float] | None = None


@dataclass(frozen=True, slots=True)
class ReportTable:
    """A table of texts.

    title  : empty for none
    head   : headings
    rows   : texts of each row
    shades : of each cell from 0 (white) to 1, nan for white; None for a table without shades
    """

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    shades: tuple[tuple[float, ...], ...] | None = None

    def to_text(self) -> str:
        """Title and rows as lines with aligned columns."""
        lines = align_columns([self.head, *self.rows])
        return f"{self.title}\n{lines}" if self.title else lines

    def to_html(self) -> str:
        """The table as HTML; intervals in brackets stand below their values, columns of words to the left."""
        wordy = [any(row[k][:1].isalpha() for row in self.rows) for k in range(len(self.head))]
        head = [_cell(text, tag="th", words=words) for text, words in zip(self.head, wordy, strict=True)]
        lines = [f"<tr>{''.join(head)}</tr>"]
        for number, row in enumerate(self.rows):
            shades = self.shades[number] if self.shades else (float("nan"),) * len(row)
            cells = zip(row, wordy, shades, strict=True)
            texts = (_cell(text, tag="td", words=words, shade=shade) for text, words, shade in cells)
            lines.append(f"<tr>{''.join(texts)}</tr>")
        title = f"<h3>{html.escape(self.title)}</h3>" if self.title else ""
        return f'{title}<div class="wide"><table>{"".join(lines)}</table></div>'


def table_of(columns: Sequence[Column[Row]], rows: Iterable[Row], *, title: str = "") -> ReportTable:
    """The table of some rows."""
    rows = list(rows)
    texts = tuple(tuple(column.text(row) for column in columns) for row in rows)
    shades = None
    if any(column.shade for column in columns):
        shades = tuple(
            tuple(column.shade(row) if column.shade else float("nan") for column in columns) for row in rows
        )
    return ReportTable(title, tuple(column.head for column in columns), texts, shades)


def _cell(text: str, *, tag: str, words: bool, shade: float = float("nan")) -> str:
    """A cell of HTML."""
    style = "" if isnan(shade) else f' style="background:rgba(70,150,90,{0.65 * min(max(shade, 0), 1):.2f})"'
    if words:
        return f'<{tag} class="text"{style}>{html.escape(text)}</{tag}>'
    return f"<{tag}{style}>{html.escape(text).replace(' (', '<br>(')}</{tag}>"


class Page:
    """A self-contained HTML page, built from top to bottom."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._parts: list[str] = []

    def heading(self, text: str) -> None:
        """Add a heading."""
        self._parts.append(f"<h2>{html.escape(text)}</h2>")

    def paragraph(self, text: str) -> None:
        """Add a paragraph; none for an empty text."""
        if text:
            self._parts.append(f"<p>{html.escape(text)}</p>")

    def points(self, texts: Iterable[str]) -> None:
        """Add a list of texts."""
        self._parts.append(f"<ul>{''.join(f'<li>{html.escape(text)}</li>' for text in texts)}</ul>")

    def table(self, table: ReportTable) -> None:
        """Add a table."""
        self._parts.append(table.to_html())

    def picture(self, png: bytes, *, alt: str) -> None:
        """Add a picture, which becomes a part of the page."""
        data = base64.b64encode(png).decode()
        self._parts.append(f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{data}">')

    def encoded(self) -> bytes:
        """The page."""
        title = html.escape(self._title)
        return (
            f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title>'
            f"<style>{_STYLE}</style><h1>{title}</h1>{''.join(self._parts)}</html>\n"
        ).encode()


def align_columns(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as lines of text with aligned columns."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def metres(value: float) -> str:
    """A length with a unit that fits it."""
    for unit, size in (("m", 1.0), ("cm", 0.01), ("mm", 0.001), ("µm", 1e-6), ("nm", 1e-9)):
        if abs(value) >= size:
            return f"{value / size:.3g} {unit}"
    return "0" if value == 0 else "below 1 nm"


def share(value: float) -> str:
    """A share in percent, with its sign if negative."""
    digits = 3 if abs(value) >= 0.995 else 2
    return "0" if value == 0 else f"{100 * value:.{digits}g} %"


def levels(value: float) -> str:
    """A difference of colours, in levels of 255."""
    text = f"{value:.3g}"
    return f"{text} level{'' if text == '1' else 's'}"


def size(value: float) -> str:
    """Bytes in decimal units."""
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(value) >= one:
            return f"{value / one:.3g} {unit}"
    return f"{value:.0f} B"
