"""Detections of the detectors of road users, in the layouts of KITTI's and nuScenes' benchmarks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.files import atomic_folder, write_atomically, write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from lidar.dataset.layout import Dataset, DatasetLike, open_dataset
from lidar.dataset.layouts.kitti import CORNERS, OBJECTS, outline
from lidar.dataset.layouts.kitti_drive import KittiDrive, read_drive
from lidar.dataset.layouts.nuscenes import streams_of, table_frame
from lidar.dataset.recorded import Stream, still_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.tools.detection import RULES
from lidar.tools.detection.detector import Detections, Detector
from lidar.tools.detection.learned import read_detector
from lidar.tools.evaluation.nuscenes_detection import samples_of

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
    """Write what a detector finds in the clouds of a dataset; return the numbers of frames and of boxes.

    detector : or its name, or a model's file, as for `read_detector`
    layout   : ``kitti``: ``NNNNNN.txt`` of each frame in the folder ``out``, of what is in the image of
             camera 2; ``nuscenes``: ``results.json`` of the key frames in it

    Clouds are without the vehicle's motion. Front and rear are not told apart, nor are velocities known.

    Raises InputError for a folder that exists, and DatasetError for a dataset without the data.
    """
    dataset, out = open_dataset(dataset), Path(out)
    detector = read_detector(detector) if isinstance(detector, str) else detector
    if out.exists() and not overwrite:
        raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    if layout == "kitti":
        drive = read_drive(dataset)
        if OBJECTS not in drive.cameras:
            raise DatasetError(f"{dataset.path}: no images of a third camera; KITTI labels them")
        boxes = frames = 0
        with atomic_folder(out, mark="000000.txt", names=r"\d{6}\.txt") as folder:
            for row, found in _detections(drive.clouds, drive.trajectory, detector=detector):
                lines = list(_kitti_lines(found, drive))
                write_atomically(folder / f"{row:06d}.txt", "".join(f"{s}\n" for s in lines).encode("ascii"))
                frames, boxes = frames + 1, boxes + len(lines)
                progress("detecting", frames, total=len(drive))
        return {"frames": frames, "boxes": boxes}
    results = _nuscenes_results(dataset, detector, progress=progress)
    meta = {f"use_{kind}": kind == "lidar" for kind in ("camera", "lidar", "radar", "map", "external")}
    with atomic_folder(out, mark=RESULTS, names=r"results\.json") as folder:
        write_json(folder / RESULTS, {"meta": meta, "results": results})
    return {"frames": len(results), "boxes": sum(map(len, results.values()))}


def _detections(
    clouds: Stream, trajectory: Trajectory, *, detector: Detector, rows: list[int] | None = None
) -> Iterator[tuple[int, Detections]]:
    """Row and detections of clouds, in the scanner's frame at their start."""
    for row in range(len(clouds.files)) if rows is None else rows:
        table = still_points(clouds, trajectory, row=row)
        xyz = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)
        yield row, detector.detect(_Cloud(xyz))


def _kitti_lines(found: Detections, drive: KittiDrive) -> Iterator[str]:
    """Lines of the detections whose boxes are in the image."""
    from_lidar, sensor = drive.camera_from_lidar, drive.cameras[OBJECTS].sensor
    sides = np.array([sensor["width"], sensor["height"]]) - 1
    for k in range(len(found)):
        c, s = np.cos(found.yaw[k]), np.sin(found.yaw[k])
        turn = from_lidar[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        size = found.size[k]
        middle = from_lidar[:3, :3] @ found.centre[k] + from_lidar[:3, 3]
        bottom = middle - turn[:, 2] * size[2] / 2
        ends = outline(bottom + (CORNERS * size) @ turn.T, drive.projections[OBJECTS])
        if ends is None:
            continue
        low, high = (np.clip(side, 0, sides) for side in ends)
        if (high - low < _SMALLEST).any():
            continue
        yaw = np.arctan2(-turn[2, 0], turn[0, 0])
        alpha = np.remainder(yaw - np.arctan2(bottom[0], bottom[2]) + np.pi, 2 * np.pi) - np.pi
        values = [alpha, *low, *high, *size[[2, 1, 0]], *bottom, yaw, found.score[k]]
        yield " ".join([_KITTI[str(found.kind[k])], "-1", "-1", *(f"{v:.4f}" for v in values)])


def _nuscenes_results(
    dataset: Dataset, detector: Detector, *, progress: Progress
) -> dict[str, list[dict[str, Any]]]:
    """Boxes of each key frame by its token, in the frame of nuScenes' tables."""
    samples, top = samples_of(dataset), streams_of(dataset)["LIDAR_TOP"]
    trajectory = dataset.trajectory()
    scale, zero = table_frame(trajectory)
    rows = np.searchsorted(top.frames, samples.frame).tolist()
    results: dict[str, list[dict[str, Any]]] = {}
    for done, (row, found) in enumerate(_detections(top, trajectory, detector=detector, rows=rows)):
        pose = trajectory.at([int(top.time_ns[row])]).mounted(top.mount.translation, top.mount.rotation)
        place = pose.place(found.centre) / scale - zero
        c, s, nothing = np.cos(found.yaw), np.sin(found.yaw), np.zeros(len(found))
        turn = np.stack([c, -s, nothing, s, c, nothing, nothing, nothing, nothing + 1], axis=1)
        quat = quat_from_matrix(pose.rotation[0] @ turn.reshape(-1, 3, 3)) if len(found) else np.empty((0, 4))
        token = samples.token[done]
        results[token] = [
            {
                "sample_token": token,
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
        progress("detecting", done + 1, total=len(rows))
    return results
