"""Clusters of points that chains of links join, in time and memory that do not grow with the links."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.support.graphs import components
from geoscene.typing import Ints

_NEAREST = 8
"""Nearest points, with itself, to which each one is linked first; they join almost all cells."""

_AT_ONCE = 1_000_000
"""Pairs of points whose distances are computed at once; two cells with more get a tree."""


def linked_clusters(points: NDArray[np.floating], *, p: float) -> Ints:
    """Cluster (n,) of each point: those within a distance of 1 are linked, chains of links make a cluster.

    points : (n, d), n > 0
    p      : of the Minkowski norm: 2 for Euclid's distance, infinity for the greatest coordinate's

    A list of all links would grow with the square of the density. Here points fall into cells so small that
    all of a cell are linked; links to nearest points join cells, and where these do not, all distances
    between the points of two cells tell.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415  (0.2 s)

    points = points.astype(np.float64)
    n, axes = points.shape
    side = (1 - 1e-9) / axes ** (1 / p)
    corner, cell = np.unique(np.floor(points / side), axis=0, return_inverse=True)
    cell = cell.reshape(n)
    away, near = (column.reshape(n, -1) for column in cKDTree(points).query(points, k=min(_NEAREST, n), p=p))
    row, place = np.nonzero(away <= 1)
    cluster = components(cell[row], cell[near[row, place]], count=len(corner))
    beside = cKDTree(corner).query_pairs(np.ceil(1 / side), p=np.inf, output_type="ndarray")
    members = _Members(cell)
    while len(beside := beside[cluster[beside[:, 0]] != cluster[beside[:, 1]]]):
        beside = beside[np.argsort(members.size[beside].prod(axis=1), kind="stable")]
        ends = np.cumsum(members.size[beside].prod(axis=1))
        most = int(np.searchsorted(ends, _AT_ONCE, side="right"))
        if most:
            pair, one, other = members.pairs(beside[:most])
            apart = np.linalg.norm(points[one] - points[other], ord=p, axis=1)
            met = beside[np.unique(pair[apart <= 1])]
        else:
            most = 1
            first, second = (points[members.of(number)] for number in beside[0])
            met = beside[: int(cKDTree(first).query(second, p=p)[0].min() <= 1)]
        cluster = components(*cluster[met].T, count=len(corner))[cluster]
        beside = beside[most:]
    return cluster[cell]


class _Members:
    """The points of each cell.

    size : (m,) points of each
    """

    def __init__(self, cell: Ints) -> None:
        self.size = np.bincount(cell)
        self._rows = np.argsort(cell, kind="stable")
        self._first = np.cumsum(self.size) - self.size

    def of(self, number: int) -> Ints:
        """The points of a cell."""
        return self._rows[self._first[number] :][: self.size[number]]

    def pairs(self, cells: NDArray[np.integer]) -> tuple[Ints, Ints, Ints]:
        """All pairs of points of pairs (k, 2) of cells: row of ``cells``, and both points."""
        counts = self.size[cells].prod(axis=1)
        pair = np.repeat(np.arange(len(cells)), counts)
        number = np.arange(len(pair)) - np.repeat(np.cumsum(counts) - counts, counts)
        one, other = np.divmod(number, self.size[cells[pair, 1]])
        first = self._first[cells[pair]]
        return pair, self._rows[first[:, 0] + one], self._rows[first[:, 1] + other]
