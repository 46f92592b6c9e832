"""Meshes and rays of the extremes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from geoscene.typing import Float, Ints

BATCH = 500_000
"""Rays or samples that are held at a time."""


def batches(count: int) -> Iterator[tuple[int, int]]:
    """Number and size of each batch of ``count`` samples."""
    for k, start in enumerate(range(0, count, BATCH)):
        yield k, min(BATCH, count - start)


def directions(rng: np.random.Generator, count: int) -> Float:
    """Unit vectors (n, 3), uniformly distributed."""
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    return out


def sheet(normal: Float, point: Float, *, size: float) -> tuple[Float, Ints]:
    """Vertices and faces of a square of four triangles about a point, its front on the normal's side."""
    n = np.asarray(normal) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    vertices = np.array([np.zeros(3), *(size * w for w in (u, v, -u, -v))]) + point
    return vertices, np.array([[0, k + 1, (k + 1) % 4 + 1] for k in range(4)])


def cuboid(low: Float, high: Float) -> tuple[Float, Ints]:
    """Vertices and faces of a box, facing outwards."""
    bits = np.arange(8)[:, None] >> np.array([2, 1, 0]) & 1
    corners = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[q[0], q[k], q[k + 1]] for q in corners for k in (1, 2)]
    return np.where(bits == 1, high, low).astype(float), np.array(faces)


def ball(levels: int, *, radius: float) -> tuple[Float, Ints]:
    """Vertices and faces of an octahedron divided ``levels`` times and moved to a sphere, facing outwards."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(levels):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, number = np.unique(edges, axis=0, return_inverse=True)
        middle = number.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
        a, b, c = faces.T
        ab, bc, ca = middle.T
        rows = ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))
        faces = np.concatenate([np.column_stack(row) for row in rows])
    return vertices * radius, faces


def prism_of_slivers(width: float, height: float, *, count: int) -> tuple[Float, Ints]:
    """A closed box of which one wall has ``count`` pairs of triangles ``width`` wide and ``height`` high."""
    x = np.arange(count + 1) * width
    front = np.array([[v, 0.0, z] for v in x for z in (0.0, height)])
    back = np.array([[v, 5.0, z] for v in (x[0], x[-1]) for z in (0.0, height)])
    k = 2 * np.arange(count)
    walls = np.concatenate([np.column_stack([k, k + 2, k + 3]), np.column_stack([k, k + 3, k + 1])])
    m, n = 2 * count, 2 * count + 2  # lower front corner at the other end, first corner at the back
    ends = [[0, 1, n + 1], [0, n + 1, n], [m, n + 2, n + 3], [m, n + 3, m + 1], [n, n + 1, n + 3]]
    bottom = [[2 * j, n, 2 * j + 2] for j in range(count)] + [[m, n, n + 2]]
    top = [[2 * j + 1, 2 * j + 3, n + 1] for j in range(count)] + [[m + 1, n + 3, n + 1]]
    faces = np.concatenate([walls, ends, [[n, n + 3, n + 2]], bottom, top])
    return np.concatenate([front, back]), faces
