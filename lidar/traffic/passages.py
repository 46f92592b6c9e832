"""Passages of road users through junctions: their routes, and where they wait."""

from __future__ import annotations

import itertools

import numpy as np

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.typing import Float
from lidar.traffic.ego import EgoTrip
from lidar.traffic.junctions import JunctionPlan, road_rank, signal_group, zone_at
from lidar.traffic.lanes import STEP, ActorPath
from lidar.traffic.trips import Trip

_TURN = 0.5  # radians from which on traffic turns
_ON_ROUNDABOUT, _ENTERING = -1.0, 20.0  # ranks of traffic on a roundabout, and of that which enters one
_LINE_REACH = 20.0  # metres before a junction within which lines to stop at are heeded
_LINE_ROOM = 4.0  # metres before the middle of a crossing, or a signal, at which the front of a vehicle stops


def passages(
    trip: Trip | EgoTrip, graph: RoadGraph, *, plan: JunctionPlan, routes: dict[tuple[int, ...], int]
) -> Float:
    """Passages through junctions (b, 8): from, to, stop, zone, group, route, rank, sign; see `BLOCK`.

    routes : numbers of the routes through junctions so far; new ones are added
    """
    path = trip.course.path
    zone = zone_at(plan.zones, path.xyz[:, :2])
    half = int(np.ceil((trip.length / 2 + 0.5) / STEP))
    rows: list[list[float]] = []
    for first, last, number in trip.course.crossing:
        if last >= trip.begin:
            z = int(zone[(first + last) // 2])
            group = signal_group(plan, z, heading=float(path.heading[(first + last) // 2])) if z >= 0 else -1
            key = routes.setdefault((-1, number), len(routes))
            rows.append([first, last, first - 1, z, group, key, 99.0, 0.0])
    if trip.on_foot:
        return np.array(rows, float).reshape(-1, 8)
    begins = np.flatnonzero(np.diff(zone, prepend=-2))
    for a, b in itertools.pairwise([*begins.tolist(), len(zone)]):
        z = int(zone[a])
        if z < 0 or b - 1 + half < trip.begin:
            continue
        before, behind = max(a - 1, 0), min(b, len(path) - 1)
        through = (
            z,
            *(int(v) for v in (path.edge[before], path.lane[before], path.edge[behind], path.lane[behind])),
        )
        heading, entry = float(path.heading[before]), int(path.edge[before])
        start, end = a - half, b - 1 + half
        stop = min(start - 2, _stop_line(path, graph, edge=entry, station=a) - half)
        if stop < 4 and isinstance(trip, EgoTrip):  # it starts inside the junction
            continue
        if rows and stop - rows[-1][1] < 2:  # no room to stand between two junctions
            rows[-1][1] = end
            rows[-1][5] = routes.setdefault((int(rows[-1][5]), -1, *through), len(routes))
            continue
        bend = (float(path.heading[behind]) - heading + np.pi) % (2 * np.pi) - np.pi
        rank = _rank(graph, entry, turns=abs(bend) > _TURN)
        group = signal_group(plan, z, heading=heading)
        halt = group < 0 and _stops(graph, entry)
        rows.append([start, end, stop, z, group, routes.setdefault(through, len(routes)), rank, float(halt)])
    return np.array(rows, float).reshape(-1, 8)


def _rank(graph: RoadGraph, edge: int, *, turns: bool) -> float:
    """Rank of the traffic that comes from an edge, lower goes first.

    Traffic on a roundabout goes before that which enters it; all that enters a mini-roundabout is equal, and
    waits for those who are in it. Else it is by class, signs, and whether it turns.
    """
    if edge < 0:
        return 2.0 * road_rank("") + 0.5 * turns
    if graph.roundabout[edge]:
        return _ON_ROUNDABOUT
    signs = graph.control_kind[graph.control_edge == edge]
    if "mini_roundabout" in signs or graph.roundabout[graph.tail == graph.head[edge]].any():
        return _ENTERING
    yields = bool(np.isin(signs, ("stop", "give_way")).any())
    return 2.0 * road_rank(str(graph.highway[edge])) + 0.5 * turns + 3.0 * yields


def _stops(graph: RoadGraph, edge: int) -> bool:
    """Whether a stop sign is at the end of an edge."""
    here = (graph.control_edge == edge) & (graph.control_kind == "stop")
    near = graph.length[edge] - graph.control_offset[here] < _LINE_REACH
    return edge >= 0 and bool(near.any() or graph.stop[graph.head[edge]])


def _stop_line(path: ActorPath, graph: RoadGraph, *, edge: int, station: int) -> int:
    """Station of the first stop line on the edge that leads to a junction at ``station``."""
    here = graph.control_edge == edge
    offset = graph.control_offset[here]
    offset = offset[graph.length[edge] - offset < _LINE_REACH]
    if not len(offset):
        return station
    line = graph.geometry[edge][:, :2]
    along = polylines.stations(line)
    at = float(offset.min()) / max(float(graph.length[edge]), 1e-9) * along[-1]
    point = polylines.points_at(line, [at], along=along)[0]
    first = max(station - int(2 * _LINE_REACH / STEP), 0)
    distance = np.hypot(*(path.xyz[first : station + 1, :2] - point).T)
    return first + int(np.argmin(distance)) - int(_LINE_ROOM / STEP)
