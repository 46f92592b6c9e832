"""Reads the frames of a dataset as defences see them: scanner data without labels and truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Ints
from lidar.dataset.formats import FORMATS
from lidar.dataset.layout import Dataset, opened_rows, reading_file
from lidar.dataset.recorded import Stream, cloud_points, clouds_in, color_images
from lidar.errors import DatasetError
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.devices import Scanner, cameras, scanners
from lidar.sensors.rig.scanner import Sensor
from lidar.sensors.rig.specs import CameraSpec, rig_of
from lidar.tools.defences.observation import NavigationMeasurements, Observation, Picture
from lidar.tools.detection import RULES, Detector

SEEN = ("x", "y", "z", "intensity", "time_ns", "ring", "column", "range", "echo", "echoes")
"""Columns of a recorded cloud that come from the scanner; the others are ground truth."""

_FIXES = ("lon", "lat", "h", "quality", "hdop")
_INERTIAL = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")


@dataclass(frozen=True)
class RecordedScans:
    """The frames of a scanner.

    pictures   : images of the cameras, by camera
    navigation : of the vehicle; None without a receiver or an inertial unit
    detector   : of road users
    """

    dataset: Dataset
    sensor: Sensor
    clouds: Stream
    trajectory: Trajectory
    pictures: tuple[tuple[CameraSpec, Stream], ...]
    navigation: NavigationMeasurements | None
    detector: Detector = RULES

    @property
    def frames(self) -> Ints:
        """Numbers of the frames."""
        return self.clouds.frames

    def __iter__(self) -> Iterator[Observation]:
        """The frames in order."""
        return map(self.frame, range(len(self.clouds.frames)))

    def frame(self, row: int) -> Observation:
        """A frame by its row of `frames`.

        Raises DatasetError for a damaged file.
        """
        start, number = int(self.clouds.time_ns[row]), int(self.clouds.frames[row])
        table = {name: c for name, c in cloud_points(self.clouds.files[row]).items() if name in SEEN}
        xyz = np.column_stack([table[axis] for axis in "xyz"]).astype(np.float64)
        whole = {
            name: table[name].astype(np.int64) for name in ("time_ns", "ring", "column", "echo", "echoes")
        }
        return Observation(
            number=number,
            start_ns=start,
            sensor=self.sensor,
            mount=self.clouds.mount,
            trajectory=self.trajectory,
            xyz=xyz,
            range=table["range"].astype(np.float64),
            intensity=table["intensity"].astype(np.float64),
            pictures=tuple(
                picture
                for camera, images in self.pictures
                for picture in _pictures_during(camera, images, window_ns=self.sensor.window_ns(number))
            ),
            navigation=self.navigation,
            detector=self.detector,
            **(whole | {"time_ns": start + whole["time_ns"]}),
        )


def read_scans(dataset: Dataset, *, detector: Detector = RULES) -> list[RecordedScans]:
    """The frames of each scanner of a dataset, with the boxes of a detector.

    Raises InputError if the rig's files have changed since the drive, and DatasetError if clouds are not in
    the sensor frame with ring, column and time.
    """
    with reading_file(dataset.paths.manifest):
        rig = rig_of(str(dataset.manifest["recipe"]["rig"]))
    trajectory = dataset.trajectory()
    pictures = _pictures(dataset, {camera.name: camera.spec for camera in cameras(rig)})
    navigation = _navigation(dataset)
    found = [
        RecordedScans(
            dataset,
            scanner.sensor,
            _clouds(dataset, scanner),
            trajectory=trajectory,
            pictures=pictures,
            navigation=navigation,
            detector=detector,
        )
        for scanner in scanners(rig)
    ]
    if not found:
        raise DatasetError(f"{dataset.path}: has no scanner")
    return found


def _clouds(dataset: Dataset, scanner: Scanner) -> Stream:
    for form in FORMATS.values():
        if form.frame != "sensor" or not set(SEEN) <= set(form.columns):
            continue
        if (stream := clouds_in(dataset, scanner.name, form=form)) is not None:
            return stream
    able = [f.name for f in FORMATS.values() if f.frame == "sensor" and set(SEEN) <= set(f.columns)]
    raise DatasetError(
        f"{dataset.path}: {scanner.name} has no clouds in the sensor frame with ring, column and time;"
        f" drive again with `formats` {' or '.join(able)}"
    )


def _pictures(dataset: Dataset, specs: dict[str, CameraSpec]) -> tuple[tuple[CameraSpec, Stream], ...]:
    streams = ((name, color_images(dataset, name)) for name in dataset.sensors("camera") if name in specs)
    return tuple((specs[name], stream) for name, stream in streams if stream is not None)


def _pictures_during(camera: CameraSpec, images: Stream, *, window_ns: tuple[int, int]) -> list[Picture]:
    """A camera's pictures from just before to just after a frame."""
    room = int(0.5e9 / camera.rate_hz)
    near = (images.time_ns >= window_ns[0] - room) & (images.time_ns <= window_ns[1] + room)
    return [Picture(camera, int(images.time_ns[k]), images.files[k]) for k in np.flatnonzero(near)]


def _navigation(dataset: Dataset) -> NavigationMeasurements | None:
    receivers, units = dataset.sensors("gnss"), dataset.sensors("imu")
    if not receivers or not units:
        return None
    receiver, unit = next(iter(receivers)), next(iter(units))
    gnss = _columns(dataset, receiver, names=_FIXES)
    imu = _columns(dataset, unit, names=_INERTIAL)
    x, y = dataset.frame.from_geographic(np.nan_to_num(gnss["lon"]), np.nan_to_num(gnss["lat"]))
    place = np.column_stack([x, y])
    place[~np.isfinite(gnss["lon"])] = np.nan
    mount = np.array(receivers[receiver]["vehicle_from_sensor"], float)
    return NavigationMeasurements(gnss, imu, mount[:3, 3], place)


def _columns(dataset: Dataset, name: str, *, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Columns of a device's measurements; none of its ground truth."""
    path = dataset.paths.measurements(name)
    with reading_file(path), opened_rows(path) as rows:
        table = [(int(row["time_ns"]), *(float(row[column]) for column in names)) for row in rows]
    values = np.array([row[1:] for row in table], float).reshape(-1, len(names))
    time_ns = np.array([row[0] for row in table], np.int64)
    return {"time_ns": time_ns, **dict(zip(names, values.T, strict=True))}
