"""Sampling of a beam's cross-section by rays."""

from __future__ import annotations

import functools
import math

import numpy as np

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.physics.settings import FOOTPRINTS

INSIDE = 1 - math.exp(-2)
"""Share of a Gaussian beam's power within its 1/e^2 radius, which rays sample."""

_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@functools.cache
def bundle(rays: int) -> Float:
    """Positions (rays, 2) on the unit disc of rays of equal power, the axis first; their mean is the axis.

    They sample a Gaussian beam within its 1/e^2 radius. Ray k lies in the middle of the ring with the k-th
    of equal parts of the power, a golden angle on from the ray before (Vogel 1979): rays seldom lie in line,
    so that wires and edges of any direction cover few at once.

    Raises InputError for a number that is not of `FOOTPRINTS`.
    """
    if rays not in FOOTPRINTS:
        raise InputError(f"`rays` {rays}: give one of {', '.join(map(str, FOOTPRINTS))}")
    ray = np.arange(1, rays)
    radius = np.sqrt(-0.5 * np.log1p(-INSIDE * (ray + 0.5) / rays))
    angle = ray * _GOLDEN_ANGLE
    place = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), place - place.mean(axis=0)]) if rays > 1 else np.zeros((1, 2))
