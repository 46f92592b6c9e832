"""Faces of the plane between noded segments, and their adjacency.

Faces and rings come in the order, and begin at the vertex, that follow from the ranks of half-edges alone: as
from GEOS's polygonizer, whose ranks are the order of lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import GeosceneError
from geoscene.typing import Bools, Float, Ints


@dataclass(frozen=True, slots=True)
class GroundFaces:
    """Faces that segments bound, and the half-edges of their outlines: ring by ring, in the ring's order.

    points : (k, 2) float64, metres, those of the segments
    a, b   : (m,) int64, numbers of a half-edge's ends
    cell   : (m,) int64, the face on its right
    other  : (m,) int64, the face on its left, -1 outside of the box
    ring   : (r + 1,) int64, offsets of the rings in the half-edges
    face   : (n + 1,) int64, offsets of the faces in the rings: the ring around it, then those within
    """

    points: Float
    a: Ints
    b: Ints
    cell: Ints
    other: Ints
    ring: Ints
    face: Ints

    def __len__(self) -> int:
        """Number of faces."""
        return len(self.face) - 1

    @property
    def first(self) -> Ints:
        """The first half-edge (n,) of each face."""
        return self.ring[self.face[:-1]]

    def polygons(self, chosen: Bools | None = None) -> NDArray[np.object_]:
        """Shapely polygons of the chosen faces (n,), of all by default.

        Neighbours share all vertices along their common border.
        """
        rings, count = np.arange(len(self.ring) - 1), np.diff(self.face)
        if chosen is not None:
            rings, count = rings[np.repeat(chosen, count)], count[chosen]
        size = np.diff(self.ring)[rings] + 1
        closed = np.append(0, np.cumsum(size))
        place = np.arange(closed[-1]) + np.repeat(self.ring[rings] - closed[:-1], size)
        place[closed[1:] - 1] = self.ring[rings]
        offsets = (closed, np.append(0, np.cumsum(count)))
        made: NDArray[np.object_] = shapely.from_ragged_array(
            shapely.GeometryType.POLYGON, self.points[self.a[place]], offsets
        )
        return made

    def inner_points(self) -> Float:
        """A point (n, 2) within each face."""
        from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

        inner: Float = kernels.inner_points(self.points, self.a, self.ring, self.face)
        return inner


def faces(points: Float, ends: Ints, *, rank: Ints, box: tuple[float, float, float, float]) -> GroundFaces:
    """The faces within a box that noded segments bound.

    points : (k, 2) float64, metres, each once, on a grid in which twice the area of each ring is exact
    ends   : (2, m) int64, numbers of the ends of segments, each segment once
    rank   : (2, m) int64, ranks of the segments' half-edges: from the first end to the second, and back
    box    : (xmin, ymin, xmax, ymax), whose sides are among the segments

    Segments with the same face on both sides bound nothing and are left out. Raises GeosceneError if the
    faces do not add up to the box.
    """
    from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

    *columns, covered = kernels.rings(points, ends, np.ascontiguousarray(rank), np.array(box, float))
    whole = (box[2] - box[0]) * (box[3] - box[1])
    if abs(covered - whole) > 1e-7 * whole:
        raise GeosceneError(f"ground cells of the tile at {box} cover {covered:.6f} m2 of {whole:.6f}")
    return GroundFaces(points, *columns)
