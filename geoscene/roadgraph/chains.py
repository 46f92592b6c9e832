"""Chains of nodes that become edges: ways cut at junctions and changes, and joined; controls on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import numpy as np

from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.tags import CLASSES, island_radius
from geoscene.sources.data import TaggedNode, Tags, Way
from geoscene.support.problems import Action, Problem
from geoscene.typing import Bools, Float, Ints

# Metres before a node within which a signal or a sign is the node's own.
_REACH = 30.0


@dataclass(frozen=True, slots=True)
class Runs:
    """The ways' nodes in driving order, one row each; a run is an unbroken sequence of nodes of one way.

    node : (k,) int64 node index
    way  : (k,) int64 way index
    run  : (k,) int64 run number, ascending
    """

    node: Ints
    way: Ints
    run: Ints


@dataclass(frozen=True, slots=True)
class RoadChain:
    """A line through nodes that becomes one edge or two; in the direction of its ways if that matters.

    node : (k,) int64 node index
    way  : (k - 1,) int64 way index of each segment
    """

    node: Ints
    way: Ints


class WayAttributes(Protocol):
    """Attributes of a way; equal ones may be joined."""

    @property
    def symmetric(self) -> bool:
        """Whether both directions have the same attributes."""


def chains_of(runs: Runs, kinds: Sequence[WayAttributes], *, nodes: int) -> list[RoadChain]:
    """The runs as chains from junction, dead end or change of kind (ways,) to the next."""
    number = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
    kind = np.array([number[kind] for kind in kinds], np.int64)
    symmetric = np.array([kind.symmetric for kind in kinds], np.bool_)
    return link_chains(runs, find_cuts(runs, kind, symmetric=symmetric, nodes=nodes))


def find_cuts(runs: Runs, kind: Ints, *, symmetric: Bools, nodes: int) -> Bools:
    """Whether a line must end at each node (nodes,): junctions, dead ends, changes.

    kind      : (ways,) equal numbers for ways that may be joined
    symmetric : (ways,) the way has the same attributes in both directions
    """
    first = np.flatnonzero(runs.run[1:] == runs.run[:-1])
    a, b, way = runs.node[first], runs.node[first + 1], runs.way[first]
    at, other = np.concatenate([a, b]), np.concatenate([b, a])
    ways, leaving = np.concatenate([way, way]), np.arange(len(at)) < len(a)
    degree = np.bincount(at, minlength=nodes)
    cut: Bools = degree != 2
    pair = np.argsort(at, kind="stable")
    pair = pair[degree[at[pair]] == 2].reshape(-1, 2)
    one, two = pair.T
    turns_back = other[one] == other[two]
    changes = kind[ways[one]] != kind[ways[two]]
    against = (leaving[one] == leaving[two]) & ~symmetric[ways[one]]
    cut[at[one]] |= turns_back | changes | against
    return cut


def link_chains(runs: Runs, cut: Bools) -> list[RoadChain]:
    """The runs as chains from cut node to cut node; a loop without any starts at its own first node."""
    pieces = _pieces(runs, cut)
    loose: dict[int, list[int]] = {}
    for number, piece in enumerate(pieces):
        for node in (int(piece.node[0]), int(piece.node[-1])):
            if not cut[node]:
                loose.setdefault(node, []).append(number)

    used = [False] * len(pieces)

    def follow(node: int) -> list[RoadChain]:
        """Pieces that follow from a node, each reversed where needed to begin where the previous one ends."""
        found = []
        while not cut[node]:
            following = [number for number in loose[node] if not used[number]]
            if not following:
                break
            used[following[0]] = True
            piece = pieces[following[0]]
            found.append(piece if piece.node[0] == node else _turn(piece))
            node = int(found[-1].node[-1])
        return found

    chains = []
    for number, piece in enumerate(pieces):
        if used[number]:
            continue
        used[number] = True
        ahead = follow(int(piece.node[-1]))
        behind = [_turn(p) for p in reversed(follow(int(piece.node[0])))]
        chains.append(_join([*behind, piece, *ahead]) if ahead or behind else piece)
    return chains


def _pieces(runs: Runs, cut: Bools) -> list[RoadChain]:
    """The runs cut at cut nodes."""
    edge = np.flatnonzero(np.diff(runs.run, prepend=-1, append=-1))
    pieces = []
    for start, end in zip(edge[:-1].tolist(), edge[1:].tolist(), strict=True):
        inner = start + 1 + np.flatnonzero(cut[runs.node[start + 1 : end - 1]])
        stops = [start, *inner.tolist(), end - 1]
        pieces += [RoadChain(runs.node[i : j + 1], runs.way[i:j]) for i, j in pairwise(stops)]
    return pieces


def _turn(piece: RoadChain) -> RoadChain:
    return RoadChain(piece.node[::-1], piece.way[::-1])


def _join(pieces: Sequence[RoadChain]) -> RoadChain:
    nodes = [pieces[0].node, *(piece.node[1:] for piece in pieces[1:])]
    return RoadChain(np.concatenate(nodes), np.concatenate([piece.way for piece in pieces]))


def _islands(graph: RoadGraph, points: Iterable[TaggedNode]) -> Float:
    """Metres (n,) of the radius of the island of a turning loop at each node."""
    loops = {
        int(point.osm_id.removeprefix("node/")): point.tags
        for point in points
        if point.tags.get("highway") == "turning_loop"
    }
    ranks = {name: k for k, name in enumerate(CLASSES)}
    island = np.zeros(len(graph.node_id))
    for k in np.flatnonzero(np.isin(graph.node_id, list(loops))).tolist():
        roads = np.flatnonzero((graph.tail == k) | (graph.head == k)).tolist()
        main = min(roads, key=lambda road: ranks.get(str(graph.highway[road]), len(CLASSES)))
        island[k] = island_radius(loops[int(graph.node_id[k])], float(graph.width[main]))
    return island


def add_controls(
    graph: RoadGraph,
    points: Iterable[TaggedNode],
    *,
    sides: tuple[Ints, Bools],
    lines: tuple[Sequence[RoadChain], Sequence[Way], Ints],
    problems: list[Problem],
) -> RoadGraph:
    """The graph with its traffic controls.

    ``direction`` tags are respected. Without one, signals and crossings control both directions, and a sign
    controls the traffic towards the nearer end of its road (OSM wiki, Key:direction). At a junction, signals
    and ``stop=all`` control every arm, other signs the arms of lesser class, or all if they are equal.
    Where a tagged direction has no traffic, they control that of the one-way streets there (``direction``).

    sides : the chain of each edge (m,) and whether the edge runs against it (m,)
    lines : the chains, the ways they are made of, and the ids of the nodes that they count
    """
    one_each = ~sides[1] | (graph.twin < 0)
    ends = np.concatenate([graph.tail[one_each], graph.head[one_each]])
    arms = np.bincount(ends, minlength=len(graph.node_id))
    arm_metres = np.bincount(ends, np.tile(graph.length[one_each], 2), minlength=len(graph.node_id))
    ranks = {name: CLASSES.index(name.removesuffix("_link")) for name in CLASSES}
    rank = np.array([ranks.get(name, len(CLASSES)) for name in graph.highway.tolist()], np.int64)
    best = np.full(len(graph.node_id), len(CLASSES), np.int64)
    worst = np.zeros(len(graph.node_id), np.int64)
    np.minimum.at(best, ends, np.tile(rank[one_each], 2))
    np.maximum.at(worst, ends, np.tile(rank[one_each], 2))

    flags = {name: np.zeros(len(graph.node_id), np.bool_) for name in ("traffic_signals", "stop", "give_way")}
    rows = []
    unused: dict[tuple[int, str], list[tuple[int, float]]] = {}
    used: set[tuple[int, str]] = set()

    def control(edge: int, offset: float, *, kind: str) -> None:
        rows.append((edge, offset, kind))
        if kind in flags and float(graph.length[edge]) - offset <= _REACH:
            flags[kind][int(graph.head[edge])] = True

    for edge, vertex, with_way, (osm_node, tags) in _controls_on_edges(
        graph, points, sides=sides, lines=lines
    ):
        plan = np.linalg.norm(np.diff(graph.geometry[edge][:, :2], axis=0), axis=1)
        length = float(graph.length[edge])
        offset = length * float(plan[:vertex].sum() / max(plan.sum(), 1e-9))
        node = int(graph.head[edge])
        at_end = vertex == len(plan)
        for kind in _kinds(tags):
            side = _direction(tags, kind)
            if side:
                applies = side == (1 if with_way else -1)
            elif kind not in ("stop", "give_way"):
                applies = True
            elif at_end and arms[node] > 2:
                applies = tags.get("stop") == "all" or bool(
                    rank[edge] > best[node] or best[node] == worst[node]
                )
            else:
                ahead = float(arm_metres[node]) - length if at_end else length - offset
                applies = ahead <= offset
            if applies:
                control(edge, offset, kind=kind)
                used.add((osm_node, kind))
            elif side:
                unused.setdefault((osm_node, kind), []).append((edge, offset))
    for (osm_node, kind), places in sorted(unused.items()):
        if (osm_node, kind) in used:
            continue
        only = [(edge, offset) for edge, offset in places if graph.twin[edge] < 0]
        for edge, offset in only:
            control(edge, offset, kind=kind)
        detail = f"{kind} in a direction without traffic" + ("; taken for the other one" if only else "")
        action: Action = "repaired" if only else "dropped"
        problems.append(Problem(f"node/{osm_node}", "control", action, "direction", detail))
    rows.sort()
    return replace(
        graph,
        signals=flags["traffic_signals"],
        stop=flags["stop"],
        give_way=flags["give_way"],
        node_island=_islands(graph, points),
        control_edge=np.array([row[0] for row in rows], np.int32),
        control_offset=np.array([row[1] for row in rows], float),
        control_kind=np.array([row[2] for row in rows], np.str_),
    )


def _controls_on_edges(
    graph: RoadGraph,
    points: Iterable[TaggedNode],
    *,
    sides: tuple[Ints, Bools],
    lines: tuple[Sequence[RoadChain], Sequence[Way], Ints],
) -> Iterator[tuple[int, int, bool, tuple[int, Tags]]]:
    """Controls on edges: (edge, vertex > 0, whether the edge runs along the way, node's id and tags)."""
    chain_of, against = sides
    chains, ways, node_id = lines
    signed = {int(p.osm_id.removeprefix("node/")): p.tags for p in points if _kinds(p.tags)}
    if not signed or not len(graph):
        return
    has_sign = np.isin(node_id, np.fromiter(signed, np.int64, len(signed)))
    here = [chain for chain, c in enumerate(chains) if has_sign[c.node].any()]
    for edge in np.flatnonzero(np.isin(chain_of, here)).tolist():
        chain = chains[chain_of[edge]]
        node, way = (chain.node[::-1], chain.way[::-1]) if against[edge] else (chain.node, chain.way)
        for vertex in (1 + np.flatnonzero(has_sign[node[1:]])).tolist():
            a, b = node_id[node[vertex - 1]], node_id[node[vertex]]
            nodes = ways[way[vertex - 1]].nodes
            with_way = bool(((nodes[:-1] == a) & (nodes[1:] == b)).any())
            yield edge, vertex, with_way, (int(b), signed[int(b)])


def _kinds(tags: Tags) -> list[str]:
    """Kinds of control at a point; a signalled crossing is also a signal."""
    values = [value.strip() for value in tags.get("highway", "").split(";")]
    if len(values) > 1:
        return list(dict.fromkeys(kind for value in values for kind in _kinds({**tags, "highway": value})))
    kind = values[0]
    if kind not in ("traffic_signals", "stop", "give_way", "mini_roundabout", "crossing"):
        return []
    crossing = tags.get("crossing", "no" if kind != "crossing" else "unknown")
    kinds = [kind] if kind != "crossing" or crossing != "no" else []
    if kind == "traffic_signals" and crossing != "no":
        return [*kinds, "crossing"]
    lit = crossing == "traffic_signals" or tags.get("crossing:signals") == "yes"
    return [*kinds, "traffic_signals"] if kind == "crossing" and lit else kinds


def _direction(tags: Tags, kind: str) -> int:
    """1 for traffic along the way, -1 for traffic against it, 0 if not tagged."""
    value = tags.get(f"{kind}:direction", tags.get("direction", ""))
    return {"forward": 1, "backward": -1}.get(value, 0)
