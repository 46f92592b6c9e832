"""Surfaces of junctions: union of the carriageways, rounded corners, and extent along each arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.carriageways import KERB, Carriageways
from geoscene.typing import Bools, Float, Ints

# Metres, radius of the kerb at a corner by the lesser road of the two. Assumed within the usual ranges of
# street design guides (NACTO: 3 to 4.5 on city streets; larger where lorries turn).
_RADIUS = {
    "motorway": 10.0,
    "trunk": 8.0,
    "primary": 6.0,
    "secondary": 6.0,
    "tertiary": 5.0,
    "unclassified": 4.0,
    "residential": 4.0,
    "road": 4.0,
    "living_street": 3.0,
}
_RADIUS_ELSE = 2.0
# Metres that a joint reaches into an arm at most: roads that part at a small angle have no end of joint.
_REACH = 20.0
JOINT = 30.0
"""Metres beyond the outside of the widest arm that a joint, its corners and their sidewalks reach at most."""

# Roads that continue within these limits of direction (radians) and width (metres) need no joint.
_BEND, _STEP = np.radians(1.0), 0.05
# Where a road that bends less than this (radians) changes its width, it does so by 1 in twice this number.
_BENT, _SLANT = np.radians(30.0), 3.0
# Neighbouring arms closer to a straight line than this (radians) have no corner to round.
_ROUNDED = np.radians(8.0)
# Arms whose directions differ by less than this (radians) have the same direction.
_ONE_DIRECTION = 1e-6

_QUAD = 6
"""Segments of a quarter circle: 1.7 cm off a circle of 2 m, 5 cm off one of 6 m."""


@dataclass(frozen=True, slots=True)
class Junctions:
    """Joints of carriageways, with the kerbs and sidewalks round their corners.

    polygon : (j,) shapely, the joint's carriageway
    main    : (j,) int64 the joint's most important arm, a row of the carriageways
    number  : (j,) int64 of the joint among all, less than twice the number of carriageways
    kerb, walk : (c,) shapely, kerb and sidewalk round a corner: the joint buffered by their widths
    corner_main : (c,) int64 the more important of the corner's two arms
    corner_number : (c,) int64 of the corner among all, less than twice the number of carriageways
    """

    polygon: NDArray[np.object_]
    main: Ints
    number: Ints
    kerb: NDArray[np.object_]
    walk: NDArray[np.object_]
    corner_main: Ints
    corner_number: Ints


def build_junctions(roads: Carriageways, importance: Ints, *, wanted: Bools) -> Junctions:
    """The joints of all carriageways that share a node, a place and (off the ground) a layer.

    A corner is the morphological closing of two neighbouring arms with the corner's radius: it rounds the
    inner corner with that radius and changes nothing else.

    importance : (k,) rank of the carriageways; the higher wins where joints and carriageways overlap
    wanted     : (k, 2) whether joints at the start and end of each carriageway are built
    """
    arms = _arms(roads)
    after, between, width, radius, tangent = _corners(roads, arms)
    count = np.bincount(arms.group)[arms.group]
    apart = np.hypot(*(arms.start_xy[after] - arms.start_xy).T)
    straight = (
        (count == 2)
        & (apart < _STEP)
        & (np.abs(between - np.pi) < _BEND)
        & (np.abs(width - width[after]) < _STEP)
        & (np.abs(arms.walk - arms.walk[after][:, ::-1]) < _STEP).all(axis=1)
    )
    keep = (count > 1) & ~straight & ~straight[np.argsort(after)]
    groups = np.zeros(int(arms.group.max(initial=-1)) + 1, np.bool_)
    groups[arms.group[wanted[arms.road, arms.end]]] = True
    keep &= groups[arms.group]
    none, no_rows = np.empty(0, object), np.empty(0, np.int64)
    if not keep.any():
        return Junctions(none, no_rows, no_rows, none, none, no_rows, no_rows)

    half = np.maximum(width, width[after]) / 2
    reach = np.maximum(tangent, tangent[np.argsort(after)])
    used = np.flatnonzero(groups[arms.group])
    stub, disc, taper = np.full((3, len(half)), None)
    stub[used] = _stubs(roads, arms, rows=used, length=np.maximum(reach + 0.5, half + 1.0)[used])
    disc[used] = shapely.buffer(
        shapely.points(arms.start_xy[used]), np.minimum(width, width[after])[used] / 2, quad_segs=_QUAD
    )
    rounded = np.where(np.abs(between - np.pi) > _ROUNDED, radius, 0.0)
    wider = (width[after] > width + _STEP) | (apart > _STEP)
    slanted = (count == 2) & (np.abs(between - np.pi) < _BENT) & wider
    tapered = np.flatnonzero(slanted & groups[arms.group])
    taper[tapered] = _tapers(roads, arms, rows=tapered, after=after[tapered], apart=apart[tapered])
    corner = _corner(np.stack([stub, stub[after], disc, taper], axis=1)[keep], rounded[keep])

    walk_width = np.minimum(arms.walk[:, 0], arms.walk[after][:, 1])[keep]
    walked = walk_width > 0
    wedge = _wedges(arms, between, reach=reach)[keep][walked]
    kerb, walk = (
        shapely.intersection(shapely.buffer(corner[walked], grow, quad_segs=_QUAD), wedge)
        for grow in (KERB, KERB + walk_width[walked])
    )
    group = arms.group[keep]
    first = np.flatnonzero(np.diff(group, prepend=-1))
    parts, of = _parts(corner, group)
    polygon = shapely.buffer(shapely.multipolygons(parts, indices=of), 0.0)
    rank = importance[arms.road]
    main = np.where(rank >= rank[after], arms.road, arms.road[after])[keep]
    best = np.lexsort([-importance[main], group])
    number = np.flatnonzero(keep)[walked]
    return Junctions(polygon, main[best][first], group[first], kerb, walk, main[walked], number)


def junction_reach(roads: Carriageways) -> tuple[Float, Ints]:
    """Reach of junctions into each carriageway at its start and end, and their number of arms.

    Metres (k, 2), 0 where fewer than three arms meet, and numbers of arms (k, 2).
    """
    arms = _arms(roads)
    after, _, width, _, tangent = _corners(roads, arms)
    count = np.bincount(arms.group)[arms.group] if len(roads) else np.empty(0, np.int64)
    half = np.maximum(width, width[after]) / 2
    reach = np.maximum(np.maximum(tangent, tangent[np.argsort(after)]), half)
    metres, number = np.zeros((len(roads), 2)), np.ones((len(roads), 2), np.int64)
    metres[arms.road, arms.end] = np.where(count > 2, reach, 0.0)
    number[arms.road, arms.end] = count
    return metres, number


@dataclass(frozen=True, slots=True)
class _Arms:
    """Ends of carriageways, grouped by junction, counter-clockwise within a junction.

    group : (a,) int64 ascending
    road, end : (a,) int64 row of the carriageways, and 0 for its start or 1 for its end
    angle : (a,) float64 direction away from the node
    walk  : (a, 2) float64 sidewalk widths on the left and the right, seen from the node
    start_xy : (a, 2) float64 end of the centre line at the junction, which may lie beside the node
    """

    group: Ints
    road: Ints
    end: Ints
    angle: Float
    walk: Float
    start_xy: Float


def _arms(roads: Carriageways) -> _Arms:
    k = len(roads)
    road, end = np.tile(np.arange(k), 2), np.repeat([0, 1], k)
    node = roads.ends.T.ravel()
    place = roads.place
    level = np.where(place == 0, 0, roads.layer.astype(np.int64) * 3 + place)
    group = np.unique(np.stack([node, level[road]]), axis=1, return_inverse=True)[1].ravel()
    # A short distance along the line: its first centimetres may be drawn imprecisely.
    length = shapely.length(roads.line)
    ahead = np.where(end == 0, 1, -1) * np.minimum(5.0, length / 2)[road]
    there = shapely.get_coordinates(shapely.line_interpolate_point(roads.line[road], ahead))
    start_xy = shapely.get_coordinates(shapely.get_point(roads.line[road], np.where(end == 0, 0, -1)))
    away = there - start_xy
    angle = np.arctan2(away[:, 1], away[:, 0])
    walk = np.where((end == 0)[:, None], roads.walk[road], roads.walk[road][:, ::-1])
    order = np.lexsort([end, road, angle, group])
    return _Arms(group[order], road[order], end[order], angle[order], walk[order], start_xy[order])


def _corners(roads: Carriageways, arms: _Arms) -> tuple[Ints, Float, Float, Float, Float]:
    """For each arm: row of the next arm, angle to it, width of the arm, radius of the kerb between them.

    The last column is the distance from the node at which their kerbs touch a circle of that radius.
    """
    after = _neighbour(arms.group)
    between = (arms.angle[after] - arms.angle) % (2 * np.pi)
    width = roads.width[arms.road]
    by_class = [_RADIUS.get(s.highway.removesuffix("_link"), _RADIUS_ELSE) for s in roads.street]
    own = np.array(by_class, float)[arms.road]
    radius = np.minimum(own, own[after])
    half = np.maximum(width, width[after]) / 2
    tangent = (half + radius) / np.tan(np.clip(between, 0.02, np.pi) / 2)
    return after, between, width, radius, np.clip(np.where(between < np.pi, tangent, 0.0), 0.0, _REACH)


def _neighbour(group: Ints) -> Ints:
    """The next arm counter-clockwise: the next row of the group, cyclically."""
    last = np.flatnonzero(np.diff(group, append=-1))
    first = np.flatnonzero(np.diff(group, prepend=-1))
    after = np.arange(1, len(group) + 1)
    after[last] = first
    return after


def _stubs(roads: Carriageways, arms: _Arms, *, rows: Ints, length: Float) -> NDArray[np.object_]:
    """Carriageways of the first metres (n,) of some arms (n,)."""
    road = arms.road[rows]
    lines = roads.line[road]
    from_end = arms.end[rows] == 1
    lines[from_end] = shapely.reverse(lines[from_end])
    return carriageway(polylines.heads(lines, length), roads.width[road] / 2)


def carriageway(lines: NDArray[np.object_], half: Float) -> NDArray[np.object_]:
    """Bands around lines, given their half-widths, with flat ends and constant width in bends."""
    bands: NDArray[np.object_] = shapely.buffer(
        lines, half, cap_style="flat", join_style="mitre", mitre_limit=1.1
    )
    return bands


def _tapers(
    roads: Carriageways, arms: _Arms, *, rows: Ints, after: Ints, apart: Float
) -> NDArray[np.object_]:
    """Tapers (n,) between the ends of some arms (n,) and the next arms (n,), metres ``apart`` (n,)."""
    width, line = roads.width[arms.road[rows]], roads.line[arms.road[rows]]
    other = roads.width[arms.road[after]]
    far = np.minimum(_SLANT * np.maximum(other - width, 2 * apart), shapely.length(line) / 2)
    ahead = np.where(arms.end[rows] == 0, far, -np.maximum(far, 1e-9))
    there = shapely.get_coordinates(shapely.line_interpolate_point(line, ahead))
    across = np.stack([-np.sin(arms.angle[rows]), np.cos(arms.angle[rows])], axis=1) / 2
    start = arms.start_xy[after]
    corners = [
        start + across * other[:, None],
        start - across * other[:, None],
        there - across * width[:, None],
        there + across * width[:, None],
    ]
    tapers: NDArray[np.object_] = shapely.convex_hull(shapely.multipoints(np.stack(corners, axis=1)))
    return tapers


def _corner(shapes: NDArray[np.object_], radius: Float) -> NDArray[np.object_]:
    """Shapes (c, s), some None, as one each, with inner corners rounded where the radius is not 0."""
    corner, nth = np.nonzero(~shapely.is_missing(shapes))
    parts, of = _parts(shapes[corner, nth], corner)
    together = shapely.multipolygons(parts, indices=of)
    with np.errstate(divide="ignore", invalid="ignore"):  # GEOS divides by tiny edges; its result is finite
        grown = shapely.buffer(together, radius, quad_segs=_QUAD, join_style="mitre", mitre_limit=2.0)
        closed: NDArray[np.object_] = shapely.buffer(grown, -radius, quad_segs=_QUAD)
    return closed


def _wedges(arms: _Arms, between: Float, *, reach: Float) -> NDArray[np.object_]:
    """Wedges between consecutive arms as seen from the node."""
    turn = np.linspace(0.0, 1.0, 9)
    angle = arms.angle[:, None] + between[:, None] * turn
    radius = (2.0 * reach + 60.0)[:, None]
    rim = arms.start_xy[:, None] + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=2)
    # Arms in one direction have no angle between them, and a full turn on their other sides.
    ring = np.concatenate([arms.start_xy[:, None], rim], axis=1)
    around = between > 2 * np.pi - _ONE_DIRECTION
    ring[around, 0] = rim[around, 0]
    wedges: NDArray[np.object_] = shapely.polygons(ring)
    wedges[between < _ONE_DIRECTION] = shapely.Polygon()
    return wedges


def _parts(shapes: NDArray[np.object_], group: Ints) -> tuple[NDArray[np.object_], Ints]:
    """Polygons and the position of their group, for `shapely.multipolygons`."""
    parts, of = shapely.get_parts(shapes, return_index=True)
    areal = shapely.get_type_id(parts) == shapely.GeometryType.POLYGON
    parts, of = parts[areal], of[areal]
    _, index = np.unique(group, return_inverse=True)
    return parts, index[of]
