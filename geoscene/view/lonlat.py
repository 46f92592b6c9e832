"""Longitude and latitude by interpolation, for a page that has no map projections."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.geometry.frames import Frame
from geoscene.typing import Float

ACCURACY = 0.01
"""Largest error of the interpolation in metres."""

_MOST = 129


@dataclass(frozen=True, slots=True)
class LonLatGrid:
    """Degrees at the nodes of a grid over a rectangle; bilinear between them.

    bounds : (xmin, ymin, xmax, ymax) in scene metres
    lon, lat : (n, n) degrees, rows from south to north
    error  : metres, the largest found between nodes
    """

    bounds: tuple[float, float, float, float]
    lon: Float
    lat: Float
    error: float

    def at(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Longitude and latitude in degrees of scene coordinates."""
        xmin, ymin, xmax, ymax = self.bounds
        last = len(self.lon) - 1
        u, v = (x - xmin) / (xmax - xmin) * last, (y - ymin) / (ymax - ymin) * last
        i, j = (np.clip(np.floor(w), 0, last - 1).astype(int) for w in (u, v))
        u, v = u - i, v - j
        weights = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v)
        nodes = ((j, i), (j, i + 1), (j + 1, i), (j + 1, i + 1))
        lon, lat = (
            sum(w * grid[n] for w, n in zip(weights, nodes, strict=True)) for grid in (self.lon, self.lat)
        )
        return lon, lat


def lonlat_grid(frame: Frame, bounds: tuple[float, float, float, float]) -> LonLatGrid:
    """The coarsest grid of 2^k + 1 nodes a side that is within `ACCURACY`, or one of 129, with its error.

    The error is taken at the middles of cells and of their sides, where a bilinear patch is furthest from a
    quadratic one.
    """
    xmin, ymin, xmax, ymax = bounds
    n = 2
    while True:
        fine = np.linspace(0, 1, 2 * n - 1)
        x, y = np.meshgrid(xmin + (xmax - xmin) * fine, ymin + (ymax - ymin) * fine)
        lon, lat = (np.asarray(v, float) for v in frame.to_geographic(x, y))
        # Nine decimals of a degree are 0.1 mm; across the date line degrees must not jump.
        lon, lat = np.round(lon[0, 0] + (lon - lon[0, 0] + 180) % 360 - 180, 9), np.round(lat, 9)
        grid = LonLatGrid(bounds, lon[::2, ::2], lat[::2, ::2], 0.0)
        there = frame.from_geographic(*grid.at(x, y))
        error = float(np.hypot(there[0] - x, there[1] - y).max())
        if error <= ACCURACY or n >= _MOST:
            return LonLatGrid(bounds, grid.lon, grid.lat, error)
        n = 2 * n - 1
