"""Solids in layers over a triangulated area: each triangle is solid in some layers and empty in others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.polylines import cross
from geoscene.ground.faces import distinct_places
from geoscene.typing import Bools, Float, Ints

PRECISION = 2.0**-9
"""Metres: the grid that plans are cut on, 2 mm, as that of the ground."""

_THIN = PRECISION / 2
"""Metres, width of the thinnest triangle at the border of a plan."""

SIDE = -1
"""Level of a face that stands upright."""


@dataclass(frozen=True, slots=True)
class LayerTriangulation:
    """A conforming triangulation of an area.

    xy    : (n, 2) float64, scene metres
    faces : (m, 3) int64, counter-clockwise
    """

    xy: Float
    faces: Ints

    @property
    def middle(self) -> Float:
        """A point (m, 2) within each triangle."""
        middle: Float = self.xy[self.faces].mean(axis=1)
        return middle


@dataclass(frozen=True, slots=True)
class Shell:
    """Closed boundary of the solid layers.

    vertices : (v, 3) float64
    faces    : (f, 3) int64, counter-clockwise seen from the empty side
    level    : (f,) int64, the level that a face lies on, `SIDE` for vertical ones
    up       : (f,) bool, the face points upward
    triangle : (f,) int64, the triangle of the plan whose solid it bounds
    """

    vertices: Float
    faces: Ints
    level: Ints
    up: Bools
    triangle: Ints


def cut_plan(area: object, lines: NDArray[np.object_]) -> LayerTriangulation:
    """The triangles of an area (Polygon or MultiPolygon), none of which crosses one of the lines.

    Lines are shapely geometries; parts outside the area are ignored. All is snap-rounded to a grid of 2 mm.
    """
    near = lines[shapely.intersects(lines, area)] if len(lines) else lines
    within = shapely.intersection(near, area)
    linework = shapely.union_all([shapely.boundary(area), *within], grid_size=PRECISION)
    cells = shapely.get_parts(shapely.polygonize([linework]))
    shapely.prepare(area)
    inside = shapely.get_coordinates(shapely.point_on_surface(cells))
    cells = cells[shapely.contains_xy(area, inside[:, 0], inside[:, 1])]
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(cells))
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    grid, faces = distinct_places(np.rint(corners.reshape(-1, 2) / PRECISION).astype(np.int64))
    plan = LayerTriangulation(np.asarray(grid * PRECISION, float), faces.reshape(-1, 3))
    twice = _twice_areas(plan)  # of multiples of the grid, so it is exact
    faces = np.where((twice < 0)[:, None], plan.faces[:, ::-1], plan.faces)
    return without_slivers(LayerTriangulation(plan.xy, faces[twice != 0]))


def without_slivers(plan: LayerTriangulation) -> LayerTriangulation:
    """The plan without triangles at its border that are thinner than `_THIN`, and connected at each vertex.

    Their sides would be walls so near to each other that rounding makes them cross. One with only its
    shortest side at the border is closed by merging that side's ends; others are left out.
    """
    while True:
        start, end, own, other = half_edges(plan)
        length = np.hypot(*(plan.xy[end] - plan.xy[start]).T).reshape(-1, 3)
        border = other.reshape(-1, 3) < 0
        thin = border.any(axis=1) & (_twice_areas(plan) < _THIN * length.max(axis=1))
        if not thin.any():
            return plan
        needle = thin & (border.sum(axis=1) == 1) & (border.argmax(axis=1) == length.argmin(axis=1))
        for triangle in np.flatnonzero(needle):
            side = 3 * triangle + border[triangle].argmax()
            faces = np.where(plan.faces == end[side], start[side], plan.faces)
            merged = LayerTriangulation(plan.xy, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])
            if (_twice_areas(merged) > 0).all():
                break
        else:
            kept = _remove_pinches(plan, ~thin, start=start, own=own, other=other)
            merged = LayerTriangulation(plan.xy, plan.faces[kept])
        plan = merged


def _twice_areas(plan: LayerTriangulation) -> Float:
    """Twice the area (m,) of each triangle; negative if clockwise."""
    a, b, c = (plan.xy[plan.faces[:, k]] for k in range(3))
    return cross(b - a, c - a)


def raise_shell(plan: LayerTriangulation, levels: Float, *, solid: Bools) -> Shell:
    """The closed surface around the solid layers of a plan's triangles.

    Where solids would touch along a vertical edge only, the smallest triangles there are left out, so that
    every edge has two faces.

    levels : (n, l) float64, rising heights of the levels at each of the plan's vertices
    solid  : (m, l - 1) bool, whether a triangle is solid between one level and the next
    """
    n, count = levels.shape
    start, end, own, other = half_edges(plan)
    solid = np.column_stack(
        [_remove_pinches(plan, layer, start=start, own=own, other=other) for layer in solid.T]
    )
    vertices = np.column_stack([np.tile(plan.xy, (count, 1)), levels.T.reshape(-1)])
    padded = np.pad(solid, ((0, 0), (1, 1)))
    faces, level, up, triangle = [], [], [], []
    for k in range(count):
        for looks_up, rows in (
            (True, np.flatnonzero(padded[:, k] & ~padded[:, k + 1])),
            (False, np.flatnonzero(~padded[:, k] & padded[:, k + 1])),
        ):
            corners = plan.faces[rows] + k * n
            faces.append(corners if looks_up else corners[:, ::-1])
            level.append(np.full(len(rows), k))
            up.append(np.full(len(rows), looks_up))
            triangle.append(rows)
    beyond = np.append(solid, np.zeros((1, count - 1), np.bool_), axis=0)[other]
    edge, layer = np.nonzero(solid[own] & ~beyond)
    a, b = start[edge] + layer * n, end[edge] + layer * n
    faces += [np.column_stack([a, b, b + n]), np.column_stack([a, b + n, a + n])]
    level.append(np.full(2 * len(a), SIDE))
    up.append(np.zeros(2 * len(a), np.bool_))
    triangle += [own[edge], own[edge]]
    return Shell(
        vertices, np.concatenate(faces), np.concatenate(level), np.concatenate(up), np.concatenate(triangle)
    )


def _remove_pinches(plan: LayerTriangulation, solid: Bools, *, start: Ints, own: Ints, other: Ints) -> Bools:
    """The layer (m,) reduced so that the solid around each vertex is connected."""
    area = np.repeat(_twice_areas(plan), 3)
    solid = solid.copy()
    while True:
        # Each sector of solid about a vertex has one side that begins there with the empty on its right.
        side = solid[own] & ~np.append(solid, False)[other]
        pinched = np.bincount(start[side], minlength=len(plan.xy)) > 1
        corner = np.flatnonzero(pinched[start] & solid[own])
        if not len(corner):
            return solid
        order = corner[np.lexsort([area[corner], start[corner]])]
        least = order[np.flatnonzero(np.diff(start[order], prepend=-1))]
        solid[own[least]] = False


def half_edges(plan: LayerTriangulation) -> tuple[Ints, Ints, Ints, Ints]:
    """Edges of all triangles: (start, end, triangle, the triangle on the other side or -1), each (3 m,)."""
    start, end = plan.faces.ravel(), np.roll(plan.faces, -1, axis=1).ravel()
    own = np.repeat(np.arange(len(plan.faces)), 3)
    there, back = start * len(plan.xy) + end, end * len(plan.xy) + start
    order = np.argsort(there)
    place = np.minimum(np.searchsorted(there[order], back), len(order) - 1)
    twin = order[place]
    return start, end, own, np.where(there[twin] == back, own[twin], -1)
