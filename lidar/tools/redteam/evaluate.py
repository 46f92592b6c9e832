"""The matrix of attacks and defences, from the figures of its drives."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from lidar.geometry.random_streams import generator
from lidar.tools.defences.calibration import Calibration, tail_of
from lidar.tools.defences.fusion import FUSED, fuse_verdicts
from lidar.tools.defences.scores import Score, SuspicionCounts, score, threshold_at
from lidar.tools.defences.verdict import Verdict
from lidar.tools.redteam.measure import FEWEST, is_attacked
from lidar.tools.redteam.plan import GOALS, Attack, Measure, Run
from lidar.tools.redteam.statistics import Rate, rate

POOLED = ("scene", "route")
"""Conditions that a setting has all of; the others, such as rig and weather, are kept apart."""

RANGES = (0, 10, 20, 30, 40, 60)
"""Metres that bound the distances of the detector's table."""

_SEED = 0


@dataclass(frozen=True, slots=True)
class Figures:
    """A drive of the matrix with the figures of `lidar.tools.redteam.measure`.

    detector : that gave the boxes; empty if all drives have the same
    """

    run: Run
    frames: list[dict[str, Any]]
    absent: list[str]
    detector: str = ""

    @property
    def setting(self) -> dict[str, str]:
        """Its conditions that are not pooled."""
        conditions = {name: text for name, text in self.run.conditions.items() if name not in POOLED}
        return conditions | ({"detector": self.detector} if self.detector else {})

    def block(self, frame: Mapping[str, Any], *, seconds: float) -> tuple[str, str, int]:
        """Key of the independent part of a drive that a frame belongs to."""
        return self.run.drive.name, frame["sensor"], int(frame["seconds"] // seconds)


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


def evaluate(figures: Sequence[Figures], attacks: Sequence[Attack], *, measure: Measure) -> Matrix:
    """The matrix of drives with and without attack; attacks by goal, the most successful first."""
    found = Matrix([], [], [], [])
    figures = _add_fused(figures, block=measure.block)
    thresholds = _thresholds(figures, measure=measure)
    for setting, scene, drives in _groups(figures):
        plain = [one for one in drives if one.run.attack is None]
        known = {"setting": setting, "scene": scene}
        frames = [(one.block(frame, seconds=measure.block), frame) for one in plain for frame in one.frames]
        found.accuracy.extend(accuracies(frames, measure=measure, known=known))
        if scene == "all":
            found.cost.extend(_costs(drives, setting=setting))
        for attack in attacks:
            mine = [one for one in drives if one.run.attack == attack]
            if mine:
                found.success.append(_success(mine, attack, measure=measure, known=known))
                chosen = thresholds[_sensor_of(setting)]
                found.detection.extend(
                    _detections(mine, plain, attack=attack, measure=measure, known=known, thresholds=chosen)
                )
    rank = _ranks([row for row in found.success if row.scene == "all"])
    found.success.sort(key=lambda row: rank[row.attack])
    found.detection.sort(key=lambda row: rank[row.attack])
    return found


def _ranks(rows: Sequence[Success]) -> dict[str, tuple[int, float, str]]:
    """Order of attacks: by goal, then by their mean success, those without trials last."""
    shares: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        shares[row.attack].append(row.success.share if row.success.count else -1.0)
    return {
        row.attack: (GOALS.index(row.goal), -float(np.mean(shares[row.attack])), row.attack) for row in rows
    }


def _groups(figures: Sequence[Figures]) -> Iterator[tuple[dict[str, str], str, list[Figures]]]:
    """Drives by setting and scene, and of all scenes of a setting if there are several."""
    settings: dict[str, list[Figures]] = defaultdict(list)
    for one in figures:
        settings[str(one.setting)].append(one)
    for drives in settings.values():
        scenes: dict[str, list[Figures]] = defaultdict(list)
        for one in drives:
            scenes[one.run.conditions.get("scene", one.run.drive.scene.name)].append(one)
        yield drives[0].setting, "all", drives
        if len(scenes) > 1:
            for scene, some in scenes.items():
                yield drives[0].setting, scene, some


def _sensor_of(setting: Mapping[str, str]) -> str:
    """The setting without the weather, to which a defence is calibrated."""
    return str({name: text for name, text in setting.items() if name != "weather"})


def _clear(figures: Iterable[Figures]) -> dict[str, list[Figures]]:
    """Drives without attack by sensor, of which those without weather if there are."""
    plain: dict[str, list[Figures]] = defaultdict(list)
    for one in figures:
        if one.run.attack is None:
            plain[_sensor_of(one.setting)].append(one)
    return {
        key: [one for one in drives if not one.setting.get("weather")] or drives
        for key, drives in plain.items()
    }


def _add_fused(figures: Sequence[Figures], *, block: float) -> list[Figures]:
    """The drives with the verdict of all defences together as one more, if there are several."""
    calibrations = {}
    for key, drives in _clear(figures).items():
        tails = {}
        for defence in _defences(drives):
            for level in ("frames", "objects"):
                samples = _samples(drives, (), defence=defence, level=level, block=block)
                if samples.genuine.any():
                    tails[defence, level] = tail_of(samples)
        calibrations[key] = Calibration(tails)
    return [
        replace(
            one, frames=[_fused_frame(frame, calibrations[_sensor_of(one.setting)]) for frame in one.frames]
        )
        for one in figures
    ]


def _fused_frame(frame: Mapping[str, Any], calibration: Calibration) -> dict[str, Any]:
    """A frame with the fused verdict of its calibrated defences."""
    verdicts = {}
    for name, suspicion in frame["suspicion"].items():
        objects = frame["object_suspicion"].get(name) if (name, "objects") in calibration.tails else None
        if (name, "frames") in calibration.tails:
            verdicts[name] = Verdict(None, None if objects is None else np.array(objects, float), suspicion)
    if len(verdicts) < 2:
        return dict(frame)
    found = fuse_verdicts(verdicts, calibration, rule="harmonic")
    objects = {} if found.objects is None else {FUSED: found.objects.tolist()}
    return {
        **frame,
        "suspicion": frame["suspicion"] | {FUSED: found.frame},
        "object_suspicion": frame["object_suspicion"] | objects,
    }


def _thresholds(figures: Sequence[Figures], *, measure: Measure) -> dict[str, dict[tuple[str, str], float]]:
    """Thresholds by sensor, defence and level, of drives without attack, and without weather if there are."""
    allowed = {"frames": measure.false_alarms, "objects": measure.false_objects}
    found: dict[str, dict[tuple[str, str], float]] = {}
    for key, clear in _clear(figures).items():
        found[key] = {
            (defence, level): threshold_at(
                _samples(clear, (), defence=defence, level=level, block=measure.block), share
            )
            for defence in _defences(clear)
            for level, share in allowed.items()
        }
    return found


def _defences(drives: Iterable[Figures]) -> list[str]:
    """Defences that judged drives, in order."""
    return list(dict.fromkeys(name for one in drives for frame in one.frames for name in frame["suspicion"]))


def _samples(
    plain: Iterable[Figures], attacked: Iterable[Figures], *, defence: str, level: str, block: float
) -> SuspicionCounts:
    """Suspicions of a defence by independent blocks, of drives without attack and of attacked ones."""
    blocks: dict[tuple[str, str, int], list[tuple[float, bool]]] = defaultdict(list)
    for one, truth in [*((one, False) for one in plain), *((one, True) for one in attacked)]:
        for frame in one.frames:
            if defence in frame["suspicion"] and (not truth or is_attacked(frame)):
                blocks[one.block(frame, seconds=block)] += _suspicions(
                    frame, defence, level=level, forged=truth
                )
    return SuspicionCounts.of(
        [
            (np.array([s for s, _ in pairs]), np.array([truth for _, truth in pairs], bool))
            for pairs in blocks.values()
            if pairs
        ]
    )


def _suspicions(
    frame: Mapping[str, Any], defence: str, *, level: str, forged: bool
) -> list[tuple[float, bool]]:
    """Suspicions of a frame, or of its forged or all other objects."""
    if level == "frames":
        return [(frame["suspicion"][defence], forged)]
    columns = zip(frame["object_suspicion"].get(defence, []), frame["objects"]["forged"], strict=False)
    return [(suspicion, forged) for suspicion, is_forged in columns if is_forged == forged]


def _success(
    drives: Sequence[Figures], attack: Attack, *, measure: Measure, known: dict[str, Any]
) -> Success:
    frames = [(one.block(frame, seconds=measure.block), frame) for one in drives for frame in one.frames]
    attacked = [(block, frame) for block, frame in frames if is_attacked(frame)]
    return Success(
        attack.name,
        attack.goal,
        frames=len(frames),
        attacked=len(attacked),
        success=_success_rate(attacked, attack, measure=measure),
        added=_mean(frame["added"] for _, frame in attacked),
        lost=_mean(frame["lost"] for _, frame in attacked),
        **known,
    )


def _success_rate(
    attacked: Sequence[tuple[Any, Mapping[str, Any]]],
    attack: Attack,
    *,
    measure: Measure,
    defence: str = "",
    thresholds: Mapping[tuple[str, str], float] | None = None,
) -> Rate:
    """Success among attacked frames, each with its block; with a defence, where that has no alarm."""
    hits = count = 0
    blocks = set()
    for block, frame in attacked:
        silent = not defence or frame["suspicion"][defence] <= (thresholds or {})[defence, "frames"]
        if attack.goal == "hide":
            tried, reached = frame["targets"], frame["hidden"] * silent
        elif attack.goal == "mislead":
            tried, reached = 1, int(silent and frame["fix_error"] >= measure.deviation)
        else:
            suspicions = frame["object_suspicion"].get(defence)
            if suspicions is None:
                passed = [silent] * len(frame["objects"]["score"])
            else:
                passed = [suspicion <= (thresholds or {})[defence, "objects"] for suspicion in suspicions]
            objects = zip(frame["objects"]["forged"], frame["objects"]["score"], passed, strict=True)
            tried, reached = 1, int(any(f and s >= measure.score and p for f, s, p in objects))
        hits, count = hits + reached, count + tried
        blocks |= {block} if tried else set()
    return rate(hits, count, blocks=len(blocks))


def _mean(values: Iterable[float]) -> float:
    known = list(values)
    return round(sum(known) / len(known), 1) if known else math.nan


def _detections(
    attacked: Sequence[Figures],
    plain: Sequence[Figures],
    *,
    attack: Attack,
    measure: Measure,
    known: dict[str, Any],
    thresholds: Mapping[tuple[str, str], float],
) -> Iterator[AttackDetection]:
    frames = [
        (one.block(frame, seconds=measure.block), frame)
        for one in attacked
        for frame in one.frames
        if is_attacked(frame)
    ]
    for defence in _defences(attacked):
        judged = [(block, frame) for block, frame in frames if defence in frame["suspicion"]]
        residual = _success_rate(judged, attack, measure=measure, defence=defence, thresholds=thresholds)
        for level in ("frames", "objects"):
            threshold = thresholds.get((defence, level), 1.0)
            samples = _samples(plain, attacked, defence=defence, level=level, block=measure.block)
            if not samples.attacked.any() and level == "objects":
                continue
            found = score(samples, threshold=threshold, rng=generator(_SEED, attack.name, defence, level))
            if min(map(_blocks, (samples.genuine, samples.attacked))) < 2:  # one block tells no spread
                found = replace(found, auc=(found.auc[0], math.nan, math.nan))
            latencies = [_latency(one, defence, threshold=thresholds[defence, "frames"]) for one in attacked]
            tried = [late for late in latencies if late is not None]
            heard = [late for late in tried if math.isfinite(late)]
            yield AttackDetection(
                attack.name,
                defence,
                level,
                genuine=_share(found.fpr[0], found.genuine, blocks=samples.genuine),
                attacked=_share(found.tpr[0], found.attacked, blocks=samples.attacked),
                score=found,
                residual=residual,
                latency=float(np.median(heard)) if heard else math.nan,
                alarmed=len(heard),
                drives=len(tried),
                **known,
            )


def _share(share: float, count: int, *, blocks: Any) -> Rate:
    if not count:
        return rate(0, 0, blocks=0)
    return rate(round(share * count), count, blocks=_blocks(blocks))


def _blocks(counts: Any) -> int:
    """Number of blocks that have samples."""
    return int(np.count_nonzero(counts.any(axis=1)))


def _latency(one: Figures, defence: str, *, threshold: float) -> float | None:
    """Seconds from the first attacked frame to the first alarm in one; None without attacked frames."""
    attacked = [frame for frame in one.frames if is_attacked(frame) and defence in frame["suspicion"]]
    if not attacked:
        return None
    alarms = [frame["seconds"] for frame in attacked if frame["suspicion"][defence] > threshold]
    return min(alarms) - min(frame["seconds"] for frame in attacked) if alarms else math.inf


def accuracies(
    frames: Sequence[tuple[Any, Mapping[str, Any]]], *, measure: Measure, known: dict[str, Any]
) -> Iterator[DetectorAccuracy]:
    """Accuracy of a detector in frames without attack, each with its block.

    known : fields of the rows that are not measured
    """
    if not frames:
        return
    for kind in ("vehicle", "person", "cycle"):
        for near, far in itertools.pairwise(RANGES):
            users: list[tuple[Any, bool]] = []
            boxes: list[tuple[Any, bool]] = []
            for block, frame in frames:
                objects = frame["objects"]
                columns = zip(
                    objects["score"], objects["user"], objects["kind"], objects["distance"], strict=True
                )
                chosen = [(user, k, away) for s, user, k, away in columns if s >= measure.score]
                found = {user for user, _, _ in chosen}
                boxes += [(block, user >= 0) for user, k, away in chosen if k == kind and near <= away < far]
                users += [
                    (block, user["id"] in found)
                    for user in frame["users"]
                    if user["kind"] == kind and near <= user["distance"] < far and user["points"] >= FEWEST
                ]
            yield DetectorAccuracy(
                kind=kind,
                near=near,
                far=far,
                recall=_rate_of(users),
                precision=_rate_of(boxes),
                false_per_frame=round(sum(not true for _, true in boxes) / len(frames), 4),
                **known,
            )


def _rate_of(trials: Sequence[tuple[Any, bool]]) -> Rate:
    return rate(sum(hit for _, hit in trials), len(trials), blocks=len({block for block, _ in trials}))


def _costs(drives: Sequence[Figures], *, setting: dict[str, str]) -> Iterator[DefenceCost]:
    seconds: dict[str, list[float]] = defaultdict(list)
    for frame in (frame for one in drives for frame in one.frames):
        for name, spent in frame["cost"].items():
            seconds[name].append(spent)
    for name, spent in seconds.items():
        yield DefenceCost(setting, name, float(np.median(spent)), len(spent))


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
