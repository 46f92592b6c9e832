"""Facades in images: colour of a wall with openings, averaged over a pixel's footprint."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.support.compiled import njit
from lidar.raycast import Hits
from lidar.raycast.memory import inline
from lidar.raycast.relief import FRAME, INFILL, ROOM, SILL, WallTables, march
from lidar.raycast.relief.walls import depth_of, height_of, on_wall, outwards
from lidar.world.surfaces import Surfaces
from lidar.world.world import World

_SHARP = 0.1
"""Metres of a pixel's footprint up to which light and shadow are those of the point that its ray hits in the
depth of an opening; beyond, those of the plane of the wall."""

_STEEP = 20.0
"""Metres along the wall for each metre of depth, up to which pixels see the sides of openings."""

_CELLS = 2.0
"""Size of the greatest footprint in cells; greater ones see those in their middle."""

_LIT, _DARK = 0.4, 0.03
"""Light in a room as a share of that outside: at the pane, and at the back. Typical values of a day."""

GLASS, ASIDE, UPRIGHT, PAINTED, LIGHT, BEHIND = 0, 1, 2, 3, 4, 7
SEEN = 10
"""Columns that `facade` fills: shares of panes, of sides of recesses whose normals run along the wall and
upright, and of painted parts (sills, frames, doors, blinds); albedo of these parts times their share (3), and
of what is behind panes (3)."""


class RenderedFacades(NamedTuple):
    """The openings of a world's walls, for compiled code.

    tables   : of the walls
    deep     : whether openings lie behind the walls; else they are painted on them
    color    : (m, 3) sRGB of faces
    material : (m,) of faces
    glass    : code of this material
    """

    tables: WallTables
    deep: bool
    color: NDArray[np.uint8]
    material: NDArray[np.uint8]
    glass: int


def facades_of(world: World) -> RenderedFacades:
    """The facades of a world."""
    surfaces, deep = world.surfaces, world.settings.relief != "off"
    return RenderedFacades(
        world.walls.tables, deep, surfaces.color, surfaces.material, materials()["glass"].code
    )


def walls_of(
    facades: RenderedFacades, surfaces: Surfaces, *, hits: Hits
) -> tuple[Surfaces, NDArray[np.int32]]:
    """The surfaces of hits, those of parts of openings being their walls', and the wall (n,) of each hit.

    A wall is a row of the tables; -1 for none.
    """
    wall = np.full(len(hits), -1, np.int32)
    if not len(facades.tables.first):
        return surfaces, wall
    color, material = surfaces.color.copy(), surfaces.material.copy()
    _walls(facades, hits.face, hits.instance, wall, color, material)
    return replace(surfaces, color=color, material=material), wall


@njit(cache=True, nogil=True, error_model="numpy")
def _walls(facades: Any, face: Any, instance: Any, wall: Any, color: Any, material: Any) -> None:
    for i in range(len(face)):
        if face[i] >= 0 and instance[i] < 0:
            _wall_one(facades, face[i], i, wall, color, material)


@inline
def _wall_one(facades: Any, f: int, i: int, wall: Any, color: Any, material: Any) -> None:
    w = facades.tables.wall[f]
    wall[i] = w
    if w >= 0 and facades.tables.part[f] > 0:
        own = facades.tables.own[w]
        material[i] = facades.material[own]
        for c in range(3):
            color[i, c] = facades.color[own, c]


@njit(cache=True, nogil=True, error_model="numpy")
def flatten(facades: Any, wall: Any, view: Any, size: Any, distance: Any, normal: Any) -> None:
    """Move hits in openings to the plane of the wall where a pixel does not resolve them.

    view             : origins of the rays, row of each ray's origin, and directions
    size             : width of a pixel at distance 0 in metres, and its growth with distance
    distance, normal : of the hits, changed in place
    """
    for i in range(len(wall)):
        if wall[i] >= 0:
            _flatten_one(facades.tables.frame, wall[i], i, view, size, distance, normal)


@inline
def _flatten_one(frame: Any, w: int, i: int, view: Any, size: Any, distance: Any, normal: Any) -> None:
    origins, rows, directions = view
    o, t = rows[i], distance[i]
    x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
    place = origins[o, 0] + t * x, origins[o, 1] + t * y, origins[o, 2] + t * z
    _, _, _, _, inwards = on_wall(frame, w, place, (x, y, z))
    if size[0] + size[1] * t * math.sqrt(x * x + y * y + z * z) > _SHARP and inwards > 0.0:
        distance[i] = t - depth_of(frame, w, place) / inwards
        normal[i, 0], normal[i, 1] = outwards(frame, w)
        normal[i, 2] = 0.0


@inline
def _lengths(kinds: Any, k: int, axis: int, low: float, high: float, slope: float) -> Any:
    """Metres of a footprint that see, in one direction: panel, its back, reveal, frame, panes, infill.

    low, high : ends of the footprint on the plane of the cell
    slope     : metres along the wall for each metre of depth. Where a ray through x on the plane passes a
                rectangle at a depth z, x lies in the rectangle moved by -slope * z
    """
    p, q = kinds[k, march.PANEL + axis], kinds[k, march.PANEL + 2 + axis]
    a, b = max(low, p), min(high, q)
    panel = max(b - a, 0.0)
    shift = slope * kinds[k, march.PANEL_DEPTH]
    a, b = max(a, p - shift), min(b, q - shift)
    back = max(b - a, 0.0)
    p, q = kinds[k, march.OPENING + axis], kinds[k, march.OPENING + 2 + axis]
    a, b = max(a, p - shift), min(b, q - shift)
    reveal = max(b - a, 0.0)
    shift = slope * kinds[k, march.REVEAL_DEPTH]
    a, b = max(a, p - shift), min(b, q - shift)
    frame, panes, infill = max(b - a, 0.0), 0.0, 0.0
    bars, bar = kinds[k, march.BARS + axis], kinds[k, march.BAR]
    p, q = p + kinds[k, march.FRAME_WIDTH], q - kinds[k, march.FRAME_WIDTH]
    step = (q - p) / (bars + 1.0)
    end = slope * kinds[k, march.PANE_DEPTH]
    for i in range(int(bars) + 1):
        start = p + i * step + (0.5 * bar if i > 0 else 0.0)
        stop = p + (i + 1.0) * step - (0.5 * bar if i < bars else 0.0)
        c, d = max(a, start - shift), min(b, stop - shift)
        panes += max(d - c, 0.0)
        infill += max(min(d, stop - end) - max(c, start - end), 0.0)
    return panel, back, reveal, frame, panes, infill


@inline
def _sill(kinds: Any, k: int, axis: int, low: float, high: float, slope: float) -> Any:
    """Metres of a footprint that see the sill, in one direction: its front, moved back by its depth."""
    p, q = kinds[k, march.SILL_BOX + axis], kinds[k, march.SILL_BOX + 2 + axis]
    shift = slope * kinds[k, march.PANEL_DEPTH]
    return max(min(high, max(q, q - shift)) - max(low, min(p, p - shift)), 0.0) if q > p else 0.0


@inline
def _beside(kinds: Any, k: int, across: Any, upright: Any, slope: float) -> bool:
    """Whether a footprint with these extents in both directions contains no part of an opening."""
    x0, x1 = across
    y0, y1 = upright
    within = x1 > kinds[k, march.PANEL] and x0 < kinds[k, march.PANEL + 2]
    if within and y1 > kinds[k, march.PANEL + 1] and y0 < kinds[k, march.PANEL + 3]:
        return False
    if kinds[k, march.SILL_BOX + 2] <= kinds[k, march.SILL_BOX]:
        return True
    return bool(_sill(kinds, k, 0, x0, x1, 0.0) * _sill(kinds, k, 1, y0, y1, slope) == 0.0)


@inline
def _paint(facades: Any, face: int, share: float, linear: Any, out: Any) -> None:
    """Add a painted part to the colour of a pixel."""
    out[PAINTED] += share
    for c in range(3):
        out[LIGHT + c] += share * linear[facades.color[face, c]]


@inline
def _room(facades: Any, cell: int, w: int, at: Any, share: float, linear: Any, out: Any) -> None:
    """Add the room behind a pane; ``at`` is the pixel's ray in the cell, for each metre of depth."""
    tables = facades.tables
    frame, kinds, k = tables.frame, tables.kinds, tables.cells[cell]
    x, y, bottom, a, b = at
    width, height = frame[w, 7], height_of(frame, w, bottom)
    pane, deep = kinds[k, march.PANE_DEPTH], kinds[k, march.ROOM_DEPTH]
    x, y = min(max(x, 0.0), width), min(max(y, 0.0), height)
    depth, axis = march.in_room(kinds, k, width, height, (x, y, 0.0, a, b, 1.0))
    dark = min(max((depth - pane) / (deep - pane), 0.0), 1.0)
    light = _DARK + (_LIT - _DARK) * (1.0 - dark) * (1.0 - dark)
    if axis == 1:
        light *= 0.7 if b < 0.0 else 1.2  # floors are darker than ceilings
    face = tables.faces[cell] + ROOM - 1
    out[GLASS] += share
    for c in range(3):
        out[BEHIND + c] += share * light * linear[facades.color[face, c]]


@inline
def _row(y: float, ground: float, height: float) -> Any:
    """Row of cells at a height; -1 below the lowest."""
    if y < ground:
        return 0.0 if y >= 0.0 else -1.0
    return 1.0 + math.floor((y - ground) / height)


@inline
def facade(facades: Any, w: int, place: Any, direction: Any, size: float, linear: Any, out: Any) -> None:
    """Fill ``out`` (`SEEN`,) with what a pixel sees of the openings of a wall.

    The footprint is a rectangle on the plane of the wall. All rectangles of an opening are moved on this
    plane by their depth times the slope of the ray, so that the shares of the footprint are those of
    rays through it: windows are at the same place in colour as in depth.

    w         : row of the wall
    place     : where the pixel's ray hits, on the wall or in an opening
    direction : unit vector of the ray
    size      : width of the pixel across the ray, metres
    linear    : `lidar.sensors.camera.shade.linear_table`
    """
    out[:] = 0.0
    tables = facades.tables
    frame, kinds = tables.frame, tables.kinds
    u, v, along, up, inwards = on_wall(frame, w, place, direction)
    if inwards < 1e-6:
        return
    a, b, depth = along / inwards, up / inwards, depth_of(frame, w, place)
    u, v = u - a * depth, v - b * depth
    a, b = min(max(a, -_STEEP), _STEEP), min(max(b, -_STEEP), _STEEP)
    width, height, columns, rows = frame[w, 7], frame[w, 8], frame[w, 10], frame[w, 11]
    across = min(size * math.sqrt(1.0 + a * a), _CELLS * width)
    upright = min(size * math.sqrt(1.0 + b * b), _CELLS * height)
    inverse = 1.0 / (across * upright)
    x0, x1, y0, y1 = u - 0.5 * across, u + 0.5 * across, v - 0.5 * upright, v + 0.5 * upright
    p, q = (a, b) if facades.deep else (0.0, 0.0)
    ground = frame[w, 9]
    first, last = max(math.floor(x0 / width), 0.0), min(math.floor(x1 / width), columns - 1.0)
    lowest, highest = max(_row(y0, ground, height), 0.0), min(_row(y1, ground, height), rows - 1.0)
    for r in range(int(lowest), int(highest) + 1):
        bottom = ground + (r - 1.0) * height if r > 0 else 0.0
        for column in range(int(first), int(last) + 1):
            left = column * width
            cell = tables.first[w] + r * int(columns) + column
            k = tables.cells[cell]
            if k < 0 or _beside(kinds, k, (x0 - left, x1 - left), (y0 - bottom, y1 - bottom), q):
                continue
            lx = _lengths(kinds, k, 0, x0 - left, x1 - left, p)
            ly = _lengths(kinds, k, 1, y0 - bottom, y1 - bottom, q)
            sill = _sill(kinds, k, 0, x0 - left, x1 - left, 0.0)  # its ends are too small to be seen
            sill *= _sill(kinds, k, 1, y0 - bottom, y1 - bottom, q) * inverse
            face = tables.faces[cell] - 1
            if sill > 0.0:
                _paint(facades, face + SILL, sill, linear, out)
            # Rays beyond both sides of a corner are shared: half of them hit either side.
            half = 0.5 * inverse
            out[ASIDE] += ((lx[0] - lx[1]) * (ly[0] + ly[1]) + (lx[2] - lx[3]) * (ly[2] + ly[3])) * half
            out[UPRIGHT] += ((lx[0] + lx[1]) * (ly[0] - ly[1]) + (lx[2] + lx[3]) * (ly[2] - ly[3])) * half
            seen = lx[5] * ly[5] * inverse
            _paint(facades, face + FRAME, lx[3] * ly[3] * inverse - seen, linear, out)
            if facades.material[face + INFILL] != facades.glass:
                _paint(facades, face + INFILL, seen, linear, out)
            elif seen > 0.0:
                _room(facades, cell, w, (u - left, v - bottom, bottom, a, b), seen, linear, out)
