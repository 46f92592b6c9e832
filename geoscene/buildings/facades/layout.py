"""Lays out openings on the walls of a tile."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geoscene.buildings.facades.attached import Attached, attach, without_touching
from geoscene.buildings.facades.description import (
    NAMES,
    SHOP,
    WINDOW,
    Chosen,
    FacadeTable,
    WallRelief,
    make_openings,
)
from geoscene.buildings.facades.doors import Sheet, facing_street, put_guessed_doors, put_mapped_doors
from geoscene.buildings.facades.setting import FacadeSetting
from geoscene.buildings.facades.solids import are_simple
from geoscene.buildings.facades.walls import Elevations, find_walls, in_passages
from geoscene.geometry.mesh import Mesh
from geoscene.support.columns import nth
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Height, Ints

_PLINTH = 0.35
"""Metres from the floor, or from higher ground in front, to the glass of a shop front; assumed."""

_GLASS = (1.2, 2.85)
"""Metres, least and greatest height of the glass of a shop front; assumed."""

_SIGN = 0.7
"""Metres from the glass of a shop front to the ceiling, where its sign is; assumed."""

_FRONT = 4.0
"""Metres of shop front to both sides of the place nearest to a mapped shop; assumed."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Relief of a tile's walls, with counts.

    parts  : solids that stand out of the walls
    counts : walls with openings; walls that stay planes because their outline touches itself, they are small,
             or blank (no opening fits, or their type has none); openings and parts by what they are;
             entrances and shops mapped and left out
    """

    relief: WallRelief
    parts: Attached
    counts: dict[str, int]


def wall_relief(
    mesh: Mesh, setting: FacadeSetting, *, base: Float, height: Height | None, guess: bool = False
) -> Layout:
    """The relief of the walls of a mesh of buildings.

    mesh   : in scene metres, features are rows of the table of buildings
    base   : (count,) z of each building's base, NaN where it is not known
    height : z of the ground at x, y; None if it is 0 everywhere
    guess  : also parts that stand out of walls and are not mapped
    """
    if not len(mesh):
        return Layout(WallRelief.empty(), Attached(mesh, np.empty(0, np.bool_), {}), {})
    walls, of_face = find_walls(mesh)
    simple = are_simple(mesh, of_face, count=len(walls))
    inside = simple & in_passages(walls, setting.buildings, base=base)
    usable = simple & ~inside
    at = Elevations.of(walls, setting, mesh=mesh, of_face=of_face, usable=usable, base=base, height=height)
    walls, grids, cells = at.walls, at.grids, at.cells
    planes = {"touching": int((~simple).sum()), "small": int(usable.sum()) - len(walls)}
    chosen, parts = _choose(at, guess=guess)
    parts, touching = without_touching(parts, mesh)
    openings, index = make_openings(chosen, at.styles, wall=cells.wall)
    kept = np.zeros(len(walls), np.bool_)
    kept[cells.wall[index >= 0]] = True
    again = np.full(len(walls) + 1, -1, np.int32)  # the last row is for faces of no wall
    again[:-1][kept] = np.arange(np.count_nonzero(kept))
    of_face = again[at.of_face]
    index = index[kept[cells.wall]]
    walls, grids = walls.take(kept), grids.take(kept)
    sizes = grids.count.prod(axis=1)
    facades = FacadeTable(
        walls.feature,
        walls.foot,
        walls.tangent,
        walls.size,
        np.column_stack([grids.start, grids.floor - grids.bottom]),
        grids.cell,
        grids.ground,
        grids.count.astype(np.int32),
        (np.cumsum(sizes) - sizes).astype(np.int32),
    )
    planes["blank"] = int((~kept).sum() + inside.sum())
    left = {f"walls_{why}": n for why, n in planes.items()}
    counts = {"walls": len(walls), **left, **parts.counts, "parts_left_out": touching}
    relief = WallRelief(facades, index.astype(np.int32), openings, of_face.astype(np.int32))
    return Layout(relief, parts, counts)


def _choose(at: Elevations, *, guess: bool) -> tuple[Chosen, Attached]:
    """Kind of opening of each cell, projecting solids, and the counts of both."""
    sheet, cells, styles, wall = Sheet(at), at.cells, at.styles, at.cells.wall
    facing = facing_street(at)
    _put_windows(sheet, at)
    mapped = _put_shops(sheet, at, facing=facing) | put_mapped_doors(sheet, at)
    put_guessed_doors(sheet, at, facing=facing)
    parts = attach(sheet, at, facing=facing, guess=guess)
    sizes = np.unique(at.walls.feature, return_counts=True)[1]
    place = nth(sizes)[wall] * 65536 + cells.storey * 256 + cells.column
    draw = uniform_at(styles.seed[wall], place, count=2, seed=1)
    closed = (sheet.kind == WINDOW) & (draw[0] < styles.closed[wall])
    counts = {name: int((sheet.kind == code).sum()) for name, code in NAMES.items()} | mapped | parts.counts
    chosen = Chosen(sheet.kind, sheet.place, closed, draw[1], cells.height)
    return chosen, replace(parts, counts=counts)


def _put_windows(sheet: Sheet, at: Elevations) -> None:
    """Put a window into each cell where it fits."""
    cell = np.flatnonzero((at.styles.window[:, 2] > 0)[at.cells.wall])
    wall = at.cells.wall[cell]
    middle, window = at.grids.middle[wall], at.styles.window[wall]
    half = (window[:, 2] - window[:, 0]) / 2
    box = np.column_stack([middle - half, window[:, 1], middle + half, window[:, 3]])
    fits = sheet.fits(cell, WINDOW, box=box, above=0.2)
    sheet.put(cell[fits], WINDOW, box=box[fits])


def _put_shops(sheet: Sheet, at: Elevations, *, facing: Bools) -> dict[str, int]:
    """Put shop fronts into ground floors to a street; returns how many mapped shops have one or none.

    Buildings with shops in the map have them there, others of their type by chance, on the whole street.
    """
    middle, height = at.grids.middle[at.cells.wall], at.cells.height
    mapped = np.isin(at.walls.feature, at.setting.shops.building)
    whole = at.styles.shop_tagged | (at.styles.shop & ~mapped)
    room = np.flatnonzero((at.cells.storey == 0) & facing[at.cells.wall] & (middle >= 0.8))
    fronts = _fronts_of_shops(at, room)
    chosen = whole[at.cells.wall[room]] | np.isin(room, np.concatenate([room[:0], *fronts]))
    cell = room[chosen]
    middle, half = middle[cell], np.minimum(middle[cell] - 0.15, 2.0)
    lift = at.cells.ground[at.cells.upright[cell]] - at.cells.floor[cell]
    low = _PLINTH + np.ceil(np.maximum(lift, 0.0) * 10 - 1e-6) / 10
    top = np.floor(np.minimum(height[cell] - _SIGN, low + _GLASS[1]) * 20 + 1e-6) / 20
    box = np.column_stack([middle - half, low, middle + half, top])
    fits = sheet.fits(cell, SHOP, box=box, above=0.1) & (top - low >= _GLASS[0])
    sheet.put(cell[fits], SHOP, box=box[fits])
    shown = sum(bool((sheet.kind[front] == SHOP).any()) for front in fronts)
    return {"shops_mapped": shown, "shops_left_out": len(fronts) - shown}


def _fronts_of_shops(at: Elevations, room: Ints) -> list[Ints]:
    """The cells of each mapped shop of these buildings, among those with room for a shop front."""
    shops, wall = at.setting.shops, at.cells.wall[room]
    place = at.walls.points(wall, at.cells.middle[room])
    building = at.walls.feature[wall]
    fronts = []
    for row in np.flatnonzero(np.isin(shops.building, at.walls.feature)).tolist():
        own = np.flatnonzero(building == shops.building[row])
        if len(own):
            nearest = own[np.hypot(*(place[own] - shops.xy[row]).T).argmin()]
            own = own[wall[own] == wall[nearest]]
            own = own[np.hypot(*(place[own] - place[nearest]).T) <= _FRONT]
        fronts.append(room[own])
    return fronts
