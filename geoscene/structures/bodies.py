"""Closed bodies in tunnels: on feet, between two rings of corners, or along rings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.structures.heights import surface_heights
from geoscene.structures.table import Structures
from geoscene.typing import Bools, Float, Ints

_RING = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, slots=True)
class Bodies:
    """Closed bodies, each with vertices of its own.

    mesh : of all of them, one after another
    size : (n,) faces of each
    """

    mesh: Mesh
    size: Ints

    def __len__(self) -> int:
        """Number of bodies."""
        return len(self.size)

    def take(self, keep: Bools) -> Bodies:
        """The bodies at which a mask (n,) is true."""
        return Bodies(self.mesh.take(np.repeat(keep, self.size)), self.size[keep])

    @classmethod
    def empty(cls) -> Bodies:
        """No bodies."""
        return cls(Mesh.empty(), np.empty(0, np.int64))

    @classmethod
    def joined(cls, some: Sequence[Bodies]) -> Bodies:
        """The bodies of one or more tables, in order."""
        return cls(
            concatenate([bodies.mesh for bodies in some]), np.concatenate([bodies.size for bodies in some])
        )


def between_rings(
    table: Structures,
    k: int,
    *,
    rings: Float,
    caps: NDArray[np.int64],
    klass: Class = Class.TUNNEL,
    material: str = "concrete",
) -> Bodies:
    """The closed bodies between two rings of corners each, turned outside.

    rings : (n, 2, c, 3)
    caps  : (m, 3) corners of the triangles that close the first ring
    """
    n = rings.shape[2]
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
    vertices = rings.reshape(len(rings), 2 * n, 3)
    return _solids(table, k, vertices=vertices, faces=faces, klass=klass, material=material)


def uprights(
    table: Structures,
    k: int,
    *,
    feet: Float,
    low: float | Float,
    top: float | Float,
    klass: Class = Class.TUNNEL,
    material: str = "concrete",
) -> Bodies:
    """Bodies over feet (n, 4, 2), each between two heights above the carriageway."""
    floor = surface_heights(table, k, xy=feet.reshape(-1, 2)).reshape(-1, 4)
    ends = np.stack([floor + np.reshape(z, (-1, 1)) for z in (low, top)], axis=1)
    rings = np.concatenate([np.repeat(feet[:, None], 2, axis=1), ends[..., None]], axis=-1)
    return between_rings(table, k, rings=rings, caps=_RING, klass=klass, material=material)


def swept(table: Structures, k: int, *, rings: Float) -> Bodies:
    """The closed body along rings (n, 4, 3) of corners."""
    n = len(rings)
    one = np.arange(4)
    two = np.roll(one, -1)
    step = 4 * np.arange(n - 1)[:, None, None]
    quads = np.stack([np.column_stack([one, one + 4, two]), np.column_stack([two, one + 4, two + 4])])
    sides = (quads.reshape(-1, 3)[None] + step).reshape(-1, 3)
    faces = np.concatenate([_RING, _RING[:, ::-1] + 4 * (n - 1), sides])
    return _solids(
        table, k, vertices=rings.reshape(1, -1, 3), faces=faces, klass=Class.TUNNEL, material="metal"
    )


def _solids(
    table: Structures, k: int, *, vertices: Float, faces: NDArray[np.int64], klass: Class, material: str
) -> Bodies:
    """Closed bodies of vertices (n, v, 3) and consistently oriented faces (m, 3) of each, turned outside."""
    n, count, _ = vertices.shape
    a, b, c = (vertices[:, faces[:, j]] - vertices[:, :1] for j in range(3))
    inward = (np.cross(a, b) * c).sum(axis=(1, 2)) < 0
    turned = np.where(inward[:, None, None], faces[:, ::-1], faces)
    of = materials()[material]
    mesh = Mesh.of(
        vertices.reshape(-1, 3),
        (turned + count * np.arange(n)[:, None, None]).reshape(-1, 3),
        feature=int(table.feature[k]),
        klass=klass,
        material=of.code,
        color=of.color,
        closed=True,
    )
    return Bodies(mesh, np.full(n, len(faces)))
