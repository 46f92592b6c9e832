"""Signal heads of a scene: junction and signal group of each, and its state over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import SceneFormatError
from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.scene import Scene
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory
from lidar.motion.vehicle import Vehicle
from lidar.traffic.ego import ego_motion, green_windows
from lidar.traffic.junctions import (
    JunctionPlan,
    Signals,
    is_green,
    junction_plan,
    signal_group,
    zone_at,
)
from lidar.traffic.lanes import lanes_of

RED, AMBER, GREEN = 0, 1, 2
"""States: rows of lamps from the top."""

STATES = ("red", "amber", "green")

AMBER_S = 3.0
"""Seconds of amber after green: 3 s at 50 km/h (RiLSA 2015, 2.4; about what ITE's formula gives, too)."""

_NEAR = 30.0  # metres in plan between a head and the point of a road where it controls traffic
_ASIDE = np.radians(
    50.0
)  # greatest angle between the traffic that a head faces and the one that is controlled
_TURN = 10.0  # metres that a match is worse for each unit of 1 - cosine of that angle
_OWN = 30.0  # metres before a junction within which a signal is the junction's, as in `roadgraph.controls`
_STEP = 1.0  # metres between points at which an edge is looked for the junction ahead


@dataclass(frozen=True, slots=True)
class SignalHeads(Columns):
    """Signal heads, one row each, sorted by feature.

    feature : (n,) int32, number in the scene
    place   : (n, 3) of the foot of the post, scene metres
    heading : (n,) radians counter-clockwise from east, the direction that it faces
    zone    : (n,) int64, junction of the plan; -1 for none, where traffic is never stopped
    group   : (n,) int64, group of its signals, -1 without a junction
    """

    feature: NDArray[np.int32]
    place: Float
    heading: Float
    zone: Ints
    group: Ints


@dataclass(frozen=True, slots=True)
class SignalStates:
    """States of signal heads over time.

    heads   : the heads
    signals : of the junctions, as traffic obeys them
    """

    heads: SignalHeads
    signals: Signals

    def at(self, time_s: float) -> NDArray[np.uint8]:
        """State (n,) of each head: `RED`, `AMBER` or `GREEN`, seconds after the drive's start.

        A head is amber for `AMBER_S` after its green; heads without a junction rest in green.
        """
        out = np.full(len(self.heads), GREEN, np.uint8)
        known = {}
        for row in np.flatnonzero(self.heads.zone >= 0).tolist():
            key = int(self.heads.zone[row]), int(self.heads.group[row])
            if key not in known:
                green, was = (is_green(*key, time_s - ago, self.signals) for ago in (0.0, AMBER_S))
                known[key] = GREEN if green else AMBER if was else RED
            out[row] = known[key]
        return out


def signal_states(
    scene: Scene,
    graph: RoadGraph | None,
    *,
    seed: int,
    side: str,
    vehicle: Vehicle,
    fixed: Trajectory | None = None,
) -> SignalStates | None:
    """States of a scene's signal heads during a drive; None in a scene without heads or roads.

    graph : road graph of the scene, if it is read already
    seed, side : of the signals and of the road, as for `lidar.traffic.junctions.junction_plan`
    fixed : trajectory of a vehicle that does not obey signals; those on its way are green when it arrives
    """
    if graph is None and not scene.files.road_graph.exists():
        return None
    try:
        layer = scene.features("furniture")
    except SceneFormatError:
        return None
    rows = np.flatnonzero(layer.columns["shape"].astype(str) == "traffic_signals")
    if not len(rows):
        return None
    graph = graph or scene.road_graph()
    lanes = lanes_of(graph, side=side, bounds=scene.bounds, cut_nodes=scene.cut_nodes)
    plan = junction_plan(graph, lanes, seed=seed)
    signals = plan.signals
    if fixed is not None:
        signals = signals._replace(window=green_windows(plan, ego_motion(fixed, vehicle, graph=graph)))
    feature = np.asarray(layer.columns["feature"])[rows].astype(np.int32)
    rows, feature = rows[np.argsort(feature)], np.sort(feature)
    place = shapely.get_coordinates(layer.geometry[rows], include_z=True)
    heading = np.asarray(layer.columns["heading"], float)[rows]
    zone, group = find_served_heads(place, heading, graph=graph, plan=plan)
    return SignalStates(SignalHeads(feature, place, heading, zone, group), signals)


def find_served_heads(
    place: Float, heading: Float, *, graph: RoadGraph, plan: JunctionPlan
) -> tuple[Ints, Ints]:
    """Junction and group (n,) of heads at places (n, 3) that face headings (n,); -1 for none.

    The map does not say which junction a head serves. It is matched to the point of the road graph with a
    signal that is nearest in place and in direction of traffic; its junction is the first one with signals
    from there on, up to 30 m ahead. A head without such a point serves the nearest junction with signals
    within 30 m.
    """
    at, toward, ahead, entering = _find_controlled(graph, plan)
    traffic = heading + np.pi
    zone, group = np.full(len(place), -1, np.int64), np.full(len(place), -1, np.int64)
    matched = np.zeros(len(place), np.bool_)
    if len(at):
        points = shapely.STRtree(shapely.points(at))
        head, point = points.query(shapely.points(place[:, :2]), predicate="dwithin", distance=_NEAR)
        cosine = np.cos(toward[point] - traffic[head])
        fits = cosine >= np.cos(_ASIDE)
        head, point, cosine = head[fits], point[fits], cosine[fits]
        worse = np.hypot(*(at[point] - place[head, :2]).T) + _TURN * (1 - cosine)
        best = np.lexsort((point, worse, head))
        head, first = np.unique(head[best], return_index=True)
        point = point[best][first]
        matched[head] = True
        for row, control in zip(head.tolist(), point.tolist(), strict=True):
            z = int(ahead[control])
            zone[row] = z
            group[row] = -1 if z < 0 else signal_group(plan, z, heading=float(entering[control]))
    lone = np.flatnonzero(~matched)
    lit = np.flatnonzero(plan.signalised)
    if len(lone) and len(lit):
        tree = shapely.STRtree(plan.zones.polygon[lit])
        head, near = tree.query_nearest(
            shapely.points(place[lone, :2]), max_distance=_NEAR, all_matches=False
        )
        for row, z in zip(lone[head].tolist(), lit[near].tolist(), strict=True):
            zone[row], group[row] = z, signal_group(plan, z, heading=float(traffic[row]))
    return zone, group


def _find_controlled(graph: RoadGraph, plan: JunctionPlan) -> tuple[Float, Float, Ints, Float]:
    """Points (k, 2) of edges where signals control traffic, and its headings (k,) there.

    And the junctions (k,) with signals that they serve, -1 for none, and the headings (k,) on entering them.
    """
    rows = np.flatnonzero(graph.control_kind == "traffic_signals").tolist()
    lit = np.flatnonzero(plan.signalised)
    at, toward = np.empty((len(rows), 2)), np.empty(len(rows))
    ahead, entering = np.full(len(rows), -1, np.int64), np.empty(len(rows))
    for k, row in enumerate(rows):
        edge = int(graph.control_edge[row])
        line = graph.geometry[edge][:, :2]
        along = polylines.stations(line)
        factor = along[-1] / max(float(graph.length[edge]), 1e-9)
        start = min(float(graph.control_offset[row]) * factor, float(along[-1]))
        on = start + np.arange(0.0, _OWN * factor + _STEP, _STEP)
        points = polylines.points_at(line, on, along=along)
        back = polylines.points_at(line, np.clip(on - _STEP, 0.0, along[-1] - _STEP), along=along)
        step = points - back
        course = np.arctan2(step[:, 1], step[:, 0])
        # An edge may end before the junction, where an attribute of the road changes: straight on from there.
        beyond = np.maximum(on - along[-1], 0.0)[:, None]
        points = points + beyond * np.column_stack([np.cos(course), np.sin(course)])
        zone = zone_at(plan.zones, points)
        inside = np.flatnonzero(np.isin(zone, lit))
        at[k], toward[k] = points[0], course[0]
        if len(inside):
            ahead[k], entering[k] = zone[inside[0]], course[inside[0]]
    return at, toward, ahead, entering
