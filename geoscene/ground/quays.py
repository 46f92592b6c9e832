"""Walls between water and streets that end above it, as at bridges."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.ground.layers import ROADS, Layers
from geoscene.typing import Float

_WALL = 0.1
"""Metres of the thickness of a wall, in which the ground falls from the street to the water."""

_SHORE = 1.0
"""Metres from a centre line to water at which a street is beside it, or ends at it."""

_SIDE = 2.0
"""Metres of shore beside a carriageway that have a wall."""


def quay_walls(
    water: NDArray[np.object_],
    surfaces: NDArray[np.object_],
    *,
    lines: NDArray[np.object_],
    width: Float,
) -> Layers:
    """Strips of ground in water along the surfaces of streets that end at it or run beside it.

    The shore has the level of the water, so that what borders on it has this level, too.

    water    : polygons of water
    surfaces : polygons of streets on the ground
    lines    : (n,) centre lines of streets on the ground
    width    : (n,) metres of their carriageways
    """
    if not len(water) or not len(lines):
        return Layers.empty()
    row, body = shapely.STRtree(water).query(lines, predicate="dwithin", distance=_SHORE)
    near = shapely.intersection(lines[row], shapely.buffer(water[body], _SHORE, quad_segs=2))
    around = shapely.buffer(near, width[row] / 2 + _SIDE, quad_segs=4)
    tree, strips = shapely.STRtree(surfaces), []
    for area, wet in zip(around, body.tolist(), strict=True):
        beside = surfaces[tree.query(area, predicate="intersects")]
        streets = shapely.union_all(shapely.intersection(beside, area))
        strips.append(shapely.intersection(streets.buffer(_WALL, join_style="mitre"), water[wet]))
    parts = shapely.get_parts(strips)
    return Layers.of(
        parts[shapely.get_dimensions(parts) == 2],
        klass=Class.TERRAIN,
        material=materials()["concrete"].code,
        priority=ROADS - 0.5,
        source="assumed",
    )
