"""Steering: smoothing a line to a vehicle's turning radius, and following it with a kinematic model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry import polylines
from geoscene.typing import Float
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
