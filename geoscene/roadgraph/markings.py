"""Road markings: centre lines, lane lines, edge lines and stop lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.roadgraph.carriageways import MINOR, PAVED, Carriageways
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.junctions import junction_reach
from geoscene.roadgraph.lanes import LaneLayout, graph_lanes, street_lanes
from geoscene.roadgraph.routing import edge_lines
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.support.columns import Columns, nth
from geoscene.typing import Bools, Float, Ints

PRIORITY = 170.0

# Metres. Widths of lines 0.10 to 0.15, 0.25 beside lanes for buses (Vienna Convention, annex 2; MUTCD 3A.04:
# 4 to 6 inches; RMS: 0.25); broken lane lines 3 m on, 6 m off (RMS: 1:2; MUTCD 3A.04: 1:3), those of cycle
# lanes that cars may use 1 m on, 1 m off (RMS); stop lines 0.3 to 0.6 wide (MUTCD 3B.19).
_LINE, _WIDE = 0.12, 0.25
_DASH, _GAP = 3.0, 6.0
_SHORT = 1.0
_STOP = 0.4
_EDGE_IN = 0.25
# Paint ends this far (metres) before the rounding of a junction, where the stop line lies.
_CLEAR = 1.0
# A crossing that begins up to this far before a signal or sign belongs to it, metres.
_STRIP_BEFORE = 12.0
_EDGED = frozenset({"motorway", "trunk", "primary", "secondary"})

_YIELDING = ("give_way", "mini_roundabout")
"""Controls with a broken line."""

_SOLID, _BROKEN, _BUS, _ADVISORY = range(4)
_STYLES = ((_LINE, 0.0, 0.0), (_LINE, _DASH, _GAP), (_WIDE, 0.0, 0.0), (_LINE, _SHORT, _SHORT))
"""Lines by style: width, length of dashes (0 for solid ones) and of gaps."""


@dataclass(frozen=True, slots=True)
class PaintedStretches(Columns):
    """The stretches of painted carriageways between junctions of streets, not interrupted at driveways.

    row    : (p,) int64 rows of the carriageways
    line   : (p,) shapely LineString, from the end of one junction's rounding to the start of the next
    ends   : (p, 2) bool, whether the line starts and ends at a junction
    layout : lanes along the line, and those against it as the others
    """

    row: Ints
    line: NDArray[np.object_]
    ends: Bools
    layout: LaneLayout

    def take(self, rows: ArrayLike | slice) -> PaintedStretches:
        """Subset of the rows."""
        taken = Columns.take(self, rows)
        return replace(taken, layout=self.layout.take(rows))


def painted_stretches(roads: Carriageways, *, left_hand: bool) -> PaintedStretches:
    """The stretches of the carriageways that have any paint along them; ``left_hand``: traffic keeps left."""
    keep = np.array([s.highway not in MINOR for s in roads.street], np.bool_)
    streets, of = roads.take(keep), np.flatnonzero(keep)
    reach, _ = junction_reach(streets)
    junction = reach > 0
    reach = np.where(junction, reach + _CLEAR, 0.0)
    used = np.array([bool(uses) for uses in streets.uses], np.bool_)
    rows = np.flatnonzero(
        (streets.marked | used) & (shapely.length(streets.line) - reach.sum(axis=1) > _DASH)
    )
    lines = np.empty(len(rows), object)
    for k, row in enumerate(rows.tolist()):
        xy = shapely.get_coordinates(streets.line[row])
        length = float(shapely.length(streets.line[row]))
        lines[k] = shapely.linestrings(polylines.cut(xy, reach[row, 0], end=length - reach[row, 1]))
    chosen = [streets.street[row] for row in rows.tolist()]
    layout = street_lanes(chosen, streets.width[rows], left_hand=left_hand)
    return PaintedStretches(of[rows], lines, junction[rows], layout)


def marking_rows(
    roads: Carriageways, stretches: PaintedStretches, *, edge: NDArray[np.int32], left_hand: bool
) -> SurfaceRows:
    """Lines along marked carriageways.

    Between the two directions the line is solid, between lanes of one direction broken; roads of the upper
    classes have edge lines where they have no kerb. Lanes for buses have wide solid lines, cycle lanes thin
    ones.
    """
    which, aside, style, kind = _offsets(roads, stretches, left_hand=left_hand)
    parallel = stretches.line[which]
    moved = aside != 0
    parallel[moved] = shapely.offset_curve(parallel[moved], aside[moved], join_style="mitre")
    parts, index = shapely.get_parts(parallel, return_index=True)
    which, style, kind = which[index], style[index], kind[index]
    painted, line_of = [], []
    for number, (_, dash, gap) in enumerate(_STYLES):
        own = np.flatnonzero(style == number)
        if dash:
            dashes, dash_of = _dashes(parts[own], dash=dash, gap=gap)
            painted.append(dashes)
            line_of.append(own[dash_of])
        else:
            painted.append(parts[own])
            line_of.append(own)
    of = np.concatenate(line_of)
    half = np.array([width for width, _, _ in _STYLES])[style[of]] / 2
    row = stretches.row[which[of]]
    lanes_source = np.array([s.lanes_source for s in roads.street], "<U8")[row]
    return SurfaceRows.of(
        shapely.buffer(np.concatenate(painted), half, cap_style="flat", join_style="mitre"),
        klass=Class.LANE_MARKING,
        material="lane_paint",
        priority=PRIORITY,
        osm_id=roads.osm_id[row],
        source=np.char.add(np.where(kind[of] == "", lanes_source, kind[of]), "/default"),
        place=roads.place[row],
        level=roads.layer[row],
        edge=edge[row],
    )


def _offsets(
    roads: Carriageways, stretches: PaintedStretches, *, left_hand: bool
) -> tuple[Ints, Float, Ints, NDArray[np.str_]]:
    """Painted lines: row of the stretches, offset in metres to the left, style, and tag.

    The tag is "" for lines between lanes and along edges.
    """
    found: list[tuple[int, float, int, str]] = []
    layout = stretches.layout
    for k, row in enumerate(stretches.row.tolist()):
        street, uses = roads.street[row], roads.uses[row]
        count, own, shared = int(layout.count[k]), int(layout.own[k]), bool(layout.shared[k])
        width = float(layout.carriageway[k])
        # Lanes along the line lie on its right, or on its left where traffic keeps left.
        aside = -1.0 if left_hand else 1.0
        of_side = (own, count - own - shared)
        buses, bicycles = (
            _borders_of(lanes, of_side, count=count, left_hand=left_hand)
            for lanes in (uses.bus, uses.bicycles)
        )
        for i in range(1, count if roads.marked[row] else 1):
            between = min(of_side) > 0 or shared
            if between and abs(i - own - 0.5 * shared) < 0.75:
                style, kind = _SOLID, ""
            elif i in buses:
                style, kind = _BUS, "busway"
            elif i in bicycles:
                style, kind = _SOLID, "cycleway"
            else:
                style, kind = _BROKEN, ""
            found.append((k, -aside * float(layout.borders[k, i]), style, kind))
        if roads.marked[row] and street.highway.removesuffix("_link") in _EDGED:
            for side, sign in ((0, 1.0), (1, -1.0)):
                if roads.walk[row, side] == 0 and width > 4 * _EDGE_IN:
                    found.append((k, sign * (width / 2 - _EDGE_IN), _SOLID, ""))
        for cycle, sign in zip(uses.cycle, (1.0, -1.0), strict=True):
            if cycle is None or cycle.kind == "shared":
                continue
            style = _ADVISORY if cycle.kind == "advisory" else _SOLID
            outer = width / 2 - cycle.inset
            found.append((k, sign * (outer - cycle.width), style, "cycleway"))
            if cycle.inset:
                found.append((k, sign * outer, _SOLID, "cycleway"))
    return (
        np.array([f[0] for f in found], np.int64),
        np.array([f[1] for f in found], float),
        np.array([f[2] for f in found], np.int64),
        np.array([f[3] for f in found], "<U8"),
    )


def _borders_of(
    chosen: tuple[tuple[int, ...], tuple[int, ...]],
    lanes: tuple[int, int],
    *,
    count: int,
    left_hand: bool,
) -> set[int]:
    """Numbers of the lines beside chosen lanes, counted from the kerb of the forward lanes.

    chosen : numbers of lanes along the line and against it, from left to right as driven
    lanes  : number of lanes along the line, and against it
    """
    found = set()
    for side in (0, 1):
        for lane in chosen[side]:
            from_kerb = lane if left_hand else lanes[side] - 1 - lane
            first = from_kerb if side == 0 else count - 1 - from_kerb
            found |= {first, first + 1}
    return found


def _dashes(lines: NDArray[np.object_], *, dash: float, gap: float) -> tuple[NDArray[np.object_], Ints]:
    """The dashes of broken lines, as lines, and the line of each."""
    length = shapely.length(lines)
    count = np.maximum(np.floor((length + gap) / (dash + gap)), 0).astype(np.int64)
    of = np.repeat(np.arange(len(lines)), count)
    number = nth(count)
    spare = (length - count * (dash + gap) + gap)[of] / 2
    start = spare + number * (dash + gap)
    at = start[:, None] + dash * np.array([0.0, 0.5, 1.0])
    points = shapely.line_interpolate_point(lines[of][:, None], at)
    if not len(of):
        return np.empty(0, object), of
    return shapely.linestrings(shapely.get_coordinates(points).reshape(-1, 3, 2)), of


def stop_rows(
    graph: RoadGraph, roads: Carriageways, *, crossings: NDArray[np.object_], left_hand: bool
) -> SurfaceRows:
    """Stop lines before signals and stop signs, broken ones before give-way signs and mini-roundabouts.

    They cross the lanes of their direction at the mapped signal or sign, but outside the junction ahead and
    before its crossings.

    crossings : (c,) shapely, the strips where people cross
    """
    paved = dict(zip(roads.osm_id.tolist(), np.isin(roads.material, list(PAVED)).tolist(), strict=True))
    keep = np.array([s.highway not in MINOR for s in roads.street], np.bool_)
    streets = roads.take(keep)
    reach, _ = junction_reach(streets)
    inside: dict[int, float] = {}
    for node, metres in zip(
        streets.node_id[streets.ends].ravel().tolist(), reach.ravel().tolist(), strict=True
    ):
        inside[node] = max(inside.get(node, 0.0), metres)

    strips = _strips(graph, crossings)
    lines: dict[tuple[int, int], tuple[int, float, str]] = {}
    for edge, offset, kind in graph.controls:
        first = str(graph.osm_id[edge]).split(";")[0]
        if kind == "crossing" or graph.width[edge] < 4 or not paved.get(first, False):
            continue
        free = float(graph.length[edge]) - inside.get(int(graph.node_id[graph.head[edge]]), 0.0) - _CLEAR
        place = min(offset, free)
        ahead = [start for start in strips.get(edge, []) if start > place - _STRIP_BEFORE]
        place = min(place, *(start - _CLEAR for start in ahead)) if ahead else place
        if place > 1.0:
            lines.setdefault((edge, round(place / 5)), (edge, place, kind))
    return _across(graph, list(lines.values()), left_hand=left_hand)


def _strips(graph: RoadGraph, crossings: NDArray[np.object_]) -> dict[int, list[float]]:
    """Start of each crossing on the controlled edges: true metres from the edge's tail."""
    edges = np.unique(graph.control_edge)
    if not len(edges) or not len(crossings):
        return {}
    lines = edge_lines(graph)[edges]
    which, strip = shapely.STRtree(crossings).query(lines, predicate="intersects")
    inside, of = shapely.get_coordinates(
        shapely.intersection(lines[which], crossings[strip]), return_index=True
    )
    at = shapely.line_locate_point(lines[which][of], shapely.points(inside), normalized=True)
    begin = np.full(len(which), np.inf)
    np.minimum.at(begin, of, at * graph.length[edges[which]][of])
    found: dict[int, list[float]] = {}
    for edge, metres in zip(edges[which].tolist(), begin.tolist(), strict=True):
        found.setdefault(edge, []).append(metres)
    return found


def _across(graph: RoadGraph, lines: list[tuple[int, float, str]], *, left_hand: bool) -> SurfaceRows:
    """Painted bands across the lanes of edges: (edge, metres from its tail, kind of control)."""
    shapes, edges = [], []
    divider = graph_lanes(graph, left_hand=left_hand).divider
    for edge, place, kind in lines:
        xy = graph.geometry[edge][:, :2]
        plan = polylines.length(xy)
        at = place * plan / float(graph.length[edge])
        bit = polylines.cut(xy, at - _STOP / 2, end=at + _STOP / 2)
        ahead = polylines.unit(bit[-1] - bit[0])
        left = np.array([-ahead[1], ahead[0]])
        far = float(graph.width[edge]) / 2 - _EDGE_IN
        near = float(divider[edge]) + _LINE if graph.twin[edge] >= 0 else -far
        sign = 1.0 if left_hand else -1.0
        count = 1 if kind not in _YIELDING else max(int((far - near) / 0.8), 1)
        stops = np.linspace(near, far, count + 1)
        fill = 1.0 if count == 1 else 0.6
        for a, b in zip(stops[:-1], stops[:-1] + np.diff(stops) * fill, strict=True):
            ends = bit[0] + left * sign * a, bit[0] + left * sign * b
            shapes.append([ends[0], ends[1], ends[1] + ahead * _STOP, ends[0] + ahead * _STOP])
            edges.append(edge)
    rows = np.array(edges, np.int64)
    place_of_edge = np.where(graph.tunnel[rows], 2, np.where(graph.bridge[rows], 1, 0))
    return SurfaceRows.of(
        shapely.polygons(shapes) if shapes else np.empty(0, object),
        klass=Class.LANE_MARKING,
        material="lane_paint",
        priority=PRIORITY,
        osm_id=np.array([str(graph.osm_id[edge]).split(";")[0] for edge in edges], np.str_),
        source="control/default",
        place=place_of_edge,
        level=graph.layer[rows],
        edge=rows,
    )
