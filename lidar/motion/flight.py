"""Routes of flights: along waypoints, or in parallel strips over an area."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float
from lidar.errors import RouteError
from lidar.geometry.poses import Trajectory
from lidar.motion.path import Ground
from lidar.motion.route import Route, free_route

_ARC_STEP = np.radians(2.0)
_STEP = 10.0  # metres between points of a flight at which the ground is looked for
_ALONG = np.cos(np.radians(15.0))  # minimum cosine of the angle between the course and a strip
_LEAD_NS = 1_000_000_000  # nanoseconds before and after a strip for which scanners work


def waypoint_flight(points: ArrayLike, *, ground: Ground | None = None, limit: float = np.inf) -> Route:
    """The route over waypoints (n, 3) in scene metres; with a ground, their z is height above it.

    limit : m/s
    """
    xyz = np.array(points, float).reshape(-1, 3)
    if ground is not None:
        xyz[:, 2] += ground(xyz[:, 0], xyz[:, 1])
    return free_route(xyz, limit=limit)


def survey_flight(
    area: Any,
    *,
    spacing: float,
    height: float,
    radius: float,
    heading_deg: float = 90.0,
    run_out: float = 0.0,
    ground: Ground | None = None,
    follow: bool = False,
    limit: float = np.inf,
) -> Route:
    """The route over an area in parallel strips, flown in alternating directions.

    area        : shapely polygon in scene metres
    spacing     : metres between strips: every point of the area is within half of it of one
    height      : metres of z; above the ground if one is given
    radius      : metres of the turns from strip to strip; where two of them do not fit between strips the
                  turn first swings out (an omega)
    heading_deg : of the first strip, clockwise from grid north
    run_out     : metres flown straight before and after the area
    ground      : of scene x (n,), y (n,), in order of the flight
    follow      : keep the height above the ground below each point; by default the flight is level, above the
                  highest ground below it and along the area's outline
    limit       : m/s

    Raises RouteError for an area or spacing that is not positive.
    """
    if not (area.area > 0 and spacing > 0 and radius > 0):
        raise RouteError("a survey needs an area, a spacing of strips and a turning radius above zero")
    west, east, middle, back = _strips(area, spacing, heading_deg=heading_deg)
    count = len(middle)
    ends = (west - run_out, east + run_out)
    parts: list[Float] = []
    for k, y in enumerate(middle.tolist()):
        forth = k % 2 == 0
        if k == 0:
            parts.append(np.array([[ends[0][k], y]]))
        if k + 1 == count:
            parts.append(np.array([[ends[1 if forth else 0][k], y]]))
        else:  # a strip extends to the end of the longer of it and the next one
            x = max(ends[1][k : k + 2]) if forth else min(ends[0][k : k + 2])
            parts.append(_turn(float(x), y, spacing=spacing, radius=radius, way=1.0 if forth else -1.0))
    xy = np.concatenate(parts) @ back
    if ground is None:
        return free_route(np.column_stack([xy, np.full(len(xy), height)]), limit=limit)
    dense = dense_line(xy)
    if follow:
        below = ground(dense[:, 0], dense[:, 1])
        return free_route(np.column_stack([dense, below + height]), limit=limit)
    edge = dense_line(shapely.get_coordinates(area.exterior))
    below = ground(*np.concatenate([dense, edge]).T)
    return free_route(np.column_stack([xy, np.full(len(xy), float(below.max()) + height)]), limit=limit)


def dense_line(xy: Float) -> Float:
    """A line (n, 2) with points at most ten metres apart, at which a flight samples the ground."""
    dense: Float = shapely.get_coordinates(shapely.segmentize(shapely.linestrings(xy), _STEP))
    return dense


def _strips(area: Any, spacing: float, *, heading_deg: float) -> tuple[Float, Float, Float, Float]:
    """Both ends (k,) and place across (k,) of strips in the survey's axes; the turn (2, 2) back."""
    turn = math.radians(90.0 - heading_deg)
    c, s = math.cos(turn), math.sin(turn)
    back = np.array([[c, s], [-s, c]])
    # in the survey's own axes strips run along x
    flat = shapely.transform(area, lambda p: p @ back.T)
    low_x, low_y, high_x, high_y = flat.bounds
    count = max(math.ceil((high_y - low_y) / spacing), 1)
    middle = (low_y + high_y) / 2 + (np.arange(count) - (count - 1) / 2) * spacing
    bands = shapely.box(low_x - 1, middle - spacing / 2, high_x + 1, middle + spacing / 2)
    west, _, east, _ = shapely.bounds(shapely.intersection(flat, bands)).T
    return west, east, middle, back


def survey_lines(area: Any, *, spacing: float, heading_deg: float = 90.0) -> Float:
    """Entry and exit points (k, 2, 2) of the strips of `survey_flight`, scene metres, in flight direction."""
    west, east, middle, back = _strips(area, spacing, heading_deg=heading_deg)
    ends = np.stack([np.column_stack([west, middle]), np.column_stack([east, middle])], axis=1)
    ends[1::2] = ends[1::2, ::-1]
    return ends @ back


def times_on_lines(trajectory: Trajectory, lines: Float, *, max_offset: float) -> NDArray[np.int64]:
    """Intervals (k, 2) in nanoseconds in which an aircraft is on a line, plus a second at both ends.

    lines  : (n, 2, 2) scene metres, from and to
    max_offset : maximum distance to the line across it, scene metres
    """
    xy, course = trajectory.position[:, :2], trajectory.velocity[:, :2]
    course = course / np.maximum(np.hypot(*course.T), 1e-9)[:, None]
    on = np.zeros(len(xy), bool)
    for begin, end in lines:
        length = float(np.hypot(*(end - begin)))
        ahead = (end - begin) / max(length, 1e-9)
        along, aside = (xy - begin) @ ahead, (xy - begin) @ [-ahead[1], ahead[0]]
        on |= (along >= 0) & (along <= length) & (np.abs(aside) <= max_offset) & (course @ ahead >= _ALONG)
    change = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int)))
    first, last = change[::2], change[1::2] - 1
    time = trajectory.time_ns
    return np.column_stack([time[first] - _LEAD_NS, time[last] + _LEAD_NS])


def _turn(x: float, y: float, *, spacing: float, radius: float, way: float) -> Float:
    """Points (n, 2) from the end of a strip flown along ``way`` (1 or -1) of x to the next strip above it."""
    if spacing >= 2 * radius:
        up = _arc(radius, -np.pi / 2, last=0.0, centre=[0.0, radius])
        on = _arc(radius, 0.0, last=np.pi / 2, centre=[0.0, spacing - radius])
        local = np.concatenate([up, on])
    else:
        # arcs of one radius: out by alpha, back by pi + 2 alpha, out by alpha; their centres lie 2 r apart
        alpha = math.acos((radius + spacing / 2) / (2 * radius))
        far = 2 * radius * math.sin(alpha)
        out = _arc(radius, np.pi / 2, last=np.pi / 2 - alpha, centre=[0.0, -radius])
        main = _arc(radius, -np.pi / 2 - alpha, last=np.pi / 2 + alpha, centre=[far, spacing / 2])
        home = _arc(radius, -np.pi / 2 + alpha, last=-np.pi / 2, centre=[0.0, spacing + radius])
        local = np.concatenate([out, main, home])
    return np.column_stack([x + way * local[:, 0], y + local[:, 1]])


def _arc(radius: float, first: float, *, last: float, centre: Sequence[float]) -> Float:
    angle = np.linspace(first, last, max(math.ceil(abs(last - first) / _ARC_STEP), 2) + 1)
    return np.asarray(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
