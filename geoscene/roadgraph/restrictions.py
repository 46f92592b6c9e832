"""Turn restrictions of the map as pairs of edges."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from geoscene.report import Problem
from geoscene.roads import RoadGraph
from geoscene.sources.data import Relation, Tags

# What a restriction may except and then does not bind a car.
_CAR = frozenset({"motorcar", "motor_vehicle", "vehicle"})


def add_turns(graph: RoadGraph, relations: Iterable[Relation], problems: list[Problem]) -> RoadGraph:
    """The graph with the turns that relations forbid or command.

    A restriction via a node is kept. One via ways is dropped and reported: a pair of edges cannot carry it.
    One at a place where the graph has no node, or with members that are not in the map, forbids nothing here.
    """
    node = {int(osm): number for number, osm in enumerate(graph.node_id.tolist())}
    via_nodes = {
        node[member]
        for relation in relations
        if _kind(relation.tags)
        for kind, member, role in relation.members
        if role == "via" and kind == "node" and member in node
    }
    arriving: dict[tuple[int, str], list[int]] = {}
    leaving: dict[tuple[int, str], list[int]] = {}
    for edges, ends, last in ((arriving, graph.head, -1), (leaving, graph.tail, 0)):
        for edge in np.flatnonzero(np.isin(ends, list(via_nodes))).tolist():
            way = str(graph.osm_id[edge]).split(";")[last]
            edges.setdefault((int(ends[edge]), way), []).append(edge)

    found: set[tuple[int, int, int, str]] = set()
    for relation in relations:
        value = _kind(relation.tags)
        if not value:
            continue
        by_role: dict[str, list[tuple[str, int]]] = {}
        for kind, member, role in relation.members:
            by_role.setdefault(role, []).append((kind, member))
        if any(kind == "way" for kind, _ in by_role.get("via", [])):
            problems.append(Problem(relation.osm_id, "turn", "dropped", "via-way", value))
            continue
        for _, via in by_role.get("via", []):
            at = node.get(via, -1)
            for _, way_in in by_role.get("from", []):
                for _, way_out in by_role.get("to", []):
                    for edge in arriving.get((at, f"way/{way_in}"), []):
                        for after in leaving.get((at, f"way/{way_out}"), []):
                            found.add((edge, at, after, value))
    rows = sorted(found)
    return replace(
        graph,
        turn_from=np.array([row[0] for row in rows], np.int32),
        turn_via=np.array([row[1] for row in rows], np.int32),
        turn_to=np.array([row[2] for row in rows], np.int32),
        turn_kind=np.array([row[3] for row in rows], np.str_),
    )


def _kind(tags: Tags) -> str:
    """``no_...`` or ``only_...`` where the relation binds cars at all times, else ""."""
    value = tags.get("restriction:motorcar", tags.get("restriction", ""))
    if not value.startswith(("no_", "only_")) or tags.get("type", "restriction") != "restriction":
        return ""
    return "" if _CAR & set(tags.get("except", "").split(";")) else value
