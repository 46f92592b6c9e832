"""Images from above of each sweep: GeoTIFFs of height, intensity and number of returns about the vehicle.

They turn with the vehicle: a row is a distance ahead, from the farthest, a column one to the right. The
transform of a GeoTIFF tells the place of its pixels in the export CRS.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.files import atomic_path, write_json
from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import all_clouds, still_points
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Poses, Trajectory

CELL, REACH = 0.1, 50.0
"""Metres of a pixel's side, and from the vehicle to the sides of the image."""

BANDS = ("height above the vehicle's ground, metres", "mean intensity, 0 to 255", "returns")


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write an image of each sweep of each scanner; return the numbers of images and of returns in them.

    Clouds are without the vehicle's motion, at the start of the frame. False returns are left out.

    Raises DatasetError for a drive without clouds in the sensor frame.
    """
    streams = all_clouds(dataset)
    trajectory, geo = dataset.trajectory(), Georeference(dataset.frame, dataset.crs)
    total, done, count = sum(len(s.files) for s in streams), 0, 0
    for stream in streams:
        mount = stream.mount.matrix
        for row, frame in enumerate(stream.frames.tolist()):
            table = still_points(stream, trajectory, row=row)
            true = table["label"] != Class.NOISE
            xyz = np.column_stack([table[axis] for axis in "xyz"])[true] @ mount[:3, :3].T + mount[:3, 3]
            image = channels(xyz, table["intensity"][true])
            path = folder / stream.name / f"{frame:06d}.tif"
            corners = _corners(trajectory, int(stream.time_ns[row]), geo=geo)
            _write(path, image, corners=corners, crs=dataset.crs.to_wkt())
            done, count = done + 1, count + int(image[2].sum())
            progress("images from above", done, total=total)
    write_json(
        folder / "bev.json",
        {
            "schema": 1,
            "cell_m": CELL,
            "reach_m": REACH,
            "bands": list(BANDS),
            "scanners": [s.name for s in streams],
        },
    )
    return {"images": done, "returns": count}


def channels(xyz: Float, intensity: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """The bands (3, h, w) of points (n, 3) in the vehicle's frame; NaN but for the number without any."""
    side = round(2 * REACH / CELL)
    row, column = (np.floor((REACH - xyz[:, k]) / CELL).astype(np.int64) for k in (0, 1))
    inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
    cell = row[inside] * side + column[inside]
    count = np.bincount(cell, minlength=side * side)
    top = np.full(side * side, -np.inf)
    np.maximum.at(top, cell, xyz[inside, 2])
    total = np.bincount(cell, intensity[inside], minlength=side * side)
    with np.errstate(invalid="ignore"):
        bands = np.stack([np.where(count, top, np.nan), total / count, count])
    return bands.reshape(3, side, side).astype(np.float32)


def _corners(trajectory: Trajectory, time_ns: int, *, geo: Georeference) -> Float:
    """The corners (3, 2) of an image in the export CRS: top left, top right and bottom left."""
    pose = trajectory.at([time_ns])
    ahead = np.arctan2(*pose.rotation[0, [1, 0], 0])
    c, s = np.cos(ahead), np.sin(ahead)
    level = Poses(pose.position, np.array([[[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]]), pose.scale)
    sides = np.array([[REACH, REACH, 0.0], [REACH, -REACH, 0.0], [-REACH, REACH, 0.0]])
    found: Float = geo.points(level.place(sides))[:, :2]
    return found


def _write(path: Path, image: NDArray[np.float32], *, corners: Float, crs: str) -> None:
    import rasterio  # noqa: PLC0415 - slow to import

    _, height, width = image.shape
    across, down = (corners[1] - corners[0]) / width, (corners[2] - corners[0]) / height
    transform = rasterio.Affine(across[0], down[0], corners[0, 0], across[1], down[1], corners[0, 1])
    options: dict[str, Any] = {"driver": "GTiff", "width": width, "height": height, "count": len(BANDS)}
    options |= {"dtype": "float32", "nodata": np.nan, "compress": "deflate", "predictor": 3}
    options |= {"transform": transform, "crs": rasterio.CRS.from_wkt(crs), "tiled": True}
    with (
        atomic_path(path, keep_suffix=True) as part,
        rasterio.open(part, "w", **options) as raster,
    ):
        raster.write(image)
        for number, meaning in enumerate(BANDS, 1):
            raster.set_band_description(number, meaning)
