"""Graphs as pairs of numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Ints


def components(first: NDArray[np.integer], second: NDArray[np.integer], *, count: int) -> Ints:
    """Number (count,) of the connected component of each node; links (k,) go from first to second nodes."""
    from scipy.sparse import coo_array  # noqa: PLC0415 - slow to import
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(count, count))
    number: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return number
