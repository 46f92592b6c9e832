"""Roofs are recovered from noisy points with chimneys on them, in any position."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.clouds.roofs import fit_roof


def house(shape, *, long, wide, eaves, rise, turn, noise, seed, chimneys=0.06):
    """A footprint and points (n, 3) of a roof by the plane equations of its shape."""
    rng = np.random.default_rng(seed)
    u, v = rng.uniform(-long / 2, long / 2, 800), rng.uniform(-wide / 2, wide / 2, 800)
    side = 1 - np.abs(v) / (wide / 2)
    end = (long / 2 - np.abs(u)) / (wide / 2)  # 1 at half a width from the end
    share = {
        "flat": np.zeros_like(u),
        "gabled": side,
        "hipped": np.minimum(side, end),
        "skillion": 0.5 + v / wide,
        "pyramidal": np.minimum(side, 1 - np.abs(u) / (long / 2)),
    }[shape]
    z = eaves + rise * share + rng.normal(0, noise, len(u))
    z[rng.random(len(u)) < chimneys] += 1.2
    c, s = np.cos(turn), np.sin(turn)
    x, y = 500 + c * u - s * v, -300 + s * u + c * v
    corners = np.array([[-long, -wide], [long, -wide], [long, wide], [-long, wide]]) / 2
    footprint = shapely.Polygon(corners @ np.array([[c, s], [-s, c]]) + (500, -300))
    return footprint, np.column_stack([x, y, z])


FEW = settings(max_examples=6, deadline=None)


@pytest.mark.full
@FEW
@given(
    st.sampled_from(["flat", "gabled", "hipped", "skillion", "pyramidal"]),
    st.floats(6, 14),
    st.floats(1.3, 2.2),
    st.floats(2, 4),
    st.floats(0, 3.1),
    st.floats(0.0, 0.05),
    st.integers(0, 99),
)
def test_eaves_ridge_and_shape_are_recovered(shape, wide, ratio, rise, turn, noise, seed):
    polygon, xyz = house(
        shape, long=wide * ratio, wide=wide, eaves=6.0, rise=rise, turn=turn, noise=noise, seed=seed
    )
    roof = fit_roof(polygon, xyz, seed="way/1")
    assert roof is not None
    assert roof.shape == shape
    assert roof.top == pytest.approx(6.0 + (rise if shape != "flat" else 0), abs=0.1)
    assert roof.height == pytest.approx(rise if shape != "flat" else 0, abs=0.15)
    assert roof.sigma < 0.15


@pytest.mark.full
@FEW
@given(st.floats(0, 6.28), st.integers(0, 50))
def test_a_skillion_slopes_to_the_side_that_was_measured(turn, seed):
    polygon, xyz = house("skillion", long=12, wide=8, eaves=5, rise=1.5, turn=turn, noise=0.02, seed=seed)
    roof = fit_roof(polygon, xyz, seed="way/1")
    downslope = turn - np.pi / 2  # v falls towards -v
    assert np.cos(roof.direction - downslope) > np.cos(np.radians(5))


def test_few_points_or_points_along_one_wall_give_no_roof():
    polygon, xyz = house("gabled", long=20, wide=10, eaves=6, rise=3, turn=0.0, noise=0.02, seed=1)
    assert fit_roof(polygon, xyz[:10], seed="way/1") is None
    along_wall = xyz[xyz[:, 1] < -304.2]
    assert len(along_wall) > 40
    assert fit_roof(polygon, along_wall, seed="way/1") is None


def test_a_plane_through_one_side_of_a_broken_roof_is_no_roof():
    """Two overlapping strips of a survey, one of them a metre too high: no shape explains both."""
    polygon, xyz = house("gabled", long=16, wide=9, eaves=6, rise=4.5, turn=0.3, noise=0.02, seed=4)
    rng = np.random.default_rng(0)
    xyz[rng.random(len(xyz)) < 0.5, 2] += 1.0
    roof = fit_roof(polygon, xyz, seed="way/1")
    assert roof is None or abs(roof.height - 4.5) < 1.1


def test_a_roof_of_two_levels_says_so():
    polygon, xyz = house("flat", long=20, wide=10, eaves=6, rise=0, turn=0.0, noise=0.02, seed=1, chimneys=0)
    xyz[xyz[:, 0] > 503, 2] += 4.0
    roof = fit_roof(polygon, xyz, seed="way/1")
    assert roof.shape == "flat"
    assert roof.top == pytest.approx(6.0, abs=0.05)
    assert roof.levels == pytest.approx((10.0,), abs=0.05)


def test_a_fit_depends_on_the_building_and_its_points_alone():
    polygon, xyz = house("hipped", long=16, wide=9, eaves=6, rise=3, turn=0.4, noise=0.04, seed=9)
    assert fit_roof(polygon, xyz, seed="way/5") == fit_roof(polygon, xyz, seed="way/5")
