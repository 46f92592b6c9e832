"""Straight skeletons of polygons with holes, by simulating the shrinking wavefront.

The wavefront of Aichholzer, Aurenhammer, Alberts and Gärtner, "A novel type of skeleton for polygons" (1995):
all edges move inwards at unit speed. An edge event removes an edge that has shrunk to a point; a split event
happens where a reflex corner hits an edge, and splits the front or joins it to that of a hole. Every step
searches the next event among all edges and corners, so that no event is missed or handled twice; simultaneous
events are handled one after another. If that fails on a symmetric polygon, its corners are perturbed by
micrometres. The result is checked: each edge has one face, and the faces fill the polygon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.typing import Float

_PARALLEL = 1e-7
_STATIONARY = 1e-12
_NEAR = 1e-9
_MERGE_DISTANCE = 1e-3
_JITTERS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3)


@dataclass(frozen=True, slots=True)
class Skeleton:
    """A straight skeleton; face k belongs to edge k of the polygon.

    xy      : (n, 2) nodes, metres; the polygon's own corners first, ring by ring, exterior first
    time    : (n,) distance of each node from the edges it belongs to, metres; 0 at the polygon's corners
    faces   : nodes around the face of each edge, counter-clockwise, beginning with the edge's two corners;
              a tiny face may consist of these two only; then the faces that merging close nodes has split off
    corners : number of the polygon's corners, and of its edges
    """

    xy: Float
    time: Float
    faces: list[list[int]]
    corners: int


class _Front:
    """The moving wavefront: closed loops of corners, each between two edges."""

    def __init__(self, rings: list[Float]) -> None:
        self.xy = np.concatenate(rings)
        n = len(self.xy)
        sizes = [len(r) for r in rings]
        starts = np.cumsum([0, *sizes[:-1]])
        following = np.concatenate([s + (np.arange(k) + 1) % k for s, k in zip(starts, sizes, strict=True)])
        along = self.xy[following] - self.xy
        self.along = along / np.linalg.norm(along, axis=1, keepdims=True)
        self.inward = np.column_stack((-self.along[:, 1], self.along[:, 0]))
        self.now = 0.0
        self.nodes = [tuple(p) for p in self.xy.tolist()]
        self.times = [0.0] * n
        self.arcs: list[list[tuple[int, int]]] = [[] for _ in range(n)]
        # by corner; corners that events have ended keep their entries
        self.next = following.tolist()
        self.previous = [0] * n
        for i, j in enumerate(self.next):
            self.previous[j] = i
        self.after = list(range(n))
        self.node = list(range(n))
        self.point = [np.array(p) for p in self.xy]
        self.speed = [self._speed(self.previous[i], i) for i in range(n)]
        self.alive = dict.fromkeys(range(n))
        self.ends = following

    def _speed(self, before: int, after: int) -> Float | None:
        """Velocity of the corner between two edges; None for antiparallel edges, where it is undefined."""
        a, b = self.inward[before], self.inward[after]
        turn = a[0] * b[1] - a[1] * b[0]
        if abs(turn) < _PARALLEL:
            return np.asarray(a, float) if float(a @ b) > 0 else None
        velocity: Float = np.array([b[1] - a[1], a[0] - b[0]]) / turn
        return velocity

    def _before(self, corner: int) -> int:
        """The edge before a corner."""
        return self.after[self.previous[corner]]

    def _reflex(self, corner: int) -> bool:
        a, b = self.along[self._before(corner)], self.along[self.after[corner]]
        return bool(a[0] * b[1] - a[1] * b[0] < -_PARALLEL)

    def _new_node(self, point: Float) -> int:
        self.nodes.append((float(point[0]), float(point[1])))
        self.times.append(self.now)
        return len(self.nodes) - 1

    def _trace(self, corner: int, node: int) -> None:
        """Add the arc that a corner has moved along, up to a node, to the faces on both sides."""
        born = self.node[corner]
        self.arcs[self._before(corner)].append((born, node))
        self.arcs[self.after[corner]].append((node, born))

    def _new_corner(self, node: int, point: Float, *, after: int, previous: int, following: int) -> int:
        corner = len(self.next)
        self.next.append(following)
        self.previous.append(previous)
        self.after.append(after)
        self.node.append(node)
        self.point.append(point.copy())
        self.next[previous] = self.previous[following] = corner
        self.speed.append(self._speed(self.after[previous], after))
        self.alive[corner] = None
        return corner

    def _close(self, corner: int) -> None:
        """End a loop of two corners; the ridge between them is an arc of both faces."""
        other = self.next[corner]
        if self.next[other] != corner:
            return
        a, b = self.node[corner], self.node[other]
        self.arcs[self.after[corner]].append((b, a))
        self.arcs[self.after[other]].append((a, b))
        del self.alive[corner], self.alive[other]

    def _join(self, corner: int, point: Float) -> None:
        """Edge event: the edge after a corner has shrunk to a point."""
        other = self.next[corner]
        node = self._new_node(point)
        self._trace(corner, node)
        self._trace(other, node)
        del self.alive[corner], self.alive[other]
        previous, following = self.previous[corner], self.next[other]
        self._close(
            self._new_corner(node, point, after=self.after[other], previous=previous, following=following)
        )

    def _split(self, corner: int, edge_start: int, *, point: Float) -> None:
        """Split event: a reflex corner has hit the edge after another corner."""
        edge_end = self.next[edge_start]
        previous, following = self.previous[corner], self.next[corner]
        after, edge = self.after[corner], self.after[edge_start]
        node = self._new_node(point)
        self._trace(corner, node)
        del self.alive[corner]
        first = self._new_corner(node, point, after=edge, previous=previous, following=edge_end)
        second = self._new_corner(node, point, after=after, previous=edge_start, following=following)
        self._close(first)
        if second in self.alive:
            self._close(second)

    def _collapse_antiparallel(self) -> bool:
        """Collapse a corner between antiparallel edges to its nearer neighbour; False without any."""
        for corner in self.alive:
            if self.speed[corner] is None:
                here = self.point[corner]
                previous, following = self.previous[corner], self.next[corner]
                to_previous = float(np.linalg.norm(self.point[previous] - here))
                if to_previous <= float(np.linalg.norm(self.point[following] - here)):
                    self._join(previous, self.point[previous])
                else:
                    self._join(corner, self.point[following])
                return True
        return False

    def step(self) -> None:
        """Advance to the next event and handle it."""
        if self._collapse_antiparallel():
            return
        alive = list(self.alive)
        slot = {corner: k for k, corner in enumerate(alive)}
        following = np.array([slot[self.next[c]] for c in alive])
        edge = np.array([self.after[c] for c in alive])
        point = np.array([self.point[c] for c in alive])
        speed = np.array([self.speed[c] for c in alive])
        along, inward = self.along[edge], self.inward[edge]

        gap = ((point[following] - point) * along).sum(axis=1)
        rate = ((speed[following] - speed) * along).sum(axis=1)
        shrink = np.full(len(alive), np.inf)
        np.divide(gap, -rate, out=shrink, where=rate < -_STATIONARY)
        shrink = np.maximum(shrink, 0.0)
        best, hit = int(np.argmin(shrink)), -1
        wait = float(shrink[best])

        reflex = np.flatnonzero([self._reflex(c) for c in alive])
        if len(reflex):
            distance = point[reflex] @ inward.T - (point * inward).sum(axis=1)
            closing = 1.0 - speed[reflex] @ inward.T
            meet = np.full(closing.shape, np.inf)
            np.divide(distance, closing, out=meet, where=(closing > _STATIONARY) & (distance > -_NEAR))
            meet = np.maximum(meet, 0.0)
            own = np.arange(len(reflex))
            meet[own, reflex] = meet[own, [slot[self.previous[alive[k]]] for k in reflex]] = np.inf
            r, e = np.nonzero(meet < wait)
            t = meet[r, e]
            where = point[reflex[r]] + speed[reflex[r]] * t[:, None]
            start = point[e] + speed[e] * t[:, None]
            stop = point[following[e]] + speed[following[e]] * t[:, None]
            inside = ((where - start) * along[e]).sum(axis=1) > -_NEAR
            inside &= ((stop - where) * along[e]).sum(axis=1) > -_NEAR
            if inside.any():
                k = np.flatnonzero(inside)[np.argmin(t[inside])]
                best, wait, hit = int(reflex[r[k]]), float(t[k]), int(e[k])
        if not np.isfinite(wait):
            raise ArithmeticError
        self.now += wait
        for k, corner in enumerate(alive):
            self.point[corner] = point[k] + speed[k] * wait
        if hit >= 0:
            self._split(alive[best], alive[hit], point=self.point[alive[best]])
        else:
            self._join(alive[best], self.point[alive[best]])

    def run(self) -> Skeleton | None:
        """Simulate until the front has vanished, and return the faces; None if they are not closed rings."""
        try:
            for _ in range(8 * len(self.xy) + 16):
                if not self.alive:
                    break
                self.step()
        except (ArithmeticError, KeyError, FloatingPointError):
            return None
        if self.alive:
            return None
        faces = []
        for edge in range(len(self.xy)):
            ring = self._ring(edge)
            if ring is None:
                return None
            faces.append(ring)
        return Skeleton(np.array(self.nodes), np.array(self.times), faces, len(faces))

    def _ring(self, edge: int) -> list[int] | None:
        """The nodes around the face of an edge, or None if its arcs do not form a ring."""
        start, stop = edge, int(self.ends[edge])
        onward: dict[int, int] = {}
        for a, b in self.arcs[edge]:
            if a != b:
                if a in onward:
                    return None
                onward[a] = b
        ring = [start, stop]
        while (node := onward.pop(ring[-1], -1)) != start:
            if node < 0:
                return None
            ring.append(node)
        return None if onward else ring


def straight_skeleton(polygon: Any) -> Skeleton | None:
    """The straight skeleton of a valid polygon (exterior counter-clockwise, holes clockwise), or None.

    None if no attempt yields faces that fill the polygon. Collinear corners are allowed. Time grows with the
    square of the number of corners: about 1 ms for a rectangle.
    """
    rings = [np.array(shapely.get_coordinates(r)[:-1]) for r in shapely.get_rings(polygon)]
    centre = rings[0].mean(axis=0)
    rings = [r - centre for r in rings]
    corners = np.concatenate(rings)
    for jitter in _JITTERS:
        # seeded by the number of corners: the same polygon always gives the same skeleton
        random = np.random.Generator(np.random.Philox(key=len(corners)))
        noise = random.uniform(-jitter, jitter, corners.shape)
        jittered = np.split(corners + noise, np.cumsum([len(r) for r in rings])[:-1])
        found = _Front(jittered).run()
        if found is None:
            continue
        xy = found.xy.copy()
        xy[: len(corners)] = corners
        found = replace(found, xy=xy + centre)
        if _fills(found, polygon):
            return _merge(found)
    return None


def _merge(skeleton: Skeleton) -> Skeleton:
    """The skeleton with nodes merged that are connected by an arc shorter than a millimetre.

    Rounding to the grid would make clusters of nodes, as in the centre of a regular polygon, invert faces.
    """
    parent = list(range(len(skeleton.xy)))

    def root(node: int) -> int:
        while parent[node] != node:
            node = parent[node]
        return node

    for face in skeleton.faces:
        ring = np.array(face)
        step = skeleton.xy[np.roll(ring, -1)] - skeleton.xy[ring]
        for k in np.flatnonzero((step**2).sum(axis=1) < _MERGE_DISTANCE**2).tolist():
            low, high = sorted((root(face[k]), root(face[(k + 1) % len(face)])))
            if high >= skeleton.corners:  # corners of the polygon are never merged with each other
                parent[high] = low
    faces, extra = [], []
    for face in skeleton.faces:
        main, *rest = loops([root(node) for node in face])
        faces.append(main)
        extra += rest
    return replace(skeleton, faces=faces + extra)


def loops(ring: list[int]) -> list[list[int]]:
    """A ring that may visit nodes twice, split into simple rings.

    The first one begins with the ring's first edge; it is this edge alone if the ring turns straight back.
    """
    loops: list[list[int]] = []
    path: list[int] = []
    # ending with the first node keeps the first edge in the path
    for node in [*ring[1:], ring[0]]:
        if node in path:
            at = path.index(node)
            if len(path) - at > 2:
                loops.append(path[at:])
            del path[at + 1 :]
        else:
            path.append(node)
    return [[path[-1], *path[:-1]], *loops]


def polygons_of(xy: Float, rings: list[list[int]]) -> NDArray[Any]:
    """Polygons of rings of at least three node numbers."""
    if not rings:
        return np.empty(0, dtype=object)
    sizes = [len(r) for r in rings]
    nodes = np.concatenate([np.array(r) for r in rings])
    lines = shapely.linearrings(xy[nodes], indices=np.repeat(np.arange(len(rings)), sizes))
    polygons: NDArray[Any] = shapely.polygons(lines)
    return polygons


def _fills(skeleton: Skeleton, polygon: Any) -> bool:
    """Whether the faces are simple, counter-clockwise, and have the polygon's area in total.

    As each arc belongs to two faces, they then cover each point of the polygon once.
    """
    shapes = polygons_of(skeleton.xy, skeleton.faces)
    area = shapely.area(shapes)
    # rounding may invert slivers or make them self-intersecting: areas below 1e-3 m2 are tolerated
    valid = (shapely.is_valid(shapes) & shapely.is_ccw(shapely.get_exterior_ring(shapes))) | (area < 1e-3)
    size = shapely.area(polygon)
    return bool(valid.all() and abs(area.sum() - size) < 1e-5 * max(size, 1.0))
