"""The ground in a point cloud: a raster of heights from its ground returns, or from those a filter finds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.clouds.read import GROUND, SurveyPoints
from geoscene.typing import Bools, Float

WINDOW = 18.0
"""Metres of the widest object that the filter takes off the ground, besides mapped buildings, which are
left out before: the default of Pingel et al. 2013."""

MARGIN = 24.0
"""Metres around a square that the filter needs."""

_SLOPE = 0.15
"""Rise over run that an opening may cut: the default of Pingel et al. 2013."""

_OFF = (0.25, 1.25)
"""Metres, and shares of the local gradient, within which a point belongs to the filtered ground."""

_BLOCK, _AROUND = 512, 128
"""Cells of a block whose gaps are bridged at once, and of the rim around it: wider gaps may have steps."""

_EMPTY = 0.6
"""Cells of area up to which a triangle over centres of cells has no further centre within it (Pick 1899)."""


class CloudGrid(NamedTuple):
    """A regular grid of cells.

    x, y    : scene metres of the lower left corner
    columns : cells along x
    rows    : cells along y
    cell    : metres of a cell's side
    """

    x: float
    y: float
    columns: int
    rows: int
    cell: float

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns); row 0 is the southernmost."""
        return self.rows, self.columns

    def cells(self, xy: Float) -> NDArray[np.int64]:
        """Flat index (n,) of the cell of each point (n, 2), which lies in the grid."""
        column = np.clip(((xy[:, 0] - self.x) / self.cell).astype(np.int64), 0, self.columns - 1)
        row = np.clip(((xy[:, 1] - self.y) / self.cell).astype(np.int64), 0, self.rows - 1)
        flat: NDArray[np.int64] = row * self.columns + column
        return flat

    def centres(self) -> tuple[Float, Float]:
        """Eastings and northings (rows, columns) of the cells' centres."""
        x = self.x + (np.arange(self.columns) + 0.5) * self.cell
        y = self.y + (np.arange(self.rows) + 0.5) * self.cell
        east, north = np.meshgrid(x, y)
        return east, north


def ground_heights(points: SurveyPoints, grid: CloudGrid, *, classified: bool, built: Bools) -> Float:
    """Heights (rows, columns) of the ground at the cells' centres, NaN where no ground return lies.

    A cell's height is the mean of its ground returns, moved along the local slope from their mean place to
    the centre.

    classified : ground returns are those of class ground, else those that `ground_returns` finds
    built      : (rows, columns) cells in mapped buildings, without ground
    """
    found = np.isin(points.klass, GROUND) if classified else ground_returns(points, grid, built=built)
    found &= ~built.ravel()[grid.cells(points.xyz[:, :2])]
    xyz = points.xyz[found]
    cell = grid.cells(xyz[:, :2])
    count = np.bincount(cell, minlength=grid.rows * grid.columns).reshape(grid.shape)
    with np.errstate(invalid="ignore"):
        x, y, z = (
            np.bincount(cell, xyz[:, k], minlength=grid.rows * grid.columns).reshape(grid.shape) / count
            for k in range(3)
        )
    east, north = grid.centres()
    if (count > 0).any():
        along_y, along_x = np.gradient(bridge(z), grid.cell)
        z -= np.clip(along_x, -1.0, 1.0) * (x - east) + np.clip(along_y, -1.0, 1.0) * (y - north)
    return np.asarray(z, float)


def ground_returns(points: SurveyPoints, grid: CloudGrid, *, built: Bools) -> Bools:
    """Mask (n,) of ground returns, by a progressive morphological filter (SMRF, Pingel et al. 2013).

    The lowest last returns of the cells are opened with windows of growing width. What an opening lowers by
    more than the slope allows is no ground; gaps are bridged, and points near the surface left are ground.

    built : (rows, columns) cells in mapped buildings, without ground
    """
    from scipy.ndimage import grey_opening  # noqa: PLC0415 - slow to import

    low = np.full(grid.rows * grid.columns, np.inf)
    last = points.xyz[points.last]
    np.minimum.at(low, grid.cells(last[:, :2]), last[:, 2])
    low = low.reshape(grid.shape)
    low[built | ~np.isfinite(low)] = np.nan
    if np.isnan(low).all():
        return np.zeros(len(points), np.bool_)
    objects = _low_outliers(low, grid.cell)
    surface = bridge(np.where(objects, np.nan, low))
    earlier = surface
    for radius in range(1, int(np.ceil(WINDOW / grid.cell)) + 1):
        opened = grey_opening(earlier, size=(2 * radius + 1, 2 * radius + 1), mode="nearest")
        objects |= earlier - opened > _SLOPE * radius * grid.cell
        earlier = opened
    ground = bridge(np.where(objects, np.nan, surface))
    steep = np.hypot(*np.gradient(ground, grid.cell))
    cell = grid.cells(points.xyz[:, :2])
    reach = _OFF[0] + _OFF[1] * np.minimum(steep, 2.0) * grid.cell / 2
    off = np.abs(points.xyz[:, 2] - ground.ravel()[cell])
    return np.asarray(off <= reach.ravel()[cell], np.bool_)


def bridged_by_blocks(heights: Float) -> Float:
    """Heights (rows, columns) with gaps between measured cells bridged, for rasters of any size."""
    out = heights.copy()
    for row in range(0, heights.shape[0], _BLOCK):
        for column in range(0, heights.shape[1], _BLOCK):
            low = np.maximum((row - _AROUND, column - _AROUND), 0)
            around = heights[low[0] : row + _BLOCK + _AROUND, low[1] : column + _BLOCK + _AROUND]
            block = out[row : row + _BLOCK, column : column + _BLOCK]
            if np.isnan(block).any():
                first = row - low[0], column - low[1]
                filled = bridge(around.astype(float), beyond=False)
                block[:] = filled[first[0] : first[0] + block.shape[0], first[1] : first[1] + block.shape[1]]
    return out


def bridge(heights: Float, *, beyond: bool = True) -> Float:
    """Heights with NaN cells by linear interpolation between the cells around.

    beyond : cells that are not between others take the nearest height, else they stay NaN
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt  # noqa: PLC0415 - slow to import

    gap = np.isnan(heights)
    if not gap.any() or gap.all():
        return heights
    filled = heights.copy()
    if beyond:
        row, column = distance_transform_edt(gap, return_distances=False, return_indices=True)
        filled = np.asarray(heights[row, column], float)
    rim = np.column_stack(np.nonzero(binary_dilation(gap, iterations=2) & ~gap))
    if len(rim) > 3 and np.ptp(rim, axis=0).all():
        linear = _interpolate(heights, rim)
        between = gap & np.isfinite(linear)
        filled[between] = linear[between]
    return filled


def _interpolate(heights: Float, places: NDArray[np.int64]) -> Float:
    """Heights (rows, columns) on the Delaunay triangles of cells (n, 2); NaN outside of them.

    The triangles are burnt into the raster: SciPy's interpolator solves equations for each of them in threads
    that wait for one another, which takes many times as long on a busy machine.
    """
    from rasterio import Affine  # noqa: PLC0415 - slow to import
    from rasterio.features import rasterize  # noqa: PLC0415

    out = np.full(heights.shape, np.nan)
    triangles = shapely.get_parts(
        shapely.delaunay_triangles(shapely.multipoints(places[:, ::-1].astype(float)))
    )
    triangles = triangles[shapely.area(triangles) > _EMPTY]
    if not len(triangles):
        return out
    centres = Affine(1.0, 0.0, -0.5, 0.0, 1.0, -0.5)
    numbered = zip(triangles.tolist(), range(1, len(triangles) + 1), strict=True)
    owner = rasterize(numbered, heights.shape, transform=centres, dtype="int32")
    row, column = np.nonzero(owner)
    corners = np.rint(shapely.get_coordinates(triangles)).astype(np.int64).reshape(-1, 4, 2)[:, :3]
    of = corners[owner[row, column] - 1]
    (ax, ay), (ux, uy), (vx, vy) = of[:, 0].T, (of[:, 1] - of[:, 0]).T, (of[:, 2] - of[:, 0]).T
    area = ux * vy - uy * vx
    s = ((column - ax) * vy - (row - ay) * vx) / area
    t = (ux * (row - ay) - uy * (column - ax)) / area
    z = heights[of[:, :, 1], of[:, :, 0]]
    out[row, column] = z[:, 0] + s * (z[:, 1] - z[:, 0]) + t * (z[:, 2] - z[:, 0])
    return out


def _low_outliers(low: Float, cell: float) -> Bools:
    """Cells whose lowest return is far below all around: echoes from below the ground."""
    from scipy.ndimage import grey_closing  # noqa: PLC0415 - slow to import

    surface = bridge(low)
    closed = grey_closing(surface, size=(3, 3), mode="nearest")
    return np.asarray(closed - surface > 5.0 * _SLOPE * cell + 0.5, np.bool_)
