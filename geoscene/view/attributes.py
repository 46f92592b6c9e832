"""Attribute tables of the features in a page, as columns of JSON."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.export.kinds import plain
from geoscene.export.objects import FeatureAttributes
from geoscene.typing import Bools, Ints

Rows = Ints


def tables(features: FeatureAttributes, present: Bools) -> list[dict[str, Any]]:
    """One table per layer with the features in the page, in the layers' order, empty ones left out.

    present : (n,) bool by feature number: it has faces or copies in the page

    Parts come with their building, road edges with the surfaces made from the same OSM ways. A table has
    ``layer``, ``feature`` numbers and ``columns``: a list of values (null for none) or, for text,
    ``words`` and the index of each row's among them (-1 for none).
    """
    out = []
    for number, layer in enumerate(features.layers):
        columns = features.columns[number]
        own = features.numbers[number]
        rows = _chosen(layer, columns, own=present[own], features=features, present=present)
        if len(rows):
            encoded = {name: _column(values[rows]) for name, values in columns.items()}
            out.append({"layer": layer, "feature": own[rows].tolist(), "columns": encoded})
    return out


def _chosen(
    layer: str, columns: dict[str, NDArray[Any]], *, own: Bools, features: FeatureAttributes, present: Bools
) -> Rows:
    """Rows of a layer that are in the page, or belong to a feature that is."""
    keep = own.copy()
    if layer == "building_parts" and "buildings" in features.layers:
        start = int(features.starts[features.layers.index("buildings")])
        keep |= present[start + columns["building"].astype(np.int64)]
    if layer == "roads" and "road_surfaces" in features.layers:
        number = features.layers.index("road_surfaces")
        ids = _text(features.columns[number]["osm_id"])
        known = {way for text in ids[present[features.numbers[number]]] for way in text.split(";")}
        keep |= np.array([not known.isdisjoint(text.split(";")) for text in _text(columns["osm_id"])])
    return np.flatnonzero(keep)


def _text(values: NDArray[Any]) -> NDArray[np.object_]:
    """Text of a column, "" for none."""
    return np.array(["" if v is None else str(v) for v in values], object)


def _column(values: NDArray[Any]) -> Any:
    if values.dtype.kind in "OU":
        words, index = np.unique(_text(values).astype(str), return_inverse=True)
        empty = int(words[0] == "")
        return {"words": words[empty:].tolist(), "index": (index.ravel() - empty).tolist()}
    if values.dtype.kind == "f":
        values = np.round(values, 4) + 0.0  # no minus zero
    return [plain(value) for value in values]
