"""The flat upright walls among the faces of buildings, the grid of cells on each, the ground before it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.setting import FacadeSetting
from geoscene.buildings.facades.styles import Styles
from geoscene.buildings.table import Buildings
from geoscene.geometry.mesh import WALL, Mesh
from geoscene.geometry.watertight import edge_uses, weld
from geoscene.support.columns import Columns, nth
from geoscene.support.graphs import components
from geoscene.typing import Bools, Float, Height, Ints

_UPRIGHT = 1e-3
"""Maximum vertical component of the unit normal of an upright face."""

_TURN = 1e-3
"""Radians between the bearings of faces of one plane, above the error of corners on a grid of 0.1 mm."""

_BEFORE = 0.15
"""Metres before a wall at which a passage is looked for; passages reach less beyond facades."""

_BESIDE = 0.3
"""Metres outside a wall at which the ground beside it is looked up."""


@dataclass(frozen=True, slots=True)
class FacadeWalls(Columns):
    """Flat upright walls, sorted by feature: connected faces of one feature in one plane.

    feature : (k,) int32
    foot    : (k, 3) lower left corner, seen from outside, of the rectangle around the wall
    tangent : (k, 2) horizontal unit vector to the right, seen from outside
    size    : (k, 2) width and height of that rectangle, metres
    polygon : (k,) shapely polygon in the wall's coordinates (x right, y up from foot); None where the wall is
              the rectangle
    """

    feature: NDArray[np.int32]
    foot: Float
    tangent: Float
    size: Float
    polygon: NDArray[np.object_]

    @property
    def outwards(self) -> Float:
        """(k, 2) horizontal unit vectors that point out of the building."""
        return np.stack([self.tangent[:, 1], -self.tangent[:, 0]], axis=1)

    def points(self, wall: Ints, u: Float, *, out: Float | float = 0.0) -> Float:
        """Plan coordinates (n, 2) of points at ``u`` metres along walls (n,) and ``out`` metres outside."""
        away = np.broadcast_to(np.asarray(out, float), u.shape)[:, None]
        return self.foot[wall, :2] + u[:, None] * self.tangent[wall] + away * self.outwards[wall]


def find_walls(mesh: Mesh) -> tuple[FacadeWalls, NDArray[np.int32]]:
    """The walls of a mesh of buildings, and the row (m,) of the wall of each face, -1 for none."""
    normal = mesh.normals()
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    face = np.flatnonzero((mesh.surface == WALL) & (np.abs(normal[:, 2]) < _UPRIGHT) & (area > 0))
    of_face = np.full(len(mesh), -1, np.int32)
    if not len(face):
        return _none(), of_face
    wall = _connect(corners[face], _bearings(normal[face, :2], feature=mesh.feature[face]))
    walls, number = _measure(
        corners[face], normal[face, :2], feature=mesh.feature[face], wall=wall, area=area[face]
    )
    of_face[face] = number
    return walls, of_face


def in_passages(walls: FacadeWalls, buildings: Buildings, *, base: Float) -> Bools:
    """Whether walls (k,) are those of passages through their building, which have no openings.

    base : (count,) z of each building's base
    """
    inside = np.zeros(len(walls), np.bool_)
    for building in np.unique(walls.feature).tolist():
        passages = buildings.passages[building]
        if not len(passages):
            continue
        mine = np.flatnonzero(walls.feature == building)
        before = shapely.points(walls.points(mine, walls.size[mine, 0] / 2, out=_BEFORE))
        top = walls.foot[mine, 2] + walls.size[mine, 1] - base[building]
        for polygon, height in passages:
            inside[mine] |= (top < height + _BEFORE) & shapely.intersects(polygon, before)
    return inside


def _none() -> FacadeWalls:
    return FacadeWalls(
        np.empty(0, np.int32), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, object)
    )


def _bearings(normal: Float, *, feature: NDArray[np.int32]) -> Ints:
    """Number (m,) of the feature and bearing of each face; connected faces of one bearing are in one plane.

    Sorting and splitting at gaps groups values that differ by rounding errors; rounded keys would not.
    """
    turn = np.arctan2(normal[:, 1], normal[:, 0])
    turn = np.where(turn > np.pi - _TURN, turn - 2 * np.pi, turn)
    order = np.lexsort((turn, feature))
    bearing = np.empty(len(turn), np.int64)
    bearing[order] = _runs(feature[order], turn[order], gap=_TURN)
    return bearing


def _runs(key: NDArray[np.integer], value: Float, *, gap: float) -> Ints:
    """Numbers (n,) of the runs in sorted rows: a new one where the key changes or the value jumps."""
    numbers = np.zeros(len(key), np.int64)
    np.cumsum((np.diff(key) != 0) | (np.diff(value) > gap), out=numbers[1:])
    return numbers


def _of_largest(value: Float, *, group: Ints, area: Float) -> Float:
    """The value (k, ...) of the largest face of each group."""
    order = np.lexsort((area, group))
    last = np.flatnonzero(np.diff(group[order], append=-1) != 0)
    largest: Float = value[order[last]]
    return largest


def _connect(corners: Float, bearing: Ints) -> Ints:
    """Number (m,) of the wall of each face: faces of one bearing that edges connect."""
    ids, _ = weld(corners.reshape(-1, 3), np.repeat(bearing, 3))
    edge, uses, _ = edge_uses(ids.reshape(-1, 3))
    face, m = np.repeat(np.arange(len(bearing)), 3), len(bearing)
    return components(face, m + edge, count=m + len(uses))[:m]


def _measure(
    corners: Float, normal: Float, *, feature: NDArray[np.int32], wall: Ints, area: Float
) -> tuple[FacadeWalls, Ints]:
    """The walls, sorted by feature and place, and the row (m,) of each face."""
    _, first, wall = np.unique(wall, return_index=True, return_inverse=True)
    k = len(first)
    out = _of_largest(normal, group=wall, area=area)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    tangent = np.stack([-out[:, 1], out[:, 0]], axis=1)
    along = np.einsum("ijk,ik->ij", corners[:, :, :2], tangent[wall])
    anchor = _of_largest(corners[:, 0, :2], group=wall, area=area)
    away = np.einsum("ij,ij->i", anchor, out)
    left, right, low, high = np.full(k, np.inf), np.full(k, -np.inf), np.full(k, np.inf), np.full(k, -np.inf)
    np.minimum.at(left, wall, along.min(axis=1))
    np.maximum.at(right, wall, along.max(axis=1))
    np.minimum.at(low, wall, corners[:, :, 2].min(axis=1))
    np.maximum.at(high, wall, corners[:, :, 2].max(axis=1))
    foot = np.column_stack([left[:, None] * tangent + away[:, None] * out, low])
    order = np.lexsort((foot[:, 2], foot[:, 1], foot[:, 0], feature[first]))
    row = np.empty(k, np.int64)
    row[order] = np.arange(k)
    size = np.column_stack([right - left, high - low])
    walls = FacadeWalls(feature[first], foot, tangent, size, np.full(k, None, object)).take(order)
    return replace(walls, polygon=_polygons(walls, corners, wall=row[wall], area=area)), row[wall]


def _polygons(walls: FacadeWalls, corners: Float, *, wall: Ints, area: Float) -> NDArray[np.object_]:
    """The polygons (k,) of walls that are no rectangles, None for the others."""
    total = np.bincount(wall, weights=area, minlength=len(walls))
    odd: Bools = np.abs(total - walls.size.prod(axis=1)) > 1e-3
    polygons = np.full(len(walls), None, object)
    rows = np.flatnonzero(odd[wall])
    rows = rows[np.argsort(wall[rows], kind="stable")]
    if not len(rows):
        return polygons
    of = wall[rows]
    flat = corners[rows, :, :2] - walls.foot[of, None, :2]
    uv = np.stack(
        [np.einsum("ijk,ik->ij", flat, walls.tangent[of]), corners[rows, :, 2] - walls.foot[of, 2, None]],
        axis=2,
    )
    pieces = shapely.polygons(np.round(uv, 4))
    for some in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(of)) + 1):
        polygons[of[some[0]]] = shapely.union_all(pieces[some], grid_size=1e-4)
    return polygons


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
