"""Small bends of borders are left out as by GEOS's simplification of coverages."""

from __future__ import annotations

import numpy as np
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.ground.faces import GroundFaces, faces

SIDE = 12
corner = st.tuples(st.integers(-3, SIDE + 3), st.integers(-3, SIDE + 3))
outline = st.lists(corner, min_size=2, max_size=9, unique=True)


def of(outlines: list[list[tuple[int, int]]]) -> GroundFaces:
    lines = [shapely.box(0, 0, SIDE, SIDE).exterior, *map(shapely.LineString, outlines)]
    noded = shapely.get_parts(shapely.union_all(lines, grid_size=1.0))
    segments = np.concatenate(
        [np.stack([c[:-1], c[1:]], axis=1) for c in map(shapely.get_coordinates, noded)]
    )
    points, number = np.unique(segments.reshape(-1, 2), axis=0, return_inverse=True)
    ends = number.reshape(-1, 2).T
    box = (0.0, 0.0, float(SIDE), float(SIDE))
    return faces(points, ends, rank=np.arange(ends.size).reshape(-1, 2).T, box=box)


def assert_as_geos(found: GroundFaces, bend: float) -> None:
    expected = shapely.coverage_simplify(found.polygons(), bend, simplify_boundary=False)
    assert shapely.to_wkt(found.simplified(bend)).tolist() == shapely.to_wkt(expected).tolist()


@given(st.lists(outline, min_size=1, max_size=8), st.sampled_from([0.1, 0.8, 1.1, 1.5, 2.0, 3.0]))
@settings(max_examples=500)
def test_polygons_are_those_of_geos(outlines, bend):
    assert_as_geos(of(outlines), bend)


def test_a_border_without_meetings_loses_its_small_bends_and_stays_a_ring():
    ring = [(3, 3), (6, 3), (9, 3), (9, 9), (3, 9), (3, 3)]
    inside = of([ring]).simplified(0.1)
    assert sorted(map(len, map(shapely.get_coordinates, inside))) == [5, 10]


def test_strips_across_the_box_keep_their_corners():
    assert_as_geos(of([[(k, 0), (k, SIDE)] for k in range(1, SIDE)]), 3.0)
