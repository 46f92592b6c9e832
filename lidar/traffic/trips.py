"""Traffic: who is on the road around the ego vehicle, and where each of them goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.typing import Float
from lidar.random_streams import generator
from lidar.traffic.lanes import STEP, ActorPath, Lanes, path_along_lanes, random_lanes
from lidar.traffic.surroundings import Surroundings, entrances
from lidar.traffic.sweep import body_poses, rectangles
from lidar.world.actor_shapes import PAINTS, Shape, catalogue

_LATERAL = 2.0  # m/s^2 across the way that drivers put up with in bends
_TRIES = 5  # ways that are tried for a vehicle until one keeps to the carriageway
_SHORT = 40  # stations that a way has at least
_FAR = 3000.0  # metres that a way has at most
_WAVE_S = 5.0  # seconds between looks at where traffic comes in
_MEAN = 0.45  # mean speed of traffic against the limit, with its stops: what it comes to in the simulation


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

VEHICLE_SHARES = {
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
    way: ActorPath
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

    def body(self) -> tuple[Float, Float]:
        """Middle (n, 2) and heading (n,) of the body at each station."""
        return body_poses(self.way, self.axle)


def vehicle_trips(
    lanes: Lanes,
    area: Surroundings,
    *,
    seed: int,
    density: float,
    shares: dict[str, float] | None = None,
    ground: shapely.Geometry | None = None,
) -> list[Trip]:
    """Vehicles at random places on the lanes around the ego, and others that come in from the rim in time.

    density : vehicles per kilometre of lane
    shares  : of kinds of `DRIVERS`; `VEHICLE_SHARES` by default
    ground  : the carriageways; ways that leave them are not driven
    """
    shares = shares or VEHICLE_SHARES
    graph, liking = lanes.graph, lanes.liking
    metres = graph.length * lanes.count * area.near * (liking > 0) * np.maximum(liking, 0.05) * lanes.open
    name = "+".join(shares)
    trips: list[Trip | None] = []
    for number in range(round(density * float(metres.sum()) / 1000)):
        rng = generator(seed, "traffic", name, number)
        edge, at = int(rng.choice(len(metres), p=metres / metres.sum())), rng.random()
        where = shapely.line_interpolate_point(area.lines[edge], at, normalized=True)
        spans = area.visits(shapely.get_coordinates(where)[0])
        trips += [
            _trip(lanes, area, rng=rng, shares=shares, place=(edge, at), span=span, ground=ground)
            for span in spans
        ]
    for wave in range(int(area.time[-1] / _WAVE_S)):
        begin = wave * _WAVE_S
        for edge, at in entrances(lanes, area, t=begin):
            rng = generator(seed, "traffic", name, "wave", wave, edge)
            rate = density / 1000 * lanes.count[edge] * max(liking[edge], 0.05) * _MEAN * graph.speed[edge]
            for _ in range(rng.poisson(rate * _WAVE_S)):
                t = begin + rng.random() * _WAVE_S
                where = shapely.line_interpolate_point(area.lines[edge], at, normalized=True)
                span = (t, area.until(shapely.get_coordinates(where)[0], t))
                trips.append(
                    _trip(lanes, area, rng=rng, shares=shares, place=(edge, at), span=span, ground=ground)
                )
    return [trip for trip in trips if trip is not None]


def _trip(
    lanes: Lanes,
    area: Surroundings,
    *,
    rng: np.random.Generator,
    shares: dict[str, float],
    place: tuple[int, float],
    span: tuple[float, float],
    ground: shapely.Geometry | None,
) -> Trip | None:
    """A vehicle's trip from a share of an edge's length on; None if it finds no way.

    span : seconds in which the place is in the surroundings of the ego
    """
    edge, at = place
    kind = list(shares)[
        int(rng.choice(len(shares), p=np.array(list(shares.values())) / sum(shares.values())))
    ]
    driver = DRIVERS[kind]
    lane = 0 if driver.kerb else int(rng.integers(lanes.count[edge]))
    shape, grow = pick(kind, rng), varied(rng)
    pace = float(np.clip(rng.normal(1.0, 0.06), 0.85, 1.1))
    width = shape.width * grow[1]
    if width > lanes.wide[edge]:
        return None
    top = min(float(lanes.graph.speed.max()) * 1.1, driver.top)
    metres = min(top * (span[1] - span[0]), _FAR) + 60.0
    for _ in range(_TRIES):
        edges, picked = random_lanes(
            lanes, rng, edge=edge, lane=lane, metres=metres, inside=area.near, width=width
        )
        whole = path_along_lanes(
            lanes, edges, picked=picked, width=width, radius=driver.radius, scale=area.scale, kerb=driver.kerb
        )
        begin = int(at * float(lanes.graph.length[edge]) / STEP)
        first, last = _on(whole, shape, grow=grow, ground=ground, begin=begin)
        complete = len(whole) - last <= shape.length / STEP + 4
        if not complete or last - begin < _SHORT:
            continue
        way = whole.part(first, last)
        end = edges[-1]
        leaves = bool(lanes.exit[end] or not area.near[end])
        wish = desired_speed(way, driver, pace=pace)
        return Trip(shape, grow, way, driver, wish, begin - first, span[0], leaves)
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
    way: ActorPath, shape: Shape, *, grow: Sequence[float], ground: shapely.Geometry | None, begin: int
) -> tuple[int, int]:
    """First and last station (exclusive) about ``begin`` between which the body keeps to the carriageway."""
    if ground is None:
        return 0, len(way)
    xy, heading = body_poses(way, shape.base * grow[0])
    boxes = rectangles(
        xy, heading, length=shape.length * grow[0] * way.scale, width=shape.width * grow[1] * way.scale
    )
    off = np.flatnonzero(~shapely.covers(ground, boxes))
    before, behind = off[off <= begin], off[off > begin]
    return int(before[-1]) + 1 if len(before) else 0, int(behind[0]) if len(behind) else len(way)


def desired_speed(way: ActorPath, driver: Driver, *, pace: float) -> Float:
    """Speed (n,) that a driver wants at each station, m/s: limit, bend, and braking for what is ahead."""
    bend = np.maximum(np.abs(way.curvature), 1e-6)
    v = np.minimum(np.minimum(way.limit * pace, driver.top), np.sqrt(_LATERAL / bend))
    v = np.maximum(v, 1.0)
    ramp = 2 * driver.brake * 0.8 * STEP * np.arange(len(v))
    back = np.minimum.accumulate((v**2 + ramp)[::-1])[::-1] - ramp
    speed: Float = np.sqrt(np.maximum(back, 1.0))
    return speed
