"""The ego vehicle as a road user of the traffic simulation."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from geoscene.typing import Float
from lidar.motion.blockwise import even, interpolate, rowwise
from lidar.motion.path import Path
from lidar.motion.road_conditions import DRY, RoadConditions
from lidar.motion.speed_profile import desired_speed
from lidar.motion.vehicle import Vehicle
from lidar.traffic.lanes import STEP, ActorPath
from lidar.traffic.trips import Driver, TripCourse, driver_on

_ROOM = (0.4, 0.2)
"""Metres added to length and width of the ego's bounding box, for its deviation from the simulated motion."""
_BRAKE = 0.7  # share of its braking that the driver uses for what is ahead, and
_PULL = 0.8  # of its acceleration
_HEADWAY_S, _GAP = 1.4, 2.0
_BEYOND = 2.0
"""Metres of stations at the path's end, all there: a simulated vehicle stops short of its last station."""


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

    def draw(self) -> TripCourse:
        """Its course."""
        return self.course

    def body(self, path: ActorPath) -> tuple[Float, Float]:  # noqa: ARG002 - as of other trips
        """Centre and heading of the box at each station."""
        return self.xy, self.heading


def ego_trip(path: Path, vehicle: Vehicle, *, at_speed: bool = False, road: RoadConditions = DRY) -> EgoTrip:
    """The ego's trip along its path, from rest or at speed; stations are `STEP` metres apart.

    road : conditions on which it brakes in an emergency
    """
    at = even(math.ceil((path.length + _BEYOND) / STEP), STEP)
    # `s` repeats where the vehicle turns round
    s = rowwise(np.add, path.s, even(len(path), 1e-9))
    scale = float(path.scale.mean())
    heading = interpolate(at, s, column=path.heading)
    ahead = scale * (vehicle.length / 2 - vehicle.rear_overhang)
    axle = [interpolate(at, s, column=path.position[:, c]) for c in range(3)]
    shift = rowwise(lambda angle: ahead * np.column_stack([np.cos(angle), np.sin(angle)]), heading)
    xy = rowwise(lambda by, *axle: np.column_stack(axle) + by, shift, *axle[:2])
    row = rowwise(lambda at: np.searchsorted(s, at, side="right").clip(1, len(s)) - 1, at, looked_up=(s,))
    curvature, edge, limit = (
        rowwise(lambda row, column=column: column[row], row, looked_up=(column,))
        for column in (path.curvature, path.edge, path.limit)
    )
    actor_path = ActorPath(
        rowwise(lambda xy, z: np.column_stack([xy, z]), xy, axle[2]),
        heading,
        curvature,
        rowwise(lambda edge: edge.astype(np.int64), edge),
        rowwise(lambda at: np.zeros(len(at), np.int64), at),
        limit,
        scale,
    )
    deceleration, acceleration = _BRAKE * vehicle.deceleration, _PULL * vehicle.acceleration
    driver = Driver(vehicle.turning_radius, vehicle.max_speed, _HEADWAY_S, acceleration, deceleration, _GAP)
    driver = replace(driver, hard=driver_on(driver, road).hard)
    desired = interpolate(at, s, column=desired_speed(path, vehicle))
    if not at_speed:
        desired = rowwise(lambda v, at: np.minimum(v, np.sqrt(2 * acceleration * (at + 0.2))), desired, at)
    path.release()
    course = TripCourse(actor_path, desired)
    return EgoTrip(course, driver, vehicle.length + _ROOM[0], vehicle.width + _ROOM[1], xy, heading)
