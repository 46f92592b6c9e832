"""Embree scenes of triangles and instances, and their tables for the kernels."""

from __future__ import annotations

import ctypes as c
import weakref
from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.raycast import kernels
from lidar.raycast import library as rtc
from lidar.raycast.columns import COPIES, RayColumns, pack_target
from lidar.raycast.geometry import Geometry, MeshInstances
from lidar.raycast.rays import share
from lidar.raycast.scene import Float64Scene


def _arguments(flags: int = 0) -> NDArray[np.int64]:
    """An RTCIntersectArguments or RTCOccludedArguments: flags, feature mask, context, filter, intersect."""
    words = np.zeros(8, np.int64)
    words.view(np.uint32)[:2] = flags, rtc.INVALID
    return words


class EmbreeScene(Float64Scene):
    """A scene whose faces Embree proposes, traced in float32.

    Commits rebuild only what was attached or placed since the last one: in a dynamic scene Embree keeps a
    tree per geometry and merges their tops.

    origin  : (3,) float64, origin of the geometries' vertices
    dynamic : whether geometries are attached and detached later

    Raises BackendError if Embree is not available or reports an error.
    """

    kernel = staticmethod(kernels.cast)

    def __init__(self, origin: Float, *, dynamic: bool = False) -> None:
        super().__init__(origin)
        self._lib = rtc.library()
        self.address: int = self._lib.call("rtcNewScene", self._lib.device)
        weakref.finalize(self, self._lib.embree.rtcReleaseScene, self.address)
        self._lib.call("rtcSetSceneFlags", self.address, rtc.ROBUST | (rtc.DYNAMIC if dynamic else 0))
        if dynamic:
            # Embree keeps a tree per geometry only in low-quality scenes; the trees have medium quality.
            self._lib.call("rtcSetSceneBuildQuality", self.address, rtc.LOW)
        self._copies: list[NDArray[np.intp]] = []
        self._packet, self._single = _arguments(rtc.COHERENT), _arguments()

    def _attach(self, geometry: int, number: int) -> None:
        self._lib.call("rtcCommitGeometry", geometry)
        self._lib.call("rtcAttachGeometryByID", self.address, geometry, number)
        self._lib.call("rtcReleaseGeometry", geometry)

    def attach(self, number: int, part: Geometry) -> None:
        """Add a geometry under a free number. Results depend on the numbers, not on the order of calls."""
        super().attach(number, part)
        if len(part) == 0:
            return
        geometry = self._lib.call("rtcNewGeometry", self._lib.device, rtc.TRIANGLE)
        patches = np.arange(len(part.vertices), len(part.hull)).reshape(-1, 3)
        faces = np.concatenate([part.faces, patches]).astype(np.uint32)
        rtc.fill(self._lib, geometry, kind=rtc.VERTEX, slot=0, form=rtc.FLOAT3, rows=part.hull)
        rtc.fill(self._lib, geometry, kind=rtc.INDEX, slot=0, form=rtc.UINT3, rows=faces)
        self._lib.call("rtcSetGeometryMask", geometry, part.mask)
        self._lib.call("rtcSetGeometryBuildQuality", geometry, rtc.MEDIUM)
        self._attach(geometry, COPIES + number)

    def detach(self, number: int) -> None:
        """Remove the geometry of a number."""
        if len(self.parts[number]):
            self._lib.call("rtcDetachGeometry", self.address, COPIES + number)
        super().detach(number)

    def place(self, groups: Sequence[MeshInstances], scenes: Sequence[Sequence[Self]]) -> int:
        """Replace all instances; ``scenes`` holds each group's shapes. Returns how many leading groups stay.

        Raises InputError for more than `COPIES` masks.
        """
        kept = super().place(groups, scenes)
        count = sum(len(np.unique(group.masks)) for group in self.groups[:kept])
        for number in range(count, len(self._copies)):
            self._lib.call("rtcDetachGeometry", self.address, number)
        del self._copies[count:]
        start = sum(len(group.copies) for group in self.groups[:kept])
        for group, shapes in zip(self.groups[kept:], scenes[kept:], strict=True):
            for bits in np.unique(group.masks):
                if len(self._copies) == COPIES:
                    raise InputError(f"instances have more than {COPIES} different masks")
                rows = np.flatnonzero(group.masks == bits)
                geometry = self._copy(
                    shapes, group.copies.shape[rows], placed=group.placed[rows], mask=int(bits)
                )
                self._attach(geometry, len(self._copies))
                self._copies.append(rows + start)
            start += len(group.copies)
        return kept

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
        rows = np.zeros(COPIES + max(self.parts, default=-1) + 1, np.int32)
        rows[COPIES + np.array(numbers, np.int64)] = np.arange(len(numbers))
        self.target = self.tables()._replace(
            scene=self.address,
            packet=self._packet.ctypes.data,
            single=self._single.ctypes.data,
            lanes=(0,) * self._lib.width,
            rows=rows,
            starts=np.cumsum([0, *(len(copied) for copied in self._copies)], dtype=np.int64),
            numbers=np.concatenate([np.empty(0, np.int32), *self._copies]).astype(np.int32),
        )
        self.packed = pack_target(self.target)

    def occluded(self, rays: RayColumns, *, threads: int) -> NDArray[np.bool_]:
        """Whether each ray hits anything."""
        out, target = np.empty(len(rays.directions), np.bool_), self.packed
        share(lambda lo, hi: int(kernels.find_occluded(target, rays, lo, hi, out)), rays, threads=threads)
        return out
