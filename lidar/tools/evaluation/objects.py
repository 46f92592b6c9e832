"""Detections and tracks against the road users of a dataset."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geoscene.drawing.report import Column, ReportTable, table_of
from lidar.dataset.layout import Dataset, open_dataset
from lidar.dataset.layouts.kitti import OBJECTS, true_lines
from lidar.dataset.layouts.kitti_drive import KittiDrive, read_drive
from lidar.dataset.layouts.mot import TrackedBox, sequence
from lidar.dataset.recorded import color_images
from lidar.errors import DatasetError, InputError
from lidar.tools.evaluation.detect import RESULTS
from lidar.tools.evaluation.kitti_detection import AveragePrecision, evaluate_kitti, labels_of, read_labels
from lidar.tools.evaluation.nuscenes_detection import (
    ClassScore,
    NuScenesScore,
    evaluate_nuscenes,
    read_results,
    samples_of,
    true_boxes,
)
from lidar.tools.evaluation.tracking import (
    CLASSES,
    LIMITS,
    ObjectTracks,
    TrackScore,
    read_tracks,
    score_tracks,
    steps_of,
)

_LABELS = re.compile(r"\d{6}\.txt")


@dataclass(frozen=True, slots=True)
class ObjectScores:
    """Scores of detections or tracks.

    kind   : ``kitti detections``, ``nuscenes detections``, ``kitti tracks`` or ``mot tracks``
    frames : that were compared
    """

    estimate: str
    truth: str
    kind: str
    frames: int
    scores: list[AveragePrecision] | list[TrackScore] | NuScenesScore

    def to_json(self) -> dict[str, Any]:
        """As ``evaluation.json``."""
        return {"schema": 1, **asdict(self)}

    def tables(self) -> list[ReportTable]:
        """The tables of the scores."""
        if isinstance(self.scores, NuScenesScore):
            return _nuscenes_tables(self.scores)
        precisions = [one for one in self.scores if isinstance(one, AveragePrecision)]
        tracks = [one for one in self.scores if isinstance(one, TrackScore)]
        return _kitti_tables(precisions) if precisions else [table_of(_TRACKS, tracks, title="Tracks")]


def kind_of(estimate: Path) -> str:
    """Whether files are detections (``kitti``, ``nuscenes``), tracks or, if empty, of a trajectory."""
    if estimate.is_dir():
        if any(_LABELS.fullmatch(path.name) for path in estimate.iterdir()):
            return "kitti"
        return "nuscenes" if (estimate / RESULTS).is_file() else ""
    if estimate.suffix.lower() == ".json":
        return "nuscenes"
    if estimate.suffix.lower() != ".txt" or not estimate.is_file():
        return ""
    with estimate.open(encoding="utf-8-sig", errors="replace") as lines:
        first = next((line for line in lines if line.strip()), "")
    words = first.split()
    return "tracks" if "," in first or (len(words) in (17, 18) and not _number(words[2])) else ""


def _number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def evaluate_objects(estimate: Path, against: Path, *, sensor: str = "") -> ObjectScores:
    """Compare detections or tracks with the road users of a dataset.

    sensor : camera of MOT's tracks; the first one with images and boxes by default

    Raises InputError for what cannot be compared, and FormatError and DatasetError for damaged files.
    """
    dataset, kind = open_dataset(against), kind_of(estimate)
    if kind == "nuscenes":
        samples = samples_of(dataset)
        path = estimate / RESULTS if estimate.is_dir() else estimate
        score = evaluate_nuscenes(
            true_boxes(dataset, samples), read_results(path, samples), vehicle=samples.vehicle
        )
        return ObjectScores(str(estimate), str(against), "nuscenes detections", score.samples, score)
    if kind == "tracks":
        found, layout = read_tracks(estimate)
        if layout == "mot":
            return _mot_tracks(estimate, found, dataset=dataset, sensor=sensor)
    if sensor:
        raise InputError(f"`sensor` {sensor}: only of trajectories and of tracks of MOT; leave it out")
    drive = _drive(dataset)
    if kind == "kitti":
        return _detections(estimate, drive, against=against)
    return _kitti_tracks(estimate, found, drive=drive)


def _drive(dataset: Dataset) -> KittiDrive:
    drive = read_drive(dataset)
    if OBJECTS not in drive.cameras or not drive.boxes:
        raise DatasetError(
            f"{dataset.path}: KITTI's measures need road users and images of a third camera; drive with"
            " `traffic` and the rig kitti, or give detections in nuScenes' layout, which need a scanner alone"
        )
    return drive


def _detections(folder: Path, drive: KittiDrive, *, against: Path) -> ObjectScores:
    files = {int(p.stem): p for p in folder.iterdir() if _LABELS.fullmatch(p.name)}
    if beyond := [row for row in files if row >= len(drive)]:
        raise InputError(f"{folder}: has {files[beyond[0]].name}, but the drive has {len(drive)} frames")
    frames = []
    for row, lines in enumerate(true_lines(drive)):
        if row in files:
            frames.append((labels_of(list(lines.values()), name=against), read_labels(files[row])))
    return ObjectScores(str(folder), str(against), "kitti detections", len(frames), evaluate_kitti(frames))


def _kitti_tracks(path: Path, found: Mapping[int, ObjectTracks], *, drive: KittiDrive) -> ObjectScores:
    true = {}
    for row, lines in enumerate(true_lines(drive)):
        labels = labels_of(list(lines.values()), name=drive.dataset.path)
        true[row] = ObjectTracks(np.array(list(lines), np.int64), labels)
    _check_frames(path, found, count=len(drive))
    scores = []
    for kind in CLASSES:
        for measure in LIMITS:
            steps = steps_of(true, found, frames=range(len(drive)), kind=kind, measure=measure)
            scores.append(score_tracks(steps, kind=kind, measure=measure))
    return ObjectScores(str(path), str(drive.dataset.path), "kitti tracks", len(drive), scores)


def _mot_tracks(
    path: Path, found: Mapping[int, ObjectTracks], *, dataset: Dataset, sensor: str
) -> ObjectScores:
    cameras = dataset.sensors("camera")
    if sensor and sensor not in cameras:
        raise InputError(f"`sensor` {sensor}: no camera of {dataset.path}; there are {', '.join(cameras)}")
    known = [name for name in cameras if dataset.paths.sensor_boxes(name).exists()]
    stream = color_images(dataset, sensor or known[0]) if known else None
    if stream is None or stream.name not in known:
        raise DatasetError(f"{dataset.path}: has no images with boxes of road users; drive with `traffic`")
    rows: dict[int, list[TrackedBox]] = {}
    for line in sequence(dataset, stream):
        rows.setdefault(line.image, []).append(line)
    true = {
        image: ObjectTracks(
            np.array([line.track for line in lines], np.int64),
            labels_of(
                ["object 0 0 0 {} {} {} {} 1 1 1 0 0 0 0".format(*one.box) for one in lines], name=path
            ),
        )
        for image, lines in rows.items()
    }
    count = len(stream.files)
    _check_frames(path, found, count=count)
    steps = steps_of(true, found, frames=range(count), kind="object", measure="2d")
    scores = [score_tracks(steps, kind="object", measure="2d")]
    return ObjectScores(str(path), str(dataset.path), f"mot tracks of {stream.name}", count, scores)


def _check_frames(path: Path, found: Mapping[int, ObjectTracks], *, count: int) -> None:
    if found and not 0 <= min(found) <= max(found) < count:
        beyond = max(found) if max(found) >= count else min(found)
        raise InputError(f"{path}: has frame {beyond} (from 0), but the drive has {count} frames")


def _kitti_tables(scores: Sequence[AveragePrecision]) -> list[ReportTable]:
    rows: dict[tuple[str, str, float], list[AveragePrecision]] = {}
    for one in scores:
        rows.setdefault((one.kind, one.measure, one.overlap), []).append(one)
    columns: list[Column[list[AveragePrecision]]] = [
        Column("class", lambda row: row[0].kind),
        Column("boxes", lambda row: row[0].measure.upper()),
        Column("IoU", lambda row: f"{row[0].overlap:g}"),
        *(_precision_column(k, one.difficulty) for k, one in enumerate(next(iter(rows.values())))),
        Column("objects", lambda row: "/".join(f"{one.objects:,}" for one in row)),
    ]
    return [table_of(columns, rows.values(), title="Average precision at 40 recalls (KITTI), %")]


def _nuscenes_tables(score: NuScenesScore) -> list[ReportTable]:
    classes = [one for one in score.classes if one.objects]
    columns: list[Column[ClassScore]] = [
        Column("class", lambda row: row.kind),
        *(_distance_column(distance) for distance in score.classes[0].precision),
        Column("mean", lambda row: _percent(100 * row.mean)),
        *(_error_column(name, k) for k, name in enumerate(("ATE", "ASE", "AOE", "AVE", "AAE"))),
        Column("objects", lambda row: f"{row.objects:,}"),
    ]
    whole = [
        ("ten classes", score.mean_ap, score.nds),
        ("classes in the data", score.mean_ap_present, score.nds_present),
    ]
    of_all: list[Column[tuple[str, float, float]]] = [
        Column("of", lambda row: row[0]),
        Column("mAP, %", lambda row: _percent(100 * row[1])),
        Column("NDS", lambda row: _fixed(row[2])),
    ]
    return [
        table_of(columns, classes, title="nuScenes, %, m, rad and m/s"),
        table_of(of_all, whole, title="Scores"),
    ]


def _precision_column(k: int, difficulty: str) -> Column[list[AveragePrecision]]:
    return Column(difficulty, lambda row: _percent(row[k].value))


def _distance_column(distance: str) -> Column[ClassScore]:
    return Column(f"AP {distance} m", lambda row: _percent(100 * row.precision[distance]))


def _error_column(name: str, k: int) -> Column[ClassScore]:
    return Column(name, lambda row: _fixed(list(row.errors.values())[k]))


_TRACKS: tuple[Column[TrackScore], ...] = (
    Column("class", lambda row: row.kind),
    Column("boxes", lambda row: row.measure.upper()),
    Column("MOTA", lambda row: _fixed(row.mota)),
    Column("MOTP", lambda row: _fixed(row.motp)),
    Column("IDF1", lambda row: _fixed(row.idf1)),
    Column("switches", lambda row: f"{row.switches:,}"),
    Column("missed", lambda row: f"{row.missed:,}"),
    Column("wrong", lambda row: f"{row.wrong:,}"),
    Column("objects", lambda row: f"{row.objects:,}"),
)


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _fixed(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
