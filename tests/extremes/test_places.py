"""Places at the extremes: the table's cases, and round trips from anywhere on Earth."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.geometry.frames import Frame, utm_crs
from geoscene.options import BuildOptions
from geoscene.pipeline.build import build
from geoscene.sources import read_osm
from lidar.options.drive import DriveOptions
from lidar.simulation.plan import plan_drive
from lidar.tools.selftest.places import CASES, write_elevation, write_hamlet
from lidar.tools.selftest.run import outcome

ARITHMETIC = 1000
"""Samples from which on a case only computes, and takes seconds at most."""


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, id=case.name, marks=[pytest.mark.gate] if case.quick >= ARITHMETIC else [])
        for case in CASES
    ],
)
def test_places_stay_within_the_bound(case):
    done = outcome(case, case.quick)
    assert done.error == ""
    assert done.measured <= case.bound


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-180, 180), st.floats(-90, 90), st.sampled_from(["local", "utm"]),
    st.floats(-5e4, 5e4), st.floats(-5e4, 5e4),
)  # fmt: skip
def test_points_anywhere_return_to_their_place(lon, lat, crs, x, y):
    frame = Frame.at(lon, lat, crs=crs)
    assert np.hypot(*(np.array(frame.from_geographic(*frame.to_geographic(x, y))) - [x, y])) < 1e-6


@settings(max_examples=100, deadline=None)
@given(st.floats(-180, 180), st.floats(-90, 90))
def test_a_turn_of_longitude_does_not_change_the_zone(lon, lat):
    assert utm_crs(lon, lat) == utm_crs(lon + 360, lat)


@pytest.mark.parametrize(("height", "told"), [(5000.0, ["height"]), (300.0, [])])
def test_a_drive_tells_the_error_of_lengths_at_its_height(height, told, tmp_path):
    frame = Frame.at(-67.0, -18.1)
    write_hamlet(frame, tmp_path / "map.osm", reach=150.0)
    write_elevation(frame, tmp_path / "dem.tif", height=height)
    options = BuildOptions(only=("roads",), dem=(str(tmp_path / "dem.tif"),))
    scene = build(read_osm(tmp_path / "map.osm"), tmp_path / "scene", options=options)
    limits = plan_drive(scene, DriveOptions(route="random", duration=2.0)).manifest()["limits"]
    assert [limit["name"] for limit in limits] == told
    assert [limit["name"] for limit in scene.manifest["limits"]] == told
