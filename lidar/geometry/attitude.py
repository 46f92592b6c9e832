"""Attitudes: quaternions (x, y, z, w), Euler angles in two conventions, axes, and extrinsics of sensors.

The angles of `poses.csv` are alpha about X (roll), beta about Y (pitch), gamma about Z (yaw), radians, with

    R = Rz(gamma) Ry(beta) Rx(alpha)

which rotates vehicle vectors (x forward, y left, z up) into scene vectors: rotations about the fixed scene
axes in the order X, Y, Z, or equally about the vehicle's own axes in the order Z, Y', X''.
Yaw is counter-clockwise from the scene's x axis (east), positive pitch is nose down, positive roll is left
side up. The alternative R = Rx(alpha) Ry(beta) Rz(gamma), intrinsic X-Y'-Z'', differs at large angles; its
functions end in ``_intrinsic``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geoscene.typing import Float

LOCK = 1e-7
"""Distance in radians of the middle angle from 90 degrees below which the outer angles are ambiguous."""


def _angles(R: Float, sign: float) -> tuple[Float, Float, Float]:
    """The three angles of Rz Ry Rx (sign 1), or of its mirror Rx Ry Rz given transposed (sign -1)."""
    middle = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 0, 0], R[..., 1, 0]))
    locked = np.abs(np.abs(middle) - np.pi / 2) < LOCK
    first = np.where(locked, 0.0, np.arctan2(R[..., 2, 1], R[..., 2, 2]))
    last = np.where(locked, np.arctan2(-R[..., 0, 1], R[..., 1, 1]), np.arctan2(R[..., 1, 0], R[..., 0, 0]))
    return sign * first, sign * middle, sign * last


def euler_from_quat(quat_xyzw: ArrayLike) -> Float:
    """Angles (..., 3) alpha, beta, gamma of R = Rz(gamma) Ry(beta) Rx(alpha), beta in [-pi/2, pi/2].

    With the nose straight up or down (gimbal lock) alpha is 0 and gamma holds the whole rotation.
    """
    quat = np.asarray(quat_xyzw, float)
    return np.stack(_angles(matrix_from_quat(quat), 1.0), axis=-1)


def quat_from_euler(alpha: ArrayLike, beta: ArrayLike, *, gamma: ArrayLike) -> Float:
    """Quaternions (..., 4) x, y, z, w of R = Rz(gamma) Ry(beta) Rx(alpha), with w >= 0."""
    a, b, g = np.broadcast_arrays(*(np.asarray(v, float) / 2.0 for v in (alpha, beta, gamma)))
    ca, sa, cb, sb, cg, sg = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(g), np.sin(g)
    quat = np.stack(
        [
            sa * cb * cg - ca * sb * sg,
            ca * sb * cg + sa * cb * sg,
            ca * cb * sg - sa * sb * cg,
            ca * cb * cg + sa * sb * sg,
        ],
        axis=-1,
    )
    return np.where(quat[..., 3:] < 0, -quat, quat)


def euler_from_quat_intrinsic(quat_xyzw: ArrayLike) -> Float:
    """Angles (..., 3) alpha, beta, gamma of R = Rx(alpha) Ry(beta) Rz(gamma), the order X-Y'-Z''."""
    quat = np.asarray(quat_xyzw, float)
    # the inverse of Rx Ry Rz is Rz(-gamma) Ry(-beta) Rx(-alpha)
    R = np.swapaxes(matrix_from_quat(quat), -1, -2)
    return np.stack(_angles(R, -1.0), axis=-1)


def quat_from_euler_intrinsic(alpha: ArrayLike, beta: ArrayLike, *, gamma: ArrayLike) -> Float:
    """Quaternions (..., 4) x, y, z, w of R = Rx(alpha) Ry(beta) Rz(gamma), with w >= 0."""
    inverse = quat_from_euler(
        -np.asarray(alpha, float), -np.asarray(beta, float), gamma=-np.asarray(gamma, float)
    )
    conjugate: Float = inverse * np.array([-1.0, -1.0, -1.0, 1.0])
    return conjugate


def matrix_from_quat(quat_xyzw: ArrayLike) -> Float:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) of any length above 0."""
    quat = np.asarray(quat_xyzw, float)
    x, y, z, w = np.moveaxis(quat * np.sqrt(2.0 / (quat**2).sum(axis=-1, keepdims=True)), -1, 0)
    rows = [
        np.stack([1 - y * y - z * z, x * y - z * w, x * z + y * w], axis=-1),
        np.stack([x * y + z * w, 1 - x * x - z * z, y * z - x * w], axis=-1),
        np.stack([x * z - y * w, y * z + x * w, 1 - x * x - y * y], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def quat_from_matrix(matrix: ArrayLike) -> Float:
    """Quaternions (n, 4) x, y, z, w, with w >= 0, of rotation matrices (n, 3, 3)."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    matrices = np.asarray(matrix, float)
    return Rotation.from_matrix(matrices).as_quat(canonical=True) if len(matrices) else np.empty((0, 4))


def quat_product(first: ArrayLike, second: ArrayLike) -> Float:
    """Quaternions (..., 4) of the rotations ``first @ second``, with w >= 0."""
    a, b, c, d = np.moveaxis(np.asarray(first, float), -1, 0)
    x, y, z, w = np.moveaxis(np.asarray(second, float), -1, 0)
    out = np.stack(
        [
            d * x + a * w + b * z - c * y,
            d * y - a * z + b * w + c * x,
            d * z + a * y - b * x + c * w,
            d * w - a * x - b * y - c * z,
        ],
        axis=-1,
    )
    return np.where(out[..., 3:] < 0, -out, out)


def body_rates(time_s: ArrayLike, quat_xyzw: ArrayLike) -> Float:
    """Angular velocities (n, 3) in the body frame, rad/s, at times (n,) with attitudes (n, 4).

    Central differences of the rotation vector, exact for a constant rate; one-sided at the ends.
    """
    from scipy.spatial.transform import Rotation  # noqa: PLC0415

    t, attitude = np.asarray(time_s, float), Rotation.from_quat(np.asarray(quat_xyzw, float))
    between = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / np.diff(t)[:, None]
    return np.concatenate([between[:1], between]) * 0.5 + np.concatenate([between, between[-1:]]) * 0.5


OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Rotation from optical axes (x right, y down, z forward) to body axes (x forward, y left, z up)."""
OPTICAL_QUAT = (-0.5, 0.5, -0.5, 0.5)


@dataclass(frozen=True, slots=True)
class Mount:
    """Extrinsics of a sensor: its point s lies at translation + rotation @ s in the vehicle frame.

    translation : metres in the vehicle frame (origin: the rear axle's centre on the ground)
    quat_xyzw   : rotation from sensor axes to vehicle axes
    """

    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quat_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)

    @property
    def rotation(self) -> Float:
        """Rotation (3, 3) from sensor axes to vehicle axes."""
        return matrix_from_quat(self.quat_xyzw)

    @property
    def matrix(self) -> Float:
        """Homogeneous transform (4, 4) from the sensor frame to the vehicle frame."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.translation
        return matrix
