"""Poses of rigid bodies and trajectories of vehicles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.columns import Columns
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.errors import InputError

KNOT_NS = 200_000
"""Interval in nanoseconds at which poses within a sweep are computed; points move linearly in between.

At a yaw rate of 1 rad/s the chord deviates from the arc by (2e-4)^2 / 8 = 5e-9 rad.
"""


@dataclass(frozen=True, slots=True)
class Poses(Columns):
    """Poses of a body in the scene; a point b of the body is at position + scale * (rotation @ b).

    position : (n, 3) float64, scene metres
    rotation : (n, 3, 3) float64, from body axes (x forward, y left, z up) to scene axes
    scale    : (n, 3) float64, scene metres per true metre along the scene's axes; (k, k, 1), where k is the
               projection's point scale (1 in a local frame, 0.9996 to 1.0004 and more in UTM)
    """

    position: Float
    rotation: Float
    scale: Float

    def mounted(self, translation: ArrayLike, rotation: ArrayLike) -> Poses:
        """Poses of a sensor mounted on the body.

        translation : (3,) true metres in the body frame
        rotation    : (3, 3) from sensor axes to body axes
        """
        shift = self.rotation @ np.asarray(translation, float)
        return Poses(
            self.position + self.scale * shift, self.rotation @ np.asarray(rotation, float), self.scale
        )

    def place(self, points: Float) -> Float:
        """Scene coordinates (n, 3) of body points (n, 3), row by row; one pose serves all points."""
        turned = np.einsum("nij,nj->ni", np.broadcast_to(self.rotation, (len(points), 3, 3)), points)
        placed: Float = self.position + self.scale * turned
        return placed

    def seen(self, points: Float) -> Float:
        """Body coordinates (n, 3) of scene points (n, 3), row by row: the inverse of `place`."""
        found: Float = np.einsum("nji,nj->ni", self.rotation, (points - self.position) / self.scale)
        return found

    def matrices(self) -> Float:
        """Transformations (n, 4, 4) from the body, with positions in true metres from the scene's origin."""
        found = np.tile(np.eye(4), (len(self.position), 1, 1))
        found[:, :3, :3], found[:, :3, 3] = self.rotation, self.position / self.scale[:1]
        return found

    def directions(self, vectors: Float) -> Float:
        """Ray directions (n, 3) in the scene of body vectors (n, 3), row by row.

        They include the scale, so that the ray parameter of a hit is a true distance for unit vectors.
        """
        turned = np.einsum("nij,nj->ni", np.broadcast_to(self.rotation, (len(vectors), 3, 3)), vectors)
        scaled: Float = self.scale * turned
        return scaled


@dataclass(frozen=True)
class Trajectory(Columns):
    """Poses of a vehicle at increasing times, interpolated linearly in position and by slerp in rotation.

    time_ns  : (n,) int64, nanoseconds since the drive's start
    position : (n, 3) float64, scene metres: the centre of the rear axle, on the ground
    quat_xyzw : (n, 4) float64, from vehicle axes to scene axes
    velocity : (n, 3) float64, true m/s along the scene's axes
    scale    : (n,) float64, scene metres per true metre, horizontally
    """

    time_ns: NDArray[np.int64]
    position: Float
    quat_xyzw: Float
    velocity: Float
    scale: Float

    def __post_init__(self) -> None:
        """Check that the trajectory can be interpolated."""
        if len(self.time_ns) < 2 or (np.diff(self.time_ns) <= 0).any():
            raise InputError("a trajectory needs two or more poses at increasing times")
        if not (np.isfinite(self.position).all() and np.isfinite(self.quat_xyzw).all()):
            raise InputError("a trajectory has poses that are not finite")

    @property
    def duration_ns(self) -> int:
        """Time of the last pose, nanoseconds."""
        return int(self.time_ns[-1])

    def until(self, time_ns: int) -> Trajectory:
        """The trajectory up to a time (at least two poses); unchanged if it ends before."""
        if time_ns >= self.time_ns[-1]:
            return self
        n = int(np.searchsorted(self.time_ns, time_ns, side="right"))
        return self.take(slice(max(n, 2)))

    def at(self, time_ns: ArrayLike) -> Poses:
        """Poses at times (k,) in nanoseconds, clamped to the first and last pose."""
        knot = self.time_ns
        t = np.clip(np.asarray(time_ns, np.int64).reshape(-1), knot[0], knot[-1])
        row = np.minimum(np.searchsorted(knot, t, side="right") - 1, len(knot) - 2)
        share = (t - knot[row]) / (knot[row + 1] - knot[row])
        out = Poses(np.empty((len(t), 3)), np.empty((len(t), 3, 3)), np.ones((len(t), 3)))
        _interpolate(
            row,
            share,
            self.position,
            self.quat_xyzw,
            self.scale,
            (out.position, out.rotation, out.scale),
        )
        return out

    def place(
        self,
        points: NDArray[np.floating],
        time_ns: NDArray[np.integer],
        *,
        translation: ArrayLike,
        rotation: ArrayLike,
    ) -> Float:
        """Scene coordinates (n, 3) of points that a sensor on the vehicle measured, each at its own time.

        points      : (n, 3) metres in the sensor frame
        time_ns     : (n,) nanoseconds since the drive's start
        translation, rotation : of the mount, see `Poses.mounted`

        Poses are computed every `KNOT_NS`; points are interpolated linearly between them. Times may be far
        apart: there are at most two poses for each point, and one.
        """
        if not len(points):
            return np.empty((0, 3))
        knot, share = np.empty(len(points), np.int64), np.empty(len(points))
        first, last = _knots_before(np.asarray(time_ns), knot, share)
        needed, row = _needed_knots(knot, first, last=last)
        knots = self.at(KNOT_NS * needed).mounted(translation, rotation)
        turn = knots.scale[:, :, None] * knots.rotation
        out: Float = np.empty((len(points), 3))
        _place(points, row, share, knots.position, turn, out)
        return out


@njit(cache=True, nogil=True)
def _knots_before(time_ns: Any, knot: Any, share: Any) -> Any:
    """Fill the knot before each time and the share of the way to the next; return the least and greatest."""
    first = last = np.int64(time_ns[0]) // KNOT_NS
    for i in range(len(time_ns)):
        t = np.int64(time_ns[i])
        k = t // KNOT_NS
        knot[i], share[i] = k, (t - k * KNOT_NS) / KNOT_NS
        first, last = min(first, k), max(last, k)
    return first, last


def _needed_knots(
    knot: NDArray[np.int64], first: int, *, last: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Knots (k,), and the row (n,) of each given one, which the next one follows.

    first, last : the least and greatest knot
    """
    if last - first < 2 * len(knot):
        return np.arange(first, last + 2), knot - first
    each, row = np.unique(knot, return_inverse=True)
    return np.stack([each, each + 1], axis=1).ravel(), 2 * row


@njit(cache=True, nogil=True)
def _dot(a: Any, b: Any) -> float:
    """Inner product of two quaternions; that of whole arrays takes long to compile."""
    return float(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3])


@njit(cache=True, nogil=True)
def _interpolate(row: Any, share: Any, place: Any, quat: Any, scale: Any, out: Any) -> None:
    """Fill ``out``: position, rotation and scale between rows and the next; slerp takes the shorter arc."""
    position, rotation, factor = out
    for i in range(len(row)):
        k, w = row[i], share[i]
        for r in range(3):
            position[i, r] = place[k, r] + w * (place[k + 1, r] - place[k, r])
        factor[i, 0] = factor[i, 1] = scale[k] + w * (scale[k + 1] - scale[k])
        a, b = quat[k], quat[k + 1]
        size_a, size_b = np.sqrt(_dot(a, a)), np.sqrt(_dot(b, b))
        size = np.sqrt(_dot(a, a) * _dot(b, b))
        along = _dot(a, b) / size
        # atan2 of sine and cosine: near 1 the cosine alone is too coarse.
        cross = np.sqrt(
            (a[3] * b[0] - a[0] * b[3] - a[1] * b[2] + a[2] * b[1]) ** 2
            + (a[3] * b[1] - a[1] * b[3] - a[2] * b[0] + a[0] * b[2]) ** 2
            + (a[3] * b[2] - a[2] * b[3] - a[0] * b[1] + a[1] * b[0]) ** 2
        )
        angle = np.arctan2(cross / size, abs(along))
        u, v = 1.0 - w, w
        if angle > 1e-8:
            u, v = np.sin(u * angle) / np.sin(angle), np.sin(w * angle) / np.sin(angle)
        if along < 0.0:
            v = -v
        u, v = u / size_a, v / size_b
        x, y, z, s = u * a[0] + v * b[0], u * a[1] + v * b[1], u * a[2] + v * b[2], u * a[3] + v * b[3]
        n = 2.0 / (x * x + y * y + z * z + s * s)
        m = rotation[i]
        m[0, 0], m[0, 1], m[0, 2] = 1 - n * (y * y + z * z), n * (x * y - z * s), n * (x * z + y * s)
        m[1, 0], m[1, 1], m[1, 2] = n * (x * y + z * s), 1 - n * (x * x + z * z), n * (y * z - x * s)
        m[2, 0], m[2, 1], m[2, 2] = n * (x * z - y * s), n * (y * z + x * s), 1 - n * (x * x + y * y)


@njit(cache=True, nogil=True)
def _place(points: Any, knot: Any, share: Any, position: Any, turn: Any, out: Any) -> None:
    """Fill ``out`` with scene coordinates of sensor points, linear between the poses at two knots."""
    for i in range(len(points)):
        k, w = knot[i], share[i]
        for r in range(3):
            here, there = position[k, r], position[k + 1, r]
            for c in range(3):
                here += turn[k, r, c] * points[i, c]
                there += turn[k + 1, r, c] * points[i, c]
            out[i, r] = here + w * (there - here)
