"""Rays at the extremes: the table's cases, and properties over drawn distances, places and shapes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.geometry.watertight import check_solids
from lidar.errors import InputError
from lidar.raycast import Caster
from lidar.tools.selftest.rays import CASES as RAYS
from lidar.tools.selftest.rays import ball, cuboid, prism_of_slivers, sheet
from lidar.tools.selftest.run import CASES, outcome


@pytest.mark.parametrize("case", RAYS, ids=lambda case: case.name)
def test_rays_stay_within_the_bound(case):
    done = outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound


@pytest.mark.parametrize(
    "mesh", [ball(2, radius=3.0), cuboid(np.zeros(3), np.ones(3)), prism_of_slivers(0.01, 1.0, count=7)]
)
def test_the_solids_of_the_cases_are_closed_and_face_outwards(mesh):
    vertices, faces = mesh
    found = check_solids(vertices[faces], np.zeros(len(faces), np.int64), n=1)
    assert found.closed_solid.all()


@settings(max_examples=50, deadline=None)
@given(st.floats(-3, 5), st.floats(0, 89.999), st.floats(0, 1e4), st.sampled_from([0.0, 5e5, 9.9e6]))
def test_the_range_to_a_plane_is_that_of_float64(exponent, incidence_deg, away, easting):
    distance, angle = 10.0**exponent, np.radians(incidence_deg)
    vertices, faces = sheet(np.array([0.0, 0, 1]), np.array([easting, 0, 0]), size=4e7)
    way = np.array([[np.sin(angle), 0, -np.cos(angle)]])
    start = np.array([easting, 0.0, distance * np.cos(angle)])
    found = Caster(vertices, faces, origin=[easting + away, 0, 0]).cast(start, way).range[0]
    assert abs(found - start[2] / np.cos(angle)) <= 1e-9 + 1e-12 * distance


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.one_of(st.floats(), st.just(0.0)), min_size=6, max_size=6),
)
def test_a_ray_is_cast_or_refused_with_its_number(values):
    caster = Caster(*sheet(np.array([0.0, 0, 1]), np.zeros(3), size=10.0))
    start, way = np.array(values[:3]), np.array([values[3:]])
    if np.isfinite(values).all() and way.any() and np.abs(values).max() < 1e40 and np.abs(way).max() > 1e-40:
        assert caster.cast(start, way).range[0] >= 0
    elif not np.isfinite(values).all() or not way.any():
        with pytest.raises(InputError, match="ray 0 of 1"):
            caster.cast(start, way)


def test_every_case_of_the_table_has_a_name_of_its_own():
    names = [(case.group, case.name) for case in CASES]
    assert len(set(names)) == len(names)
    assert all(0 < case.quick <= case.full for case in CASES)
