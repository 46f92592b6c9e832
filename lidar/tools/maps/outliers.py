"""Statistical outlier filter of a map: points that are far from their neighbours, out of core."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from geoscene.support.columns import row_blocks
from lidar.dataset.formats.table import Table
from lidar.tools.maps.squares import Square, Squares, squares_beside

_SIDE = 16.0  # metres: side of the squares whose points are worked on at once
_FARTHEST = 4.0  # metres: neighbours farther away count as this far, so that a margin of it is enough
_BLOCK = 1 << 17  # points whose neighbours are sought at once


class Outliers:
    """Points whose mean distance to their neighbours is beyond a limit, which is that of the whole map.

    The limit is the mean of these distances plus ``factor`` standard deviations (Rusu et al. 2008). The
    result does not depend on the squares: of each point the true neighbours are found.

    neighbours : number of the nearest ones
    left_out   : number of points
    """

    def __init__(self, neighbours: int, factor: float) -> None:
        self.left_out = 0
        self._neighbours, self._factor = neighbours, factor

    def without(
        self, tables: Iterator[Table], *, out: Path, offset: tuple[float, float, float]
    ) -> Iterator[Table]:
        """The tables without outliers, square by square; points are on disk meanwhile, beside ``out``."""
        with squares_beside(out, _SIDE, offset=offset, what="outliers") as squares:
            for table in tables:
                squares.add(squares.records(table))
            count, total, squared = 0, 0.0, 0.0
            for square in squares:
                spacing = self._spacing(squares, square)
                spacing.tofile(_spacing_file(squares, square))
                count += len(spacing)
                total += float(spacing.sum(dtype=float))
                squared += float((spacing.astype(float) ** 2).sum())
            mean = total / max(count, 1)
            limit = mean + self._factor * max(squared / max(count, 1) - mean**2, 0.0) ** 0.5
            for square in squares:
                data, spacing = squares.all_of(square), np.fromfile(_spacing_file(squares, square), "<f4")
                for rows in row_blocks(len(data), _BLOCK):
                    kept = data[rows][spacing[rows] <= limit]
                    self.left_out += len(data[rows]) - len(kept)
                    yield squares.table(kept)

    def _spacing(self, squares: Squares, square: Square) -> NDArray[np.float32]:
        """Mean distances (n,) of a square's points to their neighbours in it and in those around it."""
        column, row = square
        low = np.array([column, row]) * squares.side - _FARTHEST
        high = low + squares.side + 2 * _FARTHEST
        around = []
        for i in range(column - 1, column + 2):
            for j in range(row - 1, row + 2):
                data = squares.all_of((i, j))
                xyz = np.column_stack([data[axis] for axis in "xyz"])
                around.append(xyz[((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)])
        tree = KDTree(np.concatenate(around))
        here = squares.all_of(square)
        spacing = np.empty(len(here), np.float32)
        for rows in row_blocks(len(here), _BLOCK):
            xyz = np.column_stack([here[axis][rows] for axis in "xyz"])
            away, _ = tree.query(xyz, k=self._neighbours + 1, distance_upper_bound=_FARTHEST)
            # The nearest is the point itself; of those that are too few the distance is infinite.
            spacing[rows] = np.minimum(away[:, 1:], _FARTHEST).mean(axis=1)
        return spacing


def _spacing_file(squares: Squares, square: Square) -> Path:
    path = squares.path(square)
    return path.with_name(f"{path.name}.spacing")
