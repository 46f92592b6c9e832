"""Arguments of the compiled kernels: rays and their target as tuples of columns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float

COPIES = 256
"""Geometry numbers below this are for instances, numbers from it on for the mesh. Embree's commit visits all
numbers up to the highest."""

PRECISIONS = ("exact", "refined", "float32")
"""Precisions of ranges, see `lidar.raycast.Caster.cast`; `Rays.precision` is the index of one."""

EXACT, REFINED, FLOAT32 = range(len(PRECISIONS))
"""Indices of `PRECISIONS`."""

CHUNK = 2048
"""Threads share rays in multiples of this number, which is one of all packet widths: packets never change."""


class Target(NamedTuple):
    """The target of rays.

    scene, packet, single : addresses of the Embree scene and of the arguments for packets and for single rays
    lanes      : as many zeros as rays in a packet: their number is a compile-time constant
    origin     : (3,) float64, subtracted from scene coordinates
    parts      : (p, 9) int64, one row per geometry (see `lidar.raycast.rows.PART`): own ones, then those of
                 shapes
    rows       : (g,) int32, row of ``parts`` of Embree's geometry g, if it holds triangles
    starts     : (g,) int64, start in ``numbers`` of Embree's geometry g, if it holds instances
    numbers    : (k,) int32, instance numbers in Embree's order
    shape      : (k,) int32, first row of ``parts`` of the instance's shape
    sizes      : (k,) int32, number of rows of ``parts`` of the instance's shape
    masks      : (k,) uint32, of the instance
    first      : (k,) int64, first row of ``transforms``
    steps      : (k,) int64, rows of ``transforms``; 1 for a static instance
    transforms : (r, 12) float64, from instance to caster, each relative to its own origin
    groups     : (g, 4) int64, trees (see `lidar.raycast.tree`) of the own parts and of groups of instances:
                 addresses of nodes and order, number of items, number of the first instance (-1: parts)
    """

    scene: int
    packet: int
    single: int
    lanes: tuple[int, ...]
    origin: Float
    parts: NDArray[np.int64]
    rows: NDArray[np.int32]
    starts: NDArray[np.int64]
    numbers: NDArray[np.int32]
    shape: NDArray[np.int32]
    sizes: NDArray[np.int32]
    masks: NDArray[np.uint32]
    first: NDArray[np.int64]
    steps: NDArray[np.int64]
    transforms: Float
    groups: NDArray[np.int64]


class Rays(NamedTuple):
    """Rays as contiguous columns.

    directions : (n, 3) float64, in the axes of the pose if ``pose`` is not empty
    offsets    : (n, 3) float64, origins in the pose's frame; (1, 3) for all rays, (0, 3) for zero
    pose       : (n,) int64, row of the poses; empty: directions and offsets are in the caster's frame
    position   : (p, 3) float64, of the poses
    matrix     : (p, 3, 3) float64, scale * rotation of the poses (see `lidar.geometry.poses.Poses`)
    order      : (n,) int64, order of work; empty: as given
    time       : (n,) float32, ray times; empty: all 0
    near       : ray parameter
    far        : (n,) float64, ray parameter; (1,) for all rays
    mask       : bits
    precision  : index of one of `PRECISIONS`
    retrace    : whether rays that miss are traced a second time
    footprint  : metres, width of a ray at its start, and its growth per metre
    """

    directions: Float
    offsets: Float
    pose: NDArray[np.int64]
    position: Float
    matrix: Float
    order: NDArray[np.int64]
    time: NDArray[np.float32]
    near: float
    far: Float
    mask: int
    precision: int
    retrace: bool
    footprint: tuple[float, float]
