"""Openings of walls in the tiles of a world."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings.facades import WallRelief
from geoscene.classes import Class, materials
from geoscene.geometry.mesh import WALL
from geoscene.typing import Float
from lidar.raycast.relief import PARTS, WallTables, pairs_of, tables_of
from lidar.world.surfaces import Surfaces

_ROOM = "plaster"
"""Material of the rooms behind panes."""


class TileOpenings(NamedTuple):
    """The openings of a tile: tables of their geometry, and the surfaces of their additional faces."""

    tables: WallTables
    surfaces: Surfaces


def openings_of(relief: WallRelief, *, origin: Float, bits: NDArray[np.uint32]) -> TileOpenings:
    """The openings of a tile with its origin (3,) in scene metres; ``bits`` (256,) are masks by material."""
    pairs = pairs_of(relief)
    kinds = relief.openings.take(pairs.kind)
    n = PARTS * len(pairs.kind)
    room = np.full(len(pairs.kind), materials()[_ROOM].code, np.uint8)
    return TileOpenings(
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
