"""Faces of noded segments are those of GEOS's polygonizer, and know what lies beside them."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.errors import GeosceneError
from geoscene.ground.faces import GroundFaces, faces

SIDE = 12
BOX = (0.0, 0.0, float(SIDE), float(SIDE))
RING = [(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE), (0, 0)]

corner = st.tuples(st.integers(-3, SIDE + 3), st.integers(-3, SIDE + 3))
outline = st.lists(corner, min_size=2, max_size=6, unique=True)


def of(lines: list[shapely.LineString]) -> GroundFaces:
    noded = shapely.get_parts(shapely.union_all(lines, grid_size=1.0))
    segments = np.concatenate(
        [np.stack([c[:-1], c[1:]], axis=1) for c in map(shapely.get_coordinates, noded)]
    )
    points, number = np.unique(segments.reshape(-1, 2), axis=0, return_inverse=True)
    ends = number.reshape(-1, 2).T
    return faces(points, ends, rank=np.arange(ends.size).reshape(-1, 2).T, box=BOX)


@pytest.mark.full
@given(st.lists(outline, max_size=12))
@settings(max_examples=40)
def test_faces_are_those_of_the_polygonizer_in_its_order(outlines):
    lines = [shapely.LinearRing(RING), *map(shapely.LineString, outlines)]
    found = of(lines)
    noded = shapely.get_parts(shapely.union_all(lines, grid_size=1.0))
    coords, line = shapely.get_coordinates(noded, return_index=True)
    alone = [coords[k : k + 2] for k in np.flatnonzero(line[:-1] == line[1:])]
    expected = shapely.get_parts(shapely.polygonize(shapely.linestrings(np.array(alone))))
    expected = expected[shapely.covers(shapely.box(*BOX), expected)]
    assert shapely.to_wkt(found.polygons()).tolist() == shapely.to_wkt(expected).tolist()


@given(st.lists(outline, max_size=12))
@settings(max_examples=100)
def test_what_lies_left_of_a_half_edge_has_it_on_its_right_the_other_way(outlines):
    found = of([shapely.LinearRing(RING), *map(shapely.LineString, outlines)])
    right = dict(zip(zip(found.a.tolist(), found.b.tolist(), strict=True), found.cell.tolist(), strict=True))
    assert len(right) == len(found.a)
    for a, b, other in zip(found.a.tolist(), found.b.tolist(), found.other.tolist(), strict=True):
        assert other == right.get((b, a), -1)
    assert (found.other != found.cell).all()
    assert shapely.area(found.polygons()).sum() == SIDE * SIDE
    assert (found.cell[found.first] == np.arange(len(found.polygons()))).all()
    starts = shapely.get_coordinates(shapely.get_point(shapely.get_exterior_ring(found.polygons()), 0))
    assert (starts == found.points[found.a[found.first]]).all()


def test_two_squares_that_touch_in_a_corner_are_holes_of_one_face():
    found = of([shapely.LinearRing(RING), *(shapely.box(k, k, k + 2, k + 2).exterior for k in (2, 4))])
    assert sorted(shapely.area(found.polygons())) == [4.0, 4.0, SIDE * SIDE - 8.0]
    assert shapely.is_valid(found.polygons()).all()


def test_a_box_that_is_not_covered_is_an_error():
    with pytest.raises(GeosceneError, match=r"cover 4\.0+ m2 of 144"):
        of([shapely.box(2, 2, 4, 4).exterior])
