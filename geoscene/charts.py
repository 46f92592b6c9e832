"""Charts, tables and pages of reports: figures as people read them, scatter plots, self-contained HTML."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table

_INK, _GREY, _CHOICE, _OTHER = (30, 32, 38), (205, 208, 214), (200, 60, 40), (60, 110, 180)
_BAND = (250, 224, 160)
_STYLE = (
    "body{font:15px system-ui,sans-serif;margin:2em;color:#1e2026}"
    ".wide{overflow-x:auto;margin:1em 0}table{border-collapse:collapse;font-size:13px}"
    "td,th{border-bottom:1px solid #cdd0d6;padding:.3em .5em;text-align:right;white-space:nowrap}"
    "td:first-child,th:first-child{position:sticky;left:0;background:#fff}"
    "td:first-child,th:first-child{text-align:left;white-space:normal;min-width:12em}"
    "td.text,th.text{text-align:left;white-space:normal}td.text:last-child{min-width:16em}"
    "img{max-width:100%}"
)
_LEGEND = (
    (_CHOICE, "no other setting is both cheaper and more exact"),
    (_OTHER, "another setting is cheaper and at least as exact"),
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


def size(value: float) -> str:
    """Bytes in decimal units."""
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(value) >= one:
            return f"{value / one:.3g} {unit}"
    return f"{value:.0f} B"


@dataclass(frozen=True, slots=True)
class Point:
    """A named point of a chart, with intervals if they are known; ``best`` ones are joined by a line."""

    name: str
    x: float
    y: float
    best: bool
    x_interval: tuple[float, float] | None = None
    y_interval: tuple[float, float] | None = None

    @property
    def xs(self) -> tuple[float, ...]:
        """The value of x and the ends of its interval."""
        return (self.x, *(self.x_interval or ()))

    @property
    def ys(self) -> tuple[float, ...]:
        """The value of y and the ends of its interval."""
        return (self.y, *(self.y_interval or ()))


@dataclass(frozen=True, slots=True)
class Axes:
    """Titles of a chart and its axes, and the texts of values of y."""

    title: str
    x: str
    y: str
    y_text: Callable[[float], str]


def scatter(points: Sequence[Point], axes: Axes, *, width: int = 1100, height: int = 700) -> bytes:
    """A PNG of points with a legend, both axes logarithmic.

    Values of 0 are drawn at the lower end, marked ``0``. Points whose names have no room are counted in the
    legend.
    """
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=15)
    left, right, top, bottom = 90, width - 130, 96, height - 70
    x_ends, y_ends = _ends([x for p in points for x in p.xs]), _ends([y for p in points for y in p.ys])
    nothing = any(y <= 0 for p in points for y in p.ys)

    def across(value: float) -> float:
        return _place(value, x_ends, at=(left, right))

    def up(value: float) -> float:
        return _place(value, y_ends, at=(bottom - 40 * nothing, top)) if value > 0 else bottom

    def text(place: tuple[float, float], words: str, *, anchor: str) -> None:
        pen.text(place, words, fill=_INK, font=font, anchor=anchor, stroke_width=2, stroke_fill="white")

    text((left, 16), axes.title, anchor="la")
    text(((left + right) / 2, height - 16), axes.x, anchor="ms")
    text((12, top - 10), axes.y, anchor="ls")
    for value in _marks(x_ends):
        pen.line((across(value), top, across(value), bottom), fill=_GREY)
        text((across(value), bottom + 8), f"{value:g}", anchor="mt")
    for value in [*_marks(y_ends), *[0.0] * nothing]:
        pen.line((left, up(value), right, up(value)), fill=_GREY)
        text((left - 8, up(value)), axes.y_text(value), anchor="rm")
    ordered = sorted(points, key=lambda p: (not p.best, p.x))
    line = [(across(p.x), up(p.y)) for p in ordered if p.best]
    if len(line) > 1:
        pen.line(line, fill=_CHOICE, width=2)
    for p in ordered:
        u, v, color = across(p.x), up(p.y), _CHOICE if p.best else _OTHER
        pen.line((across(min(p.xs)), v, across(max(p.xs)), v), fill=color)
        pen.line((u, up(min(p.ys)), u, up(max(p.ys))), fill=color)
        pen.ellipse((u - 4, v - 4, u + 4, v + 4), fill=color)
    named: list[tuple[float, float, float, float]] = []
    for p in ordered:
        u, v = across(p.x), up(p.y)
        for place, anchor in (((u + 8, v - 4), "ls"), ((u + 8, v + 4), "lt"), ((u - 8, v + 4), "rt")):
            box = pen.textbbox(place, p.name, font=font, anchor=anchor)
            outside = box[0] < left or box[2] > width
            if not outside and not any(_overlap(box, other) for other in named):  # else the table has it
                text(place, p.name, anchor=anchor)
                named.append(box)
                break
    at = left
    unnamed = len(ordered) - len(named)
    for color, words in _LEGEND:
        pen.ellipse((at, 44, at + 8, 52), fill=color)
        text((at + 14, 48), words, anchor="lm")
        at += 34 + int(pen.textlength(words, font=font))
    if unnamed:
        text((at, 48), f"{unnamed} without a name, see the table", anchor="lm")
    return _png(picture)


_COLORS = (
    *((200, 60, 40), (60, 110, 180), (70, 150, 90), (150, 90, 170), (220, 150, 40), (90, 90, 90)),
    *((40, 160, 170), (190, 110, 140), (130, 110, 60), (110, 140, 220), (160, 190, 60), (20, 60, 90)),
)


def curves(
    lines: Mapping[str, Sequence[tuple[float, float]]], axes: Axes, *, mark: float, size: int = 560
) -> bytes:
    """A PNG of named lines of shares, both axes linear from 0 to 1, with a legend and the diagonal.

    mark : value of x at which a line stands
    """
    left, top, bottom = 70, 70, size - 60
    right = left + bottom - top
    picture = Image.new("RGB", (right + 200, size), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=14)

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return left + (right - left) * point[0], bottom + (top - bottom) * point[1]

    pen.text((left, 14), axes.title, fill=_INK, font=font)
    pen.text(((left + right) / 2, size - 14), axes.x, fill=_INK, font=font, anchor="ms")
    pen.text((12, top - 12), axes.y, fill=_INK, font=font, anchor="ls")
    for value in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
        pen.line((*place((value, 0)), *place((value, 1))), fill=_GREY)
        pen.line((*place((0, value)), *place((1, value))), fill=_GREY)
        pen.text((place((value, 0))[0], bottom + 6), f"{value:g}", fill=_INK, font=font, anchor="mt")
        pen.text((left - 8, place((0, value))[1]), axes.y_text(value), fill=_INK, font=font, anchor="rm")
    pen.line((*place((0, 0)), *place((1, 1))), fill=_GREY, width=2)
    pen.line((*place((mark, 0)), *place((mark, 1))), fill=_INK, width=1)
    for k, (name, points) in enumerate(lines.items()):
        color = _COLORS[k % len(_COLORS)]
        if len(points) > 1:
            pen.line([place(point) for point in points], fill=color, width=2)
        pen.line((right + 16, top + 10 + 20 * k, right + 36, top + 10 + 20 * k), fill=color, width=3)
        pen.text((right + 44, top + 10 + 20 * k), name, fill=_INK, font=font, anchor="lm")
    return _png(picture)


@dataclass(frozen=True, slots=True)
class Span:
    """A named share with its interval, and the bounds of what others published of it."""

    name: str
    share: float
    interval: tuple[float, float]
    published: tuple[float, float] | None = None


def spans(rows: Sequence[Span], *, title: str, width: int = 1000) -> bytes:
    """A PNG of shares from 0 to 1 with their intervals, one below the other, published bounds as bars."""
    left, right, top = 330, width - 40, 70
    picture = Image.new("RGB", (width, top + 26 * len(rows) + 50), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=14)
    bottom = top + 26 * len(rows)
    pen.text((left, 14), title, fill=_INK, font=font)
    pen.rectangle((left, 42, left + 14, 54), fill=_BAND)
    pen.text((left + 22, 48), "published", fill=_INK, font=font, anchor="lm")

    def across(share: float) -> float:
        return left + (right - left) * share

    for k, row in enumerate(rows):
        v = top + 26 * k + 13
        if row.published is not None:
            low, high = map(across, row.published)
            pen.rectangle((low - 2, v - 9, high + 2, v + 9), fill=_BAND)
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        pen.line((across(value), top, across(value), bottom), fill=_GREY)
        pen.text((across(value), bottom + 8), f"{100 * value:g} %", fill=_INK, font=font, anchor="mt")
    for k, row in enumerate(rows):
        v = top + 26 * k + 13
        pen.text((left - 10, v), row.name, fill=_INK, font=font, anchor="rm")
        if math.isfinite(row.share):
            pen.line((across(row.interval[0]), v, across(row.interval[1]), v), fill=_CHOICE, width=2)
            pen.ellipse((across(row.share) - 4, v - 4, across(row.share) + 4, v + 4), fill=_CHOICE)
    return _png(picture)


@dataclass(frozen=True, slots=True)
class Series:
    """A named line, or dots if these are single values such as published ones."""

    name: str
    points: Sequence[tuple[float, float]]
    dots: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """Series on common axes, each linear from 0 or logarithmic."""

    axes: Axes
    series: Sequence[Series]
    x_log: bool = True
    y_log: bool = True


def panels(some: Sequence[Panel], *, columns: int = 2, size: tuple[int, int] = (760, 520)) -> bytes:
    """A PNG of panels side by side, each with a legend; values of 0 are left out of logarithmic axes."""
    rows = -(-len(some) // columns)
    picture = Image.new("RGB", (columns * size[0], rows * size[1]), (255, 255, 255))
    for k, panel in enumerate(some):
        picture.paste(_panel(panel, size=size), ((k % columns) * size[0], (k // columns) * size[1]))
    return _png(picture)


def _panel(panel: Panel, *, size: tuple[int, int]) -> Image.Image:
    picture = Image.new("RGB", size, (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=14)
    left, right, top, bottom = 72, size[0] - 230, 64, size[1] - 58
    shown = [p for s in panel.series for p in s.points if _is_shown(p, panel)]
    x_ends = _ends([x for x, _ in shown]) if panel.x_log else _linear_ends([x for x, _ in shown])
    y_ends = _ends([y for _, y in shown]) if panel.y_log else _linear_ends([y for _, y in shown])

    def place(point: tuple[float, float]) -> tuple[float, float]:
        x, y = point
        across = _place if panel.x_log else _even_place
        up = _place if panel.y_log else _even_place
        return across(x, x_ends, at=(left, right)), up(y, y_ends, at=(bottom, top))

    pen.text((left, 12), panel.axes.title, fill=_INK, font=font)
    pen.text(((left + right) / 2, size[1] - 12), panel.axes.x, fill=_INK, font=font, anchor="ms")
    pen.text((10, top - 10), panel.axes.y, fill=_INK, font=font, anchor="ls")
    for value in _marks(x_ends) if panel.x_log else _even_marks(x_ends):
        u = place((value, y_ends[1]))[0]
        pen.line((u, top, u, bottom), fill=_GREY)
        pen.text((u, bottom + 6), f"{value:g}", fill=_INK, font=font, anchor="mt")
    for value in _marks(y_ends) if panel.y_log else _even_marks(y_ends):
        v = place((x_ends[1], value))[1]
        pen.line((left, v, right, v), fill=_GREY)
        pen.text((left - 8, v), panel.axes.y_text(value), fill=_INK, font=font, anchor="rm")
    for k, one in enumerate(panel.series):
        color, v = _COLORS[k % len(_COLORS)], top + 10 + 22 * k
        points = [place(p) for p in one.points if _is_shown(p, panel)]
        if one.dots:
            for u, w in [*points, (right + 26, v)]:
                pen.ellipse((u - 5, w - 5, u + 5, w + 5), outline=color, width=2, fill="white")
        else:
            if len(points) > 1:
                pen.line(points, fill=color, width=2)
            pen.line((right + 16, v, right + 36, v), fill=color, width=3)
        pen.text((right + 44, v), one.name, fill=_INK, font=font, anchor="lm")
    return picture


def _is_shown(point: tuple[float, float], panel: Panel) -> bool:
    x, y = point
    return math.isfinite(x) and math.isfinite(y) and (x > 0 or not panel.x_log) and (y > 0 or not panel.y_log)


def _linear_ends(values: Sequence[float]) -> tuple[float, float]:
    return 0.0, _ends([max(values, default=1.0)])[1]


def _even_marks(ends: tuple[float, float]) -> list[float]:
    return [ends[1] * k / 5 for k in range(6)]


def _even_place(value: float, ends: tuple[float, float], *, at: tuple[float, float]) -> float:
    return at[0] + (at[1] - at[0]) * (min(max(value, ends[0]), ends[1]) - ends[0]) / (ends[1] - ends[0])


def _png(picture: Image.Image) -> bytes:
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """The powers of ten around values; 1, 2 or 5 of them."""
    known = [v for v in values if v > 0] or [1.0]
    marks = [m * 10.0**k for k in range(-9, 13) for m in (1, 2, 5)]
    low = max((m for m in marks if m <= min(known)), default=marks[0])
    high = min((m for m in marks if m >= max(known) and m > low), default=marks[-1])
    return low, high


def _marks(ends: tuple[float, float]) -> list[float]:
    """Values to mark on an axis: powers of ten, and 2 and 5 of them on a short one."""
    steps = (1, 2, 5) if ends[1] / ends[0] <= 100 else (1,)
    every = (m * 10.0**k for k in range(-9, 13) for m in steps)
    return [v for v in every if ends[0] * (1 - 1e-9) <= v <= ends[1] * (1 + 1e-9)]


def _place(value: float, ends: tuple[float, float], *, at: tuple[float, float]) -> float:
    low, high = map(math.log10, ends)
    part = (math.log10(min(max(value, ends[0]), ends[1])) - low) / (high - low)
    return at[0] + (at[1] - at[0]) * part


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    """Whether two boxes (left, top, right, bottom) overlap."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]], *, title: str) -> None:
    """Print a table, 240 characters wide if not to a terminal."""
    table = Table(*head, title=title)
    for row in rows:
        table.add_row(*row)
    _console().print(table)


def print_lines(texts: Iterable[str]) -> None:
    """Print texts that are not empty, each from a new line."""
    for text in filter(None, texts):
        _console().print(text, highlight=False)


def _console() -> Console:
    console = Console()
    return console if console.is_terminal else Console(width=240)


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts; intervals in brackets stand below their values, columns of words to the left."""
    wordy = [any(row[k][:1].isalpha() for row in rows) for k in range(len(head))]

    def cell(text: str, *, tag: str, words: bool) -> str:
        if words:
            return f'<{tag} class="text">{html.escape(text)}</{tag}>'
        return f"<{tag}>{html.escape(text).replace(' (', '<br>(')}</{tag}>"

    def line(cells: Sequence[str], tag: str) -> str:
        texts = (cell(text, tag=tag, words=words) for text, words in zip(cells, wordy, strict=True))
        return f"<tr>{''.join(texts)}</tr>"

    return (
        f'<div class="wide"><table>{line(head, "th")}{"".join(line(row, "td") for row in rows)}</table></div>'
    )


def html_matrix(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, shades: Sequence[Sequence[float]]
) -> str:
    """A table of texts whose cells but the first of each row are shaded from 0 (white) to 1; nan is white."""

    def cell(text: str, shade: float) -> str:
        strength = 0.0 if math.isnan(shade) else min(max(shade, 0.0), 1.0)
        words = html.escape(text).replace(" (", "<br>(")
        return f'<td style="background:rgba(70,150,90,{0.65 * strength:.2f})">{words}</td>'

    lines = [
        f"<tr><td>{html.escape(row[0])}</td>{''.join(map(cell, row[1:], some))}</tr>"
        for row, some in zip(rows, shades, strict=True)
    ]
    titles = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    return f'<div class="wide"><table><tr>{titles}</tr>{"".join(lines)}</table></div>'


def html_picture(png: bytes, *, alt: str) -> str:
    """A picture within the page."""
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def html_page(title: str, body: str) -> bytes:
    """A page without links to other files."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1>{body}</html>\n"
    ).encode()
