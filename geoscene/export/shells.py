"""Shells of solids: outer shells with the cavities inside them; and surfaces in connected patches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.watertight import corner_fans, edge_uses
from geoscene.support.graphs import components
from geoscene.typing import Bools, Float, Ints


def shell_numbers(corners: Ints, owner: NDArray[np.integer]) -> Ints:
    """Shell number (m,) of each face: faces of one owner connected by edges form a shell.

    corners : (m, 3) ids of welded vertices
    owner   : (m,) object of each face
    """
    m = len(corners)
    if not m:
        return np.empty(0, np.int64)
    own = owner.astype(np.int64)[:, None] * (corners.max() + 1) + corners
    _, ids = np.unique(own, return_inverse=True)
    edge, uses, _ = edge_uses(ids.reshape(-1, 3).astype(np.int64))
    face = np.repeat(np.arange(m), 3)
    labels = components(face, m + edge, count=m + len(uses))[:m]
    _, first, numbers = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[numbers]


def manifold_patches(corners: Ints) -> Ints:
    """Patch number (m,) of each face: a patch is connected by edges, and so are its faces at each vertex.

    corners : (m, 3) ids of vertices; no edge has more than two faces
    """
    patch = np.full(len(corners), -1, np.int64)
    while (patch < 0).any():
        todo = np.flatnonzero(patch < 0)
        while (extra := _beyond_first_fan(corners[todo])).any():
            todo = todo[:1] if extra.all() else todo[~extra]
        patch[todo] = patch.max() + 1 + shell_numbers(corners[todo], np.zeros(len(todo), np.int64))
    return patch


def _beyond_first_fan(corners: Ints) -> Bools:
    """Whether a face (m,) is at one of its vertices in another fan of its patch than the largest."""
    vertex, fan = corners.ravel(), corner_fans(corners)
    patch = np.repeat(shell_numbers(corners, np.zeros(len(corners), np.int64)), 3)
    order = np.lexsort([fan, -np.bincount(fan)[fan], vertex, patch])
    place = patch[order] * (vertex.max() + 1) + vertex[order]
    _, first, which = np.unique(place, return_index=True, return_inverse=True)
    extra = np.empty(len(fan), np.bool_)
    extra[order] = fan[order] != fan[order][first][which]
    return np.asarray(extra.reshape(-1, 3).any(axis=1), np.bool_)


def bodies(points: Float, faces: NDArray[np.integer], *, shell: Ints) -> list[list[Ints]]:
    """The bodies of one object, each as rows of faces per shell: the outer shell first, then its cavities.

    A shell of negative volume is a cavity of the smallest outer shell whose box holds its box.
    """
    numbers = np.unique(shell)
    if len(numbers) == 1:
        return [[np.arange(len(faces))]]
    rows = [np.flatnonzero(shell == number) for number in numbers]
    boxes = [(points[faces[r]].min(axis=(0, 1)), points[faces[r]].max(axis=(0, 1))) for r in rows]
    volume = np.array([signed_volume(points, faces[r]) for r in rows])
    outer = np.flatnonzero(volume > 0)
    out = {int(k): [rows[k]] for k in outer}
    for k in np.flatnonzero(volume <= 0):
        low, high = boxes[k]
        around = [o for o in outer if (boxes[o][0] <= low).all() and (boxes[o][1] >= high).all()]
        if around:
            out[int(min(around, key=lambda o: volume[o]))].append(rows[k])
        else:
            out[int(k)] = [rows[k]]
    return list(out.values())


def signed_volume(points: Float, faces: NDArray[np.integer]) -> float:
    """Volume enclosed by faces; positive if they are counter-clockwise seen from outside."""
    if not len(faces):
        return 0.0
    a, b, c = (points[faces[:, k]] - points[faces[0, 0]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)
