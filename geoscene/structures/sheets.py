"""Carriageways that share a surface, carriageways above each other, and the boundaries between them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.grading import PARALLEL
from geoscene.structures.table import PARTED, SHEET, nearest_on_line
from geoscene.typing import Bools, Float

Pair = tuple[int, int]

_STRIP = 4.0
"""Metres along a carriageway at which its height is compared with another's."""

_LAP = 0.5
"""Metres by which strips overlap, so that none is missing on the outside of a bend."""

_TOUCH = 1.0
"""Metres within which pieces meet."""

_SIDE = 40.0
"""Metres: no carriageway reaches further from its centre line."""

_TIGHT = 0.05
"""Metres of free height whose lack is of no account."""

_SCANT = 0.1
"""Square metres of overlap of no account."""

_SAMPLE = 0.5
"""Metres between the points by which ground is divided among carriageways."""


@dataclass(frozen=True, slots=True)
class Sheets:
    """Relations between pieces.

    near   : (n,) object, (k,) int64 rows that share a carriageway with this one, at least in part
    over   : pairs of rows of which one lies, at least in part, over the other
    parted : pairs that differ in height somewhere, including those of `over`
    """

    near: NDArray[np.object_]
    over: set[Pair]
    parted: set[Pair]

    def apart(self, one: int, two: int) -> bool:
        """Whether two pieces overlap in plan without sharing a carriageway anywhere."""
        return (min(one, two), max(one, two)) in self.parted and two not in self.near[one]


def find_sheets(polygon: NDArray[np.object_], around: NDArray[np.object_], *, tunnel: Bools) -> Sheets:
    """Relations of pieces by their heights where their outlines touch."""
    one, two = shapely.STRtree(polygon).query(polygon, predicate="dwithin", distance=_TOUCH)
    keep = (one < two) & (tunnel[one] == tunnel[two])
    one, two = one[keep], two[keep]
    grown = shapely.buffer(polygon, _TOUCH, quad_segs=2)
    common = shapely.segmentize(shapely.intersection(grown[one], grown[two]), _STRIP)
    least, most = np.empty((2, len(one)))
    for row, (p, q) in enumerate(zip(one.tolist(), two.tolist(), strict=True)):
        places = shapely.get_coordinates([common[row], common[row].representative_point()])
        z, _, beside = nearest_on_line(around[p], places)
        other_z, _, other_beside = nearest_on_line(around[q], places)
        apart = np.abs(z - other_z)
        least[row] = apart.min()
        # Beyond its end a line is extended level: a line that continues it is not another surface.
        most[row] = apart[beside & other_beside].max(initial=least[row])
    same = least < SHEET
    over, parted = (
        set(zip(one[rows].tolist(), two[rows].tolist(), strict=True))
        for rows in (most >= SHEET, most >= PARTED)
    )
    one, two = np.concatenate([one[same], two[same]]), np.concatenate([two[same], one[same]])
    order = np.lexsort([two, one])
    ends = np.searchsorted(one[order], np.arange(len(polygon) + 1))
    near = np.fromiter((two[order[a:b]] for a, b in pairwise(ends)), object)
    return Sheets(near, over, parted)


def strips_of_equal_height(line: Float, other: Float, *, within: float) -> shapely.Geometry:
    """Strips along a line where its height differs by less than ``within`` metres from another line's."""
    cuts, middle = _strip_cuts(line)
    z, _, beside = nearest_on_line(other, middle[:, :2])
    same = (np.abs(z - middle[:, 2]) < within) | ~beside
    return shapely.union_all(
        [_flat_part(line, cuts, k=k).buffer(_SIDE, cap_style="flat") for k in np.flatnonzero(same).tolist()]
    )


def part_outlines(
    polygon: NDArray[np.object_],
    around: NDArray[np.object_],
    *,
    half: Float,
    tunnel: Bools,
    street: Bools,
    free: Float,
    body: Float,
) -> NDArray[np.object_]:
    """Outlines (n,) reduced by the clearance of adjacent pieces.

    Mapped widths are rough: carriageways side by side overlap by a metre or two. Where they do, and one is
    higher but not enough for the other to pass below, each keeps the area nearer to its own line; a tunnel of
    a street keeps all of it beside one of another way.

    half : (n,) metres from centre lines to the outside
    street : (n,) whether a piece is of the road graph
    free : (n,) metres of clearance over a carriageway
    body : (n,) metres of structure below it
    """
    lost: dict[int, list[shapely.Geometry]] = {}
    one, two = shapely.STRtree(polygon).query(polygon, predicate="intersects")
    keep = one < two
    common = shapely.intersection(polygon[one[keep]], polygon[two[keep]])
    for p, q, meeting in zip(one[keep].tolist(), two[keep].tolist(), common, strict=True):
        shared = areal(meeting)
        if shared.area < _SCANT:
            continue
        least = PARTED if tunnel[p] == tunnel[q] else 0.0
        strips = [
            strip
            for a, b in ((p, q), (q, p))
            for strip in conflict_strips(
                around[a],
                around[b],
                reach=half[p] + half[q],
                needs=(free[b] + body[a], free[a] + body[b]),
                least=least,
            )
        ]
        where = areal(shapely.union_all(strips).intersection(shared))
        if where.area < _SCANT:
            continue
        if tunnel[p] and tunnel[q] and street[p] != street[q]:
            lost.setdefault(q if street[p] else p, []).append(where)
            continue
        theirs = nearer_part(
            where, around[q], half=float(half[q]), other=around[p], other_half=float(half[p])
        )
        lost.setdefault(p, []).append(theirs)
        lost.setdefault(q, []).append(where.difference(theirs))
    out = polygon.copy()
    for k, shapes in lost.items():
        out[k] = polygon[k].difference(shapely.union_all(shapes))
    return out


def areal(shape: shapely.Geometry, *, least: float = 0.0) -> shapely.MultiPolygon:
    """The polygons of a shape that have more than ``least`` square metres."""
    parts = shapely.get_parts(shape)
    kept = (shapely.get_type_id(parts) == shapely.GeometryType.POLYGON) & (shapely.area(parts) > least)
    return shapely.MultiPolygon(parts[kept].tolist())


def conflict_strips(
    line: Float,
    other: Float,
    *,
    reach: float,
    needs: tuple[float, float],
    least: float,
    parallel: float = PARALLEL,
) -> list[shapely.Geometry]:
    """Strips along a line where another line is too near in plan and in height to pass.

    needs    : metres that the line must be above the other to pass over it, and below it to pass under it
    parallel : cosine of the greatest angle between the lines
    """
    cuts, middle = _strip_cuts(line)
    z, away, beside = nearest_on_line(other, middle[:, :2])
    up = middle[:, 2] - z
    short = (np.abs(up) >= least) & (np.abs(up) < np.where(up < 0, needs[1], needs[0]) - _TIGHT)
    strips, flat = [], polylines.flat(other)
    for k in np.flatnonzero(short & beside & (away <= reach)).tolist():
        part = _flat_part(line, cuts, k=k)
        start, end = shapely.line_locate_point(
            flat, [shapely.Point(part.coords[0]), shapely.Point(part.coords[-1])]
        )
        if abs(end - start) >= parallel * part.length:
            strips.append(part.buffer(reach, cap_style="flat"))
    return strips


def strips_between(
    line: Float, other: Float, *, reach: float, low: float, high: float
) -> list[shapely.Geometry]:
    """Strips along a line where it is ``low`` to ``high`` metres above the nearest point of another line."""
    cuts, middle = _strip_cuts(line)
    z, _, _ = nearest_on_line(other, middle[:, :2])
    up = middle[:, 2] - z
    found = np.flatnonzero((up > low + _TIGHT) & (up < high - _TIGHT)).tolist()
    return [_flat_part(line, cuts, k=k).buffer(reach, cap_style="flat") for k in found]


def _strip_cuts(line: Float) -> tuple[Float, Float]:
    """Metres along a line at which strips begin and end, and the middle (n, 3) of each strip."""
    along = polylines.stations(line)
    cuts = np.linspace(0.0, along[-1], max(int(np.ceil(along[-1] / _STRIP)), 1) + 1)
    at = (cuts[:-1] + cuts[1:]) / 2
    return cuts, polylines.points_at(line, at, along=along)


def _flat_part(line: Float, cuts: Float, *, k: int) -> shapely.LineString:
    """The line of a strip, which overlaps the next one slightly."""
    return shapely.LineString(polylines.cut(line, cuts[k] - _LAP, end=cuts[k + 1] + _LAP)[:, :2])


def nearer_part(
    where: shapely.Geometry, line: Float, *, half: float, other: Float, other_half: float
) -> shapely.Geometry:
    """The part of an area that lies further within the one carriageway than within the other.

    By the Voronoi cells of points along the narrower one's centre line, and along the other as far from its
    outside.
    """
    around = where.envelope.buffer(half + other_half)
    points = []
    for road, wide, own in ((line, half, 0), (other, other_half, 1)):
        core = polylines.flat(road)
        inset = wide - min(half, other_half)
        if inset > _SAMPLE:
            core = shapely.union_all([core, core.buffer(inset, cap_style="flat").boundary])
        xy = shapely.get_coordinates(shapely.segmentize(core.intersection(around), _SAMPLE))
        points.append(np.column_stack([np.round(xy, 3), np.full(len(xy), own)]))
    rows = np.concatenate(points)
    xy, first = np.unique(rows[:, :2], axis=0, return_index=True)
    own = rows[first, 2] == 0
    cells = shapely.get_parts(
        shapely.voronoi_polygons(shapely.MultiPoint(xy.tolist()), extend_to=around.envelope)
    )
    point, cell = shapely.STRtree(cells).query(shapely.points(xy), predicate="intersects")
    mine = shapely.union_all(cells[np.unique(cell[own[point]])])
    return mine.intersection(where)
