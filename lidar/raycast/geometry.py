"""What rays are cast against: triangles with their planes, and copies of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar.errors import InputError

if TYPE_CHECKING:
    from lidar.raycast.caster import Caster

Float = NDArray[np.float64]

ALL = 0xFFFFFFFF
"""The mask that sees every face."""


@dataclass(frozen=True, slots=True)
class Geometry:
    """Triangles ready to cast at.

    origin   : (3,) float64, whole metres near the middle of the vertices; subtracted from all below
    vertices : (n, 3) float64, metres, relative to the origin
    faces    : (m, 3) int32
    planes   : (m, 4) float64: unit normal n and offset d of each face; n @ x = d on it. Zero without area
    mask     : (m,) uint32, bits of which a ray's mask must share one to see the face
    """

    origin: Float
    vertices: Float
    faces: NDArray[np.int32]
    planes: Float
    mask: NDArray[np.uint32]


def triangles(vertices: ArrayLike, faces: ArrayLike, mask: ArrayLike | None = None) -> Geometry:
    """The geometry of vertices (n, 3) in metres, faces (m, 3) and a mask (m,) or scalar, all bits by default.

    Raises InputError for vertices that are not finite and faces that name vertices there are not.
    """
    v = np.ascontiguousarray(vertices, np.float64).reshape(-1, 3)
    f = np.ascontiguousarray(faces, np.int32).reshape(-1, 3)
    if not np.isfinite(v).all():
        bad = int(np.argmax(~np.isfinite(v).all(axis=1)))
        raise InputError(f"vertex {bad} of {len(v)} is {v[bad].tolist()}: rays need finite vertices")
    if len(f) and not (f.min() >= 0 and f.max() < len(v)):
        bad = int(np.argmax(((f < 0) | (f >= len(v))).any(axis=1)))
        raise InputError(f"face {bad} names the vertices {f[bad].tolist()} of {len(v)}")
    origin = np.round((v.min(axis=0) + v.max(axis=0)) / 2) if len(v) else np.zeros(3)
    local = v - origin
    a, b, c = (local[f[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    length = np.sqrt(np.einsum("ij,ij->i", normal, normal))[:, None]
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    planes = np.empty((len(f), 4))
    planes[:, :3] = normal
    planes[:, 3] = np.einsum("ij,ij->i", normal, a)
    bits = np.broadcast_to(np.asarray(ALL if mask is None else mask, np.uint32), (len(f),))
    return Geometry(origin, local, f, planes, np.ascontiguousarray(bits))


@dataclass(frozen=True, slots=True)
class Instances:
    """Copies of other casters' meshes, at rest or moving.

    shapes    : the casters that are copied (without instances of their own)
    shape     : (k,) int32, index into ``shapes``
    transform : (k, 3, 4) float64, caster's coordinates from the shape's: rotation and scale, then shift;
                or (k, s, 3, 4): the transform at s >= 2 moments evenly spaced over ray times 0 to 1, linear
                between neighbours
    mask      : (k,) uint32, bits of which a ray's mask must share one to see the copy, or None for all bits;
                the face's own mask counts as well
    """

    shapes: tuple[Caster, ...]
    shape: NDArray[np.int32]
    transform: Float
    mask: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        """Refuse columns that disagree, and shapes and transforms that cannot be cast at."""
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
            raise InputError(f"an instance names a shape beyond the {len(self.shapes)} there are")
        if self.mask is not None and len(self.mask) != k:
            raise InputError(f"{len(self.mask)} masks for {k} instances")
        if any(len(shape.instances) for shape in self.shapes):
            raise InputError("a shape that is copied cannot hold instances of its own")

    def __len__(self) -> int:
        """Number of copies."""
        return len(self.shape)
