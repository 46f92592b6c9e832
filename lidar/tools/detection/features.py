"""Measures of clusters that a learned detector decides by.

They are of coordinates alone, as is all of the detector: intensities of simulated materials are more alike
than real ones, and a model would learn the simulation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.typing import Float
from lidar.tools.detection.clusters import PointCluster, Scan

_BANDS = (0.3, 0.7, 1.1, 1.5, 2.0, 2.5)
"""Metres above the ground between which the share of the points is counted."""
_PARTS = (0.3, 0.9, 1.4, 2.5)
"""Metres above the ground between which length and width are measured."""
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
_BEAM = 0.004
"""Radians of elevation that tell two rows of points apart."""
_AROUND = 1.0
"""Metres around a cluster within which others count."""

FEATURES = (
    *("distance", "points", "cells", "rows", "length", "width", "edge", "across"),
    *("top", "bottom", "roof", "above", "standing"),
    *("towards", "sideways", "lone", "dense"),
    *(f"height_{round(100 * q)}" for q in _QUANTILES),
    *(f"share_{low:g}" for low in _BANDS[:-1]),
    *(f"{side}_{low:g}" for low in _PARTS[:-1] for side in ("length", "width")),
    *("line", "plane", "scatter"),
)
"""Names of the columns of `features`:

distance, edge, across, top, bottom, roof, above, standing : as in `ClusterShape`
points, cells : natural logarithms of their numbers
rows          : number of elevations of its points, of steps of 4 mrad
length, width : metres, of its rectangle
towards, sideways : metres, extent along the line of sight and across it
lone          : share of its own among the cells within a metre of its rectangle's circle
dense         : logarithm of its points against those that its distance and its extents let expect
height_<k>    : metres above the ground of the k-th percentile of its points
share_<z>     : share of its points from z metres above the ground up to the next such height
length_<z>, width_<z> : metres, extents of its points from z up, along its rectangle; -1 without any
line, plane, scatter : differences of the roots of the moments of its points, against the largest
"""


def features(scan: Scan) -> NDArray[np.float32]:
    """Measures (clusters, features) of the clusters of a scan."""
    found = np.empty((len(scan.clusters), len(FEATURES)), np.float32)
    if not len(found):
        return found
    tree = cKDTree(np.vstack([one.middle for one in scan.clusters]))
    for k, one in enumerate(scan.clusters):
        found[k] = _measures(one, scan, tree=tree)
    return found


def _measures(one: PointCluster, scan: Scan, *, tree: cKDTree) -> list[float]:
    shape, xyz, height = one.shape, scan.xyz[one.rows], scan.height[one.rows]
    flat = xyz[:, :2] - shape.seen.centre
    sight = shape.seen.centre / max(shape.distance, 1e-9)
    towards = float(np.ptp(flat @ sight))
    sideways = float(np.ptp(flat @ np.array([-sight[1], sight[0]])))
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    radius = float(np.hypot(*shape.sides)) / 2 + _AROUND
    near = tree.query_ball_point(shape.seen.centre, radius, return_length=True)
    seen_area = max(sideways, 0.2) * max(float(np.ptp(height)), 0.2)
    expected = len(scan.xyz) * seen_area / max(shape.distance, 1.0) ** 2
    return [
        shape.distance,
        float(np.log(len(xyz))),
        float(np.log(shape.cells)),
        len(np.unique(np.floor(elevation / _BEAM))),
        *shape.sides,
        shape.seen.edge,
        shape.across,
        shape.top,
        shape.bottom,
        shape.roof,
        shape.above,
        shape.standing,
        towards,
        sideways,
        shape.cells / max(int(near), 1),
        float(np.log(len(xyz) / expected)),
        *np.quantile(height, _QUANTILES).tolist(),
        *(np.histogram(height, _BANDS)[0] / len(height)).tolist(),
        *_extents(flat, height, yaw=shape.seen.yaw),
        *_moments(xyz),
    ]


def _extents(flat: Float, height: Float, *, yaw: float) -> list[float]:
    """Length and width of the lower, the middle and the upper part."""
    along = flat @ np.array([np.cos(yaw), np.sin(yaw)])
    across = flat @ np.array([-np.sin(yaw), np.cos(yaw)])
    part = np.digitize(height, _PARTS[1:-1])
    found = []
    for k in range(len(_PARTS) - 1):
        mine = part == k
        found += [float(np.ptp(side[mine])) if mine.any() else -1.0 for side in (along, across)]
    return found


def _moments(xyz: Float) -> list[float]:
    """Linearity, planarity and scattering of points."""
    around = xyz - xyz.mean(axis=0)
    small, middle, large = np.sqrt(np.maximum(np.linalg.eigvalsh(around.T @ around / len(xyz)), 0)).tolist()
    large = max(large, 1e-9)
    return [(large - middle) / large, (middle - small) / large, small / large]
