"""One frame of one sensor: from the world to files."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.files import write_columns
from geoscene.frames import Frame
from lidar.camera.png import depth_to_counts, feature_to_image, flow_to_image, write_png
from lidar.camera.render import Frame as Image
from lidar.camera.render import exposure_times, optical_flow, render
from lidar.camera.settings import PLAIN as PLAIN_CAMERA
from lidar.camera.settings import CameraSettings
from lidar.camera.sun import sun_direction
from lidar.dataset.boxes import box_rows, count_points, image_boxes
from lidar.dataset.deskew import MOMENTS, deskewed
from lidar.dataset.formats.kitti import semantic_kitti_labels, write_labels, write_velodyne
from lidar.dataset.formats.las import LasInfo, gps_seconds, write_las
from lidar.dataset.formats.nuscenes import write_lidarseg, write_nuscenes
from lidar.dataset.formats.pcd import write_pcd
from lidar.dataset.formats.ply import write_ply
from lidar.dataset.formats.table import Table, cloud_table
from lidar.dataset.formats.tally import points_in
from lidar.dataset.formats.text import write_csv
from lidar.errors import InputError
from lidar.geometry.georeference import Georeference
from lidar.geometry.poses import Poses, Trajectory
from lidar.physics.settings import PLAIN as PLAIN_SCANNER
from lidar.physics.settings import ScannerSettings
from lidar.random_streams import generator
from lidar.rig.devices import Camera, Scanner
from lidar.sensors.cloud import Cloud, no_returns
from lidar.sensors.doppler import radial_velocity, surface_velocity
from lidar.sensors.scan import scan
from lidar.world.actors import Actors
from lidar.world.thread_worlds import Worlds
from lidar.world.visibility import Visibility
from lidar.world.world import World

FORMATS = ("pcd", "ply", "csv", "laz", "las", "kitti", "nuscenes")
"""Formats of clouds."""

LABELS = ("semantickitti", "nuscenes")
"""Files of labels alone, a row a point, in the codes of others."""

_WORLD = ("laz", "las")
_WRITERS: dict[str, Callable[[Path, Table], None]] = {
    "pcd": write_pcd,
    "ply": write_ply,
    "csv": write_csv,
    "kitti": write_velodyne,
    "nuscenes": write_nuscenes,
}
_PLACES = {
    "kitti": ("velodyne", ".bin"),
    "nuscenes": ("nuscenes", ".pcd.bin"),
    "labels semantickitti": ("labels", ".label"),
    "labels nuscenes": ("lidarseg", "_lidarseg.bin"),
    "boxes": ("boxes", ".csv"),
}
"""Folder and ending of files; formats that are not here have a folder of their name, and end in it."""

_SUN_NS = 10_000_000_000
"""Nanoseconds for which the sun stands still in images: it goes 0.04 degrees meanwhile."""


class _Watch(Protocol):
    def stage(self, name: str) -> AbstractContextManager[None]: ...


@dataclass(frozen=True, slots=True)
class Contents:
    """What is written of every frame, and how it is made.

    formats : of clouds, of `FORMATS`
    labels  : of `LABELS`
    deskew  : moment, of `deskew.MOMENTS`, to which clouds are brought in files beside the raw ones
    seed    : of everything random
    scanner : settings of scanners
    camera  : settings of cameras
    """

    formats: tuple[str, ...] = ("pcd",)
    labels: tuple[str, ...] = ()
    deskew: str = ""
    seed: int = 0
    scanner: ScannerSettings = PLAIN_SCANNER
    camera: CameraSettings = PLAIN_CAMERA

    def __post_init__(self) -> None:
        """Refuse what cannot be written."""
        if not self.formats:
            raise InputError(f"`formats`: give one or more of {','.join(FORMATS)}")
        if unknown := sorted(set(self.formats) - set(FORMATS)):
            raise InputError(f"`formats` {','.join(unknown)}: one or more of {','.join(FORMATS)}")
        if unknown := sorted(set(self.labels) - set(LABELS)):
            raise InputError(f"`labels` {','.join(unknown)}: one or more of {','.join(LABELS)}")
        if self.deskew and self.deskew not in MOMENTS:
            raise InputError(f"`deskew` {self.deskew}: one of {', '.join(MOMENTS)}")
        if self.deskew and not set(self.formats) - set(_WORLD):
            raise InputError(
                f"`deskew`: {','.join(self.formats)} files hold points as they are in the world; add"
                " a format of the sensor frame (pcd, ply, csv, kitti or nuscenes)"
            )


class Recorder:
    """Writes frames of sensors into a dataset directory; may be used by several threads at once."""

    def __init__(
        self,
        out: Path,
        frame: Frame,
        *,
        trajectory: Trajectory,
        start: datetime,
        geo: Georeference,
        contents: Contents,
        watch: _Watch,
        actors: Actors | None = None,
        reach: float = 0.0,
        on: NDArray[np.int64] | None = None,
    ) -> None:
        self.out = out
        self.frame = frame
        self.trajectory = trajectory
        self.start = start
        self.geo = geo
        self.contents = contents
        self.watch = watch
        self.actors = actors
        self.reach = reach
        self.on = on
        self._visibility = None if actors is None else Visibility(actors)
        self._las = LasInfo(geo.crs, geo.offset, start)

    def paths(self, sensor: Scanner | Camera, frame: int) -> dict[str, Path]:
        """Files of one frame by what is in them."""
        folder, wanted = self.out / sensor.name, self.contents
        kinds: list[str] = ["boxes"] if self.actors is not None else []
        if isinstance(sensor, Camera):
            found = {kind: folder / kind / f"{frame:06d}.png" for kind in sensor.spec.images}
        else:
            found = {}
            kinds += [*wanted.formats, *(f"labels {name}" for name in wanted.labels)]
        for kind in kinds:
            inside, ending = _PLACES.get(kind, (kind, f".{kind}"))
            found[kind] = folder / inside / f"{frame:06d}{ending}"
            if wanted.deskew and kind in _WRITERS:
                found[f"deskewed {kind}"] = folder / "deskewed" / f"{frame:06d}{ending}"
        return found

    def is_done(self, sensor: Scanner | Camera, frame: int) -> bool:
        """Whether all files of a frame are there; a file of rows alone is empty where there are no points."""
        rows_alone = ("kitti", "nuscenes", "labels semantickitti", "labels nuscenes")
        return all(
            path.exists() and (path.stat().st_size or kind.removeprefix("deskewed ") in rows_alone)
            for kind, path in self.paths(sensor, frame).items()
        )

    def count(self, sensor: Scanner | Camera, frame: int) -> int:
        """Number of points of a frame that is done; 0 for an image."""
        if isinstance(sensor, Camera):
            return 0
        kind = self.contents.formats[0]
        return points_in(self.paths(sensor, frame)[kind], kind)

    def record(self, sensor: Scanner | Camera, frame: int, *, worlds: Worlds) -> int:
        """Sense one frame and write its files; return the number of points."""
        for path in self.paths(sensor, frame).values():
            path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(sensor, Camera):
            self._record_images(sensor, frame, worlds=worlds)
            return 0
        world = worlds.during(*sensor.sensor.window_ns(frame))
        cloud = self._record_cloud(sensor, frame, world=world)
        if self.actors is not None:
            with self.watch.stage("boxes"):
                self._record_boxes(self.actors, sensor, frame=frame, cloud=cloud, world=world)
        return len(cloud)

    def _record_boxes(
        self, actors: Actors, scanner: Scanner, *, frame: int, cloud: Cloud, world: World
    ) -> None:
        """Write the 3D boxes of a frame, with the number of its points on each and how much of it is seen."""
        begin, mount = scanner.frame_start_ns(frame), scanner.spec.mount
        columns = box_rows(actors, self.trajectory, time_ns=begin, frame=frame, reach=self.reach)
        points = count_points(actors, columns["id"], feature=cloud.feature)
        eye = self.trajectory.at([begin]).mounted(mount.translation, mount.rotation).position[0]
        assert self._visibility is not None  # noqa: S101
        share = self._visibility.seen_from(eye, world, rows=columns["id"], time_ns=begin)
        extra = {"points": points, "visibility": np.round(share, 4)}
        write_columns(self.paths(scanner, frame)["boxes"], {**columns, **extra})

    def _scanned(self, scanner: Scanner, frame: int, *, world: World) -> Cloud:
        """What a scanner reports in a frame, while it works."""
        start, end = scanner.sensor.window_ns(frame)
        if self.on is not None and not ((self.on[:, 0] <= end) & (self.on[:, 1] >= start)).any():
            return no_returns(start)
        wanted = self.contents
        with self.watch.stage("scan"):
            cloud = scan(
                scanner.sensor,
                scanner.spec.mount,
                trajectory=self.trajectory,
                world=world,
                frame=frame,
                seed=wanted.seed,
                settings=wanted.scanner,
            )
        if self.on is None:
            return cloud
        time = cloud.start_ns + cloud.time_ns.astype(np.int64)
        first = np.searchsorted(self.on[:, 0], time, side="right") - 1
        return cloud.where((first >= 0) & (time <= np.maximum.accumulate(self.on[:, 1])[first]))

    def _record_cloud(self, scanner: Scanner, frame: int, *, world: World) -> Cloud:
        wanted = self.contents
        cloud = self._scanned(scanner, frame, world=world)
        begin = scanner.frame_start_ns(frame)
        time_ns = cloud.start_ns + cloud.time_ns.astype(np.int64)
        paths = self.paths(scanner, frame)
        table = cloud_table(cloud)
        table["time_ns"] = (time_ns - begin).astype(np.uint32)
        world_kinds = [kind for kind in _WORLD if kind in paths]
        placed = np.empty((0, 3))
        if world_kinds or wanted.deskew or scanner.sensor.fmcw:
            mount = scanner.spec.mount
            with self.watch.stage("georeference"):
                placed = self.trajectory.place(
                    cloud.xyz, time_ns, translation=mount.translation, rotation=mount.rotation
                )
        if scanner.sensor.fmcw:
            with self.watch.stage("velocity"):
                table["velocity"] = self._velocity(
                    scanner, frame, cloud=cloud, placed=placed, time_ns=time_ns
                )
        self._write_raw(paths, table)
        if wanted.deskew:
            self._write_raw(paths, table | self._at_once(scanner, frame, placed=placed), prefix="deskewed ")
        if world_kinds:
            with self.watch.stage("georeference"):
                east, north, up = self.geo.points(placed).T
                gps = gps_seconds(self.start, time_ns)
                moved = table | {"x": east, "y": north, "z": up, "gps_time": gps}
            for kind in world_kinds:
                with self.watch.stage(f"write {kind}"):
                    write_las(paths[kind], moved, info=self._las)
        self._write_labels(paths, cloud)
        return cloud

    def _write_raw(self, paths: dict[str, Path], table: Table, *, prefix: str = "") -> None:
        for kind, write in _WRITERS.items():
            if prefix + kind in paths:
                with self.watch.stage(f"write {kind}"):
                    write(paths[prefix + kind], table)

    def _at_once(self, scanner: Scanner, frame: int, *, placed: NDArray[np.float64]) -> Table:
        """Coordinates of a frame's points at the moment that is asked for."""
        moment = scanner.frame_start_ns(frame) + int(MOMENTS[self.contents.deskew] * scanner.period_ns)
        x, y, z = deskewed(placed, self.trajectory, mount=scanner.spec.mount, time_ns=moment).T
        return {"x": x, "y": y, "z": z}

    def _velocity(
        self,
        scanner: Scanner,
        frame: int,
        *,
        cloud: Cloud,
        placed: NDArray[np.float64],
        time_ns: NDArray[np.int64],
    ) -> NDArray[np.float32]:
        """Radial velocities as measured: with noise where ranges have it."""
        moving = None
        if self.actors is not None:
            moving = surface_velocity(self.actors, cloud.feature, placed=placed, time_ns=time_ns)
        velocity = radial_velocity(cloud, scanner.spec.mount, trajectory=self.trajectory, moving=moving)
        sigma, wanted = scanner.sensor.velocity_sigma, self.contents
        if sigma and wanted.scanner.range_noise != "none":
            rng = generator(wanted.seed, scanner.name, frame, "velocity noise")
            velocity = velocity + np.float32(sigma) * rng.standard_normal(len(velocity), np.float32)
        return velocity

    def _write_labels(self, paths: dict[str, Path], cloud: Cloud) -> None:
        if (path := paths.get("labels semantickitti")) is not None:
            thing, moving = np.zeros(len(cloud), np.int64), np.zeros(len(cloud), bool)
            if self.actors is not None and len(self.actors):
                row = cloud.feature.astype(np.int64) - int(self.actors.feature[0])
                on = np.flatnonzero((row >= 0) & (row < len(self.actors)))
                thing[on] = row[on] + 1
                moving[on] = ~self.actors.parked[row[on]]
            write_labels(path, semantic_kitti_labels(cloud.klass, thing, moving=moving))
        if (path := paths.get("labels nuscenes")) is not None:
            write_lidarseg(path, cloud.klass)

    def _record_images(self, camera: Camera, frame: int, *, worlds: Worlds) -> None:
        spec, settings = camera.spec, self.contents.camera
        start = camera.frame_start_ns(frame)
        samples = settings.moments(spec)
        times = exposure_times(spec, start, samples=samples)
        end = max(int(times[-1]), start + 1)
        world = worlds.during(start, end)
        poses = self._seen_from(camera, times)
        with self.watch.stage("render"):
            image = render(
                spec,
                poses,
                world=world,
                sun=self._sun(start),
                times=None if self.actors is None else (times - start) / (end - start),
                random=generator(self.contents.seed, camera.name, frame, "image"),
                options=settings.options(spec),
            )
        rows = len(times) // samples
        middle = (samples // 2) * rows + rows // 2
        paths = self.paths(camera, frame)
        if self.actors is not None:
            with self.watch.stage("boxes"):
                pose = poses.take([middle])
                self._record_image_boxes(
                    self.actors, camera, frame=frame, pose=pose, time_ns=int(times[middle]), image=image
                )
        for kind in spec.images:
            with self.watch.stage(f"write {kind}"):
                if kind == "rgb" and image.rgb is not None:
                    write_png(paths[kind], image.rgb)
                elif kind == "depth":
                    write_png(paths[kind], depth_to_counts(image.depth))
                elif kind == "semantic":
                    write_png(paths[kind], image.klass)
                elif kind == "instance":
                    write_png(paths[kind], feature_to_image(image.feature))
                elif kind == "flow":
                    first = (samples // 2) * rows
                    flow = self._flow(camera, worlds, times=times[first : first + rows])
                    write_png(paths[kind], flow_to_image(flow))

    def _record_image_boxes(
        self, actors: Actors, camera: Camera, *, frame: int, pose: Poses, time_ns: int, image: Image
    ) -> None:
        """Write the 2D boxes of an image."""
        found = image_boxes(actors, camera.spec, pose=pose, time_ns=time_ns, instance=image.feature)
        names = np.array([Class(int(k)).name.lower() for k in actors.klass[found.row]], np.str_)
        sides = ("left", "top", "right", "bottom")
        columns = {
            "frame": np.full(len(found.row), frame),
            "time_ns": np.full(len(found.row), time_ns),
            "id": found.row,
            "instance": actors.feature[found.row],
            "class": names,
            "kind": actors.kind[found.row],
            **{side: np.round(found.box[:, k], 2) for k, side in enumerate(sides)},
            **{f"seen_{side}": found.seen[:, k] for k, side in enumerate(sides)},
            "pixels": found.pixels,
            "visibility": np.round(found.visibility, 4),
        }
        write_columns(self.paths(camera, frame)["boxes"], columns)

    def _seen_from(self, camera: Camera, times: NDArray[np.int64]) -> Poses:
        mount = camera.spec.mount
        return self.trajectory.at(times).mounted(mount.translation, mount.rotation)

    def _flow(self, camera: Camera, worlds: Worlds, *, times: NDArray[np.int64]) -> NDArray[np.float32]:
        """Optical flow to the next frame; the thread's world is laid anew for it.

        times : of the rows in this frame, one for all without a rolling shutter
        """
        later = times + camera.period_ns
        start, end = int(times[0]), int(later[-1])
        world = worlds.during(start, end)
        moments = [(t - start) / (end - start) for t in (times, later)]
        here, there = (self._seen_from(camera, t) for t in (times, later))
        return optical_flow(
            camera.spec, here, later=there, world=world, times=moments[0], later_times=moments[1]
        )

    def _sun(self, time_ns: int) -> NDArray[np.float64]:
        when = self.start + timedelta(seconds=(time_ns // _SUN_NS) * _SUN_NS // 10**9)
        x, y = self.trajectory.position[0, :2].tolist()
        return _sun(self.frame, when, x=x, y=y)


@functools.lru_cache(maxsize=4)
def _sun(frame: Frame, when: datetime, *, x: float, y: float) -> NDArray[np.float64]:
    return sun_direction(frame, when, at=(x, y))
