"""Watermark of point clouds: error rates and false alarms against theory, and where it is broken."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from geoscene.support.graphs import components
from lidar.errors import InputError
from lidar.tools.integrity.tampering import frame_verdict, linked_clusters
from lidar.tools.integrity.watermark import WatermarkCells, WatermarkKey, bit_error_rate

MARK = WatermarkKey(b"0123456789abcdef")
RINGS, COLUMNS = 16, 900


def scan(frame=7, *, seed=0):
    """A cloud of a scanner 2 m above flat ground between walls, with gaps, and its cells."""
    rng = np.random.default_rng(seed)
    ring, column = (a.ravel() for a in np.meshgrid(np.arange(RINGS), np.arange(COLUMNS), indexing="ij"))
    azimuth, elevation = np.pi - column * 2 * np.pi / COLUMNS, np.radians(ring * 2.0 - 15)
    away = 20 / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth))) / np.cos(elevation)
    down = np.where(elevation < 0, -2 / np.minimum(np.sin(elevation), -1e-9), np.inf)
    away = np.minimum(away, down)
    unit = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    seen = rng.random(len(ring)) > 0.05
    cells = WatermarkCells("top", frame, ring, column, np.ones(len(ring), np.uint8)).where(seen)
    return (away[:, None] * unit)[seen], cells


def extended(cells, other):
    columns = (np.append(getattr(cells, name), getattr(other, name)) for name in ("ring", "column", "echo"))
    return WatermarkCells(cells.sensor, cells.frame, *columns)


def distance(place, xyz):
    """Hausdorff distance between the corners of a place's box and those of the box of points."""
    found = np.array(list(product(*zip(place.low, place.high, strict=True))))
    true = np.array(list(product(*zip(xyz.min(axis=0), xyz.max(axis=0), strict=True))))
    apart = np.linalg.norm(found[:, None] - true, axis=2)
    return max(apart.min(axis=0).max(), apart.min(axis=1).max())


def test_theory_has_the_published_bit_error_rate():
    assert bit_error_rate(0.05, 0.004) == pytest.approx(1.778e-3, rel=1e-3)
    assert bit_error_rate(0.05, 0.0) == 0
    assert bit_error_rate(0.05, 10.0) == pytest.approx(0.5, abs=1e-6)


@pytest.mark.full
@pytest.mark.parametrize("sigma", [0.004, 0.006, 0.01])
def test_bit_errors_under_noise_are_those_of_theory(sigma):
    rng, wrong, bits = np.random.default_rng(1), 0, 0
    for frame in range(26):
        xyz, cells = scan(frame)
        noisy = MARK.embedded(xyz, cells) + rng.normal(0, sigma, xyz.shape)
        found = MARK.decoded(noisy, cells).wrong
        wrong, bits = wrong + found.sum(), bits + found.size
    assert bits > 1e6
    assert wrong / bits == pytest.approx(MARK.error_rate(sigma), rel=0.06)
    assert wrong / bits == pytest.approx(bit_error_rate(0.05, sigma), rel=0.1)


def test_points_move_uniformly_by_at_most_half_a_step():
    xyz, cells = scan()
    moved = MARK.embedded(xyz, cells) - xyz
    assert np.abs(moved).max() <= 0.025 * 1.04
    assert moved.std(axis=0) == pytest.approx(np.full(3, 0.05 / np.sqrt(12)), rel=0.03)


@pytest.mark.parametrize("rounded", [np.float32, lambda x: np.round(x, 4), lambda x: np.round(x, 2)])
def test_rounding_of_a_centimetre_leaves_every_bit(rounded):
    xyz, cells = scan()
    assert not MARK.decoded(rounded(MARK.embedded(xyz, cells)), cells).wrong.any()


def test_half_precision_breaks_bits_beyond_32_metres():
    xyz, cells = scan()
    near = np.linalg.norm(xyz, axis=1) < 15
    half = MARK.embedded(xyz * 4, cells).astype(np.float16).astype(float)
    wrong = MARK.decoded(half, cells).wrong
    assert wrong[np.abs(half) > 33].mean() > 0.1
    assert not MARK.decoded(MARK.embedded(xyz, cells).astype(np.float16), cells).wrong[near].any()


@pytest.mark.parametrize("what", ["key", "frame", "sensor", "column", "positions"])
def test_half_of_the_bits_are_wrong_with_another(what):
    xyz, cells = scan()
    marked = MARK.embedded(xyz, cells)
    mark = replace(MARK, key=b"another key of 16") if what == "key" else MARK
    if what == "column":
        cells = replace(cells, column=(cells.column + 1) % COLUMNS)
    elif what == "positions":
        marked = marked + np.random.default_rng(0).uniform(-1, 1, marked.shape)
    elif what != "key":
        cells = replace(cells, **{what: 8 if what == "frame" else "other"})
    wrong = mark.decoded(marked, cells).wrong
    assert wrong.mean() == pytest.approx(0.5, abs=0.01)
    assert (~wrong.any(axis=1)).mean() == pytest.approx(1 / 8, abs=0.01)
    assert frame_verdict(mark, marked, cells=cells).absent


@pytest.mark.full
def test_false_alarms_of_blocks_are_those_of_theory():
    rng, alarms, expected = np.random.default_rng(2), 0, 0.0
    for frame in range(30):
        xyz, cells = scan(frame)
        noisy = MARK.embedded(xyz, cells) + rng.normal(0, 0.004, xyz.shape)
        test = frame_verdict(MARK, noisy, cells=cells, noise=0.004, false_alarms=8.0).blocks
        assert test.chance.sum() <= 8.0
        alarms, expected = alarms + len(test.tampered), expected + test.chance.sum()
    assert expected > 10
    assert abs(alarms - expected) < 3.5 * np.sqrt(expected)


def test_a_cloud_as_it_was_signed_has_no_findings():
    for frame in range(10):
        xyz, cells = scan(frame, seed=frame)
        noisy = MARK.embedded(xyz, cells) + np.random.default_rng(frame).normal(0, 0.001, xyz.shape)
        found = frame_verdict(MARK, noisy.astype(np.float32), cells=cells)
        assert found.wrong == 0
        assert not found.places
        assert not found.forged.any()
        assert (found.suspicion < 0.5).mean() > 0.99


@pytest.mark.parametrize("noise", [0.0, 0.002])
def test_added_returns_are_found_with_their_box(noise):
    xyz, cells = scan()
    rng = np.random.default_rng(3)
    ghost = (cells.ring >= 2) & (cells.ring < 12) & (cells.column > 430) & (cells.column < 470)
    new = xyz[ghost] / np.linalg.norm(xyz[ghost], axis=1, keepdims=True) * 6
    noisy = MARK.embedded(xyz, cells) + rng.normal(0, noise, xyz.shape)
    found = frame_verdict(
        MARK,
        np.concatenate([noisy, new]),
        cells=extended(cells, replace(cells.where(ghost), echo=np.full(ghost.sum(), 2))),
        noise=max(noise, 0.001),
    )
    added = np.arange(len(found.forged)) >= len(xyz)
    assert found.forged[added].mean() > 0.95
    assert found.forged[~added].mean() < 0.005
    assert found.places[0].kind == "added or moved"
    assert distance(found.places[0], new) < 0.25


def test_moved_returns_are_found_where_they_are_and_were():
    xyz, cells = scan()
    marked = MARK.embedded(xyz, cells)
    near = (cells.ring >= 8) & (cells.ring < 13) & (np.abs(cells.column - 300) < 12)
    moved = np.where(near[:, None], marked * 1.2, marked)
    found = frame_verdict(MARK, moved, cells=cells)
    assert found.forged[near].mean() > 0.99
    assert found.forged[~near].mean() < 0.005
    by_kind = {place.kind: place for place in reversed(found.places)}
    assert distance(by_kind["added or moved"], moved[near]) < 0.25
    assert distance(by_kind["removed"], marked[near]) < 0.25


@pytest.mark.parametrize("middle", [450, 0, COLUMNS - 1])
def test_a_gap_of_removed_returns_is_found_even_at_the_seam(middle):
    xyz, cells = scan()
    marked = MARK.embedded(xyz, cells)
    off = (cells.column - middle + COLUMNS // 2) % COLUMNS - COLUMNS // 2
    gone = (cells.ring >= 8) & (cells.ring < 14) & (np.abs(off) <= 15)
    found = frame_verdict(MARK, marked[~gone], cells=cells.where(~gone))
    assert not found.forged.any()
    assert [place.kind for place in found.places] == ["removed"]
    assert distance(found.places[0], marked[gone]) < 0.25


@pytest.mark.full
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_three_returns_of_a_ring_are_never_missed(data):
    xyz, cells = scan()
    marked = MARK.embedded(xyz, cells)
    first = data.draw(st.integers(0, len(xyz) - 5))
    rows = np.arange(first, first + 4)
    shift = np.array(data.draw(st.tuples(*[st.floats(-30, 30).filter(lambda s: abs(s) > 0.1)] * 3)))
    marked[rows] += shift * np.random.default_rng(first).uniform(0.3, 1, (4, 1))
    found = frame_verdict(MARK, marked, cells=cells)
    assert len(found.blocks.tampered)
    assert found.forged[rows].sum() >= 2


@pytest.mark.parametrize("steps", [3, 12, 100])
def test_a_shift_by_multiples_of_the_step_is_found(steps):
    xyz, cells = scan()
    marked = MARK.embedded(xyz, cells)
    near = (cells.ring >= 8) & (cells.ring < 13) & (np.abs(cells.column - 300) < 12)
    marked[near] += 0.05 * steps
    found = frame_verdict(MARK, marked, cells=cells)
    assert found.forged[near].mean() > 0.8
    assert found.forged[~near].mean() < 0.005


def test_an_empty_cloud_and_single_returns_have_a_verdict():
    xyz, cells = scan()
    for keep in (np.zeros(len(xyz), bool), np.arange(len(xyz)) == 5, np.arange(len(xyz)) % 1000 == 0):
        few = cells.where(keep)
        found = frame_verdict(MARK, MARK.embedded(xyz[keep], few), cells=few)
        assert (found.bits, found.wrong, found.places) == (3 * keep.sum(), 0, ())


def test_a_step_out_of_bounds_is_refused():
    with pytest.raises(InputError, match=r"`step` 0: give 0\.0001 to 1 metre"):
        WatermarkKey(b"0123456789abcdef", 0.0)


@pytest.mark.full
@given(
    npst.arrays(np.int64, st.tuples(st.integers(1, 60), st.just(3)), elements=st.integers(-32, 32)),
    st.sampled_from([2, np.inf]),
)
@settings(deadline=None)
def test_clusters_are_chains_of_points_within_a_distance_of_one(eighths, p):
    points = eighths / 8  # so that distances of exactly 1 are computed as such
    linked = np.linalg.norm(points[:, None] - points[None], ord=p, axis=2) <= 1
    same = (
        own[:, None] == own
        for own in (linked_clusters(points, p=p), components(*np.argwhere(linked).T, count=len(points)))
    )
    np.testing.assert_array_equal(*same)


@pytest.mark.parametrize(("gap", "clusters"), [(0.99, 1), (1.01, 2)])
def test_dense_walls_are_one_cluster_if_any_two_points_are_within_a_distance_of_one(gap, clusters):
    """A list of the links would have 300 million rows."""
    wall = np.random.default_rng(0).uniform(0, 1, (20_000, 3)) * [0.01, 1, 1]
    other = wall.copy()
    other[:, 0] += wall[:, 0].max() - wall[:, 0].min() + gap
    other[0] = wall[np.argmax(wall[:, 0])] + [gap, 0, 0]
    assert linked_clusters(np.concatenate([wall, other]), p=2).max() + 1 == clusters


def test_further_returns_of_a_pulse_are_beside_no_gap():
    """Their column is that of the return before, not that of a whole turn later."""
    xyz, cells = scan()
    both = np.concatenate([xyz, xyz * 1.2])
    second = replace(cells, echo=np.full(len(xyz), 2, np.uint8))
    marked = MARK.embedded(both, extended(cells, second))
    forged = np.arange(3000, 4000, 5)
    marked[forged] += np.random.default_rng(1).uniform(-0.2, 0.2, (200, 3))
    verdict = frame_verdict(MARK, marked, cells=extended(cells, second))
    assert verdict.forged[forged].mean() > 0.8
    assert sum(place.returns for place in verdict.places if place.kind == "removed") < 200
