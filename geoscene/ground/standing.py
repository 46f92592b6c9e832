"""Height of the surface below objects, with sidewalks and cambered carriageways."""

from __future__ import annotations

import functools

import numpy as np
import shapely

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh
from geoscene.ground.kerbs import KERB
from geoscene.ground.layers import SIDEWALKS
from geoscene.ground.nearby import points_in_boxes
from geoscene.ground.partition import GroundPlan, rows_at, values_at
from geoscene.typing import Float, Height

_NO_FLOOR = (Class.WATER, Class.TUNNEL)


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
