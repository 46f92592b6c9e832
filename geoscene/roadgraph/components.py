"""Connected components of the road graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.roadgraph.graph import RoadGraph


@dataclass(frozen=True, slots=True)
class Components:
    """Connected components, numbered by size; 0 has the most nodes.

    weak   : (n,) int32 component of each node, ignoring the direction of one-way streets
    strong : (n,) int32 component of each node within which every node can be reached from every other
    """

    weak: NDArray[np.int32]
    strong: NDArray[np.int32]

    @property
    def largest_strong_share(self) -> float:
        """Share of the nodes that lie in the largest strongly connected component."""
        return float((self.strong == 0).mean()) if len(self.strong) else 0.0


def find_components(graph: RoadGraph) -> Components:
    """The connected components of the graph; turn restrictions are not considered."""
    from scipy.sparse import csr_array  # noqa: PLC0415  (slow to import)
    from scipy.sparse.csgraph import connected_components  # noqa: PLC0415

    n = len(graph.node_id)
    links = csr_array((np.ones(len(graph), np.int8), (graph.tail, graph.head)), shape=(n, n))
    parts = [connected_components(links, connection=kind)[1] for kind in ("weak", "strong")]
    return Components(*(_by_size(part) for part in parts))


def _by_size(part: NDArray[np.int32]) -> NDArray[np.int32]:
    """Components renumbered by size, the largest 0; equal ones in the order of their first node."""
    _, first, number, size = np.unique(part, return_index=True, return_inverse=True, return_counts=True)
    order = np.lexsort([first, -size])
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order))
    return rank[number]


def main_network(graph: RoadGraph) -> RoadGraph:
    """Largest strongly connected component: any of its streets can be reached from any other."""
    strong = find_components(graph).strong
    return graph.take((strong[graph.tail] == 0) & (strong[graph.head] == 0))
