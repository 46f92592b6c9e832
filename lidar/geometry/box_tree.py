"""Trees of boxes in which compiled code finds what a ray may hit, and the triangles nearest to points."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float

LEAF = 4
"""Items of a leaf."""
NODE = 32
"""Bytes of a node."""
DEPTH = 64
"""Nodes that wait during a traversal, at most."""
_ROUNDING = 2.0**-22  # of a bound, more than that of float32
_CELLS = 2.0**16  # of the widest extent: items are sorted along a curve through cells
RIGHT, FIRST = 6, 7
"""32-bit columns of a node after the six bounds: right child (0 for a leaf), first item of the order."""


class Tree(NamedTuple):
    """A binary tree over the boxes of n items.

    nodes : (k, 8) float32: least and greatest corner, rounded outwards, and, as int32, right child (0 for
            a leaf) and first item; the left child is the next node, the root the first
    order : (n,) int32, items in the order of the leaves; each has `LEAF` items, the last one fewer
    """

    nodes: NDArray[np.float32]
    order: NDArray[np.int32]


def tree_of(low: Float, high: Float) -> Tree:
    """The tree of boxes with corners ``low`` and ``high`` (n, 3), in metres."""
    n = len(low)
    if not n:
        return Tree(np.empty((0, 8), np.float32), np.empty(0, np.int32))
    order = np.argsort(_curve(low + high)).astype(np.int32)
    starts = np.arange(0, n, LEAF)
    margin = _ROUNDING * max(1.0, float(np.abs(low).max()), float(np.abs(high).max()))
    least = np.minimum.reduceat(low[order], starts) - margin
    greatest = np.maximum.reduceat(high[order], starts) + margin
    nodes = np.empty((2 * len(starts) - 1, 8), np.float32)
    links, levels = nodes.view(np.int32), []
    node, first, last = (np.array([k]) for k in (0, 0, len(starts)))  # halves of the leaves, by level
    while len(node):
        half, inner = (first + last) // 2, last - first > 1
        right = node + 2 * (half - first)
        links[node, RIGHT], links[node, FIRST] = np.where(inner, right, 0), first * LEAF
        levels.append((node[inner], right[inner]))
        leaf, k = node[~inner], first[~inner]
        nodes[leaf, :3], nodes[leaf, 3:6] = least[k], greatest[k]
        node, first, last = (
            np.concatenate([node[inner] + 1, right[inner]]),
            np.concatenate([first[inner], half[inner]]),
            np.concatenate([half[inner], last[inner]]),
        )
    for node, right in reversed(levels):
        nodes[node, :3] = np.minimum(nodes[node + 1, :3], nodes[right, :3])
        nodes[node, 3:6] = np.maximum(nodes[node + 1, 3:6], nodes[right, 3:6])
    return Tree(nodes, order)


def _curve(places: Float) -> NDArray[np.int64]:
    """Positions (n,) of places (n, 3) along a Morton curve."""
    least = places.min(axis=0)
    extent = max(1e-9, float((places.max(axis=0) - least).max()))
    x = ((places - least) * ((_CELLS - 1.0) / extent)).astype(np.int64)
    for shift, kept in ((16, 0x0000FF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        x = (x | x << shift) & kept
    out: NDArray[np.int64] = x[:, 0] | x[:, 1] << 1 | x[:, 2] << 2
    return out


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
