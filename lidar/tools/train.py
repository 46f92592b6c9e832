"""Trains a detector of road users on recorded drives, whose labels are the truth."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from geoscene import __version__
from geoscene.errors import need
from geoscene.support.columns import Columns
from geoscene.support.processes import run_tasks
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.layout import Dataset, DatasetLike, opened_datasets
from lidar.dataset.recorded import Stream, cloud_points, instance_clouds
from lidar.errors import DatasetError, InputError
from lidar.tools.detection.clusters import PLAIN, find_clusters
from lidar.tools.detection.detector import KINDS
from lidar.tools.detection.forest import Forest, forest_of
from lidar.tools.detection.learned import CLASSES, FEATURES, Learned, features

FEWEST = 20
"""Clusters of a kind that a model needs to learn it."""

_SHARE = 0.5
"""Share of a cluster's points from which on they make it the object's that they are of."""
_FOLDS = 3
_LEAVES = 256
"""Leaves of a tree."""
_LEAF = 3
"""Clusters at a leaf."""
_THRESHOLDS = np.linspace(0.05, 0.95, 91)


@dataclass(frozen=True, slots=True)
class Examples(Columns):
    """Labelled clusters for training.

    measures : (n, features) float32, as `lidar.tools.detection.learned.features`
    kind     : (n,) row of `lidar.tools.detection.learned.CLASSES`
    group    : (n,) part of the data that they are of: those of one part are alike
    """

    measures: NDArray[np.float32]
    kind: Ints
    group: Ints


@dataclass(frozen=True, slots=True)
class Trained:
    """A model that was trained.

    examples  : clusters by kind
    precision, recall : by kind, of clusters of parts of the data that were left out in training, at the
                        score from which on a detection counts; none of a kind with too few examples
    """

    path: Path
    frames: int
    examples: dict[str, int]
    threshold: dict[str, float] = field(default_factory=dict)
    precision: dict[str, float] = field(default_factory=dict)
    recall: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """All figures."""
        names = ("frames", "examples", "threshold", "precision", "recall")
        return {"path": str(self.path)} | {name: getattr(self, name) for name in names}

    def table(self) -> list[list[str]]:
        """Rows of a table, the head first."""
        rows = [["kind", "clusters", "threshold", "recall", "precision"]]
        for kind in CLASSES[1:]:
            figures = ["too few", "-", "-"]
            if kind in self.recall:
                shares = (self.recall[kind], self.precision[kind])
                figures = [f"{self.threshold[kind]:.2f}", *(f"{100 * share:.0f} %" for share in shares)]
            rows.append([kind, f"{self.examples[kind]:,}", *figures])
        return rows


@shows_progress
def train(
    datasets: DatasetLike | Sequence[DatasetLike],
    out: str | Path,
    *,
    seed: int = 0,
    trees: int = 60,
    every: int = 1,
    workers: int = 1,
    progress: Progress = displayed,
) -> Trained:
    """Train a detector on the labelled clouds of datasets and write its model to ``out``.

    A cluster is of a road user if half of its points are, and none of the user's other clusters has more;
    what is left of others is nothing, so that a road user is found once. The forest has probabilities of each
    kind. The threshold of a kind is the probability at which most of its clusters in left-out drives (or
    quarters of drives, with fewer than three) are found without finding others: that of the largest F1.

    seed  : of the forest
    trees : of the forest
    every : of how many frames one is used; those that follow each other are nearly the same

    Raises InputError for numbers out of their bounds, and if there are no road users, or too few vehicles;
    MissingExtraError without scikit-learn.
    """
    for name, value, low, high in (
        ("seed", seed, 0, (1 << 32) - 1),  # as scikit-learn takes it
        ("trees", trees, 1, 10_000),
        ("every", every, 1, 1_000_000),
        ("workers", workers, 1, 256),
    ):
        if not low <= value <= high:
            raise InputError(f"`{name}` {value}: give {low} to {high}")
    need("sklearn", "learn")
    opened = opened_datasets(datasets)
    jobs = _jobs(opened, every=every)
    found: dict[int, Examples] = {}
    progress("clusters", 0, total=len(jobs))
    for number, examples in run_tasks(_examples, jobs, workers=workers):
        found[number] = examples
        progress("clusters", len(found), total=len(jobs))
    parts = [found[number] for number in sorted(found)]
    data = Examples.concatenate(parts)
    counts = {kind: int((data.kind == row).sum()) for row, kind in enumerate(CLASSES)}
    _check(counts, opened)
    data = data.take(np.isin(data.kind, [row for row, kind in enumerate(CLASSES) if counts[kind] >= FEWEST]))
    left_out = _left_out(data, seed=seed, trees=trees, progress=progress)
    chosen = {
        kind: _best_threshold(left_out[:, row], data.kind == row)
        for row, kind in enumerate(CLASSES)
        if row and counts[kind] >= FEWEST
    }
    progress("forest", 0, total=1)
    model = Learned(
        _forest(data, seed=seed, trees=trees),
        {kind: chosen[kind][0] if kind in chosen else 0.5 for kind in CLASSES[1:]},
        str(out),
        training={
            "program": f"geoscene lidar {__version__}",
            "seed": seed,
            "trees": trees,
            "every": every,
            "clusters": counts,
            "drives": _drives(opened),
        },
    )
    model.write(Path(out))
    progress("forest", 1, total=1)
    columns = [{kind: row[k] for kind, row in chosen.items()} for k in range(3)]
    return Trained(Path(out), sum(len(job.rows) for job in jobs), counts, *columns)


class _Job(NamedTuple):
    """Frames of a scanner, the number of the job, and the first part of the data that is its own."""

    number: int
    clouds: Stream
    rows: Ints
    group: int


def _jobs(datasets: Sequence[Dataset], *, every: int) -> list[_Job]:
    """All scanners of all datasets."""
    jobs: list[_Job] = []
    for k, dataset in enumerate(datasets):
        scanners = dataset.sensors("lidar")
        if not scanners:
            raise DatasetError(f"{dataset.path}: has no scanner")
        for name in scanners:
            clouds = instance_clouds(dataset, name)
            jobs.append(_Job(len(jobs), clouds, np.arange(0, len(clouds.files), every), 4 * k))
    return jobs


def _examples(job: _Job) -> tuple[int, Examples]:
    """The clusters of a job's frames. Run by workers."""
    measures, kinds, groups = [np.empty((0, len(FEATURES)), np.float32)], [np.empty(0, np.int64)], []
    for k, row in enumerate(job.rows.tolist()):
        table = cloud_points(job.clouds.files[row])
        measure, kind = examples_of(table)
        measures.append(measure)
        kinds.append(kind)
        groups.append(np.full(len(kind), job.group + 4 * k // len(job.rows)))
    group = np.concatenate([np.empty(0, np.int64), *groups])
    return job.number, Examples(np.concatenate(measures), np.concatenate(kinds), group)


class _Cloud(NamedTuple):
    """A cloud as a detector reads it."""

    xyz: Float


def examples_of(table: dict[str, NDArray[Any]]) -> tuple[NDArray[np.float32], Ints]:
    """Measures of the clusters of a labelled cloud, and rows of `CLASSES` that they are."""
    scan = find_clusters(
        _Cloud(np.column_stack([table[axis] for axis in "xyz"]).astype(float)), settings=PLAIN
    )
    label, instance = table["label"][scan.row], table["instance"][scan.row]
    of_class = np.zeros(256, np.int64)
    for code, name in KINDS.items():
        of_class[code] = CLASSES.index(name)
    kind = np.zeros(len(scan.clusters), np.int64)
    largest: dict[int, tuple[int, int]] = {}
    for k, one in enumerate(scan.clusters):
        user = of_class[label[one.rows]] > 0
        users, counts = np.unique(instance[one.rows[user]], return_counts=True)
        if len(users) and counts.max() >= _SHARE * len(one.rows):
            number, count = int(users[counts.argmax()]), int(counts.max())
            of = int(of_class[label[one.rows[user]][instance[one.rows[user]] == number][0]])
            former = largest.get(number, (0, -1))
            if count > former[0]:
                largest[number] = (count, k)
                kind[k] = of
                if former[1] >= 0:
                    kind[former[1]] = 0
    return features(scan), kind


def _check(counts: dict[str, int], datasets: Sequence[Dataset]) -> None:
    where = str(datasets[0].path) if len(datasets) == 1 else f"{len(datasets)} datasets"
    if not any(counts[kind] for kind in CLASSES[1:]):
        raise InputError(f"{where}: no road users in the clouds; drive with `traffic`")
    if counts["vehicle"] < FEWEST or counts["nothing"] < FEWEST:
        kind = min(("vehicle", "nothing"), key=lambda name: counts[name])
        what = "vehicles" if kind == "vehicle" else "other objects"
        raise InputError(
            f"{where}: only {counts[kind]} clusters of {what}, and {FEWEST} are needed;"
            " record more or longer drives"
        )


def _left_out(data: Examples, *, seed: int, trees: int, progress: Progress) -> Float:
    """Probabilities (n, classes) by forests that were trained without the part that a sample is of."""
    parts = np.unique(data.group // 4)
    group = data.group // 4 if len(parts) >= _FOLDS else data.group
    fold = np.searchsorted(np.unique(group), group) % _FOLDS
    found = np.zeros((len(data), len(CLASSES)))
    for k in range(_FOLDS):
        progress("left out", k, total=_FOLDS)
        mine = fold == k
        if mine.any() and not mine.all():
            found[mine] = _forest(data.take(~mine), seed=seed, trees=trees).probability(data.measures[mine])
    progress("left out", _FOLDS, total=_FOLDS)
    return found


def _forest(data: Examples, *, seed: int, trees: int) -> Forest:
    """A random forest; kinds without examples have probability 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from sklearn.ensemble import RandomForestClassifier  # noqa: PLC0415

        forest = RandomForestClassifier(
            n_estimators=trees,
            max_leaf_nodes=_LEAVES,
            min_samples_leaf=_LEAF,
            class_weight="balanced_subsample",
            random_state=seed,
            n_jobs=1,
        )
        forest.fit(data.measures, data.kind)
    return forest_of([tree.tree_ for tree in forest.estimators_], forest.classes_, classes=len(CLASSES))


def _best_threshold(probability: Float, true: Bools) -> tuple[float, float, float]:
    """The threshold with the largest F1, its precision and its recall."""
    best, highest = (0.5, 0.0, 0.0), -1.0
    count = int(np.count_nonzero(true))
    for at in _THRESHOLDS:
        found = probability >= at
        hits, reported = int(np.count_nonzero(found & true)), int(np.count_nonzero(found))
        if (score := 2 * hits / (reported + count)) > highest:
            best, highest = (round(float(at), 2), hits / max(reported, 1), hits / count), score
    return best


def _drives(datasets: Sequence[Dataset]) -> list[dict[str, Any]]:
    """Drives that a model was trained on: their names, scenes, seeds, scanners, and credits of the maps."""
    rows = []
    for dataset in datasets:
        manifest, recipe = dataset.manifest, dataset.manifest["recipe"]
        rows.append(
            {
                "name": dataset.path.name,
                "scene": recipe.get("scene", ""),
                "seed": recipe.get("seed"),
                "fidelity": recipe.get("fidelity"),
                "scanners": sorted(dataset.sensors("lidar")),
                "attribution": manifest.get("attribution", ""),
            }
        )
    return rows
