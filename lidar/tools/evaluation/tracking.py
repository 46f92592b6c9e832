"""Tracks of road users against the truth: CLEAR MOT and IDF1, by boxes in images or in space."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from geoscene.errors import reason_of
from geoscene.typing import Bools, Float, Ints
from lidar.errors import FormatError
from lidar.tools.evaluation.kitti_detection import (
    DIFFICULTIES,
    LIKE,
    Labels,
    area_overlap,
    flat_overlap,
    footprints,
    labels_of,
    volume_overlap,
)

CLASSES = ("Car", "Pedestrian", "Cyclist")
LIMITS = {"2d": 0.5, "3d": 0.25}
"""Least intersection over union with a true box: of KITTI's benchmark; in space of Weng et al. 2020."""

_MOT_WORDS = (7, 10)
_COUNTS = DIFFICULTIES[-1]
"""Which true objects count; others are neither missed nor wrong."""


@dataclass(frozen=True, slots=True)
class ObjectTracks:
    """Objects of a frame and the numbers (n,) of their tracks."""

    track: Ints
    labels: Labels


@dataclass(frozen=True, slots=True)
class Step:
    """A frame of one class: overlaps (found, true), tracks, and which true objects count."""

    overlap: Float
    found: Ints
    true: Ints
    counts: Bools


@dataclass(frozen=True, slots=True)
class TrackScore:
    """Measures of tracks of a class.

    mota : 1 less misses, wrong objects and switches over true objects (Bernardin and Stiefelhagen 2008)
    motp : mean overlap of right objects
    idf1 : of the best one-to-one assignment of tracks (Ristani et al. 2016)
    """

    kind: str
    measure: str
    objects: int
    missed: int
    wrong: int
    switches: int
    mota: float
    motp: float
    idf1: float


def read_tracks(path: Path) -> tuple[dict[int, ObjectTracks], str]:
    """The tracks of each frame of a file of KITTI's tracking benchmark or of MOT, and which it is.

    Raises FormatError for another file.
    """
    try:
        lines = [line for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
    except UnicodeDecodeError:
        raise FormatError(f"{path}: not text") from None
    rows: dict[int, list[tuple[int, str]]] = defaultdict(list)
    kitti = bool(lines) and "," not in lines[0]
    try:
        for line in lines:
            words = line.split() if kitti else [word.strip() for word in line.split(",")]
            if kitti:
                rows[int(words[0])].append((int(words[1]), " ".join(words[2:])))
                continue
            if len(words) < _MOT_WORDS[0]:
                raise ValueError(f"{len(words)} values, 7 to 10 are expected")  # noqa: TRY301
            left, top, wide, tall, score = map(float, words[2:7])
            box = f"{left - 1} {top - 1} {left - 1 + wide} {top - 1 + tall}"
            rows[int(words[0]) - 1].append(
                (int(float(words[1])), f"object 0 0 0 {box} 1 1 1 0 0 0 0 {score}")
            )
    except (ValueError, IndexError) as error:
        raise FormatError(f"{path}: no tracks of KITTI or MOT ({reason_of(error)})") from None
    found = {
        frame: ObjectTracks(np.array([t for t, _ in own]), labels_of([text for _, text in own], name=path))
        for frame, own in rows.items()
    }
    return found, "kitti" if kitti else "mot"


def steps_of(
    true: Mapping[int, ObjectTracks],
    found: Mapping[int, ObjectTracks],
    *,
    frames: Sequence[int],
    kind: str,
    measure: str,
) -> list[Step]:
    """Frames of a class, as input of the tracking metrics; ``object`` stands for all classes.

    Objects that are low, hidden or of a class alike do not count, and found ones on them are left out.
    """
    nothing = ObjectTracks(np.empty(0, np.int64), labels_of([], name=""))
    steps = []
    for frame in frames:
        here, there = found.get(frame, nothing), true.get(frame, nothing)
        own, labels = here.labels, there.labels
        mine = np.ones(len(labels), bool) if kind == "object" else labels.kind == kind
        alike = labels.kind == LIKE.get(kind, "")
        hard = (labels.occluded > _COUNTS.occluded) | (labels.truncated > _COUNTS.truncated)
        hard |= labels.box[:, 3] - labels.box[:, 1] <= _COUNTS.height
        rows = np.flatnonzero(mine | alike)
        columns = np.flatnonzero(np.ones(len(own), bool) if kind == "object" else own.kind == kind)
        overlap = _overlap(own.take(columns), labels.take(rows), measure=measure)
        counts = (mine & ~hard)[rows]
        steps.append(Step(overlap, here.track[columns], there.track[rows], counts))
    return steps


def _overlap(found: Labels, true: Labels, *, measure: str) -> Float:
    if measure == "2d":
        return flat_overlap(found.box, true.box)
    plans = [footprints(o.place[:, [0, 2]], o.size[:, [2, 1]], yaw=-o.yaw) for o in (found, true)]
    ends = [(o.place[:, 1] - o.size[:, 0], o.place[:, 1], o.size.prod(axis=1)) for o in (found, true)]
    return volume_overlap(area_overlap(plans[0], plans[1])[0], one=ends[0], other=ends[1])


def score_tracks(steps: Sequence[Step], *, kind: str, measure: str) -> TrackScore:
    """Measures of the tracks of a class over the frames of a drive."""
    limit = LIMITS[measure]
    objects = missed = wrong = switches = right = 0
    shared = 0.0
    last: dict[int, int] = {}
    common: dict[tuple[int, int], int] = defaultdict(int)
    lengths: tuple[dict[int, int], dict[int, int]] = defaultdict(int), defaultdict(int)
    for step in steps:
        near = step.overlap >= limit
        partner = _assign(step, near, last=last)
        skipped = np.zeros(len(step.found), bool)
        for row in np.flatnonzero(partner < 0).tolist():
            skipped[row] = bool((near[row] & ~step.counts).any())
        for row, column in enumerate(partner.tolist()):
            if column >= 0 and not step.counts[column]:
                skipped[row] = True
                last[int(step.true[column])] = int(step.found[row])
            elif column >= 0:
                true, found = int(step.true[column]), int(step.found[row])
                switches += last.get(true, found) != found
                last[true] = found
                right += 1
                shared += float(step.overlap[row, column])
        objects += int(step.counts.sum())
        hit = partner[(partner >= 0) & ~skipped]
        missed += int(step.counts.sum()) - len(hit)
        wrong += int(((partner < 0) & ~skipped).sum())
        for row in np.flatnonzero(~skipped).tolist():
            lengths[0][int(step.found[row])] += 1
            for column in np.flatnonzero(near[row] & step.counts).tolist():
                common[int(step.found[row]), int(step.true[column])] += 1
        for column in np.flatnonzero(step.counts).tolist():
            lengths[1][int(step.true[column])] += 1
    mota = 1 - (missed + wrong + switches) / objects if objects else float("nan")
    motp = shared / right if right else float("nan")
    idf1 = _idf1(common, lengths)
    return TrackScore(kind, measure, objects, missed, wrong, switches, mota, motp, idf1)


def _assign(step: Step, near: Bools, *, last: Mapping[int, int]) -> Ints:
    """Column (n,) of the true object of each found one; -1 for none.

    Pairs of the frame before that still overlap are kept; others are those of the greatest sum of overlaps.
    """
    partner = np.full(len(step.found), -1, np.int64)
    row_of = {int(track): row for row, track in enumerate(step.found)}
    for column, true in enumerate(step.true.tolist()):
        row = row_of.get(last.get(true, -1), -1)
        if row >= 0 and near[row, column] and partner[row] < 0:
            partner[row] = column
    rows = np.flatnonzero(partner < 0)
    columns = np.setdiff1d(np.arange(len(step.true)), partner)
    if len(rows) and len(columns):
        # Those that count come first, and any that overlap enough before none.
        gain = np.where(near, 1 + step.overlap + 2 * step.counts, 0)[np.ix_(rows, columns)]
        for i, j in zip(*linear_sum_assignment(gain, maximize=True), strict=True):
            if near[rows[i], columns[j]]:
                partner[rows[i]] = columns[j]
    return partner


def _idf1(
    common: Mapping[tuple[int, int], int], lengths: tuple[Mapping[int, int], Mapping[int, int]]
) -> float:
    """Twice the frames in common of the best assignment of tracks, over all frames of both."""
    total = sum(lengths[0].values()) + sum(lengths[1].values())
    if not total:
        return float("nan")
    rows, columns = ({track: k for k, track in enumerate(own)} for own in lengths)
    table = np.zeros((len(rows), len(columns)))
    for (found, true), count in common.items():
        table[rows[found], columns[true]] = count
    best = linear_sum_assignment(table, maximize=True)
    return float(2 * table[best].sum() / total)
