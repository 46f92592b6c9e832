"""Voxel grids: one point per cube, in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidar.dataset.formats.table import Table
from lidar.tools.maps.squares import Square, squares_beside

_BUCKET = 64.0  # metres: side of the squares into which points are sorted before they are thinned
_SHRINK_AT = 64 * 2**20  # bytes of a square's points beyond which they are thinned


def nearest_to_centre(data: NDArray[np.void], voxel: float) -> NDArray[np.void]:
    """The record nearest to the centre of each voxel; of equally near ones the earliest."""
    xyz = np.column_stack([data[k] for k in "xyz"])
    cell = np.floor(xyz / voxel)
    away = ((xyz - (cell + 0.5) * voxel) ** 2).sum(axis=1)
    order = np.lexsort((data["gps_time"], away, cell[:, 0], cell[:, 1], cell[:, 2]))
    sorted_cells = cell[order]
    first = np.ones(len(order), bool)
    first[1:] = (sorted_cells[1:] != sorted_cells[:-1]).any(axis=1)
    return data.take(order[first])


def thin(
    tables: Iterator[Table], voxel: float, *, out: Path, offset: tuple[float, float, float]
) -> Iterator[Table]:
    """Tables with one point per voxel, by squares."""
    # The side is a multiple of the voxel, so that no voxel spans two squares.
    side = max(1.0, np.ceil(_BUCKET / voxel)) * voxel
    limits: dict[Square, int] = {}  # bytes at which a square's file is thinned
    with squares_beside(out, side, offset=offset, what="voxels") as squares:
        for table in tables:
            for square in squares.add(nearest_to_centre(squares.records(table), voxel)):
                path = squares.path(square)
                if path.stat().st_size > limits.get(square, _SHRINK_AT):
                    path.write_bytes(nearest_to_centre(np.array(squares.all_of(square)), voxel).tobytes())
                    limits[square] = max(_SHRINK_AT, 2 * path.stat().st_size)
        for square in squares:
            yield squares.table(nearest_to_centre(np.array(squares.all_of(square)), voxel))
