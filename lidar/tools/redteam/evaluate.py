"""The matrix of attacks and defences, from the figures of its drives."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidar.geometry.random_streams import generator
from lidar.tools.defences.calibration import FUSED, Calibration, fuse_verdicts, tail_of
from lidar.tools.defences.defence import Verdict
from lidar.tools.defences.scores import SuspicionCounts, score, threshold_at
from lidar.tools.redteam.matrix import (
    AttackDetection,
    DefenceCost,
    DetectorAccuracy,
    Matrix,
    Rate,
    Success,
    rate,
)
from lidar.tools.redteam.measure import FEWEST, is_attacked
from lidar.tools.redteam.plan import GOALS, Attack, Measure, Run

POOLED = ("scene", "route")
"""Conditions that a setting has all of; the others, such as rig and weather, are kept apart."""

RANGES = (0, 10, 20, 30, 40, 60)
"""Metres that bound the distances of the detector's table."""

_LEVELS = ("frames", "objects")
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

    def parted(self, seconds: float) -> Figures:
        """The drive with the key ``block`` of the independent part that each frame belongs to."""
        parts = [(self.run.drive.name, f["sensor"], int(f["seconds"] // seconds)) for f in self.frames]
        return replace(self, frames=[f | {"block": p} for f, p in zip(self.frames, parts, strict=True)])


def evaluate(figures: Sequence[Figures], attacks: Sequence[Attack], *, measure: Measure) -> Matrix:
    """The matrix of drives with and without attack; attacks by goal, the most successful first."""
    found = Matrix([], [], [], [])
    figures = _add_fused([one.parted(measure.block) for one in figures])
    thresholds = _thresholds(figures, measure=measure)
    for setting, scene, drives in _groups(figures):
        plain = [one for one in drives if one.run.attack is None]
        known = {"setting": setting, "scene": scene}
        found.accuracy.extend(accuracies(_frames(plain), measure=measure, known=known))
        if scene == "all":
            found.cost.extend(_costs(_frames(drives), setting=setting))
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


def _frames(drives: Iterable[Figures]) -> list[dict[str, Any]]:
    """The frames of drives."""
    return [frame for one in drives for frame in one.frames]


def _clear(figures: Iterable[Figures]) -> dict[str, list[dict[str, Any]]]:
    """Frames without attack by sensor, of which those without weather if there are."""
    plain: dict[str, list[Figures]] = defaultdict(list)
    for one in figures:
        if one.run.attack is None:
            plain[_sensor_of(one.setting)].append(one)
    return {
        key: _frames([one for one in drives if not one.setting.get("weather")] or drives)
        for key, drives in plain.items()
    }


def _add_fused(figures: Sequence[Figures]) -> list[Figures]:
    """The drives with the verdict of all defences together as one more, if there are several."""
    calibrations = {}
    for key, frames in _clear(figures).items():
        samples = {
            (d, level): _samples(frames, defence=d, level=level)
            for d in _defences(frames)
            for level in _LEVELS
        }
        calibrations[key] = Calibration({k: tail_of(own) for k, own in samples.items() if own.genuine.any()})
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
    allowed = dict(zip(_LEVELS, (measure.false_alarms, measure.false_objects), strict=True))
    return {
        key: {
            (defence, level): threshold_at(_samples(frames, defence=defence, level=level), share)
            for defence in _defences(frames)
            for level, share in allowed.items()
        }
        for key, frames in _clear(figures).items()
    }


def _defences(frames: Iterable[Mapping[str, Any]]) -> list[str]:
    """Defences that judged frames, in order."""
    return list(dict.fromkeys(name for frame in frames for name in frame["suspicion"]))


def _samples(
    plain: Iterable[Mapping[str, Any]],
    attacked: Iterable[Mapping[str, Any]] = (),
    *,
    defence: str,
    level: str,
) -> SuspicionCounts:
    """Suspicions of a defence by independent blocks, of frames without attack and of attacked ones."""
    blocks: dict[tuple[str, str, int], list[tuple[float, bool]]] = defaultdict(list)
    for frame, forged in [*((frame, False) for frame in plain), *((frame, True) for frame in attacked)]:
        if defence in frame["suspicion"]:
            blocks[frame["block"]] += _suspicions(frame, defence, level=level, forged=forged)
    columns = [np.array(pairs) for pairs in blocks.values() if pairs]
    return SuspicionCounts.of([(column[:, 0], column[:, 1] > 0) for column in columns])


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
    frames = _frames(drives)
    attacked = [frame for frame in frames if is_attacked(frame)]
    return Success(
        attack.name,
        attack.goal,
        frames=len(frames),
        attacked=len(attacked),
        success=_success_rate(attacked, attack, measure=measure),
        added=_mean(frame["added"] for frame in attacked),
        lost=_mean(frame["lost"] for frame in attacked),
        **known,
    )


def _success_rate(
    attacked: Sequence[Mapping[str, Any]],
    attack: Attack,
    *,
    measure: Measure,
    defence: str = "",
    thresholds: Mapping[tuple[str, str], float] | None = None,
) -> Rate:
    """Success among attacked frames; with a defence, where that has no alarm."""
    hits = count = 0
    blocks = set()
    for frame in attacked:
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
        blocks |= {frame["block"]} if tried else set()
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
    genuine, frames = _frames(plain), [frame for frame in _frames(attacked) if is_attacked(frame)]
    for defence in _defences(_frames(attacked)):
        judged = [frame for frame in frames if defence in frame["suspicion"]]
        residual = _success_rate(judged, attack, measure=measure, defence=defence, thresholds=thresholds)
        for level in _LEVELS:
            threshold = thresholds.get((defence, level), 1.0)
            samples = _samples(genuine, frames, defence=defence, level=level)
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
    frames: Sequence[Mapping[str, Any]], *, measure: Measure, known: dict[str, Any]
) -> Iterator[DetectorAccuracy]:
    """Accuracy of a detector in frames without attack; ``block`` is the independent trial that one is of.

    known : fields of the rows that are not measured
    """
    if not frames:
        return
    for kind in ("vehicle", "person", "cycle"):
        for near, far in itertools.pairwise(RANGES):
            users: list[tuple[Any, bool]] = []
            boxes: list[tuple[Any, bool]] = []
            for frame in frames:
                objects, block = frame["objects"], frame["block"]
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


def _costs(frames: Iterable[Mapping[str, Any]], *, setting: dict[str, str]) -> Iterator[DefenceCost]:
    seconds: dict[str, list[float]] = defaultdict(list)
    for frame in frames:
        for name, spent in frame["cost"].items():
            seconds[name].append(spent)
    for name, spent in seconds.items():
        yield DefenceCost(setting, name, float(np.median(spent)), len(spent))
