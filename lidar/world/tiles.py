"""Tiles of a scene as worlds load them: what the settings ask for, with the openings of walls."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings.facades import WallRelief
from geoscene.classes import Class, materials
from geoscene.geometry.mesh import WALL, Mesh, ShapeInstances
from geoscene.scene import Scene
from geoscene.scene.tile_files import Tile
from geoscene.typing import Float
from lidar.raycast import Geometry
from lidar.raycast.geometry import split
from lidar.raycast.relief import (
    NO_WALLS,
    PARTS,
    GroundTables,
    WallTables,
    ground_tables,
    pairs_of,
    tables_of,
)
from lidar.world.settings import WorldSettings
from lidar.world.surfaces import Surfaces, mask_bits, surfaces_of

_ROOM = "plaster"
"""Material of the rooms behind panes."""


def openings_of(
    relief: WallRelief, *, origin: Float, bits: NDArray[np.uint32]
) -> tuple[WallTables, Surfaces]:
    """Tables of the openings of a tile, and the surfaces of their additional faces.

    origin : (3,) of the tile, scene metres
    bits   : (256,) masks by material
    """
    pairs = pairs_of(relief)
    kinds = relief.openings.take(pairs.kind)
    n = PARTS * len(pairs.kind)
    room = np.full(len(pairs.kind), materials()[_ROOM].code, np.uint8)
    return (
        tables_of(relief, pairs, origin=origin, bits=bits),
        Surfaces(
            feature=np.repeat(relief.facades.feature[pairs.wall], PARTS).astype(np.int32),
            klass=np.full(n, Class.BUILDING, np.uint8),
            material=np.column_stack([kinds.trim, kinds.frame_material, kinds.infill, room]).reshape(n),
            surface=np.full(n, WALL, np.uint8),
            color=np.stack(
                [kinds.trim_color, kinds.frame_color, kinds.infill_color, kinds.room_color], axis=1
            ).reshape(n, 3),
        ),
    )


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


@dataclass(frozen=True, slots=True, weakref_slot=True)
class LoadedTile:
    """A tile in worlds with one origin: parts by mask, attributes of faces, instances in scene metres.

    Worlds share it, and change none of its arrays.

    scene    : it is of
    parts    : relative to the origin of the worlds
    surfaces : of the faces of the mesh, then of those that ``walls`` adds
    walls    : openings of its walls
    ground   : roughness of its ground, None for none
    centre   : (m, 3) of the faces of the mesh, scene metres; then zeros
    """

    scene: Scene
    parts: tuple[Geometry, ...]
    surfaces: Surfaces
    walls: WallTables
    ground: GroundTables | None
    instances: ShapeInstances
    centre: Float


def load_tile(
    scene: Scene, rank: int, *, origin: Float, settings: WorldSettings, shapes: Mapping[str, Mesh]
) -> LoadedTile:
    """A tile, by its number in the scene, for worlds with an origin (3,) in scene metres."""
    tile = selected_tile(scene, rank, settings=settings, shapes=shapes)
    mesh, surfaces, walls = tile.mesh, surfaces_of(tile.mesh, settings), NO_WALLS
    centre = mesh.vertices[mesh.faces].mean(axis=1) + tile.origin
    if tile.relief is not None:
        bits = mask_bits(np.arange(256, dtype=np.uint8))
        walls, added = openings_of(tile.relief, origin=tile.origin, bits=bits)
        surfaces = Surfaces.concatenate([surfaces, added])
        centre = np.concatenate([centre, np.zeros((len(added), 3))])
    is_rough = scene.relief != "off" and settings.relief != "off"
    return LoadedTile(
        scene,
        tuple(split(mesh.vertices + (tile.origin - origin), mesh.faces, mask=mask_bits(mesh.material))),
        surfaces,
        walls,
        ground_tables(mesh, origin=tile.origin) if is_rough else None,
        tile.instances.shifted(tile.origin),
        centre,
    )


class SharedTiles:
    """Tiles that all worlds of a process share: loaded once, and known while anyone holds them.

    Those last kept are held here, until others are: a drive is planned, sees satellites and is recorded in
    worlds one after the other, at first in the same place.
    """

    def __init__(self) -> None:
        self._known: weakref.WeakValueDictionary[object, LoadedTile] = weakref.WeakValueDictionary()
        self._kept: tuple[LoadedTile, ...] = ()
        self._lock = threading.Lock()

    def get(self, key: object, load: Callable[[], LoadedTile]) -> LoadedTile:
        """The tile of a key, loaded if it is not known; threads that want it meanwhile wait."""
        with self._lock:
            found = self._known.get(key)
            if found is None:
                found = self._known[key] = load()
            return found

    def keep(self, tiles: Iterable[LoadedTile]) -> None:
        """Hold tiles, instead of those kept before."""
        self._kept = tuple(tiles)
