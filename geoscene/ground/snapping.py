"""Snap rounding of segments on an integer grid (Hobby 1999; Guibas and Marimont 1998).

Every end of a segment, and every crossing of two rounded to the grid, is a hot pixel: a square of side 1,
open above and on the right. A segment is divided at the hot pixels that it passes. All is
decided in integers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geoscene.typing import Bools, Ints


def snap_rounded(
    start: Ints, end: Ints, *, fresh: Bools, box: Sequence[int] | None = None
) -> tuple[Ints, Ints, Ints]:
    """Segments divided where they intersect (snap rounding), each piece once.

    start, end : (n, 2) int64, less than 2**28 from each other, of different places
    fresh      : (n,) bool, segments that do not follow the one before
    box        : (xmin, ymin, xmax, ymax) in which most lie, on which the speed depends; theirs by default

    Returns points (k, 2), sorted by x, then y, numbers (2, m) of the ends of pieces, and ranks (2, m) of
    their half-edges: of each run of pieces between points at which others end or pass, forth, then back.
    """
    from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

    n = len(start)
    cells = _cells(np.concatenate([start, end]), box)
    offset, found = kernels.cells_of_segments(start, end, cells)
    crossings = kernels.crossings(start, end, cells, offset, found)
    points, number = distinct_places(np.concatenate([start, end, crossings]))
    met = np.bincount(np.append(number[:n][fresh], number[n:]), minlength=len(points)) > 1
    met[number[2 * n :]] = True
    ends, rank = kernels.pieces(
        start, end, fresh, points, number[: 2 * n].reshape(2, n), met, cells, offset, found
    )
    return points, ends, rank


def distinct_places(places: Ints) -> tuple[Ints, Ints]:
    """Places (k, 2), sorted by x, then y, each once, and the number (n,) of each given one (n, 2).

    They lie within a few sides of a tile: the product of their extents is below 2**63.
    """
    low = places.min(axis=0, initial=np.iinfo(np.int64).max)
    x, y = (places - low).T
    height = int(y.max(initial=0)) + 1
    key, number = np.unique(x * height + y, return_inverse=True)
    return np.stack(np.divmod(key, height), axis=1) + low, number


def _cells(places: Ints, box: Sequence[int] | None) -> Ints:
    """West, south, side, columns and rows of square cells over a box, about one for every two places."""
    low, high = (places.min(axis=0), places.max(axis=0)) if box is None else np.split(np.array(box), 2)
    extent = np.maximum(high - low, 1).astype(float)
    side = max(int(np.ceil(np.sqrt(2.0 * extent.prod() / len(places)))), 1)
    side = max(side, int(extent.max()) // len(places))
    return np.array([*low, side, *(extent // side + 1)], np.int64)
