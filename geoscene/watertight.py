"""Checks of solids: closed, consistently oriented, of positive volume, without degenerate faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.mesh import Mesh
from geoscene.typing import Float, Ints

GRID = 1e-4
"""Metres, cell size of the grid on which vertices are welded: those in one cell count as one."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of the checks, one row per feature with closed faces, in order of feature number.

    feature    : (n,) int32
    faces      : (n,) int64, number of faces
    finite     : (n,) bool, no vertex is NaN or infinite
    closed     : (n,) bool, every edge has exactly two faces after welding
    oriented   : (n,) bool, adjacent faces run along their common edge in opposite directions
    positive   : (n,) bool, the signed volume is positive
    degenerate : (n,) int64, faces without area after welding
    volume     : (n,) float64, cubic metres; NaN where not finite
    """

    feature: NDArray[np.int32]
    faces: Ints
    finite: NDArray[np.bool_]
    closed: NDArray[np.bool_]
    oriented: NDArray[np.bool_]
    positive: NDArray[np.bool_]
    degenerate: Ints
    volume: Float

    def __len__(self) -> int:
        """Number of features."""
        return len(self.feature)

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(n,) bool, the feature passes all checks."""
        passed = self.finite & self.closed & self.oriented & self.positive & (self.degenerate == 0)
        return np.asarray(passed, np.bool_)

    def fault(self, row: int) -> str:
        """The first failed check of a feature as a slug, "" if it passes all."""
        checks = (
            ("not-finite", self.finite[row]),
            ("degenerate-faces", self.degenerate[row] == 0),
            ("not-closed", self.closed[row]),
            ("not-oriented", self.oriented[row]),
            ("no-volume", self.positive[row]),
        )
        return next((slug for slug, passed in checks if not passed), "")


def _pair_ids(a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """Numbers 0..k-1 of the distinct pairs (a, b), and the first index of each."""
    # a and b are ids or grid numbers, so the product stays below 2**63
    low = b.min(initial=0)
    key = a * (b.max(initial=0) - low + 1) + (b - low)
    _, first, ids = np.unique(key, return_index=True, return_inverse=True)
    return ids.astype(np.int64), first


def weld(points: Float, owner: NDArray[np.integer], *, grid: float = GRID) -> tuple[Ints, Ints]:
    """Id (n,) of each point, equal for points of one owner in one grid cell, and the first point of each id.

    points : (n, 3) metres, finite, within 1e5 m of the origin
    """
    cell = np.rint(points * (1.0 / grid)).astype(np.int64)
    cell -= cell.min(axis=0, initial=np.iinfo(np.int64).max, keepdims=True) if len(cell) else 0
    ids, _ = _pair_ids(cell[:, 0], cell[:, 1])
    ids, _ = _pair_ids(ids, cell[:, 2])
    return _pair_ids(owner.astype(np.int64), ids)


def edge_uses(corners: Ints) -> tuple[Ints, Ints, Ints]:
    """Edge number of every half-edge (3 m,), and of each edge the number and the balance of its half-edges.

    corners : (m, 3) welded vertex ids. Half-edge k of face i is number 3 i + k and goes from corner k to
              corner k + 1; the balance counts half-edges of one direction as +1, those of the other as -1.
    """
    start, stop = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    edge, first = _pair_ids(np.minimum(start, stop), np.maximum(start, stop))
    uses = np.bincount(edge, minlength=len(first))
    balance = np.bincount(edge, weights=np.sign(stop - start), minlength=len(first)).astype(np.int64)
    return edge, uses, balance


def degenerate_faces(points: Float, faces: NDArray[np.integer], *, grid: float = GRID) -> NDArray[np.bool_]:
    """(m,) bool: the three corners, rounded to the grid, are collinear."""
    cell = np.rint(points * (1.0 / grid)).astype(np.int64)
    a, b, c = (cell[faces[:, k]] for k in range(3))
    # the cross product is exact for differences below 2**31 grid cells (200 km)
    return np.asarray(~np.cross(b - a, c - a).any(axis=1), np.bool_)


def validate_mesh(mesh: Mesh, *, grid: float = GRID) -> Verdict:
    """Check every feature that has closed faces (`Mesh.closed`).

    Vertices of a feature in one grid cell count as one, because files with rounded coordinates merge them.
    """
    rows = np.flatnonzero(mesh.closed)
    faces = mesh.faces[rows].astype(np.int64)
    feature, owner = np.unique(mesh.feature[rows], return_inverse=True)
    n = len(feature)

    finite_face = np.isfinite(mesh.vertices[faces]).all(axis=(1, 2))
    finite = np.bincount(owner, weights=~finite_face, minlength=n) == 0
    checked = finite[owner]
    corners, owners = mesh.vertices[faces[checked]].reshape(-1, 3), np.repeat(owner[checked], 3)
    ids, first = weld(corners, owners, grid=grid)
    points, triangles = corners[first], ids.reshape(-1, 3)
    owner_of = owner[checked]

    edge, uses, balance = edge_uses(triangles)
    edge_owner = np.zeros(len(uses), np.int64)
    edge_owner[edge] = np.repeat(owner_of, 3)
    closed = np.bincount(edge_owner, weights=uses != 2, minlength=n) == 0
    oriented = np.bincount(edge_owner, weights=balance != 0, minlength=n) == 0
    degenerate = np.bincount(owner_of, weights=degenerate_faces(points, triangles, grid=grid), minlength=n)

    volume = np.full(n, np.nan)
    volume[finite] = _volumes(points, triangles, owner=owner_of, n=n)[finite]
    return Verdict(
        feature.astype(np.int32),
        np.bincount(owner, minlength=n),
        finite,
        closed & finite,
        oriented & finite,
        volume > 0,
        degenerate.astype(np.int64),
        volume,
    )


def _volumes(points: Float, triangles: Ints, *, owner: Ints, n: int) -> Float:
    """Signed volume (n,) of each owner's triangles, summed about its first vertex for precision."""
    if not len(triangles):
        return np.zeros(n)
    anchor = np.zeros((n, 3))
    anchor[owner[::-1]] = points[triangles[::-1, 0]]
    a, b, c = (points[triangles[:, k]] - anchor[owner] for k in range(3))
    sixfold = np.bincount(owner, weights=np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=n)
    return np.asarray(sixfold / 6.0, float)
