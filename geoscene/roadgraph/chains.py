"""Chains of nodes that become edges: ways cut at junctions and changes, and joined in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from geoscene.typing import Bools, Ints


@dataclass(frozen=True, slots=True)
class Runs:
    """The ways' nodes in driving order, one row each; a run is an unbroken sequence of nodes of one way.

    node : (k,) int64 node index
    way  : (k,) int64 way index
    run  : (k,) int64 run number, ascending
    """

    node: Ints
    way: Ints
    run: Ints


@dataclass(frozen=True, slots=True)
class RoadChain:
    """A line through nodes that becomes one edge or two; in the direction of its ways if that matters.

    node : (k,) int64 node index
    way  : (k - 1,) int64 way index of each segment
    """

    node: Ints
    way: Ints


class WayAttributes(Protocol):
    """Attributes of a way; equal ones may be joined."""

    @property
    def symmetric(self) -> bool:
        """Whether both directions have the same attributes."""


def chains_of(runs: Runs, kinds: Sequence[WayAttributes], *, nodes: int) -> list[RoadChain]:
    """The runs as chains from junction, dead end or change of kind (ways,) to the next."""
    number = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
    kind = np.array([number[kind] for kind in kinds], np.int64)
    symmetric = np.array([kind.symmetric for kind in kinds], np.bool_)
    return link_chains(runs, find_cuts(runs, kind, symmetric=symmetric, nodes=nodes))


def find_cuts(runs: Runs, kind: Ints, *, symmetric: Bools, nodes: int) -> Bools:
    """Whether a line must end at each node (nodes,): junctions, dead ends, changes.

    kind      : (ways,) equal numbers for ways that may be joined
    symmetric : (ways,) the way has the same attributes in both directions
    """
    first = np.flatnonzero(runs.run[1:] == runs.run[:-1])
    a, b, way = runs.node[first], runs.node[first + 1], runs.way[first]
    at, other = np.concatenate([a, b]), np.concatenate([b, a])
    ways, leaving = np.concatenate([way, way]), np.arange(len(at)) < len(a)
    degree = np.bincount(at, minlength=nodes)
    cut: Bools = degree != 2
    pair = np.argsort(at, kind="stable")
    pair = pair[degree[at[pair]] == 2].reshape(-1, 2)
    one, two = pair.T
    turns_back = other[one] == other[two]
    changes = kind[ways[one]] != kind[ways[two]]
    against = (leaving[one] == leaving[two]) & ~symmetric[ways[one]]
    cut[at[one]] |= turns_back | changes | against
    return cut


def link_chains(runs: Runs, cut: Bools) -> list[RoadChain]:
    """The runs as chains from cut node to cut node; a loop without any starts at its own first node."""
    pieces = _pieces(runs, cut)
    loose: dict[int, list[int]] = {}
    for number, piece in enumerate(pieces):
        for node in (int(piece.node[0]), int(piece.node[-1])):
            if not cut[node]:
                loose.setdefault(node, []).append(number)

    used = [False] * len(pieces)

    def follow(node: int) -> list[RoadChain]:
        """Pieces that follow from a node, each reversed where needed to begin where the previous one ends."""
        found = []
        while not cut[node]:
            following = [number for number in loose[node] if not used[number]]
            if not following:
                break
            used[following[0]] = True
            piece = pieces[following[0]]
            found.append(piece if piece.node[0] == node else _turn(piece))
            node = int(found[-1].node[-1])
        return found

    chains = []
    for number, piece in enumerate(pieces):
        if used[number]:
            continue
        used[number] = True
        ahead = follow(int(piece.node[-1]))
        behind = [_turn(p) for p in reversed(follow(int(piece.node[0])))]
        chains.append(_join([*behind, piece, *ahead]) if ahead or behind else piece)
    return chains


def _pieces(runs: Runs, cut: Bools) -> list[RoadChain]:
    """The runs cut at cut nodes."""
    edge = np.flatnonzero(np.diff(runs.run, prepend=-1, append=-1))
    pieces = []
    for start, end in zip(edge[:-1].tolist(), edge[1:].tolist(), strict=True):
        inner = start + 1 + np.flatnonzero(cut[runs.node[start + 1 : end - 1]])
        stops = [start, *inner.tolist(), end - 1]
        pieces += [RoadChain(runs.node[i : j + 1], runs.way[i:j]) for i, j in pairwise(stops)]
    return pieces


def _turn(piece: RoadChain) -> RoadChain:
    return RoadChain(piece.node[::-1], piece.way[::-1])


def _join(pieces: Sequence[RoadChain]) -> RoadChain:
    nodes = [pieces[0].node, *(piece.node[1:] for piece in pieces[1:])]
    return RoadChain(np.concatenate(nodes), np.concatenate([piece.way for piece in pieces]))
