"""Steering: smoothing a line to a vehicle's turning radius, and following it with a kinematic model."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import row_blocks
from geoscene.typing import Float
from lidar.geometry.poses import release, room
from lidar.motion.blockwise import curvatures, gather, headings, mean_gap, rowwise, smooth
from lidar.motion.vehicle import Vehicle

Pose = tuple[float, float, float]
"""Scene x and y of the rear axle, and heading in radians."""

_SOLVED, _OVERLAP = 1 << 17, 1 << 13  # rows of a line that are smoothed at once, and of the next ones beside
_FOLLOWED = 1 << 14  # rows of a track up to which it is in memory


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


def relax(xy: Float, cap: float, *, reach: float) -> Float:
    """Points (n, 2) near the given ones whose curvature stays below ``cap`` (1/m) where that is possible.

    Minimises the sum of w |p - xy|^2 + reach^4 |p''|^2; w starts at 1 and falls where the line still bends
    too much.
    """
    from scipy.ndimage import maximum_filter1d  # noqa: PLC0415

    gap = mean_gap(xy)
    wide = 2 * math.ceil(1.0 / (cap * gap)) + 1
    weight = rowwise(lambda part: np.ones(len(part)), xy)
    weight[[0, -1]] = 1e3
    out = xy

    def lowered(old: Float, bad: NDArray[np.uint8]) -> Float:
        return np.where(maximum_filter1d(bad, wide) > 0, old * 0.6, old)

    for _ in range(25):
        out = _smooth(xy, weight, stiffness=(reach / gap) ** 4)
        loose = rowwise(lambda moved, line: np.hypot(*(moved - line).T) > 1.5 / cap, out, xy)
        bad = rowwise(
            lambda bend, loose: ((np.abs(bend) > cap) & ~loose).astype(np.uint8), curvatures(out), loose
        )
        if not bad.any():
            break
        weight = rowwise(lowered, weight, bad, reach=wide)
    return out


def _smooth(xy: Float, weight: Float, *, stiffness: float) -> Float:
    """The points p (n, 2) that minimise the sum of w |p - xy|^2 + stiffness |p''|^2.

    Long lines are solved in windows. Half of their overlap is left out on each side: the influence of a row
    falls below 1e-12 in some hundred rows, and below 1e-9 even with the smallest weights of `relax`.
    """
    from scipy.sparse import diags_array  # noqa: PLC0415
    from scipy.sparse.linalg import spsolve  # noqa: PLC0415

    out = room(xy.shape)
    kept = 0
    for rows in row_blocks(len(xy), _SOLVED, overlap=_OVERLAP):
        part = xy[rows]
        n = len(part)
        second = diags_array(
            [np.ones(n - 2), np.full(n - 2, -2.0), np.ones(n - 2)], offsets=[0, 1, 2], shape=(n - 2, n)
        )
        matrix = stiffness * (second.T @ second) + diags_array([weight[rows]], offsets=[0])
        solved = np.asarray(spsolve(matrix.tocsc(), weight[rows, None] * part))
        ends = rows.stop == len(xy)
        until = rows.stop if ends else rows.stop - _OVERLAP // 2
        out[kept:until] = solved[kept - rows.start : until - rows.start]
        release(out, xy, weight)
        if ends:
            break
        kept = until
    return out


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
    rows = gather(_follow_blocks(xy, vehicle, scale=scale, step=step, pose=pose))
    row = rowwise(lambda part: part[:, 4].astype(np.int64), rows)
    return SteeredTrack(rows[:, :2], rows[:, 2], rows[:, 3], row, 1, step)


def _follow_blocks(
    xy: Float, vehicle: Vehicle, *, scale: float, step: float, pose: Pose | None
) -> Iterator[Float]:
    """Blocks of rows (k, 5) of the track of `follow`: x, y, heading, curvature, row of the line."""
    most, rate = 1.0 / vehicle.turning_radius, vehicle.steering
    gap = mean_gap(xy)
    # steering starts half the steering time ahead of the bend
    early = max(0.5 * most / rate / gap, 0.5)
    bend = smooth(rowwise(lambda part: part * scale, curvatures(xy)), early, mode="nearest")
    length = 1.2 * most / rate
    near, turn_in = 1.0 / length**2, 2.0 / length
    columns: list[Any] = [rowwise(lambda part, k=k: part[:, k].copy(), xy) for k in (0, 1)]
    columns += [headings(xy), bend]
    lx, ly, lh, lk = (memoryview(column) for column in columns)  # their items are numbers of Python
    m = len(lx)
    x, y, th = pose if pose is not None else (lx[0], ly[0], lh[0])
    j = 0 if pose is None else int(np.argmin(rowwise(lambda part: np.hypot(*(part - (x, y)).T), xy)))
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
        if len(out) == _FOLLOWED:
            yield np.array(out)
            out.clear()
            release(*columns)
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
    if out:
        yield np.array(out)
