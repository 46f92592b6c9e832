"""Self-intersections of triangle meshes, decided exactly on a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.typing import Bools, Float, Ints

_AT_ONCE = 50_000
"""Pairs of faces tested at once, which bounds the memory."""

CLEARANCE = 0.2
"""Grid steps: 0.02 mm; faces closer than this may cross in a CityJSON file, whose coordinates are rounded to
0.01 mm, and so move by up to 0.0087 mm each.

Far more than the rounding of distances from planes, for points within 2**27 steps."""

_LOW = 25
"""Bits of the lower part into which products are split, so that sums of products stay within 64 bits."""

_MASK = (1 << _LOW) - 1

_EDGES = ((0, 1), (1, 2), (2, 0))
"""Start and end of each edge of a triangle."""


def intersecting_faces(cells: Ints, faces: Ints, *, owner: NDArray[np.integer]) -> Ints:
    """Pairs (k, 2) of faces of one owner that have more in common than the vertices and edges they share.

    Faces that only touch, as a corner that lies on another face, are among them. For the arguments see
    `close_faces`.
    """
    pairs, crossing = close_faces(cells, faces, owner=owner)
    return pairs[crossing]


def close_faces(
    cells: Ints, faces: Ints, *, owner: NDArray[np.integer], body: Ints | None = None
) -> tuple[Ints, Bools]:
    """Pairs (k, 2) of faces of one owner that are closer than `CLEARANCE`, and whether they cross or touch.

    The vertices and edges that two faces share do not count, nor do, with ``body``, pairs of one body.

    cells : (n, 3) whole grid numbers of the vertices, each place once per owner; all within 2**27 of another
    faces : (m, 3) vertices of each face, none degenerate
    owner : (m,) number of the solid that each face belongs to
    body  : (m,) number of the body within the solid, ascending
    """
    if not len(faces):
        return np.empty((0, 2), np.int64), np.empty(0, np.bool_)
    corners = cells[faces]
    i, j = _near_pairs(corners, owner, body=body)
    planes = _Planes.of(corners, faces)
    found, crossing = [np.empty((0, 2), np.int64)], [np.empty(0, np.bool_)]
    for first in range(0, len(i), _AT_ONCE):
        a, b = planes.not_apart(i[first : first + _AT_ONCE], j[first : first + _AT_ONCE])
        same = common_corners(faces[a], faces[b])
        hit = _intersect(corners[a], corners[b], same=same)
        near = hit | (distances(corners[a], corners[b], same=same) < CLEARANCE)
        found.append(np.stack([a, b], axis=1)[near])
        crossing.append(hit[near])
    return np.concatenate(found), np.concatenate(crossing)


def _near_pairs(corners: Ints, owner: NDArray[np.integer], *, body: Ints | None) -> tuple[Ints, Ints]:
    """Pairs i < j of triangles (m, 3, 3) of one owner, and of two bodies if given, whose boxes overlap."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    # owners stand apart, so that triangles find only those of their own
    apart = owner * float(high[:, 0].max() - low[:, 0].min() + 1)
    boxes = shapely.box(low[:, 0] + apart, low[:, 1], high[:, 0] + apart, high[:, 1])
    tree = shapely.STRtree(boxes)
    bottom, top = low[:, 2].copy(), high[:, 2].copy()
    # the first body, of which there is most, is only asked
    start = 0 if body is None else int(np.searchsorted(body, body[0], side="right"))
    found = [np.empty((2, 0), np.int64)]
    for first in range(start, len(boxes), 20_000):
        j, i = tree.query(boxes[first : first + 20_000])
        j += first
        above = i < j if body is None else body[i] < body[j]
        i, j = i[above], j[above]
        near = (bottom[i] <= top[j]) & (bottom[j] <= top[i])
        found.append(np.stack([i[near], j[near]]))
    i, j = np.concatenate(found, axis=1)
    return i, j


@dataclass(frozen=True, slots=True)
class _Planes:
    """Planes of triangles and of their edges, rounded, which tell most pairs of triangles apart.

    vertices : (3, m) numbers of the corners
    points   : (3, 3, m) grid steps: corner, axis, triangle
    normal   : (4, 3, m) unit vectors: of the triangle, and in its plane out of each edge
    offset   : (4, m) normal . x of the points x of each plane
    """

    vertices: NDArray[np.int32]
    points: Float
    normal: Float
    offset: Float

    @classmethod
    def of(cls, corners: Ints, faces: Ints) -> _Planes:
        """The planes of triangles (m, 3, 3)."""
        points = np.ascontiguousarray((corners - corners[0, 0]).transpose(1, 2, 0))
        along = np.roll(points, -1, axis=0) - points
        upright = np.cross(along[0], along[1], axis=0).astype(float)  # of whole numbers, so it is exact
        normal = np.stack([upright, *(np.cross(edge, upright, axis=0) for edge in along)])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0)
        offset = (normal * points[[0, 0, 1, 2]]).sum(axis=1)
        return cls(np.ascontiguousarray(faces.T, np.int32), points.astype(float), normal, offset)

    def not_apart(self, a: Ints, b: Ints) -> tuple[Ints, Ints]:
        """The pairs of triangles a and b (n,) that no plane of either clearly separates."""
        for separated in (self._by_face, self._by_edges):
            for _ in range(2):
                rest = ~separated(a, b)
                a, b = b[rest], a[rest]
        return a, b

    def _by_face(self, a: Ints, b: Ints) -> Bools:
        """(n,) bool, the plane of a has all corners of b on one side, except for common corners."""
        above, below = self._sides(0, a, b=b, common=(0, 1, 2))
        return above | below

    def _by_edges(self, a: Ints, b: Ints) -> Bools:
        """(n,) bool, b lies outside an edge of a, except for common ends of the edge."""
        outside = [self._sides(k + 1, a, b=b, common=ends)[0] for k, ends in enumerate(_EDGES)]
        return np.asarray(np.any(outside, axis=0), np.bool_)

    def _sides(self, plane: int, a: Ints, *, b: Ints, common: tuple[int, ...]) -> tuple[Bools, Bools]:
        """(n,) bool, whether the corners of b are clearly above a plane of a, or clearly below it.

        common : corners of a that b may have
        """
        normal, offset = self.normal[plane][:, a], self.offset[plane][a]
        own = self.vertices[list(common)][:, a]
        above, below = np.ones((2, len(a)), np.bool_)
        for corner, number in zip(self.points, self.vertices, strict=True):
            x, y, z = corner[:, b]
            away = normal[0] * x + normal[1] * y + normal[2] * z - offset
            known = reduce(np.logical_or, own == number[b])
            above &= known | (away > CLEARANCE)
            below &= known | (away < -CLEARANCE)
        return above, below


def common_corners(first: Ints, second: Ints) -> Bools:
    """(3, 3, n) bool, corner i of the first faces (n, 3) is corner j of the second."""
    return np.asarray(first.T[:, None] == second.T[None], np.bool_)


def distances(first: Ints, second: Ints, *, same: Bools) -> Float:
    """Grid steps (n,) between those corners, edges and faces of triangles (n, 3, 3) that share no corner.

    same : (3, 3, n) bool, corner i of the first is corner j of the second
    """
    least = np.full(len(first), np.inf)
    for one, two, common in ((first, second, same), (second, first, same.transpose(1, 0, 2))):
        for k in range(3):
            away = _from_triangles(one[:, k], two)
            least = np.where(common[k].any(axis=0), least, np.minimum(least, away))
    for a, b in _EDGES:
        for c, d in _EDGES:
            known = same[a, c] | same[a, d] | same[b, c] | same[b, d]
            away = _between(first[:, a], first[:, b], c=second[:, c], d=second[:, d])
            least = np.where(known, least, np.minimum(least, away))
    return least


def _from_triangles(points: Ints, triangles: Ints) -> Float:
    """Distance (n,) of points (n, 3) from triangles (n, 3, 3); one without area is its edges."""
    a, b, c = triangles.transpose(1, 0, 2).astype(float)
    across = np.cross(b - a, c - a)
    size = np.linalg.norm(across, axis=1, keepdims=True)
    normal = np.divide(across, size, out=np.full_like(across, np.nan), where=size > 0)
    sides = [(end - start, points - start) for start, end in ((a, b), (b, c), (c, a))]
    over = np.all([np.vecdot(np.cross(side, away), normal) >= 0 for side, away in sides], axis=0)
    beside = np.min([_from_edges(away, side) for side, away in sides], axis=0)
    return np.asarray(np.where(over, np.abs(np.vecdot(points - a, normal)), beside), float)


def _from_edges(away: Float, edge: Float) -> Float:
    """Distance (n,) of points from edges; both (n, 3) from the start of each edge."""
    share = np.clip(np.vecdot(away, edge) / np.vecdot(edge, edge), 0, 1)
    return np.asarray(np.linalg.norm(away - share[:, None] * edge, axis=1), float)


def _between(a: Ints, b: Ints, *, c: Ints, d: Ints) -> Float:
    """Distance (n,) of segments a b and c d, each (n, 3) (Ericson 2005, section 5.1.9)."""
    u, v, w = (b - a).astype(float), (d - c).astype(float), (a - c).astype(float)
    uu, vv, uv, uw, vw = (np.vecdot(x, y) for x, y in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    spread = uu * vv - uv * uv
    s = np.divide(uv * vw - uw * vv, spread, out=np.zeros_like(uu), where=spread > 1e-12 * uu * vv)
    t = np.clip((uv * np.clip(s, 0, 1) + vw) / vv, 0, 1)
    s = np.clip((uv * t - uw) / uu, 0, 1)
    return np.asarray(np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1), float)


def _intersect(first: Ints, second: Ints, *, same: Bools) -> Bools:
    """(n,) bool, pairs of triangles (n, 3, 3) that intersect outside their common corners and edges.

    same : (3, 3, n) bool, corner i of the first is corner j of the second
    """
    shared = same.sum(axis=(0, 1))
    common: tuple[Bools, Bools] = np.any(same, axis=1), np.any(same, axis=0)
    hit: Bools = shared == 3
    own, others = _sides(second, first), _sides(first, second)
    apart = _one_side(own, common[0]) | _one_side(others, common[1])
    rows = np.flatnonzero(~hit & ~apart)
    folded = rows[shared[rows] == 2]
    hit[folded] = _folded(first[folded], second[folded], common=(common[0][:, folded], common[1][:, folded]))
    rows = rows[shared[rows] < 2]
    edges = []
    for one, two, side, known in ((first, second, own, common[0]), (second, first, others, common[1])):
        for a, b in _EDGES:
            free = rows[~known[a, rows] & ~known[b, rows]]
            edges.append((free, one[free, a], one[free, b], two[free], side[a, free], side[b, free]))
    row, p, q, triangle, *ends = (np.concatenate(column) for column in zip(*edges, strict=True))
    hit[row[_pierces(p, q, triangle=triangle, ends=(ends[0], ends[1]))]] = True
    return hit


def _one_side(sides: Ints, common: Bools) -> Bools:
    """(n,) bool, all corners that are not common lie strictly on one side of a plane; both (3, n)."""
    up = ((sides > 0) | common).all(axis=0)
    down = ((sides < 0) | common).all(axis=0)
    return np.asarray(up | down, np.bool_)


def _sides(triangle: Ints, points: Ints) -> Ints:
    """Sides (3, n) of planes of triangles (n, 3, 3) on which points (n, 3, 3) lie: 1, 0 or -1."""
    a, b, c = triangle.transpose(1, 2, 0)
    return np.stack([_sign(_cross(b - a, c - a), point - a) for point in points.transpose(1, 2, 0)])


def _cross(u: Ints, v: Ints) -> Ints:
    """Cross products of vectors (3, n)."""
    return np.stack([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])


def _sign(normal: Ints, along: Ints) -> Ints:
    """Signs (n,) of the scalar products of vectors (3, n), of which the first are cross products."""
    high, low = 0, 0
    for part, w in zip(normal, along, strict=True):
        high = high + w * (part >> _LOW)
        low = low + w * (part & _MASK)
    high += low >> _LOW
    return np.asarray(np.where(high != 0, np.sign(high), np.sign(low & _MASK)), np.int64)


def _pierces(p: Ints, q: Ints, *, triangle: Ints, ends: tuple[Ints, Ints]) -> Bools:
    """(n,) bool, whether segments p q meet triangles (n, 3, 3); ``ends`` are the sides of p and q."""
    hit = np.zeros(len(p), np.bool_)
    level = (ends[0] == 0) & (ends[1] == 0)
    rows = np.flatnonzero(level)
    hit[rows] = _meet_in_plane(p[rows], q[rows], triangle=triangle[rows])
    rows = np.flatnonzero(~level & (ends[0] * ends[1] <= 0))
    along = (q[rows] - p[rows]).T
    corners = (triangle[rows] - p[rows, None]).transpose(1, 2, 0)
    turns = np.stack([_sign(_cross(along, corners[a]), corners[b]) for a, b in _EDGES])
    hit[rows] = (turns >= 0).all(axis=0) | (turns <= 0).all(axis=0)
    return hit


def plan_axes(triangles: Ints | Float) -> Ints:
    """The two axes (n, 2) onto which triangles (n, 3, 3) project with the greatest area."""
    normal = np.abs(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    axes: Ints = np.array([[1, 2], [2, 0], [0, 1]])[np.argmax(normal, axis=1)]
    return axes


def _turn(a: Ints, b: Ints, *, c: Ints) -> Ints:
    """Sign (n,) of the area of triangles in the plane (n, 2 each)."""
    u, v = b - a, c - a
    return np.asarray(np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), np.int64)


def _meet_in_plane(p: Ints, q: Ints, *, triangle: Ints) -> Bools:
    """(n,) bool, whether segments in the planes of triangles (n, 3, 3) meet them."""
    axes = plan_axes(triangle)
    p, q = np.take_along_axis(p, axes, axis=1), np.take_along_axis(q, axes, axis=1)
    corner = [np.take_along_axis(triangle[:, k], axes, axis=1) for k in range(3)]
    inside = np.stack([_turn(corner[a], corner[b], c=p) for a, b in _EDGES])
    hit = (inside >= 0).all(axis=0) | (inside <= 0).all(axis=0)
    for a, b in _EDGES:
        hit |= _segments_cross(p, q, a=corner[a], b=corner[b])
    return np.asarray(hit, np.bool_)


def _segments_cross(p: Ints, q: Ints, *, a: Ints, b: Ints) -> Bools:
    """(n,) bool, whether segments p q and a b in the plane have a point in common."""
    turns = (_turn(p, q, c=a) * _turn(p, q, c=b) <= 0) & (_turn(a, b, c=p) * _turn(a, b, c=q) <= 0)
    overlap = (np.maximum(p, q) >= np.minimum(a, b)) & (np.maximum(a, b) >= np.minimum(p, q))
    return np.asarray(turns & overlap.all(axis=1), np.bool_)


def _folded(first: Ints, second: Ints, *, common: tuple[Bools, Bools]) -> Bools:
    """(n,) bool, whether coplanar triangles with a common edge lie on the same side of it.

    common : which corners (3, n) of the first and of the second are those of the edge
    """
    n, tips = np.arange(len(first)), [np.argmin(known, axis=0) for known in common]
    axes = plan_axes(first)
    tip, a, b, other = (
        np.take_along_axis(x, axes, axis=1)
        for x in (*(first[n, (tips[0] + k) % 3] for k in range(3)), second[n, tips[1]])
    )
    return np.asarray(_turn(a, b, c=tip) == _turn(a, b, c=other), np.bool_)
