"""Sidewalks raised above carriageways, and kerbs that are lowered at crossings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.ground.layers import (
    COVERS,
    FLUSH,
    GULLIES,
    KERB_ENDS,
    KERBS,
    LOWERED,
    PATCHES,
    RAISED,
    RAMPS,
    SIDEWALK_ENDS,
    SIDEWALKS,
    Layers,
)
from geoscene.ground.partition import GroundPlan, Partition, rows_at, tile_box, values_at
from geoscene.ground.relief import Kerbs, points_in_boxes, shapes_near
from geoscene.ground.triangulate import PlaneTriangles
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

KERB, KERB_LOWERED = 0.12, 0.03
"""Metres from the carriageway up to sidewalks, and up to lowered kerbs (RASt 06: 12 cm; 3 cm and less)."""

_BESIDE = 0.5
"""Metres beside a crossing over which the kerb is lowered, too."""

_RAMP = 1.0
"""Metres over which a kerb comes down."""

_END = 2.0
"""Metres over which sidewalks come down to the decks of bridges and the floors of tunnels."""

_MAPPED = 1.5
"""Metres around a mapped kerb that are as it says. Assumed: half the width of a crossing."""

AROUND = 2.0**-6
"""Metres around a vertex at which the layers that touch it are looked up."""

_DIRECTIONS = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False) + 0.1
_LEVEL = (
    Class.ROAD,
    Class.LANE_MARKING,
    Class.CROSSING,
    Class.PARKING,
    Class.RAIL,
    Class.WATER,
    Class.TUNNEL,
)


@dataclass(frozen=True, slots=True)
class MappedKerbs(Columns):
    """Kerbs that the map describes.

    point : (n,) shapely Point, scene metres
    kind  : (n,) str: ``raised``, ``lowered`` or ``flush``
    crossing : (n,) bool, the point is the node of a crossing, whose two kerbs it describes
    """

    point: NDArray[np.object_]
    kind: NDArray[np.str_]
    crossing: Bools

    @classmethod
    def empty(cls) -> MappedKerbs:
        """None."""
        return cls(np.empty(0, object), np.empty(0, "U8"), np.empty(0, np.bool_))


_KINDS = {"raised": RAISED, "lowered": LOWERED, "flush": FLUSH}


def lowered_kerbs(surfaces: Layers, *, mapped: MappedKerbs | None = None) -> Layers:
    """Rows of lowered kerbs at crossings, and of the ramps at their ends and at driveways.

    They lie above the kerbs themselves and have their features. Kerbs are lowered at crossings, unless they
    are mapped otherwise.
    """
    mapped = mapped or MappedKerbs.empty()
    kerbs = surfaces.take(np.flatnonzero(surfaces.priority == KERBS))
    crossings = surfaces.take(np.flatnonzero(surfaces.klass == Class.CROSSING))
    roads = surfaces.take(np.flatnonzero((surfaces.klass == Class.ROAD) & (surfaces.priority < PATCHES)))
    rows = [
        _near(kerbs, crossings, metres=_BESIDE, priority=LOWERED),
        _near(kerbs, crossings, metres=_BESIDE + _RAMP, priority=RAMPS),
        _near(kerbs, roads, metres=_RAMP, priority=RAMPS),
    ]
    crossing_tree = shapely.STRtree(crossings.polygon)
    for kind, priority in _KINDS.items():
        of_crossing = mapped.point[(mapped.kind == kind) & mapped.crossing]
        beside = crossings.take(
            np.unique(crossing_tree.query(of_crossing, predicate="dwithin", distance=1.0)[1])
        )
        local = shapely.buffer(mapped.point[(mapped.kind == kind) & ~mapped.crossing], _MAPPED - _BESIDE)
        spots = Layers.of(local, klass=Class.CROSSING, material=0, priority=0.0)
        for places in (beside, spots):
            rows.append(_near(kerbs, places, metres=_BESIDE, priority=priority))
            if kind != "raised":
                rows.append(_near(kerbs, places, metres=_BESIDE + _RAMP, priority=RAMPS))
    return Layers.concatenate(rows)


def kerb_ends(surfaces: Layers, ends: NDArray[np.object_]) -> Layers:
    """Rows for the ends of sidewalks and kerbs, which come down to level decks.

    They lie above the sidewalks and kerbs themselves and have their features.

    ends : (n,) lines across roads where bridges and tunnels begin, scene metres
    """
    rows = []
    near = shapely.buffer(ends, _END, cap_style="flat")
    for priority, above in ((SIDEWALKS, SIDEWALK_ENDS), (KERBS, KERB_ENDS)):
        bands = surfaces.take(np.flatnonzero(surfaces.priority == priority))
        end, band = _meeting(near, bands.polygon)
        parts = shapely.buffer(shapely.intersection(near[end], bands.polygon[band]), 0.0)
        some = shapely.area(parts) > 0.0
        n = int(some.sum())
        rows.append(replace(bands.take(band[some]), polygon=parts[some], priority=np.full(n, above)))
    return Layers.concatenate(rows)


def _near(kerbs: Layers, others: Layers, *, metres: float, priority: float) -> Layers:
    """The parts of kerbs within ``metres`` of surfaces of other streets."""
    wide = shapely.buffer(others.polygon, metres, cap_style="flat", join_style="mitre")
    other, kerb = _meeting(wide, kerbs.polygon)
    foreign = (others.osm_id[other] != kerbs.osm_id[kerb]) | (others.klass[other] == Class.CROSSING)
    other, kerb = other[foreign], kerb[foreign]
    # Without the lines and points in which some only touch.
    parts = shapely.buffer(shapely.intersection(wide[other], kerbs.polygon[kerb]), 0.0)
    some = shapely.area(parts) > 0.0
    return replace(kerbs.take(kerb[some]), polygon=parts[some], priority=np.full(int(some.sum()), priority))


def _meeting(shapes: NDArray[np.object_], bands: NDArray[np.object_]) -> tuple[Ints, Ints]:
    """Rows of shapes and of bands that intersect, sorted.

    Of rows alike in all else the later covers the earlier, and the order of an index over a part of a map is
    not that over the whole.
    """
    shape, band = shapely.STRtree(bands).query(shapes, predicate="intersects")
    order = np.lexsort((band, shape))
    return shape[order], band[order]


class Beside(NamedTuple):
    """Surfaces that touch the vertices of triangles.

    vertex : (k,) numbers of vertices
    row    : (k,) rows of the layers that touch them, -1 for the base
    inside : (n,) bool, vertices that are not on a tile's side
    """

    vertex: Ints
    row: Ints
    inside: Bools


def rows_beside(plan: GroundPlan, cells: Partition, *, triangles: PlaneTriangles) -> Beside:
    """The rows of the layers that touch the vertices of triangles.

    On a tile's side they are those of all layers there, so that neighbouring tiles agree.
    """
    vertex: Ints = triangles.faces.ravel().astype(np.int64)
    row = np.repeat(cells.row[triangles.cell], 3).astype(np.int64)
    edge = on_border(plan, cells, triangles=triangles)
    inner = ~edge[vertex]
    around = triangles.points[edge][:, None] + AROUND * np.stack(
        [np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1
    )
    vertex = np.concatenate([vertex[inner], np.repeat(np.flatnonzero(edge), len(_DIRECTIONS))])
    return Beside(vertex, np.concatenate([row[inner], rows_at(plan, around.reshape(-1, 2))]), ~edge)


def has_kerbs(plan: GroundPlan, near: Ints) -> bool:
    """Whether any of the rows near a tile raises the ground there."""
    return plan.kerbs is not None and bool(_is_raised(plan.layers.priority[near]).any())


def kerb_heights(plan: GroundPlan, kerbs: Kerbs, *, triangles: PlaneTriangles, beside: Beside) -> Float:
    """Metres (n,) by which vertices of triangles are raised: on sidewalks and on the outside of kerbs.

    What touches a carriageway, water or a tunnel's mouth is not raised.
    """
    vertex, row, inside = beside
    points = triangles.points

    def touched(chosen: Bools) -> Bools:
        return np.bincount(vertex[chosen], minlength=len(points)) > 0

    def nearby(found: Bools) -> Bools:
        # Where a lowered kerb begins, its corner and that of the kerb may be a step of the grid apart.
        near, of = points_in_boxes(points, np.tile(points[found], 2), wider=AROUND)
        near = near[np.hypot(*(points[near] - points[found][of]).T) <= AROUND]
        found = found.copy()
        found[near] |= inside[near]
        return found

    priority = values_at(plan.layers.priority, row, base=-1.0)
    klass = values_at(plan.layers.klass, row, base=plan.base[0])
    raised = touched(_is_raised(priority))
    height = np.where(raised, KERB, 0.0)
    height[raised & nearby(touched(priority == LOWERED))] = KERB_LOWERED
    height[nearby(touched(priority == FLUSH)) | touched(np.isin(klass, _LEVEL))] = 0.0
    vertex, end = shapes_near(kerbs.ends, points, reach=_END)
    away = shapely.distance(shapely.points(points[vertex]), kerbs.ends.geometries[end])
    np.minimum.at(height, vertex, KERB * away / _END)
    return height


def _is_raised(priority: Float) -> Bools:
    """Whether rows are sidewalks or kerbs."""
    sidewalk = (priority >= SIDEWALKS) & (priority <= SIDEWALK_ENDS)
    return sidewalk | ((priority >= KERBS) & (priority <= RAISED))


def on_border(plan: GroundPlan, cells: Partition, *, triangles: PlaneTriangles) -> Bools:
    """Whether vertices (n,) lie on the border of a tile."""
    edge = np.zeros(len(triangles.points), np.bool_)
    x, y = triangles.points.T
    for i, j in np.unique(cells.tile, axis=0):
        xmin, ymin, xmax, ymax = tile_box(plan, i, j=j)
        within = (x >= xmin) & (x <= xmax) & (y >= ymin) & (y <= ymax)
        edge |= within & ((x == xmin) | (x == xmax) | (y == ymin) | (y == ymax))
    return edge


def count_kerbs(layers: Layers) -> dict[str, int]:
    """The numbers of kerbs that are lowered at crossings, or are what the map says."""
    return {
        "kerbs_lowered": int((layers.priority == LOWERED).sum()),
        "kerbs_flush": int((layers.priority == FLUSH).sum()),
        "kerbs_raised": int((layers.priority == RAISED).sum()),
    }


def count_covers(layers: Layers) -> dict[str, int]:
    """The numbers of manhole covers, gullies and patches in carriageways, mapped and guessed."""
    guessed = np.char.startswith(layers.source.astype(np.str_), "guess")
    kinds = {"manholes": COVERS, "gullies": GULLIES, "patches": PATCHES}
    counts = {}
    for name, priority in kinds.items():
        here = layers.priority == priority
        counts[f"{name}_mapped"] = int((here & ~guessed).sum())
        counts[f"{name}_guessed"] = int((here & guessed).sum())
    return {name: count for name, count in counts.items() if count}
