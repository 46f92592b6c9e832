"""The road graph as GraphML that osmnx and networkx open."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import chain, pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET
from xml.sax.saxutils import escape

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import BUILD_AGAIN, SceneFormatError, reading
from geoscene.geometry.frames import Frame
from geoscene.roadgraph.graph import RoadGraph
from geoscene.support.columns import row_blocks
from geoscene.support.files import write_atomically

_XMLNS = "http://graphml.graphdrawing.org/xmlns"
_FLAGS = {"signals": "traffic_signals", "stop": "stop", "give_way": "give_way"}
_WKT_BLOCK = 256  # lines that are read at once: GEOS needs 20 kB for each meanwhile
_UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_UNSAFE = re.compile(f"[&<>]|{_UNPRINTABLE.pattern}")


def write_graphml(graph: RoadGraph, frame: Frame, *, path: Path) -> None:
    """Write the graph as GraphML, with longitude and latitude to 1e-10 degrees (0.01 mm).

    Keys and values are those of ``osmnx.save_graphml``: all text; ``x`` and ``y`` are degrees, ``length``
    metres, ``lanes`` those of both directions, ``geometry`` WKT in degrees. Where the graph has heights,
    nodes have ``elevation`` and lines are ``LINESTRING Z``, scene metres. Added keys: ``*_source``;
    ``lanes_ahead`` (this direction), ``contraflow`` (for buses against a one-way street), ``lane_kinds``,
    ``lane_widths`` and ``lane_turns`` (of each lane, as in `RoadGraph`), ``edge`` (its number), ``twin`` (the
    number of the other direction), ``turns`` (``no_left_turn 17`` names a restriction and the edge turned
    into, ``no_u_turn 12 17`` one via other edges and these first) and ``controls`` (``12.5 stop``: metres
    from the tail), and of nodes ``island`` (metres of the radius of that of a turning loop).
    """
    write_atomically(path, "\n".join(_document(graph, frame)).encode())


def _document(graph: RoadGraph, frame: Frame) -> Iterator[str]:
    tall = bool(np.any(graph.node_xyz[:, 2])) or any(bool(line[:, 2].any()) for line in graph.geometry)
    header = {"crs": "EPSG:4326", "simplified": "True", "created_with": "geoscene"}
    node_keys, nodes = _with_keys(_node_rows(graph, frame, tall=tall))
    edge_keys, edges = _with_keys(_edge_rows(graph, frame, tall=tall))
    keys: dict[tuple[str, str], str] = {}
    yield "<?xml version='1.0' encoding='utf-8'?>"
    yield f'<graphml xmlns="{_XMLNS}">'
    for domain, names in (("graph", list(header)), ("node", node_keys), ("edge", edge_keys)):
        for name in names:
            keys[domain, name] = f"d{len(keys)}"
            yield f'<key id="{keys[domain, name]}" for="{domain}" attr.name="{name}" attr.type="string"/>'
    yield '<graph edgedefault="directed">'
    yield _data("graph", header, keys=keys)
    for node, row in zip(graph.node_id.tolist(), nodes, strict=True):
        yield f'<node id="{node}">{_data("node", row, keys=keys)}</node>'
    copies: Counter[tuple[int, int]] = Counter()
    ends = np.stack([graph.node_id[graph.tail], graph.node_id[graph.head]], axis=1)
    for (tail, head), row in zip(ends.tolist(), edges, strict=True):
        start = f'<edge source="{tail}" target="{head}" id="{copies[tail, head]}">'
        yield f"{start}{_data('edge', row, keys=keys)}</edge>"
        copies[tail, head] += 1
    yield "</graph></graphml>\n"


def _with_keys(rows: Iterator[dict[str, str]]) -> tuple[list[str], Iterator[dict[str, str]]]:
    """The keys of rows, and the rows."""
    first = next(rows, None)
    return ([], rows) if first is None else (list(first), chain([first], rows))


def _data(domain: str, row: Mapping[str, str], *, keys: Mapping[tuple[str, str], str]) -> str:
    return "".join(
        f'<data key="{keys[domain, name]}">{_text(value)}</data>' for name, value in row.items() if value
    )


def _text(value: str) -> str:
    """A value as text of an element; most have nothing to escape."""
    return escape(_UNPRINTABLE.sub("", value)) if _UNSAFE.search(value) else value


def _node_rows(graph: RoadGraph, frame: Frame, *, tall: bool) -> Iterator[dict[str, str]]:
    lon, lat = frame.to_geographic(graph.node_xyz[:, 0], graph.node_xyz[:, 1])
    ends = np.concatenate([graph.tail[graph.once], graph.head[graph.once]])
    streets = np.bincount(ends, minlength=len(graph.node_id))
    for k in range(len(graph.node_id)):
        at_node = [tag for name, tag in _FLAGS.items() if getattr(graph, name)[k]]
        yield {
            "x": f"{lon[k]:.10f}",
            "y": f"{lat[k]:.10f}",
            "elevation": f"{graph.node_xyz[k, 2]:.4f}" if tall else "",
            "street_count": str(streets[k]),
            "highway": at_node[0] if at_node else "",
            "controls": ";".join(at_node),
            "island": f"{graph.node_island[k]:.2f}" if graph.node_island[k] else "",
        }


def _edge_rows(graph: RoadGraph, frame: Frame, *, tall: bool) -> Iterator[dict[str, str]]:
    turns, controls = _lists(graph)
    both = graph.lanes + np.where(graph.twin >= 0, graph.lanes[graph.twin], graph.contraflow)
    seconds = graph.travel_time
    for k, wkt in enumerate(_wkt(graph, frame, tall=tall)):
        ways = [part.removeprefix("way/") for part in str(graph.osm_id[k]).split(";")]
        yield {
            "osmid": ways[0] if len(ways) == 1 else f"[{', '.join(ways)}]",
            "highway": str(graph.highway[k]),
            "name": str(graph.name[k]),
            "ref": str(graph.ref[k]),
            "oneway": str(bool(graph.oneway[k])),
            "reversed": str(bool(0 <= graph.twin[k] < k)),
            "length": f"{graph.length[k]:.6f}",
            "maxspeed": f"{graph.speed[k] * 3.6:.6g}",
            "speed_kph": repr(float(graph.speed[k] * 3.6)),
            "speed_source": str(graph.speed_source[k]),
            "travel_time": f"{seconds[k]:.6f}",
            "lanes": f"{both[k]:g}",
            "lanes_ahead": f"{graph.lanes[k]:g}",
            "contraflow": f"{graph.contraflow[k]:g}" if graph.contraflow[k] else "",
            "lanes_source": str(graph.lanes_source[k]),
            "lane_kinds": str(graph.lane_kinds[k]),
            "lane_widths": str(graph.lane_widths[k]),
            "lane_turns": str(graph.lane_turns[k]),
            "width": f"{graph.width[k]:.6g}",
            "width_source": str(graph.width_source[k]),
            "layer": str(graph.layer[k]),
            "layer_source": str(graph.layer_source[k]),
            "bridge": "yes" if graph.bridge[k] else "",
            "tunnel": "yes" if graph.tunnel[k] else "",
            "junction": "roundabout" if graph.roundabout[k] else "",
            "edge": str(k),
            "twin": str(graph.twin[k]) if graph.twin[k] >= 0 else "",
            "turns": ";".join(turns.get(k, [])),
            "controls": ";".join(controls.get(k, [])),
            "geometry": wkt,
        }


def _lists(graph: RoadGraph) -> tuple[dict[int, list[str]], dict[int, list[str]]]:
    turns: dict[int, list[str]] = {}
    for edge, after, kind in zip(
        graph.turn_from.tolist(), graph.turn_to.tolist(), graph.turn_kind.tolist(), strict=True
    ):
        turns.setdefault(edge, []).append(f"{kind} {after}")
    for passed, kind in zip(graph.chain_edges, graph.chain_kind.tolist(), strict=True):
        edge, *others = passed.tolist()
        turns.setdefault(edge, []).append(" ".join([kind, *map(str, others)]))
    controls: dict[int, list[str]] = {}
    for edge, offset, kind in graph.controls:
        controls.setdefault(edge, []).append(f"{offset:.4f} {kind}")
    return turns, controls


def _wkt(graph: RoadGraph, frame: Frame, *, tall: bool) -> Iterator[str]:
    if not len(graph):
        return
    points = np.concatenate(list(graph.geometry))
    lon, lat = frame.to_geographic(points[:, 0], points[:, 1])
    if tall:
        texts = [f"{x:.10f} {y:.10f} {z:.4f}" for x, y, z in zip(lon, lat, points[:, 2], strict=True)]
    else:
        texts = [f"{x:.10f} {y:.10f}" for x, y in zip(lon, lat, strict=True)]
    stops = np.cumsum([0, *(len(line) for line in graph.geometry)]).tolist()
    for start, stop in pairwise(stops):
        yield f"LINESTRING {'Z ' if tall else ''}({', '.join(texts[start:stop])})"


def read_graphml(path: Path, frame: Frame) -> RoadGraph:
    """The graph that `write_graphml` wrote, with coordinates within 0.1 mm.

    Raises SceneFormatError if the file is missing, damaged or not written by `write_graphml`.
    """
    with reading(path, SceneFormatError, remedy=BUILD_AGAIN):
        nodes, edges = _parse(path)
        return _graph(nodes, edges, frame=frame)


_Row = dict[str, str]


def _parse(path: Path) -> tuple[dict[int, _Row], list[tuple[int, int, _Row]]]:
    """Attributes of the nodes by id and of the edges in the order of their numbers."""
    keys: dict[str, str] = {}
    nodes: dict[int, _Row] = {}
    edges: list[tuple[int, int, _Row]] = []
    for _, element in ET.iterparse(path):  # noqa: S314  (expat bounds what entities expand to)
        tag = element.tag.rpartition("}")[2]
        if tag == "key":
            keys[element.attrib["id"]] = element.attrib["attr.name"]
        elif tag in ("node", "edge"):
            row = {keys[data.attrib["key"]]: data.text or "" for data in element}
            if tag == "node":
                nodes[int(element.attrib["id"])] = row
            else:
                edges.append((int(element.attrib["source"]), int(element.attrib["target"]), row))
            element.clear()
    edges.sort(key=lambda edge: int(edge[2]["edge"]))
    return nodes, edges


def _graph(nodes: dict[int, _Row], edges: list[tuple[int, int, _Row]], *, frame: Frame) -> RoadGraph:
    node_id = np.array(list(nodes), np.int64)
    number = {osm: k for k, osm in enumerate(nodes)}
    row_of = {int(row["edge"]): k for k, (_, _, row) in enumerate(edges)}
    rows = [row for _, _, row in edges]

    def column(name: str, kind: Callable[[str], Any], *, dtype: Any) -> NDArray[Any]:
        return np.array([kind(row.get(name, "")) for row in rows], dtype)

    places = np.array([[float(n["x"]), float(n["y"])] for n in nodes.values()]).reshape(-1, 2)
    x, y = frame.from_geographic(places[:, 0], places[:, 1])
    z = np.array([float(n.get("elevation", 0.0)) for n in nodes.values()])
    at_nodes = [node.get("controls", "").split(";") for node in nodes.values()]
    flags = {name: np.array([tag in tags for tags in at_nodes], np.bool_) for name, tag in _FLAGS.items()}
    listed = [
        (k, kind, [row_of.get(int(edge), -1) for edge in others])
        for k, row in enumerate(rows)
        for kind, *others in map(str.split, filter(None, row.get("turns", "").split(";")))
    ]
    whole = [turn for turn in listed if min(turn[2]) >= 0]
    turns = [(k, number[edges[k][1]], after[0], kind) for k, kind, after in whole if len(after) == 1]
    chains = [(np.array([k, *after], np.int32), kind) for k, kind, after in whole if len(after) > 1]
    controls = [
        (k, *control.split())
        for k, row in enumerate(rows)
        for control in filter(None, row.get("controls", "").split(";"))
    ]
    return RoadGraph(
        node_id=node_id,
        node_xyz=np.stack([x, y, z], axis=1),
        tail=np.array([number[tail] for tail, _, _ in edges], np.int32),
        head=np.array([number[head] for _, head, _ in edges], np.int32),
        geometry=_lines(rows, frame),
        length=column("length", float, dtype=float),
        speed=column("speed_kph", float, dtype=float) / 3.6,
        speed_source=column("speed_source", str, dtype=np.str_),
        lanes=column("lanes_ahead", float, dtype=float),
        contraflow=column("contraflow", lambda text: float(text or 0), dtype=float),
        lanes_source=column("lanes_source", str, dtype=np.str_),
        lane_kinds=column("lane_kinds", str, dtype=np.str_),
        lane_widths=column("lane_widths", str, dtype=np.str_),
        lane_turns=column("lane_turns", str, dtype=np.str_),
        width=column("width", float, dtype=float),
        width_source=column("width_source", str, dtype=np.str_),
        oneway=column("oneway", "True".__eq__, dtype=np.bool_),
        layer=column("layer", int, dtype=np.int8),
        layer_source=column("layer_source", str, dtype=np.str_),
        bridge=column("bridge", "yes".__eq__, dtype=np.bool_),
        tunnel=column("tunnel", "yes".__eq__, dtype=np.bool_),
        roundabout=column("junction", "roundabout".__eq__, dtype=np.bool_),
        highway=column("highway", str, dtype=np.str_),
        name=column("name", str, dtype=np.str_),
        ref=column("ref", str, dtype=np.str_),
        osm_id=column("osmid", _way_ids, dtype=np.str_),
        twin=column("twin", lambda text: row_of.get(int(text), -1) if text else -1, dtype=np.int32),
        **flags,
        node_island=np.array([float(node.get("island") or 0) for node in nodes.values()]),
        turn_from=np.array([turn[0] for turn in turns], np.int32),
        turn_via=np.array([turn[1] for turn in turns], np.int32),
        turn_to=np.array([turn[2] for turn in turns], np.int32),
        turn_kind=np.array([turn[3] for turn in turns], np.str_),
        chain_edges=np.fromiter((chain for chain, _ in chains), object),
        chain_kind=np.array([kind for _, kind in chains], np.str_),
        control_edge=np.array([control[0] for control in controls], np.int32),
        control_offset=np.array([control[1] for control in controls], float),
        control_kind=np.array([control[2] for control in controls], np.str_),
    )


def _way_ids(osmid: str) -> str:
    return ";".join(f"way/{int(part)}" for part in osmid.strip("[]").split(","))


def _lines(rows: list[_Row], frame: Frame) -> NDArray[np.object_]:
    if not rows:
        return np.empty(0, object)
    texts = [row["geometry"] for row in rows]
    shapes = np.concatenate([shapely.from_wkt(texts[block]) for block in row_blocks(len(texts), _WKT_BLOCK)])
    points, index = shapely.get_coordinates(shapes, include_z=True, return_index=True)
    x, y = frame.from_geographic(points[:, 0], points[:, 1])
    xyz = np.stack([x, y, np.nan_to_num(points[:, 2])], axis=1)
    return np.fromiter(np.split(xyz, np.flatnonzero(np.diff(index)) + 1), object)
