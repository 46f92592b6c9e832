"""Heights on which buildings and objects stand: foundations, and the surface with kerbs and camber."""

from __future__ import annotations

import functools

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh
from geoscene.ground.drape import WaterLevels
from geoscene.ground.kerbs import KERB
from geoscene.ground.layers import SIDEWALKS, Layers
from geoscene.ground.partition import GroundPlan, rows_at, values_at
from geoscene.ground.relief import points_in_boxes
from geoscene.typing import Float, Height

_NO_FLOOR = (Class.WATER, Class.TUNNEL)

_BESIDE = (0.5, 1.0)
"""Metres outside the walls at which the ground beside a building is looked up."""

_SHORE = 10.0
"""Metres from the walls within which water does: the ground falls evenly from the last vertex on land."""

_MARGIN = 0.5
"""Metres that walls on sloping ground reach below the lowest ground; assumed, less than any storey."""

_AT_ONCE = 1000
"""Footprints whose ground is looked up at once, which bounds the memory."""


def standing_height(plan: GroundPlan, height: Height | None, *, ground: Mesh | None = None) -> Height | None:
    """Height z (n,) of the surface below objects at x, y (n,); ``height`` itself without kerbs.

    On the ground of a tile it is that of its faces, save in water; elsewhere it is ``height``, on raised
    sidewalks higher by a kerb.

    height : of the ground at the edges of carriageways, None if it is 0 everywhere
    ground : faces of the tile's ground, scene metres
    """
    if plan.kerbs is None:
        return height

    @functools.cache
    def floor() -> tuple[Float, Float]:
        """Corners (m, 3, 3) of walkable faces, and their bounding boxes (m, 4) in plan."""
        faces = Mesh.empty() if ground is None else ground.take(~np.isin(ground.klass, _NO_FLOOR))
        corners = faces.vertices[faces.faces]
        return corners, np.hstack([corners[..., :2].min(axis=1), corners[..., :2].max(axis=1)])

    def standing(x: Float, y: Float) -> Float:
        xy = np.column_stack([x, y])
        z = np.zeros(len(xy)) if height is None else np.array(height(x, y), float)
        corners, boxes = floor()
        point, face = points_in_boxes(xy, boxes, wider=0.0)
        on = shapely.intersects_xy(shapely.polygons(corners[face][..., :2]), xy[point, 0], xy[point, 1])
        point, face = point[on], face[on]
        beyond = np.setdiff1d(np.arange(len(xy)), point)
        priority = values_at(plan.layers.priority, rows_at(plan, xy[beyond]), base=-1.0)
        z[beyond] += np.where(priority == SIDEWALKS, KERB, 0.0)
        z[point] = _heights(corners[face], xy[point])
        return z

    return standing


def _heights(corners: Float, xy: Float) -> Float:
    """Height (n,) of each face (n, 3, 3) at a point (n, 2)."""
    a = corners[:, 0]
    normal = np.cross(corners[:, 1] - a, corners[:, 2] - a)
    z: Float = a[:, 2] - ((xy - a[:, :2]) * normal[:, :2]).sum(axis=1) / normal[:, 2]
    return z


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
