"""Ballast beds of railways: level tops above the ground, with slopes at their sides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.ground.nearby import shapes_near
from geoscene.typing import Float, Ints

HEIGHT = 0.4
"""Metres from the ground to the top of the ballast. Assumed: 30 cm below sleepers of 21 cm, partly sunk."""

SLOPE = 0.6
"""Metres in plan over which ballast falls to the ground: 1 to 1.5, the slope at which it lies."""

FADE = 15.0
"""Metres of track over which a bed comes down to crossings, bridges and tunnels. Assumed."""


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
