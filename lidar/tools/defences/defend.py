"""Run defences on datasets, score the verdicts against ground truth, and write both."""

from __future__ import annotations

import io
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.drawing.report import Column, ReportTable, table_of
from geoscene.scene import Scene, SceneLike, open_scene
from geoscene.support.columns import write_columns
from geoscene.support.files import atomic_folder, write_atomically, write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Float
from lidar.dataset.derived import check_target
from lidar.dataset.layout import Dataset, DatasetLike, opened_datasets
from lidar.dataset.png import write_png
from lidar.errors import DatasetError, InputError
from lidar.geometry.random_streams import generator
from lidar.tools.defences.calibration import (
    FUSED,
    Calibration,
    Joint,
    calibration_text,
    fuse_verdicts,
    fused_threshold,
    joint_of,
    read_calibration,
    tail_of,
)
from lidar.tools.defences.defence import Verdict
from lidar.tools.defences.observation import RecordedScans, read_scans
from lidar.tools.defences.registry import Judged, NamedDefence, able, judged_frames, read_defences
from lidar.tools.defences.scores import (
    FALSE_ALARMS,
    LEVELS,
    FrameTruth,
    Score,
    SuspicionCounts,
    attack_truth,
    score,
)
from lidar.tools.detection import RULES, Detector
from lidar.tools.detection.learned import read_detector

_MARK = "defend.json"
"""File of a directory of verdicts: the scores."""

_NAMES = rf"{_MARK}|(frames|objects)\.csv|[^/]+/[^/]+/(\d{{6,}}\.npz|\w+/\d{{6,}}_[^/]+\.png)"
"""Regular expression of the paths of the files of verdicts."""

_Pairs = list[tuple[Float, NDArray[np.bool_]]]
_Row = dict[str, Any]


@dataclass
class DefenceTally:
    """Suspicions and truth of all frames, by defence and level, and the seconds of each frame."""

    pairs: dict[tuple[str, str], _Pairs] = field(default_factory=lambda: defaultdict(list))
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    frames: int = 0

    def add(self, judged: Judged, truth: FrameTruth) -> None:
        """Add a frame."""
        self.frames += 1
        forged = truth.objects(judged.frame.members)
        for name, verdict in judged.verdicts.items():
            if verdict.returns is not None:
                self.pairs[name, "returns"].append((verdict.returns, truth.returns))
            if verdict.objects is not None:
                self.pairs[name, "objects"].append((verdict.objects, forged))
            self.pairs[name, "frames"].append((np.array([verdict.frame]), np.array([truth.attacked])))
        for name, seconds in judged.seconds.items():
            self.seconds[name].append(seconds)

    def samples(self) -> dict[tuple[str, str], SuspicionCounts]:
        """Samples by defence and level."""
        return {key: SuspicionCounts.of(pairs) for key, pairs in self.pairs.items()}

    def joint(self, calibration: Calibration, *, rng: np.random.Generator) -> dict[str, Joint]:
        """Suspicions of the same samples by all defences, by level."""
        found = {}
        for level in LEVELS:
            columns = {name: pairs for (name, of), pairs in self.pairs.items() if of == level}
            if any(len(column) for pairs in columns.values() for column, _ in pairs):
                frames = ({name: pairs[k][0] for name, pairs in columns.items()} for k in range(self.frames))
                found[level] = joint_of(frames, calibration, level=level, rng=rng)
        return found


@dataclass(frozen=True, slots=True)
class Defended:
    """Verdicts of defences on datasets, with their scores.

    frames  : frames that were judged
    scores  : by defence and level
    seconds : median time of a frame, by defence
    """

    frames: int
    scores: dict[tuple[str, str], Score]
    seconds: dict[str, float]

    def document(self) -> dict[str, Any]:
        """The scores as JSON."""
        rows: dict[str, Any] = {}
        for (name, level), found in self.scores.items():
            rows.setdefault(name, {"seconds_per_frame": self.seconds.get(name)})[level] = found.to_json()
        return {"frames": self.frames, "false_alarms": FALSE_ALARMS, "defences": rows}


@shows_progress
def defend(
    datasets: DatasetLike | Sequence[DatasetLike],
    defences: str | Sequence[str | NamedDefence],
    *,
    calibration: Calibration | str | Path | None = None,
    detector: Detector | str = RULES,
    rule: str = "",
    scene: SceneLike | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    seed: int = 0,
    progress: Progress = displayed,
) -> Defended:
    """Judge datasets by defences, score the verdicts and write them to ``out``, all of them or none.

    defences  : also texts, as `read_defences` takes them
    calibration : of the same detector, or its file; by default the one that comes with the program
    detector  : that gives the boxes, also as `read_detector` takes it
    rule      : of `calibration.FUSIONS`, by which verdicts of several are also fused; none if empty
    overwrite : replace a directory with former verdicts; other files there are kept

    Raises InputError if the data lack what a defence needs, before anything is judged.
    """
    opened, chosen = opened_datasets(datasets), taken_defences(defences)
    detector = read_detector(detector) if isinstance(detector, str) else detector
    if not isinstance(calibration, Calibration):
        calibration = read_calibration(Path(calibration) if calibration else None, detector=detector)
    calibration.check(detector)
    scene, out = None if scene is None else open_scene(scene), None if out is None else Path(out)
    for dataset in opened:
        if out is not None:
            check_target(out, source=dataset.path, overwrite=overwrite)
    with nullcontext() if out is None else atomic_folder(out, mark=_MARK, names=_NAMES) as part:
        job = _job(opened, chosen, scene=scene, seed=seed, detector=detector)
        rule = rule if len(job.defences) > 1 else ""
        found = _judge(job, calibration, rule=rule, out=part, progress=progress)
        if part is not None:
            document = found.document() | {"datasets": [str(d.path) for d in opened], "fusion": rule}
            document |= {"calibration": calibration.note}
            document |= {"detector": {"name": detector.name, "identity": detector.identity}}
            write_json(part / _MARK, document | {"options": [n.to_json() for n in job.defences]})
    return found


def taken_defences(defences: str | Sequence[str | NamedDefence]) -> list[NamedDefence]:
    """Defences of Python code: texts as on the command line, or defences that were read."""
    chosen: list[NamedDefence] = []
    for one in [defences] if isinstance(defences, str) else defences:
        chosen += read_defences([one]) if isinstance(one, str) else [one]
    return chosen


def _judge(
    job: DefenceJob, calibration: Calibration, *, rule: str, out: Path | None, progress: Progress
) -> Defended:
    """Judge and score frames; with ``out`` write the verdicts."""
    defences = job.defences
    for named in defences:
        calibration.tail(named.name, "frames")
    thresholds = {
        (n.name, level): calibration.threshold(n.name, level)
        for n in defences
        for level in LEVELS
        if (n.name, level) in calibration.tails
    }
    if rule:
        names = [named.name for named in defences]
        thresholds |= {
            (FUSED, level): fused_threshold(calibration, names, level=level, rule=rule) for level in LEVELS
        }
    tally, tables = DefenceTally(), {"frames": list[_Row](), "objects": list[_Row]()}
    for place, scans, judged in job.judged(progress):
        if rule:
            judged.verdicts[FUSED] = fuse_verdicts(dict(judged.verdicts), calibration, rule=rule)
        frame = judged.frame
        truth = attack_truth(scans, frame)
        tally.add(judged, truth)
        if out is not None:
            for name, row in _rows(place, judged, truth=truth, thresholds=thresholds):
                tables[name].append(row)
            _write_returns(out / place / f"{frame.number:06d}.npz", judged.verdicts)
            _write_pictures(out / place, judged, defences=defences, thresholds=thresholds)
    if out is not None:
        for name, rows in tables.items():
            if rows:
                write_columns(out / f"{name}.csv", {key: [row[key] for row in rows] for key in rows[0]})
    rng = generator(job.seed, "bootstrap")
    return Defended(
        tally.frames,
        {key: score(samples, threshold=thresholds[key], rng=rng) for key, samples in tally.samples().items()},
        {name: float(np.median(seconds)) for name, seconds in tally.seconds.items()},
    )


def score_table(found: Defended) -> ReportTable:
    """The scores of each defence by frames and objects."""

    def milliseconds(row: tuple[str, str, Score]) -> str:
        return f"{1000 * found.seconds[row[0]]:.1f}" if row[0] in found.seconds else ""

    columns: tuple[Column[tuple[str, str, Score]], ...] = (
        Column("defence", lambda row: row[0]),
        Column("of", lambda row: row[1]),
        Column("genuine", lambda row: f"{row[2].genuine:,}"),
        Column("attacked", lambda row: f"{row[2].attacked:,}"),
        Column("threshold", lambda row: f"{row[2].threshold:.3f}"),
        Column("false alarms", lambda row: _with_interval(row[2].fpr)),
        Column("detected", lambda row: _with_interval(row[2].tpr)),
        Column("AUC", lambda row: _with_interval(row[2].auc)),
        Column("ms/frame", milliseconds),
    )
    return table_of(columns, [(name, level, one) for (name, level), one in found.scores.items()])


def _with_interval(values: tuple[float, float, float]) -> str:
    value, low, high = values
    if np.isnan(value):
        return "-"
    return f"{value:.3g}" if np.isnan(low) else f"{value:.3g} ({low:.3g} to {high:.3g})"


@shows_progress
def calibrate(
    datasets: DatasetLike | Sequence[DatasetLike],
    defences: str | Sequence[str | NamedDefence],
    *,
    out: str | Path,
    detector: Detector | str = RULES,
    scene: SceneLike | None = None,
    seed: int = 0,
    progress: Progress = displayed,
) -> Calibration:
    """Write the calibration of defences on datasets without attacks to a TOML file.

    Parameters are those of `defend`. Raises DatasetError if a frame was attacked.
    """
    detector = read_detector(detector) if isinstance(detector, str) else detector
    scene, out = None if scene is None else open_scene(scene), Path(out)
    job = _job(opened_datasets(datasets), taken_defences(defences), scene=scene, seed=seed, detector=detector)
    tally, names = DefenceTally(), []
    for _, scans, judged in job.judged(progress):
        truth = attack_truth(scans, judged.frame)
        if truth.attacked:
            raise DatasetError(f"{scans.dataset.path}: was attacked; calibrate on genuine data")
        tally.add(judged, truth)
        names.append(f"{scans.dataset.path.name} ({scans.sensor.model})")
    note = f"{tally.frames} frames of {', '.join(dict.fromkeys(names))}"
    found = Calibration({key: tail_of(samples) for key, samples in tally.samples().items()}, note)
    joint = tally.joint(found, rng=generator(seed, "calibration"))
    found = replace(found, joint=joint, detector=detector.identity)
    write_atomically(out, calibration_text(found).encode())
    return found


@dataclass(frozen=True)
class DefenceJob:
    """Frames to judge: scanners of datasets with the folder of their files, and the defences they allow."""

    scans: tuple[tuple[Path, RecordedScans], ...]
    defences: tuple[NamedDefence, ...]
    scene: Scene | None
    seed: int

    def judged(self, progress: Progress) -> Iterator[tuple[Path, RecordedScans, Judged]]:
        """The frames in order."""
        for place, scans in self.scans:
            scene = self.scene_of(scans.dataset)
            for one in judged_frames(scans, self.defences, scene=scene, seed=self.seed, progress=progress):
                yield place, scans, one

    def scene_of(self, dataset: Dataset) -> Scene | None:
        """The scene that a dataset is compared with; None if no defence needs one."""
        if not any("scene" in named.defence.needs for named in self.defences):
            return None
        return open_scene(dataset.scene_path) if self.scene is None else self.scene


def _job(
    datasets: Sequence[Dataset],
    defences: Sequence[NamedDefence],
    *,
    scene: Scene | None,
    seed: int,
    detector: Detector,
) -> DefenceJob:
    """The frames of all scanners of datasets; raises InputError as `able` does."""
    scans = []
    for k, dataset in enumerate(datasets):
        name = dataset.path.name if len(datasets) == 1 else f"{k}_{dataset.path.name}"
        scans += [(Path(name) / each.sensor.name, each) for each in read_scans(dataset, detector=detector)]
    job = DefenceJob(
        tuple(scans), tuple(able([each for _, each in scans], defences, scene=scene)), scene, seed
    )
    for _, each in scans:
        if (seen := job.scene_of(each.dataset)) is not None and seen.frame != each.dataset.frame:
            raise InputError(
                f"{seen.path}: is in another frame (CRS and origin) than {each.dataset.path};"
                " give the scene that was driven in, or one in its frame"
            )
    return job


def _write_returns(path: Path, verdicts: dict[str, Verdict]) -> None:
    """Suspicions of the returns of a frame by defence, and places of missing ones, as a NumPy archive."""
    columns: dict[str, NDArray[Any]] = {}
    for name, verdict in verdicts.items():
        if verdict.returns is not None:
            columns[name] = verdict.returns.astype(np.float32)
        if len(verdict.gaps):
            gaps = verdict.gaps
            columns[f"{name}_gaps"] = np.column_stack([gaps.xy, gaps.radius, gaps.suspicion]).astype(
                np.float32
            )
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **columns)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())


def _write_pictures(
    folder: Path,
    judged: Judged,
    *,
    defences: Sequence[NamedDefence],
    thresholds: dict[tuple[str, str], float],
) -> None:
    for named in defences:
        threshold = thresholds.get((named.name, "objects"), 1.0)
        shown = named.defence.pictures(judged.frame, judged.verdicts[named.name], threshold=threshold)
        for name, image in shown.items():
            write_png(folder / named.name / f"{judged.frame.number:06d}_{name}.png", image)


def _rows(
    place: Path, judged: Judged, *, truth: FrameTruth, thresholds: dict[tuple[str, str], float]
) -> Iterator[tuple[str, _Row]]:
    """Rows of ``frames.csv`` and ``objects.csv`` of a frame, with the name of the table."""
    frame, boxes = judged.frame, judged.frame.objects
    forged = truth.objects(frame.members)
    for name, verdict in judged.verdicts.items():
        known: _Row = {"data": str(place), "frame": frame.number, "defence": name}
        of_frame: _Row = {
            "suspicion": round(verdict.frame, 5),
            "alarm": int(verdict.frame > thresholds[name, "frames"]),
            "attacked": int(truth.attacked),
            "attacked_returns": int(truth.returns.sum()),
            "removed_returns": len(truth.removed_xyz),
        }
        yield "frames", known | of_frame
        for k, suspicion in enumerate(() if verdict.objects is None else verdict.objects):
            box: _Row = dict(zip(("x", "y", "z"), boxes.centre[k].round(3).tolist(), strict=True))
            box |= dict(zip(("length", "width", "height"), boxes.size[k].round(3).tolist(), strict=True))
            box |= {"yaw": round(float(boxes.yaw[k]), 4), "kind": str(boxes.kind[k])}
            alarm = int(suspicion > thresholds[name, "objects"])
            found = {"suspicion": round(float(suspicion), 5), "alarm": alarm, "forged": int(forged[k])}
            yield "objects", known | {"object": k} | box | found
