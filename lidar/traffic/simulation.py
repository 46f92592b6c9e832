"""Simulation of trips around a fixed or a simulated ego vehicle."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.support.columns import Columns, row_blocks
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory, release, room
from lidar.traffic.ego_trip import EgoTrip
from lidar.traffic.junctions import JunctionPlan, signal_group, zone_at
from lidar.traffic.passages import passages
from lidar.traffic.simulation_kernel import MOTION, STEP_S
from lidar.traffic.simulation_windows import EgoBox, Log, TrafficSimulation, records
from lidar.traffic.trips import Trip

_KEEP = (0.8, 0.3)  # metres that others keep from the ego's box before and beside it
_ROUNDS = 30
_POINTS = 1 << 14  # points whose edges are looked for at once
_NEAR = 6.0  # metres in plan from an edge's middle within which the ego may be on it


@dataclass(frozen=True, slots=True)
class SimulatedTrips(Columns):
    """Motion of the trips that appeared, sorted by trip and time; that of a long drive is in files.

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
    signals = plan.signals if obeys_signals else plan.signals._replace(window=green_windows(plan, known))
    simulation = TrafficSimulation(trips, graph, plan=plan, ego=known, signals=signals, radius=radius)
    excluded = np.zeros(len(trips), bool)
    with closing(Log()) as log:
        for _ in range(_ROUNDS):
            log.clear()
            hit_ego = np.zeros(len(trips), bool)
            for rows, hit in simulation.windows(excluded):
                log.add(rows)
                hit_ego[hit] = True
            if not hit_ego.any():
                break
            excluded |= hit_ego
        return _by_trip(log, len(trips))


def _by_trip(log: Log, count: int) -> SimulatedTrips:
    """The rows of a log, sorted by trip and time."""
    knots = sum((np.bincount(rows[:, 0].astype(int), minlength=count) for rows in log), np.zeros(count, int))
    n = int(knots.sum())
    columns = [room((n,), kind) for kind in (np.int64, np.int64, float, float)]
    to = np.cumsum(knots) - knots
    for rows in log:
        trip = rows[:, 0].astype(int)
        order = np.argsort(trip, kind="stable")
        number = np.bincount(trip, minlength=count)
        rank = np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)
        place = to[trip[order]] + rank
        for column, values in zip(columns, rows[order].T, strict=True):
            column[place] = values
        release(*columns)
        to += number
    return SimulatedTrips(*columns)


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
    motion = EgoBox(room((steps,), MOTION), np.full(2, -np.inf))
    motion.motion[:] = 0
    simulation = TrafficSimulation(
        [ego, *trips], graph, plan=plan, ego=motion, signals=plan.signals, radius=radius, ego_row=0
    )
    travelled = np.zeros(steps)
    for rows, _ in simulation.windows(np.zeros(len(trips) + 1, bool)):
        mine = rows[:, 0] == 0
        travelled[rows[mine, 1].astype(int)] = rows[mine, 2]
    return np.maximum.accumulate(travelled)


def has_traffic_control(ego: EgoTrip, graph: RoadGraph, *, plan: JunctionPlan) -> bool:
    """Whether there are signals or stop signs along the ego's path."""
    blocks = passages(ego, ego.course, graph=graph, plan=plan, routes={})
    return bool((blocks[:, 4] >= 0).any() or (blocks[:, 7] > 0).any())


def ego_motion(ego: Trajectory, box: tuple[float, float, float], *, graph: RoadGraph) -> EgoBox:
    """The ego's motion and the area that others keep free of; ``box`` as in `simulate_trips`."""
    length, width, ahead = box
    steps = int(ego.duration_ns * 1e-9 / STEP_S) + 2
    time = np.round(np.arange(steps) * STEP_S * 1e9).astype(np.int64)
    level_of = _Levels(graph)
    motion, level = np.empty(steps, MOTION), np.empty(steps, np.int64)
    for rows, part in ego.windows(time, margin=2):
        poses = part.at(time[rows])
        forward = poses.rotation[:, :, 0]
        middle = poses.position + poses.scale * forward * ahead
        heading = np.arctan2(forward[:, 1], forward[:, 0])
        speed = np.interp(time[rows], part.time_ns, np.hypot(*part.velocity[:, :2].T))
        motion[rows] = records(MOTION, x=middle[:, 0], y=middle[:, 1], heading=heading, speed=speed)
        level[rows] = level_of(middle)
    grown = np.column_stack(
        [length / 2 + _KEEP[0] + motion["speed"] * STEP_S / 2, np.full(steps, width / 2 + _KEEP[1])]
    )
    return EgoBox(motion, np.array([length / 2 + 0.2, width / 2 + 0.1]), grown, level)


class _Levels:
    """Whether points are on bridges or in tunnels: by the edge of a graph nearest in height."""

    def __init__(self, graph: RoadGraph) -> None:
        self._covered = graph.bridge | graph.tunnel
        if self._covered.any():
            self._lines = edge_lines(graph)
            self._tree = shapely.STRtree(self._lines)
            self._solid = np.array([shapely.linestrings(line) for line in graph.geometry], object)

    def __call__(self, xyz: Float) -> Ints:
        """1 for points (n, 3) on bridges and in tunnels, 0 for others."""
        out = np.zeros(len(xyz), np.int64)
        if not self._covered.any():
            return out
        for rows in row_blocks(len(xyz), _POINTS):
            points = shapely.points(xyz[rows, :2])
            row, edge = self._tree.query(points, predicate="dwithin", distance=_NEAR)
            share = shapely.line_locate_point(self._lines[edge], points[row], normalized=True)
            z = shapely.get_z(shapely.line_interpolate_point(self._solid[edge], share, normalized=True))
            order = np.argsort(-np.abs(z - xyz[rows][row, 2]), kind="stable")
            out[rows.start + row[order]] = self._covered[edge[order]]
        return out


def green_windows(plan: JunctionPlan, ego: EgoBox) -> Float:
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
