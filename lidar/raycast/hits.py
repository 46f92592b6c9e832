"""First hits of rays as columns, one row per ray, and surfaces that refine them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns
from geoscene.typing import Float
from lidar.raycast.columns import RayColumns


@dataclass(frozen=True, slots=True)
class Hits(Columns):
    """The first surface along each ray.

    range    : (n,) float64, ray parameter of the hit (metres for unit directions; true metres for directions
               from `Poses.directions`); inf for a miss
    face     : (n,) int32, face in the caster's mesh, or in the mesh of the instance's shape; -1 for a miss
    instance : (n,) int32, instance that was hit; -1 for the caster's own mesh and for a miss
    cosine   : (n,) float32, cosine of the incidence angle: positive on the front (counter-clockwise corners),
               negative on the back; 0 for a miss
    normal   : (n, 3) float64, the face's unit normal in the caster's axes, zero for a miss; (0, 3) unless
               requested
    """

    range: NDArray[np.float64]
    face: NDArray[np.int32]
    instance: NDArray[np.int32]
    cosine: NDArray[np.float32]
    normal: NDArray[np.float64]


def own_faces(hits: Hits) -> NDArray[np.int32]:
    """Faces (n,) of hits on the caster's own mesh, -1 for others: where rays start that go on from there."""
    return np.where(hits.instance < 0, hits.face, np.int32(-1))


class Refiner(Protocol):
    """A surface behind the planes of some faces of a caster's own mesh.

    A `lidar.raycast.Caster` hands the first hits of all its rays to its refiners, one after the other. A
    refiner changes the hits on its own faces and leaves those on other faces as they are. Its surface lies
    at or behind the plane of the face and is closed: a ray that hits the front of the face hits the surface,
    whatever else lies behind the plane.
    """

    def refine(self, rays: RayColumns, hits: Hits, *, threads: int) -> None:
        """Change the hits in place: range, face, cosine and, unless it is empty, the normal.

        A hit beyond the ray's ``far`` becomes a miss.
        """
        ...

    def leave(self, rays: RayColumns, on: NDArray[np.int32], hits: Hits) -> Float:
        """Follow rays that start between the surface and the plane of a face.

        on : (n,) the face, as in ``hits.face`` after `refine`; -1 for none

        Returns the ray parameter (n,) at which each ray has crossed the plane from behind, by a millimetre
        unless it is nearly parallel; 0 for rays that start elsewhere; inf for those that hit the surface
        before, whose hit is written in place.
        """
        ...
