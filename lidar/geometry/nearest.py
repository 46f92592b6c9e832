"""Distances of points to the nearest triangles of a tree."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.geometry.box_tree import DEPTH, FIRST, LEAF, RIGHT


@njit(cache=True, nogil=True)
def lower_to_nearest(
    points: Float, corners: Float, nodes: NDArray[np.float32], order: NDArray[np.int32], squared: Float
) -> None:
    """Lower ``squared`` (n,) to the squared distances of points to the nearest triangles, where less.

    points       : (n, 3) metres
    corners      : (k, 3, 3) float64, of the triangles, in the same frame
    nodes, order : of the triangles' boxes, see `lidar.geometry.box_tree.Tree`; of at least one triangle
    """
    links = nodes.view(np.int32)
    stack = np.empty(DEPTH, np.int64)
    bound = np.empty(DEPTH)
    for i in range(len(points)):
        p, best = points[i], squared[i]
        stack[0], bound[0], top = 0, _to_box(p, nodes[0]), 1
        while top:
            top -= 1
            node = stack[top]
            if bound[top] >= best:
                continue
            right = links[node, RIGHT]
            if right == 0:
                first = links[node, FIRST]
                for k in order[first : first + LEAF]:
                    best = min(best, _to_triangle(p, corners[k, 0], corners[k, 1], corners[k, 2]))
                continue
            left_bound, right_bound = _to_box(p, nodes[node + 1]), _to_box(p, nodes[right])
            near, far = node + 1, right
            if right_bound < left_bound:
                near, far, left_bound, right_bound = far, near, right_bound, left_bound
            stack[top], bound[top] = far, right_bound  # the nearer one is next
            stack[top + 1], bound[top + 1] = near, left_bound
            top += 2
        squared[i] = best


@njit(cache=True, nogil=True)
def _to_box(p: Any, node: Any) -> float:
    """Squared distance of a point to the box of a node."""
    total = 0.0
    for k in range(3):
        away = max(node[k] - p[k], 0.0, p[k] - node[3 + k])
        total += away * away
    return total


@njit(cache=True, nogil=True)
def _to_triangle(p: Any, a: Any, b: Any, c: Any) -> float:
    """Squared distance of a point to a triangle, by the region of its plane (Ericson 2005, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return _dot(ap, ap)
    bp = p - b
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return _dot(bp, bp)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        along = ap - d1 / (d1 - d3) * ab
        return _dot(along, along)
    cp = p - c
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return _dot(cp, cp)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        along = ap - d2 / (d2 - d6) * ac
        return _dot(along, along)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        along = bp - (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)
        return _dot(along, along)
    inside = ap - (vb / (va + vb + vc)) * ab - (vc / (va + vb + vc)) * ac
    return _dot(inside, inside)


@njit(cache=True, nogil=True)
def _dot(a: Any, b: Any) -> float:
    """Inner product of two vectors."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
