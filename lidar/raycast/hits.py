"""First hits of rays as columns, one row per ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import Columns


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
