"""Rays in, what they met out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar.poses import Poses
from lidar.raycast.geometry import ALL, Geometry, Instances, triangles
from lidar.raycast.hits import Echoes, Hits

Float = NDArray[np.float64]


class Caster:
    """A mesh, and copies of other casters' meshes, ready to be hit by rays.

    All coordinates are float64 metres in one frame of the caller's choice (scene axes, as a rule). Ranges are
    ray parameters: a hit lies at origin + range * direction. Directions need not be unit vectors.

    vertices, faces : (n, 3) and (m, 3), the caster's own mesh
    mask            : (m,) bits per face, of which a ray's ``mask`` must share one; all bits by default
    instances       : copies of other casters; their numbers run through all groups in the given order
    backend         : ``embree``, ``embreex`` (slower, same results), or ``auto``: the first that works

    Raises InputError for meshes that cannot be cast at and BackendError if the backend does not work here.
    """

    geometry: Geometry
    instances: tuple[Instances, ...]

    def __init__(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        *,
        mask: ArrayLike | None = None,
        instances: Sequence[Instances] = (),
        backend: str = "auto",
    ) -> None:
        self.geometry = triangles(vertices, faces, mask)
        self.instances = tuple(instances)

    def cast(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        near: float = 0.0,
        far: float = np.inf,
        mask: int = ALL,
        time: ArrayLike | None = None,
        order: NDArray[np.integer] | None = None,
        threads: int = 1,
    ) -> Hits:
        """The first hit of each ray.

        origins    : (n, 3) or (3,) metres
        directions : (n, 3), any length but zero
        near, far  : bounds of the ray parameter
        mask       : bits; faces and instances that share none are not there
        time       : (n,) ray times 0 to 1 within the motion of moving instances; 0 by default
        order      : (n,) permutation: the order in which neighbouring rays are worked on together. Rays are
                     fastest where 16 in a row go almost the same way (16 azimuths of one channel, 16 pixels)
        threads    : threads to use; the result does not depend on it

        Raises InputError for rays that are not finite or have a direction of length zero.
        """
        raise NotImplementedError

    def cast_posed(
        self,
        poses: Poses,
        pose_index: NDArray[np.integer],
        directions: Float,
        *,
        offsets: Float | None = None,
        near: float = 0.0,
        far: float = np.inf,
        mask: int = ALL,
        time: ArrayLike | None = None,
        order: NDArray[np.integer] | None = None,
        threads: int = 1,
    ) -> Hits:
        """The first hit of each ray of a sensor that moves; ranges are true metres for unit directions.

        poses      : p poses of the sensor
        pose_index : (n,) each ray's row of ``poses``
        directions : (n, 3) unit vectors in the sensor frame
        offsets    : (n, 3) where each beam starts in the sensor frame, true metres; the frame's zero by default

        ``near`` and ``far`` count from the beam's start in true metres; the rest as for `cast`.
        """
        raise NotImplementedError

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        far: float | NDArray[np.float64] = np.inf,
        *,
        near: float = 0.0,
        mask: int = ALL,
        time: ArrayLike | None = None,
        threads: int = 1,
    ) -> NDArray[np.bool_]:
        """Whether anything lies on each ray (n,) between ``near`` and ``far`` (a number or (n,)).

        Start shadow rays `shadow_near` metres along, so that they do not hit the surface they leave.
        """
        raise NotImplementedError

    def cast_all(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        k: int = 8,
        near: float = 0.0,
        far: float = np.inf,
        mask: int = ALL,
        time: ArrayLike | None = None,
        threads: int = 1,
    ) -> Echoes:
        """The first ``k`` surfaces along each ray, nearest first; arguments as for `cast`.

        A ray that meets an edge or vertex meets each of the faces there.
        """
        raise NotImplementedError

    def normals(self, hits: Hits, *, time: ArrayLike | None = None) -> Float:
        """Unit normals (n, 3) of the faces that were hit, in the caster's axes; zero for a miss.

        time : (n,) the ray times the hits were cast with
        """
        raise NotImplementedError
