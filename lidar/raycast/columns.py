"""Arguments of the compiled kernels: rays and their target as tuples of columns."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.memory import float64_column, int32_column, int64_column, uint32_column

COPIES = 256
"""Geometry numbers below this are for instances, numbers from it on for the mesh. Embree's commit visits all
numbers up to the highest."""

PRECISIONS = ("exact", "refined", "float32")
"""Precisions of ranges, see `lidar.raycast.Caster.cast`; `RayColumns.precision` is the index of one."""

EXACT, REFINED, FLOAT32 = range(len(PRECISIONS))
"""Indices of `PRECISIONS`."""

CHUNK = 2048
"""Threads share rays in multiples of this number, which is one of all packet widths: packets never change."""


class RayTarget(NamedTuple):
    """Geometry that rays are cast against, as columns for compiled code.

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
    groups     : (g, 4) int64, trees (`lidar.geometry.box_tree`) of the own parts and of groups of instances:
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


class Packed(NamedTuple):
    """A target as kernels are given it: numba takes a microsecond for each array.

    lanes : as of `RayTarget`
    words : int64, its other numbers, and addresses and lengths of its columns
    """

    lanes: tuple[int, ...]
    words: NDArray[np.int64]


def pack_target(target: RayTarget) -> Packed:
    """A target for kernels, of which the caller keeps the columns."""
    columns = target[4:]
    words = [target.scene, target.packet, target.single]
    for column in columns:
        words += [column.ctypes.data, len(column)]
    return Packed(target.lanes, np.array(words, np.int64))


@njit(nogil=True)
def unpack_target(given: Packed) -> Any:
    """Inverse of `pack_target`."""
    w = given.words
    return RayTarget(
        w[0],
        w[1],
        w[2],
        given.lanes,
        float64_column(w[3], (w[4],)),
        int64_column(w[5], (w[6], 9)),
        int32_column(w[7], (w[8],)),
        int64_column(w[9], (w[10],)),
        int32_column(w[11], (w[12],)),
        int32_column(w[13], (w[14],)),
        int32_column(w[15], (w[16],)),
        uint32_column(w[17], (w[18],)),
        int64_column(w[19], (w[20],)),
        int64_column(w[21], (w[22],)),
        float64_column(w[23], (w[24], 12)),
        int64_column(w[25], (w[26], 4)),
    )


class RayColumns(NamedTuple):
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
    scattered  : whether footprints near the border of two levels of detail are of either, by chance
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
    scattered: bool
