"""Topics of cameras: calibrations and images."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from geoscene.typing import Ints
from lidar.dataset.layout import Dataset, frame_numbers, reading_file
from lidar.dataset.layouts import ros_messages as ros
from lidar.dataset.layouts.ros_drive import Message, RosDrive, Topic
from lidar.dataset.png import counts_to_depth, read_png
from lidar.errors import DatasetError

log = logging.getLogger(__name__)

_ENCODINGS = {"rgb": "rgb8", "semantic": "mono8", "instance": "rgb8"}
"""Images that are copied as PNG files, with the encoding of their pixels."""

_IMAGES = {"rgb": "image_raw", "semantic": "semantic", "instance": "instance"}
"""Their topics below the camera's name; ``/compressed`` follows, by the convention of image_transport."""


def camera_topics(drive: RosDrive, name: str) -> list[Topic]:
    """Topics of a camera: its calibration with each image, and its images; none without images.

    Raises DatasetError for images without a time and a camera without intrinsics.
    """
    frames = {kind: _image_frames(drive.dataset, name, kind=kind) for kind in (*_ENCODINGS, "depth")}
    frames = {kind: numbers for kind, numbers in frames.items() if len(numbers)}
    if not frames:
        log.warning("%s: no images", name)
        return []
    base = f"/{drive.names[name]}"
    times = drive.dataset.sample_times(name)
    every = functools.reduce(np.union1d, frames.values())
    if every[-1] >= len(times):
        stamps = drive.dataset.paths.timestamps(name)
        raise DatasetError(f"{stamps}: has no time of frame {every[-1]}; drive again with `overwrite`")
    with reading_file(drive.dataset.paths.calibration):
        if not np.isfinite(np.array(drive.sensors[name]["K"], float).reshape(3, 3)).all():
            raise ValueError("intrinsics are not finite")
        _ = ros.camera_info(drive.sensors[name], 0, frame_id="")
    shots = functools.partial(_shots, drive, name, times=times)
    found = [
        Topic(
            f"{base}/camera_info",
            "sensor_msgs/msg/CameraInfo",
            shots(frames=every, make=functools.partial(_info, drive, name)),
            len(every),
        )
    ]
    for kind, numbers in frames.items():
        copied = kind in _ENCODINGS
        make = functools.partial(_png if copied else _depth, drive, name, kind=kind)
        found.append(
            Topic(
                f"{base}/{_IMAGES[kind]}/compressed" if copied else f"{base}/depth",
                "sensor_msgs/msg/CompressedImage" if copied else "sensor_msgs/msg/Image",
                shots(frames=numbers, make=make),
                len(numbers),
                counted="images",
            )
        )
    return found


def _image_frames(dataset: Dataset, name: str, *, kind: str) -> Ints:
    first = dataset.frame_file(dataset.paths.image(name, 0, kind=kind))
    return frame_numbers(first.parent, ".png")


def _shots(
    drive: RosDrive, name: str, *, times: Ints, frames: Ints, make: Callable[..., Any]
) -> Iterator[Message]:
    """Messages of a camera's frames, made of their number ``frame`` and their ``stamp_ns``.

    The stamp is that of boxes in images: the middle of the exposure, of a rolling shutter of the middle row.
    A message is complete when the exposure ends.
    """
    sensor = drive.sensors[name]
    exposure, row_ns, height = (int(sensor.get(k, 0)) for k in ("exposure_ns", "row_ns", "height"))
    for frame in frames.tolist():
        start_ns = int(times[frame])
        stamp = drive.stamp(start_ns + exposure // 2 + height // 2 * row_ns)
        yield start_ns + exposure + height * row_ns, functools.partial(make, frame=frame, stamp_ns=stamp)


def _optical(drive: RosDrive, name: str) -> str:
    return f"{drive.names[name]}_optical"


def _info(drive: RosDrive, name: str, *, frame: int, stamp_ns: int) -> Any:  # noqa: ARG001
    return ros.camera_info(drive.sensors[name], stamp_ns, frame_id=_optical(drive, name))


def _png(drive: RosDrive, name: str, *, kind: str, frame: int, stamp_ns: int) -> Any:
    path = drive.dataset.paths.image(name, frame, kind=kind)
    with reading_file(path):
        data = path.read_bytes()
    return ros.png_image(data, stamp_ns, frame_id=_optical(drive, name), encoding=_ENCODINGS[kind])


def _depth(drive: RosDrive, name: str, *, kind: str, frame: int, stamp_ns: int) -> Any:
    path = drive.dataset.paths.image(name, frame, kind=kind)
    with reading_file(path):
        counts = read_png(path)
        if counts.dtype != np.uint16:
            raise ValueError("is no image of 16 bits")
    return ros.depth_image(
        counts_to_depth(counts.astype(np.uint16)), stamp_ns, frame_id=_optical(drive, name)
    )
