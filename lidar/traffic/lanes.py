"""Lanes of the road graph for traffic, and the paths of road users along them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lanes import LaneLayout, graph_lanes
from geoscene.roadgraph.routing import HEADING_REACH, turn_states
from geoscene.roadgraph.turn_lanes import lanes_into
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.motion.steering import relax

STEP = 0.5
"""True metres between the stations of a path."""
_KERB = 0.25  # metres between a body and the edge of the carriageway where there is room
_SIDE = 0.55  # metres, minimum distance between bodies in neighbouring lanes
_QUIET = {"service": 0.02, "track": 0.0, "living_street": 0.2}
"""Relative density of traffic on minor roads."""
_STRAIGHT = np.radians(30.0)
_EDGE = 60.0  # metres from the bounds of the map within which a dead end leaves the map


@dataclass(frozen=True, slots=True)
class Lanes:
    """Lanes of a road graph.

    graph  : the road graph
    layout : lanes of each edge and where they lie
    count  : (m,) int64, lanes in the direction of each edge
    max_width : (m,) metres, maximum width of a body on each edge
    side   : 1 where traffic keeps right, -1 where it keeps left
    state  : (s,) the edge of each state of `geoscene.roadgraph.routing.turn_states`
    successors : permitted next states of each state
    leads_on : (s,) bool, the state does not lead into a dead end inside the map
    leave, enter : (m,) headings in which an edge is left and entered, radians
    traffic_weight : (m,) relative density of traffic
    open   : (m,) bool, `leads_on` of the first state of each edge
    exit, entry : (m,) bool, the edge ends, or begins, at the map's edge
    leading : lanes of an edge that lead into each that follows, by arrows, as `lanes_into` numbers them
    """

    graph: RoadGraph
    layout: LaneLayout
    count: Ints
    max_width: Float
    side: int
    state: Ints
    successors: Sequence[Ints]
    leads_on: NDArray[np.bool_]
    leave: Float
    enter: Float
    traffic_weight: Float
    open: NDArray[np.bool_]
    exit: NDArray[np.bool_]
    entry: NDArray[np.bool_]
    leading: Callable[[int], Mapping[int, Sequence[int]]]


def lanes_of(
    graph: RoadGraph,
    *,
    side: str = "right",
    bounds: tuple[float, float, float, float] | None = None,
    cut_nodes: Ints | None = None,
) -> Lanes:
    """The lanes of a road graph.

    bounds    : (xmin, ymin, xmax, ymax) of the map in scene metres; streets that end near them continue
                outside
    cut_nodes : ids of nodes from which streets continue that the graph does not have
    """
    layout = graph_lanes(graph, left_hand=side == "left")
    single = layout.count == 1
    lane_width = np.where(single & layout.shared, graph.width / 2, layout.width) - _SIDE
    max_width = np.where(single & ~layout.shared, graph.width - 2 * _KERB, lane_width)
    states = turn_states(graph)
    before, after, state = states.before, states.after, states.edge.astype(np.int64)
    order = np.argsort(before, kind="stable")
    starts = np.searchsorted(before[order], np.arange(len(states) + 1))
    successors = [after[order[a:b]].astype(np.int64) for a, b in itertools.pairwise(starts)]
    ends = [polylines.end_headings(line, reach=HEADING_REACH) for line in graph.geometry]
    enter, leave = np.array(ends).reshape(-1, 2).T
    traffic_weight = np.array([_QUIET.get(str(kind), 1.0) for kind in graph.highway])
    leads_out = _at_edge(graph, bounds, end=graph.head, other=graph.tail)
    if cut_nodes is not None:
        leads_out |= np.isin(graph.node_id[graph.head], cut_nodes)
    leads_in = _at_edge(graph, bounds, end=graph.tail, other=graph.head)
    straight_on = graph.twin[state[before]] != state[after]
    leads_on = _leading_on(before[straight_on], after[straight_on], leads_out=leads_out[state])
    return Lanes(
        graph,
        layout,
        np.maximum(layout.own, 1),
        max_width,
        1 if side == "right" else -1,
        state,
        successors,
        leads_on,
        leave,
        enter,
        traffic_weight,
        leads_on[: len(graph)],
        leads_out,
        leads_in,
        cache(partial(lanes_into, graph, left_hand=side == "left")),
    )


def _at_edge(
    graph: RoadGraph,
    bounds: tuple[float, float, float, float] | None,
    *,
    end: NDArray[np.int32],
    other: NDArray[np.int32],
) -> NDArray[np.bool_]:
    """Whether (m,) an end of each edge is near the map's edge and joins no other street."""
    if bounds is None:
        return np.zeros(len(graph), np.bool_)
    xy = graph.node_xyz[end, :2]
    within = np.minimum(xy - bounds[:2], np.array(bounds[2:]) - xy).min(axis=1)
    joining = np.bincount(other, minlength=len(graph.node_id))[end]
    out: NDArray[np.bool_] = (within < _EDGE) & (joining - (graph.twin >= 0) < 1)
    return out


def _leading_on(before: Ints, after: Ints, *, leads_out: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether (s,) a drive from each state can continue endlessly or to the map's edge."""
    leads_on = np.ones(len(leads_out), np.bool_)
    while True:
        further = leads_out.copy()
        further[before[leads_on[after]]] = True
        if np.array_equal(further, leads_on):
            return leads_on
        leads_on = further


def turn(lanes: Lanes, a: int, *, b: int) -> float:
    """Change of heading in radians from edge a to edge b, positive to the left."""
    return float((lanes.enter[b] - lanes.leave[a] + np.pi) % (2 * np.pi) - np.pi)


def lane_shift(lanes: Lanes, edge: int, *, lane: int, width: float, kerb: bool = False) -> float:
    """Metres from an edge's centre line to a body's path in a lane, positive on the side that is driven on.

    Lane 0 is the one at the kerb. A body of that width stays inside the carriageway where there is room; with
    ``kerb`` it keeps to the kerb.
    """
    if kerb and lane == 0:
        half = (float(lanes.graph.width[edge]) - width) / 2
        room = max(half - _KERB, 0.0)
        return float(np.clip(half - 2 * _KERB, -room, room))
    return float(lanes.layout.take([edge]).offsets(lane, body_width=width, clearance=_KERB)[0])


@dataclass(frozen=True, slots=True)
class ActorPath(Columns):
    """The path of a road user's centre, with stations every `STEP` true metres.

    xyz     : (n, 3) scene metres
    heading : (n,) radians, unwrapped
    edge    : (n,) int32 edge of the graph, -1 off it
    lane    : (n,) int8 lane on the edge
    scale   : scene metres per true metre
    """

    xyz: Float
    heading: Float
    edge: NDArray[np.int32]
    lane: NDArray[np.int8]
    scale: float


def edge_name(graph: RoadGraph, edge: int) -> str:
    """Name of an edge that does not depend on the extent of the map, for keys of random numbers."""
    ends = graph.node_id[[graph.tail[edge], graph.head[edge]]].tolist()
    return f"{graph.osm_id[edge]} from {ends[0]} to {ends[1]}"


def open_lanes(lanes: Lanes, edge: int, *, any_kind: bool = False) -> Ints:
    """Numbers of the lanes of an edge that cars may use; with ``any_kind``, or without such lanes, of all."""
    closed = lanes.layout.closed[edge, : int(lanes.count[edge])]
    return np.arange(len(closed)) if any_kind or closed.all() else np.flatnonzero(~closed)


def random_lanes(
    lanes: Lanes,
    rng: np.random.Generator,
    *,
    edge: int,
    lane: int,
    metres: float,
    inside: NDArray[np.bool_],
    width: float,
    any_kind: bool = False,
) -> tuple[list[int], list[int]]:
    """Edges and lanes of a random drive from an edge, up to ``metres`` or out of the edges ``inside``.

    Road users go where the arrows of their lane point. Without arrows they go straight on or turn towards the
    kerb from the kerb lane; from the innermost lane straight on or away from it, if possible. Straight on is
    preferred.

    any_kind : also use lanes that are closed to cars, whatever the arrows
    """
    edges, picked = [edge], [lane]
    far = float(lanes.graph.length[edge])
    state = edge
    while far < metres:
        states = lanes.successors[state]
        ways = lanes.state[states]
        fit = (
            (lanes.max_width[ways] >= width)
            & (lanes.traffic_weight[ways] > 0)
            & (lanes.graph.twin[edge] != ways)
        )
        states, ways = states[fit], ways[fit]
        if not len(ways):
            break
        turns = np.array([turn(lanes, edge, b=int(w)) for w in ways])
        weight = lanes.traffic_weight[ways] * np.where(np.abs(turns) < _STRAIGHT, 3.0, 1.0)
        weight = weight * np.where(np.abs(turns) > np.radians(140), 0.02, 1.0)
        weight = weight * np.where(lanes.leads_on[states], 1.0, 1e-9)
        here = open_lanes(lanes, edge, any_kind=any_kind)
        if len(here) > 1 and lanes.graph.lane_turns[edge] and not any_kind:
            into = lanes.leading(edge)
            leads = np.array([lane in into.get(int(way), ()) for way in ways])
            weight = np.where(leads, weight, 1e-6 * weight)
        elif len(here) > 1:
            inward = turns * lanes.side > _STRAIGHT
            outward = turns * lanes.side < -_STRAIGHT
            weight = np.where((lane > here[0]) & outward, 1e-6 * weight, weight)
            weight = np.where((lane < here[-1]) & inward, 1e-6 * weight, weight)
        k = int(np.searchsorted(np.cumsum(weight), rng.random() * weight.sum(), side="right"))
        k = min(k, len(ways) - 1)
        state, following = int(states[k]), int(ways[k])
        there = open_lanes(lanes, following, any_kind=any_kind)
        if turns[k] * lanes.side > _STRAIGHT:
            lane = int(there[-1])
        elif turns[k] * lanes.side < -_STRAIGHT:
            lane = int(there[0])
        else:
            lane = int(there[np.argmin(np.abs(there - lane))])
        edge = following
        edges.append(edge)
        picked.append(lane)
        far += float(lanes.graph.length[edge])
        if not inside[edge]:
            break
    return edges, picked


def path_along_lanes(
    lanes: Lanes,
    edges: NDArray[np.int32],
    *,
    picked: NDArray[np.int8],
    width: float,
    radius: float,
    scale: float,
    keeps_kerb: bool = False,
) -> ActorPath:
    """The path along lanes of consecutive edges, rounded to a turning radius.

    width  : metres of the body
    radius : true metres
    keeps_kerb : keep to the kerb within the lane
    """
    parts, owner = [], []
    graph = lanes.graph
    lines = [
        polylines.parallel(
            graph.geometry[e],
            -lanes.side * scale * lane_shift(lanes, e, lane=k, width=width, kerb=keeps_kerb),
        )
        for e, k in zip(edges.tolist(), picked.tolist(), strict=True)
    ]
    for k, line in enumerate(lines):
        if k + 1 < len(lines):
            line, following, joint = _joint(line, lines[k + 1], radius=radius)  # noqa: PLW2901
            lines[k + 1] = following
        else:
            joint = np.empty((0, 3))
        parts += [line, joint]
        owner += [np.full(len(line), k), np.full(len(joint), k)]
    xyz, own = np.concatenate(parts), np.concatenate(owner)
    along = polylines.stations(xyz)
    keep = np.concatenate([[True], np.diff(along) > 1e-6])
    xyz, own, along = xyz[keep], own[keep], along[keep]
    gap = STEP * scale
    at = np.arange(0.0, max(along[-1], 6 * gap), gap)
    line = polylines.points_at(xyz, at, along=along)
    row = own[np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(own) - 1)]
    return round_corners(line, edges[row], lane=picked[row], radius=radius, scale=scale)


def round_corners(
    line: Float, edge: NDArray[np.int32], *, lane: NDArray[np.int8], radius: float, scale: float
) -> ActorPath:
    """The path along a line (n, 3) of evenly spaced points, rounded to a turning radius.

    radius     : true metres
    edge, lane : columns of `ActorPath` at the points
    """
    gap = STEP * scale
    smooth = relax(line[:, :2], 0.95 / radius / scale, reach=0.45 * radius)
    # corners that were rounded are shorter: even spacing again
    length = polylines.stations(smooth)
    even = np.arange(0.0, length[-1], gap)
    near = np.clip(np.searchsorted(length, even), 0, len(line) - 1)
    out = polylines.points_at(np.column_stack([smooth, line[:, 2]]), even, along=length)
    return ActorPath(out, polylines.headings(out), edge[near], lane[near], scale)


def _joint(a: Float, b: Float, *, radius: float) -> tuple[Float, Float, Float]:
    """Two lanes, cut back at their junction, and the curve (c, 3) between them."""
    u, v = polylines.unit(a[-1, :2] - a[-2, :2]), polylines.unit(b[1, :2] - b[0, :2])
    gap = b[0, :2] - a[-1, :2]
    sine, cosine = float(u[0] * v[1] - u[1] * v[0]), float(u @ v)
    long_a, long_b = polylines.length(a), polylines.length(b)
    if abs(sine) > 0.25:
        on_a = (gap[0] * v[1] - gap[1] * v[0]) / sine  # metres beyond a's end to where the lanes cross
        on_b = (gap[0] * u[1] - gap[1] * u[0]) / sine  # metres after b's start
        angle = abs(float(np.arctan2(sine, cosine)))
        back = 1.15 * radius * np.tan(min(angle, 2.4) / 2)
        cut_a, cut_b = back - on_a, back + on_b
    else:
        aside = abs(float(u[0] * gap[1] - u[1] * gap[0]))
        cut_a = cut_b = 0.0 if aside < 0.05 else max(4.0 * aside, 2.0) + max(-float(gap @ u), 0.0)
    a = polylines.cut(a, 0.0, end=max(long_a - max(cut_a, 0.0), 0.55 * long_a), gap=1e-6, least=1e-3)
    b = polylines.cut(b, min(max(cut_b, 0.0), 0.45 * long_b), end=long_b, gap=1e-6, least=1e-3)
    p, q = a[-1], b[0]
    u, v = polylines.unit(a[-1, :2] - a[-2, :2]), polylines.unit(b[1, :2] - b[0, :2])
    reach = float(np.hypot(*(q - p)[:2]))
    if reach < 0.2:
        return a, b, np.empty((0, 3))
    t = np.linspace(0.0, 1.0, max(int(reach / 0.5), 2) + 1)[1:-1, None]
    handle = 0.4 * reach
    p1, q1 = p[:2] + handle * u, q[:2] - handle * v
    xy = (1 - t) ** 3 * p[:2] + 3 * t * (1 - t) ** 2 * p1 + 3 * t**2 * (1 - t) * q1 + t**3 * q[:2]
    return a, b, np.column_stack([xy, p[2] + t * (q[2] - p[2])])
