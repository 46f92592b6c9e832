"""A recorded drive as KITTI's layouts hold it: a scanner, up to four cameras, and one index for all.

Frames are those of the scanner; a frame's images are the nearest in time. Clouds are without the ego
vehicle's motion, in the frame of the scanner at the frame's start.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.support.files import copy_file, write_lines
from geoscene.typing import Float, Ints
from lidar.dataset.formats import FORMATS, LABELS, kitti
from lidar.dataset.ground_truth import COLUMNS, boxes_by_frame
from lidar.dataset.layout import Dataset
from lidar.dataset.recorded import (
    Stream,
    all_images,
    clouds_in,
    labelled_clouds,
    labelled_formats,
    mount_of,
    nearest,
    no_clouds,
    recorded_labels,
    still_points,
)
from lidar.geometry.attitude import OPTICAL, Mount, quat_from_matrix
from lidar.geometry.poses import Poses, Trajectory
from lidar.geometry.time_scales import iso_times
from lidar.sensors.rig.camera_model import intrinsic_matrix
from lidar.sensors.rig.specs import Rig

log = logging.getLogger(__name__)

CAMERAS = 4
"""Cameras of KITTI."""

_NUMBERS = (2, 3, 0, 1)
"""Numbers of cameras not called image_<number>, in order: that of KITTI's left colour camera first."""

Boxes = dict[int, dict[int, dict[str, Any]]]
"""Rows of boxes by frame and road user."""


@dataclass(frozen=True)
class KittiDrive:
    """A dataset as KITTI's layouts read it: one scanner, numbered cameras, boxes.

    clouds  : of the scanner; in KITTI's format if they were not recorded with all their columns
    cameras : streams of the cameras by their numbers, 0 to 3
    """

    dataset: Dataset
    clouds: Stream
    cameras: dict[int, Stream]

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.clouds.files)

    @functools.cached_property
    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return self.dataset.trajectory()

    @functools.cached_property
    def reference(self) -> Mount:
        """Mount of the camera in whose frame poses are; without cameras, at the scanner and looking ahead."""
        return self.cameras[min(self.cameras)].mount if self.cameras else looking_ahead(self.clouds.mount)

    @functools.cached_property
    def reference_poses(self) -> Poses:
        """Poses (n,) of the reference camera at each frame."""
        poses = self.trajectory.at(self.clouds.time_ns)
        return poses.mounted(self.reference.translation, self.reference.rotation)

    @functools.cached_property
    def inertial_unit(self) -> Mount:
        """Mount of the first inertial unit, or else GNSS receiver, or else the vehicle's frame."""
        sensors = {**self.dataset.sensors("imu"), **self.dataset.sensors("gnss")}
        return mount_of(next(iter(sensors.values()))) if sensors else Mount()

    @property
    def camera_from_lidar(self) -> Float:
        """Transformation (4, 4) from the scanner's frame to the reference camera's."""
        return np.asarray(np.linalg.inv(self.reference.matrix) @ self.clouds.mount.matrix, float)

    @property
    def lidar_from_imu(self) -> Float:
        """Transformation (4, 4) from the inertial unit's frame to the scanner's."""
        return np.asarray(np.linalg.inv(self.clouds.mount.matrix) @ self.inertial_unit.matrix, float)

    @functools.cached_property
    def projections(self) -> list[Float]:
        """Projections (3, 4) of cameras 0 to 3 from the reference camera's frame; else those of the first."""
        own = {
            number: projection(np.array(stream.sensor["K"]), stream.mount, reference=self.reference)
            for number, stream in self.cameras.items()
        }
        some = own[min(own)] if own else np.eye(3, 4)
        return [own.get(number, some) for number in range(CAMERAS)]

    @functools.cached_property
    def images(self) -> dict[int, Ints]:
        """Row (n,) of the image of each frame in its camera's stream, by camera."""
        return {number: nearest(s.time_ns, self.clouds.time_ns) for number, s in self.cameras.items()}

    @functools.cached_property
    def boxes(self) -> Boxes:
        """3D boxes as seen from the scanner; none without traffic."""
        path = self.dataset.paths.sensor_boxes(self.clouds.name)
        return boxes_by_frame(path, (*COLUMNS, "points", "visibility"))

    def image_boxes(self, number: int) -> Boxes:
        """2D boxes in a camera's images; none without traffic."""
        path = self.dataset.paths.sensor_boxes(self.cameras[number].name)
        columns = ("frame", "id", "left", "top", "right", "bottom", "pixels", "visibility")
        return boxes_by_frame(path, columns)

    def write_cloud(self, path: Path, *, row: int, labels: Path | None = None) -> None:
        """Write a frame's cloud and, if wanted and recorded, SemanticKITTI's labels of its points.

        Points are in the order of `lidar.dataset.formats.kitti.laser_order`; those recorded in KITTI's
        format, which has no rings, keep theirs.
        """
        source = self.clouds.files[row]
        if source.name.endswith(FORMATS["kitti"].suffix):
            copy_file(source, path)
            folder, frame = self.dataset.paths.sensor(self.clouds.name), int(self.clouds.frames[row])
            recorded = LABELS["semantickitti"].path(folder, frame)
            if labels is not None and self.dataset.frame_file(recorded).exists():
                copy_file(recorded, labels)
            return
        points = still_points(self.clouds, self.trajectory, row=row)
        order = kitti.laser_order(points)
        table = {name: column[order] for name, column in points.items()}
        kitti.write(path, table)
        if labels is not None:
            found = recorded_labels(table, self.boxes.get(int(self.clouds.frames[row]), {}).values())
            kitti.write_labels(labels, found)

    def write_images(self, folder: Path, name: str, *, row: int) -> None:
        """Write the images of a frame.

        name : below the folder, in which ``{0}`` stands for the number of the camera
        """
        for number, stream in self.cameras.items():
            copy_file(stream.files[self.images[number][row]], folder / name.format(number))

    def write_times(self, folder: Path, name: str) -> None:
        """Write the time stamps of each camera's images; names as for `write_images`."""
        for number, stream in self.cameras.items():
            times = stream.time_ns[self.images[number]]
            write_stamps(folder / name.format(number), self.dataset, times=times)

    def rectified(self, number: int) -> dict[str, ArrayLike]:
        """Intrinsics and extrinsics of a camera as KITTI's calibrations name them, but for ``P_rect``.

        Those of a missing camera are the first's; R and T are from the reference camera's frame to its own.
        """
        stream = self.cameras.get(number, next(iter(self.cameras.values()), None))
        size, K, own = np.ones(2), np.eye(3), self.reference.matrix
        if stream is not None:
            size = np.array([stream.sensor["width"], stream.sensor["height"]])
            K, own = np.array(stream.sensor["K"], float), stream.mount.matrix
        moved = np.linalg.inv(own) @ self.reference.matrix
        turn = {"R": moved[:3, :3], "T": moved[:3, 3]}
        return {"S": size, "K": K, "D": np.zeros(5), **turn, "S_rect": size, "R_rect": np.eye(3)}


def write_stamps(path: Path, dataset: Dataset, *, times: Ints) -> None:
    """Write UTC time stamps with nanoseconds, a line each."""
    write_lines(path, (stamp[:-1].replace("T", " ") for stamp in iso_times(dataset.start, times)))


def read_drive(dataset: Dataset, *, numbers: Sequence[int] = _NUMBERS) -> KittiDrive:
    """The drive of a dataset, of its first scanner with clouds.

    numbers : of cameras; those not called ``image_<number>`` get the first free ones

    Raises DatasetError for a dataset without clouds in the sensor frame.
    """
    names = dataset.sensors("lidar")
    found = (
        labelled_clouds(dataset, name) or clouds_in(dataset, name, form=FORMATS["kitti"]) for name in names
    )
    clouds = next((stream for stream in found if stream is not None), None)
    if clouds is None:
        raise no_clouds(dataset, formats=[*labelled_formats(), FORMATS["kitti"]])
    cameras = [stream for stream in all_images(dataset) if _is_rectified(stream)]
    return KittiDrive(dataset, clouds, _assign_numbers(cameras, numbers))


def _is_rectified(camera: Stream) -> bool:
    """Whether a camera's images have no distortion, for which KITTI's projections have no place."""
    if camera.sensor["model"] == "pinhole" and not any(camera.sensor["distortion"]):
        return True
    log.warning("%s: left out: KITTI has no fisheye cameras of this model and no distortion", camera.name)
    return False


def _assign_numbers(cameras: Sequence[Stream], numbers: Sequence[int]) -> dict[int, Stream]:
    """Cameras by numbers: that of their name, or else free ones in order; those beyond are left out."""
    own = {int(s.name[-1]): s for s in cameras if s.name in {f"image_{k}" for k in numbers}}
    others = [s for s in cameras if s.name not in {camera.name for camera in own.values()}]
    free = [number for number in numbers if number not in own]
    for camera in others[len(free) :]:
        log.warning("%s: left out: there are %d cameras in this layout", camera.name, len(numbers))
    return dict(sorted({**own, **dict(zip(free, others, strict=False))}.items()))


def write_sequence(
    folder: Path, rig: Rig, *, mount: Mount, trajectory: Trajectory, time_ns: NDArray[np.int64]
) -> None:
    """Write calib.txt, times.txt and poses.txt of a scanner into its folder.

    mount   : of the scanner
    time_ns : (n,) starts of its frames

    The cameras are the rig's first four; without one, a camera at the scanner that faces its x axis.
    """
    cameras = [(intrinsic_matrix(camera), camera.mount) for camera in rig.cameras[:4]]
    first = cameras[0][1] if cameras else looking_ahead(mount)
    projections = [projection(K, own, reference=first) for K, own in cameras] or [np.eye(3, 4)]
    camera_from_lidar = np.linalg.inv(first.matrix) @ mount.matrix
    write_calibration(folder / "calib.txt", projections, camera_from_lidar=camera_from_lidar)
    if len(time_ns):
        write_times(folder / "times.txt", time_ns)
        write_poses(folder / "poses.txt", trajectory.at(time_ns).mounted(first.translation, first.rotation))


def looking_ahead(mount: Mount) -> Mount:
    """Extrinsics of a camera at a sensor's origin whose optical axis is the sensor's x axis."""
    return Mount(mount.translation, tuple(quat_from_matrix(mount.rotation @ OPTICAL).tolist()))


def projection(K: Float, mount: Mount, *, reference: Mount) -> Float:
    """Projection (3, 4) from the frame of a reference camera to the pixels of a camera with intrinsics K."""
    return np.asarray(K @ (np.linalg.inv(mount.matrix) @ reference.matrix)[:3], float)


def write_calibration(path: Path, projections: Sequence[ArrayLike], *, camera_from_lidar: Float) -> None:
    """Write ``calib.txt``: projections P0 to P3, and Tr, the transformation from scanner to first camera.

    projections : (3, 4) each, from the first camera's frame to the pixels of each camera. Loaders need four:
                  the first is repeated for missing ones, a fifth is left out
    """
    four = [*projections[:4], *[projections[0]] * (4 - len(projections))]
    named = [*((f"P{k}", projection) for k, projection in enumerate(four)), ("Tr", camera_from_lidar)]
    write_lines(path, (f"{name}: {numbers(np.asarray(matrix)[:3])}" for name, matrix in named))


def write_times(path: Path, time_ns: NDArray[np.integer]) -> None:
    """Write ``times.txt``: seconds since the first frame."""
    write_lines(path, (f"{(int(t) - int(time_ns[0])) * 1e-9:.9e}" for t in time_ns))


def write_poses(path: Path, camera: Poses) -> None:
    """Write ``poses.txt``: the poses of the first camera at each frame relative to the first frame."""
    world_from_camera = camera.matrices()
    poses = np.linalg.inv(world_from_camera[0]) @ world_from_camera
    write_lines(path, (numbers(pose[:3]) for pose in poses))


def numbers(values: ArrayLike) -> str:
    """Numbers of any shape as KITTI writes them, separated by spaces."""
    return " ".join(f"{value:.12e}" for value in np.asarray(values, float).ravel())
