"""Rays of a sensor that moves while it fires."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lidar.physics.footprint import bundle
from lidar.poses import KNOT_NS, Poses, Trajectory
from lidar.rig import Mount
from lidar.sensors.beams import Firings

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Rays:
    """The rays of a frame: those of the first pulse, of the second, ...; the beam's axis leads each bundle.

    poses     : of the sensor
    index     : (n,) int32, each ray's row of ``poses``
    direction : (n, 3) float64, unit vectors in the sensor frame of that pose
    origin    : (n, 3) float64, metres, in the same frame
    order     : (n,) int32, permutation in which neighbours go almost the same way
    per_pulse : rays of a pulse
    share     : (per_pulse,) float64, their shares of its power
    """

    poses: Poses
    index: NDArray[np.int32]
    direction: Float
    origin: Float
    order: NDArray[np.int32]
    per_pulse: int
    share: Float


def cast_from(
    firings: Firings,
    mount: Mount,
    trajectory: Trajectory,
    *,
    rays: int = 1,
    divergence: tuple[float, float] = (0.0, 0.0),
    aperture: tuple[float, float] = (0.0, 0.0),
) -> Rays:
    """The rays of pulses that are fired from a moving vehicle.

    Direction and start of a ray carry the motion from its pose to the pulse's own time, so that casting them
    from the pose is casting each pulse from where the sensor is when it fires. Poses are taken every
    `KNOT_NS` and beams moved linearly between them, as in `Trajectory.place`.

    rays       : rays a pulse, see `lidar.physics.footprint.bundle`
    divergence : (2,) radians, full 1/e^2 angles, level and upright
    aperture   : (2,) metres, the beam's size at its start
    """
    first, last = (int(t) // KNOT_NS for t in (firings.time_ns.min(), firings.time_ns.max()))
    knots = trajectory.at(KNOT_NS * np.arange(first, last + 2, dtype=np.int64))
    poses = knots.mounted(mount.translation, mount.rotation)
    back = poses.rotation[:-1].transpose(0, 2, 1)
    turn = back @ poses.rotation[1:] - np.eye(3)
    step = (poses.position[1:] - poses.position[:-1]) / poses.scale[:-1]
    shift = np.einsum("nij,nj->ni", back, step)
    place, share = bundle(rays)
    n = len(firings) * rays
    index, direction, origin = np.empty(n, np.int32), np.empty((n, 3)), np.empty((n, 3))
    spread, size = place * np.divide(divergence, 2), place * np.divide(aperture, 2)
    _fill(
        firings.time_ns - first * KNOT_NS,
        firings.direction,
        firings.origin,
        (turn, shift),
        (spread, size),
        (index, direction, origin),
    )
    order: Any = firings.order
    if rays > 1:  # those of a pulse go together
        order = (order[:, None] * np.int32(rays) + np.arange(rays, dtype=np.int32)).ravel()
    return Rays(poses, index, direction, origin, order, rays, share)


@njit(cache=True, nogil=True)
def _fill(since: Any, directions: Any, origins: Any, motion: Any, spread: Any, out: Any) -> None:
    """Fill ``out``: pose, direction and origin of every ray."""
    turn, shift = motion
    angle, size = spread
    index, direction, origin = out
    i = 0
    for pulse in range(len(since)):
        k = since[pulse] // KNOT_NS
        w = (since[pulse] - k * KNOT_NS) / KNOT_NS
        m = turn[k]
        x, y, z = directions[pulse, 0], directions[pulse, 1], directions[pulse, 2]
        ox, oy, oz = origins[pulse, 0], origins[pulse, 1], origins[pulse, 2]
        # Across the beam: level to the left (lx, ly), and upright (ux, uy, uz).
        lx, ly, ux, uy, uz = 0.0, 1.0, 0.0, 0.0, 0.0
        if len(angle) > 1:
            level = np.sqrt(x * x + y * y)
            if level > 1e-9:  # else along the spin axis, where left is as good as any
                lx, ly = -y / level, x / level
            ux, uy, uz = -z * ly, z * lx, x * ly - y * lx
        for ray in range(len(angle)):
            a, b = angle[ray, 0], angle[ray, 1]
            dx, dy, dz = x + a * lx + b * ux, y + a * ly + b * uy, z + b * uz
            a, b = size[ray, 0], size[ray, 1]
            px, py, pz = ox + a * lx + b * ux, oy + a * ly + b * uy, oz + b * uz
            vx = dx + w * (m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz)
            vy = dy + w * (m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz)
            vz = dz + w * (m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz)
            scale = 1 / np.sqrt(vx * vx + vy * vy + vz * vz)
            direction[i, 0], direction[i, 1], direction[i, 2] = vx * scale, vy * scale, vz * scale
            origin[i, 0] = px + w * (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + shift[k, 0])
            origin[i, 1] = py + w * (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + shift[k, 1])
            origin[i, 2] = pz + w * (m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + shift[k, 2])
            index[i] = k
            i += 1
