"""The drivable road graph as columns, and its connected components."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Bools, Float, Ints


@dataclass(frozen=True, slots=True)
class RoadGraph:
    """Directed drivable graph; one row an edge, two-way streets are two edges.

    node_id  : (n,) int64 OSM node ids
    node_xyz : (n, 3) float64, scene frame, metres
    tail, head : (m,) int32 node indices: traffic runs from tail to head
    geometry : (m,) object, each (k, 3) float64 centre line of the carriageway from tail to head, scene frame;
               it begins and ends beside the nodes where the map's line is not the middle (``placement``)
    length   : (m,) float64, true metres in plan
    speed    : (m,) float64, speed limit in m/s
    speed_source : (m,) str: ``maxspeed``, ``zone`` (a legal default named by the map: ``DE:urban``) or
                   ``default`` (by road class)
    lanes    : (m,) float64, lanes in this direction; a half is a lane shared with the other direction
    contraflow : (m,) float64, lanes against the traffic of a one-way street, for buses; 0 on other streets
    lanes_source : (m,) str: ``lanes`` or ``default``
    lane_kinds, lane_widths, lane_turns : (m,) str, who may drive in each lane of this direction
               (``driving|bus``), its metres (``3|3.5``) and the values of ``turn:lanes`` (``left|through``),
               from left to right; "" where they are not mapped. Cycle lanes are among them (``biking``)
    width    : (m,) float64, metres of the whole carriageway (both directions)
    width_source : (m,) str: ``width``, ``est_width``, ``lanes`` (mapped lanes x the class's lane width),
                   ``default``, or ``buildings`` (less than that, between walls)
    oneway   : (m,) bool
    layer    : (m,) int8
    layer_source : (m,) str: ``layer``, ``level``, ``bridge``, ``tunnel`` or ``default`` (ground)
    bridge, tunnel : (m,) bool
    roundabout : (m,) bool, the edge is a part of a roundabout
    highway  : (m,) str
    name     : (m,) str, "" if none
    ref      : (m,) str, "" if none
    osm_id   : (m,) str, ``way/123``; ``way/123;way/124`` where ways of equal tags were joined
    twin     : (m,) int32, the edge of the same carriageway in the other direction, -1 if there is none
    signals, stop, give_way : (n,) bool, traffic control at the node
    node_island : (n,) float64, metres of the radius of the island of a turning loop at the node; 0 without

    Turn restrictions, one row each:

    turn_from, turn_to : (r,) int32 edges
    turn_via  : (r,) int32 node, head of ``turn_from`` and tail of ``turn_to``
    turn_kind : (r,) str, OSM's value: ``no_left_turn``, ``only_straight_on`` ...

    Restrictions via ways, one row each:

    chain_edges : (q,) object, each (k >= 3,) int32: edges that follow each other, not to be driven in this
                  order, or the only ones that may follow the first
    chain_kind  : (q,) str, as ``turn_kind``

    Traffic controls along edges, one row each:

    control_edge   : (c,) int32
    control_offset : (c,) float64, true metres in plan from the edge's tail
    control_kind   : (c,) str: ``traffic_signals``, ``stop``, ``give_way``, ``mini_roundabout`` or
                     ``crossing``
    """

    node_id: Ints
    node_xyz: Float
    tail: NDArray[np.int32]
    head: NDArray[np.int32]
    geometry: NDArray[np.object_]
    length: Float
    speed: Float
    speed_source: NDArray[np.str_]
    lanes: Float
    contraflow: Float
    lane_kinds: NDArray[np.str_]
    lane_widths: NDArray[np.str_]
    lane_turns: NDArray[np.str_]
    lanes_source: NDArray[np.str_]
    width: Float
    width_source: NDArray[np.str_]
    oneway: Bools
    layer: NDArray[np.int8]
    layer_source: NDArray[np.str_]
    bridge: Bools
    tunnel: Bools
    roundabout: Bools
    highway: NDArray[np.str_]
    name: NDArray[np.str_]
    ref: NDArray[np.str_]
    osm_id: NDArray[np.str_]
    twin: NDArray[np.int32]
    signals: Bools
    stop: Bools
    give_way: Bools
    node_island: Float
    turn_from: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    turn_via: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    turn_to: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    turn_kind: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, np.str_))
    chain_edges: NDArray[np.object_] = field(default_factory=lambda: np.empty(0, object))
    chain_kind: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, np.str_))
    control_edge: NDArray[np.int32] = field(default_factory=lambda: np.empty(0, np.int32))
    control_offset: Float = field(default_factory=lambda: np.empty(0))
    control_kind: NDArray[np.str_] = field(default_factory=lambda: np.empty(0, np.str_))

    def __len__(self) -> int:
        """Number of edges."""
        return len(self.tail)

    @property
    def controls(self) -> Iterator[tuple[int, float, str]]:
        """Edge, offset and kind of each traffic control."""
        columns = (self.control_edge, self.control_offset, self.control_kind)
        return zip(*(column.tolist() for column in columns), strict=True)

    @property
    def travel_time(self) -> Float:
        """Seconds (m,) that each edge takes at its speed limit."""
        return self.length / self.speed

    @property
    def once(self) -> Bools:
        """Whether (m,) each edge is the first of its street, so that two-way streets count once."""
        first: Bools = (self.twin < 0) | (self.twin > np.arange(len(self)))
        return first

    def take(self, keep: Bools | NDArray[np.integer]) -> RoadGraph:
        """The chosen edges, in the given order, with the nodes they use.

        Restrictions and controls of edges that are left out are left out too.
        """
        chosen = np.arange(len(self))[keep].astype(np.int32)
        used, ends = np.unique(np.concatenate([self.tail[chosen], self.head[chosen]]), return_inverse=True)
        edge = np.full(len(self) + 1, -1, np.int32)
        edge[chosen] = np.arange(len(chosen))
        node = np.full(len(self.node_id), -1, np.int32)
        node[used] = np.arange(len(used))
        per_node = ("node_id", "node_xyz", "signals", "stop", "give_way", "node_island")
        apart = {*per_node, "tail", "head", "twin"}
        columns = {name: getattr(self, name)[used] for name in per_node} | {
            f.name: getattr(self, f.name)[chosen]
            for f in fields(self)
            if f.name not in apart and not f.name.startswith(("turn_", "chain_", "control_"))
        }
        tail, head = ends.astype(np.int32).reshape(2, -1)
        whole = (edge[self.turn_from] >= 0) & (edge[self.turn_to] >= 0)
        there = edge[self.control_edge] >= 0
        unbroken = np.array([bool((edge[chain] >= 0).all()) for chain in self.chain_edges], np.bool_)
        return replace(
            self,
            **columns,
            tail=tail,
            head=head,
            twin=edge[self.twin[chosen]],
            turn_from=edge[self.turn_from[whole]],
            turn_via=node[self.turn_via[whole]],
            turn_to=edge[self.turn_to[whole]],
            turn_kind=self.turn_kind[whole],
            chain_edges=np.fromiter((edge[chain] for chain in self.chain_edges[unbroken]), object),
            chain_kind=self.chain_kind[unbroken],
            control_edge=edge[self.control_edge[there]],
            control_offset=self.control_offset[there],
            control_kind=self.control_kind[there],
        )


@dataclass(frozen=True, slots=True)
class Components:
    """Connected components, numbered by size; 0 has the most nodes.

    weak   : (n,) int32 component of each node, ignoring the direction of one-way streets
    strong : (n,) int32 component of each node within which every node can be reached from every other
    """

    weak: NDArray[np.int32]
    strong: NDArray[np.int32]

    @property
    def largest_strong_share(self) -> float:
        """Share of the nodes that lie in the largest strongly connected component."""
        return float((self.strong == 0).mean()) if len(self.strong) else 0.0


def find_components(graph: RoadGraph) -> Components:
    """The connected components of the graph; turn restrictions are not considered."""
    from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    n = len(graph.node_id)
    links = csr_array((np.ones(len(graph), np.int8), (graph.tail, graph.head)), shape=(n, n))
    parts = [connected_components(links, connection=kind)[1] for kind in ("weak", "strong")]
    return Components(*(_by_size(part) for part in parts))


def _by_size(part: NDArray[np.int32]) -> NDArray[np.int32]:
    """Components renumbered by size, the largest 0; equal ones in the order of their first node."""
    _, first, number, size = np.unique(part, return_index=True, return_inverse=True, return_counts=True)
    order = np.lexsort([first, -size])
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return rank[number]


def main_network(graph: RoadGraph) -> RoadGraph:
    """Largest strongly connected component: any of its streets can be reached from any other."""
    strong = find_components(graph).strong
    return graph.take((strong[graph.tail] == 0) & (strong[graph.head] == 0))
