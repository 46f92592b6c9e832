"""Triangle meshes with what every face is: columns, no loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.columns import Columns
from geoscene.errors import GeosceneError
from geoscene.typing import Float

OTHER, WALL, ROOF, FLOOR = 0, 1, 2, 3
"""Codes of `Mesh.surface`."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles of one or many features.

    vertices : (n, 3) float64, metres
    faces    : (m, 3) int32, counter-clockwise seen from outside (or from above)
    feature  : (m,) int32, the scene-wide feature number, -1 for none
    klass    : (m,) uint8, code of `geoscene.classes`
    material : (m,) uint8, code of `geoscene.materials`
    surface  : (m,) uint8, OTHER, WALL, ROOF or FLOOR
    color    : (m, 3) uint8, sRGB
    closed   : (m,) bool, the face belongs to a closed solid (a feature's closed faces together bound it)
    """

    vertices: Float
    faces: NDArray[np.int32]
    feature: NDArray[np.int32]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    color: NDArray[np.uint8]
    closed: NDArray[np.bool_]

    def __post_init__(self) -> None:
        """Refuse columns that disagree in length."""
        for name in ("feature", "klass", "material", "surface", "color", "closed"):
            if len(getattr(self, name)) != len(self.faces):
                raise GeosceneError(
                    f"mesh column {name} has {len(getattr(self, name))} rows for {len(self.faces)} faces"
                )

    def __len__(self) -> int:
        """Number of faces."""
        return len(self.faces)

    @classmethod
    def of(
        cls,
        vertices: Float,
        faces: NDArray[np.integer],
        *,
        feature: int | NDArray[np.integer] = -1,
        klass: int | NDArray[np.integer] = 0,
        material: int | NDArray[np.integer] = 0,
        surface: int | NDArray[np.integer] = OTHER,
        color: Sequence[int] | NDArray[np.integer] = (128, 128, 128),
        closed: bool | NDArray[np.bool_] = False,
    ) -> Mesh:
        """A mesh from vertices (n, 3) and faces (m, 3); every other column is broadcast over the faces."""
        m = len(faces)
        return cls(
            np.ascontiguousarray(vertices, np.float64).reshape(-1, 3),
            np.ascontiguousarray(faces, np.int32).reshape(-1, 3),
            np.broadcast_to(np.asarray(feature, np.int32), (m,)).copy(),
            np.broadcast_to(np.asarray(klass, np.uint8), (m,)).copy(),
            np.broadcast_to(np.asarray(material, np.uint8), (m,)).copy(),
            np.broadcast_to(np.asarray(surface, np.uint8), (m,)).copy(),
            np.broadcast_to(np.asarray(color, np.uint8), (m, 3)).copy(),
            np.broadcast_to(np.asarray(closed, np.bool_), (m,)).copy(),
        )

    @classmethod
    def empty(cls) -> Mesh:
        """A mesh without faces."""
        return cls.of(np.empty((0, 3)), np.empty((0, 3), np.int32))

    def take(self, keep: NDArray[np.bool_] | NDArray[np.integer]) -> Mesh:
        """The chosen faces, in the given order, with the vertices they use, in their old order."""
        faces = self.faces[keep]
        used, renumbered = np.unique(faces, return_inverse=True)
        columns = {
            f.name: getattr(self, f.name)[keep] for f in fields(self) if f.name not in ("vertices", "faces")
        }
        return Mesh(self.vertices[used], renumbered.reshape(-1, 3).astype(np.int32), **columns)

    def shifted(self, offset: Sequence[float] | Float) -> Mesh:
        """The mesh with every vertex moved by ``offset`` (3,), metres."""
        return replace(self, vertices=self.vertices + np.asarray(offset, float))

    def normals(self) -> Float:
        """Unit normals (m, 3); zero for a face without area."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        n = np.cross(b - a, c - a)
        length = np.linalg.norm(n, axis=1, keepdims=True)
        unit: Float = np.divide(n, length, out=np.zeros_like(n), where=length > 0)
        return unit


def concatenate(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all faces, in order; vertices are not merged."""
    if not meshes:
        return Mesh.empty()
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    columns = {
        f.name: np.concatenate([getattr(m, f.name) for m in meshes])
        for f in fields(Mesh)
        if f.name not in ("vertices", "faces")
    }
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + np.int32(s) for m, s in zip(meshes, starts, strict=True)]),
        **columns,
    )


@dataclass(frozen=True, slots=True)
class Instances(Columns):
    """Copies of shapes, such as trees.

    shape     : (k,) int32, index into the scene's shapes
    transform : (k, 3, 4) float64, shape to tile: rotation and scale, then shift
    feature   : (k,) int32
    """

    shape: NDArray[np.int32]
    transform: Float
    feature: NDArray[np.int32]

    @classmethod
    def empty(cls) -> Instances:
        """No copies."""
        return cls(np.empty(0, np.int32), np.empty((0, 3, 4)), np.empty(0, np.int32))
