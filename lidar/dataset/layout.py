"""A dataset on disk: names and reading of its files.

DATASET/
  dataset.json            schema, scene, rig, options, seed, frames, licence; updated last
  poses.csv               the vehicle at each frame's start
  trajectory.csv          the vehicle at 100 Hz; points are placed with it
  calibration.json        mounts and intrinsics of every sensor
  gnss.csv, imu.csv       measured, by the receivers' and units' names
  boxes.csv               road users in 3D, at the frames of the first scanner
  frames.csv              finished frames, with their points and digests of their files
  checksums.sha256        checksums of all other files
  <sensor>/<format>/<frame>.<ext>
  <camera>/signals.csv    states of traffic lights in images
  <sensor>/truth/<frame>.npz  changes by stages; only with stages
  integrity/              digests and the signature of `lidar sign`
"""

from __future__ import annotations

import csv
import json
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from geoscene.errors import reading, schema_fault
from geoscene.geometry.frames import Frame
from geoscene.support.digests import digest
from geoscene.support.files import delete_leftovers, write_json
from geoscene.support.option_values import brief, listed
from geoscene.support.progress import Progress, silent
from geoscene.support.registry import Previewed
from geoscene.support.storage import StoredFolder, cache_folder, url_of
from geoscene.typing import Ints
from lidar.dataset.checksums import CHECKSUMS, differences, read_checksums
from lidar.dataset.formats import Format
from lidar.errors import DatasetError, InputError, LidarError
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_files import MANIFEST, read_trajectory
from lidar.sensors.rig.names import names_folder
from lidar.sensors.rig.specs import Rig, rig_of

log = logging.getLogger(__name__)

SCHEMA = 1
"""Version of the dataset directory; a reader refuses others."""

_DEPTH_OF_TABLES = 2
"""Files in a dataset and in its sensors' folders are not of single frames."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Files of the dataset directory ``root``."""

    root: Path

    @property
    def manifest(self) -> Path:
        """Schema, scene, rig, options, seed, frames and licence; updated last."""
        return self.root / MANIFEST

    @property
    def journal(self) -> Path:
        """Finished frames with their points and digests; a drive that is resumed verifies them."""
        return self.root / "frames.csv"

    @property
    def checksums(self) -> Path:
        """Checksums of all other files; written when the dataset is complete."""
        return self.root / CHECKSUMS

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

    def measurements_truth(self, name: str) -> Path:
        """Ground truth of stages on the measurements of a GNSS receiver or an inertial unit."""
        return self.measurements(name, ".truth.csv")

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

    def sensor_signals(self, name: str) -> Path:
        """Signal heads in all frames of a camera."""
        return self.root / name / "signals.csv"

    def frame_signals(self, name: str, frame: int) -> Path:
        """Signal heads in one frame of a camera."""
        return self.root / name / "signals" / f"{frame:06d}.csv"

    def image(self, name: str, frame: int, *, kind: str) -> Path:
        """An image of a camera: ``rgb``, ``depth``, ``semantic``, ``instance`` or ``flow``."""
        return self.root / name / kind / f"{frame:06d}.png"

    @property
    def integrity(self) -> Path:
        """Folder of digests and the signature of a signed dataset."""
        return self.root / "integrity"

    @property
    def chain(self) -> Path:
        """The signature; written last."""
        return self.integrity / "chain.json"

    def truth(self, name: str, frame: int) -> Path:
        """Ground truth of stages on a frame of a sensor."""
        return self.root / name / "truth" / f"{frame:06d}.npz"

    def deskewed(self, name: str, frame: int, *, suffix: str) -> Path:
        """A de-skewed cloud of a scanner."""
        return self.root / name / "deskewed" / f"{frame:06d}{suffix}"


@dataclass(frozen=True)
class Dataset(Previewed):
    """An opened dataset directory.

    path     : the directory, or the cache of one in object storage
    manifest : the document ``dataset.json``
    stored   : the directory in object storage, if it is there
    """

    path: Path
    manifest: dict[str, Any]
    stored: StoredFolder | None = None
    _fetched: set[Path] = field(default_factory=set, repr=False, compare=False)

    def __repr__(self) -> str:
        """What the drive is and recorded, in a few lines."""
        about = self.manifest
        done, frames = about.get("frames_done", 0), about.get("frames", 0)
        parts = [f"{done:,} of {frames:,} frames" if done != frames else f"{frames:,} frames"]
        parts += [f"{about.get('duration_ns', 0) / 1e9:.1f} s", f"{about.get('length_m', 0):,.0f} m"]
        scene, points = about.get("scene", {}), about.get("points", {})
        of = {name: f"{count:,} frames" for name, count in about.get("sensor_frames", {}).items()}
        of |= {name: f"{of.get(name, '')}, {count:,} points".lstrip(", ") for name, count in points.items()}
        lines = [f"Dataset {self.path if self.stored is None else self.stored.name}: {', '.join(parts)}"]
        lines.append(f"  rig {about.get('rig', '')}, scene {scene.get('name') or scene.get('path', '')}")
        lines.append(f"  start {about.get('start_time', '')}")
        return "\n".join([*lines, *(f"  {name}: {text}" for name, text in of.items())])

    def __fspath__(self) -> str:
        """The directory, so that a dataset can be given for its path."""
        return str(self.path)

    @property
    def frame(self) -> Frame:
        """The scene frame that poses are in."""
        return Frame.from_json(self.manifest["frame"])

    @property
    def scene_path(self) -> Path:
        """The scene's URL or folder as it was given for the drive, or in the dataset's parent."""
        given = Path(self.manifest["scene"]["path"])
        return given if url_of(given) or given.exists() else self.path.resolve().parent / given

    @property
    def start(self) -> datetime:
        """UTC time of the drive's start."""
        return datetime.fromisoformat(self.manifest["start_time"])

    def microseconds(self, time_ns: int) -> int:
        """Microseconds since 1970 of a time since the drive's start."""
        return round(self.start.timestamp() * 1e6) + time_ns // 1000

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
        return read_sensors(self.paths, *kinds)

    def sample_times(self, name: str) -> Ints:
        """Times (n,) of a sensor's measurements or frame starts, nanoseconds since the drive's start.

        Raises DatasetError if the drive has not written them.
        """
        frames = self.sensors()[name]["kind"] in ("lidar", "camera")
        path = self.paths.timestamps(name) if frames else self.paths.measurements(name)
        with reading_file(path), opened_rows(path) as rows:
            times = np.fromiter((int(row["time_ns"]) for row in rows), np.int64)
            if (np.diff(times) <= 0).any() or (times < 0).any():
                raise DatasetError(f"{path}: damaged (times do not increase); drive again with `overwrite`")
            if not len(times) and self.manifest.get("sensor_frames", {}).get(name):
                raise DatasetError(f"{path}: damaged (no times of its frames); drive again with `overwrite`")
        return times

    def rig(self) -> Rig:
        """The rig, with sensors and mounts; raises InputError if its files are not as they were."""
        with reading_file(self.paths.manifest):
            return rig_of(str(self.manifest["recipe"]["rig"]))

    def trajectory(self) -> Trajectory:
        """The ego vehicle's poses."""
        return read_trajectory(self.paths.trajectory)

    def files(self, sensor: str, form: Format) -> Iterator[tuple[int, Path]]:
        """(frame number, path) of a sensor's clouds of one format, in order."""
        folder = self.paths.sensor(sensor)
        for frame in frame_numbers(self.frame_file(form.path(folder, 0)).parent, form.suffix).tolist():
            yield frame, form.path(folder, frame)

    def fetch(self, progress: Progress) -> None:
        """Fetch all files of a dataset in storage; of others nothing."""
        if self.stored is not None:
            self.stored.mirror(self.path, progress=progress)

    def frame_file(self, path: Path) -> Path:
        """The path of a file of a frame; of a dataset in storage, its folder is fetched first."""
        folder = path.parent
        if self.stored is not None and folder not in self._fetched:
            StoredFolder(f"{self.stored.url}/{folder.relative_to(self.path).as_posix()}").mirror(folder)
            self._fetched.add(folder)
        return path


DatasetLike = str | os.PathLike[str]
"""Directory or URL of a dataset, or an opened one."""


def is_dataset(path: DatasetLike) -> bool:
    """Whether a place is to be opened as a dataset: a URL, or a folder with a manifest.

    Raises InputError for what is no place.
    """
    _check_place(path)
    return bool(url_of(path)) or Paths(Path(path)).manifest.exists()


def _check_place(path: DatasetLike) -> None:
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"`dataset` {brief(path)}: give the directory or URL of a dataset, or an opened one")


def open_dataset(path: DatasetLike) -> Dataset:
    """Open a dataset directory, finished or not, or one at a URL; opened ones pass.

    Files at a URL are fetched into the user's cache: tables now, folders of frames when they are read.

    Raises DatasetError if it is not a dataset or has another schema version, and StorageError if the storage
    cannot be reached or has no dataset there.
    """
    if isinstance(path, Dataset):
        return path
    _check_place(path)
    folder, stored = Path(path), None
    if url := url_of(path):
        stored, folder = StoredFolder(url), cache_folder() / "datasets" / digest(url.encode())
        stored.read(MANIFEST)
        stored.mirror(folder, depth=_DEPTH_OF_TABLES)
    manifest_path = Paths(folder).manifest
    if not manifest_path.exists():
        raise DatasetError(f"{folder}: no dataset.json in it; lidar drive records a dataset")
    with reading_file(manifest_path):
        manifest = json.loads(manifest_path.read_text("utf-8-sig"))
        schema = manifest["schema"]
        if schema != SCHEMA:
            raise DatasetError(f"{folder}: {schema_fault(schema, reads=SCHEMA, remedy='drive again')}")
        dataset = Dataset(folder, manifest, stored)
        _ = dataset.frame, dataset.start, dataset.crs, dataset.frames, int(manifest["frames_done"])
        _ = dataset.scene_path
        if not isinstance(manifest["recipe"], dict):
            raise DatasetError(f"{manifest_path}: damaged (no recipe); drive again with `overwrite`")
        for counts in (manifest.get(name, {}) for name in ("sensor_frames", "points")):
            if not all(isinstance(count, int) for count in counts.values()):
                raise ValueError("counts that are no whole numbers")
    return dataset


def opened_datasets(datasets: DatasetLike | Sequence[DatasetLike]) -> list[Dataset]:
    """One or several datasets, opened; raises InputError for none, and as `open_dataset` does."""
    given = [datasets] if isinstance(datasets, str | os.PathLike) else listed(datasets)
    if not given:
        raise InputError("`datasets`: give one or more directories that lidar drive wrote")
    return [open_dataset(one) for one in given]


def reading_file(path: Path) -> AbstractContextManager[None]:
    """Raises errors of the block, which reads a file of a dataset, as DatasetErrors that name the file."""
    return reading(path, DatasetError, remedy="drive again with `overwrite`", known=LidarError)


def frame_numbers(folder: Path, suffix: str) -> Ints:
    """Numbers (n,) of the frames that have a file in a folder, rising; none without the folder."""
    if not folder.is_dir():
        return np.empty(0, np.int64)
    with os.scandir(folder) as entries:
        stems = (entry.name.removesuffix(suffix) for entry in entries if entry.name.endswith(suffix))
        numbers = np.fromiter((int(s) for s in stems if s.isdecimal() and s == f"{int(s):06d}"), np.int64)
    return np.sort(numbers)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a dataset's CSV file.

    Raises DatasetError if it cannot be read.
    """
    with opened_rows(path) as rows:
        return list(rows)


@contextmanager
def opened_rows(path: Path) -> Iterator[Iterator[dict[str, str]]]:
    """Yield the rows of a dataset's CSV file, of which one at a time is in memory.

    Raises DatasetError if it cannot be read.
    """
    remedy = "was the drive finished?"
    with (
        reading(path, DatasetError, remedy=remedy, known=LidarError),
        path.open(newline="", encoding="utf-8-sig") as file,
    ):
        file.seek(max(path.stat().st_size - 1, 0))
        last = file.read()
        file.seek(0)
        rows = csv.DictReader(file, strict=True)
        if not rows.fieldnames:
            raise ValueError("no line with the names of columns")
        if last != "\n":
            raise ValueError("ends within a line")
        yield rows


def read_sensors(paths: Paths, *kinds: str) -> dict[str, dict[str, Any]]:
    """Entries of ``calibration.json`` by name, of sensors of some kinds, all by default.

    Raises DatasetError for a file that is missing or damaged.
    """
    with reading_file(paths.calibration):
        sensors = json.loads(paths.calibration.read_text("utf-8-sig"))["sensors"]
        found = {name: sensor for name, sensor in sensors.items() if not kinds or sensor["kind"] in kinds}
        for name, sensor in found.items():
            if not names_folder(name):
                raise ValueError(f"the name {name!r} of a sensor is none of a folder")
            mount = np.array(sensor["vehicle_from_sensor"], float)
            turn = mount[:3, :3]
            if mount.shape != (4, 4) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6):
                raise ValueError("a mount is no rigid transformation")
            if np.linalg.det(turn) < 0:
                raise ValueError(f"the mount of {name} mirrors: its determinant is -1")
            if not np.isfinite(mount).all():
                raise ValueError("a mount is not finite")
            if sensor["kind"] in ("lidar", "camera"):
                _ = float(sensor["rate_hz"]), int(sensor["time_offset_ns"])
    return found


def prepare(path: Path, recipe: Mapping[str, Any], *, overwrite: bool) -> int:
    """Prepare a directory for a drive made by ``recipe``; return the number of frames that are complete.

    A drive of the same recipe is kept and can be resumed. With ``overwrite`` any drive is deleted, and files
    that are not of a dataset are kept.

    Raises DatasetError for a drive of another recipe without ``overwrite``, and for a directory that is
    neither empty nor a dataset.
    """
    manifest_path = Paths(path).manifest
    if path.exists() and not path.is_dir():
        raise DatasetError(f"{path}: is a file; give a directory")
    if path.exists():  # a drive may have been killed when it wrote its first file
        delete_leftovers(path, stem=manifest_path.stem, below=False)
    if not path.exists() or not any(path.iterdir()):
        path.mkdir(parents=True, exist_ok=True)
        return 0
    if not manifest_path.exists():
        raise DatasetError(f"{path}: is not empty and not a dataset; give another directory")
    if overwrite:
        remove_dataset(path)
        return 0
    manifest = open_dataset(path).manifest
    if changed := _changed(manifest["recipe"], recipe):
        changes = ", ".join(f"{name} {_text(old)} (now {_text(new)})" for name, (old, new) in changed.items())
        raise DatasetError(
            f"{path}: holds a drive made with other options: {changes};"
            " set `overwrite` to replace it, or give another directory"
        )
    delete_leftovers(path)
    return int(manifest["frames_done"])


def _changed(old: Mapping[str, Any], recipe: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Former and new values of options that differ between the recipe of a manifest and another one."""
    new = json.loads(json.dumps(recipe))
    return {key: (old.get(key), new.get(key)) for key in {**old, **new} if old.get(key) != new.get(key)}


def finished(path: Path, recipe: Mapping[str, Any], *, progress: Progress = silent) -> Dataset | None:
    """The dataset of a finished drive made by ``recipe`` if all its files are as they were written."""
    paths = Paths(path)
    if not (paths.manifest.is_file() and paths.checksums.is_file()):
        return None
    dataset = open_dataset(path)
    manifest = dataset.manifest
    if not manifest["frames_done"] == manifest["frames"] > 0 or _changed(manifest["recipe"], recipe):
        return None
    own = own_files(path)
    for found in differences(path, read_checksums(paths.checksums), progress=progress):
        if found.what != "added" or own(found.name):
            return None
    return dataset


def remove_dataset(path: Path) -> None:
    """Delete the files of a dataset, its manifest last; files of others are kept, with a warning for each.

    If it is killed meanwhile, the manifest states a drive that was not finished.
    """
    paths = Paths(path)
    if paths.manifest.exists():
        with suppress(DatasetError):
            write_json(paths.manifest, open_dataset(path).manifest | {"frames_done": 0})
    own, (sensors, _) = own_files(path), _own_names(paths)
    last = paths.chain, paths.calibration, paths.manifest  # they tell which files are of the dataset
    folders: list[Path] = []
    for entry in sorted(path.rglob("*")):
        name = entry.relative_to(path)
        if entry.is_dir() and not entry.is_symlink():
            folders += [entry] if name.parts[0] in (*sensors, paths.integrity.name) else []
        elif not own(name.as_posix()):
            log.warning("%s: kept, though not of the dataset", entry)
        elif entry not in last:
            entry.unlink()
    for entry in last:
        if own(entry.relative_to(path).as_posix()):
            entry.unlink(missing_ok=True)
        for folder in reversed(folders):
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()


def own_files(path: Path) -> Callable[[str], bool]:
    """Whether a path relative to a dataset is that of a file which drives write."""
    sensors, top = _own_names(Paths(path))
    signed = Paths(path).chain.is_file()

    def own(name: str) -> bool:
        place = Path(name).parts
        if signed and place[0] == Paths(path).integrity.name:
            return True
        return path / name in top or (len(place) > 1 and place[0] in sensors and _of_a_sensor(place[1:]))

    return own


def _own_names(paths: Paths) -> tuple[set[str], set[Path]]:
    """Names of the sensors of a dataset, and its files outside of their folders."""
    sensors: set[str] = set()
    with suppress(DatasetError):
        sensors = set(read_sensors(paths))
    top = {paths.calibration, paths.trajectory, paths.poses, paths.boxes, paths.journal, paths.manifest}
    top.add(paths.checksums)
    top |= {
        paths.measurements(name, suffix) for name in sensors for suffix in (".csv", ".nmea", ".truth.csv")
    }
    return sensors, top


_FRAME_FILE = re.compile(r"\d{6,}[._][\w.]+")
_SENSOR_FILES = {"timestamps.csv", "boxes.csv", "signals.csv", "calib.txt", "times.txt", "poses.txt"}


def _of_a_sensor(place: Sequence[str]) -> bool:
    """Whether names below a sensor's folder are those of a dataset's file."""
    return place[0] in _SENSOR_FILES if len(place) == 1 else bool(_FRAME_FILE.fullmatch(place[-1]))


def _text(value: Any) -> str:
    """A short text of a recipe's value."""
    if isinstance(value, list) and all(isinstance(v, str) for v in value):
        value = ",".join(value)
    text = "none" if value in (None, "", []) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
