"""Height of the ground below the points of one cloud, from a polar grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from geoscene.typing import Float

_SECTORS = 180
_BIN = 1.0
"""Metres of range of a cell of the grid."""
_CELLS = 100
_STEP = 0.15
"""Metres by which the ground may rise or fall between cells in any case, as at a kerb."""
_BEND = 0.05
"""Largest change of the gradient along a sector."""
_FIRST_BEND = 0.12
"""The same from the vehicle to a sector's first ground."""
_STEEPEST = 0.2
"""Largest gradient against the plane of the sensor."""
_NEAR = (3.0, 15.0)
"""Metres of range within which the height of the sensor is estimated."""


@dataclass(frozen=True, slots=True)
class Ground:
    """Height of the ground around the sensor.

    surface : (sectors, cells) metres, in the middle of each cell of the polar grid
    """

    surface: Float

    def below(self, xy: Float) -> Float:
        """Height (n,) of the ground at places (n, 2 or 3)."""
        middle = np.arange(_CELLS) * _BIN + _BIN / 2
        place = np.clip((np.hypot(xy[:, 0], xy[:, 1]) - middle[0]) / _BIN, 0, _CELLS - 1 - 1e-9)
        inner, sector = place.astype(np.int64), _sector(xy)
        part = place - inner
        height: Float = self.surface[sector, inner] * (1 - part) + self.surface[sector, inner + 1] * part
        return height

    def hit(self, direction: Float, *, reach: float) -> Float:
        """Metres (n,) along unit vectors (n, 3) from the sensor to the ground; inf beyond ``reach``."""
        middle = np.arange(_CELLS) * _BIN + _BIN / 2
        near = middle < reach + _BIN
        level = np.maximum(np.hypot(direction[:, 0], direction[:, 1]), 1e-9)
        over = direction[:, 2:] / level[:, None] * middle[near] - self.surface[_sector(direction)][:, near]
        below = over <= 0
        first = np.argmax(below, axis=1)
        before = np.maximum(first - 1, 0)
        row = np.arange(len(direction))
        fall = over[row, before] - over[row, first]
        part = np.where(first > 0, over[row, before] / np.where(fall > 0, fall, 1.0), 0.0)
        away = (middle[before] + part * _BIN) / level
        found: Float = np.where(below.any(axis=1) & (away * level < reach), away, np.inf)
        return found


def ground_of(xyz: Float) -> Ground:
    """The ground below the points (n, 3) of one cloud.

    In each sector of 2 degrees the ground is followed outwards through the lowest points of cells of 1 m: a
    cell is ground if it continues the sector's gradient within 0.15 m and 5 % of the distance to the cell
    before. A median over five sectors removes those that went astray.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    cell = np.minimum((distance / _BIN).astype(np.int64), _CELLS - 1)
    lowest = _lowest(xyz[:, 2], sector=_sector(xyz), cell=cell)
    return Ground(_surface(lowest, start=_start(xyz[:, 2], distance)))


def height_above_ground(xyz: Float) -> Float:
    """Metres (n,) of points (n, 3) above the ground, along the sensor's z axis."""
    found: Float = xyz[:, 2] - ground_of(xyz).below(xyz)
    return found


def _sector(xyz: Float) -> np.ndarray:
    turn = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) + 0.5
    return np.minimum((turn * _SECTORS).astype(np.int64), _SECTORS - 1)


def _start(z: Float, distance: Float) -> float:
    """Height of the ground around the vehicle: the most frequent one of near points below the sensor."""
    near = z[(distance > _NEAR[0]) & (distance < _NEAR[1]) & (z < 0) & (z > -5)]
    if not len(near):
        return -1.8
    counts, edges = np.histogram(near, bins=100, range=(-5, 0))
    smooth = np.convolve(counts, [1, 1, 1], "same")
    return float(edges[smooth.argmax()] + 0.025)


def _lowest(z: Float, *, sector: np.ndarray, cell: np.ndarray) -> Float:
    """Lowest point (sectors, cells) of each cell; infinite without points."""
    lowest = np.full((_SECTORS, _CELLS), np.inf)
    np.minimum.at(lowest, (sector, cell), z)
    return lowest


def _surface(lowest: Float, *, start: float) -> Float:
    """Height (sectors, cells) of the ground in the middle of each cell."""
    height, gradient = np.full(_SECTORS, start), np.zeros(_SECTORS)
    reached, ground = np.zeros(_SECTORS), np.empty((_SECTORS, _CELLS))
    for k in range(_CELLS):
        at = (k + 0.5) * _BIN
        step = at - reached
        expected = height + gradient * step
        ground[:, k] = expected
        bend = np.where(reached > 0, _BEND, _FIRST_BEND)
        found = np.abs(lowest[:, k] - expected) < _STEP + bend * step
        slope = np.where(found, (lowest[:, k] - height) / step, 0.0)
        weight = np.clip(step / 8, 0.1, 0.7)  # a kerb within one cell is no gradient
        gradient = np.where(found, (1 - weight) * gradient + weight * slope, gradient)
        gradient = np.clip(gradient, -_STEEPEST, _STEEPEST)
        height, reached = np.where(found, lowest[:, k], height), np.where(found, at, reached)
        ground[found, k] = lowest[found, k]
    return np.asarray(median_filter(ground, size=(5, 1), mode="wrap"), float)
