"""Facades: the openings of walls, described in wall coordinates.

One description serves scanners, cameras and exports. All of it lies behind the plane of the wall, so that
footprints and solids stay as mapped, and a ray that hits a wall decides there what it hits in the relief.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Openings(Columns):
    """Kinds of openings, one row each; many cells of `FacadeTable` share one. Metres.

    A cell is a rectangle of the wall with the coordinates x to the right (seen from outside) and y up from
    its lower left corner, and z the depth behind the plane of the wall. Behind the plane lie three layers,
    each a box with blocks that fill it from front to back; it opens on the next one through its back:

    1. the panel: ``panel``, from z = 0 to ``panel_depth``, with the sill as a block;
    2. the reveal: ``opening``, within the panel, from ``panel_depth`` to ``reveal_depth``;
    3. the panes: ``opening`` less ``frame`` on each side, from ``reveal_depth`` to ``pane_depth``, with
       ``bars`` as blocks; its back is the infill.

    panel   : (t, 4) x and y of its lower left, x and y of its upper right corner; inside the cell
    sill    : (t, 4) likewise, inside the panel and outside the opening; empty (zeros) for none
    opening : (t, 4) likewise, inside the panel
    panel_depth, reveal_depth, pane_depth : (t,) 0 <= panel < reveal < pane
    frame   : (t,) width of the frame
    bars    : (t, 2) int32, number of vertical and of horizontal bars, evenly spaced
    bar     : (t,) width of the bars
    room    : (t,) depth of the room behind glass, from the plane of the wall; as wide and high as the cell
    trim, frame_material, infill : (t,) uint8, materials of the sill, of the frame with its bars, and of the
              infill (glass, wood, metal); panel and reveal have the material of the wall
    trim_color, frame_color, infill_color, room_color : (t, 3) uint8, sRGB
    door     : (t,) bool, a door or a gate
    """

    panel: Float
    sill: Float
    opening: Float
    panel_depth: Float
    reveal_depth: Float
    pane_depth: Float
    frame: Float
    bars: NDArray[np.int32]
    bar: Float
    room: Float
    trim: NDArray[np.uint8]
    frame_material: NDArray[np.uint8]
    infill: NDArray[np.uint8]
    trim_color: NDArray[np.uint8]
    frame_color: NDArray[np.uint8]
    infill_color: NDArray[np.uint8]
    room_color: NDArray[np.uint8]
    door: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class FacadeTable(Columns):
    """Flat upright walls of buildings with openings, one row each; coordinates of the tile, metres.

    The cells of a wall are a grid: columns of one width from ``start`` on, a ground floor and storeys of one
    height above. A wall is a union of faces of the mesh in one plane; the panel of every cell with an opening
    lies within it.

    feature  : (k,) int32, feature number of the building
    foot     : (k, 3) lower left corner of the wall, seen from outside, on its plane
    tangent  : (k, 2) horizontal unit vector to the right, seen from outside; (y, -x) of it points outwards
    size     : (k, 2) width and height of the wall
    start    : (k, 2) lower left corner of the first cell, from ``foot``
    cell     : (k, 2) width and height of a cell
    ground   : (k,) height of the cells of the ground floor
    grid     : (k, 2) int32, number of columns and of rows, the ground floor included
    first    : (k,) int32, the wall's first cell in `WallRelief.cells`; they run row by row from below
    """

    feature: NDArray[np.int32]
    foot: Float
    tangent: Float
    size: Float
    start: Float
    cell: Float
    ground: Float
    grid: NDArray[np.int32]
    first: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class WallRelief:
    """The facades of a tile.

    facades  : the walls
    cells    : (c,) int32, row of ``openings`` of each cell, -1 for none
    openings : kinds of openings
    wall     : (m,) int32, row of ``facades`` of each face of the tile's mesh, -1 for other faces
    """

    facades: FacadeTable
    cells: NDArray[np.int32]
    openings: Openings
    wall: NDArray[np.int32]

    @classmethod
    def empty(cls) -> WallRelief:
        """The relief of a mesh without faces."""

        def none(kind: type[T], *width: int) -> NDArray[T]:
            return np.empty((0, *width), kind)

        real, count, code = np.float64, np.int32, np.uint8
        facades = FacadeTable(
            none(count), none(real, 3), none(real, 2), none(real, 2), none(real, 2), none(real, 2),
            none(real), none(count, 2), none(count),
        )  # fmt: skip
        openings = Openings(
            none(real, 4), none(real, 4), none(real, 4), none(real), none(real), none(real), none(real),
            none(count, 2), none(real), none(real), none(code), none(code), none(code), none(code, 3),
            none(code, 3), none(code, 3), none(code, 3), none(np.bool_),
        )  # fmt: skip
        return cls(facades, none(count), openings, none(count))

    def placed(self, offset: Float, *, faces: int) -> WallRelief:
        """The relief moved by ``offset`` (3,), of a mesh of ``faces`` faces that begins with its own."""
        wall = np.full(faces, -1, np.int32)
        wall[: len(self.wall)] = self.wall
        return replace(self, facades=replace(self.facades, foot=self.facades.foot + offset), wall=wall)
