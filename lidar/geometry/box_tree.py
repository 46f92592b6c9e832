"""Trees of boxes in which compiled code finds the triangles, or the instances, that a ray may hit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
