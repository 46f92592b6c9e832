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
    from the pose is casting each pulse from where the sensor is when it fires.

    rays       : rays a pulse, see `lidar.physics.footprint.bundle`
    divergence : (2,) radians, full 1/e^2 angles, level and upright
    aperture   : (2,) metres, the beam's size at its start
    """
    first = int(firings.time_ns.min())
    count = (int(firings.time_ns.max()) - first) // KNOT_NS + 2
    knots = trajectory.at(first + KNOT_NS * np.arange(count, dtype=np.int64))
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
        firings.time_ns - first,
        firings.direction,
        firings.origin,
        (turn, shift),
        (spread, size),
        (index, direction, origin),
    )
    # Rays of a pulse go together.
    order = (firings.order[:, None] * rays + np.arange(rays)).ravel().astype(np.int32)
    return Rays(poses, index, direction, origin, order, rays, share)


@njit(cache=True, nogil=True)
def _fill(since: Any, directions: Any, origins: Any, motion: Any, spread: Any, out: Any) -> None:
    """Fill ``out``: pose, direction and origin of every ray."""
    turn, shift = motion
    angle, size = spread
    index, direction, origin = out
    d, o = np.empty(3), np.empty(3)
    i = 0
    for pulse in range(len(since)):
        k = since[pulse] // KNOT_NS
        w = (since[pulse] - k * KNOT_NS) / KNOT_NS
        m = turn[k]
        x, y, z = directions[pulse]
        level = np.sqrt(x * x + y * y)
        # Across the beam: level to the left, and upright. A beam along the axis takes left as it is.
        lx, ly = (-y / level, x / level) if level > 1e-9 else (0.0, 1.0)
        ux, uy, uz = -z * ly, z * lx, x * ly - y * lx
        for ray in range(len(angle)):
            a, b = angle[ray, 0], angle[ray, 1]
            d[0], d[1], d[2] = x + a * lx + b * ux, y + a * ly + b * uy, z + b * uz
            a, b = size[ray, 0], size[ray, 1]
            o[0] = origins[pulse, 0] + a * lx + b * ux
            o[1] = origins[pulse, 1] + a * ly + b * uy
            o[2] = origins[pulse, 2] + b * uz
            length = 0.0
            for r in range(3):
                v = d[r] + w * (m[r, 0] * d[0] + m[r, 1] * d[1] + m[r, 2] * d[2])
                direction[i, r] = v
                length += v * v
                origin[i, r] = o[r] + w * (m[r, 0] * o[0] + m[r, 1] * o[1] + m[r, 2] * o[2] + shift[k, r])
            length = 1 / np.sqrt(length)
            for r in range(3):
                direction[i, r] *= length
            index[i] = k
            i += 1
