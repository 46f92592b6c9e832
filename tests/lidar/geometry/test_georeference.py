"""Georeferencing of scene points, checked against independent transformations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Geod

from geoscene.errors import FrameError
from geoscene.geometry.frames import Frame, utm_crs
from lidar.geometry.georeference import AFFINE_LIMIT, Georeference, export_crs

# Published-formula anchors (transverse Mercator of WGS 84): E, N, point scale, convergence in degrees.
ANCHORS = {
    "Norfolk": (36.8853, -76.3059, 383629.0124, 4082944.5213, 0.99976683, -0.783909),
    "Berlin": (52.516275, 13.377704, 389918.0416, 5819699.1324, 0.99974875, -1.287463),
    "Quito": (-0.180653, -78.467838, 781857.2256, 9980012.7675, 1.00058357, -0.007989),
    "Sydney": (-33.856784, 151.215297, 334900.2613, 6252290.5224, 0.99993603, 0.994517),
}
places = st.tuples(st.floats(-179.9, 179.9), st.floats(-79, 83))


@pytest.mark.parametrize("place", ANCHORS)
def test_utm_scale_and_convergence_of_known_places(place):
    lat, lon, east, north, scale, convergence = ANCHORS[place]
    frame = Frame.at(lon, lat, crs="utm")
    found = frame.to_projected(*frame.from_geographic(lon, lat))
    np.testing.assert_allclose(found, (east, north), atol=1e-3)
    assert frame.scale(lon, lat) == pytest.approx(scale, abs=2e-8)
    assert np.degrees(frame.convergence(lon, lat)) == pytest.approx(convergence, abs=1e-6)


@settings(deadline=None, max_examples=15)
@given(places, st.floats(-5000, 5000), st.floats(-5000, 5000))
def test_the_local_frame_has_scale_one(place, x, y):
    frame = Frame.at(*place)
    lon0, lat0 = frame.to_geographic(0, 0)
    lon, lat = frame.to_geographic(x, y)
    distance = Geod(ellps="WGS84").inv(lon0, lat0, lon, lat)[2]
    assert distance == pytest.approx(np.hypot(x, y), rel=1e-6, abs=1e-4)


@settings(deadline=None, max_examples=15)
@given(places, st.floats(-20000, 20000), st.floats(-20000, 20000), st.sampled_from(["local", "utm"]))
def test_the_inverse_projection_returns_the_same_point(place, x, y, crs):
    frame = Frame.at(place[0], place[1], crs=crs)
    np.testing.assert_allclose(frame.from_geographic(*frame.to_geographic(x, y)), (x, y), atol=1e-6)
    again = Frame.from_json(frame.to_json())
    np.testing.assert_allclose(again.from_geographic(*frame.to_geographic(x, y)), (x, y), atol=1e-6)


@settings(deadline=None, max_examples=15)
@given(places, st.floats(-10000, 10000), st.floats(-10000, 10000), st.sampled_from([20.0, 200.0, 5000.0]))
def test_the_affine_approximation_is_within_its_limit(place, x, y, width):
    frame = Frame.at(*place)
    crs = export_crs(frame)
    rng = np.random.default_rng(1)
    points = rng.uniform(-width / 2, width / 2, (200, 3)) + np.array([x, y, 0])
    fast = Georeference(frame, crs).points(points)
    exact = Georeference(frame, crs, exact=True).points(points)
    assert np.abs(fast - exact).max() <= 1.05 * AFFINE_LIMIT
    back = np.column_stack([*frame.from_crs(exact[:, 0], exact[:, 1], crs=crs), exact[:, 2]])
    assert np.abs(back - points).max() < 1e-5


def test_the_export_crs_is_the_utm_zone_or_the_scenes_crs():
    assert export_crs(Frame.at(-76.3, 36.9)).to_epsg() == 32618
    assert export_crs(Frame.at(-76.3, -36.9)).to_epsg() == 32718
    assert export_crs(Frame.at(10.7, 59.9)).to_epsg() == 32632
    assert export_crs(Frame.at(5.3, 60.4)).to_epsg() == 32632  # zone 32 is wide off south-west Norway
    assert export_crs(Frame.at(20.0, 78.0)).to_epsg() == 32633  # and 33 on Svalbard
    assert export_crs(Frame.at(13.4, 52.5, crs="EPSG:25833")).to_epsg() == 25833
    assert export_crs(Frame.at(13.4, 52.5), "EPSG:3035") == CRS.from_epsg(3035)


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:2263", "EPSG:3857", "nonsense"])
def test_an_unsuitable_crs_is_refused(crs):
    with pytest.raises(FrameError, match=crs):
        Frame.at(-73.99, 60.72, crs=crs)


@pytest.mark.parametrize(("lat", "crs"), [(87.0, "EPSG:5041"), (84.5, "EPSG:5041"), (-80.5, "EPSG:5042")])
def test_near_the_poles_utm_is_ups(lat, crs):
    assert utm_crs(10.0, lat) == crs
    frame = Frame.at(10.0, lat, crs="utm")
    east, north = frame.to_projected(0.0, 0.0)
    # Snyder (1987), (21-33): rho of the polar stereographic with k0 = 0.994 and false origin 2,000 km.
    e = np.sqrt(2 / 298.257223563 - 298.257223563**-2)
    phi = np.radians(abs(lat))
    t = np.tan(np.pi / 4 - phi / 2) / ((1 - e * np.sin(phi)) / (1 + e * np.sin(phi))) ** (e / 2)
    rho = 2 * 6378137 * 0.994 * t / np.sqrt((1 + e) ** (1 + e) * (1 - e) ** (1 - e))
    sign = -1 if lat > 0 else 1
    assert east == pytest.approx(2e6 + rho * np.sin(np.radians(10)), abs=1)
    assert north == pytest.approx(2e6 + sign * rho * np.cos(np.radians(10)), abs=1)
