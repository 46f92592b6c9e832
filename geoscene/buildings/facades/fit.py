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

_SKIN = 0.01
"""Metres behind a wall within which other faces belong to its plane."""


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
