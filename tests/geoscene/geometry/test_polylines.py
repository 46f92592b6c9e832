"""Polylines: properties of random lines, and corner cases of cuts and offset lines."""

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from geoscene.geometry import polylines


@st.composite
def lines(draw):
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    steps = rng.normal(size=(draw(st.integers(1, 8)), 3)) * draw(st.sampled_from([0.1, 1.0, 1e3]))
    return np.cumsum(np.concatenate([[[0.0, 0.0, 0.0]], steps]), axis=0)


@given(lines(), st.floats(0, 1), st.floats(0, 1))
def test_cut_has_the_requested_length_and_ends_on_the_line(line, a, b):
    total = polylines.length(line)
    start, end = sorted((a * total, b * total))
    part = polylines.cut(line, start, end=end)
    assert polylines.length(part) == pytest.approx(end - start, abs=1e-9 * max(total, 1))
    np.testing.assert_allclose(part[[0, -1]], polylines.points_at(line, [start, end]), atol=1e-9)


@given(lines())
def test_points_at_vertex_stations_are_the_vertices(line):
    np.testing.assert_allclose(polylines.points_at(line, polylines.stations(line)), line, atol=1e-9)
    assert polylines.stations(line)[-1] == pytest.approx(polylines.length(line))


def test_cut_interpolates_heights():
    line = np.array([[0, 0, 0], [10, 0, 1], [10, 30, 4.0]])
    np.testing.assert_allclose(polylines.cut(line, 5.0, end=30.0), [[5, 0, 0.5], [10, 0, 1], [10, 20, 3]])


def test_cut_is_clamped_to_the_line_and_respects_least_length_and_gap():
    line = np.array([[0.0, 0], [10, 0], [20, 0]])
    np.testing.assert_allclose(polylines.cut(line, -5.0, end=99.0), line)
    np.testing.assert_allclose(polylines.cut(line, 3.0, end=1.0, least=0.5), [[3, 0], [3.5, 0]])
    np.testing.assert_allclose(polylines.cut(line, 9.99, end=15.0, gap=0.1), [[9.99, 0], [15, 0]])


@pytest.mark.parametrize("moved", [polylines.parallel, polylines.offset_curve])
def test_positive_offsets_are_on_the_left_with_mitred_corners(moved):
    line = np.array([[0, 0, 1], [10, 0, 2], [10, 10, 3.0]])
    np.testing.assert_allclose(moved(line, 2.0), [[0, 2, 1], [8, 2, 1.8], [8, 10, 3]], atol=0.21)
    np.testing.assert_allclose(moved(line, 2.0)[:, :2], [[0, 2], [8, 2], [8, 10]], atol=1e-9)


def test_end_headings_span_short_segments():
    line = np.array([[0, 0], [0, 0.1], [10, 0], [20, 0], [20, 10.0]])
    first, last = polylines.end_headings(line, reach=5.0)
    assert (first, last) == (0.0, np.pi / 2)


def test_heads_of_many_lines_are_those_cut_one_by_one():
    rng = np.random.default_rng(5)
    lines = [rng.uniform(0, 30, (n, 2)) for n in (2, 3, 7, 12)] + [np.array([[0, 0], [0, 0], [3, 4.0]])]
    for end in (0.5, 12.0, 1e3):
        found = polylines.heads(np.array([shapely.LineString(xy) for xy in lines]), np.full(len(lines), end))
        expected = [shapely.LineString(polylines.cut(xy, 0.0, end=end)) for xy in lines]
        assert shapely.hausdorff_distance(found, expected).max() < 1e-9
        assert np.allclose(shapely.length(found), shapely.length(expected))


@given(lines())
def test_parts_are_those_cut_one_by_one(line):
    cuts = np.linspace(0.0, polylines.length(line), 4)
    found = polylines.parts(line[:, :2], cuts)
    for part, start, end in zip(found, cuts[:-1], cuts[1:], strict=True):
        expected = polylines.cut(line, start, end=end)[:, :2]
        assert np.array_equal(shapely.get_coordinates(part), expected)


@pytest.mark.parametrize("turn", [0.0, 0.02, np.pi / 2])
@pytest.mark.parametrize("offset", [1.75, -3.5])
def test_an_offset_line_keeps_the_heights_of_vertices_on_straights(turn, offset):
    along = np.array([0.0, 40, 90, 100, 110, 160, 200])
    height = np.array([0.0, 0, 5, 5.5, 5, 0, 0])
    line = np.column_stack([along * np.cos(turn), along * np.sin(turn), height])
    moved = polylines.offset_curve(line, offset)
    at = np.linspace(0.0, 200.0, 401)
    found = np.interp(at, moved[:, :2] @ [np.cos(turn), np.sin(turn)], moved[:, 2])
    np.testing.assert_allclose(found, np.interp(at, along, height), atol=2e-3)
