"""Junctions of the road graph: reservations, signal groups and their phases."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.roadgraph.graph import RoadGraph
from geoscene.support.compiled import njit
from geoscene.typing import Float, Ints
from lidar.geometry.random_streams import generator
from lidar.traffic.lanes import Lanes

_ROUND = 3.0  # metres by which a junction reaches beyond half the width of its widest street
_TOGETHER = (
    16.0  # metres between the parts of a junction with signals: carriageways apart, one set of signals
)
_CYCLE_S = 60.0
AMBER = 5.0
"""Seconds without green at the end of each group's half cycle: amber and clearing."""


class Signals(NamedTuple):
    """Fixed-time signals, one row per junction, and time windows reserved for the ego.

    cycle, shift : (z,) seconds
    window       : (w, 4) junction, group, from and to in seconds: only that group has green then
    """

    cycle: Float
    shift: Float
    window: Float


@dataclass(frozen=True, slots=True)
class Zones:
    """Areas of junctions; overlapping ones are one.

    polygon : (z,) shapely polygons, scene metres
    tree    : their search tree
    nodes   : the graph's nodes in each
    """

    polygon: NDArray[np.object_]
    tree: shapely.STRtree
    nodes: Sequence[Ints]


def zones_of(graph: RoadGraph) -> Zones:
    """The junctions of a graph: circles about nodes of three or more streets, united where they touch.

    Those with signals are united where they are close to each other: they are one junction to traffic.
    """
    ends = np.concatenate([graph.tail[graph.once], graph.head[graph.once]])
    arms = np.bincount(ends, minlength=len(graph.node_id))
    half = np.zeros(len(graph.node_id))
    np.maximum.at(half, graph.tail, graph.width / 2)
    np.maximum.at(half, graph.head, graph.width / 2)
    node = np.flatnonzero(arms >= 3)
    if not len(node):
        none = np.empty(0, object)
        return Zones(none, shapely.STRtree(none), [])
    circles = shapely.buffer(shapely.points(graph.node_xyz[node, :2]), half[node] + _ROUND, quad_segs=4)
    signalised = shapely.union_all(shapely.buffer(circles[graph.signals[node]], _TOGETHER / 2, quad_segs=4))
    signalised = shapely.buffer(signalised, -_TOGETHER / 2, quad_segs=4)
    polygon = shapely.get_parts(shapely.union_all([*circles, signalised]))
    tree = shapely.STRtree(polygon)
    point, zone = tree.query(shapely.points(graph.node_xyz[node, :2]), predicate="intersects")
    return Zones(polygon, tree, [node[point[zone == z]] for z in range(len(polygon))])


def zone_at(zones: Zones, xy: Float) -> Ints:
    """The junction (n,) that each point lies in, -1 for none."""
    out = np.full(len(xy), -1, np.int64)
    if len(zones.polygon) and len(xy):
        point, zone = zones.tree.query(shapely.points(xy), predicate="intersects")
        out[point] = zone
    return out


def road_rank(highway: str) -> int:
    """Rank of a road's class, 0 the most important."""
    order = ("motorway", "trunk", "primary", "secondary", "tertiary", "unclassified", "residential")
    name = highway.removesuffix("_link")
    return order.index(name) if name in order else len(order)


@dataclass(frozen=True, slots=True)
class JunctionPlan:
    """Junctions and their signals.

    zones  : the junctions
    axis   : (z,) heading in radians along which the first of a junction's two groups of streets runs
    signalised : (z,) bool, has signals
    """

    zones: Zones
    axis: Float
    signalised: NDArray[np.bool_]
    signals: Signals


def junction_plan(graph: RoadGraph, lanes: Lanes, *, seed: int) -> JunctionPlan:
    """Junctions with fixed-time signals of two groups where the map has signals."""
    zones = zones_of(graph)
    n = len(zones.polygon)
    axis, shift, signalised = np.zeros(n), np.zeros(n), np.zeros(n, bool)
    for z, nodes in enumerate(zones.nodes):
        into = np.isin(graph.head, nodes) & ~np.isin(graph.tail, nodes)
        into = into if into.any() else np.isin(graph.head, nodes)
        axis[z] = np.angle(np.exp(4j * lanes.leave[into]).sum()) / 4
        signalised[z] = bool(graph.signals[nodes].any())
        if signalised[z]:
            first = int(graph.node_id[nodes].min())
            shift[z] = generator(seed, "traffic", "signals", first).uniform(0, _CYCLE_S)
    return JunctionPlan(zones, axis, signalised, Signals(np.full(n, _CYCLE_S), shift, np.empty((0, 4))))


def signal_group(plan: JunctionPlan, zone: int, *, heading: float) -> int:
    """Signal group of a junction for traffic of a heading, -1 without signals."""
    if not plan.signalised[zone]:
        return -1
    return 0 if abs(np.cos(heading - plan.axis[zone])) >= abs(np.sin(heading - plan.axis[zone])) else 1


@njit(cache=True, nogil=True)
def is_green(zone: int, group: int, t: float, signals: Any) -> bool:
    """Whether a group of a junction's signals shows green: half the cycle each, less `AMBER`."""
    for w in range(len(signals.window)):
        if signals.window[w, 0] == zone and signals.window[w, 2] <= t <= signals.window[w, 3]:
            return bool(signals.window[w, 1] == group)
    phase = (t + signals.shift[zone]) % signals.cycle[zone]
    half = 0.5 * signals.cycle[zone]
    return bool(group * half <= phase < (group + 1) * half - AMBER)
