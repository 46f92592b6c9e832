"""Snap rounding of segments on an integer grid, and the faces of the plane between them.

Every end of a segment, and every crossing of two rounded to the grid, is a hot pixel: a square of side 1,
open above and on the right. A segment is divided at the hot pixels that it passes. All is
decided in integers (Hobby 1999; Guibas and Marimont 1998).

Faces and rings come in the order, and begin at the vertex, that follow from the ranks of half-edges alone: as
from GEOS's polygonizer, whose ranks are the order of lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import GeosceneError
from geoscene.typing import Bools, Float, Ints


def snap_rounded(
    start: Ints, end: Ints, *, fresh: Bools, box: Sequence[int] | None = None
) -> tuple[Ints, Ints, Ints]:
    """Segments divided where they intersect (snap rounding), each piece once.

    start, end : (n, 2) int64, less than 2**28 from each other, of different places
    fresh      : (n,) bool, segments that do not follow the one before
    box        : (xmin, ymin, xmax, ymax) in which most lie, on which the speed depends; theirs by default

    Returns points (k, 2), sorted by x, then y, numbers (2, m) of the ends of pieces, and ranks (2, m) of
    their half-edges: of each run of pieces between points at which others end or pass, forth, then back.
    """
    from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

    # Compiled functions have machine code for rows in one piece.
    n, start, end = len(start), np.ascontiguousarray(start), np.ascontiguousarray(end)
    cells = _cells(np.concatenate([start, end]), box)
    offset, found = kernels.cells_of_segments(start, end, cells)
    crossings = kernels.crossings(start, end, cells, offset, found)
    points, number = distinct_places(np.concatenate([start, end, crossings]))
    met = np.bincount(np.append(number[:n][fresh], number[n:]), minlength=len(points)) > 1
    met[number[2 * n :]] = True
    ends, rank = kernels.pieces(
        start, end, fresh, points, number[: 2 * n].reshape(2, n), met, cells, offset, found
    )
    return points, ends, rank


def distinct_places(places: Ints) -> tuple[Ints, Ints]:
    """Places (k, 2), sorted by x, then y, each once, and the number (n,) of each given one (n, 2).

    They lie within a few sides of a tile: the product of their extents is below 2**63.
    """
    low = places.min(axis=0, initial=np.iinfo(np.int64).max)
    x, y = (places - low).T
    height = int(y.max(initial=0)) + 1
    key, number = np.unique(x * height + y, return_inverse=True)
    return np.stack(np.divmod(key, height), axis=1) + low, number


def _cells(places: Ints, box: Sequence[int] | None) -> Ints:
    """West, south, side, columns and rows of square cells over a box, about one for every two places."""
    low, high = (places.min(axis=0), places.max(axis=0)) if box is None else np.split(np.array(box), 2)
    extent = np.maximum(high - low, 1).astype(float)
    side = max(int(np.ceil(np.sqrt(2.0 * extent.prod() / len(places)))), 1)
    side = max(side, int(extent.max()) // len(places))
    return np.array([*low, side, *(extent // side + 1)], np.int64)


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

    ends, rank = np.ascontiguousarray(ends), np.ascontiguousarray(rank)
    *columns, covered = kernels.rings(points, ends, rank, np.array(box, float))
    whole = (box[2] - box[0]) * (box[3] - box[1])
    if abs(covered - whole) > 1e-7 * whole:
        raise GeosceneError(f"ground cells of the tile at {box} cover {covered:.6f} m2 of {whole:.6f}")
    return GroundFaces(points, *columns)
