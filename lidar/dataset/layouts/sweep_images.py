"""Sweeps as images: from above, as GeoTIFFs of height, intensity and number of returns, and of their pulses.

Images from above turn with the vehicle: a row is a distance ahead, from the farthest, a column one to the
right. The transform of a GeoTIFF tells the place of its pixels in the export CRS.

Range images are images of pulses, from which the points come back. A row is a ring, the highest first; a
column is a firing block, in order of time. Rows whose lasers fire to the side of the lowest ring's are turned
by whole columns, so that a column is one direction. ``range/NNNNNN.npy`` holds (h, w, 5) float32: range in
metres, azimuth and elevation in radians in the sensor frame, intensity, seconds since the frame's start; NaN
without a return. A point is at range * (cos e cos a, cos e sin a, sin e).
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.files import atomic_path, write_atomically, write_json
from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import Table
from lidar.dataset.layout import Dataset
from lidar.dataset.png import write_png
from lidar.dataset.recorded import all_clouds, cloud_points, still_points
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.scanner import firings

CELL, REACH = 0.1, 50.0
"""Metres of a pixel's side, and from the vehicle to the sides of the image."""

BANDS = ("height above the vehicle's ground, metres", "mean intensity, 0 to 255", "returns")


def export_from_above(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
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
    with atomic_path(path, keep_suffix=True) as part, rasterio.open(part, "w", **options) as raster:
        raster.write(image)
        for number, meaning in enumerate(BANDS, 1):
            raster.set_band_description(number, meaning)


CHANNELS = ("range", "azimuth", "elevation", "intensity", "time")

_CONSTANT = 0.999
"""Mean of unit vectors of angles that are one angle."""
_TURN = 6.0
"""Radians of a full turn, at least."""

COUNTS = 128.0
"""Counts per metre of the ranges as PNG, which hold up to 511.99 m."""


def export_range_images(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write the range images of each scanner; return the numbers of images, returns and returns left out.

    Of several returns of a pulse, the nearest is kept.

    Raises DatasetError for a drive without clouds in the sensor frame.
    """
    streams = all_clouds(dataset)
    total = sum(len(s.files) for s in streams)
    done = kept = left = 0
    devices = {device.name: device for device in scanners(dataset.rig())}
    for stream in streams:
        tables = (cloud_points(dataset.frame_file(path)) for path in stream.files)
        shape = _shape([dataset.frame_file(path) for path in stream.files])
        shift = shifts(devices[stream.name], shape)
        place = folder / stream.name
        for frame, table in zip(stream.frames.tolist(), tables, strict=True):
            rows, cell = pixels(table, shape, shift=shift)
            image = np.full((shape[0] * shape[1], len(CHANNELS)), np.nan, np.float32)
            image[cell] = _values(table, rows)
            label, instance = np.zeros(len(image), np.uint8), np.full(len(image), -1, np.int32)
            label[cell], instance[cell] = table["label"][rows], table["instance"][rows]
            whole = image.reshape(*shape, -1)
            name = f"{frame:06d}"
            _write_npy(place / "range" / f"{name}.npy", whole)
            _write_npy(place / "instance" / f"{name}.npy", instance.reshape(shape))
            write_png(place / "label" / f"{name}.png", label.reshape(shape))
            counts = np.rint(np.nan_to_num(whole[..., 0]) * COUNTS)
            write_png(place / "png" / f"{name}.png", np.clip(counts, 0, 65535).astype(np.uint16))
            done, kept, left = done + 1, kept + len(rows), left + len(table["x"]) - len(rows)
            progress("range images", done, total=total)
        write_json(
            place / "geometry.json",
            {
                "schema": 1,
                "shape": list(shape),
                "channels": list(CHANNELS),
                "rows": "rings, the highest first",
                "columns": "firing blocks in order of time, plus column_shift, modulo their number",
                "column_shift": shift[::-1].tolist(),
                "point": "range * (cos(elevation) cos(azimuth), cos(elevation) sin(azimuth), sin(elevation))",
                "png_counts_per_metre": COUNTS,
                "vehicle_from_sensor": stream.mount.matrix.tolist(),
            },
        )
    write_json(folder / "range_images.json", {"schema": 1, "scanners": [s.name for s in streams]})
    return {"images": done, "returns": kept, "left out": left}


def _shape(files: list[Path]) -> tuple[int, int]:
    """Rings and firing blocks of all frames."""
    high = wide = 1
    for path in files:
        table = cloud_points(path)
        if len(table["x"]):
            high, wide = (
                max(n, int(table[name].max()) + 1) for n, name in ((high, "ring"), (wide, "column"))
            )
    return high, wide


def shifts(device: Scanner, shape: tuple[int, int]) -> Ints:
    """Columns (h,) by which each ring is turned, so that a column is one azimuth.

    They are 0 for scanners whose rings have no constant azimuth between each other.
    """
    sent = firings(device.sensor, 0)
    turn = np.full(shape, np.nan, complex)
    inside = (sent.ring < shape[0]) & (sent.column < shape[1])
    turn[sent.ring[inside], sent.column[inside]] = (sent.direction @ [1.0, 1.0j, 0.0])[inside]
    with np.errstate(invalid="ignore"):
        turn /= np.abs(turn)
    step = np.angle(np.nanmean(turn[0, 1:] * turn[0, :-1].conj())) if shape[1] > 1 else 0.0
    away = np.array([_mean(ring * turn[0].conj()) for ring in turn])
    if not (np.isfinite(away).all() and (np.abs(away) > _CONSTANT).all() and abs(step) * shape[1] > _TURN):
        return np.zeros(shape[0], np.int64)
    turned: Ints = np.rint(np.angle(away) / step).astype(np.int64)
    return turned


def _mean(values: NDArray[np.complexfloating[Any, Any]]) -> complex:
    known = values[np.isfinite(values)]
    return complex(known.mean()) if len(known) else complex(np.nan)


def pixels(table: Table, shape: tuple[int, int], *, shift: Ints) -> tuple[Ints, Ints]:
    """Rows (k,) of the returns that get a pixel, and the numbers (k,) of these: row by row."""
    ring = table["ring"].astype(np.int64)
    column = (table["column"].astype(np.int64) + shift[ring]) % shape[1]
    cell = (shape[0] - 1 - ring) * shape[1] + column
    order = np.lexsort((_spherical(table)[0], cell))
    found, first = np.unique(cell[order], return_index=True)
    return order[first], found


def points(image: NDArray[np.floating]) -> Float:
    """Points (n, 3) of a range image (h, w, 5), row by row, those without a return left out."""
    distance, azimuth, elevation = image[..., :3].reshape(-1, 3).astype(np.float64).T
    flat = np.cos(elevation)
    ray = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
    found: Float = (distance[:, None] * ray)[np.isfinite(distance)]
    return found


def _spherical(table: Table) -> tuple[Float, Float, Float]:
    x, y, z = (table[axis].astype(np.float64) for axis in "xyz")
    flat = np.hypot(x, y)
    return np.hypot(flat, z), np.arctan2(y, x), np.arctan2(z, flat)


def _values(table: Table, rows: Ints) -> NDArray[np.float32]:
    geometry = [values[rows] for values in _spherical(table)]
    columns = [*geometry, table["intensity"][rows], table["time_ns"][rows] * 1e-9]
    return np.column_stack(columns).astype(np.float32)


def _write_npy(path: Path, array: NDArray[np.generic]) -> None:
    file = io.BytesIO()
    np.save(file, array)
    write_atomically(path, file.getvalue())
