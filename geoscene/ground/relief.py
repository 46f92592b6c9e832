"""Heights that cambers of carriageways and beds of ballast add to the ground; ends of raised sidewalks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.typing import Float, Ints

CAMBER = 0.025
"""Fall from the middle of a carriageway to its edges, m/m (RASt 06, RAL: the least crossfall is 2.5 %)."""

HEIGHT = 0.4
"""Metres from the ground to the top of the ballast. Assumed: 30 cm below sleepers of 21 cm, partly sunk."""

SLOPE = 0.6
"""Metres in plan over which ballast falls to the ground: 1 to 1.5, the slope at which it lies."""

FADE = 15.0
"""Metres of track over which a bed comes down to crossings, bridges and tunnels. Assumed."""


@dataclass(frozen=True, slots=True)
class Kerbs:
    """Raised sidewalks beside carriageways.

    ends : STRtree of lines across roads at which they come down, as bridges and tunnels are level
    """

    ends: shapely.STRtree

    @classmethod
    def of(cls, ends: Iterable[Any] = ()) -> Kerbs:
        """Kerbs along given lines."""
        return cls(shapely.STRtree(np.fromiter(ends, object)))


@dataclass(frozen=True, slots=True)
class Camber:
    """Gable roofs over straight pieces of centre lines; where several overlap the highest counts.

    start, end : (m, 2) float64 scene metres, ends of the pieces
    half  : (m,) float64 metres, half the width of the carriageway
    crown : (m, 2) float64 metres by which the middle stands above the edges at start and end
    tree  : STRtree of the pieces
    """

    start: Float
    end: Float
    half: Float
    crown: Float
    tree: shapely.STRtree

    @classmethod
    def of(cls, start: Float, end: Float, *, half: Float, crown: Float) -> Camber:
        """The camber of pieces; columns as above."""
        pieces = shapely.linestrings(np.stack([start, end], axis=1)) if len(start) else np.empty(0, object)
        return cls(start, end, half, crown, shapely.STRtree(pieces))

    def metres(self, box: Sequence[float]) -> float:
        """Length of the pieces whose middle lies in a box (xmin, ymin, xmax, ymax)."""
        middle = (self.start + self.end) / 2
        within = ((middle >= box[:2]) & (middle <= box[2:])).all(axis=1)
        return float(np.hypot(*(self.end - self.start)[within].T).sum())

    def height(self, xy: Float) -> Float:
        """Height (n,) in metres of the surface above the edges of its carriageway at points (n, 2).

        0 on edges and outside. It depends on the place alone and has no steps.
        """
        z = np.zeros(len(xy))
        if not len(self.start):
            return z
        point, piece = shapes_near(self.tree, xy, reach=self.half)
        along = self.end[piece] - self.start[piece]
        square = np.maximum((along**2).sum(axis=1), 1e-12)
        share = np.clip(((xy[point] - self.start[piece]) * along).sum(axis=1) / square, 0.0, 1.0)
        away = np.hypot(*(xy[point] - self.start[piece] - share[:, None] * along).T)
        crown = self.crown[piece, 0] * (1.0 - share) + self.crown[piece, 1] * share
        np.maximum.at(z, point, crown * np.maximum(1.0 - away / self.half[piece], 0.0))
        return z


@dataclass(frozen=True, slots=True)
class Raised:
    """Surfaces above the planned height of the ground: cambered carriageways and ballast beds.

    They do not overlap.
    """

    camber: Camber
    beds: Beds

    def height(self, xy: Float) -> Float:
        """Metres (n,) above the planned height at points (n, 2)."""
        return self.camber.height(xy) + self.beds.height(xy)


@dataclass(frozen=True, slots=True)
class Beds:
    """Ballast beds of railway tracks.

    tops : STRtree of the level tops, polygons in scene metres that do not overlap
    ends : STRtree of the places to which beds come down
    """

    tops: shapely.STRtree
    ends: shapely.STRtree

    @classmethod
    def of(cls, tops: NDArray[np.object_], ends: NDArray[np.object_]) -> Beds:
        """Beds with such tops that come down to such places."""
        return cls(shapely.STRtree(tops), shapely.STRtree(ends))

    def height(self, xy: Float) -> Float:
        """Height (n,) in metres of ballast beds above the ground at points (n, 2)."""
        z = np.zeros(len(xy))
        point, away = _distances(self.tops, xy, reach=SLOPE)
        np.maximum.at(z, point, HEIGHT * (1.0 - away / SLOPE))
        if z.any():
            share = np.ones(len(xy))
            point, away = _distances(self.ends, xy, reach=FADE)
            np.minimum.at(share, point, away / FADE)
            z *= share
        return np.asarray(z, float)

    def square_metres(self, box: Sequence[float]) -> float:
        """Area of the tops within a box (xmin, ymin, xmax, ymax)."""
        return float(shapely.area(shapely.intersection(self.tops.geometries, shapely.box(*box))).sum())


def _distances(tree: shapely.STRtree, xy: Float, *, reach: float) -> tuple[Ints, Float]:
    """Points (k,) and their distances (k,) in metres to geometries of a tree, within ``reach``."""
    point, row = shapes_near(tree, xy, reach=reach)
    return point, shapely.distance(shapely.points(xy[point]), tree.geometries[row])


def shapes_near(tree: shapely.STRtree, xy: Float, *, reach: float | Float) -> tuple[Ints, Ints]:
    """Points (k,) and rows (k,) of a tree's geometries whose bounding boxes, made wider, hold them.

    xy    : (n, 2) float64, close together, such as those of a tile
    reach : metres by which boxes are wider on each side, of all or of each geometry
    """
    none = np.empty(0, np.int64)
    if not len(xy) or not len(tree.geometries):
        return none, none
    reach = np.broadcast_to(reach, len(tree.geometries))
    most = reach.max()
    row = np.sort(tree.query(shapely.box(*(xy.min(axis=0) - most), *(xy.max(axis=0) + most))))
    point, box = points_in_boxes(xy, shapely.bounds(tree.geometries[row]), wider=reach[row])
    return point, row[box]


def points_in_boxes(xy: Float, boxes: Float, *, wider: float | Float) -> tuple[Ints, Ints]:
    """Points (k,) and the boxes (k,) that hold them, of points (n, 2) and boxes (m, 4) made wider."""
    from geoscene.ground import kernels  # noqa: PLC0415 - slow to import

    by_y = np.argsort(xy[:, 1])
    wide = boxes + np.multiply.outer(np.broadcast_to(wider, len(boxes)), [-1.0, -1.0, 1.0, 1.0])
    point, box = kernels.in_boxes(xy[by_y], wide)
    return by_y[point], box
