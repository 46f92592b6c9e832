"""A recorded drive in the layouts of KITTI's odometry, object and tracking benchmarks.

Geiger et al. 2012; labels of points are those of SemanticKITTI (Behley et al. 2019). With ``calib/`` and
``label_2/``, ``sequences/00`` is also a ``training`` folder of the object benchmark.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.classes import Class
from geoscene.support.files import write_lines
from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.kitti_drive import (
    KittiDrive,
    numbers,
    read_drive,
    write_calibration,
    write_poses,
    write_times,
)
from lidar.errors import DatasetError
from lidar.geometry.attitude import matrix_from_quat

SEQUENCE, TRACKING = "00", "0000"
"""Names of the sequence in the odometry and in the tracking benchmark."""

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
    for path in (sequence / "poses.txt", folder / "poses" / f"{SEQUENCE}.txt"):
        write_poses(path, drive.reference_poses)
    for row in range(len(drive)):
        name = f"{row:06d}"
        labels = sequence / "labels" / f"{name}.label"
        drive.write_cloud(sequence / "velodyne" / f"{name}.bin", row=row, labels=labels)
        drive.write_images(sequence, f"image_{{0}}/{name}.png", row=row)
        progress("KITTI", row + 1, total=len(drive))
    objects = _write_objects(drive, sequence) if OBJECTS in drive.cameras and drive.boxes else 0
    return {"clouds": len(drive), "images": len(drive) * len(drive.cameras), "objects": objects}


def _write_objects(drive: KittiDrive, sequence: Path) -> int:
    """Write the object labels and the calibration of each frame; return the number of objects."""
    calibration = _calibration_lines(drive, ("R0_rect:", "Tr_velo_to_cam:", "Tr_imu_to_velo:"))
    count = 0
    for row, lines in enumerate(true_lines(drive)):
        write_lines(sequence / "label_2" / f"{row:06d}.txt", lines.values())
        write_lines(sequence / "calib" / f"{row:06d}.txt", calibration)
        count += len(lines)
    return count


def _calibration_lines(drive: KittiDrive, names: tuple[str, str, str]) -> list[str]:
    """Lines of a calibration file of the object or the tracking benchmark.

    names : of the rectification, and of the transformations from scanner to camera and from inertial unit to
            scanner
    """
    named = {f"P{k}:": matrix for k, matrix in enumerate(drive.projections)}
    others = np.eye(3), drive.camera_from_lidar[:3], drive.lidar_from_imu[:3]
    named |= zip(names, others, strict=True)
    return [f"{name} {numbers(matrix)}" for name, matrix in named.items()]


def export_tracking(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write a sequence of the tracking benchmark; return the numbers of clouds, images, tracks and boxes.

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
    lines: list[str] = []
    tracks: set[int] = set()
    for row, found in enumerate(true_lines(drive)):
        lines += [f"{row} {track} {line}" for track, line in found.items()]
        tracks |= found.keys()
        drive.write_cloud(training / "velodyne" / TRACKING / f"{row:06d}.bin", row=row)
        drive.write_images(training, f"image_{{0:02d}}/{TRACKING}/{row:06d}.png", row=row)
        progress("KITTI tracking", row + 1, total=len(drive))
    write_lines(training / "label_02" / f"{TRACKING}.txt", lines)
    calibration = _calibration_lines(drive, ("R_rect", "Tr_velo_cam", "Tr_imu_velo"))
    write_lines(training / "calib" / f"{TRACKING}.txt", calibration)
    images = len(drive) * len(drive.cameras)
    return {"clouds": len(drive), "images": images, "tracks": len(tracks), "boxes": len(lines)}


TYPES = {
    Class.CAR: "Car",
    Class.VAN: "Van",
    Class.TRUCK: "Truck",
    Class.CYCLIST: "Cyclist",
    Class.PEDESTRIAN: "Pedestrian",
}
"""KITTI's types; other road users are ``Misc``."""

_VISIBLE = (0.4, 0.8)
"""Shares of visible pixels below which an object is largely (2) and partly (1) occluded: assumed."""
_NEAR = 0.1
"""Metres before the camera at which boxes are cut off."""

CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
_EDGES = np.array([[a, b] for a in range(8) for b in (a ^ 1, a ^ 2, a ^ 4) if b > a])


def true_lines(drive: KittiDrive) -> Iterator[dict[int, str]]:
    """Lines of the road users with visible pixels in each frame's image of camera 2, by number, in order.

    A line is ``type truncated occluded alpha left top right bottom height width length x y z rotation_y``:
    the 2D box in pixels, the 3D box in true metres and the frame of the reference camera (x right, y down, z
    forward), its position being the middle of its lower face; angles in radians.
    """
    boxes, stream = drive.image_boxes(OBJECTS), drive.cameras[OBJECTS]
    for row in range(len(drive)):
        frame = int(stream.frames[drive.images[OBJECTS][row]])
        yield _object_lines(drive, row, image_boxes=boxes.get(frame, {}))


def _object_lines(
    drive: KittiDrive, row: int, *, image_boxes: Mapping[int, Mapping[str, Any]]
) -> dict[int, str]:
    boxes = drive.boxes.get(int(drive.clouds.frames[row]), {})
    seen = [key for key in sorted(boxes.keys() & image_boxes.keys()) if image_boxes[key]["pixels"]]
    sensor, camera = drive.cameras[OBJECTS].sensor, drive.reference_poses.take([row])
    lines = {}
    for key in seen:
        box, flat = boxes[key], image_boxes[key]
        turn = camera.rotation[0].T @ matrix_from_quat([box[k] for k in ("qx", "qy", "qz", "qw")])
        middle = (
            (np.array([box[k] for k in "xyz"]) - camera.position[0]) / camera.scale[0] @ camera.rotation[0]
        )
        size = np.array([box[k] for k in ("length", "width", "height")])
        bottom = middle - turn[:, 2] * size[2] / 2
        yaw = np.arctan2(-turn[2, 0], turn[0, 0])
        corners = bottom + (CORNERS * size) @ turn.T
        side = np.array([sensor["width"], sensor["height"]] * 2) - 1
        values = [
            truncation(corners, drive.projections[OBJECTS], sides=side[:2]),
            len(_VISIBLE) - int(np.searchsorted(_VISIBLE, flat["visibility"], side="right")),
            float(np.remainder(yaw - np.arctan2(bottom[0], bottom[2]) + np.pi, 2 * np.pi) - np.pi),
            *np.clip([flat[k] for k in ("left", "top", "right", "bottom")], 0, side),
            *size[[2, 1, 0]],
            *bottom,
            yaw,
        ]
        kind = TYPES.get(Class[box["class"].upper()], "Misc")
        lines[key] = " ".join([kind, *(str(v) if isinstance(v, int) else f"{v:.4f}" for v in values)])
    return lines


def truncation(corners: Float, projection: Float, *, sides: Float) -> float:
    """Share of the rectangle around a box's projection that is outside the image; 1 behind the camera.

    corners : (8, 3), the reference camera's frame; bits of their numbers tell the sides x, y and z
    sides   : (2,) greatest pixel coordinates of the image
    """
    if (found := outline(corners, projection)) is None:
        return 1.0
    low, high = found
    inside = np.clip(np.minimum(high, sides) - np.maximum(low, 0), 0, None)
    return float(1 - inside.prod() / (high - low).prod())


def outline(corners: Float, projection: Float) -> tuple[Float, Float] | None:
    """Least and greatest pixels (2,) of the projection of a box's corners (8, 3); None behind the camera."""
    points = np.column_stack([corners, np.ones(8)]) @ projection.T
    ends = points[_EDGES]
    depth = ends[..., 2]
    before = (depth > _NEAR).any(axis=1)
    if not before.any():
        return None
    ends, depth = ends[before], depth[before]
    across = np.clip((_NEAR - depth) / np.where(depth[:, ::-1] == depth, 1.0, depth[:, ::-1] - depth), 0, 1)
    ends = ends + (ends[:, ::-1] - ends) * across[..., None]
    pixels = (ends[..., :2] / ends[..., 2:]).reshape(-1, 2)
    return pixels.min(axis=0), pixels.max(axis=0)
