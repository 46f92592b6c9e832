"""The facades of loaded tiles, and the refinement of hits on their walls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings.facades import WallRelief
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.columns import RayColumns
from lidar.raycast.hits import Hits
from lidar.raycast.memory import inline
from lidar.raycast.planes import beyond_plane, direction_of, origin_of
from lidar.raycast.rays import share
from lidar.raycast.relief.march import (
    INFILL,
    OUT,
    PANEL,
    PARTS,
    ROOM,
    SILL,
    WALL,
    WIDTH,
    in_room,
    layer_of,
    march,
    opening_table,
    within,
)

_ADDED = np.arange(SILL, SILL + PARTS, dtype=np.uint8)

_FOOT, _TANGENT, _START, _WIDTH, _HEIGHT, _GROUND, _COLUMNS, _ROWS = 0, 3, 5, 7, 8, 9, 10, 11


class WallPairs(NamedTuple):
    """The pairs of a wall and a kind of opening on it; each has a face for each of `PARTS` surfaces.

    wall : (p,) int64, row of the facades
    kind : (p,) int64, row of the openings
    cell : (c,) int32, pair of each cell; -1 without an opening
    """

    wall: NDArray[np.int64]
    kind: NDArray[np.int64]
    cell: NDArray[np.int32]


def pairs_of(relief: WallRelief) -> WallPairs:
    """The pairs of a tile."""
    facades, kind = relief.facades, relief.cells.astype(np.int64)
    counts = facades.grid[:, 0].astype(np.int64) * facades.grid[:, 1]
    wall = np.full(len(kind), -1, np.int64)
    row = np.repeat(facades.first - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    wall[row] = np.repeat(np.arange(len(counts)), counts)
    used = np.flatnonzero((kind >= 0) & (wall >= 0))
    types = max(len(relief.openings), 1)
    found, pair = np.unique(wall[used] * types + kind[used], return_inverse=True)
    cell = np.full(len(kind), -1, np.int32)
    cell[used] = pair
    return WallPairs(found // types, found % types, cell)


class WallTables(NamedTuple):
    """Facades for compiled code, of one or of several tiles.

    wall  : (m,) int32, facade of each face of the mesh and of each additional face; -1 for other faces
    part  : (m,) uint8, of each face: `march.SILL` to `ROOM`; `WALL` for those of the mesh
    frame : (k, 12) foot, tangent, start, size of a cell, height of the ground floor, columns and rows of the
            grid; scene metres
    first : (k,) int64, first cell
    own   : (k,) int32, number of a face of the mesh on the wall
    cells : (c,) int32, row of ``kinds``; -1 without an opening
    faces : (c,) int32, number of the face of the cell's `march.SILL`; the other parts follow
    kinds : see `lidar.raycast.relief.march.opening_table`
    bits  : (t,) uint32, mask bits of the infill
    """

    wall: NDArray[np.int32]
    part: NDArray[np.uint8]
    frame: Float
    first: NDArray[np.int64]
    own: NDArray[np.int32]
    cells: NDArray[np.int32]
    faces: NDArray[np.int32]
    kinds: Float
    bits: NDArray[np.uint32]


NO_WALLS = WallTables(
    wall=np.empty(0, np.int32),
    part=np.empty(0, np.uint8),
    frame=np.empty((0, 12)),
    first=np.empty(0, np.int64),
    own=np.empty(0, np.int32),
    cells=np.empty(0, np.int32),
    faces=np.empty(0, np.int32),
    kinds=np.empty((0, WIDTH)),
    bits=np.empty(0, np.uint32),
)
"""The tables of a tile without facades."""


def tables_of(relief: WallRelief, pairs: WallPairs, *, origin: Float, bits: NDArray[np.uint32]) -> WallTables:
    """The tables of a tile, whose additional faces follow its own.

    origin : (3,) scene metres, of the tile
    bits   : (256,) mask bits by material
    """
    f = relief.facades
    m = len(relief.wall)
    own = np.full(len(f.feature), -1, np.int32)
    of_wall = np.flatnonzero(relief.wall >= 0)
    own[relief.wall[of_wall]] = of_wall
    return WallTables(
        wall=np.concatenate([relief.wall, np.repeat(pairs.wall, PARTS)]).astype(np.int32),
        part=np.concatenate([np.full(m, WALL, np.uint8), np.tile(_ADDED, len(pairs.wall))]),
        frame=np.column_stack([f.foot + origin, f.tangent, f.start, f.cell, f.ground, f.grid]).astype(
            np.float64
        ),
        first=f.first.astype(np.int64),
        own=own,
        cells=relief.cells.astype(np.int32),
        faces=np.where(pairs.cell >= 0, m + PARTS * pairs.cell, -1).astype(np.int32),
        kinds=opening_table(relief.openings),
        bits=bits[relief.openings.infill],
    )


def join(tables: Sequence[WallTables], *, faces: Sequence[int], count: int) -> WallTables:
    """The tables of several tiles.

    faces : number of the first face of each tile
    count : number of faces in all
    """
    wall, part = np.full(count, -1, np.int32), np.full(count, WALL, np.uint8)
    walls = np.cumsum([0, *(len(t.first) for t in tables)])
    kinds = np.cumsum([0, *(len(t.kinds) for t in tables)])
    cells = np.cumsum([0, *(len(t.cells) for t in tables)])
    for table, face, before in zip(tables, faces, walls, strict=False):
        part[face : face + len(table.part)] = table.part
        wall[face : face + len(table.wall)] = np.where(table.wall >= 0, table.wall + np.int32(before), -1)

    def plus(columns: Sequence[NDArray[Any]], offsets: Sequence[int] | NDArray[np.integer]) -> NDArray[Any]:
        moved = [np.where(c >= 0, c + c.dtype.type(o), -1) for c, o in zip(columns, offsets, strict=False)]
        return np.concatenate(moved)

    return WallTables(
        wall=wall,
        part=part,
        frame=np.concatenate([t.frame for t in tables]),
        first=plus([t.first for t in tables], cells),
        own=plus([t.own for t in tables], faces).astype(np.int32),
        cells=plus([t.cells for t in tables], kinds).astype(np.int32),
        faces=plus([t.faces for t in tables], faces).astype(np.int32),
        kinds=np.concatenate([t.kinds for t in tables]),
        bits=np.concatenate([t.bits for t in tables]),
    )


class WallRefiner:
    """Refines hits on walls of buildings by the openings of their facades; see `lidar.raycast.hits`.

    tables : of the loaded tiles, with scene coordinates
    """

    def __init__(self, tables: WallTables) -> None:
        self.tables = tables

    def refine(self, rays: RayColumns, hits: Hits, *, threads: int) -> None:
        """Change hits on walls in place, as `lidar.raycast.hits.Refiner.refine` describes."""
        columns = hits.range, hits.face, hits.instance, hits.cosine, hits.normal
        tables = self.tables

        def work(low: int, high: int) -> int:
            _refine(tables, rays, low, high, columns)
            return -1

        share(work, rays, threads=threads)

    def leave(self, rays: RayColumns, on: NDArray[np.int32], hits: Hits) -> Float:
        """Follow rays that start in an opening, as `lidar.raycast.hits.Refiner.leave` describes."""
        at = np.zeros(len(on))
        _leave(self.tables, rays, on, (hits.range, hits.face, hits.instance, hits.cosine, hits.normal), at)
        return at

    def panes(self, hits: Hits) -> NDArray[np.int32]:
        """The faces (n,) of hits on the infill of openings, -1 for other hits."""
        own = (hits.face >= 0) & (hits.instance < 0)
        return np.where(own & (self.tables.part[hits.face] == INFILL), hits.face, np.int32(-1))

    def rooms(self, face: NDArray[np.int32], place: Float, direction: Float) -> Hits:
        """Hits of rays behind the pane of an opening: surfaces of the closed room.

        face      : (n,) faces of panes
        place     : (n, 3) scene metres, on the pane or behind it
        direction : (n, 3) into the room
        """
        n = len(face)
        hits = Hits(
            np.empty(n),
            np.empty(n, np.int32),
            np.full(n, -1, np.int32),
            np.empty(n, np.float32),
            np.empty((n, 3)),
        )
        _rooms(self.tables, face, place, direction, (hits.range, hits.face, hits.cosine, hits.normal))
        return hits


@inline
def on_wall(frame: Any, w: int, origin: Any, direction: Any) -> Any:
    """A ray relative to the first cell of a wall: origin without its depth, direction."""
    tx, ty = frame[w, _TANGENT], frame[w, _TANGENT + 1]
    x, y, z = origin[0] - frame[w, _FOOT], origin[1] - frame[w, _FOOT + 1], origin[2] - frame[w, _FOOT + 2]
    dx, dy, dz = direction
    return (
        x * tx + y * ty - frame[w, _START],
        z - frame[w, _START + 1],
        dx * tx + dy * ty,
        dz,
        tx * dy - ty * dx,
    )


@inline
def outwards(frame: Any, w: int) -> Any:
    """The horizontal normal of a wall."""
    return frame[w, _TANGENT + 1], -frame[w, _TANGENT]


@inline
def cell_number(frame: Any, w: int, u: float, v: float) -> Any:
    """Number of the cell of a wall's grid at a place (-1: none), and its lower left corner."""
    width, height, ground = frame[w, _WIDTH], frame[w, _HEIGHT], frame[w, _GROUND]
    column, row, low = np.floor(u / width), 0.0, 0.0
    if v >= ground:
        row = 1.0 + np.floor((v - ground) / height)
        low = ground + (row - 1.0) * height
    if v < 0.0 or not 0.0 <= column < frame[w, _COLUMNS] or not row < frame[w, _ROWS]:
        return np.int64(-1), 0.0, 0.0
    return np.int64(row * frame[w, _COLUMNS] + column), column * width, low


@inline
def _write_normal(frame: Any, w: int, axis: int, along: float, up: float, out: Any, i: int) -> None:
    """Write the normal of a surface across an axis of the wall; it faces a ray with these components."""
    tx, ty = frame[w, _TANGENT], frame[w, _TANGENT + 1]
    if axis == 0:
        sign = -1.0 if along > 0.0 else 1.0
        out[i, 0], out[i, 1], out[i, 2] = sign * tx, sign * ty, 0.0
    elif axis == 1:
        out[i, 0], out[i, 1], out[i, 2] = 0.0, 0.0, -1.0 if up > 0.0 else 1.0
    else:
        out[i, 0], out[i, 1], out[i, 2] = ty, -tx, 0.0


@inline
def height_of(frame: Any, w: int, bottom: float) -> Any:
    """Height of the cell of a wall that starts at a height above the first one."""
    return frame[w, _HEIGHT] if bottom > 0.0 else frame[w, _GROUND]


@inline
def _refine_one(tables: Any, rays: Any, i: int, columns: Any) -> None:
    """Refine one hit."""
    distance, face, instance, cosine, normal = columns
    if face[i] < 0 or instance[i] >= 0 or cosine[i] <= 0.0:
        return
    w = tables.wall[face[i]]
    if w < 0:
        return
    frame, kinds = tables.frame, tables.kinds
    direction = direction_of(rays, i)
    ox, oy, dx, dy, dz = on_wall(frame, w, origin_of(rays, i), direction)
    if not dz > 0.0:
        return
    t = distance[i]
    number, left, bottom = cell_number(frame, w, ox + t * dx, oy + t * dy)
    if number < 0:
        return
    number += tables.first[w]
    k = tables.cells[number]
    if k < 0:
        return
    # The depth counts from the plane of the face that was hit, so that no ray slips between the two.
    ray = ox - left, oy - bottom, -t * dz, dx, dy, dz
    if not within(kinds, k, PANEL, ray[0] + t * dx, ray[1] + t * dy, 0.0):
        return
    s, axis, part = march(kinds, k, ray, t, 0)
    if part == INFILL and rays.mask & tables.bits[k] == 0:
        s, axis = in_room(kinds, k, frame[w, _WIDTH], height_of(frame, w, bottom), ray)
        part = ROOM
    if s > rays.far[i if len(rays.far) > 1 else 0]:
        distance[i], face[i], instance[i], cosine[i] = np.inf, -1, -1, 0.0
        if len(normal) > 0:
            normal[i, 0], normal[i, 1], normal[i, 2] = 0.0, 0.0, 0.0
    elif part != WALL:
        _write(frame, w, (s, axis, tables.faces[number] + part - 1), (dx, dy, dz), direction, columns, i)
    elif axis != 2 or s > t:
        _write(frame, w, (s, axis, face[i]), (dx, dy, dz), direction, columns, i)


@inline
def _write(frame: Any, w: int, hit: Any, way: Any, direction: Any, columns: Any, i: int) -> None:
    """Write a hit: range, axis of the normal, and face."""
    distance, face, instance, cosine, normal = columns
    t, axis, number = hit
    x, y, z = direction
    across = way[0] if axis == 0 else (way[1] if axis == 1 else way[2])
    distance[i], face[i], instance[i] = t, number, -1
    cosine[i] = abs(across) / np.sqrt(x * x + y * y + z * z)
    if len(normal) > 0:
        _write_normal(frame, w, axis, way[0], way[1], normal, i)


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(tables: Any, rays: Any, low: int, high: int, columns: Any) -> None:
    """Refine the hits ``low`` to ``high`` in the order of work."""
    order = rays.order
    for j in range(low, high):
        _refine_one(tables, rays, order[j] if len(order) > 0 else j, columns)


@inline
def _leave_one(tables: Any, rays: Any, on: Any, i: int, columns: Any) -> Any:
    """Ray parameter at which a ray leaves the opening in which it starts; 0 and inf as in `_leave`."""
    w = tables.wall[on[i]]
    if w < 0:
        return 0.0
    frame, kinds, near = tables.frame, tables.kinds, rays.near
    origin, direction = origin_of(rays, i), direction_of(rays, i)
    ox, oy, dx, dy, dz = on_wall(frame, w, origin, direction)
    depth = depth_of(frame, w, origin)
    number, left, bottom = cell_number(frame, w, ox + near * dx, oy + near * dy)
    if number < 0:
        return 0.0
    number += tables.first[w]
    k = tables.cells[number]
    ray = ox - left, oy - bottom, depth, dx, dy, dz
    if k < 0 or depth + near * dz <= 0.0:
        return 0.0
    layer = layer_of(kinds, k, ray[0] + near * dx, ray[1] + near * dy, depth + near * dz)
    if layer < 0:
        return 0.0
    s, axis, part = march(kinds, k, ray, near, layer)
    if part == OUT:
        length = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
        return s + beyond_plane(-dz, length)
    if part == INFILL and rays.mask & tables.bits[k] == 0:
        s, axis = in_room(kinds, k, frame[w, _WIDTH], height_of(frame, w, bottom), ray)
        part = ROOM
    if not s > rays.far[i if len(rays.far) > 1 else 0]:
        number = tables.faces[number] + part - 1 if part != WALL else tables.own[w]
        _write(frame, w, (s, axis, number), (dx, dy, dz), direction, columns, i)
    return np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _leave(tables: Any, rays: Any, on: Any, columns: Any, at: Any) -> None:
    """Fill ``at``: 0 for a ray that starts in no opening, inf for one that stays in it."""
    for i in range(len(on)):
        if on[i] >= 0:
            at[i] = _leave_one(tables, rays, on, i, columns)


@inline
def depth_of(frame: Any, w: int, place: Any) -> Any:
    """Depth of a place behind the plane of a wall."""
    tx, ty = frame[w, _TANGENT], frame[w, _TANGENT + 1]
    return tx * (place[1] - frame[w, _FOOT + 1]) - ty * (place[0] - frame[w, _FOOT])


@njit(cache=True, nogil=True, error_model="numpy")
def _rooms(tables: Any, face: Any, place: Any, direction: Any, out: Any) -> None:
    distance, hit, cosine, normal = out
    frame, kinds = tables.frame, tables.kinds
    for i in range(len(face)):
        w = tables.wall[face[i]]
        x, y, z = direction[i, 0], direction[i, 1], direction[i, 2]
        ox, oy, dx, dy, dz = on_wall(frame, w, (place[i, 0], place[i, 1], place[i, 2]), (x, y, z))
        number, left, bottom = cell_number(frame, w, ox, oy)
        number += tables.first[w]
        k = tables.cells[number]
        depth = depth_of(frame, w, (place[i, 0], place[i, 1], place[i, 2]))
        ray = ox - left, oy - bottom, depth, dx, dy, dz
        t, axis = in_room(kinds, k, frame[w, _WIDTH], height_of(frame, w, bottom), ray)
        across = dx if axis == 0 else (dy if axis == 1 else dz)
        distance[i], hit[i] = max(t, 0.0), tables.faces[number] + ROOM - 1
        cosine[i] = abs(across) / np.sqrt(x * x + y * y + z * z)
        _write_normal(frame, w, axis, dx, dy, normal, i)
