"""First crossings of rays with the rough ground of a kind, as compiled code.

Rays are put into lanes and followed by turns; a lane is a row of a table whose columns are named below.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.memory import compile_out_of_line, inline
from lidar.raycast.relief.roughness import BLOCK, KINDS, LEVELS, NODES, REACH, STEP, roughness

DEPTH, _SLOPE, _SCALE, _JOINTS, FIELD_SLOPE = range(5, 10)
"""Columns of `Roughness.kinds`."""

_CELLS = 1.0 / STEP
"""Cells of a field per metre."""

_LEAST = 5e-4
"""Metres along the plane that a step among joints covers at least; dips shorter than that can be missed."""

_STEPS = 4096
_NARROWINGS = 60
"""Steps towards the surface at most, and narrowings of the step that crosses it."""

_PAST = 1e-7
"""Cells by which a step goes past the border of a cell."""

_DIFFERENCE = 1e-3
"""Metres to both sides over which the slope of joints is measured, so that normals in them point upwards."""

LANES = 64
"""Rays that are followed by turns."""

_X, _Y, _Z, DX, DY, _DZ, _OVER_X, _OVER_Y, _UNIT, _PASSES = range(10)
_T, END, _KIND, FOUND, SLOPE_X, SLOPE_Y, GAIN, LENGTH, SIDE, _FIRST, _NODES = range(10, 21)
COLUMNS = 21
"""Columns of a lane: place in cells and height in units of the field, their changes, one over those along x
and y, steepness and steps past borders per parameter; parameter, its end, kind, crossing, slopes there,
height that the ray gains on the plane, length of the direction, metres along a cell, start of the field and
its nodes along a side."""

_CLOSE = 1e-8
"""Metres from the surface at which a crossing is found."""


_FINEST = STEP * np.sqrt(2.0)
"""Metres; a level's cells are nearest to half of the patch that is seen, in powers of two."""

_SCATTER = 39916801.0, 27644437.0
"""Multiplied by these numbers, places that are close to each other have fractions that differ at random."""

_SPREAD = 0.84, 0.35
"""Least factor by which patches are scattered, and the range of factors: half an octave in all."""


def heights(kind: str, xy: Float, *, level: int = 0) -> Float:
    """Heights (n,) of a kind of ground at places (n, 2), scene metres, relative to the plane: 0 or less.

    level : of detail; 0: all, else cells are 2^level times as wide and stones have no joints
    """
    out = np.empty(len(xy))
    _heights(roughness(), list(KINDS).index(kind), level, np.ascontiguousarray(xy, np.float64), out)
    return out


@inline
def level_of(patch: float, scattered: Any, x: float, y: float) -> int:
    """Level of detail about a place for a footprint of ``patch`` metres.

    scattered : whether rays near the border of two levels take either, by a random number of the place, so
                that no edge is seen in images where a level ends
    """
    level, cells = 0, patch / _FINEST
    if scattered:
        chance = x * _SCATTER[0] + y * _SCATTER[1]
        cells *= _SPREAD[0] + _SPREAD[1] * (chance - np.floor(chance))
    while cells >= 2.0 and level < LEVELS - 1:
        level, cells = level + 1, 0.5 * cells
    return level


@inline
def _cell(field: Any, first: int, nodes: int, u: float, v: float) -> Any:
    """Block of a place in cells, the place in its cell, and the surface there, a + p u + q v + r u v.

    first, nodes : start of the level in ``field``, and nodes along its side, a power of two
    """
    fu, fv = np.floor(u), np.floor(v)
    start, side = np.uint64(first), np.uint64(nodes)
    last = side - np.uint64(1)
    i, j = np.uint64(np.int64(fu)) & last, np.uint64(np.int64(fv)) & last
    k, m = (i + np.uint64(1)) & last, (j + np.uint64(1)) & last
    row, next_row = start + i * side, start + k * side
    a = np.float64(field[row + j])
    p, q = np.float64(field[next_row + j]) - a, np.float64(field[row + m]) - a
    r = np.float64(field[next_row + m]) - a - p - q
    two = np.uint64(BLOCK)
    block = start // (two * two) + (i // two) * (side // two) + j // two
    return block, u - fu, v - fv, a, p, q, r


@inline
def _joint(length: float, width: float, joint: float, deep: float, x: float, y: float) -> Any:
    """Height among stones in stretcher bond: 0 on top, ``-deep`` in the middle of joints."""
    row = np.floor(y / width)
    v = y - row * width
    u = x + (0.5 * length if np.int64(row) & 1 else 0.0)
    u -= np.floor(u / length) * length
    edge = min(u, length - u, v, width - v)
    return -deep * max(1.0 - 2.0 * edge / joint, 0.0)


@inline
def joints(rough: Any, k: int, x: float, y: float) -> Any:
    """Height of a kind with stones above its waves."""
    kinds = rough.kinds
    return _joint(kinds[k, 1], kinds[k, 2], kinds[k, 3], kinds[k, 4], x, y)


@compile_out_of_line
def height(rough: Any, k: int, x: float, y: float) -> Any:
    """Height of a kind at a place, metres."""
    first = rough.first[rough.number[k], 0]
    _, u, v, a, p, q, r = _cell(rough.field, first, NODES, x * _CELLS, y * _CELLS)
    h = rough.kinds[k, 0] * (a + p * u + q * v + r * u * v)
    return h + joints(rough, k, x, y) if rough.kinds[k, 1] > 0.0 else h


@inline
def _slopes(rough: Any, k: int, x: float, y: float) -> Any:
    """Slopes of `height` along x and y."""
    first = rough.first[rough.number[k], 0]
    _, u, v, _, p, q, r = _cell(rough.field, first, NODES, x * _CELLS, y * _CELLS)
    factor = rough.kinds[k, 0] * _CELLS
    sx, sy = factor * (p + r * v), factor * (q + r * u)
    if rough.kinds[k, 1] > 0.0 and joints(rough, k, x, y) < 0.0:
        d = _DIFFERENCE
        sx += (joints(rough, k, x + d, y) - joints(rough, k, x - d, y)) / (2.0 * d)
        sy += (joints(rough, k, x, y + d) - joints(rough, k, x, y - d)) / (2.0 * d)
    return sx, sy


@njit(cache=True, nogil=True, error_model="numpy")
def _heights(rough: Any, k: int, level: int, xy: Any, out: Any) -> None:
    side, nodes, first = STEP * 2.0**level, NODES >> level, rough.first[rough.number[k], level]
    for i in range(len(out)):
        if level == 0:
            out[i] = height(rough, k, xy[i, 0], xy[i, 1])
            continue
        _, u, v, a, p, q, r = _cell(rough.field, first, nodes, xy[i, 0] / side, xy[i, 1] / side)
        out[i] = rough.kinds[k, 0] * (a + p * u + q * v + r * u * v) + rough.kinds[k, _JOINTS]


@inline
def _gap(rough: Any, k: int, place: Any, way: Any, t: float) -> Any:
    """Metres of a ray above the surface at a parameter."""
    return place[2] + t * way[2] - height(rough, k, place[0] + t * way[0], place[1] + t * way[1])


@compile_out_of_line
def _narrow(rough: Any, k: int, place: Any, way: Any, low: Any, high: Any) -> Any:
    """The crossing between two parameters with the gaps there, by false position (Illinois)."""
    (a, above), (b, below) = low, high
    side = 0
    for _ in range(_NARROWINGS):
        t = (a * below - b * above) / (below - above)
        if not a < t < b:
            return b if t >= b else a
        gap = _gap(rough, k, place, way, t)
        if gap > 0.0:
            a, above = t, gap
            if gap < _CLOSE:
                return a
            if side > 0:
                below *= 0.5
            side = 1
        else:
            b, below = t, gap
            if side < 0:
                above *= 0.5
            side = -1
    return a


@compile_out_of_line
def _among_joints(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """Ray parameter of the first crossing of the surface by a ray that is below the top of the stones.

    Steps are so short that the greatest slope cannot reach the ray within them, but for those of `_LEAST`
    metres.
    """
    dx, dy, dz = way
    across = np.sqrt(dx * dx + dy * dy)
    closing = across * rough.kinds[k, _SLOPE] + abs(dz)
    shortest = _LEAST / max(across, abs(dz))
    t, gap = start, _gap(rough, k, place, way, start)
    if gap <= 0.0:
        return t
    for _ in range(_STEPS):
        ahead = min(t + max(gap / closing, shortest), end)
        there = _gap(rough, k, place, way, ahead)
        if there <= 0.0:
            return _narrow(rough, k, place, way, (t, gap), (ahead, there))
        if ahead >= end:
            return np.inf
        t, gap = ahead, there
    return t


@compile_out_of_line
def _in_joint(rough: Any, k: int, place: Any, way: Any, start: float, end: float) -> Any:
    """`_crossing` of a ray that is below the top of the stones at ``start``."""
    t = _among_joints(rough, k, place, way, start, end)
    sx, sy = 0.0, 0.0
    if t < np.inf:
        sx, sy = _slopes(rough, k, place[0] + t * way[0], place[1] + t * way[1])
    return t, sx, sy


@inline
def _inverse(way: float) -> Any:
    """One over a change; for none a number so great that no border is reached."""
    return 1.0 / way if way != 0.0 else 1e300


@inline
def begin(rough: Any, k: int, level: int, place: Any, way: Any, span: Any, lanes: Any, n: int) -> None:
    """Put a ray into a lane.

    level : of detail
    place : x, y and height above the plane at parameter 0
    way   : change of each per parameter
    span  : first and last parameter
    """
    scale, f = rough.kinds[k, _SCALE], rough.number[k]
    side, cells = STEP * np.float64(1 << level), _CELLS / np.float64(1 << level)
    z = place[2] - rough.kinds[k, _JOINTS] if level > 0 else place[2]
    lanes[n, _X], lanes[n, _Y], lanes[n, _Z] = place[0] * cells, place[1] * cells, z * scale
    dx, dy = way[0] * cells, way[1] * cells
    lanes[n, DX], lanes[n, DY], lanes[n, _DZ] = dx, dy, way[2] * scale
    lanes[n, _OVER_X], lanes[n, _OVER_Y] = _inverse(dx), _inverse(dy)
    speed = max(abs(dx), abs(dy))
    lanes[n, _UNIT], lanes[n, _PASSES] = rough.unit[f, level] * speed, _PAST / speed
    lanes[n, _T], lanes[n, END] = span
    lanes[n, _KIND], lanes[n, GAIN], lanes[n, SIDE] = k, way[2], side
    lanes[n, _FIRST], lanes[n, _NODES] = rough.first[f, level], NODES >> level


@inline
def descend(rough: Any, lanes: Any, n: int) -> None:
    """Advance the ray of a lane from the plane to the highest place near ahead of it."""
    t, dx, dy, dz = lanes[n, _T], lanes[n, DX], lanes[n, DY], lanes[n, _DZ]
    first, blocks = np.int64(lanes[n, _FIRST]), np.int64(lanes[n, _NODES]) // REACH
    i = np.int64(np.floor((lanes[n, _X] + t * dx) * (1.0 / REACH))) & (blocks - 1)
    j = np.int64(np.floor((lanes[n, _Y] + t * dy) * (1.0 / REACH))) & (blocks - 1)
    towards = (2 if dx < 0.0 else 0) + (1 if dy < 0.0 else 0)
    top = np.float64(rough.top[towards, first // (REACH * REACH) + i * blocks + j])
    falls = (top - lanes[n, _Z] - t * dz) / dz
    lanes[n, _T] = t + max(min(falls, (REACH - 1) / max(abs(dx), abs(dy))), 0.0)


@inline
def _step(rough: Any, lanes: Any, n: int) -> Any:
    """Advance the ray of a lane by a step; whether it goes on.

    A step goes as far as no place ahead of the ray's block can rise to the ray (a cone step, after Dummer
    2006). Within a cell the surface is bilinear, and the crossing the root of a quadratic equation.
    """
    t, dx, dy, dz = lanes[n, _T], lanes[n, DX], lanes[n, DY], lanes[n, _DZ]
    first, nodes = np.int64(lanes[n, _FIRST]), np.int64(lanes[n, _NODES])
    block, u, v, a, p, q, r = _cell(rough.field, first, nodes, lanes[n, _X] + t * dx, lanes[n, _Y] + t * dy)
    gap = lanes[n, _Z] + t * dz - (a + p * u + q * v + r * u * v)
    towards = (2 if dx < 0.0 else 0) + (1 if dy < 0.0 else 0)
    closing = lanes[n, _UNIT] * np.float64(rough.steep[towards, block]) - dz
    border = min(
        ((1.0 if dx >= 0.0 else 0.0) - u) * lanes[n, _OVER_X],
        ((1.0 if dy >= 0.0 else 0.0) - v) * lanes[n, _OVER_Y],
    )
    crosses, ends, step = gap <= 0.0, closing <= 0.0, 0.0
    if gap > border * closing:
        step = gap / closing
    elif not crosses:
        # The least t at which gap + falls t + bend t^2 is zero.
        falls, bend = dz - (p * dx + q * dy + r * (u * dy + v * dx)), -r * dx * dy
        under = falls * falls - 4.0 * bend * gap
        over = np.sqrt(max(under, 0.0)) - falls
        crosses = (under >= 0.0) & (over > 0.0) & (2.0 * gap <= border * over)
        step = 2.0 * gap / over if crosses else border + lanes[n, _PASSES]
    t += step
    lanes[n, _T] = t
    lanes[n, SLOPE_X], lanes[n, SLOPE_Y] = p + r * (v + step * dy), q + r * (u + step * dx)
    ends = (t > lanes[n, END]) | (ends & (not crosses))
    lanes[n, FOUND] = np.inf if ends else t
    return not (crosses | ends)


@inline
def follow(rough: Any, lanes: Any, active: Any, count: int) -> None:
    """Follow the rays of lanes to their first crossing: its parameter (inf: none) and the slopes there.

    Rays advance by turns, for a step waits for its own numbers, but not for those of other rays.
    """
    for n in range(count):
        active[n] = n
    left = count
    for _ in range(_STEPS):
        kept = 0
        for m in range(left):
            n = active[m]
            active[kept] = n
            kept += 1 if _step(rough, lanes, n) else 0
        left = kept
        if left == 0:
            break
    for n in range(count):
        k = np.int64(lanes[n, _KIND])
        factor = rough.kinds[k, 0]
        slope = factor / lanes[n, SIDE]
        lanes[n, SLOPE_X], lanes[n, SLOPE_Y] = slope * lanes[n, SLOPE_X], slope * lanes[n, SLOPE_Y]
        t = lanes[n, FOUND]
        if rough.kinds[k, 1] > 0.0 and t < np.inf and np.int64(lanes[n, _NODES]) == NODES:
            place = lanes[n, _X] * STEP, lanes[n, _Y] * STEP, lanes[n, _Z] * factor
            way = lanes[n, DX] * STEP, lanes[n, DY] * STEP, lanes[n, _DZ] * factor
            if joints(rough, k, place[0] + t * way[0], place[1] + t * way[1]) < 0.0:
                lanes[n, FOUND], lanes[n, SLOPE_X], lanes[n, SLOPE_Y] = _in_joint(
                    rough, k, place, way, t, lanes[n, END]
                )
