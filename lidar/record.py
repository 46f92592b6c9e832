"""One frame of one sensor: from the world to files."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoscene.frames import Frame
from lidar.actors import Actors, box_rows, count_points
from lidar.camera.png import depth_to_counts, feature_to_image, flow_to_image, write_png
from lidar.camera.render import exposure_times, optical_flow, render
from lidar.camera.sun import sun_direction
from lidar.cloud import Cloud
from lidar.crowd import Worlds
from lidar.dataset import write_columns
from lidar.formats.las import LasInfo, gps_seconds, write_las
from lidar.formats.pcd import write_pcd
from lidar.formats.ply import write_ply
from lidar.formats.table import Table, cloud_table
from lidar.formats.text import write_csv
from lidar.georeference import Georeference
from lidar.physics.effects import Effects
from lidar.poses import Trajectory
from lidar.rig import CameraSpec, LidarSpec, Rig
from lidar.sensors.beams import frame_ns
from lidar.sensors.preset import Sensor, load_sensor
from lidar.sensors.scan import scan
from lidar.world import World

FORMATS = ("pcd", "ply", "csv", "laz", "las")
"""Formats of clouds."""


@dataclass(frozen=True, slots=True)
class Scanner:
    """A laser scanner of the rig, ready to fire."""

    spec: LidarSpec
    sensor: Sensor

    @property
    def name(self) -> str:
        """Name on the rig."""
        return self.spec.name

    @property
    def reach(self) -> float:
        """Metres beyond which nothing is seen."""
        return self.sensor.max_range

    @property
    def period_ns(self) -> int:
        """Nanoseconds a frame lasts, rounded down."""
        return int(frame_ns(self.sensor.rate_hz))

    def frame_start_ns(self, frame: int) -> int:
        """Time at which a frame starts, since the drive's start."""
        return self.sensor.frame_start_ns(frame)

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames that end within a drive of that length."""
        return self.sensor.frame_count(duration_ns)


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera of the rig."""

    spec: CameraSpec

    @property
    def name(self) -> str:
        """Name on the rig."""
        return self.spec.name

    @property
    def reach(self) -> float:
        """Metres beyond which nothing is seen."""
        return self.spec.far

    @property
    def period_ns(self) -> int:
        """Nanoseconds from frame to frame, rounded down."""
        return int(frame_ns(self.spec.rate_hz))

    def frame_start_ns(self, frame: int) -> int:
        """Time at which the shutter opens, since the drive's start."""
        return self.spec.time_offset_ns + int(frame * frame_ns(self.spec.rate_hz))

    def frame_count(self, duration_ns: int) -> int:
        """Number of frames whose period ends within a drive of that length, as for scanners."""
        return max(0, int((duration_ns - self.spec.time_offset_ns) // frame_ns(self.spec.rate_hz)))


def scanners(rig: Rig) -> list[Scanner]:
    """The rig's laser scanners with their presets.

    Raises RigError for a preset that is unknown or bad.
    """
    return [
        Scanner(
            s,
            load_sensor(
                s.preset,
                name=s.name,
                rate_hz=s.rate_hz,
                return_mode=s.return_mode,
                start_ns=s.time_offset_ns,
            ),
        )
        for s in rig.lidars
    ]


def cameras(rig: Rig) -> list[Camera]:
    """The rig's cameras."""
    return [Camera(s) for s in rig.cameras]


class _Watch(Protocol):
    def stage(self, name: str) -> AbstractContextManager[None]: ...


class Recorder:
    """Writes frames of sensors into a dataset directory; may be used by several threads at once."""

    def __init__(
        self,
        out: Path,
        frame: Frame,
        trajectory: Trajectory,
        start: datetime,
        geo: Georeference,
        formats: Sequence[str],
        seed: int,
        effects: Effects,
        watch: _Watch,
        *,
        actors: Actors | None = None,
        reach: float = 0.0,
    ) -> None:
        self.out = out
        self.frame = frame
        self.trajectory = trajectory
        self.start = start
        self.geo = geo
        self.formats = tuple(formats)
        self.seed = seed
        self.effects = effects
        self.watch = watch
        self.actors = actors
        self.reach = reach
        self._las = LasInfo(geo.crs, geo.offset, start)

    def paths(self, sensor: Scanner | Camera, frame: int) -> dict[str, Path]:
        """Files of one frame by format or image kind."""
        folder = self.out / sensor.name
        if isinstance(sensor, Scanner):
            return {kind: folder / kind / f"{frame:06d}.{kind}" for kind in self.formats}
        return {kind: folder / kind / f"{frame:06d}.png" for kind in sensor.spec.images}

    def is_done(self, sensor: Scanner | Camera, frame: int) -> bool:
        """Whether all files of a frame are there."""
        files = list(self.paths(sensor, frame).values())
        if self.actors is not None and isinstance(sensor, Scanner):
            files.append(self._boxes_path(sensor, frame))
        return all(path.exists() and path.stat().st_size for path in files)

    def _boxes_path(self, scanner: Scanner, frame: int) -> Path:
        return self.out / scanner.name / "boxes" / f"{frame:06d}.csv"

    def record(self, sensor: Scanner | Camera, frame: int, worlds: Worlds) -> int:
        """Sense one frame and write its files; return the number of points."""
        start = sensor.frame_start_ns(frame)
        if isinstance(sensor, Scanner):
            world = worlds.during(*sensor.sensor.window_ns(frame))
            cloud = self._record_cloud(sensor, frame, world)
            if self.actors is not None:
                self._record_boxes(self.actors, sensor, frame, cloud)
            return len(cloud)
        times = exposure_times(sensor.spec, start, samples=5 if sensor.spec.exposure_ns else 1)
        end = max(int(times[-1]), start + 1)
        self._record_images(sensor, frame, worlds.during(start, end), times, (times - start) / (end - start))
        return 0

    def _record_boxes(self, actors: Actors, scanner: Scanner, frame: int, cloud: Cloud) -> None:
        """Write the boxes of a frame, with the number of its points on each."""
        begin = scanner.frame_start_ns(frame)
        columns = box_rows(actors, self.trajectory, begin, frame, reach=self.reach)
        points = count_points(actors, columns["id"], cloud.feature)
        path = self._boxes_path(scanner, frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_columns(path, {**columns, "points": points})

    def _record_cloud(self, scanner: Scanner, frame: int, world: World) -> Cloud:
        with self.watch.stage("scan"):
            cloud = scan(
                scanner.sensor,
                scanner.spec.mount,
                self.trajectory,
                world,
                frame,
                seed=self.seed,
                effects=self.effects,
            )
        begin = scanner.frame_start_ns(frame)
        paths = self.paths(scanner, frame)
        for path in paths.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        table = cloud_table(cloud)
        table["time_ns"] = (cloud.time_ns + (cloud.start_ns - begin)).astype(np.uint32)
        for kind, write in (("pcd", write_pcd), ("ply", write_ply), ("csv", write_csv)):
            if kind in paths:
                with self.watch.stage(f"write {kind}"):
                    write(paths[kind], table)
        if world_kinds := [kind for kind in ("laz", "las") if kind in paths]:
            with self.watch.stage("georeference"):
                placed = self._world_table(scanner, cloud, table)
            for kind in world_kinds:
                with self.watch.stage(f"write {kind}"):
                    write_las(paths[kind], placed, self._las)
        return cloud

    def _world_table(self, scanner: Scanner, cloud: Cloud, table: Table) -> Table:
        mount, time_ns = scanner.spec.mount, cloud.start_ns + cloud.time_ns.astype(np.int64)
        placed = self.trajectory.place(
            cloud.xyz, time_ns, translation=mount.translation, rotation=mount.rotation
        )
        world = self.geo.points(placed)
        return table | {
            "x": world[:, 0],
            "y": world[:, 1],
            "z": world[:, 2],
            "gps_time": gps_seconds(self.start, time_ns),
        }

    def _record_images(
        self, camera: Camera, frame: int, world: World, times: NDArray[np.int64], shares: NDArray[np.float64]
    ) -> None:
        spec = camera.spec
        with self.watch.stage("render"):
            poses = self.trajectory.at(times).mounted(spec.mount.translation, spec.mount.rotation)
            image = render(spec, poses, world, sun=self._sun(), times=None if self.actors is None else shares)
        for kind, path in self.paths(camera, frame).items():
            path.parent.mkdir(parents=True, exist_ok=True)
            with self.watch.stage(f"write {kind}"):
                if kind == "rgb" and image.rgb is not None:
                    write_png(path, image.rgb)
                elif kind == "depth":
                    write_png(path, depth_to_counts(image.depth))
                elif kind == "semantic":
                    write_png(path, image.klass)
                elif kind == "instance":
                    write_png(path, feature_to_image(image.feature))
                elif kind == "flow":
                    write_png(path, flow_to_image(self._flow(camera, frame, world)))

    def _flow(self, camera: Camera, frame: int, world: World) -> NDArray[np.float32]:
        mount = camera.spec.mount
        here, later = (
            self.trajectory.at([camera.frame_start_ns(k)]).mounted(mount.translation, mount.rotation)
            for k in (frame, frame + 1)
        )
        return optical_flow(camera.spec, here, later, world)

    def _sun(self) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return _sun(self.frame, self.start, *self.trajectory.position[0, :2].tolist())


@functools.lru_cache(maxsize=4)
def _sun(
    frame: Frame, start: datetime, x: float, y: float
) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return sun_direction(frame, start, at=(x, y))
