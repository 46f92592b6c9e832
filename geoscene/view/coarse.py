"""Coarser copies of parts of a scene, for views from far away."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geoscene.classes import Class
from geoscene.geometry.mesh import FLOOR, Mesh, ShapeInstances
from geoscene.support.splitmix import uniform_at
from geoscene.typing import Bools, Float, Ints

_ON_EDGE = 1e-6
"""Metres within which a vertex lies on a side of a box."""

_BARE = 4.0
"""Cells along a side of a cell of bare ground."""

_INSIDE, _BARE_INSIDE = 1.0, 5.0
"""Kinds of vertices of the ground inside a box; those on its sides are between them."""

_THINNEST = 0.5
"""Instances whose second-largest side is a smaller share of a cell are left out."""


def coarser_mesh(mesh: Mesh, *, cell: float, box: Sequence[float]) -> Mesh:
    """The mesh with one vertex per cube of side ``cell``, without the faces that lose their area by it.

    Vertices move by at most the diagonal of a cell, to the vertex nearest to the middle of their cell (vertex
    clustering; Rossignac and Borrel 1993). Those of solids and of surfaces are apart, and so are those on the
    sides of ``box`` (xmin, ymin, xmax, ymax): surfaces of neighbouring boxes keep their common edges without
    gaps. Vertices of bare ground alone, inside the box, stand in cells of `_BARE` sides: what lies between
    them is even. Undersides of solids are left out.
    """
    faces = mesh.faces[~(mesh.closed & (mesh.surface & 3 == FLOOR))]
    rows = np.flatnonzero(~(mesh.closed & (mesh.surface & 3 == FLOOR)))
    ground = np.zeros(len(mesh.vertices), np.bool_)
    ground[faces[~mesh.closed[rows]]] = True
    bare = ground.copy()
    bare[faces[mesh.klass[rows] != Class.TERRAIN]] = False
    kind = _apart(mesh.vertices, ground, box=box)
    kind[bare & (kind == _INSIDE)] = _BARE_INSIDE
    sides = np.where(kind == _BARE_INSIDE, _BARE * cell, cell)
    keep = _nearest(mesh.vertices, sides=sides, apart=kind)
    faces = keep[faces]
    a, b, c = faces.T
    whole = (a != b) & (b != c) & (c != a)
    faces, rows = faces[whole], rows[whole]
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    first.sort()
    kept = mesh.take(rows[first])
    used, number = np.unique(turned[first], return_inverse=True)
    return Mesh(
        mesh.vertices[used],
        number.reshape(-1, 3).astype(np.int32),
        kept.feature,
        kept.klass,
        kept.material,
        kept.surface,
        kept.color,
        kept.closed,
    )


def _apart(points: Float, ground: Bools, *, box: Sequence[float]) -> Float:
    """Number (n,) of a vertex's kind: of a solid, or of the ground, inside or on which sides of the box."""
    xmin, ymin, xmax, ymax = box
    on_x, on_y = (
        np.minimum(np.abs(points[:, axis] - low), np.abs(points[:, axis] - high)) < _ON_EDGE
        for axis, low, high in ((0, xmin, xmax), (1, ymin, ymax))
    )
    return np.where(ground, _INSIDE + on_x + 2 * on_y, 0).astype(float)


def _nearest(points: Float, *, sides: Float, apart: Float) -> Ints:
    """Row (n,) of the representative point of each point's cell, of the same side and kind."""
    place = np.floor(points / sides[:, None])
    away = np.square(points - (place + 0.5) * sides[:, None]).sum(axis=1)
    columns = (*points.T, away, *place.T, apart)
    order = np.lexsort(columns)
    keys = np.column_stack([*place.T, apart])[order]
    new = (
        np.concatenate([[True], (keys[1:] != keys[:-1]).any(axis=1)]) if len(keys) else np.empty(0, np.bool_)
    )
    out = np.empty(len(points), np.int64)
    out[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]
    return out


def fewer_instances(
    copies: ShapeInstances, sizes: Float, *, cell: float, share: float, seed: int
) -> ShapeInstances:
    """A share of the instances that are at least half a cell thick, widened so that they cover as much.

    Which are kept depends on their places and the seed alone.

    sizes : (s, 3) metres, sides of the shapes
    """
    scale = np.sqrt(np.square(copies.transform[:, :, :3]).sum(axis=1))  # (k, 3) of the shape's axes
    wide = 1.0 / np.sqrt(share)
    sides = scale * sizes[copies.shape] * np.array([wide, wide, 1.0])
    place = np.rint(copies.transform[:, :2, 3] * 100).astype(np.int64)
    drawn = uniform_at(place[:, 0], place[:, 1], count=1, seed=seed)[0]
    kept = copies.take((np.sort(sides, axis=1)[:, 1] >= _THINNEST * cell) & (drawn < share))
    matrix = kept.transform.copy()
    matrix[:, :, :2] *= wide
    return ShapeInstances(kept.shape, matrix, kept.feature)
