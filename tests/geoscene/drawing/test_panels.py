"""Axes hold their values, and PNG and SVG show the same marks where the axes put them."""

import io
import math
import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from geoscene.drawing.axes import Axis, linear_axis, log_axis
from geoscene.drawing.canvas import Canvas
from geoscene.drawing.charts import Axes
from geoscene.drawing.panels import Panel, Raster, Series, ShadedBand, figure

NUMBERS = st.floats(-1e6, 1e6).filter(lambda v: v == 0 or abs(v) > 1e-6)
RED = (200, 60, 40)
TEXTS = Axes("title", "x", "y", str)


def pixels(canvas):
    return np.asarray(Image.open(io.BytesIO(canvas.png())))


def polylines(canvas, name):
    """Corners (n, 2) in pixels of the lines of a series in the SVG."""
    found = re.findall(rf'<polyline data-name="{name}" points="([^"]+)"', canvas.svg().decode())
    return [np.array([pair.split(",") for pair in line.split()], float) for line in found]


@given(st.lists(NUMBERS, max_size=20), st.integers(2, 12))
def test_a_linear_axis_holds_its_values_and_zero_between_ticks(values, parts):
    axis = linear_axis(values, parts=parts)
    span = axis.high - axis.low
    assert all(axis.low - 1e-9 * span <= v <= axis.high + 1e-9 * span for v in [0.0, *values])
    ticks = axis.ticks()
    assert math.isclose(ticks[0], axis.low, abs_tol=1e-9 * span)
    assert math.isclose(ticks[-1], axis.high, abs_tol=1e-9 * span)
    assert 2 <= len(ticks) <= parts + 3
    assert np.allclose(np.diff(ticks), axis.step)


@given(st.lists(st.floats(1e-9, 1e9), min_size=1, max_size=20))
def test_a_logarithmic_axis_holds_its_values(values):
    axis = log_axis(values)
    assert axis.low <= min(values) * (1 + 1e-9)
    assert axis.high >= max(values) * (1 - 1e-9)
    assert all(axis.low * (1 - 1e-9) <= tick <= axis.high * (1 + 1e-9) for tick in axis.ticks())


@given(st.floats(0, 1), st.booleans())
def test_a_value_lies_at_its_share_of_an_axis(share, log):
    axis = Axis(2.0, 2000.0, log)
    value = 2.0 * 1000.0**share if log else 2.0 + 1998.0 * share
    assert math.isclose(axis.share(value), share, abs_tol=1e-9)


def test_a_line_is_at_the_same_pixels_in_png_and_svg():
    canvas = figure([Panel(TEXTS, [Series("a", [(0, 0), (5, 5), (10, 0)])], x_log=False, y_log=False)])
    (corners,) = polylines(canvas, "a")
    image = pixels(canvas)
    for u, v in corners:
        around = image[round(v) - 2 : round(v) + 3, round(u) - 2 : round(u) + 3].reshape(-1, 3)
        assert (np.abs(around.astype(int) - RED).max(axis=1) < 40).any()
    assert corners[1, 1] < corners[0, 1] == corners[2, 1], "up is larger"


def test_gaps_break_lines_and_bands():
    gap = math.nan
    points = [(0, 1), (1, 2), (2, gap), (3, 2), (4, 1)]
    band = ShadedBand("b", [(x, -y, y) for x, y in points])
    canvas = figure([Panel(TEXTS, [Series("a", points)], x_log=False, y_log=False, bands=[band])])
    assert [len(line) for line in polylines(canvas, "a")] == [2, 2]
    assert canvas.svg().decode().count('<polygon data-name="b"') == 2


def test_empty_bins_of_a_histogram_lie_on_the_floor_of_a_logarithmic_axis():
    points = [(0, 100), (1, 0), (2, 1)]
    (shown,) = polylines(figure([Panel(TEXTS, [Series("a", points)], x_log=False, floor=True)]), "a")
    assert shown[1, 1] == shown[2, 1] > shown[0, 1], "1 is the lower end of the axis"
    assert [
        len(line) for line in polylines(figure([Panel(TEXTS, [Series("a", points)], x_log=False)]), "a")
    ] == []


def test_a_raster_has_north_up_and_square_cells():
    image = np.full((2, 4, 3), 255, np.uint8)
    image[0, 3] = RED  # the north-eastern cell
    canvas = figure(
        [Raster(TEXTS, image, (0, 40), (0, 20), square=True, lines=[Series("a", [(0, 0), (40, 20)])])]
    )
    down, across = np.nonzero((pixels(canvas) == RED).all(axis=2))
    (line,) = polylines(canvas, "a")
    (left, bottom), (right, top) = line
    assert math.isclose((right - left) / 40, (bottom - top) / 20, rel_tol=1e-3)
    cell = (
        (across > right - 0.2 * (right - left))
        & (across < right)
        & (down > top)
        & (down < (top + bottom) / 2)
    )
    assert cell.sum() > 0.5 * 0.2 * (right - left) * (bottom - top) / 2


def test_texts_of_an_svg_are_escaped():
    canvas = Canvas(100, 100)
    canvas.text((5, 5), "a < b & c")
    canvas.line([(0, 0), (1, 1)], RED, name='x"<y')
    text = canvas.svg().decode()
    assert "a &lt; b &amp; c" in text
    assert 'data-name="x&quot;&lt;y"' in text
