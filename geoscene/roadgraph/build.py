"""The road graph from the ways of a map: choice of ways, joining of ways into edges, turn restrictions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.chains import RoadChain, Runs, add_controls, chains_of, link_chains
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lanes import lane_column
from geoscene.roadgraph.streets import move_aside, read_streets
from geoscene.roadgraph.tags import Street, find_odd_diameters
from geoscene.roadgraph.walls import Walls
from geoscene.sources.data import OsmData, Relation, Tags, Way
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Ints

# Vehicle classes that include a car, the most specific first: for restrictions and exemptions.
_CAR = ("motorcar", "motor_vehicle", "vehicle")
_KEYS = (*(f"restriction:{kind}" for kind in _CAR), "restriction")
# Older tags for the times of a restriction.
_HOURS = ("hour_on", "day_on")


@dataclass(frozen=True, slots=True)
class RoadOptions:
    """Contents of the road graph.

    simplify : nodes only where roads join, end or change; else every OSM node becomes a node
    private  : include roads closed to the public, tracks and busways
    left_hand : traffic keeps left
    """

    simplify: bool = True
    private: bool = False
    left_hand: bool = False


def build_road_graph(
    osm: OsmData, frame: Frame, *, options: RoadOptions | None = None, walls: Walls | None = None
) -> tuple[RoadGraph, list[Problem]]:
    """The drivable graph of a map on level ground (z = 0), and the problems repaired or dropped.

    Roads join where they share an OSM node and nowhere else: a bridge does not join the road below. A node of
    the simplified graph is a junction, a dead end, or a place where an attribute of the edges changes
    (class, name, width, lanes and their uses, limit, direction, layer, bridge, tunnel); ways of equal tags
    are joined. Nodes are sorted by id, edges follow the order of the ways; the two edges of a two-way street
    are consecutive.

    walls : of buildings that streets of unknown width yield to
    """
    options = options or RoadOptions()
    problems: list[Problem] = []
    problems += find_odd_diameters(osm.points)
    ways, streets, remarks = read_streets(
        osm, frame, private=options.private, left_hand=options.left_hand, walls=walls
    )
    problems += [
        Problem(osm_id, "road", "repaired", reason, detail)
        for osm_id, found in remarks
        for reason, detail in found
    ]
    runs, node_id, lonlat = read_runs(ways, problems)
    if options.simplify:
        chains = chains_of(runs, streets, nodes=len(node_id))
    else:
        chains = link_chains(runs, np.ones(len(node_id), np.bool_))
    graph, sides = _edges(chains, ways, streets=streets, places=(node_id, lonlat), frame=frame)
    graph = add_turns(graph, osm.relations, problems=problems)
    lines = chains, ways, node_id
    return add_controls(graph, osm.points, sides=sides, lines=lines, problems=problems), problems


def read_runs(ways: Sequence[Way], problems: list[Problem]) -> tuple[Runs, Ints, Float]:
    """Unbroken runs of nodes with coordinates; the nodes' ids, ascending; their longitudes and latitudes."""
    if not ways:
        none = np.empty(0, np.int64)
        return Runs(none, none, none), none, np.empty((0, 2))
    ids = np.concatenate([way.nodes for way in ways])
    lonlat = np.concatenate([way.lonlat for way in ways])
    way = np.repeat(np.arange(len(ways)), [len(w.nodes) for w in ways])
    fresh = np.ones(len(ids), np.bool_)
    fresh[1:] = (ids[1:] != ids[:-1]) | (way[1:] != way[:-1])
    placed = np.isfinite(lonlat).all(axis=1)

    ids, lonlat, way, placed = ids[fresh], lonlat[fresh], way[fresh], placed[fresh]
    broken = np.ones(len(ids), np.bool_)
    broken[1:] = (way[1:] != way[:-1]) | ~placed[1:] | ~placed[:-1]
    run = np.cumsum(broken)
    good = placed & (np.bincount(run)[run] > 1)

    for number in np.unique(way[~good]).tolist():
        missing = int((~placed[way == number]).sum())
        left = bool(good[way == number].any())
        problems.append(
            Problem(
                ways[number].osm_id,
                "road",
                "repaired" if left else "dropped",
                "missing-nodes" if missing else "too-short",
                f"{missing} of {len(ways[number].nodes)} nodes have no place"
                if missing
                else "fewer than 2 nodes",
            )
        )
    node_id, where, node = np.unique(ids[good], return_index=True, return_inverse=True)
    return Runs(node, way[good], run[good]), node_id, lonlat[good][where]


def _edges(
    chains: Sequence[RoadChain],
    ways: Sequence[Way],
    *,
    streets: Sequence[Street],
    places: tuple[Ints, Float],
    frame: Frame,
) -> tuple[RoadGraph, tuple[Ints, Bools]]:
    """The graph without turns and controls; each edge's chain (m,); whether the edge runs against it (m,)."""
    node_id, lonlat = places
    x, y = frame.from_geographic(lonlat[:, 0], lonlat[:, 1])
    xyz = np.stack([x, y, np.zeros(len(x))], axis=1)
    ends = np.array([(chain.node[0], chain.node[-1]) for chain in chains], np.int64).reshape(-1, 2)
    used, ends = np.unique(ends, return_inverse=True)
    ends = ends.reshape(-1, 2).astype(np.int32)

    of_chain = [streets[chain.way[0]] for chain in chains]
    rows = [
        (number, backward)
        for number, street in enumerate(of_chain)
        for backward in (False, True)
        if street.direction != (1 if backward else -1)
    ]
    chain_of = np.array([number for number, _ in rows], np.int64)
    backward = np.array([b for _, b in rows], np.bool_)
    two_way = np.bincount(chain_of, minlength=len(chains))[chain_of] == 2
    twin = np.where(two_way, np.arange(len(rows)) + np.where(backward, -1, 1), -1).astype(np.int32)

    lines = move_aside([xyz[chain.node] for chain in chains], chains, ways=ways, streets=streets, frame=frame)
    geometry = np.empty(len(rows), object)
    for edge, (number, against) in enumerate(rows):
        geometry[edge] = lines[number][::-1].copy() if against else lines[number]
    chain_ids = [
        [name for name, _ in groupby(ways[k].osm_id for k in chain.way.tolist())] for chain in chains
    ]
    side = [(of_chain[number], int(against)) for number, against in rows]
    none = np.zeros(len(used), np.bool_)
    graph = RoadGraph(
        node_id=node_id[used],
        node_xyz=xyz[used],
        tail=ends[chain_of, backward.astype(int)],
        head=ends[chain_of, 1 - backward.astype(int)],
        geometry=geometry,
        length=true_lengths(lines, frame)[chain_of],
        speed=np.array([s.speed[k] for s, k in side], float),
        speed_source=np.array([s.speed_source[k] for s, k in side], np.str_),
        lanes=np.array([s.lanes[k] for s, k in side], float),
        contraflow=np.array([s.lanes[1 - k] if s.direction else 0.0 for s, k in side], float),
        lane_kinds=lane_column([s.described[k] for s, k in side], lambda lane: lane.kind, plain="driving"),
        lane_widths=lane_column(
            [s.described[k] for s, k in side], lambda lane: f"{lane.width:g}" if lane.width else ""
        ),
        lane_turns=lane_column([s.described[k] for s, k in side], lambda lane: ";".join(lane.turns)),
        lanes_source=np.array([s.lanes_source for s, _ in side], np.str_),
        width=np.array([s.width for s, _ in side], float),
        width_source=np.array([s.width_source for s, _ in side], np.str_),
        oneway=np.array([s.direction != 0 for s, _ in side], np.bool_),
        layer=np.array([s.layer for s, _ in side], np.int8),
        layer_source=np.array([s.layer_source for s, _ in side], np.str_),
        bridge=np.array([s.bridge for s, _ in side], np.bool_),
        tunnel=np.array([s.tunnel for s, _ in side], np.bool_),
        roundabout=np.array([s.roundabout for s, _ in side], np.bool_),
        highway=np.array([s.highway for s, _ in side], np.str_),
        name=np.array([s.name for s, _ in side], np.str_),
        ref=np.array([s.ref for s, _ in side], np.str_),
        osm_id=np.array(
            [";".join(chain_ids[n][::-1] if against else chain_ids[n]) for n, against in rows], np.str_
        ),
        twin=twin,
        signals=none,
        stop=none,
        give_way=none,
        node_island=np.zeros(len(none)),
    )
    return graph, (chain_of, backward)


def true_lengths(lines: Sequence[Float], frame: Frame) -> Float:
    """True metres in plan (m,) of lines (k, 2 or 3) in the scene frame: grid lengths over the point scale."""
    if not lines:
        return np.empty(0)
    points = np.concatenate([line[:, :2] for line in lines])
    line = np.repeat(np.arange(len(lines)), [len(part) for part in lines])
    inside = line[1:] == line[:-1]
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)[inside]
    middle = (points[1:] + points[:-1])[inside] / 2
    scale = frame.scale_at(middle[:, 0], middle[:, 1])
    return np.bincount(line[1:][inside], step / scale, minlength=len(lines)).astype(float)


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
