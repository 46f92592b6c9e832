"""The ground below a point cloud."""

import numpy as np
import pytest

from lidar.tools.detection.ground import Ground, ground_of


def flat(height):
    """A plane below the sensor, as a cloud on a grid of half metres."""
    x, y = np.meshgrid(np.arange(-40, 40.5, 0.5), np.arange(-40, 40.5, 0.5))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


@pytest.mark.parametrize("height", [-1.8, -2.3])
def test_rays_hit_a_plane_at_the_distance_of_geometry(height):
    ground = ground_of(flat(height))
    assert isinstance(ground, Ground)
    fall, turn = (
        np.radians(np.repeat([4.0, 8.0, 16.0, 25.0], 36)),
        np.tile(np.radians(np.arange(0, 360, 10)), 4),
    )
    way = np.column_stack([np.cos(fall) * np.cos(turn), np.cos(fall) * np.sin(turn), -np.sin(fall)])
    np.testing.assert_allclose(ground.hit(way, reach=60.0), -height / np.sin(fall), rtol=1e-6)
    assert np.isinf(ground.hit(way * [1, 1, -1], reach=60.0)).all()
    np.testing.assert_allclose(ground.below(flat(0.0)[::7]), height, atol=1e-9)
