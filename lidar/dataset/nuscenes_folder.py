"""Key frames of datasets in nuScenes' layout that other programs wrote."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.errors import reading
from geoscene.typing import Float
from lidar.errors import FormatError
from lidar.geometry.attitude import matrix_from_quat

TOP = "LIDAR_TOP"
"""Channel of the scanner whose clouds have boxes."""

_UNIT = 1e-3
"""Largest difference of a quaternion's length from 1."""


@dataclass(frozen=True, slots=True)
class KeyCloud:
    """The cloud of a key frame.

    token             : of the sample
    path              : of the cloud
    global_from_lidar : (4, 4) from the scanner's frame to that of the tables, metres
    """

    token: str
    path: Path
    global_from_lidar: Float


def key_clouds(folder: Path) -> list[KeyCloud]:
    """The clouds of `TOP` at the key frames, in order of samples; none without tables.

    Raises FormatError for damaged tables and for a cloud of theirs that is missing.
    """
    return [cloud for path in sorted(folder.glob("v1.0-*/sample.json")) for cloud in _clouds(path.parent)]


def _clouds(tables: Path) -> Iterator[KeyCloud]:
    samples, sensors = (_Table.read(tables, name) for name in ("sample", "sensor"))
    calibrated, poses, data = (
        _Table.read(tables, name) for name in ("calibrated_sensor", "ego_pose", "sample_data")
    )
    for token in calibrated.rows:
        calibrated.check_intrinsics(token)
    with samples.reading():
        for token, row in samples.rows.items():
            after = row["next"]
            if after and samples.rows[after]["timestamp"] <= row["timestamp"]:
                raise FormatError(f"{samples.path}: sample {after} is not later than {token} before it")
    with data.reading(), calibrated.reading(), sensors.reading():
        tops = {
            token
            for token, row in calibrated.rows.items()
            if sensors.rows[row["sensor_token"]]["channel"] == TOP
        }
        found = {
            str(row["sample_token"]): row
            for row in data.rows.values()
            if row["is_key_frame"] and row["calibrated_sensor_token"] in tops
        }
        for token in samples.rows:
            if token not in found:
                raise FormatError(f"{data.path}: sample {token} has no cloud of {TOP}")
            row = found[token]
            path = tables.parent / str(row["filename"])
            if not path.is_file():
                raise FormatError(f"{path}: is missing; {data.path} names it")
            placed = poses.pose(row["ego_pose_token"]) @ calibrated.pose(row["calibrated_sensor_token"])
            yield KeyCloud(token, path, placed)


@dataclass(frozen=True, slots=True)
class _Table:
    """The rows of a table by token."""

    path: Path
    rows: dict[str, dict[str, Any]]

    @staticmethod
    def read(tables: Path, name: str) -> _Table:
        path = tables / f"{name}.json"
        with _reading(path):
            return _Table(path, {row["token"]: row for row in json.loads(path.read_text("utf-8-sig"))})

    def reading(self) -> AbstractContextManager[None]:
        """Raises errors of the block as those of the table."""
        return _reading(self.path)

    def pose(self, token: str) -> Float:
        """The transformation (4, 4) of a row with rotation (w, x, y, z) and translation."""
        with self.reading():
            row = self.rows[token]
            quat, place = np.array(row["rotation"], float), np.array(row["translation"], float)
            if quat.shape != (4,) or not abs(np.linalg.norm(quat) - 1) < _UNIT:
                raise FormatError(f"{self.path}: the rotation of {token} is no unit quaternion")
            if place.shape != (3,) or not np.isfinite(place).all():
                raise FormatError(f"{self.path}: the translation of {token} is no place")
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = matrix_from_quat(quat[[1, 2, 3, 0]]), place
            return pose

    def check_intrinsics(self, token: str) -> None:
        """Raise FormatError for intrinsics of a camera that are no finite matrix (3, 3)."""
        with self.reading():
            matrix = np.array(self.rows[token]["camera_intrinsic"], float)
            if matrix.size and not (matrix.shape == (3, 3) and np.isfinite(matrix).all()):
                raise FormatError(f"{self.path}: the intrinsics of {token} are no finite 3 x 3 matrix")


def _reading(path: Path) -> AbstractContextManager[None]:
    return reading(path, FormatError, remedy="give nuScenes' tables", known=FormatError)
