"""Trips of pedestrians along sidewalks and over crossings."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.typing import Float
from lidar.geometry.random_streams import generator
from lidar.traffic.lanes import STEP, ActorPath, Lanes, round_corners
from lidar.traffic.surroundings import TrafficArea
from lidar.traffic.trips import Driver, Trip, TripCourse, random_shape, random_stretch

_KINDS = {"adult": 0.5, "small_adult": 0.38, "child": 0.12}
_FREE = {"adult": 1.36, "small_adult": 1.30, "child": 1.15}
"""m/s, free walking: adults after Weidmann, "Transporttechnik der Fussgänger" (1993), 1.34 on average."""
_WALK = Driver(min_radius=0.4, max_speed=2.5, headway=0.5, acceleration=0.8, deceleration=1.2, gap=0.3)
_LANE = 0.6  # metres from a sidewalk's centre line to the path, on the driving side
_EDGE = 0.15  # metres, minimum distance of a path from the edge of the sidewalk
_OUT = (2.4, 2.1, 1.8, 1.5, 1.3, 1.1, 0.95, 0.8)
"""Metres beyond the carriageway's edge where the line may run, best first."""
_ROOM = 1.0  # metres, minimum distance of a sidewalk's line from obstacles
_TURN = 4  # stations before and after the end of a sidewalk within which nobody waits for others who turn
_PIECE = 12.0  # metres, minimum length of a stretch of sidewalk


@dataclass(frozen=True, slots=True)
class Sidewalks:
    """Stretches of sidewalk along streets.

    line  : (w,) object, each (k, 3) float64 scene metres, in the direction of its edge
    edge  : (w,) int64
    side  : (w,) 1 to the left of the edge, -1 to its right
    """

    line: list[Float]
    edge: list[int]
    side: list[int]


def sidewalks_around(
    lanes: Lanes, area: TrafficArea, *, pavement: shapely.Geometry | None, obstacles: NDArray[np.object_]
) -> Sidewalks:
    """Stretches of sidewalk around the ego, clear of obstacles.

    pavement : the sidewalks, None for none
    obstacles : polygons of buildings, poles and trunks
    """
    out = Sidewalks([], [], [])
    if pavement is None:
        return out
    g = lanes.graph
    tree = shapely.STRtree(obstacles)
    # pedestrians walk beside the line and must stay on the sidewalk
    pavement = shapely.buffer(pavement, -(_LANE + _EDGE) * area.scale)
    shapely.prepare(pavement)
    for e in np.flatnonzero(area.near).tolist():
        if 0 <= g.twin[e] < e or g.bridge[e] or g.tunnel[e] or g.length[e] < _PIECE:
            continue
        for side in (1, -1):
            best: list[Float] = []
            for wide in _OUT:
                aside = (float(g.width[e]) / 2 + wide) * area.scale
                line = polylines.parallel(g.geometry[e], side * aside)
                pieces = _clear(line, pavement, tree=tree)
                if sum(map(polylines.length, pieces)) > 1.3 * sum(map(polylines.length, best)):
                    best = pieces
            out.line.extend(best)
            out.edge.extend([e] * len(best))
            out.side.extend([side] * len(best))
    return out


def _clear(line: Float, pavement: shapely.Geometry, *, tree: shapely.STRtree) -> list[Float]:
    """Pieces of a line on the sidewalk and away from obstacles."""
    whole = shapely.linestrings(line)
    if len(tree):
        near = tree.geometries[tree.query(whole, predicate="dwithin", distance=_ROOM)]
        if len(near):
            whole = shapely.difference(whole, shapely.union_all(shapely.buffer(near, _ROOM)))
    parts = shapely.get_parts(shapely.intersection(whole, pavement))
    pieces = [shapely.get_coordinates(p, include_z=True) for p in parts if p.geom_type == "LineString"]
    return [p for p in pieces if polylines.length(p) >= _PIECE]


def pedestrian_trips(
    lanes: Lanes, area: TrafficArea, *, walks: Sidewalks, seed: int, density: float
) -> list[Trip]:
    """Trips of pedestrians that start at random places; each takes a crossing with probability one half.

    density : pedestrians per kilometre of sidewalk
    """
    if not walks.line:
        return []
    metres = np.array([polylines.length(line) for line in walks.line])
    crossings = _crossings(lanes, walks)
    names, chance = list(_KINDS), np.array(list(_KINDS.values()))
    trips = []
    for number in range(round(density * float(metres.sum()) / 1000)):
        rng = generator(seed, "traffic", "walker", number)
        walk = int(rng.choice(len(metres), p=metres / metres.sum()))
        begin = rng.uniform(1.0, metres[walk] - 1.0)
        kind = names[int(rng.choice(len(names), p=chance / chance.sum()))]
        shape, grow = random_shape(kind, rng), random_stretch(rng)
        pace = _FREE[kind] * float(np.clip(rng.normal(1.0, 0.12), 0.7, 1.4))
        place = shapely.line_interpolate_point(shapely.linestrings(walks.line[walk][:, :2]), begin)
        for start, end in area.visits(shapely.get_coordinates(place)[0]):
            line, over = _stroll(
                walks,
                crossings,
                walk=walk,
                begin=begin,
                metres=pace * (end - start) + 20.0,
                side=lanes.side,
                rng=rng,
            )
            course = _course(line, over, pace=pace, scale=area.scale)
            trips.append(Trip(shape, grow, course, _WALK, 0, start, leaves=False, on_foot=True))
    return trips


def _stroll(
    walks: Sidewalks,
    crossings: Mapping[int, list[tuple[int, float, float, int]]],
    *,
    walk: int,
    begin: float,
    metres: float,
    side: int,
    rng: np.random.Generator,
) -> tuple[list[Float], list[tuple[int, int]]]:
    """Consecutive lines that a pedestrian walks, and pairs of a line and the passage after it.

    A passage is the number of a crossing, or a negative number of an end of a sidewalk where the pedestrian
    turns. It walks to the end of a sidewalk and back, or over a crossing on the way, until it has walked
    ``metres``.
    """
    parts: list[Float] = []
    over: list[tuple[int, int]] = []
    forwards, far = bool(rng.random() < 0.5), 0.0
    while far < metres or (over and over[-1][0] == len(parts) - 1):
        own = walks.line[walk]
        end = polylines.length(own) - 0.7 if forwards else 0.7
        ahead = [c for c in crossings.get(walk, []) if min(begin, end) + 3.0 < c[1] < max(begin, end) - 1.0]
        taken = ahead[int(rng.integers(len(ahead)))] if ahead and rng.random() < 0.5 else None
        stop = end if taken is None else taken[1]
        if abs(stop - begin) > 0.5:
            if len(parts) > (over[-1][0] + 1 if over else 0):
                over.append((len(parts) - 1, -1 - 2 * walk - forwards))
            parts.append(_lane(own, begin, end=stop, side=side))
            far += abs(stop - begin)
        if taken is None:
            begin, forwards = stop, not forwards
        else:
            if parts:
                over.append((len(parts) - 1, taken[3]))
            walk, begin = taken[0], taken[2]
            forwards = bool(rng.random() < 0.5)
            far += 5.0
    return parts, over


def _crossings(lanes: Lanes, walks: Sidewalks) -> dict[int, list[tuple[int, float, float, int]]]:
    """Crossings by the stretch of sidewalk from which they start.

    Each is the stretch opposite, metres along the one and the other, and the crossing's number.
    """
    g = lanes.graph
    rows = g.control_kind == "crossing"
    edge, offset = g.control_edge[rows], g.control_offset[rows]
    other = (g.twin[edge] >= 0) & (g.twin[edge] < edge)
    offset = np.where(other, g.length[edge] - offset, offset)
    edge = np.where(other, g.twin[edge], edge)
    by_edge: dict[int, list[int]] = {}
    for k, e in enumerate(walks.edge):
        by_edge.setdefault(e, []).append(k)
    found: dict[int, list[tuple[int, float, float, int]]] = {}
    for number, (e, at) in enumerate(
        sorted(set(zip(edge.tolist(), np.round(offset, 1).tolist(), strict=True)))
    ):
        share = at / max(float(g.length[e]), 1e-9)
        middle = shapely.line_interpolate_point(
            shapely.linestrings(g.geometry[e][:, :2]), share, normalized=True
        )
        reach = float(g.width[e]) / 2 + _OUT[0] + 0.5
        ends = []
        for k in by_edge.get(e, []):
            line = shapely.linestrings(walks.line[k][:, :2])
            if shapely.distance(line, middle) < reach:
                ends.append((k, float(shapely.line_locate_point(line, middle))))
        for (a, at_a), (b, at_b) in itertools.permutations(ends, 2):
            if walks.side[a] != walks.side[b]:
                found.setdefault(a, []).append((b, at_a, at_b, number))
    return found


def _course(parts: list[Float], over: list[tuple[int, int]], *, pace: float, scale: float) -> TripCourse:
    """Course along lines with their crossings, at constant speed."""
    line = np.concatenate(parts)
    ends = np.cumsum([len(p) for p in parts])
    along = polylines.stations(line)
    gap = STEP * scale
    even = np.arange(0.0, along[-1], gap)
    keep = np.concatenate([[True], np.diff(along) > 1e-6])
    points = polylines.points_at(line[keep], even, along=along[keep])
    edge, lane = np.full(len(even), -1, np.int32), np.full(len(even), -1, np.int8)
    path = round_corners(points, edge, lane=lane, radius=_WALK.min_radius, scale=scale)
    crossed = []
    for part, number in over:
        # rounded corners shorten the path a little: the crossing is found by its ends
        first, last = (
            _nearest(path, line[k, :2], about=along[k] / gap) for k in (ends[part] - 1, ends[part])
        )
        if number < 0:
            first, last = max(first - _TURN, 0), min(last + _TURN, len(path) - 1)
        crossed.append((first + 1, max(last - 1, first + 2), number))
    return TripCourse(path, np.full(len(path), pace), tuple(crossed))


def _nearest(path: ActorPath, point: Float, *, about: float) -> int:
    """The station of a path nearest to a point, close to station ``about``."""
    low = int(np.clip(about - 16, 0, len(path) - 1))
    part = path.xyz[low : int(about) + 17, :2]
    return low + int(np.argmin(np.hypot(*(part - point).T)))


def _lane(line: Float, begin: float, *, end: float, side: int) -> Float:
    """A part of a sidewalk's line in walking direction, shifted to the driving side."""
    part = polylines.cut(line, min(begin, end), end=max(begin, end), least=0.1)
    return polylines.parallel(part if end >= begin else part[::-1], -side * _LANE)
