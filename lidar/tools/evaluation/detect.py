"""Detections of the detectors of road users, in the layouts of KITTI's and nuScenes' benchmarks."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from geoscene.support.files import atomic_folder, write_atomically, write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Float
from lidar.dataset.foreign import KITTI, NUSCENES, ForeignFolder, open_recorded
from lidar.dataset.formats import Format
from lidar.dataset.formats.table import Table
from lidar.dataset.kitti_folder import CameraView, camera_view
from lidar.dataset.layout import Dataset, DatasetLike
from lidar.dataset.layouts.kitti import CORNERS, OBJECTS, outline
from lidar.dataset.layouts.kitti_drive import looking_ahead, read_drive
from lidar.dataset.layouts.nuscenes import streams_of, table_frame
from lidar.dataset.nuscenes_folder import KeyCloud, key_clouds
from lidar.dataset.recorded import still_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import Mount, quat_from_matrix
from lidar.tools.detection import RULES
from lidar.tools.detection.detector import Detections, Detector
from lidar.tools.detection.learned import read_detector
from lidar.tools.evaluation.nuscenes_detection import samples_of

log = logging.getLogger(__name__)

T = TypeVar("T")

LAYOUTS = ("kitti", "nuscenes")
RESULTS = "results.json"

_KITTI = {"vehicle": "Car", "person": "Pedestrian", "cycle": "Cyclist"}
_NUSCENES = {
    "vehicle": ("car", "vehicle.parked"),
    "person": ("pedestrian", "pedestrian.moving"),
    "cycle": ("bicycle", "cycle.with_rider"),
}
"""Class and most frequent attribute."""

_SMALLEST = 1.0
"""Pixels of the sides of a box in an image, at least."""


@dataclass(frozen=True, slots=True)
class _Cloud:
    xyz: NDArray[np.floating[Any]]


@shows_progress
def detect(
    dataset: DatasetLike,
    out: str | Path,
    *,
    layout: str,
    detector: Detector | str = RULES,
    overwrite: bool = False,
    progress: Progress = displayed,
) -> dict[str, int]:
    """Write what a detector finds in recorded clouds; return the numbers of frames and of boxes.

    dataset  : or a folder with clouds of KITTI or nuScenes, for the layout of its own name
    detector : or its name, or a model's file, as for `read_detector`
    layout   : ``kitti``: ``NNNNNN.txt`` of each frame in the folder ``out``, of what is in the image of
               camera 2; ``nuscenes``: ``results.json`` of the key frames in it

    Clouds of datasets are without the vehicle's motion. Front and rear are not told apart, nor are velocities
    known. Of a folder of KITTI, files have the names of the clouds; without a calibration boxes are in the
    frame of a camera at the scanner that faces its x axis, and without an image or a calibration all boxes
    are written, their 2D boxes being -1. Of a folder of nuScenes without tables, the names of all clouds are
    tokens, and boxes are in the scanner's frame.

    Raises InputError for a folder that exists, and DatasetError or FormatError for data that lack something
    or are damaged.
    """
    out = Path(out)
    detector = read_detector(detector) if isinstance(detector, str) else detector
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    found = open_recorded(dataset)
    if layout == "kitti":
        images = _images_of_folder(found) if isinstance(found, ForeignFolder) else _images(found)
        return _write_kitti(images, out, detector=detector, progress=progress)
    samples = _samples_of_folder(found) if isinstance(found, ForeignFolder) else _samples(found)
    return _write_nuscenes(samples, out, detector=detector, progress=progress)


@dataclass(frozen=True, slots=True)
class _Image:
    """A cloud as KITTI labels it.

    xyz : (n, 3) metres, in the scanner's frame
    """

    name: str
    xyz: Float
    view: CameraView


@dataclass(frozen=True, slots=True)
class _Sample:
    """A cloud as nuScenes has it.

    place : from positions (n, 3) in the scanner's frame to those of the tables
    turn  : (3, 3) rotation to the axes of the tables
    """

    token: str
    xyz: Float
    place: Callable[[Float], Float]
    turn: Float


@dataclass(frozen=True, slots=True)
class _Clouds(Generic[T]):
    """Clouds that are read one at a time."""

    names: list[str]
    read: Callable[[int], T]

    def each(self, progress: Progress) -> Iterator[T]:
        for row in range(len(self.names)):
            yield self.read(row)
            progress("detecting", row + 1, total=len(self.names))


def _images(dataset: Dataset) -> _Clouds[_Image]:
    drive = read_drive(dataset)
    if OBJECTS not in drive.cameras:
        raise DatasetError(f"{dataset.path}: no images of a third camera; KITTI labels them")
    sensor = drive.cameras[OBJECTS].sensor
    size = np.array([sensor["width"], sensor["height"]], float)
    view = CameraView(drive.camera_from_lidar, drive.projections[OBJECTS], size)
    names = [f"{row:06d}" for row in range(len(drive))]

    def read(row: int) -> _Image:
        return _Image(names[row], _points_of(still_points(drive.clouds, drive.trajectory, row=row)), view)

    return _Clouds(names, read)


def _images_of_folder(found: ForeignFolder) -> _Clouds[_Image]:
    source, paths = found.path, _of_format(found, form=KITTI)
    if len(folders := list(dict.fromkeys(path.parent for path in paths))) > 1:
        names = ", ".join(str(folder.relative_to(source)) for folder in folders[:3])
        raise InputError(f"{source}: has clouds in {len(folders)} folders ({names}, ...); give one of them")
    views = [camera_view(path) for path in paths]
    if None in views:
        log.warning("%s: has no calibration; boxes are in the frame of a camera at the scanner", source)
    elif any(view is None or view.size is None for view in views):
        log.warning("%s: lacks images of camera 2; all detections are written, without 2D boxes", source)

    def read(row: int) -> _Image:
        return _Image(paths[row].stem, _points_of(KITTI.read(paths[row])), views[row] or _AHEAD)

    return _Clouds([path.stem for path in paths], read)


_AHEAD = CameraView(np.asarray(np.linalg.inv(looking_ahead(Mount()).matrix), float), np.eye(3, 4), None)
"""The camera of clouds without a calibration."""


def _of_format(found: ForeignFolder, *, form: Format) -> list[Path]:
    """Clouds of a folder in a format; raises InputError if all are in another."""
    paths = [path for path, own in found.clouds if own is form]
    if not paths:
        other = found.clouds[0][1].name
        raise InputError(f"`to` {form.name}: {found.path} holds clouds of {other}; give {other}")
    return paths


def _samples(dataset: Dataset) -> _Clouds[_Sample]:
    samples, top = samples_of(dataset), streams_of(dataset)["LIDAR_TOP"]
    trajectory = dataset.trajectory()
    scale, zero = table_frame(trajectory)
    rows = np.searchsorted(top.frames, samples.frame).tolist()

    def read(number: int) -> _Sample:
        row = rows[number]
        pose = trajectory.at([int(top.time_ns[row])]).mounted(top.mount.translation, top.mount.rotation)
        xyz = _points_of(still_points(top, trajectory, row=row))
        return _Sample(samples.token[number], xyz, lambda at: pose.place(at) / scale - zero, pose.rotation[0])

    return _Clouds(samples.token, read)


def _samples_of_folder(found: ForeignFolder) -> _Clouds[_Sample]:
    source, paths = found.path, _of_format(found, form=NUSCENES)
    clouds = key_clouds(source)
    if not clouds:
        log.warning("%s: has no tables; tokens are names of clouds, boxes in the scanner's frame", source)
        clouds = [KeyCloud(p.name.removesuffix(NUSCENES.suffix), p, np.eye(4)) for p in paths]

    def read(row: int) -> _Sample:
        cloud = clouds[row]
        turn, shift = cloud.global_from_lidar[:3, :3], cloud.global_from_lidar[:3, 3]
        xyz = _points_of(NUSCENES.read(cloud.path))
        return _Sample(cloud.token, xyz, lambda at: at @ turn.T + shift, turn)

    return _Clouds([cloud.token for cloud in clouds], read)


def _points_of(table: Table) -> Float:
    """Positions (n, 3) of a table's points."""
    return np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)


def _write_kitti(
    images: _Clouds[_Image], out: Path, *, detector: Detector, progress: Progress
) -> dict[str, int]:
    names, boxes = [re.escape(name) for name in images.names], 0
    with atomic_folder(
        out, mark=f"{images.names[0]}.txt", names=rf"(\d{{6}}|{'|'.join(names)})\.txt"
    ) as folder:
        for image in images.each(progress):
            lines = list(_kitti_lines(detector.detect(_Cloud(image.xyz)), image.view))
            write_atomically(folder / f"{image.name}.txt", "".join(f"{s}\n" for s in lines).encode("ascii"))
            boxes += len(lines)
    return {"frames": len(images.names), "boxes": boxes}


def _write_nuscenes(
    samples: _Clouds[_Sample], out: Path, *, detector: Detector, progress: Progress
) -> dict[str, int]:
    results = {
        sample.token: _nuscenes_boxes(detector.detect(_Cloud(sample.xyz)), sample)
        for sample in samples.each(progress)
    }
    meta = {f"use_{kind}": kind == "lidar" for kind in ("camera", "lidar", "radar", "map", "external")}
    with atomic_folder(out, mark=RESULTS, names=r"results\.json") as folder:
        write_json(folder / RESULTS, {"meta": meta, "results": results})
    return {"frames": len(results), "boxes": sum(map(len, results.values()))}


def _kitti_lines(found: Detections, view: CameraView) -> Iterator[str]:
    """Lines of the detections whose boxes are in the image; of all without one."""
    from_lidar = view.camera_from_lidar
    for k in range(len(found)):
        c, s = np.cos(found.yaw[k]), np.sin(found.yaw[k])
        turn = from_lidar[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        size = found.size[k]
        middle = from_lidar[:3, :3] @ found.centre[k] + from_lidar[:3, 3]
        bottom = middle - turn[:, 2] * size[2] / 2
        if (flat := _flat_box(bottom + (CORNERS * size) @ turn.T, view)) is None:
            continue
        yaw = np.arctan2(-turn[2, 0], turn[0, 0])
        alpha = np.remainder(yaw - np.arctan2(bottom[0], bottom[2]) + np.pi, 2 * np.pi) - np.pi
        values = [alpha, *flat, *size[[2, 1, 0]], *bottom, yaw, found.score[k]]
        yield " ".join([_KITTI[str(found.kind[k])], "-1", "-1", *(f"{v:.4f}" for v in values)])


def _flat_box(corners: Float, view: CameraView) -> Float | None:
    """2D box (4,) of a box's corners (8, 3): -1 without an image, None outside of it."""
    if view.size is None:
        return np.full(4, -1.0)
    ends = outline(corners, view.projection)
    if ends is None:
        return None
    low, high = (np.clip(side, 0, view.size - 1) for side in ends)
    return None if (high - low < _SMALLEST).any() else np.concatenate([low, high])


def _nuscenes_boxes(found: Detections, sample: _Sample) -> list[dict[str, Any]]:
    """Boxes of a sample in the frame of nuScenes' tables."""
    place = sample.place(found.centre)
    c, s, nothing = np.cos(found.yaw), np.sin(found.yaw), np.zeros(len(found))
    turn = np.stack([c, -s, nothing, s, c, nothing, nothing, nothing, nothing + 1], axis=1)
    quat = quat_from_matrix(sample.turn @ turn.reshape(-1, 3, 3))
    return [
        {
            "sample_token": sample.token,
            "translation": place[k].tolist(),
            "size": found.size[k, [1, 0, 2]].tolist(),
            "rotation": quat[k, [3, 0, 1, 2]].tolist(),
            "velocity": [0.0, 0.0],
            "detection_name": _NUSCENES[str(found.kind[k])][0],
            "detection_score": float(found.score[k]),
            "attribute_name": _NUSCENES[str(found.kind[k])][1],
        }
        for k in range(len(found))
    ]
