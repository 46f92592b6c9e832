"""Rays in float64 throughout, slowly: what the fast path is measured against."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from geoscene.typing import Float

_LEAF = 4


@njit(nogil=True, cache=True)
def _tree(low: Float, high: Float, order: Any, box: Any, child: Any) -> int:
    """Build boxes (nodes, 6) and children (nodes, 2) by halving along the longest side; the number of nodes.

    A leaf has (start, -count) for children.
    """
    stack = [(0, len(order), 0)]
    used = 1
    while stack:
        start, stop, node = stack.pop()
        for a in range(3):
            box[node, a], box[node, 3 + a] = np.inf, -np.inf
            for i in order[start:stop]:
                box[node, a] = min(box[node, a], low[i, a])
                box[node, 3 + a] = max(box[node, 3 + a], high[i, a])
        if stop - start <= _LEAF:
            child[node, 0], child[node, 1] = start, start - stop
            continue
        axis = np.argmax(box[node, 3:] - box[node, :3])
        part = order[start:stop].copy()
        order[start:stop] = part[np.argsort(low[part, axis] + high[part, axis], kind="mergesort")]
        middle = (start + stop) // 2
        child[node, 0], child[node, 1] = used, used + 1
        stack.append((start, middle, used))
        stack.append((middle, stop, used + 1))
        used += 2
    return used


@njit(nogil=True, cache=True, error_model="numpy")
def _triangle(o: Float, d: Float, a: Float, b: Float, c: Float) -> Any:
    """Ray parameter at which a ray meets a triangle, edges included; inf if it does not."""
    e, f = b - a, c - a
    n = np.cross(e, f)
    along = np.dot(n, d)
    if along == 0.0:
        return np.inf
    p, q, r = a - o, b - o, c - o
    # Signed volumes with the three edges: one sign for all inside, zero on an edge.
    u, v, w = np.dot(d, np.cross(p, q)), np.dot(d, np.cross(q, r)), np.dot(d, np.cross(r, p))
    if (u < 0.0 or v < 0.0 or w < 0.0) and (u > 0.0 or v > 0.0 or w > 0.0):
        return np.inf
    return np.dot(n, p) / along


@njit(nogil=True, cache=True, error_model="numpy")
def _pass(
    o: Float,
    d: Float,
    corners: Float,
    order: Any,
    box: Any,
    child: Any,
    near: float,
    far: float,
    ranges: Float,
    faces: Any,
) -> int:
    """Collect the nearest faces a ray meets, as many as ``ranges`` has room for; their number."""
    count, room = 0, len(ranges)
    stack = [0]
    while stack:
        node = stack.pop()
        reach = min(far, ranges[room - 1]) if count == room else far
        first, last = near, reach
        for a in range(3):
            s, t = (box[node, a] - o[a]) / d[a], (box[node, 3 + a] - o[a]) / d[a]
            if d[a] == 0.0:
                if o[a] < box[node, a] or o[a] > box[node, 3 + a]:
                    last = -np.inf
                continue
            slack = 1e-12 * (abs(s) + abs(t))
            first, last = max(first, min(s, t) - slack), min(last, max(s, t) + slack)
        if first > last:
            continue
        if child[node, 1] > 0:
            stack.append(child[node, 0])
            stack.append(child[node, 1])
            continue
        for i in order[child[node, 0] : child[node, 0] - child[node, 1]]:
            t = _triangle(o, d, corners[i, 0], corners[i, 1], corners[i, 2])
            if not near <= t <= far or t == np.inf or (count == room and t >= ranges[room - 1]):
                continue
            count = min(count + 1, room)
            e = count - 1
            while e > 0 and ranges[e - 1] > t:
                ranges[e], faces[e] = ranges[e - 1], faces[e - 1]
                e -= 1
            ranges[e], faces[e] = t, i
    return count


@njit(nogil=True, cache=True)
def _passes(
    origins: Float,
    directions: Float,
    corners: Float,
    order: Any,
    box: Any,
    child: Any,
    near: float,
    far: Float,
    ranges: Float,
    faces: Any,
) -> None:
    for i in range(len(origins)):
        _pass(origins[i], directions[i], corners, order, box, child, near, far[i], ranges[i], faces[i])


class Reference:
    """A tree of triangles; ``corners`` (m, 3, 3) are their corners in float64."""

    def __init__(self, corners: Float) -> None:
        self.corners = np.ascontiguousarray(corners, np.float64)
        m = len(corners)
        self._order = np.arange(m)
        box, child = np.empty((max(2 * m, 1), 6)), np.zeros((max(2 * m, 1), 2), np.int64)
        used = _tree(self.corners.min(axis=1), self.corners.max(axis=1), self._order, box, child) if m else 0
        self._box, self._child = box[:used], child[:used]

    def cast(
        self, origins: Float, directions: Float, *, k: int = 1, near: float = 0.0, far: float | Float = np.inf
    ) -> tuple[Float, NDArray[np.int64]]:
        """Ray parameters and faces (n, k) of the first k hits, nearest first; inf and -1 past the last."""
        o, d = (np.ascontiguousarray(np.broadcast_to(a, directions.shape)) for a in (origins, directions))
        ranges, faces = np.full((len(d), k), np.inf), np.full((len(d), k), -1, np.int64)
        reach = np.ascontiguousarray(np.broadcast_to(np.asarray(far, float), (len(d),)))
        if len(self.corners):
            _passes(o, d, self.corners, self._order, self._box, self._child, near, reach, ranges, faces)
        return ranges, faces
