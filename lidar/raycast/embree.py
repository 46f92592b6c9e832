"""Embree scenes of triangles and instances, and their tables for the kernels."""

from __future__ import annotations

import ctypes as c
import weakref
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.raycast import kernels
from lidar.raycast import library as rtc
from lidar.raycast.columns import COPIES, Rays, Target
from lidar.raycast.geometry import Geometry, Instances
from lidar.raycast.hits import Hits
from lidar.raycast.rays import share


def _arguments(flags: int = 0) -> NDArray[np.int64]:
    """An RTCIntersectArguments or RTCOccludedArguments: flags, feature mask, context, filter, intersect."""
    words = np.zeros(8, np.int64)
    words.view(np.uint32)[:2] = flags, rtc.INVALID
    return words


class _Group(NamedTuple):
    """A group of instances, its transforms relative to the scene's origin, and its number of geometries."""

    copies: Instances
    shapes: Sequence[EmbreeScene]
    placed: Float
    geometries: int


class EmbreeScene:
    """An Embree scene of numbered geometries and of instances of other scenes.

    Changes take effect with `commit`, which rebuilds only what was attached or placed since: in a dynamic
    scene Embree keeps a tree per geometry and merges their tops.

    origin  : (3,) float64, origin of the geometries' vertices
    dynamic : whether geometries are attached and detached later

    Raises BackendError if Embree is not available or reports an error.
    """

    def __init__(self, origin: Float, *, dynamic: bool = False) -> None:
        self.origin = origin
        self._lib = rtc.library()
        self.address: int = self._lib.call("rtcNewScene", self._lib.device)
        weakref.finalize(self, self._lib.embree.rtcReleaseScene, self.address)
        self._lib.call("rtcSetSceneFlags", self.address, rtc.ROBUST | (rtc.DYNAMIC if dynamic else 0))
        if dynamic:
            # Embree keeps a tree per geometry only in low-quality scenes; the trees have medium quality.
            self._lib.call("rtcSetSceneBuildQuality", self.address, rtc.LOW)
        self.parts: dict[int, Geometry] = {}
        self._copies: list[NDArray[np.intp]] = []
        self._groups: list[_Group] = []
        self._own: tuple[list[Geometry], NDArray[np.int64]] = [], np.empty((0, 5), np.int64)
        self._packet, self._single = _arguments(rtc.COHERENT), _arguments()
        self.target: Target

    def _attach(self, geometry: int, number: int) -> None:
        self._lib.call("rtcCommitGeometry", geometry)
        self._lib.call("rtcAttachGeometryByID", self.address, geometry, number)
        self._lib.call("rtcReleaseGeometry", geometry)

    def attach(self, number: int, part: Geometry) -> None:
        """Add a geometry under a free number. Results depend on the numbers, not on the order of calls."""
        self.parts[number] = part
        if len(part) == 0:
            return
        geometry = self._lib.call("rtcNewGeometry", self._lib.device, rtc.TRIANGLE)
        faces = part.faces.astype(np.uint32)
        rtc.fill(self._lib, geometry, kind=rtc.VERTEX, slot=0, form=rtc.FLOAT3, rows=part.hull)
        rtc.fill(self._lib, geometry, kind=rtc.INDEX, slot=0, form=rtc.UINT3, rows=faces)
        self._lib.call("rtcSetGeometryMask", geometry, part.mask)
        self._lib.call("rtcSetGeometryBuildQuality", geometry, rtc.MEDIUM)
        self._attach(geometry, COPIES + number)

    def detach(self, number: int) -> None:
        """Remove the geometry of a number."""
        if len(self.parts.pop(number)):
            self._lib.call("rtcDetachGeometry", self.address, COPIES + number)

    def place(self, groups: Sequence[Instances], scenes: Sequence[Sequence[EmbreeScene]]) -> None:
        """Replace all instances; ``scenes`` holds each group's shapes. Unchanged leading groups are kept.

        Raises InputError for more than `COPIES` masks.
        """
        kept = 0
        while kept < min(len(groups), len(self._groups)) and groups[kept] is self._groups[kept].copies:
            kept += 1
        count = sum(group.geometries for group in self._groups[:kept])
        for number in range(count, len(self._copies)):
            self._lib.call("rtcDetachGeometry", self.address, number)
        del self._copies[count:], self._groups[kept:]
        start = sum(len(group.copies) for group in self._groups)
        for group, shapes in zip(groups[kept:], scenes[kept:], strict=True):
            moments = group.transform if group.transform.ndim == 4 else group.transform[:, None]
            origins = np.array([shape.origin for shape in shapes]).reshape(-1, 3)[group.shape]
            placed = moments.copy()
            placed[..., 3] += np.einsum("ksij,kj->ksi", moments[..., :3], origins) - self.origin
            mask = np.full(len(group), rtc.INVALID, np.uint32) if group.mask is None else group.mask
            masks = np.unique(mask)
            if len(self._copies) + len(masks) > COPIES:
                raise InputError(f"instances have more than {COPIES} different masks")
            for bits in masks:
                rows = np.flatnonzero(mask == bits)
                self._attach(
                    self._copy(shapes, group.shape[rows], placed=placed[rows], mask=int(bits)),
                    len(self._copies),
                )
                self._copies.append(rows + start)
            self._groups.append(_Group(group, shapes, placed, len(masks)))
            start += len(group)

    def _copy(
        self, shapes: Sequence[EmbreeScene], shape: NDArray[np.int32], *, placed: Float, mask: int
    ) -> int:
        """Address of an Embree geometry of instances with one mask."""
        lib = self._lib
        if len(shape) == 1:  # for a single instance Embree ignores the shape index and takes the first
            shapes, shape = [shapes[int(shape[0])]], np.zeros(1, np.int32)
        copies: int = lib.call("rtcNewGeometry", lib.device, rtc.INSTANCE_ARRAY)
        addresses = (c.c_void_p * len(shapes))(*(one.address for one in shapes))
        lib.call("rtcSetGeometryInstancedScenes", copies, addresses, len(shapes))
        steps = placed.shape[1]
        lib.call("rtcSetGeometryTimeStepCount", copies, steps)
        for step in range(steps):
            matrices = np.ascontiguousarray(placed[:, step], np.float32)
            rtc.fill(lib, copies, kind=rtc.TRANSFORM, slot=step, form=rtc.FLOAT3X4_ROW_MAJOR, rows=matrices)
        rtc.fill(lib, copies, kind=rtc.INDEX, slot=0, form=rtc.UINT, rows=shape.astype(np.uint32))
        lib.call("rtcSetGeometryMask", copies, mask)
        return copies

    def commit(self) -> None:
        """Rebuild what changed, and the tables for the kernels."""
        self._lib.call("rtcCommitScene", self.address)
        numbers = sorted(self.parts)
        parts = [self.parts[number] for number in numbers]
        # Keep the columns alive while the kernels use their addresses.
        self._own = parts, np.array([_addresses(part) for part in parts], np.int64).reshape(-1, 5)
        kept = [self._own]
        rows = np.zeros(COPIES + max(self.parts, default=-1) + 1, np.int32)
        rows[COPIES + np.array(numbers, np.int64)] = np.arange(len(parts))
        starts = np.cumsum([0, *(len(copied) for copied in self._copies)], dtype=np.int64)
        shape, steps, transforms = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty((0, 12))]
        for group in self._groups:
            before = sum(len(own) for own, _ in kept)
            kept += [one._own for one in group.shapes]  # noqa: SLF001
            first = before + np.cumsum([0, *(len(one._own[0]) for one in group.shapes)])  # noqa: SLF001
            shape.append(first[group.copies.shape])
            steps.append(np.full(len(group.copies), group.placed.shape[1], np.int64))
            transforms.append(group.placed.reshape(-1, 12))
        counts = np.concatenate(steps)
        self._kept = kept
        self.target = Target(
            self.address,
            self._packet.ctypes.data,
            self._single.ctypes.data,
            (0,) * self._lib.width,
            self.origin,
            np.concatenate([addresses for _, addresses in kept]),
            rows,
            starts,
            np.concatenate([np.empty(0, np.int32), *self._copies]).astype(np.int32),
            np.concatenate(shape).astype(np.int32),
            np.cumsum(counts) - counts,
            counts,
            np.concatenate(transforms),
            max((part.margin for own, _ in kept for part in own), default=0.0),
        )

    def cast(self, rays: Rays, *, normals: bool, threads: int) -> Hits:
        """The first hit of each ray."""
        n = len(rays.directions)
        columns = np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.float32)
        hits = Hits(*columns, np.empty((n if normals else 0, 3)))
        target = self.target

        def work(lo: int, hi: int) -> int:
            return int(kernels.cast(target, rays, lo, hi, *columns, hits.normal))

        share(work, rays, threads=threads)
        return hits

    def occluded(self, rays: Rays, *, threads: int) -> NDArray[np.bool_]:
        """Whether each ray hits anything."""
        out, target = np.empty(len(rays.directions), np.bool_), self.target
        share(lambda lo, hi: int(kernels.occluded(target, rays, lo, hi, out)), rays, threads=threads)
        return out


def _addresses(part: Geometry) -> tuple[int, int, int, int, int]:
    return (
        part.planes.ctypes.data,
        part.vertices.ctypes.data,
        part.faces.ctypes.data,
        part.numbers.ctypes.data if len(part.numbers) else 0,
        part.first,
    )
