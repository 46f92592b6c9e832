"""Random forests as arrays: prediction without the library that trained them, and their file."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import reason_of
from geoscene.support.files import write_atomically
from geoscene.support.untrusted import DAMAGED_ARCHIVE, read_arrays
from geoscene.typing import Float
from lidar.errors import FormatError

KIND = "geoscene random forest"
VERSION = 1
_HEADER = "header"
_MOST = 50_000_000
"""Bytes of a file, and of the arrays in it."""

_DAMAGE = (*DAMAGED_ARCHIVE, MemoryError, TypeError, AttributeError)
"""What reading a damaged archive raises."""


@dataclass(frozen=True, slots=True)
class Forest:
    """Decision trees, node after node.

    root      : (trees,) int32, node at which each tree begins
    feature   : (nodes,) int16, column that is compared; -1 at a leaf
    threshold : (nodes,) float32, a value up to which the left node follows
    left, right : (nodes,) int32, nodes that follow
    share     : (nodes, classes) float32, probability of each class at a leaf; 0 elsewhere
    """

    root: NDArray[np.int32]
    feature: NDArray[np.int16]
    threshold: NDArray[np.float32]
    left: NDArray[np.int32]
    right: NDArray[np.int32]
    share: NDArray[np.float32]

    def probability(self, features: NDArray[np.float32]) -> Float:
        """Mean over the trees (n, classes) of the probabilities at the leaves of samples (n, features)."""
        row = np.arange(len(features))
        node = np.repeat(self.root[:, None], len(features), axis=1)
        while (inner := self.feature[node] >= 0).any():
            value = features[row, np.maximum(self.feature[node], 0)]
            following = np.where(value <= self.threshold[node], self.left[node], self.right[node])
            node = np.where(inner, following, node)
        found: Float = self.share[node].astype(np.float64).mean(axis=0)
        return found

    def check(self, *, columns: int, classes: int) -> None:
        """Raise ValueError unless each path ends at a leaf."""
        nodes = len(self.feature)
        shapes = [(len(self.root),), *[(nodes,)] * 4, (nodes, classes)]
        for one, shape in zip(fields(self), shapes, strict=True):
            array = getattr(self, one.name)
            if array.shape != shape or array.dtype != _TYPES[one.name]:
                raise ValueError(f"{one.name} is {array.dtype} {array.shape}")
        inner = self.feature >= 0
        row = np.arange(nodes)[inner]
        later = [(side[inner] > row) & (side[inner] < nodes) for side in (self.left, self.right)]
        if not (len(self.root) and all(one.all() for one in later)):
            raise ValueError("nodes do not follow each other")
        if (self.root < 0).any() or (self.root >= nodes).any() or (self.feature >= columns).any():
            raise ValueError("nodes or features that there are not")
        if not (np.isfinite(self.threshold).all() and ((self.share >= 0) & (self.share <= 1)).all()):
            raise ValueError("thresholds or probabilities that are none")


_TYPES = {
    "root": np.int32,
    "feature": np.int16,
    "threshold": np.float32,
    "left": np.int32,
    "right": np.int32,
    "share": np.float32,
}


def forest_of(trees: Sequence[Any], labels: NDArray[np.integer], *, classes: int) -> Forest:
    """The forest of trained trees of scikit-learn (``tree_`` of each estimator).

    labels : class of each column of the trees, of ``classes``; the others have probability 0

    Samples are float32, so a threshold between two of them can be rounded down without changing a decision.
    """
    counts = np.cumsum([0, *(tree.node_count for tree in trees)])
    leaf = np.concatenate([tree.children_left < 0 for tree in trees])
    left, right = (
        np.concatenate([getattr(tree, side) + at for tree, at in zip(trees, counts, strict=False)])
        for side in ("children_left", "children_right")
    )
    exact = np.where(leaf, 0.0, np.concatenate([tree.threshold for tree in trees]))
    threshold = exact.astype(np.float32)
    high = threshold > exact
    threshold[high] = np.nextafter(threshold[high], np.float32(-np.inf))
    value = np.concatenate([tree.value[:, 0, :] for tree in trees])
    share = np.zeros((len(leaf), classes))
    share[:, labels] = np.where(leaf[:, None], value / value.sum(axis=1, keepdims=True), 0.0)
    return Forest(
        counts[:-1].astype(np.int32),
        np.where(leaf, -1, np.concatenate([tree.feature for tree in trees])).astype(np.int16),
        threshold,
        np.where(leaf, -1, left).astype(np.int32),
        np.where(leaf, -1, right).astype(np.int32),
        share.astype(np.float32),
    )


def write_forest(path: Path, forest: Forest, *, header: Mapping[str, Any]) -> None:
    """Write a forest with a header of JSON values as a NumPy archive; the same bytes each time."""
    text = json.dumps({"kind": KIND, "version": VERSION} | dict(header), sort_keys=True)
    columns = {_HEADER: np.frombuffer(text.encode(), np.uint8)}
    columns |= {one.name: getattr(forest, one.name) for one in fields(forest)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **columns)  # type: ignore[arg-type]
    write_atomically(path, buffer.getvalue())


def read_forest(path: Path) -> tuple[Forest, dict[str, Any], str]:
    """A forest, its header, and the SHA-256 of its file; nothing in it is run.

    Raises FormatError for a missing file and for one that `write_forest` did not write.
    """
    try:
        if path.stat().st_size > _MOST:
            raise ValueError("too large for a model")
        data = path.read_bytes()
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > _MOST:
                raise ValueError("too large for a model")
        file = read_arrays(io.BytesIO(data))
        header = json.loads(file[_HEADER].tobytes())
        if (header["kind"], header["version"]) != (KIND, VERSION):
            raise ValueError(f"version {header['version']}")
        forest = Forest(**{one.name: file[one.name] for one in fields(Forest)})
        forest.check(columns=len(header["features"]), classes=len(header["classes"]))
    except _DAMAGE as error:
        text = reason_of(error)
        raise FormatError(f"{path}: is no model of a detector ({text}); make one with lidar train") from None
    return forest, header, hashlib.sha256(data).hexdigest()
