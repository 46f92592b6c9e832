"""Compiled loops that trace packets of rays with Embree and compute float64 ranges. All release the GIL.

Embree traces in float32 and identifies the face; the range is then computed in float64 from the plane of that
face. Embree's surfaces enclose those of float64 (`lidar.raycast.hull`). A hit near an edge is therefore
tested in float64. Where the ray passes beside the face, at grazing incidence, on the back of a face, on
patches and at sharp vertices, the first hit is found in float64 among all faces (`lidar.raycast.exact`).

In robust mode no ray passes between two faces at their shared edge, but some of the rays aimed exactly at a
vertex of Embree's surfaces do. A ray that misses is retried with a perturbed direction. Rays to retry are
buffered until they fill a packet.

Each step processes all lanes of a packet, with vector arithmetic (`lidar.raycast.lanes`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.columns import CHUNK, EXACT, FLOAT32, Packed, RayColumns, RayTarget, unpack_target
from lidar.raycast.exact import STACK, first_hit
from lidar.raycast.hull import LONG, REACH, ROUNDING
from lidar.raycast.lanes import (
    GRAZING,
    START,
    cross,
    hits,
    look_up,
    move_float64,
    move_int32,
    narrow,
    nudge,
    sole,
    unit,
)
from lidar.raycast.library import library
from lidar.raycast.memory import (
    compile_out_of_line,
    float32_aligned,
    float64_aligned,
    float64_at,
    inline,
    int32_aligned,
    int32_at,
    int64_at,
    uint32_column,
)
from lidar.raycast.packets import NUDGE, alike, first_bad, gather, trace
from lidar.raycast.planes import (
    INVALID,
    PLANE,
    face_number,
    instance_row,
    intersection,
    outside,
    plane_of,
    ray_of,
)
from lidar.raycast.rows import (
    COSINE,
    FAR,
    HIT_COPY,
    HIT_FACE,
    HIT_GEOMETRY,
    HIT_INSTANCE,
    HIT_U,
    HIT_V,
    INVERSE,
    MARGIN,
    NUMBERS,
    NX,
    NY,
    NZ,
    OFFSET,
    OX,
    OY,
    OZ,
    PACKET_RAY_ROWS,
    PACKET_ROWS,
    PART,
    RANGE,
    RAY_FAR,
    RAY_ID,
    RAY_MASK,
    RAY_NEAR,
    RAY_OX,
    RAY_OY,
    RAY_OZ,
    RAY_ROWS,
    RAY_TIME,
    SCALE,
    START_NUMBER,
    TIME,
    WORK_ROWS,
)


@inline
def _normal(out: Float, i: int, x: float, y: float, z: float) -> None:
    """Write a normal as a unit vector; zero stays zero."""
    length = np.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    out[i, 0], out[i, 1], out[i, 2] = scale * x, scale * y, scale * z


@inline
def _identify(target: RayTarget, W: int, u: Any, work: Any, faces: Any, instances: Any) -> None:
    """Write planes, faces and instances of the lanes' hits; what it writes for a miss means nothing."""
    for k in range(W):
        work[SCALE * W + k] = work[INVERSE * W + k]
    geometry, number = u.ctypes.data + 4 * HIT_GEOMETRY * W, np.int64(-1)
    if hits(target.lanes, u.ctypes.data + 4 * HIT_INSTANCE * W) == 0:
        number = sole(target.lanes, geometry)
    if number >= 0:
        # The common case, all hits on one part of the mesh: look it up once.
        part = target.parts.ctypes.data + 8 * PART * np.int64(target.rows[number])
        planes, numbers, first = int64_at(part, 0), int64_at(part, NUMBERS), int64_at(part, START_NUMBER)
        look_up(target.lanes, planes, PLANE, u.ctypes.data + 4 * HIT_FACE * W, geometry, work.ctypes.data)
        for k in range(W):
            faces[k] = first + np.int64(u[HIT_FACE * W + k])
        if numbers:
            for k in range(W):
                if u[HIT_GEOMETRY * W + k] != INVALID:
                    faces[k] = first + np.int64(int32_at(numbers, np.int64(u[HIT_FACE * W + k])))
        for k in range(W):
            instances[k] = -1
        return
    for k in range(W):
        geom, inst, prim = u[HIT_GEOMETRY * W + k], u[HIT_INSTANCE * W + k], np.int64(u[HIT_FACE * W + k])
        if geom == INVALID:
            work[NX * W + k], work[NY * W + k], work[NZ * W + k], work[OFFSET * W + k] = 0.0, 0.0, 0.0, 0.0
            faces[k], instances[k] = -1, -1
        elif inst == INVALID:
            row = np.int64(target.rows[geom])
            plane = int64_at(target.parts.ctypes.data, PART * row) + PLANE * prim
            work[NX * W + k], work[NY * W + k] = float64_at(plane, 0), float64_at(plane, 1)
            work[NZ * W + k], work[OFFSET * W + k] = float64_at(plane, 2), float64_at(plane, 3)
            work[MARGIN * W + k] = float64_at(plane, 4)
            faces[k], instances[k] = face_number(target, row, prim), -1
        else:
            row, instance = instance_row(target, geom, inst, u[HIT_COPY * W + k])
            x, y, z, d = plane_of(target, row, prim, instance, work[TIME * W + k])
            work[NX * W + k], work[NY * W + k], work[NZ * W + k], work[OFFSET * W + k] = x, y, z, d
            work[SCALE * W + k] /= np.sqrt(x * x + y * y + z * z)
            work[MARGIN * W + k] = float64_at(
                int64_at(target.parts.ctypes.data, PART * row) + PLANE * prim, 4
            )
            faces[k], instances[k] = face_number(target, row, prim), instance


@inline
def _approximate(W: int, near: float, precision: int, work: Any, f: Any) -> bool:
    """Accept Embree's hits, with Embree's ranges for float32; whether all lanes have one that is clear.

    Patches have planes without a normal, so that a hit on one is not clear.
    """
    clear = True
    for k in range(W):
        cosine = work[COSINE * W + k]
        if precision == FLOAT32 and abs(cosine) > 0.0:
            work[RANGE * W + k] = np.float64(f[RAY_FAR * W + k]) * work[INVERSE * W + k]
        t = work[RANGE * W + k]
        clear &= (abs(cosine) >= GRAZING) & (t <= work[FAR * W + k])
        clear &= not _starts(t, near, cosine, work[INVERSE * W + k])
    return clear


@inline
def _margin(ray: Any, t: float) -> float:
    """The margin (`lidar.raycast.hull.margins_of`) of the point at ray parameter t."""
    ox, oy, oz, dx, dy, dz = ray
    return float(ROUNDING * max(REACH, abs(ox + t * dx), abs(oy + t * dy), abs(oz + t * dz)))


@inline
def _starts(t: float, near: float, cosine: float, inverse: float) -> bool:
    """Whether a face lies nearer than near, or within rounding of it."""
    return not (t - near) * abs(cosine) > START * inverse


@inline
def _miss(i: int, columns: Any) -> None:
    """Write a miss of ray i."""
    ranges, faces, instances, cosines, normals = columns
    ranges[i], cosines[i], faces[i], instances[i] = np.inf, 0.0, -1, -1
    if normals.size:
        normals[i, 0], normals[i, 1], normals[i, 2] = 0.0, 0.0, 0.0


@compile_out_of_line
def _keep(
    target: RayTarget,
    row: int,
    prim: int,
    instance: int,
    ray: Any,
    inverse: float,
    time: float,
    i: int,
    columns: Any,
) -> None:
    """Write a face, or a miss if its row is -1, as the hit of ray i."""
    ranges, faces, instances, cosines, normals = columns
    if row < 0:
        _miss(i, columns)
        return
    t, cosine, x, y, z = intersection(target, row, prim, instance, ray, inverse, time)
    ranges[i], cosines[i], faces[i], instances[i] = t, cosine, face_number(target, row, prim), instance
    if normals.size:
        _normal(normals, i, x, y, z)


@inline
def _decide(
    target: RayTarget,
    rays: RayColumns,
    k: int,
    W: int,
    work: Any,
    ids: Any,
    f: Any,
    u: Any,
    stack: Any,
    columns: Any,
) -> bool:
    """Decide in float64 what lane k hits, where in doubt; write a miss. Whether it is a hit."""
    t, cosine, far = work[RANGE * W + k], work[COSINE * W + k], work[FAR * W + k]
    if u[HIT_GEOMETRY * W + k] != INVALID:
        share = min(f[HIT_U * W + k], f[HIT_V * W + k], 1.0 - f[HIT_U * W + k] - f[HIT_V * W + k])
        starts = _starts(t, rays.near, cosine, work[INVERSE * W + k])
        if rays.precision == EXACT:
            clear = share * cosine >= work[MARGIN * W + k] and cosine >= GRAZING
        else:
            clear = abs(cosine) >= GRAZING
        if starts or not clear:
            ray, inverse, time = ray_of(W, k, work), work[INVERSE * W + k], work[TIME * W + k]
            row, copy = instance_row(
                target, u[HIT_GEOMETRY * W + k], u[HIT_INSTANCE * W + k], u[HIT_COPY * W + k]
            )
            prim = np.int64(u[HIT_FACE * W + k])
            trusted = cosine >= GRAZING and not starts
            if not work[MARGIN * W + k] < np.inf:
                before = (t / inverse - f[RAY_FAR * W + k]) * cosine
                trusted &= copy < 0 and before <= LONG * _margin(ray, t)
            if not trusted or outside(target, row, prim, copy, ray, time) > 0.0:
                row, prim, copy = first_hit(target, rays.near, far, rays.mask, ray, time, stack)
                _keep(target, row, prim, copy, ray, inverse, time, ids[k], columns)
                return True
        if t <= far:
            return True
    _miss(ids[k], columns)
    return False


@inline
def _again(
    target: RayTarget,
    rays: RayColumns,
    m: int,
    work: Any,
    ids: Any,
    f: Any,
    valid: Any,
    one: Any,
    stack: Any,
    columns: Any,
) -> None:
    """Trace the first m rays of a packet, which hit nothing, with perturbed directions.

    Embree finds whether there is a hit; float64 decides what is hit.
    """
    W = len(target.lanes)
    nudge(target.lanes, work.ctypes.data, f.ctypes.data, NUDGE)
    for k in range(m, W):
        valid[k] = 0
    trace(target, W, PACKET_RAY_ROWS, f, valid, alike(W, work), one)
    for k in range(m, W):
        valid[k] = -1
    for k in range(m):
        if f[RAY_FAR * W + k] < 0:
            ray, inverse, time = ray_of(W, k, work), work[INVERSE * W + k], work[TIME * W + k]
            row, prim, copy = first_hit(target, rays.near, work[FAR * W + k], rays.mask, ray, time, stack)
            _keep(target, row, prim, copy, ray, inverse, time, ids[k], columns)


@njit(nogil=True, cache=True, error_model="numpy", needs=library)
def cast(
    given: Packed,
    rays: RayColumns,
    lo: int,
    hi: int,
    ranges: Float,
    faces: NDArray[np.int32],
    instances: NDArray[np.int32],
    cosines: NDArray[np.float32],
    normals: Float,
) -> Any:
    """Cast rays lo to hi of the order into the columns of `Hits`; returns the first invalid ray, or -1.

    No normals are written if ``normals`` is empty. Packets are consecutive from lo.
    """
    target = unpack_target(given)
    W = len(target.lanes)
    f = float32_aligned(PACKET_ROWS * W)
    u = uint32_column(f.ctypes.data, (len(f),))
    one, valid = float32_aligned(32), int32_aligned(W)
    work, ids = float64_aligned(WORK_ROWS * W), np.zeros(W, np.int64)
    face, instance = int32_aligned(W), int32_aligned(W)
    stack = np.zeros(STACK, np.int64)
    late, doubtful, waiting = np.zeros(2 * RAY_ROWS * W), np.zeros(2 * W, np.int64), 0
    columns = ranges, faces, instances, cosines, normals
    whole, geometry = (1 << W) - 1, u.ctypes.data + 4 * HIT_GEOMETRY * W
    for k in range(W):
        u[RAY_MASK * W + k] = rays.mask
        u[RAY_ID * W + k] = k
        valid[k] = -1
    for at in range(lo, hi, W):
        m = min(W, hi - at)
        if not gather(target, rays, at, m, target.lanes, ids, work, f):
            return first_bad(W, ids, work)
        for k in range(W):
            u[HIT_GEOMETRY * W + k] = INVALID
            u[HIT_INSTANCE * W + k] = INVALID
        for k in range(m, W):
            valid[k] = 0
        trace(target, W, PACKET_ROWS, f, valid, alike(W, work), one)
        struck = hits(target.lanes, geometry)
        if struck == 0:
            for k in range(m):
                _miss(ids[k], columns)
            if rays.retrace:
                _again(target, rays, m, work, ids, f, valid, one, stack, columns)
        else:
            _identify(target, W, u, work, face, instance)
            settled = cross(target.lanes, work.ctypes.data, f.ctypes.data, rays.near)
            if rays.precision != EXACT:
                settled = _approximate(W, rays.near, rays.precision, work, f)
            if m == W and not rays.order.size:
                exact = work.ctypes.data + 8 * RANGE * W
                move_float64(target.lanes, exact, ranges.ctypes.data + 8 * at)
                narrow(target.lanes, exact + 8 * W, cosines.ctypes.data + 4 * at)
                move_int32(target.lanes, face.ctypes.data, faces.ctypes.data + 4 * at)
                move_int32(target.lanes, instance.ctypes.data, instances.ctypes.data + 4 * at)
            else:
                for k in range(m):
                    i = ids[k]
                    ranges[i], cosines[i] = work[RANGE * W + k], work[COSINE * W + k]
                    faces[i], instances[i] = face[k], instance[k]
            if normals.size:
                unit(target.lanes, work.ctypes.data)
                for k in range(m):
                    i = ids[k]
                    normals[i, 0], normals[i, 1] = work[NX * W + k], work[NY * W + k]
                    normals[i, 2] = work[NZ * W + k]
            for k in range(0 if settled and struck == whole else m):
                if _decide(target, rays, k, W, work, ids, f, u, stack, columns) or not rays.retrace:
                    continue
                for r in range(RAY_ROWS):
                    late[r * 2 * W + waiting] = work[r * W + k]
                doubtful[waiting] = ids[k]
                waiting += 1
        # The buffer is emptied at the end of each chunk, so that the number of threads changes no packet.
        last = hi - at <= W or (at - lo + W) % CHUNK == 0
        while waiting >= W or (last and waiting > 0):
            n = min(W, waiting)
            for k in range(W):
                for r in range(RAY_ROWS):
                    work[r * W + k] = late[r * 2 * W + min(k, n - 1)]
                ids[k] = doubtful[min(k, n - 1)]
            for k in range(W):
                f[RAY_OX * W + k] = work[OX * W + k]
                f[RAY_OY * W + k] = work[OY * W + k]
                f[RAY_OZ * W + k] = work[OZ * W + k]
                f[RAY_NEAR * W + k] = rays.near / work[INVERSE * W + k]
                f[RAY_TIME * W + k] = work[TIME * W + k]
            _again(target, rays, n, work, ids, f, valid, one, stack, columns)
            for k in range(W):
                doubtful[k] = doubtful[W + k]
                for r in range(RAY_ROWS):
                    late[r * 2 * W + k] = late[r * 2 * W + W + k]
            waiting -= n
    return -1


@njit(nogil=True, cache=True, error_model="numpy")
def cast_float64(
    given: Packed,
    rays: RayColumns,
    lo: int,
    hi: int,
    ranges: Float,
    faces: NDArray[np.int32],
    instances: NDArray[np.int32],
    cosines: NDArray[np.float32],
    normals: Float,
) -> Any:
    """The same as `cast`, entirely in float64, without Embree."""
    target = unpack_target(given)
    work, ids, stack = np.zeros(WORK_ROWS), np.zeros(1, np.int64), np.zeros(STACK, np.int64)
    f = np.zeros(PACKET_ROWS, np.float32)
    for at in range(lo, hi):
        if not gather(target, rays, at, 1, target.lanes, ids, work, f):
            return first_bad(1, ids, work)
        ray, inverse, time = ray_of(1, 0, work), work[INVERSE], work[TIME]
        row, prim, copy = first_hit(target, rays.near, work[FAR], rays.mask, ray, time, stack)
        columns = ranges, faces, instances, cosines, normals
        _keep(target, row, prim, copy, ray, inverse, time, ids[0], columns)
    return -1


@njit(nogil=True, cache=True, error_model="numpy", needs=library)
def find_occluded(given: Packed, rays: RayColumns, lo: int, hi: int, out: NDArray[np.bool_]) -> Any:
    """Write whether rays lo to hi hit anything; returns the first invalid ray, or -1."""
    target = unpack_target(given)
    W = len(target.lanes)
    f = float32_aligned(PACKET_RAY_ROWS * W)
    u = uint32_column(f.ctypes.data, (len(f),))
    one, valid = float32_aligned(16), int32_aligned(W)
    work, ids = np.zeros(RAY_ROWS * W), np.zeros(W, np.int64)
    for k in range(W):
        u[RAY_MASK * W + k] = rays.mask
        u[RAY_ID * W + k] = k
    for at in range(lo, hi, W):
        m = min(W, hi - at)
        if not gather(target, rays, at, m, target.lanes, ids, work, f):
            return first_bad(W, ids, work)
        for k in range(W):
            valid[k] = -1 if k < m else 0
        together = alike(W, work)
        trace(target, W, PACKET_RAY_ROWS, f, valid, together, one)
        doubtful = False
        for k in range(m):
            hit = f[RAY_FAR * W + k] < 0
            out[ids[k]] = hit
            valid[k] = 0 if hit else -1
            doubtful |= not hit
        if not (doubtful and rays.retrace):
            continue
        nudge(target.lanes, work.ctypes.data, f.ctypes.data, NUDGE)
        trace(target, W, PACKET_RAY_ROWS, f, valid, together, one)
        for k in range(W):
            if valid[k]:
                out[ids[k]] = f[RAY_FAR * W + k] < 0
    return -1
