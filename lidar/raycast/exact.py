"""The first hit of a ray in float64, found in trees of all parts and instances."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar.geometry.box_tree import DEPTH, FIRST, LEAF, NODE, RIGHT
from lidar.raycast.columns import RayTarget
from lidar.raycast.lanes import GRAZING, START
from lidar.raycast.memory import (
    compile_out_of_line,
    float32_at,
    float64_at,
    inline,
    int32_at,
    int64_at,
    vector,
)
from lidar.raycast.planes import PLANE, beside, transform_of
from lidar.raycast.rows import CORNERS, COUNT, MASK, NODES, ORDER, PART, PLANES, VERTICES

STACK = 2 * DEPTH
"""Numbers of the array ``stack`` that `first_hit` needs."""


@inline
def _slopes(ray: Any) -> Any:
    """A ray's origin and the inverse of its direction, huge where that is zero."""
    ox, oy, oz, dx, dy, dz = ray
    return (
        ox,
        oy,
        oz,
        1.0 / dx if abs(dx) > 1e-100 else 1e100,
        1.0 / dy if abs(dy) > 1e-100 else 1e100,
        1.0 / dz if abs(dz) > 1e-100 else 1e100,
    )


@inline
def _enters(node: int, slopes: Any, near: float, far: float) -> float:
    """The ray parameter at which a ray enters the box of a node; inf if it does not."""
    ox, oy, oz, ix, iy, iz = slopes
    a, b = (float32_at(node, 0) - ox) * ix, (float32_at(node, 3) - ox) * ix
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (float32_at(node, 1) - oy) * iy, (float32_at(node, 4) - oy) * iy
    near, far = max(near, min(a, b)), min(far, max(a, b))
    a, b = (float32_at(node, 2) - oz) * iz, (float32_at(node, 5) - oz) * iz
    near, far = max(near, min(a, b)), min(far, max(a, b))
    return near if near <= far else np.inf


@compile_out_of_line
def _next_leaf(nodes: int, slopes: Any, near: float, far: float, stack: Any, bottom: int, top: int) -> Any:
    """The first item of the next leaf that a ray enters before ``far``, or -1, and the stack's new top."""
    while top > bottom:
        top -= 1
        node = stack[top]
        if not _enters(nodes + NODE * node, slopes, near, far) < np.inf:
            continue
        while True:
            place = nodes + NODE * node
            right = np.int64(int32_at(place, RIGHT))
            if right == 0:
                return np.int64(int32_at(place, FIRST)), top
            one = _enters(place + NODE, slopes, near, far)
            two = _enters(nodes + NODE * right, slopes, near, far)
            if not min(one, two) < np.inf:
                break
            stack[top] = right if one <= two else node + 1
            top += max(one, two) < np.inf
            node = node + 1 if one <= two else right
    return np.int64(-1), top


@compile_out_of_line
def _within(target: RayTarget, instance: int, ray: Any, time: float) -> Any:
    """A ray in the frame of an instance."""
    ox, oy, oz, dx, dy, dz = ray
    a, b, c, x, e, f, g, y, h, i, j, z = transform_of(target, instance, time)
    ux, uy, uz = f * j - g * i, g * h - e * j, e * i - f * h
    vx, vy, vz = c * i - b * j, a * j - c * h, b * h - a * i
    wx, wy, wz = b * g - c * f, c * e - a * g, a * f - b * e
    scale = 1.0 / (a * ux + b * uy + c * uz)
    ox, oy, oz = (ox - x) * scale, (oy - y) * scale, (oz - z) * scale
    dx, dy, dz = dx * scale, dy * scale, dz * scale
    return (
        ux * ox + vx * oy + wx * oz,
        uy * ox + vy * oy + wy * oz,
        uz * ox + vz * oy + wz * oz,
        ux * dx + vx * dy + wx * dz,
        uy * dx + vy * dy + wy * dz,
        uz * dx + vz * dy + wz * dz,
    )


@inline
def _relative(part: int, corner: int, ray: Any) -> Any:
    """A corner of a part's faces, relative to the origin of a ray."""
    x, y, z = vector(int64_at(part, VERTICES), np.int64(int32_at(int64_at(part, CORNERS), corner)))
    return x - ray[0], y - ray[1], z - ray[2]


@compile_out_of_line
def _range(part: int, prim: int, ray: Any, near: float, far: float) -> Any:
    """The ray parameter at which a ray hits a face after near, not at its start, and before far; else inf."""
    ox, oy, oz, dx, dy, dz = ray
    plane = int64_at(part, PLANES) + PLANE * prim
    nx, ny, nz = float64_at(plane, 0), float64_at(plane, 1), float64_at(plane, 2)
    along = nx * dx + ny * dy + nz * dz
    height = float64_at(plane, 3) - nx * ox - ny * oy - nz * oz
    squared = dx * dx + dy * dy + dz * dz
    grazing = along * along < GRAZING * GRAZING * squared
    t = height / along
    if not grazing and not (t < far and (t - near) * abs(along) > START):
        return np.inf
    a, b, c = (
        _relative(part, 3 * prim, ray),
        _relative(part, 3 * prim + 1, ray),
        _relative(part, 3 * prim + 2, ray),
    )
    if (nx == 0.0 and ny == 0.0 and nz == 0.0) or beside(ray, a, b, c) > 0.0:
        return np.inf
    if grazing:
        low, high = np.inf, -np.inf
        for x, y, z in (a, b, c):
            place = (x * dx + y * dy + z * dz) / squared
            low, high = min(low, place), max(high, place)
        t = high if t > high else low if not t >= low else t
        if not (t < far and (t - near) * abs(along) > START):
            return np.inf
    return t


@compile_out_of_line
def _first_of_part(part: int, ray: Any, slopes: Any, near: float, far: float, stack: Any) -> Any:
    """The first face of a part that a ray hits before ``far``, or -1, and its ray parameter.

    part : address of the row of ``parts``
    """
    nodes, order, count = int64_at(part, NODES), int64_at(part, ORDER), int64_at(part, COUNT)
    best, top = np.int64(-1), DEPTH
    if count:
        stack[top] = 0
        top += 1
    while True:
        first, top = _next_leaf(nodes, slopes, near, far, stack, DEPTH, top)
        if first < 0:
            return best, far
        for k in range(first, min(first + LEAF, count)):
            prim = np.int64(int32_at(order, k))
            t = _range(part, prim, ray, near, far)
            if t < far:
                best, far = prim, t


@compile_out_of_line
def first_hit(
    target: RayTarget, near: float, far: float, mask: int, ray: Any, time: float, stack: Any
) -> Any:
    """The first face that a ray hits: row of ``parts``, number in it, instance; row -1 for a miss.

    stack : (`STACK`,) int64, overwritten
    """
    best: Any = (np.int64(-1), np.int64(-1), np.int64(-1))
    parts, slopes = target.parts.ctypes.data, _slopes(ray)
    far *= 1.0 + 1e-15  # hits at far count
    for group in range(len(target.groups)):
        nodes, order, count, start = target.groups[group]
        top = np.int64(0)
        if count:
            stack[top] = 0
            top += 1
        while True:
            first, top = _next_leaf(nodes, slopes, near, far, stack, 0, top)
            if first < 0:
                break
            for k in range(first, min(first + LEAF, count)):
                item = np.int64(int32_at(order, k))
                row, last, instance, local = item, item + 1, np.int64(-1), ray
                if start >= 0:
                    instance = start + item
                    if not np.int64(target.masks[instance]) & mask:
                        continue
                    local = _within(target, instance, ray, time)
                    row = np.int64(target.shape[instance])
                    last = row + np.int64(target.sizes[instance])
                for one in range(row, last):
                    part = parts + 8 * PART * one
                    if int64_at(part, MASK) & mask:
                        prim, far = _first_of_part(part, local, _slopes(local), near, far, stack)
                        if prim >= 0:
                            best = (one, prim, instance)
    return best
