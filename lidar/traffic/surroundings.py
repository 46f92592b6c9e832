"""The moving surroundings of the ego vehicle within which road users are simulated."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.roadgraph.routing import edge_lines
from geoscene.typing import Float
from lidar.geometry.poses import Trajectory
from lidar.traffic.lanes import Lanes

LEFT = 100.0
"""Metres beyond the radius at which road users disappear."""


@dataclass(frozen=True, slots=True)
class TrafficArea:
    """The area within ``radius`` of the ego over time.

    lines  : (m,) the graph's edges in plan
    tree   : their search tree
    start  : (m, 2) where they begin
    near   : (m,) bool, edges that ever come within radius
    time   : (t,) seconds, about one apart
    ego    : (t, 2) scene metres, the ego vehicle then
    radius  : true metres
    scale  : scene metres per true metre
    """

    lines: NDArray[np.object_]
    tree: shapely.STRtree
    start: Float
    near: NDArray[np.bool_]
    time: Float
    ego: Float
    radius: float
    scale: float

    def visits(self, xy: Float) -> list[tuple[float, float]]:
        """Seconds from and until which a place (2,) is in the surroundings of the ego, visit by visit."""
        away = np.hypot(*(self.ego - xy).T) / self.scale
        turns = np.flatnonzero((away <= self.radius) | (away > self.radius + LEFT))
        inside = away[turns] <= self.radius
        change = turns[np.flatnonzero(np.diff(inside, prepend=False))]
        begins, ends = self.time[change[::2]].tolist(), self.time[change[1::2]].tolist()
        return list(itertools.zip_longest(begins, ends, fillvalue=float(self.time[-1])))

    def until(self, xy: Float, start: float) -> float:
        """Seconds until which a place (2,) that is in the surroundings at ``start`` stays in them."""
        away = np.hypot(*(self.ego - xy).T) / self.scale
        left = (self.time > start) & (away > self.radius + LEFT)
        return float(self.time[np.argmax(left)] if left.any() else self.time[-1])


def surroundings_of(lanes: Lanes, ego: Trajectory, *, radius: float, scale: float) -> TrafficArea:
    """The surroundings of an ego trajectory."""
    lines = edge_lines(lanes.graph)
    seconds = ego.duration_ns * 1e-9
    time = np.linspace(0.0, seconds, max(int(np.ceil(seconds)), 1) + 1)
    xy = ego.at(np.round(time * 1e9).astype(np.int64)).position[:, :2]
    near = shapely.dwithin(lines, ego_line(ego), radius * scale)
    start = shapely.get_coordinates(shapely.get_point(lines, 0)).reshape(-1, 2)
    return TrafficArea(lines, shapely.STRtree(lines), start, near, time, xy, radius, scale)


def ego_line(ego: Trajectory) -> shapely.Geometry:
    """The ego trajectory in plan, simplified."""
    xy = ego.position[:: max(len(ego.position) // 5000, 1), :2]
    return shapely.linestrings(xy).simplify(0.2) if np.ptp(xy, axis=0).max() > 0.5 else shapely.points(xy[0])


def entrances(lanes: Lanes, area: TrafficArea, *, t: float) -> list[tuple[int, float]]:
    """Edges, and shares of their lengths, at which traffic enters the surroundings of the ego at a time.

    That is where edges cross the rim inwards, and where they come into the map.
    """
    here = np.array([np.interp(t, area.time, area.ego[:, c]) for c in (0, 1)])
    rim = shapely.Point(here).buffer(area.radius * area.scale, quad_segs=16).exterior
    used = area.near & (lanes.traffic_weight > 0) & lanes.open
    rows = np.sort(area.tree.query(rim))
    rows = rows[used[rows]]
    found: list[tuple[int, float]] = []
    cut = shapely.intersection(area.lines[rows], rim)
    points, owner = shapely.get_parts(cut, return_index=True)
    for point, k in zip(points, rows[owner].tolist(), strict=True):
        if point.geom_type != "Point":
            continue
        share = float(shapely.line_locate_point(area.lines[k], point, normalized=True))
        length = max(area.lines[k].length, 1e-9)
        ahead = shapely.line_interpolate_point(area.lines[k], min(share + 2.0 / length, 1.0), normalized=True)
        if np.hypot(ahead.x - here[0], ahead.y - here[1]) < area.radius * area.scale:
            found.append((k, share))
    within = np.hypot(*(area.start - here).T) < area.radius * area.scale
    return found + [(k, 0.0) for k in np.flatnonzero(within & lanes.entry & used).tolist()]
