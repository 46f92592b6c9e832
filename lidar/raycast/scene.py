"""Scenes of triangles and instances whose rays are cast in float64, and their tables for compiled code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import BackendError
from lidar.geometry.box_tree import Tree, tree_of
from lidar.raycast import kernels
from lidar.raycast.columns import Packed, RayColumns, RayTarget, pack_target
from lidar.raycast.geometry import ALL, Geometry, MeshInstances
from lidar.raycast.hits import Hits
from lidar.raycast.rays import share
from lidar.raycast.rows import PART


class Group(NamedTuple):
    """A group of instances with its shapes.

    placed : (k, s, 3, 4) transforms, relative to the scene's origin
    tree   : of the instances' boxes, at all of their times
    """

    copies: MeshInstances
    shapes: Sequence[Float64Scene]
    placed: Float
    tree: Tree

    @property
    def masks(self) -> NDArray[np.uint32]:
        """Mask (k,) of each instance."""
        mask = self.copies.mask
        return np.full(len(self.copies), ALL, np.uint32) if mask is None else mask


class Float64Scene:
    """A scene of numbered geometries and of instances of other scenes, traced in float64.

    Changes take effect with `commit`.

    origin : (3,) float64, origin of the geometries' vertices
    """

    kernel: Callable[..., Any] = staticmethod(kernels.cast_float64)

    def __init__(self, origin: Float) -> None:
        self.origin = origin
        self.parts: dict[int, Geometry] = {}
        self.groups: list[Group] = []
        self.target: RayTarget
        self.packed: Packed
        self._own: tuple[list[Geometry], NDArray[np.int64]]

    def attach(self, number: int, part: Geometry) -> None:
        """Add a geometry under a free number. Results depend on the numbers, not on the order of calls."""
        self.parts[number] = part

    def detach(self, number: int) -> None:
        """Remove the geometry of a number."""
        del self.parts[number]

    def place(self, groups: Sequence[MeshInstances], scenes: Sequence[Sequence[Self]]) -> int:
        """Replace all instances; ``scenes`` holds each group's shapes. Returns how many leading groups stay.

        Raises BackendError if a shape has another backend.
        """
        kept = 0
        while kept < min(len(groups), len(self.groups)) and groups[kept] is self.groups[kept].copies:
            kept += 1
        del self.groups[kept:]
        for group, shapes in zip(groups[kept:], scenes[kept:], strict=True):
            if any(type(shape) is not type(self) for shape in shapes):
                raise BackendError("instances and their shapes need the same backend")
            moments = group.transform if group.transform.ndim == 4 else group.transform[:, None]
            origins = np.array([shape.origin for shape in shapes]).reshape(-1, 3)[group.shape]
            placed = moments.copy()
            placed[..., 3] += np.einsum("ksij,kj->ksi", moments[..., :3], origins) - self.origin
            bounds = np.array([shape.bounds() for shape in shapes]).reshape(-1, 8, 3)[group.shape]
            corners = np.einsum("ksij,kcj->ksci", placed[..., :3], bounds) + placed[:, :, None, :, 3]
            low, high = corners.min(axis=(1, 2)), corners.max(axis=(1, 2))
            self.groups.append(Group(group, shapes, placed, tree_of(low, high)))
        return kept

    def bounds(self) -> Float:
        """Corners (8, 3) of the box of all own geometries; zeros without any."""
        roots = [part.tree.nodes[0] for part in self.parts.values() if len(part)]
        if not roots:
            return np.zeros((8, 3))
        low, high = np.min(roots, axis=0)[:3], np.max(roots, axis=0)[3:6]
        return np.array([[(low, high)[i >> c & 1][c] for c in range(3)] for i in range(8)], np.float64)

    def commit(self) -> None:
        """Rebuild what changed, and the tables for the kernels."""
        self.target = self.tables()
        self.packed = pack_target(self.target)

    def tables(self) -> RayTarget:
        """The tables for the kernels, without those of Embree."""
        parts = [self.parts[number] for number in sorted(self.parts)]
        # Keep the columns alive while the kernels use their addresses.
        self._own = parts, np.array([self._row(part) for part in parts], np.int64).reshape(-1, PART)
        kept = [self._own]
        roots = [part.tree.nodes[:1] for part in parts]
        bounds = np.concatenate([np.empty((0, 8), np.float32), *roots]).astype(np.float64)
        trees = [tree_of(bounds[:, :3], bounds[:, 3:6])]
        shape, sizes, steps = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [np.empty(0, np.int64)]
        masks, transforms = [np.empty(0, np.uint32)], [np.empty((0, 12))]
        for group in self.groups:
            before = sum(len(own) for own, _ in kept)
            kept += [one._own for one in group.shapes]  # noqa: SLF001
            counts = np.array([len(one._own[0]) for one in group.shapes], np.int64)  # noqa: SLF001
            shape.append((before + np.cumsum(counts) - counts)[group.copies.shape])
            sizes.append(counts[group.copies.shape])
            steps.append(np.full(len(group.copies), group.placed.shape[1], np.int64))
            masks.append(group.masks)
            transforms.append(group.placed.reshape(-1, 12))
            trees.append(group.tree)
        starts = np.cumsum([0, *(len(group.copies) for group in self.groups)])
        counts = np.concatenate(steps)
        self._kept = kept, trees
        return RayTarget(
            scene=0,
            packet=0,
            single=0,
            lanes=(0,),
            origin=self.origin,
            parts=np.concatenate([rows for _, rows in kept]),
            rows=np.empty(0, np.int32),
            starts=np.empty(0, np.int64),
            numbers=np.empty(0, np.int32),
            shape=np.concatenate(shape).astype(np.int32),
            sizes=np.concatenate(sizes).astype(np.int32),
            masks=np.concatenate(masks).astype(np.uint32),
            first=np.cumsum(counts) - counts,
            steps=counts,
            transforms=np.concatenate(transforms),
            groups=np.array(
                [
                    (self.pointer(tree.nodes), self.pointer(tree.order), len(tree.order), start)
                    for tree, start in zip(trees, [-1, *starts[:-1]], strict=True)
                ],
                np.int64,
            ),
        )

    def pointer(self, column: NDArray[Any]) -> int:
        """Address at which the kernels read a column of a geometry or a tree."""
        return column.ctypes.data

    def _row(self, part: Geometry) -> tuple[int, ...]:
        """Row of `RayTarget.parts`."""
        return (
            self.pointer(part.planes),
            self.pointer(part.vertices),
            self.pointer(part.faces),
            self.pointer(part.numbers) if len(part.numbers) else 0,
            part.first,
            self.pointer(part.tree.nodes),
            self.pointer(part.tree.order),
            len(part),
            part.mask,
        )

    def cast(self, rays: RayColumns, *, normals: bool, threads: int) -> Hits:
        """The first hit of each ray."""
        n = len(rays.directions)
        columns = np.empty(n), np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.float32)
        hits = Hits(*columns, np.empty((n if normals else 0, 3)))
        kernel, target = self.kernel, self.packed
        share(lambda lo, hi: int(kernel(target, rays, lo, hi, *columns, hits.normal)), rays, threads=threads)
        return hits

    def occluded(self, rays: RayColumns, *, threads: int) -> NDArray[np.bool_]:
        """Whether each ray hits anything."""
        return self.cast(rays, normals=False, threads=threads).face >= 0
