"""Whether openings fit: within their wall, above the ground, with free space in front and solid behind."""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.facades.grids import Elevations, nth
from geoscene.buildings.facades.kinds import BLANK, depths, panels
from geoscene.ground.terrain import base_heights
from geoscene.typing import Bools, Float, Ints

FREE = 1.0
"""Metres of free space in front of an opening."""

OUT = 0.08
"""Metres outside a wall from which space must be free: more than outlines are aligned by."""

_EDGE = 0.05
"""Metres, at least, from a panel to the edge of its wall, besides the depth of the opening."""


def obstacles(at: Elevations, wall: Ints, *, shape: NDArray[np.object_]) -> tuple[Ints, Float]:
    """Which shapes (p,) in plan before walls (n,) buildings intersect.

    Returns also the lower and upper height (p, 2) of the building or part above the base of the wall's.
    """
    table = at.setting.buildings
    which, found = at.setting.solid.query(shape, predicate="intersects")
    other = at.setting.rows[found]
    stands = _bases(at, table.outline[other].astype(np.int64)) - at.grids.zero[wall[which]]
    return which, np.stack([stands + table.min_height[other], stands + table.height[other]], axis=1)


def _bases(at: Elevations, building: Ints) -> Float:
    """Height z (n,) of the bases of buildings, also of those out of reach of a route."""
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

    def _obstacles(self) -> tuple[Ints, Float]:
        """Columns (p,), sorted, and the lower and upper height (p, 2) of what stands before them."""
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
        """Whether nothing stands before openings."""
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
        """Whether no other wall is as near to the inner corners of openings as their own."""
        table = self._at.setting.buildings
        outline = shapely.boundary(table.footprint[self._at.grids.row[wall]])
        deep = depth + _EDGE
        near = [
            shapely.distance(shapely.points(self._at.walls.points(wall, box[:, k], out=-deep)), outline)
            for k in (0, 2)
        ]
        return np.min(near, axis=0) >= deep - 0.01 if len(wall) else np.empty(0, np.bool_)


class Sheet:
    """What each cell holds, while it is filled in."""

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
