"""Borders between faces without small bends (Visvalingam and Whyatt 1993), compiled."""

from __future__ import annotations

import heapq

import numpy as np

from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float, Ints


@njit(cache=True, nogil=True, error_model="numpy")
def without_bends(
    points: Float, a: Ints, b: Ints, other: Ints, ring: Ints, largest: float
) -> tuple[Ints, Ints]:
    """Vertices of rings without small bends of borders between two faces, and offsets of the rings in them.

    Of each border between two meetings of borders, or all around a face, the vertex with the smallest
    triangle to its neighbours is left out again and again, unless another vertex lies in that triangle.
    Borders are taken in the order of the rings. Rings begin where borders meet; those of one or two borders
    run the way of the ring that had the first of them first, as from GEOS.

    points  : (k, 2) float64, on a grid on which products of differences are exact
    a, b, other, ring : as in `geoscene.ground.faces.GroundFaces`
    largest : area of the largest triangle that counts as a small bend, m2
    """
    node = _meetings(len(points), a, other, ring)
    twin = _twins(len(points), a, b)
    # Borders as vertices, and as the borders of each ring.
    line, line_size, first = np.empty(2 * len(a), np.int64), 0, np.zeros(len(a) + 1, np.int64)
    closed, inner, count = np.zeros(len(a), np.bool_), np.zeros(len(a), np.bool_), 0
    border_of = np.full(len(a), -1, np.int64)
    of_ring, ring_first, uses = np.empty(len(a), np.int64), np.zeros(len(ring), np.int64), 0
    own = np.zeros(len(a), np.bool_)
    for r in range(len(ring) - 1):
        begin, size = ring[r], ring[r + 1] - ring[r]
        start = begin
        while start < ring[r + 1] and not node[a[start]]:
            start += 1
        meets = start < ring[r + 1]
        start = start if meets else begin
        nth = 0
        while nth < size:
            k = begin + (start - begin + nth) % size
            border, fresh = border_of[k], border_of[k] < 0
            if fresh:
                border = count
            of_ring[uses], own[uses] = border, fresh
            uses += 1
            head = a[k]
            while True:
                if fresh:
                    line[line_size] = a[k]
                    line_size += 1
                    border_of[k] = border
                    if twin[k] >= 0:
                        border_of[twin[k]] = border
                nth += 1
                end = b[k]
                if nth == size or node[end]:
                    break
                k = begin + (start - begin + nth) % size
            if fresh:
                closed[border], inner[border] = end == head, other[k] >= 0
                if end != head:
                    line[line_size] = end
                    line_size += 1
                count += 1
                first[count] = line_size
        ring_first[r + 1] = uses
    kept = _kept(points, node, line[:line_size], first[: count + 1], closed, inner, largest)
    vertex, size = np.empty(len(a), np.int64), 0
    offset = np.zeros(len(ring), np.int64)
    for r in range(len(ring) - 1):
        borders, last = of_ring[ring_first[r] : ring_first[r + 1]], -1
        for nth in range(len(borders)):
            low, high = first[borders[nth]], first[borders[nth] + 1]
            as_first = len(borders) <= 2 or own[ring_first[r]]
            forward = line[low] == last if nth else as_first
            ends = 0 if closed[borders[nth]] else 1  # the last of a border is the first of the next
            if forward:
                for k in range(low, high - ends):
                    if kept[k]:
                        vertex[size] = line[k]
                        size += 1
                last = line[high - 1]
            else:
                for k in range(high - 1, low - 1 + ends, -1):
                    if kept[k]:
                        vertex[size] = line[k]
                        size += 1
                last = line[low]
        offset[r + 1] = size
    return vertex[:size], offset


@njit(cache=True, nogil=True, error_model="numpy")
def _meetings(count: int, a: Ints, other: Ints, ring: Ints) -> Bools:
    """Which of the points are on more than two rings, or where a ring reaches or leaves the outside."""
    rings, node = np.zeros(count, np.int64), np.zeros(count, np.bool_)
    for r in range(len(ring) - 1):
        before = other[ring[r + 1] - 1] < 0
        for k in range(ring[r], ring[r + 1]):
            rings[a[k]] += 1
            outside = other[k] < 0
            if rings[a[k]] > 2 or outside != before:
                node[a[k]] = True
            before = outside
    return node


@njit(cache=True, nogil=True, error_model="numpy")
def _twins(count: int, a: Ints, b: Ints) -> Ints:
    """The half-edge the other way of each, -1 where there is none."""
    latest, before = np.full(count, -1, np.int64), np.empty(len(a), np.int64)
    twin = np.full(len(a), -1, np.int64)
    for k in range(len(a)):
        low = min(a[k], b[k])
        like = latest[low]
        while like >= 0 and (a[like] != b[k] or b[like] != a[k]):
            like = before[like]
        if like >= 0:
            twin[k], twin[like] = like, k
        before[k], latest[low] = latest[low], k
    return twin


@njit(cache=True, nogil=True, error_model="numpy")
def _kept(
    points: Float, node: Bools, line: Ints, first: Ints, closed: Bools, inner: Bools, largest: float
) -> Bools:
    """Which vertices of borders remain; borders are ``line[first[k]:first[k + 1]]``."""
    alive = np.zeros(len(points), np.bool_)
    for p in line:
        alive[p] = True
    grid, offset, found = _cells_of_points(points, alive)
    kept = np.ones(len(line), np.bool_)
    size = first[1:] - first[:-1]
    latest, earlier = np.full(len(points), -1, np.int64), np.empty(len(size), np.int64)
    for e in range(len(size)):
        v = min(line[first[e]], line[first[e + 1] - 1])
        earlier[e], latest[v] = latest[v], e
    before, after = np.empty(len(line), np.int64), np.empty(len(line), np.int64)
    for e in range(len(size)):
        low, high = first[e], first[e + 1]
        if not inner[e] or high - low < 3:
            continue
        for k in range(low, high):
            before[k], after[k] = k - 1, k + 1
        if closed[e]:
            before[low], after[high - 1] = high - 1, low
        free = closed[e] and not node[line[low]]
        begin, stop = low + (not free), high - (not closed[e])
        bends = [(0.0, 0, 0, 0)][:0]
        for k in range(begin, stop):
            area = _area(points, line[before[k]], line[k], line[after[k]])
            if area <= largest:
                heapq.heappush(bends, (area, k, before[k], after[k]))
        while len(bends) and size[e] > 2 + closed[e]:
            _, k, prev, following = heapq.heappop(bends)
            if not kept[k] or before[k] != prev or after[k] != following:
                continue
            p, v, q = line[prev], line[k], line[following]
            if _holds_other(points, p, v, q, alive, grid, offset, found):
                continue
            if not closed[e] and prev == low and following == high - 1:
                # Another border may be the straight line already.
                like = latest[min(p, q)]
                while like >= 0:
                    ends = line[first[like]], line[first[like + 1] - 1]
                    if like != e and size[like] == 2 and max(ends[0], ends[1]) == max(p, q):
                        break
                    like = earlier[like]
                if like >= 0:
                    continue
            kept[k], alive[v] = False, False
            size[e] -= 1
            after[prev], before[following] = following, prev
            for corner in (prev, following):
                if begin <= corner < stop:
                    area = _area(points, line[before[corner]], line[corner], line[after[corner]])
                    if area <= largest:
                        heapq.heappush(bends, (area, corner, before[corner], after[corner]))
    return kept


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _area(points: Float, p: int, v: int, q: int) -> float:
    x, y = points[p]
    area: float = abs((points[q, 0] - x) * (points[v, 1] - y) - (points[v, 0] - x) * (points[q, 1] - y)) / 2.0
    return area


@njit(cache=True, nogil=True, error_model="numpy")
def _cells_of_points(points: Float, chosen: Bools) -> tuple[Float, Ints, Ints]:
    """Square cells (west, south, side, columns, rows), and the chosen points by cell: offsets and numbers."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for p in range(len(points)):
        if chosen[p]:
            for axis in range(2):
                low[axis], high[axis] = min(low[axis], points[p, axis]), max(high[axis], points[p, axis])
    wide, tall = high - low
    side = max(np.sqrt(wide * tall / max(chosen.sum(), 1)), max(wide, tall) / 1000.0)
    columns, rows = int(wide / side) + 1, int(tall / side) + 1
    cell = np.full(len(points), -1, np.int64)
    offset = np.zeros(columns * rows + 1, np.int64)
    for p in range(len(points)):
        if chosen[p]:
            cell[p] = int((points[p, 1] - low[1]) / side) * columns + int((points[p, 0] - low[0]) / side)
            offset[cell[p] + 1] += 1
    offset = np.cumsum(offset)
    place, found = offset[:-1].copy(), np.empty(offset[-1], np.int64)
    for p in range(len(points)):
        if chosen[p]:
            found[place[cell[p]]] = p
            place[cell[p]] += 1
    return np.array([low[0], low[1], side, columns, rows]), offset, found


@njit(cache=True, nogil=True, error_model="numpy")
def _holds_other(
    points: Float, p: int, v: int, q: int, alive: Bools, grid: Float, offset: Ints, found: Ints
) -> bool:
    """Whether a triangle, its outline included, holds a living point other than its corners."""
    west, south, side, columns = grid[0], grid[1], grid[2], int(grid[3])
    (ax, ay), (bx, by), (cx, cy) = points[p], points[v], points[q]
    left, right = min(ax, bx, cx), max(ax, bx, cx)
    bottom, top = min(ay, by, cy), max(ay, by, cy)
    outer = -1.0 if (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > 0.0 else 1.0
    for row in range(int((bottom - south) / side), int((top - south) / side) + 1):
        # The triangle's part in the row, a little wider.
        y0, y1 = south + row * side - 1e-6, south + (row + 1) * side + 1e-6
        x0, x1 = np.inf, -np.inf
        for nth in range(3):
            px, py, qx, qy = (
                (ax, ay, bx, by) if nth == 0 else (bx, by, cx, cy) if nth == 1 else (cx, cy, ax, ay)
            )
            if max(py, qy) < y0 or min(py, qy) > y1:
                continue
            low, high = min(px, qx), max(px, qx)
            if py != qy:
                slope = (qx - px) / (qy - py)
                u, w = px + slope * (y0 - py), px + slope * (y1 - py)
                low, high = max(low, min(u, w) - 1e-6), min(high, max(u, w) + 1e-6)
            x0, x1 = min(x0, low), max(x1, high)
        if x0 > x1:
            continue
        begin, end = int((max(x0, left) - west) / side), int((min(x1, right) - west) / side)
        for other in found[offset[row * columns + begin] : offset[row * columns + end + 1]]:
            if other in (p, v, q) or not alive[other]:
                continue
            x, y = points[other]
            if x < left or x > right or y < bottom or y > top:
                continue
            if outer * ((ax - x) * (by - y) - (ay - y) * (bx - x)) > 0.0:
                continue
            if outer * ((bx - x) * (cy - y) - (by - y) * (cx - x)) > 0.0:
                continue
            if outer * ((cx - x) * (ay - y) - (cy - y) * (ax - x)) > 0.0:
                continue
            return True
    return False
