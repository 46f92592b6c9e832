"""The ego vehicle in the traffic simulation: its trip where it is simulated, its motion where it is fixed."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory
from lidar.motion.path import Path
from lidar.motion.speed_profile import desired_speed
from lidar.motion.vehicle import DRY, RoadConditions, Vehicle
from lidar.traffic.junctions import JunctionPlan, signal_group, zone_at
from lidar.traffic.lanes import STEP, ActorPath
from lidar.traffic.simulation_kernel import MOTION, STEP_S, EgoMotion, records
from lidar.traffic.sweep import CELL_SIZE, cells_under
from lidar.traffic.trips import Driver, TripCourse, driver_on

_ROOM = (0.4, 0.2)
"""Metres added to length and width of the ego's bounding box, for its deviation from the simulated motion."""
_DECELERATION, _ACCELERATION = 0.7, 0.8  # shares of the vehicle's maxima that the driver uses
_HEADWAY_S, _GAP = 1.4, 2.0
_KEEP = (0.8, 0.3)  # metres that others keep from the ego's box before and beside it
_NEAR = 6.0  # metres in plan from an edge's middle within which the ego may be on it
_BEYOND = 2.0
"""Metres of stations beyond the path's end: a simulated vehicle stops short of its last station."""


@dataclass(frozen=True, slots=True)
class EgoBox:
    """The ego's bounding box, one row per step (t).

    motion : (t,) `MOTION`
    half   : (2,) metres, half length and half width
    grown  : (t, 2) the same with the margin that others keep; None if they do not know the ego's motion
    level  : (t,) 1 on bridges and in tunnels, 0 elsewhere
    """

    motion: NDArray[np.void]
    half: Float
    grown: Float | None = None
    level: Ints | None = None

    def known(self, first: int, last: int) -> EgoMotion:
        """The motion, with the cells that the box covers from step ``first`` to ``last`` (exclusive)."""
        cells: list[Ints] = [np.empty(0, np.int64)] * (last - first)
        if self.grown is not None and self.level is not None:
            size = self.grown.max(axis=0)
            under = np.empty(int(4 * np.prod(size / CELL_SIZE + 2)), np.int64)
            for k in range(first, min(last, len(self.motion))):
                x, y, heading, _ = self.motion[k].item()
                n = cells_under(x, y, heading, self.grown[k], self.level[k], under)
                cells[k - first] = under[:n].copy()
        start = np.cumsum([0, *(len(part) for part in cells)])
        return EgoMotion(self.motion, self.half, first, start, np.concatenate(cells))


@dataclass(frozen=True, slots=True)
class EgoTrip:
    """The ego's trip, with the attributes of `lidar.traffic.trips.Trip`.

    xy, heading : (n, 2) and (n,) of the box's centre at each station
    """

    course: TripCourse
    driver: Driver
    length: float
    width: float
    xy: Float
    heading: Float
    begin: int = 0
    appear_s: float = 0.0
    leaves: bool = False
    on_foot: bool = False

    def body(self) -> tuple[Float, Float]:
        """Centre and heading of the box at each station."""
        return self.xy, self.heading


def ego_trip(path: Path, vehicle: Vehicle, *, at_speed: bool = False, road: RoadConditions = DRY) -> EgoTrip:
    """The ego's trip along its path, from rest or at speed; stations are `STEP` metres apart.

    road : conditions on which it brakes in an emergency
    """
    at = STEP * np.arange(math.ceil((path.length + _BEYOND) / STEP))
    # `s` repeats where the vehicle turns round
    s = path.s + 1e-9 * np.arange(len(path))
    scale = float(path.scale.mean())
    heading = np.interp(at, s, path.heading)
    ahead = scale * vehicle.middle
    axle = np.column_stack([np.interp(at, s, column) for column in path.position.T])
    xy = axle[:, :2] + ahead * np.column_stack([np.cos(heading), np.sin(heading)])
    row = np.searchsorted(s, at, side="right").clip(1, len(s)) - 1
    actor_path = ActorPath(
        np.column_stack([xy, axle[:, 2]]),
        heading,
        path.edge[row],
        np.zeros(len(at), np.int8),
        scale,
    )
    deceleration, acceleration = _DECELERATION * vehicle.deceleration, _ACCELERATION * vehicle.acceleration
    driver = Driver(vehicle.turning_radius, vehicle.max_speed, _HEADWAY_S, acceleration, deceleration, _GAP)
    driver = replace(driver, hard=driver_on(driver, road).hard)
    desired = np.interp(at, s, desired_speed(path, vehicle))
    if not at_speed:
        desired = np.minimum(desired, np.sqrt(2 * acceleration * (at + 0.2)))
    course = TripCourse(actor_path, desired)
    return EgoTrip(course, driver, vehicle.length + _ROOM[0], vehicle.width + _ROOM[1], xy, heading)


def ego_motion(ego: Trajectory, vehicle: Vehicle, *, graph: RoadGraph) -> EgoBox:
    """The ego's motion and the area that others keep free of."""
    length, width = vehicle.length, vehicle.width
    steps = int(ego.duration_ns * 1e-9 / STEP_S) + 2
    time = np.round(np.arange(steps) * STEP_S * 1e9).astype(np.int64)
    poses = ego.at(time)
    forward = poses.rotation[:, :, 0]
    middle = poses.position + poses.scale * forward * vehicle.middle
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    speed = np.interp(time, ego.time_ns, np.hypot(*ego.velocity[:, :2].T))
    motion = records(MOTION, x=middle[:, 0], y=middle[:, 1], heading=heading, speed=speed)
    grown = np.column_stack(
        [length / 2 + _KEEP[0] + speed * STEP_S / 2, np.full(steps, width / 2 + _KEEP[1])]
    )
    half = np.array([length / 2 + 0.2, width / 2 + 0.1])
    return EgoBox(motion, half, grown, _levels(graph, middle))


def _levels(graph: RoadGraph, xyz: Float) -> Ints:
    """1 for points (n, 3) on bridges and in tunnels, 0 for others: by the edge nearest in height."""
    out = np.zeros(len(xyz), np.int64)
    covered = graph.bridge | graph.tunnel
    if not covered.any():
        return out
    lines = edge_lines(graph)
    points = shapely.points(xyz[:, :2])
    row, edge = shapely.STRtree(lines).query(points, predicate="dwithin", distance=_NEAR)
    solid = np.array([shapely.linestrings(line) for line in graph.geometry], object)
    share = shapely.line_locate_point(lines[edge], points[row], normalized=True)
    z = shapely.get_z(shapely.line_interpolate_point(solid[edge], share, normalized=True))
    order = np.argsort(-np.abs(z - xyz[row, 2]), kind="stable")
    out[row[order]] = covered[edge[order]]
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
