"""Points sorted into squares of the plane, for maps larger than memory: thinning, outliers, and tiles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from scipy.spatial import KDTree

from geoscene.scene.geopackage import Layer, open_geopackage
from geoscene.support.columns import row_blocks
from geoscene.support.files import temporary_folder
from lidar.dataset.formats import Format
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import Table, records

Square = tuple[int, int]
"""Column and row of a square: its lower left corner over its side."""
_BUCKET = 64.0  # metres: side of the squares into which points are sorted before they are thinned
_SHRINK_AT = 64 * 2**20  # bytes of a square's points beyond which they are thinned
_SIDE = 16.0  # metres: side of the squares whose points are worked on at once
_FARTHEST = 4.0  # metres: neighbours farther away count as this far, so that a margin of it is enough
_BLOCK = 1 << 17  # points whose neighbours are sought at once
INDEX = "tiles.gpkg"
"""Name of the index in a folder of tiles."""

NAMES = r"-?\d+_-?\d+\.(copc\.laz|laz|las)|tiles\..*"
"""Names of the files in such a folder."""

_WRITTEN = 1 << 20  # points that are written at once


class Squares:
    """Records of points by square, files of a folder; coordinates are less an offset of whole metres.

    side : metres
    """

    def __init__(self, folder: Path, side: float, *, offset: tuple[float, float, float]) -> None:
        self.side = side
        self._folder = folder
        self._offset = offset
        self._kinds = np.dtype([])
        self._found: set[Square] = set()

    def path(self, square: Square) -> Path:
        """The file of a square."""
        return self._folder / f"{square[0]}_{square[1]}"

    def records(self, table: Table) -> NDArray[np.void]:
        """Records of a table, less the offset."""
        data = records(table)
        self._kinds = data.dtype
        for axis, shift in zip("xyz", self._offset, strict=True):
            data[axis] -= shift
        return data

    def add(self, data: NDArray[np.void]) -> list[Square]:
        """Append records of `records`; return the squares that they are in."""
        if not len(data):
            return []
        column, row = (np.floor(data[axis] / self.side).astype(np.int64) for axis in "xy")
        order = np.lexsort((row, column))  # stable: points of a square keep their order
        column, row = column[order], row[order]
        begins = np.flatnonzero(np.r_[True, (np.diff(column) != 0) | (np.diff(row) != 0)])
        touched = [(int(column[k]), int(row[k])) for k in begins]
        for square, mine in zip(touched, np.split(order, begins[1:]), strict=True):
            with self.path(square).open("ab") as file:
                file.write(data.take(mine).tobytes())  # records: far faster than by an index
        self._found.update(touched)
        return touched

    def __iter__(self) -> Iterator[Square]:
        """Squares with points, in order."""
        return iter(sorted(self._found))

    def all_of(self, square: Square) -> NDArray[np.void]:
        """Records of a square, on disk until they are used; none of a square without points."""
        if square not in self._found:
            return np.empty(0, self._kinds)
        mapped: NDArray[np.void] = np.memmap(self.path(square), self._kinds, "r")
        return mapped

    def table(self, data: NDArray[Any]) -> Table:
        """The table of records, with the offset again."""
        table = {name: np.array(data[name]) for name in data.dtype.names or ()}
        for axis, shift in zip("xyz", self._offset, strict=True):
            table[axis] += shift
        return table


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
    with temporary_folder(out, "voxels") as folder:
        squares = Squares(folder, side, offset=offset)
        for table in tables:
            for square in squares.add(nearest_to_centre(squares.records(table), voxel)):
                path = squares.path(square)
                if path.stat().st_size > limits.get(square, _SHRINK_AT):
                    path.write_bytes(nearest_to_centre(np.array(squares.all_of(square)), voxel).tobytes())
                    limits[square] = max(_SHRINK_AT, 2 * path.stat().st_size)
        for square in squares:
            yield squares.table(nearest_to_centre(np.array(squares.all_of(square)), voxel))


class Outliers:
    """Points whose mean distance to their neighbours is beyond a limit, which is that of the whole map.

    The limit is the mean of these distances plus ``factor`` standard deviations (Rusu et al. 2008). The
    result does not depend on the squares: of each point the true neighbours are found.

    neighbours : number of the nearest ones
    left_out   : number of points
    """

    def __init__(self, neighbours: int, factor: float) -> None:
        self.left_out = 0
        self._neighbours, self._factor = neighbours, factor

    def without(
        self, tables: Iterator[Table], *, out: Path, offset: tuple[float, float, float]
    ) -> Iterator[Table]:
        """The tables without outliers, square by square; points are on disk meanwhile, beside ``out``."""
        with temporary_folder(out, "outliers") as folder:
            squares = Squares(folder, _SIDE, offset=offset)
            for table in tables:
                squares.add(squares.records(table))
            count, total, squared = 0, 0.0, 0.0
            for square in squares:
                spacing = self._spacing(squares, square)
                spacing.tofile(_spacing_file(squares, square))
                count += len(spacing)
                total += float(spacing.sum(dtype=float))
                squared += float((spacing.astype(float) ** 2).sum())
            mean = total / max(count, 1)
            limit = mean + self._factor * max(squared / max(count, 1) - mean**2, 0.0) ** 0.5
            for square in squares:
                data, spacing = squares.all_of(square), np.fromfile(_spacing_file(squares, square), "<f4")
                for rows in row_blocks(len(data), _BLOCK):
                    kept = data[rows][spacing[rows] <= limit]
                    self.left_out += len(data[rows]) - len(kept)
                    yield squares.table(kept)

    def _spacing(self, squares: Squares, square: Square) -> NDArray[np.float32]:
        """Mean distances (n,) of a square's points to their neighbours in it and in those around it."""
        column, row = square
        low = np.array([column, row]) * squares.side - _FARTHEST
        high = low + squares.side + 2 * _FARTHEST
        around = []
        for i in range(column - 1, column + 2):
            for j in range(row - 1, row + 2):
                data = squares.all_of((i, j))
                xyz = np.column_stack([data[axis] for axis in "xyz"])
                around.append(xyz[((xyz[:, :2] >= low) & (xyz[:, :2] <= high)).all(axis=1)])
        tree = KDTree(np.concatenate(around))
        here = squares.all_of(square)
        spacing = np.empty(len(here), np.float32)
        for rows in row_blocks(len(here), _BLOCK):
            xyz = np.column_stack([here[axis][rows] for axis in "xyz"])
            away, _ = tree.query(xyz, k=self._neighbours + 1, distance_upper_bound=_FARTHEST)
            # The nearest is the point itself; of those that are too few the distance is infinite.
            spacing[rows] = np.minimum(away[:, 1:], _FARTHEST).mean(axis=1)
        return spacing


def _spacing_file(squares: Squares, square: Square) -> Path:
    path = squares.path(square)
    return path.with_name(f"{path.name}.spacing")


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
    with temporary_folder(folder / INDEX, "squares") as beside:
        squares = Squares(beside, side, offset=(east, north, 0.0))

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
                for part in row_blocks(len(data), _WRITTEN):
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
