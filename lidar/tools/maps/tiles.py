"""Maps in tiles: a file for each square of the projected grid, and an index."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS

from geoscene.scene.geopackage import Layer, open_geopackage
from geoscene.support.columns import row_blocks
from lidar.dataset.formats import Format
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table
from lidar.tools.maps.squares import squares_beside

INDEX = "tiles.gpkg"
"""Name of the index in a folder of tiles."""

NAMES = r"-?\d+_-?\d+\.(copc\.laz|laz|las)|tiles\..*"
"""Names of the files in such a folder."""

_BLOCK = 1 << 20  # points that are written at once


@contextmanager
def open_tiles(
    folder: Path, side: int, *, form: Format, info: LasInfo, columns: tuple[str, ...]
) -> Iterator[Callable[[Table], None]]:
    """Yield a function that appends tables to tiles, which are written afterwards with `INDEX`.

    side : metres; borders are multiples of it
    form : LAS, LAZ or COPC

    Tiles are named ``<easting>_<northing>`` of their lower left corners. The index is a layer ``tiles`` of
    squares with file name, number of points, and least and greatest height.
    """
    east, north = (int(v // side) * side for v in info.offset[:2])
    with squares_beside(folder / INDEX, side, offset=(east, north, 0.0), what="squares") as squares:

        def append(table: Table) -> None:
            # As files hold them: a rounded coordinate can be beyond a border.
            steps = {axis: np.round(table[axis] / info.scale) * info.scale for axis in "xyz"}
            squares.add(squares.records(table | steps))

        yield append
        found = []
        for column, row in squares:
            corner = east + column * side, north + row * side
            name, data = f"{corner[0]}_{corner[1]}{form.suffix}", squares.all_of((column, row))
            with form.open_map(folder / name, info=info, columns=columns) as write:
                for part in row_blocks(len(data), _BLOCK):
                    write(squares.table(data[part]))
            found.append((*corner, name, len(data), data["z"].min(), data["z"].max()))
        _write_index(folder / INDEX, found, side=side, crs=info.crs)


def _write_index(path: Path, tiles: Sequence[tuple[Any, ...]], *, side: int, crs: CRS) -> None:
    """Write the squares of tiles: easting, northing, name, points, least and greatest height of each."""
    east, north, names, points, low, high = (
        np.array([tile[k] for tile in tiles], kind)
        for k, kind in enumerate((float, float, object, np.int64, float, float))
    )
    columns = {"file": names, "points": points, "low": low, "high": high}
    squares = shapely.box(east, north, east + side, north + side)
    with open_geopackage(path) as append:
        append(Layer("tiles", squares, columns), "Polygon", crs.to_wkt())
