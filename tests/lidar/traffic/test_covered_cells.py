"""Cells of the grid that a body covers along its path."""

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.traffic.lanes import STEP
from lidar.traffic.sweep import CELL_SIZE, sweep

LENGTH, WIDTH = 4.5, 1.8
HALF = np.array([LENGTH / 2 + STEP / 2, WIDTH / 2]) + 0.05 + CELL_SIZE * np.sqrt(0.5)
"""Half a body between two stations, grown so that it covers each cell that it touches."""


def stations_by_cell(xy, heading, level):
    """Stations at which the centre of each cell (column, row, level) lies in the body's rectangle."""
    found = defaultdict(list)
    for k, ((x, y), angle) in enumerate(zip(xy, heading, strict=True)):
        reach = np.hypot(*HALF) + CELL_SIZE
        column = np.arange(*np.floor((np.array([-reach, reach]) + x) / CELL_SIZE).astype(int))
        row = np.arange(*np.floor((np.array([-reach, reach]) + y) / CELL_SIZE).astype(int))
        i, j = (grid.ravel() for grid in np.meshgrid(column, row))
        away = np.stack([(i + 0.5) * CELL_SIZE - x, (j + 0.5) * CELL_SIZE - y], axis=1)
        forward, left = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        inside = (abs(away @ forward) <= HALF[0]) & (abs(away @ left) <= HALF[1])
        for cell in zip(i[inside].tolist(), j[inside].tolist(), strict=True):
            found[*cell, int(level[k])].append(k)
    return found


def runs(stations):
    """First and last of each run of stations without a gap."""
    parts = np.split(np.array(stations), np.flatnonzero(np.diff(stations) > 1) + 1)
    return [(int(part[0]), int(part[-1])) for part in parts]


@pytest.mark.full
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 25),
    turning=st.sampled_from([0.0, 0.05, 0.5]),
    returns=st.booleans(),
    bridge=st.booleans(),
)
def test_a_body_covers_each_cell_from_when_it_comes_until_it_leaves_and_again_when_it_returns(
    seed, count, turning, returns, bridge
):
    random = np.random.default_rng(seed)
    heading = random.uniform(-np.pi, np.pi) + np.cumsum(turning * random.standard_normal(count))
    way = random.uniform(0.1, 3.0) * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    xy = random.uniform(-50.0, 50.0, 2) + np.cumsum(way, axis=0)
    if returns:
        xy, heading = np.concatenate([xy, xy[::-1]]), np.concatenate([heading, heading[::-1]])
    level = (np.arange(len(xy)) >= len(xy) // 2).astype(np.int64) * bridge
    found = sweep(xy, heading, length=LENGTH, width=WIDTH, level=level, scale=1.0)
    upper, column = np.divmod(found.cell, 1 << 30)
    plane, row = np.divmod(upper, 1 << 30)
    here = defaultdict(list)
    for i, j, z, first, last in zip(column, row, plane, found.first, found.last, strict=True):
        here[int(i) - (1 << 29), int(j) - (1 << 29), int(z)].append((int(first), int(last)))
    expected = stations_by_cell(xy, heading, level)
    assert here == {cell: runs(stations) for cell, stations in expected.items()}
    assert (np.diff(found.first) >= 0).all()
    assert (np.diff(found.last[found.leave]) >= 0).all()
