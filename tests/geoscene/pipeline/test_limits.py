"""Errors of lengths by the frame and the height of a scene, told where they exceed the bound."""

import numpy as np
import pytest
from pyproj import Geod, Transformer

from geoscene.geometry.frames import Frame
from geoscene.pipeline.limits import LENGTHS, height_limit, places, scale_limit


@pytest.mark.parametrize("place", [(8.7, 49.4), (9.0, 0.0), (0.0, 90.0), (180.0, -16.8)])
def test_a_local_frame_of_a_hundred_kilometres_is_within_the_bound(place):
    assert scale_limit(Frame.at(*place), (-5e4, -5e4, 5e4, 5e4)) == []


@pytest.mark.parametrize(
    ("place", "way"), [((9.0, 47.0), "shorter"), ((6.02, 0.5), "longer"), ((5.0, 88.0), "shorter")]
)
def test_the_error_of_lengths_in_utm_and_ups_is_that_against_geodesics(place, way):
    frame, bounds = Frame.at(*place, crs="utm"), (-5e3, -5e3, 5e3, 5e3)
    (limit,) = scale_limit(frame, bounds)
    xy = places(bounds)
    ends = [frame.to_geographic(xy[:, 0] + dx, xy[:, 1]) for dx in (-50.0, 50.0)]
    _, _, true = Geod(ellps="WGS84").inv(*ends[0], *ends[1])
    assert limit.measured == pytest.approx(np.abs(100 / true - 1).max() * 1e6, rel=2e-3)
    assert way in limit.advice
    assert "`crs` local" in limit.advice


@pytest.mark.parametrize("z", [-430.0, 0.0, 600.0])
def test_low_ground_is_within_the_bound(z):
    assert height_limit(np.array([0.0, z])) == []


def test_the_error_of_lengths_on_high_ground_is_that_between_places_in_space():
    to_centre = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    frame = Frame.at(-68.13, -16.5)
    lon, lat = frame.to_geographic(np.zeros(2), np.array([-50.0, 50.0]))
    start, end = np.column_stack(to_centre.transform(lon, lat, np.full(2, 5000.0)))
    (limit,) = height_limit(np.array([100.0, 5000.0]))
    assert limit.measured == pytest.approx((np.linalg.norm(end - start) / 100 - 1) * 1e6, rel=0.01)
    assert limit.measured > LENGTHS
    assert "5,000 m" in limit.advice
    assert "1.000785" in limit.advice
