"""Attributes of the surfaces of a world."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import materials
from geoscene.geometry.mesh import Mesh
from geoscene.support.columns import Columns
from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.memory import inline
from lidar.world.settings import WorldSettings

SOLID, GLASS, FOLIAGE, WATER = 1, 2, 4, 8
"""Mask bits of a world's faces, by material: ``mask=ALL & ~GLASS`` lets rays pass through windows."""

OPEN = 128
"""Bit of a material's code on faces open to the sky, in a world that is wet or under snow."""

_STEEPEST = 0.5
"""Least vertical part of the normal of a face that water and snow stay on: up to 60 degrees of slope."""

_BARE = ("glass", "water", "skin", "retroreflector")
"""Materials that the weather leaves as they are."""

_SEEN_THROUGH = {"glass": GLASS, "foliage": FOLIAGE, "conifer": FOLIAGE, "water": WATER}


@dataclass(frozen=True, slots=True)
class Surfaces(Columns):
    """Surfaces that rays hit, one row per ray; a miss has feature -1 and zero elsewhere.

    feature  : (n,) int32, feature number of the scene, or of the actor
    klass    : (n,) uint8, code of `geoscene.classes.Class`
    material : (n,) uint8, code of `geoscene.classes.Material`, with the bit `OPEN` where water or snow lies
    surface  : (n,) uint8, OTHER, WALL, ROOF or FLOOR of `geoscene.geometry.mesh`
    color    : (n, 3) uint8, sRGB
    """

    feature: NDArray[np.int32]
    klass: NDArray[np.uint8]
    material: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    color: NDArray[np.uint8]


class SurfaceFaces(NamedTuple):
    """Attributes of the faces of a world, for compiled code.

    A hit is on row ``face + start[instance]`` of ``packed``, a miss (both -1) on its last.

    start : (k + 1,) int64, first row of each instance's shape; the last is 0, the caster's own mesh
    named : (k,) int32, feature number of each instance
    packed : (m,) int64, feature << 32 | kind of leaves << 16 | class << 8 | material
    low, high : bounds of all feature numbers
    leaves : (l,) float64, m2/m3, leaf area per volume behind a face by its kind of leaves; 0 for kind 0, none
    """

    start: NDArray[np.int64]
    named: NDArray[np.int32]
    packed: NDArray[np.int64]
    low: int
    high: int
    leaves: Float


def pack_surfaces(surfaces: Surfaces, leaves: NDArray[np.integer] | None = None) -> NDArray[np.int64]:
    """The column `SurfaceFaces.packed` of surfaces and of their kinds of leaves (none by default)."""
    column = surfaces.feature.astype(np.int64) << 32
    if leaves is not None:
        column |= leaves.astype(np.int64) << 16
    column |= surfaces.klass.astype(np.int64) << 8
    column |= surfaces.material
    return column


def surfaces_at(
    table: Surfaces,
    face: NDArray[np.int32],
    instance: NDArray[np.int32],
    *,
    start: NDArray[np.int64],
    named: NDArray[np.int32],
) -> Surfaces:
    """Rows of a table of surfaces for hits (n,), as `SurfaceFaces` describes ``start`` and ``named``."""
    n = len(face)
    out = Surfaces(*(np.empty((n, *column.shape[1:]), column.dtype) for column in table.columns().values()))
    _take(tuple(table.columns().values()), face, instance, start, named, tuple(out.columns().values()))
    return out


@njit(cache=True, nogil=True)
def _take(table: Any, face: Any, instance: Any, start: Any, named: Any, out: Any) -> None:
    for i in range(len(face)):
        _take_one(table, face, instance, start, named, out, i)


@inline
def _take_one(table: Any, face: Any, instance: Any, start: Any, named: Any, out: Any, i: int) -> None:
    feature, klass, material, surface, color = table
    copy = instance[i]
    row = face[i] + start[copy]
    if row < 0:
        row += len(feature)
    out[0][i] = feature[row] if copy < 0 else named[copy]
    out[1][i], out[2][i], out[3][i] = klass[row], material[row], surface[row]
    for c in range(3):
        out[4][i, c] = color[row, c]


@njit(cache=True, nogil=True)
def label_hits(faces: SurfaceFaces, face: Any, instance: Any, klass: Any, feature: Any) -> None:
    """Fill ``klass`` and ``feature`` of hits (n,): 0 and -1 for misses."""
    start, named, rows = faces.start, faces.named, faces.packed
    for i in range(len(face)):
        copy = instance[i]
        surface = rows[face[i] + start[copy]]
        klass[i] = (surface >> 8) & 255
        feature[i] = surface >> 32 if copy < 0 else named[copy]


def surfaces_of(mesh: Mesh, settings: WorldSettings) -> Surfaces:
    """The faces of a mesh as surfaces, with the bit `OPEN` where water or snow may lie."""
    material = mesh.material
    if settings.wetness or settings.snow:
        material = material | np.where(_is_open(mesh), np.uint8(OPEN), np.uint8(0))
    return Surfaces(mesh.feature, mesh.klass, material, mesh.surface, mesh.color)


def _is_open(mesh: Mesh) -> NDArray[np.bool_]:
    """Faces (m,) that face the sky and are not of a material that the weather leaves as it is."""
    known = materials()
    up = mesh.normals()[:, 2] > _STEEPEST
    open_faces: NDArray[np.bool_] = up & ~np.isin(mesh.material, [known[name].code for name in _BARE])
    return open_faces


MISS = Surfaces(
    np.full(1, -1, np.int32),
    np.zeros(1, np.uint8),
    np.zeros(1, np.uint8),
    np.zeros(1, np.uint8),
    np.zeros((1, 3), np.uint8),
)


def mask_bits(material: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Mask bits of materials."""
    table = np.full(256, SOLID, np.uint32)
    known = materials()
    for name, bit in _SEEN_THROUGH.items():
        table[known[name].code] = bit
    return table[material]
