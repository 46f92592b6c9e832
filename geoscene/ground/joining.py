"""Joins tiles on whose ground nothing lies into larger ones."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from geoscene.classes import Class
from geoscene.ground.partition import GroundPlan, rows_at, values_at
from geoscene.typing import Bools

_LARGEST = 4096.0
"""Metres of the longest side of a joined tile."""

_MOST_STEPS = 128
"""Most steps of the lattice along a side of a joined tile, which bounds the number of its faces."""

_MOST_LINES = 100
"""The same for lines of the terrain, where the ground follows lines."""


def join_tiles(plan: GroundPlan, occupied: Collection[tuple[int, int]]) -> GroundPlan:
    """The plan with squares on which nothing lies joined to tiles of 2, 4, 8 ... squares along a side.

    Such a square has no outline, none of the ``occupied`` squares' features, no forest (whose trees are
    placed tile by tile), no river and no ground graded to roads. The ground follows the terrain's heights, or
    else keeps its lines. Tiles that are not joined only change on sides beside joined ones.
    """
    low, high = plan.tiles[0], plan.tiles[-1]
    columns, rows = (high - low + 1).tolist()
    span = np.ones((rows, columns), np.int64)
    whole = _bare(plan, occupied).reshape(rows, columns)
    lines = plan.coarse if plan.ruled is not None else plan.lines
    most = min(_LARGEST, _MOST_LINES * lines) if lines else _LARGEST
    if plan.terrain is not None:
        most = min(_LARGEST, _MOST_STEPS * plan.tile_size / plan.terrain.steps(plan.tile_size))
    n = 2
    while n * plan.tile_size <= most and whole.any():
        # Squares beyond the extent are bare: tiles are cut at its east and north sides.
        odd = np.pad(whole, [(0, whole.shape[0] % 2), (0, whole.shape[1] % 2)], constant_values=True)
        whole = odd[::2, ::2] & odd[1::2, ::2] & odd[::2, 1::2] & odd[1::2, 1::2]
        span[np.repeat(np.repeat(whole, n, axis=0), n, axis=1)[:rows, :columns]] = n
        n *= 2
    return replace(plan, span=span.ravel())


def ground_tiles(plan: GroundPlan) -> list[tuple[int, int]]:
    """Indices (i, j) of all tiles of the ground: their south-west squares."""
    first = ((plan.tiles - plan.tiles[0]) % plan.span[:, None] == 0).all(axis=1)
    return [(int(i), int(j)) for i, j in plan.tiles[first]]


def _bare(plan: GroundPlan, occupied: Collection[tuple[int, int]]) -> Bools:
    """Whether nothing lies on each square (t,), outlines along the border of the extent aside."""
    low, high = np.array(plan.extent[:2]), np.array(plan.extent[2:])
    on_border = (plan.start == plan.end) & ((plan.start == low) | (plan.start == high))
    square = np.repeat(np.arange(len(plan.tiles)), np.diff(plan.offset))
    within = square[~on_border.any(axis=1)[plan.order]]
    bare: Bools = np.bincount(within, minlength=len(plan.tiles)) == 0
    taken = {*occupied, *(plan.ruled or ())}
    bare &= np.array([tile not in taken for tile in map(tuple, plan.tiles.tolist())])
    corner = np.maximum(plan.tiles[bare] * plan.tile_size, low)
    far = np.minimum((plan.tiles[bare] + 1) * plan.tile_size, high)
    row = rows_at(plan, (corner + far) / 2)
    is_forest = values_at(plan.layers.klass, row, base=plan.base[0]) == Class.FOREST_FLOOR
    bare[bare] = ~is_forest & (values_at(plan.layers.body, row, base="") != "river")
    return bare
