"""Roads with lanes, and junctions that connect them, in the structure of OpenDRIVE."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.export.lane_links import (
    DrivenLane,
    LanePair,
    Pose,
    Turn,
    link_lanes,
    link_new_lanes,
    side_by_side,
)
from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lane_tags import Lane, LaneKind
from geoscene.roadgraph.lanes import LaneLayout, edge_lanes, graph_lanes
from geoscene.roadgraph.routing import turn_table
from geoscene.roadgraph.turn_lanes import STRAIGHT
from geoscene.typing import Bools, Float, Ints

START, END = 0, 1

_LEAST_GAP, _MOST_GAP, _MOST_SHARE = 2.0, 30.0, 0.4
_STRAIGHT = np.radians(0.05)
_TOGETHER = 0.01
"""Metres between the ends of two centre lines that are one line."""

REACH = 0.1
"""Metres that a reference line may cut a corner of its polyline by."""

_TURNING_BACK = np.radians(75.0)
"""Of two roads that leave a junction within this angle, turning from one into the other is turning back."""

_LEAST_DIVIDED = 0.5
"""Metres: shorter roads have one lane section."""

_LEVEL = 0.02
"""Metres a metre: connecting roads are not made longer for gradients below this."""

_SMALLEST_RADIUS = 0.3
_IN_LINE = 1e-4
"""Metres off a straight by which a vertex is no corner: it is there for its height."""


@dataclass(frozen=True, slots=True)
class Carriageway:
    """One road: an edge of the graph and its twin, cut back at junctions.

    edge     : number of its edge along the reference line
    twin     : number of the edge in the other direction, -1 for none
    line     : (n, 3) centre line as cut, scene metres
    plan     : the reference line
    begins   : metres along the edge's whole centre line at which ``line`` begins
    whole    : length of the whole centre line, metres
    ahead, back : lanes along the edge and against it, from the middle outwards
    shared   : metres of one more lane, used in both directions, between them; 0 without it
    shift    : metres that the line between the directions lies left of the reference line
    shoulder : metres of the carriageway on each side of the lanes
    """

    edge: int
    twin: int
    line: Float
    plan: PlanView
    begins: float
    whole: float
    ahead: tuple[Lane, ...]
    back: tuple[Lane, ...]
    shared: float
    shift: float
    shoulder: float


@dataclass(frozen=True, slots=True)
class Connection:
    """A connection through a junction.

    node   : node of the junction
    before, after : edges
    curve  : reference line
    lanes  : (k, 2) numbers of the lanes that are joined, from the middle outwards
    kinds  : (k) of the lanes
    widths : (k, 2) metres of each lane at its start and end
    rise   : (4,) height along it, coefficients of 1, s, s2, s3
    """

    node: int
    before: int
    after: int
    curve: Curve
    lanes: Ints
    kinds: tuple[LaneKind, ...]
    widths: Float
    rise: Float


@dataclass(frozen=True, slots=True)
class RoadNet:
    """Roads, junctions, the connections through them, and joints of roads without a junction.

    roads       : in the order of their edges
    road_of     : (m,) number of the road of each edge of the graph, -1 for none
    junctions   : (n,) bool, by node
    connections : in order of nodes and edges
    joints      : (road, end) to the (road, end) that continues it
    sections    : (k,) int64, lane sections of each road, of the same lanes; see `_sections`
    """

    roads: list[Carriageway]
    road_of: Ints
    junctions: Bools
    connections: list[Connection]
    joints: dict[tuple[int, int], tuple[int, int]]
    sections: Ints


def road_net(graph: RoadGraph, *, left_hand: bool = False, split_shared: bool = False) -> RoadNet:
    """The road graph as carriageways and junctions.

    split_shared : a single lane for both directions is written as a lane in each half of it

    A node where two roads with equal lanes meet within 0.05 degrees is a joint; any other node where roads
    meet is a junction, with a connection for every turn that the graph permits (`routing.turn_table`).
    """
    firsts = [
        k
        for k in range(len(graph))
        if not 0 <= graph.twin[k] < k and polylines.length(graph.geometry[k]) > 0.05
    ]
    number = {edge: k for k, edge in enumerate(firsts)}
    road_of = np.array(
        [number.get(k, number.get(int(graph.twin[k]), -1)) for k in range(len(graph))], np.int64
    )
    before, after = turn_table(graph)
    known = (road_of[before] >= 0) & (road_of[after] >= 0) & (graph.twin[before] != after)
    before, after = before[known], after[known]
    ends: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for k, edge in enumerate(firsts):
        ends[int(graph.tail[edge])].append((k, START))
        ends[int(graph.head[edge])].append((k, END))
    joints = _joints(graph, firsts, ends=ends, before=before, after=after)
    junctions = np.zeros(len(graph.node_id), np.bool_)
    junctions[graph.head[before]] = True
    for k, end in joints:
        edge = firsts[k]
        junctions[graph.head[edge] if end == END else graph.tail[edge]] = False
    gaps = _gaps(graph, firsts, ends=ends, junctions=junctions)
    lanes = graph_lanes(graph, left_hand=left_hand)
    roads = [
        _carriageway(graph, lanes, edge=edge, gap=gaps[k], left_hand=left_hand, split_shared=split_shared)
        for k, edge in enumerate(firsts)
    ]
    following: dict[int, list[int]] = defaultdict(list)
    for first, then in sorted(zip(before.tolist(), after.tolist(), strict=True)):
        if junctions[graph.head[first]]:
            following[first].append(then)
    turns = [
        turn
        for first, then in following.items()
        for turn in _turns(graph, roads, road_of=road_of, before=first, after=then, left_hand=left_hand)
    ]
    link_new_lanes(turns)
    connections = [
        _connection(turn, pairs, node=int(graph.head[turn.before]))
        for turn in turns
        for pairs in side_by_side(turn.pairs)
    ]
    connections.sort(key=lambda c: (c.node, c.before, c.after))
    sections = _sections(graph, roads, junctions=junctions)
    return RoadNet(roads, road_of, junctions, connections, joints, sections)


def _sections(graph: RoadGraph, roads: list[Carriageway], *, junctions: Bools) -> Ints:
    """Lane sections (k,) that tell each road apart for readers that know roads by their two junctions.

    A road that returns to the junction it begins at has three, as two would join the same points. All but the
    shortest of the roads between the same two junctions have two, if one of them is two-way and turning from
    one into another is turning back.
    """
    sections = np.ones(len(roads), np.int64)
    between: dict[tuple[int, int], list[int]] = defaultdict(list)
    for k, road in enumerate(roads):
        a, b = sorted((int(graph.tail[road.edge]), int(graph.head[road.edge])))
        if junctions[a] and junctions[b] and road.plan.total > _LEAST_DIVIDED:
            between[a, b].append(k)
    for (a, b), same in between.items():
        if a == b:
            sections[same] = 3
        elif any(roads[k].twin >= 0 for k in same) and any(
            _nearest_angle(graph, [roads[k].edge for k in same], node=node) < _TURNING_BACK for node in (a, b)
        ):
            by_length = sorted(same, key=lambda k: (roads[k].plan.total, k))
            sections[by_length[1:]] = 2
    return sections


def _nearest_angle(graph: RoadGraph, edges: Sequence[int], *, node: int) -> float:
    """Least angle (radians) between two of the edges that meet in a node; pi for a single one."""
    away = [_leaving_heading(graph, k, end=START if graph.tail[k] == node else END) for k in edges]
    return min((_angle(a, b) for k, a in enumerate(away) for b in away[:k]), default=np.pi)


def _leaving_heading(graph: RoadGraph, edge: int, *, end: int) -> float:
    """Heading (radians) in which a road leaves the node at one of its ends."""
    line = graph.geometry[edge]
    return polylines.end_headings(line if end == START else line[::-1], reach=1e-3)[0]


def _angle(a: float, b: float) -> float:
    return abs((a - b + np.pi) % (2 * np.pi) - np.pi)


def _joints(
    graph: RoadGraph,
    firsts: list[int],
    *,
    ends: dict[int, list[tuple[int, int]]],
    before: NDArray[np.int32],
    after: NDArray[np.int32],
) -> dict[tuple[int, int], tuple[int, int]]:
    turns = set(zip(before.tolist(), after.tolist(), strict=True))
    joints = {}
    for meeting in ends.values():
        if len(meeting) != 2 or meeting[0][0] == meeting[1][0]:
            continue
        (a, end_a), (b, end_b) = meeting
        edge_a, edge_b = firsts[a], firsts[b]
        away = _angle(_leaving_heading(graph, edge_a, end=end_a), _leaving_heading(graph, edge_b, end=end_b))
        if np.pi - away > _STRAIGHT:
            continue
        turned = end_a == end_b  # one runs against the other
        twin_a, twin_b = int(graph.twin[edge_a]), int(graph.twin[edge_b])
        if (twin_a < 0) != (twin_b < 0) or (twin_a < 0 and turned):
            continue
        along = (twin_b, edge_b) if turned else (edge_b, twin_b)
        same = _alike(graph, edge_a, other=along[0]) and graph.width[edge_a] == graph.width[edge_b]
        one, other = (
            graph.geometry[edge][-1 if end == END else 0, :2]
            for edge, end in ((edge_a, end_a), (edge_b, end_b))
        )
        same = same and bool(np.hypot(*(one - other)) < _TOGETHER)
        wanted = {(edge_a, along[0]) if end_a == END else (along[0], edge_a)}
        if twin_a >= 0:
            same = same and _alike(graph, twin_a, other=along[1])
            wanted.add((along[1], twin_a) if end_a == END else (twin_a, along[1]))
        if same and wanted <= turns:
            joints[a, end_a] = (b, end_b)
            joints[b, end_b] = (a, end_a)
    return joints


def _alike(graph: RoadGraph, edge: int, *, other: int) -> bool:
    """Whether two edges have the same lanes."""
    columns = (graph.lanes, graph.contraflow, graph.lane_kinds, graph.lane_widths)
    return all(bool(column[edge] == column[other]) for column in columns)


def _gaps(
    graph: RoadGraph, firsts: list[int], *, ends: dict[int, list[tuple[int, int]]], junctions: Bools
) -> Float:
    """Metres (roads, 2) by which each road is shortened at its ends to clear its neighbours.

    Roads of half widths a and b that leave a node at an angle t meet (b + a cos t) / sin t from it.
    """
    gaps = np.zeros((len(firsts), 2))
    for node, arms in ends.items():
        if not junctions[node]:
            continue
        heading = [_leaving_heading(graph, firsts[k], end=end) for k, end in arms]
        half = [graph.width[firsts[k]] / 2 for k, _ in arms]
        for i, (k, end) in enumerate(arms):
            need = _LEAST_GAP
            for j in range(len(arms)):
                t = _angle(heading[i], heading[j])
                if j != i and np.radians(5) < t < np.radians(170):
                    need = max(need, (half[j] + half[i] * np.cos(t)) / np.sin(t) + 1.0)
            most = min(_MOST_GAP, _MOST_SHARE * polylines.length(graph.geometry[firsts[k]]))
            gaps[k, end] = min(need, most)
    return gaps


def _carriageway(
    graph: RoadGraph, lanes: LaneLayout, *, edge: int, gap: Float, left_hand: bool, split_shared: bool
) -> Carriageway:
    full = graph.geometry[edge]
    fresh = np.append(True, np.hypot(*np.diff(full[:, :2], axis=0).T) > 1e-3)
    distinct = full[fresh]
    end = polylines.stations(distinct)[-1] - float(gap[END])
    line = polylines.cut(distinct, float(gap[START]), end=end, gap=1e-3)
    own, other, shared = int(lanes.own[edge]), int(lanes.other[edge]), int(lanes.shared[edge])
    borders = lanes.borders[edge]
    widths = (borders[:-1] - borders[1:])[: own + shared + other].tolist()
    twin = int(graph.twin[edge])
    described = [edge_lanes(graph, k) if k >= 0 else () for k in (edge, twin)]
    kinds = [sides[::-1] if left_hand else sides for sides in described]
    ahead = kinds[0] or (Lane(),) * own
    back = kinds[1] or (Lane("driving" if twin >= 0 else "bus"),) * other
    road = Carriageway(
        edge=edge,
        twin=twin,
        line=line,
        plan=plan_view(line[:, :2]),
        begins=float(gap[START]),
        whole=polylines.length(full),
        ahead=tuple(replace(lane, width=w) for lane, w in zip(ahead, widths[:own][::-1], strict=True)),
        back=tuple(replace(lane, width=w) for lane, w in zip(back, widths[own + shared :], strict=True)),
        shared=widths[own] if shared else 0.0,
        shift=-float(borders[own + shared]),
        shoulder=float(graph.width[edge] - lanes.span[edge]) / 2,
    )
    if split_shared and shared and not (own or other):
        half = (Lane(width=road.shared / 2),)
        return replace(road, ahead=half, back=half, shared=0.0, shift=0.0)
    return road


def driven_lanes(road: Carriageway, edge: int, *, left_hand: bool) -> list[DrivenLane]:
    """The lanes of one direction of a road, from the middle outwards.

    In right-hand traffic the lanes along the reference line have negative numbers, the shared lane among
    them. ``shift`` is that of right-hand traffic; it is mirrored for left-hand traffic.
    """
    sign = 1 if left_hand else -1  # of the lanes along the reference line
    along = edge == road.edge
    at = -sign * road.shift if along else sign * road.shift  # of the lanes' zero, left as one drives
    lanes = road.ahead if along else road.back
    first = 1
    if not lanes:  # the shared lane is all there is
        lanes = (Lane(width=road.shared),)
        at -= 0.0 if along else sign * road.shared
        along = True
    elif road.shared and along:
        first, at = 2, at + sign * road.shared
    number = sign if along else -sign
    found = []
    for k, lane in enumerate(lanes):
        found.append(DrivenLane(number * (first + k), lane, at, at + sign * lane.width / 2))
        at += sign * lane.width
    return found


def _turns(
    graph: RoadGraph,
    roads: list[Carriageway],
    *,
    road_of: Ints,
    before: int,
    after: Sequence[int],
    left_hand: bool,
) -> list[Turn]:
    """The turns from the end of one edge to the starts of others, with the lanes that they join."""
    source = roads[road_of[before]]
    begin = _pose(source, arriving=True, along=before == source.edge)
    room, steep = _within_junction(graph, source, edge=before, arriving=True)
    turns = []
    for edge in after:
        road = roads[road_of[edge]]
        end = _pose(road, arriving=False, along=edge == road.edge)
        beyond, other_steep = _within_junction(graph, road, edge=edge, arriving=False)
        there = driven_lanes(road, edge, left_hand=left_hand)
        steepest = max(steep, other_steep, abs(begin[2]), abs(end[2]))
        turns.append(Turn(before, edge, begin, end, there, [], (room, beyond), steepest))
    link_lanes(driven_lanes(source, before, left_hand=left_hand), turns, left_hand=left_hand)
    return turns


def _within_junction(
    graph: RoadGraph, road: Carriageway, *, edge: int, arriving: bool
) -> tuple[float, float]:
    """Metres from a road's end to the node, and the greatest gradient there."""
    line = graph.geometry[edge]
    first = road.begins
    last = road.whole - first - polylines.length(road.line)
    gap = last if arriving == (edge == road.edge) else first
    part = polylines.cut(line[::-1] if arriving else line, 0.0, end=gap)
    run = np.hypot(*np.diff(part[:, :2], axis=0).T)
    rise = np.abs(np.diff(part[:, 2]))
    return gap, float(np.max(rise[run > 1e-3] / run[run > 1e-3], initial=0.0))


def _connection(turn: Turn, pairs: Sequence[LanePair], *, node: int) -> Connection:
    """The connection of lanes that lie side by side, from the middle outwards."""
    (start, heading, slope), (stop, end_heading, end_slope) = turn.begin, turn.end
    first = start[:2] + pairs[0][0].inner * np.array([-np.sin(heading), np.cos(heading)])
    last = stop[:2] + pairs[0][1].inner * np.array([-np.sin(end_heading), np.cos(end_heading)])
    gradient = max(turn.steepest, _LEVEL)
    rise = float(stop[2] - start[2])
    curve = connecting_curve(
        first, heading, end=last, end_heading=end_heading, least=abs(rise) / gradient, room=turn.room
    )
    return Connection(
        node,
        turn.before,
        turn.after,
        curve,
        np.array([[a.number, b.number] for a, b in pairs], np.int64),
        tuple(a.lane.kind for a, _ in pairs),
        np.array([[a.lane.width, b.lane.width] for a, b in pairs]),
        height_profile(start[2], stop[2], slopes=(slope, end_slope), length=curve.length, steepest=gradient),
    )


def height_profile(
    start: float, stop: float, *, slopes: tuple[float, float], length: float, steepest: float
) -> Float:
    """Coefficients (4,) of 1, s, s2, s3 of the height between two roads, metres, for s along the connection.

    The profile continues the roads' gradients ``slopes`` if it is nowhere steeper than ``steepest`` (metres a
    metre) for that; else its gradient is constant.
    """
    length = max(length, 1e-3)
    (slope, end_slope), mean = slopes, (stop - start) / length
    c = (3 * mean - 2 * slope - end_slope) / length
    d = (slope + end_slope - 2 * mean) / length**2
    turning = -c / (3 * d) if d else 0.0  # where the gradient is greatest or least
    at = np.array([0.0, length, turning if 0.0 < turning < length else 0.0])
    if np.abs(slope + 2 * c * at + 3 * d * at**2).max() > steepest + 1e-9:
        return np.array([start, mean, 0.0, 0.0])
    return np.array([start, slope, c, d])


def _pose(road: Carriageway, *, arriving: bool, along: bool) -> Pose:
    last = arriving == along
    plan, line = road.plan, road.line
    rows = (-2, -1) if last else (0, 1)
    span = plan.at[rows[1]] - plan.at[rows[0]]
    slope = float((line[rows[1], 2] - line[rows[0], 2]) / span)
    heading = float(plan.heading[-1 if last else 0])
    if last:
        heading += float(plan.curvature[-1] * plan.length[-1])
    point = line[-1 if last else 0]
    return (point, heading, slope) if along else (point, heading + np.pi, -slope)


@dataclass(frozen=True, slots=True)
class PlanView:
    """Pieces of a reference line; each begins at the end of the previous one.

    s         : (k,) metres along the line to the piece's start
    x, y      : (k,) its start
    heading   : (k,) there, radians counter-clockwise from x
    length    : (k,) metres
    curvature : (k,) 1/metre, 0 for a straight line, positive to the left
    at        : (n,) metres along the line to the point nearest to each vertex of the polyline
    """

    s: Float
    x: Float
    y: Float
    heading: Float
    length: Float
    curvature: Float
    at: Float

    @property
    def total(self) -> float:
        """Length of the whole line, metres."""
        return float(self.s[-1] + self.length[-1])


def plan_view(points: Float, *, reach: float = REACH) -> PlanView:
    """Lines and arcs along a polyline (n, 2) without repeated points: its corners are rounded.

    An arc touches both sides of its corner and passes it by at most ``reach`` metres; it takes at most half
    of either side. With turn angle a and tangent t, its radius is t / tan(a / 2) and it passes the corner at
    t tan(a / 4). Corners too sharp for a radius of 0.3 m stay corners.
    """
    corner = _corners(points)
    along = polylines.stations(points)
    points = points[corner]
    step = np.diff(points, axis=0)
    side = np.hypot(*step.T)
    heading = np.arctan2(step[:, 1], step[:, 0])
    turn = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    bend = np.maximum(np.abs(turn), 1e-12)
    tangent = np.minimum(np.minimum(side[:-1], side[1:]) / 2, reach / np.tan(bend / 4))
    radius = tangent / np.tan(bend / 2)
    tangent = np.where(radius < _SMALLEST_RADIUS, 0.0, tangent)
    arc = np.where(tangent > 0, radius * bend, 0.0)

    before, after = np.append(0.0, tangent), np.append(tangent, 0.0)
    straight = np.maximum(side - before - after, 0.0)
    unit = step / side[:, None]
    line_start = points[:-1] + unit * before[:, None]
    arc_start = points[1:-1] - unit[:-1] * tangent[:, None]

    pieces = 2 * len(side) - 1
    columns = np.zeros((5, pieces))
    columns[:, 0::2] = line_start[:, 0], line_start[:, 1], heading, straight, np.zeros(len(side))
    curve = np.divide(np.sign(turn), radius, out=np.zeros_like(turn), where=tangent > 0)
    columns[:, 1::2] = arc_start[:, 0], arc_start[:, 1], heading[:-1], arc, curve
    s = np.cumsum(columns[3]) - columns[3]
    # Where the line is at each corner, and at both ends of each straight.
    reached = np.concatenate([[0.0], s[1::2] + arc / 2, [s[-1] + columns[3, -1]]])
    bases = np.append(0.0, np.cumsum(side))
    knots = np.concatenate([bases, bases[:-1] + before, bases[1:] - after])
    order = np.argsort(knots, kind="stable")
    stations = np.concatenate([reached, s[0::2], s[0::2] + straight])
    ends = np.interp(np.interp(along, along[corner], bases), knots[order], stations[order])
    keep = columns[3] > 1e-6
    x, y, angle, length, curvature = columns[:, keep]
    # Pieces left out are shorter than a micrometre: lengths are summed again so that s has no gap.
    return PlanView(np.cumsum(length) - length, x, y, angle, length, curvature, ends)


def section_starts(plan: PlanView, count: int) -> list[float]:
    """Metres along a line at which each of ``count`` sections begins, away from bends.

    Each is in the middle of the longest straight, within half a section of where equal sections would begin.
    """
    ends = plan.s + plan.length
    part = plan.total / count
    starts = [0.0]
    for middle in part * np.arange(1, count):
        begin, end = np.maximum(plan.s, middle - part / 2), np.minimum(ends, middle + part / 2)
        straight = np.where(plan.curvature == 0.0, end - begin, -np.inf)
        best = int(straight.argmax())
        starts.append(float(begin[best] + end[best]) / 2 if straight[best] > 0.0 else float(middle))
    return starts


def _corners(points: Float) -> Bools:
    """Which points (n,) of a polyline (n, 2) it needs to keep within `_IN_LINE` of all of them."""
    corner = np.zeros(len(points), np.bool_)
    corner[[0, -1]] = True
    kept = shapely.get_coordinates(
        shapely.simplify(polylines.flat(points), _IN_LINE, preserve_topology=False)
    )
    row = 0
    for point in kept[1:-1]:
        row += 1 + int(np.flatnonzero((points[row + 1 :] == point).all(axis=1))[0])
        corner[row] = True
    return corner


@dataclass(frozen=True, slots=True)
class Curve:
    """A cubic from one pose to another (OpenDRIVE paramPoly3, pRange normalized).

    x, y, heading : of its start
    u, v   : (4,) coefficients of forward and left offset, of 1, p, p2, p3 for p from 0 to 1
    length : metres
    """

    x: float
    y: float
    heading: float
    u: Float
    v: Float
    length: float


_TO_CORNER = 4 / 3  # a cubic between antiparallel handles goes three quarters of their length
_LENGTHENINGS = 21

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(96)  # cubics that nearly turn on the spot need that many


def connecting_curve(
    start: Float,
    heading: float,
    *,
    end: Float,
    end_heading: float,
    least: float = 0.0,
    room: tuple[float, float] = (0.0, 0.0),
) -> Curve:
    """The cubic from a point (2,) with a heading to another, close to an arc where an arc fits.

    For a turn by a with chord c the handles of an arc's cubic are c tan(a / 4) / (1.5 sin(a / 2)) long. In
    turns, they are lengthened until the curve is ``least`` metres long, but only until it reaches the corner
    of the roads, which is ``room`` metres ahead of the start and behind the end.
    """
    c, s = np.cos(heading), np.sin(heading)
    to_local = np.array([[c, s], [-s, c]])
    goal = to_local @ (end - start)
    turn = (end_heading - heading + np.pi) % (2 * np.pi) - np.pi
    bend = min(max(abs(turn), 1e-4), 0.95 * np.pi)
    handle = float(np.hypot(*goal) * np.tan(bend / 4) / (1.5 * np.sin(bend / 2)))
    most = np.maximum(handle, _TO_CORNER * np.array(room))
    for share in np.linspace(0.0, 1.0, _LENGTHENINGS) if abs(turn) > STRAIGHT else (0.0,):
        u, v, length = _cubic(goal, turn, handles=handle + share * (most - handle))
        if length >= least:
            break
    return Curve(float(start[0]), float(start[1]), heading, u, v, length)


def _cubic(goal: Float, turn: float, *, handles: Float) -> tuple[Float, Float, float]:
    """Coefficients (4,) of both coordinates, and length, of a cubic from 0 ahead to a point (2,) and a turn.

    handles : (2,) metres
    """
    leave, arrive = (
        3 * handles[0] * np.array([1.0, 0.0]),
        3 * handles[1] * np.array([np.cos(turn), np.sin(turn)]),
    )
    a, b = leave, 3 * goal - 2 * leave - arrive
    d = leave + arrive - 2 * goal
    p = (_NODES + 1) / 2
    speed = a[:, None] + 2 * b[:, None] * p + 3 * d[:, None] * p**2
    length = float((np.hypot(*speed) * _WEIGHTS).sum() / 2)
    u, v = (np.array([0.0, a[k], b[k], d[k]]) for k in (0, 1))
    return u, v, length
