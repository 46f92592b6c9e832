"""Turn restrictions as sequences of edges."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geoscene.roadgraph.graph import RoadGraph
from geoscene.sources.data import Relation, Tags
from geoscene.support.problems import Problem

# Vehicle classes that include a car, the most specific first: for restrictions and exemptions.
_CAR = ("motorcar", "motor_vehicle", "vehicle")
_KEYS = (*(f"restriction:{kind}" for kind in _CAR), "restriction")
# Older tags for the times of a restriction.
_HOURS = ("hour_on", "day_on")


def add_turns(graph: RoadGraph, relations: Iterable[Relation], *, problems: list[Problem]) -> RoadGraph:
    """The graph with the turns that relations prohibit or prescribe for cars.

    A restriction via a node is a pair of edges, one via ways a chain of three or more. One at a place where
    the graph has no node, or with members that are not in the graph, has no effect. Conditional ones are
    dropped and reported (``conditional``), as are those via ways that no drive can follow (``via-way``).
    """
    streets = _Streets.of(graph)
    pairs: set[tuple[int, int, int, str]] = set()
    chains: set[tuple[tuple[int, ...], str]] = set()
    for relation in relations:
        value, at_times = _kind(relation.tags)
        if at_times:
            problems.append(Problem(relation.osm_id, "turn", "dropped", "conditional", at_times))
        if not value:
            continue
        members: dict[str, list[str]] = defaultdict(list)
        for kind, member, role in relation.members:
            members[role].append(f"{kind}/{member}")
        via = {name for name in members["via"] if name.startswith("way/")}
        if via:
            trips = _trips(streets, members["from"], via=via, targets=members["to"])
            if not trips and streets.have(members["from"], members["to"]) and via <= streets.of_way.keys():
                problems.append(Problem(relation.osm_id, "turn", "dropped", "via-way", value))
        else:
            trips = list(_turns(streets, members["from"], via=members["via"], targets=members["to"]))
        for trip in trips:
            if len(trip) == 2:
                pairs.add((trip[0], int(graph.head[trip[0]]), trip[1], value))
            else:
                chains.add((trip, value))
    rows = sorted(pairs)
    long = sorted(chains)
    return replace(
        graph,
        turn_from=np.array([row[0] for row in rows], np.int32),
        turn_via=np.array([row[1] for row in rows], np.int32),
        turn_to=np.array([row[2] for row in rows], np.int32),
        turn_kind=np.array([row[3] for row in rows], np.str_),
        chain_edges=np.fromiter((np.array(trip, np.int32) for trip, _ in long), object),
        chain_kind=np.array([value for _, value in long], np.str_),
    )


@dataclass(frozen=True, slots=True)
class _Streets:
    """The graph indexed by the ids that restrictions refer to.

    ways    : for each edge the ways it was joined from, in driving direction
    of_way  : the edges of each way
    leaving : the edges that leave each node
    node    : the graph's node of each OSM node
    """

    graph: RoadGraph
    ways: Sequence[tuple[str, ...]]
    of_way: Mapping[str, list[int]]
    leaving: Mapping[int, list[int]]
    node: Mapping[str, int]

    @classmethod
    def of(cls, graph: RoadGraph) -> _Streets:
        ways = [tuple(text.split(";")) for text in graph.osm_id.tolist()]
        of_way: dict[str, list[int]] = {}
        leaving: dict[int, list[int]] = {}
        for edge, (names, tail) in enumerate(zip(ways, graph.tail.tolist(), strict=True)):
            for name in dict.fromkeys(names):
                of_way.setdefault(name, []).append(edge)
            leaving.setdefault(tail, []).append(edge)
        node = {f"node/{osm}": number for number, osm in enumerate(graph.node_id.tolist())}
        return cls(graph, ways, of_way, leaving, node)

    def have(self, *members: Sequence[str]) -> bool:
        return all(any(name in self.of_way for name in names) for names in members)


def _turns(
    streets: _Streets, sources: Sequence[str], *, via: Sequence[str], targets: Sequence[str]
) -> Iterator[tuple[int, ...]]:
    """Pairs of edges that turn at a node from one of the ways into another."""
    graph, ways = streets.graph, streets.ways
    for at in (streets.node[name] for name in via if name in streets.node):
        for source in sources:
            for edge in streets.of_way.get(source, []):
                if graph.head[edge] == at and ways[edge][-1] == source:
                    for after in streets.leaving.get(at, []):
                        if ways[after][0] in targets:
                            yield edge, after


def _trips(
    streets: _Streets, sources: Sequence[str], *, via: set[str], targets: Sequence[str]
) -> list[tuple[int, ...]]:
    """Chains of edges from one of the ways over all those of ``via`` into another.

    They pass no node twice; of several between the same two edges only the shortest is returned. Where ways
    were joined, the first edge may include the start of the via way, and the last edge its end.
    """
    graph, ways = streets.graph, streets.ways
    best: dict[tuple[int, int], tuple[float, tuple[int, ...]]] = {}
    unfinished: list[tuple[tuple[int, ...], set[str], float]] = []
    for source in sources:
        for edge in streets.of_way.get(source, []):
            rest = set(ways[edge][len(ways[edge]) - ways[edge][::-1].index(source) :])
            if rest <= via:
                unfinished.append(((edge,), rest, 0.0))
    while unfinished:
        trip, used, metres = unfinished.pop()
        last = trip[-1]
        passed = {int(graph.head[edge]) for edge in trip}
        for edge in streets.leaving.get(int(graph.head[last]), []):
            names = ways[edge]
            if edge == graph.twin[last]:
                continue
            ends = [k for k, name in enumerate(names) if name in targets]
            if ends and set(names[: ends[0]]) <= via and used | set(names[: ends[0]]) == via:
                key = (trip[0], edge)
                best[key] = min(best.get(key, (np.inf, ())), (metres, (*trip, edge)))
            if set(names) <= via and int(graph.head[edge]) not in passed:
                unfinished.append(((*trip, edge), used | set(names), metres + float(graph.length[edge])))
    return [trip for _, trip in best.values()]


def _kind(tags: Tags) -> tuple[str, str]:
    """``no_...`` or ``only_...`` where the relation always applies to cars, and the conditional value if any.

    The most specific of ``restriction:motorcar`` ... ``restriction`` counts; those for other vehicles
    (``restriction:hgv``) do not. ``except`` exempts from the plain tag.
    """
    kind = tags.get("type", "restriction")
    if kind != "restriction" and kind not in _KEYS:
        return "", ""
    exempt = {name.strip() for name in tags.get("except", "").split(";")}
    if not exempt.isdisjoint(_CAR):
        return "", ""
    key = next((key for key in _KEYS if key in tags), "")
    value = tags.get(key, "").strip()
    value = value if value.startswith(("no_", "only_")) else ""
    if value and any(hours in tags for hours in _HOURS):
        return "", f"{value} at hours or on days"
    at_times = next((tags[f"{key}:conditional"] for key in _KEYS if f"{key}:conditional" in tags), "")
    return value, at_times
