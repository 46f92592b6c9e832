"""Parts of a road graph: within the extent of a scene, and without what is closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.typing import Float

_INSET = 0.01
"""Metres inside the extent at which roads are cut, so that rounding leaves their ends on the ground."""

_LEAST = 0.5
"""Metres of an edge, at least."""

Stretches = dict[int, list[tuple[float, float]]]
"""Metres along streets, from and to, by the first of a street's two edges."""


@dataclass(frozen=True, slots=True)
class _Piece:
    """A part of an edge: stations of its ends in metres, and whether they are those of the edge."""

    edge: int
    start: float
    end: float
    whole_start: bool
    whole_end: bool

    def turned(self, edge: int, length: float) -> _Piece:
        """The same part of the edge in the other direction."""
        return _Piece(edge, length - self.end, length - self.start, self.whole_end, self.whole_start)


def clip_graph(graph: RoadGraph, extent: Sequence[float]) -> RoadGraph:
    """The graph cut at an extent (xmin, ymin, xmax, ymax) in scene metres, beyond which there is no ground.

    Where it cuts an edge there is a new node, whose id is negative and less than those of the map. Turns and
    controls of parts that are left out are left out, too.
    """
    low, high = np.array(extent[:2]) + _INSET, np.array(extent[2:]) - _INSET
    beyond = [
        edge
        for edge, line in enumerate(graph.geometry)
        if graph.once[edge] and ((line[:, :2] < low) | (line[:, :2] > high)).any()
    ]
    return _cut(graph, {edge: _within(graph.geometry[edge], low=low, high=high) for edge in beyond})


def leave_out(graph: RoadGraph, closed: Stretches) -> RoadGraph:
    """The graph without stretches of streets; cut ends, turns and controls are as in `clip_graph`."""
    kept = {}
    for edge, found in closed.items():
        stretches: list[tuple[float, float]] = []
        for start, end in sorted(found):
            if stretches and start <= stretches[-1][1]:
                stretches[-1] = stretches[-1][0], max(end, stretches[-1][1])
            else:
                stretches.append((start, end))
        bounds = [
            0.0,
            *(at for stretch in stretches for at in stretch),
            polylines.length(graph.geometry[edge]),
        ]
        kept[edge] = list(zip(bounds[::2], bounds[1::2], strict=True))
    return _cut(graph, kept)


def _cut(graph: RoadGraph, kept: Mapping[int, Sequence[tuple[float, float]]]) -> RoadGraph:
    """The graph with only stretches of some streets, by the first of their two edges: metres along it."""
    if not kept:
        return graph
    pieces: list[_Piece] = []
    twin_of: dict[int, int] = {}
    for edge in np.flatnonzero(graph.once).tolist():
        twin, length = int(graph.twin[edge]), polylines.length(graph.geometry[edge])
        for start, end in kept.get(edge, [(0.0, length)]):
            if edge in kept and end - start <= _LEAST:
                continue
            piece = _Piece(edge, start, end, start < 1e-6, end > length - 1e-6)
            pieces.append(piece)
            if twin >= 0:
                twin_of |= {len(pieces) - 1: len(pieces), len(pieces): len(pieces) - 1}
                pieces.append(piece.turned(twin, length))
    return _assemble(graph, pieces, twin_of=twin_of)


def _within(line: Float, *, low: Float, high: Float) -> list[tuple[float, float]]:
    """The stretches of a line within a box, as metres along it."""
    line = line[:, :2]
    step, along = np.diff(line, axis=0), polylines.stations(line)
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (low - line[:-1]) / step, (high - line[:-1]) / step
    flat = step == 0.0
    outside = flat & ((line[:-1] < low) | (line[:-1] > high))
    first = np.where(flat, np.where(outside, 2.0, 0.0), np.minimum(near, far)).max(axis=1).clip(min=0.0)
    last = np.where(flat, np.where(outside, -1.0, 1.0), np.maximum(near, far)).min(axis=1).clip(max=1.0)
    runs: list[list[float]] = []
    for k in np.flatnonzero(last > first).tolist():
        run = float(along[k + 1] - along[k])
        begin, end = along[k] + first[k] * run, along[k] + last[k] * run
        if runs and begin - runs[-1][1] < 1e-6:
            runs[-1][1] = end
        else:
            runs.append([begin, end])
    return [(begin, end) for begin, end in runs]


def _assemble(graph: RoadGraph, pieces: Sequence[_Piece], *, twin_of: dict[int, int]) -> RoadGraph:
    """The graph of pieces of edges."""
    rows = np.array([piece.edge for piece in pieces], np.int64)
    geometry, length = np.empty(len(pieces), object), np.empty(len(pieces))
    tail, head = graph.tail[rows].copy(), graph.head[rows].copy()
    xyz: list[Float] = []
    number: dict[tuple[float, ...], int] = {}

    def node_at(place: Float) -> int:
        key = tuple(place.tolist())
        if key not in number:
            number[key] = len(graph.node_id) + len(xyz)
            xyz.append(place)
        return number[key]

    for k, piece in enumerate(pieces):
        line = graph.geometry[piece.edge]
        twin = twin_of.get(k, k)
        if twin < k:
            geometry[k], length[k] = geometry[twin][::-1].copy(), length[twin]
            tail[k], head[k] = head[twin], tail[twin]
            continue
        whole = polylines.length(line)
        cut = not (piece.whole_start and piece.whole_end)
        geometry[k] = polylines.cut(line, piece.start, end=piece.end, gap=1e-6) if cut else line
        length[k] = graph.length[piece.edge] * (polylines.length(geometry[k]) / whole if cut else 1.0)
        if not piece.whole_start:
            tail[k] = node_at(geometry[k][0])
        if not piece.whole_end:
            head[k] = node_at(geometry[k][-1])
    first = min(int(graph.node_id.min(initial=0)), 0) - 1
    added = len(xyz)
    none = np.zeros(added, np.bool_)
    columns: dict[str, Any] = {
        f.name: getattr(graph, f.name)[rows]
        for f in fields(graph)
        if not f.name.startswith(("node_", "turn_", "chain_", "control_"))
        and f.name not in ("signals", "stop", "give_way")
    }
    columns |= {name: np.append(getattr(graph, name), none) for name in ("signals", "stop", "give_way")}
    columns |= {
        "node_id": np.append(graph.node_id, first - np.arange(added)),
        "node_island": np.append(graph.node_island, np.zeros(added)),
        "node_xyz": np.concatenate([graph.node_xyz, *(place[None] for place in xyz)]),
        "tail": tail,
        "head": head,
        "geometry": geometry,
        "length": length,
        "twin": np.array([twin_of.get(k, -1) for k in range(len(pieces))], np.int32),
    }
    made = replace(graph, **columns, **_relations(graph, pieces))
    return made.take(np.ones(len(made), np.bool_))  # without nodes that no edge has


def _relations(graph: RoadGraph, pieces: Sequence[_Piece]) -> dict[str, Any]:
    """Turns and controls of the graph of pieces."""
    starts = {piece.edge: k for k, piece in enumerate(pieces) if piece.whole_start}
    ends = {piece.edge: k for k, piece in enumerate(pieces) if piece.whole_end}
    whole = {edge: k for edge, k in starts.items() if ends.get(edge) == k}
    turns = [
        k
        for k in range(len(graph.turn_from))
        if int(graph.turn_from[k]) in ends and int(graph.turn_to[k]) in starts
    ]
    chains = [
        k
        for k, chain in enumerate(graph.chain_edges)
        if int(chain[0]) in ends and int(chain[-1]) in starts and all(int(e) in whole for e in chain[1:-1])
    ]
    controls = []
    of_edge: dict[int, list[int]] = {}
    for k, piece in enumerate(pieces):
        of_edge.setdefault(piece.edge, []).append(k)
    for edge, offset, kind in graph.controls:
        scale = float(graph.length[edge]) / max(polylines.length(graph.geometry[edge]), 1e-9)
        for k in of_edge.get(edge, []):
            start, end = pieces[k].start * scale, pieces[k].end * scale
            if start - 1e-6 <= offset <= end + 1e-6:
                controls.append((k, max(offset - start, 0.0), kind))
                break
    chained = [
        np.array([ends[int(c[0])], *(whole[int(e)] for e in c[1:-1]), starts[int(c[-1])]], np.int32)
        for c in graph.chain_edges[chains]
    ]
    return {
        "turn_from": np.array([ends[int(graph.turn_from[k])] for k in turns], np.int32),
        "turn_via": graph.turn_via[turns],
        "turn_to": np.array([starts[int(graph.turn_to[k])] for k in turns], np.int32),
        "turn_kind": graph.turn_kind[turns],
        "chain_edges": np.fromiter(chained, object),
        "chain_kind": graph.chain_kind[chains],
        "control_edge": np.array([row[0] for row in controls], np.int32),
        "control_offset": np.array([row[1] for row in controls], float),
        "control_kind": np.array([row[2] for row in controls], np.str_),
    }
