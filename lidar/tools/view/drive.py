"""What the page shows of a dataset: a scanner's sweeps with boxes and truth, images, the path, and roads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geoscene.classes import Class, class_codes
from geoscene.errors import GeosceneError
from geoscene.scene.layout import open_scene
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import Table
from lidar.dataset.ground_truth import read_boxes, read_truth
from lidar.dataset.layout import Dataset, frame_numbers, reading_file
from lidar.dataset.recorded import Stream, cloud_points, frames_within, mount_of, nearest, scanner_clouds
from lidar.errors import InputError
from lidar.geometry.attitude import quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.options.look import PlaybackOptions
from lidar.sensors.physics.origin import Origin
from lidar.tools.maps.colors import distinct, ramp
from lidar.tools.view.sweeps import (
    ANGLE_STEP,
    RANGE_STEP,
    TABLE_STEP,
    TIME_STEP_NS,
    Slots,
    pack_sweep,
    slots_of,
)

POSES = 9
"""Poses of the scanner over a sweep, between which the page interpolates: 12.5 ms apart at 10 Hz."""

_SAMPLE = 16
"""Sweeps from which the table of directions is made."""

_WIDTH = 640
"""Largest width of images in pixels."""

_QUALITY = 75
"""Quality of images, of 95 (JPEG)."""

_FARTHEST = 80.0
"""Metres at which the colours of depth end; its square root is drawn, so that near things differ."""

_AROUND = 150.0
"""Metres around the path within which roads are drawn."""

_PATH_POINTS = 4000
"""Points of the path on the plan, at most."""

_BOX = (
    *("id", "instance", "x", "y", "z", "qx", "qy", "qz", "qw"),
    *("length", "width", "height", "vx", "vy", "points"),
)


@dataclass(frozen=True)
class ScannerSweeps:
    """Sweeps of a scanner, one row for each that is shown.

    clouds : of the scanner
    rows   : (m,) of ``clouds``
    index  : (n,) row of ``rows`` in each frame of the page: its own sweep of the first scanner, of others the
             one that starts nearest in time
    """

    clouds: Stream
    rows: Ints
    index: Ints


@dataclass(frozen=True)
class CameraImages:
    """Images of a camera, one row for each that is shown.

    name  : of the camera
    kinds : which there are: ``rgb``, ``depth``
    frame : (m,) number of each image that is nearest in time to some sweep
    index : (n,) row of the image of each sweep
    """

    name: str
    kinds: tuple[str, ...]
    frame: Ints
    index: Ints


class Drive:
    """The part of a dataset that a page shows; its frames are the sweeps of the first scanner.

    Raises InputError for a sensor that is not in the dataset and frames that it does not have, and
    DatasetError for a dataset without clouds in the sensor frame.
    """

    def __init__(self, dataset: Dataset, options: PlaybackOptions) -> None:
        self.dataset = dataset
        scanners, cameras = _chosen(dataset, options.sensors)
        self.clouds, *others = scanners
        shown = frames_within(self.clouds, options.limits, every=options.every or 1)
        self.rows: Ints = np.searchsorted(self.clouds.frames, shown.frames)
        self.scanners = [ScannerSweeps(self.clouds, self.rows, np.arange(len(self.rows)))]
        for clouds in others:
            rows, index = np.unique(nearest(clouds.time_ns, shown.time_ns), return_inverse=True)
            self.scanners.append(ScannerSweeps(clouds, rows, index.ravel()))
        self.cameras = [found for name in cameras if (found := self._images(name)) is not None]
        self.notes: list[str] = []

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return self.dataset.trajectory()

    @cached_property
    def slots(self) -> list[Slots]:
        """Directions of each scanner's pulses, from some sweeps over the drive."""
        return [
            slots_of(
                [
                    cloud_points(self._file(shown.clouds, row))
                    for row in shown.rows[:: max(1, len(shown.rows) // _SAMPLE)].tolist()
                ]
            )
            for shown in self.scanners
        ]

    def sweep(self, k: int, *, scanner: int = 0) -> tuple[int, bytes]:
        """Number of returns of the k-th sweep of a scanner that is shown, and its bytes with poses and boxes.

        Raises DatasetError for a damaged file.
        """
        clouds, row = self.scanners[scanner].clouds, int(self.scanners[scanner].rows[k])
        table = cloud_points(self._file(clouds, row))
        head = {"poses": self._poses(clouds, row, table=table), "boxes": self._boxes(clouds, row)}
        origin = self._origin(clouds, row, count=len(table["x"]))
        return len(table["x"]), pack_sweep(table, self.slots[scanner], origin=origin, head=head)

    def image(self, camera: int, k: int, *, kind: str) -> bytes:
        """The k-th image of a camera that is shown, as JPEG; depth in colours.

        Raises DatasetError for a damaged file.
        """
        images = self.cameras[camera]
        path = self.dataset.frame_file(self.dataset.paths.image(images.name, int(images.frame[k]), kind=kind))
        with reading_file(path), Image.open(path) as image:
            pixels = np.asarray(image)
        if kind == "depth":
            counts = float(self.dataset.sensors()[images.name]["depth_counts_per_metre"])
            colors = ramp(-np.sqrt(pixels / counts), -np.sqrt(_FARTHEST), high=0.0)
            pixels = np.where(pixels[..., None] > 0, colors, np.uint8(0))
        picture = Image.fromarray(pixels).convert("RGB")
        picture.thumbnail((_WIDTH, _WIDTH), Image.Resampling.BILINEAR)
        file = BytesIO()
        picture.save(file, "JPEG", quality=_QUALITY)
        return file.getvalue()

    def head(self) -> dict[str, Any]:
        """Header that the player needs: names, colours, units, and columns of the frames."""
        times = self.clouds.time_ns[self.rows]
        at = self.trajectory.at(times)
        forward = at.rotation[:, :, 0]
        classes = class_codes().color.tolist()
        path, roads = self._path(), self._roads()
        return {
            "name": self.dataset.path.resolve().name,
            "scanners": [
                {
                    "name": shown.clouds.name,
                    "model": shown.clouds.sensor.get("model", ""),
                    "far": float(shown.clouds.sensor.get("max_range", 100.0)),
                    "index": shown.index.tolist(),
                }
                for shown in self.scanners
            ],
            "start": self.dataset.start.isoformat(),
            "frame": self.dataset.frame.name,
            "numbers": self.clouds.frames[self.rows].tolist(),
            "time_ns": times.tolist(),
            "position": np.round(at.position, 3).tolist(),
            "heading": np.round(np.arctan2(forward[:, 1], forward[:, 0]), 5).tolist(),
            "speed": np.round(_speeds(self.trajectory, times), 3).tolist(),
            "path": path.round(2).tolist(),
            "roads": roads,
            "cameras": [{"name": c.name, "kinds": c.kinds, "index": c.index.tolist()} for c in self.cameras],
            "truth": bool(self._truth_path(self.clouds, int(self.rows[0])).exists()),
            "classes": {int(code): [code.name.lower(), classes[code]] for code in Class},
            "origins": [origin.name.lower() for origin in Origin],
            "ramp": ramp(np.arange(256), 0, high=255).tolist(),
            "distinct": distinct(np.arange(7)).tolist(),
            "steps": {"range": RANGE_STEP, "angle": ANGLE_STEP, "table": TABLE_STEP, "time_ns": TIME_STEP_NS},
        }

    def cloud(self, scanner: ScannerSweeps, k: int) -> Path:
        """File of the k-th sweep of a scanner that is shown."""
        return self._file(scanner.clouds, int(scanner.rows[k]))

    def _file(self, clouds: Stream, row: int) -> Path:
        return self.dataset.frame_file(clouds.files[row])

    def _images(self, name: str) -> CameraImages | None:
        """Which images of a camera are shown with the sweeps; None without images."""
        numbers = {kind: self._numbers(name, kind) for kind in ("rgb", "depth")}
        kinds = tuple(kind for kind, found in numbers.items() if len(found))
        if not kinds:
            return None
        frames = numbers[kinds[0]]
        for kind in kinds:
            frames = np.intersect1d(frames, numbers[kind])
        times = self.dataset.sample_times(name)
        frames = frames[frames < len(times)]
        if not len(frames):
            return None
        shown = nearest(times[frames], self.clouds.time_ns[self.rows])
        used, index = np.unique(shown, return_inverse=True)
        return CameraImages(name, kinds, frames[used], index.ravel())

    def _numbers(self, name: str, kind: str) -> Ints:
        """Frames of which a camera has an image."""
        return frame_numbers(
            self.dataset.frame_file(self.dataset.paths.image(name, 0, kind=kind)).parent, ".png"
        )

    def _truth_path(self, clouds: Stream, row: int) -> Any:
        return self.dataset.frame_file(self.dataset.paths.truth(clouds.name, int(clouds.frames[row])))

    def _origin(self, clouds: Stream, row: int, *, count: int) -> Any:
        """Cause of each return; None where no stage acted."""
        truth = read_truth(self._truth_path(clouds, row), count=count)
        return None if truth is None else truth["origin"]

    def _poses(self, clouds: Stream, row: int, *, table: Table) -> dict[str, Any]:
        """Poses of the scanner at even times from a sweep's start to its last return."""
        start, last = int(clouds.time_ns[row]), int(table["time_ns"].max(initial=1))
        times = start + np.rint(np.linspace(0, max(last, 1), POSES)).astype(np.int64)
        mount = mount_of(clouds.sensor)
        poses = self.trajectory.at(times).mounted(mount.translation, mount.rotation)
        quat = quat_from_matrix(poses.rotation)
        quat *= np.where((quat * quat[:1]).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
        return {
            "span": max(last, 1),
            "scale": float(poses.scale[0, 0]),
            "position": poses.position.round(4).tolist(),
            "quat": quat.round(7).tolist(),
        }

    def _boxes(self, clouds: Stream, row: int) -> list[dict[str, Any]]:
        """3D boxes of road users at a sweep's start."""
        path = self.dataset.frame_file(self.dataset.paths.frame_boxes(clouds.name, int(clouds.frames[row])))
        if not path.exists():
            return []
        return [
            {"class": int(Class[str(box["class"]).upper()])}
            | {name: round(box[name], 4) if isinstance(box[name], float) else box[name] for name in _BOX}
            for box in read_boxes(path, _BOX)
        ]

    def _path(self) -> Float:
        """The way of the ego vehicle in plan, (n, 2) scene metres."""
        step = max(1, len(self.trajectory) // _PATH_POINTS)
        return self.trajectory.position[::step, :2]

    def _roads(self) -> list[list[list[float]]]:
        """Centre lines of the scene's roads near the path in plan; none without the scene."""
        try:
            graph = open_scene(self.dataset.scene_path).road_graph()
        except (GeosceneError, OSError) as error:
            self.notes.append(f"the plan has no roads: {error}")
            return []
        path = self._path()
        low, high = path.min(axis=0) - _AROUND, path.max(axis=0) + _AROUND
        lines = []
        for edge, line in enumerate(graph.geometry):
            if 0 <= graph.twin[edge] < edge:
                continue
            plan = np.asarray(line)[:, :2]
            if (plan.max(axis=0) > low).all() and (plan.min(axis=0) < high).all():
                lines.append(plan.round(1).tolist())
        return lines


def _speeds(trajectory: Trajectory, time_ns: Ints) -> Float:
    """Speeds (n,) at times, m/s."""
    speed = np.linalg.norm(trajectory.velocity, axis=1)
    found: Float = np.interp(time_ns, trajectory.time_ns, speed)
    return found


def _chosen(dataset: Dataset, names: Sequence[str]) -> tuple[list[Stream], list[str]]:
    """The clouds of the scanners, and the names of the cameras, that are to be shown."""
    kinds = {name: sensor["kind"] for name, sensor in dataset.sensors("lidar", "camera").items()}
    if unknown := sorted(set(names) - set(kinds)):
        raise InputError(
            f"`sensors`: no scanner or camera {', '.join(unknown)} in {dataset.path}; there are"
            f" {', '.join(kinds)}"
        )
    scanners = [name for name in names if kinds[name] == "lidar"]
    clouds = [scanner_clouds(dataset, name) for name in dict.fromkeys(scanners or [""])]
    cameras = [name for name in names if kinds[name] == "camera"]
    if not cameras:
        with_images = (
            name
            for name, kind in kinds.items()
            if kind == "camera"
            and len(
                frame_numbers(dataset.frame_file(dataset.paths.image(name, 0, kind="rgb")).parent, ".png")
            )
        )
        cameras = [name for name in (next(with_images, ""),) if name]
    return clouds, cameras
