"""Scenes of triangles and instances in the memory of a device, whose rays are cast there in float64."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import warp as wp
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import BackendError
from lidar.raycast import warp_kernels
from lidar.raycast.columns import RayColumns
from lidar.raycast.columns import RayTarget as Tables
from lidar.raycast.device import WarpDevice
from lidar.raycast.geometry import MeshInstances
from lidar.raycast.hits import Hits
from lidar.raycast.rays import share
from lidar.raycast.scene import Float64Scene

_COLUMNS = {
    "directions": wp.vec3d,
    "offsets": wp.vec3d,
    "pose": wp.int64,
    "position": wp.vec3d,
    "matrix": wp.float64,
    "order": wp.int64,
    "time": wp.float32,
    "far": wp.float64,
}
"""Columns of `RayColumns` that travel to the device, and the types of their items."""


class WarpScene(Float64Scene):
    """A scene on a device of Warp. Its hits are those of a `Float64Scene`, byte for byte.

    Columns of geometries and trees are copied to the device once; later commits copy what is new, and the
    tables of instances.

    origin : (3,) float64, origin of the geometries' vertices
    """

    def __init__(self, origin: Float, *, device: WarpDevice) -> None:
        super().__init__(origin)
        self.device = device
        self._copies: dict[int, tuple[NDArray[Any], Any]] = {}
        self._former = self._copies

    def pointer(self, column: NDArray[Any]) -> int:
        """Address at which the kernels read a column of a geometry or a tree."""
        key = id(column)  # of a column that is kept: no other gets its number
        copy = self._copies.get(key) or self._former.get(key) or (column, self.device.upload(column))
        self._copies[key] = copy
        return int(copy[1].ptr or 0)

    def place(self, groups: Sequence[MeshInstances], scenes: Sequence[Sequence[Self]]) -> int:
        """Replace all instances; see `Float64Scene.place`."""
        kept = super().place(groups, scenes)
        if any(shape.device is not self.device for shapes in scenes for shape in shapes):
            raise BackendError("instances and their shapes need the same device")
        return kept

    def tables(self) -> Tables:
        """The tables for the kernels, with addresses of the device."""
        with self.device.lock:
            self._former, self._copies = self._copies, {}
            tables = super().tables()
            self._former = {}
            upload, target = self.device.upload, warp_kernels.WarpTarget()
            target.origin = wp.vec3d(*self.origin)
            for name in ("parts", "shape", "sizes", "masks", "first", "steps", "transforms", "groups"):
                setattr(target, name, upload(getattr(tables, name)))
            self._on_device = target
        return tables

    def cast(self, rays: RayColumns, *, normals: bool, threads: int) -> Hits:  # noqa: ARG002
        """The first hit of each ray."""
        n = len(rays.directions)
        kinds = (wp.float64, wp.int32, wp.int32, wp.float32)
        out = self._run(warp_kernels.cast, rays, [*((n, k) for k in kinds), (n if normals else 0, wp.vec3d)])
        return Hits(*out)

    def occluded(self, rays: RayColumns, *, threads: int) -> NDArray[np.bool_]:  # noqa: ARG002
        """Whether each ray hits anything."""
        blocked: NDArray[np.bool_] = self._run(
            warp_kernels.test_occlusion, rays, [(len(rays.directions), wp.bool)]
        )[0]
        return blocked

    def _run(self, kernel: Any, rays: RayColumns, results: Sequence[tuple[int, Any]]) -> list[NDArray[Any]]:
        """The results of a kernel, given their lengths and types."""
        found: list[NDArray[Any]] = []

        def launch(_: int, n: int) -> int:
            """Cast all rays; returns the first invalid one, or -1."""
            with self.device.lock:
                there = warp_kernels.WarpRays()
                for name, kind in _COLUMNS.items():
                    setattr(there, name, self.device.upload(getattr(rays, name), kind))
                there.near, there.mask = rays.near, rays.mask
                out = [self.device.empty(count, kind) for count, kind in results]
                bad = self.device.upload(np.array([n], np.int32))
                where = self.device.warp_device
                wp.launch(kernel, dim=n, inputs=[self._on_device, there, *out, bad], device=where)
                found.extend(column.numpy() for column in out)
                first = int(bad.numpy()[0])
            return first if first < n else -1

        share(launch, rays, threads=1)
        return found
