"""A detector that was trained on recorded drives: the clusters of the rules, judged by a random forest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.errors import FormatError
from lidar.tools.detection.boxes import Rectangle, complete_rectangle
from lidar.tools.detection.clusters import PLAIN, DetectorSettings, PointCluster, find_clusters
from lidar.tools.detection.detector import CloudPoints, DetectedObject, Detections, apart, table
from lidar.tools.detection.features import FEATURES, features
from lidar.tools.detection.forest import Forest, read_forest, write_forest

CLASSES = ("nothing", "vehicle", "person", "cycle")
"""What a cluster may be."""

PIVOT = 0.3
"""Score of a cluster at the threshold of its kind."""

_SMALLEST = {"person": (0.5, 0.5), "cycle": (1.7, 0.6)}
"""Least length and width in metres."""
_HIGHEST = 4.5
"""Metres of a vehicle."""
_HANGING = 0.02
"""Share of points above the clustered heights from which on they count to a vehicle."""


@dataclass(frozen=True)
class Learned:
    """A trained detector.

    threshold : probability of each kind from which on a cluster most likely is one; its score is 0.3
    identity  : start of the digest of the model's file
    training  : what it was trained on
    """

    forest: Forest
    threshold: Mapping[str, float]
    name: str
    identity: str = ""
    training: Mapping[str, Any] = field(default_factory=dict)
    settings: DetectorSettings = PLAIN

    def detect(self, cloud: CloudPoints) -> Detections:
        """Road users in the point cloud of one turn of an upright scanner on a vehicle."""
        scan = find_clusters(cloud, settings=self.settings)
        scores = self.scores(features(scan))
        found = []
        for one, row in zip(scan.clusters, scores, strict=True):
            best = int(row.argmax())
            if row[best] >= self.settings.certain:
                found.append(_found(one, CLASSES[1 + best], score=float(row[best]), settings=self.settings))
        return table(apart(found), scan.xyz)

    def scores(self, measures: NDArray[np.float32]) -> Float:
        """Scores (clusters, kinds) 0 to 1 of clusters by their measures."""
        return scores_of(self.forest.probability(measures)[:, 1:], [self.threshold[k] for k in CLASSES[1:]])

    def write(self, path: Path) -> None:
        """Write the model; raises OSError if that fails."""
        header = {
            "features": FEATURES,
            "classes": CLASSES,
            "threshold": dict(self.threshold),
            "training": dict(self.training),
        }
        write_forest(path, self.forest, header=header)


def scores_of(probability: Float, threshold: Sequence[float]) -> Float:
    """Scores (n, kinds) of probabilities: linear to `PIVOT` at the kind's threshold, and from there to 1."""
    columns = [
        np.interp(probability[:, k], [0.0, at, 1.0], [0.0, PIVOT, 1.0]) for k, at in enumerate(threshold)
    ]
    return np.column_stack(columns)


def read_model(path: Path, *, name: str = "") -> Learned:
    """The detector of a file of `lidar train`.

    name : by which messages and results name it; the path if empty

    Raises FormatError for a file that is none, or one with other features.
    """
    forest, header, digest = read_forest(path)
    try:
        known = (tuple(header["features"]), tuple(header["classes"])) == (FEATURES, CLASSES)
        threshold = {kind: float(header["threshold"][kind]) for kind in CLASSES[1:]}
        training = dict(header["training"])
    except (ValueError, KeyError, TypeError, AttributeError):
        known, threshold, training = False, {}, {}
    if not (known and all(0 < at < 1 for at in threshold.values())):
        raise FormatError(f"{path}: is a model of another version of this program; train it again")
    return Learned(forest, threshold, name or str(path), f"model {digest[:16]}", training)


def _found(one: PointCluster, kind: str, *, score: float, settings: DetectorSettings) -> DetectedObject:
    """The object of a kind that a cluster is."""
    shape, seen = one.shape, one.shape.seen
    if kind == "vehicle":
        high = shape.above > _HANGING and shape.roof < _HIGHEST
        box = complete_rectangle(seen, length=settings.length, width=settings.width)
        return DetectedObject(box, (one.floor, one.floor + (shape.roof if high else shape.top)), score, kind)
    size = tuple(np.maximum(seen.size, _SMALLEST[kind]).tolist())
    box = Rectangle(seen.centre, (size[0], size[1]), seen.yaw, seen.edge)
    return DetectedObject(box, (one.floor, one.floor + shape.top), score, kind)
