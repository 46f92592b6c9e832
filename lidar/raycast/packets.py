"""Packets of rays: gathered in float64, rounded for Embree, traced.

The layout of ``work`` (float64) and of Embree's packet ``f`` (float32) is in `lidar.raycast.rows`.
"""

from __future__ import annotations

from typing import Any

from lidar.raycast.columns import RayColumns, RayTarget
from lidar.raycast.lanes import HUGE, fill, settle, shift, shorten, spread, turn
from lidar.raycast.memory import (
    float32_at,
    float64_at,
    inline,
    int64_at,
    intersect1,
    intersect4,
    intersect8,
    intersect16,
    occluded1,
    occluded4,
    occluded8,
    occluded16,
)
from lidar.raycast.rows import DX, DY, DZ, FAR, INVERSE, OX, OY, OZ, PACKET_ROWS, RAY_FAR, TIME

VECTOR = 24
"""Bytes of a row of a column of vectors."""

NUDGE = 3e-7
"""Radians, turn of the second trace: the least that closed all leaks of a million rays aimed at vertices."""

_COHERENT = 0.985  # cosine; packets that fan out over more than 10° are faster as single rays
_SPREAD = 4.0  # metres; likewise packets whose origins lie farther apart


@inline
def first_bad(W: int, ids: Any, work: Any) -> int:
    """The first invalid ray of the lanes, or -1."""
    for k in range(W):
        x, y, z = work[DX * W + k], work[DY * W + k], work[DZ * W + k]
        squared = x * x + y * y + z * z
        size = abs(work[OX * W + k]) + abs(work[OY * W + k]) + abs(work[OZ * W + k])
        if not (0.0 < squared < HUGE and size < HUGE):
            return int(ids[k])
    return -1


@inline
def gather(
    target: RayTarget, rays: RayColumns, at: int, m: int, lanes: Any, ids: Any, work: Any, f: Any
) -> bool:
    """Load rays ``at`` to ``at + m`` of the order; spare lanes repeat the last. Whether all are valid.

    Embree's packet ``f`` gets unit directions and far rounded up.
    """
    W = len(lanes)
    directions, offsets, far = rays.directions.ctypes.data, rays.offsets.ctypes.data, rays.far.ctypes.data
    order, pose, time = rays.order.ctypes.data, rays.pose.ctypes.data, rays.time.ctypes.data
    position, matrix = rays.position.ctypes.data, rays.matrix.ctypes.data
    stride = VECTOR if rays.offsets.shape[0] > 1 else 0
    number, rows = ids.ctypes.data, work.ctypes.data
    if m == W:
        for k in range(W):
            ids[k] = at + k
    else:
        for k in range(W):
            ids[k] = at + min(k, m - 1)
    if rays.order.size:
        for k in range(W):
            ids[k] = int64_at(order, ids[k])
    if rays.pose.size:
        turn(lanes, number, directions, VECTOR, pose, position, matrix, rows)
        if rays.offsets.shape[0]:
            shift(lanes, number, offsets, stride, pose, position, matrix, rows)
    else:
        spread(lanes, number, directions, VECTOR, rows + 8 * DX * W)
        spread(lanes, number, offsets, stride, rows + 8 * OX * W)
    if rays.far.size > 1:
        for k in range(W):
            work[FAR * W + k] = float64_at(far, ids[k])
    else:
        fill(lanes, float64_at(far, 0), rows + 8 * FAR * W)
    if rays.time.size:
        for k in range(W):
            work[TIME * W + k] = float32_at(time, ids[k])
    x, y, z = target.origin[0], target.origin[1], target.origin[2]
    if settle(lanes, rows, f.ctypes.data, x, y, z, rays.near):
        return True
    return bool(shorten(lanes, rows, f.ctypes.data))


@inline
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


@inline
def trace(target: RayTarget, W: int, rows: int, f: Any, valid: Any, together: bool, one: Any) -> None:  # noqa: FBT001
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
