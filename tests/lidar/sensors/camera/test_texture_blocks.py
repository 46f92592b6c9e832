"""Textures of blocks of pixels are those of single pixels."""

import numpy as np
import pytest

from lidar.sensors.camera.ground_texture import ground
from lidar.sensors.camera.texture import GRAINS, detail
from lidar.sensors.camera.texture_blocks import BLOCK, DETAIL, PAINTED, PLACES, UPRIGHT, factors, scratch


@pytest.mark.full
@pytest.mark.parametrize("wide", [1e-3, 0.02, 0.5])
def test_factors_of_mixed_pixels_are_those_of_one_pixel_each(wide):
    rng = np.random.default_rng(0)
    work, worst = scratch(), 0.0
    for _ in range(40):
        n = int(rng.integers(1, BLOCK + 1))
        floors = rng.integers(0, 7, n) + PAINTED * rng.integers(0, 2, n)
        details = DETAIL + 2 * rng.integers(0, len(GRAINS), n) + UPRIGHT * rng.integers(0, 2, n)
        kind = np.where(rng.random(n) < 0.6, floors, details)
        kind[rng.random(n) < 0.1] = -1
        turn = rng.uniform(0, 2 * np.pi, n)
        across = wide * rng.uniform(0.5, 2, n)
        places = np.empty((PLACES, n))
        places[:4] = rng.uniform(-2000, 2000, (4, n))
        places[4:] = np.cos(turn), np.sin(turn), across, across * rng.uniform(1, 20, n), across
        out = np.empty(n)
        factors(kind, places, work, out)
        for k, (x, y, z, u, hx, hy, a, b, footprint), found in zip(kind, places.T, out, strict=True):
            if k < 0:
                one = 1.0
            elif k < DETAIL:
                one = ground(k % PAINTED, bool(k & PAINTED), x, y, hx, hy, a, b)
            else:
                one = detail((k - DETAIL) // 2, k & UPRIGHT, x, y, z, u, footprint)
            worst = max(worst, abs(found - one))
    assert worst < 1e-5
