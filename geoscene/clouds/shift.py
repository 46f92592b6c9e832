"""The horizontal shift between a map and a point cloud, by buildings in both."""

from __future__ import annotations

import numpy as np

from geoscene.typing import Bools, Float

CELL = 0.5
"""Metres of the rasters that are compared."""

REACH = 10
"""Cells by which they are shifted against each other, to each side."""

MARGIN = CELL * REACH
"""Metres around a square that the comparison needs."""


def agreement(high: Bools, built: Bools) -> Float:
    """Cells (2 REACH + 1, 2 REACH + 1) of a mapped building's inside at a high place minus those around it.

    The value at [REACH + r, REACH + c] is for the cloud moved by r rows and c columns.

    high  : (rows, columns) bool, cells with points high above the ground, with `REACH` cells around
    built : (rows, columns) bool, cells in mapped buildings, of the same raster
    """
    inner = built[REACH:-REACH, REACH:-REACH]
    weight = np.where(inner, 1.0, -1.0) * _near_edge(built)[REACH:-REACH, REACH:-REACH]
    rows, columns = inner.shape
    out = np.zeros((2 * REACH + 1, 2 * REACH + 1))
    for r in range(-REACH, REACH + 1):
        for c in range(-REACH, REACH + 1):
            moved = high[REACH - r : REACH - r + rows, REACH - c : REACH - c + columns]
            out[REACH + r, REACH + c] = weight[moved].sum()
    return out


def _near_edge(built: Bools) -> Bools:
    """Mask of the cells within 3 m of the outline of a mapped building, which determine the shift."""
    from scipy.ndimage import binary_dilation, binary_erosion  # noqa: PLC0415 - slow to import

    steps = int(3.0 / CELL)
    return np.asarray(binary_dilation(built, iterations=steps) & ~binary_erosion(built, iterations=steps))


def best_shift(score: Float) -> tuple[float, float, float]:
    """Metres east and north by which to move the cloud, and the gain over no shift as a share of the best.

    score : sum of `agreement` over all squares

    The peak between cells is that of a parabola through the best cell and its neighbours; zero without a
    clear peak, as where there are no buildings or the best lies at the rim.
    """
    best = score.max()
    if best <= 0:
        return 0.0, 0.0, 0.0
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    if not (0 < row < 2 * REACH and 0 < column < 2 * REACH):
        return 0.0, 0.0, 0.0
    north = row - REACH + _vertex(score[row - 1 : row + 2, column])
    east = column - REACH + _vertex(score[row, column - 1 : column + 2])
    return float(east * CELL), float(north * CELL), float((best - score[REACH, REACH]) / best)


def _vertex(three: Float) -> float:
    """Place of the extremum of a parabola through values at -1, 0 and 1."""
    bend = three[0] - 2 * three[1] + three[2]
    return float(0.5 * (three[0] - three[2]) / bend) if bend < 0 else 0.0
