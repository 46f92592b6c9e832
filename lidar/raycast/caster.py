"""Rays in, what they met out."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float
from lidar.errors import BackendError, InputError
from lidar.geometry.poses import Poses
from lidar.raycast.embree import EmbreeScene
from lidar.raycast.fallback import EmbreexScene
from lidar.raycast.geometry import ALL, Geometry, Instances, checked, middle, split
from lidar.raycast.hits import Hits
from lidar.raycast.library import library
from lidar.raycast.rays import free_rays, limited, posed_rays

log = logging.getLogger(__name__)

_NOTHING: Mapping[int, Geometry] = {}
_NUMBERS: Mapping[int, int] = {}


@functools.cache
def _works(backend: str) -> bool:
    """Whether to use Embree directly; says once if that was wished for and cannot be."""
    if backend not in ("auto", "embree", "embreex"):
        raise InputError(f"backend {backend!r} is none of auto, embree and embreex")
    if backend == "embreex":
        return False
    try:
        library()
    except BackendError as error:
        if backend == "embree":
            raise
        log.warning("casting rays with plain embreex, several times slower: %s", error)
        return False
    return True


class Caster:
    """A mesh, and copies of other casters' meshes, ready to be hit by rays.

    All coordinates are float64 metres in one frame of the caller's choice (scene axes, as a rule). Ranges are
    ray parameters: a hit lies at origin + range * direction. Directions need not be unit vectors.

    vertices, faces : (n, 3) and (m, 3), the caster's own mesh
    mask            : (m,) bits per face, of which a ray's ``mask`` must share one; all bits by default
    instances       : copies of other casters; their numbers run through all groups in the given order
    origin          : (3,) metres, within a few kilometres of all vertices and rays: what float32 coordinates
                      are relative to; the middle of the vertices by default
    dynamic         : whether `update` will exchange parts of the mesh
    backend         : ``embree``; ``embreex``, which needs no more than that package's own interface and gives
                      the same results at a fifth of the speed; or ``auto``: Embree if it works here

    Raises InputError for meshes that cannot be cast at and BackendError if Embree does not work here.
    """

    def __init__(
        self,
        vertices: ArrayLike = (),
        faces: ArrayLike = (),
        *,
        mask: ArrayLike | None = None,
        instances: Sequence[Instances] = (),
        origin: ArrayLike | None = None,
        dynamic: bool = False,
        backend: str = "auto",
    ) -> None:
        v, f = checked(vertices, faces)
        self.origin: Float = middle(v) if origin is None else np.array(origin, np.float64)
        scene = EmbreeScene if _works(backend) else EmbreexScene
        self.scene = scene(self.origin, dynamic=dynamic)
        self.instances: tuple[Instances, ...] = ()
        self.update(attach=dict(enumerate(split(v - self.origin, f, mask=mask))), instances=instances)

    def update(
        self,
        *,
        detach: Iterable[int] = (),
        attach: Mapping[int, Geometry] = _NOTHING,
        first: Mapping[int, int] = _NUMBERS,
        instances: Sequence[Instances] | None = None,
    ) -> None:
        """Exchange parts of the mesh, in place; trees of the parts that stay are kept.

        detach    : numbers of parts to take away
        attach    : parts to add, relative to ``origin``, by number; the same set of numbered parts gives the
                    same hits, whatever came and went before
        first     : numbers of the first faces of parts, by the part's number; as they were by default
        instances : all copies from now on; as they were by default
        """
        for number in detach:
            self.scene.detach(number)
        for number, part in attach.items():
            self.scene.attach(number, part)
        for number, start in first.items():
            self.scene.parts[number] = replace(self.scene.parts[number], first=start)
        if instances is not None:
            self.instances = tuple(instances)
            shapes: Any = [[shape.scene for shape in group.shapes] for group in self.instances]
            self.scene.place(self.instances, shapes)
        self.scene.commit()

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
        normals: bool = False,
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
        normals    : whether to fill in `Hits.normal`
        threads    : threads to use; the result does not depend on it

        Raises InputError for rays that are not finite or have a direction of length zero.
        """
        rays = limited(free_rays(origins, directions), near=near, far=far, mask=mask, time=time, order=order)
        return self.scene.cast(rays, normals=normals, threads=threads)

    def cast_posed(
        self,
        poses: Poses,
        pose_index: NDArray[np.integer],
        *,
        directions: Float,
        offsets: Float | None = None,
        near: float = 0.0,
        far: float = np.inf,
        mask: int = ALL,
        time: ArrayLike | None = None,
        order: NDArray[np.integer] | None = None,
        normals: bool = False,
        threads: int = 1,
    ) -> Hits:
        """The first hit of each ray of a sensor that moves; ranges are true metres for unit directions.

        poses      : p poses of the sensor
        pose_index : (n,) each ray's row of ``poses``
        directions : (n, 3) unit vectors in the sensor frame
        offsets    : (n, 3) where each beam starts in the sensor frame, true metres; its zero by default

        ``near`` and ``far`` count from the beam's start in true metres; the rest as for `cast`.
        """
        rays = posed_rays(poses, pose_index, directions=directions, offsets=offsets)
        rays = limited(rays, near=near, far=far, mask=mask, time=time, order=order)
        return self.scene.cast(rays, normals=normals, threads=threads)

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        far: float | NDArray[np.float64] = np.inf,
        near: float = 0.0,
        mask: int = ALL,
        time: ArrayLike | None = None,
        threads: int = 1,
    ) -> NDArray[np.bool_]:
        """Whether anything lies on each ray (n,) between ``near`` and ``far`` (a number or (n,)).

        Lift the origins of shadow rays off their surface by a millimetre along its normal, or they hit it.
        """
        rays = limited(free_rays(origins, directions), near=near, far=far, mask=mask, time=time)
        return self.scene.occluded(rays, threads=threads)
