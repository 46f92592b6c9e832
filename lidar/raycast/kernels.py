"""Compiled loops between the caller's rays and Embree: packets out, float64 ranges back. All release the GIL.

Embree traces in float32; a hit tells which face was met, and the range is computed again in float64 from that
face's plane. In robust mode no ray passes between two faces at their shared edge, but about 0.3 % of the rays
aimed exactly at a vertex do. Such a ray misses, or meets the back of a face: it is traced once more with its
direction turned by `_NUDGE`, and a nearer front face counts.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

Float = NDArray[np.float64]

_INVALID = np.uint32(0xFFFFFFFF)
_NUDGE = 3e-7  # radians; the smallest that closed every leak among a million rays aimed at vertices
_COHERENT = 0.985  # cosine; packets that fan out over more than 10° are faster as single rays
_SPREAD = 4.0  # metres; so are packets whose origins lie farther apart
_UNIT = 1e-12  # how far the squared length of a unit vector may be from 1
_GRAZING = 1e-3  # cosine below which a range is held within the face's extent along the ray
_RAY, _ROWS = 12, 21  # 32-bit rows of RTCRayN and RTCRayHitN


class Target(NamedTuple):
    """What rays are cast at.

    scene, packet, single : addresses of the Embree scene and of the arguments for packets and for single rays
    lanes      : as many zeros as rays in a packet: its length is a constant to the compiler
    origin     : (3,) float64, subtracted from scene coordinates
    parts      : (p, 5) int64, addresses of a geometry's planes, vertices, faces and face numbers (0: they
                 count up) and the first number
    rows       : (g,) int32, row of ``parts`` of Embree's geometry g, if it is one of triangles
    starts     : (g,) int64, start in ``numbers`` of Embree's geometry g, if it is one of instances
    numbers    : (k,) int32, instance numbers in Embree's order
    shape      : (k,) int32, first row of ``parts`` of the instance's shape
    first      : (k,) int64, first row of ``transforms``
    steps      : (k,) int64, rows of ``transforms``; 1 for an instance at rest
    transforms : (r, 12) float64, caster from instance, each relative to its own origin
    """

    scene: int
    packet: int
    single: int
    lanes: tuple[int, ...]
    origin: Float
    parts: NDArray[np.int64]
    rows: NDArray[np.int32]
    starts: NDArray[np.int64]
    numbers: NDArray[np.int32]
    shape: NDArray[np.int32]
    first: NDArray[np.int64]
    steps: NDArray[np.int64]
    transforms: Float


class Rays(NamedTuple):
    """Rays as columns.

    directions : (n, 3) float64, in the pose's axes where there are poses
    offsets    : (n, 3) float64, origins in the pose's frame; (1, 3) serves all
    pose       : (n,) int64, row of the poses; empty: directions and offsets are in the caster's frame
    position, rotation, scale : the poses (see `lidar.poses.Poses`)
    order      : (n,) int64, order of work; empty: as they come
    time       : (n,) float32, ray times; empty: all 0
    near       : ray parameter
    far        : (n,) float64, ray parameter; (1,) serves all
    mask       : bits
    """

    directions: Float
    offsets: Float
    pose: NDArray[np.int64]
    position: Float
    rotation: Float
    scale: Float
    order: NDArray[np.int64]
    time: NDArray[np.float32]
    near: float
    far: Float
    mask: int


def _external(name: str) -> Any:
    # Three addresses for a single ray (scene, ray, arguments), four for a packet (mask of lanes first).
    return types.ExternalFunction(name, types.void(*[types.int64] * (3 if name.endswith("1") else 4)))


_intersect1, _occluded1 = _external("rtcIntersect1"), _external("rtcOccluded1")
_intersect4, _occluded4 = _external("rtcIntersect4"), _external("rtcOccluded4")
_intersect8, _occluded8 = _external("rtcIntersect8"), _external("rtcOccluded8")
_intersect16, _occluded16 = _external("rtcIntersect16"), _external("rtcOccluded16")


def _loader(kind: Any, size: int) -> Any:
    @intrinsic
    def load(context: Any, address: Any, index: Any) -> Any:  # noqa: ARG001
        def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
            step = builder.mul(values[1], values[1].type(size))
            place = builder.inttoptr(builder.add(values[0], step), target.get_value_type(kind).as_pointer())
            return builder.load(place)

        return kind(types.int64, types.int64), build

    return load


_float64_at = _loader(types.float64, 8)
_int64_at = _loader(types.int64, 8)
_int32_at = _loader(types.int32, 4)


@intrinsic
def pointer(context: Any, address: Any) -> Any:  # noqa: ARG001
    """The void pointer to an address."""

    def build(target: Any, builder: Any, signature: Any, values: Any) -> Any:  # noqa: ARG001
        return builder.inttoptr(values[0], cgutils.voidptr_t)

    return types.voidptr(types.int64), build


# Compiled into their callers, and without counting references to the columns, which their callers hold:
# counting them would take ten times as long as the rest.
_UNCOUNTED: dict[str, Any] = {"_nrt": False}
inlined = njit(nogil=True, error_model="numpy", forceinline=True, **_UNCOUNTED)


@njit(nogil=True)
def aligned(size: int) -> Any:
    """Zeroed bytes that start at a multiple of 64."""
    raw = np.zeros(size + 64, np.uint8)
    start = (64 - raw.ctypes.data % 64) % 64
    return raw[start : start + size]


@inlined
def ray_of(rays: Rays, i: int, origin: Float) -> Any:
    """Origin, relative to the caster's, and direction of ray i: six numbers."""
    x, y, z = rays.directions[i, 0], rays.directions[i, 1], rays.directions[i, 2]
    j = i if rays.offsets.shape[0] > 1 else 0
    a, b, c = rays.offsets[j, 0], rays.offsets[j, 1], rays.offsets[j, 2]
    if rays.pose.size:
        p = rays.pose[i]
        R, s, at = rays.rotation, rays.scale, rays.position
        x, y, z = (
            s[p, 0] * (R[p, 0, 0] * x + R[p, 0, 1] * y + R[p, 0, 2] * z),
            s[p, 1] * (R[p, 1, 0] * x + R[p, 1, 1] * y + R[p, 1, 2] * z),
            s[p, 2] * (R[p, 2, 0] * x + R[p, 2, 1] * y + R[p, 2, 2] * z),
        )
        a, b, c = (
            at[p, 0] + s[p, 0] * (R[p, 0, 0] * a + R[p, 0, 1] * b + R[p, 0, 2] * c),
            at[p, 1] + s[p, 1] * (R[p, 1, 0] * a + R[p, 1, 1] * b + R[p, 1, 2] * c),
            at[p, 2] + s[p, 2] * (R[p, 2, 0] * a + R[p, 2, 1] * b + R[p, 2, 2] * c),
        )
    return a - origin[0], b - origin[1], c - origin[2], x, y, z


@inlined
def usable(a: float, b: float, c: float, squared: float) -> bool:
    """Whether an origin is finite and a direction's squared length finite and not zero."""
    return abs(a) + abs(b) + abs(c) < np.inf and 0.0 < squared < np.inf


@inlined
def transform_of(target: Target, instance: int, time: float) -> Any:
    """The transform of an instance at a ray time: twelve numbers, row by row."""
    M = target.transforms
    row = target.first[instance]
    w = 0.0
    if target.steps[instance] > 1:
        place = min(max(np.float64(time), 0.0), 1.0) * (target.steps[instance] - 1)
        step = min(int(place), target.steps[instance] - 2)
        row += step
        w = place - step
    r = row + 1 if w > 0.0 else row
    return (
        M[row, 0] + w * (M[r, 0] - M[row, 0]),
        M[row, 1] + w * (M[r, 1] - M[row, 1]),
        M[row, 2] + w * (M[r, 2] - M[row, 2]),
        M[row, 3] + w * (M[r, 3] - M[row, 3]),
        M[row, 4] + w * (M[r, 4] - M[row, 4]),
        M[row, 5] + w * (M[r, 5] - M[row, 5]),
        M[row, 6] + w * (M[r, 6] - M[row, 6]),
        M[row, 7] + w * (M[r, 7] - M[row, 7]),
        M[row, 8] + w * (M[r, 8] - M[row, 8]),
        M[row, 9] + w * (M[r, 9] - M[row, 9]),
        M[row, 10] + w * (M[r, 10] - M[row, 10]),
        M[row, 11] + w * (M[r, 11] - M[row, 11]),
    )


@inlined
def plane_of(target: Target, row: int, prim: int, instance: int, time: float) -> Any:
    """A face's plane in the caster's axes: normal (a unit vector for the own mesh) and offset."""
    planes = target.parts[row, 0] + 32 * prim
    nx, ny, nz, d = (
        _float64_at(planes, 0),
        _float64_at(planes, 1),
        _float64_at(planes, 2),
        _float64_at(planes, 3),
    )
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


@inlined
def _extent(target: Target, row: int, prim: int, instance: int, ray: Any, time: float) -> Any:
    """Least and greatest ray parameter of a face's corners, measured along the ray."""
    ox, oy, oz, dx, dy, dz = ray
    vertices, faces = target.parts[row, 1], target.parts[row, 2]
    low, high = np.inf, -np.inf
    for k in range(3):
        v = 3 * np.int64(_int32_at(faces, 3 * prim + k))
        x, y, z = _float64_at(vertices, v), _float64_at(vertices, v + 1), _float64_at(vertices, v + 2)
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
def exact(target: Target, row: int, prim: int, instance: int, ray: Any, inverse: float, time: float) -> Any:
    """Range, cosine and normal (not unit), in float64, of a ray that meets a face.

    inverse : one over the length of the ray's direction
    """
    ox, oy, oz, dx, dy, dz = ray
    nx, ny, nz, d = plane_of(target, row, prim, instance, time)
    along = nx * dx + ny * dy + nz * dz
    t = (d - nx * ox - ny * oy - nz * oz) / along
    cosine = -along * inverse
    if instance >= 0:
        cosine /= np.sqrt(nx * nx + ny * ny + nz * nz)
    if not abs(cosine) >= _GRAZING:
        low, high = _extent(target, row, prim, instance, ray, time)
        t = high if t > high else low if not t >= low else t
        cosine = cosine if cosine == cosine else 0.0  # noqa: PLR0124
    return t, cosine, nx, ny, nz


@inlined
def placed(target: Target, geom: Any, inst: Any, place: Any) -> Any:
    """Row of ``parts`` and instance of what Embree names by geometry, instance geometry and place in it."""
    if inst == _INVALID:
        return np.int64(target.rows[np.int64(geom)]), np.int64(-1)
    instance = np.int64(target.numbers[target.starts[np.int64(inst)] + np.int64(place)])
    return np.int64(target.shape[instance]) + np.int64(geom), instance


@inlined
def numbered(target: Target, row: int, prim: int) -> Any:
    """The number of a face."""
    numbers = target.parts[row, 3]
    return target.parts[row, 4] + (prim if numbers == 0 else np.int64(_int32_at(numbers, prim)))


@inlined
def _trace(target: Target, p: int, f: Any, rows: int, valid: Any, coherent: bool, one: Any) -> None:  # noqa: FBT001
    """Trace the valid lanes of a packet, all at once or one by one."""
    W = len(target.lanes)
    if coherent and W > 1:
        v = valid.ctypes.data
        if rows == _ROWS:
            if W == 16:
                _intersect16(v, target.scene, p, target.packet)
            elif W == 8:
                _intersect8(v, target.scene, p, target.packet)
            else:
                _intersect4(v, target.scene, p, target.packet)
        elif W == 16:
            _occluded16(v, target.scene, p, target.packet)
        elif W == 8:
            _occluded8(v, target.scene, p, target.packet)
        else:
            _occluded4(v, target.scene, p, target.packet)
        return
    q = one.ctypes.data
    for k in range(W):
        if valid[k] == 0:
            continue
        for r in range(rows):
            one[r] = f[r * W + k]
        if rows == _ROWS:
            _intersect1(target.scene, q, target.single)
        else:
            _occluded1(target.scene, q, target.single)
        for r in range(8, rows):
            f[r * W + k] = one[r]


@inlined
def _nudged(x: float, y: float, z: float) -> Any:
    """A unit vector turned by `_NUDGE`, towards the axis it lies farthest from."""
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        return x + _NUDGE, y, z
    if abs(y) <= abs(z):
        return x, y + _NUDGE, z
    return x, y, z + _NUDGE


@inlined
def above(x: float) -> Any:
    """The float32 next above a float64, or equal to it."""
    y = np.float32(x)
    return y if y >= x else np.nextafter(y, np.float32(np.inf))


@inlined
def gather(target: Target, rays: Rays, at: int, m: int, ids: Any, work: Any, f: Any) -> Any:
    """Load rays ``at`` to ``at + m`` of the order; the number of a bad one or -1, and whether they are alike.

    work : (8, width) float64: origin, direction, one over its length, far
    f    : Embree's packet; its rays get directions of length 1
    """
    W = len(target.lanes)
    near = rays.near
    for k in range(m):
        i = rays.order[at + k] if rays.order.size else at + k
        ids[k] = i
        ox, oy, oz, dx, dy, dz = ray_of(rays, i, target.origin)
        squared = dx * dx + dy * dy + dz * dz
        if not usable(ox, oy, oz, squared):
            return i, False
        inverse = 1.0
        if abs(squared - 1.0) > _UNIT:
            inverse = 1.0 / np.sqrt(squared)
        far = rays.far[i] if rays.far.size > 1 else rays.far[0]
        work[0, k], work[1, k], work[2, k] = ox, oy, oz
        work[3, k], work[4, k], work[5, k] = dx, dy, dz
        work[6, k], work[7, k] = inverse, far
        f[k], f[W + k], f[2 * W + k] = ox, oy, oz
        f[3 * W + k] = near / inverse
        f[4 * W + k], f[5 * W + k], f[6 * W + k] = dx * inverse, dy * inverse, dz * inverse
        if rays.time.size:
            f[7 * W + k] = rays.time[i]
        f[8 * W + k] = above(far / inverse)
    alike = True
    for k in (m // 3, 2 * m // 3, m - 1):  # a sample tells a scan from a shuffle
        along = work[3, 0] * work[3, k] + work[4, 0] * work[4, k] + work[5, 0] * work[5, k]
        apart = (
            abs(work[0, 0] - work[0, k]) + abs(work[1, 0] - work[1, k]) + abs(work[2, 0] - work[2, k])
        )
        alike = alike and along * work[6, 0] * work[6, k] > _COHERENT and apart < _SPREAD
    return -1, alike


@inlined
def _reload(W: int, k: int, work: Any, f: Any, far: float) -> None:
    """Turn the direction of lane k of Embree's packet a little and let it look as far as ``far``."""
    inverse = work[6, k]
    x, y, z = _nudged(work[3, k] * inverse, work[4, k] * inverse, work[5, k] * inverse)
    f[4 * W + k], f[5 * W + k], f[6 * W + k] = x, y, z
    f[8 * W + k] = above(far / inverse)


@inlined
def _hit(target: Target, f: Any, u: Any, k: int, work: Any) -> Any:
    """Range, cosine, face, instance and normal of lane k's hit."""
    W = len(target.lanes)
    row, instance = placed(target, u[18 * W + k], u[19 * W + k], u[20 * W + k])
    prim = np.int64(u[17 * W + k])
    ray = (work[0, k], work[1, k], work[2, k], work[3, k], work[4, k], work[5, k])
    t, cosine, x, y, z = exact(target, row, prim, instance, ray, work[6, k], f[7 * W + k])
    return t, cosine, numbered(target, row, prim), instance, x, y, z


@inlined
def _unit(out: Float, i: int, x: float, y: float, z: float) -> None:
    """Write a normal as a unit vector; zero stays zero."""
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        x, y, z = x / length, y / length, z / length
    out[i, 0], out[i, 1], out[i, 2] = x, y, z


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
) -> int:
    """Cast the rays lo to hi of the order into the columns of `Hits`; the first bad ray's number, or -1.

    No normals are written if ``normals`` is empty.

    Packets start at lo and every width from it.
    """
    W = len(target.lanes)
    packet = aligned(4 * _ROWS * W)
    f, u = packet.view(np.float32), packet.view(np.uint32)
    one = aligned(128).view(np.float32)
    valid = aligned(4 * W).view(np.int32)
    work, ids = np.zeros((8, W)), np.zeros(W, np.int64)
    p = packet.ctypes.data
    for k in range(W):
        u[9 * W + k] = rays.mask
        u[10 * W + k] = k
    for at in range(lo, hi, W):
        m = min(W, hi - at)
        bad, alike = gather(target, rays, at, m, ids, work, f)
        if bad >= 0:
            return bad
        for k in range(W):
            valid[k] = -1 if k < m else 0
            u[18 * W + k] = _INVALID
            u[19 * W + k] = _INVALID
        _trace(target, p, f, _ROWS, valid, alike, one)
        doubtful = False
        for k in range(m):
            i = ids[k]
            ranges[i], cosines[i], faces[i], instances[i] = np.inf, 0.0, -1, -1
            valid[k] = -1
            if normals.size:
                _unit(normals, i, 0.0, 0.0, 0.0)
            if u[18 * W + k] != _INVALID:
                t, cosine, face, instance, x, y, z = _hit(target, f, u, k, work)
                if t <= work[7, k]:
                    ranges[i], cosines[i], faces[i], instances[i] = t, cosine, face, instance
                    valid[k] = -1 if cosine < 0.0 else 0
                    if normals.size:
                        _unit(normals, i, x, y, z)
            doubtful = doubtful or valid[k] != 0
        if not doubtful:
            continue
        for k in range(m):
            if valid[k]:
                u[18 * W + k] = _INVALID
                u[19 * W + k] = _INVALID
                _reload(W, k, work, f, min(work[7, k], ranges[ids[k]]))
        _trace(target, p, f, _ROWS, valid, alike, one)
        for k in range(m):
            if valid[k] and u[18 * W + k] != _INVALID:
                i = ids[k]
                t, cosine, face, instance, x, y, z = _hit(target, f, u, k, work)
                if t <= work[7, k] and t < ranges[i] and (faces[i] < 0 or cosine > 0.0):
                    ranges[i], cosines[i], faces[i], instances[i] = t, cosine, face, instance
                    if normals.size:
                        _unit(normals, i, x, y, z)
    return -1


@njit(nogil=True, cache=True, error_model="numpy")
def occluded(target: Target, rays: Rays, lo: int, hi: int, out: NDArray[np.bool_]) -> int:
    """Fill in whether anything lies on the rays lo to hi; the first bad ray's number, or -1."""
    W = len(target.lanes)
    packet = aligned(4 * _RAY * W)
    f, u = packet.view(np.float32), packet.view(np.uint32)
    one = aligned(64).view(np.float32)
    valid = aligned(4 * W).view(np.int32)
    work, ids = np.zeros((8, W)), np.zeros(W, np.int64)
    p = packet.ctypes.data
    for k in range(W):
        u[9 * W + k] = rays.mask
        u[10 * W + k] = k
    for at in range(lo, hi, W):
        m = min(W, hi - at)
        bad, alike = gather(target, rays, at, m, ids, work, f)
        if bad >= 0:
            return bad
        for k in range(W):
            valid[k] = -1 if k < m else 0
        _trace(target, p, f, _RAY, valid, alike, one)
        doubtful = False
        for k in range(m):
            out[ids[k]] = f[8 * W + k] < 0
            valid[k] = 0 if out[ids[k]] else -1
            doubtful = doubtful or valid[k] != 0
        if not doubtful:
            continue
        for k in range(m):
            if valid[k]:
                _reload(W, k, work, f, work[7, k])
        _trace(target, p, f, _RAY, valid, alike, one)
        for k in range(m):
            if valid[k]:
                out[ids[k]] = f[8 * W + k] < 0
    return -1
