"""Detections and tracks against the road users of a dataset."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lidar.dataset.layout import Dataset, open_dataset
from lidar.dataset.layouts.kitti import OBJECTS
from lidar.dataset.layouts.kitti_drive import KittiDrive, read_drive
from lidar.dataset.layouts.kitti_objects import object_lines
from lidar.dataset.layouts.mot import TrackedBox, sequence
from lidar.dataset.recorded import color_images
from lidar.errors import DatasetError, InputError
from lidar.tools.evaluation.detect import RESULTS
from lidar.tools.evaluation.kitti_detection import AveragePrecision, evaluate_kitti, labels_of, read_labels
from lidar.tools.evaluation.nuscenes_detection import (
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

Rows = list[list[str]]


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

    def tables(self) -> list[tuple[str, list[str], Rows]]:
        """Title, head and rows of each table."""
        if isinstance(self.scores, NuScenesScore):
            return _nuscenes_tables(self.scores)
        precisions = [one for one in self.scores if isinstance(one, AveragePrecision)]
        tracks = [one for one in self.scores if isinstance(one, TrackScore)]
        return _kitti_tables(precisions) if precisions else _track_tables(tracks)


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
    with estimate.open(encoding="utf-8", errors="replace") as lines:
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


def true_lines(drive: KittiDrive) -> Iterator[dict[int, str]]:
    """Lines of the road users in the image of each frame, by their numbers."""
    boxes, stream = drive.image_boxes(OBJECTS), drive.cameras[OBJECTS]
    for row in range(len(drive)):
        frame = int(stream.frames[drive.images[OBJECTS][row]])
        yield object_lines(drive, number=OBJECTS, row=row, image_boxes=boxes.get(frame, {}))


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


def _kitti_tables(scores: list[AveragePrecision]) -> list[tuple[str, list[str], Rows]]:
    rows: dict[tuple[str, str, float], list[AveragePrecision]] = {}
    for one in scores:
        rows.setdefault((one.kind, one.measure, one.overlap), []).append(one)
    lines = [
        [
            kind,
            measure.upper(),
            f"{limit:g}",
            *(_percent(one.value) for one in own),
            "/".join(f"{one.objects:,}" for one in own),
        ]
        for (kind, measure, limit), own in rows.items()
    ]
    head = ["class", "boxes", "IoU", *(one.difficulty for one in next(iter(rows.values()))), "objects"]
    return [("Average precision at 40 recalls (KITTI), %", head, lines)]


def _nuscenes_tables(score: NuScenesScore) -> list[tuple[str, list[str], Rows]]:
    distances = list(score.classes[0].precision)
    head = ["class", *(f"AP {d} m" for d in distances), "mean", "ATE", "ASE", "AOE", "AVE", "AAE", "objects"]
    rows = [
        [
            one.kind,
            *(_percent(100 * v) for v in one.precision.values()),
            _percent(100 * one.mean),
            *("–" if v is None else f"{v:.3f}" for v in one.errors.values()),
            f"{one.objects:,}",
        ]
        for one in score.classes
        if one.objects
    ]
    whole = [
        ["ten classes", _percent(100 * score.mean_ap), f"{score.nds:.3f}"],
        ["classes in the data", _percent(100 * score.mean_ap_present), f"{score.nds_present:.3f}"],
    ]
    return [("nuScenes, %, m, rad and m/s", head, rows), ("Scores", ["of", "mAP, %", "NDS"], whole)]


def _track_tables(scores: list[TrackScore]) -> list[tuple[str, list[str], Rows]]:
    head = ["class", "boxes", "MOTA", "MOTP", "IDF1", "switches", "missed", "wrong", "objects"]
    rows = [
        [one.kind, one.measure.upper(), *(f"{v:.3f}" for v in (one.mota, one.motp, one.idf1))]
        + [f"{v:,}" for v in (one.switches, one.missed, one.wrong, one.objects)]
        for one in scores
    ]
    return [("Tracks", head, rows)]


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"
