"""Sampling of a beam's cross-section by rays."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.sensors.physics.settings import MOST_RAYS

INSIDE = 1 - math.exp(-2)
"""Share of a Gaussian beam's power within its 1/e^2 radius, which rays sample."""

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@functools.cache
def bundle(rays: int) -> Float:
    """Positions (rays, 2) on the unit disc of rays of equal power, the axis first; their mean is the axis.

    They sample a Gaussian beam within its 1/e^2 radius. Ray k lies in the middle of the ring with the k-th
    of equal parts of the power, a golden angle on from the ray before (Vogel 1979): rays seldom lie in line,
    so that wires and edges of any direction cover few at once.

    Raises InputError for a number that is not from 1 to `MOST_RAYS`.
    """
    if not 1 <= rays <= MOST_RAYS:
        raise InputError(f"`rays` {rays}: give 1 to {MOST_RAYS}")
    ray = np.arange(1, rays)
    radius = np.sqrt(-0.5 * np.log1p(-INSIDE * (ray + 0.5) / rays))
    angle = ray * _GOLDEN_ANGLE
    place = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), place - place.mean(axis=0)]) if rays > 1 else np.zeros((1, 2))


class Gap(NamedTuple):
    """Widest gap between neighbouring rays of a beam, across it.

    start  : metres where the beam starts
    spread : radians by which the gap widens
    """

    start: float = 0.0
    spread: float = 0.0


AXIS_ONLY = Gap()
"""Of a beam of one ray."""


@functools.cache
def widest_gap(rays: int) -> float:
    """Widest gap between neighbours of a `bundle` in projection on any line, on the unit disc."""
    angle = np.linspace(0, math.pi, 720, endpoint=False)
    across = np.sort(bundle(rays) @ np.stack([np.cos(angle), np.sin(angle)]), axis=0)
    return float(np.diff(across, axis=0).max(initial=0.0))
