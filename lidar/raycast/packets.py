"""Packets of rays: gathered in float64, rounded for Embree, traced.

Rows of numbers, one a lane, lie end to end in ``work``. Of the ray: origin (0 to 2), direction (3 to 5), one
over its length (6), far (7), time (8). Of what it met: the plane's normal and offset (9 to 12), the scale of
the cosine (13), range (14) and cosine (15).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar.raycast.columns import Rays, Target
from lidar.raycast.lanes import HUGE, settle
from lidar.raycast.memory import (
    float32_at,
    float64_at,
    inlined,
    int64_at,
    intersect1,
    intersect4,
    intersect8,
    intersect16,
    occluded1,
    occluded4,
    occluded8,
    occluded16,
    vector,
)

RAY, ROWS = 12, 21
"""32-bit rows of RTCRayN and RTCRayHitN."""

_NUDGE = 3e-7  # radians; the smallest that closed every leak among a million rays aimed at vertices
_COHERENT = 0.985  # cosine; packets that fan out over more than 10° are faster as single rays
_SPREAD = 4.0  # metres; so are packets whose origins lie farther apart
_UP = 1.0 + 2.0**-23  # what lifts a float64 above the float32 it is rounded to


@inlined
def _posed(pose: Any, p: int, x: float, y: float, z: float) -> Any:
    """A vector of the pose's frame in the caster's axes."""
    R = pose[1] + 72 * p
    return (
        float64_at(R, 0) * x + float64_at(R, 1) * y + float64_at(R, 2) * z,
        float64_at(R, 3) * x + float64_at(R, 4) * y + float64_at(R, 5) * z,
        float64_at(R, 6) * x + float64_at(R, 7) * y + float64_at(R, 8) * z,
    )


@inlined
def _shorten(W: int, k: int, work: Any, f: Any) -> None:
    """Give lane k of Embree's packet a direction of length 1."""
    x, y, z = work[3 * W + k], work[4 * W + k], work[5 * W + k]
    length = np.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / length
    work[6 * W + k] = inverse
    f[4 * W + k], f[5 * W + k], f[6 * W + k] = x * inverse, y * inverse, z * inverse
    f[3 * W + k] = f[3 * W + k] * length
    f[8 * W + k] = work[7 * W + k] * length * _UP


@inlined
def first_bad(W: int, ids: Any, work: Any) -> int:
    """The first ray of the lanes that cannot be cast."""
    for k in range(W):
        x, y, z = work[3 * W + k], work[4 * W + k], work[5 * W + k]
        squared = x * x + y * y + z * z
        size = abs(work[k]) + abs(work[W + k]) + abs(work[2 * W + k])
        if not (0.0 < squared < HUGE and size < HUGE):
            return int(ids[k])
    return -1


@inlined
def gather(target: Target, rays: Rays, at: int, m: int, lanes: Any, ids: Any, work: Any, f: Any) -> bool:
    """Load rays ``at`` to ``at + m`` of the order, the last again in lanes left over; whether all will do.

    Embree's packet ``f`` gets directions of length 1 and far rounded up.
    """
    W = len(lanes)
    ordered, posed, timed, reach = rays.order.size, rays.pose.size, rays.time.size, rays.far.size > 1
    shifted, step = rays.offsets.shape[0] > 0, 1 if rays.offsets.shape[0] > 1 else 0
    directions, offsets, far = rays.directions.ctypes.data, rays.offsets.ctypes.data, rays.far.ctypes.data
    order, pose_of, time = rays.order.ctypes.data, rays.pose.ctypes.data, rays.time.ctypes.data
    pose = (rays.position.ctypes.data, rays.matrix.ctypes.data)
    cx, cy, cz = target.origin[0], target.origin[1], target.origin[2]
    for k in range(W):
        ids[k] = at + min(k, m - 1)
    if ordered:
        for k in range(W):
            ids[k] = int64_at(order, ids[k])
    if posed:
        for k in range(W):
            p = int64_at(pose_of, ids[k])
            x, y, z = vector(directions, ids[k])
            work[3 * W + k], work[4 * W + k], work[5 * W + k] = _posed(pose, p, x, y, z)
            work[k], work[W + k], work[2 * W + k] = vector(pose[0], p)
        if shifted:
            for k in range(W):
                x, y, z = vector(offsets, step * ids[k])
                x, y, z = _posed(pose, int64_at(pose_of, ids[k]), x, y, z)
                work[k] += x
                work[W + k] += y
                work[2 * W + k] += z
    else:
        for k in range(W):
            work[3 * W + k], work[4 * W + k], work[5 * W + k] = vector(directions, ids[k])
            work[k], work[W + k], work[2 * W + k] = vector(offsets, step * ids[k])
    plain = settle(lanes, work.ctypes.data, f.ctypes.data, cx, cy, cz)
    if reach:
        for k in range(W):
            work[7 * W + k] = float64_at(far, ids[k])
    else:
        limit = float64_at(far, 0)
        for k in range(W):
            work[7 * W + k] = limit
    if timed:
        for k in range(W):
            work[8 * W + k] = float32_at(time, ids[k])
    for k in range(W):
        work[6 * W + k] = 1.0
        f[3 * W + k] = rays.near
        f[7 * W + k] = work[8 * W + k]
        f[8 * W + k] = work[7 * W + k] * _UP
    if plain:
        return True
    if first_bad(W, ids, work) >= 0:
        return False
    for k in range(W):
        _shorten(W, k, work, f)
    return True


@inlined
def nudge(W: int, k: int, work: Any, f: Any, far: float) -> None:
    """Turn the direction of lane k of Embree's packet a little and let it look as far as ``far``."""
    inverse = work[6 * W + k]
    x, y, z = work[3 * W + k] * inverse, work[4 * W + k] * inverse, work[5 * W + k] * inverse
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        x += _NUDGE
    elif abs(y) <= abs(z):
        y += _NUDGE
    else:
        z += _NUDGE
    f[4 * W + k], f[5 * W + k], f[6 * W + k] = x, y, z
    f[8 * W + k] = far / inverse * _UP


@inlined
def alike(W: int, work: Any) -> bool:
    """Whether a sample of the lanes goes the same way from about the same place: a scan, not a shuffle."""
    same = True
    for k in (W // 3, 2 * W // 3, W - 1):
        along = work[3 * W] * work[3 * W + k] + work[4 * W] * work[4 * W + k] + work[5 * W] * work[5 * W + k]
        apart = abs(work[0] - work[k]) + abs(work[W] - work[W + k]) + abs(work[2 * W] - work[2 * W + k])
        same &= (along * work[6 * W] * work[6 * W + k] > _COHERENT) & (apart < _SPREAD)
    return same


@inlined
def trace(target: Target, W: int, rows: int, f: Any, valid: Any, together: bool, one: Any) -> None:  # noqa: FBT001
    """Trace the valid lanes of a packet, all at once or one by one."""
    if together and W > 1:
        v, p = valid.ctypes.data, f.ctypes.data
        if rows == ROWS:
            if W == 16:
                intersect16(v, target.scene, p, target.packet)
            elif W == 8:
                intersect8(v, target.scene, p, target.packet)
            else:
                intersect4(v, target.scene, p, target.packet)
        elif W == 16:
            occluded16(v, target.scene, p, target.packet)
        elif W == 8:
            occluded8(v, target.scene, p, target.packet)
        else:
            occluded4(v, target.scene, p, target.packet)
        return
    q = one.ctypes.data
    for k in range(W):
        if valid[k] == 0:
            continue
        for r in range(rows):
            one[r] = f[r * W + k]
        if rows == ROWS:
            intersect1(target.scene, q, target.single)
        else:
            occluded1(target.scene, q, target.single)
        for r in range(8, rows):
            f[r * W + k] = one[r]
