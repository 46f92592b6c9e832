"""Footprints with roofs at different heights are cut where the roof steps, and nowhere else."""

import numpy as np
import pytest
import shapely
from hypothesis import example, given, settings
from hypothesis import strategies as st

from geoscene.clouds.levels import split_bodies
from geoscene.clouds.roofs import block_of, fit_roof

FEW = settings(max_examples=8, deadline=None)


def turned(uv, turn):
    c, s = np.cos(turn), np.sin(turn)
    return uv @ np.array([[c, s], [-s, c]]) + (200.0, -80.0)


def terrace(*, cut, low, ridge, turn, seed, noise=0.03):
    """A house of 9 x 7 m with a gabled roof and a flat extension of 7 m depth behind it, from u = cut."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform((0, 0), (9 + cut, 7), (900, 2))
    u = uv[:, 0]
    gable = 6.0 + (ridge - 6.0) * (1 - np.abs(u - cut - 4.5) / 4.5)
    z = np.where(u < cut, low, gable) + rng.normal(0, noise, len(u))
    outline = shapely.Polygon(turned(np.array([(0, 0), (9 + cut, 0), (9 + cut, 7), (0, 7)], float), turn))
    return outline, np.column_stack([turned(uv, turn), z])


@pytest.mark.full
@FEW
@given(
    st.floats(3.0, 6.0),
    st.floats(2.5, 4.5),
    st.floats(8.0, 9.5),
    st.floats(0, 3.1),
    st.integers(0, 99),
)
def test_a_gabled_house_with_a_flat_extension_is_cut_between_them(cut, low, ridge, turn, seed):
    outline, xyz = terrace(cut=cut, low=low, ridge=ridge, turn=turn, seed=seed)
    house, extension = split_bodies(outline, xyz, inset=0.25, seed="way/1")
    assert (house.roof.shape, extension.roof.shape) == ("gabled", "flat")
    assert house.roof.top == pytest.approx(ridge, abs=0.15)
    assert extension.roof.top == pytest.approx(low, abs=0.05)
    assert shapely.area(extension.polygon) == pytest.approx(7 * cut, abs=7 * 0.5)
    assert shapely.area(shapely.union(house.polygon, extension.polygon)) == pytest.approx(outline.area)
    assert shapely.area(shapely.intersection(house.polygon, extension.polygon)) < 1e-6


def test_cuts_go_through_corners_of_the_footprint_near_them():
    rng = np.random.default_rng(3)
    outline = shapely.Polygon([(0, 0), (10, 0), (10, 8), (4, 8), (4, 6), (0, 6)])
    xy = rng.uniform((0, 0), (10, 8), (1200, 2))
    xy = xy[shapely.contains_xy(outline, *xy.T)]
    z = np.where(xy[:, 0] < 4.2, 3.0, 7.0)  # map and cloud differ by 0.2 m
    high, low = split_bodies(outline, np.column_stack([xy, z]), inset=0.25, seed="way/1")
    assert shapely.area(low.polygon) == pytest.approx(24.0)
    assert shapely.area(high.polygon) == pytest.approx(48.0)


@FEW
@given(st.floats(20, 55), st.floats(0, 3.1), st.integers(0, 99))
@example(44.0, 0.0, 0)
@example(55.0, 0.3, 1)
def test_a_single_roof_however_steep_is_not_cut(pitch, turn, seed):
    rng = np.random.default_rng(seed)
    uv = rng.uniform((0, 0), (12, 8), (900, 2))
    z = 5.0 + np.tan(np.radians(pitch)) * (4 - np.abs(uv[:, 1] - 4)) + rng.normal(0, 0.03, 900)
    outline = shapely.Polygon(turned(np.array([(0, 0), (12, 0), (12, 8), (0, 8)], float), turn))
    assert split_bodies(outline, np.column_stack([turned(uv, turn), z]), inset=0.25, seed="way/1") == ()


def test_points_without_a_roof_give_a_height_alone():
    rng = np.random.default_rng(1)
    outline = shapely.box(0, 0, 12, 10)
    xy = rng.uniform((0, 0), (12, 10), (800, 2))
    z = 8.0 + 3.0 * rng.random(800)  # a heap that no roof explains
    xyz = np.column_stack([xy, z])
    assert fit_roof(outline, xyz, seed="way/1") is None
    block = block_of(outline, xyz)
    assert block.shape == ""
    assert block.top == pytest.approx(8.0 + 3.0 * 0.7, abs=0.1)
    assert block_of(outline, xyz[xy[:, 0] < 3]) is None  # along one wall only
    assert block_of(outline, xyz[:10]) is None
