"""Closed shells of many buildings at once: floor, walls and roof surface over their footprints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.errors import GEOSException

from geoscene.buildings.footprints import Polygons, to_grid
from geoscene.buildings.table import GRID
from geoscene.geometry.mesh import FLOOR, ROOF, WALL
from geoscene.geometry.polylines import cross
from geoscene.geometry.watertight import edge_uses, weld
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

PARAPET = 0.25
"""Metres, thickness of a parapet: a brick and coping."""


@dataclass(frozen=True, slots=True)
class ShellTriangles(Columns):
    """Triangles given by their corners, each belonging to one piece.

    corners : (m, 3, 3) metres, counter-clockwise seen from outside
    piece   : (m,) int64
    surface : (m,) uint8, codes of `geoscene.geometry.mesh`
    """

    corners: Float
    piece: Ints
    surface: NDArray[np.uint8]


def triangulate(polygons: Polygons) -> tuple[Float, Ints]:
    """Constrained Delaunay triangles (m, 3, 2) of polygons (n,), counter-clockwise, and the polygon of each.

    No vertex is added. A polygon that GEOS cannot triangulate, or whose triangles do not cover it, yields
    none.
    """
    try:
        collections = shapely.constrained_delaunay_triangles(polygons)
    except GEOSException:
        collections = np.array([_triangles_or_none(p) for p in polygons], dtype=object)
    triangles, owner = shapely.get_parts(collections, return_index=True)
    xy = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    double = cross(xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0])
    xy[double < 0] = xy[double < 0, ::-1]
    covered = np.bincount(owner, weights=np.abs(double) / 2, minlength=len(polygons))
    fine = np.abs(covered - shapely.area(polygons)) < 1e-6 * np.maximum(covered, 1.0)
    keep = fine[owner] & (double != 0)
    return xy[keep], owner[keep].astype(np.int64)


def _triangles_or_none(polygon: Any) -> Any:
    try:
        return shapely.constrained_delaunay_triangles(polygon)
    except GEOSException:
        return shapely.GeometryCollection()


def lift(xy: Float, z: Float) -> Float:
    """Corners (m, 3, 3) of triangles in plan (m, 3, 2) at heights (m,) or (m, 3)."""
    height = np.broadcast_to(z[:, None] if z.ndim == 1 else z, (len(xy), 3))
    return np.concatenate([xy, height[..., None]], axis=2)


def boundary(corners: Float, piece: Ints) -> tuple[Float, Ints]:
    """Boundary edges (k, 2, 3), each in the direction of its only triangle, and their pieces."""
    ids, _ = weld(corners.reshape(-1, 3), np.repeat(piece, 3))
    edge, uses, _ = edge_uses(ids.reshape(-1, 3))
    open_ = np.flatnonzero(uses[edge] == 1)
    face, k = open_ // 3, open_ % 3
    return np.stack([corners[face, k], corners[face, (k + 1) % 3]], axis=1), piece[face]


def close(top: ShellTriangles, floor: ShellTriangles, *, underside: Float) -> ShellTriangles:
    """Closed shells: top surfaces, walls from their boundaries down to the undersides, and floors.

    Walls of no height are left out, so that a roof may reach down to the floor.

    top       : counter-clockwise from above, every vertex on the grid
    floor     : counter-clockwise from above; its boundary in plan is that of the top
    underside : (n,) z of each piece's floor
    """
    edge, piece = boundary(top.corners, top.piece)
    a, b = edge[:, 0], edge[:, 1]
    a0, b0 = a.copy(), b.copy()
    a0[:, 2] = b0[:, 2] = underside[piece]
    walls = np.concatenate([np.stack([a0, b0, b], axis=1), np.stack([a0, b, a], axis=1)])
    wall = ShellTriangles(walls, np.tile(piece, 2), np.full(len(walls), WALL, np.uint8))
    bottom = ShellTriangles(floor.corners[:, ::-1], floor.piece, np.full(len(floor), FLOOR, np.uint8))
    shells = ShellTriangles.concatenate([top, wall, bottom])
    # a wall of no height has triangles with two equal corners; real slivers must stay, or the shell opens
    return shells.take(distinct_corners(shells.corners))


def distinct_corners(triangles: Float) -> Bools:
    """(m,) bool, whether the three corners of triangles (m, 3, 2 or 3) are different grid points."""
    c = np.rint(triangles * 1e4)
    distinct: Bools = ~(c == np.roll(c, -1, axis=1)).all(axis=2).any(axis=1)
    return distinct


def prisms(polygons: Polygons, piece: Ints, *, low: Float, high: Float) -> ShellTriangles:
    """Prisms over polygons (n,) from z low to z high (n,), metres; ``piece`` (n,) are their numbers."""
    xy, owner = triangulate(polygons)
    top = ShellTriangles(lift(xy, to_grid(high)[owner]), owner, np.full(len(xy), ROOF, np.uint8))
    floor = ShellTriangles(lift(xy, to_grid(low)[owner]), owner, np.full(len(xy), FLOOR, np.uint8))
    shells = close(top, floor, underside=to_grid(low))
    return ShellTriangles(shells.corners, piece[shells.piece], shells.surface)


def parapets(polygons: Polygons, piece: Ints, *, low: Float, high: Float, rise: Float) -> ShellTriangles:
    """As `prisms`, with parapets along the edges of the flat tops, `PARAPET` wide and ``rise`` (n,) high.

    A polygon so narrow that no roof is left between its parapets becomes a prism.
    """
    inner = shapely.set_precision(shapely.buffer(polygons, -PARAPET, join_style="mitre"), GRID)
    rim = shapely.difference(polygons, inner)
    fits = (
        (shapely.area(inner) > 0.3 * shapely.area(polygons)) & shapely.is_valid(rim) & shapely.is_valid(inner)
    )
    plain = np.flatnonzero(~fits)
    shells = [prisms(polygons[plain], piece[plain], low=low[plain], high=high[plain])]
    rows = np.flatnonzero(fits)
    low, high, top = (to_grid(z[rows]) for z in (low, high, high + rise))
    roof, of_roof = triangulate(inner[rows])
    cap, of_cap = triangulate(rim[rows])
    base, of_base = triangulate(polygons[rows])
    edge, of_edge = boundary(lift(roof, high[of_roof]), of_roof)
    a, b = edge[:, 0], edge[:, 1]
    a1, b1 = a.copy(), b.copy()
    a1[:, 2] = b1[:, 2] = top[of_edge]
    inside = np.concatenate([np.stack([b, a, a1], axis=1), np.stack([b, a1, b1], axis=1)])
    corners = np.concatenate([lift(roof, high[of_roof]), lift(cap, top[of_cap]), inside])
    owner = np.concatenate([of_roof, of_cap, of_edge, of_edge])
    upper = ShellTriangles(corners, owner, np.full(len(corners), ROOF, np.uint8))
    floor = ShellTriangles(lift(base, low[of_base]), of_base, np.full(len(base), FLOOR, np.uint8))
    made = close(upper, floor, underside=low)
    shells.append(ShellTriangles(made.corners, piece[rows][made.piece], made.surface))
    return ShellTriangles.concatenate(shells)
