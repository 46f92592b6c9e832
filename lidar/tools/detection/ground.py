"""Height of the ground below the points of one cloud, from a polar grid."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.ndimage import median_filter

from geoscene.typing import Bools, Float

_SECTORS = 180
_BIN = 1.0
"""Metres of range of a cell of the grid."""
_CELLS = 100
_STEP = 0.15
"""Metres by which the ground may rise or fall between cells in any case, as at a kerb."""
_BEND = 0.05
"""Largest change of the gradient along a sector, by a cell that is flat."""
_RISE = (0.2, 1.5)
"""Metres above the lowest point of a cell in which a flat one has no points; higher ones hang over it."""
_FIRST_BEND = 0.12
"""The same between the plane around the vehicle and a sector's first ground."""
_STEEPEST = 0.2
"""Largest gradient against the plane of the sensor."""
_NEAR = (3.0, 15.0)
"""Metres of range within which the plane of the ground around the vehicle is fitted."""
_CLOSE = (0.4, 0.25, 0.15)
"""Metres from the plane within which near points count as of it, in turn; the last are those of kerbs."""
_FEWEST = 10
"""Cells that a plane is fitted to."""
_USUAL = -1.8
"""Height in metres of the ground where no near point tells it."""

_AZIMUTH = ((np.arange(_SECTORS) + 0.5) / _SECTORS - 0.5) * 2 * np.pi
_DIRECTION = np.column_stack([np.cos(_AZIMUTH), np.sin(_AZIMUTH)])
_STEPS = np.arange(-5, 6) * _STEEPEST / 5
_GRADIENTS = np.array(sorted(product(_STEPS, _STEPS), key=lambda xy: np.hypot(*xy)))
"""Gradients (k, 2) along x and y of planes that the ground may be, the flattest first."""


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

    The ground around the vehicle is the plane that most of the lowest points of near cells are close to. From
    it the ground is followed outwards in sectors of 2 degrees through the lowest points of cells of 1 m: a
    cell is ground if it continues the sector's gradient within 0.2 m. One that is flat, as sides of cars are
    not, may differ by 0.15 m and 5 % of the distance to the cell before, or 12 % before the first. A median
    over five sectors removes those that went astray.
    """
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    cell = np.minimum((distance / _BIN).astype(np.int64), _CELLS - 1)
    sector = _sector(xyz)
    lowest = _lowest(xyz[:, 2], sector=sector, cell=cell)
    above = xyz[:, 2] - lowest[sector, cell]
    rising = (above > _RISE[0]) & (above < _RISE[1])
    flat = np.ones(lowest.shape, bool)
    flat[sector[rising], cell[rising]] = False
    return Ground(_surface(lowest, flat=flat, plane=_plane(lowest)))


def height_above_ground(xyz: Float) -> Float:
    """Metres (n,) of points (n, 3) above the ground, along the sensor's z axis."""
    found: Float = xyz[:, 2] - ground_of(xyz).below(xyz)
    return found


def _sector(xyz: Float) -> np.ndarray:
    turn = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi) + 0.5
    return np.minimum((turn * _SECTORS).astype(np.int64), _SECTORS - 1)


def _plane(lowest: Float) -> Float:
    """Gradients along x and y, and height, (3,) of the ground around the vehicle.

    Of planes by steps of 4 % and 0.2 m it is the one that most cells are close to, the flattest of equal
    ones, refined by least squares.
    """
    sector, cell = np.nonzero(np.isfinite(lowest))
    near = (cell * _BIN >= _NEAR[0]) & (cell * _BIN < _NEAR[1])
    sector, cell = sector[near], cell[near]
    place = np.column_stack([_DIRECTION[sector] * (cell[:, None] + 0.5) * _BIN, np.ones(len(cell))])
    z = lowest[sector, cell]
    level = np.floor((z - _GRADIENTS @ place[:, :2].T) / 0.2).astype(np.int64) + 25
    inside = (level >= 0) & (level < 25)
    number = np.broadcast_to(np.arange(len(_GRADIENTS))[:, None], level.shape)
    votes = np.bincount((number * 25 + level)[inside], minlength=25 * len(_GRADIENTS))
    if not votes.any():
        return np.array([0.0, 0.0, _USUAL])
    best, height = divmod(int(votes.argmax()), 25)
    plane = np.array([*_GRADIENTS[best], (height - 24.5) * 0.2])
    for reach in _CLOSE:
        close = np.abs(z - place @ plane) < reach
        if np.count_nonzero(close) < _FEWEST:
            break
        plane = np.linalg.lstsq(place[close], z[close])[0]
    return plane


def _lowest(z: Float, *, sector: np.ndarray, cell: np.ndarray) -> Float:
    """Lowest point (sectors, cells) of each cell; infinite without points."""
    lowest = np.full((_SECTORS, _CELLS), np.inf)
    np.minimum.at(lowest, (sector, cell), z)
    return lowest


def _surface(lowest: Float, *, flat: Bools, plane: Float) -> Float:
    """Height (sectors, cells) of the ground in the middle of each cell."""
    height, gradient = np.full(_SECTORS, plane[2]), _DIRECTION @ plane[:2]
    reached, ground = np.zeros(_SECTORS), np.empty((_SECTORS, _CELLS))
    for k in range(_CELLS):
        at = (k + 0.5) * _BIN
        step = at - reached
        expected = height + gradient * step
        ground[:, k] = expected
        bend = np.where(reached > 0, _BEND, _FIRST_BEND) * step
        found = np.abs(lowest[:, k] - expected) < _STEP + np.where(flat[:, k], bend, _BEND * _BIN)
        slope = np.where(found, (lowest[:, k] - height) / step, 0.0)
        weight = np.clip(step / 8, 0.1, 0.7)  # a kerb within one cell is no gradient
        gradient = np.where(found, (1 - weight) * gradient + weight * slope, gradient)
        gradient = np.clip(gradient, -_STEEPEST, _STEEPEST)
        height, reached = np.where(found, lowest[:, k], height), np.where(found, at, reached)
        ground[found, k] = lowest[found, k]
    return np.asarray(median_filter(ground, size=(5, 1), mode="wrap"), float)
