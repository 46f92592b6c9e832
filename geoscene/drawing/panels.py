"""Figures of several panels: lines, dots and bands on common axes, and rasters with a scale or a legend."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.drawing.axes import Axis, linear_axis, log_axis
from geoscene.drawing.canvas import Box, Canvas, Color, Place
from geoscene.drawing.charts import COLORS, GREY, Axes

Point = tuple[float, float]
P = TypeVar("P", bound=tuple[float, ...])

_LEFT, _RIGHT, _TOP, _BOTTOM = 78, 230, 64, 58
"""Pixels of a panel around its axes, for texts and the legend."""

_LINE = 22
"""Pixels between the lines of a legend."""

_SCALE = (170, 260)
"""Pixels of the height of a scale, at least and at most."""

_TICK = (90, 36)
"""Pixels between ticks of x and y, at least."""


@dataclass(frozen=True, slots=True)
class Series:
    """A named line, or dots if these are single values such as published ones.

    A line is broken at points that are not finite. ``color`` is by its rank by default.
    """

    name: str
    points: Sequence[Point]
    dots: bool = False
    color: Color | None = None


@dataclass(frozen=True, slots=True)
class ShadedBand:
    """A named area between two values of y, (x, low, high) from point to point; broken where not finite."""

    name: str
    points: Sequence[tuple[float, float, float]]
    color: Color = (150, 180, 220)


@dataclass(frozen=True, slots=True)
class Panel:
    """Series on common axes, each linear with 0 on it or logarithmic.

    x_ends, y_ends : of an axis that ends there instead
    floor : whether values of y that are not positive lie at the lower end of a logarithmic axis, as counts of
            histograms do, instead of being left out
    """

    axes: Axes
    series: Sequence[Series]
    x_log: bool = True
    y_log: bool = True
    bands: Sequence[ShadedBand] = ()
    x_ends: Point | None = None
    y_ends: Point | None = None
    floor: bool = False

    def draw(self, canvas: Canvas, box: Box) -> None:
        """Draw the panel into a box; values that an axis does not have are left out."""
        left, top, right, bottom = _inside(box)
        known = [p for s in self.series for p in s.points if self._has(p) and (p[1] > 0 or not self.y_log)]
        known += [(x, y) for b in self.bands for x, *ends in b.points for y in ends if self._has((x, y))]
        parts = _parts(right - left, _TICK[0]), _parts(bottom - top, _TICK[1])
        x_axis = _axis([x for x, _ in known], log=self.x_log, ends=self.x_ends, parts=parts[0])
        y_axis = _axis([y for _, y in known], log=self.y_log, ends=self.y_ends, parts=parts[1])

        def place(point: Point) -> Place:
            u, v = x_axis.share(point[0]), y_axis.share(point[1])
            return left + (right - left) * u, bottom + (top - bottom) * v

        _frame(canvas, (left, top, right, bottom), axes=self.axes, x_axis=x_axis, y_axis=y_axis, grid=True)
        entries = 0
        for band in self.bands:
            for part in _runs(band.points, lambda p: self._has(p[:2]) and self._has((p[0], p[2]))):
                outline = [*((x, low) for x, low, _ in part), *((x, high) for x, _, high in reversed(part))]
                canvas.area([place(p) for p in outline], band.color, opacity=0.5, name=band.name)
        for k, one in enumerate(self.series):
            color, v = one.color or COLORS[k % len(COLORS)], top + 10 + _LINE * entries
            entries += 1
            if one.dots:
                for u, w in [*(place(p) for p in one.points if self._has(p)), (right + 26, v)]:
                    canvas.dot((u, w), color, radius=5, hollow=True, name=one.name)
            else:
                for run in _runs(one.points, self._has):
                    canvas.line([place(p) for p in run], color, width=2, name=one.name)
                canvas.line([(right + 16, v), (right + 36, v)], color, width=3)
            canvas.text((right + 44, v), one.name, anchor="lm")
        for band in self.bands:
            v = top + 10 + _LINE * entries
            entries += 1
            canvas.rectangle((right + 16, v - 6, right + 36, v + 6), band.color)
            canvas.text((right + 44, v), band.name, anchor="lm")

    def _has(self, point: Sequence[float]) -> bool:
        x, y = point[:2]
        if (
            not (math.isfinite(x) and math.isfinite(y))
            or (self.x_log and x <= 0)
            or (self.y_log and y <= 0 and not self.floor)
        ):
            return False
        return self.x_ends is None or self.x_ends[0] <= x <= self.x_ends[1]


@dataclass(frozen=True, slots=True)
class Scale:
    """The colours of a raster's values along an axis, and what they are, with the unit."""

    title: str
    axis: Axis
    colors: Callable[[NDArray[np.float64]], NDArray[np.uint8]]


@dataclass(frozen=True, slots=True)
class Raster:
    """An image whose sides are values: of ``x`` from left to right, of ``y`` from bottom to top.

    pixels : (h, w, 3) uint8
    scale  : of its colours, or None
    legend : names and colours, if it has no scale
    square : whether units of x and y are equally long
    lines  : over the image
    """

    axes: Axes
    pixels: NDArray[np.uint8]
    x: Point
    y: Point
    scale: Scale | None = None
    legend: Sequence[tuple[str, Color]] = ()
    square: bool = False
    lines: Sequence[Series] = ()

    def draw(self, canvas: Canvas, box: Box) -> None:
        """Draw the raster into a box."""
        left, top, right, bottom = _inside(box)
        x_axis, y_axis = (_Turned(*ends) for ends in (self.x, self.y))
        if self.square:
            wide, tall = abs(self.x[1] - self.x[0]), abs(self.y[1] - self.y[0])
            side = min((right - left) / wide, (bottom - top) / tall)
            right, bottom = left + side * wide, top + side * tall

        def place(point: Point) -> Place:
            u, v = x_axis.share(point[0]), y_axis.share(point[1])
            return left + (right - left) * u, bottom + (top - bottom) * v

        canvas.image(self.pixels, (left, top, right, bottom), name=self.axes.title)
        _frame(canvas, (left, top, right, bottom), axes=self.axes, x_axis=x_axis, y_axis=y_axis, grid=False)
        v = top + 10.0
        if self.scale is not None:
            v = _draw_scale(canvas, self.scale, place=(right + 16, top), bottom=bottom) + 2 * _LINE
        for one in self.lines:
            color = one.color or COLORS[0]
            for run in _runs(one.points, lambda p: math.isfinite(p[0] + p[1])):
                canvas.line([place(p) for p in run], color, width=2, name=one.name)
            canvas.line([(right + 16, v), (right + 36, v)], color, width=3)
            canvas.text((right + 44, v), one.name, anchor="lm")
            v += _LINE
        for name, color in self.legend:
            _swatch(canvas, (right + 16, v - 6, right + 36, v + 6), color=color)
            canvas.text((right + 44, v), name, anchor="lm")
            v += _LINE


@dataclass(frozen=True, slots=True)
class _Turned:
    """A linear axis that may fall from its first to its last value."""

    first: float
    last: float

    def share(self, value: float) -> float:
        return (value - self.first) / (self.last - self.first)

    def ticks(self, parts: int) -> list[float]:
        return Axis(min(self.first, self.last), max(self.first, self.last)).ticks(parts)


def figure(
    parts: Sequence[Panel | Raster], *, columns: int = 2, size: tuple[int, int] = (760, 520)
) -> Canvas:
    """A picture of panels side by side, each with a legend."""
    rows, columns = -(-len(parts) // columns), min(columns, len(parts))
    canvas = Canvas(columns * size[0], rows * size[1])
    for k, part in enumerate(parts):
        left, top = (k % columns) * size[0], (k // columns) * size[1]
        part.draw(canvas, (left, top, left + size[0], top + size[1]))
    return canvas


def _inside(box: Box) -> Box:
    return box[0] + _LEFT, box[1] + _TOP, box[2] - _RIGHT, box[3] - _BOTTOM


def _parts(pixels: float, step: float) -> int:
    return max(round(pixels / step), 2)


def _axis(values: Sequence[float], *, log: bool, ends: Point | None, parts: int) -> Axis:
    if ends is not None:
        return Axis(*ends, log=log)
    return log_axis(values) if log else linear_axis(values, parts=parts)


def _frame(
    canvas: Canvas, inside: Box, *, axes: Axes, x_axis: Axis | _Turned, y_axis: Axis | _Turned, grid: bool
) -> None:
    """Draw titles, ticks with their values, and lines across at them or a border."""
    left, top, right, bottom = inside
    canvas.text((left, top - 52), axes.title, size=15)
    canvas.text(((left + right) / 2, bottom + 46), axes.x, anchor="ms")
    canvas.text((left - 62, top - 10), axes.y, anchor="ls")
    for value in x_axis.ticks(_parts(right - left, _TICK[0])):
        u = left + (right - left) * x_axis.share(value)
        canvas.line([(u, top if grid else bottom), (u, bottom if grid else bottom + 5)], GREY)
        canvas.text((u, bottom + 8), f"{value:g}", anchor="mt")
    for value in y_axis.ticks(_parts(bottom - top, _TICK[1])):
        v = bottom + (top - bottom) * y_axis.share(value)
        canvas.line([(left, v), (right if grid else left - 5, v)], GREY)
        canvas.text((left - 8, v), axes.y_text(value), anchor="rm")
    if not grid:
        canvas.line([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)], GREY)


def _swatch(canvas: Canvas, box: Box, *, color: Color) -> None:
    """Draw a colour of a legend with a border."""
    left, top, right, bottom = box
    canvas.rectangle(box, color)
    canvas.line([(left, top), (right, top), (right, bottom), (left, bottom), (left, top)], GREY)


def _draw_scale(canvas: Canvas, scale: Scale, *, place: Place, bottom: float) -> float:
    """Draw the colours of a scale with its ticks from (left, top) down; return where it ends."""
    left, top = place
    bottom = min(max(bottom, top + _SCALE[0]), top + _SCALE[1])
    title_room = 26
    axis = scale.axis
    values = (np.geomspace if axis.log else np.linspace)(axis.high, axis.low, 64)
    canvas.text((left, top), scale.title)
    canvas.image(scale.colors(values)[:, None, :], (left, top + title_room, left + 18, bottom))
    for value in axis.ticks():
        v = bottom + (top + title_room - bottom) * axis.share(value)
        canvas.line([(left + 18, v), (left + 23, v)], GREY)
        canvas.text((left + 28, v), f"{value:g}", anchor="lm")
    return bottom


def _runs(points: Sequence[P], known: Callable[[P], bool]) -> Iterator[list[P]]:
    """Longest runs of points that are known."""
    return (list(run) for fits, run in itertools.groupby(points, known) if fits)
