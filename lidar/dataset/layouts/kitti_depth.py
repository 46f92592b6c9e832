"""Depth completion: sparse depth of a scanner in each image, and the dense true depth (Uhrig et al. 2017).

The layout is KITTI's: ``train/DRIVE/proj_depth/velodyne_raw`` and ``groundtruth``, 16-bit PNG of 256 counts
per metre, 0 without data, with the images and their intrinsics.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from geoscene.support.files import copy_file, write_json, write_lines
from geoscene.support.progress import Progress
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.kitti_drive import numbers
from lidar.dataset.png import DEPTH_SCALE, depth_to_counts, write_png
from lidar.dataset.recorded import cloud_points, scanner_clouds
from lidar.dataset.seen_points import ImageView, motions_of, returns_of, views_of
from lidar.errors import DatasetError
from lidar.sensors.rig.camera_model import intrinsic_matrix


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write the images with true depth of each camera; return the numbers of images and of depths.

    Of the first scanner with clouds, the returns of the frame nearest in time are moved to the time of the
    image, with the road users that they are on. Those that the camera does not see are left out.

    Raises DatasetError for a drive without clouds in the sensor frame, colour or depth images.
    """
    views = [view for view in views_of(dataset) if view.depth(0) is not None]
    if not views:
        raise DatasetError(f"{dataset.path}: no camera with colour and depth images; drive with a rig of one")
    clouds, trajectory = scanner_clouds(dataset), dataset.trajectory()
    motions = motions_of(dataset, clouds.name)
    name = f"{dataset.path.resolve().name}_sync"
    half = int(0.5e9 / float(clouds.sensor["rate_hz"]))
    total, done, depths = sum(len(view.images.files) for view in views), 0, 0
    for channel, view in zip(_channels(views), views, strict=True):
        write_lines(
            folder / "train" / name / "intrinsics" / f"{channel}.txt",
            [numbers(intrinsic_matrix(view.camera))],
        )
        for row, time_ns in enumerate(view.images.time_ns.tolist()):
            cloud = int(np.abs(clouds.time_ns + half - time_ns).argmin())
            table = cloud_points(dataset.frame_file(clouds.files[cloud]))
            own = motions.get(int(clouds.frames[cloud]), {})
            returns = returns_of(
                table,
                trajectory,
                start_ns=int(clouds.time_ns[cloud]),
                mount=clouds.mount.matrix,
                motions=own,
            )
            sight = view.sight(returns, row)
            sparse = np.full((view.camera.height, view.camera.width), np.inf)
            np.minimum.at(sparse, sight.cell, sight.depth[sight.seen])
            place = folder / "train" / name
            parts = place / "proj_depth" / "velodyne_raw", place / "proj_depth" / "groundtruth", place
            paths = [part / channel / f"{row:010d}.png" for part in parts[:2]]
            paths.append(place / channel / "data" / f"{row:010d}.png")
            write_png(paths[0], depth_to_counts(sparse))
            copy_file(_depth_file(dataset, view, row=row), paths[1])
            copy_file(dataset.frame_file(view.images.files[row]), paths[2])
            done, depths = done + 1, depths + int(np.isfinite(sparse).sum())
            progress("depth completion", done, total=total)
    cameras = [view.camera.name for view in views]
    write_json(folder / "depth.json", {"schema": 1, "counts_per_metre": DEPTH_SCALE, "cameras": cameras})
    return {"images": done, "depths": depths}


def _channels(views: Sequence[ImageView]) -> list[str]:
    """Names of cameras in this layout: ``image_02`` of image_2, and free numbers for other names."""
    own = [re.fullmatch(r"image_(\d)", view.camera.name) for view in views]
    free = iter(sorted(set(range(len(views) + 10)) - {int(found[1]) for found in own if found}))
    return [f"image_{int(found[1]) if found else next(free):02d}" for found in own]


def _depth_file(dataset: Dataset, view: ImageView, *, row: int) -> Path:
    return dataset.frame_file(
        dataset.paths.image(view.camera.name, int(view.images.frames[row]), kind="depth")
    )
