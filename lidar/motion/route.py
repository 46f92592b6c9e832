"""Routes: the streets that a vehicle takes, and the lane centre line along them."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lanes import LaneLayout, graph_lanes
from geoscene.roadgraph.routing import turns_back
from geoscene.roadgraph.turn_lanes import lanes_into
from geoscene.typing import Float
from lidar.errors import RouteError
from lidar.motion.random_route import random_edges
from lidar.motion.waypoints import match_track, read_track, route_through

Side = Literal["right", "left"]
Spec = str | Path | Sequence[tuple[float, float]]

_STEP = 0.3  # metres between the lanes of two streets from which on a change of lane is drawn out
_STRAIGHT = 0.5  # cosine of the turn up to which a junction is gone straight over
_TURN_ROOM = 0.75  # turning radii that a U-turn takes beyond the place where the vehicle stops
_KEEP = 0.2  # metres between the body and the kerb where the carriageway is narrow


@dataclass(frozen=True, slots=True)
class Route:
    """A lane-level route over the road graph, or a free line.

    line  : (n, 3) float64 scene metres, lane centre in driving direction
    edge  : (n,) int32 edge of the road graph under each point, -1 off the graph
    limit : (n,) m/s, speed limit from each point on
    free  : (n,) bool, on a bridge or in a tunnel: buildings and ground are not checked there
    turns : (t,) int64 rows of `line` after which the vehicle turns round
    edges : (k,) int32 edges in driving order
    side  : side of the street that is driven on
    """

    line: Float
    edge: NDArray[np.int32]
    limit: Float
    free: NDArray[np.bool_]
    turns: NDArray[np.int64]
    edges: NDArray[np.int32]
    side: Side = "right"

    @property
    def length(self) -> float:
        """Scene metres of the line in plan."""
        return polylines.length(self.line)

    def least_seconds(self, max_speed: float) -> float:
        """Seconds that the route takes at its speed limits, and at most at ``max_speed`` in m/s."""
        steps = np.hypot(*np.diff(self.line[:, :2], axis=0).T)
        return float((steps / np.minimum(self.limit[:-1], max_speed)).sum())


@dataclass(frozen=True, slots=True)
class RouteOptions:
    """Options of route planning.

    seed       : of a random route
    duration   : seconds of a random route at the speed limits; 600 if neither this nor `length` is given
    length     : true metres of a random route
    side       : side of two-way streets that is driven on
    body_width : metres; the body stays inside narrow carriageways
    turning_radius : metres; the vehicle turns round before the island of a turning loop
    """

    seed: int = 0
    duration: float | None = None
    length: float | None = None
    side: Side = "right"
    body_width: float = 1.82
    turning_radius: float = 5.5


def plan_route(
    graph: RoadGraph,
    frame: Frame,
    *,
    spec: Spec,
    options: RouteOptions | None = None,
    avoid: Collection[tuple[int, int]] = (),
    roofs: shapely.STRtree | None = None,
) -> Route:
    """A route over the road graph.

    spec  : ``random``, a GPX or GeoJSON file, or two or more waypoints (latitude, longitude) in degrees
    avoid : turns (edge, edge) not to take; (edge, edge) of one edge twice closes it
    roofs : polygons in scene metres, below which a random route does not start

    Raises RouteError for a waypoint off the streets, one that cannot be reached, an unreadable file, or a
    graph without streets.
    """
    options = options or RouteOptions()
    lanes = functools.partial(
        lane_route,
        graph,
        side=options.side,
        body_width=options.body_width,
        turning_radius=options.turning_radius,
    )
    if spec == "random":
        _need_streets(graph)
        metres = np.inf if options.length is None else options.length
        seconds = np.inf if options.duration is None else options.duration
        if options.length is None and options.duration is None:
            seconds = 600.0
        edges, ends = random_edges(
            graph,
            seed=options.seed,
            seconds=seconds,
            metres=metres,
            avoid=avoid,
            body_width=options.body_width,
            roofs=roofs,
        )
        return lanes(edges, ends=ends)

    if isinstance(spec, str | Path):
        track = read_track(Path(spec), frame)
        _need_streets(graph)
        if track.dense:
            edges, ends = match_track(graph, track, frame=frame, avoid=avoid)
            return lanes(edges, ends=ends)
        points = track.lat_lon
    else:
        points = [(float(lat), float(lon)) for lat, lon in spec]
    _need_streets(graph)
    edges, ends = route_through(graph, frame, points=points, avoid=avoid)
    return lanes(edges, ends=ends)


def _need_streets(graph: RoadGraph) -> None:
    if not len(graph):
        raise RouteError("the scene has no drivable streets; build one of a place with roads")


# ------------------------------------------------------------------------------------------------ lanes


def _cut(line: Float, begin: float, *, end: float) -> Float:
    """The part of a line (k, 3) between two shares of its length in plan."""
    total = float(polylines.stations(line)[-1])
    return polylines.cut(line, begin * total, end=end * total)


def _joined_lanes(a: Float, b: Float, *, reach: float) -> tuple[Float, Float]:
    """Two lanes that follow each other, joined within ``reach``.

    Straight on, a lane that lies beside the other is left over five times the metres between them. In a turn
    the lanes are cut where they cross, or extended to where they meet.
    """
    u, v = polylines.unit(a[-1, :2] - a[-2, :2]), polylines.unit(b[1, :2] - b[0, :2])
    ahead = polylines.unit(u + v)
    gap = b[0, :2] - a[-1, :2]
    change = float(ahead[0] * gap[1] - ahead[1] * gap[0])
    if abs(change) > _STEP and u @ v > _STRAIGHT:
        long_a, long_b = polylines.length(a), polylines.length(b)
        taper = 2.5 * abs(change)
        return _cut(a, 0.0, end=max(1 - taper / long_a, 0.6)), _cut(b, min(taper / long_b, 0.4), end=1.0)
    one, two = shapely.linestrings(a[:, :2]), shapely.linestrings(b[:, :2])
    cross = shapely.get_coordinates(shapely.intersection(one, two))
    if len(cross):
        points = shapely.points(cross)
        spent = one.length - shapely.line_locate_point(one, points)
        spent = spent + shapely.line_locate_point(two, points)
        k = int(np.argmin(spent))
        if spent[k] <= 2 * reach:
            at_one = float(shapely.line_locate_point(one, points[k]) / one.length)
            at_two = float(shapely.line_locate_point(two, points[k]) / two.length)
            return _cut(a, 0.0, end=max(at_one, 1e-6)), _cut(b, min(at_two, 1 - 1e-6), end=1.0)
    sine = u[0] * v[1] - u[1] * v[0]
    if abs(sine) > 0.2:
        on_a, on_b = (gap[0] * v[1] - gap[1] * v[0]) / sine, (gap[0] * u[1] - gap[1] * u[0]) / sine
        if 0 < on_a < reach and -reach < on_b < 0:
            corner = np.append(a[-1, :2] + on_a * u, 0.5 * (a[-1, 2] + b[0, 2]))
            return np.concatenate([a, corner[None]]), b
    return a, b


def _turning_lane(graph: RoadGraph, layout: LaneLayout, *, edge: int, following: int, side: Side) -> int:
    """Number from the kerb of the outermost lane of an edge for cars whose arrow leads into the next edge."""
    from_kerb = lanes_into(graph, edge, left_hand=side == "left")[following]
    closed = layout.closed[edge]
    return next((lane for lane in from_kerb if not closed[lane]), int(layout.take([edge]).open_lane()[0]))


def lane_route(
    graph: RoadGraph,
    edges: ArrayLike,
    *,
    ends: tuple[float, float],
    side: Side = "right",
    body_width: float = 1.82,
    turning_radius: float = 5.5,
) -> Route:
    """The route along edges, in the outermost lane of each that is open to cars and leads into the next.

    It ends, begins and turns round before the island of a turning loop, with room for the manoeuvre.

    edges : (k,) each follows from the one before
    ends  : true metres from the first edge's tail to the start, and from the last one's tail to the end
    """
    order = np.asarray(edges, np.int32)
    layout = graph_lanes(graph, left_hand=side == "left")
    chosen = layout.open_lane()
    for edge, following in pairwise(order.tolist()):
        if graph.lane_turns[edge]:
            chosen[edge] = _turning_lane(graph, layout, edge=edge, following=following, side=side)
    offset = layout.offsets(chosen, body_width=body_width, clearance=_KEEP)
    offset = offset * (-1.0 if side == "right" else 1.0)
    lanes: list[Float] = []
    rounds = np.append(turns_back(graph, order[:-1], after=order[1:]), False)
    island = graph.node_island + _TURN_ROOM * turning_radius * (graph.node_island > 0)
    for k, e in enumerate(order):
        lane = polylines.offset_curve(graph.geometry[e], float(offset[e]))
        whole = max(float(graph.length[e]), 1e-9)
        begin = min(max(ends[0] / whole, 0.0), 1.0) if k == 0 else 0.0
        end = min(max(ends[1] / whole, 0.0), 1.0) if k == len(order) - 1 else 1.0
        if k == 0 or rounds[k - 1]:
            begin = max(begin, min(float(island[graph.tail[e]]) / whole, 0.5))
        if k == len(order) - 1 or rounds[k]:
            end = min(end, max(1.0 - float(island[graph.head[e]]) / whole, 0.5))
        lanes.append(_cut(lane, begin, end=max(end, begin + 1e-6)))
    for k in range(len(order) - 1):
        if not rounds[k]:
            reach = 2.0 * max(abs(float(offset[order[k]])), abs(float(offset[order[k + 1]])), 1.0)
            lanes[k], lanes[k + 1] = _joined_lanes(lanes[k], lanes[k + 1], reach=reach)
    sizes = np.array([len(lane) for lane in lanes])
    last = np.cumsum(sizes) - 1
    under = np.repeat(order, sizes).astype(np.int32)
    covered = graph.bridge | graph.tunnel
    return Route(
        np.concatenate(lanes),
        under,
        graph.speed[under],
        covered[under],
        last[rounds].astype(np.int64),
        order,
        side,
    )


def free_route(xyz: ArrayLike, *, limit: float = np.inf) -> Route:
    """A route along a line (n, 3) of scene metres off the road graph, with one speed limit in m/s."""
    line = np.asarray(xyz, float).reshape(-1, 3)
    if len(line) < 2 or not np.isfinite(line).all():
        raise RouteError("a route needs two points or more, all of them finite")
    n = len(line)
    return Route(
        line,
        np.full(n, -1, np.int32),
        np.full(n, float(limit)),
        np.zeros(n, bool),
        np.empty(0, np.int64),
        np.empty(0, np.int32),
    )
