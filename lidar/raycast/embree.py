"""Embree scenes: triangles and copies of them, and the rays cast at them."""

from __future__ import annotations

import ctypes as c
import weakref
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lidar.raycast import kernels
from lidar.raycast.geometry import Geometry, Instances
from lidar.raycast.library import (
    COHERENT,
    FLOAT3,
    FLOAT3X4_ROW_MAJOR,
    INDEX,
    INSTANCE_ARRAY,
    INVALID,
    ROBUST,
    TRANSFORM,
    TRIANGLE,
    UINT,
    UINT3,
    VERTEX,
    Library,
    fill,
    library,
)

Float = NDArray[np.float64]


def arguments(flags: int = 0, *, context: int = 0, collect: int = 0) -> NDArray[np.int64]:
    """An RTCIntersectArguments (or RTCOccludedArguments): flags, feature mask, context, filter, intersect."""
    words = np.zeros(8, np.int64)
    words.view(np.uint32)[:2] = flags, INVALID
    words[1:3] = context, collect
    return words


class EmbreeScene:
    """A committed Embree scene of a geometry and of copies of other scenes' own triangles.

    Raises BackendError if Embree is not to be had or refuses.
    """

    def __init__(
        self,
        geometry: Geometry,
        instances: Sequence[Instances],
        shapes: Sequence[Sequence[EmbreeScene]],
    ) -> None:
        """Build it; ``shapes`` holds, for each group of instances, the scenes that its shapes are."""
        lib = library()
        self.geometry = geometry
        self.address: int = lib.call("rtcNewScene", lib.device)
        weakref.finalize(self, lib.embree.rtcReleaseScene, self.address)
        lib.call("rtcSetSceneFlags", self.address, ROBUST)
        self._add_triangles(lib)
        table = _Table(geometry.origin)
        for group, scenes in zip(instances, shapes, strict=True):
            self._add_instances(lib, group, scenes, table)
        lib.call("rtcCommitScene", self.address)
        self._packet, self._single = arguments(COHERENT), arguments()
        self._parts = table.parts  # the shapes' columns must live as long as their addresses
        self.target = kernels.Target(
            self.address,
            self._packet.ctypes.data,
            self._single.ctypes.data,
            lib.width,
            geometry.origin,
            np.array([self.row, *(part.row for part in table.parts)], np.int64),
            *table.columns(),
        )

    def _attach(self, lib: Library, geometry: int) -> int:
        lib.call("rtcCommitGeometry", geometry)
        number: int = lib.call("rtcAttachGeometry", self.address, geometry)
        lib.call("rtcReleaseGeometry", geometry)
        return number

    def _add_triangles(self, lib: Library) -> None:
        """Attach the own faces, one Embree geometry for each mask."""
        g = self.geometry
        points = g.vertices.astype(np.float32)
        masks = np.unique(g.mask)
        chosen = [np.flatnonzero(g.mask == mask).astype(np.int32) for mask in masks]
        for mask, rows in zip(masks, chosen, strict=True):
            part = lib.call("rtcNewGeometry", lib.device, TRIANGLE)
            fill(lib, part, VERTEX, 0, FLOAT3, points)
            corners = g.faces if len(masks) == 1 else g.faces[rows]
            fill(lib, part, INDEX, 0, UINT3, corners.astype(np.uint32))
            lib.call("rtcSetGeometryMask", part, int(mask))
            self._attach(lib, part)
        self.parts = len(masks)
        self._faces = np.concatenate(chosen) if len(masks) > 1 else np.empty(0, np.int32)
        self._starts = np.cumsum([0, *(len(rows) for rows in chosen)]).astype(np.int64)
        self.row = (
            g.planes.ctypes.data,
            g.vertices.ctypes.data,
            g.faces.ctypes.data,
            self._faces.ctypes.data if len(masks) > 1 else 0,
            self._starts.ctypes.data,
        )

    def _add_instances(
        self, lib: Library, group: Instances, scenes: Sequence[EmbreeScene], table: _Table
    ) -> None:
        """Attach the copies of a group, one Embree geometry for each mask."""
        moments = group.transform if group.transform.ndim == 4 else group.transform[:, None]
        placed = table.add(group, scenes, moments)
        mask = np.full(len(group), INVALID, np.uint32) if group.mask is None else group.mask
        for bits in np.unique(mask):
            rows = np.flatnonzero(mask == bits)
            copies = lib.call("rtcNewGeometry", lib.device, INSTANCE_ARRAY)
            addresses = (c.c_void_p * len(scenes))(*(scene.address for scene in scenes))
            lib.call("rtcSetGeometryInstancedScenes", copies, addresses, len(scenes))
            lib.call("rtcSetGeometryTimeStepCount", copies, moments.shape[1])
            for step in range(moments.shape[1]):
                matrices = np.ascontiguousarray(placed[rows, step], np.float32)
                fill(lib, copies, TRANSFORM, step, FLOAT3X4_ROW_MAJOR, matrices)
            fill(lib, copies, INDEX, 0, UINT, group.shape[rows].astype(np.uint32))
            lib.call("rtcSetGeometryMask", copies, int(bits))
            table.attached(self._attach(lib, copies), rows)


class _Table:
    """The columns of `kernels.Target` that say which instance is where, collected group by group."""

    def __init__(self, origin: Float) -> None:
        self.origin = origin
        self.parts: list[EmbreeScene] = []
        self.count = 0
        self._starts: dict[int, int] = {}
        self._numbers: list[NDArray[np.int64]] = []
        self._shape: list[NDArray[np.int64]] = []
        self._steps: list[NDArray[np.int64]] = []
        self._transforms: list[Float] = []

    def add(self, group: Instances, scenes: Sequence[EmbreeScene], moments: Float) -> Float:
        """Take in a group; its transforms (k, s, 3, 4), caster from shape, each relative to its own origin."""
        origins = np.array([scene.geometry.origin for scene in scenes]).reshape(-1, 3)[group.shape]
        placed = moments.copy()
        placed[..., 3] += np.einsum("ksij,kj->ksi", moments[..., :3], origins) - self.origin
        self._shape.append(group.shape.astype(np.int64) + 1 + len(self.parts))
        self._steps.append(np.full(len(group), moments.shape[1], np.int64))
        self._transforms.append(placed.reshape(-1, 12))
        self.parts += scenes
        self._group, self.count = self.count, self.count + len(group)
        return placed

    def attached(self, geometry: int, rows: NDArray[np.intp]) -> None:
        """Note that Embree's geometry holds these rows of the group taken in last."""
        self._starts[geometry] = sum(map(len, self._numbers))
        self._numbers.append(rows.astype(np.int64) + self._group)

    def columns(self) -> tuple[NDArray[np.int64] | NDArray[np.int32] | Float, ...]:
        """starts, numbers, shape, first, steps and transforms."""
        none = np.empty(0, np.int64)
        starts = np.zeros(max(self._starts, default=-1) + 1, np.int64)
        for geometry, start in self._starts.items():
            starts[geometry] = start
        steps = np.concatenate([none, *self._steps])
        return (
            starts,
            np.concatenate([none, *self._numbers]).astype(np.int32),
            np.concatenate([none, *self._shape]).astype(np.int32),
            np.cumsum(steps) - steps,
            steps,
            np.concatenate([np.empty((0, 12)), *self._transforms]),
        )
