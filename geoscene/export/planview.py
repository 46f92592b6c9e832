"""Reference lines of roads: tangential lines and arcs along a polyline."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from geoscene.typing import Float

REACH = 0.1
"""Metres that a reference line may cut a corner of its polyline by."""

_SMALLEST_RADIUS = 0.3
_STRAIGHT = 1e-7  # radians: vertices that turn by less are no corners


@dataclass(frozen=True, slots=True)
class PlanView:
    """Pieces of a reference line; each begins at the end of the previous one.

    s         : (k,) metres along the line to the piece's start
    x, y      : (k,) its start
    heading   : (k,) there, radians counter-clockwise from x
    length    : (k,) metres
    curvature : (k,) 1/metre, 0 for a straight line, positive to the left
    at        : (n,) metres along the line to the point nearest to each vertex of the polyline
    """

    s: Float
    x: Float
    y: Float
    heading: Float
    length: Float
    curvature: Float
    at: Float

    @property
    def total(self) -> float:
        """Length of the whole line, metres."""
        return float(self.s[-1] + self.length[-1])


def plan_view(points: Float, *, reach: float = REACH) -> PlanView:
    """Lines and arcs along a polyline (n, 2) without repeated points: its corners are rounded.

    An arc touches both sides of its corner and passes it by at most ``reach`` metres; it takes at most half
    of either side. With turn angle a and tangent t, its radius is t / tan(a / 2) and it passes the corner at
    t tan(a / 4). Corners too sharp for a radius of 0.3 m stay corners.
    """
    step = np.diff(points, axis=0)
    side = np.hypot(*step.T)
    heading = np.arctan2(step[:, 1], step[:, 0])
    turn = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    bend = np.maximum(np.abs(turn), 1e-12)
    if (bend < _STRAIGHT).any():
        corner = np.concatenate([[True], bend >= _STRAIGHT, [True]])
        along = np.append(0.0, np.cumsum(side))
        plan = plan_view(points[corner], reach=reach)
        return replace(plan, at=np.interp(along, along[corner], plan.at))
    tangent = np.minimum(np.minimum(side[:-1], side[1:]) / 2, reach / np.tan(bend / 4))
    radius = tangent / np.tan(bend / 2)
    tangent = np.where(radius < _SMALLEST_RADIUS, 0.0, tangent)
    arc = np.where(tangent > 0, radius * bend, 0.0)

    before, after = np.append(0.0, tangent), np.append(tangent, 0.0)
    straight = np.maximum(side - before - after, 0.0)
    unit = step / side[:, None]
    line_start = points[:-1] + unit * before[:, None]
    arc_start = points[1:-1] - unit[:-1] * tangent[:, None]

    pieces = 2 * len(side) - 1
    columns = np.zeros((5, pieces))
    columns[:, 0::2] = line_start[:, 0], line_start[:, 1], heading, straight, np.zeros(len(side))
    curve = np.divide(np.sign(turn), radius, out=np.zeros_like(turn), where=tangent > 0)
    columns[:, 1::2] = arc_start[:, 0], arc_start[:, 1], heading[:-1], arc, curve
    s = np.cumsum(columns[3]) - columns[3]
    ends = np.concatenate([[0.0], s[1::2] + arc / 2, [s[-1] + columns[3, -1]]])
    keep = columns[3] > 1e-6
    x, y, angle, length, curvature = columns[:, keep]
    # Pieces left out are shorter than a micrometre: lengths are summed again so that s has no gap.
    return PlanView(np.cumsum(length) - length, x, y, angle, length, curvature, ends)


@dataclass(frozen=True, slots=True)
class Curve:
    """A cubic from one pose to another (OpenDRIVE paramPoly3, pRange normalized).

    x, y, heading : of its start
    u, v   : (4,) coefficients of forward and left offset, of 1, p, p2, p3 for p from 0 to 1
    length : metres
    """

    x: float
    y: float
    heading: float
    u: Float
    v: Float
    length: float


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(96)  # cubics that nearly turn on the spot need that many


def connecting_curve(start: Float, heading: float, *, end: Float, end_heading: float) -> Curve:
    """The cubic from a point (2,) with a heading to another, close to an arc where an arc fits.

    For a turn by a with chord c the handles of an arc's cubic are c tan(a / 4) / (1.5 sin(a / 2)) long.
    """
    c, s = np.cos(heading), np.sin(heading)
    to_local = np.array([[c, s], [-s, c]])
    goal = to_local @ (end - start)
    turn = (end_heading - heading + np.pi) % (2 * np.pi) - np.pi
    bend = min(max(abs(turn), 1e-4), 0.95 * np.pi)
    handle = float(np.hypot(*goal) * np.tan(bend / 4) / (1.5 * np.sin(bend / 2)))
    leave, arrive = 3 * handle * np.array([1.0, 0.0]), 3 * handle * np.array([np.cos(turn), np.sin(turn)])
    a, b = leave, 3 * goal - 2 * leave - arrive
    d = leave + arrive - 2 * goal
    p = (_NODES + 1) / 2
    speed = a[:, None] + 2 * b[:, None] * p + 3 * d[:, None] * p**2
    length = float((np.hypot(*speed) * _WEIGHTS).sum() / 2)
    u, v = (np.array([0.0, a[k], b[k], d[k]]) for k in (0, 1))
    return Curve(float(start[0]), float(start[1]), heading, u, v, length)
