"""Tracks of road users in the layout of KITTI's tracking benchmark (Geiger et al. 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.support.files import write_lines
from geoscene.support.progress import Progress
from lidar.dataset.kitti_sequence import numbers
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.kitti import OBJECTS
from lidar.dataset.layouts.kitti_drive import read_drive
from lidar.dataset.layouts.kitti_objects import object_lines
from lidar.errors import DatasetError

SEQUENCE = "0000"


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write one sequence; return the numbers of clouds, images, tracks and boxes.

    Boxes are of the road users with visible pixels in the image of camera 2; the number of a track is that of
    the road user, all over the drive.

    Raises DatasetError for a drive without clouds in the sensor frame, images or road users.
    """
    drive = read_drive(dataset)
    if OBJECTS not in drive.cameras or not drive.boxes:
        raise DatasetError(
            f"{dataset.path}: tracks need road users and images of a third camera; drive with `traffic` and"
            " the rig kitti"
        )
    training = folder / "training"
    boxes, stream = drive.image_boxes(OBJECTS), drive.cameras[OBJECTS]
    lines: list[str] = []
    tracks: set[int] = set()
    for row in range(len(drive)):
        frame = int(stream.frames[drive.images[OBJECTS][row]])
        found = object_lines(drive, number=OBJECTS, row=row, image_boxes=boxes.get(frame, {}))
        lines += [f"{row} {track} {line}" for track, line in found.items()]
        tracks |= found.keys()
        drive.write_cloud(training / "velodyne" / SEQUENCE / f"{row:06d}.bin", row=row)
        for number in drive.cameras:
            drive.write_image(
                training / f"image_{number:02d}" / SEQUENCE / f"{row:06d}.png", number=number, row=row
            )
        progress("KITTI tracking", row + 1, total=len(drive))
    write_lines(training / "label_02" / f"{SEQUENCE}.txt", lines)
    named = {f"P{k}": matrix for k, matrix in enumerate(drive.projections)}
    named |= {"R_rect": np.eye(3), "Tr_velo_cam": drive.camera_from_lidar[:3]}
    named |= {"Tr_imu_velo": drive.lidar_from_imu[:3]}
    write_lines(
        training / "calib" / f"{SEQUENCE}.txt",
        (f"{name}{':' if name.startswith('P') else ''} {numbers(matrix)}" for name, matrix in named.items()),
    )
    images = len(drive) * len(drive.cameras)
    return {"clouds": len(drive), "images": images, "tracks": len(tracks), "boxes": len(lines)}
