"""Simulation of trips: tables for `lidar.traffic.simulation_kernel`, and its results."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory
from lidar.traffic.ego_trip import EgoTrip
from lidar.traffic.junctions import JunctionPlan, road_rank, signal_group, zone_at
from lidar.traffic.lanes import STEP, ActorPath
from lidar.traffic.simulation_kernel import (
    BLOCK,
    CELL,
    MOTION,
    STATION,
    USER,
    EgoMotion,
    Movers,
    simulated,
)
from lidar.traffic.surroundings import LEFT
from lidar.traffic.sweep import CELL_SIZE, Sweep, cells_under, sweep
from lidar.traffic.trips import Trip

STEP_S = 0.1
"""Seconds of a simulation step."""
_HORIZON = 60  # steps that the ego's path is known ahead: 6 s
_KEEP = (0.8, 0.3)  # metres that others keep from the ego's box before and beside it
_ROUNDS = 30
_NEAR = 6.0  # metres in plan from an edge's middle within which the ego may be on it
_LINE_REACH = 20.0  # metres before a junction within which lines to stop at are heeded
_LINE_ROOM = 4.0  # metres before the middle of a crossing, or a signal, at which the front of a vehicle stops


@dataclass(frozen=True, slots=True)
class SimulatedTrips:
    """Motion of the trips that appeared, sorted by trip and time.

    trip, step : (k,) int64
    travelled, speed : (k,) metres of the body's centre along the path, m/s
    """

    trip: Ints
    step: Ints
    travelled: Float
    speed: Float


def simulate_trips(
    trips: Sequence[Trip],
    graph: RoadGraph,
    *,
    plan: JunctionPlan,
    ego: Trajectory,
    ego_box: tuple[float, float, float],
    radius: float,
    obeys_signals: bool = False,
) -> SimulatedTrips:
    """The motion of trips around a fixed ego trajectory, from its start to its end.

    ego_box : length, width and metres from the rear axle to the middle of the ego's box
    obeys_signals   : whether the ego's motion obeys the signals; otherwise they turn green for it

    Trips that the ego would hit are left out.
    """
    if not trips:
        none = np.empty(0, np.int64)
        return SimulatedTrips(none, none, np.empty(0), np.empty(0))
    known = ego_motion(ego, ego_box, graph=graph)
    movers, known, cells = _tables(trips, known, graph=graph, plan=plan)
    signals = plan.signals if obeys_signals else plan.signals._replace(window=green_windows(plan, known))
    excluded = np.zeros(len(trips), bool)
    for _ in range(_ROUNDS):
        log, hit_ego = simulated(
            movers,
            known,
            signals=signals,
            excluded=excluded,
            cells=cells,
            dt=STEP_S,
            horizon=_HORIZON,
            radius=radius + LEFT,
        )
        if not hit_ego.any():
            break
        excluded |= hit_ego
    order = np.lexsort((log[:, 1], log[:, 0]))
    log = log[order]
    return SimulatedTrips(log[:, 0].astype(np.int64), log[:, 1].astype(np.int64), log[:, 2], log[:, 3])


def simulate_ego(
    ego: EgoTrip,
    trips: Sequence[Trip],
    *,
    graph: RoadGraph,
    plan: JunctionPlan,
    seconds: float,
    radius: float,
) -> Float:
    """Metres (t,) along its path that the ego has driven at each step of `STEP_S`, simulated with the trips.

    It follows, gives way and obeys signals and signs like the other road users, and they react to it.
    """
    steps = int(np.ceil(seconds / STEP_S)) + 1
    starts = np.zeros(steps + 1, np.int64)
    known = EgoMotion(np.zeros(steps, MOTION), np.full(2, -np.inf), starts, np.empty(0, np.int64))
    movers, known, cells = _tables([ego, *trips], known, graph=graph, plan=plan)
    excluded = np.zeros(len(trips) + 1, bool)
    log, _ = simulated(
        movers,
        known,
        signals=plan.signals,
        excluded=excluded,
        cells=cells,
        dt=STEP_S,
        horizon=_HORIZON,
        radius=radius + LEFT,
        ego_row=0,
    )
    mine = log[:, 0] == 0
    travelled = np.zeros(steps)
    travelled[log[mine, 1].astype(int)] = log[mine, 2]
    return np.maximum.accumulate(travelled)


def has_traffic_control(ego: EgoTrip, graph: RoadGraph, *, plan: JunctionPlan) -> bool:
    """Whether there are signals or stop signs along the ego's path."""
    blocks = _blocks(ego, graph, plan=plan, routes={})
    return bool((blocks[:, 4] >= 0).any() or (blocks[:, 7] > 0).any())


def ego_motion(ego: Trajectory, box: tuple[float, float, float], *, graph: RoadGraph) -> EgoMotion:
    """The ego's motion and the cells that it covers; ``box`` as in `simulate_trips`."""
    length, width, ahead = box
    steps = int(ego.duration_ns * 1e-9 / STEP_S) + 2
    time = np.round(np.arange(steps) * STEP_S * 1e9).astype(np.int64)
    poses = ego.at(time)
    forward = poses.rotation[:, :, 0]
    middle = poses.position + poses.scale * forward * ahead
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    speed = np.interp(time, ego.time_ns, np.hypot(*ego.velocity[:, :2].T))
    level = _levels(middle, graph)
    grown = np.column_stack(
        [length / 2 + _KEEP[0] + speed * STEP_S / 2, np.full(steps, width / 2 + _KEEP[1])]
    )
    under = np.empty(int(4 * np.prod(grown.max(axis=0) / CELL_SIZE + 2)), np.int64)
    events = []
    for k in range(steps):
        n = cells_under(middle[k, 0], middle[k, 1], heading[k], grown[k], level[k], under)
        events.append(under[:n].copy())
    start = np.concatenate([[0], np.cumsum([len(e) for e in events])])
    half = np.array([length / 2 + 0.2, width / 2 + 0.1])
    motion = _records(MOTION, x=middle[:, 0], y=middle[:, 1], heading=heading, speed=speed)
    return EgoMotion(motion, half, start, np.concatenate(events))


def _levels(xyz: Float, graph: RoadGraph) -> Ints:
    """1 for points (n, 3) on bridges and in tunnels, 0 for others: by the edge nearest in height."""
    covered = graph.bridge | graph.tunnel
    out = np.zeros(len(xyz), np.int64)
    if not covered.any():
        return out
    lines = edge_lines(graph)
    points = shapely.points(xyz[:, :2])
    row, edge = shapely.STRtree(lines).query(points, predicate="dwithin", distance=_NEAR)
    share = shapely.line_locate_point(lines[edge], points[row], normalized=True)
    solid = np.array([shapely.linestrings(graph.geometry[e]) for e in edge.tolist()], object)
    z = shapely.get_z(shapely.line_interpolate_point(solid, share, normalized=True))
    order = np.argsort(-np.abs(z - xyz[row, 2]), kind="stable")
    out[row[order]] = covered[edge[order]]
    return out


def green_windows(plan: JunctionPlan, ego: EgoMotion) -> Float:
    """Windows (w, 4) in which signals are green for the ego: from 8 s before it reaches a junction."""
    zone = zone_at(plan.zones, np.column_stack([ego.motion["x"], ego.motion["y"]]))
    rows = []
    cuts = np.flatnonzero(np.diff(np.concatenate([[-2], zone, [-2]])))
    for a, b in itertools.pairwise(cuts.tolist()):
        z = int(zone[a])
        if z >= 0 and plan.signalised[z]:
            rows.append(
                (
                    z,
                    signal_group(plan, z, heading=float(ego.motion["heading"][a])),
                    a * STEP_S - 8.0,
                    b * STEP_S,
                )
            )
    return np.array(rows, float).reshape(-1, 4)


def _tables(
    trips: Sequence[Trip | EgoTrip], ego: EgoMotion, *, graph: RoadGraph, plan: JunctionPlan
) -> tuple[Movers, EgoMotion, int]:
    """The tables of the simulation with cells numbered from 0, and the number of cells."""
    routes: dict[tuple[int, ...], int] = {}
    covered = graph.bridge | graph.tunnel
    stations, sweeps, passages = [], [], []
    for trip in trips:
        path = trip.path
        xy, heading = trip.body()
        swept = Sweep.empty()
        if len(trips) > 1 or len(ego.event_cell):  # alone, nobody takes its ground
            level = np.where(path.edge >= 0, covered[path.edge], False).astype(np.int64)
            swept = sweep(xy, heading, length=trip.length, width=trip.width, level=level, scale=path.scale)
        own = _records(STATION, desired_speed=trip.desired_speed, x=xy[:, 0], y=xy[:, 1], heading=heading)
        stations.append(own)
        sweeps.append(swept)
        passages.append(_blocks(trip, graph, plan=plan, routes=routes))
    blocks = np.concatenate(passages)
    columns = Sweep.concatenate(sweeps)
    used, number = np.unique(np.concatenate([columns.cell, ego.event_cell]), return_inverse=True)
    mine, its = np.split(number.astype(np.int32), [len(columns)])
    tables = (("station_start", stations), ("cell_start", sweeps), ("block_start", passages))
    starts = {name: np.cumsum([0, *(len(part) for part in parts)]) for name, parts in tables}
    drivers = ("headway", "acceleration", "deceleration", "gap")
    user = {name: [getattr(t.driver, name) for t in trips] for name in drivers}
    user |= {name: [getattr(t, name) for t in trips] for name in ("length", "width", "begin", "leaves")}
    user["appear"] = [int(t.appear_s / STEP_S) for t in trips]
    user["whole_block"] = [t.on_foot for t in trips]
    end = {name: [*values, 0] for name, values in user.items()}
    movers = Movers(
        _records(USER, **starts, **end),
        np.concatenate(stations),
        _records(CELL, number=mine, first=columns.first, last=columns.last, leave=columns.leave),
        _records(BLOCK, **dict(zip(BLOCK.names or (), blocks.T, strict=True))),
    )
    return movers, ego._replace(event_cell=its), len(used)


def _records(dtype: np.dtype[np.void], **columns: ArrayLike) -> NDArray[np.void]:
    """A table of records from its columns."""
    table = np.empty(np.size(next(iter(columns.values()))), dtype)
    for name, values in columns.items():
        table[name] = values
    return table


def _blocks(
    trip: Trip | EgoTrip, graph: RoadGraph, *, plan: JunctionPlan, routes: dict[tuple[int, ...], int]
) -> Float:
    """Passages through junctions (b, 8): from, to, stop, zone, group, route, rank, sign; see `BLOCK`."""
    path = trip.path
    zone = zone_at(plan.zones, path.xyz[:, :2])
    half = int(np.ceil((trip.length / 2 + 0.5) / STEP))
    rows: list[list[float]] = []
    for first, last, number in trip.crossing:
        if last >= trip.begin:
            z = int(zone[(first + last) // 2])
            group = signal_group(plan, z, heading=float(path.heading[(first + last) // 2])) if z >= 0 else -1
            key = routes.setdefault((-1, number), len(routes))
            rows.append([first, last, first - 1, z, group, key, 99.0, 0.0])
    if trip.on_foot:
        return np.array(rows, float).reshape(-1, 8)
    cuts = np.flatnonzero(np.diff(np.concatenate([[-2], zone, [-2]])))
    for a, b in itertools.pairwise(cuts.tolist()):
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
        rank = 2.0 * road_rank(str(graph.highway[entry]) if entry >= 0 else "") + 0.5 * (abs(bend) > 0.5)
        signs = graph.control_kind[graph.control_edge == entry]
        rank += 3.0 if np.isin(signs, ("stop", "give_way")).any() else 0.0
        group = signal_group(plan, z, heading=heading)
        halt = group < 0 and _stops(graph, entry)
        rows.append([start, end, stop, z, group, routes.setdefault(through, len(routes)), rank, float(halt)])
    return np.array(rows, float).reshape(-1, 8)


def _stops(graph: RoadGraph, edge: int) -> bool:
    """Whether there is a stop sign where an edge leads up to a junction."""
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
