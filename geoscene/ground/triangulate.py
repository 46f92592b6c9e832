"""Conforming triangulation of the ground's cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import GeosceneError
from geoscene.geometry.polylines import cross
from geoscene.ground.partition import Partition, distinct
from geoscene.ground.terrain_lattice import Lattice, lattice_corners
from geoscene.typing import Float, Ints


@dataclass(frozen=True, slots=True)
class PlaneTriangles:
    """Triangles in the plane.

    points : (n, 2) float64, scene metres, sorted by x, then y, each once
    faces  : (m, 3) int32, counter-clockwise
    cell   : (m,) int32, the cell of the partition that each lies in
    """

    points: Float
    faces: NDArray[np.int32]
    cell: NDArray[np.int32]

    def __len__(self) -> int:
        """Number of triangles."""
        return len(self.faces)


def triangulate(partition: Partition) -> PlaneTriangles:
    """The triangles of a partition: each cell by constrained Delaunay over its own vertices, none added.

    Neighbouring cells have the same vertices on their border, so triangles meet edge to edge, and they do
    so over the borders of tiles too. Of all triangulations that keep the borders, Delaunay's has the
    least sharp angles (Lee and Lin 1986).

    Raises GeosceneError if the triangles of a cell do not add up to its area.
    """
    found = shapely.constrained_delaunay_triangles(partition.polygon)
    rings, cell = shapely.get_coordinates(found, return_index=True)
    return _check(partition, rings.reshape(-1, 4, 2)[:, :3], cell=cell[::4])


def triangulate_lattice(partition: Partition, vertices: Lattice) -> PlaneTriangles:
    """The triangles of a tile of bare ground, which is one cell, with the vertices that the terrain needs.

    Raises GeosceneError if the triangles do not add up to its area.
    """
    corners = lattice_corners(vertices, partition.polygon[0])
    return _check(partition, corners, cell=np.zeros(len(corners), np.int64))


def _check(partition: Partition, corners: Float, *, cell: Ints) -> PlaneTriangles:
    """Triangles with these corners (m, 3, 2), if they add up to the area of their cells (m,)."""
    points, number = distinct(corners.reshape(-1, 2))
    faces = number.reshape(-1, 3)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = 0.5 * cross(b - a, c - a)  # differences of points on the grid are exact
    faces = np.where((area < 0)[:, None], faces[:, ::-1], faces)
    covered = np.bincount(cell, np.abs(area), minlength=len(partition))
    amiss = np.abs(covered - shapely.area(partition.polygon)) > 1e-6
    if amiss.any() or (area == 0).any():
        where = partition.polygon[np.argmax(amiss)].representative_point()
        raise GeosceneError(
            f"{int(amiss.sum())} ground cells not fully triangulated, {int((area == 0).sum())} triangles "
            f"have no area; look at ({where.x:z.3f}, {where.y:z.3f})"
        )
    return PlaneTriangles(points, faces.astype(np.int32), cell.astype(np.int32))
