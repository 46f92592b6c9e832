"""The path a vehicle drives along a route: drivable by construction, clear of obstacles, on the ground.

The route's line has kinks and a vehicle has a steering wheel. The line is relaxed (a smoothing spline that
gives way where it bends too tightly), then a kinematic vehicle follows it: a point on the rear axle whose
curvature never exceeds what the vehicle can steer and changes no faster than the wheel turns. What comes out
has continuous position, heading and curvature and no side slip, whatever went in. Where the body would touch
an obstacle the line is pushed aside and followed again; where that does not help, a RouteError says so.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.geometry.frames import Frame
from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import BlockedError, RouteError
from lidar.motion.route import Route
from lidar.motion.steering import (
    ASIDE,
    PathParameters,
    Pose,
    RouteLine,
    SteeredTrack,
    follow,
    pushes,
    relax,
    turning_manoeuvre,
    turns_at,
)
from lidar.motion.vehicle import Vehicle

Ground = Callable[[Float, Float], Float]
"""z (n,) of the ground at scene x (n,), y (n,)."""

Surface = Callable[[Float, Float, Float], Float]
"""z (n,) of the surface that wheels stand on at scene x, y (n,), near heights z (n,)."""

MARGIN = 0.25
"""Minimum distance in metres between body and obstacles."""
_REPAIRS = 16
_SPRING = 0.5  # metres over which tyres and springs smooth the ground
_AXLES = 0.5  # metres, wheelbase below which a body does not pitch with the ground
_STEEP = 0.35  # maximum gradient of the ground under a wheel
_JOINT = 0.25  # metres of height between rows of a path from which a step becomes a ramp
_WHEEL_STEP = 0.2  # metres: a kerb
_PUSH = 4.0  # metres before and behind an obstacle over which the line is shifted
_ASTRAY = 1.5  # turning radii, maximum distance of a vehicle from its lane centre
_FINISH = 3.0  # turning radii, maximum distance between the ends of a path and of its line off the roads
_REGION = 2000.0  # metres, side of the square whose ground is loaded at once
_RUN_STEP, _RUN = 256, 512  # rows of a track that stay together, and how many of these share loaded ground
_WHEEL = 0.95  # share of the maximum curvature of a line, a margin for feedback


@dataclass(frozen=True, slots=True)
class Path(Columns):
    """The path of the rear axle, with a row every few decimetres.

    s         : (n,) true metres driven from the start, along the slope
    position  : (n, 3) scene metres, the rear axle's centre on the ground
    heading   : (n,) radians, where the vehicle points, counter-clockwise from the scene's x axis, unwrapped
    curvature : (n,) 1/m, change of heading per true metre driven over ground; positive is a turn to the left
    slope     : (n,) radians, of the path where the vehicle points, positive uphill
    pitch     : (n,) radians, of the vehicle on its wheels, positive uphill: from the ground under both axles
    bank      : (n,) radians, of the vehicle about its own x axis, positive where the left wheels stand higher
    scale     : (n,) scene metres per true metre
    gear      : (n,) int8, 1 forwards, -1 backwards
    leg       : (n,) int32, stretch between stops; at a stop the position stands twice
    limit     : (n,) m/s, speed limit
    edge      : (n,) int32, edge of the road graph, -1 for none
    offset    : (n,) true metres from the route's line, positive to its left
    """

    s: Float
    position: Float
    heading: Float
    curvature: Float
    slope: Float
    pitch: Float
    bank: Float
    scale: Float
    gear: NDArray[np.int8]
    leg: NDArray[np.int32]
    limit: Float
    edge: NDArray[np.int32]
    offset: Float

    @property
    def length(self) -> float:
        """True metres driven."""
        return float(self.s[-1])


def plan_path(
    route: Route,
    vehicle: Vehicle,
    *,
    frame: Frame,
    obstacles: Sequence[Any] | NDArray[np.object_] | shapely.STRtree | None = None,
    ground: Surface | None = None,
) -> Path:
    """The path of a vehicle along a route.

    obstacles : polygons in scene metres that the body must not touch (footprints of buildings that stand on
                the ground), but come near to `MARGIN`; they do not hold on bridges and in tunnels
    ground    : the surface near the heights of the route's line; without it, those heights are the ground

    Raises BlockedError where the vehicle cannot follow the route, or cannot without touching an obstacle: its
    ``turns`` are those that rerouting must avoid. Raises RouteError for a route too short to drive.
    """
    if not isinstance(obstacles, shapely.STRtree):
        obstacles = shapely.STRtree([] if obstacles is None else list(obstacles))
    # aircraft have no lane, and larger turning radii
    step = vehicle.turning_radius / 17 if vehicle.kind == "air" else min(0.25, vehicle.turning_radius / 8)
    setting = PathParameters(vehicle, frame, obstacles, MARGIN, step, route.side)
    line = _resample(route, 2 * step if vehicle.kind == "air" else min(0.5, 2 * step))
    cuts = [0, *(np.flatnonzero(line.turn) + 1).tolist(), len(line.edge)]
    legs: list[SteeredTrack] = []
    lines: list[RouteLine] = []
    pose: Pose | None = None
    for first, last in itertools.pairwise(cuts):
        part = line.take(slice(first, last))
        turns_back = last < len(line.edge)
        if turns_back:
            part = _shorten(part, vehicle)
        track = _clear_track(part, setting, pose=pose)
        tracks = [track] if len(track.row) > 1 else []  # a U-turn may end where its leg ends
        if turns_back:
            tracks += turning_manoeuvre(track.end, part, setting=setting)
        pose = tracks[-1].end if tracks else pose
        legs += tracks
        lines += [part] * len(tracks)
    return _join(legs, lines, setting=setting, ground=ground)


def _resample(route: Route, spacing: float) -> RouteLine:
    """The route's line with points about ``spacing`` apart; its turning points stay points."""
    stretches: list[RouteLine] = []
    ends = [0, *(np.asarray(route.turns, int) + 1).tolist(), len(route.line)]
    for first, last in itertools.pairwise(ends):
        xyz = route.line[first:last]
        s = polylines.stations(xyz)
        keep = np.append(np.diff(s) > 1e-9, True)  # of coincident points the last one counts
        xyz, s = xyz[keep], s[keep]
        if len(s) < 2 or s[-1] < 2 * spacing:
            raise RouteError(f"the route has a stretch of {s[-1]:.2f} m; too short to drive")
        count = max(math.ceil(s[-1] / spacing), 4) + 1
        at = np.arange(count) * (s[-1] / (count - 1))
        at[-1] = s[-1]
        turn = np.zeros(count, bool)
        turn[-1] = last < len(route.line)
        point = np.arange(first, last)[keep]
        index = point[np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(s) - 1)]
        new = polylines.points_at(xyz, at, along=s)
        stretches.append(RouteLine(new, route.edge[index], route.limit[index], route.free[index], turn))
    return RouteLine.concatenate(stretches)


def _shorten(line: RouteLine, vehicle: Vehicle) -> RouteLine:
    """The line without its last metres, so that the front of the body stops at its end."""
    spare = min(round(vehicle.front / line.gap), len(line.edge) - 5)
    return line.take(slice(0, len(line.edge) - max(spare, 0)))


def _clear_track(line: RouteLine, setting: PathParameters, *, pose: Pose | None) -> SteeredTrack:
    """A leg along the line on which the body touches no obstacle, from a pose if one is given.

    Raises BlockedError if the line cannot be pushed clear, or bends too tightly.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d  # noqa: PLC0415

    vehicle = setting.vehicle
    cap = _WHEEL / vehicle.turning_radius
    reach = 0.47 * vehicle.turning_radius
    middle = line.xyz[len(line.xyz) // 2]
    scale = float(setting.frame.scale_at(middle[0], middle[1]))
    base, gap = line.xyz[:, :2], line.gap
    heading = gaussian_filter1d(polylines.headings(base), 2.0 / gap, mode="nearest")
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=1)
    shift = np.zeros(len(base))
    wide = 2 * math.ceil(_PUSH / gap) + 1
    for _ in range(_REPAIRS):
        pushed = base + shift[:, None] * left
        xy = relax(pushed, cap / scale, reach=reach)
        track = follow(xy, vehicle, scale=scale, pose=pose, step=setting.step)
        departure = _departure(track, line, xy=pushed, vehicle=vehicle)
        if len(departure):
            x, y = base[departure[0]]
            raise BlockedError(
                f"the {vehicle.name} cannot follow the route near scene x {x:.1f}, y {y:.1f} (edge"
                f" {line.edge[departure[0]]}): it bends too tightly for a turning radius of"
                f" {vehicle.turning_radius} m",
                turns_at(line, departure),
            )
        push, at = pushes(track, line, setting=setting)
        if not len(at):
            return track
        if np.isnan(push).any():
            break
        for sign in (1.0, -1.0):
            bump = np.zeros(len(base))
            np.maximum.at(bump, at, np.maximum(sign * push, 0.0))
            bump = gaussian_filter1d(maximum_filter1d(bump, wide), 0.5 * _PUSH / gap, mode="nearest")
            shift = shift + sign * bump
        shift = np.clip(shift, -ASIDE, ASIDE)
    stuck = np.isnan(push)
    at = at[stuck] if stuck.any() else at
    worst = at[0]
    x, y, _ = line.xyz[worst]
    raise BlockedError(
        f"the {vehicle.name} ({vehicle.length} x {vehicle.width} m) does not pass between the buildings near"
        f" scene x {x:.1f}, y {y:.1f} (edge {line.edge[worst]}); choose another route or a smaller vehicle",
        turns_at(line, at),
    )


def _departure(track: SteeredTrack, line: RouteLine, *, xy: Float, vehicle: Vehicle) -> NDArray[np.int64]:
    """The row of the line, pushed to ``xy`` (n, 2), where the track leaves it; none if it does not."""
    if track.row[-1] < len(line.edge) - 1:
        return track.row[-1:]
    off = np.hypot(*(track.xy - xy[track.row]).T) / vehicle.turning_radius
    astray = (line.edge[track.row] >= 0) & (off > _ASTRAY)
    if astray.any():
        worst = int(np.argmax(off))
        return track.row[worst : worst + 1]
    return track.row[-1:] if off[-1] > _FINISH else track.row[:0]


def _join(
    legs: list[SteeredTrack], lines: list[RouteLine], *, setting: PathParameters, ground: Surface | None
) -> Path:
    """One path of all legs, with heights."""
    whole = Path.concatenate([*_leg_paths(legs, lines, setting=setting, ground=ground)])
    # headings of consecutive legs may differ by whole turns
    change = np.diff(whole.heading, prepend=whole.heading[0])
    turns = np.cumsum(np.round(change / (2 * np.pi)) * 2 * np.pi)
    return replace(whole, heading=whole.heading - turns)


def _leg_paths(
    legs: list[SteeredTrack], lines: list[RouteLine], *, setting: PathParameters, ground: Surface | None
) -> Iterator[Path]:
    """The paths of legs, one after another."""
    start = 0.0
    heights = _heights(legs, lines, setting=setting, ground=ground)
    for number, (leg, line, (z, slope, pitch, bank)) in enumerate(zip(legs, lines, heights, strict=True)):
        steps = np.hypot(leg.step, np.diff(z, prepend=z[0]))
        steps[0] = 0.0
        s = start + np.cumsum(steps)
        start = float(s[-1])
        scale = setting.frame.scale_at(*leg.xy.T).astype(float)
        yield Path(
            s=s,
            position=np.column_stack([leg.xy, z]),
            heading=leg.heading,
            curvature=leg.curvature,
            slope=slope,
            pitch=pitch,
            bank=bank,
            scale=scale,
            gear=np.full(len(s), leg.gear, np.int8),
            leg=np.full(len(s), number, np.int32),
            limit=line.limit[leg.row],
            edge=line.edge[leg.row],
            offset=_from_line(leg, line)[:, 1] / scale,
        )


def _from_line(leg: SteeredTrack, line: RouteLine) -> Float:
    """Scene metres (n, 2) by which a track's rows are ahead of their rows of the line, and to its left."""
    heading = polylines.headings(line.xyz)[leg.row]
    d = leg.xy - line.xyz[leg.row, :2]
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack([d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s])


def _heights(
    legs: list[SteeredTrack], lines: list[RouteLine], *, setting: PathParameters, ground: Surface | None
) -> Iterator[tuple[Float, Float, Float, Float]]:
    """Height of the rear axle, slope of its path, pitch and bank of the body on its wheels, of each leg.

    Wheels keep to the ground; without one, the route's profile is smoothed over the wheelbase.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d, median_filter  # noqa: PLC0415

    raw = [_raw_heights(*pair, setting=setting, ground=ground) for pair in zip(legs, lines, strict=True)]
    # positions are doubled between legs: smooth without the duplicates
    z, tilt, bank = (
        np.concatenate([column[min(k, 1) :] for k, column in enumerate(columns)])
        for columns in zip(*raw, strict=True)
    )
    body = setting.vehicle
    over = body.turning_radius if body.kind == "air" else max(body.wheelbase, 1.0)
    width = (over if ground is None else _SPRING) / legs[0].step
    # extrapolate the road at both ends with its gradient
    spare, wide = math.ceil(4 * over / legs[0].step) + 1, over / legs[0].step
    far = np.pad(z, spare, mode="reflect", reflect_type="odd")
    near, soft = (gaussian_filter1d(far, w)[spare : spare + len(z)] for w in (width, wide))
    if ground is not None:  # a step, as at the joint of a bridge, becomes a ramp
        reach = 2 * math.ceil(wide) + 1
        rise = np.gradient(z)
        steps = np.abs(rise - median_filter(rise, reach, mode="nearest")) > _JOINT / 2
        share = gaussian_filter1d(maximum_filter1d(steps.astype(float), reach), wide / 2)
        near = near + share * (soft - near)
        tilt = tilt + share * (gaussian_filter1d(tilt, wide, mode="mirror") - tilt)
    tilt, bank = (gaussian_filter1d(column, width, mode="mirror") for column in (tilt, bank))
    stands = ground is not None and body.wheelbase >= _AXLES
    start = 0
    for leg in legs:
        height, ahead, across = (c[start : start + len(leg.row)] for c in (near, tilt, bank))
        slope = np.arctan(leg.gear * np.gradient(height, leg.step))
        pitch = np.arctan(ahead) if stands else slope
        yield height, slope, pitch, np.arctan(across * np.cos(pitch))
        start += len(leg.row) - 1


def _raw_heights(
    leg: SteeredTrack, line: RouteLine, *, setting: PathParameters, ground: Surface | None
) -> tuple[Float, Float, Float]:
    """Height, rise per metre ahead to the front axle and to the left, at the rows of a leg (n,).

    As the ground has them, or, without one, the line.
    """
    # the last row may lie a little beyond the end of the line
    profile = np.append(line.xyz[:, 2], 2 * line.xyz[-1, 2] - line.xyz[-2, 2])
    place = leg.row + _from_line(leg, line)[:, 0] / line.gap
    z = np.interp(place, np.arange(len(profile)), profile)
    rise = leg.gear * np.gradient(z, leg.step)
    if ground is None:
        return z, rise, np.zeros(len(z))
    runs = [
        _on_wheels(
            leg.xy[rows], leg.heading[rows], z=z[rows], rise=rise[rows], setting=setting, ground=ground
        )
        for rows in _runs(leg.xy)
    ]
    rear, ahead, across = (np.concatenate(column) for column in zip(*runs, strict=True))
    return rear, ahead, across


def _runs(xy: Float) -> Iterator[slice]:
    """Runs of rows of a track (n, 2) within a square of `_REGION`: the ground is loaded run by run."""
    starts = np.arange(0, len(xy), _RUN_STEP)
    low, high = (reduce.reduceat(xy, starts, axis=0) for reduce in (np.minimum, np.maximum))
    first = 0
    for k in range(1, len(starts)):
        size = high[first : k + 1].max(axis=0) - low[first : k + 1].min(axis=0)
        if size.max() > _REGION or k - first == _RUN:
            yield slice(int(starts[first]), int(starts[k]))
            first = k
    yield slice(int(starts[first]), len(xy))


def _on_wheels(
    xy: Float, heading: Float, *, z: Float, rise: Float, setting: PathParameters, ground: Surface
) -> tuple[Float, Float, Float]:
    """Height of the rear axle, and rise to the front axle and to the left, of a body on the ground.

    xy, heading : (n, 2) and (n,) of the rear axle
    z, rise     : (n,) heights near the ground, and their change per metre ahead
    """
    base = max(setting.vehicle.wheelbase, _AXLES)
    rear, across = _axle(xy, heading, z=z, ahead=0.0, setting=setting, ground=ground)
    ahead = np.clip(rise, -_STEEP, _STEEP)
    for _ in range(2):  # on a slope the front axle is less than the wheelbase ahead, in plan
        reach = base / np.hypot(1.0, ahead)
        near = rear + reach * ahead
        front, twisted = _axle(xy, heading, z=near, ahead=reach, setting=setting, ground=ground)
        ahead = (front - rear) / reach
    # a rigid body on four wheels: springs take the twist of the ground
    return rear, ahead, (across + twisted) / 2


def _axle(
    xy: Float, heading: Float, *, z: Float, ahead: Float | float, setting: PathParameters, ground: Surface
) -> tuple[Float, Float]:
    """Mean height of the ground under the wheels of an axle, and its rise to the left, near heights (n,).

    ahead : metres in plan from the rear axle
    """
    c, s = np.cos(heading), np.sin(heading)
    x, y = xy.T
    scale = setting.frame.scale_at(x, y)
    track = max(setting.vehicle.track, 0.1)
    x, y, half = x + ahead * scale * c, y + ahead * scale * s, track / 2 * scale
    middle = ground(x, y, z)
    under = []
    for side in (1.0, -1.0):
        wheel = ground(x - side * half * s, y + side * half * c, middle)
        # larger height differences are walls or edges on which no wheel stands
        under.append(np.where(np.abs(wheel - middle) <= _WHEEL_STEP + _STEEP * track / 2, wheel, middle))
    left, right = under
    return 0.5 * (left + right), (left - right) / track
