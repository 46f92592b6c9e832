"""Numbers and planes of hit faces, and intersections of rays with these planes, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar.raycast.columns import COPIES, RayTarget
from lidar.raycast.lanes import GRAZING
from lidar.raycast.memory import compile_out_of_line, float64_at, inline, int32_at, int64_at, vector
from lidar.raycast.rows import CORNERS, DX, DY, DZ, NUMBERS, OX, OY, OZ, PART, START_NUMBER, VERTICES

PLANE = 40
"""Bytes of a row of `lidar.raycast.geometry.Geometry.planes`."""
EXACT = 4e-15
"""Rounding of the distance between a ray and an edge, per metre of distance and of coordinates."""
INVALID = np.uint32(0xFFFFFFFF)
"""Embree's number for no geometry and no instance."""

OVER, _FARTHEST = 1e-3, 0.1
"""Metres off a plane at which a ray from behind it goes on, as far as shadow rays keep off surfaces; and
metres along the ray at most."""


@inline
def transform_of(target: RayTarget, instance: int, time: float) -> Any:
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


@inline
def instance_row(target: RayTarget, geom: Any, inst: Any, place: Any) -> Any:
    """Row of ``parts`` and instance for Embree's geometry, instance geometry and index within it."""
    if inst == INVALID:
        return np.int64(target.rows[np.int64(geom)]), np.int64(-1)
    instance = np.int64(target.numbers[target.starts[np.int64(inst)] + np.int64(place)])
    return np.int64(target.shape[instance]) + np.int64(geom) - COPIES, instance


@inline
def face_number(target: RayTarget, row: int, prim: int) -> Any:
    """The number of a face."""
    part = target.parts.ctypes.data + 8 * PART * row
    numbers = int64_at(part, NUMBERS)
    return int64_at(part, START_NUMBER) + (prim if numbers == 0 else np.int64(int32_at(numbers, prim)))


@inline
def plane_of(target: RayTarget, row: int, prim: int, instance: int, time: float) -> Any:
    """A face's plane in the caster's axes: normal (a unit vector for the own mesh) and offset."""
    plane = int64_at(target.parts.ctypes.data, PART * row) + PLANE * prim
    nx, ny, nz, d = float64_at(plane, 0), float64_at(plane, 1), float64_at(plane, 2), float64_at(plane, 3)
    if instance < 0:
        return nx, ny, nz, d
    a, b, c, x, e, f, g, y, h, i, j, z = transform_of(target, instance, time)
    # Normals transform by the cofactor matrix; a point of the plane is its offset times its unit normal.
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


@inline
def _corner(target: RayTarget, row: int, corner: int, instance: int, time: float) -> Any:
    """A corner of a face in the caster's axes; corners of face f are 3 f to 3 f + 2."""
    x, y, z = vector(target.parts[row, VERTICES], np.int64(int32_at(target.parts[row, CORNERS], corner)))
    if instance >= 0:
        M = transform_of(target, instance, time)
        x, y, z = (
            M[0] * x + M[1] * y + M[2] * z + M[3],
            M[4] * x + M[5] * y + M[6] * z + M[7],
            M[8] * x + M[9] * y + M[10] * z + M[11],
        )
    return x, y, z


@compile_out_of_line
def _extent(target: RayTarget, row: int, prim: int, instance: int, ray: Any, time: float) -> Any:
    """Least and greatest ray parameter of a face's corners, measured along the ray."""
    ox, oy, oz, dx, dy, dz = ray
    low, high = np.inf, -np.inf
    for k in range(3):
        x, y, z = _corner(target, row, 3 * prim + k, instance, time)
        t = ((x - ox) * dx + (y - oy) * dy + (z - oz) * dz) / (dx * dx + dy * dy + dz * dz)
        low, high = min(low, t), max(high, t)
    return low, high


@inline
def beside(ray: Any, a: Any, b: Any, c: Any) -> float:
    """Metres by which a ray passes outside the edges of a triangle, in float64; 0 if it hits the triangle.

    Edges belong to both of their faces: what remains of float64 rounding counts as a hit.

    a, b, c : corners, relative to the ray's origin
    """
    ox, oy, oz, dx, dy, dz = ray
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    size = abs(ox) + abs(oy) + abs(oz)
    low, high = np.inf, -np.inf
    for (ax, ay, az), (bx, by, bz) in ((a, b), (b, c), (c, a)):
        ex, ey, ez = bx - ax, by - ay, bz - az
        edge = np.sqrt(ex * ex + ey * ey + ez * ez)
        moment = dx * (ey * az - ez * ay) + dy * (ez * ax - ex * az) + dz * (ex * ay - ey * ax)
        passed = moment / (length * edge) if edge > 0.0 else 0.0
        rounding = EXACT * (size + abs(ax) + abs(ay) + abs(az) + edge)
        passed = 0.0 if abs(passed) <= rounding else passed
        low, high = min(low, passed), max(high, passed)
    return max(0.0, min(-low, high))


@compile_out_of_line
def outside(target: RayTarget, row: int, prim: int, instance: int, ray: Any, time: float) -> float:
    """Distance in metres by which a ray passes outside a face, as in `beside`."""
    ox, oy, oz, _, _, _ = ray
    ax, ay, az = _corner(target, row, 3 * prim, instance, time)
    bx, by, bz = _corner(target, row, 3 * prim + 1, instance, time)
    cx, cy, cz = _corner(target, row, 3 * prim + 2, instance, time)
    passed: float = beside(
        ray, (ax - ox, ay - oy, az - oz), (bx - ox, by - oy, bz - oz), (cx - ox, cy - oy, cz - oz)
    )
    return passed


@inline
def ray_of(W: int, k: int, work: Any) -> Any:
    """Origin and direction of lane k."""
    return (
        work[OX * W + k],
        work[OY * W + k],
        work[OZ * W + k],
        work[DX * W + k],
        work[DY * W + k],
        work[DZ * W + k],
    )


@compile_out_of_line
def intersection(
    target: RayTarget, row: int, prim: int, instance: int, ray: Any, inverse: float, time: float
) -> Any:
    """Range, cosine and normal (not unit), in float64, where a ray intersects the plane of a face."""
    ox, oy, oz, dx, dy, dz = ray
    nx, ny, nz, d = plane_of(target, row, prim, instance, time)
    along = nx * dx + ny * dy + nz * dz
    t = (d - nx * ox - ny * oy - nz * oz) / along
    cosine = -along * inverse
    if instance >= 0:
        cosine /= np.sqrt(nx * nx + ny * ny + nz * nz)
    if not abs(cosine) >= GRAZING:
        low, high = _extent(target, row, prim, instance, ray, time)
        t = high if t > high else low if not t >= low else t
        cosine = cosine if cosine == cosine else 0.0  # noqa: PLR0124
    return t, cosine, nx, ny, nz


@inline
def beyond_plane(leaving: float, length: float) -> Any:
    """Ray parameter beyond a plane that the ray crosses from behind.

    leaving : metres that it leaves the plane by per parameter, above 0
    length  : metres per parameter

    A ray that starts on the plane itself would meet it again in float32.
    """
    return min(OVER / leaving, _FARTHEST / length)


@inline
def direction_of(rays: Any, i: int) -> Any:
    """A ray's direction in the caster's axes."""
    x, y, z = rays.directions[i, 0], rays.directions[i, 1], rays.directions[i, 2]
    if len(rays.pose) == 0:
        return x, y, z
    m, p = rays.matrix, rays.pose[i]
    return (
        m[p, 0, 0] * x + m[p, 0, 1] * y + m[p, 0, 2] * z,
        m[p, 1, 0] * x + m[p, 1, 1] * y + m[p, 1, 2] * z,
        m[p, 2, 0] * x + m[p, 2, 1] * y + m[p, 2, 2] * z,
    )


@inline
def origin_of(rays: Any, i: int) -> Any:
    """A ray's origin in the caster's axes."""
    x, y, z = 0.0, 0.0, 0.0
    if len(rays.offsets) > 0:
        o = i if len(rays.offsets) > 1 else 0
        x, y, z = rays.offsets[o, 0], rays.offsets[o, 1], rays.offsets[o, 2]
    if len(rays.pose) == 0:
        return x, y, z
    m, p, at = rays.matrix, rays.pose[i], rays.position
    return (
        at[p, 0] + m[p, 0, 0] * x + m[p, 0, 1] * y + m[p, 0, 2] * z,
        at[p, 1] + m[p, 1, 0] * x + m[p, 1, 1] * y + m[p, 1, 2] * z,
        at[p, 2] + m[p, 2, 0] * x + m[p, 2, 1] * y + m[p, 2, 2] * z,
    )
