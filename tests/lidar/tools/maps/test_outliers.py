"""The statistical outlier filter: that of all points at once, whatever the squares."""

import laspy
import numpy as np
import pytest
from helpers.map_data import dataset
from hypothesis import given, settings
from hypothesis import strategies as st

from lidar.errors import InputError
from lidar.options import MapOptions
from lidar.tools.maps import squares
from lidar.tools.maps.aggregate import aggregate
from lidar.tools.maps.squares import Outliers

OFFSET = (500_000.0, 6_700_000.0, 0.0)


def cloud(rng, count, *, spread):
    """Points (count, 3) around a few places, and some far from all others."""
    centre = rng.uniform(-spread, spread, (4, 3))
    points = centre[rng.integers(0, 4, count)] + rng.normal(0, 2, (count, 3))
    far = rng.random(count) < 0.03
    points[far] = rng.uniform(-2 * spread, 2 * spread, (np.count_nonzero(far), 3))
    return points


def kept_of_all_pairs(points, neighbours, factor):
    """Whether each point is kept, by the distances of all pairs."""
    away = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, 1 : neighbours + 1]
    short = np.pad(away, ((0, 0), (0, max(0, neighbours - away.shape[1]))), constant_values=np.inf)
    spacing = np.minimum(short, squares._FARTHEST).mean(axis=1)
    return spacing <= spacing.mean() + factor * spacing.std() + 1e-6


def tables_of(points, pieces):
    number = np.arange(len(points), dtype=np.uint32)
    for part in np.array_split(number, pieces):
        xyz = points[part] + OFFSET
        yield {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "frame": part}


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 300),
    neighbours=st.integers(1, 12),
    factor=st.floats(0.2, 3),
    spread=st.sampled_from([3.0, 20.0, 60.0]),
)
def test_the_points_left_are_those_by_the_distances_of_all_pairs(
    tmp_path_factory, seed, count, neighbours, factor, spread
):
    points = np.round(cloud(np.random.default_rng(seed), count, spread=spread), 3)
    out = tmp_path_factory.mktemp("outliers") / "map.laz"
    filtered = Outliers(neighbours, factor)
    left = list(filtered.without(tables_of(points, 3), out=out, offset=OFFSET))
    numbers = np.concatenate([np.zeros(0, np.uint32), *(table["frame"] for table in left)])
    expected = np.flatnonzero(kept_of_all_pairs(points, neighbours, factor))
    assert sorted(numbers) == expected.tolist()
    assert filtered.left_out == count - len(expected)
    assert not list(out.parent.iterdir())
    for table in left:
        np.testing.assert_allclose(
            np.column_stack([table[axis] for axis in "xyz"]), points[table["frame"]] + OFFSET, atol=1e-8
        )


def test_lonely_points_are_left_out_of_a_map_and_counted(tmp_path):
    data = dataset(tmp_path / "d")
    summary = aggregate(data, tmp_path / "m.laz", options=MapOptions(outliers=(8, 1.0)))
    left = len(laspy.read(tmp_path / "m.laz"))
    assert 0 < summary.left_out["outliers"] < 600
    assert summary.points == left == summary.points_in - summary.left_out["outliers"]


@pytest.mark.parametrize("given_outliers", [(0, 1.0), (5, -1.0), (501, 1.0), (5, float("nan"))])
def test_impossible_filters_are_refused(given_outliers):
    with pytest.raises(InputError, match="`outliers`"):
        MapOptions(outliers=given_outliers)
