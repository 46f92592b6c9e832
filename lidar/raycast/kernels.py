"""Compiled loops between the caller's rays and Embree: packets out, float64 ranges back. All release the GIL.

Embree traces in float32; a hit tells which face was met, and the range is computed again in float64 from that
face's plane. In robust mode no ray passes between two faces at their shared edge, but about 0.3 % of the rays
aimed exactly at a vertex do. Such a ray misses, or meets the back of a face: it is traced once more with its
direction turned by `_NUDGE`, and a nearer front face counts. Such rays wait until they fill a packet.

Work on a packet goes step by step over all its lanes, arithmetic on all at once (`lidar.raycast.lanes`).
Rows of numbers, one a lane, lie end to end in ``work``. Of the ray: origin (0 to 2), direction (3 to 5), one
over its length (6), far (7), time (8). Of what it met: the plane's normal and offset (9 to 12), the scale of
the cosine (13), range (14) and cosine (15).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lidar.raycast.columns import CHUNK, COPIES, Rays, Target
from lidar.raycast.lanes import GRAZING, HUGE, cross, move_float64, move_int32, narrow, settle
from lidar.raycast.memory import (
    aligned,
    called,
    float32_at,
    float64_at,
    inlined,
    int32_at,
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

Float = NDArray[np.float64]

_INVALID = np.uint32(0xFFFFFFFF)
_NUDGE = 3e-7  # radians; the smallest that closed every leak among a million rays aimed at vertices
_COHERENT = 0.985  # cosine; packets that fan out over more than 10° are faster as single rays
_SPREAD = 4.0  # metres; so are packets whose origins lie farther apart
_UP = 1.0 + 2.0**-23  # what lifts a float64 above the float32 it is rounded to
_RAY, _ROWS = 12, 21  # 32-bit rows of RTCRayN and RTCRayHitN


@inlined
def _vector(address: int, row: int) -> Any:
    """Three numbers of a row of an (n, 3) float64 column."""
    place = address + 24 * row
    return float64_at(place, 0), float64_at(place, 1), float64_at(place, 2)


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
            x, y, z = _vector(directions, ids[k])
            work[3 * W + k], work[4 * W + k], work[5 * W + k] = _posed(pose, p, x, y, z)
            work[k], work[W + k], work[2 * W + k] = _vector(pose[0], p)
        if shifted:
            for k in range(W):
                x, y, z = _vector(offsets, step * ids[k])
                x, y, z = _posed(pose, int64_at(pose_of, ids[k]), x, y, z)
                work[k] += x
                work[W + k] += y
                work[2 * W + k] += z
    else:
        for k in range(W):
            work[3 * W + k], work[4 * W + k], work[5 * W + k] = _vector(directions, ids[k])
            work[k], work[W + k], work[2 * W + k] = _vector(offsets, step * ids[k])
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
def _alike(W: int, work: Any) -> bool:
    """Whether a sample of the lanes goes the same way from about the same place: a scan, not a shuffle."""
    same = True
    for k in (W // 3, 2 * W // 3, W - 1):
        along = work[3 * W] * work[3 * W + k] + work[4 * W] * work[4 * W + k] + work[5 * W] * work[5 * W + k]
        apart = abs(work[0] - work[k]) + abs(work[W] - work[W + k]) + abs(work[2 * W] - work[2 * W + k])
        same &= (along * work[6 * W] * work[6 * W + k] > _COHERENT) & (apart < _SPREAD)
    return same


@inlined
def _trace(target: Target, W: int, rows: int, f: Any, valid: Any, together: bool, one: Any) -> None:  # noqa: FBT001
    """Trace the valid lanes of a packet, all at once or one by one."""
    if together and W > 1:
        v, p = valid.ctypes.data, f.ctypes.data
        if rows == _ROWS:
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
        if rows == _ROWS:
            intersect1(target.scene, q, target.single)
        else:
            occluded1(target.scene, q, target.single)
        for r in range(8, rows):
            f[r * W + k] = one[r]


@inlined
def transform_of(target: Target, instance: int, time: float) -> Any:
    """The transform of an instance at a ray time: twelve numbers, row by row."""
    M = target.transforms.ctypes.data + 96 * target.first[instance]
    steps = target.steps[instance]
    w = 0.0
    if steps > 1:
        place = min(max(time, 0.0), 1.0) * (steps - 1)
        step = min(int(place), steps - 2)
        M += 96 * step
        w = place - step
    N = M + 96 if w > 0.0 else M
    return (
        float64_at(M, 0) + w * (float64_at(N, 0) - float64_at(M, 0)),
        float64_at(M, 1) + w * (float64_at(N, 1) - float64_at(M, 1)),
        float64_at(M, 2) + w * (float64_at(N, 2) - float64_at(M, 2)),
        float64_at(M, 3) + w * (float64_at(N, 3) - float64_at(M, 3)),
        float64_at(M, 4) + w * (float64_at(N, 4) - float64_at(M, 4)),
        float64_at(M, 5) + w * (float64_at(N, 5) - float64_at(M, 5)),
        float64_at(M, 6) + w * (float64_at(N, 6) - float64_at(M, 6)),
        float64_at(M, 7) + w * (float64_at(N, 7) - float64_at(M, 7)),
        float64_at(M, 8) + w * (float64_at(N, 8) - float64_at(M, 8)),
        float64_at(M, 9) + w * (float64_at(N, 9) - float64_at(M, 9)),
        float64_at(M, 10) + w * (float64_at(N, 10) - float64_at(M, 10)),
        float64_at(M, 11) + w * (float64_at(N, 11) - float64_at(M, 11)),
    )


@inlined
def placed(target: Target, geom: Any, inst: Any, place: Any) -> Any:
    """Row of ``parts`` and instance of what Embree names by geometry, instance geometry and place in it."""
    if inst == _INVALID:
        return np.int64(target.rows[np.int64(geom)]), np.int64(-1)
    instance = np.int64(target.numbers[target.starts[np.int64(inst)] + np.int64(place)])
    return np.int64(target.shape[instance]) + np.int64(geom) - COPIES, instance


@inlined
def numbered(target: Target, row: int, prim: int) -> Any:
    """The number of a face."""
    part = target.parts.ctypes.data + 40 * row
    numbers = int64_at(part, 3)
    return int64_at(part, 4) + (prim if numbers == 0 else np.int64(int32_at(numbers, prim)))


@inlined
def plane_of(target: Target, row: int, prim: int, instance: int, time: float) -> Any:
    """A face's plane in the caster's axes: normal (a unit vector for the own mesh) and offset."""
    plane = int64_at(target.parts.ctypes.data, 5 * row) + 32 * prim
    nx, ny, nz, d = float64_at(plane, 0), float64_at(plane, 1), float64_at(plane, 2), float64_at(plane, 3)
    if instance < 0:
        return nx, ny, nz, d
    a, b, c, x, e, f, g, y, h, i, j, z = transform_of(target, instance, time)
    # Normals turn with the cofactors; a point of the plane is its offset times its unit normal.
    mx = (f * j - g * i) * nx + (g * h - e * j) * ny + (e * i - f * h) * nz
    my = (c * i - b * j) * nx + (a * j - c * h) * ny + (b * h - a * i) * nz
    mz = (b * g - c * f) * nx + (c * e - a * g) * ny + (a * f - b * e) * nz
    px, py, pz = d * nx, d * ny, d * nz
    offset = (
        mx * (a * px + b * py + c * pz + x)
        + my * (e * px + f * py + g * pz + y)
        + mz * (h * px + i * py + j * pz + z)
    )
    return mx, my, mz, offset


@called
def _extent(target: Target, row: int, prim: int, instance: int, ray: Any, time: float) -> Any:
    """Least and greatest ray parameter of a face's corners, measured along the ray."""
    ox, oy, oz, dx, dy, dz = ray
    vertices, faces = target.parts[row, 1], target.parts[row, 2]
    low, high = np.inf, -np.inf
    for k in range(3):
        x, y, z = _vector(vertices, np.int64(int32_at(faces, 3 * prim + k)))
        if instance >= 0:
            M = transform_of(target, instance, time)
            x, y, z = (
                M[0] * x + M[1] * y + M[2] * z + M[3],
                M[4] * x + M[5] * y + M[6] * z + M[7],
                M[8] * x + M[9] * y + M[10] * z + M[11],
            )
        t = ((x - ox) * dx + (y - oy) * dy + (z - oz) * dz) / (dx * dx + dy * dy + dz * dz)
        low, high = min(low, t), max(high, t)
    return low, high


@inlined
def meet(target: Target, W: int, k: int, row: int, prim: int, instance: int, work: Any) -> Any:
    """Range, cosine and normal (not unit), in float64, where lane k's ray meets the plane of a face."""
    ox, oy, oz, dx, dy, dz = (
        work[k],
        work[W + k],
        work[2 * W + k],
        work[3 * W + k],
        work[4 * W + k],
        work[5 * W + k],
    )
    nx, ny, nz, d = plane_of(target, row, prim, instance, work[8 * W + k])
    along = nx * dx + ny * dy + nz * dz
    t = (d - nx * ox - ny * oy - nz * oz) / along
    cosine = -along * work[6 * W + k]
    if instance >= 0:
        cosine /= np.sqrt(nx * nx + ny * ny + nz * nz)
    if not abs(cosine) >= GRAZING:
        low, high = _extent(target, row, prim, instance, (ox, oy, oz, dx, dy, dz), work[8 * W + k])
        t = high if t > high else low if not t >= low else t
        cosine = cosine if cosine == cosine else 0.0  # noqa: PLR0124
    return t, cosine, nx, ny, nz


@inlined
def _normal(out: Float, i: int, x: float, y: float, z: float) -> None:
    """Write a normal as a unit vector; zero stays zero."""
    length = np.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    out[i, 0], out[i, 1], out[i, 2] = scale * x, scale * y, scale * z


@inlined
def _name(target: Target, W: int, u: Any, work: Any, faces: Any, instances: Any) -> None:
    """Planes and numbers of what lanes met; a lane that met nothing has a plane without a normal."""
    for k in range(W):
        geom, inst, prim = u[18 * W + k], u[19 * W + k], np.int64(u[17 * W + k])
        work[13 * W + k] = work[6 * W + k]
        if geom == _INVALID:
            work[9 * W + k], work[10 * W + k], work[11 * W + k], work[12 * W + k] = 0.0, 0.0, 0.0, 0.0
            faces[k], instances[k] = -1, -1
        elif inst == _INVALID:
            row = np.int64(target.rows[geom])
            plane = int64_at(target.parts.ctypes.data, 5 * row) + 32 * prim
            work[9 * W + k], work[10 * W + k] = float64_at(plane, 0), float64_at(plane, 1)
            work[11 * W + k], work[12 * W + k] = float64_at(plane, 2), float64_at(plane, 3)
            faces[k], instances[k] = numbered(target, row, prim), -1
        else:
            row, instance = placed(target, geom, inst, u[20 * W + k])
            x, y, z, d = plane_of(target, row, prim, instance, work[8 * W + k])
            work[9 * W + k], work[10 * W + k], work[11 * W + k], work[12 * W + k] = x, y, z, d
            work[13 * W + k] /= np.sqrt(x * x + y * y + z * z)
            faces[k], instances[k] = numbered(target, row, prim), instance


@inlined
def _second(
    target: Target,
    near: float,
    m: int,
    work: Any,
    ids: Any,
    f: Any,
    valid: Any,
    one: Any,
    ranges: Any,
    faces: Any,
    instances: Any,
    cosines: Any,
    normals: Any,
) -> None:
    """Trace m rays once more, turned a little, and keep what they meet if it is nearer."""
    W = len(target.lanes)
    u = f.view(np.uint32)
    for k in range(W):
        f[k], f[W + k], f[2 * W + k] = work[k], work[W + k], work[2 * W + k]
        f[3 * W + k], f[7 * W + k] = near / work[6 * W + k], work[8 * W + k]
        nudge(W, k, work, f, min(work[7 * W + k], ranges[ids[k]]))
        valid[k] = -1 if k < m else 0
        u[18 * W + k] = _INVALID
        u[19 * W + k] = _INVALID
    _trace(target, W, _ROWS, f, valid, _alike(W, work), one)
    for k in range(m):
        if u[18 * W + k] == _INVALID:
            continue
        i = ids[k]
        row, instance = placed(target, u[18 * W + k], u[19 * W + k], u[20 * W + k])
        prim = np.int64(u[17 * W + k])
        t, cosine, x, y, z = meet(target, W, k, row, prim, instance, work)
        if t <= work[7 * W + k] and t < ranges[i] and (faces[i] < 0 or cosine > 0.0):
            ranges[i], cosines[i] = t, cosine
            faces[i], instances[i] = numbered(target, row, prim), instance
            if normals.size:
                _normal(normals, i, x, y, z)
    for k in range(W):
        valid[k] = -1


@njit(nogil=True, cache=True, error_model="numpy")
def cast(
    target: Target,
    rays: Rays,
    lo: int,
    hi: int,
    ranges: Float,
    faces: NDArray[np.int32],
    instances: NDArray[np.int32],
    cosines: NDArray[np.float32],
    normals: Float,
) -> Any:
    """Cast the rays lo to hi of the order into the columns of `Hits`; the first bad ray's number, or -1.

    No normals are written if ``normals`` is empty. Packets start at lo and every width from it.
    """
    W = len(target.lanes)
    packet = aligned(4 * _ROWS * W)
    f, u = packet.view(np.float32), packet.view(np.uint32)
    one, valid = aligned(128).view(np.float32), aligned(4 * W).view(np.int32)
    work, ids = aligned(8 * 16 * W).view(np.float64), np.zeros(W, np.int64)
    face, instance = aligned(4 * W).view(np.int32), aligned(4 * W).view(np.int32)
    late, doubtful, waiting = np.zeros(18 * W), np.zeros(2 * W, np.int64), 0
    for k in range(W):
        u[9 * W + k] = rays.mask
        u[10 * W + k] = k
        valid[k] = -1
    for at in range(lo, hi, W):
        m = min(W, hi - at)
        if not gather(target, rays, at, m, target.lanes, ids, work, f):
            return first_bad(W, ids, work)
        for k in range(W):
            u[18 * W + k] = _INVALID
            u[19 * W + k] = _INVALID
        for k in range(m, W):
            valid[k] = 0
        _trace(target, W, _ROWS, f, valid, _alike(W, work), one)
        _name(target, W, u, work, face, instance)
        settled = cross(target.lanes, work.ctypes.data)
        if m == W and not rays.order.size:
            exact = work.ctypes.data + 8 * 14 * W
            move_float64(target.lanes, exact, ranges.ctypes.data + 8 * at)
            narrow(target.lanes, exact + 8 * W, cosines.ctypes.data + 4 * at)
            move_int32(target.lanes, face.ctypes.data, faces.ctypes.data + 4 * at)
            move_int32(target.lanes, instance.ctypes.data, instances.ctypes.data + 4 * at)
        else:
            for k in range(m):
                i = ids[k]
                ranges[i], cosines[i] = work[14 * W + k], work[15 * W + k]
                faces[i], instances[i] = face[k], instance[k]
        if normals.size:
            for k in range(m):
                _normal(normals, ids[k], work[9 * W + k], work[10 * W + k], work[11 * W + k])
        for k in range(0 if settled else m):
            i = ids[k]
            met = u[18 * W + k] != _INVALID
            if met and not abs(work[15 * W + k]) >= GRAZING:
                row, copy = placed(target, u[18 * W + k], u[19 * W + k], u[20 * W + k])
                prim = np.int64(u[17 * W + k])
                ranges[i], cosines[i], _, _, _ = meet(target, W, k, row, prim, copy, work)
            if not (met and ranges[i] <= work[7 * W + k]):
                ranges[i], cosines[i], faces[i], instances[i] = np.inf, 0.0, -1, -1
                if normals.size:
                    _normal(normals, i, 0.0, 0.0, 0.0)
            elif cosines[i] >= 0.0:
                continue
            for r in range(9):
                late[r * 2 * W + waiting] = work[r * W + k]
            doubtful[waiting] = i
            waiting += 1
        # Threads take chunks: at the end of each, nothing waits, so that their number changes no packet.
        last = hi - at <= W or (at - lo + W) % CHUNK == 0
        while waiting >= W or (last and waiting > 0):
            n = min(W, waiting)
            for k in range(W):
                for r in range(9):
                    work[r * W + k] = late[r * 2 * W + min(k, n - 1)]
                ids[k] = doubtful[min(k, n - 1)]
            _second(
                target, rays.near, n, work, ids, f, valid, one, ranges, faces, instances, cosines, normals
            )
            for k in range(W):
                doubtful[k] = doubtful[W + k]
                for r in range(9):
                    late[r * 2 * W + k] = late[r * 2 * W + W + k]
            waiting -= n
    return -1


@njit(nogil=True, cache=True, error_model="numpy")
def occluded(target: Target, rays: Rays, lo: int, hi: int, out: NDArray[np.bool_]) -> Any:
    """Fill in whether anything lies on the rays lo to hi; the first bad ray's number, or -1."""
    W = len(target.lanes)
    packet = aligned(4 * _RAY * W)
    f, u = packet.view(np.float32), packet.view(np.uint32)
    one, valid = aligned(64).view(np.float32), aligned(4 * W).view(np.int32)
    work, ids = np.zeros(9 * W), np.zeros(W, np.int64)
    for k in range(W):
        u[9 * W + k] = rays.mask
        u[10 * W + k] = k
    for at in range(lo, hi, W):
        m = min(W, hi - at)
        if not gather(target, rays, at, m, target.lanes, ids, work, f):
            return first_bad(W, ids, work)
        for k in range(W):
            valid[k] = -1 if k < m else 0
        together = _alike(W, work)
        _trace(target, W, _RAY, f, valid, together, one)
        doubtful = False
        for k in range(m):
            met = f[8 * W + k] < 0
            out[ids[k]] = met
            valid[k] = 0 if met else -1
            doubtful |= not met
        if not doubtful:
            continue
        for k in range(W):
            if valid[k]:
                nudge(W, k, work, f, work[7 * W + k])
        _trace(target, W, _RAY, f, valid, together, one)
        for k in range(W):
            if valid[k]:
                out[ids[k]] = f[8 * W + k] < 0
    return -1
