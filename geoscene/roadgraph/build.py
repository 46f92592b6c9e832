"""The road graph from the ways of a map: choice of ways, junctions, joining of ways into edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from geoscene.geometry.frames import Frame
from geoscene.roadgraph.chains import RoadChain, Runs, chains_of, link_chains
from geoscene.roadgraph.controls import add_controls
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lane_uses import read_lane_uses
from geoscene.roadgraph.restrictions import add_turns
from geoscene.roadgraph.tags import Street, drivable, read_street
from geoscene.sources.data import OsmData, Way
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Ints


@dataclass(frozen=True, slots=True)
class RoadOptions:
    """Contents of the road graph.

    simplify : nodes only where roads join, end or change; else every OSM node becomes a node
    private  : include roads closed to the public, tracks and busways
    """

    simplify: bool = True
    private: bool = False


def build_road_graph(
    osm: OsmData, frame: Frame, *, options: RoadOptions | None = None
) -> tuple[RoadGraph, list[Problem]]:
    """The drivable graph of a map on level ground (z = 0), and the problems repaired or dropped.

    Roads join where they share an OSM node and nowhere else: a bridge does not join the road below. A node of
    the simplified graph is a junction, a dead end, or a place where an attribute of the edges changes
    (class, name, width, lanes, limit, direction, layer, bridge, tunnel); ways of equal tags are joined.
    Nodes are sorted by id, edges follow the order of the ways; the two edges of a two-way street are
    consecutive.
    """
    options = options or RoadOptions()
    problems: list[Problem] = []
    ways = [way for way in osm.ways if drivable(way.tags, private=options.private)]
    streets = _read_streets(ways, problems)
    runs, node_id, lonlat = read_runs(ways, problems)
    if options.simplify:
        chains = chains_of(runs, streets, nodes=len(node_id))
    else:
        chains = link_chains(runs, np.ones(len(node_id), np.bool_))
    graph, sides = _edges(chains, ways, streets=streets, places=(node_id, lonlat), frame=frame)
    graph = add_turns(graph, osm.relations, problems=problems)
    return add_controls(graph, osm.points, sides=sides, lines=(chains, ways, node_id)), problems


def _read_streets(ways: Sequence[Way], problems: list[Problem]) -> list[Street]:
    streets = []
    for way in ways:
        street, unread = read_street(way.tags)
        unread += read_lane_uses(way.tags, street)[1]
        streets.append(street)
        problems += [Problem(way.osm_id, "road", "repaired", "unreadable-tag", text) for text in unread]
    return streets


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

    lines = [xyz[chain.node] for chain in chains]
    geometry = np.empty(len(rows), object)
    for edge, (number, against) in enumerate(rows):
        geometry[edge] = lines[number][::-1].copy() if against else lines[number]
    chain_ids = [[ways[way].osm_id for way, _ in groupby(chain.way.tolist())] for chain in chains]
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
        lanes_source=np.array([s.lanes_source for s, _ in side], np.str_),
        width=np.array([s.width for s, _ in side], float),
        width_source=np.array([s.width_source for s, _ in side], np.str_),
        oneway=np.array([s.direction != 0 for s, _ in side], np.bool_),
        layer=np.array([s.layer for s, _ in side], np.int8),
        layer_source=np.array([s.layer_source for s, _ in side], np.str_),
        bridge=np.array([s.bridge for s, _ in side], np.bool_),
        tunnel=np.array([s.tunnel for s, _ in side], np.bool_),
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
