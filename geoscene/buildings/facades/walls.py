"""Finds the flat upright walls among the faces of buildings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.geometry.mesh import WALL, Mesh
from geoscene.geometry.watertight import edge_uses, weld
from geoscene.support.columns import Columns
from geoscene.support.graphs import components
from geoscene.typing import Bools, Float, Ints

_UPRIGHT = 1e-3
"""Maximum vertical component of the unit normal of an upright face."""

_TURN = 1e-3
"""Radians between the bearings of faces of one plane, above the error of corners on a grid of 0.1 mm."""


@dataclass(frozen=True, slots=True)
class FacadeWalls(Columns):
    """Flat upright walls, sorted by feature: connected faces of one feature in one plane.

    feature : (k,) int32
    foot    : (k, 3) lower left corner, seen from outside, of the rectangle around the wall
    tangent : (k, 2) horizontal unit vector to the right, seen from outside
    size    : (k, 2) width and height of that rectangle, metres
    polygon : (k,) shapely polygon in the wall's coordinates (x right, y up from foot); None where the wall is
              the rectangle
    """

    feature: NDArray[np.int32]
    foot: Float
    tangent: Float
    size: Float
    polygon: NDArray[np.object_]

    @property
    def outwards(self) -> Float:
        """(k, 2) horizontal unit vectors that point out of the building."""
        return np.stack([self.tangent[:, 1], -self.tangent[:, 0]], axis=1)

    def points(self, wall: Ints, u: Float, *, out: Float | float = 0.0) -> Float:
        """Plan coordinates (n, 2) of points at ``u`` metres along walls (n,) and ``out`` metres outside."""
        away = np.broadcast_to(np.asarray(out, float), u.shape)[:, None]
        return self.foot[wall, :2] + u[:, None] * self.tangent[wall] + away * self.outwards[wall]


def find_walls(mesh: Mesh) -> tuple[FacadeWalls, NDArray[np.int32]]:
    """The walls of a mesh of buildings, and the row (m,) of the wall of each face, -1 for none."""
    normal = mesh.normals()
    corners = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    face = np.flatnonzero((mesh.surface == WALL) & (np.abs(normal[:, 2]) < _UPRIGHT) & (area > 0))
    of_face = np.full(len(mesh), -1, np.int32)
    if not len(face):
        return _none(), of_face
    wall = _connect(corners[face], _bearings(normal[face, :2], feature=mesh.feature[face]))
    walls, number = _measure(
        corners[face], normal[face, :2], feature=mesh.feature[face], wall=wall, area=area[face]
    )
    of_face[face] = number
    return walls, of_face


def _none() -> FacadeWalls:
    return FacadeWalls(
        np.empty(0, np.int32), np.empty((0, 3)), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, object)
    )


def _bearings(normal: Float, *, feature: NDArray[np.int32]) -> Ints:
    """Number (m,) of the feature and bearing of each face; connected faces of one bearing are in one plane.

    Sorting and splitting at gaps groups values that differ by rounding errors; rounded keys would not.
    """
    turn = np.arctan2(normal[:, 1], normal[:, 0])
    turn = np.where(turn > np.pi - _TURN, turn - 2 * np.pi, turn)
    order = np.lexsort((turn, feature))
    bearing = np.empty(len(turn), np.int64)
    bearing[order] = _runs(feature[order], turn[order], gap=_TURN)
    return bearing


def _runs(key: NDArray[np.integer], value: Float, *, gap: float) -> Ints:
    """Numbers (n,) of the runs in sorted rows: a new one where the key changes or the value jumps."""
    numbers = np.zeros(len(key), np.int64)
    np.cumsum((np.diff(key) != 0) | (np.diff(value) > gap), out=numbers[1:])
    return numbers


def _of_largest(value: Float, *, group: Ints, area: Float) -> Float:
    """The value (k, ...) of the largest face of each group."""
    order = np.lexsort((area, group))
    last = np.flatnonzero(np.diff(group[order], append=-1) != 0)
    largest: Float = value[order[last]]
    return largest


def _connect(corners: Float, bearing: Ints) -> Ints:
    """Number (m,) of the wall of each face: faces of one bearing that edges connect."""
    ids, _ = weld(corners.reshape(-1, 3), np.repeat(bearing, 3))
    edge, uses, _ = edge_uses(ids.reshape(-1, 3))
    face, m = np.repeat(np.arange(len(bearing)), 3), len(bearing)
    return components(face, m + edge, count=m + len(uses))[:m]


def _measure(
    corners: Float, normal: Float, *, feature: NDArray[np.int32], wall: Ints, area: Float
) -> tuple[FacadeWalls, Ints]:
    """The walls, sorted by feature and place, and the row (m,) of each face."""
    _, first, wall = np.unique(wall, return_index=True, return_inverse=True)
    k = len(first)
    out = _of_largest(normal, group=wall, area=area)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    tangent = np.stack([-out[:, 1], out[:, 0]], axis=1)
    along = np.einsum("ijk,ik->ij", corners[:, :, :2], tangent[wall])
    anchor = _of_largest(corners[:, 0, :2], group=wall, area=area)
    away = np.einsum("ij,ij->i", anchor, out)
    left, right, low, high = np.full(k, np.inf), np.full(k, -np.inf), np.full(k, np.inf), np.full(k, -np.inf)
    np.minimum.at(left, wall, along.min(axis=1))
    np.maximum.at(right, wall, along.max(axis=1))
    np.minimum.at(low, wall, corners[:, :, 2].min(axis=1))
    np.maximum.at(high, wall, corners[:, :, 2].max(axis=1))
    foot = np.column_stack([left[:, None] * tangent + away[:, None] * out, low])
    order = np.lexsort((foot[:, 2], foot[:, 1], foot[:, 0], feature[first]))
    row = np.empty(k, np.int64)
    row[order] = np.arange(k)
    size = np.column_stack([right - left, high - low])
    walls = FacadeWalls(feature[first], foot, tangent, size, np.full(k, None, object)).take(order)
    return replace(walls, polygon=_polygons(walls, corners, wall=row[wall], area=area)), row[wall]


def _polygons(walls: FacadeWalls, corners: Float, *, wall: Ints, area: Float) -> NDArray[np.object_]:
    """The polygons (k,) of walls that are no rectangles, None for the others."""
    total = np.bincount(wall, weights=area, minlength=len(walls))
    odd: Bools = np.abs(total - walls.size.prod(axis=1)) > 1e-3
    polygons = np.full(len(walls), None, object)
    rows = np.flatnonzero(odd[wall])
    rows = rows[np.argsort(wall[rows], kind="stable")]
    if not len(rows):
        return polygons
    of = wall[rows]
    flat = corners[rows, :, :2] - walls.foot[of, None, :2]
    uv = np.stack(
        [
            np.einsum("ijk,ik->ij", flat, walls.tangent[of]),
            corners[rows, :, 2] - walls.foot[of, 2, None],
        ],
        axis=2,
    )
    pieces = shapely.polygons(np.round(uv, 4))
    for some in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(of)) + 1):
        polygons[of[some[0]]] = shapely.union_all(pieces[some], grid_size=1e-4)
    return polygons
