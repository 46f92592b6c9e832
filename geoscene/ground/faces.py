"""Faces of the plane between noded segments, and which of them lie beside each other.

Faces and rings come in the order, and begin at the vertex, that follow from the ranks of half-edges alone: as
from GEOS's polygonizer, whose ranks are the order of lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import GeosceneError
from geoscene.typing import Float, Ints


@dataclass(frozen=True, slots=True)
class Faces:
    """Faces that segments bound, and the half-edges of their outlines: ring by ring, in the ring's order.

    polygon : (n,) object, shapely Polygon; neighbours share all vertices along their common border
    points  : (k, 2) float64, metres, those of the segments
    a, b    : (m,) int64, numbers of a half-edge's ends
    cell    : (m,) int64, the face on its right
    other   : (m,) int64, the face on its left, -1 outside of the box
    first   : (n,) int64, the first half-edge of each face
    """

    polygon: NDArray[np.object_]
    points: Float
    a: Ints
    b: Ints
    cell: Ints
    other: Ints
    first: Ints


def faces(points: Float, ends: Ints, *, rank: Ints, box: tuple[float, float, float, float]) -> Faces:
    """The faces within a box that noded segments bound.

    points : (k, 2) float64, metres, each once, on a grid in which twice the area of each ring is exact
    ends   : (2, m) int64, numbers of the ends of segments, each segment once
    rank   : (2, m) int64, ranks of the segments' half-edges: from the first end to the second, and back
    box    : (xmin, ymin, xmax, ymax), whose sides are among the segments

    Segments with the same face on both sides bound nothing and are left out. Raises GeosceneError if the
    faces do not add up to the box.
    """
    xmin, ymin, xmax, ymax = box
    x, y = points[ends].mean(axis=0).T
    within = (x >= xmin) & (x <= xmax) & (y >= ymin) & (y <= ymax)
    while True:
        ends, rank = ends[:, within], rank[:, within]
        start, stop, m = ends.ravel(), ends[::-1].ravel(), ends.shape[1]
        star, following = _turns(points, start, stop=stop)
        ring = _cycles(following)
        within = ring[:m] != ring[m:]
        if within.all():
            break
    if _split_touching(following, star, ring=ring, start=start):
        ring = _cycles(following)
    order, offset = _in_rings(following, ring, rank=rank.ravel())
    return _assembled(points, start[order], order=order, offset=offset, box=box)


def _turns(points: Float, start: Ints, *, stop: Ints) -> tuple[Ints, Ints]:
    """Half-edges sorted by start, then counter-clockwise, and the one that follows each around its face."""
    n, m = len(start), len(start) // 2
    dx, dy = (points[stop] - points[start]).T
    star = np.lexsort((np.arctan2(dy, dx), start))
    begin = np.flatnonzero(np.diff(start[star], prepend=-1))
    after = np.append(star[1:], star[:1])
    after[np.append(begin[1:], n) - 1] = star[begin]
    following = np.empty(n, np.int64)
    following[(star + m) % n] = after
    return star, following


def _cycles(following: Ints) -> Ints:
    """The number of the cycle that each half-edge is in."""
    from scipy.sparse import csr_array  # noqa: PLC0415 - slow to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    n = len(following)
    graph = csr_array((np.ones(n, np.int8), following, np.arange(n + 1)), shape=(n, n))
    number: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return number


def _split_touching(following: Ints, star: Ints, *, ring: Ints, start: Ints) -> bool:
    """Divide, in place, rings that pass a point more than once there; whether there were any."""
    key = ring * (int(start.max(initial=0)) + 1) + start
    ordered = np.sort(key)
    twice = np.unique(ordered[1:][ordered[1:] == ordered[:-1]])
    place = np.searchsorted(start[star], start[np.isin(key, twice)])
    n, m = len(start), len(start) // 2
    for here in np.unique(place).tolist():
        around = star[here : np.searchsorted(start[star], start[star[here]], "right")][::-1].tolist()
        for number in {int(ring[h]) for h in around if key[h] in twice}:
            # Clockwise around the point: each half-edge that arrives goes on along the next that leaves.
            passing = [(h, ring[h] == number, ring[(h + m) % n] == number) for h in around]
            first = arriving = -1
            for h, leaves, arrives in passing:
                if arrives:
                    arriving = (h + m) % n
                if leaves and arriving >= 0:
                    following[arriving], arriving = h, -1
                if leaves and first < 0:
                    first = h
            if arriving >= 0:
                following[arriving] = first
    return len(twice) > 0


def _in_rings(following: Ints, ring: Ints, *, rank: Ints) -> tuple[Ints, Ints]:
    """Half-edges ring by ring, each from its least rank on, rings by that rank; and where rings begin."""
    n = len(following)
    by_rank = np.argsort(rank)
    first = by_rank[np.sort(np.unique(ring[by_rank], return_index=True)[1])]
    number = np.empty(len(first), np.int64)
    number[ring[first]] = np.arange(len(first))
    # Steps from each half-edge to its ring's end, by doubling.
    ahead, steps = following.copy(), np.ones(n, np.int64)
    is_first = np.zeros(n, np.bool_)
    is_first[first] = True
    active = np.flatnonzero(~is_first[ahead])
    while len(active):
        via = ahead[active]
        steps[active] += steps[via]
        ahead[active] = ahead[via]
        active = active[~is_first[ahead[active]]]
    offset = np.append(0, np.cumsum(steps[first]))
    order = np.empty(n, np.int64)
    order[offset[number[ring] + 1] - steps] = np.arange(n)
    return order, offset


def _assembled(
    points: Float, start: Ints, *, order: Ints, offset: Ints, box: tuple[float, float, float, float]
) -> Faces:
    """Faces of rings: those that run clockwise around theirs, and in them those that run around others."""
    m, count = len(order) // 2, np.diff(offset)
    xy = points[start]
    stop = np.append(start[1:], start[:1])
    stop[offset[1:] - 1] = start[offset[:-1]]
    corner = np.repeat(xy[offset[:-1]], count, axis=0)
    u, v = xy - corner, points[stop] - corner
    area = 0.5 * np.add.reduceat(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0], offset[:-1])
    low = np.minimum.reduceat(xy, offset[:-1], axis=0)
    high = np.maximum.reduceat(xy, offset[:-1], axis=0)
    inside = (low >= box[:2]).all(axis=1) & (high <= box[2:]).all(axis=1)
    shell, hole = np.flatnonzero(inside & (area < 0)), np.flatnonzero(area > 0)
    middle = (xy[offset[hole]] + points[stop[offset[hole]]]) / 2
    owner = _owners(_polygons(points, start, offset=offset, rings=shell), area=-area[shell], middle=middle)
    shell_of = np.concatenate([np.arange(len(shell)), owner[owner >= 0]])
    rings = np.concatenate([shell, hole[owner >= 0]])
    by_face = np.argsort(shell_of, kind="stable")
    rings, face = rings[by_face], shell_of[by_face]
    whole = (box[2] - box[0]) * (box[3] - box[1])
    if abs(-area[rings].sum() - whole) > 1e-7 * whole:
        raise GeosceneError(
            f"ground cells of the tile at {box} cover {-area[rings].sum():.6f} m2 of {whole:.6f}"
        )
    first = np.append(0, np.cumsum(count[rings]))
    edge = np.repeat(offset[rings] - first[:-1], count[rings]) + np.arange(first[-1])
    cell = np.repeat(face, count[rings])
    face_of = np.full(2 * m, -1, np.int64)
    face_of[order[edge]] = cell
    begins = np.flatnonzero(np.diff(face, prepend=-1))
    polygon = _polygons(points, start, offset=offset, rings=rings, begins=begins)
    other = face_of[(order[edge] + m) % (2 * m)]
    return Faces(polygon, points, start[edge], stop[edge], cell, other, first[begins])


def _owners(shells: NDArray[np.object_], *, area: Float, middle: Float) -> Ints:
    """The innermost of the shells around each point (n, 2), -1 where there is none."""
    owner = np.full(len(middle), -1, np.int64)
    point, around = shapely.STRtree(shells).query(shapely.points(middle), predicate="within")
    largest_first = np.argsort(-area[around], kind="stable")
    owner[point[largest_first]] = around[largest_first]
    return owner


def _polygons(
    points: Float, start: Ints, *, offset: Ints, rings: Ints, begins: Ints | None = None
) -> NDArray[np.object_]:
    """Polygons of rings, each of one ring, or of those from one of ``begins`` to the next."""
    count = np.diff(offset)[rings] + 1
    closed = np.append(0, np.cumsum(count))
    place = np.arange(closed[-1]) - np.repeat(closed[:-1], count)
    place[closed[1:] - 1] = 0
    coords = points[start[place + np.repeat(offset[rings], count)]]
    polygon = np.arange(len(rings) + 1) if begins is None else np.append(begins, len(rings))
    made: NDArray[np.object_] = shapely.from_ragged_array(
        shapely.GeometryType.POLYGON, coords, (closed, polygon)
    )
    return made
