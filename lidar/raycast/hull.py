"""Float32 vertices that enclose the float64 surface, so that rounding loses no hit.

Each vertex is moved by a few units of float32 rounding: outwards, by a margin along the normal of each of its
faces, and sideways, as Embree misses some rays that are aimed exactly at one of its vertices.
A ray that hits the float64 surface then also hits the float32 one, and a float64 test of the face decides
(`lidar.raycast.planes.outside`). Faces keep sharing vertices, so that no ray passes between them.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from geoscene.typing import Float

ROUNDING = 2.0**-22
"""Margin per metre of distance from the origin: four times the rounding of a float32 coordinate."""
REACH = 256.0
"""Metres from the origin within which the margin is constant: 0.06 mm."""
_PLANE = 0.9995  # cosine to the mean normal from which all faces at a vertex form a plane
_LONGEST = 5.0  # margins by which a vertex moves at most
_SIDEWAYS = 1.5  # margins along the surface
_ROUNDS = 12  # rounds of corrections, enough for the corners of buildings


def margin_of(vertices: Float) -> float:
    """Metres by which float32 surfaces enclose the faces of vertices (n, 3) relative to the origin."""
    return ROUNDING * max(REACH, float(np.abs(vertices).max(initial=0.0)))


@njit(nogil=True, cache=True, error_model="numpy")
def displacements(vertices: Float, faces: NDArray[np.int32], planes: Float) -> Float:
    """Displacements (n, 3) of vertices, in margins.

    At least 1 along the normal of each face at the vertex. A vertex of a plane surface moves by 1 along the
    surface instead: it has no silhouette there, and edges shift less at grazing incidence. Vertices at a
    border of the surface, and those of surfaces that touch from both sides, stay.
    """
    n = len(vertices)
    out, mean, balance = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, np.uint64)
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            balance[v] += _scrambled(faces[f, (k + 1) % 3]) - _scrambled(faces[f, (k + 2) % 3])
            for c in range(3):
                mean[v, c] += planes[f, c]
    for v in range(n):
        length = np.sqrt(mean[v, 0] ** 2 + mean[v, 1] ** 2 + mean[v, 2] ** 2)
        for c in range(3):
            mean[v, c] = mean[v, c] / length if length > 0.0 else 0.0
        x, y, z = mean[v]
        # Sideways too: a ray at the vertex from straight ahead does not meet the displaced one.
        if abs(0.36 * x + 0.48 * y + 0.8 * z) < 0.8:
            ax, ay, az = 0.8 * y - 0.48 * z, 0.36 * z - 0.8 * x, 0.48 * x - 0.36 * y
        else:
            ax, ay, az = 0.6 * z, 0.8 * z, -0.6 * x - 0.8 * y
        side = _SIDEWAYS / max(np.sqrt(ax * ax + ay * ay + az * az), 0.1)
        out[v, 0], out[v, 1], out[v, 2] = x + side * ax, y + side * ay, z + side * az
    flattest = np.ones(n)
    for f in range(len(faces)):
        if planes[f, 0] == 0.0 and planes[f, 1] == 0.0 and planes[f, 2] == 0.0:
            continue
        for k in range(3):
            v = faces[f, k]
            flattest[v] = min(flattest[v], _along(mean, v, planes, f))
    for _ in range(_ROUNDS):
        for f in range(len(faces)):
            for k in range(3):
                v = faces[f, k]
                short = 1.0 - _along(out, v, planes, f)
                if short > 0.0:
                    for c in range(3):
                        out[v, c] += short * planes[f, c]
    least = np.full(n, np.inf)
    for f in range(len(faces)):
        if planes[f, 0] == 0.0 and planes[f, 1] == 0.0 and planes[f, 2] == 0.0:
            continue
        for k in range(3):
            v = faces[f, k]
            least[v] = min(least[v], _along(out, v, planes, f))
    for v in range(n):
        x, y, z = mean[v]
        length = np.sqrt(out[v, 0] ** 2 + out[v, 1] ** 2 + out[v, 2] ** 2)
        if balance[v] != 0 or not least[v] > 0.5 or length > _LONGEST:
            out[v, 0], out[v, 1], out[v, 2] = 0.0, 0.0, 0.0
        elif flattest[v] > _PLANE:
            if abs(z) > 0.7:
                out[v, 0], out[v, 1], out[v, 2] = z, 0.0, -x
            else:
                out[v, 0], out[v, 1], out[v, 2] = y, -x, 0.0
    return out


@njit(nogil=True, cache=True)
def _scrambled(number: int) -> np.uint64:
    """A hash of a vertex number: the sum over the edges around an inner vertex is zero."""
    x = np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    return (x ^ (x >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)


@njit(nogil=True, cache=True)
def _along(vectors: Float, v: int, planes: Float, f: int) -> float:
    along: float = vectors[v, 0] * planes[f, 0] + vectors[v, 1] * planes[f, 1] + vectors[v, 2] * planes[f, 2]
    return along
