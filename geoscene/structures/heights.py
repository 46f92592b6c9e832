"""Heights of carriageways away from their centre lines."""

from __future__ import annotations

import math

import numpy as np

from geoscene.structures.table import Structures
from geoscene.support.compiled import njit
from geoscene.typing import Bools, Float

_FADE = 1.5
"""Metres beyond its outside over which a carriageway's height ceases to count."""

SHEET = 2.5
"""Metres: carriageways that meet in plan and differ less in height are one, else one is over the other."""

_MERGED, _LEVEL = 1.0, 0.02
"""Metres from one centre line to another that is beside it, and in height that make a slope between them."""

SHARED, PARTED = 0.5, 1.0
"""Metres of difference in height up to which carriageways share one surface, and from which on they part."""


def nearest_on_line(line: Float, xy: Float) -> tuple[Float, Float, Bools]:
    """Nearest point on a line (k, 3) to points (n, 2): its z, its distance, whether it is not an end."""
    return _nearest(np.ascontiguousarray(line, float), np.ascontiguousarray(xy, float))


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest(line: Float, xy: Float) -> tuple[Float, Float, Bools]:
    """The result of `nearest_on_line`; of parts as near, the first counts."""
    z, metres, inner = np.empty(len(xy)), np.full(len(xy), np.inf), np.ones(len(xy), np.bool_)
    last = len(line) - 2
    for p in range(len(xy)):
        for k in range(last + 1):
            x, y = line[k + 1, 0] - line[k, 0], line[k + 1, 1] - line[k, 1]
            t = ((xy[p, 0] - line[k, 0]) * x + (xy[p, 1] - line[k, 1]) * y) / max(x * x + y * y, 1e-12)
            on = min(max(t, 0.0), 1.0)
            away = math.hypot(xy[p, 0] - (line[k, 0] + on * x), xy[p, 1] - (line[k, 1] + on * y))
            if away < metres[p] or k == 0:
                metres[p] = away
                z[p] = line[k, 2] + on * (line[k + 1, 2] - line[k, 2])
                inner[p] = not ((k == 0 and t < 0) or (k == last and t > 1))
    return z, metres, inner


def surface_heights(table: Structures, piece: int, *, xy: Float) -> Float:
    """Heights (n,) of a piece's carriageway at points (n, 2).

    The carriageway is level across its centre line. Where carriageways join, their heights are blended by the
    inverse fourth power of the distance, so that each centre line keeps its own height.
    """
    own, metres, _ = nearest_on_line(table.around[piece], xy)
    weight = _weight(metres, float(table.half[piece]))
    total, z = weight, weight * own
    for other in table.near[piece]:
        if table.edge[other] == table.edge[piece] and table.osm_id[other] == table.osm_id[piece]:
            continue  # the same line further on
        theirs, metres, beside = nearest_on_line(table.around[other], xy)
        weight = _weight(metres, float(table.half[other]))
        alike = np.clip((PARTED - np.abs(theirs - own)) / (PARTED - SHARED), 0.0, 1.0)
        weight = np.where(beside, weight * alike, 0.0)
        total, z = total + weight, z + weight * theirs
    return z / total


def slopes_across(table: Structures, piece: int) -> bool:
    """Whether a piece's carriageway shares its surface with one beside it at another height."""
    for other in table.near[piece]:
        line = table.around[other]
        z, metres, beside = nearest_on_line(table.around[piece], line[:, :2])
        shared = beside & (metres > _MERGED) & (metres < table.half[piece] + table.half[other])
        apart = np.abs(z - line[:, 2])
        if (shared & (apart > _LEVEL) & (apart < PARTED)).any():
            return True
    return False


def _weight(metres: Float, half: float) -> Float:
    share = np.clip(1.0 - (metres - half) / _FADE, 1e-4, 1.0)
    return share**2 / (metres + 0.03) ** 4
