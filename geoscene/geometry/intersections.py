"""Self-intersections of triangle meshes, decided exactly on a grid."""

from __future__ import annotations

import math

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float, Ints

CLEARANCE = 0.2
"""Grid steps: 0.02 mm; faces closer than this may cross in a CityJSON file, whose coordinates are rounded to
0.01 mm, and so move by up to 0.0087 mm each.

Far more than the rounding of distances from planes, for points within 2**27 steps."""

_LOW = 25
"""Bits of the lower part into which products are split, so that sums of products stay within 64 bits."""

_MASK = (1 << _LOW) - 1

_AFTER = (1, 2, 0)
"""The corner that follows each corner of a triangle: edge k goes from corner k to it."""


def intersecting_faces(cells: Ints, faces: Ints, *, owner: NDArray[np.integer]) -> Ints:
    """Pairs (k, 2) of faces of one owner that have more in common than the vertices and edges they share.

    Faces that only touch, as a corner that lies on another face, are among them. For the arguments see
    `close_faces`. Pairs of one second face follow each other by place, as in a tree of the faces' boxes.
    """
    pairs, crossing = close_faces(cells, faces, owner=owner)
    pairs = pairs[crossing]
    if len(pairs) < 2:
        return pairs
    corners = cells[faces]
    apart = owner * float(np.ptp(corners[:, :, 0]) + 1)
    low, high = corners.min(axis=1), corners.max(axis=1)
    boxes = shapely.box(low[:, 0] + apart, low[:, 1], high[:, 0] + apart, high[:, 1])
    place = np.empty(len(faces), np.int64)
    place[shapely.STRtree(boxes).query(shapely.box(*shapely.total_bounds(boxes)))] = np.arange(len(faces))
    return pairs[np.lexsort((place[pairs[:, 0]], pairs[:, 1]))]


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
    solid: Ints = owner.astype(np.int64)
    low, high = _turned_boxes(corners, solid)
    apart = solid * (high[0].max() - low[0].min() + 1)
    low[0] += apart
    high[0] += apart
    order = np.argsort(low[0])
    low, high = low.take(order, axis=1), high.take(order, axis=1)
    found = _met(
        low,
        high,
        order,
        np.arange(len(faces)) if body is None else body,
        corners - corners[0, 0],
        np.ascontiguousarray(faces, np.int64),
    )
    found = found[np.lexsort(found.T[:2])]
    return found[:, :2], found[:, 2] == _CROSSING


_APART, _NEAR, _CROSSING = 0, 1, 2
"""How two faces lie to each other: apart, closer than `CLEARANCE`, or with a point in common."""


def common_corners(first: Ints, second: Ints) -> Bools:
    """(3, 3, n) bool, corner i of the first faces (n, 3) is corner j of the second."""
    return np.asarray(first.T[:, None] == second.T[None], np.bool_)


def distances(first: Ints, second: Ints, *, same: Bools) -> Float:
    """Grid steps (n,) between those corners, edges and faces of triangles (n, 3, 3) that share no corner.

    same : (3, 3, n) bool, corner i of the first is corner j of the second
    """
    one, two = np.ascontiguousarray(first, np.int64), np.ascontiguousarray(second, np.int64)
    return _distances(one, two, np.ascontiguousarray(same.transpose(2, 0, 1), np.bool_))


def plan_axes(triangles: Ints | Float) -> Ints:
    """The two axes (n, 2) onto which triangles (n, 3, 3) project with the greatest area."""
    normal = np.abs(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]))
    axes: Ints = np.array([[1, 2], [2, 0], [0, 1]])[np.argmax(normal, axis=1)]
    return axes


@njit(cache=True, nogil=True)
def _turned_boxes(corners: Ints, owner: Ints) -> tuple[Ints, Ints]:
    """Low and high ends (3, m) of the boxes of triangles, the longest axis of the owner's box first.

    Along that the fewest faces lie side by side.
    """
    count = len(corners)
    low, high = np.empty((3, count), np.int64), np.empty((3, count), np.int64)
    owners = owner.max() + 1
    bottom, top = np.empty((owners, 3), np.int64), np.empty((owners, 3), np.int64)
    known = np.zeros(owners, np.bool_)
    for k in range(count):
        of = owner[k]
        for axis in range(3):
            a, b, c = corners[k, 0, axis], corners[k, 1, axis], corners[k, 2, axis]
            low[axis, k], high[axis, k] = min(a, b, c), max(a, b, c)
            if not known[of] or low[axis, k] < bottom[of, axis]:
                bottom[of, axis] = low[axis, k]
            if not known[of] or high[axis, k] > top[of, axis]:
                top[of, axis] = high[axis, k]
        known[of] = True
    for k in range(count):
        first = np.argmax(top[owner[k]] - bottom[owner[k]])
        for ends in (low, high):
            x, y, z = ends[first, k], ends[(first + 1) % 3, k], ends[(first + 2) % 3, k]
            ends[0, k], ends[1, k], ends[2, k] = x, y, z
    return low, high


@njit(cache=True, nogil=True, error_model="numpy")
def _met(low: Ints, high: Ints, order: Ints, body: Ints, corners: Ints, faces: Ints) -> Ints:
    """Pairs of intersecting triangles of one owner and different bodies, and their relation: (k, 3).

    The first of a pair has the smaller number.

    low, high : (3, m) ends of the triangles' boxes, sorted by their low ends on the first axis, on which the
                owners are set apart
    order     : (m,) the triangle of each box
    corners   : (m, 3, 3) grid steps of the triangles' corners
    faces     : (m, 3) vertices of the triangles
    """
    count = len(corners)
    planes = np.empty((count, 4, 4))
    for k in range(count):
        _find_planes(corners[k], planes[k])
    found = np.empty((64, 3), np.int64)
    n = 0
    same, turned = np.empty((3, 3), np.bool_), np.empty((3, 3), np.bool_)
    for i in range(count):
        x1, y0, y1, z0, z1 = high[0, i], low[1, i], high[1, i], low[2, i], high[2, i]
        for j in range(i + 1, count):
            if low[0, j] > x1:
                break
            if low[1, j] > y1 or high[1, j] < y0 or low[2, j] > z1 or high[2, j] < z0:
                continue
            a, b = min(order[i], order[j]), max(order[i], order[j])
            if body[a] == body[b]:
                continue
            state = _meeting(a, b, corners, faces, planes, same, turned)
            if state == _APART:
                continue
            if n == len(found):
                found = np.concatenate((found, np.empty_like(found)))
            found[n, 0], found[n, 1], found[n, 2] = a, b, state
            n += 1
    return found[:n]


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(first: Ints, second: Ints, same: Bools) -> Float:
    """`distances`, of triangles whose common corners are in the columns of ``same`` (n, 3, 3)."""
    found = np.empty(len(first))
    for k in range(len(first)):
        found[k] = _distance(first[k], second[k], same[k])
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _meeting(a: int, b: int, corners: Ints, faces: Ints, planes: Float, same: Bools, turned: Bools) -> int:
    """Relation of two triangles.

    planes       : (m, 4, 4) of all triangles, from `_find_planes`
    same, turned : (3, 3) room for the common corners
    """
    one, two = corners[a], corners[b]
    shared = np.int64(0)
    for i in range(3):
        for j in range(3):
            same[i, j] = turned[j, i] = faces[a, i] == faces[b, j]
            shared += same[i, j]
    if _is_separated(planes[a], two, same) or _is_separated(planes[b], one, turned):
        return _APART
    if _intersect(one, two, same, turned, shared):
        return _CROSSING
    return _NEAR if _distance(one, two, same) < CLEARANCE else _APART


@njit(cache=True, nogil=True, error_model="numpy")
def _find_planes(corner: Ints, planes: Float) -> None:
    """Set the rounded planes (4, 4) of a triangle, and in it through each edge: unit normal and offset."""
    ux, uy, uz = corner[1] - corner[0]
    vx, vy, vz = corner[2] - corner[1]
    n = (float(uy * vz - uz * vy), float(uz * vx - ux * vz), float(ux * vy - uy * vx))  # exact
    for k in range(4):
        x, y, z = n
        at = corner[max(k - 1, 0)]
        if k:
            ex, ey, ez = corner[_AFTER[k - 1]] - at
            x, y, z = ey * n[2] - ez * n[1], ez * n[0] - ex * n[2], ex * n[1] - ey * n[0]
        size = max(math.sqrt(x * x + y * y + z * z), 1.0)
        planes[k, 0], planes[k, 1], planes[k, 2] = x / size, y / size, z / size
        planes[k, 3] = planes[k, 0] * at[0] + planes[k, 1] * at[1] + planes[k, 2] * at[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _is_separated(planes: Float, other: Ints, same: Bools) -> bool:
    """Whether a plane of a triangle clearly has another triangle on one side, except for common corners.

    That is the triangle's own plane, or one through an edge, which it lies outside of; there only the ends
    of the edge count as common.
    """
    for k in range(4):
        above = below = True
        for j in range(3):
            if k == 0:
                known = same[0, j] or same[1, j] or same[2, j]
            else:
                known = same[k - 1, j] or same[_AFTER[k - 1], j]
            if known:
                continue
            away = planes[k, 0] * other[j, 0] + planes[k, 1] * other[j, 1] + planes[k, 2] * other[j, 2]
            away -= planes[k, 3]
            above &= away > CLEARANCE
            below &= away < -CLEARANCE
        if above or (k == 0 and below):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _distance(first: Ints, second: Ints, same: Bools) -> float:
    """Grid steps between those corners, edges and faces of two triangles that share no corner."""
    least = np.inf
    for k in range(3):
        if not same[k].any():
            least = min(least, _from_triangle(first[k], second))
        if not same[:, k].any():
            least = min(least, _from_triangle(second[k], first))
    for i in range(3):
        for j in range(3):
            a, b, c, d = i, _AFTER[i], j, _AFTER[j]
            if not (same[a, c] or same[a, d] or same[b, c] or same[b, d]):
                least = min(least, _between(first[a], first[b], second[c], second[d]))
    return least


@njit(cache=True, nogil=True, error_model="numpy")
def _from_triangle(point: Ints, triangle: Ints) -> float:
    """Distance of a point from a triangle; one without area is its edges."""
    ux, uy, uz = _difference(triangle[1], triangle[0])
    vx, vy, vz = _difference(triangle[2], triangle[0])
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    size = math.sqrt(nx * nx + ny * ny + nz * nz)
    over, beside = size > 0, np.inf
    for k in range(3):
        ex, ey, ez = _difference(triangle[_AFTER[k]], triangle[k])
        x, y, z = _difference(point, triangle[k])
        over &= (ey * z - ez * y) * nx + (ez * x - ex * z) * ny + (ex * y - ey * x) * nz >= 0
        square = ex * ex + ey * ey + ez * ez
        share = min(max((x * ex + y * ey + z * ez) / square, 0.0), 1.0) if square > 0 else 0.0
        x, y, z = x - share * ex, y - share * ey, z - share * ez
        beside = min(beside, math.sqrt(x * x + y * y + z * z))
    if over:
        x, y, z = _difference(point, triangle[0])
        return abs(x * nx + y * ny + z * nz) / size
    return beside


@njit(cache=True, nogil=True, error_model="numpy")
def _between(a: Ints, b: Ints, c: Ints, d: Ints) -> float:
    """Distance of segments a b and c d (Ericson 2005, section 5.1.9)."""
    ux, uy, uz = _difference(b, a)
    vx, vy, vz = _difference(d, c)
    wx, wy, wz = _difference(a, c)
    uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    uv, uw = ux * vx + uy * vy + uz * vz, ux * wx + uy * wy + uz * wz
    vw = vx * wx + vy * wy + vz * wz
    spread = uu * vv - uv * uv
    s = (uv * vw - uw * vv) / spread if spread > 1e-12 * uu * vv else 0.0
    t = min(max((uv * min(max(s, 0.0), 1.0) + vw) / vv, 0.0), 1.0) if vv > 0 else 0.0
    s = min(max((uv * t - uw) / uu, 0.0), 1.0) if uu > 0 else 0.0
    x, y, z = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def _difference(a: Ints, b: Ints) -> tuple[float, float, float]:
    """The vector from b to a."""
    return float(a[0] - b[0]), float(a[1] - b[1]), float(a[2] - b[2])


@njit(cache=True, nogil=True, error_model="numpy")
def _intersect(first: Ints, second: Ints, same: Bools, turned: Bools, shared: int | np.int64) -> bool:
    """Whether two triangles intersect outside their common corners and edges.

    turned : (3, 3), ``same`` with rows and columns exchanged
    shared : number of common corners
    """
    if shared == 3:
        return True
    own, others = np.empty(3, np.int64), np.empty(3, np.int64)
    for k in range(3):
        own[k], others[k] = _side(second, first[k]), _side(first, second[k])
    if _one_side(own, same) or _one_side(others, turned):
        return False
    if shared == 2:
        return _is_folded(first, second, same)
    return _edges_pierce(first, second, own, same) or _edges_pierce(second, first, others, turned)


@njit(cache=True, nogil=True, error_model="numpy")
def _side(triangle: Ints, point: Ints) -> int:
    """Side of the plane of a triangle on which a point lies: 1, 0 or -1."""
    return _volume_sign(triangle[1] - triangle[0], triangle[2] - triangle[0], point - triangle[0])


@njit(cache=True, nogil=True, error_model="numpy")
def _volume_sign(u: Ints, v: Ints, w: Ints) -> int:
    """Sign of the scalar product of u x v and w."""
    high, low = np.int64(0), np.int64(0)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        part = u[i] * v[j] - u[j] * v[i]
        high += w[k] * (part >> _LOW)
        low += w[k] * (part & _MASK)
    high += low >> _LOW
    return _sign(high) if high != 0 else _sign(low & _MASK)


@njit(cache=True, nogil=True, error_model="numpy")
def _sign(value: int | np.int64) -> int:
    """Sign of a number: 1, 0 or -1."""
    return int(value > 0) - int(value < 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _one_side(sides: Ints, same: Bools) -> bool:
    """Whether all corners (3,) that are not common lie strictly on one side of a plane."""
    up = down = True
    for k in range(3):
        if not same[k].any():
            up &= sides[k] > 0
            down &= sides[k] < 0
    return up or down


@njit(cache=True, nogil=True, error_model="numpy")
def _edges_pierce(one: Ints, two: Ints, sides: Ints, same: Bools) -> bool:
    """Whether an edge of a triangle without common corners intersects another triangle.

    sides : (3,) of the other's plane on which the corners lie
    """
    for a in range(3):
        b = _AFTER[a]
        if same[a].any() or same[b].any():
            continue
        p, q = one[a], one[b]
        if sides[a] == 0 and sides[b] == 0:
            if _meet_in_plane(p, q, two):
                return True
        elif sides[a] * sides[b] <= 0:
            left = right = True
            for k in range(3):
                turn = _volume_sign(q - p, two[k] - p, two[_AFTER[k]] - p)
                left &= turn >= 0
                right &= turn <= 0
            if left or right:
                return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _axes(triangle: Ints) -> tuple[int, int]:
    """The two axes onto which a triangle projects with the greatest area."""
    u, v = triangle[1] - triangle[0], triangle[2] - triangle[0]
    most, axes = np.int64(-1), (1, 2)
    for i, j in ((1, 2), (2, 0), (0, 1)):
        size = abs(u[i] * v[j] - u[j] * v[i])
        if size > most:
            most, axes = size, (i, j)
    return axes


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(a: Ints, b: Ints, c: Ints, i: int, j: int) -> int:
    """Sign of the area of a triangle in the plane of axes i and j."""
    return _sign((b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i]))


@njit(cache=True, nogil=True, error_model="numpy")
def _meet_in_plane(p: Ints, q: Ints, triangle: Ints) -> bool:
    """Whether a segment in the plane of a triangle intersects it."""
    i, j = _axes(triangle)
    left = right = True
    for k in range(3):
        a, b = triangle[k], triangle[_AFTER[k]]
        turn = _turn(a, b, p, i, j)
        left &= turn >= 0
        right &= turn <= 0
        if (
            _turn(p, q, a, i, j) * _turn(p, q, b, i, j) <= 0
            and _turn(a, b, p, i, j) * _turn(a, b, q, i, j) <= 0
            and max(p[i], q[i]) >= min(a[i], b[i])
            and max(a[i], b[i]) >= min(p[i], q[i])
            and max(p[j], q[j]) >= min(a[j], b[j])
            and max(a[j], b[j]) >= min(p[j], q[j])
        ):
            return True
    return left or right


@njit(cache=True, nogil=True, error_model="numpy")
def _is_folded(first: Ints, second: Ints, same: Bools) -> bool:
    """Whether coplanar triangles with a common edge lie on the same side of it."""
    tip = other = 0
    for k in range(3):
        if not same[k].any():
            tip = k
        if not same[:, k].any():
            other = k
    i, j = _axes(first)
    a, b = first[_AFTER[tip]], first[_AFTER[_AFTER[tip]]]
    return _turn(a, b, first[tip], i, j) == _turn(a, b, second[other], i, j)
