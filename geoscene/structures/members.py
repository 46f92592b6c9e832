"""Roads and paths on bridges and in tunnels: centre lines with heights, and their ends on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

_APPROACH = 6.0
"""Metres of the road on the ground that tell which way a bridge or tunnel opens."""

_SILL = 0.05
"""Metres by which what opens reaches in, so that it is open on the outside of a bend at the mouth too."""

_WALK = 5.0
"""Metres beside a carriageway that its sidewalk and parapet take up at most."""


@dataclass(frozen=True, slots=True)
class Members(Columns):
    """Roads and paths on bridges and in tunnels, one row each.

    line     : (n,) object, (k, 3) float64 scene metres
    tunnel   : (n,) bool
    foot     : (n,) bool, for pedestrians or cyclists
    width    : (n,) float64 metres of the carriageway or path
    rows     : (n,) object, (k,) int64 rows of its surfaces among the raised ones
    approach : (n,) object, shapely: the first metres of the roads at its ends that are of another kind:
               on the ground or, from a tunnel, on a bridge
    landed   : (n, 2) bool, start and end lie on the ground
    level    : (n,) int8
    edge     : (n,) int32, -1 for paths
    osm_id   : (n,) str
    """

    line: NDArray[np.object_]
    tunnel: Bools
    foot: Bools
    width: Float
    rows: NDArray[np.object_]
    approach: NDArray[np.object_]
    landed: Bools
    level: NDArray[np.int8]
    edge: NDArray[np.int32]
    osm_id: NDArray[np.str_]


def road_members(graph: RoadGraph, raised: SurfaceRows) -> Members:
    """The bridges and tunnels of a road graph with heights that have surfaces; two-way streets once."""
    structure = graph.bridge | graph.tunnel
    order = np.argsort(raised.edge, kind="stable")
    begin, stop = (
        np.searchsorted(raised.edge[order], np.arange(len(graph)), side=s) for s in ("left", "right")
    )
    once = np.flatnonzero(
        structure & (begin < stop) & ((graph.twin < 0) | (graph.twin > np.arange(len(graph))))
    )
    arms = _arms(graph, once)
    count = len(once)
    line, rows, approach = (np.empty(count, object) for _ in range(3))
    landed = np.zeros((count, 2), np.bool_)
    for k, edge in enumerate(once.tolist()):
        line[k] = graph.geometry[edge]
        rows[k] = order[begin[edge] : stop[edge]]
        kind = _kind(graph, edge)
        ends = [arms[int(node)] for node in (graph.tail[edge], graph.head[edge])]
        landed[k] = [any(other == 0 for other, _, _ in found) for found in ends]
        bands = [
            _band(
                np.concatenate([polylines.cut(inward[:, :2], 0.0, end=_SILL)[1:], first]),
                max(width, graph.width[edge]),
            )
            for inward, found in zip((line[k], line[k][::-1]), ends, strict=True)
            for other, first, width in found
            if other != kind
        ]
        bands += [
            shapely.Point(line[k][e, :2]).buffer(graph.width[edge] / 2)
            for e, found in zip((0, -1), ends, strict=True)
            if any(other != kind for other, _, _ in found)
        ]
        approach[k] = shapely.union_all(bands)
    return Members(
        line,
        graph.tunnel[once],
        np.zeros(count, np.bool_),
        graph.width[once],
        rows,
        approach,
        landed,
        graph.layer[once],
        once.astype(np.int32),
        graph.osm_id[once],
    )


def _kind(graph: RoadGraph, edge: int) -> int:
    """0 on the ground, 1 on a bridge, 2 in a tunnel."""
    return 2 if graph.tunnel[edge] else int(graph.bridge[edge])


def _arms(graph: RoadGraph, members: Ints) -> dict[int, list[tuple[int, Float, float]]]:
    """Kind, first metres (from the node) and width of all roads at the ends of members, by node."""
    ends = np.unique(np.concatenate([graph.tail[members], graph.head[members]]))
    arms: dict[int, list[tuple[int, Float, float]]] = {int(node): [] for node in ends}
    for node, step in ((graph.tail, 1), (graph.head, -1)):
        for edge in np.flatnonzero(np.isin(node, ends)).tolist():
            line = polylines.cut(graph.geometry[edge][::step, :2], 0.0, end=_APPROACH)
            arms[int(node[edge])].append((_kind(graph, edge), line, float(graph.width[edge])))
    return arms


def _band(first: Float, width: float) -> shapely.Geometry:
    """Opening in a parapet or wall for a road: as wide as the wider of both roads, plus a sidewalk."""
    return shapely.LineString(first).buffer(width / 2 + _WALK, cap_style="flat", join_style="mitre")
