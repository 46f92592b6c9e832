"""Figures as people read them, and scatter plots of points with intervals."""

import io

import numpy as np
from PIL import Image, ImageFont

from geoscene.drawing.canvas import drawable
from geoscene.drawing.charts import Axes, ChartPoint, scatter
from geoscene.drawing.figures import metres, share

RED = (200, 60, 40)


def red_box(*points):
    """Left, top, right and bottom of what is red in a plot of points, below the legend."""
    png = scatter(points, Axes("title", "x", "y", metres))
    down, across = np.nonzero((np.asarray(Image.open(io.BytesIO(png))) == RED).all(axis=2))
    plotted = down > 60
    across, down = across[plotted], down[plotted]
    return across.min(), down.min(), across.max(), down.max()


def test_figures_have_fitting_units():
    assert [metres(v) for v in (0, 1e-12, 2e-6, 0.25)] == ["0", "below 1 nm", "2 µm", "25 cm"]
    assert [share(v) for v in (0, 0.1, -0.0021, 1.0)] == ["0", "10 %", "-0.21 %", "100 %"]


def test_the_font_of_pictures_has_every_letter_of_lengths():
    font = ImageFont.load_default(size=15)
    unknown = bytes(font.getmask("\uffff"))
    for letter in set("".join(metres(v) for v in (0, 1e-12, 2e-9, 2e-6, 2e-3, 0.25, 3.0))) - {" "}:
        assert bytes(font.getmask(drawable(letter))) != unknown, letter


def test_intervals_are_lines_within_the_axes():
    plain = red_box(ChartPoint("a", 2.0, 0.1, True))
    wide = red_box(ChartPoint("a", 2.0, 0.1, True, (1.0, 30.0), (0.0, 0.4)))
    assert (plain[2] - plain[0], plain[3] - plain[1]) == (8, 8)
    assert wide[2] - wide[0] > 500
    assert 90 <= wide[0] < wide[2] <= 970
    assert wide[3] == 630  # an end of 0 lies on the lower axis
