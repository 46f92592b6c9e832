"""Rasterisation: the highest face over every cell of a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float


@njit(cache=True, nogil=True)
def draw_triangles(
    corners: Float, label: NDArray[np.uint8], height: NDArray[np.float32], labels: NDArray[np.uint8]
) -> None:
    """Rasterise triangles into a grid, in place; the highest over the middle of each cell remains.

    corners : (m, 3, 3) float64; x and y in cells from the grid's corner (column and row), z in metres
    label   : (m,) of each triangle
    height  : (rows, columns) float32, NaN where nothing has been drawn yet
    labels  : (rows, columns) label of the highest triangle; of two as high, the one drawn first stays

    A middle on an edge counts as inside, so that triangles that share an edge leave no gap. Vertical faces
    cover no cell.
    """
    rows, columns = height.shape
    for k in range(len(corners)):
        ax, ay, az = corners[k, 0]
        bx, by, bz = corners[k, 1]
        cx, cy, cz = corners[k, 2]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-12:
            continue
        top = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
        bottom = min(int(np.floor(max(ay, by, cy) - 0.5)), rows - 1)
        left = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
        right = min(int(np.floor(max(ax, bx, cx) - 0.5)), columns - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                w = 1.0 - u - v
                if u < -1e-9 or v < -1e-9 or w < -1e-9:
                    continue
                z = np.float32(u * az + v * bz + w * cz)
                if not height[row, column] >= z:
                    height[row, column] = z
                    labels[row, column] = label[k]
