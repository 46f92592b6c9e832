"""Roads in weather: speeds and accelerations that grip and visibility permit."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lidar.motion.vehicle import Vehicle

GRAVITY = 9.81
"""m/s^2."""
DRY_GRIP, WET_GRIP, SNOW_GRIP, ICE_GRIP = 0.85, 0.60, 0.20, 0.10
"""Peak coefficients of friction of tyres: middle of 0.8 to 0.9 on dry and of 0.5 to 0.7 on wet asphalt, and
those of hard-packed snow and ice (Taborek 1957; table in Wong, "Theory of Ground Vehicles"; unconfirmed)."""
_REACTION_S, _BRAKING = 2.5, 3.4
"""Reaction time in seconds and deceleration in m/s^2 of the stopping sight distance (AASHTO, "A Policy on
Geometric Design of Highways and Streets")."""


@dataclass(frozen=True, slots=True)
class RoadConditions:
    """State of the roads and of the air above them.

    grip       : peak coefficient of friction between tyres and road
    visibility : metres
    """

    grip: float = DRY_GRIP
    visibility: float = math.inf

    @property
    def share(self) -> float:
        """Grip over that of a dry road: drivers use the same share of the available grip."""
        return self.grip / DRY_GRIP

    @property
    def pace(self) -> float:
        """Desired speed over that on a dry road: SUMO's friction device, over its value on a dry road."""
        return _friction_factor(self.share) / _friction_factor(1.0)

    @property
    def sight_speed(self) -> float:
        """Greatest speed in m/s from which a driver stops within the visibility."""
        if math.isinf(self.visibility):
            return math.inf
        deceleration = min(_BRAKING, self.grip * GRAVITY)
        braking_s = math.sqrt(_REACTION_S**2 + 2 * self.visibility / deceleration) - _REACTION_S
        return deceleration * braking_s

    def braking_distance(self, speed: float) -> float:
        """Metres within which a vehicle stops that uses all of the grip, without the reaction time."""
        return speed**2 / (2 * self.grip * GRAVITY)


DRY = RoadConditions()
ROADS = {
    "dry": DRY,
    "wet": RoadConditions(WET_GRIP),
    "snow": RoadConditions(SNOW_GRIP),
    "ice": RoadConditions(ICE_GRIP),
}
"""Conditions by name."""


def _friction_factor(share: float) -> float:
    """Factor on the desired speed (Weber et al.; SUMO, "Friction"), for a friction of 1 on dry roads."""
    return -0.3491 * share**2 + 0.8922 * share + 0.4493


def vehicle_on(vehicle: Vehicle, road: RoadConditions) -> Vehicle:
    """A vehicle as it is driven under conditions; others than road vehicles stay as they are."""
    if road == DRY or vehicle.kind != "road":
        return vehicle
    return replace(
        vehicle,
        max_speed=min(vehicle.max_speed, road.sight_speed),
        pace=vehicle.pace * road.pace,
        acceleration=vehicle.acceleration * road.share,
        deceleration=vehicle.deceleration * road.share,
        lateral_acceleration=vehicle.lateral_acceleration * road.share,
    )
