"""Nearest edges of points, permitted turns, shortest paths on the road graph, and the line of a route."""

from __future__ import annotations

import csv
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.errors import InputError, SourceNotFoundError, reading
from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.sources.tracks import read_track
from geoscene.support.columns import nth
from geoscene.typing import Bools, Float

HEADING_REACH = 5.0
"""Scene metres over which the heading of a street at a junction is taken."""
_NEAR_MAP = 10_000.0
"""Scene metres from the graph to places that are meant to lie in it."""
_SHOWN = 100
"""Most letters of a list of columns that a message shows."""
SWAPPED = "latitude and longitude look swapped: write LAT,LON"
"""What to do about places that `looks_swapped` finds."""
_U_TURN = np.radians(150.0)
"""Smallest change of direction at a node, in radians, that needs a U-turn."""


@dataclass(frozen=True, slots=True)
class RoadPath:
    """A path through the graph: consecutive edges in driving direction.

    edges  : (k,) int32; the head of one is the tail of the next
    start  : true metres in plan from the first edge's tail to where the path begins
    end    : true metres in plan from the last edge's tail to where the path ends
    length : true metres in plan
    time   : seconds at the speed limits
    """

    edges: NDArray[np.int32]
    start: float
    end: float
    length: float
    time: float


def edge_lines(graph: RoadGraph, *, heights: bool = False) -> NDArray[np.object_]:
    """The edges' centre lines as shapely LineStrings (m,), in plan or with heights."""
    if not len(graph):
        return np.empty(0, object)
    sizes = [len(line) for line in graph.geometry]
    lines: NDArray[np.object_] = shapely.linestrings(
        np.concatenate(list(graph.geometry))[:, : 2 + heights],
        indices=np.repeat(np.arange(len(sizes)), sizes),
    )
    return lines


def nearest_edge(
    graph: RoadGraph, xy: ArrayLike, *, tree: shapely.STRtree | None = None
) -> tuple[NDArray[np.int32], Float, Float]:
    """The nearest edge of each point: ``(edge (q,), offset (q,), distance (q,))``.

    The offset is in true metres in plan from the edge's tail; the distance in scene metres. Of the two edges
    of a two-way street the lower-numbered one is returned; `shortest_path` considers both.

    xy   : (q, 2) scene metres
    tree : `shapely.STRtree` of `edge_lines`, to avoid building it at every call

    Raises InputError where the graph has no edges.
    """
    if not len(graph):
        raise InputError("the road graph has no edges: the map holds no drivable roads here")
    points = shapely.points(np.asarray(xy, float).reshape(-1, 2))
    tree = shapely.STRtree(edge_lines(graph)) if tree is None else tree
    (query, found), _ = tree.query_nearest(points, all_matches=True, return_distance=True)
    first = np.full(len(points), len(graph), np.int64)
    np.minimum.at(first, query, found)
    lines = tree.geometries[first]
    plan = np.maximum(shapely.length(lines), 1e-9)  # nodes may share a place
    along = shapely.line_locate_point(lines, points) / plan
    return first.astype(np.int32), along * graph.length[first], shapely.distance(lines, points)


def looks_swapped(graph: RoadGraph, frame: Frame, *, lat: Float, lon: Float) -> bool:
    """Whether places (n,) in degrees lie near the graph if their latitudes and longitudes are exchanged.

    For messages about places that lie far from it as they are.
    """
    if (np.abs(lon) > 90).any() or (np.abs(lat) > 180).any() or not len(graph):
        return False
    with np.errstate(all="ignore"):
        xy = np.column_stack(frame.from_geographic(lat, lon))
    low, high = graph.node_xyz[:, :2].min(axis=0), graph.node_xyz[:, :2].max(axis=0)
    return bool(((xy > low - _NEAR_MAP) & (xy < high + _NEAR_MAP)).all())


def turn_table(graph: RoadGraph, *, u_turns: bool = False) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The permitted turns as pairs of edges ``(from (t,), to (t,))``.

    Restrictions are respected (``no_*`` forbids its turn, ``only_*`` every other turn from its edge at its
    node) as far as pairs of edges can express them; `turn_states` covers restrictions via ways. U-turns into
    the same street are permitted at dead ends only, unless ``u_turns``.
    """
    order = np.argsort(graph.tail, kind="stable").astype(np.int32)
    start = np.searchsorted(graph.tail[order], np.arange(len(graph.node_id) + 1))
    count = (start[1:] - start[:-1])[graph.head]
    before = np.repeat(np.arange(len(graph), dtype=np.int32), count)
    rank = nth(count)
    after = order[start[graph.head[before]] + rank]

    only = _is_mandatory(graph.turn_kind)
    chains = graph.chain_edges[_is_mandatory(graph.chain_kind)]
    first = np.array([chain[:2] for chain in chains], np.int32)
    mandatory = np.concatenate(
        [np.column_stack([graph.turn_from[only], graph.turn_to[only]]), first.reshape(-1, 2)]
    )
    forbidden = _among(graph, before, after=after, first=graph.turn_from[~only], second=graph.turn_to[~only])
    forbidden |= np.isin(before, mandatory[:, 0]) & ~_among(
        graph, before, after=after, first=mandatory[:, 0], second=mandatory[:, 1]
    )
    if not u_turns:
        round_ = graph.twin[before] == after
        ways_out = np.bincount(before[~round_], minlength=len(graph))
        forbidden |= round_ & (ways_out[before] > 0)
    return before[~forbidden], after[~forbidden]


def _is_mandatory(kind: NDArray[np.str_]) -> Bools:
    """Whether restrictions (r,) are ``only_*``."""
    return np.char.startswith(kind, "only_") if len(kind) else np.empty(0, np.bool_)


def _among(
    graph: RoadGraph,
    before: NDArray[np.int32],
    *,
    after: NDArray[np.int32],
    first: NDArray[np.int32],
    second: NDArray[np.int32],
) -> Bools:
    """Whether turns (t,) are among the pairs (first, second)."""
    key = before.astype(np.int64) * len(graph) + after
    return np.isin(key, first.astype(np.int64) * len(graph) + second)


@dataclass(frozen=True, slots=True)
class TurnStates:
    """Permitted turns between states: an edge with the part of a restriction via ways driven so far.

    edge          : (s,) int32, the edge of each state. The first states are the edges themselves, in their
                    order: a drive that begins there or has no pending restriction
    before, after : (t,) int32, states that may follow each other
    """

    edge: NDArray[np.int32]
    before: NDArray[np.int32]
    after: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of states."""
        return len(self.edge)


def turn_states(graph: RoadGraph, *, u_turns: bool = False) -> TurnStates:
    """The permitted turns, including those that depend on the streets driven before.

    A drive from state to state obeys every restriction. Those via ways apply to drives that followed the
    chain from its first edge: ``no_*`` forbids the last turn, ``only_*`` every turn off the chain. Without
    them the turns are those of `turn_table`. States beyond the edges are prefixes of chains; the state of a
    drive is the longest prefix that it ends with (Aho and Corasick 1975).
    """
    before, after = turn_table(graph, u_turns=u_turns)
    forbidden: set[tuple[int, ...]] = set()
    mandatory: dict[tuple[int, ...], set[int]] = {}
    prefixes: set[tuple[int, ...]] = set()
    for edges, only in zip(graph.chain_edges, _is_mandatory(graph.chain_kind).tolist(), strict=True):
        chain = tuple(edges.tolist())
        prefixes |= {chain[:k] for k in range(2, len(chain))}
        if only:
            for k in range(2, len(chain)):
                mandatory.setdefault(chain[:k], set()).add(chain[k])
        else:
            forbidden.add(chain)
    if not prefixes:
        return TurnStates(np.arange(len(graph), dtype=np.int32), before, after)

    ordered = sorted(prefixes)
    number = {prefix: len(graph) + k for k, prefix in enumerate(ordered)}
    first, second = np.array([p[:2] for p in ordered], np.int32).T
    watched = np.flatnonzero(_among(graph, before, after=after, first=first, second=second))
    following: dict[int, list[int]] = {}
    for row in np.flatnonzero(np.isin(before, [prefix[-1] for prefix in ordered])).tolist():
        following.setdefault(int(before[row]), []).append(int(after[row]))
    more: list[tuple[int, int]] = []
    for prefix in ordered:
        for edge in following.get(prefix[-1], []):
            driven = (*prefix, edge)
            if any(driven[k:] in forbidden for k in range(len(prefix) - 1)):
                continue
            if any(edge not in mandatory.get(prefix[k:], {edge}) for k in range(len(prefix) - 1)):
                continue
            ends = (driven[k:] for k in range(len(prefix)))
            more.append((number[prefix], next((number[end] for end in ends if end in number), edge)))
    after = after.copy()
    for row in watched.tolist():
        after[row] = number[int(before[row]), int(after[row])]
    added = np.array(more, np.int32).reshape(-1, 2)
    return TurnStates(
        np.array([*range(len(graph)), *(prefix[-1] for prefix in ordered)], np.int32),
        np.concatenate([before, added[:, 0]]),
        np.concatenate([after, added[:, 1]]),
    )


def turns_back(graph: RoadGraph, before: NDArray[Any], *, after: NDArray[Any]) -> NDArray[np.bool_]:
    """Whether (k,) the turn from one edge to the next is a U-turn."""
    ends = np.array([polylines.end_headings(line, reach=HEADING_REACH) for line in graph.geometry])
    enter, leave = ends.reshape(-1, 2).T
    turn = np.abs((enter[after] - leave[before] + np.pi) % (2 * np.pi) - np.pi)
    back: NDArray[np.bool_] = (graph.twin[before] == after) | (turn > _U_TURN)
    return back


def permitted_turns(graph: RoadGraph, avoid: Collection[tuple[int, int]]) -> TurnStates:
    """The permitted turns between states, without the turns and edges to avoid."""
    states = turn_states(graph)
    if not avoid:
        return states
    shut = np.array(sorted(avoid), np.int64).reshape(-1, 2)
    closed = shut[shut[:, 0] == shut[:, 1], 0]
    before, after = states.edge[states.before], states.edge[states.after]
    key = before.astype(np.int64) * len(graph) + after
    bad = (
        np.isin(key, shut[:, 0] * len(graph) + shut[:, 1]) | np.isin(before, closed) | np.isin(after, closed)
    )
    return replace(states, before=states.before[~bad], after=states.after[~bad])


def shortest_path(
    graph: RoadGraph,
    start: tuple[int, float],
    *,
    goal: tuple[int, float],
    weight: Literal["time", "length"] = "time",
    either_side: bool = True,
    u_turns: bool = False,
) -> RoadPath | None:
    """Fastest or shortest path between two places on the graph; None if they are not connected.

    start, goal : (edge, offset), as `nearest_edge` gives them
    weight      : ``time`` at the speed limits, or ``length``
    either_side : start and goal may also lie on the opposite edge of a two-way street
    u_turns     : U-turns are permitted at every node, not only at dead ends

    Dijkstra's algorithm over the states of `turn_states`, not over nodes, so that turn restrictions hold.
    """
    from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

    cost = np.maximum(graph.travel_time if weight == "time" else graph.length, 1e-9)
    starts = _sides(graph, start, either_side=either_side)
    goals = _sides(graph, goal, either_side=either_side)
    best: tuple[float, list[int], float, float] | None = None

    for edge, offset in starts:
        for target, end in goals:
            if edge == target and end >= offset:
                spent = cost[edge] * _share(graph, edge, offset=end - offset)
                if best is None or spent < best[0]:
                    best = (spent, [edge], offset, end)

    states = turn_states(graph, u_turns=u_turns)
    entered = states.edge[states.after]
    turns = csr_array((cost[entered], (states.before, states.after)), shape=(len(states), len(states)))
    for edge, offset in starts:
        reach, came_from = dijkstra(turns, indices=edge, return_predecessors=True)
        left = cost[edge] * (1 - _share(graph, edge, offset=offset))
        for target, end in goals:
            into = states.before[entered == target]
            if not len(into):
                continue
            last = int(into[np.argmin(reach[into])])
            spent = left + reach[last] + cost[target] * _share(graph, target, offset=end)
            if np.isfinite(spent) and (best is None or spent < best[0]):
                driven = states.edge[_walk(came_from, edge, last=last)].tolist()
                best = (spent, [*driven, target], offset, end)
    if best is None:
        return None
    _, edges, leave, arrive = best
    return _path(graph, edges, start=leave, end=arrive)


def path_line(graph: RoadGraph, path: RoadPath) -> Float:
    """The centre line (k, 3) of a path in the scene frame, cut at its start and its end."""
    parts = [graph.geometry[e] for e in path.edges]
    first, last = path.edges[0], path.edges[-1]
    line = np.concatenate([parts[0], *(part[1:] for part in parts[1:])])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1))])
    begin = _share(graph, first, offset=path.start) * _plan(parts[0])
    end = along[-1] - (1 - _share(graph, last, offset=path.end)) * _plan(parts[-1])
    inside = (along > begin) & (along < end)
    at = np.concatenate([[begin], along[inside], [end]])
    return np.stack([np.interp(at, along, line[:, k]) for k in range(3)], axis=1)


def _plan(line: Float) -> float:
    return float(np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1).sum())


def _share(graph: RoadGraph, edge: int, *, offset: float) -> float:
    length = float(graph.length[edge])
    return min(max(offset / length, 0.0), 1.0) if length > 0 else 0.0


def _sides(graph: RoadGraph, place: tuple[int, float], *, either_side: bool) -> list[tuple[int, float]]:
    """The place, and the same place on the street's other edge."""
    edge, offset = int(place[0]), float(np.clip(place[1], 0.0, graph.length[place[0]]))
    twin = int(graph.twin[edge])
    if either_side and twin >= 0:
        return [(edge, offset), (twin, float(graph.length[edge]) - offset)]
    return [(edge, offset)]


def _walk(came_from: NDArray[Any], first: int, *, last: int) -> list[int]:
    """States from ``first`` to ``last`` along Dijkstra's predecessors."""
    states = [last]
    while states[-1] != first:
        states.append(int(came_from[states[-1]]))
    return states[::-1]


def _path(graph: RoadGraph, edges: list[int], *, start: float, end: float) -> RoadPath:
    rows = np.array(edges, np.int32)
    driven = graph.length[rows].copy()
    driven[-1] = end
    driven[0] -= start
    return RoadPath(rows, start, end, float(driven.sum()), float((driven / graph.speed[rows]).sum()))


def route_line(words: Sequence[str], graph: RoadGraph, *, frame: Frame) -> Any:
    """The route as a shapely line or points, scene metres.

    words : two or more waypoints ``LAT,LON`` (joined over the road graph), or one file: GPX, GeoJSON, or CSV
            with columns lon and lat (a dataset's ``poses.csv``), used as it is

    Raises InputError for other words and SourceNotFoundError for a missing file.
    """
    given = [word.strip() for word in words]
    if len(given) == 1 and "," not in given[0]:
        lonlat = _read_lonlat(Path(given[0]))
        xy = np.column_stack(frame.from_geographic(*lonlat.T))
        return shapely.LineString(xy) if len(xy) > 1 else shapely.Point(xy[0])
    try:
        latlon = np.array([[float(v) for v in word.split(",")] for word in given])
        lat, lon = latlon.T
    except ValueError:
        raise InputError(f"`along` {' '.join(given)}: a file, or two or more LAT,LON") from None
    if not ((np.abs(lat) <= 90) & (np.abs(lon) <= 180)).all():
        swapped = f"; {SWAPPED}" if looks_swapped(graph, frame, lat=lat, lon=lon) else ""
        raise InputError(f"`along` {' '.join(given)}: not latitudes and longitudes in degrees{swapped}")
    if len(lat) < 2:
        raise InputError(f"`along` {given[0]}: one waypoint is no route; give two or more, or a file")
    xy = np.column_stack(frame.from_geographic(lon, lat))
    edges, offsets, distances = nearest_edge(graph, xy)
    if distances.max() > 100.0:
        far = int(distances.argmax())
        swapped = f"; {SWAPPED}" if looks_swapped(graph, frame, lat=lat, lon=lon) else ""
        raise InputError(
            f"`along` {given[far]}: {distances[far]:,.0f} m from the nearest road; at most 100{swapped}"
        )
    places = list(zip(edges.tolist(), offsets.tolist(), strict=True))
    lines = []
    for a, b in pairwise(places):
        path = shortest_path(graph, a, goal=b)
        if path is None:
            raise InputError(f"`along` {' '.join(given)}: no way to drive from one waypoint to the next")
        lines.append(path_line(graph, path)[:, :2])
    return shapely.LineString(np.concatenate(lines))


def _read_lonlat(path: Path) -> Float:
    """Longitudes and latitudes (n, 2) of the points in a file."""
    if not path.exists():
        raise SourceNotFoundError(f"{path}: no such file; a route is GPX, GeoJSON, CSV, or LAT,LON")
    if path.suffix.lower() != ".csv":
        points = read_track(path)[:, :2]
    else:
        with reading(path, InputError, remedy="give a CSV file with columns lon and lat"):
            rows = csv.DictReader(path.read_text("utf-8-sig", errors="replace").splitlines())
            if missing := [name for name in ("lon", "lat") if name not in (rows.fieldnames or ())]:
                has = ", ".join(rows.fieldnames or ())[:_SHOWN] or "no columns"
                raise InputError(f"{path}: has {has}; no {' and no '.join(missing)}")
            points = np.array([(float(row["lon"]), float(row["lat"])) for row in rows])
    if not len(points):
        raise InputError(f"{path}: holds no points")
    return points
