"""Traffic: who is on the road around the ego vehicle, where it goes, and its track in time."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.roads import RoadGraph
from lidar.actors.lanes import (
    STEP,
    Lanes,
    Way,
    Zones,
    road_rank,
    wander,
    way_along,
    zone_at,
    zones_of,
)  # fmt: skip
from lidar.actors.shapes import PAINTS, Shape, catalogue
from lidar.actors.simulate import Ego, Movers, Signals, run
from lidar.actors.sweep import SQUARE, body_poses, squares_under, sweep
from lidar.physics.random import generator
from lidar.poses import Trajectory

Float = NDArray[np.float64]
Ints = NDArray[np.int64]

DT = 0.1
"""Seconds of a step of the simulation."""
_HORIZON = 60  # steps that the ego's way is known ahead: 6 s
_KEEP = (0.8, 0.3)  # metres that others keep from the ego's box before and beside it
_LATERAL = 2.0  # m/s^2 across the way that drivers put up with in bends


@dataclass(frozen=True, slots=True)
class Driver:
    """How a kind of vehicle is driven.

    share   : of the traffic
    radius  : least radius of its way in metres
    top     : m/s
    headway, pull, brake, gap : time gap in s, largest acceleration and comfortable braking in m/s^2, standing
              gap in metres of the Intelligent Driver Model
    """

    share: float
    radius: float
    top: float
    headway: float
    pull: float
    brake: float
    gap: float


DRIVERS: dict[str, Driver] = {
    "sedan": Driver(0.30, 5.5, 60.0, 1.2, 1.5, 2.0, 2.0),
    "hatchback": Driver(0.30, 5.2, 60.0, 1.2, 1.5, 2.0, 2.0),
    "suv": Driver(0.20, 5.5, 60.0, 1.2, 1.5, 2.0, 2.0),
    "van": Driver(0.10, 6.2, 40.0, 1.3, 1.2, 2.0, 2.0),
    "truck": Driver(0.04, 8.0, 25.0, 1.6, 0.8, 1.8, 2.5),
    "bus": Driver(0.02, 9.5, 22.0, 1.6, 0.9, 1.6, 2.5),
    "motorcycle": Driver(0.04, 4.0, 60.0, 1.1, 2.0, 2.5, 2.0),
}
"""Shares: assumed. Headway, acceleration and braking: the ranges that Treiber and Kesting, "Traffic Flow
Dynamics" (2013), give for city traffic (1 s, 1 m/s^2, 1.5 m/s^2, 2 m), livelier in acceleration as cars are
at lights; lorries and buses slower. Radii: kerb-to-kerb turning circles of such vehicles, nominal."""


@dataclass(frozen=True, slots=True)
class Trip:
    """A mover before it moves: its body, its way and where on it it appears when."""

    shape: Shape
    stretch: tuple[float, float, float]
    way: Way
    driver: Driver
    pace: float
    begin: int
    appear_s: float


@dataclass(frozen=True, slots=True)
class Flow:
    """What became of trips: the knots of those that came to be, by trip and in time.

    trip, step : (k,) int64
    gone, speed : (k,) metres along the way of the body's middle, m/s
    """

    trip: Ints
    step: Ints
    gone: Float
    speed: Float


def vehicle_trips(
    graph: RoadGraph,
    lanes: Lanes,
    ego: Trajectory,
    *,
    seed: int,
    density: float,
    reach: float,
    ground: shapely.Geometry | None = None,
    scale: float = 1.0,
) -> list[Trip]:
    """Vehicles around the ego's way, at random places on the lanes.

    density : vehicles per kilometre of lane
    reach   : metres from the ego within which there is traffic
    ground  : the carriageways; ways that leave them are not driven
    """
    rng = generator(seed, "traffic", "vehicles")
    track = ego.position[:: max(len(ego.position) // 2000, 1), :2]
    route = shapely.linestrings(track) if np.ptp(track, axis=0).max() > 0.5 else shapely.points(track[0])
    lines = np.array([shapely.linestrings(line[:, :2]) for line in graph.geometry], object)
    inside = shapely.dwithin(lines, route, reach)
    metres = graph.length * lanes.count * inside * (lanes.liking > 0) * np.maximum(lanes.liking, 0.05)
    count = round(density * float(metres.sum()) / 1000)
    if not count:
        return []
    kinds = list(DRIVERS)
    shares = np.array([d.share for d in DRIVERS.values()])
    seconds = ego.time_ns * 1e-9
    sizes = catalogue()
    paints = np.array([share for _, share in PAINTS.values()])
    trips = []
    for number in range(count):
        rng = generator(seed, "traffic", "vehicle", number)
        edge = int(rng.choice(len(metres), p=metres / metres.sum()))
        lane = int(rng.integers(lanes.count[edge]))
        kind = kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))]
        shape = pick(sizes, kind, rng, paints)
        at = rng.random()
        grow = tuple((1 + rng.uniform(-0.03, 0.03, 3)).tolist())
        pace = float(np.clip(rng.normal(1.0, 0.06), 0.85, 1.1))
        width = shape.width * grow[1]
        if width > lanes.wide[edge]:
            continue
        where = shapely.get_coordinates(shapely.line_interpolate_point(lines[edge], at, normalized=True))[0]
        near = np.flatnonzero(np.hypot(*(ego.position[:, :2] - where).T) <= reach)
        if not len(near):
            continue
        appear = float(seconds[near[0]])
        driver = DRIVERS[kind]
        want = 15.0 * (float(seconds[-1]) - appear) + 60.0
        edges, picked = wander(lanes, rng, edge, lane, metres=min(want, 1500.0), inside=inside, width=width)
        way = way_along(lanes, edges, picked, width=width, radius=driver.radius, scale=scale)
        if len(way) < 40:
            continue
        if ground is not None:
            way = _kept_on(way, shape, grow, ground)
            if len(way) < 40:
                continue
        begin = min(int(at * float(graph.length[edge]) / STEP), len(way) - 30)
        trips.append(Trip(shape, (grow[0], grow[1], grow[2]), way, driver, pace, max(begin, 0), appear))
    return trips


def pick(sizes: dict[str, Shape], kind: str, rng: np.random.Generator, paints: Float) -> Shape:
    """A body of a kind in a random colour."""
    names = [name for name, shape in sizes.items() if shape.kind == kind]
    weight = paints if len(names) == len(paints) else np.ones(len(names))
    return sizes[names[int(rng.choice(len(names), p=weight / weight.sum()))]]


def _kept_on(way: Way, shape: Shape, grow: Sequence[float], ground: shapely.Geometry) -> Way:
    """The way until the body would leave the carriageway."""
    xy, heading = body_poses(way, shape.base * grow[0])
    boxes = rectangles(xy, heading, shape.length * grow[0] * way.scale, shape.width * grow[1] * way.scale)
    bad = ~shapely.covers(ground, boxes)
    # where it starts it may stand at the map's edge
    if not bad.any():
        return way
    cut = int(np.argmax(bad)) - 1
    return Way(
        way.xyz[:cut],
        way.heading[:cut],
        way.curvature[:cut],
        way.edge[:cut],
        way.lane[:cut],
        way.limit[:cut],
        way.scale,
    )


def rectangles(xy: Float, heading: Float, length: float, width: float) -> NDArray[np.object_]:
    """Outlines (n,) of boxes in plan."""
    c, s = np.cos(heading), np.sin(heading)
    corners = [(1, 1), (-1, 1), (-1, -1), (1, -1)]
    ring = np.stack(
        [
            np.stack(
                [
                    xy[:, 0] + a * length / 2 * c - b * width / 2 * s,
                    xy[:, 1] + a * length / 2 * s + b * width / 2 * c,
                ],
                axis=1,
            )
            for a, b in corners
        ],
        axis=1,
    )
    boxes: NDArray[np.object_] = shapely.polygons(ring)
    return boxes


def desired_speed(way: Way, driver: Driver, pace: float) -> Float:
    """Speed (n,) that a driver wants at each station, m/s: limit, bend, and braking for what is ahead."""
    bend = np.maximum(np.abs(way.curvature), 1e-6)
    v = np.minimum(np.minimum(way.limit * pace, driver.top), np.sqrt(_LATERAL / bend))
    v = np.maximum(v, 1.0)
    ramp = 2 * driver.brake * 0.8 * STEP * np.arange(len(v))
    back = np.minimum.accumulate((v**2 + ramp)[::-1])[::-1] - ramp
    speed: Float = np.sqrt(np.maximum(back, 1.0))
    return speed


@dataclass(frozen=True, slots=True)
class Plan:
    """Junctions and their signals.

    zones  : the junctions
    axis   : (z,) heading in radians along which the first of a junction's two groups of streets runs
    lit    : (z,) bool, has signals
    """

    zones: Zones
    axis: Float
    lit: NDArray[np.bool_]
    signals: Signals


def junction_plan(graph: RoadGraph, lanes: Lanes, *, seed: int, cycle: float = 60.0) -> Plan:
    """Junctions with fixed-time signals of two groups where the map has signals."""
    zones = zones_of(graph)
    n = len(zones.polygon)
    axis, lit = np.zeros(n), np.zeros(n, bool)
    for z, nodes in enumerate(zones.nodes):
        into = np.isin(graph.head, nodes) & ~np.isin(graph.tail, nodes)
        into = into if into.any() else np.isin(graph.head, nodes)
        axis[z] = np.angle(np.exp(4j * lanes.leave[into]).sum()) / 4
        lit[z] = bool(graph.signals[nodes].any())
    shift = generator(seed, "traffic", "signals").uniform(0, cycle, n)
    return Plan(zones, axis, lit, Signals(np.full(n, cycle), shift, np.empty((0, 4))))


def signal_group(plan: Plan, zone: int, heading: float) -> int:
    """Group of a junction's signals that speaks to traffic of a heading, -1 without signals."""
    if not plan.lit[zone]:
        return -1
    return 0 if abs(np.cos(heading - plan.axis[zone])) >= abs(np.sin(heading - plan.axis[zone])) else 1


def simulate_trips(
    trips: Sequence[Trip],
    graph: RoadGraph,
    plan: Plan,
    ego: Trajectory,
    ego_box: tuple[float, float, float],
    *,
    reach: float,
    blocked: NDArray[np.object_] | None = None,
) -> Flow:
    """Trips in time, from the drive's start to its end.

    ego_box : length, width and metres from the rear axle to the middle of the ego's box
    blocked : polygons that nobody may enter

    Those whom the ego, whose motion is given, would run into do not take place.
    """
    if not trips:
        none = np.empty(0, np.int64)
        return Flow(none, none, np.empty(0), np.empty(0))
    wrap = 1 << int(np.ceil(np.log2(2 * (reach + 150.0) / SQUARE)))
    covered = graph.bridge | graph.tunnel
    movers = _movers(trips, covered, graph, plan, wrap)
    steps = int(ego.duration_ns * 1e-9 / DT) + 2
    known = _ego(ego, ego_box, steps, wrap)
    signals = plan.signals._replace(window=_windows(plan, known))
    still = _blocked_squares(blocked, wrap)
    out = np.zeros(len(trips), bool)
    for _ in range(30):
        log, met, _ = run(
            movers, known, signals, out, still, 2 * wrap * wrap, DT, steps, _HORIZON, reach + 100.0
        )
        if not met.any():
            break
        out |= met
    order = np.lexsort((log[:, 1], log[:, 0]))
    log = log[order]
    return Flow(log[:, 0].astype(np.int64), log[:, 1].astype(np.int64), log[:, 2], log[:, 3])


def _blocked_squares(polygons: NDArray[np.object_] | None, wrap: int) -> NDArray[np.int32]:
    del polygons, wrap
    return np.empty(0, np.int32)


def _ego(ego: Trajectory, box: tuple[float, float, float], steps: int, wrap: int) -> Ego:
    length, width, ahead = box
    time = np.round(np.arange(steps) * DT * 1e9).astype(np.int64)
    poses = ego.at(time)
    forward = poses.rotation[:, :, 0]
    middle = poses.position + poses.scale * forward * ahead
    heading = np.arctan2(forward[:, 1], forward[:, 0])
    speed = np.interp(time, ego.time_ns, np.hypot(*ego.velocity[:, :2].T))
    half = np.array([length / 2 + _KEEP[0], width / 2 + _KEEP[1]])
    under = np.empty(8192, np.int32)
    events, start = [], [0]
    for k in range(steps):
        grown = half[0] + speed[k] * DT / 2
        n = squares_under(
            middle[k, 0], middle[k, 1], np.cos(heading[k]), np.sin(heading[k]), grown, half[1], wrap, 0, under
        )
        events.append(under[:n].copy())
        start.append(start[-1] + n)
    tight = np.array([length / 2 + 0.2, width / 2 + 0.1])
    return Ego(middle[:, 0], middle[:, 1], heading, speed, tight, np.array(start), np.concatenate(events))


def _windows(plan: Plan, ego: Ego) -> Float:
    """Windows (w, 4) in which signals are green for the ego: from 8 s before it reaches a junction."""
    zone = zone_at(plan.zones, np.column_stack([ego.x, ego.y]))
    rows = []
    cuts = np.flatnonzero(np.diff(np.concatenate([[-2], zone, [-2]])))
    for a, b in itertools.pairwise(cuts.tolist()):
        z = int(zone[a])
        if z >= 0 and plan.lit[z]:
            rows.append((z, signal_group(plan, z, float(ego.heading[a])), a * DT - 8.0, b * DT))
    return np.array(rows, float).reshape(-1, 4)


def _movers(
    trips: Sequence[Trip], covered: NDArray[np.bool_], graph: RoadGraph, plan: Plan, wrap: int
) -> Movers:
    """The tables of the simulation."""
    station, square, blocks = [0], [0], [0]
    columns: dict[str, list[NDArray[Any]]] = {
        name: [] for name in ("speed", "x", "y", "heading", "square", "first", "last", "leave", "block")
    }
    ways: dict[tuple[int, ...], int] = {}
    for trip in trips:
        way, shape = trip.way, trip.shape
        length, width = shape.length * trip.stretch[0], shape.width * trip.stretch[1]
        axle = shape.base * trip.stretch[0]
        xy, heading = body_poses(way, axle)
        level = np.where(way.edge >= 0, covered[way.edge], False).astype(np.int64)
        swept = sweep(way, length, width, axle, level, wrap)
        found = _blocks(trip, graph, plan, ways, length)
        columns["speed"].append(desired_speed(way, trip.driver, trip.pace))
        columns["x"].append(xy[:, 0])
        columns["y"].append(xy[:, 1])
        columns["heading"].append(heading)
        for name in ("square", "first", "last", "leave"):
            columns[name].append(getattr(swept, name))
        columns["block"].append(found)
        station.append(station[-1] + len(way))
        square.append(square[-1] + len(swept.square))
        blocks.append(blocks[-1] + len(found))
    whole = {name: np.concatenate(parts) for name, parts in columns.items()}
    b = whole["block"]

    def of(name: str) -> Float:
        return np.array([getattr(t.driver, name) for t in trips])

    names = ("block_from", "block_to", "block_stop", "block_zone", "block_group", "block_way")
    return Movers(
        station_start=np.array(station),
        speed_limit=whole["speed"],
        x=whole["x"],
        y=whole["y"],
        heading=whole["heading"],
        square_start=np.array(square),
        square=whole["square"],
        first=whole["first"],
        last=whole["last"],
        leave=whole["leave"],
        block_start=np.array(blocks),
        **{name: b[:, c].astype(np.int64) for c, name in enumerate(names)},
        block_rank=b[:, 6].copy(),
        headway=of("headway"),
        pull=of("pull"),
        brake=of("brake"),
        gap=of("gap"),
        length=np.array([t.shape.length * t.stretch[0] for t in trips]),
        width=np.array([t.shape.width * t.stretch[1] for t in trips]),
        appear=np.array([int(t.appear_s / DT) for t in trips]),
        begin=np.array([t.begin for t in trips]),
    )


def _blocks(
    trip: Trip, graph: RoadGraph, plan: Plan, ways: dict[tuple[int, ...], int], length: float
) -> Float:
    """Stretches through junctions (b, 7): from, to, stop, zone, group, way, rank; see `Movers`."""
    way = trip.way
    zone = zone_at(plan.zones, way.xyz[:, :2])
    half = int(np.ceil((length / 2 + 0.5) / STEP))
    cuts = np.flatnonzero(np.diff(np.concatenate([[-2], zone, [-2]])))
    rows: list[list[float]] = []
    for a, b in itertools.pairwise(cuts.tolist()):
        z = int(zone[a])
        if z < 0 or b - 1 + half < trip.begin:
            continue
        before, behind = max(a - 1, 0), min(b, len(way) - 1)
        key = (z, *(int(v) for v in (way.edge[before], way.lane[before], way.edge[behind], way.lane[behind])))
        heading = float(way.heading[before])
        entry = int(way.edge[before])
        bend = (float(way.heading[behind]) - heading + np.pi) % (2 * np.pi) - np.pi
        rank = 2.0 * road_rank(str(graph.highway[entry])) + (0.5 if abs(bend) > 0.5 else 0.0)
        signs = graph.control_kind[graph.control_edge == entry]
        rank += 3.0 if np.isin(signs, ("stop", "give_way")).any() else 0.0
        start, end = a - half, b - 1 + half
        stop = start - 2
        if rows and stop - rows[-1][1] < 2:  # no room to stand between two junctions
            rows[-1][1] = end
            rows[-1][5] = ways.setdefault((int(rows[-1][5]), -1, *key), len(ways))
            continue
        group = signal_group(plan, z, heading)
        rows.append([start, end, stop, z, group, ways.setdefault(key, len(ways)), rank])
    return np.array(rows, float).reshape(-1, 7)
