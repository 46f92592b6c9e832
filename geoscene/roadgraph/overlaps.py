"""Roads that overlap side by side in plan: at forks, or on different levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely

from geoscene.geometry.polylines import directions, unit
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.stations import Stations
from geoscene.typing import Float, Ints

_LAP = 1.0
"""Metres by which carriageways overlap at least; widths on maps are no better than that."""

_PARALLEL = np.sin(np.radians(35.0))
"""Sine of the greatest angle between roads that run side by side; others cross."""

_REACH = 400.0
"""Metres along roads within which a fork is looked for."""


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
    way = _heading(stations, row)
    theirs = directions(lines[found], along, reach=0.5)
    keep &= np.abs(way[:, 0] * theirs[:, 1] - way[:, 1] * theirs[:, 0]) < _PARALLEL
    row, edge, other, along, metres, length, both = (
        column[keep] for column in (row, edge, other, along, metres, length, both)
    )
    deep = metres < np.minimum(graph.width[edge], graph.width[other]) / 2
    rank = graph.layer * 2 + np.where(graph.tunnel, -1, graph.bridge.astype(np.int64))
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


def _heading(stations: Stations, row: Ints) -> Float:
    """Unit vectors (k, 2) along the edges at rows of stations."""
    ends = np.append(stations.edge[1:] != stations.edge[:-1], True)[row]
    a, b = np.where(ends, row - 1, row), np.where(ends, row, row + 1)
    step = stations.xy[stations.row[b]] - stations.xy[stations.row[a]]
    return unit(step)


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
