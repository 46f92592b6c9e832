"""Triangle meshes with one column per face attribute, and instances of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import GeosceneError
from geoscene.support.columns import Columns
from geoscene.typing import Float

OTHER, WALL, ROOF, FLOOR, WINDOW, DOOR = range(6)
"""Codes of `Mesh.surface`; panes and frames of windows and doors are in meshes with modelled facades only."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles of one or many features.

    vertices : (n, 3) float64, metres
    faces    : (m, 3) int32, counter-clockwise seen from outside (or from above)
    feature  : (m,) int32, scene-wide feature number, -1 for none
    klass    : (m,) uint8, code of `geoscene.classes`
    material : (m,) uint8, code of `geoscene.classes.Material`
    surface  : (m,) uint8, OTHER, WALL, ROOF, FLOOR, WINDOW or DOOR
    color    : (m, 3) uint8, sRGB
    closed   : (m,) bool, the face belongs to a closed solid, bounded by all closed faces of its feature
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
        """Raises GeosceneError if the columns differ in length."""
        for name in _COLUMNS:
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
        """A mesh of vertices (n, 3) and faces (m, 3); the other columns are broadcast over the faces."""
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
        """The selected faces in the given order, and the vertices they use in their original order."""
        faces = self.faces[keep]
        used = np.zeros(len(self.vertices), np.bool_)
        used[faces] = True
        number = np.cumsum(used, dtype=np.int32) - np.int32(1)
        columns = {name: getattr(self, name)[keep] for name in _COLUMNS}
        return Mesh(self.vertices[used], number[faces], **columns)

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


_COLUMNS = tuple(f.name for f in fields(Mesh) if f.name not in ("vertices", "faces"))


def concatenate(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of the faces of all meshes, in order; vertices are not merged."""
    if not meshes:
        return Mesh.empty()
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    columns = {name: np.concatenate([getattr(m, name) for m in meshes]) for name in _COLUMNS}
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + np.int32(s) for m, s in zip(meshes, starts, strict=True)]),
        **columns,
    )


@dataclass(frozen=True, slots=True)
class ShapeInstances(Columns):
    """Instances of shapes, such as trees.

    shape     : (k,) int32, index into the scene's shapes
    transform : (k, 3, 4) float64, shape to tile: [rotation and scale | translation]
    feature   : (k,) int32, scene-wide feature number
    """

    shape: NDArray[np.int32]
    transform: Float
    feature: NDArray[np.int32]

    def shifted(self, offset: Sequence[float] | Float) -> ShapeInstances:
        """The instances moved by ``offset`` (3,), metres."""
        moved = self.transform.copy()
        moved[:, :, 3] += np.asarray(offset, float)
        return replace(self, transform=moved)

    @classmethod
    def empty(cls) -> ShapeInstances:
        """No instances."""
        return cls(np.empty(0, np.int32), np.empty((0, 3, 4)), np.empty(0, np.int32))
