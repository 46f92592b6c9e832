"""Areas from their boundary lines: segments are joined by node, regardless of order, direction and role."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from geoscene.geometry.polylines import cross
from geoscene.sources.data import METRES_PER_DEGREE, Bounds
from geoscene.typing import Bools, Float, Ints

_LONG, _CROSSINGS = 200, 10_000
"""Points of rings whose crossings are counted, and the number beyond which they are dropped."""


@dataclass(frozen=True, slots=True)
class RingMember:
    """One member of an area's boundary.

    nodes : (k,) node indices, none missing
    inner : its role is that of a hole's boundary
    """

    nodes: Ints
    inner: bool


def polygons_of(geometry: Any) -> Any:
    """The polygonal part of a geometry, valid, exteriors counter-clockwise; None if it has no area."""
    if not shapely.is_valid(geometry):
        geometry = shapely.make_valid(geometry, method="structure", keep_collapsed=False)
    parts = shapely.get_parts(shapely.get_parts(geometry))
    parts = parts[(shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > 0)]
    if len(parts) == 0:
        return None
    return shapely.orient_polygons(parts[0] if len(parts) == 1 else shapely.multipolygons(parts))


def is_tangled(ring: Float) -> bool:
    """Whether a closed ring (n, 2) crosses itself so often that no area can be meant.

    The number of crossings is estimated from at most 64 segments; making a ring valid takes time by it.
    """
    if len(ring) < _LONG:
        return False
    a, b = ring[:-1], ring[1:]
    some = np.linspace(0, len(a) - 1, 64).astype(int)
    crossings = 0
    for k in some:
        p, q = a[k], b[k]
        across = _side(p, q, points=a) * _side(p, q, points=b) < 0
        c, d = a[across], b[across]
        crossings += int((cross(d - c, p - c) * cross(d - c, q - c) < 0).sum())
    return crossings / len(some) * len(a) / 2 > _CROSSINGS


def _side(p: Float, q: Float, *, points: Float) -> Float:
    """Positive (n,) for points left of the line from p to q, negative for those right of it."""
    return cross(np.broadcast_to(q - p, points.shape), points - p)


def segments_of(nodes: Ints) -> Ints:
    """(s, 2) int64 node indices of a chain's segments, the smaller first; without segments of no length."""
    pairs: Ints = np.sort(np.stack([nodes[:-1], nodes[1:]], axis=1), axis=1)
    distinct: Ints = pairs[pairs[:, 0] != pairs[:, 1]]
    return distinct


def _open_nodes(segments: Ints) -> Ints:
    """The nodes where an odd number of segments end, so that the boundary is open."""
    nodes, count = np.unique(segments, return_counts=True)
    odd: Ints = nodes[count % 2 == 1]
    return odd


def _prune(segments: Ints) -> Ints:
    """The segments without dead ends."""
    while len(segments):
        _, inverse, count = np.unique(segments, return_inverse=True, return_counts=True)
        alive = (count[inverse.reshape(segments.shape)] > 1).all(axis=1)
        if alive.all():
            break
        segments = segments[alive]
    return segments


def _inside(points: Float, a: Float, *, b: Float) -> Bools:
    """(p,) bool, whether an eastward ray from each point crosses an odd number of segments a to b."""
    out = np.empty(len(points), bool)
    for i, (x, y) in enumerate(points):
        spans = (a[:, 1] > y) != (b[:, 1] > y)
        p, q = a[spans], b[spans]
        out[i] = np.count_nonzero(p[:, 0] + (y - p[:, 1]) / (q[:, 1] - p[:, 1]) * (q[:, 0] - p[:, 0]) > x) % 2
    return out


def enclose(segments: Ints, xy: Float) -> tuple[Any, bool]:
    """The area that segments enclose by the even-odd rule, and whether any cross or overlap between nodes.

    If the boundary is open, dead ends are removed and everything enclosed counts as inside. The area is None
    if nothing is enclosed.
    """
    segments = _prune(segments)
    if len(segments) == 0:
        return None, False
    ends = xy[segments]
    lines = shapely.get_parts(shapely.union_all(shapely.linestrings(ends)))
    crossing = len(lines) != len(segments)
    faces = shapely.get_parts(shapely.polygonize(lines))
    if len(faces) > 1 and len(_open_nodes(segments)) == 0:
        points = shapely.get_coordinates(shapely.point_on_surface(faces))
        faces = faces[_inside(points, ends[:, 0], b=ends[:, 1])]
    if len(faces) == 0:
        return None, crossing
    return polygons_of(shapely.union_all(faces)), crossing


def _join(chains: Sequence[Ints]) -> list[list[Ints]]:
    """Chains grouped into rings: each closed one alone, open ones with those that share their ends."""
    groups: list[list[Ints]] = []
    owner: dict[int, int] = {}
    for chain in chains:
        ends = {int(chain[0]), int(chain[-1])}
        if len(ends) == 1:
            groups.append([chain])
            continue
        groups_at_ends = sorted({owner[end] for end in ends if end in owner})
        target = groups_at_ends[0] if groups_at_ends else len(groups)
        if not groups_at_ends:
            groups.append([])
        groups[target].append(chain)
        for other in groups_at_ends[1:]:
            groups[target] += groups[other]
            groups[other] = []
        for member in groups[target]:
            owner[int(member[0])] = owner[int(member[-1])] = target
    return [group for group in groups if group]


def _union_of_rings(chains: Sequence[Ints], xy: Float) -> Any:
    """Union of the areas enclosed by the rings; empty without any."""
    areas = []
    for group in _join(chains):
        segments = np.unique(np.concatenate([segments_of(chain) for chain in group]), axis=0)
        area, _ = enclose(segments, xy)
        if area is not None:
            areas.append(area)
    return shapely.union_all(areas)


@dataclass(frozen=True, slots=True)
class Assembly:
    """Result of `assemble`.

    geometry : Polygon or MultiPolygon, valid, exteriors counter-clockwise; None if nothing is enclosed
    reason   : "" if the boundary is valid, else ``open-ring``, ``self-crossing``, ``both-roles``,
               ``duplicate-way`` or ``spike``
    """

    geometry: Any
    reason: str


def assemble(chains: Sequence[RingMember], xy: Float, *, complete: bool = True) -> Assembly:
    """The area that chains enclose.

    A valid boundary (an even number of segments at every node, no crossing between nodes) is filled by the
    even-odd rule and needs no roles: segments shared by two rings cancel, so that touching holes
    become one. Otherwise, or if members are missing (not ``complete``) or have both roles, the closed rings
    are used: the union of the outer ones minus the union of the inner ones.

    xy : (n, 2) coordinates of all nodes
    """
    roles: dict[bytes, set[bool]] = {}
    unique: list[RingMember] = []
    parts: list[Ints] = []
    spikes = False
    for chain in chains:
        segments = segments_of(chain.nodes)
        distinct = np.unique(segments, axis=0)
        of = roles.setdefault(distinct.tobytes(), set())
        if len(segments) and chain.inner not in of:
            unique.append(chain)
            if not of:
                spikes |= len(distinct) < len(segments)
                parts.append(segments)
            of.add(chain.inner)
    if not parts:
        return Assembly(None, "open-ring")
    every, count = np.unique(np.concatenate(parts), axis=0, return_counts=True)
    odd = every[count % 2 == 1]
    is_open = len(_open_nodes(odd)) > 0
    both_roles = len(parts) < len(unique)
    defects = (
        ("both-roles", both_roles),
        ("open-ring", is_open),
        ("duplicate-way", len(unique) < len(chains)),
        ("spike", spikes),
    )
    reason = next((name for name, found in defects if found), "")
    crossing = False
    if complete and not is_open and not both_roles and len(odd):
        geometry, crossing = enclose(odd, xy)
        if not crossing:
            return Assembly(geometry, reason)
        reason = "self-crossing"
    outer = _union_of_rings([c.nodes for c in unique if not c.inner], xy)
    inner = _union_of_rings([c.nodes for c in unique if c.inner], xy)
    if complete and outer.is_empty:
        return Assembly(polygons_of(inner), reason)
    return Assembly(polygons_of(shapely.difference(outer, inner)), reason)


def close_cut_ring(nodes: Ints, xy: Float, *, extent: Bounds) -> Ints | None:
    """A ring cut off at the edge of an extract, closed by straight edges; None if the result is implausible.

    It is plausible if both ends of every gap lie within 100 m of the extent's edge, the added edges are at
    most a third of the outline, and the outline does not cross itself and has at least 1 m².

    nodes  : (k,) node indices, -1 where a node is missing; the last need not equal the first
    xy     : (n, 2) degrees of all nodes
    extent : (west, south, east, north) degrees of the extract
    """
    closed = len(nodes) > 1 and nodes[0] == nodes[-1] and nodes[0] >= 0
    ring = nodes[:-1] if closed else nodes
    here = np.flatnonzero(ring >= 0)
    if len(here) < 3:
        return None
    kept = ring[here]
    following = np.roll(here, -1)
    gap = following != here + 1
    gap[-1] = not (closed and here[-1] == len(ring) - 1)
    west, south, east, north = extent
    metres = METRES_PER_DEGREE * np.array([np.cos(np.radians((south + north) / 2)), 1.0])
    start = xy[kept] * metres
    end = np.roll(start, -1, axis=0)
    length = np.hypot(*(end - start).T)
    low, high = np.array([west, south]) * metres, np.array([east, north]) * metres
    margin = np.minimum(start - low, high - start).min(axis=1)
    far = np.maximum(margin, np.roll(margin, -1))[gap] > 100.0
    if far.any() or length[gap].sum() > length.sum() / 3:
        return None
    polygon = shapely.polygons(np.vstack([start, start[:1]]))
    if not shapely.is_valid(polygon) or shapely.area(polygon) < 1.0:
        return None
    return np.append(kept, kept[0])
