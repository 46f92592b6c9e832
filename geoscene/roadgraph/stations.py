"""Stations along the road graph, at which heights are determined; roads that cross or overlap there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.layers import rank_ways
from geoscene.roadgraph.routing import edge_lines
from geoscene.support.columns import nth
from geoscene.typing import Bools, Float, Ints

# Arms of a node that deviate from a straight line by less than this (radians) are one continuous road.
_STRAIGHT = np.radians(40.0)

_LAP = 1.0
"""Metres by which carriageways overlap at least; widths on maps are no better than that."""

_PARALLEL = np.sin(np.radians(35.0))
"""Sine of the greatest angle between roads that run side by side; others cross."""

_REACH = 400.0
"""Metres along roads within which a fork is looked for."""


@dataclass(frozen=True, slots=True)
class Stations:
    """Stations of a graph; the two edges of a two-way street share theirs.

    xy      : (v, 2) float64 scene metres; the first rows are the graph's nodes
    row     : (r,) int64 stations edge after edge, each edge's from its tail to its head
    edge    : (r,) int64 edge of each row
    along   : (r,) float64 scene metres in plan from the edge's tail
    drawn   : (r,) bool, the row is a vertex of the edge's line, not an inserted point
    place   : (r, 2) float64 scene metres of each row on its edge's line, which may end beside its nodes
    """

    xy: Float
    row: Ints
    edge: Ints
    along: Float
    drawn: Bools
    place: Float

    @property
    def segments(self) -> tuple[Ints, Ints, Float, Ints]:
        """Neighbours on an edge: (from (s,), to (s,), metres (s,), edge (s,))."""
        first = np.flatnonzero(self.edge[1:] == self.edge[:-1])
        metres = np.maximum(self.along[first + 1] - self.along[first], 1e-3)
        return self.row[first], self.row[first + 1], metres, self.edge[first]

    @property
    def triples(self) -> tuple[Ints, Ints, Ints, Float, Float]:
        """Stations before, at and after each bend: (a, b, c (t,), metres from a to b, and from b to c).

        Within edges, and across nodes where a road continues.
        """
        a, b, metres, edge = self.segments
        inner = np.flatnonzero(edge[1:] == edge[:-1])
        inside = (a[inner], b[inner], b[inner + 1], metres[inner], metres[inner + 1])
        begins = np.flatnonzero(np.diff(edge, prepend=-1))
        ends = np.flatnonzero(np.diff(edge, append=-1))
        node = np.concatenate([a[begins], b[ends]])
        other = np.concatenate([b[begins], a[ends]])
        far = np.concatenate([metres[begins], metres[ends]])
        away = polylines.unit(self.xy[other] - self.xy[node])
        i, j = _pairs(node)
        on = (away[i] * away[j]).sum(axis=1) < -np.cos(_STRAIGHT)
        i, j = i[on], j[on]
        across = (other[i], node[i], other[j], far[i], far[j])
        joined = [np.concatenate(columns) for columns in zip(inside, across, strict=True)]
        return joined[0], joined[1], joined[2], joined[3], joined[4]

    def at(self, edge: Ints, along: Float) -> tuple[Ints, Ints, Float]:
        """Stations before and after places on edges, and the weight (0..1) of the latter."""
        # One ascending key over all edges, so that one search serves them all.
        step = float(self.along.max(initial=0.0)) + 1.0
        key = self.edge * step + self.along
        after = np.searchsorted(key, edge * step + along, side="right")
        first = np.searchsorted(self.edge, edge, side="left")
        last = np.searchsorted(self.edge, edge, side="right") - 1
        after = np.clip(after, first + 1, last)
        before = after - 1
        metres = np.maximum(self.along[after] - self.along[before], 1e-9)
        share = np.clip((along - self.along[before]) / metres, 0.0, 1.0)
        return self.row[before], self.row[after], share


def _pairs(group: Ints) -> tuple[Ints, Ints]:
    """All pairs i < j of rows of equal group."""
    order = np.argsort(group, kind="stable")
    size = np.bincount(group)[group[order]]
    start = np.searchsorted(group[order], group[order])
    ahead = size - 1 - (np.arange(len(order)) - start)
    i = np.repeat(np.arange(len(order)), ahead)
    j = i + 1 + nth(ahead)
    return order[i], order[j]


def place_stations(graph: RoadGraph, *, spacing: float) -> Stations:
    """Stations at all vertices and, between them, at most ``spacing`` metres apart."""
    once = np.flatnonzero(graph.once)
    if not len(once):
        none = np.empty(0, np.int64)
        empty = np.empty(0), np.empty(0, np.bool_), np.empty((0, 2))
        return Stations(graph.node_xyz[:, :2], none, none, *empty)
    lines = [graph.geometry[edge][:, :2] for edge in once.tolist()]
    xy, of = np.concatenate(lines), np.repeat(np.arange(len(once)), [len(line) for line in lines])
    first, last = np.flatnonzero(np.diff(of, prepend=-1)), np.flatnonzero(np.diff(of, append=-1))
    step = np.diff(xy, axis=0, append=xy[-1:])
    step[last] = 0.0
    metres = np.hypot(*step.T)
    corner = polylines.add_up(np.concatenate([[0.0], metres[:-1]]), first[of])
    pieces = np.maximum(np.ceil(metres / spacing), 1).astype(np.int64)
    vertex = np.repeat(np.arange(len(xy)), pieces)
    part = nth(pieces)
    share = part / pieces[vertex]
    is_first, is_last = np.zeros((2, len(xy)), np.bool_)
    is_first[first], is_last[last] = True, True
    tail, head = is_first[vertex] & (part == 0), is_last[vertex]
    inner = ~tail & ~head
    edge = once[of[vertex]]
    row = np.where(tail, graph.tail[edge], graph.head[edge]).astype(np.int64)
    row[inner] = len(graph.node_id) + np.arange(int(inner.sum()))
    places = xy[vertex] + share[:, None] * step[vertex]
    return Stations(
        np.concatenate([graph.node_xyz[:, :2], places[inner]]),
        row,
        edge,
        corner[vertex] + share * metres[vertex],
        part == 0,
        places,
    )


def find_crossings(
    graph: RoadGraph, stations: Stations, *, level: bool = False
) -> tuple[Ints, Float, Ints, Float, Float]:
    """Grade-separated crossings: (upper edge, metres along it, lower edge, metres along it, margin).

    These are lines that cross in plan without a common node and differ in rank
    (`geoscene.roadgraph.layers.rank_ways`). The margin is the length in metres along the upper road that half
    the lower road's width takes up.

    level : those of equal rank instead, whose roads have the same height
    """
    once = np.unique(stations.edge)
    lines = edge_lines(graph)[once]
    rank = rank_ways(graph.layer, bridge=graph.bridge, tunnel=graph.tunnel)[once]
    one, two = shapely.STRtree(lines).query(lines, predicate="intersects")
    over = (rank[one] == rank[two]) & (one < two) if level else rank[one] > rank[two]
    one, two = one[over], two[over]
    points, pair = shapely.get_parts(shapely.intersection(lines[one], lines[two]), return_index=True)
    point = shapely.get_type_id(points) == shapely.GeometryType.POINT
    points, one, two = points[point], one[pair[point]], two[pair[point]]
    xy = shapely.get_coordinates(points)
    at_node = np.zeros(len(points), np.bool_)
    for upper_end in (graph.tail, graph.head):
        for lower_end in (graph.tail, graph.head):
            same = upper_end[once[one]] == lower_end[once[two]]
            near = np.hypot(*(graph.node_xyz[upper_end[once[one]], :2] - xy).T) < 0.5
            at_node |= same & near
    points, one, two = points[~at_node], one[~at_node], two[~at_node]
    upper, lower = (shapely.line_locate_point(lines[k], points) for k in (one, two))
    across = polylines.cross(_heading(lines[one], upper), _heading(lines[two], lower))
    sine = np.clip(np.abs(across), 0.2, 1.0)
    return once[one], upper, once[two], lower, graph.width[once[two]] / 2 / sine


def _heading(lines: NDArray[np.object_], along: Float) -> Float:
    step = np.minimum(1.0, shapely.length(lines) / 4)
    at = np.clip(along, step, shapely.length(lines) - step)
    return polylines.directions(lines, at, reach=step)


@dataclass(frozen=True, slots=True)
class Overlaps:
    """Stations of bridges and tunnels within another road beside them.

    station : (k,) int64
    before, after, share : (k,) the other road's stations before and after its nearest point, and the share
              (0..1) of the latter
    away    : (k,) float64 metres between the two
    side    : (k,) int64, 1 where the station's road is over the other, -1 under it, 0 at the same height
    fork    : (k,) float64 metres along both roads from the fork; inf where they are not connected
    """

    station: Ints
    before: Ints
    after: Ints
    share: Float
    away: Float
    side: Ints
    fork: Float


def find_overlaps(
    graph: RoadGraph, stations: Stations, *, crossing: tuple[Ints, Ints], room: float
) -> Overlaps:
    """Stations of bridges and tunnels within carriageways that run beside them.

    Roads of different layers lie over one another if they cross somewhere, or if the centre line of one runs
    within the other far enough from the fork to be parted in height. Otherwise, as at forks and in the same
    layer, they have the same height.

    crossing : edges that cross each other, from `geoscene.roadgraph.stations.find_crossings`
    room     : metres along both roads from a fork that parting in height takes
    """
    once = np.unique(stations.edge)
    structure = graph.bridge | graph.tunnel
    lines = edge_lines(graph)[once]
    rows = np.flatnonzero(structure[stations.edge])
    points = shapely.points(stations.xy[stations.row[rows]])
    tree = shapely.STRtree(lines)
    reach = (graph.width[stations.edge[rows]] + graph.width[once].max(initial=0.0)) / 2
    point, found = tree.query(points, predicate="dwithin", distance=reach)
    row, other = rows[point], once[found]
    edge = stations.edge[row]
    metres = shapely.distance(points[point], lines[found])
    along = shapely.line_locate_point(lines[found], points[point])
    length = shapely.length(lines[found])
    lap = (graph.width[edge] + graph.width[other]) / 2 - metres
    both = structure[other]
    deep = metres < np.minimum(graph.width[edge], graph.width[other]) / 2
    keep = (edge != other) & (lap > _LAP) & (along > 0.01) & (along < length - 0.01)
    keep &= both | (graph.bridge[edge] & deep)
    way = _edge_heading(stations, row)
    theirs = polylines.directions(lines[found], along, reach=0.5)
    keep &= np.abs(polylines.cross(way, theirs)) < _PARALLEL
    row, edge, other, along, metres, length, both = (
        column[keep] for column in (row, edge, other, along, metres, length, both)
    )
    deep = metres < np.minimum(graph.width[edge], graph.width[other]) / 2
    rank = rank_ways(graph.layer, bridge=graph.bridge, tunnel=graph.tunnel)
    side = np.sign(rank[edge] - rank[other]).astype(np.int64)
    fork = _from_fork(graph, stations, row=row, edge=edge, other=other, along=along, length=length)
    roomy = fork >= room
    pair = np.minimum(edge, other) * len(graph) + np.maximum(edge, other)
    crosses = np.minimum(*crossing) * len(graph) + np.maximum(*crossing)
    over = np.isin(pair, np.append(pair[roomy & deep & (side != 0)], crosses))
    # Far from their fork, roads of different layers that only touch are separated by a wall.
    keep = over | (both & ((side == 0) | ~roomy))
    side = np.where(over, side, 0)
    row, other, along, metres, side, fork = (
        column[keep] for column in (row, other, along, metres, side, fork)
    )
    before, after, share = stations.at(other, along)
    return Overlaps(stations.row[row], before, after, share, metres, side, fork)


def _edge_heading(stations: Stations, row: Ints) -> Float:
    """Unit vectors (k, 2) along the edges at rows of stations."""
    ends = np.append(stations.edge[1:] != stations.edge[:-1], True)[row]
    a, b = np.where(ends, row - 1, row), np.where(ends, row, row + 1)
    step = stations.xy[stations.row[b]] - stations.xy[stations.row[a]]
    return polylines.unit(step)


def _from_fork(
    graph: RoadGraph, stations: Stations, *, row: Ints, edge: Ints, other: Ints, along: Float, length: Float
) -> Float:
    """Distance (k,) along roads from stations to places on other edges; inf beyond ``reach``."""
    from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

    if not len(row):
        return np.empty(0)
    own = stations.along[np.searchsorted(stations.edge, edge, side="right") - 1]
    once = np.unique(stations.edge)
    metres = stations.along[np.searchsorted(stations.edge, once, side="right") - 1]
    count = len(graph.node_id)
    # Of parallel edges between two nodes the shortest counts.
    order = np.lexsort(np.stack([metres, graph.head[once], graph.tail[once]]))
    tail, head, metres = graph.tail[once][order], graph.head[once][order], metres[order]
    first = np.flatnonzero((np.diff(tail, prepend=-1) != 0) | (np.diff(head, prepend=-1) != 0))
    net = csr_array((metres[first], (tail[first], head[first])), shape=(count, count))
    start = np.unique(np.concatenate([graph.tail[edge], graph.head[edge]]))
    between = dijkstra(net, directed=False, indices=start, limit=_REACH)
    least = np.full(len(row), np.inf)
    for node, near in ((graph.tail, stations.along[row]), (graph.head, own - stations.along[row])):
        for end, far in ((graph.tail, along), (graph.head, length - along)):
            way = near + between[np.searchsorted(start, node[edge]), end[other]] + far
            least = np.minimum(least, way)
    return least
