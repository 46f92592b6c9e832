"""Packets of rays: gathered in float64, rounded for Embree, traced.

The layout of ``work`` (float64) and of Embree's packet ``f`` (float32) is in `lidar.raycast.rows`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar.raycast.columns import Rays, Target
from lidar.raycast.lanes import HUGE, UP, settle
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
from lidar.raycast.rows import (
    DX,
    DY,
    DZ,
    FAR,
    INVERSE,
    OX,
    OY,
    OZ,
    PACKET_ROWS,
    RAY_DX,
    RAY_DY,
    RAY_DZ,
    RAY_FAR,
    RAY_NEAR,
    TIME,
)

_NUDGE = 3e-7  # radians; the smallest that closed all leaks of a million rays aimed at vertices
_COHERENT = 0.985  # cosine; packets that fan out over more than 10° are faster as single rays
_SPREAD = 4.0  # metres; likewise packets whose origins lie farther apart


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
    """Normalise the direction of lane k of Embree's packet."""
    x, y, z = work[DX * W + k], work[DY * W + k], work[DZ * W + k]
    length = np.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / length
    work[INVERSE * W + k] = inverse
    f[RAY_DX * W + k], f[RAY_DY * W + k], f[RAY_DZ * W + k] = x * inverse, y * inverse, z * inverse
    f[RAY_NEAR * W + k] = f[RAY_NEAR * W + k] * length
    f[RAY_FAR * W + k] = work[FAR * W + k] * length * UP


@inlined
def first_bad(W: int, ids: Any, work: Any) -> int:
    """The first invalid ray of the lanes, or -1."""
    for k in range(W):
        x, y, z = work[DX * W + k], work[DY * W + k], work[DZ * W + k]
        squared = x * x + y * y + z * z
        size = abs(work[OX * W + k]) + abs(work[OY * W + k]) + abs(work[OZ * W + k])
        if not (0.0 < squared < HUGE and size < HUGE):
            return int(ids[k])
    return -1


@inlined
def gather(target: Target, rays: Rays, at: int, m: int, lanes: Any, ids: Any, work: Any, f: Any) -> bool:
    """Load rays ``at`` to ``at + m`` of the order; spare lanes repeat the last. Whether all are valid.

    Embree's packet ``f`` gets unit directions and far rounded up.
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
            work[DX * W + k], work[DY * W + k], work[DZ * W + k] = _posed(pose, p, x, y, z)
            work[OX * W + k], work[OY * W + k], work[OZ * W + k] = vector(pose[0], p)
        if shifted:
            for k in range(W):
                x, y, z = vector(offsets, step * ids[k])
                x, y, z = _posed(pose, int64_at(pose_of, ids[k]), x, y, z)
                work[OX * W + k] += x
                work[OY * W + k] += y
                work[OZ * W + k] += z
    else:
        for k in range(W):
            work[DX * W + k], work[DY * W + k], work[DZ * W + k] = vector(directions, ids[k])
            work[OX * W + k], work[OY * W + k], work[OZ * W + k] = vector(offsets, step * ids[k])
    if reach:
        for k in range(W):
            work[FAR * W + k] = float64_at(far, ids[k])
    else:
        limit = float64_at(far, 0)
        for k in range(W):
            work[FAR * W + k] = limit
    if timed:
        for k in range(W):
            work[TIME * W + k] = float32_at(time, ids[k])
    if settle(lanes, work.ctypes.data, f.ctypes.data, cx, cy, cz, rays.near):
        return True
    if first_bad(W, ids, work) >= 0:
        return False
    for k in range(W):
        _shorten(W, k, work, f)
    return True


@inlined
def nudge(W: int, k: int, work: Any, f: Any, far: float) -> None:
    """Perturb the direction of lane k of Embree's packet and set its far."""
    inverse = work[INVERSE * W + k]
    x, y, z = work[DX * W + k] * inverse, work[DY * W + k] * inverse, work[DZ * W + k] * inverse
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        x += _NUDGE
    elif abs(y) <= abs(z):
        y += _NUDGE
    else:
        z += _NUDGE
    f[RAY_DX * W + k], f[RAY_DY * W + k], f[RAY_DZ * W + k] = x, y, z
    f[RAY_FAR * W + k] = far / inverse * UP


@inlined
def alike(W: int, work: Any) -> bool:
    """Whether a sample of the lanes is nearly parallel and starts at nearly the same point."""
    same = True
    for k in (W // 3, 2 * W // 3, W - 1):
        along = (
            work[DX * W] * work[DX * W + k]
            + work[DY * W] * work[DY * W + k]
            + work[DZ * W] * work[DZ * W + k]
        )
        apart = (
            abs(work[OX * W] - work[OX * W + k])
            + abs(work[OY * W] - work[OY * W + k])
            + abs(work[OZ * W] - work[OZ * W + k])
        )
        same &= (along * work[INVERSE * W] * work[INVERSE * W + k] > _COHERENT) & (apart < _SPREAD)
    return same


@inlined
def trace(target: Target, W: int, rows: int, f: Any, valid: Any, together: bool, one: Any) -> None:  # noqa: FBT001
    """Trace the valid lanes of a packet, all at once or one by one."""
    if together and W > 1:
        v, p = valid.ctypes.data, f.ctypes.data
        if rows == PACKET_ROWS:
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
        if rows == PACKET_ROWS:
            intersect1(target.scene, q, target.single)
        else:
            occluded1(target.scene, q, target.single)
        for r in range(RAY_FAR, rows):
            f[r * W + k] = one[r]
