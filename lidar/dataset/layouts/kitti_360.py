"""A recorded drive in the layout of KITTI-360 (Liao et al. 2021), as kitti360scripts reads it.

A pose is that of the inertial unit (x forward, y right, z down) in the world (x east, y north, z up), true
metres from the scene's origin. Clouds are without the ego vehicle's motion, of the moment of their pose.
"""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.files import write_atomically, write_lines
from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.coco import label_images, missing_labels
from lidar.dataset.layouts.kitti_drive import KittiDrive, numbers, read_drive, write_stamps
from lidar.dataset.png import write_png
from lidar.geometry.attitude import matrix_from_quat

log = logging.getLogger(__name__)

SEQUENCE = "2013_05_28_drive_0000_sync"
"""Name of the sequence: kitti360scripts make it of this date and a number."""

_CAMERAS = (0, 1)
"""Numbers of perspective cameras; 2 and 3 are fisheye cameras of another model than those of drives."""

_DOWN = np.diag([1.0, -1.0, -1.0])
"""The axes forward, left, up from the unit's forward, right, down."""

_LABELS = {
    "unlabeled": (0, -1, (Class.UNLABELED, Class.NOISE)),
    "ground": (6, -1, (Class.WATER, Class.BUILDING_PAD, Class.PAVED)),
    "road": (7, 1, (Class.ROAD, Class.LANE_MARKING, Class.CROSSING)),
    "sidewalk": (8, 3, (Class.SIDEWALK, Class.KERB)),
    "parking": (9, 2, (Class.PARKING,)),
    "rail track": (10, 10, (Class.RAIL,)),
    "building": (11, 11, (Class.BUILDING,)),
    "wall": (12, 7, (Class.WALL,)),
    "fence": (13, 8, (Class.FENCE,)),
    "bridge": (15, 31, (Class.BRIDGE,)),
    "tunnel": (16, 32, (Class.TUNNEL,)),
    "pole": (17, 21, (Class.POLE,)),
    "traffic light": (19, 23, (Class.TRAFFIC_LIGHT,)),
    "traffic sign": (20, 24, (Class.TRAFFIC_SIGN,)),
    "vegetation": (21, 5, (Class.HEDGE, Class.TREE_CROWN, Class.TRUNK)),
    "terrain": (22, 4, (Class.TERRAIN, Class.GRASS, Class.FOREST_FLOOR, Class.SAND)),
    "sky": (23, 9, (Class.SKY,)),
    "person": (24, 19, (Class.PEDESTRIAN,)),
    "rider": (25, 20, (Class.CYCLIST, Class.MOTORCYCLIST)),
    "car": (26, 13, (Class.CAR, Class.VAN)),
    "truck": (27, 14, (Class.TRUCK,)),
    "bus": (28, 34, (Class.BUS,)),
    "motorcycle": (32, 17, (Class.MOTORCYCLE,)),
    "bicycle": (33, 18, (Class.BICYCLE,)),
    "smallpole": (37, 22, (Class.BOLLARD,)),
    "unknown construction": (42, 35, (Class.OTHER_STRUCTURE,)),
    "unknown object": (44, 37, (Class.BENCH, Class.WIRE)),
}
"""Labels by name: id, which images have, KITTI's id, which boxes have, and classes (``labels.py`` there)."""

_NAMES = {klass: name for name, (_, _, classes) in _LABELS.items() for klass in classes}

_INSTANCES = 1000
"""A pixel is its label's id times this and the number of its instance; 0 for none."""

_VERTICES = np.array(
    [[1, -1, 1], [1, 1, 1], [1, -1, -1], [1, 1, -1], [-1, 1, 1], [-1, -1, 1], [-1, 1, -1], [-1, -1, -1]]
) * 0.5  # fmt: skip
"""Corners of a box, in the order that kitti360scripts draws its edges in."""

_FACES = np.array(
    [
        [0, 2, 3], [0, 3, 1], [4, 6, 7], [4, 7, 5], [0, 1, 4], [0, 4, 5],
        [2, 7, 6], [2, 6, 3], [1, 3, 6], [1, 6, 4], [0, 5, 7], [0, 7, 2],
    ]
)  # fmt: skip
"""Triangles of a box, counter-clockwise from outside."""


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write a sequence; return the numbers of clouds, images and 3D boxes.

    Raises DatasetError for a drive without clouds in the sensor frame.
    """
    drive = read_drive(dataset, numbers=_CAMERAS)
    _write_calibration(drive, folder / "calibration")
    _write_poses(drive, folder / "data_poses" / SEQUENCE)
    images, scans = folder / "data_2d_raw" / SEQUENCE, folder / "data_3d_raw" / SEQUENCE / "velodyne_points"
    write_stamps(scans / "timestamps.txt", dataset, times=drive.clouds.time_ns)
    drive.write_times(images, "image_{0:02d}/timestamps.txt")
    instances = _instances(drive)
    labels = _Labels(drive, instances, out=folder / "data_2d_semantics" / "train" / SEQUENCE)
    for row in range(len(drive)):
        drive.write_cloud(scans / "data" / f"{row:010d}.bin", row=row)
        drive.write_images(images, f"image_{{0:02d}}/data_rect/{row:010d}.png", row=row)
        for number in labels.cameras:
            labels.write(number, row=row)
        progress("KITTI-360", row + 1, total=len(drive))
    labels.close()
    boxes = list(_boxes(drive, instances))
    if boxes:
        _write_boxes(boxes, folder / "data_3d_bboxes" / "train" / f"{SEQUENCE}.xml")
    return {"clouds": len(drive), "images": len(drive) * len(drive.cameras), "boxes": len(boxes)}


def _vehicle_from_unit(drive: KittiDrive) -> Float:
    """Transformation (4, 4) from the axes of KITTI-360's inertial unit to the vehicle's."""
    matrix = drive.inertial_unit.matrix.copy()
    matrix[:3, :3] = matrix[:3, :3] @ _DOWN
    return np.asarray(matrix, float)


def _write_calibration(drive: KittiDrive, folder: Path) -> None:
    """Write mounts and intrinsics; missing cameras are those of the first, as loaders need them all."""
    unit_from_vehicle = np.linalg.inv(_vehicle_from_unit(drive))
    mounts = [drive.cameras[k].mount if k in drive.cameras else drive.reference for k in range(4)]
    to_unit = (
        f"image_{number:02d}: {numbers((unit_from_vehicle @ mount.matrix)[:3])}"
        for number, mount in enumerate(mounts)
    )
    write_lines(folder / "calib_cam_to_pose.txt", to_unit)
    write_lines(folder / "calib_cam_to_velo.txt", [numbers(np.linalg.inv(drive.camera_from_lidar)[:3])])
    lines = []
    for number in _CAMERAS:
        values = drive.rectified(number)
        K = np.asarray(values["K"])
        values["P_rect"] = np.column_stack([K, K @ values["T"]])
        lines += [f"{name}_{number:02d}: {numbers(value)}" for name, value in values.items()]
    write_lines(folder / "perspective.txt", lines)


def _write_poses(drive: KittiDrive, folder: Path) -> None:
    """Write the poses of the inertial unit and of the first camera at each frame."""
    world_from_vehicle = drive.trajectory.at(drive.clouds.time_ns).matrices()
    unit = world_from_vehicle @ _vehicle_from_unit(drive)
    camera = world_from_vehicle @ drive.reference.matrix
    write_lines(folder / "poses.txt", [f"{row} {numbers(pose[:3])}" for row, pose in enumerate(unit)])
    write_lines(folder / "cam0_to_world.txt", [f"{row} {numbers(pose)}" for row, pose in enumerate(camera)])


def _instances(drive: KittiDrive) -> dict[int, tuple[str, int, int]]:
    """Label, number among those of the label from 1, and road user, by the number in points and pixels.

    The number is 0 beyond 999, for which a pixel has no place.
    """
    frames = [drive.boxes, *(drive.image_boxes(number) for number in drive.cameras)]
    users = {
        box["id"]: (box["instance"], _NAMES[Class[box["class"].upper()]])
        for boxes in frames
        for of_frame in boxes.values()
        for box in of_frame.values()
    }
    count: dict[str, int] = defaultdict(int)
    found = {}
    for user, (instance, name) in sorted(users.items()):
        count[name] += 1
        found[instance] = (name, count[name] if count[name] < _INSTANCES else 0, user)
    for name, many in count.items():
        if many >= _INSTANCES:
            log.warning(
                "%d of %s have no number: KITTI-360 has %d", many - _INSTANCES + 1, name, _INSTANCES - 1
            )
    return found


class _Labels:
    """Labels of pixels of the cameras with semantic and instance images."""

    def __init__(self, drive: KittiDrive, instances: dict[int, tuple[str, int, int]], *, out: Path) -> None:
        self.drive, self.out = drive, out
        self.ids = np.zeros(256, np.uint8)
        for klass, name in _NAMES.items():
            self.ids[klass] = _LABELS[name][0]
        self.features = np.array(sorted(instances), np.int64)
        self.values = np.array(
            [_LABELS[instances[k][0]][0] * _INSTANCES + instances[k][1] for k in self.features.tolist()],
            np.uint16,
        )
        self.cameras = [
            number
            for number, stream in drive.cameras.items()
            if not missing_labels(drive.dataset, stream.name, frames=stream.frames[drive.images[number]])
        ]
        self.images: dict[int, list[str]] = defaultdict(list)

    def write(self, number: int, *, row: int) -> None:
        """Write the labels of the pixels of a frame, of one of ``cameras``."""
        stream = self.drive.cameras[number]
        frame = int(stream.frames[self.drive.images[number][row]])
        klass, feature = label_images(self.drive.dataset, stream.name, frame=frame)
        pixels = self.ids[klass].astype(np.uint16) * _INSTANCES
        if len(self.features):
            place = np.searchsorted(self.features, feature).clip(max=len(self.features) - 1)
            pixels = np.where(self.features[place] == feature, self.values[place], pixels)
        folder, name = self.out / f"image_{number:02d}", f"{row:010d}.png"
        for kind, image in (("semantic", (pixels // _INSTANCES).astype(np.uint8)), ("instance", pixels)):
            write_png(folder / kind / name, image)
        if number == self.cameras[0]:
            for value in np.unique(pixels).tolist():
                self.images[value].append(name)

    def close(self) -> None:
        """Write the images of the first camera that show each instance."""
        if self.cameras:
            document = json.dumps({str(value): names for value, names in sorted(self.images.items())})
            write_atomically(self.out / "instanceDict.json", document.encode("ascii"))


def _boxes(drive: KittiDrive, instances: dict[int, tuple[str, int, int]]) -> Iterator[dict[str, Any]]:
    """The 3D boxes: of a road user that never moves one without a time, of others one for each frame."""
    rows = {int(frame): row for row, frame in enumerate(drive.clouds.frames)}
    seen: dict[int, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    for frame, boxes in drive.boxes.items():
        for box in boxes.values():
            if frame in rows:
                seen[box["instance"]].append((rows[frame], box))
    scale = drive.trajectory.scale[0]
    for instance, found in sorted(seen.items()):
        name, number, _ = instances[instance]
        first, last = found[0][0], found[-1][0]
        for row, box in found if found[0][1]["moving"] else found[:1]:
            size = np.diag([box[k] for k in ("length", "width", "height")])
            transform = np.eye(4)
            transform[:3, :3] = matrix_from_quat([box[k] for k in ("qx", "qy", "qz", "qw")]) @ size
            transform[:3, 3] = np.array([box[k] for k in "xyz"]) / [scale, scale, 1.0]
            yield {
                "label": name,
                "semanticId_orig": _LABELS[name][0],
                "semanticId": _LABELS[name][1],
                "instanceId": number,
                "category": name,
                "timestamp": row if box["moving"] else -1,
                "dynamic": int(box["moving"]),
                "start_frame": first,
                "end_frame": last,
                "transform": transform,
            }


def _write_boxes(boxes: Iterable[dict[str, Any]], path: Path) -> None:
    """Write 3D boxes as OpenCV's XML."""
    root = ET.Element("opencv_storage")
    for index, box in enumerate(boxes):
        node = ET.SubElement(root, f"object{index + 1}")
        ET.SubElement(node, "index").text = str(index)
        for name, value in (box | {"vertices": _VERTICES, "faces": _FACES}).items():
            entry = ET.SubElement(node, name)
            if isinstance(value, np.ndarray):
                _add_matrix(entry, value)
            else:
                entry.text = str(value)
    ET.indent(root)
    text = ET.tostring(root, encoding="unicode")
    write_atomically(path, f'<?xml version="1.0"?>\n{text}\n'.encode("ascii"))


def _add_matrix(node: ET.Element, values: NDArray[Any]) -> None:
    """Add a matrix to a node as OpenCV writes it."""
    whole = values.dtype.kind == "i"
    node.set("type_id", "opencv-matrix")
    rows, columns = values.shape
    entries = {"rows": rows, "cols": columns, "dt": "i" if whole else "d"}
    for name, value in entries.items():
        ET.SubElement(node, name).text = str(value)
    ET.SubElement(node, "data").text = " ".join(map(str, values.ravel().tolist()))
