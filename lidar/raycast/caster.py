"""The ray caster: first hits and shadow rays against a mesh and instances."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float
from lidar.errors import BackendError, InputError
from lidar.geometry.poses import Poses
from lidar.raycast.columns import RayColumns
from lidar.raycast.device import CPU
from lidar.raycast.device import device as warp_device
from lidar.raycast.embree import EmbreeScene
from lidar.raycast.geometry import ALL, Geometry, MeshInstances, check_mesh, middle, split
from lidar.raycast.hits import Hits, Refiner, own_faces
from lidar.raycast.library import library
from lidar.raycast.rays import EXACTLY, beyond, free_rays, limit_rays, posed_rays, taken
from lidar.raycast.scene import Float64Scene

log = logging.getLogger(__name__)

_NOTHING: Mapping[int, Geometry] = {}
_NUMBERS: Mapping[int, int] = {}


@functools.cache
def _uses_embree(backend: str) -> bool:
    """Whether to call Embree directly; logs one warning if ``auto`` falls back to float64."""
    if backend not in ("auto", "embree", "float64"):
        raise InputError(f"backend {backend!r}: choose one of auto, embree, float64")
    if backend == "float64":
        return False
    try:
        library()
    except BackendError as error:
        if backend == "embree":
            raise
        log.warning("casting rays in float64, several times slower: %s", error)
        return False
    return True


def _scene(origin: Float, *, backend: str, device: str, dynamic: bool) -> Float64Scene:
    """An empty scene of a backend, on a device."""
    if device != CPU:
        if backend not in ("auto", "float64"):
            raise InputError(f"backend {backend!r} is of the CPU; `device` {device} needs auto or float64")
        from lidar.raycast.warp_scene import WarpScene  # noqa: PLC0415

        return WarpScene(origin, device=warp_device(device))
    return EmbreeScene(origin, dynamic=dynamic) if _uses_embree(backend) else Float64Scene(origin)


class Caster:
    """Casts rays at a mesh and at instances of other casters' meshes.

    All coordinates are float64 metres in one frame, usually the scene's. Ranges are ray parameters: a hit
    lies at origin + range * direction. Directions need not be unit vectors.

    vertices, faces : (n, 3) and (m, 3), the caster's own mesh
    mask            : (m,) bits per face; a ray hits faces that share one with its ``mask``; all by default
    instances       : groups of instances, numbered consecutively through all groups
    origin          : (3,) metres, origin of the float32 coordinates, within a few kilometres of all vertices
                      and rays; the middle of the vertices by default
    dynamic         : whether `update` will exchange parts of the mesh
    backend         : ``embree``; ``float64``, the same hits without Embree, 10 to 50 times slower; or
                      ``auto``: Embree if it is available, else float64
    device          : ``cpu``, or a device of NVIDIA Warp: ``cuda``, ``cuda:N`` or ``warp-cpu``. These return
                      the hits of the backend float64; ``backend`` must be ``auto`` or ``float64`` then

    ``refiners`` replace hits on faces of the own mesh by hits on the surfaces behind them; every cast goes
    through them.

    Raises InputError for an invalid mesh or a device that is not there, BackendError if Embree is not
    available, and MissingExtraError if Warp is not.
    """

    refiners: Sequence[Refiner] = ()

    def __init__(
        self,
        vertices: ArrayLike = (),
        faces: ArrayLike = (),
        *,
        mask: ArrayLike | None = None,
        instances: Sequence[MeshInstances] = (),
        origin: ArrayLike | None = None,
        dynamic: bool = False,
        backend: str = "auto",
        device: str = CPU,
    ) -> None:
        v, f = check_mesh(vertices, faces)
        self.origin: Float = middle(v) if origin is None else np.array(origin, np.float64)
        self.scene = _scene(self.origin, backend=backend, device=device, dynamic=dynamic)
        self.instances: tuple[MeshInstances, ...] = ()
        self.update(attach=dict(enumerate(split(v - self.origin, f, mask=mask))), instances=instances)

    def update(
        self,
        *,
        detach: Iterable[int] = (),
        attach: Mapping[int, Geometry] = _NOTHING,
        first: Mapping[int, int] = _NUMBERS,
        instances: Sequence[MeshInstances] | None = None,
    ) -> None:
        """Exchange parts of the mesh in place; unchanged parts keep their acceleration structures.

        detach    : numbers of parts to remove
        attach    : parts to add, relative to ``origin``, by number; hits depend on the present parts and
                    their numbers only, not on earlier updates
        first     : numbers of the first faces of parts, by part number; unchanged by default
        instances : replacement of all instances; unchanged by default
        """
        for number in detach:
            self.scene.detach(number)
        for number, part in attach.items():
            self.scene.attach(number, part)
        for number, start in first.items():
            self.scene.parts[number] = replace(self.scene.parts[number], first=start)
        if instances is not None:
            self.instances = tuple(instances)
            self.scene.place(self.instances, [[shape.scene for shape in g.shapes] for g in self.instances])
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
        on: NDArray[np.int32] | None = None,
        normals: bool = False,
        precision: str = "exact",
        retrace: bool = True,
        footprint: tuple[float, float] = EXACTLY,
        scattered: bool = False,
        threads: int = 1,
    ) -> Hits:
        """The first hit of each ray.

        origins    : (n, 3) or (3,) metres
        directions : (n, 3), any length but zero
        near, far  : bounds of the ray parameter; a ray that starts on a face (within 1e-9 m of its plane)
                     does not hit this face
        mask       : bits; rays pass faces and instances that share none
        time       : (n,) ray times 0 to 1 within the motion of moving instances; 0 by default
        order      : (n,) permutation, the order in which rays form packets; fastest where 16 rays in a
                     row are nearly parallel (16 azimuths of one channel, 16 pixels)
        on         : (n,) faces of the own mesh on which rays start, as in `Hits.face`; -1 for none. Give it
                     for rays that start on a hit, which a refiner may have moved behind the plane of its face
        normals    : whether to compute `Hits.normal`
        precision  : ``exact``; ``refined``: the float64 range on the face that Embree finds in float32, also
                     near its edges; ``float32``: Embree's range. The latter two may hit faces in which a ray
                     starts. Without effect on the float64 backend
        retrace    : whether rays that miss are traced a second time, with a perturbed direction, as rays
                     towards a vertex may pass between faces. Without effect on the float64 backend
        footprint  : width of a ray, metres, at its start, and its growth per metre: surfaces of refiners may
                     be averaged over what it covers, for no sensor resolves more; 0: exact first hits
        scattered  : whether footprints near the border of two levels of detail are of either, by chance, so
                     that no edge is seen in images
        threads    : threads to use; the result does not depend on it

        Raises InputError for rays that are not finite or have a direction of length zero.
        """
        rays = free_rays(origins, directions)
        rays = limit_rays(
            rays,
            near=near,
            far=far,
            mask=mask,
            time=time,
            order=order,
            precision=precision,
            retrace=retrace,
            footprint=footprint,
            scattered=scattered,
        )
        return self._first_hits(rays, on, normals=normals, threads=threads)

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
        precision: str = "exact",
        retrace: bool = True,
        footprint: tuple[float, float] = EXACTLY,
        threads: int = 1,
    ) -> Hits:
        """The first hit of each ray of a moving sensor; ranges are true metres for unit directions.

        poses      : p poses of the sensor
        pose_index : (n,) each ray's row of ``poses``
        directions : (n, 3) unit vectors in the sensor frame
        offsets    : (n, 3) start of each beam in the sensor frame, true metres; the frame's origin by default

        ``near`` and ``far`` are true metres from the start of the beam; other parameters as for `cast`.
        """
        rays = posed_rays(poses, pose_index, directions=directions, offsets=offsets)
        rays = limit_rays(
            rays,
            near=near,
            far=far,
            mask=mask,
            time=time,
            order=order,
            precision=precision,
            retrace=retrace,
            footprint=footprint,
        )
        return self._first_hits(rays, None, normals=normals, threads=threads)

    def occluded(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        *,
        far: float | NDArray[np.float64] = np.inf,
        near: float = 0.0,
        mask: int = ALL,
        time: ArrayLike | None = None,
        on: NDArray[np.int32] | None = None,
        retrace: bool = True,
        threads: int = 1,
    ) -> NDArray[np.bool_]:
        """Whether each ray (n,) hits anything between ``near`` and ``far`` (a number or (n,)).

        ``on`` and the other parameters are those of `cast`. Without ``retrace`` a ray aimed at a vertex, or
        within 3e-7 rad beside a face, may pass.

        Offset the origins of shadow rays by a millimetre along the normal, or they hit their own surface.
        Within a tenth of a millimetre (at 400 m from the caster's origin) of an edge
        a ray counts as occluded.
        """
        rays = free_rays(origins, directions)
        rays = limit_rays(rays, near=near, far=far, mask=mask, time=time, retrace=retrace)
        return self._any_hit(rays, on, threads=threads)

    def _first_hits(
        self, rays: RayColumns, on: NDArray[np.int32] | None, *, normals: bool, threads: int
    ) -> Hits:
        """The first hits of checked rays."""
        if on is None or not self.refiners:
            hits = self.scene.cast(rays, normals=normals, threads=threads)
            for refiner in self.refiners:
                refiner.refine(rays, hits, threads=threads)
            return hits
        hits, at = self._left(rays, on, normals=normals)
        for row, part in _parts(rays, at):
            found = self._first_hits(part, None, normals=normals, threads=threads)
            found.range[:] += at[row]
            for column, new in zip(hits.columns().values(), found.columns().values(), strict=True):
                if len(column):
                    column[row] = new
        return hits

    def _any_hit(self, rays: RayColumns, on: NDArray[np.int32] | None, *, threads: int) -> NDArray[np.bool_]:
        """Whether checked rays hit anything."""
        if on is not None and self.refiners:
            hits, at = self._left(rays, on, normals=False)
            blocked = hits.face >= 0
            row = np.flatnonzero(at < np.inf)
            part, at = (taken(rays, row), at[row]) if len(row) < len(at) else (rays, at)
            part = beyond(part, np.maximum(at, rays.near))
            blocked[row] = self._any_hit(part, None, threads=threads)
            held = np.flatnonzero(blocked[row] & (at > 0.0))
            if len(held):
                # Where faces meet in a hollow, a ray that has left one plane may be behind the next.
                part, row = taken(part, held), row[held]
                behind = self._behind(part, threads=threads)
                again = np.flatnonzero(behind >= 0)
                if len(again):
                    part, behind = taken(part, again), behind[again]
                    blocked[row[again]] = self._any_hit(part, behind, threads=threads)
            return blocked
        blocked = self.scene.occluded(rays, threads=threads)
        if self.refiners and np.isfinite(rays.far).any():
            # The surface behind a plane that is in the way can lie beyond the end of the ray.
            row = np.flatnonzero(blocked)
            part = taken(rays, row)
            blocked[row] = self._first_hits(part, None, normals=False, threads=threads).face >= 0
        return blocked

    def _behind(self, rays: RayColumns, *, threads: int) -> NDArray[np.int32]:
        """Faces (n,) of the own mesh that rays hit first, from behind; -1 for all other hits."""
        hits = self.scene.cast(rays, normals=False, threads=threads)
        return np.where(hits.cosine < 0.0, own_faces(hits), np.int32(-1))

    def _left(self, rays: RayColumns, on: NDArray[np.int32], *, normals: bool) -> tuple[Hits, Float]:
        """Hits of rays on the surface in which they start, and the ray parameter at which others leave it."""
        n = len(rays.directions)
        if on.shape != (n,):
            raise InputError(f"{n} rays start on {len(on)} faces; give one per ray, -1 for none")
        none, normal = np.full(n, -1, np.int32), np.zeros((n if normals else 0, 3))
        hits = Hits(np.full(n, np.inf), none, none.copy(), np.zeros(n, np.float32), normal)
        at = np.zeros(n)
        for refiner in self.refiners:
            at = np.maximum(at, refiner.leave(rays, on, hits))
        return hits, at


def _parts(rays: RayColumns, at: Float) -> Iterator[tuple[NDArray[np.intp], RayColumns]]:
    """Rays that start in front of all planes, and those that cross one from behind, from there on."""
    for row in (np.flatnonzero(at == 0.0), np.flatnonzero((at > 0.0) & (at < np.inf))):
        if len(row):
            part = taken(rays, row)
            yield row, part if at[row[0]] == 0.0 else beyond(part, at[row])
