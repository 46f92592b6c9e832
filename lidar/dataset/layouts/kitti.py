"""A recorded drive in the layout of KITTI's odometry benchmark, with labels of SemanticKITTI and of objects.

Geiger et al. 2012, Behley et al. 2019. With ``calib/`` and ``label_2/``, ``sequences/00`` is also a
``training`` folder of the object benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geoscene.support.files import write_lines
from geoscene.support.progress import Progress
from lidar.dataset.kitti_sequence import numbers, write_calibration, write_poses, write_times
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.kitti_drive import KittiDrive, read_drive
from lidar.dataset.layouts.kitti_objects import object_lines

SEQUENCE = "00"
"""Name of the sequence."""

OBJECTS = 2
"""Camera in which KITTI labels objects."""


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write ``sequences/00`` and ``poses/00.txt``; return the numbers of clouds, images and object labels.

    Raises DatasetError for a drive without clouds in the sensor frame.
    """
    drive = read_drive(dataset)
    sequence = folder / "sequences" / SEQUENCE
    write_calibration(sequence / "calib.txt", drive.projections, camera_from_lidar=drive.camera_from_lidar)
    write_times(sequence / "times.txt", drive.clouds.time_ns)
    camera = drive.trajectory.at(drive.clouds.time_ns)
    camera = camera.mounted(drive.reference.translation, drive.reference.rotation)
    for path in (sequence / "poses.txt", folder / "poses" / f"{SEQUENCE}.txt"):
        write_poses(path, camera)
    for row in range(len(drive)):
        name = f"{row:06d}"
        labels = sequence / "labels" / f"{name}.label"
        drive.write_cloud(sequence / "velodyne" / f"{name}.bin", row=row, labels=labels)
        for number in drive.cameras:
            drive.write_image(sequence / f"image_{number}" / f"{name}.png", number=number, row=row)
        progress("KITTI", row + 1, total=len(drive))
    objects = _write_objects(drive, sequence) if OBJECTS in drive.cameras and drive.boxes else 0
    return {"clouds": len(drive), "images": len(drive) * len(drive.cameras), "objects": objects}


def _write_objects(drive: KittiDrive, sequence: Path) -> int:
    """Write the object labels and the calibration of each frame; return the number of objects."""
    boxes, stream = drive.image_boxes(OBJECTS), drive.cameras[OBJECTS]
    calibration = _object_calibration(drive)
    count = 0
    for row in range(len(drive)):
        frame = int(stream.frames[drive.images[OBJECTS][row]])
        lines = object_lines(drive, number=OBJECTS, row=row, image_boxes=boxes.get(frame, {})).values()
        write_lines(sequence / "label_2" / f"{row:06d}.txt", lines)
        write_lines(sequence / "calib" / f"{row:06d}.txt", calibration)
        count += len(lines)
    return count


def _object_calibration(drive: KittiDrive) -> list[str]:
    """Lines of a calibration file of the object benchmark; its inertial unit is the vehicle's."""
    named = {f"P{k}": matrix for k, matrix in enumerate(drive.projections)}
    named |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": drive.camera_from_lidar[:3]}
    named |= {"Tr_imu_to_velo": drive.lidar_from_imu[:3]}
    return [f"{name}: {numbers(matrix)}" for name, matrix in named.items()]
