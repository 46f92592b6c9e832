"""Float32 vertices that enclose the float64 surface, so that rounding loses no hit.

Each vertex is moved by a few units of float32 rounding: outwards, by a margin along the normal of each of its
faces, and sideways, as Embree misses some rays that are aimed exactly at one of its vertices.
A ray that hits the float64 surface then also hits the float32 one, and float64 decides
(`lidar.raycast.exact`). Faces keep sharing vertices, so that no ray passes between them.
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
_LONGEST = 250.0  # margins by which a vertex moves at most
_SHARP = 0.05  # cosine to the mean normal of a face at a tip
_SIDEWAYS = 1.5  # margins along the surface
_DIRECTIONS = 12  # along the surface, of which the best is taken
_BORDER = (0.9, 1.2, 0.0)  # margins, the same in all tiles that share the vertex
_ROUNDS = 1000  # of corrections: enough for sharp corners; most vertices need less than ten
_SHORT = 0.05  # margins that a displacement along a normal may lack


def margins_of(vertices: Float) -> Float:
    """Metres (n,) by which float32 surfaces enclose the faces of vertices (n, 3) relative to the origin."""
    margins: Float = ROUNDING * np.maximum(REACH, np.abs(vertices).max(axis=1, initial=0.0))
    return margins


@njit(nogil=True, cache=True, error_model="numpy")
def displacements(vertices: Float, faces: NDArray[np.int32], planes: Float) -> Float:
    """Displacements (n, 3) of vertices, in margins.

    At least 1 along the normal of each face at the vertex. A vertex of a plane surface moves along the
    surface instead: it has no silhouette there, and edges shift less at grazing incidence. All vertices at a
    border of the surface move alike. The few that no displacement up to `_LONGEST` serves move, too.
    """
    n = len(vertices)
    out, mean, balance, flattest = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n, np.uint64), np.ones(n)
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
    for f in range(len(faces)):
        if not planes[f, 0] == planes[f, 1] == planes[f, 2] == 0.0:
            for k in range(3):
                flattest[faces[f, k]] = min(flattest[faces[f, k]], _along(mean, faces[f, k], planes, f))
    sideways = _sideways(vertices, faces, mean)
    lacking = np.zeros(n, np.bool_)
    for v in range(n):
        lacking[v] = balance[v] == 0 and flattest[v] <= _PLANE
        outwards = 1.0 if lacking[v] else 0.0
        if lacking[v] and 0.0 < flattest[v] < _SHARP:
            outwards = (1.0 + _SIDEWAYS) / flattest[v]  # encloses all faces, whatever the way sideways
        for c in range(3):
            along = _SIDEWAYS * sideways[v, c] + outwards * mean[v, c]
            out[v, c] = _BORDER[c] if balance[v] != 0 else along
    rows = np.arange(len(faces))
    for _ in range(_ROUNDS):
        rows, lacking = _corrected(out, faces, planes, rows, lacking)
    for v in range(n):
        length = np.sqrt(out[v, 0] ** 2 + out[v, 1] ** 2 + out[v, 2] ** 2)
        if length > _LONGEST:
            for c in range(3):
                out[v, c] *= _LONGEST / length
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _sideways(vertices: Float, faces: NDArray[np.int32], mean: Float) -> Float:
    """Unit vectors (n, 3) along the surface at vertices with mean normals (n, 3), away from all edges.

    Embree misses some rays at a vertex and along the edges of narrow faces. The rays aimed at the vertex or
    the edges of float64 pass these by. Of some directions, the one farthest from the line of any edge.
    """
    n = len(vertices)
    cosine, sine = np.cos(np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS), np.empty(_DIRECTIONS)
    sine[:] = np.sin(np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS)
    u, w, clear, side = np.empty((n, 3)), np.empty((n, 3)), np.ones((n, _DIRECTIONS)), np.empty((n, 3))
    for v in range(n):
        x, y, z = mean[v]
        if abs(z) < 0.7:
            length = max(np.sqrt(x * x + y * y), 1e-9)
            u[v, 0], u[v, 1], u[v, 2] = -y / length, x / length, 0.0
        else:
            length = np.sqrt(x * x + z * z)
            u[v, 0], u[v, 1], u[v, 2] = z / length, 0.0, -x / length
        for c in range(3):
            w[v, c] = mean[v, (c + 1) % 3] * u[v, (c + 2) % 3] - mean[v, (c + 2) % 3] * u[v, (c + 1) % 3]
    for f in range(len(faces)):
        for k in range(3):
            v, end = faces[f, k], faces[f, (k + 1) % 3]
            p, q = 0.0, 0.0
            for c in range(3):
                p += (vertices[end, c] - vertices[v, c]) * u[v, c]
                q += (vertices[end, c] - vertices[v, c]) * w[v, c]
            length = np.sqrt(p * p + q * q)
            for i in range(_DIRECTIONS if length > 0.0 else 0):
                clear[v, i] = min(clear[v, i], abs(p * sine[i] - q * cosine[i]) / length)
    for v in range(n):
        best = np.argmax(clear[v])
        for c in range(3):
            side[v, c] = cosine[best] * u[v, c] + sine[best] * w[v, c]
    return side


@njit(nogil=True, cache=True)
def _corrected(
    out: Float, faces: NDArray[np.int32], planes: Float, rows: NDArray[np.int64], lacking: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Move the vertices that are still lacking along the normals of the faces in ``rows``.

    Returns the faces of vertices that lacked more than `_SHORT` along one of the normals, and these vertices.
    """
    still, kept = np.zeros(len(lacking), np.bool_), np.zeros(len(rows), np.bool_)
    for f in rows:
        for k in range(3):
            v = faces[f, k]
            short = 1.0 - _along(out, v, planes, f)
            if lacking[v] and short > 0.0 and not (planes[f, 0] == planes[f, 1] == planes[f, 2] == 0.0):
                still[v] |= short > _SHORT
                for c in range(3):
                    out[v, c] += short * planes[f, c]
    for i in range(len(rows)):
        for k in range(3):
            kept[i] |= still[faces[rows[i], k]]
    return rows[kept], still


@njit(nogil=True, cache=True)
def _scrambled(number: int) -> np.uint64:
    """A hash of a vertex number: the sum over the edges around an inner vertex is zero."""
    x = np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    return (x ^ (x >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)


@njit(nogil=True, cache=True)
def _along(vectors: Float, v: int, planes: Float, f: int) -> float:
    along: float = vectors[v, 0] * planes[f, 0] + vectors[v, 1] * planes[f, 1] + vectors[v, 2] * planes[f, 2]
    return along
