"""The learned detector: measures of clusters, judged by a random forest; and look-up of detectors by name.

Measures are of coordinates alone, as is all of the detector: intensities of simulated materials are more
alike than real ones, and a model would learn the simulation.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.typing import Float
from lidar.errors import FormatError, InputError
from lidar.tools.detection.clusters import PLAIN, DetectorSettings, PointCluster, Scan, find_clusters
from lidar.tools.detection.detector import (
    CloudPoints,
    DetectedObject,
    Detections,
    Detector,
    Rectangle,
    apart,
    complete_rectangle,
    table,
)
from lidar.tools.detection.forest import Forest, read_forest, write_forest
from lidar.tools.detection.rules import RULES

_BANDS = (0.3, 0.7, 1.1, 1.5, 2.0, 2.5)
"""Metres above the ground between which the share of the points is counted."""
_PARTS = (0.3, 0.9, 1.4, 2.5)
"""Metres above the ground between which length and width are measured."""
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)
_BEAM = 0.004
"""Radians of elevation that tell two rows of points apart."""
_AROUND = 1.0
"""Metres around a cluster within which others count."""

FEATURES = (
    *("distance", "points", "cells", "rows", "length", "width", "edge", "across"),
    *("top", "bottom", "roof", "above", "standing"),
    *("towards", "sideways", "lone", "dense"),
    *(f"height_{round(100 * q)}" for q in _QUANTILES),
    *(f"share_{low:g}" for low in _BANDS[:-1]),
    *(f"{side}_{low:g}" for low in _PARTS[:-1] for side in ("length", "width")),
    *("line", "plane", "scatter"),
)
"""Names of the columns of `features`:

distance, edge, across, top, bottom, roof, above, standing : as in `ClusterShape`
points, cells : natural logarithms of their numbers
rows          : number of elevations of its points, of steps of 4 mrad
length, width : metres, of its rectangle
towards, sideways : metres, extent along the line of sight and across it
lone          : share of its own among the cells within a metre of its rectangle's circle
dense         : logarithm of its points against those that its distance and its extents let expect
height_<k>    : metres above the ground of the k-th percentile of its points
share_<z>     : share of its points from z metres above the ground up to the next such height
length_<z>, width_<z> : metres, extents of its points from z up, along its rectangle; -1 without any
line, plane, scatter : differences of the roots of the moments of its points, against the largest
"""
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

MODEL = Path(__file__).with_name("learned.npz")
"""The model that comes with the program."""


def features(scan: Scan) -> NDArray[np.float32]:
    """Measures (clusters, features) of the clusters of a scan."""
    found = np.empty((len(scan.clusters), len(FEATURES)), np.float32)
    if not len(found):
        return found
    tree = cKDTree(np.vstack([one.middle for one in scan.clusters]))
    for k, one in enumerate(scan.clusters):
        found[k] = _measures(one, scan, tree=tree)
    return found


def _measures(one: PointCluster, scan: Scan, *, tree: cKDTree) -> list[float]:
    shape, xyz, height = one.shape, scan.xyz[one.rows], scan.height[one.rows]
    flat = xyz[:, :2] - shape.seen.centre
    sight = shape.seen.centre / max(shape.distance, 1e-9)
    towards = float(np.ptp(flat @ sight))
    sideways = float(np.ptp(flat @ np.array([-sight[1], sight[0]])))
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    radius = float(np.hypot(*shape.sides)) / 2 + _AROUND
    near = tree.query_ball_point(shape.seen.centre, radius, return_length=True)
    seen_area = max(sideways, 0.2) * max(float(np.ptp(height)), 0.2)
    expected = len(scan.xyz) * seen_area / max(shape.distance, 1.0) ** 2
    return [
        shape.distance,
        float(np.log(len(xyz))),
        float(np.log(shape.cells)),
        len(np.unique(np.floor(elevation / _BEAM))),
        *shape.sides,
        shape.seen.edge,
        shape.across,
        shape.top,
        shape.bottom,
        shape.roof,
        shape.above,
        shape.standing,
        towards,
        sideways,
        shape.cells / max(int(near), 1),
        float(np.log(len(xyz) / expected)),
        *np.quantile(height, _QUANTILES).tolist(),
        *(np.histogram(height, _BANDS)[0] / len(height)).tolist(),
        *_extents(flat, height, yaw=shape.seen.yaw),
        *_moments(xyz),
    ]


def _extents(flat: Float, height: Float, *, yaw: float) -> list[float]:
    """Length and width of the lower, the middle and the upper part."""
    along = flat @ np.array([np.cos(yaw), np.sin(yaw)])
    across = flat @ np.array([-np.sin(yaw), np.cos(yaw)])
    part = np.digitize(height, _PARTS[1:-1])
    found = []
    for k in range(len(_PARTS) - 1):
        mine = part == k
        found += [float(np.ptp(side[mine])) if mine.any() else -1.0 for side in (along, across)]
    return found


def _moments(xyz: Float) -> list[float]:
    """Linearity, planarity and scattering of points."""
    around = xyz - xyz.mean(axis=0)
    small, middle, large = np.sqrt(np.maximum(np.linalg.eigvalsh(around.T @ around / len(xyz)), 0)).tolist()
    large = max(large, 1e-9)
    return [(large - middle) / large, (middle - small) / large, small / large]


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


@functools.lru_cache(maxsize=8)
def read_detector(name: str) -> Detector:
    """The detector ``rules``, ``learned``, or that of a model's file.

    Raises InputError for another name, and FormatError for a file that is no model.
    """
    if name == RULES.name:
        return RULES
    if name == "learned":
        return read_model(MODEL, name=name)
    if not Path(name).exists():
        raise InputError(f"`detector` {name}: give rules, learned, or the file of a model (lidar train)")
    return read_model(Path(name))
