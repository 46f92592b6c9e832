"""Ground truth, which defences never see, and scores of suspicions against it: ROC, bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.untrusted import read_arrays
from geoscene.typing import Float
from lidar.dataset.layout import reading_file
from lidar.errors import DatasetError
from lidar.sensors.physics.origin import Origin
from lidar.signal.registry import ATTACKS, acts_on, read_stage
from lidar.tools.defences.observation import Observation, RecordedScans

LEVELS = ("returns", "objects", "frames")
"""What is scored."""

FALSE_ALARMS = {"returns": 0.001, "objects": 0.01, "frames": 0.05}
"""Share of genuine returns, objects and frames that may be suspected, by level."""

BINS = 2000
"""Steps of suspicion that samples are counted in."""
_BOOTSTRAPS = 1000

FORGED = (Origin.INJECTED, Origin.REPLAYED, Origin.MOVED)
"""Origins of returns that an attack adds or moves."""

FORGED_SHARE = 0.5
"""Share of a box's returns from which on attacked ones make it a forged object."""


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """Ground truth of the attacks on a frame.

    returns     : (n,) bool, returns that an attack gave
    removed_xyz : (k, 3) metres, sensor frame: genuine returns that are missing
    """

    returns: NDArray[np.bool_]
    removed_xyz: Float

    @property
    def attacked(self) -> bool:
        """Whether the frame differs from what the sensor measured."""
        return bool(self.returns.any()) or len(self.removed_xyz) > 0

    def objects(self, members: Sequence[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """Whether each box (m,), of which the rows of its returns are given, is forged."""
        return np.array(
            [len(rows) > 0 and self.returns[rows].mean() >= FORGED_SHARE for rows in members], bool
        )


def attack_truth(scans: RecordedScans, frame: Observation) -> FrameTruth:
    """As `frame_truth`; returns that are missing count only while an attack on the sensor's returns goes on.

    Weather, lost packets and dirt take returns, too, and are no attacks.
    """
    truth, recipe = frame_truth(scans, frame), scans.dataset.manifest["recipe"]
    with reading_file(scans.dataset.paths.manifest):
        stages = [table for key in ("stages", "applied_stages") for table in recipe.get(key, ())]
        goes_on = any(
            table["name"] in ATTACKS
            and acts_on(table, scans.sensor.name, kind="lidar")
            and _is_on(table, frame.start_ns * 1e-9)
            for table in stages
        )
    return truth if goes_on else replace(truth, removed_xyz=truth.removed_xyz[:0])


def _is_on(table: Mapping[str, Any], seconds: float) -> bool:
    """Whether an attack, as `NamedStage.to_json` writes it, goes on at a time since the drive's start."""
    stage = read_stage(table).stage
    return bool(getattr(stage, "start", 0.0) <= seconds < getattr(stage, "stop", math.inf))


def frame_truth(scans: RecordedScans, frame: Observation) -> FrameTruth:
    """The truth of a frame; without a truth file nothing was changed.

    Returns that weather hid are not counted as missing.

    Raises DatasetError for a truth file that is damaged or of another cloud.
    """
    path = scans.dataset.paths.truth(scans.sensor.name, frame.number)
    if not path.exists():
        return FrameTruth(np.zeros(len(frame), bool), np.empty((0, 3)))
    with reading_file(path):
        file = read_arrays(path)
        origin, hidden, removed = file["origin"], file["hidden"], file["removed"]
        xyz = file["removed_xyz"].astype(np.float64).reshape(-1, 3)
    if len(origin) != len(frame):
        raise DatasetError(f"{path}: is of {len(origin)} returns, the cloud has {len(frame)}")
    by_weather = hidden[(origin == Origin.WEATHER) & (hidden >= 0)]
    missing = ~np.isin(removed, by_weather)
    return FrameTruth(np.isin(origin, FORGED), xyz[missing])


@dataclass(frozen=True, slots=True)
class SuspicionCounts:
    """Counts of suspicions by frame and bin, from 0 to 1.

    genuine  : (frames, bins + 1)
    attacked : (frames, bins + 1)
    """

    genuine: NDArray[np.int64]
    attacked: NDArray[np.int64]

    @classmethod
    def of(cls, frames: Sequence[tuple[Float, NDArray[np.bool_]]]) -> SuspicionCounts:
        """Samples of frames; each gives its suspicions and which of them are of attacked ones."""
        genuine = np.zeros((len(frames), BINS + 1), np.int64)
        attacked = np.zeros_like(genuine)
        for k, (suspicion, truth) in enumerate(frames):
            rows = bins_of(suspicion)
            genuine[k] = np.bincount(rows[~truth], minlength=BINS + 1)
            attacked[k] = np.bincount(rows[truth], minlength=BINS + 1)
        return cls(genuine, attacked)


def bins_of(suspicion: Float) -> NDArray[np.int64]:
    """Bin of each suspicion."""
    return np.clip(np.round(np.asarray(suspicion) * BINS), 0, BINS).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Score:
    """Separation of attacked from genuine samples by their suspicion.

    genuine, attacked : numbers of both
    auc        : area under the ROC, with its 95 % interval; nan without both kinds
    threshold  : suspicion above which there is an alarm
    fpr, tpr   : shares of genuine and attacked ones above it, with their 95 % intervals
    roc        : (false positive rate, true positive rate) at falling thresholds
    """

    genuine: int
    attacked: int
    auc: tuple[float, float, float]
    threshold: float
    fpr: tuple[float, float, float]
    tpr: tuple[float, float, float]
    roc: list[tuple[float, float]]

    def to_json(self) -> dict[str, Any]:
        """Columns of the score; unknown figures are null."""
        document = asdict(self)
        for name in ("auc", "fpr", "tpr"):
            document[name] = [None if np.isnan(v) else round(v, 5) for v in document[name]]
        document["roc"] = [[round(x, 5), round(y, 5)] for x, y in self.roc]
        return document


def threshold_at(samples: SuspicionCounts, rate: float) -> float:
    """Lowest suspicion that at most a share ``rate`` of genuine samples exceeds; 1 if there is none."""
    genuine = samples.genuine.sum(axis=0)
    above = genuine.sum() - np.cumsum(genuine)
    allowed = np.flatnonzero(above <= rate * genuine.sum())
    return float(allowed[0] / BINS)


def score(samples: SuspicionCounts, *, threshold: float, rng: np.random.Generator) -> Score:
    """The score of samples at a threshold.

    Intervals are those of frames drawn with replacement (percentile bootstrap), as returns and objects of a
    frame are not independent.
    """
    weights = np.ones((1, len(samples.genuine)), np.int64)
    drawn = rng.multinomial(
        len(samples.genuine), np.full(len(samples.genuine), 1 / max(len(samples.genuine), 1)), _BOOTSTRAPS
    )
    every = np.concatenate([weights, drawn])
    # numpy multiplies matrices of integers ten times as slowly; counts are exact in float64
    genuine, attacked = (
        (every.astype(float) @ counts.astype(float)).astype(np.int64)
        for counts in (samples.genuine, samples.attacked)
    )
    alarm = int(np.floor(threshold * BINS + 1e-9)) + 1
    return Score(
        int(genuine[0].sum()),
        int(attacked[0].sum()),
        _interval(_area(genuine, attacked)),
        threshold,
        _interval(_share(genuine[:, alarm:].sum(axis=1), genuine.sum(axis=1))),
        _interval(_share(attacked[:, alarm:].sum(axis=1), attacked.sum(axis=1))),
        _curve(genuine[0], attacked[0]),
    )


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> Float:
    return np.where(whole > 0, part / np.maximum(whole, 1), np.nan)


def _area(genuine: NDArray[np.int64], attacked: NDArray[np.int64]) -> Float:
    """Areas under the ROC: the probability that an attacked one has the higher suspicion, ties half."""
    below = np.cumsum(genuine, axis=1) - genuine / 2
    pairs = genuine.sum(axis=1).astype(float) * attacked.sum(axis=1)
    area: Float = np.where(pairs > 0, (below * attacked).sum(axis=1) / np.maximum(pairs, 1), np.nan)
    return area


def _interval(values: Float) -> tuple[float, float, float]:
    """The first value, and the 95 % interval of the others."""
    known = values[1:][np.isfinite(values[1:])]
    if not np.isfinite(values[0]) or not len(known):
        return float(values[0]), float("nan"), float("nan")
    low, high = np.percentile(known, [2.5, 97.5])
    return float(values[0]), float(low), float(high)


def _curve(genuine: NDArray[np.int64], attacked: NDArray[np.int64]) -> list[tuple[float, float]]:
    """The corners of the ROC."""
    if not genuine.sum() or not attacked.sum():
        return []
    x = np.concatenate([[0], np.cumsum(genuine[::-1])]) / genuine.sum()
    y = np.concatenate([[0], np.cumsum(attacked[::-1])]) / attacked.sum()
    corner = np.ones(len(x), bool)
    corner[1:-1] = (np.diff(x)[:-1] > 0) | (np.diff(y)[:-1] > 0) | (np.diff(x)[1:] > 0) | (np.diff(y)[1:] > 0)
    points = np.unique(np.column_stack([x[corner], y[corner]]), axis=0)
    keep = np.linspace(0, len(points) - 1, min(len(points), 200)).round().astype(int)
    return [(float(a), float(b)) for a, b in points[np.unique(keep)]]
