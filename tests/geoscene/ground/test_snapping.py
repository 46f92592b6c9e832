"""Snap rounding: segments meet at the ends of their pieces only, and pass the pixels they are divided at."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from geoscene.ground.faces import snap_rounded

corner = st.tuples(st.integers(-9, 9), st.integers(-9, 9))
segments = st.lists(st.tuples(corner, corner).filter(lambda s: s[0] != s[1]), min_size=1, max_size=14)


def of(pairs):
    start, end = np.array(pairs).transpose(1, 0, 2)
    fresh = np.append(True, (start[1:] != end[:-1]).any(axis=1))
    return snap_rounded(start, end, fresh=fresh)


def pieces_of(pairs):
    points, ends, _ = of(pairs)
    return {frozenset(map(tuple, points[pair].tolist())) for pair in ends.T}


@pytest.mark.full
@given(segments)
@settings(max_examples=60)
def test_pieces_are_those_of_geos_where_no_corner_is_touched(pairs):
    # Where a segment touches a pixel's corner, GEOS decides by the rounding errors of its crossings.
    start, end = np.array(pairs).transpose(1, 0, 2)[:, :, None]
    u, v = end - start, of(pairs)[0] - start
    twice = 2 * np.abs(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])
    assume((twice != np.abs(u).sum(axis=-1)).all())
    far = shapely.LineString([(1000, 1000), (1000, 1001)])
    rounded = shapely.union(shapely.multilinestrings(shapely.linestrings(np.array(pairs))), far, grid_size=1)
    coords, line = shapely.get_coordinates(shapely.get_parts(rounded), return_index=True)
    expected = {
        frozenset(map(tuple, coords[k : k + 2].astype(int).tolist()))
        for k in np.flatnonzero(line[:-1] == line[1:])
    }
    assert pieces_of(pairs) == expected - {frozenset({(1000, 1000), (1000, 1001)})}


@given(segments)
@settings(max_examples=200)
def test_pieces_meet_at_their_ends_only(pairs):
    points, ends, _ = of(pairs)
    pieces = shapely.linestrings(points[ends.T].astype(float))
    one, other = shapely.STRtree(pieces).query(pieces, predicate="intersects")
    one, other = one[one < other], other[one < other]
    met = shapely.intersection(pieces[one], pieces[other])
    assert (shapely.get_type_id(met) == 0).all()
    assert (shapely.disjoint(met, shapely.boundary(pieces[one])) == 0).all()
    assert (shapely.disjoint(met, shapely.boundary(pieces[other])) == 0).all()


@pytest.mark.full
@given(segments, st.integers(-(10**7), 10**7), st.integers(-(10**7), 10**7))
def test_the_pieces_move_with_the_segments(pairs, x, y):
    moved = [tuple((u + x, v + y) for u, v in pair) for pair in pairs]
    back = {frozenset((u - x, v - y) for u, v in piece) for piece in pieces_of(moved)}
    assert back == pieces_of(pairs)


@pytest.mark.full
@given(segments)
def test_the_pieces_do_not_depend_on_order_and_direction(pairs):
    assert pieces_of([(b, a) for a, b in reversed(pairs)]) == pieces_of(pairs)


def place(*, east, north):
    """A place up to 10 km from the middle, in a quarter of the plane."""
    span = st.integers(1, 5 * 10**6)
    return st.tuples(span.map(lambda v: v * east), span.map(lambda v: v * north))


@given(place(east=-1, north=-1), place(east=1, north=1), place(east=-1, north=1), place(east=1, north=-1))
def test_crossings_of_long_segments_are_rounded_exactly(p, q, r, s):
    d = (q[0] - p[0], q[1] - p[1])
    e = (s[0] - r[0], s[1] - r[1])
    whole = d[0] * e[1] - d[1] * e[0]  # d points north-east and e south-east: below 0
    t = (r[0] - p[0]) * e[1] - (r[1] - p[1]) * e[0]
    u = (r[0] - p[0]) * d[1] - (r[1] - p[1]) * d[0]
    assume(0 > t > whole and 0 > u > whole)
    at = tuple((2 * (p[k] * whole + d[k] * t) + whole) // (2 * whole) for k in range(2))
    points, _, _ = of([(p, q), (r, s)])
    assert at in set(map(tuple, points.tolist()))
