"""A dataset on disk: names and reading of its files.

DATASET/
  dataset.json            schema, scene, rig, options, seed, frames, licence; updated last
  poses.csv               the vehicle at each frame's start
  trajectory.csv          the vehicle at 100 Hz; points are placed with it
  calibration.json        mounts and intrinsics of every sensor
  gnss.csv, imu.csv       measured, by the receivers' and units' names
  boxes.csv               road users in 3D, at the frames of the first scanner
  <sensor>/<format>/<frame>.<ext>
  <sensor>/truth/<frame>.npz  changes by stages; only with stages
"""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from geoscene.frames import Frame
from lidar.dataset.formats import Format
from lidar.errors import DatasetError
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_csv import MANIFEST, read_trajectory

SCHEMA = 1
"""Version of the dataset directory; a reader refuses others."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Files of the dataset directory ``root``."""

    root: Path

    @property
    def manifest(self) -> Path:
        """Schema, scene, rig, options, seed, frames and licence; updated last."""
        return self.root / MANIFEST

    @property
    def calibration(self) -> Path:
        """Mounts and intrinsics of all sensors."""
        return self.root / "calibration.json"

    @property
    def trajectory(self) -> Path:
        """The ego vehicle at 100 Hz."""
        return self.root / "trajectory.csv"

    @property
    def poses(self) -> Path:
        """The ego vehicle at the start of each frame of the first sensor."""
        return self.root / "poses.csv"

    @property
    def boxes(self) -> Path:
        """3D boxes at the frames of the first scanner."""
        return self.root / "boxes.csv"

    def measurements(self, name: str, suffix: str = ".csv") -> Path:
        """Measurements of a GNSS receiver (also ``.nmea``) or an inertial unit."""
        return self.root / f"{name}{suffix}"

    def sensor(self, name: str) -> Path:
        """Folder of a scanner or camera."""
        return self.root / name

    def timestamps(self, name: str) -> Path:
        """Start times of a sensor's frames."""
        return self.root / name / "timestamps.csv"

    def sensor_boxes(self, name: str) -> Path:
        """Boxes of all frames of a sensor."""
        return self.root / name / "boxes.csv"

    def frame_boxes(self, name: str, frame: int) -> Path:
        """Boxes of one frame of a sensor."""
        return self.root / name / "boxes" / f"{frame:06d}.csv"

    def image(self, name: str, frame: int, *, kind: str) -> Path:
        """An image of a camera: ``rgb``, ``depth``, ``semantic``, ``instance`` or ``flow``."""
        return self.root / name / kind / f"{frame:06d}.png"

    def truth(self, name: str, frame: int) -> Path:
        """What stages did to a frame of a sensor."""
        return self.root / name / "truth" / f"{frame:06d}.npz"

    def deskewed(self, name: str, frame: int, *, suffix: str) -> Path:
        """A de-skewed cloud of a scanner."""
        return self.root / name / "deskewed" / f"{frame:06d}{suffix}"


@dataclass(frozen=True)
class Dataset:
    """An opened dataset directory.

    path     : the directory
    manifest : the document ``dataset.json``
    """

    path: Path
    manifest: dict[str, Any]

    @property
    def frame(self) -> Frame:
        """The scene frame that poses are in."""
        return Frame.from_json(self.manifest["frame"])

    @property
    def start(self) -> datetime:
        """UTC time of the drive's start."""
        return datetime.fromisoformat(self.manifest["start_time"])

    @property
    def crs(self) -> CRS:
        """The CRS of LAZ files."""
        return CRS.from_user_input(self.manifest["export_crs"])

    @property
    def frames(self) -> int:
        """Number of frames of the whole drive."""
        return int(self.manifest["frames"])

    @property
    def paths(self) -> Paths:
        """The dataset's files."""
        return Paths(self.path)

    def sensors(self, *kinds: str) -> dict[str, dict[str, Any]]:
        """Entries of ``calibration.json`` by name, of sensors of some kinds (lidar, camera, gnss, imu)."""
        sensors = json.loads(self.paths.calibration.read_text("utf-8"))["sensors"]
        return {name: sensor for name, sensor in sensors.items() if not kinds or sensor["kind"] in kinds}

    def sample_times(self, name: str) -> NDArray[np.int64]:
        """Times (n,) of a sensor's measurements or frame starts, nanoseconds since the drive's start.

        Raises DatasetError if the drive has not written them.
        """
        frames = self.sensors()[name]["kind"] in ("lidar", "camera")
        rows = read_rows(self.paths.timestamps(name) if frames else self.paths.measurements(name))
        return np.array([int(row["time_ns"]) for row in rows], np.int64)

    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return read_trajectory(self.paths.trajectory)

    def files(self, sensor: str, form: Format) -> Iterator[tuple[int, Path]]:
        """(frame number, path) of a sensor's clouds of one format, in order."""
        for path in sorted(form.path(self.paths.sensor(sensor), 0).parent.glob(f"*{form.suffix}")):
            if (number := path.name.removesuffix(form.suffix)).isdigit():
                yield int(number), path


def open_dataset(path: str | Path) -> Dataset:
    """Open a dataset directory, finished or not.

    Raises DatasetError if it is not a dataset or has another schema version.
    """
    folder = Path(path)
    manifest_path = Paths(folder).manifest
    if not manifest_path.exists():
        raise DatasetError(f"{folder}: no dataset.json in it; lidar drive records a dataset")
    try:
        manifest = json.loads(manifest_path.read_text("utf-8"))
        schema = manifest["schema"]
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{manifest_path}: damaged ({error})") from error
    if schema != SCHEMA:
        raise DatasetError(f"{folder}: schema version {schema}, this program reads {SCHEMA}; drive again")
    return Dataset(folder, manifest)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a dataset's CSV file.

    Raises DatasetError if it cannot be read.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}; was the drive finished?") from error


def prepare(path: Path, recipe: Mapping[str, Any], *, overwrite: bool) -> int:
    """Prepare a directory for a drive made by ``recipe``; return the number of frames that are complete.

    A drive of the same recipe is kept and can be resumed. A drive of another recipe is deleted with
    ``overwrite``.

    Raises DatasetError for a drive of another recipe without ``overwrite``, and for a directory that is
    neither empty nor a dataset.
    """
    manifest_path = Paths(path).manifest
    if path.exists() and not path.is_dir():
        raise DatasetError(f"{path}: is a file; give a directory")
    if not path.exists() or not any(path.iterdir()):
        path.mkdir(parents=True, exist_ok=True)
        return 0
    if not manifest_path.exists():
        raise DatasetError(f"{path}: is not empty and not a dataset; give another directory")
    if overwrite:
        shutil.rmtree(path)
        path.mkdir(parents=True)
        return 0
    manifest = open_dataset(path).manifest
    old, new = manifest["recipe"], json.loads(json.dumps(recipe))
    changed = [k for k in old | new if old.get(k) != new.get(k)]
    if changed:
        changes = ", ".join(f"{k} {_text(old.get(k))} (now {_text(new.get(k))})" for k in changed)
        raise DatasetError(
            f"{path}: holds a drive made with other options: {changes};"
            " set `overwrite` to replace it, or give another directory"
        )
    for left in path.rglob("*.part"):  # of a drive that was killed
        left.unlink()
    return int(manifest["frames_done"])


def _text(value: Any) -> str:
    """A short text of a recipe's value."""
    if isinstance(value, list) and all(isinstance(v, str) for v in value):
        value = ",".join(value)
    text = "none" if value in (None, "", []) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
