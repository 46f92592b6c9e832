"""Distances of points to the triangles of a scene: exact, tile by tile."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import numpy as np

from geoscene.scene import Scene
from geoscene.scene.layout import OVERHANG
from geoscene.typing import Float
from lidar.geometry.box_tree import Tree, lower_to_nearest, tree_of

_KEPT = 12
"""Tiles whose triangles are in memory: those around a place, and some of the way."""


class _Triangles(NamedTuple):
    """Triangles of a tile: corners (n, 3, 3) less the origin (3,), and their tree."""

    corners: Float
    origin: Float
    tree: Tree


class TrueSurfaces:
    """The surfaces of a scene, with openings of walls and all copies of its shapes.

    Rough ground counts as its planes, which lie above it by the depth of the roughness at most.

    limit : metres, beyond which distances are not sought
    """

    def __init__(self, scene: Scene, *, limit: float) -> None:
        self.limit = limit
        self._scene = scene if scene.relief == "off" else scene.with_relief_mesh()
        self._shapes = [mesh.vertices[mesh.faces] for mesh in scene.shapes().values()]
        self._tiles: OrderedDict[int, _Triangles] = OrderedDict()

    def distances(self, points: Float) -> Float:
        """Distances (n,), scene metres, of points (n, 3) to the nearest triangle; beyond `limit` infinite."""
        squared = np.full(len(points), self.limit**2)
        if len(points):
            low, high = points.min(axis=0), points.max(axis=0)
            boxes, reach = self._scene.tile_boxes, self.limit + OVERHANG
            near = (boxes[:, :2] <= high[:2] + reach) & (boxes[:, 2:] >= low[:2] - reach)
            for rank in np.flatnonzero(near.all(axis=1)).tolist():
                triangles = self._of(rank)
                if len(triangles.corners):
                    lower_to_nearest(points - triangles.origin, triangles.corners, *triangles.tree, squared)
        distance: Float = np.where(squared < self.limit**2, np.sqrt(squared), np.inf)
        return distance

    def _of(self, rank: int) -> _Triangles:
        """The triangles of a tile, read if they are not in memory."""
        if rank in self._tiles:
            self._tiles.move_to_end(rank)
            return self._tiles[rank]
        tile = self._scene.tile(*self._scene.tile_indices[rank])
        parts = [tile.mesh.vertices[tile.mesh.faces]]
        for shape, corners in enumerate(self._shapes):
            placed = tile.instances.transform[tile.instances.shape == shape]
            turned = np.einsum("kij,fcj->kfci", placed[:, :, :3], corners)
            parts.append((turned + placed[:, None, None, :, 3]).reshape(-1, 3, 3))
        corners = np.ascontiguousarray(np.concatenate(parts))
        self._tiles[rank] = _Triangles(
            corners, tile.origin, tree_of(corners.min(axis=1), corners.max(axis=1))
        )
        if len(self._tiles) > _KEPT:
            self._tiles.popitem(last=False)
        return self._tiles[rank]
