"""Crowns are found with their sizes, and unmapped roofs, lamps and cars are not taken for trees."""

import numpy as np
import pytest

from geoscene.clouds.ground import CloudGrid
from geoscene.clouds.trees import find_trees

GRID = CloudGrid(0.0, 0.0, 120, 120, 0.5)
CROWNS = {(15.0, 15.0): (12.0, 8.0), (45.0, 15.0): (7.0, 4.5), (24.5, 17.0): (10.0, 7.0)}


def street(*, noise, seed):
    """Points (n, 3) on level ground with three crowns, a gabled house, a lamp and a van."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 60, (45_000, 2))
    z = np.zeros(len(xy))
    for middle, (height, crown) in CROWNS.items():
        off = np.hypot(*(xy - middle).T) / (crown / 2)
        top = 0.65 * height + 0.35 * height * np.sqrt(np.clip(1 - off**2, 0, 1))
        z = np.maximum(z, np.where(off < 1, top, 0))
    u, v = np.abs(xy - (35, 45)).T
    z = np.where((u < 7) & (v < 4.5), 5 + 3 * (1 - v / 4.5), z)
    z = np.where(np.hypot(*(xy - (50, 50)).T) < 0.3, 8.0, z)
    u, v = np.abs(xy - (10, 50)).T
    z = np.where((u < 2.4) & (v < 1), 2.2, z)
    return np.column_stack([xy, z + rng.normal(0, noise, len(xy))])


@pytest.mark.parametrize("noise", [0.0, 0.03, 0.06])
def test_crowns_are_found_and_houses_lamps_and_cars_are_not(noise):
    xyz = street(noise=noise, seed=1)
    found = find_trees(xyz, xyz[:, 2], grid=GRID, excluded=np.zeros(GRID.shape, bool))
    assert len(found) == len(CROWNS)
    for middle, (height, crown) in CROWNS.items():
        nearest = np.argmin(np.hypot(*(found.xy - middle).T))
        assert np.hypot(*(found.xy[nearest] - middle)) < 0.7
        assert found.height[nearest] == pytest.approx(height, abs=0.3)
        assert found.crown[nearest] == pytest.approx(crown, rel=0.2)


def test_no_tree_is_sought_in_buildings():
    xyz = street(noise=0.02, seed=2)
    found = find_trees(xyz, xyz[:, 2], grid=GRID, excluded=np.ones(GRID.shape, bool))
    assert len(found) == 0
