"""Overlaps of boxes, and detections by KITTI's object benchmark: average precision at 40 recalls.

Geiger et al. 2012; 40 recalls: Simonelli et al. 2019. Boxes are in the frame of the reference camera: x
right, y down, z forward, y at the lower face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints
from lidar.errors import FormatError

_CORNERS = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
RECALLS = 40

OVERLAPS = {"Car": (0.7, 0.5), "Pedestrian": (0.5, 0.25), "Cyclist": (0.5, 0.25)}
"""Least intersection over union by class: of the benchmark, and loose ones that papers also state."""

LIKE = {"Car": "Van", "Pedestrian": "Person_sitting"}
"""Classes whose objects are neither missed nor wrong as another."""

MEASURES = ("2d", "bev", "3d")

COUNTS, MAY, OTHER = 0, 1, -1
"""Roles: what counts, what is neither right nor wrong, and what is of another class."""


def flat_overlap(one: Float, other: Float) -> Float:
    """Intersection over union (n, m) of boxes (n, 4) and (m, 4): left, top, right, bottom."""
    low = np.maximum(one[:, None, :2], other[None, :, :2])
    high = np.minimum(one[:, None, 2:], other[None, :, 2:])
    common = np.clip(high - low, 0, None).prod(axis=2)
    area, area_other = ((b[:, 2:] - b[:, :2]).prod(axis=1) for b in (one, other))
    return _share(common, area[:, None] + area_other[None] - common)


def footprints(centre: Float, size: Float, *, yaw: Float) -> Float:
    """Corners (n, 4, 2) of rectangles: centres (n, 2), lengths and widths (n, 2), yaw (n,) of the length."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    corners: Float = centre[:, None] + (_CORNERS * size[:, None]) @ turn.swapaxes(1, 2)
    return corners


def area_overlap(one: Float, other: Float) -> tuple[Float, Float]:
    """Common areas (n, m) and intersections over unions (n, m) of footprints (n, 4, 2) and (m, 4, 2)."""
    if not (len(one) and len(other)):
        nothing = np.zeros((len(one), len(other)))
        return nothing, nothing
    first, second = shapely.polygons(one), shapely.polygons(other)
    common = shapely.area(shapely.intersection(first[:, None], second[None]))
    union = shapely.area(first)[:, None] + shapely.area(second)[None] - common
    return common, _share(common, union)


def volume_overlap(
    common: Float, *, one: tuple[Float, Float, Float], other: tuple[Float, Float, Float]
) -> Float:
    """Intersection over union (n, m) of upright boxes whose footprints have common areas (n, m).

    one, other : their least and greatest heights and their volumes
    """
    low, high, volume = one
    low_other, high_other, volume_other = other
    tall = np.clip(np.minimum(high[:, None], high_other) - np.maximum(low[:, None], low_other), 0, None)
    shared = common * tall
    return _share(shared, volume[:, None] + volume_other - shared)


def _share(part: Float, whole: Float) -> Float:
    found: Float = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
    return found


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Which objects count: of a height in pixels above, and up to an occlusion and a truncation."""

    name: str
    height: float
    occluded: int
    truncated: float


DIFFICULTIES = (
    Difficulty("easy", 40, 0, 0.15),
    Difficulty("moderate", 25, 1, 0.3),
    Difficulty("hard", 25, 2, 0.5),
)


@dataclass(frozen=True, slots=True)
class Labels(Columns):
    """Objects of an image, as lines of KITTI's labels.

    kind      : (n,) text
    truncated : (n,) 0 to 1
    occluded  : (n,) 0 visible, 1 partly, 2 largely, 3 unknown
    box       : (n, 4) left, top, right, bottom, pixels
    size      : (n, 3) height, width, length, metres
    place     : (n, 3) middle of the lower face, metres
    yaw       : (n,) radians about y
    score     : (n,) of detections; 1 for true objects
    """

    kind: NDArray[np.str_]
    truncated: Float
    occluded: Float
    box: Float
    size: Float
    place: Float
    yaw: Float
    score: Float


def labels_of(lines: Sequence[str], *, name: object) -> Labels:
    """The objects of the lines of a file.

    Raises FormatError for lines that are none of KITTI's.
    """
    words = [line.split() for line in lines if line.strip()]
    try:
        if any(len(row) not in (15, 16) for row in words):
            raise ValueError("15 values, or 16 with a score, are expected in each line")  # noqa: TRY301
        kinds = np.array([row[0] for row in words], np.str_)
        values = np.array([[float(v) for v in (*row[1:], "1")[:15]] for row in words]).reshape(-1, 15)
        if not np.isfinite(values).all():
            raise ValueError("numbers that are not finite")  # noqa: TRY301
    except ValueError as error:
        raise FormatError(f"{name}: no labels of KITTI ({reason_of(error)})") from None
    split = (values[:, 3:7], values[:, 7:10], values[:, 10:13])
    return Labels(kinds, values[:, 0], values[:, 1], *split, values[:, 13], values[:, 14])


def read_labels(path: Path) -> Labels:
    """The objects of a file; raises FormatError as `labels_of`."""
    try:
        return labels_of(path.read_text("utf-8-sig").splitlines(), name=path)
    except UnicodeDecodeError:
        raise FormatError(f"{path}: not text") from None


@dataclass(frozen=True, slots=True)
class AveragePrecision:
    """Average precision of a class in percent; None without objects that count.

    overlap : intersection over union from which a detection is right
    objects : that count
    """

    kind: str
    measure: str
    difficulty: str
    overlap: float
    value: float | None
    objects: int


@dataclass(frozen=True, slots=True)
class _Frame:
    """A frame with the overlaps (found, true) of its boxes by measure."""

    true: Labels
    found: Labels
    overlap: dict[str, Float]


def evaluate_kitti(frames: Sequence[tuple[Labels, Labels]]) -> list[AveragePrecision]:
    """Average precisions of detections, as KITTI's development kit computes them.

    frames : true objects and detections of each image
    """
    prepared = [_Frame(true, found, _overlaps(found, true)) for true, found in frames]
    rows = []
    for kind, limits in OVERLAPS.items():
        for measure in MEASURES:
            for limit in limits if measure != "2d" else limits[:1]:
                for difficulty in DIFFICULTIES:
                    value, count = _average(prepared, kind, measure=measure, limit=limit, at=difficulty)
                    rows.append(AveragePrecision(kind, measure, difficulty.name, limit, value, count))
    return rows


def _overlaps(found: Labels, true: Labels) -> dict[str, Float]:
    plans = [footprints(o.place[:, [0, 2]], o.size[:, [2, 1]], yaw=-o.yaw) for o in (found, true)]
    common, above = area_overlap(plans[0], plans[1])
    ends = [(o.place[:, 1] - o.size[:, 0], o.place[:, 1], o.size.prod(axis=1)) for o in (found, true)]
    volume = volume_overlap(common, one=ends[0], other=ends[1])
    return {"2d": flat_overlap(found.box, true.box), "bev": above, "3d": volume}


def _average(
    frames: Sequence[_Frame], kind: str, *, measure: str, limit: float, at: Difficulty
) -> tuple[float | None, int]:
    """Average precision of a class in percent, and the number of its objects that count."""
    roles = [(_true_roles(f.true, kind, at=at), _found_roles(f.found, kind, at=at)) for f in frames]
    count = sum(int((true == COUNTS).sum()) for true, _ in roles)
    if not count:
        return None, 0
    hits = [
        _match(f.overlap[measure] > limit, f, roles=r, best="score")
        for f, r in zip(frames, roles, strict=True)
    ]
    precision = np.zeros(RECALLS + 1)
    for k, least in enumerate(_thresholds(np.concatenate([h.scores for h in hits]), count)):
        right = wrong = 0
        for frame, role in zip(frames, roles, strict=True):
            found = _match(
                frame.overlap[measure] > limit, frame, roles=role, best=frame.overlap[measure], least=least
            )
            right, wrong = right + len(found.scores), wrong + found.wrong
        precision[k] = right / (right + wrong) if right + wrong else 0.0
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(100 * best[1:].mean()), count


def _true_roles(true: Labels, kind: str, *, at: Difficulty) -> Ints:
    height = true.box[:, 3] - true.box[:, 1]
    hard = (true.occluded > at.occluded) | (true.truncated > at.truncated) | (height <= at.height)
    mine, alike = true.kind == kind, true.kind == LIKE.get(kind, "")
    return np.where(mine & ~hard, COUNTS, np.where(mine | alike, MAY, OTHER))


def _found_roles(found: Labels, kind: str, *, at: Difficulty) -> Ints:
    low = np.abs(found.box[:, 3] - found.box[:, 1]) < at.height
    return np.where(low, MAY, np.where(found.kind == kind, COUNTS, OTHER))


@dataclass(frozen=True, slots=True)
class _Matched:
    """Scores of right detections, and the number of wrong ones."""

    scores: Float
    wrong: int


def _match(
    near: Bools, frame: _Frame, *, roles: tuple[Ints, Ints], best: Float | str, least: float | None = None
) -> _Matched:
    """Match each true object in order with the best free detection near it.

    near  : (found, true) whether boxes overlap enough
    best  : ``score``, or the overlaps, by which detections that count come before others
    least : score from which detections are taken
    """
    true_role, role = roles
    score = frame.found.score
    free = role != OTHER
    if least is not None:
        free &= score >= least
    taken, scores = np.zeros(len(role), bool), []
    for k in np.flatnonzero(true_role != OTHER).tolist():
        rows = np.flatnonzero(near[:, k] & free & ~taken)
        if not len(rows):
            continue
        if isinstance(best, str):
            row = rows[score[rows].argmax()]
        else:
            own = rows[role[rows] == COUNTS]
            row = own[best[own, k].argmax()] if len(own) else rows[0]
        taken[row] = True
        if true_role[k] == COUNTS and role[row] == COUNTS:
            scores.append(score[row])
    wrong = int((free & ~taken & (role == COUNTS)).sum())
    return _Matched(np.array(scores, float), wrong)


def _thresholds(scores: Float, count: int) -> list[float]:
    """Scores at which the recall comes nearest to multiples of a fortieth."""
    ordered = np.sort(scores)[::-1].tolist()
    recall, found = 0.0, []
    for k, score in enumerate(ordered):
        here = (k + 1) / count
        after = (k + 2) / count if k + 1 < len(ordered) else here
        if after - recall < recall - here and k + 1 < len(ordered):
            continue
        found.append(score)
        recall += 1 / RECALLS
    return found
