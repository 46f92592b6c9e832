"""Cloud-optimised GeoTIFFs of a scene: surface model, terrain model, class map."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes
from geoscene.errors import InputError
from geoscene.export.kinds import Summary
from geoscene.export.objects import attribution, expand, parts
from geoscene.geometry.mesh import Mesh, concatenate
from geoscene.scene import Scene
from geoscene.support.compiled import njit
from geoscene.support.files import atomic_path, naming, not_written, temporary_folder
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float

Model = Literal["surface", "terrain", "classes"]

MOST_CELLS = 4_000_000_000
"""Maximum number of cells of a raster; larger ones are refused as mistakes in the resolution."""

_BLOCK = 512

_STRUCTURES = (Class.BUILDING, Class.BRIDGE, Class.TUNNEL, Class.WALL, Class.FENCE, Class.HEDGE)


@dataclass(frozen=True, slots=True)
class RasterGrid:
    """Cells of a raster: its north-west corner in projected coordinates, their side, their counts."""

    west: float
    north: float
    cell: float
    columns: int
    rows: int

    def cells(self, points: Float, origin: tuple[float, float]) -> Float:
        """Points (..., 3) in scene metres as column, row and height."""
        x = (points[..., 0] + (origin[0] - self.west)) / self.cell
        y = ((self.north - origin[1]) - points[..., 1]) / self.cell
        return np.stack([x, y, points[..., 2]], axis=-1)


def grid_of(scene: Scene, resolution: float) -> RasterGrid:
    """The scene's extent aligned to multiples of the resolution, so that rasters of one CRS match."""
    if not (np.isfinite(resolution) and resolution > 0):
        raise InputError(f"`resolution` {resolution}: must be positive metres")
    xmin, ymin, xmax, ymax = scene.bounds
    east, north = scene.frame.origin
    left, right = np.floor((xmin + east) / resolution), np.ceil((xmax + east) / resolution)
    low, high = np.floor((ymin + north) / resolution), np.ceil((ymax + north) / resolution)
    columns, rows = int(right - left), int(high - low)
    if columns * rows > MOST_CELLS:
        raise InputError(
            f"`resolution` {resolution}: {columns} x {rows} cells are too many; use a larger one"
        )
    return RasterGrid(float(left * resolution), float(high * resolution), resolution, columns, rows)


def write_geotiff(
    scene: Scene,
    path: Path,
    *,
    model: Model = "surface",
    resolution: float = 0.5,
    layers: Collection[str] | None = None,
    progress: Progress = silent,
) -> Summary:
    """Write a raster of a scene as a cloud-optimised GeoTIFF in the scene's CRS.

    A cell has the value of the highest face over its middle; without one it is NaN (heights) or 0 (classes).

    model      : ``surface`` (height of the highest face: roofs, crowns, ground), ``terrain`` (height of the
                 ground alone, under buildings and trees too) or ``classes`` (`Class` code of the highest)
    resolution : metres, side of a cell; the grid is aligned to multiples of it

    Raises InputError for an unknown model, an unusable resolution, and layers that the model does not show.
    """
    from rasterio.errors import RasterioError  # noqa: PLC0415

    if model not in ("surface", "terrain", "classes"):
        raise InputError(f"`model` {model}: surface, terrain or classes")
    grid = grid_of(scene, resolution)
    library = list(scene.shapes().values())
    faces = 0
    with temporary_folder(path, "cells") as folder:
        with naming(path):
            height = _cells_on_disk(folder / "height", grid, value=np.float32(np.nan))
            labels = _cells_on_disk(folder / "labels", grid, value=np.uint8(0))
        for part in parts(scene, layers, stage="GeoTIFF", progress=progress):
            mesh = part.mesh
            if model == "terrain":
                mesh = mesh.take(~mesh.closed & ~np.isin(mesh.klass, _STRUCTURES))
            elif len(part.instances):
                mesh = concatenate([mesh, expand(part.instances, library)])
            draw(mesh, part.origin, scene=scene, grid=grid, height=height, labels=labels)
            faces += len(mesh)
        if not faces:
            raise InputError(
                f"`layers` {', '.join(layers or ())}: no faces of the {model} model in this scene"
            )
        draft = folder / "draft.tif"
        try:
            _write_draft(draft, scene, grid=grid, cells=labels if model == "classes" else height, model=model)
            _write_cog(draft, path, model=model)
        except RasterioError as error:
            raise not_written(path, error) from error
    count = grid.columns * grid.rows
    return Summary.of(path, "geotiff", objects=count, faces=faces, crs=scene.frame.name)


def _cells_on_disk(path: Path, grid: RasterGrid, *, value: np.generic) -> NDArray[Any]:
    """Cells (rows, columns) of a value in a file, mapped to memory.

    They are written first: a disk that is full then ends in an OSError, not in a fault of the memory.
    """
    block = np.full((_BLOCK, grid.columns), value)
    with path.open("wb") as file:
        for top in range(0, grid.rows, _BLOCK):
            file.write(block[: grid.rows - top].data)
    return np.memmap(path, value.dtype, "r+", shape=(grid.rows, grid.columns))


def draw(
    mesh: Mesh,
    origin: Float,
    *,
    scene: Scene,
    grid: RasterGrid,
    height: NDArray[np.float32],
    labels: NDArray[np.uint8],
) -> None:
    """Rasterise a mesh at an origin (scene metres) into cells (rows, columns), in place."""
    if not len(mesh):
        return
    corners = grid.cells((mesh.vertices + origin)[mesh.faces], scene.frame.origin)
    low = np.floor(corners.min(axis=(0, 1))[:2]).astype(int).clip(0)
    high = np.ceil(corners.max(axis=(0, 1))[:2]).astype(int)
    window = (slice(low[1], max(high[1], 0)), slice(low[0], max(high[0], 0)))
    corners[..., :2] -= low
    draw_triangles(corners, mesh.klass, height[window], labels[window])


def _write_draft(path: Path, scene: Scene, *, grid: RasterGrid, cells: NDArray[Any], model: Model) -> None:
    import rasterio  # noqa: PLC0415  (0.4 s)
    from rasterio.windows import Window  # noqa: PLC0415

    profile = {
        "driver": "GTiff",
        "width": grid.columns,
        "height": grid.rows,
        "count": 1,
        "dtype": cells.dtype,
        "crs": rasterio.crs.CRS.from_wkt(scene.frame.wkt),
        "transform": rasterio.Affine(grid.cell, 0.0, grid.west, 0.0, -grid.cell, grid.north),
        "nodata": 0 if model == "classes" else np.nan,
        "tiled": True,
        "BIGTIFF": "IF_SAFER",
    }
    with rasterio.open(path, "w", **profile) as out:
        for top in range(0, grid.rows, _BLOCK):
            band = np.asarray(cells[top : top + _BLOCK])
            out.write(band, 1, window=Window(0, top, grid.columns, len(band)))
        out.set_band_description(1, model)
        out.update_tags(attribution=attribution(scene), AREA_OR_POINT="Area", vertical=scene.frame.vertical)
        if model == "classes":
            color = class_codes().color
            out.write_colormap(1, {int(c): (*map(int, color[c]), 255) for c in Class if c})
            out.update_tags(1, **{f"class_{int(c)}": c.name.lower() for c in Class})
        else:
            out.set_band_unit(1, "metre")


def _write_cog(draft: Path, path: Path, *, model: Model) -> None:
    import rasterio.shutil  # noqa: PLC0415

    with atomic_path(path, keep_suffix=True) as part:
        rasterio.shutil.copy(
            draft,
            part,
            driver="COG",
            COMPRESS="DEFLATE",
            PREDICTOR="YES",
            OVERVIEW_RESAMPLING="MODE" if model == "classes" else "AVERAGE",
            BIGTIFF="IF_SAFER",
            NUM_THREADS="1",
        )


@njit(cache=True, nogil=True)
def draw_triangles(
    corners: Float, label: NDArray[np.uint8], height: NDArray[np.float32], labels: NDArray[np.uint8]
) -> None:
    """Rasterise triangles into a grid, in place; the highest over the middle of each cell remains.

    corners : (m, 3, 3) float64; x and y in cells from the grid's corner (column and row), z in metres
    label   : (m,) of each triangle
    height  : (rows, columns) float32, NaN where nothing has been drawn yet
    labels  : (rows, columns) label of the highest triangle; of two as high, the one drawn first stays

    A middle on an edge counts as inside, so that triangles that share an edge leave no gap. Vertical faces
    cover no cell.
    """
    rows, columns = height.shape
    for k in range(len(corners)):
        ax, ay, az = corners[k, 0]
        bx, by, bz = corners[k, 1]
        cx, cy, cz = corners[k, 2]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if abs(area) < 1e-12:
            continue
        top = max(int(np.ceil(min(ay, by, cy) - 0.5)), 0)
        bottom = min(int(np.floor(max(ay, by, cy) - 0.5)), rows - 1)
        left = max(int(np.ceil(min(ax, bx, cx) - 0.5)), 0)
        right = min(int(np.floor(max(ax, bx, cx) - 0.5)), columns - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                w = 1.0 - u - v
                if u < -1e-9 or v < -1e-9 or w < -1e-9:
                    continue
                z = np.float32(u * az + v * bz + w * cz)
                if not height[row, column] >= z:
                    height[row, column] = z
                    labels[row, column] = label[k]
