"""Footprints at the extremes: the table's cases, and drawn rings of any kind."""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.buildings.roofs import RoofSpec, roof_shell
from lidar.tools.selftest.footprints import CASES, built, house
from lidar.tools.selftest.run import outcome

POINTS = st.tuples(st.floats(-50, 50), st.floats(-50, 50))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_footprints_stay_within_the_bound(case):
    done = outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound


@settings(max_examples=60, deadline=None)
@given(
    st.lists(POINTS, min_size=3, max_size=9),
    st.sampled_from(["flat", "gabled", "hipped", "pyramidal", "skillion", "dome"]),
    st.floats(0, 1e4),
)
def test_any_ring_becomes_a_solid_or_is_reported(corners, roof, height):
    _, verdict, lost = built([house(1, shapely.Polygon(corners), height=f"{height:.6f}", roof__shape=roof)])
    assert verdict.ok.all()
    assert lost == 0


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_crowd_of_rings_becomes_solids_or_is_reported(seed):
    rng = np.random.default_rng(seed)
    rings = rng.uniform(0, 30, (6, 4, 2)).round(int(rng.integers(0, 4)))
    _, verdict, lost = built([house(k + 1, shapely.Polygon(ring)) for k, ring in enumerate(rings)])
    assert verdict.ok.all()
    assert lost == 0


@pytest.mark.parametrize("roof", ["hipped", "gabled", "mansard"])
def test_a_roof_on_a_footprint_of_a_millimetre_is_flat_and_finite(roof):
    corners = [(317.6413, 1012.0132), (317.6413, 1052.3341), (317.6403, 1012.0142)]
    polygon = shapely.orient_polygons(shapely.Polygon(corners))
    shell, note = roof_shell(polygon, RoofSpec(roof, 0.0, 10.0, 4.0))
    assert np.isfinite(shell.corners).all()
    assert note == f"{roof} roof made flat"
