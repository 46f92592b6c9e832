"""Inputs that every frame is recorded from, and frames as they are measured, before any file."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.support.digests import file_sha256
from geoscene.typing import Float
from lidar.dataset.formats.las import LasInfo
from lidar.dataset.formats.table import MOMENTS, deskew
from lidar.dataset.layout import Paths
from lidar.errors import InputError
from lidar.geometry.attitude import Mount
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Poses, Trajectory
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.specs import CameraSpec
from lidar.settings import RecordingSettings
from lidar.signal.situation import Effects
from lidar.world.actors import Actors
from lidar.world.visibility import Visibility

if TYPE_CHECKING:
    from lidar.sensors.camera.render import CameraImage as Image
    from lidar.traffic.signal_heads import SignalStates


class Stopwatch:
    """Seconds by stage, summed over threads."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._lock = threading.Lock()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time until the block ends to a stage."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.add({name: time.perf_counter() - began})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add seconds by stage."""
        with self._lock:
            for name, spent in seconds.items():
                self.seconds[name] = self.seconds.get(name, 0.0) + spent


@dataclass(frozen=True)
class Recording:
    """Input of all frames of a drive, shared by its threads.

    out         : dataset directory
    frame       : scene frame
    trajectory  : of the ego vehicle
    start       : UTC time of the drive's start
    geo         : from the scene frame to the export CRS
    settings    : which files are written
    watch       : measures the time of each stage
    effects     : counts what stages do
    actors      : other road users; None without traffic, and then without boxes
    signals     : what signal heads show; None without any, or where it is not known
    max_range   : metres from the ego vehicle within which road users get 3D boxes
    scanning_ns : (k, 2) times from and until which scanners work; None for always
    """

    out: Path
    frame: Frame
    trajectory: Trajectory
    start: datetime
    geo: Georeference
    settings: RecordingSettings
    watch: Stopwatch = field(default_factory=Stopwatch)
    effects: Effects = field(default_factory=Effects)
    actors: Actors | None = None
    signals: SignalStates | None = None
    max_range: float = 0.0
    scanning_ns: NDArray[np.int64] | None = None

    @functools.cached_property
    def visibility(self) -> Visibility | None:
        """Visibility of each road user; None without traffic."""
        return None if self.actors is None else Visibility(self.actors)

    @functools.cached_property
    def las_info(self) -> LasInfo:
        """Header fields that all LAS and LAZ files of the dataset share."""
        return LasInfo(self.geo.crs, self.geo.offset, self.start)

    def paths(self, sensor: Scanner | Camera, frame: int) -> dict[str, Path]:
        """Files of one frame.

        By image, format, ``deskewed <format>``, ``labels <format>``, boxes, signals, truth.
        """
        name, paths = sensor.name, Paths(self.out)
        files = {} if self.actors is None else {"boxes": paths.frame_boxes(name, frame)}
        if self.has_stages(sensor):
            files["truth"] = paths.truth(name, frame)
        if isinstance(sensor, Camera):
            if self.signals is not None:
                files["signals"] = paths.frame_signals(name, frame)
            return files | {kind: paths.image(name, frame, kind=kind) for kind in sensor.spec.images}
        for form in self.settings.cloud_formats:
            files[form.name] = form.path(paths.sensor(name), frame)
            if self.settings.deskew and form.frame == "sensor":
                files[f"deskewed {form.name}"] = paths.deskewed(name, frame, suffix=form.suffix)
        for row in self.settings.label_formats:
            files[f"labels {row.name}"] = row.path(paths.sensor(name), frame)
        return files

    def digests(self, sensor: Scanner | Camera, frame: int) -> bytes:
        """SHA-256 of the files of a frame in the order of `paths`; empty if one is missing."""
        try:
            return b"".join(file_sha256(path) for path in self.paths(sensor, frame).values())
        except OSError:
            return b""

    def has_stages(self, sensor: Scanner | Camera) -> bool:
        """Whether stages act on a sensor's clouds or colour images."""
        if isinstance(sensor, Camera) and "rgb" not in sensor.spec.images:
            return False
        kind = "camera" if isinstance(sensor, Camera) else "lidar"
        return self.settings.stages.act_on(sensor.name, kind=kind)


Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class MeasuredFrame:
    """A frame of a sensor.

    sensor     : name on the rig
    frame      : number, from 0
    time_ns    : start, nanoseconds since the drive's start
    mount      : extrinsics of the sensor
    trajectory : of the ego vehicle
    boxes      : columns of the bounding boxes of road users: as in ``boxes.csv``, see
                 `lidar.dataset.ground_truth.box_rows`; empty without traffic
    truth      : what stages did, as in truth files; empty without stages
    """

    sensor: str
    frame: int
    time_ns: int
    mount: Mount
    trajectory: Trajectory
    boxes: Columns
    truth: Columns

    @property
    def pose(self) -> Poses:
        """The one pose of the sensor in the scene at the frame's start."""
        return self.trajectory.at([self.time_ns]).mounted(self.mount.translation, self.mount.rotation)

    @property
    def points(self) -> int:
        """Number of returns; 0 for images."""
        return 0


@dataclass(frozen=True)
class MeasuredCloud(MeasuredFrame):
    """A frame of a scanner.

    cloud     : its returns, in the sensor frame at each return's own time; a `TracedCloud` with stages
    period_ns : duration of a frame
    velocity  : (n,) radial velocities as a Doppler scanner measures them, m/s, positive away; else None
    """

    cloud: Cloud
    period_ns: int
    velocity: NDArray[np.float32] | None = None

    @property
    def points(self) -> int:
        """Number of returns."""
        return len(self.cloud)

    @functools.cached_property
    def placed(self) -> Float:
        """The returns (n, 3) in the scene, metres, each placed with the pose at its own time."""
        return placed_cloud(self.cloud, self.trajectory, mount=self.mount)

    def deskewed(self, moment: str = "start") -> NDArray[np.float32]:
        """The returns (n, 3) without the ego vehicle's motion, in the sensor's frame at one moment, metres.

        moment : of the frame: start, middle or end

        Raises InputError for another moment.
        """
        if moment not in MOMENTS:
            raise InputError(f"`moment` {moment}: one of {', '.join(MOMENTS)}")
        time_ns = self.time_ns + int(MOMENTS[moment] * self.period_ns)
        return deskew(self.placed, self.trajectory, mount=self.mount, time_ns=time_ns)


@dataclass(frozen=True)
class MeasuredImages(MeasuredFrame):
    """A frame of a camera.

    camera  : intrinsics and exposure
    image   : colour, depth, classes and instances
    signals : columns of the signal heads in it: as in ``signals.csv``, see
              `lidar.simulation.record_images.signal_columns`; empty where their states are not known
    flow    : (h, w, 2) optical flow to the next frame in pixels, NaN where unknown; None if not recorded
    """

    camera: CameraSpec
    image: Image
    signals: Columns
    flow: NDArray[np.float32] | None = None


def firing_times(cloud: Cloud) -> NDArray[np.int64]:
    """Times (n,) of a cloud's returns, nanoseconds since the drive's start."""
    return cloud.start_ns + cloud.time_ns.astype(np.int64)


def placed_cloud(cloud: Cloud, trajectory: Trajectory, *, mount: Mount) -> Float:
    """A cloud's returns (n, 3) in the scene, metres, each placed with the pose at its own time.

    mount : extrinsics of the scanner
    """
    return trajectory.place(
        cloud.xyz, firing_times(cloud), translation=mount.translation, rotation=mount.rotation
    )
