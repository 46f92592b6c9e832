"""Charts as PNG and SVG by matplotlib: panels of lines, rasters, scatter plots, curves and shares."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.errors import need

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Plot
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

SUFFIXES: Mapping[str, dict[str, Any]] = {".png": {"Software": None}, ".svg": {"Date": None, "Creator": None}}
"""Of files of figures, and the metadata that they are without, so that the same figure has the same bytes."""

COLORS = (
    *("#c83c28", "#3c6eb4", "#46965a", "#965aaa", "#dc9628", "#5a5a5a"),
    *("#28a0aa", "#be6e8c", "#826e3c", "#6e8cdc", "#a0be3c", "#143c5a"),
)
"""Of lines, by rank."""

_GREY, _INK, _BAND, _PUBLISHED = "#cdd0d6", "#1e2026", "#96b4dc", "#fae0a0"
_STYLE: dict[str, Any] = {
    "figure.dpi": 100,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "none",
    "svg.hashsalt": "geoscene",
    "image.interpolation": "none",
    "image.composite_image": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 11,
    "axes.edgecolor": _GREY,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.xmargin": 0,
    "grid.color": _GREY,
    "legend.frameon": False,
    "font.size": 10,
}
_BESIDE: dict[str, Any] = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.02)}
_DOTS: dict[str, Any] = {"marker": "o", "linestyle": "", "markerfacecolor": "white", "clip_on": False}
_LEGEND = (
    (True, COLORS[0], "no other setting is both cheaper and more exact"),
    (False, COLORS[1], "another setting is cheaper and at least as exact"),
)


@dataclass(frozen=True, slots=True)
class Axes:
    """Titles of a chart and its axes, and perhaps the texts of values of y."""

    title: str
    x: str
    y: str
    y_text: Callable[[float], str] | None = None


@dataclass(frozen=True, slots=True)
class Series:
    """A named line through points (n,), or dots if these are single values such as published ones.

    A line is broken at points that are not finite. ``color`` is by its rank by default.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    _: KW_ONLY
    dots: bool = False
    color: str | None = None


@dataclass(frozen=True, slots=True)
class ShadedBand:
    """A named area between two values of y at each x, all (n,); broken where not finite."""

    name: str
    x: ArrayLike
    low: ArrayLike
    high: ArrayLike


@dataclass(frozen=True, slots=True)
class Panel:
    """Series on common axes; that of y is linear with 0 on it, or logarithmic with 0 at its lower end."""

    axes: Axes
    series: Sequence[Series]
    log: bool = False
    bands: Sequence[ShadedBand] = ()

    def draw(self, plot: Plot) -> None:
        """Draw the panel and its legend."""
        for band in self.bands:
            area: dict[str, Any] = {"color": _BAND, "alpha": 0.5, "linewidth": 0}
            plot.fill_between(band.x, band.low, band.high, label=band.name, gid=band.name, **area)
        least = -np.inf
        if self.log:
            ends = _ends_around([v for one in self.series for v in np.asarray(one.y)])
            plot.set(yscale="log", ylim=ends)
            least = ends[0]
        else:
            plot.axhline(0, color=_GREY)
        for k, one in enumerate(self.series):
            _draw_series(plot, replace(one, y=np.maximum(one.y, least)), color=COLORS[k % len(COLORS)])
        _write_titles(plot, self.axes)


@dataclass(frozen=True, slots=True)
class Scale:
    """The colours of a raster's values, from violet to yellow or, ``turned``, from yellow to violet."""

    title: str
    low: float
    high: float
    log: bool = False
    turned: bool = False


@dataclass(frozen=True, slots=True)
class Raster:
    """An image whose sides are values: of ``x`` from left to right, of ``y`` from bottom to top.

    pixels : (h, w, 3) uint8, or values (h, w) of a scale, NaN for none
    legend : names and colours, if it has no scale
    square : whether units of x and y are equally long
    lines  : over the image
    """

    axes: Axes
    pixels: NDArray[Any]
    x: tuple[float, float]
    y: tuple[float, float]
    scale: Scale | None = None
    legend: Sequence[tuple[str, str]] = ()
    square: bool = False
    lines: Sequence[Series] = ()

    def draw(self, plot: Plot) -> None:
        """Draw the raster, its scale and its legend."""
        options: dict[str, Any] = {"extent": (*self.x, *self.y), "aspect": "equal" if self.square else "auto"}
        if (scale := self.scale) is not None:
            options |= {"norm": "log" if scale.log else "linear", "vmin": scale.low, "vmax": scale.high}
            options |= {"cmap": "viridis_r" if scale.turned else "viridis"}
        image = plot.imshow(self.pixels, gid=self.axes.title, **options)
        plot.grid(visible=False)
        if scale is not None:
            bar = plot.figure.colorbar(image, ax=plot, label=scale.title, shrink=0.9, aspect=12, format="%g")
            if scale.log:
                _mark_decades(bar.ax.yaxis)
        for k, one in enumerate(self.lines):
            _draw_series(plot, one, color=COLORS[k % len(COLORS)])
        for name, color in self.legend:
            plot.plot([], [], "s", color=color, markeredgecolor=_GREY, label=name)
        _write_titles(plot, self.axes)


def figure(parts: Sequence[Panel | Raster], *, size: tuple[int, int]) -> Figure:
    """A figure of panels one below the other, each ``size`` (width, height) pixels."""
    with _styled():
        drawn = _blank(size[0], size[1] * len(parts))
        for part, plot in zip(parts, drawn.subplots(len(parts), squeeze=False).flat, strict=True):
            part.draw(plot)
    return drawn


def encode(drawn: Figure, suffix: str = ".png") -> bytes:
    """A figure as a file with a suffix of `SUFFIXES`. In an SVG the ``id`` of a mark's group is its name."""
    file = io.BytesIO()
    with _styled():
        drawn.savefig(file, format=suffix[1:], metadata=SUFFIXES[suffix])
    return file.getvalue()


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
    def x_ends(self) -> tuple[float, float]:
        """Ends of the interval of x, which holds x."""
        values = (self.x, *(self.x_interval or ()))
        return min(values), max(values)

    @property
    def y_ends(self) -> tuple[float, float]:
        """Ends of the interval of y, which holds y."""
        values = (self.y, *(self.y_interval or ()))
        return min(values), max(values)


def scatter(points: Sequence[ChartPoint], axes: Axes) -> bytes:
    """A PNG of points with a legend, both axes logarithmic.

    Values of y of 0 are drawn at the lower end, marked ``0``. Points whose names have no room are counted in
    the corner.
    """
    with _styled():
        drawn = _blank(1100, 700)
        plot = drawn.subplots()
        plot.set(xscale="log", xlim=_ends_around([v for p in points for v in p.x_ends]))
        least, most = _ends_around([v for p in points for v in (p.y, *p.y_ends)])
        if any(p.y_ends[0] <= 0 for p in points):
            decade = 10 ** math.floor(math.log10(least))
            plot.set_yscale("symlog", linthresh=decade, linscale=0.3)
            plot.set_ylim(-decade / 2, most)
        else:
            plot.set(yscale="log", ylim=(least, most))
        for best, color, words in _LEGEND:
            some = sorted((p for p in points if p.best == best), key=lambda p: p.x)
            x, y = [p.x for p in some], [p.y for p in some]
            plot.plot(x, y, "o-" if best else "o", color=color, label=words)
            plot.hlines(y, *np.reshape([p.x_ends for p in some], (-1, 2)).T, color=color, linewidth=1)
            plot.vlines(x, *np.reshape([p.y_ends for p in some], (-1, 2)).T, color=color, linewidth=1)
        for axis in (plot.xaxis, plot.yaxis):
            _mark_decades(axis)
        _write_titles(plot, axes)
        plot.set_title(axes.title, pad=26)
        plot.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
        _write_names(drawn, plot, points=sorted(points, key=lambda p: (not p.best, p.x)))
    return encode(drawn)


def curves(lines: Mapping[str, Sequence[tuple[float, float]]], axes: Axes, *, mark: float) -> bytes:
    """A PNG of named lines of shares, both axes linear from 0 to 1, with a legend and the diagonal.

    mark : value of x at which a line stands
    """
    series = [Series(name, *np.reshape(points, (-1, 2)).T) for name, points in lines.items()]
    drawn = figure([Panel(axes, series)], size=(760, 560))
    plot = drawn.axes[0]
    plot.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    plot.axline((0, 0), slope=1, color=_GREY)
    plot.axvline(mark, color=_INK, linewidth=1)
    return encode(drawn)


@dataclass(frozen=True, slots=True)
class Span:
    """A named share with its interval, and the bounds of what others published of it."""

    name: str
    share: float
    interval: tuple[float, float]
    published: tuple[float, float] | None = None


def spans(rows: Sequence[Span], *, title: str) -> bytes:
    """A PNG of shares from 0 to 1 with their intervals, one below the other, published bounds as bars."""
    with _styled():
        drawn = _blank(1000, 120 + 26 * len(rows))
        plot = drawn.subplots()
        plot.barh([0], [0], color=_PUBLISHED, label="published")
        for k, row in enumerate(rows):
            if row.published is not None:
                low, high = row.published
                plot.barh(k, high - low, 0.7, low, color=_PUBLISHED, edgecolor=_PUBLISHED, linewidth=4)
            if math.isfinite(row.share):
                plot.plot(row.interval, (k, k), color=COLORS[0])
                plot.plot(row.share, k, "o", color=COLORS[0])
        plot.set(xlim=(-0.01, 1.01), ylim=(max(len(rows), 1) - 0.5, -0.5), title=title)
        plot.set_yticks(range(len(rows)), [row.name for row in rows])
        plot.xaxis.set_major_formatter(lambda value, _: f"{100 * value:g} %")
        plot.grid(visible=False, axis="y")
        plot.legend(**_BESIDE)
    return encode(drawn)


def _styled() -> AbstractContextManager[None]:
    """A context in which figures look as here, whatever the user's settings are."""
    context: AbstractContextManager[None] = need("matplotlib.style", "plots").context(["default", _STYLE])
    return context


def _blank(width: int, height: int) -> Figure:
    drawn: Figure = need("matplotlib.figure", "plots").Figure(figsize=(width / 100, height / 100))
    return drawn


def _mark_decades(axis: Axis) -> None:
    """Mark 1, 2 and 5 times powers of ten on a logarithmic axis."""
    locator: Any = axis.get_major_locator()
    locator.set_params(subs=(1, 2, 5))
    axis.set_major_formatter("{x:g}")
    axis.minorticks_off()


def _ends_around(values: Sequence[float]) -> tuple[float, float]:
    """Ends of a logarithmic axis around the positive ones of some values."""
    known = [v for v in values if v > 0] or [1.0]
    return 0.8 * min(known), 1.25 * max(known)


def _draw_series(plot: Plot, one: Series, *, color: str) -> None:
    kind: dict[str, Any] = (
        {"marker": "o", "linestyle": "", "markerfacecolor": "white", "clip_on": False} if one.dots else {}
    )
    plot.plot(one.x, one.y, color=one.color or color, label=one.name, gid=one.name, **kind)


def _write_titles(plot: Plot, axes: Axes) -> None:
    """Write the titles, the values of y, and a legend beside the axes if something has a name."""
    plot.set(title=axes.title, xlabel=axes.x, ylabel=axes.y)
    if (text := axes.y_text) is not None:
        plot.yaxis.set_major_formatter(lambda value, _: text(value))
    if plot.get_legend_handles_labels()[0]:
        plot.legend(**_BESIDE)


def _write_names(drawn: Figure, plot: Plot, *, points: Sequence[ChartPoint]) -> None:
    """Write the names of points that have room beside them, and the number of the others."""
    drawn.draw_without_rendering()
    frame = plot.get_window_extent()
    taken: list[Bbox] = []
    for point in points:
        for side, down in (("left", "bottom"), ("left", "top"), ("right", "top")):
            shift = (6 if side == "left" else -6, 3 if down == "bottom" else -3)
            text = plot.annotate(
                point.name, (point.x, point.y), shift, textcoords="offset points", ha=side, va=down
            )
            box = text.get_window_extent()
            if frame.containsx(box.x0) and frame.containsx(box.x1) and not box.count_overlaps(taken):
                taken.append(box)
                break
            text.remove()
    if unnamed := len(points) - len(taken):
        words = f"{unnamed} without a name, see the table"
        plot.text(1, 0, words, transform=plot.transAxes, ha="right", va="bottom")
