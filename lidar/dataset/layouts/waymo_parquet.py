"""Parquet files of components of the Waymo Open Dataset 2: names and types of their columns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Self

from geoscene.errors import need

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
