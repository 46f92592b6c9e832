"""Snap rounding of segments on an integer grid (Hobby 1999; Guibas and Marimont 1998).

Every end of a segment, and every crossing of two rounded to the grid, is a hot pixel: a square of side 1,
open above and on the right. A segment is divided at the hot pixels that it passes. All is
decided in integers.
"""

from __future__ import annotations

import numpy as np
import shapely

from geoscene.typing import Bools, Ints

_EXACT = 2.0**62
"""Products below this are exact in 64 bits."""


def snap_rounded(start: Ints, end: Ints, *, fresh: Bools) -> tuple[Ints, Ints, Ints]:
    """Segments divided where they meet, each piece once.

    start, end : (n, 2) int64, less than 2**28 from each other, of different places
    fresh      : (n,) bool, segments that do not follow the one before

    Returns points (k, 2), sorted by x, then y, numbers (2, m) of the ends of pieces, and ranks (2, m) of
    their half-edges: of each run of pieces between points at which others end or pass, forth, then back.
    """
    n = len(start)
    lines = shapely.linestrings(np.stack([start, end], axis=1).astype(float))
    tree = shapely.STRtree(lines)
    points, number, met = _hot_pixels(
        start, end, fresh=fresh, crossings=_crossings(start, end, pairs=tree.query(lines))
    )
    segment, pixel = _passed(start, end, points=points, number=number, tree=tree)
    met[pixel] = True
    segment = np.append(np.arange(n), segment)
    a = np.append(number[0], pixel)
    order = np.lexsort((*_along(end - start, points[a], segment=segment), segment))
    segment, a = segment[order], a[order]
    last = np.append(segment[1:] != segment[:-1], True)
    b = np.append(a[1:], 0)
    b[last] = number[1]
    begins = met[a] | (np.append(True, last[:-1]) & fresh[segment])
    _, once = np.unique(np.minimum(a, b) * len(points) + np.maximum(a, b), return_index=True)
    once.sort()
    return points, np.stack([a[once], b[once]]), _ranks(begins)[:, once]


def distinct_places(places: Ints) -> tuple[Ints, Ints]:
    """Places (k, 2), sorted by x, then y, each once, and the number (n,) of each given one (n, 2).

    They lie within a few sides of a tile: the product of their extents is below 2**63.
    """
    low = places.min(axis=0, initial=np.iinfo(np.int64).max)
    x, y = (places - low).T
    height = int(y.max(initial=0)) + 1
    key, number = np.unique(x * height + y, return_inverse=True)
    return np.stack(np.divmod(key, height), axis=1) + low, number


def _crossings(start: Ints, end: Ints, *, pairs: Ints) -> Ints:
    """The grid points (m, 2) nearest to where pairs of segments cross between their ends."""
    one, other = pairs[:, pairs[0] < pairs[1]]
    side, far = (_cross(end[one] - start[one], ends[other] - start[one]) for ends in (start, end))
    apart = np.sign(side) * np.sign(far) < 0
    one, other, side, far = one[apart], other[apart], side[apart], far[apart]
    direction = end[other] - start[other]
    here, there = (_cross(direction, ends[one] - start[other]) for ends in (start, end))
    cross = np.sign(here) * np.sign(there) < 0
    return _rounded(start[other[cross]], direction[cross], part=side[cross], whole=(side - far)[cross])


def _rounded(start: Ints, direction: Ints, *, part: Ints, whole: Ints) -> Ints:
    """The grid points (n, 2) nearest to ``part / whole`` of directions from starts; halves are rounded up."""
    part, whole = (part * np.sign(whole))[:, None], np.abs(whole)[:, None]
    if 2.0 * np.abs(direction).max(initial=0) * float(whole.max(initial=0)) >= _EXACT:
        direction, part, whole = (values.astype(object) for values in (direction, part, whole))
    nearest: Ints = start + ((2 * direction * part + whole) // (2 * whole)).astype(np.int64)
    return nearest


def _hot_pixels(start: Ints, end: Ints, *, fresh: Bools, crossings: Ints) -> tuple[Ints, Ints, Bools]:
    """Hot pixels (k, 2), numbers (2, n) of segments' ends, and where several ends or a crossing lie."""
    n = len(start)
    points, number = distinct_places(np.concatenate([start, end, crossings]))
    ends = np.append(number[:n][fresh], number[n:])
    met = np.bincount(ends, minlength=len(points)) > 1
    met[number[2 * n :]] = True
    return points, number[: 2 * n].reshape(2, n), met


def _passed(
    start: Ints, end: Ints, *, points: Ints, number: Ints, tree: shapely.STRtree
) -> tuple[Ints, Ints]:
    """Segments, and the hot pixels between their ends that they pass."""
    pixel, segment = tree.query(shapely.points(points.astype(float)))
    between = (pixel != number[0][segment]) & (pixel != number[1][segment])
    pixel, segment = pixel[between], segment[between]
    direction = end[segment] - start[segment]
    side = _cross(direction, points[pixel] - start[segment]) * 2
    reach = np.abs(direction).sum(axis=1)
    falls = direction.prod(axis=1) < 0
    # Of a pixel's corners only the lower left belongs to it.
    corner = (np.abs(side) == reach) & falls & ((side > 0) == (direction[:, 0] > 0))
    passed = (np.abs(side) < reach) | corner | (direction == 0).any(axis=1)
    return segment[passed], pixel[passed]


def _along(direction: Ints, places: Ints, *, segment: Ints) -> tuple[Ints, Ints]:
    """Keys by which points (n, 2) on segments lie along them: the longer axis (last), and the other."""
    forward = places * np.sign(direction)[segment]
    flat = np.abs(direction[segment, 0]) >= np.abs(direction[segment, 1])
    return np.where(flat, forward[:, 1], forward[:, 0]), np.where(flat, forward[:, 0], forward[:, 1])


def _ranks(begins: Bools) -> Ints:
    """Ranks (2, n) of the half-edges of pieces in runs: of each run forth, then back."""
    first = np.flatnonzero(begins)
    count = np.diff(first, append=len(begins))
    begin, count = np.repeat(first, count), np.repeat(count, count)
    nth = np.arange(len(begins)) - begin
    ranks: Ints = 2 * begin + np.stack([nth, 2 * count - 1 - nth])
    return ranks


def _cross(u: Ints, v: Ints) -> Ints:
    product: Ints = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    return product
