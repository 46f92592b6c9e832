"""Outlines of bridges and tunnels that leave the carriageways of other roads to these."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.roadgraph.grading import PARALLEL
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.routing import edge_lines
from geoscene.structures.sheets import areal, conflict_strips, nearer_part, strips_between
from geoscene.structures.table import THINNEST, nearest_on_line
from geoscene.typing import Bools, Float

_LEVEL = 0.05
"""Metres of difference in height up to which a bridge or a tunnel shares the height of a road beside it."""

_STEP = 0.5
"""Metres of difference in height up to which a road begins a bridge or a tunnel at its side."""

_MET = 0.1
"""Metres between an end and a line that are joined there."""

_SCANT = 0.1
"""Square metres of overlap of no account."""

_LEAST_FREE = 2.5
"""Metres of free height over a road down to which a bridge passes over it."""

_AROUND = 5.0
"""Metres beyond a piece to which roads on the ground are looked at."""


@dataclass(frozen=True, slots=True)
class Clearances:
    """Sizes of pieces, in metres.

    half : (n,) from centre lines to the outside
    free : (n,) clearance over a carriageway
    body : (n,) structure below it
    """

    half: Float
    free: Float
    body: Float


def without_ground_roads(
    polygon: NDArray[np.object_],
    middle: NDArray[np.object_],
    *,
    around: NDArray[np.object_],
    foot: Bools,
    ends: NDArray[np.object_],
    sizes: Clearances,
    graph: RoadGraph,
    headroom: float,
) -> NDArray[np.object_]:
    """Outlines (n,) without the carriageways of roads on the ground at their height.

    Of bridges and tunnels for vehicles that run beside a road, too near in height to pass over or under it,
    each keeps the area nearer to its own line; those that begin at the side of a road begin at its edge, and
    where a road goes on from a fork at their end they end there.
    Footbridges and foot tunnels leave the whole carriageway, also of roads on bridges and in tunnels.
    Bridges that cross a road pass over it with less free height than others.

    middle   : (n,) object, (k, 3) centre lines of pieces
    around   : the same lines some metres further at both ends
    ends     : (n,) object, (k, 2) places at which a piece's way begins or ends
    headroom : free height over roads
    """
    once, raised = np.flatnonzero(graph.once), graph.bridge | graph.tunnel
    lines = edge_lines(graph)[once]
    piece, road = shapely.STRtree(lines).query(
        polygon, predicate="dwithin", distance=float(graph.width[once].max(initial=0.0)) / 2
    )
    out = polygon.copy()
    lost: dict[int, list[shapely.Geometry]] = {}
    for k, r in zip(piece.tolist(), road.tolist(), strict=True):
        edge = int(once[r])
        if raised[edge] and not foot[k]:
            continue
        half = float(graph.width[edge]) / 2
        line = _near(graph.geometry[edge], lines[r], area=polygon[k].envelope.buffer(half + _AROUND))
        if line is None:
            continue
        band = polylines.flat(line).buffer(half, cap_style="flat")
        shared = areal(polygon[k].intersection(band))
        if shared.area < _SCANT:
            continue
        needs = float(sizes.free[k]) + THINNEST, headroom + float(sizes.body[k])
        if shapely.crosses(polylines.flat(line), polylines.flat(around[k])):
            needs = needs[0], _LEAST_FREE + float(sizes.body[k])
        if foot[k]:
            strips = strips_between(line, around[k], reach=half, low=-needs[1], high=needs[0])
            taken = areal(shapely.union_all(strips).intersection(shared))
        else:
            reach = half + float(sizes.half[k])
            strips = [
                *conflict_strips(line, around[k], reach=reach, needs=needs, least=_LEVEL, parallel=0.0),
                *conflict_strips(around[k], line, reach=reach, needs=needs[::-1], least=_LEVEL, parallel=0.0),
            ]
            where = areal(shapely.union_all(strips).intersection(shared))
            taken = shapely.MultiPolygon()
            if where.area > _SCANT:
                taken = nearer_part(where, line, half=half, other=around[k], other_half=half)
            if _goes_on(line, middle[k], within=shared):
                beyond = nearer_part(shared, line, half=half, other=middle[k], other_half=half)
                taken = areal(shapely.union_all([taken, beyond]))
            begun = _begun(line, around[k], ends=ends[k], half=half)
            taken = shapely.union_all([taken, *(shared.intersection(disc) for disc in begun)])
        if taken.area > _SCANT:
            lost.setdefault(k, []).append(taken)
    for k, shapes in lost.items():
        rest = shapely.get_parts(areal(polygon[k].difference(shapely.union_all(shapes))))
        # What is left on the far side of a road goes, too.
        own = shapely.intersects(rest, polylines.flat(around[k]))
        out[k] = shapely.MultiPolygon((rest[own] if own.any() else rest).tolist())
    return out


def _near(line: Float, flat: shapely.LineString, *, area: shapely.Geometry) -> Float | None:
    """The part (k, 3) of a line near an area, None if it is too short."""
    xy = shapely.get_coordinates(flat.intersection(area))
    if len(xy) < 2:
        return None
    at = shapely.line_locate_point(flat, shapely.points(xy))
    if np.ptp(at) < 0.1:
        return None
    return polylines.cut(line, float(at.min()), end=float(at.max()))


def _goes_on(line: Float, piece: Float, *, within: shapely.Geometry) -> bool:
    """Whether a road begins where a piece ends, and has another height somewhere within an area."""
    ends, starts = piece[[0, -1], None], line[None, [0, -1]]
    end, start = np.nonzero(np.hypot(*(ends - starts)[..., :2].transpose(2, 0, 1)) < _MET)
    if not len(end) or abs(ends[end[0], 0, 2] - starts[0, start[0], 2]) > _LEVEL:
        return False
    z, _, _ = nearest_on_line(line, shapely.get_coordinates(within))
    return bool(np.abs(z - ends[end[0], 0, 2]).max() > _LEVEL)


def _begun(line: Float, piece: Float, *, ends: Float, half: float) -> list[shapely.Geometry]:
    """Discs around the ends (k, 2) of a piece's way that lie within a road, across which it begins."""
    found: list[shapely.Geometry] = []
    flat = polylines.flat(line)
    for end in ends:
        z, away, _ = nearest_on_line(line, end[None])
        own, _, _ = nearest_on_line(piece, end[None])
        if away[0] > half or abs(z[0] - own[0]) > _STEP:
            continue
        first = piece if np.hypot(*(piece[0, :2] - end)) < np.hypot(*(piece[-1, :2] - end)) else piece[::-1]
        step = polylines.unit(polylines.points_at(first[:, :2], [2.0])[0] - end)
        at = np.array([shapely.line_locate_point(flat, shapely.Point(end))])
        along = polylines.directions(np.array([flat], object), at, reach=1.0)[0]
        if abs(float(step @ along)) < PARALLEL:
            found.append(shapely.Point(end).buffer(2.0 * half + _AROUND))
    return found
