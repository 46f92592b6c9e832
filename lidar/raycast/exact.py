"""Rays near edges: the first hit decided in float64 among the faces around them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from geoscene.typing import Float
from lidar.raycast.columns import Target
from lidar.raycast.lanes import START
from lidar.raycast.memory import called, inlined
from lidar.raycast.packets import trace
from lidar.raycast.planes import INVALID, intersection, outside, placed
from lidar.raycast.rows import (
    HIT_COPY,
    HIT_FACE,
    HIT_GEOMETRY,
    HIT_INSTANCE,
    PACKET_ROWS,
    RAY_DX,
    RAY_DY,
    RAY_DZ,
    RAY_FAR,
    RAY_NEAR,
    RAY_OX,
    RAY_OY,
    RAY_OZ,
    RAY_TIME,
)

AROUND = 16
"""Number of parallel rays around a ray: one on it, and two circles beyond the displacement of edges."""
_INNER, _CIRCLES = 6, (3.0, 8.0)  # rays of the inner circle with the one on the ray; radii in margins
_GOLDEN = 2.399963229728653  # radians between successive rays
STARTS = 4
"""Faces at the start of a ray that it passes."""
_BEYOND = 1.0 + 2.0**-21  # factor of a float32 range to the range beyond it


@inlined
def _aim(f: Any, valid: Any, W: int, first: int, ray: Any, inverse: float, margin: float) -> None:
    """Write parallel rays first to first + W around a ray to Embree's packet."""
    ox, oy, oz, dx, dy, dz = ray
    dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
    if abs(dz) < 0.7:
        length = 1.0 / np.sqrt(dx * dx + dy * dy)
        ux, uy, uz = dy * length, -dx * length, 0.0
    else:
        length = 1.0 / np.sqrt(dx * dx + dz * dz)
        ux, uy, uz = dz * length, 0.0, -dx * length
    vx, vy, vz = dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux
    for k in range(W):
        number = first + k
        radius = 0.0 if number == 0 else _CIRCLES[0] if number < _INNER else _CIRCLES[1]
        a, b = margin * radius * np.cos(_GOLDEN * number), margin * radius * np.sin(_GOLDEN * number)
        f[RAY_OX * W + k] = ox + a * ux + b * vx
        f[RAY_OY * W + k] = oy + a * uy + b * vy
        f[RAY_OZ * W + k] = oz + a * uz + b * vz
        f[RAY_DX * W + k], f[RAY_DY * W + k], f[RAY_DZ * W + k] = dx, dy, dz
        valid[k] = -1 if number < AROUND else 0


def circles(directions: Float, margin: float) -> Iterator[Float]:
    """Offsets (n, 3) of the parallel rays around rays with unit directions (n, 3)."""
    steep = np.abs(directions[:, 2:]) < 0.7
    u = np.cross(directions, np.where(steep, [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(directions, u)
    for k in range(AROUND):
        radius = margin * (0.0 if k == 0 else _CIRCLES[0] if k < _INNER else _CIRCLES[1])
        yield radius * (np.cos(_GOLDEN * k) * u + np.sin(_GOLDEN * k) * v)


@inlined
def _known(u: Any, W: int, k: int) -> bool:
    """Whether an earlier lane has the same face as lane k."""
    found = False
    for j in range(k):
        found |= (
            (u[HIT_FACE * W + j] == u[HIT_FACE * W + k])
            & (u[HIT_GEOMETRY * W + j] == u[HIT_GEOMETRY * W + k])
            & (u[HIT_INSTANCE * W + j] == u[HIT_INSTANCE * W + k])
            & (u[HIT_COPY * W + j] == u[HIT_COPY * W + k])
        )
    return found


@called
def first_hit(
    target: Target,
    near: float,
    far: float,
    ray: Any,
    inverse: float,
    time: float,
    f: Any,
    valid: Any,
    one: Any,
) -> Any:
    """The first face that a ray hits in float64: row of ``parts``, number in it, instance; row -1 for a miss.

    The faces are those that parallel rays around it hit in float32. If it hits none of them and all parallel
    rays hit something, the face is the one that it passes at the least distance.
    """
    W = len(target.lanes)
    u = f.view(np.uint32)
    best, closest, t_best = (np.int64(-1), np.int64(-1), np.int64(-1)), np.inf, np.inf
    missed = False
    for first in range(0, AROUND, W):
        _aim(f, valid, W, first, ray, inverse, target.margin)
        for k in range(W):
            f[RAY_NEAR * W + k], f[RAY_TIME * W + k] = near / inverse, time
        for _ in range(STARTS):
            for k in range(W):
                f[RAY_FAR * W + k] = np.inf
                u[HIT_GEOMETRY * W + k], u[HIT_INSTANCE * W + k] = INVALID, INVALID
            trace(target, W, PACKET_ROWS, f, valid, W > 1, one)
            again = False
            for k in range(W):
                if valid[k] == 0:
                    continue
                valid[k] = 0
                if u[HIT_GEOMETRY * W + k] == INVALID:
                    missed = True
                    continue
                row, instance = placed(
                    target, u[HIT_GEOMETRY * W + k], u[HIT_INSTANCE * W + k], u[HIT_COPY * W + k]
                )
                prim = np.int64(u[HIT_FACE * W + k])
                t, cosine, _, _, _ = intersection(target, row, prim, instance, ray, inverse, time)
                if not (t - near) * abs(cosine) > START * inverse:
                    f[RAY_NEAR * W + k] = f[RAY_FAR * W + k] * _BEYOND + np.float32(1e-6)
                    valid[k], again = -1, True
                elif t > far:
                    missed = True
                elif not _known(u, W, k):
                    passed = outside(target, row, prim, instance, ray, time)
                    if passed < closest or (passed == closest and t < t_best):
                        best, closest, t_best = (row, prim, instance), passed, t
            if not again:
                break
    if missed and closest > 0.0:
        best = (np.int64(-1), np.int64(-1), np.int64(-1))
    return best
