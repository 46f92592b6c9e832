"""Facades: the openings of walls, described in wall coordinates, and the kinds of openings.

One description serves scanners, cameras and exports. All of it lies behind the plane of the wall, so that
footprints and solids stay as mapped, and a ray that hits a wall decides there what it hits in the relief.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings.facades.styles import TYPES, Styles
from geoscene.classes import materials
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

T = TypeVar("T", bound=np.generic)

BLANK, WINDOW, SHOP, DOOR, GATE = range(5)
"""What a cell holds."""

NAMES = {"windows": WINDOW, "shop_fronts": SHOP, "doors": DOOR, "gates": GATE}

_SILL = 0.06
"""Metres, height of a sill, and by which it is longer than the window at both ends; assumed."""

_UNDER = 0.1
"""Metres from a window to the lower edge of its panel; assumed."""

_BEHIND = {WINDOW: 0.03, SHOP: 0.04, DOOR: 0.05, GATE: 0.05}
"""Metres from the face of a frame to the pane; assumed."""

_LOGGIA = 1.2
"""Metres, depth of openings without glass; assumed."""

_ROOM, _CURTAIN = 4.0, 0.15
"""Metres from a pane to the back of the room, and to a drawn curtain; assumed."""

_DRAWN = 0.65
"""Draw above which a window that is not shut has its curtains drawn; assumed."""


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


@dataclass(frozen=True, slots=True)
class Chosen(Columns):
    """Kind of opening chosen for each cell (c,).

    kind   : (c,) int64: BLANK, WINDOW, SHOP, DOOR or GATE
    place  : (c, 4) left, lower, right and upper edge of the opening in the cell
    closed : (c,) bool, behind shutters or blinds
    draw   : (c,) random numbers in [0, 1)
    height : (c,) of the cell
    """

    kind: Ints
    place: Float
    closed: Bools
    draw: Float
    height: Float


def depths(kind: int, styles: Styles) -> Float:
    """Depth (n,) of the panes of a kind of opening behind the wall, in each style."""
    loggia = styles.deep & (kind == WINDOW)
    return np.asarray(np.where(loggia, _LOGGIA, styles.reveal + _BEHIND[kind]), float)


def panels(box: Float, kind: int, *, margin: Float) -> Float:
    """The panels (n, 4) around openings (n, 4)."""
    under = np.where(margin > _SILL, _UNDER, margin) if kind == WINDOW else np.full(len(box), 0.02)
    around: Float = box + np.column_stack([-margin, -under, margin, margin])
    return around


def make_openings(chosen: Chosen, styles: Styles, *, wall: Ints) -> tuple[Openings, Ints]:
    """The different openings, and the row (c,) of each cell's, -1 for none.

    styles : of each wall; ``wall`` (c,) is that of each cell
    """
    some = np.flatnonzero(chosen.kind != BLANK)
    rows = _openings(chosen.take(some), styles.take(wall[some]))
    whole = np.column_stack([_whole(getattr(rows, f.name)) for f in fields(Openings)])
    # Few differ, of which only the first are sorted.
    of_row: dict[bytes, int] = {}
    keys = whole.view(f"V{whole.itemsize * whole.shape[1]}").ravel().tolist()
    same = np.array([of_row.setdefault(key, k) for k, key in enumerate(keys)], np.int64)
    first = np.fromiter(of_row.values(), np.int64)
    order = np.lexsort(whole[first].T[::-1])
    place = np.empty(len(some), np.int64)
    place[first[order]] = np.arange(len(first))
    index = np.full(len(wall), -1, np.int64)
    index[some] = place[same]
    return rows.take(first[order]), index


def _whole(column: Float) -> Ints:
    """A column as whole numbers (n, ...): lengths in units of 0.1 mm."""
    scale = 1e4 if column.dtype.kind == "f" else 1
    return np.rint(column.reshape(len(column), *column.shape[1:] or (1,)) * scale).astype(np.int64)


def _openings(chosen: Chosen, styles: Styles) -> Openings:
    """The opening of each cell (n,), given its style."""
    codes = {name: material.code for name, material in materials().items()}
    n, kind, opening = len(chosen), chosen.kind, np.round(chosen.place, 4)
    window, shop, door, gate = (kind == k for k in (WINDOW, SHOP, DOOR, GATE))
    panel = np.zeros((n, 4))
    depth, behind = np.zeros(n), np.zeros(n)
    for k, own in ((WINDOW, window), (SHOP, shop), (DOOR, door), (GATE, gate)):
        panel[own] = panels(opening[own], k, margin=styles.margin[own])
        depth[own], behind[own] = depths(k, styles)[own], _BEHIND[k]
    deep = window & styles.deep
    silled = window & ~deep & (styles.panel > 0) & (styles.margin > _SILL)
    sill = (
        np.column_stack([opening[:, 0] - _SILL, opening[:, 1] - _SILL, opening[:, 2] + _SILL, opening[:, 1]])
        * silled[:, None]
    )
    width = opening[:, 2] - opening[:, 0]
    bars = np.where(window[:, None], styles.bars, 0)
    bars[shop, 0] = np.maximum(np.rint(width[shop] / 1.4) - 1, 0)
    bars[door & (width > 1.25), 0] = 1
    bars[gate, 1] = 4
    bars[deep | (window & chosen.closed)] = 0
    glass_door = np.isin(
        styles.type, [TYPES.index(t) for t in ("office", "curtain", "retail", "hotel", "tower")]
    )
    opaque = np.where(styles.frames == codes["metal"], codes["metal"], codes["wood"])
    infill = np.where(window | shop | (door & glass_door), codes["glass"], opaque)
    infill[gate] = codes["metal"]
    infill[window & chosen.closed] = opaque[window & chosen.closed]
    infill[deep] = codes["concrete"]
    glass = infill == codes["glass"]
    curtain = glass & window & (chosen.draw > _DRAWN)
    room = depth + np.where(curtain, _CURTAIN, _ROOM)
    rooms = np.where(curtain[:, None], np.array([206, 200, 190]), np.array([62, 58, 54]))
    infill_color = np.where(glass[:, None], np.array([70, 82, 88]), styles.colors[:, 1])
    infill_color = np.where((window & chosen.closed)[:, None], styles.colors[:, 2], infill_color)
    infill_color = np.where(deep[:, None], np.array([52, 52, 52]), infill_color)
    return Openings(
        panel=np.round(panel, 4),
        sill=np.round(sill, 4),
        opening=opening,
        panel_depth=styles.panel.copy(),
        reveal_depth=np.round(depth - behind, 4),
        pane_depth=np.round(depth, 4),
        frame=np.where(deep, 0.0, styles.frame),
        bars=bars.astype(np.int32),
        bar=np.where(gate, 0.02, 0.035),
        room=np.round(room, 4),
        trim=np.where(silled, styles.trim, 0).astype(np.uint8),
        frame_material=styles.frames.copy(),
        infill=infill.astype(np.uint8),
        trim_color=styles.colors[:, 3].copy(),
        frame_color=styles.colors[:, 0].copy(),
        infill_color=infill_color.astype(np.uint8),
        room_color=rooms.astype(np.uint8),
        door=door | gate,
    )
