"""Rays in, what they met out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lidar.errors import InputError
from lidar.poses import Poses
from lidar.raycast import kernels
from lidar.raycast.columns import Rays
from lidar.raycast.embree import EmbreeScene
from lidar.raycast.geometry import ALL, Geometry, Instances, checked, middle, split
from lidar.raycast.hits import Echoes, Hits

Float = NDArray[np.float64]

_CHUNK = 8192
"""Rays that a thread takes at a time; a multiple of every packet width, so that packets do not depend on it."""
_NO_INDEX = np.empty(0, np.int64)
_NO_TIME = np.empty(0, np.float32)
_NOTHING: Mapping[int, Geometry] = {}
_NUMBERS: Mapping[int, int] = {}
_COPIES = 1 << 20
"""Number of the first geometry of copies; parts of a mesh have lesser numbers."""
_NO_POSES = (_NO_INDEX, np.empty((0, 3)), np.empty((0, 3, 3)))


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
    ) -> None:
        v, f = checked(vertices, faces)
        self.origin: Float = middle(v) if origin is None else np.array(origin, np.float64)
        self.scene = EmbreeScene(self.origin, dynamic=dynamic)
        self.instances: tuple[Instances, ...] = ()
        self.update(attach=dict(enumerate(split(v - self.origin, f, mask))), instances=instances)

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
            shapes = [[shape.scene for shape in group.shapes] for group in self.instances]
            self.scene.place(self.instances, shapes, _COPIES)
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
        d = _rows(directions, "directions")
        o = np.ascontiguousarray(origins, np.float64).reshape(-1, 3)
        if len(o) not in (1, len(d)):
            raise InputError(f"{len(o)} origins for {len(d)} directions; give one, or one a ray")
        return self._cast(_rays(d, o, _NO_POSES, near, far, mask, time, order), threads, normals=normals)

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
        normals: bool = False,
        threads: int = 1,
    ) -> Hits:
        """The first hit of each ray of a sensor that moves; ranges are true metres for unit directions.

        poses      : p poses of the sensor
        pose_index : (n,) each ray's row of ``poses``
        directions : (n, 3) unit vectors in the sensor frame
        offsets    : (n, 3) where each beam starts in the sensor frame, true metres; the frame's zero by default

        ``near`` and ``far`` count from the beam's start in true metres; the rest as for `cast`.
        """
        d = _rows(directions, "directions")
        o = np.zeros((1, 3)) if offsets is None else _rows(offsets, "offsets")
        index = np.ascontiguousarray(pose_index, np.int64)
        if len(o) not in (1, len(d)) or len(index) != len(d):
            raise InputError(f"{len(d)} directions, {len(o)} offsets and {len(index)} pose numbers disagree")
        if len(index) and not (index.min() >= 0 and index.max() < len(poses)):
            raise InputError(f"a ray names a pose beyond the {len(poses)} there are")
        position = np.ascontiguousarray(poses.position, np.float64)
        matrix = poses.scale[:, :, None] * poses.rotation
        return self._cast(
            _rays(d, o, (index, position, matrix), near, far, mask, time, order), threads, normals=normals
        )

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
        d = _rows(directions, "directions")
        o = np.ascontiguousarray(origins, np.float64).reshape(-1, 3)
        if len(o) not in (1, len(d)):
            raise InputError(f"{len(o)} origins for {len(d)} directions; give one, or one a ray")
        rays = _rays(d, o, _NO_POSES, near, far, mask, time, None)
        out = np.empty(len(d), np.bool_)
        target = self.scene.target
        _share(lambda lo, hi: kernels.occluded(target, rays, lo, hi, out), rays, threads)
        return out

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

    def _cast(self, rays: Rays, threads: int, *, normals: bool) -> Hits:
        n = len(rays.directions)
        ranges, faces, instances = np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32)
        cosines, normal = np.empty(n, np.float32), np.empty((n if normals else 0, 3))
        target = self.scene.target
        _share(
            lambda lo, hi: kernels.cast(target, rays, lo, hi, ranges, faces, instances, cosines, normal),
            rays,
            threads,
        )
        return Hits(ranges, faces, instances, cosines, normal)


def _rows(values: ArrayLike, name: str) -> Float:
    rows = np.ascontiguousarray(values, np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise InputError(f"{name} have the shape {rows.shape}, rays need (n, 3)")
    return rows


def _rays(
    directions: Float,
    offsets: Float,
    poses: tuple[NDArray[np.int64], Float, Float],
    near: float,
    far: float | Float,
    mask: int,
    time: ArrayLike | None,
    order: NDArray[np.integer] | None,
) -> Rays:
    """The rays as the kernels want them; refuses columns that disagree."""
    n = len(directions)
    work = _NO_INDEX if order is None else np.ascontiguousarray(order, np.int64)
    if order is not None and not np.array_equal(np.bincount(work, minlength=n), np.ones(n, int)):
        raise InputError(f"order is not a permutation of {n} rays")
    moments = _NO_TIME if time is None else np.ascontiguousarray(time, np.float32)
    if time is not None and not (moments.shape == (n,) and ((moments >= 0) & (moments <= 1)).all()):
        raise InputError(f"ray times are numbers from 0 to 1, one for each of {n} rays")
    reach = np.ascontiguousarray(far, np.float64).reshape(-1)
    if len(reach) not in (1, n) or not (near >= 0 and (reach >= near).all()):
        raise InputError("rays need 0 <= near <= far, far one number or one a ray")
    return Rays(directions, offsets, *poses, work, moments, float(near), reach, int(mask) & ALL)


def _share(work: Callable[[int, int], int], rays: Rays, threads: int) -> None:
    """Have the threads do the rays in chunks; raises InputError for a ray that cannot be cast."""
    n = len(rays.directions)
    if threads <= 1 or n <= _CHUNK:
        bad = work(0, n)
    else:
        with ThreadPoolExecutor(threads) as pool:
            bad = max(pool.map(lambda lo: work(lo, min(lo + _CHUNK, n)), range(0, n, _CHUNK)), default=-1)
    if bad >= 0:
        direction, origin = rays.directions[bad], rays.offsets[bad if len(rays.offsets) > 1 else 0]
        raise InputError(
            f"ray {bad} of {n} has the origin {origin.tolist()} and direction {direction.tolist()}"
            + (f" at the pose {rays.position[rays.pose[bad]].tolist()}" if rays.pose.size else "")
            + ": rays need finite numbers and a direction that is not zero"
        )
