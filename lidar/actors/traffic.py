"""Traffic: who is on the road around the ego vehicle, and where each of them goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.routing import edge_lines
from lidar.actors.lanes import STEP, Lanes, Way, wander, way_along
from lidar.actors.shapes import PAINTS, Shape, catalogue
from lidar.actors.sweep import body_poses, rectangles
from lidar.physics.random import generator
from lidar.poses import Trajectory

Float = NDArray[np.float64]
Ints = NDArray[np.int64]

_LATERAL = 2.0  # m/s^2 across the way that drivers put up with in bends
_TRIES = 5  # ways that are tried for a vehicle until one keeps to the carriageway
_SHORT = 40  # stations that a way has at least


@dataclass(frozen=True, slots=True)
class Driver:
    """How a kind of road user goes.

    radius  : least radius of its way in metres
    top     : m/s
    headway, pull, brake, gap : time gap in s, largest acceleration and comfortable braking in m/s^2, standing
              gap in metres of the Intelligent Driver Model
    kerb    : whether it keeps to the kerb within its lane
    """

    radius: float
    top: float
    headway: float
    pull: float
    brake: float
    gap: float
    kerb: bool = False


DRIVERS: dict[str, Driver] = {
    "sedan": Driver(5.5, 60.0, 1.2, 1.5, 2.0, 2.0),
    "hatchback": Driver(5.2, 60.0, 1.2, 1.5, 2.0, 2.0),
    "suv": Driver(5.5, 60.0, 1.2, 1.5, 2.0, 2.0),
    "van": Driver(6.2, 40.0, 1.3, 1.2, 2.0, 2.0),
    "truck": Driver(8.0, 25.0, 1.6, 0.8, 1.8, 2.5),
    "bus": Driver(9.5, 22.0, 1.6, 0.9, 1.6, 2.5),
    "motorcycle": Driver(4.0, 60.0, 1.1, 2.0, 2.5, 2.0),
    "cyclist": Driver(2.5, 6.0, 1.0, 0.8, 1.5, 1.0, kerb=True),
}
"""Headway, acceleration and braking: about the values that Treiber and Kesting, "Traffic Flow Dynamics"
(2013), give for city traffic (1 s, 1 m/s^2, 1.5 m/s^2, 2 m), livelier in acceleration as cars are at lights;
lorries and buses slower. Radii: of the middle, from kerb-to-kerb turning circles of such vehicles, nominal.
Cyclists: assumed."""

MOTOR_SHARES = {
    "sedan": 0.30,
    "hatchback": 0.30,
    "suv": 0.20,
    "van": 0.10,
    "truck": 0.04,
    "bus": 0.02,
    "motorcycle": 0.04,
}
"""Shares of the traffic: assumed."""


@dataclass(frozen=True, slots=True)
class Trip:
    """A mover before it moves.

    shape    : its body, ``stretch`` the factors along x, y and z
    way      : where it goes
    driver   : how
    wish     : (n,) m/s, the speed that it wants at each station
    begin    : station at which it appears
    appear_s : when, in seconds
    leaves   : whether the way's end is out of sight; otherwise it stops there
    walks    : whether it goes on foot, off the carriageway
    crossing : stretches of a walk across carriageways: first and last station, and the crossing's number
    """

    shape: Shape
    stretch: tuple[float, float, float]
    way: Way
    driver: Driver
    wish: Float
    begin: int
    appear_s: float
    leaves: bool
    walks: bool = False
    crossing: tuple[tuple[int, int, int], ...] = ()

    @property
    def length(self) -> float:
        """Metres."""
        return self.shape.length * self.stretch[0]

    @property
    def width(self) -> float:
        """Metres."""
        return self.shape.width * self.stretch[1]

    @property
    def axle(self) -> float:
        """Metres between the points of the body that stay on the way."""
        return self.shape.base * self.stretch[0]


@dataclass(frozen=True, slots=True)
class Area:
    """Where there are road users.

    lines : (m,) the graph's edges in plan
    near  : (m,) bool, edges within ``reach`` of the ego's way
    ego   : its trajectory
    reach : metres from the ego
    scale : scene metres per true metre
    """

    lines: NDArray[np.object_]
    near: NDArray[np.bool_]
    ego: Trajectory
    reach: float
    scale: float

    def appears(self, xy: Float) -> float | None:
        """Seconds at which a place (2,) first comes within reach of the ego; None if it never does."""
        close = np.flatnonzero(np.hypot(*(self.ego.position[:, :2] - xy).T) <= self.reach * self.scale)
        return float(self.ego.time_ns[close[0]]) * 1e-9 if len(close) else None


def area_of(lanes: Lanes, ego: Trajectory, reach: float, scale: float) -> Area:
    """The surroundings of the ego's way."""
    lines = edge_lines(lanes.graph)
    return Area(lines, shapely.dwithin(lines, ego_line(ego), reach * scale), ego, reach, scale)


def ego_line(ego: Trajectory) -> shapely.Geometry:
    """The ego's way in plan."""
    xy = ego.position[:: max(len(ego.position) // 5000, 1), :2]
    return shapely.linestrings(xy).simplify(0.2) if np.ptp(xy, axis=0).max() > 0.5 else shapely.points(xy[0])


def vehicle_trips(
    lanes: Lanes,
    area: Area,
    *,
    seed: int,
    density: float,
    shares: dict[str, float] | None = None,
    ground: shapely.Geometry | None = None,
) -> list[Trip]:
    """Vehicles at random places on the lanes around the ego's way.

    density : vehicles per kilometre of lane
    shares  : of kinds of `DRIVERS`; `MOTOR_SHARES` by default
    ground  : the carriageways; ways that leave them are not driven
    """
    shares = shares or MOTOR_SHARES
    graph, liking = lanes.graph, lanes.liking
    metres = graph.length * lanes.count * area.near * (liking > 0) * np.maximum(liking, 0.05) * lanes.open
    count = round(density * float(metres.sum()) / 1000)
    kinds, chance = list(shares), np.array(list(shares.values()))
    trips = []
    for number in range(count):
        rng = generator(seed, "traffic", kinds[-1], number)
        edge = int(rng.choice(len(metres), p=metres / metres.sum()))
        at, lane = rng.random(), int(rng.integers(lanes.count[edge]))
        kind = kinds[int(rng.choice(len(kinds), p=chance / chance.sum()))]
        where = shapely.line_interpolate_point(area.lines[edge], at, normalized=True)
        appear = area.appears(shapely.get_coordinates(where)[0])
        if appear is None:
            continue
        start = (edge, 0 if DRIVERS[kind].kerb else lane, at)
        trip = _trip(lanes, area, rng, kind, start, appear, ground)
        if trip is not None:
            trips.append(trip)
    return trips


def _trip(
    lanes: Lanes,
    area: Area,
    rng: np.random.Generator,
    kind: str,
    start: tuple[int, int, float],
    appear: float,
    ground: shapely.Geometry | None,
) -> Trip | None:
    """A vehicle's trip from an edge, a lane and a share of the edge's length; None if it finds no way."""
    edge, lane, at = start
    shape, grow = pick(kind, rng), varied(rng)
    driver = DRIVERS[kind]
    pace = float(np.clip(rng.normal(1.0, 0.06), 0.85, 1.1))
    width = shape.width * grow[1]
    if width > lanes.wide[edge]:
        return None
    top = min(float(lanes.graph.speed.max()) * 1.1, driver.top)
    metres = top * (area.ego.duration_ns * 1e-9 - appear) + 60.0
    for _ in range(_TRIES):
        edges, picked = wander(lanes, rng, edge, lane, metres=metres, inside=area.near, width=width)
        whole = way_along(
            lanes, edges, picked, width=width, radius=driver.radius, scale=area.scale, kerb=driver.kerb
        )
        begin = int(at * float(lanes.graph.length[edge]) / STEP)
        first, last = _on(whole, shape, grow, ground, begin)
        complete = len(whole) - last <= shape.length / STEP + 4
        if not complete or last - begin < _SHORT:
            continue
        way = whole.part(first, last)
        end = edges[-1]
        leaves = bool(lanes.exit[end] or not area.near[end])
        wish = desired_speed(way, driver, pace)
        return Trip(shape, grow, way, driver, wish, begin - first, appear, leaves)
    return None


def pick(kind: str, rng: np.random.Generator) -> Shape:
    """A body of a kind in a random colour; people and riders in the first of their poses."""
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


def varied(rng: np.random.Generator) -> tuple[float, float, float]:
    """Factors from a body's size to an individual's."""
    x, y, z = (1 + rng.uniform(-0.03, 0.03, 3)).tolist()
    return x, y, z


def _on(
    way: Way, shape: Shape, grow: Sequence[float], ground: shapely.Geometry | None, begin: int
) -> tuple[int, int]:
    """First and last station (exclusive) about ``begin`` between which the body keeps to the carriageway."""
    if ground is None:
        return 0, len(way)
    xy, heading = body_poses(way, shape.base * grow[0])
    boxes = rectangles(xy, heading, shape.length * grow[0] * way.scale, shape.width * grow[1] * way.scale)
    off = np.flatnonzero(~shapely.covers(ground, boxes))
    before, behind = off[off <= begin], off[off > begin]
    return int(before[-1]) + 1 if len(before) else 0, int(behind[0]) if len(behind) else len(way)


def desired_speed(way: Way, driver: Driver, pace: float) -> Float:
    """Speed (n,) that a driver wants at each station, m/s: limit, bend, and braking for what is ahead."""
    bend = np.maximum(np.abs(way.curvature), 1e-6)
    v = np.minimum(np.minimum(way.limit * pace, driver.top), np.sqrt(_LATERAL / bend))
    v = np.maximum(v, 1.0)
    ramp = 2 * driver.brake * 0.8 * STEP * np.arange(len(v))
    back = np.minimum.accumulate((v**2 + ramp)[::-1])[::-1] - ramp
    speed: Float = np.sqrt(np.maximum(back, 1.0))
    return speed
