"""Foundations: depth of the walls of buildings, so that no adjacent ground lies lower."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.ground.drape import WaterLevels
from geoscene.ground.layers import Layers
from geoscene.typing import Float, Height

_BESIDE = (0.5, 1.0)
"""Metres outside the walls at which the ground beside a building is looked up."""

_SHORE = 10.0
"""Metres from the walls within which water does: the ground falls evenly from the last vertex on land."""

_MARGIN = 0.5
"""Metres that walls on sloping ground reach below the lowest ground; assumed, less than any storey."""

_AT_ONCE = 1000
"""Footprints whose ground is looked up at once, which bounds the memory."""


def foundation_heights(
    footprints: NDArray[np.object_],
    base: Float,
    *,
    height: Height | None,
    layers: Layers,
    levels: WaterLevels,
) -> Float:
    """Height z (n,) of the lower end of each building's walls: 0.5 m below the adjacent ground.

    That is the lowest of the base, the ground up to 1 m outside the walls, and water up to 10 m away. Where
    none is lower than the base, as on level ground, the walls end at the base.

    footprints : (n,) polygons, scene metres
    base       : (n,) z of the lowest ground along each outline, NaN for an empty footprint
    height     : z of the ground at x, y; None if it is 0 everywhere, as the base then is
    layers     : of the ground; ``levels`` are those of their water
    """
    lowest = np.where(np.isnan(base), np.inf, base)
    if height is not None:
        lowest = np.minimum(lowest, _beside(footprints, height))
    water = np.flatnonzero(layers.body != "")
    near, row = shapely.STRtree(layers.polygon[water]).query(footprints, predicate="dwithin", distance=_SHORE)
    row = water[row]
    stands = ~levels.river[row]
    np.minimum.at(lowest, near[stands], levels.level[row[stands]])
    rivers = near[~stands]
    if len(rivers):
        fine = shapely.segmentize(shapely.boundary(footprints[rivers]), 2.0)
        xy, owner = shapely.get_coordinates(fine, return_index=True)
        np.minimum.at(lowest, rivers[owner], levels.height[levels.nearest.query(xy)[1]])
    return np.where(lowest < base, lowest - _MARGIN, base)


def _beside(footprints: NDArray[np.object_], height: Height) -> Float:
    """The lowest ground (n,) up to 1 m outside each building's walls; inf for an empty footprint."""
    lowest = np.full(len(footprints), np.inf)
    for first in range(0, len(footprints), _AT_ONCE):
        some = footprints[first : first + _AT_ONCE]
        for reach in _BESIDE:
            rim = shapely.boundary(shapely.buffer(some, reach, quad_segs=2))
            xy, owner = shapely.get_coordinates(shapely.segmentize(rim, 1.0), return_index=True)
            np.minimum.at(lowest, first + owner, height(xy[:, 0], xy[:, 1]))
    return lowest
