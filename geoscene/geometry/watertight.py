"""Checks of solids: closed, oriented 2-manifolds of positive volume that do not touch themselves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.intersections import close_faces
from geoscene.geometry.mesh import Mesh
from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float, Ints

GRID = 1e-4
"""Metres, cell size of the grid on which vertices are welded: those in one cell count as one."""

NEAR = 1e-3
"""Metres; vertices of a feature that are closer than this merge in programs that snap to a millimetre."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """Result of `check_solids`, one row per solid.

    closed     : (n,) bool, every edge has exactly two faces after welding
    oriented   : (n,) bool, adjacent faces run along their common edge in opposite directions
    degenerate : (n,) int64, faces without area after welding
    fans       : (n,) int64, vertices whose faces are connected only in the vertex itself
    crossings  : (n,) int64, pairs of faces that cross or touch outside their common vertices and edges
    near       : (n,) int64, pairs of vertices less than 1 mm apart
    close      : (n,) int64, pairs of faces that may cross once their coordinates are rounded (`CLEARANCE`)
    volume     : (n,) float64, signed, cubic metres
    """

    closed: Bools
    oriented: Bools
    degenerate: Ints
    fans: Ints
    crossings: Ints
    near: Ints
    close: Ints
    volume: Float

    @property
    def positive(self) -> Bools:
        """(n,) bool, the signed volume is positive."""
        return np.asarray(self.volume > 0, np.bool_)

    @property
    def closed_solid(self) -> Bools:
        """(n,) bool, the surface is closed, oriented, without degenerate faces, and of positive volume."""
        return np.asarray(self.closed & self.oriented & (self.degenerate == 0) & self.positive, np.bool_)

    @property
    def valid(self) -> Bools:
        """(n,) bool, the solid has no fault but, perhaps, close faces."""
        return np.asarray(self.closed_solid & (self.fans + self.crossings + self.near == 0), np.bool_)

    @property
    def ok(self) -> Bools:
        """(n,) bool, the solid has no fault."""
        return np.asarray(self.valid & (self.close == 0), np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshVerdict(Findings):
    """Result of the checks of a mesh, one row per feature with closed faces, in order of feature number.

    A feature with a vertex that is not finite is not closed, and its volume is NaN.

    feature : (n,) int32
    faces   : (n,) int64, number of faces
    finite  : (n,) bool, no vertex is NaN or infinite
    """

    feature: NDArray[np.int32]
    faces: Ints
    finite: Bools

    def __len__(self) -> int:
        """Number of features."""
        return len(self.feature)

    def fault(self, row: int) -> str:
        """The first failed check of a feature as a slug, "" if it passes all."""
        checks = (
            ("not-finite", self.finite[row]),
            ("degenerate-faces", self.degenerate[row] == 0),
            ("not-closed", self.closed[row]),
            ("not-oriented", self.oriented[row]),
            ("no-volume", self.positive[row]),
            ("touches-in-a-vertex", self.fans[row] == 0),
            ("self-intersection", self.crossings[row] == 0),
            ("vertices-within-1-mm", self.near[row] == 0),
            ("faces-within-0.02-mm", self.close[row] == 0),
        )
        return next((slug for slug, passed in checks if not passed), "")


def weld(points: Float, owner: NDArray[np.integer], *, grid: float = GRID) -> tuple[Ints, Ints]:
    """Id (n,) of each point, equal for points of one owner in one grid cell, and the first point of each id.

    points : (n, 3) metres, finite, within 1e5 m of the origin
    """
    cell = grid_cells(points, grid=grid)
    x, y, z = (axis - axis.min(initial=0) for axis in cell.T)
    # products of ranges within 2e9 steps stay below 2**63
    keys = y * (z.max(initial=0) + 1) + z, owner.astype(np.int64) * (x.max(initial=0) + 1) + x
    order = np.lexsort(keys)
    new = np.zeros(len(order), np.bool_)
    for key in keys:
        ordered = key[order]
        new |= np.diff(ordered, prepend=ordered[:1] - 1) != 0
    ids = np.empty(len(order), np.int64)
    ids[order] = np.cumsum(new) - 1
    return ids, order[new]


def edge_uses(corners: Ints) -> tuple[Ints, Ints, Ints]:
    """Edge number of every half-edge (3 m,), and of each edge the number and the balance of its half-edges.

    corners : (m, 3) welded vertex ids. Half-edge k of face i is number 3 i + k and goes from corner k to
              corner k + 1; the balance counts half-edges of one direction as +1, those of the other as -1.
    """
    start, stop = corners.ravel(), np.roll(corners, -1, axis=1).ravel()
    low, high = np.minimum(start, stop), np.maximum(start, stop)
    # of ids, so the product stays below 2**63
    _, edge, uses = np.unique(low * (high.max(initial=0) + 1) + high, return_inverse=True, return_counts=True)
    balance = np.bincount(edge, weights=np.sign(stop - start), minlength=len(uses)).astype(np.int64)
    return edge, uses, balance


def degenerate_faces(points: Float, faces: NDArray[np.integer], *, grid: float = GRID) -> Bools:
    """(m,) bool: the three corners, rounded to the grid, are collinear."""
    cell = grid_cells(points, grid=grid)
    a, b, c = (cell[faces[:, k]] for k in range(3))
    # the cross product is exact for differences below 2**31 grid cells (200 km)
    return np.asarray(~np.cross(b - a, c - a).any(axis=1), np.bool_)


def corner_fans(corners: Ints) -> Ints:
    """Fan (3 m,) of each corner of each face: faces around a vertex that edges connect form a fan.

    corners : (m, 3) welded vertex ids
    """
    return _fans(corners.ravel(), edge_uses(corners)[0])


@njit(cache=True, nogil=True)
def _fans(vertex: Ints, edge: Ints) -> Ints:
    """The fans of corners (3 m,), given their vertices and the edges of their half-edges."""
    size = len(edge)
    parent, first = np.arange(size), np.full(size, -1)
    for half in range(size):
        one = first[edge[half]]
        if one < 0:
            first[edge[half]] = half
            continue
        # an edge joins its faces at both ends
        after, beyond = half - 2 if half % 3 == 2 else half + 1, one - 2 if one % 3 == 2 else one + 1
        same = vertex[half] == vertex[one]
        for a, b in ((half, one if same else beyond), (after, beyond if same else one)):
            roots = _root(parent, a), _root(parent, b)
            parent[max(roots)] = min(roots)
    fan = np.empty(size, np.int64)
    count = 0
    for corner in range(size):
        root = _root(parent, corner)
        if root == corner:  # the first of its fan
            fan[corner] = count
            count += 1
        else:
            fan[corner] = fan[root]
    return fan


@njit(cache=True, nogil=True)
def _root(parent: Ints, k: int) -> int:
    """The root of a row in a forest; paths to it become shorter."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


def vertex_fans(corners: Ints) -> Ints:
    """Vertices (k,) whose faces form several fans, connected by edges only within each.

    corners : (m, 3) welded vertex ids
    """
    _, first = np.unique(corner_fans(corners), return_index=True)
    vertex, fans = np.unique(corners.ravel()[first], return_counts=True)
    found: Ints = vertex[fans > 1]
    return found


def near_vertices(cells: Ints, owner: NDArray[np.integer], *, steps: int) -> Ints:
    """Pairs (k, 2) of different points of one owner less than ``steps`` grid steps apart.

    cells : (n, 3) whole grid numbers
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    # owners are set apart in a fourth dimension
    apart = np.column_stack([cells - cells.min(axis=0, initial=0), owner * (2.0 * steps)])
    pairs = cKDTree(apart).query_pairs(steps, output_type="ndarray").astype(np.int64)
    squared = ((cells[pairs[:, 0]] - cells[pairs[:, 1]]) ** 2).sum(axis=1)
    chosen: Ints = pairs[(squared > 0) & (squared < steps**2)]
    return chosen


def grid_cells(points: Float, *, grid: float = GRID) -> Ints:
    """Whole grid numbers (n, 3) of points (n, 3)."""
    return np.rint(points * (1.0 / grid)).astype(np.int64)


def validate_mesh(mesh: Mesh, *, grid: float = GRID) -> MeshVerdict:
    """Check every feature that has closed faces (`Mesh.closed`).

    Vertices of a feature in one grid cell count as one, because files with rounded coordinates merge them.
    """
    rows = np.flatnonzero(mesh.closed)
    feature, owner = np.unique(mesh.feature[rows], return_inverse=True)
    finite_face = np.isfinite(mesh.vertices[mesh.faces[rows]]).all(axis=(1, 2))
    n = len(feature)
    finite = np.bincount(owner, weights=~finite_face, minlength=n) == 0
    checked = finite[owner]
    corners = mesh.vertices[mesh.faces[rows[checked]]]
    found = check_solids(corners, owner[checked].astype(np.int64), n=n, grid=grid)
    return MeshVerdict(
        feature=feature.astype(np.int32),
        faces=np.bincount(owner, minlength=n),
        finite=finite,
        closed=found.closed & finite,
        oriented=found.oriented & finite,
        degenerate=found.degenerate,
        fans=found.fans,
        crossings=found.crossings,
        near=found.near,
        close=found.close,
        volume=np.where(finite, found.volume, np.nan),
    )


def check_solids(corners: Float, owner: Ints, *, n: int, grid: float = GRID) -> Findings:
    """Checks of n solids, given the corners (m, 3, 3) of their triangles and the solid (m,) of each.

    Solids that are not closed or have degenerate faces are not searched for further faults.
    """
    if not len(corners):  # most tiles of wide maps have no solids
        none = np.zeros(n, np.int64)
        return Findings(
            closed=none == 0,
            oriented=none == 0,
            degenerate=none,
            fans=none,
            crossings=none,
            near=none,
            close=none,
            volume=np.zeros(n),
        )
    ids, first = weld(corners.reshape(-1, 3), np.repeat(owner, 3), grid=grid)
    points, triangles = corners.reshape(-1, 3)[first], ids.reshape(-1, 3)
    edge, uses, balance = edge_uses(triangles)
    edge_owner = np.zeros(len(uses), np.int64)
    edge_owner[edge] = np.repeat(owner, 3)
    closed = np.bincount(edge_owner, weights=uses != 2, minlength=n) == 0
    oriented = np.bincount(edge_owner, weights=balance != 0, minlength=n) == 0
    flat = degenerate_faces(points, triangles, grid=grid)
    degenerate = np.bincount(owner, weights=flat, minlength=n).astype(np.int64)

    whole = (closed & oriented & (degenerate == 0))[owner]
    cells, of = grid_cells(points, grid=grid), np.repeat(owner, 3)[first]
    fans = np.bincount(of[vertex_fans(triangles[whole])], minlength=n)
    pairs, crossing = close_faces(cells, triangles[whole], owner=owner[whole])
    of_pair = owner[whole][pairs[:, 0]]
    near = np.bincount(of[near_vertices(cells, of, steps=round(NEAR / grid))[:, 0]], minlength=n)
    volume = volumes(points[triangles], owner=owner, n=n)
    return Findings(
        closed=closed,
        oriented=oriented,
        degenerate=degenerate,
        fans=fans,
        crossings=np.bincount(of_pair[crossing], minlength=n),
        near=near,
        close=np.bincount(of_pair[~crossing], minlength=n),
        volume=volume,
    )


def volumes(corners: Float, *, owner: NDArray[np.integer], n: int) -> Float:
    """Signed volume (n,) of each owner's closed triangles (m, 3, 3), about its first corner for precision."""
    if not len(corners):
        return np.zeros(n)
    anchor = np.zeros((n, 3))
    anchor[owner[::-1]] = corners[::-1, 0]
    a, b, c = np.moveaxis(corners - anchor[owner, None], 1, 0)
    sixfold = np.bincount(owner, weights=np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=n)
    return np.asarray(sixfold / 6.0, float)
