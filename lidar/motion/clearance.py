"""Collision checks of a vehicle's body along a track, shifts around obstacles, and turning manoeuvres."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import BlockedError
from lidar.motion.steering import Pose, SteeredTrack, mean_gap
from lidar.motion.vehicle import Vehicle

ASIDE = 4.0
"""Maximum lateral shift of a line, in metres, to pass an obstacle."""
_NEAR = 12.0  # metres from a junction within which a collision blocks its turn, not the edge
_SWEEP = 0.5  # metres between the poses that are checked for collisions


@dataclass(frozen=True, slots=True)
class PathParameters:
    """Parameters of path planning.

    tree   : obstacles, polygons in scene metres
    margin : minimum distance in metres between body and obstacles
    step   : true metres between the rows of a track
    side   : side of the street that is driven on
    """

    vehicle: Vehicle
    frame: Frame
    tree: shapely.STRtree
    margin: float
    step: float
    side: str


@dataclass(frozen=True, slots=True)
class RouteLine(Columns):
    """The line of a route, resampled evenly.

    xyz   : (n, 3) scene metres
    edge, limit, free : as for `Route`
    turn  : (n,) bool, the vehicle makes a U-turn after this point
    """

    xyz: Float
    edge: NDArray[np.int32]
    limit: Float
    free: NDArray[np.bool_]
    turn: NDArray[np.bool_]

    @property
    def gap(self) -> float:
        """Mean distance between points in plan, scene metres."""
        return mean_gap(self.xyz)


def body_outlines(
    xy: Float, heading: Float, *, vehicle: Vehicle, margin: float = 0.0, aside: float = 0.0
) -> NDArray[np.object_]:
    """Outlines (n,) of the body in plan, with a margin all round and ``aside`` more metres on each side.

    xy      : (n, 2) scene metres of the rear axle
    heading : (n,) radians
    """
    back, front, half = -vehicle.rear_overhang - margin, vehicle.front + margin, vehicle.width / 2 + margin
    half += aside
    box = np.array([[back, -half], [front, -half], [front, half], [back, half]])
    c, s = np.cos(heading), np.sin(heading)
    turn = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)
    corners = xy[:, None, :] + np.einsum("nij,kj->nki", turn, box)
    shapes: NDArray[np.object_] = shapely.polygons(corners)
    return shapes


def colliding_rows(track: SteeredTrack, line: RouteLine, *, setting: PathParameters) -> NDArray[np.int64]:
    """Rows (k,) of a track where the body intersects obstacles."""
    every = max(round(_SWEEP / track.step), 1)
    last = len(track.row) - 1
    rows = np.arange(0, last + 1, every)
    if rows[-1] < last:
        rows = np.append(rows, last)
    rows = rows[~line.free[track.row[rows]]]
    bodies = body_outlines(
        track.xy[rows], track.heading[rows], vehicle=setting.vehicle, margin=setting.margin
    )
    return np.unique(rows[setting.tree.query(bodies, predicate="intersects")[0]])


def pushes(
    track: SteeredTrack, line: RouteLine, *, setting: PathParameters
) -> tuple[Float, NDArray[np.int64]]:
    """Lateral shifts (k,) in metres, positive to the left, and the rows (k,) of the line that need them.

    NaN where no shift within `ASIDE` frees the body.
    """
    rows = colliding_rows(track, line, setting=setting)
    if not len(rows):
        return np.empty(0), np.empty(0, np.int64)
    half = setting.vehicle.width / 2 + setting.margin
    strips = body_outlines(
        track.xy[rows], track.heading[rows], vehicle=setting.vehicle, margin=setting.margin, aside=ASIDE
    )
    strip, obstacle = setting.tree.query(strips, predicate="intersects")
    parts, of = shapely.get_parts(
        shapely.intersection(strips[strip], setting.tree.geometries[obstacle]), return_index=True
    )
    points, part = shapely.get_coordinates(parts, return_index=True)
    k = strip[of][part]
    c, s = np.cos(track.heading[rows])[k], np.sin(track.heading[rows])[k]
    d = points - track.xy[rows][k]
    ahead, across = d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s
    low, high = np.full(len(parts), np.inf), np.full(len(parts), -np.inf)
    np.minimum.at(low, part, across)
    np.maximum.at(high, part, across)
    near = np.full(len(rows), -np.inf)
    body = np.abs(across) <= half
    np.maximum.at(near, k[body], ahead[body])
    push = np.array(
        [_way_out(low[strip[of] == r], high[strip[of] == r], half=half) for r in range(len(rows))]
    )
    at = track.row[rows] + np.round(np.clip(near, 0.0, setting.vehicle.front) / line.gap).astype(np.int64)
    return push, np.minimum(at, len(line.edge) - 1)


def _way_out(low: Float, high: Float, *, half: float) -> float:
    """Smallest lateral shift that moves a body out of all intervals; NaN if none within `ASIDE` does."""
    ways = np.concatenate([high + half, low - half])
    ways += np.copysign(0.05, ways)
    free = ((ways[:, None] - half >= high) | (ways[:, None] + half <= low)).all(axis=1) & (
        np.abs(ways) < ASIDE
    )
    return float(ways[free][np.argmin(np.abs(ways[free]))]) if free.any() else np.nan


def turns_at(line: RouteLine, rows: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Turns (edge, edge) to avoid so that rows of a line are not passed; an edge twice if no turn is near."""
    near = math.ceil(_NEAR / line.gap)
    change = np.flatnonzero(line.edge[1:] != line.edge[:-1]) + 1
    found = set()
    for row in np.unique(rows).tolist():
        k = change[np.abs(change - row) <= near]
        at = int(k[np.argmin(np.abs(k - row))]) if len(k) else 0
        found.add((int(line.edge[at - 1]), int(line.edge[at])) if at else (int(line.edge[row]),) * 2)
    return sorted(found)


def turning_manoeuvre(pose: Pose, line: RouteLine, *, setting: PathParameters) -> list[SteeredTrack]:
    """A U-turn in 3, 5, 7 or 9 arcs, alternately forwards and backwards.

    Raises BlockedError if the body touches an obstacle with any number of arcs.
    """
    radius, step = 1.02 * setting.vehicle.turning_radius, setting.step
    scale = float(setting.frame.scale_at(pose[0], pose[1]))
    hand = 1.0 if setting.side == "right" else -1.0
    here = len(line.edge) - 1
    for arcs in (3, 5, 7, 9):
        tracks: list[SteeredTrack] = []
        x, y, th = pose
        for k in range(arcs):
            gear = 1 if k % 2 == 0 else -1
            n = max(math.ceil(math.pi / arcs * radius / step), 4) + 1
            heading = th + hand * np.linspace(0.0, math.pi / arcs, n)
            # the axle's centre runs on a circle about a point to its left (hand 1) when going forwards
            r = hand * gear * radius * scale
            cx, cy = x - r * math.sin(th), y + r * math.cos(th)
            xy = np.stack([cx + r * np.sin(heading), cy - r * np.cos(heading)], axis=1)
            span = math.pi / arcs * radius / (n - 1)
            tracks.append(SteeredTrack(xy, heading, np.full(n, hand / radius), np.full(n, here), gear, span))
            x, y, th = tracks[-1].end
        if not any(len(colliding_rows(t, line, setting=setting)) for t in tracks):
            return tracks
    edge = int(line.edge[-1])
    raise BlockedError(
        f"the {setting.vehicle.name} has no room to turn round near scene x {pose[0]:.1f}, y {pose[1]:.1f}"
        f" (edge {edge})",
        [(edge, edge)],
    )
