"""The ego vehicle as a road user of the traffic simulation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float
from lidar.planning.path import Path
from lidar.planning.speed_profile import desired_speed
from lidar.rig.vehicle import Vehicle
from lidar.traffic.lanes import STEP, ActorPath
from lidar.traffic.trips import Course, Driver

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

    course: Course
    driver: Driver
    length: float
    width: float
    xy: Float
    heading: Float
    begin: int = 0
    appear_s: float = 0.0
    leaves: bool = False
    on_foot: bool = False

    def draw(self) -> Course:
        """Its course."""
        return self.course

    def body(self, path: ActorPath) -> tuple[Float, Float]:  # noqa: ARG002 - as of other trips
        """Centre and heading of the box at each station."""
        return self.xy, self.heading


def ego_trip(path: Path, vehicle: Vehicle, *, at_speed: bool = False) -> EgoTrip:
    """The ego's trip along its path, from rest or at speed; stations are `STEP` metres apart."""
    at = np.arange(0.0, path.length + _BEYOND, STEP)
    # `s` repeats where the vehicle turns round
    s = path.s + 1e-9 * np.arange(len(path))
    scale = float(path.scale.mean())
    heading = np.interp(at, s, path.heading)
    ahead = scale * (vehicle.length / 2 - vehicle.rear_overhang)
    axle = np.stack([np.interp(at, s, path.position[:, c]) for c in range(3)], axis=1)
    xy = axle[:, :2] + ahead * np.column_stack([np.cos(heading), np.sin(heading)])
    row = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(path) - 1)
    actor_path = ActorPath(
        np.column_stack([xy, axle[:, 2]]),
        heading,
        path.curvature[row],
        path.edge[row].astype(np.int64),
        np.zeros(len(at), np.int64),
        path.limit[row],
        scale,
    )
    deceleration, acceleration = _BRAKE * vehicle.deceleration, _PULL * vehicle.acceleration
    driver = Driver(vehicle.turning_radius, vehicle.max_speed, _HEADWAY_S, acceleration, deceleration, _GAP)
    desired = np.interp(at, s, desired_speed(path, vehicle))
    if not at_speed:
        desired = np.minimum(desired, np.sqrt(2 * acceleration * (at + 0.2)))
    course = Course(actor_path, desired)
    return EgoTrip(course, driver, vehicle.length + _ROOM[0], vehicle.width + _ROOM[1], xy, heading)
