"""Routes through waypoints snapped to streets, and map matching of recorded tracks."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph, find_components
from geoscene.roadgraph.routing import (
    SWAPPED,
    edge_lines,
    looks_swapped,
    nearest_edge,
    permitted_turns,
    turns_back,
)
from geoscene.sources.tracks import read_track as read_points
from geoscene.typing import Float
from lidar.errors import OffStreetError, RouteError

Place = tuple[int, float]
"""An edge and the true metres from its tail."""

_ABOVE = 5.0
"""Scene metres by which a street above a tunnel may be farther from a waypoint than the tunnel."""
_NAMED = 3
"""Maximum number of waypoints that an error names."""

TOLERANCE = 50.0
"""Metres from a drivable street to a waypoint or a point of a track, at most."""

DENSE_M = 60.0
"""Median metres between a file's points up to which they are a track; farther apart, they are waypoints."""
SIGMA_M = 6.0
"""Standard deviation of a track's points across a street (Newson and Krumm 2009 found 4 m for open sky)."""
BETA_M = 15.0
"""Metres by which driven and straight distance between two points of a track typically differ."""
_CANDIDATES = 6
_U_TURN_S = 30.0
"""Cost in seconds of a U-turn at a dead end in the search for the fastest route."""


@dataclass(frozen=True, slots=True)
class RecordedTrack:
    """Points read from a file.

    lat_lon : (latitude, longitude) in degrees, in order
    xyz     : (n, 3) scene metres; z is the file's height, 0 where it has none
    dense   : whether they lie close enough to be a track rather than waypoints
    """

    lat_lon: list[tuple[float, float]]
    xyz: Float
    dense: bool


def read_track(path: Path, frame: Frame) -> RecordedTrack:
    """The points of a GPX or GeoJSON file; see `geoscene.sources.tracks.read_track`, whose errors it raises.

    Raises RouteError for a missing file and for one with fewer than two points.
    """
    if not path.exists():
        raise RouteError(
            f"{path}: does not exist; give random, a GPX or GeoJSON file, or LAT,LON LAT,LON ..."
        )
    points = read_points(path)
    if len(points) < 2:
        raise RouteError(f"{path} holds {len(points)} points; a route needs two or more")
    lon, lat, h = points.T
    x, y = frame.from_geographic(lon, lat)
    xyz = np.column_stack([x, y, h])
    gaps = np.hypot(*np.diff(xyz[:, :2], axis=0).T)
    dense = len(points) > 2 and float(np.median(gaps)) <= DENSE_M
    return RecordedTrack(list(zip(lat.tolist(), lon.tolist(), strict=True)), xyz, dense)


# ------------------------------------------------------------------------------------------- waypoints


def route_through(
    graph: RoadGraph,
    frame: Frame,
    *,
    points: Sequence[tuple[float, float]],
    avoid: Collection[tuple[int, int]] = (),
) -> tuple[NDArray[np.int32], tuple[float, float]]:
    """Edges of the fastest route through waypoints (latitude, longitude), and metres of its start and end.

    One-way streets and turn restrictions hold; the vehicle passes waypoints without turning round.

    A waypoint is on the nearest street; of a tunnel and a street above it, on the street.

    Raises OffStreetError naming waypoints that are farther than `TOLERANCE` metres from a street, and
    RouteError naming the first that cannot be reached.
    """
    if len(points) < 2:
        raise RouteError("a route needs two waypoints or more, each as LAT,LON")
    lat, lon = np.array(points, float).T
    swapped = f"; {SWAPPED}" if looks_swapped(graph, frame, lat=lat, lon=lon) else ""
    if not ((np.abs(lat) <= 90).all() and (np.abs(lon) <= 180).all()):
        raise RouteError(
            f"waypoints are LAT,LON in degrees: latitudes within 90, longitudes within 180{swapped}"
        )
    x, y = frame.from_geographic(lon, lat)
    xy = np.column_stack([x, y])
    edge, offset, distance = _nearest_in_the_open(graph, xy)
    scale = frame.scale(lon, lat)
    far = np.flatnonzero(~(distance <= TOLERANCE * scale))
    if len(far):
        named = [
            f"waypoint {k + 1} ({lat[k]:.6f}, {lon[k]:.6f}) is {distance[k]:,.0f} m from the nearest"
            f" drivable street, more than {TOLERANCE:.0f} m"
            for k in far[:_NAMED]
        ]
        rest = [f"and so are {len(far) - _NAMED} more"] if len(far) > _NAMED else []
        raise OffStreetError("; ".join(named + rest) + swapped, [] if swapped else xy[far[:_NAMED]].tolist())
    candidates = [_both_sides(graph, int(e), offset=float(o)) for e, o in zip(edge, offset, strict=True)]
    chain = _Search(graph, graph.travel_time, avoid=avoid, u_turn=_U_TURN_S)

    def score(_: int, cost: Float) -> Float:
        return cost

    best = chain.best(candidates, [np.zeros(len(c)) for c in candidates], score=score)
    if isinstance(best, int):
        part = find_components(graph).weak[graph.tail[edge]]
        why = "along one-way streets and permitted turns"
        if part[best] != part[best - 1]:
            why = "because the streets at the two are not connected within the scene"
        raise RouteError(
            f"waypoint {best + 1} ({lat[best]:.6f}, {lon[best]:.6f}) cannot be reached from waypoint {best}"
            f" {why}"
        )
    return best


def _nearest_in_the_open(graph: RoadGraph, xy: Float) -> tuple[NDArray[np.int32], Float, Float]:
    """As `nearest_edge`; of a tunnel and a street above it, the street."""
    edge, offset, distance = nearest_edge(graph, xy)
    under = graph.tunnel[edge]
    if under.any() and not graph.tunnel.all():
        number = np.flatnonzero(~graph.tunnel).astype(np.int32)
        other, along, away = nearest_edge(graph.take(number), xy)
        above = under & (away < distance + _ABOVE)
        edge, offset = np.where(above, number[other], edge), np.where(above, along, offset)
        distance = np.where(above, away, distance)
    return edge, offset, distance


def _both_sides(graph: RoadGraph, edge: int, *, offset: float) -> list[Place]:
    twin = int(graph.twin[edge])
    return [(edge, offset)] + ([(twin, float(graph.length[edge]) - offset)] if twin >= 0 else [])


def match_track(
    graph: RoadGraph,
    track: RecordedTrack,
    *,
    frame: Frame,
    avoid: Collection[tuple[int, int]] = (),
) -> tuple[NDArray[np.int32], tuple[float, float]]:
    """Edges that a recorded track most likely followed, and metres of its start and end.

    The hidden Markov model of Newson and Krumm (2009): a point lies about `SIGMA_M` off its street, and the
    way driven between two points is about as long as the straight line. Raises RouteError naming the points
    that have no street within `TOLERANCE`, or where the streets do not connect.
    """
    xy = _thin(track.xyz[:, :2], 2.5 * SIGMA_M)
    tree = shapely.STRtree(edge_lines(graph))
    candidates: list[list[Place]] = []
    costs: list[Float] = []
    lost: list[int] = []
    points = shapely.points(xy)
    which, near = tree.query(points, predicate="dwithin", distance=TOLERANCE)
    distance = shapely.distance(points[which], tree.geometries[near])
    share = shapely.line_locate_point(tree.geometries[near], points[which], normalized=True)
    for k in range(len(xy)):
        rows = np.flatnonzero(which == k)
        rows = rows[np.argsort(distance[rows], kind="stable")][: 2 * _CANDIDATES]
        if not len(rows):
            lost.append(k)
            continue
        candidates.append([(int(near[r]), float(share[r] * graph.length[near[r]])) for r in rows])
        costs.append(0.5 * (distance[rows] / SIGMA_M) ** 2)
    if lost:
        lon, lat = frame.to_geographic(*xy[lost[0]])
        raise RouteError(
            f"{len(lost)} of {len(xy)} points of the track have no drivable street within {TOLERANCE:.0f} m,"
            f" the first at {float(lat):.6f}, {float(lon):.6f}; cut the track to the scene's streets, or"
            " build a scene that holds it"
        )
    straight = np.hypot(*np.diff(xy, axis=0).T)

    def score(k: int, cost: Float) -> Float:
        excess: Float = np.abs(cost - straight[k]) / BETA_M
        return excess

    search = _Search(graph, graph.length, avoid=avoid, u_turn=100.0, slack=2 * SIGMA_M)
    best = search.best(candidates, costs, score=score, reach=4 * straight + 300.0)
    if isinstance(best, int):
        lon, lat = frame.to_geographic(*xy[best])
        raise RouteError(
            f"the track cannot be driven along the streets near {float(lat):.6f}, {float(lon):.6f} (against a"
            " one-way street, or over a gap); mend the track there, or drive it in two parts"
        )
    return best


def _thin(xy: Float, gap: float) -> Float:
    """Points of a track at least ``gap`` apart, with the first and the last."""
    keep, last = [0], xy[0]
    for k in range(1, len(xy)):
        if np.hypot(*(xy[k] - last)) >= gap:
            keep.append(k)
            last = xy[k]
    if keep[-1] != len(xy) - 1:
        keep.append(len(xy) - 1)
    return xy[keep]


class _Search:
    """Cheapest sequences of places on a graph: dynamic programming over candidates, Dijkstra in between.

    A place is on a state of `routing.turn_states`, so that restrictions via ways hold across places.
    """

    def __init__(
        self,
        graph: RoadGraph,
        cost: Float,
        *,
        avoid: Collection[tuple[int, int]],
        u_turn: float,
        slack: float = 0.0,
    ) -> None:
        from scipy.sparse import csr_array  # noqa: PLC0415

        states = permitted_turns(graph, avoid)
        self.edge, self.length, self.slack = states.edge, graph.length[states.edge], slack
        self.cost = np.maximum(cost, 1e-9)[states.edge]
        self.watched = set(states.edge[len(graph) :].tolist())
        round_ = turns_back(graph, states.edge[states.before], after=states.edge[states.after])
        # a step costs the edge it leaves behind, so that a target's own edge is not counted
        weight = self.cost[states.before] + np.where(round_, u_turn, 0.0)
        self.links = csr_array((weight, (states.before, states.after)), shape=(len(states), len(states)))

    def _states(
        self, candidates: list[list[Place]], own: list[Float]
    ) -> tuple[list[list[Place]], list[Float]]:
        """Places on states instead of edges, those after the first on every state of their edge."""
        if not self.watched:
            return candidates, own
        places, costs = candidates[:1], own[:1]
        for there, cost in zip(candidates[1:], own[1:], strict=True):
            on = [np.flatnonzero(self.edge == e) if e in self.watched else [e] for e, _ in there]
            places.append([(int(s), o) for states, (_, o) in zip(on, there, strict=True) for s in states])
            costs.append(np.repeat(cost, [len(states) for states in on]))
        return places, costs

    def _dijkstra(self, source: int, reach: float) -> tuple[Float, NDArray[np.int32]]:
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

        far, previous = dijkstra(self.links, indices=source, return_predecessors=True, limit=reach)
        return far, previous

    def _share(self, place: Place) -> float:
        edge, offset = place
        return float(self.cost[edge] * min(max(offset / max(self.length[edge], 1e-9), 0.0), 1.0))

    def _costs(self, source: Place, targets: list[Place], *, reach: float) -> Float:
        """Cost from one place to each of others; infinite beyond reach."""
        edge, offset = source
        far, _ = self._dijkstra(edge, reach)
        far = far.copy()
        far[edge] = self._round_trip(edge, far)
        begun = self._share(source)
        out = np.array([far[e] - begun + self._share((e, o)) for e, o in targets])
        for k, (e, o) in enumerate(targets):
            if e == edge and o >= offset - self.slack:
                out[k] = max(self._share((e, o)) - begun, 0.0)
        return out

    def _round_trip(self, edge: int, far: Float) -> float:
        """Cost from an edge's tail round to its tail again."""
        column = self._incoming(edge)
        return float((far[column[0]] + column[1]).min()) if len(column[0]) else np.inf

    def _incoming(self, edge: int) -> tuple[NDArray[Any], Float]:
        coo = self.links.tocoo()
        rows = coo.col == edge
        return coo.row[rows], coo.data[rows]

    def best(
        self,
        candidates: list[list[Place]],
        own: list[Float],
        *,
        score: Callable[[int, Float], Float],
        reach: Float | None = None,
    ) -> tuple[NDArray[np.int32], tuple[float, float]] | int:
        """Edges and end offsets of the cheapest sequence, or the number of the first unreachable place."""
        total, choice = own[0], []
        candidates, own = self._states(candidates, own)
        for k in range(1, len(candidates)):
            limit = np.inf if reach is None else float(reach[k - 1])
            step = np.array([self._costs(c, candidates[k], reach=limit) for c in candidates[k - 1]])
            sums = total[:, None] + np.where(np.isfinite(step), score(k - 1, step), np.inf)
            choice.append(np.argmin(sums, axis=0))
            total = sums.min(axis=0) + own[k]
            if not np.isfinite(total).any():
                return k
        last = int(np.argmin(total))
        picks = [last]
        for back in reversed(choice):
            picks.append(int(back[picks[-1]]))
        places = [candidates[k][c] for k, c in enumerate(reversed(picks))]
        edges = [places[0][0]]
        for a, b in itertools.pairwise(places):
            edges += self._between(a, b)[1:]
        return self.edge[edges], (places[0][1], places[-1][1])

    def _between(self, a: Place, b: Place) -> list[int]:
        """Edges of the cheapest way from one place to another, both included."""
        if a[0] == b[0] and b[1] >= a[1] - self.slack:
            return [a[0]]
        far, previous = self._dijkstra(a[0], np.inf)
        walk = [b[0]]
        if a[0] == b[0]:
            before, cost = self._incoming(b[0])
            walk.append(int(before[np.argmin(far[before] + cost)]))
        while walk[-1] != a[0]:
            walk.append(int(previous[walk[-1]]))
        return walk[::-1]
