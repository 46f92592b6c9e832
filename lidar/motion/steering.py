"""Tracks of a vehicle along a line: smoothed to its turning radius and followed by a kinematic model.

And collision checks of its body along a track, shifts around obstacles, and turning manoeuvres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import BlockedError
from lidar.motion.vehicle import Vehicle

Pose = tuple[float, float, float]
"""Scene x and y of the rear axle, and heading in radians."""


@dataclass(frozen=True, slots=True)
class SteeredTrack:
    """Poses of a vehicle that follows a line, in plan.

    xy        : (n, 2) scene metres, the rear axle
    heading   : (n,) radians, of the vehicle
    curvature : (n,) 1/m, true, change of heading per metre driven
    row       : (n,) int64, the nearest row of the line
    gear      : 1 forwards, -1 backwards
    step      : true metres between rows
    """

    xy: Float
    heading: Float
    curvature: Float
    row: NDArray[np.int64]
    gear: int
    step: float

    @property
    def end(self) -> Pose:
        """The last pose."""
        return float(self.xy[-1, 0]), float(self.xy[-1, 1]), float(self.heading[-1])


def mean_gap(line: Float) -> float:
    """Mean distance in plan between the points (n, 2 or 3) of a line."""
    return float(np.mean(np.hypot(*np.diff(line[:, :2], axis=0).T)))


def relax(xy: Float, cap: float, *, reach: float) -> Float:
    """Points (n, 2) near the given ones whose curvature stays below ``cap`` (1/m) where that is possible.

    Minimises the sum of w |p - xy|^2 + reach^4 |p''|^2; w starts at 1 and falls where the line still bends
    too much.
    """
    from scipy.ndimage import maximum_filter1d  # noqa: PLC0415

    gap = mean_gap(xy)
    wide = 2 * math.ceil(1.0 / (cap * gap)) + 1
    weight = np.ones(len(xy))
    weight[[0, -1]] = 1e3
    out = xy
    for _ in range(25):
        out = _smooth(xy, weight, stiffness=(reach / gap) ** 4)
        loose = np.hypot(*(out - xy).T) > 1.5 / cap
        bad = (np.abs(polylines.curvatures(out)) > cap) & ~loose
        if not bad.any():
            break
        weight = np.where(maximum_filter1d(bad.astype(np.uint8), wide) > 0, weight * 0.6, weight)
    return out


def _smooth(xy: Float, weight: Float, *, stiffness: float) -> Float:
    """The points p (n, 2) that minimise the sum of w |p - xy|^2 + stiffness |p''|^2."""
    from scipy.sparse import diags_array  # noqa: PLC0415
    from scipy.sparse.linalg import spsolve  # noqa: PLC0415

    n = len(xy)
    second = diags_array(
        [np.ones(n - 2), np.full(n - 2, -2.0), np.ones(n - 2)], offsets=[0, 1, 2], shape=(n - 2, n)
    )
    matrix = stiffness * (second.T @ second) + diags_array([weight], offsets=[0])
    return np.asarray(spsolve(matrix.tocsc(), weight[:, None] * xy))


def follow(
    xy: Float, vehicle: Vehicle, *, scale: float, step: float, pose: Pose | None = None
) -> SteeredTrack:
    """The track of a vehicle that follows a line (m, 2) from its start, or from a pose, to its end.

    The controller adds feedback of lateral and heading error to the line's curvature. The curvature of the
    track stays within the turning radius and changes by at most ``vehicle.steering`` per metre.

    scale : scene metres per true metre
    step  : true metres between the track's rows

    If the vehicle cannot reach the end, the track ends at the last row of the line that it reached.
    """
    from scipy.ndimage import gaussian_filter1d  # noqa: PLC0415

    most, rate = 1.0 / vehicle.turning_radius, vehicle.steering
    gap = mean_gap(xy)
    # steering starts half the steering time ahead of the bend
    early = max(0.5 * most / rate / gap, 0.5)
    bend = gaussian_filter1d(polylines.curvatures(xy) * scale, early, mode="nearest")
    length = 1.2 * most / rate
    near, turn_in = 1.0 / length**2, 2.0 / length
    # numbers of Python: items of arrays are slow
    lx, ly, lh, lk = (column.tolist() for column in (*xy.T, polylines.headings(xy), bend))
    m = len(lx)
    x, y, th = pose if pose is not None else (lx[0], ly[0], lh[0])
    j = 0 if pose is None else int(np.argmin(np.hypot(*(xy - (x, y)).T)))
    k = 0.0 if pose is not None else max(-most, min(most, lk[0]))
    out: list[tuple[float, float, float, float, int]] = []
    stride = step * scale
    budget = int(3 * m * gap / stride) + 400
    for _ in range(budget):
        while (
            j + 1 < m and (x - lx[j + 1]) ** 2 + (y - ly[j + 1]) ** 2 <= (x - lx[j]) ** 2 + (y - ly[j]) ** 2
        ):
            j += 1
        out.append((x, y, th, k, j))
        c, s = math.cos(lh[j]), math.sin(lh[j])
        along, aside = (x - lx[j]) * c + (y - ly[j]) * s, ((y - ly[j]) * c - (x - lx[j]) * s) / scale
        if j == m - 1 and along >= -0.5 * stride:
            break
        # heading and lateral position of the line between its points
        bend_here = lk[j] + (lk[min(j + 1, m - 1)] - lk[j]) * max(-0.5, min(1.5, along / gap))
        aside -= 0.5 * bend_here * (along / scale) ** 2
        off = math.remainder(th - lh[j] - bend_here * along / scale, 2 * math.pi)
        error = 1.2 * length * math.tanh(aside / (1.2 * length))
        want = bend_here - near * error - turn_in * math.sin(max(-1.5, min(1.5, off)))
        want = max(-most, min(most, want))
        new = k + max(-rate * step, min(rate * step, want - k))
        mean = 0.5 * (k + new)
        half = 0.5 * mean * step
        chord = stride * (1.0 - half * half / 6.0)  # of an arc; the next term is below 1e-9 m
        x, y = x + chord * math.cos(th + half), y + chord * math.sin(th + half)
        th, k = th + mean * step, new
    rows = np.array(out)
    return SteeredTrack(rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4].astype(np.int64), 1, step)


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
