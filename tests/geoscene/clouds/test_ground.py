"""The ground filter keeps slopes and takes off houses, cars and trees."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.clouds.ground import (
    MARGIN,
    CloudGrid,
    bridge,
    bridged_by_blocks,
    ground_heights,
    ground_returns,
)
from geoscene.clouds.read import SurveyPoints


def sloping(gradient, *, azimuth, seed, wave=0.0, noise=0.03):
    """Points (n, 3) on a slope with noise, and the ground's height as a function of place."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 90, (32_000, 2))

    def height(x, y):
        along = x * np.cos(azimuth) + y * np.sin(azimuth)
        return gradient * along + wave * np.sin(along / 12)

    return np.column_stack([xy, height(*xy.T) + rng.normal(0, noise, len(xy))]), height


def of(xyz):
    return SurveyPoints(xyz, np.zeros(len(xyz), np.uint8), np.ones(len(xyz), bool))


GRID = CloudGrid(0.0, 0.0, 90, 90, 1.0)


FEW = settings(max_examples=6, deadline=None)


@pytest.mark.full
@FEW
@given(st.floats(0, 0.4), st.floats(0, 6.28), st.integers(0, 99))
def test_bare_slopes_are_kept(gradient, azimuth, seed):
    xyz, _ = sloping(gradient, azimuth=azimuth, seed=seed, wave=0.5)
    kept = ground_returns(of(xyz), GRID, built=np.zeros(GRID.shape, bool))
    inner = (np.abs(xyz[:, :2] - 45) < 45 - MARGIN).all(axis=1)  # squares have this margin
    assert kept[inner].mean() > 0.995


@pytest.mark.full
@FEW
@given(st.floats(0, 0.3), st.floats(0, 6.28), st.integers(0, 99))
def test_objects_are_taken_off_and_the_ground_is_measured_to_centimetres(gradient, azimuth, seed):
    xyz, height = sloping(gradient, azimuth=azimuth, seed=seed)
    house = (np.abs(xyz[:, 0] - 30) < 8) & (np.abs(xyz[:, 1] - 40) < 6)
    shed = (np.abs(xyz[:, 0] - 60) < 3) & (np.abs(xyz[:, 1] - 70) < 2)
    hedge = (np.abs(xyz[:, 0] - 75) < 1.5) & (np.abs(xyz[:, 1] - 30) < 2.5)
    xyz[:, 2] += np.where(house, 6.0, 0) + np.where(shed, 2.5, 0) + np.where(hedge, 1.6, 0)
    built = np.zeros(GRID.shape, bool)
    kept = ground_returns(of(xyz), GRID, built=built)
    assert not kept[house | shed | hedge].any()
    found = ground_heights(of(xyz), GRID, classified=False, built=built)
    east, north = GRID.centres()
    error = found - height(east, north)
    assert np.nanpercentile(np.abs(error), 95) < 0.05
    assert np.isfinite(found).mean() > 0.9


def test_low_noise_does_not_dig_holes():
    xyz, height = sloping(0.1, azimuth=0.3, seed=5)
    deep = np.array([[20.5, 20.5, -8.0], [70.5, 50.5, -3.0]])
    built = np.zeros(GRID.shape, bool)
    found = ground_heights(of(np.concatenate([xyz, deep])), GRID, classified=False, built=built)
    east, north = GRID.centres()
    assert np.nanmax(np.abs(found - height(east, north))) < 0.3


def test_classified_ground_is_used_as_it_is():
    xyz, height = sloping(0.2, azimuth=1.0, seed=2)
    klass = np.where(np.arange(len(xyz)) % 4 == 0, 2, 1).astype(np.uint8)
    xyz[klass == 1, 2] += 0.4  # low vegetation that no filter tells from the ground
    points = SurveyPoints(xyz, klass, np.ones(len(xyz), bool))
    found = ground_heights(points, GRID, classified=True, built=np.zeros(GRID.shape, bool))
    east, north = GRID.centres()
    assert np.nanpercentile(np.abs(found - height(east, north)), 99) < 0.1


@FEW
@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_gaps_in_a_plane_are_bridged_by_the_plane(a, b):
    east, north = GRID.centres()
    plane = a * east + b * north
    gappy = plane.copy()
    gappy[20:60, 30:50] = np.nan
    assert np.abs(bridge(gappy) - plane).max() < 1e-6


@pytest.mark.full
def test_gaps_that_cross_blocks_are_bridged_as_if_there_were_none():
    rows, columns = np.mgrid[:700, :1100].astype(float)
    plane = (0.1 * columns - 0.05 * rows).astype(np.float32)
    gappy = plane.copy()
    gappy[480:560, 490:600] = np.nan
    gappy[100:103, 1000:1090] = np.nan
    gappy[:, :5] = np.nan  # beyond all measured cells
    found = bridged_by_blocks(gappy)
    assert np.isnan(found[:, :5]).all()
    assert np.abs(found[:, 5:] - plane[:, 5:]).max() < 1e-3
