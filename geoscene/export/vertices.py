"""Unique vertices of a file that is written tile by tile, also across tile borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geoscene.typing import Float, Ints

_REACH = 1000.0
"""Metres by which objects reach beyond their tile at most; equal vertices further apart are written twice."""


@dataclass(frozen=True, slots=True)
class _Numbered:
    """Vertices of a tile: whole coordinates (n, 3), their numbers (n,), and the tile's last column."""

    whole: Ints
    number: Ints
    last: int


class Vertices:
    """Numbers of the vertices of a file, in the order of writing.

    Vertices of tiles that no later tile reaches are forgotten, so memory does not grow with the scene.

    count : vertices so far
    low, high : (3,) float64, least and greatest coordinates so far, infinite without any
    """

    def __init__(self, tile_size: float) -> None:
        self._reach = int(np.ceil(_REACH / tile_size))
        self._near: list[_Numbered] = []
        self.count = 0
        self.low: Float = np.full(3, np.inf)
        self.high: Float = np.full(3, -np.inf)

    def add(self, whole: Ints, *, column: int, span: int = 1) -> tuple[Ints, Ints]:
        """The numbers (n,) of a tile's vertices, and those (m, 3) among them that are new, in their order.

        whole  : (n, 3) whole coordinates, each once
        column : the tile's place from west to east; tiles come column by column
        span   : columns that the tile covers
        """
        number = np.full(len(whole), -1, np.int64)
        self._near = [tile for tile in self._near if tile.last >= column - self._reach]
        for tile in self._near:
            _adopt(number, whole, known=tile)
        fresh = number < 0
        number[fresh] = self.count + np.arange(fresh.sum())
        if len(whole):
            self._near.append(_Numbered(whole, number, column + span - 1))
            self.low = np.minimum(self.low, whole.min(axis=0))
            self.high = np.maximum(self.high, whole.max(axis=0))
        self.count += int(fresh.sum())
        return number, whole[fresh]


def _adopt(number: Ints, whole: Ints, *, known: _Numbered) -> None:
    """Set the numbers (n,) of those vertices (n, 3) that are known."""
    if not len(whole):
        return
    low = np.maximum(whole.min(axis=0), known.whole.min(axis=0))
    high = np.minimum(whole.max(axis=0), known.whole.max(axis=0))
    here, there = (
        np.flatnonzero(((points >= low) & (points <= high)).all(axis=1)) for points in (whole, known.whole)
    )
    if not len(here) or not len(there):
        return
    both = np.concatenate([known.whole[there], whole[here]])
    distinct, which = np.unique(both, axis=0, return_inverse=True)
    found = np.full(len(distinct), -1, np.int64)
    found[which.ravel()[: len(there)]] = known.number[there]
    told = found[which.ravel()[len(there) :]]
    number[here[told >= 0]] = told[told >= 0]
