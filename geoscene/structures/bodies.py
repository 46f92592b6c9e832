"""Closed bodies in tunnels: on a foot, between two rings of corners, or along rings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.mesh import Mesh
from geoscene.structures.heights import surface_heights
from geoscene.structures.table import Structures
from geoscene.typing import Float

_RING = np.array([[0, 1, 2], [0, 2, 3]])


def body(
    table: Structures,
    k: int,
    *,
    rings: Sequence[Float],
    caps: NDArray[np.int64],
    klass: Class = Class.TUNNEL,
    material: str = "concrete",
) -> Mesh:
    """The closed body between two rings (n, 3) of corners, turned outside.

    rings : two
    caps  : (m, 3) corners of the triangles that close the first ring
    """
    front, back = rings
    n = len(front)
    one = np.arange(n)
    two = np.roll(one, -1)
    faces = np.concatenate(
        [
            caps,
            caps[:, ::-1] + n,
            np.column_stack([one, one + n, two]),
            np.column_stack([two, one + n, two + n]),
        ]
    )
    vertices = np.concatenate([front, back])
    return _solid(table, k, vertices=vertices, faces=faces, klass=klass, material=material)


def upright(
    table: Structures,
    k: int,
    *,
    foot: Float,
    low: float,
    top: float,
    klass: Class = Class.TUNNEL,
    material: str = "concrete",
) -> Mesh:
    """A body over a foot (4, 2) between two heights above the carriageway."""
    floor = surface_heights(table, k, xy=foot)
    rings = [np.column_stack([foot, floor + z]) for z in (low, top)]
    return body(table, k, rings=rings, caps=_RING, klass=klass, material=material)


def swept(table: Structures, k: int, *, rings: Float) -> Mesh:
    """The closed body along rings (n, 4, 3) of corners."""
    n = len(rings)
    one = np.arange(4)
    two = np.roll(one, -1)
    step = 4 * np.arange(n - 1)[:, None, None]
    quads = np.stack([np.column_stack([one, one + 4, two]), np.column_stack([two, one + 4, two + 4])])
    sides = (quads.reshape(-1, 3)[None] + step).reshape(-1, 3)
    faces = np.concatenate([_RING, _RING[:, ::-1] + 4 * (n - 1), sides])
    vertices = rings.reshape(-1, 3)
    return _solid(table, k, vertices=vertices, faces=faces, klass=Class.TUNNEL, material="metal")


def _solid(
    table: Structures, k: int, *, vertices: Float, faces: NDArray[np.int64], klass: Class, material: str
) -> Mesh:
    """A closed mesh of consistently oriented faces, turned outside."""
    a, b, c = (vertices[faces[:, j]] - vertices[0] for j in range(3))
    if (np.cross(a, b) * c).sum() < 0:
        faces = faces[:, ::-1]
    of = materials()[material]
    return Mesh.of(
        vertices,
        faces,
        feature=int(table.feature[k]),
        klass=klass,
        material=of.code,
        color=of.color,
        closed=True,
    )
