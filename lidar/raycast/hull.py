"""Float32 vertices that enclose the float64 surface, so that rounding loses no hit.

Each vertex is moved by a few units of float32 rounding: outwards, by a margin along the normal of each of its
faces, and sideways, as Embree misses some rays that are aimed exactly at one of its vertices.
A ray that hits the float64 surface then also hits the float32 one, and float64 decides
(`lidar.raycast.exact`). Faces keep sharing vertices, so that no ray passes between them. Patches cover the
moved vertices, which rays along their displacements meet, and narrow faces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float

ROUNDING = 2.0**-22
"""Margin per metre of distance from the origin: four times the rounding of a float32 coordinate."""
REACH = 256.0
"""Metres from the origin within which the margin is constant: 0.06 mm."""
LONG = 2.5
"""Margins by which a float32 face may lie before its face; float64 decides hits that lie farther before."""
NARROW = 0.05
"""Margin (`lidar.raycast.geometry.Geometry.planes`) from which a face is narrow."""
_PLANE = 1.0 - 5e-7  # cosine to the mean normal (1 mrad) from which all faces at a vertex form a plane
_LONGEST = 30.0  # margins by which a vertex moves at most
_TIP = 5.0  # margins by which the patch of a narrow face extends beyond a corner at most
_SIDEWAYS = 1.5  # margins along the surface
_DIRECTIONS = 12  # along the surface, of which the best is taken
_BORDER = (0.9, 1.2, 0.0)  # margins, the same in all tiles that share the vertex
_ROUNDS = 1000  # of corrections: enough for sharp corners; most vertices need less than ten
_SHORT = 0.05  # margins that a displacement along a normal may lack


def margins_of(vertices: Float) -> Float:
    """Metres (n,) by which float32 surfaces enclose the faces of vertices (n, 3) relative to the origin."""
    margins: Float = ROUNDING * np.maximum(REACH, np.abs(vertices).max(axis=1, initial=0.0))
    return margins


def displacements(vertices: Float, faces: NDArray[np.int32], planes: Float) -> Float:
    """Displacements (n, 3) of vertices, in margins.

    At least 1 along the normal of each face at the vertex. A vertex of a plane surface moves along the
    surface instead: it has no silhouette there, and edges shift less at grazing incidence. All vertices at a
    border of the surface move alike. The few that no displacement up to `_LONGEST` serves move, too.
    """
    n = len(vertices)
    mean, balance, flattest = np.zeros((n, 3)), np.zeros(n, np.uint64), np.ones(n)
    _normals(faces, planes, mean, balance, flattest)
    border = balance != 0
    lacking = ~border & (flattest <= _PLANE)
    out = _SIDEWAYS * _sideways(vertices, faces, mean) + np.where(lacking[:, None], mean, 0.0)
    out[border] = _BORDER
    _correct(out, faces, planes, lacking)
    length = np.sqrt((out * out).sum(axis=1))
    far = length > _LONGEST
    out[far] *= (_LONGEST / length[far])[:, None]
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _normals(
    faces: NDArray[np.int32], planes: Float, mean: Float, balance: NDArray[np.uint64], flattest: Float
) -> None:
    """Write mean normals, cosines of the faces to them, and a balance that is 0 at surrounded vertices."""
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            balance[v] += _scramble(faces[f, (k + 1) % 3]) - _scramble(faces[f, (k + 2) % 3])
            for c in range(3):
                mean[v, c] += planes[f, c]
    for v in range(len(mean)):
        length = np.sqrt(mean[v, 0] ** 2 + mean[v, 1] ** 2 + mean[v, 2] ** 2)
        for c in range(3):
            mean[v, c] = mean[v, c] / length if length > 0.0 else 0.0
    for f in range(len(faces)):
        if planes[f, 0] != 0.0 or planes[f, 1] != 0.0 or planes[f, 2] != 0.0:
            for k in range(3):
                flattest[faces[f, k]] = min(flattest[faces[f, k]], _along(mean, faces[f, k], planes, f))


def _sideways(vertices: Float, faces: NDArray[np.int32], mean: Float) -> Float:
    """Unit vectors (n, 3) along the surface at vertices with mean normals (n, 3), away from all edges.

    Embree misses some rays at a vertex and along the edges of narrow faces. The rays aimed at the vertex or
    the edges of float64 pass these by. Of some directions, the one farthest from the line of any edge.
    """
    u, w = _across(mean)
    angle = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    clear = np.ones((len(vertices), _DIRECTIONS))
    _clear(vertices, faces, u, w, np.cos(angle), np.sin(angle), clear)
    best = angle[clear.argmax(axis=1), None]
    sideways: Float = np.cos(best) * u + np.sin(best) * w
    return sideways


def _across(normals: Float) -> tuple[Float, Float]:
    """Two directions (n, 3) at right angles to unit vectors (n, 3) and to each other."""
    x, y, z = normals.T
    level = np.abs(z) < 0.7
    u = np.where(level[:, None], np.stack([-y, x, 0 * z], axis=1), np.stack([z, 0 * z, -x], axis=1))
    u /= np.maximum(np.sqrt((u * u).sum(axis=1)), 1e-9)[:, None]
    return u, np.cross(normals, u)


def patches(places: Float, narrow: NDArray[np.int32], *, margins: Float, moved: Float) -> Float:
    """Corners (p, 3, 3) of triangles over vertices that moved, and over narrow faces (k, 3).

    A ray aimed at a vertex also meets the moved one if it is parallel to the displacement, and Embree may
    lose it there: the triangle over a vertex lies across its displacement. A narrow face is covered with its
    edges.

    places  : (n, 3), moved vertices
    margins : (n,) metres
    moved   : (n, 3), displacements in margins
    """
    length = np.sqrt((moved * moved).sum(axis=1))
    rows = np.flatnonzero(length > 0)
    u, w = _across(moved[rows] / length[rows, None])
    turned = [u, -0.5 * u + np.sqrt(0.75) * w, -0.5 * u - np.sqrt(0.75) * w]
    over = places[rows, None] + margins[rows, None, None] * np.stack(turned, axis=1)
    corners = places[narrow]
    one, other = (_unit(np.roll(corners, -k, axis=1) - corners) for k in (1, 2))
    sine = np.maximum(np.linalg.norm(one - other, axis=2) / 2, 1 / _TIP)  # of half the angle
    size = margins[narrow].max(axis=1, initial=0.0)[:, None] / sine
    return np.concatenate([over, corners - size[:, :, None] * _unit(one + other)])


def _unit(vectors: Float) -> Float:
    out: Float = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
    return out


@njit(nogil=True, cache=True, error_model="numpy")
def _clear(
    vertices: Float, faces: NDArray[np.int32], u: Float, w: Float, cosine: Float, sine: Float, clear: Float
) -> None:
    """Lower the sines (n, d) of the angles between directions along the axes u and w and the nearest edge."""
    for f in range(len(faces)):
        for k in range(3):
            v, end = faces[f, k], faces[f, (k + 1) % 3]
            p, q = 0.0, 0.0
            for c in range(3):
                p += (vertices[end, c] - vertices[v, c]) * u[v, c]
                q += (vertices[end, c] - vertices[v, c]) * w[v, c]
            length = np.sqrt(p * p + q * q)
            if length > 0.0:
                for i in range(len(cosine)):
                    clear[v, i] = min(clear[v, i], abs(p * sine[i] - q * cosine[i]) / length)


@njit(nogil=True, cache=True)
def _correct(out: Float, faces: NDArray[np.int32], planes: Float, lacking: NDArray[np.bool_]) -> None:
    """Move the lacking vertices along the normals of their faces, in rounds, until none lacks much.

    lacking : (n,), overwritten
    """
    rows, count, still = np.arange(len(faces)), len(faces), lacking.copy()
    for _ in range(_ROUNDS):
        kept = 0
        for f in rows[:count]:
            if lacking[faces[f, 0]] or lacking[faces[f, 1]] or lacking[faces[f, 2]]:
                rows[kept] = f
                kept += 1
        count = kept
        if count == 0:
            break
        still[:] = False
        for f in rows[:count]:
            for k in range(3):
                v = faces[f, k]
                short = 1.0 - _along(out, v, planes, f)
                if lacking[v] and short > 0.0:
                    if planes[f, 0] != 0.0 or planes[f, 1] != 0.0 or planes[f, 2] != 0.0:
                        still[v] |= short > _SHORT
                    for c in range(3):
                        out[v, c] += short * planes[f, c]
        lacking, still = still, lacking


@njit(nogil=True, cache=True)
def _scramble(number: int) -> np.uint64:
    """A hash of a vertex number: the sum over the edges around an inner vertex is zero."""
    x = np.uint64(number) * np.uint64(0x9E3779B97F4A7C15)
    return (x ^ (x >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)


@njit(nogil=True, cache=True)
def _along(vectors: Float, v: int, planes: Float, f: int) -> float:
    along: float = vectors[v, 0] * planes[f, 0] + vectors[v, 1] * planes[f, 1] + vectors[v, 2] * planes[f, 2]
    return along
