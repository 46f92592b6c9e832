"""Tampers with recorded files: frames replaced by those of another time or drive, and shifted time stamps."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.csv_tables import write_columns
from lidar.dataset.derived import check_target, complete_folder, copy_folder
from lidar.dataset.formats import FORMATS, LABELS, read_table
from lidar.dataset.formats.table import table_cloud
from lidar.dataset.layout import Dataset, Paths, open_dataset, read_rows, reading_file
from lidar.dataset.signable import signed_files
from lidar.dataset.truth_files import read_truth
from lidar.errors import InputError
from lidar.geometry.time_scales import iso_times
from lidar.sensors.camera.png import read_png
from lidar.signal.run import changed_pixels, cloud_truth, trace_unaltered, write_truth

TRUTH = "tamper.truth.csv"
"""File of a tampered dataset that tells what was done; not for defences."""

_LABELS = {row.folder for row in LABELS.values()}
_DATA = {"deskewed", "rgb", *(form.folder or form.name for form in FORMATS.values()), *_LABELS}
"""Folders of a sensor whose files are measurements; boxes, depth and classes stay those of the true world."""

_REPLACED = re.compile(r"([^:=]+):(\d+)(?:-(\d+))?=(\d+)")
_SHIFTED = re.compile(r"([^:=]+)=([-+]?[0-9.]+(?:[eE][-+]?\d+)?)")


@dataclass(frozen=True)
class Replacement:
    """Frames of a sensor that are replaced by others, which start with frame ``source``."""

    sensor: str
    first: int
    last: int
    source: int


def read_replacement(text: str) -> Replacement:
    """A replacement from a text ``SENSOR:FIRST-LAST=SOURCE`` or ``SENSOR:FRAME=SOURCE``.

    Raises InputError for another text.
    """
    found = _REPLACED.fullmatch(text.strip())
    if not found:
        raise InputError(f"`replace` {text}: give SENSOR:FIRST-LAST=SOURCE, such as lidar_top:10-19=0")
    first, last = int(found[2]), int(found[3] or found[2])
    if last < first:
        raise InputError(f"`replace` {text}: frame {last} is before frame {first}")
    return Replacement(found[1], first, last, int(found[4]))


def read_shift(text: str) -> tuple[str, int]:
    """Sensor and nanoseconds of a text ``SENSOR=SECONDS``; raises InputError for another text."""
    found = _SHIFTED.fullmatch(text.strip())
    seconds = float(found[2]) if found and found[2].count(".") < 2 and found[2] != "." else np.nan
    if not found or not abs(seconds) < 1e6:
        raise InputError(f"`shift` {text}: give SENSOR=SECONDS, such as camera_front=0.1")
    return found[1], round(seconds * 1e9)


@dataclass(frozen=True, slots=True)
class TamperSummary:
    """What was done.

    files  : that were replaced
    shifts : nanoseconds by which time stamps were shifted, by sensor
    """

    path: Path
    files: int
    shifts: dict[str, int]


def tamper(
    source: str | Path,
    out: str | Path,
    *,
    replacements: Sequence[Replacement] = (),
    by: str | Path = "",
    freeze: bool = False,
    shifts: Iterable[tuple[str, int]] = (),
    overwrite: bool = False,
) -> TamperSummary:
    """Write a dataset with other files in the place of some, and shifted time stamps, to ``out``.

    by     : dataset that the other frames are taken from; the dataset itself by default
    freeze : repeat the first of the other frames
    shifts : sensor and nanoseconds; its frames or samples carry later time stamps

    The truth is in `TRUTH`; what stages did to a frame (``truth/``) goes along with its files. Raises
    InputError and DatasetError for frames or sensors that there are not, and InputError for those that are
    given twice.
    """
    source, out, moved = Path(source), Path(out), dict[str, int]()
    for name, shift in shifts:
        if name in moved:
            raise InputError(f"`shift`: {name} is given twice")
        moved[name] = shift
    if not replacements and not moved:
        raise InputError("give `replace`, `shift` or both")
    check_target(out, source=source, overwrite=overwrite)
    dataset = open_dataset(source)
    other = open_dataset(by) if str(by) else dataset
    copies = _copies(dataset, other, replacements=replacements, freeze=freeze)
    stamps = {name: _shift(dataset, name, shift_ns=shift) for name, shift in moved.items()}
    rows = [("replaced", name, path.as_posix(), 0) for name, path in copies.items()]
    rows += [("shifted", path, "", moved[name]) for name, (path, _) in stamps.items()]
    with complete_folder(out) as part:
        copy_folder(dataset.path, part)
        for name, path in copies.items():
            shutil.copyfile(path, part / name)
        for place, truth in _truths(dataset, other, copies=copies):
            (part / place).parent.mkdir(parents=True, exist_ok=True)
            write_truth(part / place, truth)
        for table, columns in stamps.values():
            write_columns(part / table, columns)
        names = ("what", "file", "source", "shift_ns")
        write_columns(
            part / TRUTH, {name: list(c) for name, c in zip(names, zip(*rows, strict=True), strict=True)}
        )
    return TamperSummary(out, len(copies), moved)


def _copies(
    dataset: Dataset, other: Dataset, *, replacements: Sequence[Replacement], freeze: bool
) -> dict[str, Path]:
    """Files of another dataset by the paths, in this one, of those that they replace."""
    files, found = signed_files(dataset), dict[str, Path]()
    for one in replacements:
        if one.sensor not in files.frames:
            raise InputError(f"`replace`: no sensor {one.sensor!r}; there are {', '.join(files.frames)}")
        for frame in range(one.first, one.last + 1):
            taken = one.source if freeze else one.source + frame - one.first
            names = [n for n in files.frames[one.sensor].get(frame, []) if Path(n).parts[1] in _DATA]
            if not names:
                raise InputError(f"`replace`: {dataset.path} has no frame {frame} of {one.sensor}")
            for name in names:
                if name in found:
                    raise InputError(f"`replace`: frame {frame} of {one.sensor} is given twice")
                stem = Path(name).name.removeprefix(f"{frame:06d}")
                path = other.path / Path(name).with_name(f"{taken:06d}{stem}")
                if not path.is_file():
                    raise InputError(f"`replace`: {path} is missing; give other frames or another `by`")
                found[name] = path
    return found


def _truths(
    dataset: Dataset, other: Dataset, *, copies: Mapping[str, Path]
) -> Iterator[tuple[Path, dict[str, NDArray[Any]]]]:
    """Paths, in this dataset, and columns of the truth of the stages that acted on frames put into it.

    A frame that no stage has changed gets a truth file, which says so, where the replaced one has one.
    """
    frames = {
        (Path(name).parts[0], _number(Path(name))): path
        for name, path in copies.items()
        if Path(name).parts[1] not in _LABELS
    }
    for (sensor, frame), path in frames.items():
        truth = dataset.paths.truth(sensor, frame)
        columns = read_truth(other.paths.truth(sensor, _number(path)))
        if columns is None and truth.exists():
            columns = _truth_unchanged(path)
        if columns is not None:
            yield truth.relative_to(dataset.path), columns


def _number(path: Path) -> int:
    """Number of the frame of a file."""
    return int(re.split(r"[._]", path.name)[0])


def _truth_unchanged(path: Path) -> dict[str, NDArray[Any]]:
    """The truth of a cloud or an image that no stage has changed."""
    if path.suffix == ".png":
        rgb = read_png(path).astype(np.uint8)
        return changed_pixels(rgb, rgb)
    return cloud_truth(trace_unaltered(table_cloud(read_table(path))), start_ns=0)


def _shift(dataset: Dataset, name: str, *, shift_ns: int) -> tuple[str, Mapping[str, list[str]]]:
    """Path and columns of the table of a sensor's times, with later time stamps."""
    sensors = dataset.sensors("lidar", "camera", "imu")
    if name not in sensors:
        raise InputError(
            f"`shift`: no scanner, camera or inertial unit {name!r}; there are {', '.join(sensors)}"
        )
    paths = Paths(dataset.path)
    path = paths.measurements(name) if sensors[name]["kind"] == "imu" else paths.timestamps(name)
    rows = read_rows(path)
    with reading_file(path):
        columns = {key: [row[key] for row in rows] for key in (rows[0] if rows else ("time_ns", "timestamp"))}
        times = np.array([int(text) for text in columns["time_ns"]], np.int64) + shift_ns
    if len(times) and times[0] < 0:
        raise InputError(f"`shift`: {name} would begin {-times[0] / 1e9:g} s before the drive's start")
    stamps = {"time_ns": list(map(str, times.tolist())), "timestamp": iso_times(dataset.start, times)}
    return path.relative_to(dataset.path).as_posix(), columns | stamps
