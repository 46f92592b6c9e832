"""Members cut into pieces that do not overlap, and which pieces carry on from which."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.roadgraph.junctions import cut_line
from geoscene.roadgraph.surface_rows import SurfaceRows
from geoscene.structures.heights import SHEET, foot
from geoscene.structures.layered import PRECISION
from geoscene.structures.members import Members
from geoscene.structures.table import StructureOptions, Structures

Float = NDArray[np.float64]
Int = NDArray[np.int64]

_STRIP = 4.0
"""Metres along a carriageway at which its height is compared with another's."""

_TOUCH = 1.0
"""Metres within which pieces meet."""

_AROUND = 12.0
"""Metres by which a piece's centre line is known beyond its ends."""

_SIDE = 40.0
"""Metres: no carriageway reaches further from its centre line."""

_BESIDE_RAILS = 1.45
"""Metres of a railway bridge's deck beside each rail; over half the gauge: it is whole between the rails."""

_OVERLAP = 0.003
"""Metres by which pieces of one carriageway overlap, so that rounding opens no crack between them."""

_CRUMB = 0.02
"""Square metres; smaller parts of a piece are left out."""


def cut_pieces(members: Members, raised: SurfaceRows, options: StructureOptions) -> Structures:
    """The pieces of all members, in order, without piers.

    Where outlines of one carriageway overlap, as they do at junctions, the smaller has the ground.
    """
    member, polygon, line, around, half = _outlines(members, raised, options)
    tunnel = members.tunnel[member]
    near, partly = _neighbours(polygon, around, tunnel)
    inner = _inner(polygon, near, members.approach[member], np.where(tunnel, options.wall, options.rim))
    polygon = _territories(polygon, around, near, partly)
    foot_only = members.foot[member]
    body = np.where(tunnel, options.wall, np.where(foot_only, options.slab, options.deck))
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
        pier_spacing=np.zeros(len(member)),
        level=members.level[member],
        edge=members.edge[member],
        osm_id=members.osm_id[member],
        feature=np.full(len(member), -1, np.int32),
        surfaces=raised,
    )
    # What a neighbour covers altogether is no piece.
    return table.take(~shapely.is_empty(polygon))


def _outlines(
    members: Members, raised: SurfaceRows, options: StructureOptions
) -> tuple[Int, NDArray[np.object_], NDArray[np.object_], NDArray[np.object_], Float]:
    """Pieces before they are told apart: member, outline, line, line with its surroundings, half-width."""
    rows: list[tuple[int, object, Float, Float, float]] = []
    for m in range(len(members)):
        line = members.line[m]
        flat = shapely.LineString(line[:, :2])
        own = members.rows[m]
        own = own[raised.klass[own] != Class.LANE_MARKING]
        whole = _union(raised.polygon[own])
        if len(own) and (raised.klass[own] == Class.RAIL).all():
            whole = whole.buffer(_BESIDE_RAILS, cap_style="flat", join_style="mitre", mitre_limit=1.5)
        if members.tunnel[m] or not (raised.klass[own] == Class.BRIDGE).any():
            grow = options.margin + options.wall if members.tunnel[m] else options.rim
            grown = whole.buffer(grow, join_style="mitre", mitre_limit=1.5)
            whole = grown.intersection(flat.buffer(_SIDE, cap_style="flat", join_style="mitre"))
        half = _half(whole, flat)
        count = max(int(np.ceil(flat.length / options.piece)), 1)
        cuts = np.linspace(0.0, flat.length, count + 1)
        for k, (start, end) in enumerate(pairwise(cuts)):
            part = cut_line(line, start, end)
            outline = whole
            if count > 1:
                reach = shapely.LineString(part[:, :2]).buffer(_SIDE, cap_style="flat", join_style="mitre")
                ends = [p for p, last in ((part[0], k == 0), (part[-1], k == count - 1)) if last]
                discs = [shapely.Point(p[:2]).buffer(_SIDE / 2) for p in ends]
                wedges = [shapely.Point(p[:2]).buffer(half + 1.0) for p in (part[0], part[-1])]
                outline = whole.intersection(shapely.union_all([reach, *discs, *wedges]))
            rows.append((m, outline, part, cut_line(line, start - _AROUND, end + _AROUND), half))
    columns = np.empty((3, len(rows)), object)
    for k, row in enumerate(rows):
        columns[:, k] = row[1:4]
    outline, line, around = columns
    return (
        np.array([r[0] for r in rows], np.int64),
        outline,
        line,
        around,
        np.array([r[4] for r in rows], float),
    )


def _half(outline: shapely.Geometry, line: shapely.LineString) -> float:
    """Metres from the line to the outside, midway along it."""
    a, b = (shapely.get_coordinates(line.interpolate(s, normalized=True))[0] for s in (0.499, 0.501))
    along = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
    across = np.array([-along[1], along[0]]) * _SIDE
    ray = shapely.LineString([(a + b) / 2 - across, (a + b) / 2 + across])
    parts = shapely.get_parts(outline.intersection(ray))
    hit = parts[shapely.distance(parts, shapely.Point((a + b) / 2)) < 0.01]
    return max(float(shapely.length(hit).max(initial=0.0)) / 2, 0.5)


def _neighbours(
    polygon: NDArray[np.object_], around: NDArray[np.object_], tunnel: NDArray[np.bool_]
) -> tuple[NDArray[np.object_], set[tuple[int, int]]]:
    """For each piece, its neighbours on one carriageway; and which pairs of them overlie in part."""
    one, two = shapely.STRtree(polygon).query(polygon, predicate="dwithin", distance=_TOUCH)
    keep = (one < two) & (tunnel[one] == tunnel[two])
    one, two = one[keep], two[keep]
    grown = shapely.buffer(polygon, _TOUCH, quad_segs=2)
    common = shapely.segmentize(shapely.intersection(grown[one], grown[two]), _STRIP)
    least, most = np.empty((2, len(one)))
    for row, (p, q) in enumerate(zip(one.tolist(), two.tolist(), strict=True)):
        places = shapely.get_coordinates([common[row], common[row].representative_point()])
        apart = np.abs(foot(around[p], places)[0] - foot(around[q], places)[0])
        least[row], most[row] = apart.min(), apart.max()
    same, over = least < SHEET, (least < SHEET) & (most >= SHEET)
    partly = set(zip(one[over].tolist(), two[over].tolist(), strict=True))
    one, two = np.concatenate([one[same], two[same]]), np.concatenate([two[same], one[same]])
    order = np.lexsort([two, one])
    ends = np.searchsorted(one[order], np.arange(len(polygon) + 1))
    near = np.empty(len(polygon), object)
    near[:] = [two[order[a:b]] for a, b in pairwise(ends)]
    return near, partly


def _where_same(line: Float, other: Float) -> shapely.Geometry:
    """Where, beside a line, it is as high as another one, in strips."""
    flat = shapely.LineString(line[:, :2])
    cuts = np.linspace(0.0, flat.length, max(int(np.ceil(flat.length / _STRIP)), 1) + 1)
    strips = []
    for start, end in pairwise(cuts):
        part = cut_line(line, start, end)
        middle = part.mean(axis=0, keepdims=True)
        if abs(foot(other, middle[:, :2])[0][0] - middle[0, 2]) < SHEET:
            strips.append(shapely.LineString(part[:, :2]).buffer(_SIDE, cap_style="flat"))
    return _union(strips)


def _inner(
    polygon: NDArray[np.object_], near: NDArray[np.object_], approach: NDArray[np.object_], rim: Float
) -> NDArray[np.object_]:
    """What is within the rim of a piece and its neighbours, and open to the ground's roads."""
    inner = np.empty(len(polygon), object)
    for k, others in enumerate(near):
        # Neighbours' neighbours too, so that no rim stands where the next piece but one begins.
        beyond = np.unique(np.concatenate([[k], others, *(near[q] for q in others)]).astype(np.int64))
        whole = _union([*polygon[beyond], *approach[np.r_[k, others].astype(np.int64)]])
        closed = whole.buffer(0.05, join_style="mitre").buffer(-0.05 - rim[k], join_style="mitre")
        inner[k] = closed.intersection(polygon[k].buffer(1.0))
    return inner


def _territories(
    polygon: NDArray[np.object_],
    around: NDArray[np.object_],
    near: NDArray[np.object_],
    partly: set[tuple[int, int]],
) -> NDArray[np.object_]:
    """Outlines less those of smaller neighbours, so that none is covered altogether."""
    rank = np.empty(len(polygon), np.int64)
    rank[np.argsort(shapely.area(polygon), kind="stable")] = np.arange(len(polygon))
    out = np.empty(len(polygon), object)
    for k, others in enumerate(near):
        rest = polygon[k]
        for earlier in others[rank[others] < rank[k]].tolist():
            taken = polygon[earlier].buffer(-_OVERLAP, join_style="mitre")
            if (min(earlier, k), max(earlier, k)) in partly:
                taken = taken.intersection(_where_same(around[k], around[earlier]))
            rest = rest.difference(taken)
        # Opened a little: what hangs together in a point only, or by a hair, does not belong together.
        rest = rest.buffer(-0.005, join_style="mitre").buffer(0.005, join_style="mitre")
        parts = shapely.get_parts(shapely.set_precision(rest, PRECISION))
        areal = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > _CRUMB)
        out[k] = shapely.MultiPolygon(parts[areal].tolist())
    return out


def _union(polygons: Sequence[object] | NDArray[np.object_]) -> shapely.Geometry:
    """The union on the grid, as a geometry that does not keep to it (buffers of such that do go amiss)."""
    return shapely.set_precision(shapely.union_all(polygons, grid_size=PRECISION), 0.0)
