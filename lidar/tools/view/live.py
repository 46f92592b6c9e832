"""Drives in viewers of others: in Rerun while they are recorded, or a file for it; sweeps in Open3D."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes
from geoscene.errors import need
from geoscene.support.files import atomic_path
from geoscene.typing import Float
from lidar.dataset.formats import format_of, read_table
from lidar.dataset.layout import open_dataset, reading_file
from lidar.dataset.recorded import cloud_points, still_points
from lidar.errors import InputError, LidarError
from lidar.geometry.poses import Trajectory
from lidar.options.look import PlaybackOptions
from lidar.sensors.rig.devices import Camera
from lidar.sensors.rig.specs import CameraSpec
from lidar.simulation.drive import Live
from lidar.simulation.plan import DrivePlan
from lidar.simulation.recording import Columns, MeasuredCloud, MeasuredImages
from lidar.tools.maps.colors import ramp
from lidar.tools.view.drive import Drive

_TIMELINE = "drive"
"""Of the viewer: time since the drive's start."""

_VEHICLE = "scene/vehicle"
_PATH_POINTS = 4000
"""Points of the path, at most."""

_QUALITY = 85
"""Of colour images (JPEG)."""


@dataclass(frozen=True, slots=True)
class LiveTarget:
    """Target of a live view: a file, or a viewer."""

    file: Path | None


def live_target(words: Sequence[str] | None, *, overwrite: bool) -> LiveTarget | None:
    """Target of a live view from the words of an option; None without the option.

    Raises InputError for other words than a free file name that ends with .rrd, and MissingExtraError without
    rerun.
    """
    if words is None:
        return None
    if len(words) > 1 or not all(word.endswith(".rrd") for word in words):
        raise InputError(
            f"`live` {' '.join(words)}: give one file that ends with .rrd, or none to open a viewer; other"
            " arguments stand before it"
        )
    need("rerun", "live")
    file = Path(words[0]) if words else None
    if file is not None and file.exists() and not overwrite:
        raise InputError(f"`live` {file}: exists already; give another name, or set `overwrite`")
    return LiveTarget(file)


@contextmanager
def opened_live(target: LiveTarget | None) -> Iterator[Live | None]:
    """Yield what `simulation.drive.drive` shows frames with; None without a target. A file is written whole.

    Raises LidarError if no viewer opens.
    """
    if target is None:
        yield None
        return
    rr = need("rerun", "live")
    stream = rr.RecordingStream("lidar")
    if target.file is None:
        try:
            rr.spawn(recording=stream)
        except (RuntimeError, OSError) as error:
            raise LidarError(
                f"`live`: no viewer of Rerun opens ({error}); write a file instead: --live FILE.rrd"
            ) from error
        yield lambda plan: _Viewer(stream, plan).show
        stream.flush()
        return
    with atomic_path(target.file, keep_suffix=True) as part:
        stream.save(part)
        yield lambda plan: _Viewer(stream, plan).show
        stream.disconnect()


class _Viewer:
    """Logs a drive to a viewer: at first what does not change, classes, mounts, intrinsics and the path."""

    def __init__(self, stream: Any, plan: DrivePlan) -> None:
        self._rr, self._stream = need("rerun", "live"), stream
        self._boxed = next((s.name for s in plan.sensors if not isinstance(s, Camera)), "")
        rr, colors = self._rr, class_codes().color
        stream.send_blueprint(_blueprint(plan.sensors))
        stream.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        classes = [(int(k), k.name.lower(), tuple(colors[k].tolist())) for k in Class]
        stream.log("/", rr.AnnotationContext(classes), static=True)
        for sensor in plan.sensors:
            mount, place = sensor.spec.mount, f"{_VEHICLE}/{sensor.name}"
            stream.log(
                place, rr.Transform3D(translation=mount.translation, mat3x3=mount.rotation), static=True
            )
            if isinstance(sensor, Camera) and sensor.spec.model == "pinhole":
                stream.log(place, self._pinhole(sensor.spec), static=True)
        step = max(1, len(plan.trajectory) // _PATH_POINTS)
        path = rr.LineStrips3D([plan.trajectory.position[::step]], colors=[(230, 80, 40)])
        stream.log("scene/path", path, static=True)

    def show(self, measured: MeasuredCloud | MeasuredImages) -> None:
        """Log a frame, at its start."""
        rr, stream = self._rr, self._stream
        stream.set_time(_TIMELINE, duration=np.timedelta64(measured.time_ns, "ns"))
        self._log_vehicle(measured.trajectory, time_ns=measured.time_ns)
        if isinstance(measured, MeasuredImages):
            self._log_images(measured)
            return
        classes = measured.cloud.klass.astype(np.uint16)
        stream.log(f"{_VEHICLE}/{measured.sensor}", rr.Points3D(measured.deskewed(), class_ids=classes))
        if measured.sensor == self._boxed and measured.boxes:
            self._log_boxes(measured.boxes)

    def _log_vehicle(self, trajectory: Trajectory, *, time_ns: int) -> None:
        """Log the pose and the speed of the ego vehicle."""
        pose = trajectory.at([time_ns])
        matrix = pose.scale[0][:, None] * pose.rotation[0]
        self._stream.log(_VEHICLE, self._rr.Transform3D(translation=pose.position[0], mat3x3=matrix))
        row = min(int(np.searchsorted(trajectory.time_ns, time_ns)), len(trajectory) - 1)
        speed = float(np.linalg.norm(trajectory.velocity[row]))
        self._stream.log("speed", self._rr.Scalars(speed))

    def _log_images(self, measured: MeasuredImages) -> None:
        """Log the colours of a frame of a camera, or its depth without colours, and boxes in sight."""
        place, image = f"{_VEHICLE}/{measured.sensor}", measured.image
        if "rgb" in measured.camera.images and image.rgb is not None:
            self._stream.log(f"{place}/rgb", self._rr.Image(image.rgb).compress(jpeg_quality=_QUALITY))
        elif "depth" in measured.camera.images:
            depth = np.where(np.isfinite(image.depth), image.depth, np.float32(0))
            self._stream.log(f"{place}/depth", self._rr.DepthImage(depth, meter=1.0))
        if measured.boxes:
            boxes = _where(measured.boxes, measured.boxes["pixels"] > 0)
            logged = self._rr.Boxes2D(
                # A pixel's corner is (0, 0) in the viewer.
                array=np.column_stack([boxes[k] for k in ("left", "top", "right", "bottom")]) + 0.5,
                array_format=self._rr.Box2DFormat.XYXY,
                class_ids=_codes(boxes["class"]),
                show_labels=False,
            )
            self._stream.log(f"{place}/boxes", logged)

    def _log_boxes(self, boxes: Columns) -> None:
        """Log the 3D boxes of road users in the scene, those with returns."""
        boxes = _where(boxes, boxes["points"] > 0)
        logged = self._rr.Boxes3D(
            centers=np.column_stack([boxes[k] for k in "xyz"]),
            half_sizes=np.column_stack([boxes[k] for k in ("length", "width", "height")]) / 2,
            quaternions=np.column_stack([boxes[k] for k in ("qx", "qy", "qz", "qw")]),
            class_ids=_codes(boxes["class"]),
            labels=[f"{kind} {number}" for kind, number in zip(boxes["kind"], boxes["id"], strict=True)],
            show_labels=False,
        )
        self._stream.log("scene/road_users", logged)

    def _pinhole(self, camera: CameraSpec) -> Any:
        """The intrinsics of a camera; distortion is not shown."""
        return self._rr.Pinhole(
            focal_length=(camera.fx, camera.fy),
            principal_point=(camera.cx + 0.5, camera.cy + 0.5),
            resolution=(camera.width, camera.height),
            camera_xyz=self._rr.ViewCoordinates.RDF,
            image_plane_distance=1.0,
        )


def _where(columns: Columns, mask: NDArray[np.bool_]) -> Columns:
    return {name: values[mask] for name, values in columns.items()}


def _codes(names: NDArray[Any]) -> NDArray[np.uint16]:
    return np.array([Class[str(name).upper()] for name in names], np.uint16)


def _blueprint(sensors: Sequence[Any]) -> Any:
    """The layout of the viewer: the scene, the images beside it, the speed below."""
    rrb = need("rerun.blueprint", "live")
    follow = {}
    if hasattr(rrb, "EyeControls3D"):  # of newer versions
        follow = {"eye_controls": rrb.EyeControls3D(tracking_entity=f"/{_VEHICLE}")}
    scene = rrb.Spatial3DView(origin="scene", name="Scene", **follow)
    speed = rrb.TimeSeriesView(origin="speed", name="Speed, m/s")
    parts = [rrb.Vertical(scene, speed, row_shares=[5, 1])]
    cameras = [sensor.name for sensor in sensors if isinstance(sensor, Camera)]
    if cameras:
        views = [rrb.Spatial2DView(origin=f"{_VEHICLE}/{name}", name=name) for name in cameras]
        parts.append(rrb.Grid(*views) if len(views) > 1 else views[0])
    return rrb.Blueprint(rrb.Horizontal(*parts), collapse_panels=True)


def colored_points(path: str | Path, options: PlaybackOptions) -> tuple[Float, Float]:
    """Points (n, 3) in metres, and their colours (n, 3) from 0 to 1: of a file, or of a dataset's sweep.

    The sweep is the first of the frames, without the ego vehicle's motion, in the sensor's frame. A file's
    points are relative to their mean. Colours are those in the file, else those of the classes, else heights.

    Raises InputError or DatasetError for what is not readable.
    """
    path = Path(path)
    if path.is_file():
        with reading_file(path):
            table = read_table(path) if format_of(path).frame == "world" else cloud_points(path)
        points = np.column_stack([table[axis].astype(float) for axis in "xyz"])
        points -= points.mean(axis=0) if len(points) else 0.0
    else:
        drive = Drive(open_dataset(path), options)
        table = still_points(drive.clouds, drive.trajectory, row=int(drive.rows[0]))
        points = np.column_stack([table[axis].astype(float) for axis in "xyz"])
    return points, _colors(table, points[:, 2]).astype(float) / 255


def _colors(table: dict[str, NDArray[Any]], height: Float) -> NDArray[np.uint8]:
    if "red" in table:
        rgb = np.column_stack([table[name] for name in ("red", "green", "blue")])
        return (rgb >> 8 if rgb.dtype == np.uint16 else rgb).astype(np.uint8)  # LAS has 16 bits
    if "label" in table:
        colors: NDArray[np.uint8] = class_codes().color[table["label"]]
        return colors
    low, high = np.percentile(height, (1, 99)) if len(height) else (0.0, 1.0)
    return ramp(height, float(low), high=float(high))


def show_window(path: str | Path, *, options: PlaybackOptions = PlaybackOptions()) -> int:
    """Open a window with a sweep or a map, and return the number of points after it is closed.

    Raises MissingExtraError without Open3D, and as `colored_points`.
    """
    o3d = need("open3d", "open3d")
    points, colors = colored_points(path, options)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(colors)
    o3d.visualization.draw_geometries([cloud], window_name=str(path))
    return len(points)
