"""Candidate pairs of points and nearby shapes, by bounding boxes."""

from __future__ import annotations

import numpy as np
import shapely

from geoscene.typing import Float, Ints


def shapes_near(tree: shapely.STRtree, xy: Float, *, reach: float | Float) -> tuple[Ints, Ints]:
    """Points (k,) and rows (k,) of a tree's geometries whose bounding boxes, made wider, hold them.

    xy    : (n, 2) float64, close together, such as those of a tile
    reach : metres by which boxes are wider on each side, of all or of each geometry
    """
    none = np.empty(0, np.int64)
    if not len(xy) or not len(tree.geometries):
        return none, none
    reach = np.broadcast_to(reach, len(tree.geometries))
    most = reach.max()
    row = np.sort(tree.query(shapely.box(*(xy.min(axis=0) - most), *(xy.max(axis=0) + most))))
    point, box = points_in_boxes(xy, shapely.bounds(tree.geometries[row]), wider=reach[row])
    return point, row[box]


def points_in_boxes(xy: Float, boxes: Float, *, wider: float | Float) -> tuple[Ints, Ints]:
    """Points (k,) and the boxes (k,) that hold them, of points (n, 2) and boxes (m, 4) made wider."""
    from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

    by_y = np.argsort(xy[:, 1])
    wide = boxes + np.multiply.outer(np.broadcast_to(wider, len(boxes)), [-1.0, -1.0, 1.0, 1.0])
    point, box = kernels.in_boxes(xy[by_y], wide)
    return by_y[point], box
