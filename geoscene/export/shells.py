"""Shells of solids with the cavities inside them, and unique vertices of a file written tile by tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.watertight import corner_fans, edge_uses
from geoscene.support.graphs import components
from geoscene.typing import Bools, Float, Ints

_REACH = 1000.0
"""Metres by which objects reach beyond their tile at most; equal vertices further apart are written twice."""


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


@dataclass(frozen=True, slots=True)
class _Numbered:
    """Vertices of a tile: whole coordinates (n, 3), their numbers (n,), and the tile's last column."""

    whole: Ints
    number: Ints
    last: int


class Vertices:
    """Numbers of the vertices of a file, in the order of writing.

    Vertices of tiles that no later tile reaches are forgotten, so memory does not grow with the scene.

    count : vertices so far
    low, high : (3,) float64, least and greatest coordinates so far, infinite without any
    """

    def __init__(self, tile_size: float) -> None:
        self._reach = int(np.ceil(_REACH / tile_size))
        self._near: list[_Numbered] = []
        self.count = 0
        self.low: Float = np.full(3, np.inf)
        self.high: Float = np.full(3, -np.inf)

    def add(self, whole: Ints, *, column: int, span: int = 1) -> tuple[Ints, Ints]:
        """The numbers (n,) of a tile's vertices, and those (m, 3) among them that are new, in their order.

        whole  : (n, 3) whole coordinates, each once
        column : the tile's place from west to east; tiles come column by column
        span   : columns that the tile covers
        """
        number = np.full(len(whole), -1, np.int64)
        self._near = [tile for tile in self._near if tile.last >= column - self._reach]
        for tile in self._near:
            _adopt(number, whole, known=tile)
        fresh = number < 0
        number[fresh] = self.count + np.arange(fresh.sum())
        if len(whole):
            self._near.append(_Numbered(whole, number, column + span - 1))
            self.low = np.minimum(self.low, whole.min(axis=0))
            self.high = np.maximum(self.high, whole.max(axis=0))
        self.count += int(fresh.sum())
        return number, whole[fresh]


def _adopt(number: Ints, whole: Ints, *, known: _Numbered) -> None:
    """Set the numbers (n,) of those vertices (n, 3) that are known."""
    if not len(whole):
        return
    low = np.maximum(whole.min(axis=0), known.whole.min(axis=0))
    high = np.minimum(whole.max(axis=0), known.whole.max(axis=0))
    here, there = (
        np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)) for points in (whole, known.whole)
    )
    if not len(here) or not len(there):
        return
    both = np.concatenate([known.whole[there], whole[here]])
    distinct, which = np.unique(both, axis=0, return_inverse=True)
    found = np.full(len(distinct), -1, np.int64)
    found[which.ravel()[: len(there)]] = known.number[there]
    told = found[which.ravel()[len(there) :]]
    number[here[told >= 0]] = told[told >= 0]
