"""The grid of cells on each wall, and the ground in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.setting import FacadeSetting
from geoscene.buildings.facades.styles import Styles
from geoscene.buildings.facades.walls import FacadeWalls
from geoscene.geometry.mesh import Mesh
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Height, Ints

_BESIDE = 0.3
"""Metres outside a wall at which the ground beside it is looked up."""


@dataclass(frozen=True, slots=True)
class Grids(Columns):
    """Grid of each wall; metres. Heights are above the building's base.

    row    : (k,) row of the table that the wall belongs to
    zero   : (k,) z of the building's base
    bottom : (k,) height of the wall's lower edge
    floor  : (k,) height of the lowest row of cells
    storey : (k,) int64 number of that row, 0 for the ground floor
    ground : (k,) height of that row's cells
    cell   : (k, 2)
    start  : (k,) from the wall's left edge to the first cell
    middle : (k,) from a cell's left edge to the middle of its openings
    count  : (k, 2) int64 columns and rows
    """

    row: Ints
    zero: Float
    bottom: Float
    floor: Float
    storey: Ints
    ground: Float
    cell: Float
    start: Float
    middle: Float
    count: Ints


@dataclass(frozen=True, slots=True)
class FacadeCells:
    """All cells of the walls, row by row from the bottom.

    wall, column, storey : (c,) int64; storeys count from the ground floor of the building
    middle : (c,) metres from the wall's left edge to the middle of the openings
    floor  : (c,) height above the building's base
    height : (c,) of the cell
    upright : (c,) int64, number of the column among all columns of all walls
    ground : (u,) height of the ground before each column above the building's base
    """

    wall: Ints
    column: Ints
    storey: Ints
    middle: Float
    floor: Float
    height: Float
    upright: Ints
    ground: Float


@dataclass(frozen=True, slots=True)
class Elevations:
    """The walls of a tile with their grids.

    walls   : those with room for cells
    grids   : one row for each wall
    styles  : likewise
    cells   : of all walls
    setting : map-wide data
    mesh    : the tile's buildings, scene metres
    of_face : (m,) row of ``walls`` of each face of the mesh, -1 for others
    base    : (count,) z of each building's base, NaN where it is not known
    height  : z of the ground at x, y; None if it is 0 everywhere
    """

    walls: FacadeWalls
    grids: Grids
    styles: Styles
    cells: FacadeCells
    setting: FacadeSetting
    mesh: Mesh
    of_face: NDArray[np.int32]
    base: Float
    height: Height | None

    @classmethod
    def of(
        cls,
        walls: FacadeWalls,
        setting: FacadeSetting,
        *,
        mesh: Mesh,
        of_face: NDArray[np.int32],
        usable: Bools,
        base: Float,
        height: Height | None,
    ) -> Elevations:
        """The elevations of those usable walls that have room for cells.

        of_face : (m,) wall of each face of the mesh, -1 for none
        """
        row = _table_rows(walls, setting, base=base)
        grids = _grids(walls, setting, row=row, base=base)
        some = np.flatnonzero(usable & (grids.count.min(axis=1) > 0))
        walls, grids = walls.take(some), grids.take(some)
        styles = setting.styles.take(grids.row)
        cells = _cells(walls, grids, styles=styles, height=height)
        number = np.full(len(usable) + 1, -1, np.int32)  # the last row is for faces of no wall
        number[some] = np.arange(len(some))
        return cls(walls, grids, styles, cells, setting, mesh, number[of_face], base, height)


def _table_rows(walls: FacadeWalls, setting: FacadeSetting, *, base: Float) -> Ints:
    """Row of the table (k,) of each wall: its building, or the part just behind it at half its height."""
    table = setting.buildings
    row = walls.feature.astype(np.int64)
    divided = np.flatnonzero(~table.drawn[row])
    if not len(divided):
        return row
    behind = walls.points(divided, walls.size[divided, 0] / 2, out=-0.15)
    at, found = setting.solid.query(shapely.points(behind), predicate="intersects")
    part = setting.rows[found]
    wall = divided[at]
    middle = walls.foot[wall, 2] + walls.size[wall, 1] / 2 - base[row[wall]]
    fits = (table.outline[part] == row[wall]) & (middle >= table.min_height[part] - 0.1)
    fits &= middle <= table.height[part] + 0.1
    order = np.lexsort((part[fits], wall[fits]))
    row[wall[fits][order][::-1]] = part[fits][order][::-1]  # the first part remains
    return row


def _grids(walls: FacadeWalls, setting: FacadeSetting, *, row: Ints, base: Float) -> Grids:
    styles, table = setting.styles.take(row), setting.buildings
    zero = base[walls.feature]
    bottom = walls.foot[:, 2] - zero
    top = bottom + walls.size[:, 1]
    above = np.ceil((bottom - styles.ground - 0.02) / styles.storey).astype(np.int64) + 1
    storey = np.where(bottom <= 0.3, 0, np.maximum(above, 1))
    floor = np.where(storey > 0, styles.ground + (storey - 1) * styles.storey, 0.0)
    # a storey under a pitched roof has windows in gables
    attic = (table.roof_height[row] > 1.5) & (top > table.height[row] - table.roof_height[row] + 1.0)
    rows = np.minimum(
        styles.storeys + attic, np.ceil((top - styles.ground) / styles.storey - 0.05).astype(np.int64) + 1
    )
    width = walls.size[:, 0]
    widest = np.maximum(styles.window[:, 2] - styles.window[:, 0], styles.gate[:, 0] * (styles.bay < 3.2))
    # at both ends a window keeps as far from the corner as it is deep
    least = np.maximum(widest, 0.5) + 2 * (styles.margin + styles.reveal + 0.1)
    columns = np.maximum(np.rint(width / styles.bay), 1)
    columns -= width / columns < least
    columns = np.where(styles.stretch, columns, np.floor((width - 0.2) / styles.bay)).astype(np.int64)
    cell = np.where(styles.stretch, width / np.maximum(columns, 1), styles.bay)
    # middles on a grid of 25 cm let walls of different bays share kinds of openings
    middle = np.where(styles.stretch, np.maximum(np.floor(cell * 2.0) / 4.0, least / 2), cell / 2)
    start = np.where(styles.stretch, cell / 2 - middle, (width - columns * cell) / 2)
    count = np.stack([columns, rows - storey], axis=1)
    return Grids(
        row,
        zero,
        bottom,
        floor,
        storey,
        np.where(storey > 0, styles.storey, styles.ground),
        np.column_stack([cell, styles.storey]),
        start,
        middle,
        np.maximum(count, 0),
    )


def _cells(walls: FacadeWalls, grids: Grids, *, styles: Styles, height: Height | None) -> FacadeCells:
    """The cells of grids."""
    columns, rows = grids.count.T
    wall = np.repeat(np.arange(len(walls)), columns * rows)
    row, column = np.divmod(nth(columns * rows), columns[wall])
    storey = grids.storey[wall] + row
    floor = np.where(row > 0, grids.floor[wall] + grids.ground[wall] + (row - 1) * styles.storey[wall],
                     grids.floor[wall])  # fmt: skip
    before = np.cumsum(columns) - columns
    of = np.repeat(np.arange(len(walls)), columns)
    middle = grids.start[of] + grids.middle[of] + nth(columns) * grids.cell[of, 0]
    return FacadeCells(
        wall,
        column,
        storey,
        middle[before[wall] + column],
        floor,
        np.where(row > 0, styles.storey[wall], grids.ground[wall]),
        before[wall] + column,
        _ground(walls, grids, of=of, middle=middle, height=height),
    )


def nth(sizes: Ints) -> Ints:
    """Position (n,) of each row in its group, given the sizes of groups."""
    return np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)


def _ground(walls: FacadeWalls, grids: Grids, *, of: Ints, middle: Float, height: Height | None) -> Float:
    """Height (u,) of the highest ground in front of each column, above the building's base."""
    if height is None:
        return -grids.zero[of]
    half = np.minimum(grids.middle[of], grids.cell[of, 0] / 2)
    found = [
        height(*walls.points(of, np.clip(middle + shift * half, 0.0, walls.size[of, 0]), out=_BESIDE).T)
        for shift in (-1.0, 0.0, 1.0)
    ]
    highest: Float = np.max(found, axis=0) - grids.zero[of]
    return highest
