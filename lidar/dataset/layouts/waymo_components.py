"""Components of the Waymo Open Dataset 2: Parquet files with their columns, and range images of scanners.

Range images are clouds with a pixel for each pulse, its pose and its label. A row is a ring, the highest
first, a column a step of azimuth on the vehicle, from behind by the left. Angles of this grid are not those
of the pulses: the pose of a pixel, which is the vehicle's at its time, is shifted by the difference, so that
points come out where they were recorded.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import class_codes
from geoscene.errors import need
from geoscene.typing import Float, Ints
from lidar.dataset.formats.table import Table
from lidar.dataset.recorded import Stream, cloud_points, recorded_labels
from lidar.geometry.attitude import euler_from_quat, quat_from_matrix
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.devices import Scanner
from lidar.sensors.rig.scanner import firings

Row = dict[str, Any]

RETURNS = 2
"""Range images of a scanner."""

DISTORTION = ("k1", "k2", "p1", "p2", "k3")
SHUTTER = ("shutter", "camera_trigger_time", "camera_readout_done_time")

_SEGMENT = ("segment_context_name",)
_FRAME = (*_SEGMENT, "frame_timestamp_micros")
_LASER, _CAMERA = (*_FRAME, "laser_name"), (*_FRAME, "camera_name")
_KEYS = {
    "segment_context_name": "text", "frame_timestamp_micros": "long", "laser_name": "byte",
    "camera_name": "byte", "laser_object_id": "text", "camera_object_id": "text",
}  # fmt: skip
_BOX = dict.fromkeys(("box.center.x", "box.center.y", "box.size.x", "box.size.y"), "double")
_MOTION = {f"velocity.linear_velocity.{axis}": "float" for axis in "xyz"} | {
    f"velocity.angular_velocity.{axis}": "double" for axis in "xyz"
}


def _image(kind: str, *, returns: int = RETURNS) -> dict[str, str]:
    """Columns of range images."""
    columns: dict[str, str] = {}
    for number in range(1, returns + 1):
        columns |= {f"range_image_return{number}.values": kind, f"range_image_return{number}.shape": "shape"}
    return columns


COMPONENTS: dict[str, tuple[str, tuple[str, ...], dict[str, str]]] = {
    "vehicle_pose": ("VehiclePoseComponent", _FRAME, {"world_from_vehicle.transform": "matrix"}),
    "lidar": ("LiDARComponent", _LASER, _image("floats")),
    "lidar_pose": ("LiDARPoseComponent", _LASER, _image("floats", returns=1)),
    "lidar_segmentation": ("LiDARSegmentationLabelComponent", _LASER, _image("ints")),
    "lidar_calibration": (
        "LiDARCalibrationComponent",
        (*_SEGMENT, "laser_name"),
        {
            "extrinsic.transform": "matrix",
            "beam_inclination.min": "double",
            "beam_inclination.max": "double",
            "beam_inclination.values": "doubles",
        },
    ),
    "lidar_box": (
        "LiDARBoxComponent",
        (*_FRAME, "laser_object_id"),
        {
            **{f"box.{part}.{axis}": "double" for part in ("center", "size") for axis in "xyz"},
            "box.heading": "double",
            "type": "byte",
            "num_lidar_points_in_box": "long",
            "num_top_lidar_points_in_box": "long",
            **{f"speed.{axis}": "double" for axis in "xyz"},
            **{f"acceleration.{axis}": "double" for axis in "xyz"},
            "difficulty_level.detection": "byte",
            "difficulty_level.tracking": "byte",
        },
    ),
    "camera_calibration": (
        "CameraCalibrationComponent",
        (*_SEGMENT, "camera_name"),
        {
            **{f"intrinsic.{name}": "double" for name in ("f_u", "f_v", "c_u", "c_v", *DISTORTION)},
            "extrinsic.transform": "matrix",
            "width": "int",
            "height": "int",
            "rolling_shutter_direction": "byte",
        },
    ),
    "camera_image": (
        "CameraImageComponent",
        _CAMERA,
        {
            "image": "bytes",
            "pose.transform": "matrix",
            **_MOTION,
            "pose_timestamp": "double",
            **{f"rolling_shutter_params.{name}": "double" for name in SHUTTER},
        },
    ),
    "camera_box": (
        "CameraBoxComponent",
        (*_CAMERA, "camera_object_id"),
        {**_BOX, "type": "byte", "difficulty_level.detection": "byte", "difficulty_level.tracking": "byte"},
    ),
    "camera_to_lidar_box_association": (
        "CameraToLiDARBoxAssociationComponent",
        (*_CAMERA, "camera_object_id", "laser_object_id"),
        {},
    ),
}
"""Components by the folder of their files: name, keys, and types of the other columns."""


class Component:
    """The file of a component that rows are appended to."""

    def __init__(self, tag: str, folder: Path, *, context: str) -> None:
        pa, parquet = need("pyarrow", "gis"), need("pyarrow.parquet", "gis")
        name, keys, columns = COMPONENTS[tag]
        types = {
            "text": pa.string(), "bytes": pa.binary(), "byte": pa.int8(), "int": pa.int32(),
            "long": pa.int64(), "float": pa.float32(), "double": pa.float64(),
            "floats": pa.list_(pa.float32()), "doubles": pa.list_(pa.float64()), "ints": pa.list_(pa.int32()),
            "shape": pa.list_(pa.int32(), 3), "matrix": pa.list_(pa.float64(), 16),
        }  # fmt: skip
        self._context = context
        self._names = {key: f"key.{key}" for key in keys} | {key: f"[{name}].{key}" for key in columns}
        kinds = {key: types[_KEYS[key]] for key in keys} | {key: types[k] for key, k in columns.items()}
        self._schema = pa.schema([(self._names[key], kind) for key, kind in kinds.items()])
        path = folder / tag / f"{context}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        split = [f"{self._names[key]}.list.element" for key, kind in columns.items() if kind == "floats"]
        whole = [self._names[key] for key in keys]
        whole += [f"{self._names[key]}.list.element" for key, kind in columns.items() if kind == "ints"]
        self._writer = parquet.ParquetWriter(
            path, self._schema, compression="zstd", use_dictionary=whole, use_byte_stream_split=split
        )

    def __enter__(self) -> Self:
        """The file, open."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._writer.close()

    def write(self, rows: Iterable[Row]) -> None:
        """Append rows: values by column; those that are missing are null."""
        named = list(self._named(rows))
        self._writer.write_table(need("pyarrow", "gis").Table.from_pylist(named, schema=self._schema))

    def _named(self, rows: Iterable[Row]) -> Iterator[Row]:
        for row in rows:
            known = {"segment_context_name": self._context} | row
            yield {name: known.get(key) for key, name in self._names.items()}


_FINE = 2
"""Columns of a range image for each firing block of a turn: nearly all points have a pixel of their own."""
_EMPTY = -1.0


@dataclass(frozen=True)
class RangeImageGrid:
    """The range images of a scanner.

    number      : from 1, of its name
    stream      : its clouds
    inclination : (h,) radians, rising, of each ring
    width       : columns
    """

    number: int
    stream: Stream
    inclination: Float
    width: int

    def azimuth(self, column: Ints) -> Float:
        """Azimuths (n,) in the sensor frame of columns: they fall from pi to -pi on the vehicle."""
        turn = self.stream.mount.rotation
        return np.asarray(
            ((self.width - column - 0.5) / self.width * 2 - 1) * np.pi - np.arctan2(turn[1, 0], turn[0, 0])
        )

    def column(self, azimuth: Float) -> Ints:
        """Columns (n,) nearest to azimuths in the sensor frame."""
        turn = self.stream.mount.rotation
        ahead = azimuth + np.arctan2(turn[1, 0], turn[0, 0])
        share = np.remainder(ahead / (2 * np.pi) + 0.5, 1.0)
        column: Ints = np.rint(self.width * (1 - share) - 0.5).astype(np.int64) % self.width
        return column


def grid_of(device: Scanner, stream: Stream, *, number: int) -> RangeImageGrid:
    """The grid of a scanner: elevations of its rings, and firing blocks of a turn."""
    sent = firings(device.sensor, 0)
    count = np.bincount(sent.ring)
    x, y, z = sent.direction.T
    inclination = np.bincount(sent.ring, np.arctan2(z, np.hypot(x, y))) / count
    return RangeImageGrid(number, stream, inclination, _FINE * (int(sent.column.max()) + 1))


def pixels(grid: RangeImageGrid, table: Table) -> tuple[Ints, Ints]:
    """Rows (k,) of the points of a cloud that get a pixel, and (k,) its number: image, row and column.

    Of points with the same pixel the first one gets it.
    """
    height = len(grid.inclination)
    azimuth = np.arctan2(table["y"], table["x"]).astype(float)
    image = table.get("echo", np.ones(len(azimuth), np.int64)).astype(np.int64) - 1
    ring = table["ring"].astype(np.int64)
    place = (image * height + height - 1 - ring) * grid.width + grid.column(azimuth)
    fits = np.flatnonzero((image < RETURNS) & (ring < height))
    pixel, first = np.unique(place[fits], return_index=True)
    return fits[first], pixel


def range_images(
    grid: RangeImageGrid, trajectory: Trajectory, *, row: int, boxes: Iterable[Mapping[str, Any]] | None
) -> tuple[dict[str, Row], int]:
    """Range, pose and label images of a frame by component, and the number of points left out.

    row   : of the scanner's stream
    boxes : of the frame, which give the numbers of road users; None for no labels
    """
    stream = grid.stream
    table = cloud_points(stream.files[row])
    total = len(table["x"])
    kept, pixel = pixels(grid, table)
    table = {name: column[kept] for name, column in table.items()}
    size = len(grid.inclination) * grid.width
    points = np.column_stack([table[axis] for axis in "xyz"]).astype(float)
    distance = np.linalg.norm(points, axis=1)
    values = np.full((RETURNS * size, 4), _EMPTY, np.float32)
    values[pixel] = np.column_stack(
        [distance, table["intensity"] / 255, np.zeros_like(distance), np.full_like(distance, _EMPTY)]
    )
    inclination = grid.inclination[table["ring"].astype(np.int64)]
    azimuth = grid.azimuth(pixel % grid.width)
    level = np.cos(inclination)
    ray = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(inclination)])
    poses = trajectory.at(int(stream.time_ns[row]) + table["time_ns"].astype(np.int64))
    off = (points - ray * distance[:, None]) @ stream.mount.rotation.T
    place = poses.position / poses.scale + np.einsum("nij,nj->ni", poses.rotation, off)
    turned = euler_from_quat(quat_from_matrix(poses.rotation))
    pose = np.zeros((RETURNS * size, 6), np.float32)
    pose[pixel] = np.column_stack([turned, place])
    pose[:size] = np.where(values[:size, :1] > 0, pose[:size], pose[size:])
    shape = [len(grid.inclination), grid.width]
    images = {
        "lidar": _images(values, shape=shape),
        "lidar_pose": _images(pose[:size], shape=shape, returns=1),
    }
    if boxes is not None:
        labels = recorded_labels(table, boxes)
        segments = np.zeros((RETURNS * size, 2), np.int32)
        segments[pixel] = np.column_stack([labels.road_user, class_codes().waymo[labels.klass]])
        images["lidar_segmentation"] = _images(segments, shape=shape)
    return images, total - len(kept)


def _images(values: NDArray[Any], *, shape: Sequence[int], returns: int = RETURNS) -> Row:
    """Columns of range images, one after the other in (pixels, channels)."""
    row: Row = {}
    for number, part in enumerate(np.split(values, returns)):
        row[f"range_image_return{number + 1}.values"] = part.ravel()
        row[f"range_image_return{number + 1}.shape"] = [*shape, values.shape[1]]
    return row


def laser_calibration(grid: RangeImageGrid) -> Row:
    """The calibration of a scanner."""
    return {
        "laser_name": grid.number,
        "extrinsic.transform": grid.stream.mount.matrix.ravel(),
        "beam_inclination.min": float(grid.inclination[0]),
        "beam_inclination.max": float(grid.inclination[-1]),
        "beam_inclination.values": grid.inclination,
    }
