"""Refinement of hits on faces whose surface is not the plane of the face."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.raycast.columns import RayColumns
from lidar.raycast.hits import Hits


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
