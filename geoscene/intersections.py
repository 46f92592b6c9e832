"""Self-intersections of triangle meshes, decided exactly on a grid."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.typing import Bools, Ints

_AT_ONCE = 400_000
"""Pairs of faces tested at once, which bounds the memory."""

_LOW = 25
"""Bits of the lower part into which products are split, so that sums of products stay within 64 bits."""

_MASK = (1 << _LOW) - 1

_EDGES = ((0, 1), (1, 2), (2, 0))
"""Start and end of each edge of a triangle."""


def intersecting_faces(cells: Ints, faces: Ints, *, owner: NDArray[np.integer]) -> Ints:
    """Pairs (k, 2) of faces of one owner that have more in common than the vertices and edges they share.

    Faces that only touch, as a corner that lies on another face, are among them.

    cells : (n, 3) whole grid numbers of the vertices, each place once per owner; all within 2**27 of another
    faces : (m, 3) vertices of each face, none degenerate
    owner : (m,) number of the solid that each face belongs to
    """
    corners = cells[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    found = [np.empty((0, 2), np.int64)]
    tree = shapely.STRtree(boxes)
    for first in range(0, len(faces), 20_000):
        i, j = tree.query(boxes[first : first + 20_000])
        i = i.astype(np.int64) + first
        j = j.astype(np.int64)
        near = (i < j) & (owner[i] == owner[j])
        i, j = i[near], j[near]
        near = (low[i, 2] <= high[j, 2]) & (low[j, 2] <= high[i, 2])
        i, j = i[near], j[near]
        for start in range(0, len(i), _AT_ONCE):
            a, b = i[start : start + _AT_ONCE], j[start : start + _AT_ONCE]
            hit = _intersect(corners[a], corners[b], same=faces[a].T[:, None] == faces[b].T[None])
            found.append(np.stack([a[hit], b[hit]], axis=1))
    return np.concatenate(found)


def _intersect(first: Ints, second: Ints, *, same: Bools) -> Bools:
    """(n,) bool, pairs of triangles (n, 3, 3) that intersect outside their common corners and edges.

    same : (3, 3, n) bool, corner i of the first is corner j of the second
    """
    shared = same.sum(axis=(0, 1))
    common: tuple[Bools, Bools] = np.any(same, axis=1), np.any(same, axis=0)
    hit: Bools = shared == 3
    own = np.stack([_sides(second, first[:, k]) for k in range(3)])
    others = np.stack([_sides(first, second[:, k]) for k in range(3)])
    apart = _one_side(own, common[0]) | _one_side(others, common[1])
    rows = np.flatnonzero(~hit & ~apart)
    folded = rows[shared[rows] == 2]
    hit[folded] = _folded(first[folded], second[folded], common=(common[0][:, folded], common[1][:, folded]))
    rows = rows[shared[rows] < 2]
    for one, two, side, known in ((first, second, own, common[0]), (second, first, others, common[1])):
        for a, b in _EDGES:
            free = rows[~hit[rows] & ~known[a, rows] & ~known[b, rows]]
            ends = side[a, free], side[b, free]
            hit[free] = _pierces(one[free, a], one[free, b], triangle=two[free], ends=ends)
    return hit


def _one_side(sides: Ints, common: Bools) -> Bools:
    """(n,) bool, all corners that are not common lie strictly on one side of a plane; both (3, n)."""
    up = ((sides > 0) | common).all(axis=0)
    down = ((sides < 0) | common).all(axis=0)
    return np.asarray(up | down, np.bool_)


def _sides(triangle: Ints, point: Ints) -> Ints:
    """Side (n,) of planes of triangles (n, 3, 3) on which points (n, 3) lie: 1, 0 or -1."""
    return _orientation(triangle[:, 0], triangle[:, 1], c=triangle[:, 2], d=point)


def _orientation(a: Ints, b: Ints, *, c: Ints, d: Ints) -> Ints:
    """Sign (n,) of the volume of tetrahedra."""
    (ux, uy, uz), (vx, vy, vz), (wx, wy, wz) = ((x - a).T for x in (b, c, d))
    high, low = 0, 0
    for w, normal in ((wx, uy * vz - uz * vy), (wy, uz * vx - ux * vz), (wz, ux * vy - uy * vx)):
        high = high + w * (normal >> _LOW)
        low = low + w * (normal & _MASK)
    high += low >> _LOW
    return np.asarray(np.where(high != 0, np.sign(high), np.sign(low & _MASK)), np.int64)


def _pierces(p: Ints, q: Ints, *, triangle: Ints, ends: tuple[Ints, Ints]) -> Bools:
    """(n,) bool, whether segments p q meet triangles (n, 3, 3); ``ends`` are the sides of p and q."""
    hit = np.zeros(len(p), np.bool_)
    level = (ends[0] == 0) & (ends[1] == 0)
    rows = np.flatnonzero(level)
    hit[rows] = _meet_in_plane(p[rows], q[rows], triangle=triangle[rows])
    rows = np.flatnonzero(~level & (ends[0] * ends[1] <= 0))
    turns = np.stack(
        [_orientation(p[rows], q[rows], c=triangle[rows, a], d=triangle[rows, b]) for a, b in _EDGES]
    )
    hit[rows] = (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
    return hit


def _plan(triangle: Ints) -> Ints:
    """The two axes (n, 2) onto which triangles (n, 3, 3) project with the greatest area."""
    normal = np.abs(np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0]))
    axes: Ints = np.array([[1, 2], [2, 0], [0, 1]])[np.argmax(normal, axis=1)]
    return axes


def _turn(a: Ints, b: Ints, *, c: Ints) -> Ints:
    """Sign (n,) of the area of triangles in the plane (n, 2 each)."""
    u, v = b - a, c - a
    return np.asarray(np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), np.int64)


def _meet_in_plane(p: Ints, q: Ints, *, triangle: Ints) -> Bools:
    """(n,) bool, whether segments in the planes of triangles (n, 3, 3) meet them."""
    axes = _plan(triangle)
    p, q = np.take_along_axis(p, axes, axis=1), np.take_along_axis(q, axes, axis=1)
    corner = [np.take_along_axis(triangle[:, k], axes, axis=1) for k in range(3)]
    inside = np.stack([_turn(corner[a], corner[b], c=p) for a, b in _EDGES])
    hit = (inside >= 0).all(axis=0) | (inside <= 0).all(axis=0)
    for a, b in _EDGES:
        hit |= _cross(p, q, a=corner[a], b=corner[b])
    return np.asarray(hit, np.bool_)


def _cross(p: Ints, q: Ints, *, a: Ints, b: Ints) -> Bools:
    """(n,) bool, whether segments p q and a b in the plane have a point in common."""
    turns = (_turn(p, q, c=a) * _turn(p, q, c=b) <= 0) & (_turn(a, b, c=p) * _turn(a, b, c=q) <= 0)
    overlap = (np.maximum(p, q) >= np.minimum(a, b)) & (np.maximum(a, b) >= np.minimum(p, q))
    return np.asarray(turns & overlap.all(axis=1), np.bool_)


def _folded(first: Ints, second: Ints, *, common: tuple[Bools, Bools]) -> Bools:
    """(n,) bool, whether coplanar triangles with a common edge lie on the same side of it.

    common : which corners (3, n) of the first and of the second are those of the edge
    """
    n, tips = np.arange(len(first)), [np.argmin(known, axis=0) for known in common]
    axes = _plan(first)
    tip, a, b, other = (
        np.take_along_axis(x, axes, axis=1)
        for x in (*(first[n, (tips[0] + k) % 3] for k in range(3)), second[n, tips[1]])
    )
    return np.asarray(_turn(a, b, c=tip) == _turn(a, b, c=other), np.bool_)
