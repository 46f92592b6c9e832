"""Targets of rays: triangles with their planes, and instances of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.box_tree import Tree, tree_of
from lidar.raycast.hull import LONG, NARROW, displacements, margins_of, patches

ALL = 0xFFFFFFFF
"""The mask that includes every face."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """Triangles with one mask, and their planes.

    vertices : (n, 3) float64, metres, relative to the caster's origin
    hull     : (n + 3 p, 3) float32, the same, moved outwards, and corners of p patches (see
               `lidar.raycast.hull`): for Embree
    faces    : (m, 3) int32
    planes   : (m + p, 5) float64: unit normal n and offset d of each face; n @ x = d on it; zeros for zero
               area and patches; and its margin: a hit whose barycentric coordinates, times the cosine of
               incidence, are at least this is on the face also in float64; inf where a corner moved far along
               n
    numbers  : (m + p,) int32, `Hits.face` of each face minus ``first``, 0 for patches; empty: consecutive
    first    : number of the first face
    tree     : of the faces' boxes
    mask     : bits; rays hit the faces if their masks share one
    """

    vertices: Float
    hull: NDArray[np.float32]
    faces: NDArray[np.int32]
    planes: Float
    numbers: NDArray[np.int32]
    tree: Tree
    first: int = 0
    mask: int = ALL

    def __len__(self) -> int:
        """Number of faces."""
        return len(self.faces)


def middle(vertices: Float) -> Float:
    """Centre (3,) of the extent of vertices (n, 3), rounded to metres: an origin for them."""
    return np.round((vertices.min(axis=0) + vertices.max(axis=0)) / 2) if len(vertices) else np.zeros(3)


def check_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Float, NDArray[np.int32]]:
    """Vertices (n, 3) float64 and faces (m, 3) int32, contiguous.

    Raises InputError for vertices that are not finite and for vertex numbers out of range.
    """
    v = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3)
    f = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    if not np.isfinite(v).all():
        bad = int(np.argmax(~np.isfinite(v).all(axis=1)))
        raise InputError(f"vertex {bad} of {len(v)} is {v[bad].tolist()}: rays need finite vertices")
    if len(f) and not (f.min() >= 0 and f.max() < len(v)):
        bad = int(np.argmax(((f < 0) | (f >= len(v))).any(axis=1)))
        raise InputError(f"face {bad} names the vertices {f[bad].tolist()} of {len(v)}")
    return v, f


def planes(vertices: Float, faces: NDArray[np.int32]) -> Float:
    """The planes and margins (m, 5) of faces, for margins of 1 m; see `Geometry.planes`."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
    out = np.zeros((len(faces), 5))
    np.divide(normal, length, out=out[:, :3], where=length > 0)
    out[:, 3] = np.einsum("ij,ij->i", out[:, :3], a)
    longest = np.maximum(np.maximum(_square(b - a), _square(c - b)), _square(a - c))
    out[:, 4] = np.divide(
        np.sqrt(longest), length[:, 0], out=np.full(len(faces), np.inf), where=length[:, 0] > 0
    )
    return out


def _square(vectors: Float) -> Float:
    out: Float = np.einsum("ij,ij->i", vectors, vectors)
    return out


def split(vertices: Float, faces: NDArray[np.int32], *, mask: ArrayLike | None = None) -> list[Geometry]:
    """Geometries of checked vertices and faces, relative to the origin: one for each distinct mask.

    mask : (m,) bits, or one number for all faces; all bits by default
    """
    bits = np.broadcast_to(np.asarray(ALL if mask is None else mask, np.uint32), (len(faces),))
    found = np.unique(bits)
    whole, margins = planes(vertices, faces), margins_of(vertices)
    moved = displacements(vertices, faces, whole)
    if len(found) == 1:
        return [_geometry(vertices, faces, whole, margins=margins, moved=moved, mask=int(found[0]))]
    out = []
    for one in found:
        rows = np.flatnonzero(bits == one)
        used, renumbered = np.unique(faces[rows], return_inverse=True)
        corners: NDArray[np.int32] = np.ascontiguousarray(renumbered.reshape(-1, 3), np.int32)
        part = _geometry(
            vertices[used], corners, whole[rows], margins=margins[used], moved=moved[used], mask=int(one)
        )
        numbers = np.zeros(len(part.planes), np.int32)
        numbers[: len(rows)] = rows
        out.append(replace(part, numbers=numbers))
    return out


def _geometry(
    vertices: Float, faces: NDArray[np.int32], whole: Float, *, margins: Float, moved: Float, mask: int
) -> Geometry:
    """The geometry of faces with planes (m, 5) for margins of 1 m, and of displacements (n, 3) in margins."""
    length = np.sqrt(_square(moved))
    # Rounding shifts an edge by one margin at most, in addition to its ends' displacements.
    share = whole[:, 4] * (margins * (1 + length))[faces].max(axis=1, initial=0.0)
    places = vertices + margins[:, None] * moved
    extra = patches(places, faces[(share > NARROW) & (share < np.inf)], margins=margins, moved=moved)
    outwards = [np.einsum("ij,ij->i", moved[faces[:, k]], whole[:, :3]) for k in range(3)]
    share[np.max(outwards, axis=0) > LONG] = np.inf
    rows = np.zeros((len(faces) + len(extra), 5))
    rows[: len(faces)] = np.column_stack([whole[:, :4], share])
    hull = np.concatenate([places, extra.reshape(-1, 3)]).astype(np.float32)
    return Geometry(vertices, hull, faces, rows, np.empty(0, np.int32), _tree(vertices, faces), mask=mask)


def _tree(vertices: Float, faces: NDArray[np.int32]) -> Tree:
    corners = vertices[faces]
    return tree_of(corners.min(axis=1), corners.max(axis=1))


class Instanced(Protocol):
    """A `lidar.raycast.Caster` whose mesh is instanced: its scene, and its own instances."""

    scene: Any
    instances: tuple[MeshInstances, ...]


@dataclass(frozen=True, slots=True)
class MeshInstances(Columns):
    """Instances of other casters' meshes, static or moving.

    shapes    : the instanced casters (without instances of their own)
    shape     : (k,) int32, index into ``shapes``
    transform : (k, 3, 4) float64, from shape to caster: rotation and scale, then translation; or
                (k, s, 3, 4): at s >= 2 times evenly spaced over ray times 0 to 1, linear in between
    mask      : (k,) uint32, bits; rays hit an instance if their masks share one, and one with the face; None:
                all bits
    """

    shapes: tuple[Instanced, ...]
    shape: NDArray[np.int32]
    transform: Float
    mask: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        """Check the columns' lengths, the transforms and the shapes."""
        k = len(self.shape)
        if self.transform.shape[:1] != (k,) or self.transform.shape[-2:] != (3, 4):
            raise InputError(f"{k} instances need transforms ({k}, 3, 4), not {self.transform.shape}")
        if self.transform.ndim not in (3, 4) or (self.transform.ndim == 4 and self.transform.shape[1] < 2):
            raise InputError(
                f"moving instances need transforms ({k}, s >= 2, 3, 4), not {self.transform.shape}"
            )
        if not np.isfinite(self.transform).all():
            raise InputError("an instance has a transform that is not finite")
        if k and not (self.shape.min() >= 0 and self.shape.max() < len(self.shapes)):
            raise InputError(f"an instance has a shape number beyond the {len(self.shapes)} shapes")
        if self.mask is not None and len(self.mask) != k:
            raise InputError(f"{len(self.mask)} masks for {k} instances")
        if any(len(shape.instances) for shape in self.shapes):
            raise InputError("a shape of instances cannot have instances itself")
