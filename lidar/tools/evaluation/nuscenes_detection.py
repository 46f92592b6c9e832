"""Detections by nuScenes' benchmark: average precision over distances of centres, errors, and their score.

Caesar et al. 2020, configuration ``detection_cvpr_2019`` of nuscenes-devkit. Boxes are in the frame of the
tables that ``lidar convert --to nuscenes`` writes.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, class_codes
from geoscene.errors import reading
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.dataset.ground_truth import COLUMNS, read_boxes
from lidar.dataset.layout import Dataset
from lidar.dataset.layouts.nuscenes import (
    CATEGORIES,
    attributes_of,
    key_rows,
    streams_of,
    table_frame,
    token_of,
)
from lidar.errors import FormatError, InputError

RANGES = {
    **dict.fromkeys(("car", "truck", "bus", "trailer", "construction_vehicle"), 50.0),
    **dict.fromkeys(("pedestrian", "motorcycle", "bicycle"), 40.0),
    **dict.fromkeys(("traffic_cone", "barrier"), 30.0),
}
"""Classes, and metres from the vehicle up to which they count."""

DISTANCES = (0.5, 1.0, 2.0, 4.0)
"""Metres between centres up to which a detection is right."""

ERRORS = ("translation", "scale", "orientation", "velocity", "attribute")
_NONE = {"traffic_cone": ERRORS[2:], "barrier": ERRORS[3:]}
"""Errors that classes do not have."""

_AT = 2.0
"""Metres between centres up to which errors of detections are taken."""
_FIRST, _POINTS = 11, 101
"""First of the 101 recalls that count: above 10 %."""
_LEAST = 0.1
"""Precision that counts as none."""
_MOST = 500
"""Boxes of a sample, at most."""
_WEIGHT = 5
"""Weight of the mean average precision in the score, of ten."""
_APART_S = 1.5
"""Seconds between the annotations that a velocity is taken from, at most, on each side."""


@dataclass(frozen=True, slots=True)
class Boxes(Columns):
    """Boxes of all samples.

    sample    : (n,) row of the sample
    kind      : (n,) one of `RANGES`
    place     : (n, 3) centre, metres
    size      : (n, 3) width, length, height, metres
    yaw       : (n,) radians
    velocity  : (n, 2) m/s; NaN where it is not known
    attribute : (n,) text
    score     : (n,) of detections
    """

    sample: Ints
    kind: NDArray[np.str_]
    place: Float
    size: Float
    yaw: Float
    velocity: Float
    attribute: NDArray[np.str_]
    score: Float


@dataclass(frozen=True, slots=True)
class KeyFrames:
    """Key frames of a nuScenes dataset, as columns.

    token : of each sample
    time_ns, frame : (n,) of each, since the drive's start, and of the scanner
    vehicle : (n, 3) its place, metres
    """

    token: list[str]
    time_ns: Ints
    frame: Ints
    vehicle: Float


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Average precisions by distance (0 to 1), and errors in metres, shares, radians and m/s, or None."""

    kind: str
    objects: int
    precision: dict[str, float]
    errors: dict[str, float | None]

    @property
    def mean(self) -> float:
        """Mean average precision over the distances."""
        return float(np.mean(list(self.precision.values())))


@dataclass(frozen=True, slots=True)
class NuScenesScore:
    """Scores of detections.

    mean_ap, nds, errors : over all ten classes, as the benchmark has them
    mean_ap_present, nds_present : over the classes that the data have
    """

    samples: int
    classes: list[ClassScore]
    mean_ap: float
    nds: float
    errors: dict[str, float]
    mean_ap_present: float
    nds_present: float


def samples_of(dataset: Dataset) -> KeyFrames:
    """The key frames of a dataset as `lidar.dataset.layouts.nuscenes` has them."""
    top = streams_of(dataset)["LIDAR_TOP"]
    rows, name = key_rows(top.time_ns), dataset.path.resolve().name
    trajectory = dataset.trajectory()
    scale, zero = table_frame(trajectory)
    time_ns, frames = top.time_ns[rows], top.frames[rows]
    tokens = [token_of(name, "sample", frame) for frame in frames.tolist()]
    return KeyFrames(tokens, time_ns, frames, trajectory.at(time_ns).position / scale - zero)


def true_boxes(dataset: Dataset, samples: KeyFrames) -> Boxes:
    """Road users of the key frames with returns, of classes of the benchmark.

    Velocities are those between annotations before and after, as the development kit takes them.
    """
    top = streams_of(dataset)["LIDAR_TOP"]
    path = dataset.paths.sensor_boxes(top.name)
    if not path.exists():
        raise InputError(f"{dataset.path}: has no road users; drive with `traffic`")
    scale, zero = table_frame(dataset.trajectory())
    row_of = {frame: k for k, frame in enumerate(samples.frame.tolist())}
    ways: dict[int, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    for box in read_boxes(path, (*COLUMNS, "points", "visibility")):
        if box["frame"] in row_of and (box["points"] or box["visibility"]):
            ways[box["id"]].append((row_of[box["frame"]], box))
    found: list[tuple[Any, ...]] = []
    for way in ways.values():
        places = np.array([[box[a] for a in "xyz"] for _, box in way]) / scale - zero
        speed = _velocities(places, samples.time_ns[[row for row, _ in way]])
        for (row, box), place, velocity in zip(way, places, speed, strict=True):
            category = CATEGORIES[int(class_codes().nuscenes[Class[box["class"].upper()]])]
            kind = _detect(category)
            if kind and box["points"]:
                size = [box[name] for name in ("width", "length", "height")]
                attribute = (attributes_of(category, box) or [""])[0]
                found.append((row, kind, place, size, box["yaw"], velocity, attribute, 1.0))
    return _boxes(sorted(found, key=lambda one: one[0]))


def _boxes(found: Sequence[tuple[Any, ...]]) -> Boxes:
    sample, kind, place, size, yaw, velocity, attribute, score = (
        zip(*found, strict=True) if found else ((),) * 8
    )
    return Boxes(
        np.array(sample, np.int64),
        np.array(kind, np.str_),
        np.array(place, float).reshape(-1, 3),
        np.array(size, float).reshape(-1, 3),
        np.array(yaw, float),
        np.array(velocity, float).reshape(-1, 2),
        np.array(attribute, np.str_),
        np.array(score, float),
    )


def _velocities(place: Float, time_ns: Ints) -> Float:
    """Velocities (n, 2) between the annotations before and after each of a road user's."""
    n = len(place)
    first, last = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    seconds = (time_ns[last] - time_ns[first]) * 1e-9
    most = _APART_S * np.where(last - first == 2, 2, 1)
    out = np.full((n, 2), np.nan)
    good = (last > first) & (seconds <= most)
    out[good] = (place[last] - place[first])[good, :2] / seconds[good, None]
    return out


def _detect(category: str) -> str:
    """The class of the benchmark of a category; empty for none."""
    words = category.split(".")
    if words[:2] == ["human", "pedestrian"]:
        return "pedestrian" if words[2] in ("adult", "child", "construction_worker", "police_officer") else ""
    if words[0] == "vehicle" and words[1] in RANGES:
        return words[1]
    return "construction_vehicle" if words[:2] == ["vehicle", "construction"] else ""


def read_results(path: Path, samples: KeyFrames) -> Boxes:
    """The detections of a file of results in nuScenes' layout, those of unknown samples left out.

    Raises FormatError for another file, InputError if it has none of the samples.
    """
    with reading(path, FormatError, remedy="give results in nuScenes' layout", known=FormatError):
        results: Mapping[str, list[dict[str, Any]]] = json.loads(path.read_text("utf-8-sig"))["results"]
        found = []
        rows = {token: row for row, token in enumerate(samples.token)}
        for token, boxes_there in results.items():
            if len(boxes_there) > _MOST:
                raise FormatError(f"{path}: over {_MOST} boxes in sample {token}")
            row = rows.get(token, -1)
            for box in boxes_there if row >= 0 else ():
                w, x, y, z = map(float, box["rotation"])
                yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
                if box["detection_name"] not in RANGES:
                    raise FormatError(f"{path}: {box['detection_name']}: no class of the benchmark")
                found.append(
                    (row, box["detection_name"], box["translation"], box["size"], yaw, box["velocity"],
                     box["attribute_name"], float(box["detection_score"]))
                )  # fmt: skip
        boxes = _boxes(found)
        finite = all(np.isfinite(v).all() for v in (boxes.place, boxes.size, boxes.yaw, boxes.score))
        if not finite or (boxes.size <= 0).any():
            raise ValueError("boxes that are not finite")
    if not any(token in results for token in samples.token):
        raise InputError(
            f"{path}: has none of the {len(samples.token)} key frames; sample tokens are those that lidar"
            " convert --to nuscenes gives this dataset"
        )
    return boxes


def evaluate_nuscenes(true: Boxes, found: Boxes, *, vehicle: Float) -> NuScenesScore:
    """Scores of detections, as nuscenes-devkit computes them.

    vehicle : (samples, 3) its place in each
    """
    true, found = (_near(boxes, vehicle) for boxes in (true, found))
    classes = [_class_score(true, found, kind=kind) for kind in RANGES]
    present = [one for one in classes if one.objects]
    mean_ap, errors = _means(classes)
    nds = _score(mean_ap, errors)
    mean_present, errors_present = _means(present or classes)
    return NuScenesScore(
        len(vehicle), classes, mean_ap, nds, errors, mean_present, _score(mean_present, errors_present)
    )


def _near(boxes: Boxes, vehicle: Float) -> Boxes:
    away = np.linalg.norm((boxes.place - vehicle[boxes.sample])[:, :2], axis=1)
    return boxes.where(away < np.array([RANGES[kind] for kind in boxes.kind.tolist()], float))


def _means(classes: Sequence[ClassScore]) -> tuple[float, dict[str, float]]:
    errors = {}
    for name in ERRORS:
        known = [v for v in (one.errors[name] for one in classes) if v is not None]
        errors[name] = float(np.mean(known)) if known else 1.0
    return float(np.mean([one.mean for one in classes])), errors


def _score(mean_ap: float, errors: Mapping[str, float]) -> float:
    return (_WEIGHT * mean_ap + sum(max(1 - v, 0.0) for v in errors.values())) / (_WEIGHT + len(errors))


def _class_score(true: Boxes, found: Boxes, *, kind: str) -> ClassScore:
    mine, theirs = true.where(true.kind == kind), found.where(found.kind == kind)
    # Of equal scores the devkit takes the last one first.
    theirs = theirs.take(np.lexsort((np.arange(len(theirs)), theirs.score))[::-1])
    precision, errors = {}, dict.fromkeys(ERRORS, 1.0)
    for limit in DISTANCES:
        partner = _partners(mine, theirs, limit=limit)
        precision[f"{limit:g}"] = _precision(partner, len(mine))
        if limit == _AT:
            errors = _errors(mine, theirs, partner=partner)
    skipped = _NONE.get(kind, ())
    return ClassScore(kind, len(mine), precision, {k: None if k in skipped else v for k, v in errors.items()})


def _partners(true: Boxes, found: Boxes, *, limit: float) -> Ints:
    """Row (n,) of the true box that each detection takes, the most certain first; -1 for none."""
    partner = np.full(len(found), -1, np.int64)
    rows_of = {int(sample): np.flatnonzero(true.sample == sample) for sample in np.unique(true.sample)}
    taken = np.zeros(len(true), bool)
    for k, sample in enumerate(found.sample.tolist()):
        rows = rows_of.get(sample, np.empty(0, np.int64))
        rows = rows[~taken[rows]]
        if len(rows):
            away = np.linalg.norm((true.place[rows] - found.place[k])[:, :2], axis=1)
            if away.min() < limit:
                partner[k] = rows[away.argmin()]
                taken[partner[k]] = True
    return partner


def _precision(partner: Ints, count: int) -> float:
    """Average precision: the mean of what exceeds 10 % at recalls above 10 %."""
    hits = np.cumsum(partner >= 0)
    if not count or not len(hits) or not hits[-1]:
        return 0.0
    precision, recall = hits / np.arange(1, len(hits) + 1), hits / count
    curve = np.interp(np.linspace(0, 1, _POINTS), recall, precision, right=0)
    return float(np.clip(curve[_FIRST:] - _LEAST, 0, None).mean() / (1 - _LEAST))


def _errors(true: Boxes, found: Boxes, *, partner: Ints) -> dict[str, float]:
    """Mean errors of right detections over the recalls above 10 % that are reached; 1 if none are."""
    hits = np.cumsum(partner >= 0)
    if not len(true) or not len(hits) or not hits[-1]:
        return dict.fromkeys(ERRORS, 1.0)
    right = partner >= 0
    mine, theirs = true.take(partner[right]), found.where(right)
    low = np.minimum(mine.size, theirs.size).prod(axis=1)
    turn = (theirs.yaw - mine.yaw + np.pi) % (2 * np.pi) - np.pi
    if len(mine) and mine.kind[0] == "barrier":
        turn = (theirs.yaw - mine.yaw + np.pi / 2) % np.pi - np.pi / 2
    each = {
        "translation": np.linalg.norm((mine.place - theirs.place)[:, :2], axis=1),
        "scale": 1 - low / (mine.size.prod(axis=1) + theirs.size.prod(axis=1) - low),
        "orientation": np.abs(turn),
        "velocity": np.linalg.norm(theirs.velocity - mine.velocity, axis=1),
        "attribute": np.where(mine.attribute == "", np.nan, (mine.attribute != theirs.attribute) * 1.0),
    }
    recalls = np.linspace(0, 1, _POINTS)
    score = np.interp(recalls, hits / len(true), found.score, right=0)
    reached = np.flatnonzero(score)
    last = int(reached[-1]) if len(reached) else 0
    if last < _FIRST:
        return dict.fromkeys(ERRORS, 1.0)
    of_hits = found.score[right]
    out = {}
    for name, values in each.items():
        curve = np.interp(score[::-1], of_hits[::-1], _running_mean(values)[::-1])[::-1]
        out[name] = float(curve[_FIRST : last + 1].mean())
    return out


def _running_mean(values: Float) -> Float:
    """Mean (n,) of the values so far that are known; 1 if none is known at all, 0 before the first."""
    known = np.isfinite(values)
    if not known.any():
        return np.ones(len(values))
    sums, counts = np.cumsum(np.where(known, values, 0.0)), np.cumsum(known)
    means: Float = np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0)
    return means
