"""Puts doors and gates into cells: mapped entrances, and one for each side to a street where none is."""

from __future__ import annotations

import numpy as np
import shapely

from geoscene.buildings.facades.fit import OUT, Sheet
from geoscene.buildings.facades.grids import Elevations, FacadeCells, nth
from geoscene.buildings.facades.kinds import DOOR, GATE
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

_STREET = 40.0
"""Metres from a wall to the middle of the street that it faces."""

_AHEAD = 0.6
"""Cosine of the angle between a wall's normal and the nearest street within which it faces the street."""

_APART = 25.0
"""Metres of a wall to a street for each door; assumed."""

_STEP = 0.08
"""Metres from the ground to the lower edge of a door's panel."""

_HIGHEST_STEP = 0.7
"""Metres from the floor of the ground floor to the highest guessed door; assumed."""

_AT_DOOR = 0.6
"""Metres from a wall to an entrance on it."""

_DOOR, _GATE = (1.0, 2.1), (2.4, 2.1)
"""Width and height of mapped doors and garage doors in buildings that usually have none; assumed."""


def facing_street(at: Elevations) -> Bools:
    """Whether walls (k,) face a street with no building between."""
    walls, setting = at.walls, at.setting
    facing = np.zeros(len(walls), np.bool_)
    if not len(walls) or not len(setting.streets.geometries):
        return facing
    middle = walls.points(np.arange(len(walls)), walls.size[:, 0] / 2, out=OUT + 0.1)
    wall, street = setting.streets.query_nearest(
        shapely.points(middle), max_distance=_STREET, all_matches=False
    )
    line, points = setting.streets.geometries[street], shapely.points(middle[wall])
    along = shapely.line_locate_point(line, points)
    nearest = shapely.get_coordinates(shapely.line_interpolate_point(line, along))
    away = nearest - middle[wall]
    ahead = np.einsum("ij,ij->i", away, walls.outwards[wall]) > _AHEAD * np.linalg.norm(away, axis=1)
    wall, nearest = wall[ahead], nearest[ahead]
    sights = shapely.linestrings(np.stack([middle[wall], nearest], axis=1))
    hidden = np.unique(setting.solid.query(sights, predicate="intersects")[0])
    facing[np.delete(wall, hidden)] = True
    return facing


def _door_boxes(cells: FacadeCells, cell: Ints, *, middle: Float, size: Float) -> Float:
    """Openings (m, 4) of doors in cells: on a step above the ground in front, on a grid of 10 cm."""
    lift = cells.ground[cells.upright[cell]] - cells.floor[cell]
    low = np.ceil(np.maximum(lift, 0.0) * 10 - 1e-6) / 10 + 0.1
    return np.column_stack([middle - size[:, 0] / 2, low, middle + size[:, 0] / 2, low + size[:, 1]])


def put_mapped_doors(sheet: Sheet, at: Elevations) -> dict[str, int]:
    """Place doors at mapped entrances; returns the numbers placed and left out for lack of space."""
    walls, grids = at.walls, at.grids
    mine = at.setting.entrances.take(np.isin(at.setting.entrances.building, walls.feature))
    placed = 0
    for building, xy, kind, size in zip(
        mine.building.tolist(), mine.xy, mine.kind.tolist(), mine.size, strict=True
    ):
        own = np.flatnonzero((walls.feature == building) & (grids.storey == 0))
        away = xy - walls.foot[own, :2]
        off = np.einsum("ij,ij->i", away, walls.outwards[own])
        u = np.einsum("ij,ij->i", away, walls.tangent[own])
        near = np.hypot(off, np.maximum(np.maximum(-u, u - walls.size[own, 0]), 0.0))
        for k in np.argsort(near, kind="stable")[: np.count_nonzero(near < _AT_DOOR)].tolist():
            if _put_mapped_door(sheet, at, wall=int(own[k]), u=float(u[k]), kind=kind, mapped=size):
                placed += 1
                break
    return {"entrances_mapped": placed, "entrances_left_out": len(mine) - placed}


def _put_mapped_door(sheet: Sheet, at: Elevations, *, wall: int, u: float, kind: str, mapped: Float) -> bool:
    """Put a door as near as can be to ``u`` metres along a wall, 1.5 m away at most; whether it fits.

    mapped : (2,) width and height, NaN where the map has none
    """
    code = GATE if kind == "garage" else DOOR
    usual = at.styles.door[wall] if at.styles.door[wall].all() else np.array(_DOOR)
    size = np.array(_GATE) if code == GATE else usual * ((1.2, 1.05) if kind == "main" else 1.0)
    size = np.where(np.isnan(mapped), size, mapped)
    width, half = float(at.grids.cell[wall, 0]), size[0] / 2 + 0.05
    if width < 2 * half:
        return False
    wanted = u + np.array([0.0, 0.3, -0.3, 0.6, -0.6, 1.0, -1.0, 1.5, -1.5])
    first = float(at.grids.start[wall])
    column = np.clip(np.floor((wanted - first) / width), 0, at.grids.count[wall, 0] - 1).astype(np.int64)
    middle = np.round(np.clip(wanted - first - column * width, half, width - half), 1)
    cell = np.searchsorted(at.cells.wall, wall) + column
    box = _door_boxes(at.cells, cell, middle=middle, size=np.tile(size, (len(cell), 1)))
    fits = np.flatnonzero(sheet.fits(cell, code, box=box, above=_STEP) & (sheet.kind[cell] != DOOR))[:1]
    sheet.put(cell[fits], code, box=box[fits])
    return len(fits) > 0


def put_guessed_doors(sheet: Sheet, at: Elevations, *, facing: Bools) -> None:
    """Put doors and gates into buildings without mapped ones: one a side to a street, else one.

    facing : (k,) whether walls face a street
    """
    mapped = np.isin(at.walls.feature, at.setting.entrances.building)
    wanted = ((at.cells.storey == 0) & ~mapped[at.cells.wall]) & (sheet.kind != GATE)
    sizes: list[tuple[int, Float]] = [(GATE, at.styles.gate), (DOOR, at.styles.door)]
    for code, size in sizes:
        cell = np.flatnonzero(wanted & (size[:, 0] > 0)[at.cells.wall] & (sheet.kind != GATE))
        wall = at.cells.wall[cell]
        box = _door_boxes(at.cells, cell, middle=at.grids.middle[wall], size=size[wall])
        # a door high above the floor behind it would open on a landing
        fits = sheet.fits(cell, code, box=box, above=_STEP) & (box[:, 1] <= _HIGHEST_STEP)
        cell, box = cell[fits], box[fits]
        chosen = _doors_of(at, at.cells.wall[cell], facing=facing, once=code == GATE)
        sheet.put(cell[chosen], code, box=box[chosen])


def _doors_of(at: Elevations, wall: Ints, *, facing: Bools, once: bool) -> Ints:
    """Sorted cells (d,) that get a door, among those with room for one, given the walls (n,).

    once : one in each building at most
    """
    walls = at.walls
    first = np.flatnonzero(np.diff(wall, prepend=-1))
    sizes = np.diff(first, append=len(wall))
    of = wall[first]  # walls with room
    building = walls.feature[of]
    street = np.isin(building, building[facing[of]])
    # the widest wall stands for the street's where the building has none there
    order = np.lexsort((np.arange(len(of)), -walls.size[of, 0], ~facing[of], building))
    best = np.zeros(len(of), np.bool_)
    best[order[np.flatnonzero(np.diff(building[order], prepend=-1))]] = True
    chosen = np.flatnonzero(best if once else np.where(street, facing[of], best))
    doors = np.maximum(1, np.rint(walls.size[of[chosen], 0] / _APART)).astype(np.int64)
    doors = np.minimum(1 if once else doors, sizes[chosen])
    place = nth(doors)
    k = np.repeat(chosen, doors)
    draw = uniform_at(at.styles.seed[of[k]], place, count=1, seed=2)[0]
    within = ((place + 0.25 + 0.5 * draw) * sizes[k] / np.repeat(doors, doors)).astype(np.int64)
    found: Ints = first[k] + within
    return found
