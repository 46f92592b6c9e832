"""The tiles of a scene without the kinds of objects that the settings of a world leave out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geoscene.classes import Class
from geoscene.mesh import Instances, Mesh
from geoscene.scene import Scene
from geoscene.scene.tile_files import Tile
from lidar.world.settings import WorldSettings

_CLASSES = {
    "trees": (Class.TREE_CROWN, Class.TRUNK),
    "furniture": (
        Class.POLE,
        Class.TRAFFIC_SIGN,
        Class.TRAFFIC_LIGHT,
        Class.BOLLARD,
        Class.BENCH,
        Class.WIRE,
    ),
    "barriers": (Class.WALL, Class.FENCE, Class.HEDGE),
}


def selected_tile(scene: Scene, rank: int, *, settings: WorldSettings, shapes: Sequence[Mesh]) -> Tile:
    """A tile, by its number in the scene, with what the settings ask for.

    shapes : of the scene; an instance has the class of the first face of its shape
    """
    i, j = scene.tile_indices[rank]
    tile = scene.tile(i, j, forests=settings.forests)
    without = [code for name, codes in _CLASSES.items() if not getattr(settings, name) for code in codes]
    if not without:
        return tile
    mapped = tile.instances
    if settings.forests:  # the trees of forests follow those of the file
        mapped = mapped.take(np.arange(len(scene.tile(i, j, forests=False).instances)))
    forest = tile.instances.take(np.arange(len(mapped), len(tile.instances)))
    classes = np.array([mesh.klass[0] for mesh in shapes], np.uint8)
    mapped = mapped.take(np.flatnonzero(~np.isin(classes[mapped.shape], without)))
    keep = ~np.isin(tile.mesh.klass, without)
    relief = tile.relief
    return replace(
        tile,
        mesh=tile.mesh.take(keep),
        relief=None if relief is None else replace(relief, wall=relief.wall[keep]),
        instances=Instances.concatenate([mapped, forest]),
    )
