"""Rays through the layers of an opening in a wall, in float64. Compiled, per ray.

Coordinates are those of `geoscene.buildings.facades.Openings`: x to the right and y up from the lower left
corner of the cell, z the depth behind the plane of the wall. Every layer is a box of air: a ray leaves it
through a side, through a block, through its back, or towards the layer in front. All surfaces are computed
from the start of the ray, so that the range on a side is as exact at grazing incidence as any other.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geoscene.buildings.facades import Openings
from geoscene.typing import Float
from lidar.raycast.memory import inline

WALL, SILL, FRAME, INFILL, ROOM = range(5)
"""Surfaces of an opening: `WALL` are the panel and the reveal."""
OUT = -1
"""In place of a surface: the ray crosses the plane of the wall from behind."""

PARTS = 4
"""Surfaces that are not of the wall: `SILL` to `ROOM`."""

_X, _Y, _Z = range(3)
_ON = 1e-6
"""Metres off a surface up to which a ray starts on it."""

(PANEL, _, _, _, SILL_BOX, _, _, _, OPENING, _, _, _) = range(12)
PANEL_DEPTH, REVEAL_DEPTH, PANE_DEPTH, FRAME_WIDTH, BARS, _, BAR, ROOM_DEPTH = range(12, 20)
WIDTH = 20
"""Columns of `opening_table`."""


def opening_table(openings: Openings) -> Float:
    """The dimensions (t, `WIDTH`) of kinds of openings for compiled code."""
    columns = (
        openings.panel,
        openings.sill,
        openings.opening,
        openings.panel_depth,
        openings.reveal_depth,
        openings.pane_depth,
        openings.frame,
        openings.bars,
        openings.bar,
        openings.room,
    )
    return np.ascontiguousarray(np.column_stack(columns), np.float64)


@inline
def within(kinds: Any, k: int, first: int, x: float, y: float, by: float) -> Any:
    """Whether a point lies in a rectangle of the table, grown by some metres."""
    return (
        kinds[k, first] - by <= x <= kinds[k, first + 2] + by
        and kinds[k, first + 1] - by <= y <= kinds[k, first + 3] + by
    )


@inline
def _pane(low: float, high: float, bars: float, bar: float, place: float) -> Any:
    """Ends of the pane, between bars of one direction, that holds a place; empty on a bar.

    The middles of n bars divide the way from low to high into n + 1 equal parts.
    """
    if bars < 1.0:
        return low, high
    step = (high - low) / (bars + 1.0)
    i = min(max(np.floor((place - low) / step), 0.0), bars)
    start = low + i * step + (0.5 * bar if i > 0.0 else 0.0)
    end = low + (i + 1.0) * step - (0.5 * bar if i < bars else 0.0)
    return start, end


@inline
def _leaves(x0: float, y0: float, z0: float, x1: float, y1: float, z1: float, ray: Any) -> Any:
    """Ray parameter and axis at which a ray in a box leaves it."""
    ox, oy, oz, dx, dy, dz = ray
    t, axis = np.inf, _Z
    if dz > 0.0:
        t = (z1 - oz) / dz
    elif dz < 0.0:
        t = (z0 - oz) / dz
    if dx != 0.0:
        s = ((x1 if dx > 0.0 else x0) - ox) / dx
        if s < t:
            t, axis = s, _X
    if dy != 0.0:
        s = ((y1 if dy > 0.0 else y0) - oy) / dy
        if s < t:
            t, axis = s, _Y
    return t, axis


@inline
def _enters(x0: float, y0: float, z0: float, x1: float, y1: float, z1: float, ray: Any, near: float) -> Any:
    """Ray parameter and axis at which a ray enters a block from ``near`` on; inf if it does not."""
    ox, oy, oz, dx, dy, dz = ray
    t, end, axis = -np.inf, np.inf, _Z
    for k in range(3):
        low, high, o, d = x0, x1, ox, dx
        if k == _Y:
            low, high, o, d = y0, y1, oy, dy
        elif k == _Z:
            low, high, o, d = z0, z1, oz, dz
        if d == 0.0:
            if not low < o < high:
                return np.inf, axis
            continue
        a, b = (low - o) / d, (high - o) / d
        if a > b:
            a, b = b, a
        if a >= t:
            t, axis = a, k
        end = min(end, b)
    if t >= end or t < near - _ON or end < near + _ON:
        return np.inf, axis
    return t, axis


@inline
def march(kinds: Any, k: int, ray: Any, start: float, layer: int) -> Any:
    """Follow a ray through the layers of an opening: ray parameter, axis of the normal, and surface.

    kinds, k : `opening_table` and its row
    ray      : origin and direction in the coordinates of the cell, six numbers
    start    : ray parameter of a point in the layer
    layer    : 0 panel, 1 reveal, 2 panes
    """
    ox, oy, _, dx, dy, dz = ray
    d0, d1, d2 = kinds[k, PANEL_DEPTH], kinds[k, REVEAL_DEPTH], kinds[k, PANE_DEPTH]
    x0, y0, x1, y1 = (
        kinds[k, OPENING],
        kinds[k, OPENING + 1],
        kinds[k, OPENING + 2],
        kinds[k, OPENING + 3],
    )
    f, bar = kinds[k, FRAME_WIDTH], kinds[k, BAR]
    t, front, passes = start, layer == 0 and dz > 0.0, layer == 2
    while True:
        if layer == 0:
            p, q, r, s = kinds[k, PANEL], kinds[k, PANEL + 1], kinds[k, PANEL + 2], kinds[k, PANEL + 3]
            begin = t
            t, axis = _leaves(p, q, 0.0, r, s, d0, ray)
            p, q, r, s = (
                kinds[k, SILL_BOX],
                kinds[k, SILL_BOX + 1],
                kinds[k, SILL_BOX + 2],
                kinds[k, SILL_BOX + 3],
            )
            if r > p:
                if front and within(kinds, k, SILL_BOX, ox + begin * dx, oy + begin * dy, 0.0):
                    return begin, _Z, SILL
                at, side = _enters(p, q, 0.0, r, s, d0, ray, begin)
                if at < t:
                    return at, side, SILL
            if axis != _Z:
                return t, axis, WALL
            if dz < 0.0:
                return t, _Z, OUT
            if not within(kinds, k, OPENING, ox + t * dx, oy + t * dy, 0.0):
                return t, _Z, WALL
            layer = 1
        if layer == 1:
            t, axis = _leaves(x0, y0, d0, x1, y1, d1, ray)
            if axis != _Z:
                return t, axis, WALL
            if dz < 0.0:
                layer = 0
                continue
            passes = False
        x, y = ox + t * dx, oy + t * dy
        p, r = _pane(x0 + f, x1 - f, kinds[k, BARS], bar, x)
        q, s = _pane(y0 + f, y1 - f, kinds[k, BARS + 1], bar, y)
        if not (passes or (p <= x <= r and q <= y <= s)):
            return t, _Z, FRAME
        t, axis = _leaves(p, q, d1, r, s, d2, ray)
        if axis != _Z:
            return t, axis, FRAME
        if dz > 0.0:
            return t, _Z, INFILL
        layer = 1


@inline
def layer_of(kinds: Any, k: int, x: float, y: float, z: float) -> int:
    """The layer whose air holds a point, its surfaces included; -1 for none."""
    if z <= kinds[k, PANEL_DEPTH] + _ON:
        sill = kinds[k, SILL_BOX + 2] > kinds[k, SILL_BOX] and within(kinds, k, SILL_BOX, x, y, -_ON)
        return 0 if within(kinds, k, PANEL, x, y, _ON) and not sill else -1
    if z <= kinds[k, REVEAL_DEPTH] + _ON:
        return 1 if within(kinds, k, OPENING, x, y, _ON) else -1
    if z > kinds[k, PANE_DEPTH] + _ON:
        return -1
    f, bar = kinds[k, FRAME_WIDTH], kinds[k, BAR]
    p, r = _pane(kinds[k, OPENING] + f, kinds[k, OPENING + 2] - f, kinds[k, BARS], bar, x)
    q, s = _pane(kinds[k, OPENING + 1] + f, kinds[k, OPENING + 3] - f, kinds[k, BARS + 1], bar, y)
    return 2 if p - _ON <= x <= r + _ON and q - _ON <= y <= s + _ON else -1


@inline
def in_room(kinds: Any, k: int, width: float, height: float, ray: Any) -> Any:
    """Ray parameter and axis at which a ray that has passed the pane hits the room; it is closed."""
    return _leaves(0.0, 0.0, kinds[k, PANE_DEPTH], width, height, kinds[k, ROOM_DEPTH], ray)
