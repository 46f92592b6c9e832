"""Clusters of points above the ground, and their measures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.support.graphs import components
from geoscene.typing import Bools, Float, Ints
from lidar.tools.detection.detector import CloudPoints, Rectangle, fit_rectangle
from lidar.tools.detection.ground import height_above_ground


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Sizes in metres; heights above the ground.

    reach   : largest horizontal distance
    band    : lowest and highest height of points that are clustered
    cell    : side of the cells that points are thinned to before they are clustered
    link    : distance within which cells are of one object, at the sensor and per metre of distance
    length, width : of a vehicle that is seen in part
    fewest  : cells of an object
    certain : score below which nothing is returned
    """

    reach: float = 60.0
    band: tuple[float, float] = (0.3, 2.5)
    cell: float = 0.15
    link: tuple[float, float] = (0.55, 0.012)
    length: float = 4.3
    width: float = 1.8
    fewest: int = 3
    certain: float = 0.05


PLAIN = DetectorSettings()

_SPACING = 0.035
"""Largest angle between beams in radians, as of a scanner with 16 over 30 degrees."""

_BEYOND = np.arange(0.7, 14.0, 0.7)
"""Metres beyond the end of a side at which walls are looked for."""
_GAP = 3
"""Number of these places without a wall at which it ends."""
_BESIDE = 0.4
"""Metres from there within which points count: walls of openings stand back."""
WALL = 1.9
"""Metres above the ground from which on points are of a wall and not of a car."""


@dataclass(frozen=True, slots=True)
class ClusterShape:
    """Measures of a cluster, in metres.

    seen   : its rectangle, of the middles of its cells
    cells  : number of its cells
    sides  : the longer and the shorter side of the rectangle, cells included
    top    : height of its points above the ground, but for 2 % of them
    bottom : of its lowest point
    above  : share of the points at its place that follow above the clustered heights; what hangs higher
             over it, such as a tree's crown, does not count
    roof   : height of all points at its place, but for 2 % of them
    line   : length of what is higher than a car in line with its longer side, over gaps as of doors
    distance : from the sensor
    across : cosine between its longer side and the line of sight, 0 for one that is seen from the side
    """

    seen: Rectangle
    cells: int
    sides: tuple[float, float]
    top: float
    bottom: float
    above: float
    roof: float
    line: float
    distance: float
    across: float

    @property
    def standing(self) -> float:
        """0 to 1 by the gap to the ground, in which no beam may have hit it."""
        return ramp(-(self.bottom - _SPACING * self.distance), -0.7, -0.4)


@dataclass(frozen=True, slots=True)
class PointCluster:
    """Points that may be of one object.

    rows   : (m,) of the points of its `Scan`
    middle : (k, 2) metres, middles of its cells
    floor  : z of the ground below it
    """

    rows: Ints
    middle: NDArray[np.floating]
    shape: ClusterShape
    floor: float


@dataclass(frozen=True, slots=True)
class Scan:
    """A point cloud within the detector's maximum range, and its clusters.

    xyz    : (n, 3) metres, sensor frame
    height : (n,) metres above the ground
    row    : (n,) of the cloud
    """

    xyz: Float
    height: Float
    row: Ints
    clusters: tuple[PointCluster, ...]


def find_clusters(cloud: CloudPoints, *, settings: DetectorSettings) -> Scan:
    """Clusters of the point cloud of one turn of an upright scanner on a vehicle.

    Points above the ground, up to 2.5 m, are clustered seen from above; clusters that are too long are
    clustered again with half the distance.
    """
    xyz = np.asarray(cloud.xyz, float)
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    row = np.flatnonzero(np.isfinite(xyz).all(axis=1) & (distance < settings.reach) & (distance > 0.5))
    xyz = xyz[row]
    height = height_above_ground(xyz)
    low, high = settings.band
    solid = height > low
    body = np.flatnonzero(solid & (height < high))
    cells, cell = np.unique(
        np.floor(xyz[body, :2] / settings.cell).astype(np.int64), axis=0, return_inverse=True
    )
    middle = (cells + 0.5) * settings.cell
    groups = _clusters(middle, settings=settings)
    order = np.argsort(groups[cell], kind="stable")
    first = np.searchsorted(groups[cell][order], np.arange(groups.max(initial=-1) + 2))
    tall = _Tall(xyz[solid], height[solid])
    found = []
    for k in range(len(first) - 1):
        rows = body[order[first[k] : first[k + 1]]]
        mine = middle[groups == k]
        if len(mine) >= settings.fewest:
            shape = _shape(height[rows], mine, tall=tall, settings=settings)
            floor = float((xyz[rows, 2] - height[rows]).mean())
            found.append(PointCluster(rows, mine, shape, floor))
    return Scan(xyz, height, row, tuple(found))


def _shape(
    height: Float, middle: NDArray[np.floating], *, tall: _Tall, settings: DetectorSettings
) -> ClusterShape:
    seen = fit_rectangle(middle)
    distance = float(np.hypot(*seen.centre))
    around = tall.near(middle, radius=0.25)
    following = around[around < settings.band[1] + 0.5 + _SPACING * distance]
    return ClusterShape(
        seen,
        len(middle),
        (seen.size[0] + settings.cell, seen.size[1] + settings.cell),
        top=float(np.quantile(height, 0.98)),
        bottom=float(height.min()),
        above=np.count_nonzero(following > settings.band[1]) / max(len(following), 1),
        roof=float(np.quantile(around, 0.98)),
        line=_line(seen, tall=tall),
        distance=distance,
        across=_aspect(seen),
    )


def _line(seen: Rectangle, *, tall: _Tall) -> float:
    """Length in metres of the longer side, extended by wall-high neighbours in line with it."""
    axis = np.array([np.cos(seen.yaw), np.sin(seen.yaw)])
    side = np.array([-axis[1], axis[0]]) * seen.size[1] / 2
    beyond = seen.size[0] / 2 + _BEYOND
    ends = [seen.centre + line + end * np.outer(beyond, axis) for line in (side, -side) for end in (1, -1)]
    high = tall.high(np.concatenate(ends)).reshape(2, 2, len(_BEYOND))
    ended = ~np.any(sliding_window_view(high, _GAP, axis=2), axis=-1)
    steps = np.where(ended.any(axis=2), ended.argmax(axis=2), high.shape[2])
    return float(seen.size[0] + _BEYOND[0] * steps.sum(axis=1).max())


class _Tall:
    """Finds how high the points near a place are."""

    def __init__(self, xyz: Float, height: Float) -> None:
        self._tree, self.height = cKDTree(xyz[:, :2]), height
        self._walls = cKDTree(xyz[height > WALL, :2])

    def near(self, xy: NDArray[np.floating], *, radius: float) -> Float:
        """Heights of points within a radius of places (k, 2)."""
        rows = self._tree.query_ball_point(xy, radius)
        return self.height[np.unique(np.concatenate([*rows, []]).astype(np.int64))]

    def high(self, xy: NDArray[np.floating]) -> Bools:
        """Whether wall-high points are near places (k, 2)."""
        found: Bools = self._walls.query(xy, distance_upper_bound=_BESIDE)[0] < np.inf
        return found


def _clusters(xy: NDArray[np.floating], *, settings: DetectorSettings) -> Ints:
    """Number (n,) of the cluster of each cell."""
    link = settings.link[0] + settings.link[1] * np.hypot(*xy.T)
    groups = _link(xy, link)
    if not len(xy):
        return groups
    count = int(groups.max()) + 1
    span = np.array([np.ptp(xy[groups == k], axis=0).max() for k in range(count)])
    again = (span > 6.0)[groups]
    if again.any():
        groups[again] = count + _link(xy[again], link[again] / 2)
        groups = np.unique(groups, return_inverse=True)[1]
    return groups


def _link(xy: NDArray[np.floating], link: NDArray[np.floating]) -> Ints:
    """Connected components (n,) of places (n, 2) that are linked within the smaller of their distances."""
    if not len(xy):
        return np.empty(0, np.int64)
    pairs = cKDTree(xy).query_pairs(float(link.max()), output_type="ndarray")
    apart = np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1)
    pairs = pairs[apart <= np.minimum(link[pairs[:, 0]], link[pairs[:, 1]])]
    return components(*pairs.T, count=len(xy))


def _aspect(seen: Rectangle) -> float:
    """Cosine between the axis of a rectangle and the line of sight; 0 for a side view."""
    towards = seen.centre / max(float(np.hypot(*seen.centre)), 1e-9)
    return float(abs(towards @ [np.cos(seen.yaw), np.sin(seen.yaw)]))


def ramp(value: float, low: float, high: float) -> float:  # noqa: PLR0917 - as np.interp
    """0 up to ``low``, 1 from ``high``, linear between."""
    return min(max((value - low) / (high - low), 0.0), 1.0)
