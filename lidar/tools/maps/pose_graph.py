"""A trajectory that fits measured motion and fixes best."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from geoscene.typing import Float, Ints
from lidar.tools.maps.measured_poses import MeasuredPositions, RelativeMotion

_KNOT_NS = 1_000_000_000  # between the poses that are adjusted
_TILT = (0.3, 0.1)  # rad, of pitch and roll against level: roads keep their slope for longer than a second
_COURSE = 0.05  # rad, of a heading by the course
_MOVING = 2.0  # m/s, from which headings by the course are used
_CORRELATED_NS = 10_000_000_000  # fixes share most of their error for longer: one counts in such a time
_SCALES = (1000.0, 100.0, 10.0, 1.0)
"""Standard deviations beyond which fixes lose weight, one after the other: where the poses begin far from the
fixes, as on a slope, all of these would seem to be far off."""

_ITERATIONS = 100
_DIFFERENCE = 1e-6  # radians and metres, over which derivatives are taken
_SMALL = 1e-7  # radians and metres: the last step


def fit_poses(motion: RelativeMotion, fixes: MeasuredPositions) -> Float:
    """Poses (n + 1, 4, 4) at the times of a motion, true metres, that fit it and some fixes best.

    The pose graph has a pose for each second (6 unknowns), edges of the motion between successive ones, the
    positions and courses of the fixes, and pitch and roll not far from level. Fixes far off have little
    weight (Cauchy's loss, at ever smaller scales: graduated non-convexity).
    """
    time_ns, relative = motion.time_ns, motion.poses()
    wanted = np.arange(time_ns[0], time_ns[-1], _KNOT_NS)
    knots = np.unique(np.append(np.searchsorted(time_ns, wanted), len(time_ns) - 1))
    variance = np.add.reduceat(motion.sigma**2, knots[:-1])
    graph = PoseGraph(relative[knots], time_ns[knots], sigma=np.sqrt(variance), fixes=fixes)
    return _between(relative, knots, adjusted=graph.solved())


def _between(relative: Float, knots: Ints, *, adjusted: Float) -> Float:
    """Poses at all times: relative ones moved by the correction of their knots, interpolated in between."""
    correction = adjusted @ np.linalg.inv(relative[knots])
    rows = np.arange(len(relative))
    left = np.clip(np.searchsorted(knots, rows, side="right") - 1, 0, len(knots) - 2)
    share = (rows - knots[left]) / (knots[left + 1] - knots[left])
    first, second = correction[left] @ relative, correction[left + 1] @ relative
    turn = Rotation.from_matrix(np.swapaxes(first[:, :3, :3], 1, 2) @ second[:, :3, :3]).as_rotvec()
    poses = first.copy()
    poses[:, :3, :3] = first[:, :3, :3] @ Rotation.from_rotvec(share[:, None] * turn).as_matrix()
    poses[:, :3, 3] += share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return poses


class PoseGraph:
    """Residuals of poses of knots, as rotation vectors and positions (n, 6).

    relative : (n, 4, 4) poses by the motion
    time_ns  : (n,) their times
    sigma    : (n - 1, 6) one standard deviation of rotation and translation from each to the next
    """

    def __init__(self, relative: Float, time_ns: Ints, *, sigma: Float, fixes: MeasuredPositions) -> None:
        self._relative, self._edge_sigma = relative, sigma
        step = np.linalg.inv(relative[:-1]) @ relative[1:]
        self._turn, self._shift = step[:, :3, :3], step[:, :3, 3]
        inside = (fixes.time_ns >= time_ns[0]) & (fixes.time_ns < time_ns[-1])
        at = fixes.time_ns[inside]
        self._knot = np.searchsorted(time_ns, at, side="right") - 1
        span = time_ns[self._knot + 1] - time_ns[self._knot]
        self._share = (at - time_ns[self._knot]) / span
        self._position, self._lever = fixes.position[inside], fixes.lever
        self._shared = max(_CORRELATED_NS / float(np.median(np.diff(fixes.time_ns))), 1.0)
        self._sigma = fixes.sigma[inside]
        self._robust = 4 * len(at)  # residuals of positions and courses, which are the last ones
        self._yaw = fixes.yaw[inside]
        self._moving = fixes.speed[inside] > _MOVING

    def solved(self) -> Float:
        """Poses (n, 4, 4) in true metres that fit best, by Levenberg's and Marquardt's method."""
        values = self._start()
        for scale in _SCALES:
            values = self._minimum(values, scale)
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3, :3] = Rotation.from_rotvec(values[:, :3]).as_matrix()
        poses[:, :3, 3] = values[:, 3:]
        return poses

    def _minimum(self, values: Float, scale: float) -> Float:
        """The unknowns at the minimum of the cost next to some, by Levenberg's and Marquardt's method."""
        damping, residuals = 1e-6, self._residuals(values)
        for _ in range(_ITERATIONS):
            jacobian, weight = self._jacobian(values), self._weight(residuals, scale)
            normal = (jacobian.T @ jacobian.multiply(weight[:, None])).tocsc()
            gradient = jacobian.T @ (weight * residuals)
            step = spsolve(normal + damping * diags_array(normal.diagonal()).tocsc(), -gradient)
            there = values + step.reshape(values.shape)
            beyond = self._residuals(there)
            gain = self._cost(residuals, scale) - self._cost(beyond, scale)
            damping = damping / 10 if gain >= 0 else damping * 10
            if gain >= 0:
                values, residuals = there, beyond
            if abs(step).max() < _SMALL or damping > 1 / _SMALL:
                break
        return values

    def _cost(self, residuals: Float, scale: float) -> float:
        """Half the sum of squares, of fixes by Cauchy's loss."""
        firm, fixes = np.split(residuals, [len(residuals) - self._robust])
        loss = scale**2 * np.log1p((fixes / scale) ** 2)
        return float((firm**2).sum() + loss.sum() / self._shared) / 2

    def _weight(self, residuals: Float, scale: float) -> Float:
        """Weights (m,) with which squares have the gradient of the cost."""
        weight = np.ones(len(residuals))
        weight[-self._robust :] = 1 / (1 + (residuals[-self._robust :] / scale) ** 2) / self._shared
        return weight

    def _jacobian(self, values: Float) -> Any:
        """Derivatives of the residuals: no residual depends on two even poses, nor on two odd ones."""
        row, knot = self._depends
        derivatives = []
        for column in range(6):
            for parity in range(2):
                step = np.zeros_like(values)
                step[parity::2, column] = _DIFFERENCE
                change = (self._residuals(values + step) - self._residuals(values - step)) / (2 * _DIFFERENCE)
                mine = knot % 2 == parity
                derivatives.append((change[row[mine]], row[mine], 6 * knot[mine] + column))
        data, rows, columns = (np.concatenate(parts) for parts in zip(*derivatives, strict=True))
        return coo_array((data, (rows, columns)), shape=(int(row.max()) + 1, values.size)).tocsr()

    def _start(self) -> Float:
        """The aligned poses, turned to the courses and moved to the middle of the fixes."""
        turn = Rotation.from_matrix(self._relative[:, :3, :3])
        yaw = np.unwrap(turn.as_euler("zyx")[:, 0])[self._knot]
        off = (self._yaw - yaw)[self._moving]
        north = np.median(np.angle(np.exp(1j * (off - off[0])))) + off[0] if len(off) else 0.0
        turned = Rotation.from_euler("z", north) * turn
        place = Rotation.from_euler("z", north).apply(self._relative[:, :3, 3])
        antenna = place[self._knot] + turned[self._knot].apply(self._lever)
        place += np.median(self._position - antenna, axis=0) if len(antenna) else 0.0
        return np.hstack([turned.as_rotvec(), place])

    def _residuals(self, values: Float) -> Float:
        poses = values.reshape(-1, 6)
        turn, place = Rotation.from_rotvec(poses[:, :3]), poses[:, 3:]
        off_turn = (Rotation.from_matrix(self._turn).inv() * turn[:-1].inv() * turn[1:]).as_rotvec()
        off_shift = turn[:-1].inv().apply(np.diff(place, axis=0)) - self._shift
        antenna = place + turn.apply(self._lever)
        share = self._share[:, None]
        seen = (1 - share) * antenna[self._knot] + share * antenna[self._knot + 1]
        ahead = turn.apply([1.0, 0.0, 0.0])
        along = (1 - share) * ahead[self._knot] + share * ahead[self._knot + 1]
        off_yaw = np.arctan2(along[:, 1], along[:, 0]) - self._yaw
        off_yaw = np.angle(np.exp(1j * off_yaw)) * self._moving
        up = turn.inv().apply([0.0, 0.0, 1.0])
        parts = [
            off_turn / self._edge_sigma[:, :3],
            off_shift / self._edge_sigma[:, 3:],
            up[:, :2] / np.array(_TILT),
            (seen - self._position) / self._sigma,
            off_yaw / _COURSE,
        ]
        return np.concatenate([part.ravel() for part in parts])

    @property
    def _depends(self) -> tuple[Ints, Ints]:
        """Residuals and knots that these depend on, in pairs."""
        n = len(self._relative)
        edges, fixes = np.repeat(np.arange(n - 1), 3), np.repeat(self._knot, 3)
        first = np.concatenate([edges, edges, np.repeat(np.arange(n), 2), fixes, self._knot])
        second = np.concatenate([edges + 1, edges + 1, np.full(2 * n, -1), fixes + 1, self._knot + 1])
        row = np.tile(np.arange(len(first)), 2)
        knot = np.concatenate([first, second])
        return row[knot >= 0], knot[knot >= 0]
