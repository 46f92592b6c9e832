"""Trees of boxes in which compiled code finds the triangles, or the instances, that a ray may hit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
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
    if not len(low):
        return Tree(np.empty((0, 8), np.float32), np.empty(0, np.int32))
    margin = _ROUNDING * max(1.0, float(np.abs(low).max()), float(np.abs(high).max()))
    order = np.argsort(_curve(low, high)).astype(np.int32)
    return Tree(_nodes(low, high, order, margin), order)


@njit(nogil=True, cache=True)
def _curve(low: Float, high: Float) -> NDArray[np.int64]:
    """Positions (n,) of the boxes' centres along a Morton curve."""
    out, least, extent = np.empty(len(low), np.int64), np.empty(3), 1e-9
    for c in range(3):
        least[c] = (low[:, c] + high[:, c]).min()
        extent = max(extent, (low[:, c] + high[:, c]).max() - least[c])
    for i in range(len(low)):
        place = 0
        for c in range(3):
            x = int((low[i, c] + high[i, c] - least[c]) / extent * (_CELLS - 1.0))
            x = (x | x << 16) & 0x0000FF0000FF
            x = (x | x << 8) & 0x00F00F00F00F
            x = (x | x << 4) & 0x0C30C30C30C3
            x = (x | x << 2) & 0x249249249249
            place |= x << c
        out[i] = place
    return out


@njit(nogil=True, cache=True)
def _nodes(low: Float, high: Float, order: NDArray[np.int32], margin: float) -> NDArray[np.float32]:
    """The nodes of a tree, halves of the order."""
    leaves = (len(order) + LEAF - 1) // LEAF
    nodes = np.empty((2 * leaves - 1, 8), np.float32)
    links = nodes.view(np.int32)
    waiting, count = np.empty((DEPTH, 3), np.int64), 1
    waiting[0] = 0, 0, leaves
    while count:
        count -= 1
        node, first, last = waiting[count]
        links[node, FIRST], links[node, RIGHT] = first * LEAF, 0
        if last - first > 1:
            half = (first + last) // 2
            links[node, RIGHT] = node + 2 * (half - first)
            waiting[count] = node + 2 * (half - first), half, last
            waiting[count + 1] = node + 1, first, half
            count += 2
    for node in range(len(nodes) - 1, -1, -1):
        right, start = links[node, RIGHT], links[node, FIRST]
        for c in range(3):
            if right:
                nodes[node, c] = min(nodes[node + 1, c], nodes[right, c])
                nodes[node, c + 3] = max(nodes[node + 1, c + 3], nodes[right, c + 3])
            else:
                least, greatest = np.inf, -np.inf
                for k in range(start, min(start + LEAF, len(order))):
                    least, greatest = min(least, low[order[k], c]), max(greatest, high[order[k], c])
                nodes[node, c], nodes[node, c + 3] = least - margin, greatest + margin
    return nodes
