"""Boundaries become areas for any order, direction and division of their ways."""

from itertools import pairwise

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from geoscene.sources.rings import Assembly, RingMember, assemble, close_cut_ring


@st.composite
def cities(draw):
    """A valid area of star-shaped blocks with star-shaped holes: (polygons, rng)."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def star(x: float, y: float, size: float) -> np.ndarray:
        n = rng.integers(4, 10)
        # gaps between directions below a half turn keep the centre inside
        angle = np.sort((np.arange(n) + rng.uniform(0.2, 0.8, n)) * 2 * np.pi / n)
        reach = size * rng.uniform(0.5, 1.0, n)
        return np.stack([x + reach * np.cos(angle), y + reach * np.sin(angle)], axis=1)

    blocks = []
    for i in range(draw(st.integers(1, 4))):
        outer = star(10.0 * i, 0.0, 4.0)
        holes = [star(10.0 * i, 0.0, 0.3)] if draw(st.booleans()) else []
        blocks.append((outer, holes))
    return blocks, rng


def chains_of(blocks, rng) -> tuple[list[RingMember], np.ndarray]:
    """The rings cut at random nodes into pieces of random direction, shuffled."""
    xy = []
    chains = []
    for outer, holes in blocks:
        for inner, ring in ((False, outer), *((True, hole) for hole in holes)):
            nodes = np.arange(len(xy), len(xy) + len(ring))
            xy.extend(ring)
            nodes = np.append(nodes, nodes[0])
            cuts = np.flatnonzero(rng.random(len(nodes) - 2) < 0.3) + 1
            bounds = [0, *cuts.tolist(), len(nodes) - 1]
            for a, b in pairwise(bounds):
                piece = nodes[a : b + 1]
                chains.append(RingMember(piece[::-1] if rng.random() < 0.5 else piece, inner))
    order = rng.permutation(len(chains))
    return [chains[i] for i in order], np.array(xy)


def area_of(blocks):
    return shapely.union_all([shapely.Polygon(outer, holes) for outer, holes in blocks])


@given(cities())
@settings(max_examples=60, deadline=None)
def test_pieces_in_any_order_and_direction_make_the_area(city):
    blocks, rng = city
    chains, xy = chains_of(blocks, rng)
    made = assemble(chains, xy)
    assert made.reason == ""
    assert shapely.equals(made.geometry, area_of(blocks))


@given(cities())
@settings(max_examples=30, deadline=None)
def test_roles_do_not_matter_if_the_boundary_is_valid(city):
    blocks, rng = city
    chains, xy = chains_of(blocks, rng)
    lied = [RingMember(c.nodes, bool(rng.random() < 0.5)) for c in chains]
    assert shapely.equals(assemble(lied, xy).geometry, area_of(blocks))


@given(cities())
@settings(max_examples=30, deadline=None)
def test_a_member_listed_twice_counts_once(city):
    blocks, rng = city
    chains, xy = chains_of(blocks, rng)
    made = assemble([*chains, chains[0]], xy)
    assert made.reason == "duplicate-way"
    assert shapely.equals(made.geometry, area_of(blocks))


def test_an_inner_ring_that_equals_its_outer_ring_leaves_no_area():
    xy = np.array([(0, 0), (4, 0), (4, 4), (0, 4), (9, 9), (10, 9), (10, 10)], float)
    outer = RingMember(np.array([0, 1, 2, 3, 0]), inner=False)
    same = RingMember(np.array([2, 1, 0, 3, 2]), inner=True)
    island = RingMember(np.array([4, 5, 6, 4]), inner=False)
    assert assemble([outer, same], xy) == assemble([same, outer], xy) == Assembly(None, "both-roles")
    made = assemble([outer, same, island], xy)
    assert (made.geometry.area, made.reason) == (0.5, "both-roles")


@given(cities())
@settings(max_examples=30, deadline=None)
def test_a_missing_piece_drops_only_its_ring(city):
    blocks, rng = city
    chains, xy = chains_of(blocks, rng)
    lost = int(rng.integers(len(chains)))
    made = assemble([c for i, c in enumerate(chains) if i != lost], xy, complete=False)
    node = xy[chains[lost].nodes[0]]

    def hit(ring: np.ndarray) -> bool:
        return bool((ring == node).all(axis=1).any())

    left = [(o, [h for h in holes if not hit(h)]) for o, holes in blocks if not hit(o)]
    if left:
        assert shapely.equals(made.geometry, area_of(left))
    else:
        assert made.geometry is None


def test_holes_that_share_a_side_become_one():
    xy = np.array([(0, 0), (9, 0), (9, 9), (0, 9), (2, 2), (4, 2), (6, 2), (6, 4), (4, 4), (2, 4)], float)
    outer = RingMember(np.array([0, 1, 2, 3, 0]), inner=False)
    left = RingMember(np.array([4, 5, 8, 9, 4]), inner=True)
    right = RingMember(np.array([5, 6, 7, 8, 5]), inner=True)
    made = assemble([outer, left, right], xy)
    assert made.reason == ""
    assert made.geometry.area == 81 - 8
    assert len(made.geometry.interiors) == 1


def test_overlapping_outlines_are_united_not_cancelled():
    xy = np.array([(0, 0), (4, 0), (4, 4), (0, 4), (2, 2), (6, 2), (6, 6), (2, 6)], float)
    one, two = (
        RingMember(np.array([0, 1, 2, 3, 0]), inner=False),
        RingMember(np.array([4, 5, 6, 7, 4]), inner=False),
    )
    made = assemble([one, two], xy)
    assert made.reason == "self-crossing"
    assert made.geometry.area == 16 + 16 - 4


def test_open_boundary_has_no_area():
    xy = np.array([(0, 0), (4, 0), (4, 4)], float)
    made = assemble([RingMember(np.array([0, 1, 2]), inner=False)], xy)
    assert made.geometry is None
    assert made.reason == "open-ring"


EDGE = (0.0, 0.0, 0.01, 0.01)
METRE = 9e-6


@pytest.mark.parametrize("shift", range(5))
def test_a_cut_ring_is_closed_the_same_from_any_start(shift):
    corners = np.array([(5, 30), (5, 10), (30, 10), (30, 40), (5, 40)]) * METRE
    ring = np.roll([0, 1, 2, 3, 4, -1], shift)
    closed = close_cut_ring(np.append(ring, ring[0]), corners, extent=EDGE)
    assert closed is not None
    assert closed[0] == closed[-1]
    assert shapely.Polygon(corners[closed]).area / METRE**2 == pytest.approx(750)


def test_ring_with_a_long_or_inland_gap_is_not_closed():
    corners = np.array([(5, 40), (5, 5), (30, 5), (30, 40)]) * METRE
    assert close_cut_ring(np.arange(4), corners, extent=EDGE) is not None
    assert close_cut_ring(np.arange(3), corners, extent=EDGE) is None
    inland = corners + 500 * METRE
    assert close_cut_ring(np.arange(4), inland, extent=EDGE) is None
    assert close_cut_ring(np.array([0, -1, -1]), corners, extent=EDGE) is None
    crossing = corners[[0, 2, 1, 3]]
    assert close_cut_ring(np.arange(4), crossing, extent=EDGE) is None
