"""Watermarks of clouds without pulses: the direction of a return tells its cell, and its range is marked.

The direction is that of a cell of 0.18 by 0.35 degrees; a mark along the beam leaves it as it is. Directions
within 2 microradians of a cell's edge are moved off it, so that single precision cannot carry them over.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.tools.integrity.watermark import WatermarkCells, WatermarkKey

LEAST = 0.1
"""Metres from the sensor below which returns bear no mark."""

_TURN, _RISE = 2 * np.pi / 2048, np.pi / 512
"""Width and height of a cell, radians."""

_EDGE = 2e-6
"""Radians from a cell's edge that marked returns keep; single precision moves directions by 1e-7."""


def cells_by_direction(xyz: NDArray[np.floating], *, sensor: str, frame: int) -> WatermarkCells:
    """Cells of returns (n, 3), sensor frame: step of the elevation as ring, of the azimuth as column."""
    turn, rise, _ = _polar(xyz)
    ring, column = (rise // _RISE).astype(np.uint16), (turn // _TURN).astype(np.int64)
    return WatermarkCells(sensor, frame, ring, column, np.zeros(len(xyz), np.uint8), ranges=True)


def is_marked(xyz: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which returns (n,) bear a mark."""
    marked: NDArray[np.bool_] = np.linalg.norm(xyz.astype(np.float64), axis=1) >= LEAST
    return marked


def with_mark(
    watermark: WatermarkKey, xyz: NDArray[np.float32], *, sensor: str, frame: int
) -> NDArray[np.float32]:
    """Coordinates (n, 3) with the watermark in their ranges, in single precision."""
    out, rows = xyz.copy(), np.flatnonzero(is_marked(xyz))
    points = _off_edges(xyz[rows].astype(np.float64))
    cells = cells_by_direction(points, sensor=sensor, frame=frame)
    away = np.linalg.norm(points, axis=1)[:, None]
    marked = watermark.embedded(away, cells)
    marked = np.where(marked < LEAST + _EDGE, watermark.embedded(away + watermark.step, cells), marked)
    out[rows] = points * (marked / away)
    return out


def _polar(xyz: NDArray[np.floating]) -> tuple[Float, Float, Float]:
    """Azimuth from -x to the left and angle from straight down (n,), both at least 0, and range."""
    x, y, z = xyz.astype(np.float64).T
    level = np.hypot(x, y)
    turn = np.minimum(np.arctan2(y, x) + np.pi, np.nextafter(2 * np.pi, 0))
    return turn, np.minimum(np.arctan2(z, level) + np.pi / 2, np.nextafter(np.pi, 0)), np.hypot(level, z)


def _off_edges(xyz: Float) -> Float:
    """Points (n, 3) whose directions are not near an edge of a cell, each at its range."""
    turn, rise, away = _polar(xyz)
    inner_turn = np.clip(turn % _TURN, _EDGE, _TURN - _EDGE) + turn // _TURN * _TURN
    inner_rise = np.clip(rise % _RISE, _EDGE, _RISE - _EDGE) + rise // _RISE * _RISE
    near = (np.abs(inner_turn - turn) > 1e-12) | (np.abs(inner_rise - rise) > 1e-12)
    level, out = away * np.sin(inner_rise), xyz.copy()
    moved = np.column_stack(
        [-level * np.cos(inner_turn), -level * np.sin(inner_turn), -away * np.cos(inner_rise)]
    )
    out[near] = moved[near]
    return out
