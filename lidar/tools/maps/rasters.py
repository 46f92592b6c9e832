"""Rasters of maps as cloud-optimized GeoTIFF: surface, terrain, density and intensity."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from geoscene.classes import GROUND, Class
from geoscene.support.files import atomic_path
from lidar.dataset.formats.table import Table
from lidar.errors import InputError

_TERRAIN = tuple(int(k) for k in GROUND if k != Class.WATER)
"""Classes of which the terrain is made: all of the ground but water."""

_BLOCK = 256  # cells: side of the blocks that are in memory, those with points
_MOST = 2**31
"""Cells of a raster, at most."""


@dataclass
class _Block:
    """Sums of the points in the cells of a block (y, x), rows from the south."""

    points: NDArray[np.uint32]
    intensity: NDArray[np.float64]
    top: NDArray[np.float64]
    ground: NDArray[np.float64]
    ground_points: NDArray[np.uint32]


class Rasters:
    """Rasters that grow with the tables of a map; memory is that of the blocks with points.

    kinds      : of `lidar.options.maps.RASTERS`
    resolution : side of a cell in metres; borders of cells are multiples of it
    """

    def __init__(self, kinds: Sequence[str], resolution: float) -> None:
        self._kinds = kinds
        self._resolution = resolution
        self._blocks: dict[tuple[int, int], _Block] = {}
        self._low = np.full(2, np.iinfo(np.int64).max)
        self._high = np.full(2, np.iinfo(np.int64).min)

    def measured(self, tables: Iterator[Table]) -> Iterator[Table]:
        """The tables, whose points are added."""
        for table in tables:
            self._add(table)
            yield table

    def _add(self, table: Table) -> None:
        if not len(table["x"]):
            return
        cell = np.floor(np.column_stack([table["x"], table["y"]]) / self._resolution).astype(np.int64)
        self._low = np.minimum(self._low, cell.min(axis=0))
        self._high = np.maximum(self._high, cell.max(axis=0))
        place = cell // _BLOCK
        keys, which = np.unique(place, axis=0, return_inverse=True)
        ground = np.isin(table["label"], _TERRAIN)
        for k, key in enumerate(keys.tolist()):
            mine = np.flatnonzero(which.ravel() == k)
            block = self._blocks.setdefault((key[0], key[1]), _empty())
            x, y = (cell[mine] - keys[k] * _BLOCK).T
            z = table["z"][mine]
            np.add.at(block.points, (y, x), np.uint32(1))
            np.add.at(block.intensity, (y, x), table["intensity"][mine])
            np.maximum.at(block.top, (y, x), z)
            on = ground[mine]
            np.add.at(block.ground, (y[on], x[on]), z[on])
            np.add.at(block.ground_points, (y[on], x[on]), np.uint32(1))

    def write(self, out: Path, *, crs: CRS) -> list[Path]:
        """Write the rasters beside a map; return their paths, none for a map without points.

        Raises InputError for more cells than a raster can have.
        """
        if not self._blocks:
            return []
        width, height = (self._high - self._low + 1).tolist()
        if width * height > _MOST:
            raise InputError(
                f"`resolution` {self._resolution:g}: rasters of {width} by {height} cells are too large;"
                " give a coarser one"
            )
        return [self._written(out.with_suffix(f".{kind}.tif"), kind, crs=crs) for kind in self._kinds]

    def _written(self, path: Path, kind: str, *, crs: CRS) -> Path:
        import rasterio  # noqa: PLC0415 - slow to import
        import rasterio.shutil  # noqa: PLC0415
        from rasterio.windows import Window  # noqa: PLC0415

        side, (width, height) = self._resolution, (self._high - self._low + 1).tolist()
        west, north = float(self._low[0] * side), float((self._high[1] + 1) * side)
        options: dict[str, Any] = {"crs": rasterio.CRS.from_wkt(crs.to_wkt()), "dtype": "float32", "count": 1}
        options |= {"transform": rasterio.Affine(side, 0.0, west, 0.0, -side, north)}
        options |= {"width": width, "height": height, "nodata": 0.0 if kind == "density" else np.nan}
        options |= {"tiled": True, "blockxsize": _BLOCK, "blockysize": _BLOCK, "sparse_ok": True}
        with atomic_path(path, keep_suffix=True) as part:
            whole = part.with_suffix(".whole.tif")
            try:
                with rasterio.open(whole, "w", driver="GTiff", BIGTIFF="IF_SAFER", **options) as raster:
                    raster.set_band_description(1, _MEANINGS[kind])
                    for key, block in sorted(self._blocks.items()):
                        first = np.array(key) * _BLOCK
                        low, high = np.maximum(first, self._low), np.minimum(first + _BLOCK - 1, self._high)
                        rows, columns = (slice(low[k] - first[k], high[k] - first[k] + 1) for k in (1, 0))
                        window = Window(
                            int(low[0] - self._low[0]),
                            int(self._high[1] - high[1]),
                            int(high[0] - low[0] + 1),
                            int(high[1] - low[1] + 1),
                        )
                        raster.write(_values(block, kind, side=side)[rows, columns][::-1], 1, window=window)
                rasterio.shutil.copy(
                    whole,
                    part,
                    driver="COG",
                    compress="DEFLATE",
                    predictor="YES",
                    overview_resampling="AVERAGE",
                )
            finally:
                whole.unlink(missing_ok=True)
        return path


_MEANINGS = {
    "dsm": "height of the highest return, metres",
    "dtm": "mean height of the returns of the ground, metres",
    "density": "returns per square metre",
    "intensity": "mean intensity, 0 to 255",
}


def _empty() -> _Block:
    shape = (_BLOCK, _BLOCK)
    return _Block(
        np.zeros(shape, np.uint32),
        np.zeros(shape),
        np.full(shape, -np.inf),
        np.zeros(shape),
        np.zeros(shape, np.uint32),
    )


def _values(block: _Block, kind: str, *, side: float) -> NDArray[np.float32]:
    """The cells of a block, NaN without points."""
    with np.errstate(invalid="ignore", divide="ignore"):
        if kind == "dsm":
            found = np.where(block.points > 0, block.top, np.nan)
        elif kind == "dtm":
            found = block.ground / block.ground_points
        elif kind == "density":
            found = block.points / side**2
        else:
            found = block.intensity / block.points
    return found.astype(np.float32)
