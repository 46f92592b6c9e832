"""A sweep or a map in a window of Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import class_codes
from geoscene.errors import need
from geoscene.typing import Float
from lidar.dataset.formats import format_of, read_table
from lidar.dataset.layout import open_dataset, reading_file
from lidar.dataset.recorded import cloud_points, still_points
from lidar.options import PlaybackOptions
from lidar.tools.maps.colors import ramp
from lidar.tools.view.drive import Drive


def colored_points(path: str | Path, options: PlaybackOptions) -> tuple[Float, Float]:
    """Points (n, 3) in metres, and their colours (n, 3) from 0 to 1: of a file, or of a dataset's sweep.

    The sweep is the first of the frames, without the ego vehicle's motion, in the sensor's frame. A file's
    points are relative to their mean. Colours are those in the file, else those of the classes, else heights.

    Raises InputError or DatasetError for what is not readable.
    """
    path = Path(path)
    if path.is_file():
        with reading_file(path):
            table = read_table(path) if format_of(path).frame == "world" else cloud_points(path)
        points = np.column_stack([table[axis].astype(float) for axis in "xyz"])
        points -= points.mean(axis=0) if len(points) else 0.0
    else:
        drive = Drive(open_dataset(path), options)
        table = still_points(drive.clouds, drive.trajectory, row=int(drive.rows[0]))
        points = np.column_stack([table[axis].astype(float) for axis in "xyz"])
    return points, _colors(table, points[:, 2]).astype(float) / 255


def _colors(table: dict[str, NDArray[Any]], height: Float) -> NDArray[np.uint8]:
    if "red" in table:
        rgb = np.column_stack([table[name] for name in ("red", "green", "blue")])
        return (rgb >> 8 if rgb.dtype == np.uint16 else rgb).astype(np.uint8)  # LAS has 16 bits
    if "label" in table:
        colors: NDArray[np.uint8] = class_codes().color[table["label"]]
        return colors
    low, high = np.percentile(height, (1, 99)) if len(height) else (0.0, 1.0)
    return ramp(height, float(low), high=float(high))


def show_window(path: str | Path, *, options: PlaybackOptions = PlaybackOptions()) -> int:
    """Open a window with a sweep or a map, and return the number of points after it is closed.

    Raises MissingExtraError without Open3D, and as `colored_points`.
    """
    o3d = need("open3d", "open3d")
    points, colors = colored_points(path, options)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(colors)
    o3d.visualization.draw_geometries([cloud], window_name=str(path))
    return len(points)
