"""Charts show their values, and the same charts have the same bytes."""

import io
import math
import sys

import numpy as np
import pytest
from helpers.figures import images, lines
from PIL import Image

from geoscene.drawing.charts import (
    Axes,
    ChartPoint,
    Panel,
    Raster,
    Scale,
    Series,
    ShadedBand,
    Span,
    curves,
    encode,
    figure,
    scatter,
    spans,
)
from geoscene.drawing.report import metres
from geoscene.errors import MissingExtraError

RED = (200, 60, 40)
TEXTS = Axes("a < b & c", "x", "y")
SIZE = (700, 400)


@pytest.mark.full
def test_gaps_break_lines_and_counts_of_zero_lie_at_the_end_of_a_logarithmic_axis():
    y = np.array([100.0, 0.0, 1.0, math.nan, 10.0, 100.0])
    band = ShadedBand("b", np.arange(6), y, y + 1)
    svg = encode(figure([Panel(TEXTS, [Series("a", np.arange(6), y)], bands=[band])], size=SIZE), ".svg")
    first, second = lines(svg, "a")
    assert len(first) == 3
    assert len(second) == 2
    assert np.allclose(first[0, 1], second[1, 1])
    assert first[0, 1] < first[2, 1] < first[1, 1], "up is larger"
    assert b"a &lt; b &amp; c" in svg
    drawn = figure([Panel(TEXTS, [Series("a", np.arange(6), y)], log=True)], size=SIZE)
    first, _ = lines(encode(drawn, ".svg"), "a")
    bottom = (1 - drawn.axes[0].get_position().y0) * SIZE[1] * 72 / 100
    assert first[0, 1] < first[2, 1] < first[1, 1]
    assert math.isclose(first[1, 1], bottom, abs_tol=0.5)


@pytest.mark.full
def test_the_same_figure_has_the_same_bytes_and_names_no_date():
    def drawn(suffix):
        return encode(figure([Panel(TEXTS, [Series("a", [0, 1], [0, 1], dots=True)])], size=SIZE), suffix)

    assert drawn(".png") == drawn(".png")
    assert drawn(".svg") == drawn(".svg")
    assert b"dc:date" not in drawn(".svg")
    assert Image.open(io.BytesIO(drawn(".png"))).size == SIZE


@pytest.mark.full
def test_a_raster_has_north_up_and_square_cells():
    image = np.full((2, 4, 3), 255, np.uint8)
    image[0, 3] = RED  # the north-eastern cell
    raster = Raster(TEXTS, image, (0, 40), (0, 20), square=True, lines=[Series("a", [0, 40], [0, 20])])
    drawn = figure([raster], size=SIZE)
    (((left, bottom), (right, top)),) = lines(encode(drawn, ".svg"), "a")
    assert math.isclose((right - left) / 40, (bottom - top) / 20, rel_tol=1e-3)
    pixels = np.asarray(Image.open(io.BytesIO(encode(drawn))).convert("RGB"))
    down, across = np.nonzero((pixels == RED).all(axis=2))
    side = (right - left) / 4 * 100 / 72  # SVG has points of 1/72 inch
    assert (across > right * 100 / 72 - side - 2).mean() > 0.9
    assert (down < top * 100 / 72 + side + 2).mean() > 0.9
    assert len(down) > 0.8 * side**2


def test_values_of_a_scale_have_its_colours_and_none_is_white():
    values = np.array([[1.0, 100.0, math.nan]])
    scale = Scale("s", 1.0, 100.0, log=True)
    svg = encode(figure([Raster(TEXTS, values, (0, 3), (0, 1), scale=scale)], size=SIZE), ".svg")
    (image,) = images(svg)
    assert image[0, :, :3].tolist()[:2] == [[68, 1, 84], [253, 231, 36]]
    assert image[0, 2, 3] == 0


def test_figures_have_fitting_units():
    assert [metres(v) for v in (0, 1e-12, 2e-6, 0.25)] == ["0", "below 1 nm", "2 µm", "25 cm"]


@pytest.mark.parametrize(
    "points",
    [
        [ChartPoint("a", 2.0, 0.1, True, (1.0, 30.0), (0.0, 0.4))],
        [ChartPoint(str(k), 1 + 0.001 * k, 0.1, k > 3) for k in range(9)],
        [ChartPoint("a", 2.0, 0.0, True)],
    ],
)
def test_charts_of_reports_are_whole_pictures(points):
    for png in (
        scatter(points, Axes("title", "x", "y", metres)),
        curves({"a": [(0, 0), (0.1, 0.8), (1, 1)], "b": []}, TEXTS, mark=0.05),
        spans([Span("a", 0.4, (0.2, 0.5), (0.3, 0.3)), Span("b", math.nan, (math.nan,) * 2)], title="t"),
    ):
        picture = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))
        edge = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
        assert (edge == 255).all(), "nothing is cut off"
        assert (picture == RED).all(axis=2).any()


def test_shares_of_nothing_are_an_empty_chart():
    assert Image.open(io.BytesIO(spans([], title="t"))).width == 1000


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.style", None)
    with pytest.raises(MissingExtraError, match=r"geoscene\[plots\]"):
        figure([Panel(TEXTS, [])], size=SIZE)
