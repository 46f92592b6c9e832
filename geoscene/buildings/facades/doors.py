"""Doors and gates, mapped or guessed, and whether openings fit.

They lie within their wall, above the ground, with free space in front and solid behind.
"""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.description import BLANK, DOOR, GATE, depths, panels
from geoscene.buildings.facades.walls import Elevations, FacadeCells
from geoscene.ground.terrain import base_heights
from geoscene.support.columns import nth
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

FREE = 1.0
"""Metres of free space in front of an opening."""

OUT = 0.08
"""Metres outside a wall from which space must be free: more than outlines are aligned by."""

_EDGE = 0.05
"""Metres, at least, from a panel to the edge of its wall, besides the depth of the opening."""

_SKIN = 0.01
"""Metres behind a wall within which other faces belong to its plane."""


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


def obstacles(at: Elevations, wall: Ints, *, shape: NDArray[np.object_]) -> tuple[Ints, Float]:
    """Rows of shapes (p,) in plan before walls (n,) that buildings intersect.

    Returns also the lower and upper height (p, 2) of the building or part above the base of the wall's.
    """
    table = at.setting.buildings
    which, found = at.setting.solid.query(shape, predicate="intersects")
    other = at.setting.rows[found]
    stands = _bases(at, table.outline[other].astype(np.int64)) - at.grids.zero[wall[which]]
    return which, np.stack([stands + table.min_height[other], stands + table.height[other]], axis=1)


def _bases(at: Elevations, building: Ints) -> Float:
    """Height z (n,) of the bases of buildings, also of those outside the tiles of a route."""
    known = at.base[building]
    lacking = np.unique(building[np.isnan(known)])
    if not len(lacking):
        return known
    found = np.full(len(at.base), np.nan)
    found[lacking] = base_heights(at.setting.buildings.footprint[lacking], at.height)
    return np.where(np.isnan(known), found[building], known)


class Fit:
    """Tests whether openings can be where they are wanted."""

    def __init__(self, at: Elevations) -> None:
        self._at = at
        self._column, self._span = self._obstacles()
        self._faces = at.mesh.vertices[at.mesh.faces]
        low, high = self._faces.min(axis=1), self._faces.max(axis=1)
        self._levels = np.stack([low[:, 2], high[:, 2]], axis=1)
        self._tree = shapely.STRtree(shapely.box(*low[:, :2].T, *high[:, :2].T))

    def _obstacles(self) -> tuple[Ints, Float]:
        """Columns (p,), sorted, and the height intervals (p, 2) of obstacles in front of them."""
        walls, cells = self._at.walls, self._at.cells
        first = np.unique(cells.upright, return_index=True)[1]
        of, middle = cells.wall[first], cells.middle[first]
        half = 0.45 * self._at.grids.cell[of, 0]
        low, high = (np.clip(middle + sign * half, 0.05, walls.size[of, 0] - 0.05) for sign in (-1, 1))
        corners = [
            walls.points(of, u, out=out) for u, out in ((low, OUT), (low, FREE), (high, FREE), (high, OUT))
        ]
        rims = shapely.linestrings(np.stack(corners, axis=1)) if len(of) else np.empty(0, object)
        column, span = obstacles(self._at, of, shape=rims)
        order = np.argsort(column, kind="stable")
        return column[order], span[order]

    def __call__(self, cell: Ints, box: Float, *, depth: Float, above: float) -> Bools:
        """Whether openings (n,) in cells fit.

        box   : (n, 4) left, lower, right and upper edge of the panel, from the wall's left edge and above
                the building's base
        depth : (n,) of the opening
        above : metres between the ground and the panel
        """
        wall = self._at.cells.wall[cell]
        fits = box[:, 1] >= self._at.cells.ground[self._at.cells.upright[cell]] + above - 1e-9
        fits &= box[:, 3] <= self._at.cells.floor[cell] + self._at.cells.height[cell] - 0.02 + 1e-9
        fits &= (box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1])
        fits &= self._within_wall(wall, box, depth=depth)
        fits &= self._free(cell, box)
        fits[fits] &= self._backed(wall[fits], box[fits], depth=depth[fits])
        return fits

    def _within_wall(self, wall: Ints, box: Float, *, depth: Float) -> Bools:
        size, lift = self._at.walls.size[wall], self._at.grids.bottom[wall]
        aside = _EDGE + depth
        grown = np.column_stack(
            [box[:, 0] - aside, box[:, 1] - lift - _EDGE, box[:, 2] + aside, box[:, 3] - lift + aside]
        )
        fits: Bools = (grown[:, 0] >= 0) & (grown[:, 1] >= -1e-9)
        fits &= (grown[:, 2] <= size[:, 0]) & (grown[:, 3] <= size[:, 1])
        polygon = self._at.walls.polygon[wall]
        odd = np.flatnonzero(fits & (polygon != None))  # noqa: E711 - element by element
        shapely.prepare(polygon[odd])
        fits[odd] = shapely.contains(polygon[odd], shapely.box(*grown[odd].T))
        return fits

    def _free(self, cell: Ints, box: Float) -> Bools:
        """Whether openings have no obstacle in front of them."""
        column, span = self._column, self._span
        own = self._at.cells.upright[cell]
        begin, end = np.searchsorted(column, own), np.searchsorted(column, own, side="right")
        sizes = end - begin
        of = np.repeat(np.arange(len(cell)), sizes)
        pair = begin[of] + nth(sizes)
        hits = (span[pair, 0] < box[of, 3]) & (span[pair, 1] > box[of, 1])
        free = np.ones(len(cell), np.bool_)
        free[of[hits]] = False
        return free

    def _backed(self, wall: Ints, box: Float, *, depth: Float) -> Bools:
        """Whether no other face of the building is behind openings, nor an opening as deep of such a face.

        Roofs, passages and parts cut walls off from behind.
        """
        at = self._at
        low = np.column_stack([box[:, 0] - depth, np.full(len(box), _SKIN), box[:, 1] - _EDGE + _SKIN])
        high = np.column_stack([box[:, 2] + depth, 2 * depth + _EDGE, box[:, 3] + depth])
        corners = np.stack(
            [
                at.walls.points(wall, u, out=-v)
                for u in (low[:, 0], high[:, 0])
                for v in (low[:, 1], high[:, 1])
            ]
        )
        which, face = self._tree.query(shapely.box(*corners.min(axis=0).T, *corners.max(axis=0).T))
        zero = at.grids.zero[wall[which]]
        near = (at.mesh.feature[face] == at.walls.feature[wall[which]]) & (at.of_face[face] != wall[which])
        near &= self._levels[face, 0] <= zero + high[which, 2]
        near &= self._levels[face, 1] >= zero + low[which, 2]
        which, face, zero = which[near], face[near], zero[near]
        own = wall[which]
        flat = self._faces[face][:, :, :2] - at.walls.foot[own, None, :2]
        placed = np.stack(
            [
                np.einsum("ijk,ik->ij", flat, at.walls.tangent[own]),
                -np.einsum("ijk,ik->ij", flat, at.walls.outwards[own]),
                self._faces[face][:, :, 2] - zero[:, None],
            ],
            axis=2,
        )
        backed = np.ones(len(wall), np.bool_)
        backed[which[_enter(placed, low=low[which], high=high[which])]] = False
        return backed


def _enter(triangles: Float, *, low: Float, high: Float) -> Bools:
    """Whether triangles (n, 3, 3) have points in boxes (n, 3): no axis of either separates them.

    Separating axes of a triangle and a box: Akenine-Moeller, "Fast 3D triangle-box overlap testing" (2001).
    """
    corners, half = triangles - ((low + high) / 2)[:, None], (high - low) / 2
    beside = (corners.min(axis=1) > half) | (corners.max(axis=1) < -half)
    enter: Bools = ~beside.any(axis=1)  # no axis of the box separates them
    corners, half = corners[enter], half[enter]
    sides = np.roll(corners, -1, axis=1) - corners
    across = np.cross(sides[:, :, None], np.eye(3)).reshape(-1, 9, 3)
    axes = np.concatenate([across, np.cross(sides[:, :1], sides[:, 1:2])], axis=1)
    reach = np.einsum("nij,nj->ni", np.abs(axes), half)
    along = np.einsum("nij,nkj->nik", axes, corners)
    apart = (along.min(axis=2) > reach) | (along.max(axis=2) < -reach)
    enter[enter] = ~apart.any(axis=1)
    return enter


class Sheet:
    """Contents of the facade cells while they are filled."""

    def __init__(self, at: Elevations) -> None:
        cells = at.cells
        self.kind = np.full(len(cells.wall), BLANK, np.int64)
        self.place = np.zeros((len(cells.wall), 4))
        self._corner = np.column_stack([cells.middle - at.grids.middle[cells.wall], cells.floor])
        self._styles, self._wall, self._fit = at.styles, cells.wall, Fit(at)

    def fits(self, cell: Ints, kind: int, *, box: Float, above: float) -> Bools:
        """Whether openings (m,) fit into cells; box (m, 4): left, lower, right and upper edge in the cell."""
        wall = self._wall[cell]
        panel = panels(box, kind, margin=self._styles.margin[wall]) + np.tile(self._corner[cell], (1, 2))
        return self._fit(cell, panel, depth=depths(kind, self._styles)[wall], above=above)

    def put(self, cell: Ints, kind: int, *, box: Float) -> None:
        """Put openings into cells."""
        self.kind[cell], self.place[cell] = kind, box
