"""Results of a matrix of attacks and defences: rows, and rates with confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from lidar.tools.defences.scores import Score

_Z = 1.959964
"""Standard normal deviate of a two-sided interval of 95 %."""


@dataclass(frozen=True, slots=True)
class Rate:
    """A share with its 95 % interval; nan without trials.

    hits, count : of the trials
    blocks      : independent ones among them
    """

    hits: int
    count: int
    blocks: int
    share: float
    low: float
    high: float

    def to_text(self) -> str:
        """As ``83 % (66 to 93 %)``; a dash without trials."""
        if not self.count:
            return "–"
        return f"{100 * self.share:.0f} % ({100 * self.low:.0f} to {100 * self.high:.0f} %)"


def rate(hits: int, count: int, *, blocks: int) -> Rate:
    """A share with Wilson's interval.

    Frames that follow each other are no independent trials: the interval is that of ``blocks`` trials with
    the same share.
    """
    if not count:
        return Rate(0, 0, 0, math.nan, math.nan, math.nan)
    trials, share = min(max(blocks, 1), count), hits / count
    centre = (share + _Z**2 / (2 * trials)) / (1 + _Z**2 / trials)
    half = _Z * math.sqrt(share * (1 - share) / trials + _Z**2 / (4 * trials**2)) / (1 + _Z**2 / trials)
    return Rate(hits, count, trials, share, max(centre - half, 0.0), min(centre + half, 1.0))


@dataclass(frozen=True, slots=True)
class Success:
    """Success rate of an attack in a setting.

    scene    : of the drives; ``all`` for all of them
    attacked : frames that the attack changed
    success  : forge: attacked frames in which the detector reports a forged object; hide: targets that it no
               longer finds; mislead: attacked frames whose last fix is off. Targets are road users that it
               finds without the attack and that lost half of their returns.
    added, lost : mean number of returns of an attacked frame
    """

    attack: str
    goal: str
    setting: dict[str, str]
    scene: str
    frames: int
    attacked: int
    success: Rate
    added: float
    lost: float


@dataclass(frozen=True, slots=True)
class AttackDetection:
    """Detection rate of an attack by a defence in a setting.

    level    : ``frames`` or ``objects``
    genuine  : share of frames or objects without attack above the threshold
    attacked : share of attacked frames or forged objects above it
    score    : with the ROC and its area
    residual : success of the attack where the defence has no alarm: of the forged object that the detector
               reports, or of the frame if it does not judge objects or the goal is to hide
    latency  : median seconds from the first attacked frame of a drive to the first alarm; nan without any
    alarmed, drives : drives with an alarm in an attacked frame, and attacked drives
    """

    attack: str
    defence: str
    level: str
    setting: dict[str, str]
    scene: str
    genuine: Rate
    attacked: Rate
    score: Score
    residual: Rate
    latency: float
    alarmed: int
    drives: int


@dataclass(frozen=True, slots=True)
class DetectorAccuracy:
    """Recall and precision of the detector without attack, from ``near`` to ``far`` metres away."""

    setting: dict[str, str]
    scene: str
    kind: str
    near: int
    far: int
    recall: Rate
    precision: Rate
    false_per_frame: float


@dataclass(frozen=True, slots=True)
class DefenceCost:
    """Median seconds of a defence for a frame."""

    setting: dict[str, str]
    defence: str
    seconds: float
    frames: int


@dataclass(frozen=True, slots=True)
class Matrix:
    """Results of a matrix of attacks and defences."""

    success: list[Success]
    detection: list[AttackDetection]
    accuracy: list[DetectorAccuracy]
    cost: list[DefenceCost]

    @property
    def of_all_scenes(self) -> Matrix:
        """The rows that are not of a single scene."""
        return Matrix(
            [row for row in self.success if row.scene == "all"],
            [row for row in self.detection if row.scene == "all"],
            [row for row in self.accuracy if row.scene == "all"],
            self.cost,
        )


def document_of(rows: Iterable[Any]) -> list[dict[str, Any]]:
    """Rows of the matrix as JSON; unknown figures are null."""
    documents = []
    for row in rows:
        document = asdict(row)
        if isinstance(row, AttackDetection):
            document["score"] = row.score.to_json()
        documents.append(_without_nan(document))
    return documents


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_nan(part) for name, part in value.items()}
    if isinstance(value, float):
        return None if math.isnan(value) else round(value, 6)
    return value
