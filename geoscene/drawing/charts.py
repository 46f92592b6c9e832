"""Charts of reports: scatter plots, curves of shares, shares with intervals."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from PIL import Image, ImageDraw, ImageFont

from geoscene.drawing.axes import log_axis
from geoscene.drawing.canvas import INK, Color, drawable

GREY: Color = (205, 208, 214)
"""Of ticks and grids."""

_CHOICE, _OTHER = (200, 60, 40), (60, 110, 180)
_BAND = (250, 224, 160)
_LEGEND = (
    (_CHOICE, "no other setting is both cheaper and more exact"),
    (_OTHER, "another setting is cheaper and at least as exact"),
)


@dataclass(frozen=True, slots=True)
class ChartPoint:
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


def scatter(points: Sequence[ChartPoint], axes: Axes, *, width: int = 1100, height: int = 700) -> bytes:
    """A PNG of points with a legend, both axes logarithmic.

    Values of 0 are drawn at the lower end, marked ``0``. Points whose names have no room are counted in the
    legend.
    """
    picture = Image.new("RGB", (width, height), (255, 255, 255))
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=15)
    left, right, top, bottom = 90, width - 130, 96, height - 70
    x_axis, y_axis = log_axis(x for p in points for x in p.xs), log_axis(y for p in points for y in p.ys)
    nothing = any(y <= 0 for p in points for y in p.ys)

    def across(value: float) -> float:
        return left + (right - left) * x_axis.share(value)

    def up(value: float) -> float:
        low = bottom - 40 * nothing
        return low + (top - low) * y_axis.share(value) if value > 0 else bottom

    def text(place: tuple[float, float], words: str, *, anchor: str) -> None:
        pen.text(
            place, drawable(words), fill=INK, font=font, anchor=anchor, stroke_width=2, stroke_fill="white"
        )

    text((left, 16), axes.title, anchor="la")
    text(((left + right) / 2, height - 16), axes.x, anchor="ms")
    text((12, top - 10), axes.y, anchor="ls")
    for value in x_axis.ticks():
        pen.line((across(value), top, across(value), bottom), fill=GREY)
        text((across(value), bottom + 8), f"{value:g}", anchor="mt")
    for value in [*y_axis.ticks(), *[0.0] * nothing]:
        pen.line((left, up(value), right, up(value)), fill=GREY)
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


COLORS: tuple[Color, ...] = (
    *((200, 60, 40), (60, 110, 180), (70, 150, 90), (150, 90, 170), (220, 150, 40), (90, 90, 90)),
    *((40, 160, 170), (190, 110, 140), (130, 110, 60), (110, 140, 220), (160, 190, 60), (20, 60, 90)),
)
"""Of lines, by rank."""


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

    pen.text((left, 14), axes.title, fill=INK, font=font)
    pen.text(((left + right) / 2, size - 14), axes.x, fill=INK, font=font, anchor="ms")
    pen.text((12, top - 12), axes.y, fill=INK, font=font, anchor="ls")
    for value in (0.0, 0.2, 0.4, 0.6, 0.8, 1.0):
        pen.line((*place((value, 0)), *place((value, 1))), fill=GREY)
        pen.line((*place((0, value)), *place((1, value))), fill=GREY)
        pen.text((place((value, 0))[0], bottom + 6), f"{value:g}", fill=INK, font=font, anchor="mt")
        pen.text((left - 8, place((0, value))[1]), axes.y_text(value), fill=INK, font=font, anchor="rm")
    pen.line((*place((0, 0)), *place((1, 1))), fill=GREY, width=2)
    pen.line((*place((mark, 0)), *place((mark, 1))), fill=INK, width=1)
    for k, (name, points) in enumerate(lines.items()):
        color = COLORS[k % len(COLORS)]
        if len(points) > 1:
            pen.line([place(point) for point in points], fill=color, width=2)
        pen.line((right + 16, top + 10 + 20 * k, right + 36, top + 10 + 20 * k), fill=color, width=3)
        pen.text((right + 44, top + 10 + 20 * k), name, fill=INK, font=font, anchor="lm")
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
    pen.text((left, 14), title, fill=INK, font=font)
    pen.rectangle((left, 42, left + 14, 54), fill=_BAND)
    pen.text((left + 22, 48), "published", fill=INK, font=font, anchor="lm")

    def across(part: float) -> float:
        return left + (right - left) * part

    for k, row in enumerate(rows):
        v = top + 26 * k + 13
        if row.published is not None:
            low, high = map(across, row.published)
            pen.rectangle((low - 2, v - 9, high + 2, v + 9), fill=_BAND)
    for value in (0.0, 0.25, 0.5, 0.75, 1.0):
        pen.line((across(value), top, across(value), bottom), fill=GREY)
        pen.text((across(value), bottom + 8), f"{100 * value:g} %", fill=INK, font=font, anchor="mt")
    for k, row in enumerate(rows):
        v = top + 26 * k + 13
        pen.text((left - 10, v), row.name, fill=INK, font=font, anchor="rm")
        if math.isfinite(row.share):
            pen.line((across(row.interval[0]), v, across(row.interval[1]), v), fill=_CHOICE, width=2)
            pen.ellipse((across(row.share) - 4, v - 4, across(row.share) + 4, v + 4), fill=_CHOICE)
    return _png(picture)


def _png(picture: Image.Image) -> bytes:
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def _overlap(one: tuple[float, float, float, float], other: tuple[float, float, float, float]) -> bool:
    """Whether two boxes (left, top, right, bottom) overlap."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
