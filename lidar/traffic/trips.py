"""Trips of vehicles and cyclists around the ego vehicle: body, driver model, path and speed profile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import shapely

from geoscene.geometry import polylines
from geoscene.typing import Float
from lidar.geometry.random_streams import generator
from lidar.motion.vehicle import DRY, GRAVITY, RoadConditions
from lidar.traffic.lanes import (
    STEP,
    ActorPath,
    Lanes,
    edge_name,
    open_lanes,
    path_along_lanes,
    random_lanes,
)
from lidar.traffic.surroundings import TrafficArea, entrances
from lidar.traffic.sweep import body_poses, rectangles
from lidar.world.actor_shapes import PAINTS, ActorShape, catalogue

_TRIES = 5  # paths tried for a vehicle until one stays on the carriageway
_MIN_STATIONS = 40  # of a path
_MAX_LENGTH = 3000.0  # metres of a path
_WAVE_S = 5.0  # seconds between spawns at the entrances of the surroundings
_MEAN_SPEED = 0.45  # mean speed of simulated traffic, with its stops, over the speed limit


@dataclass(frozen=True, slots=True)
class Driver:
    """Parameters of the Intelligent Driver Model and of the paths of one kind of road user.

    min_radius   : metres, smallest turning radius
    max_speed    : m/s
    headway      : seconds, desired time gap
    acceleration : m/s^2, maximum
    deceleration : m/s^2, comfortable
    gap          : metres to the road user ahead at standstill
    keeps_kerb   : whether it rides at the kerb within its lane
    hard         : m/s^2, deceleration in an emergency; decides how far ahead it reserves the ground
    lateral      : m/s^2, comfortable in bends
    """

    min_radius: float
    max_speed: float
    headway: float
    acceleration: float
    deceleration: float
    gap: float
    keeps_kerb: bool = False
    hard: float = 8.0
    lateral: float = 2.0


def driver_on(driver: Driver, road: RoadConditions) -> Driver:
    """A driver as it drives under road conditions."""
    if road == DRY:
        return driver
    return replace(
        driver,
        max_speed=min(driver.max_speed, road.sight_speed),
        acceleration=driver.acceleration * road.share,
        deceleration=driver.deceleration * road.share,
        lateral=driver.lateral * road.share,
        hard=min(driver.hard, road.grip * GRAVITY),
    )


DRIVERS: dict[str, Driver] = {
    "sedan": Driver(5.5, 60.0, 1.2, 1.5, 2.0, 2.0),
    "hatchback": Driver(5.2, 60.0, 1.2, 1.5, 2.0, 2.0),
    "suv": Driver(5.5, 60.0, 1.2, 1.5, 2.0, 2.0),
    "van": Driver(6.2, 40.0, 1.3, 1.2, 2.0, 2.0),
    "truck": Driver(8.0, 25.0, 1.6, 0.8, 1.8, 2.5),
    "bus": Driver(9.5, 22.0, 1.6, 0.9, 1.6, 2.5),
    "motorcycle": Driver(4.0, 60.0, 1.1, 2.0, 2.5, 2.0),
    "cyclist": Driver(2.5, 6.0, 1.0, 0.8, 1.5, 1.0, keeps_kerb=True),
}
"""Headway, acceleration, deceleration and gap: close to the values of Treiber and Kesting, "Traffic Flow
Dynamics" (2013), for city traffic (1 s, 1 m/s^2, 1.5 m/s^2, 2 m), with higher acceleration as observed at
traffic lights; lorries and buses accelerate less. Radii: of the body's centre, from nominal kerb-to-kerb
turning circles. Cyclists: assumed."""

VEHICLE_SHARES = {
    "sedan": 0.30,
    "hatchback": 0.30,
    "suv": 0.20,
    "van": 0.10,
    "truck": 0.04,
    "bus": 0.02,
    "motorcycle": 0.04,
}
"""Shares of the vehicle kinds in traffic: assumed."""


@dataclass(frozen=True, slots=True)
class TripCourse:
    """The path of a trip, and how fast it is followed.

    path          : n stations
    desired_speed : (n,) m/s at each station
    crossing      : of pedestrians: first and last station and number of each crossing or turn on the path
    """

    path: ActorPath
    desired_speed: Float
    crossing: Sequence[tuple[int, int, int]] = ()


@dataclass(frozen=True, slots=True)
class Trip:
    """One simulated road user.

    shape    : body
    stretch  : scale factors of the body along x, y and z
    course   : its path and desired speed
    driver   : driver model
    begin    : station of the start
    appear_s : seconds after the drive's start at which it appears
    leaves   : whether it drives on at the end of its path; otherwise it stops there before it disappears
    on_foot  : whether it is a pedestrian
    """

    shape: ActorShape
    stretch: tuple[float, float, float]
    course: TripCourse
    driver: Driver
    begin: int
    appear_s: float
    leaves: bool
    on_foot: bool = False

    @property
    def length(self) -> float:
        """Metres, of the body."""
        return self.shape.length * self.stretch[0]

    @property
    def width(self) -> float:
        """Metres, of the body."""
        return self.shape.width * self.stretch[1]

    @property
    def axle(self) -> float:
        """Wheelbase in metres: both axles stay on the path."""
        return self.shape.base * self.stretch[0]

    def body(self) -> tuple[Float, Float]:
        """Centre (n, 2) in scene metres and heading (n,) in radians of the body at each station."""
        return body_poses(self.course.path, self.axle)


def vehicle_trips(
    lanes: Lanes,
    area: TrafficArea,
    *,
    seed: int,
    density: float,
    shares: dict[str, float] | None = None,
    ground: shapely.Geometry | None = None,
    road: RoadConditions = DRY,
) -> list[Trip]:
    """Trips that start at random places on the lanes around the ego, and later ones that enter at the rim.

    density : vehicles per kilometre of lane
    shares  : shares of the kinds of `DRIVERS`; `VEHICLE_SHARES` by default
    ground  : the carriageways; a path ends where the body would leave them
    road    : conditions that lower speeds and accelerations
    """
    shares = shares or VEHICLE_SHARES
    graph, weight = lanes.graph, lanes.traffic_weight
    metres = graph.length * lanes.count * area.near * (weight > 0) * np.maximum(weight, 0.05) * lanes.open
    used = np.flatnonzero(metres)
    metres, name = metres[used], "+".join(shares)
    trips: list[Trip | None] = []
    make = partial(_trip, lanes, area, shares=shares, ground=ground, road=road)
    for number in range(round(density * float(metres.sum()) / 1000)):
        rng = generator(seed, "traffic", name, number)
        edge, at = int(rng.choice(used, p=metres / metres.sum())), rng.random()
        where = shapely.line_interpolate_point(area.lines[edge], at, normalized=True)
        spans = area.visits(shapely.get_coordinates(where)[0])
        trips += [make(rng=rng, place=(edge, at), span=span) for span in spans]
    for wave in range(int(area.time[-1] / _WAVE_S)):
        begin = wave * _WAVE_S
        for edge, at in entrances(lanes, area, t=begin):
            rng = generator(seed, "traffic", name, "wave", wave, edge_name(graph, edge))
            rate = (
                density / 1000 * lanes.count[edge] * max(weight[edge], 0.05) * _MEAN_SPEED * graph.speed[edge]
            )
            for _ in range(rng.poisson(rate * _WAVE_S)):
                t = begin + rng.random() * _WAVE_S
                where = shapely.line_interpolate_point(area.lines[edge], at, normalized=True)
                span = (t, area.until(shapely.get_coordinates(where)[0], t))
                trips.append(make(rng=rng, place=(edge, at), span=span))
    return [trip for trip in trips if trip is not None]


def _trip(
    lanes: Lanes,
    area: TrafficArea,
    *,
    rng: np.random.Generator,
    shares: dict[str, float],
    place: tuple[int, float],
    span: tuple[float, float],
    ground: shapely.Geometry | None,
    road: RoadConditions,
) -> Trip | None:
    """A trip of a random vehicle; None if no path is long enough.

    place : edge and share of its length at which the trip starts
    span  : seconds from and until which that place is in the surroundings of the ego
    """
    edge, at = place
    kind = list(shares)[
        int(rng.choice(len(shares), p=np.array(list(shares.values())) / sum(shares.values())))
    ]
    driver = driver_on(DRIVERS[kind], road)
    usable = open_lanes(lanes, edge, any_kind=driver.keeps_kerb)
    lane = 0 if driver.keeps_kerb else int(usable[rng.integers(len(usable))])
    shape, grow = random_shape(kind, rng), random_stretch(rng)
    pace = float(np.clip(rng.normal(1.0, 0.06), 0.85, 1.1)) * road.pace
    width = shape.width * grow[1]
    if width > lanes.max_width[edge]:
        return None
    top = min(float(lanes.graph.speed[area.near].max()) * 1.1, driver.max_speed)
    metres = min(top * (span[1] - span[0]), _MAX_LENGTH) + 60.0
    for _ in range(_TRIES):
        edges, picked = random_lanes(
            lanes,
            rng,
            edge=edge,
            lane=lane,
            metres=metres,
            inside=area.near,
            width=width,
            any_kind=driver.keeps_kerb,
        )
        whole = path_along_lanes(
            lanes,
            np.array(edges, np.int32),
            picked=np.array(picked, np.int8),
            width=width,
            radius=driver.min_radius,
            scale=area.scale,
            keeps_kerb=driver.keeps_kerb,
        )
        begin = int(at * float(lanes.graph.length[edge]) / STEP)
        first, last = _stations_on_carriageway(whole, shape, grow=grow, ground=ground, begin=begin)
        complete = len(whole) - last <= shape.length / STEP + 4
        if not complete or last - begin < _MIN_STATIONS:
            continue
        end = edges[-1]
        leaves = bool(lanes.exit[end] or not area.near[end])
        speed = _desired_speed(
            polylines.curvatures(whole.xyz)[first:last] * area.scale,
            pace * lanes.graph.speed[whole.edge[first:last]],
            driver=driver,
        )
        course = TripCourse(whole.take(np.arange(first, last)), speed)
        return Trip(shape, grow, course, driver, begin - first, span[0], leaves)
    return None


def random_shape(kind: str, rng: np.random.Generator) -> ActorShape:
    """A body of a kind in a random colour; pedestrians and riders in the first of their poses."""
    bodies = [
        s
        for s in catalogue().values()
        if s.kind == kind and (s.name.count("/") == 1 or s.name.endswith("/0"))
    ]
    weight = (
        np.array([PAINTS[s.name.split("/")[1]][1] for s in bodies]) if len(bodies) == len(PAINTS) else None
    )
    if weight is None:
        return bodies[int(rng.integers(len(bodies)))]
    return bodies[int(rng.choice(len(bodies), p=weight / weight.sum()))]


def random_stretch(rng: np.random.Generator) -> tuple[float, float, float]:
    """Random scale factors of a body along x, y and z."""
    x, y, z = (1 + rng.uniform(-0.03, 0.03, 3)).tolist()
    return x, y, z


def _stations_on_carriageway(
    path: ActorPath, shape: ActorShape, *, grow: Sequence[float], ground: shapely.Geometry | None, begin: int
) -> tuple[int, int]:
    """First and last station (exclusive) around ``begin`` between which the body stays on the carriageway."""
    if ground is None:
        return 0, len(path)
    xy, heading = body_poses(path, shape.base * grow[0])
    boxes = rectangles(
        xy, heading, length=shape.length * grow[0] * path.scale, width=shape.width * grow[1] * path.scale
    )
    off = np.flatnonzero(~shapely.covers(ground, boxes))
    before, behind = off[off <= begin], off[off > begin]
    return int(before[-1]) + 1 if len(before) else 0, int(behind[0]) if len(behind) else len(path)


def _desired_speed(curvature: Float, limit: Float, *, driver: Driver) -> Float:
    """Desired speed (n,) in m/s below limits (n,): slower in bends and in time before them.

    curvature : (n,) 1/m
    """
    bend = np.maximum(np.abs(curvature), 1e-6)
    v = np.minimum(np.minimum(limit, driver.max_speed), np.sqrt(driver.lateral / bend))
    v = np.maximum(v, 1.0)
    ramp = 2 * driver.deceleration * 0.8 * STEP * np.arange(len(v))
    back = np.minimum.accumulate((v**2 + ramp)[::-1])[::-1] - ramp
    speed: Float = np.sqrt(np.maximum(back, 1.0))
    return speed
