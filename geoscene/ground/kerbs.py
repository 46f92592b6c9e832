"""Sidewalks raised above carriageways, and kerbs that are lowered at crossings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely

from geoscene.classes import Class
from geoscene.ground.layers import KERBS, LOWERED, RAMPS, SIDEWALKS, Layers
from geoscene.ground.partition import GroundPlan, Partition, rows_at, tile_box, values_at
from geoscene.ground.triangulate import Triangles
from geoscene.typing import Bools, Float

KERB, KERB_LOWERED = 0.12, 0.03
"""Metres from the carriageway up to sidewalks, and up to lowered kerbs (RASt 06: 12 cm; 3 cm and less)."""

_BESIDE = 0.5
"""Metres beside a crossing over which the kerb is lowered, too."""

_RAMP = 1.0
"""Metres over which a kerb comes down."""

_AROUND = 2.0**-6
_DIRECTIONS = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False) + 0.1
_FLUSH = (
    Class.ROAD,
    Class.LANE_MARKING,
    Class.CROSSING,
    Class.PARKING,
    Class.RAIL,
    Class.WATER,
    Class.TUNNEL,
)


def lowered_kerbs(surfaces: Layers) -> Layers:
    """Rows for the parts of kerbs beside crossings, and for the ramps up from there and from driveways.

    They lie above the kerbs themselves and have their features.
    """
    kerbs = surfaces.take(np.flatnonzero(surfaces.priority == KERBS))
    crossings = surfaces.take(np.flatnonzero(surfaces.klass == Class.CROSSING))
    roads = surfaces.take(np.flatnonzero(surfaces.klass == Class.ROAD))
    return Layers.concatenate(
        [
            _near(kerbs, crossings, metres=_BESIDE, priority=LOWERED),
            _near(kerbs, crossings, metres=_BESIDE + _RAMP, priority=RAMPS),
            _near(kerbs, roads, metres=_RAMP, priority=RAMPS),
        ]
    )


def _near(kerbs: Layers, others: Layers, *, metres: float, priority: float) -> Layers:
    """The parts of kerbs within ``metres`` of surfaces of other streets."""
    wide = shapely.buffer(others.polygon, metres, cap_style="flat", join_style="mitre")
    other, kerb = shapely.STRtree(kerbs.polygon).query(wide, predicate="intersects")
    foreign = (others.osm_id[other] != kerbs.osm_id[kerb]) | (others.klass[other] == Class.CROSSING)
    other, kerb = other[foreign], kerb[foreign]
    # Without the lines and points in which some only touch.
    parts = shapely.buffer(shapely.intersection(wide[other], kerbs.polygon[kerb]), 0.0)
    some = shapely.area(parts) > 0.0
    return replace(kerbs.take(kerb[some]), polygon=parts[some], priority=np.full(int(some.sum()), priority))


def kerb_heights(plan: GroundPlan, cells: Partition, *, triangles: Triangles) -> Float:
    """Metres (n,) by which vertices of triangles are raised: on sidewalks and on the outside of kerbs.

    What touches a carriageway, water or a tunnel's mouth is not raised. The height of a vertex on a tile's
    border depends on all layers there, so that neighbouring tiles agree.
    """
    vertex = triangles.faces.ravel()
    row = np.repeat(cells.row[triangles.cell], 3).astype(np.int64)
    edge = on_border(plan, cells, triangles=triangles)
    inner = ~edge[vertex]
    around = triangles.points[edge][:, None] + _AROUND * np.stack(
        [np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1
    )
    vertex = np.concatenate([vertex[inner], np.repeat(np.flatnonzero(edge), len(_DIRECTIONS))])
    row = np.concatenate([row[inner], rows_at(plan, around.reshape(-1, 2))])

    def touched(chosen: Bools) -> Bools:
        return np.bincount(vertex[chosen], minlength=len(triangles.points)) > 0

    priority = values_at(plan.layers.priority, row, base=-1.0)
    klass = values_at(plan.layers.klass, row, base=plan.base[0])
    raised = touched(np.isin(priority, (SIDEWALKS, KERBS, RAMPS, LOWERED)))
    height = np.where(raised, KERB, 0.0)
    height[touched(priority == LOWERED)] = KERB_LOWERED
    height[touched(np.isin(klass, _FLUSH))] = 0.0
    return height


def on_border(plan: GroundPlan, cells: Partition, *, triangles: Triangles) -> Bools:
    """Whether vertices (n,) lie on the border of a tile."""
    edge = np.zeros(len(triangles.points), np.bool_)
    x, y = triangles.points.T
    for i, j in np.unique(cells.tile, axis=0):
        xmin, ymin, xmax, ymax = tile_box(plan, i, j=j)
        within = (x >= xmin) & (x <= xmax) & (y >= ymin) & (y <= ymax)
        edge |= within & ((x == xmin) | (x == xmax) | (y == ymin) | (y == ymax))
    return edge


def count_lowered(layers: Layers) -> int:
    """The number of lowered kerbs."""
    return int((layers.priority == LOWERED).sum())
