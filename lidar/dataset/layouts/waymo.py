"""A recorded drive as Parquet files of the Waymo Open Dataset 2 (Sun et al. 2020), a component each.

Frames are those of the first scanner; what other sensors recorded is the nearest in time. The world is true
metres from the scene's origin, x east, y north, z up; vehicles are x forward, y left, z up.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from geoscene.classes import Class
from geoscene.support.files import write_lines
from geoscene.support.progress import Progress
from geoscene.typing import Float, Ints
from lidar.dataset.ground_truth import COLUMNS, boxes_by_frame, read_boxes
from lidar.dataset.layout import Dataset, reading_file
from lidar.dataset.layouts.waymo_components import (
    DISTORTION,
    SHUTTER,
    Component,
    RangeImageGrid,
    Row,
    grid_of,
    laser_calibration,
    pixels,
    range_images,
)
from lidar.dataset.recorded import (
    Stream,
    all_images,
    cloud_points,
    labelled_clouds,
    labelled_formats,
    nearest,
)
from lidar.errors import DatasetError
from lidar.geometry.attitude import OPTICAL, body_rates
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.devices import scanners

log = logging.getLogger(__name__)

LASERS = ("TOP", "FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR")
"""Names of scanners; their numbers count from 1."""

CAMERAS = {"FRONT": 0.0, "FRONT_LEFT": 45.0, "FRONT_RIGHT": -45.0, "SIDE_LEFT": 90.0, "SIDE_RIGHT": -90.0}
"""Names of cameras, which count from 1, and the directions in degrees from ahead that Waymo's have."""

SEGMENTS = "segments.txt"
"""File with the name of the segment."""

_TYPES = {
    **dict.fromkeys((Class.CAR, Class.VAN, Class.TRUCK, Class.BUS), 1),
    **dict.fromkeys((Class.MOTORCYCLE, Class.MOTORCYCLIST), 1),
    Class.PEDESTRIAN: 2,
    Class.CYCLIST: 4,
}
"""Types of boxes: vehicle, pedestrian and cyclist; others, which are bicycles, are unknown (0)."""

_LOST = 0.02
"""Greatest share of points without a pixel of their own; of more, a scanner has no rows of one elevation."""
_EDGE = 0.5
"""Pixels from the coordinates of a dataset, whose first pixel has its centre at 0, to edges at 0."""
_TOP_TO_BOTTOM, _GLOBALSHUTTER = 1, 5


def export(dataset: Dataset, folder: Path, *, progress: Progress) -> dict[str, int]:
    """Write the components of a drive; return the numbers of frames, clouds, images, boxes and lost points.

    Raises DatasetError for a drive without labelled clouds in the sensor frame.
    """
    lasers = _lasers(dataset)
    drive = _Drive(dataset, lasers, _cameras(dataset), *_boxes(dataset, lasers[0].stream))
    write_lines(folder / SEGMENTS, [drive.context])
    counts = dict.fromkeys(("frames", "clouds", "images", "3D boxes", "2D boxes", "points without pixel"), 0)
    with ExitStack() as opened:
        files = {tag: Component(tag, folder, context=drive.context) for tag in _written(drive)}
        out = {tag: opened.enter_context(file) for tag, file in files.items()}
        out["lidar_calibration"].write([laser_calibration(grid) for grid in drive.lasers])
        if drive.cameras:
            out["camera_calibration"].write(
                [_camera_calibration(number, camera) for number, camera in drive.cameras.items()]
            )
        for row in range(len(drive)):
            rows, lost = _frame_rows(drive, row)
            for tag, of_tag in rows.items():
                out[tag].write(of_tag)
            found = zip(list(counts)[1:5], ("lidar", "camera_image", "lidar_box", "camera_box"), strict=True)
            counts |= {name: counts[name] + len(rows.get(tag, ())) for name, tag in found}
            counts["frames"] += 1
            counts["points without pixel"] += lost
            progress("Waymo", row + 1, total=len(drive))
    return counts


@dataclass(frozen=True)
class _Drive:
    """A drive as Waymo's components hold it.

    lasers  : of scanners, the first of which gives the frames
    cameras : by number
    boxes   : 3D boxes of the first scanner by frame
    hits    : returns of all scanners by frame and road user
    """

    dataset: Dataset
    lasers: tuple[RangeImageGrid, ...]
    cameras: dict[int, Stream]
    boxes: Mapping[int, list[Row]]
    hits: Mapping[tuple[int, int], int]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.lasers[0].stream.files)

    @property
    def context(self) -> str:
        """Name of the segment."""
        return self.dataset.path.resolve().name

    @cached_property
    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return self.dataset.trajectory()

    @cached_property
    def near(self) -> dict[str, Ints]:
        """Row (n,) of each frame in the stream of a sensor, by its name."""
        streams = (*(grid.stream for grid in self.lasers), *self.cameras.values())
        return {stream.name: nearest(stream.time_ns, self.lasers[0].stream.time_ns) for stream in streams}

    @cached_property
    def flat(self) -> dict[str, dict[int, list[Row]]]:
        """2D boxes with visible pixels by camera's name and frame."""
        found: dict[str, dict[int, list[Row]]] = {}
        for camera in self.cameras.values():
            path = self.dataset.paths.sensor_boxes(camera.name)
            boxes = boxes_by_frame(path, ("frame", "id", "class", "pixels"))
            seen = {frame: [box for box in of.values() if box["pixels"]] for frame, of in boxes.items()}
            found[camera.name] = {frame: of for frame, of in seen.items() if of}
        return found

    def seconds(self, time_ns: int) -> float:
        """Seconds since 1970."""
        return self.dataset.start.timestamp() + time_ns * 1e-9

    def matrix(self, time_ns: int) -> Float:
        """The pose (4, 4) of the vehicle at a time, world from vehicle."""
        matrix: Float = self.trajectory.at([time_ns]).matrices()[0]
        return matrix


def _written(drive: _Drive) -> list[str]:
    """Folders of the components that a drive has."""
    tags = ["vehicle_pose", "lidar", "lidar_pose", "lidar_segmentation", "lidar_calibration"]
    tags += ["lidar_box"] if drive.boxes else []
    tags += ["camera_image", "camera_calibration"] if drive.cameras else []
    return tags + (["camera_box", "camera_to_lidar_box_association"] if any(drive.flat.values()) else [])


def _lasers(dataset: Dataset) -> tuple[RangeImageGrid, ...]:
    """Grids of the scanners that have rows of one elevation, five at most."""
    devices = {device.name: device for device in scanners(dataset.rig())}
    found: list[RangeImageGrid] = []
    for name in dataset.sensors("lidar"):
        stream = labelled_clouds(dataset, name)
        if stream is None:
            continue
        if len(found) == len(LASERS):
            log.warning("%s: left out: Waymo has %d scanners", name, len(LASERS))
            continue
        with reading_file(dataset.paths.manifest):
            grid = grid_of(devices[name], stream, number=len(found) + 1)
        table = cloud_points(stream.files[0])
        kept = pixels(grid, table)[0]
        if len(kept) < (1 - _LOST) * len(table["x"]):
            log.warning("%s: left out: a range image holds %d of %d points", name, len(kept), len(table["x"]))
            continue
        found.append(grid)
    if not found:
        names = ", ".join(form.name for form in labelled_formats())
        raise DatasetError(
            f"{dataset.path}: holds no labelled clouds in the sensor frame whose rings have one elevation;"
            f" drive with a spinning scanner and `formats` {names}"
        )
    return tuple(found)


def _cameras(dataset: Dataset) -> dict[int, Stream]:
    """Pinhole cameras by the number of the name whose direction is nearest to theirs."""
    streams = []
    for stream in all_images(dataset):
        if stream.sensor["model"] == "pinhole":
            streams.append(stream)
        else:
            log.warning("%s: left out: Waymo has no fisheye cameras", stream.name)
    ahead = [np.arctan2(*(stream.mount.rotation @ OPTICAL.T)[1::-1, 0]) for stream in streams]
    away = np.subtract.outer(ahead, np.radians(list(CAMERAS.values())))
    rows, columns = linear_sum_assignment(np.abs(np.angle(np.exp(1j * away))))
    for k in sorted(set(range(len(streams))) - set(rows.tolist())):
        log.warning("%s: left out: Waymo has %d cameras", streams[k].name, len(CAMERAS))
    taken = dict(zip(columns.tolist(), rows.tolist(), strict=True))
    return {number + 1: streams[taken[number]] for number in sorted(taken)}


def _boxes(dataset: Dataset, top: Stream) -> tuple[dict[int, list[Row]], dict[tuple[int, int], int]]:
    """3D boxes that the first scanner can see, by frame, and the returns of all scanners on them."""
    path, whole = dataset.paths.sensor_boxes(top.name), dataset.paths.boxes
    found: dict[int, list[Row]] = defaultdict(list)
    hits: dict[tuple[int, int], int] = {}
    if not path.exists():
        return found, hits
    for box in read_boxes(path, (*COLUMNS, "points", "visibility")):
        if box["points"] or box["visibility"]:
            found[box["frame"]].append(box)
    if whole.exists():
        for box in read_boxes(whole, ("frame", "id")):
            counts = [value for name, value in box.items() if name.startswith("points_")]
            hits[box["frame"], box["id"]] = int(sum(counts))
    return found, hits


def _frame_rows(drive: _Drive, row: int) -> tuple[dict[str, list[Row]], int]:
    """The rows of a frame by component, and the number of points without a pixel."""
    top = drive.lasers[0].stream
    frame, time_ns = int(top.frames[row]), int(top.time_ns[row])
    rows: dict[str, list[Row]] = defaultdict(list)
    rows["vehicle_pose"] = [{"world_from_vehicle.transform": drive.matrix(time_ns).ravel()}]
    lost = 0
    for grid in drive.lasers:
        near = int(drive.near[grid.stream.name][row])
        users = drive.boxes.get(frame, ()) if grid is drive.lasers[0] else None
        images, left = range_images(grid, drive.trajectory, row=near, boxes=users)
        lost += left
        for tag, image in images.items():
            rows[tag].append({"laser_name": grid.number} | image)
    rows["lidar_box"] = [_laser_box(box, hits=drive.hits) for box in drive.boxes.get(frame, ())]
    known = {box["id"] for box in drive.boxes.get(frame, ())}
    for number, camera in drive.cameras.items():
        near = int(drive.near[camera.name][row])
        rows["camera_image"].append({"camera_name": number} | _camera_image(drive, camera, row=near))
        for box in drive.flat[camera.name].get(int(camera.frames[near]), ()):
            key = {"camera_name": number, "camera_object_id": str(box["id"])}
            rows["camera_box"].append(key | _camera_box(box))
            if box["id"] in known:
                rows["camera_to_lidar_box_association"].append(key | {"laser_object_id": str(box["id"])})
    stamp = {
        "segment_context_name": drive.context,
        "frame_timestamp_micros": drive.dataset.microseconds(time_ns),
    }
    return {tag: [stamp | one for one in of_tag] for tag, of_tag in rows.items() if of_tag}, lost


def _camera_calibration(number: int, camera: Stream) -> Row:
    """The calibration of a camera; its frame is that of the body: x forward, y left, z up."""
    sensor, K = camera.sensor, np.array(camera.sensor["K"], float)
    extrinsic = camera.mount.matrix.copy()
    extrinsic[:3, :3] = extrinsic[:3, :3] @ OPTICAL.T
    factors = [*sensor["distortion"], *[0.0] * len(DISTORTION)][: len(DISTORTION)]
    return {
        "camera_name": number,
        "intrinsic.f_u": K[0, 0],
        "intrinsic.f_v": K[1, 1],
        "intrinsic.c_u": K[0, 2] + _EDGE,
        "intrinsic.c_v": K[1, 2] + _EDGE,
        **{f"intrinsic.{name}": float(value) for name, value in zip(DISTORTION, factors, strict=True)},
        "extrinsic.transform": extrinsic.ravel(),
        "width": int(sensor["width"]),
        "height": int(sensor["height"]),
        "rolling_shutter_direction": _TOP_TO_BOTTOM if sensor["row_ns"] else _GLOBALSHUTTER,
    }


def _camera_image(drive: _Drive, camera: Stream, *, row: int) -> Row:
    """An image, and the vehicle's motion at its middle."""
    sensor, start_ns = camera.sensor, int(camera.time_ns[row])
    exposure_ns, rows_ns = int(sensor["exposure_ns"]), int(sensor["row_ns"]) * (int(sensor["height"]) - 1)
    middle_ns = start_ns + (exposure_ns + rows_ns) // 2
    velocity, rates = _motion(drive.trajectory, middle_ns)
    times = (exposure_ns * 1e-9, drive.seconds(start_ns), drive.seconds(start_ns + exposure_ns + rows_ns))
    return {
        "image": camera.files[row].read_bytes(),
        "pose.transform": drive.matrix(middle_ns).ravel(),
        **{f"velocity.linear_velocity.{axis}": v for axis, v in zip("xyz", velocity, strict=True)},
        **{f"velocity.angular_velocity.{axis}": v for axis, v in zip("xyz", rates, strict=True)},
        "pose_timestamp": drive.seconds(middle_ns),
        **{f"rolling_shutter_params.{name}": t for name, t in zip(SHUTTER, times, strict=True)},
    }


def _motion(trajectory: Trajectory, time_ns: int) -> tuple[list[float], list[float]]:
    """Velocity and angular rates (rad/s) of the vehicle at a time, along the world's axes."""
    row = int(np.searchsorted(trajectory.time_ns, time_ns))
    near = trajectory.take(slice(max(row - 2, 0), row + 2))
    knots = near.time_ns * 1e-9
    rates = body_rates(knots, near.quat_xyzw)
    at = time_ns * 1e-9
    velocity = [float(np.interp(at, knots, near.velocity[:, k])) for k in range(3)]
    body = np.array([np.interp(at, knots, rates[:, k]) for k in range(3)])
    turned: list[float] = (trajectory.at([time_ns]).rotation[0] @ body).tolist()
    return velocity, turned


def _laser_box(box: Row, *, hits: Mapping[tuple[int, int], int]) -> Row:
    """A 3D box in the vehicle's frame."""
    size = zip("xyz", ("length", "width", "height"), strict=True)
    return {
        "laser_object_id": str(box["id"]),
        **{f"box.center.{axis}": box[f"ego_{axis}"] for axis in "xyz"},
        **{f"box.size.{axis}": box[name] for axis, name in size},
        "box.heading": box["ego_yaw"],
        "type": _type(box),
        "num_lidar_points_in_box": max(hits.get((box["frame"], box["id"]), 0), box["points"]),
        "num_top_lidar_points_in_box": box["points"],
        **{f"speed.{axis}": box[f"ego_v{axis}"] for axis in "xyz"},
    }


def _camera_box(box: Row) -> Row:
    left, top, right, bottom = (box[f"seen_{side}"] + _EDGE for side in ("left", "top", "right", "bottom"))
    return {
        "box.center.x": (left + right) / 2,
        "box.center.y": (top + bottom) / 2,
        "box.size.x": right - left,
        "box.size.y": bottom - top,
        "type": _type(box),
    }


def _type(box: Row) -> int:
    return _TYPES.get(Class[box["class"].upper()], 0)
