"""Roads and paths on bridges and in tunnels, cut into pieces that do not overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry import polylines
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.surface_rows import SurfaceRows, in_reach
from geoscene.structures.layered import PRECISION
from geoscene.structures.sheets import Sheets, areal, find_sheets, part_outlines, strips_of_equal_height
from geoscene.structures.table import PARTED, SHEET, THINNEST, StructureOptions, Structures, nearest_on_line
from geoscene.structures.verges import Clearances, without_ground_roads
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

NEAR = 10.0
"""Metres from an area within which pieces are complete: more than surfaces below keep a pier away."""

_AROUND = 12.0
"""Metres by which a piece's centre line is known beyond its ends."""

_MET = 0.1
"""Metres between an end and a line that are joined there."""

_SIDE = 40.0
"""Metres: no carriageway reaches further from its centre line."""

_BESIDE_RAILS = 1.45
"""Metres of a railway bridge's deck beside each rail; over half the gauge: it is whole between the rails."""

_VEHICLE = 1.3
"""Metres on both sides of a centre line that one vehicle needs."""

_OVERLAP = 0.003
"""Metres by which pieces of one carriageway overlap, so that rounding opens no crack between them."""

_CRUMB = 0.02
"""Square metres; smaller parts of a piece are left out."""

_APPROACH = 6.0
"""Metres of the road on the ground that tell which way a bridge or tunnel opens."""

_SILL = 0.05
"""Metres by which what opens reaches in, so that it is open on the outside of a bend at the mouth too."""

_WALK = 5.0
"""Metres beside a carriageway that its sidewalk and parapet take up at most."""


def cut_pieces(
    members: Members, raised: SurfaceRows, *, graph: RoadGraph, options: StructureOptions, area: Any | None
) -> Structures:
    """The pieces of all members, in order, without piers.

    Those far from an ``area``, a shapely geometry, have no area within their parapets; all have without one.
    Where outlines of one carriageway overlap, as at junctions, the smaller one keeps the area. Roads of the
    graph that lie on the ground keep theirs.
    """
    member, polygon, line, around, half = _outlines(members, raised, options=options)
    tunnel = members.tunnel[member]
    foot_only = members.foot[member]
    body = np.where(tunnel, options.wall, np.where(foot_only, options.slab, options.deck))
    free = np.where(foot_only, options.passage, options.headroom) + np.where(tunnel, THINNEST, 0.0)
    street = members.edge[member] >= 0
    polygon = part_outlines(polygon, around, half=half, tunnel=tunnel, street=street, free=free, body=body)
    at_end = _at_member_ends(members, member, line=line)
    polygon = without_ground_roads(
        polygon,
        line,
        around=around,
        foot=foot_only,
        ends=np.fromiter((part[[0, -1], :2][own] for part, own in zip(line, at_end, strict=True)), object),
        sizes=Clearances(half, free, body),
        graph=graph,
        headroom=options.headroom,
    )
    sheets = find_sheets(polygon, around, tunnel=tunnel)
    near = sheets.near
    rim = np.where(tunnel, options.wall, options.rim)
    inner = _inner(
        polygon,
        line,
        around=around,
        half=half,
        sheets=sheets,
        approach=members.approach[member],
        shut=members.closed[member] & at_end,
        rim=rim,
        rows=np.flatnonzero(in_reach(polygon, area, metres=NEAR)),
    )
    polygon = _territories(polygon, around, sheets=sheets)
    rise = np.where(
        tunnel,
        np.where(foot_only, options.passage, options.headroom),
        np.where(foot_only, options.railing, options.parapet),
    )
    tops = np.empty(len(member), object)
    for k, others in enumerate(near):
        every = np.unique(np.concatenate([members.rows[m] for m in np.unique(member[[k, *others]])]))
        tops[k] = every[shapely.intersects(raised.polygon[every], polygon[k])]
    none = np.empty(len(member), object)
    none[:] = shapely.MultiPolygon()
    table = Structures(
        polygon=polygon,
        line=line,
        around=around,
        tunnel=tunnel,
        half=half,
        body=body,
        body_source=np.full(len(member), "default"),
        rise=rise,
        rise_source=np.full(len(member), "default"),
        near=near,
        tops=tops,
        inner=inner,
        approach=members.approach[member],
        pier=none,
        low=none.copy(),
        pier_spacing=np.zeros(len(member)),
        level=members.level[member],
        edge=members.edge[member],
        osm_id=members.osm_id[member],
        feature=np.full(len(member), -1, np.int32),
        surfaces=raised,
    )
    # Pieces that a neighbour covers entirely are dropped.
    return table.take(~shapely.is_empty(polygon))


def _outlines(
    members: Members, raised: SurfaceRows, *, options: StructureOptions
) -> tuple[Ints, NDArray[np.object_], NDArray[np.object_], NDArray[np.object_], Float]:
    """Pieces before overlaps are removed: member, outline, line, extended line, half-width."""
    lines = [_without_near_vertices(line) for line in members.line]
    whole, half = _wholes(members, lines, raised=raised, options=options)
    rows: list[tuple[int, object, Float, Float, float]] = []
    for m, line in enumerate(lines):
        length = polylines.length(line)
        count = max(int(np.ceil(length / options.piece)), 1)
        cuts = np.linspace(0.0, length, count + 1)
        for k, (start, end) in enumerate(pairwise(cuts)):
            part = _without_near_vertices(polylines.cut(line, start, end=end))
            outline = whole[m]
            if count > 1:
                ring = np.hypot(*(line[0] - line[-1])[:2]) < _MET  # where its end is beside its start
                wide = half[m] + 1.0 if ring else 2 * half[m] + 5.0
                reach = polylines.flat(part).buffer(wide, cap_style="flat", join_style="mitre")
                lasts = (part[0], k == 0 and not ring), (part[-1], k == count - 1 and not ring)
                ends = [p for p, last in lasts if last]
                discs = [shapely.Point(p[:2]).buffer(_SIDE / 2) for p in ends]
                wedges = [shapely.Point(p[:2]).buffer(half[m] + 1.0) for p in (part[0], part[-1])]
                outline = outline.intersection(shapely.union_all([reach, *discs, *wedges]))
            rows.append((m, outline, part, polylines.cut(line, start - _AROUND, end=end + _AROUND), half[m]))
    member, *shapes, width = zip(*rows, strict=True) if rows else ((),) * 5
    outlines, parts, around = (np.fromiter(column, object) for column in shapes)
    return np.array(member, np.int64), outlines, parts, around, np.array(width, float)


def _at_member_ends(members: Members, member: Ints, *, line: NDArray[np.object_]) -> Bools:
    """Whether the start and the end of pieces (n, 2) are those of their members."""
    own = np.array([part[[0, -1], :2] for part in line]).reshape(-1, 2, 2)
    whole = np.array([part[[0, -1], :2] for part in members.line[member]]).reshape(-1, 2, 2)
    same: Bools = np.abs(own - whole).max(axis=2, initial=0.0) < 1e-6
    return same


def _wholes(
    members: Members, lines: list[Float], *, raised: SurfaceRows, options: StructureOptions
) -> tuple[list[shapely.Geometry], Float]:
    """Outlines of members with their parapets or walls, and metres from their lines to the outside.

    A member ends square, but round where another one continues from its end, so that no gap is left on the
    outside of the bend.
    """
    whole, half = [], np.empty(len(lines))
    for m, line in enumerate(lines):
        flat = polylines.flat(line)
        own = members.rows[m]
        own = own[raised.klass[own] != Class.LANE_MARKING]
        shape = _union(raised.polygon[own])
        if len(own) and (raised.klass[own] == Class.RAIL).all():
            shape = shape.buffer(_BESIDE_RAILS, cap_style="flat", join_style="mitre", mitre_limit=1.5)
        if members.tunnel[m] or not (raised.klass[own] == Class.BRIDGE).any():
            beside = options.margin if members.foot[m] else max(options.margin, options.walkway)
            grow = beside + options.wall if members.tunnel[m] else options.rim
            grown = shape.buffer(grow, join_style="mitre", mitre_limit=1.5)
            shape = grown.intersection(flat.buffer(_SIDE, cap_style="flat", join_style="mitre"))
        half[m] = _half(shape, flat)
        # So that the road ends before the wall or the parapet across it.
        thick = options.wall if members.tunnel[m] else options.rim
        for end in np.flatnonzero(members.closed[m] & (members.edge[m] >= 0)).tolist():
            first = line[:: 1 - 2 * end, :2]
            beyond = first[0] + thick * polylines.unit(first[0] - first[1])
            band = shapely.LineString([first[0], beyond]).buffer(half[m], cap_style="flat")
            shape = _union([shape, band])
        whole.append(shape)
    flats = np.array([polylines.flat(line) for line in lines], object)
    ends = np.array([line[e] for line in lines for e in (0, -1)]).reshape(-1, 3)
    end, other = shapely.STRtree(flats).query(shapely.points(ends[:, :2]), predicate="dwithin", distance=_MET)
    for row, q in zip(end.tolist(), other.tolist(), strict=True):
        m = row // 2
        if q == m or members.tunnel[q] != members.tunnel[m] or members.landed[m, row % 2]:
            continue
        if abs(nearest_on_line(lines[q], ends[row, None, :2])[0][0] - ends[row, 2]) < PARTED:
            disc = shapely.Point(ends[row, :2]).buffer(min(half[m], half[q]))
            whole[m] = _union([whole[m], disc])
    return whole, half


def _without_near_vertices(line: Float) -> Float:
    """The line (k, 3) without vertices close to its ends, where they would tilt the caps of buffers."""
    inner = line[1:-1]
    clear = [np.hypot(*(inner - end)[:, :2].T) > _MET for end in (line[0], line[-1])]
    return np.concatenate([line[:1], inner[clear[0] & clear[1]], line[-1:]])


def _half(outline: shapely.Geometry, line: shapely.LineString) -> float:
    """Metres from the line to the outside, midway along it."""
    a, b = (shapely.get_coordinates(line.interpolate(s, normalized=True))[0] for s in (0.499, 0.501))
    along = polylines.unit(b - a)
    across = np.array([-along[1], along[0]]) * _SIDE
    ray = shapely.LineString([(a + b) / 2 - across, (a + b) / 2 + across])
    parts = shapely.get_parts(outline.intersection(ray))
    hit = parts[shapely.distance(parts, shapely.Point((a + b) / 2)) < 0.01]
    return max(float(shapely.length(hit).max(initial=0.0)) / 2, 0.5)


def _inner(
    polygon: NDArray[np.object_],
    line: NDArray[np.object_],
    *,
    around: NDArray[np.object_],
    half: Float,
    sheets: Sheets,
    approach: NDArray[np.object_],
    shut: Bools,
    rim: Float,
    rows: Ints,
) -> NDArray[np.object_]:
    """The area within the parapets of a piece and its neighbours, open towards roads on the ground.

    Of pieces in ``rows``; none of others. ``shut`` (n, 2): no road continues from the start and the end.
    """
    inner = np.full(len(polygon), shapely.Polygon(), object)
    near = sheets.near
    for k in rows.tolist():
        others = near[k]
        # Neighbours' neighbours too, so that no parapet stands where the next piece but one begins.
        beyond = np.unique(np.concatenate([others, *(near[q] for q in others)]).astype(np.int64))
        shapes = [polygon[k]]
        for q in beyond[beyond != k].tolist():
            if sheets.apart(k, q):
                continue
            shape = polygon[q]
            if (min(k, q), max(k, q)) in sheets.parted:
                shape = shape.intersection(strips_of_equal_height(around[k], around[q], within=PARTED))
            shapes.append(shape)
        whole = _union([*shapes, *approach[np.r_[k, others].astype(np.int64)]])
        closed = whole.buffer(0.05, join_style="mitre").buffer(-0.05 - rim[k], join_style="mitre")
        # Where two are so close that a wall would stand in the middle of the road, it is left out.
        wide = min(_VEHICLE, float(half[k]) / 2)
        start, end = np.where(shut[k], wide, 0.0) * (1.0, -1.0) + (0.0, polylines.length(line[k]))
        middle = polylines.flat(polylines.cut(line[k], start, end=end)).buffer(wide, cap_style="flat")
        inner[k] = _union([closed, middle]).intersection(polygon[k].buffer(1.0))
    return inner


def _territories(
    polygon: NDArray[np.object_], around: NDArray[np.object_], *, sheets: Sheets
) -> NDArray[np.object_]:
    """Outlines less those of smaller neighbours, so that none is covered entirely."""
    rank = np.empty(len(polygon), np.int64)
    rank[np.argsort(shapely.area(polygon), kind="stable")] = np.arange(len(polygon))
    out = np.empty(len(polygon), object)
    for k, others in enumerate(sheets.near):
        rest = polygon[k]
        for earlier in others[rank[others] < rank[k]].tolist():
            taken = polygon[earlier].buffer(-_OVERLAP, join_style="mitre")
            if (min(earlier, k), max(earlier, k)) in sheets.over:
                taken = taken.intersection(strips_of_equal_height(around[k], around[earlier], within=SHEET))
            rest = rest.difference(taken)
        out[k] = _clean(rest)
    return out


def within_extent(table: Structures, extent: tuple[float, float, float, float]) -> Structures:
    """The pieces cut square where they leave (xmin, ymin, xmax, ymax): a scene ends at its extent."""
    box = shapely.box(*extent)
    out = np.flatnonzero(~shapely.covered_by(table.polygon, box))
    polygon, pier = table.polygon.copy(), table.pier.copy()
    for k in out.tolist():
        polygon[k] = _clean(polygon[k].intersection(box))
        pier[k] = _clean(pier[k].intersection(box))
    return replace(table, polygon=polygon, pier=pier).take(~shapely.is_empty(polygon))


def _clean(shape: shapely.Geometry) -> shapely.MultiPolygon:
    """A shape on the grid, morphologically opened to remove hairline connections."""
    opened = shape.buffer(-0.005, join_style="mitre").buffer(0.005, join_style="mitre")
    return areal(shapely.set_precision(opened, PRECISION), least=_CRUMB)


def _union(polygons: Sequence[object] | NDArray[np.object_]) -> shapely.Geometry:
    """The union on the grid, without its precision model, with which buffers can fail."""
    return shapely.set_precision(shapely.union_all(polygons, grid_size=PRECISION), 0.0)


@dataclass(frozen=True, slots=True)
class Members(Columns):
    """Roads and paths on bridges and in tunnels, one row each.

    line     : (n,) object, (k, 3) float64 scene metres
    tunnel   : (n,) bool
    foot     : (n,) bool, for pedestrians or cyclists, or as low as for these
    width    : (n,) float64 metres of the carriageway or path
    rows     : (n,) object, (k,) int64 rows of its surfaces among the raised ones
    approach : (n,) object, shapely: the first metres of the roads at its ends that are of another kind:
               on the ground or, from a tunnel, on a bridge
    landed   : (n, 2) bool, start and end lie on the ground
    closed   : (n, 2) bool, no road continues from start and end
    level    : (n,) int8
    edge     : (n,) int32, -1 for paths
    osm_id   : (n,) str
    """

    line: NDArray[np.object_]
    tunnel: Bools
    foot: Bools
    width: Float
    rows: NDArray[np.object_]
    approach: NDArray[np.object_]
    landed: Bools
    closed: Bools
    level: NDArray[np.int8]
    edge: NDArray[np.int32]
    osm_id: NDArray[np.str_]


def road_members(graph: RoadGraph, raised: SurfaceRows) -> Members:
    """The bridges and tunnels of a road graph with heights that have surfaces; two-way streets once."""
    structure = graph.bridge | graph.tunnel
    order = np.argsort(raised.edge, kind="stable")
    begin, stop = (
        np.searchsorted(raised.edge[order], np.arange(len(graph)), side=s) for s in ("left", "right")
    )
    once = np.flatnonzero(structure & (begin < stop) & graph.once)
    arms = _arms(graph, once)
    count = len(once)
    line, rows, approach = (np.empty(count, object) for _ in range(3))
    landed, closed = np.zeros((2, count, 2), np.bool_)
    for k, edge in enumerate(once.tolist()):
        line[k] = graph.geometry[edge]
        rows[k] = order[begin[edge] : stop[edge]]
        kind = _kind(graph, edge)
        ends = [arms[int(node)] for node in (graph.tail[edge], graph.head[edge])]
        landed[k] = [any(other == 0 for other, _, _ in found) for found in ends]
        closed[k] = [len(found) <= 1 + (graph.twin[edge] >= 0) for found in ends]
        bands = [
            _band(part, max(width, graph.width[edge]))
            for inward, found in zip((line[k], line[k][::-1]), ends, strict=True)
            for other, first, width in found
            if other != kind
            for part in (polylines.cut(inward[:, :2], 0.0, end=_SILL), first)
        ]
        bands += [
            shapely.Point(line[k][e, :2]).buffer(graph.width[edge] / 2)
            for e, found in zip((0, -1), ends, strict=True)
            if any(other != kind for other, _, _ in found)
        ]
        approach[k] = shapely.union_all(bands)
    return Members(
        line,
        graph.tunnel[once],
        np.zeros(count, np.bool_),
        graph.width[once],
        rows,
        approach,
        landed,
        closed,
        graph.layer[once],
        once.astype(np.int32),
        graph.osm_id[once],
    )


def _kind(graph: RoadGraph, edge: int) -> int:
    """0 on the ground, 1 on a bridge, 2 in a tunnel."""
    return 2 if graph.tunnel[edge] else int(graph.bridge[edge])


def _arms(graph: RoadGraph, members: Ints) -> dict[int, list[tuple[int, Float, float]]]:
    """Kind, first metres (from the node) and width of all roads at the ends of members, by node."""
    ends = np.unique(np.concatenate([graph.tail[members], graph.head[members]]))
    arms: dict[int, list[tuple[int, Float, float]]] = {int(node): [] for node in ends}
    for node, step in ((graph.tail, 1), (graph.head, -1)):
        for edge in np.flatnonzero(np.isin(node, ends)).tolist():
            line = polylines.cut(graph.geometry[edge][::step, :2], 0.0, end=_APPROACH)
            arms[int(node[edge])].append((_kind(graph, edge), line, float(graph.width[edge])))
    return arms


def _band(first: Float, width: float) -> shapely.Geometry:
    """Opening in a parapet or wall for a road: as wide as the wider of both roads, plus a sidewalk."""
    return shapely.LineString(first).buffer(width / 2 + _WALK, cap_style="flat", join_style="mitre")
