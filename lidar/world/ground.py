"""Heights of the ground under points of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.classes import Class
from geoscene.scene import Scene
from geoscene.typing import Float
from lidar.raycast import Caster

_GROUND = (
    *(Class.ROAD, Class.LANE_MARKING, Class.CROSSING, Class.SIDEWALK, Class.KERB, Class.PARKING, Class.RAIL),
    *(Class.TERRAIN, Class.GRASS, Class.FOREST_FLOOR, Class.SAND, Class.PAVED),
    *(Class.BUILDING_PAD, Class.BRIDGE),
)
_ABOVE, _BELOW = 1.5, 6.0
"""Metres above and below the expected height within which the ground is looked for."""
_SKY = 1e4
"""Metres above and below zero within which the ground is looked for whose height is not known."""
_KNOWN: dict[tuple[Path, float, float], float] = {}
_BORDER = 1e-3
"""Metres from the border of a tile's ground, where rays may miss it, at which heights are taken."""


def ground_heights(scene: Scene, xyz: Float, *, above: float = _ABOVE, below: float = _BELOW) -> Float:
    """Height (n,) of the ground near points (n, 3), metres in the scene frame; NaN without ground.

    One tile is held at a time.
    """
    z: Float = np.full(len(xyz), np.nan)
    if not len(xyz):
        return z
    on, indices = scene.tiles_at(xyz[:, :2]), scene.tile_indices
    for row in np.unique(on[on >= 0]).tolist():
        rows = np.flatnonzero(on == row)
        tile = scene.tile(*indices[row], forests=False)
        faces = tile.mesh.faces[np.isin(tile.mesh.klass, _GROUND)]
        if not len(faces):
            continue
        caster = Caster(tile.mesh.vertices, faces)
        start = xyz[rows] - tile.origin + [0.0, 0.0, above]
        low, high = scene.tile_boxes[row].reshape(2, 2) - tile.origin[:2]
        start[:, :2] = np.clip(start[:, :2], low + _BORDER, high - _BORDER)
        down = np.broadcast_to([0.0, 0.0, -1.0], start.shape)
        hits = caster.cast(start, down, far=above + below)
        found = np.isfinite(hits.range)
        z[rows[found]] = xyz[rows[found], 2] + above - hits.range[found]
    return z


def ground_height(scene: Scene, *, x: float, y: float) -> float:
    """Height of the ground at a place, scene metres; NaN without ground. Cached."""
    key = scene.path, x, y
    if key not in _KNOWN:
        _KNOWN[key] = float(ground_heights(scene, np.array([[x, y, 0.0]]), above=_SKY, below=_SKY)[0])
    return _KNOWN[key]
