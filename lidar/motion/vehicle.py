"""Vehicles: dimensions, limits of motion and body roll and pitch, read from TOML; and roads in weather.

Grip and visibility limit the speeds and accelerations of vehicles.
"""

from __future__ import annotations

import math
from dataclasses import MISSING, dataclass, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any, TypeGuard, cast

import numpy as np

from geoscene.support.registry import unknown_name
from lidar.errors import InputError
from lidar.toml_table import read_table

KINDS = ("road", "foot", "air")
"""Kinds of motion: on the carriageway, on foot, or through the air."""

_POSITIVE = (
    *("length", "width", "turning_radius", "steering", "max_speed", "pace"),
    *("acceleration", "deceleration", "jerk", "lateral_acceleration", "lateral_jerk"),
)

_LARGEST = 1e4
_SMALLEST_TURN = 0.1  # metres; paths are sampled at a part of the turning radius
_SIGNED = ("roll_gradient", "pitch_gradient")


@dataclass(frozen=True, slots=True)
class Vehicle:
    """A vehicle. Its frame has the origin at the rear axle's centre on the ground, x forward, y left, z up.

    kind            : road, foot or air
    length, width, height : metres, of the bounding box
    wheelbase, rear_overhang, track : metres; rear_overhang is from the rear axle to the rear end
    turning_radius  : minimum turning radius of the rear axle's centre, metres
    steering        : maximum change of curvature per metre of path, 1/m^2
    max_speed       : m/s
    acceleration, deceleration, jerk : maxima along the path, m/s^2, m/s^2, m/s^3
    lateral_acceleration, lateral_jerk : maxima across the path, m/s^2, m/s^3
    roll_gradient, pitch_gradient : roll and pitch of the body in radians per m/s^2 of lateral and
                      longitudinal acceleration; positive: out of bends and backwards (suspension), negative:
                      into bends and forwards (aircraft)
    pace            : share of the speed limits that it drives at
    cruise          : at cruising speed from the start of the drive to its end (aircraft)
    bob             : gait: lateral sway in metres, vertical rise per step in metres, steps per second at full
                      speed
    source          : reference for the figures
    """

    name: str
    kind: str
    length: float
    width: float
    height: float
    wheelbase: float
    rear_overhang: float
    track: float
    turning_radius: float
    steering: float
    max_speed: float
    acceleration: float
    deceleration: float
    jerk: float
    lateral_acceleration: float
    lateral_jerk: float
    roll_gradient: float
    pitch_gradient: float
    source: str
    pace: float = 1.0
    cruise: bool = False
    bob: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def front(self) -> float:
        """Metres from the rear axle to the front of the bounding box."""
        return self.length - self.rear_overhang

    @property
    def middle(self) -> float:
        """Metres from the rear axle ahead to the middle of the bounding box."""
        return self.length / 2 - self.rear_overhang


def vehicle_names() -> list[str]:
    """Names of the built-in vehicles."""
    folder = resources.files("lidar.motion").joinpath("vehicles")
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def load_vehicle(name: str | Path) -> Vehicle:
    """A built-in vehicle by name, or one from a TOML file with the keys of `Vehicle`.

    Raises InputError for an unknown name, and one for all unknown or missing keys and values out of range.
    """
    path = Path(name)
    if path.suffix == ".toml":
        if not path.exists():
            raise InputError(f"{path} does not exist; built-in vehicles are {', '.join(vehicle_names())}")
        file: Any = path
    elif str(name) in vehicle_names():
        file = resources.files("lidar.motion").joinpath("vehicles", f"{name}.toml")
    else:
        remedy = f"give a .toml file or one of {', '.join(vehicle_names())}"
        raise InputError(unknown_name("vehicle", str(name), known=vehicle_names(), remedy=remedy))
    return _check(read_table(file).data, str(name))


def _is_numbers(value: object, count: int) -> TypeGuard[list[float]]:
    """Whether a value is a list of ``count`` finite numbers of at least 0."""
    return (
        isinstance(value, list)
        and len(value) == count
        and all(type(v) in (int, float) and 0 <= v < np.inf for v in value)
    )


def _check(table: dict[str, object], name: str) -> Vehicle:
    """A vehicle from a table of keys; raises one InputError for all faults."""
    known = {f.name: f for f in fields(Vehicle)}
    faults = [
        f"unknown key {key}; known are {', '.join(known)}" for key in sorted(table.keys() - known.keys())
    ]
    missing = [key for key, f in known.items() if f.default is MISSING and key not in table]
    faults += [f"missing {', '.join(missing)}"] if missing else []
    values: dict[str, object] = {}
    for key in known.keys() & table.keys():
        value, kind = table[key], str(known[key].type)
        if kind == "float" and isinstance(value, (int, float)) and not isinstance(value, bool):
            values[key] = float(value)
            if not np.isfinite(float(value)) or (float(value) < 0 and key not in _SIGNED):
                faults.append(f"{key} = {value} must be a number of at least 0")
            elif abs(float(value)) > _LARGEST:
                faults.append(f"{key} = {value} exceeds {_LARGEST:g}")
        elif kind.startswith("tuple") and _is_numbers(value, 3):
            values[key] = tuple(value)
        elif (kind, type(value)) in (("str", str), ("bool", bool)):
            values[key] = value
        else:
            faults.append(f"{key} = {value!r} must be a {kind}")
    if values.get("kind", "road") not in KINDS:
        faults.append(f"kind = {values['kind']!r} must be one of {', '.join(KINDS)}")
    faults += [f"{key} must be above 0" for key in _POSITIVE if values.get(key) == 0.0]
    if 0.0 < cast("float", values.get("turning_radius", _SMALLEST_TURN)) < _SMALLEST_TURN:
        faults.append(f"turning_radius = {values['turning_radius']} is below {_SMALLEST_TURN:g} m")
    if faults:
        raise InputError(f"vehicle {name}: " + "; ".join(faults))
    return Vehicle(**values)  # type: ignore[arg-type]


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
