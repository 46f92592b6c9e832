"""The tiles of a scene without what the settings of a world leave out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.geometry.mesh import Mesh, ShapeInstances
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


_PLAIN_SHAPES = {"bicycle_stand_1": "bicycle_stand", "bicycle_stand_2": "bicycle_stand"}
"""Shapes of mapped objects to which full relief adds something, here bicycles, and those without it."""


def selected_tile(scene: Scene, rank: int, *, settings: WorldSettings, shapes: Mapping[str, Mesh]) -> Tile:
    """A tile, by its number in the scene, with what the settings ask for.

    shapes : of the scene by name; an instance has the class of the first face of its shape
    """
    i, j = scene.tile_indices[rank]
    tile = scene.tile(i, j, forests=settings.forests)
    without = [code for name, codes in _CLASSES.items() if not getattr(settings, name) for code in codes]
    full_parts = tile.full_parts if settings.relief in {"off", "plain"} else None
    if not without and full_parts is None:
        return tile
    mapped = tile.instances
    if full_parts is not None:  # the trees of forests follow those of the file
        mapped = mapped.take(np.arange(len(full_parts.instances)))
    elif settings.forests:
        mapped = mapped.take(np.arange(len(scene.tile(i, j, forests=False).instances)))
    forest = tile.instances.take(np.arange(len(mapped), len(tile.instances)))
    classes = np.array([mesh.klass[0] for mesh in shapes.values()], np.uint8)
    keep, kept = ~np.isin(tile.mesh.klass, without), ~np.isin(classes[mapped.shape], without)
    if full_parts is not None:
        keep, kept = keep & ~full_parts.faces, kept & ~full_parts.instances
        mapped = replace(mapped, shape=_plain_shapes(shapes)[mapped.shape])
    relief = tile.relief
    return replace(
        tile,
        mesh=tile.mesh.take(keep),
        relief=None if relief is None else replace(relief, wall=relief.wall[keep]),
        full_parts=None,
        instances=ShapeInstances.concatenate([mapped.take(np.flatnonzero(kept)), forest]),
    )


def _plain_shapes(shapes: Mapping[str, Mesh]) -> NDArray[np.int32]:
    """The plain shape of each shape."""
    number = {name: k for k, name in enumerate(shapes)}
    return np.array([number[_PLAIN_SHAPES.get(name, name)] for name in shapes], np.int32)
