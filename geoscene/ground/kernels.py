"""Compiled loops: intersections of a tile's segments, their rings, and point location.

They search, sort and choose in plain loops: numba compiles the general functions of NumPy for each type of
argument, which made the first build wait half as long again.
"""

from __future__ import annotations

import numpy as np

from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float, Ints

_NEAR = 2
"""Steps of the grid around a segment whose cells have it; pixels that it passes are nearer."""

_DOUBT = 1e-15
"""Share of its two products to which the sign of a determinant of doubles is sure."""


@njit(cache=True, nogil=True, error_model="numpy")
def cells_of_segments(start: Ints, end: Ints, cells: Ints) -> tuple[Ints, Ints]:
    """Segments by cell, in compressed rows (offset, segment); those of a cell ascend.

    start, end : (n, 2) int64
    cells      : west, south, side, columns and rows of the cells, row by row from the south; those at the
                 sides have what lies beyond, too
    """
    west, south, side, columns, rows = cells
    offset = np.zeros(columns * rows + 1, np.int64)
    found = np.empty(0, np.int64)
    for fill in (False, True):
        for k in range(len(start)):
            (ax, ay), (bx, by) = start[k], end[k]
            low, high = min(ax, bx), max(ax, bx)
            slope = (by - ay) / (bx - ax) if ax != bx else 0.0
            first = _step(low - _NEAR, west, side, columns)
            last = _step(high + _NEAR, west, side, columns)
            for column in range(first, last + 1):
                y0, y1 = ay, by
                if first < last and ax != bx:
                    left, right = low, high
                    if column > first:
                        left = min(max(low, west + column * side - _NEAR), high)
                    if column < last:
                        right = max(min(high, west + (column + 1) * side + _NEAR), low)
                    y0, y1 = ay + int(slope * (left - ax)), ay + int(slope * (right - ax))
                bottom = _step(min(y0, y1) - _NEAR, south, side, rows)
                top = _step(max(y0, y1) + _NEAR, south, side, rows)
                for row in range(bottom, top + 1):
                    cell = row * columns + column
                    if fill:
                        found[offset[cell]] = k
                        offset[cell] += 1
                    else:
                        offset[cell + 1] += 1
        if not fill:
            offset = np.cumsum(offset)
            found = np.empty(offset[-1], np.int64)
    for cell in range(len(offset) - 1, 0, -1):
        offset[cell] = offset[cell - 1]
    offset[0] = 0
    return offset, found


@njit(cache=True, nogil=True, error_model="numpy")
def crossings(start: Ints, end: Ints, cells: Ints, offset: Ints, found: Ints) -> Ints:
    """The grid points (m, 2) nearest to where two segments cross between their ends; halves are rounded up.

    cells, offset, found : as in `cells_of_segments`
    """
    west, south, side, columns, rows = cells
    points, count = np.empty((256, 2), np.int64), 0
    for cell in range(columns * rows):
        here = found[offset[cell] : offset[cell + 1]]
        for k in range(len(here)):
            (ax, ay), (bx, by) = start[here[k]], end[here[k]]
            ux, uy = bx - ax, by - ay
            for other in here[k + 1 :]:
                (cx, cy), (dx, dy) = start[other], end[other]
                if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx):
                    continue
                if max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
                    continue
                part = ux * (cy - ay) - uy * (cx - ax)
                far = ux * (dy - ay) - uy * (dx - ax)
                if not (part < 0 < far or far < 0 < part):
                    continue
                vx, vy = dx - cx, dy - cy
                here_, there = vx * (ay - cy) - vy * (ax - cx), vx * (by - cy) - vy * (bx - cx)
                if not (here_ < 0 < there or there < 0 < here_):
                    continue
                whole = part - far
                if whole < 0:
                    part, whole = -part, -whole
                x, y = cx + _nearest(vx, part, whole), cy + _nearest(vy, part, whole)
                if _step(y, south, side, rows) * columns + _step(x, west, side, columns) != cell:
                    continue  # another cell has the same two
                if count == len(points):
                    points = np.concatenate((points, np.empty_like(points)))
                points[count, 0], points[count, 1] = x, y
                count += 1
    return points[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def pieces(
    start: Ints,
    end: Ints,
    fresh: Bools,
    points: Ints,
    number: Ints,
    met: Bools,
    cells: Ints,
    offset: Ints,
    found: Ints,
) -> tuple[Ints, Ints]:
    """Ends (2, m) of the pieces into which segments are divided at the points they pass, and ranks (2, m).

    points : (k, 2) int64, hot pixels, which are open above and on the right
    number : (2, n) int64, those of the segments' ends
    met    : (k,) bool, pixels at which several ends or a crossing lie; those passed are entered
    """
    west, south, side, columns, rows = cells
    n = len(start)
    segment, pixel, count = np.empty(256, np.int64), np.empty(256, np.int64), 0
    passed = np.zeros(n + 1, np.int64)
    for p in range(len(points)):
        x, y = points[p]
        cell = _step(y, south, side, rows) * columns + _step(x, west, side, columns)
        for k in found[offset[cell] : offset[cell + 1]]:
            if number[0, k] == p or number[1, k] == p or not _passes(start[k], end[k], x, y):
                continue
            if count == len(segment):
                segment = np.concatenate((segment, np.empty_like(segment)))
                pixel = np.concatenate((pixel, np.empty_like(pixel)))
            segment[count], pixel[count] = k, p
            passed[k + 1] += 1
            met[p] = True
            count += 1
    first = np.cumsum(passed)
    on = np.empty(count, np.int64)
    fill = first.copy()
    for k in range(count):
        on[fill[segment[k]]] = pixel[k]
        fill[segment[k]] += 1
    ends, begins = np.empty((2, n + count), np.int64), np.empty(n + count, np.bool_)
    t = 0
    for k in range(n):
        along = on[first[k] : first[k + 1]]
        _sort_along(along, points, end[k] - start[k])
        at = number[0, k]
        for nth in range(len(along) + 1):
            begins[t] = met[at] or (nth == 0 and fresh[k])
            ends[0, t] = at
            at = along[nth] if nth < len(along) else number[1, k]
            ends[1, t] = at
            t += 1
    return _once(ends, _ranks(begins), len(points))


@njit(cache=True, nogil=True, error_model="numpy")
def rings(
    points: Float, ends: Ints, rank: Ints, box: Float
) -> tuple[Ints, Ints, Ints, Ints, Ints, Ints, float]:
    """The rings of faces within a box; arguments as in `geoscene.ground.faces.faces`.

    Returns ends a and b, face and opposite face of half-edges; offsets of rings in them and of faces in the
    rings; and the area of the faces.
    """
    two = 2.0 * box
    chosen = np.zeros(ends.shape[1], np.bool_)
    for k in range(len(chosen)):
        x, y = points[ends[0, k]] + points[ends[1, k]]
        chosen[k] = two[0] <= x <= two[2] and two[1] <= y <= two[3]
    while True:
        ends, rank = _columns(ends, chosen), _columns(rank, chosen)
        m = ends.shape[1]
        start = np.concatenate((ends[0], ends[1]))
        stop = np.concatenate((ends[1], ends[0]))
        star, offset = _stars(points, start, stop)
        following = np.empty(2 * m, np.int64)
        for v in range(len(points)):
            for k in range(offset[v], offset[v + 1]):
                after = k + 1 if k + 1 < offset[v + 1] else offset[v]
                following[_twin(star[k], m)] = star[after]
        ring = _cycles(following)
        chosen, bridges = np.empty(m, np.bool_), 0
        for k in range(m):
            chosen[k] = ring[k] != ring[m + k]
            bridges += not chosen[k]
        if not bridges:
            break
    _split_touching(following, ring, star, offset)
    order, offset = _in_rings(following, np.concatenate((rank[0], rank[1])))
    area, owner = _owners(points, start, stop, order, offset, box)
    faces = 0
    for r in range(len(area)):
        faces += owner[r] == r
    # Rings by face: the one around it, then those within.
    face_of_ring = np.full(len(area), -1, np.int64)
    face, size = 0, np.zeros(faces + 1, np.int64)
    for r in range(len(area)):
        if owner[r] == r:
            face_of_ring[r] = face
            face += 1
    for r in range(len(area)):
        if owner[r] >= 0:
            face_of_ring[r] = face_of_ring[owner[r]]
            size[face_of_ring[r] + 1] += 1
    face_offset = np.cumsum(size)
    chosen_rings, place = np.empty(face_offset[-1], np.int64), face_offset[:-1].copy()
    for around in (True, False):
        for r in range(len(area)):
            if owner[r] >= 0 and (owner[r] == r) == around:
                chosen_rings[place[face_of_ring[r]]] = r
                place[face_of_ring[r]] += 1
    face_of = np.full(2 * m, -1, np.int64)
    ring_offset, covered = np.zeros(len(chosen_rings) + 1, np.int64), 0.0
    for k in range(len(chosen_rings)):
        r = chosen_rings[k]
        covered -= area[r]
        ring_offset[k + 1] = ring_offset[k] + offset[r + 1] - offset[r]
        for h in order[offset[r] : offset[r + 1]]:
            face_of[h] = face_of_ring[r]
    a, b = np.empty(ring_offset[-1], np.int64), np.empty(ring_offset[-1], np.int64)
    cell, other = np.empty_like(a), np.empty_like(a)
    for k in range(len(chosen_rings)):
        of = order[offset[chosen_rings[k]] : offset[chosen_rings[k] + 1]]
        for nth in range(len(of)):
            e, h = ring_offset[k] + nth, of[nth]
            a[e], b[e] = start[h], stop[h]
            cell[e], other[e] = face_of[h], face_of[_twin(h, m)]
    return a, b, cell, other, ring_offset, face_offset, covered


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _step(value: int, low: int, side: int, count: int) -> int:
    return min(max((value - low) // side, 0), count - 1)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _nearest(direction: int, part: int, whole: int) -> int:
    """The integer nearest to ``direction * part / whole``."""
    near = int(np.rint(direction * (part / whole)))  # off by one at most
    # The products may exceed 64 bits, what is left of them does not: the excess cancels out.
    rest = 2 * direction * part + whole - 2 * whole * near
    return near + rest // (2 * whole)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _passes(start: Ints, end: Ints, x: int, y: int) -> bool:
    """Whether a segment passes the hot pixel of a point in its bounding box."""
    (ax, ay), (bx, by) = start, end
    if x < min(ax, bx) or x > max(ax, bx) or y < min(ay, by) or y > max(ay, by):
        return False
    dx, dy = bx - ax, by - ay
    if dx == 0 or dy == 0:
        return True
    side = 2 * (dx * (y - ay) - dy * (x - ax))
    reach = abs(dx) + abs(dy)
    # Of a pixel's corners only the lower left belongs to it.
    falls = (dx < 0) != (dy < 0)
    passes: bool = abs(side) < reach or (abs(side) == reach and falls and (side > 0) == (dx > 0))
    return passes


@njit(cache=True, nogil=True, error_model="numpy")
def _sort_along(chosen: Ints, points: Ints, direction: Ints) -> None:
    """Sort numbers of points on a segment, in place: by the longer axis, then by the other."""
    axis = 0 if abs(direction[0]) >= abs(direction[1]) else 1
    one, other = np.sign(direction[axis]), np.sign(direction[1 - axis])
    for nth in range(1, len(chosen)):
        k, p = nth, chosen[nth]
        x, y = one * points[p, axis], other * points[p, 1 - axis]
        while k > 0:
            q = chosen[k - 1]
            u, v = one * points[q, axis], other * points[q, 1 - axis]
            if u < x or (u == x and v <= y):
                break
            chosen[k] = q
            k -= 1
        chosen[k] = p


@njit(cache=True, nogil=True, error_model="numpy")
def _ranks(begins: Bools) -> Ints:
    """Ranks (2, n) of the half-edges of pieces in runs: of each run forth, then back."""
    rank = np.empty((2, len(begins)), np.int64)
    first = 0
    for last in range(len(begins)):
        if last + 1 == len(begins) or begins[last + 1]:
            count = last + 1 - first
            for nth in range(count):
                rank[0, first + nth] = 2 * first + nth
                rank[1, first + nth] = 2 * first + 2 * count - 1 - nth
            first = last + 1
    return rank


@njit(cache=True, nogil=True, error_model="numpy")
def _once(ends: Ints, rank: Ints, count: int) -> tuple[Ints, Ints]:
    """The first of pieces with the same two ends."""
    latest, before = np.full(count, -1, np.int64), np.empty(ends.shape[1], np.int64)
    keep = np.zeros(ends.shape[1], np.bool_)
    for k in range(ends.shape[1]):
        low, high = min(ends[0, k], ends[1, k]), max(ends[0, k], ends[1, k])
        like = latest[low]
        while like >= 0 and max(ends[0, like], ends[1, like]) != high:
            like = before[like]
        if like < 0:
            before[k], latest[low] = latest[low], k
            keep[k] = True
    return _columns(ends, keep), _columns(rank, keep)


@njit(cache=True, nogil=True, error_model="numpy")
def _columns(table: Ints, chosen: Bools) -> Ints:
    """The chosen columns of a table of two rows."""
    found = np.empty((2, chosen.sum()), np.int64)
    n = 0
    for k in range(len(chosen)):
        if chosen[k]:
            found[0, n], found[1, n] = table[0, k], table[1, k]
            n += 1
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _first_from(values: Float, low: float) -> int:
    """The number of the first of ascending values that is not below one."""
    first, last = 0, len(values)
    while first < last:
        middle = (first + last) // 2
        if values[middle] < low:
            first = middle + 1
        else:
            last = middle
    return first


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _twin(half: int, count: int) -> int:
    """The half-edge the other way."""
    return half - count if half >= count else half + count


@njit(cache=True, nogil=True, error_model="numpy")
def _stars(points: Float, start: Ints, stop: Ints) -> tuple[Ints, Ints]:
    """Half-edges by start, then counter-clockwise, and offsets (k + 1,) of the points in them."""
    count = np.zeros(len(points) + 1, np.int64)
    for v in start:
        count[v + 1] += 1
    offset = np.cumsum(count)
    star, size = np.empty(len(start), np.int64), np.zeros(len(points), np.int64)
    for h in range(len(start)):
        v = start[h]
        k = offset[v] + size[v]
        dx, dy = points[stop[h]] - points[v]
        turn = _quarter(dx, dy)
        while k > offset[v]:
            ux, uy = points[stop[star[k - 1]]] - points[v]
            earlier = _quarter(ux, uy)
            if earlier < turn or (earlier == turn and ux * dy - uy * dx >= 0.0):
                break
            star[k] = star[k - 1]
            k -= 1
        star[k] = h
        size[v] += 1
    return star, offset


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _quarter(dx: float, dy: float) -> int:
    """Which comes first counter-clockwise from west: directions to the south, east, the north, west."""
    if dy == 0.0:
        return 1 if dx > 0.0 else 3
    return 0 if dy < 0.0 else 2


@njit(cache=True, nogil=True, error_model="numpy")
def _cycles(following: Ints) -> Ints:
    """The number of the cycle that each half-edge is in."""
    number, count = np.full(len(following), -1, np.int64), 0
    for first in range(len(following)):
        if number[first] < 0:
            h = first
            while number[h] < 0:
                number[h] = count
                h = following[h]
            count += 1
    return number


@njit(cache=True, nogil=True, error_model="numpy")
def _split_touching(following: Ints, ring: Ints, star: Ints, offset: Ints) -> None:
    """Divide, in place, rings that pass a point more than once there."""
    m = len(ring) // 2
    for v in range(len(offset) - 1):
        around = star[offset[v] : offset[v + 1]]
        for k in range(1, len(around)):
            number, earlier = ring[around[k]], 0
            for h in around[:k]:
                earlier += ring[h] == number
            if earlier != 1:
                continue
            # Clockwise around the point: each half-edge that arrives goes on along the next that leaves.
            first = arriving = -1
            for h in around[::-1]:
                if ring[_twin(h, m)] == number:
                    arriving = _twin(h, m)
                if ring[h] == number:
                    if arriving >= 0:
                        following[arriving] = h
                        arriving = -1
                    if first < 0:
                        first = h
            if arriving >= 0:
                following[arriving] = first


@njit(cache=True, nogil=True, error_model="numpy")
def _in_rings(following: Ints, rank: Ints) -> tuple[Ints, Ints]:
    """Half-edges ring by ring, each from its least rank on, rings by that rank; and where rings begin."""
    n = len(following)
    greatest = -1
    for h in range(n):
        greatest = max(greatest, int(rank[h]))
    by_rank: Ints = np.full(greatest + 1, -1, np.int64)
    for h in range(n):
        by_rank[rank[h]] = h
    order, offset, count, k = np.empty(n, np.int64), np.empty(n + 1, np.int64), 0, 0
    done = np.zeros(n, np.bool_)
    for first in by_rank:
        if first < 0 or done[first]:
            continue
        offset[count] = k
        count += 1
        h = first
        while not done[h]:
            done[h] = True
            order[k] = h
            k += 1
            h = following[h]
    offset[count] = k
    return order, offset[: count + 1]


@njit(cache=True, nogil=True, error_model="numpy")
def _owners(
    points: Float, start: Ints, stop: Ints, order: Ints, offset: Ints, box: Float
) -> tuple[Float, Ints]:
    """Areas of rings, below 0 for those around faces, and the ring around the face that each bounds.

    -1 for rings that bound none in the box.
    """
    count = len(offset) - 1
    area, bounds = np.zeros(count), np.empty((count, 4))
    owner = np.full(count, -1, np.int64)
    shells, holes = np.empty(count, np.int64), np.empty(count, np.int64)
    shell_count = hole_count = 0
    for r in range(count):
        x0, y0 = points[start[order[offset[r]]]]
        west, south, east, north = x0, y0, x0, y0
        for h in order[offset[r] : offset[r + 1]]:
            (ax, ay), (bx, by) = points[start[h]], points[stop[h]]
            area[r] += 0.5 * ((ax - x0) * (by - y0) - (ay - y0) * (bx - x0))
            west, south, east, north = min(west, ax), min(south, ay), max(east, ax), max(north, ay)
        bounds[r, 0], bounds[r, 1], bounds[r, 2], bounds[r, 3] = west, south, east, north
        if area[r] > 0.0:
            holes[hole_count] = r
            hole_count += 1
        elif area[r] < 0.0 and west >= box[0] and south >= box[1] and east <= box[2] and north <= box[3]:
            owner[r] = r
            shells[shell_count] = r
            shell_count += 1
    for r in holes[:hole_count]:
        h = order[offset[r]]
        x, y = 0.5 * (points[start[h]] + points[stop[h]])
        for s in shells[:shell_count]:
            west, south, east, north = bounds[s]
            if x <= west or x >= east or y <= south or y >= north:
                continue
            smaller = owner[r] < 0 or area[s] >= area[owner[r]]
            if smaller and _holds(points, start, stop, order[offset[s] : offset[s + 1]], x, y):
                owner[r] = s
    return area, owner


@njit(cache=True, nogil=True, error_model="numpy")
def _holds(points: Float, start: Ints, stop: Ints, ring: Ints, x: float, y: float) -> bool:
    """Whether a point, exact on half the grid, is within a ring and not on it."""
    inside = False
    for h in ring:
        (ax, ay), (bx, by) = points[start[h]], points[stop[h]]
        if max(ay, by) < y or min(ay, by) > y:
            continue
        side = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        if side == 0.0 and min(ax, bx) <= x <= max(ax, bx):
            return False
        if (ay > y) != (by > y) and (side > 0.0) == (by > ay):
            inside = not inside
    return inside


@njit(cache=True, nogil=True, error_model="numpy")
def last_around(xy: Float, corners: Float, ring: Ints, polygon: Ints) -> tuple[Ints, Ints, Ints]:
    """The last of the polygons (n,) around each point, -1 for none; and points and polygons left in doubt.

    A point on an outline is not inside. In doubt are those nearer to an outline than rounding tells.

    xy      : (n, 2) float64, sorted by y
    corners : (m, 2) float64, of closed rings
    ring    : (r + 1,) int64, offsets of the rings in them
    polygon : (r,) int64, the polygon that each ring is of, ascending
    """
    x, y = xy[:, 0].copy(), xy[:, 1].copy()
    west = np.inf
    for p in range(len(x)):
        west = min(west, x[p])
    best = np.full(len(x), -1, np.int64)
    state = np.zeros(len(x), np.uint8)  # bit 0: inside, bit 1: in doubt
    point, of, count = np.empty(16, np.int64), np.empty(16, np.int64), 0
    first, last = len(x), 0
    for r in range(len(polygon)):
        for k in range(ring[r], ring[r + 1] - 1):
            (ax, ay), (bx, by) = corners[k], corners[k + 1]
            low, high = min(ay, by), max(ay, by)
            left, right = min(ax, bx), max(ax, bx)
            if right < west or high < y[0] or low > y[-1]:
                continue
            begin = _first_from(y, low)
            for p in range(begin, len(y)):
                if y[p] > high:
                    last = max(last, p)
                    break
                if x[p] > right:
                    continue
                on_end = x[p] == bx and y[p] == by
                if on_end or (low == high and x[p] >= left):
                    state[p] |= 2
                elif (ay > y[p]) != (by > y[p]):
                    if x[p] < left:
                        state[p] ^= 1
                        continue
                    one, other = (ax - x[p]) * (by - y[p]), (ay - y[p]) * (bx - x[p])
                    if abs(one - other) <= _DOUBT * (abs(one) + abs(other)):
                        state[p] |= 2
                    elif (one > other) == (by > ay):
                        state[p] ^= 1
            else:
                last = len(y)
            first = min(first, begin)
        if r + 1 < len(polygon) and polygon[r + 1] == polygon[r]:
            continue
        for p in range(first, last):
            if state[p] == 1:
                best[p] = polygon[r]
            elif state[p] > 1:
                if count == len(point):
                    point, of = np.concatenate((point, point)), np.concatenate((of, of))
                point[count], of[count] = p, polygon[r]
                count += 1
            state[p] = 0
        first, last = len(x), 0
    return best, point[:count], of[:count]


@njit(cache=True, nogil=True, error_model="numpy")
def inner_points(points: Float, a: Ints, ring: Ints, face: Ints) -> Float:
    """A point (n, 2) within each face: amid the widest section at half its height, between two vertices.

    a, ring, face : as in `geoscene.ground.faces.GroundFaces`
    """
    found = np.empty((len(face) - 1, 2))
    cuts = np.empty(16)
    for f in range(len(found)):
        begin, end = ring[face[f]], ring[face[f + 1]]
        bottom = top = points[a[begin], 1]
        for k in range(begin, end):
            bottom, top = min(bottom, points[a[k], 1]), max(top, points[a[k], 1])
        middle, low, high = 0.5 * (bottom + top), bottom, top
        for k in range(begin, end):
            y = points[a[k], 1]
            if y <= middle:
                low = max(low, y)
            else:
                high = min(high, y)
        y, count = 0.5 * (low + high), 0
        for r in range(face[f], face[f + 1]):
            for k in range(ring[r], ring[r + 1]):
                p, q = points[a[k]], points[a[k + 1] if k + 1 < ring[r + 1] else a[ring[r]]]
                if (p[1] > y) != (q[1] > y):
                    if count == len(cuts):
                        cuts = np.concatenate((cuts, cuts))
                    x, at = p[0] + (y - p[1]) * (q[0] - p[0]) / (q[1] - p[1]), count
                    while at > 0 and cuts[at - 1] > x:
                        cuts[at] = cuts[at - 1]
                        at -= 1
                    cuts[at] = x
                    count += 1
        widest = 0
        for k in range(0, count, 2):
            if cuts[k + 1] - cuts[k] > cuts[widest + 1] - cuts[widest]:
                widest = k
        found[f, 0], found[f, 1] = 0.5 * (cuts[widest] + cuts[widest + 1]), y
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def in_boxes(xy: Float, boxes: Float) -> tuple[Ints, Ints]:
    """Points and boxes (k,) that hold them; points (n, 2) float64 sorted by y, boxes (m, 4) float64."""
    x, y = xy[:, 0].copy(), xy[:, 1].copy()
    point, box, count = np.empty(64, np.int64), np.empty(64, np.int64), 0
    for b in range(len(boxes)):
        west, south, east, north = boxes[b]
        for p in range(_first_from(y, south), len(y)):
            if y[p] > north:
                break
            if west <= x[p] <= east:
                if count == len(point):
                    point, box = np.concatenate((point, point)), np.concatenate((box, box))
                point[count], box[count] = p, b
                count += 1
    return point[:count], box[:count]
