"""Procedural texture of level ground: patches, cracks, stains, joints and stones. Compiled, per pixel.

As in `texture`, everything is a hash of places in the scene. What a pixel covers on the ground
is long and thin, so each feature is filtered along and across the line of sight, and fades to its mean where
it is finer than a pixel. The mean of each texture is 1: it changes no surface's mean albedo.
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import math
from typing import Any

import numpy as np

from geoscene.classes import Class
from lidar.sensors.camera.texture import (
    FACTOR_X,
    FACTOR_Y,
    cell,
    compiled,
    hash_place,
    inlined,
    joints,
    key,
    mix,
    noise,
    pulses,
)

BARE, ASPHALT, CONCRETE, PAVING, SETTS, LOOSE, GREEN = range(7)
"""Kinds of ground: without texture; asphalt; concrete; paving stones; setts; gravel, sand and soil; grass."""

MATERIALS = {
    ASPHALT: ("asphalt", "asphalt_fresh"),
    CONCRETE: ("concrete",),
    PAVING: ("paving", "brick"),
    SETTS: ("stone",),
    LOOSE: ("gravel", "soil", "dirt", "sand", "ballast"),
    GREEN: ("grass", "dry_grass"),
}

LOWEST, HIGHEST, PAVED = int(Class.ROAD), int(Class.BUILDING_PAD), int(Class.PAVED)
"""Classes from and up to which level surfaces are ground; road markings are among them."""

PAINT_KEPT = 0.35
"""Share of the texture of the road that shows on its paint."""

# For each kind: amplitude and size in metres of four octaves of noise. Standard deviations are a third of
# the amplitudes. The finest are stones of asphalt concrete (0/11 mm), sand in mortar, blades of grass: most
# of what the eye sees of a road is their contrast, and little of it coarser. All numbers here are assumed.
OCTAVES = np.array(
    [
        [[0.0, 1.0], [0.0, 1.0], [0.0, 1.0], [0.0, 1.0]],
        [[0.08, 2.6], [0.14, 0.33], [0.34, 0.055], [0.36, 0.010]],
        [[0.10, 2.1], [0.10, 0.35], [0.14, 0.05], [0.20, 0.008]],
        [[0.10, 2.3], [0.10, 0.30], [0.14, 0.05], [0.18, 0.008]],
        [[0.10, 2.7], [0.12, 0.40], [0.24, 0.045], [0.22, 0.009]],
        [[0.22, 1.9], [0.20, 0.26], [0.40, 0.060], [0.17, 0.018]],
        [[0.24, 1.9], [0.22, 0.37], [0.30, 0.085], [0.22, 0.016]],
    ]
)

FINE = 1.0 / OCTAVES[:, :, 1]

# Spots, of two sizes for each kind: side in metres of the squares of which a share has one, that share, least
# and greatest radius in metres, factors of the albedo of dark and of light ones, and the share of dark ones:
# oil, tar and chewing gum; paint, pebbles and worn places; tufts and bare earth.
_SPOTS = np.array(
    [
        [[1.0, 0.0, 0.1, 0.1, 1.0, 1.0, 1.0], [1.0, 0.0, 0.1, 0.1, 1.0, 1.0, 1.0]],
        [[0.45, 0.55, 0.012, 0.05, 0.40, 2.0, 0.65], [1.40, 0.60, 0.06, 0.24, 0.50, 1.45, 0.7]],
        [[0.40, 0.65, 0.012, 0.04, 0.45, 1.25, 0.8], [1.70, 0.50, 0.06, 0.24, 0.70, 1.15, 0.8]],
        [[0.40, 0.65, 0.012, 0.04, 0.45, 1.25, 0.8], [1.70, 0.50, 0.06, 0.24, 0.70, 1.15, 0.8]],
        [[0.50, 0.30, 0.012, 0.04, 0.50, 1.30, 0.8], [1.70, 0.40, 0.06, 0.26, 0.65, 1.20, 0.8]],
        [[0.30, 0.70, 0.015, 0.05, 0.50, 1.60, 0.5], [1.30, 0.50, 0.08, 0.30, 0.70, 1.30, 0.5]],
        [[0.35, 0.70, 0.020, 0.07, 0.50, 1.60, 0.6], [1.40, 0.60, 0.09, 0.35, 0.60, 1.40, 0.6]],
    ]
)

_CELL, _CHANCE, _LEAST, _MOST, _DARK, _LIGHT, _DARK_SHARE = np.moveaxis(_SPOTS, -1, 0)
# The mean share of ground under spots, of radii evenly distributed from the least to the greatest.
_COVERED = _CHANCE * np.pi * (_LEAST**2 + _LEAST * _MOST + _MOST**2) / (3.0 * _CELL**2)
SPOT_LEVEL = 1.0 / (1.0 + _COVERED * (_DARK_SHARE * _DARK + (1.0 - _DARK_SHARE) * _LIGHT - 1.0))
"""One over the mean factor of ground with spots."""

_PATCH = 7.3
"""Side in metres of the squares of which `_PATCHED` have a patch of other asphalt with a sealed edge."""
_PATCHED = 0.40
_PATCH_LONG, _PATCH_WIDE = (0.7, 1.9), (0.35, 0.9)
_PATCH_DARK, _PATCH_LIGHT = 0.66, 1.28
_SEAL, _SEALED = 0.025, 0.55

_LONG, _WIDE = 0.5 * (_PATCH_LONG[0] + _PATCH_LONG[1]), 0.5 * (_PATCH_WIDE[0] + _PATCH_WIDE[1])
PATCHES = (
    1.0
    + _PATCHED * 4.0 * _LONG * _WIDE / (_PATCH * _PATCH) * (0.5 * (_PATCH_DARK + _PATCH_LIGHT) - 1.0)
    + _PATCHED * 8.0 * _SEAL * (_LONG + _WIDE) / (_PATCH * _PATCH) * (_SEALED - 1.0)
)
"""The mean factor of ground with patches."""

_CRACK_DARK = 0.40
_CRACK = 0.030
"""Greatest width of a crack in metres, sealed with bitumen or not."""
CRACKS = 2.0 * _CRACK
"""Width of a pixel in metres up to which cracks are seen."""
CRACK_SHARE = np.array([0.0, 0.0062, 0.0033, 0.0, 0.0, 0.0, 0.0])
"""Share of the ground that lies in cracks, by kind: means over 400 by 400 m."""
_CRACK_FROM = np.array([2.0, 0.00, 0.25, 2.0, 2.0, 2.0, 2.0])
"""Level of the noise above which ground is cracked, by kind; 1 is its maximum."""

_SLAB_CONCRETE, _SLAB_PAVING = 2.4, 0.6
_SETT_LONG, _SETT_WIDE, _SETT_JOINT = 0.17, 0.11, 0.014
_JOINT_DARK, _SETT_DARK = 0.45, 0.55


@compiled
def _octave(
    x: float, y: float, hx: float, hy: float, fine: float, across: float, along: float, k: int
) -> float:
    """Noise of one size, averaged over the footprint of a pixel by up to five samples along it.

    fine : one over the size
    """
    fade = 2.0 - 2.0 * across * fine
    if fade <= 0.0:
        return 0.0
    x, y, along = x * fine, y * fine, along * fine
    n = min(int(1.6 * along) + 1, 5)
    fade = min(fade, 1.0, 2.0 - 0.2 * along)
    if fade <= 0.0:
        return 0.0
    if n == 1:
        return fade * noise(x, y, k)
    step = along / n
    start = 0.5 * (step - along)
    total = 0.0
    for i in range(n):
        total += noise(x + (start + i * step) * hx, y + (start + i * step) * hy, k)
    return fade * total / n


@compiled
def _within(d: float, half: float, width: float) -> float:
    """Share of a footprint of some width about d that lies between -half and half."""
    low, high = max(d - 0.5 * width, -half), min(d + 0.5 * width, half)
    return max(high - low, 0.0) / width


@inlined
def _part(h: np.uint32, k: int) -> float:
    """`lidar.sensors.camera.texture.hash_place` of a cell with the key h for k = 0."""
    return float(mix(np.uint32(h + key(0, 0, k))))


@inlined
def spot_sizes(kind: int, which: int) -> tuple[float, float, float, float]:
    """Side of the squares of spots, the share of those with one, and least and greatest radius."""
    return _SPOTS[kind, which, 0], _SPOTS[kind, which, 1], _SPOTS[kind, which, 2], _SPOTS[kind, which, 3]


@inlined
def _spot(
    x: float, y: float, which: int, sizes: tuple[float, float, float, float]
) -> tuple[np.uint32, float, float, float]:
    """Key of the cell of a place, the radius of its spot, and the place from its middle."""
    side, _, least, most = sizes
    fine = 1.0 / side
    h = key(cell(x * fine), cell(y * fine), 0)
    r = least + (most - least) * _part(h, 62 + which)
    free = 0.5 - 1.3 * r * fine
    dx = x - (np.floor(x * fine) + 0.5 + free * (2.0 * _part(h, 64 + which) - 1.0)) * side
    dy = y - (np.floor(y * fine) + 0.5 + free * (2.0 * _part(h, 66 + which) - 1.0)) * side
    return h, r, dx, dy


@inlined
def near_spot(x: float, y: float, along: float, which: int, sizes: tuple[float, float, float, float]) -> bool:
    """Whether a footprint of this length may reach a spot of these `spot_sizes`."""
    h, r, dx, dy = _spot(x, y, which, sizes)
    reach = 1.3 * r + along
    return dx * dx + dy * dy < reach * reach and _part(h, 60 + which) < sizes[1]


@inlined
def spot_fade(across: float, along: float, sizes: tuple[float, float, float, float]) -> float:
    """Share of spots that is seen with a footprint of this size."""
    return max(min(2.0 - across * (2.0 / sizes[3]), 2.0 - along * (2.0 / sizes[0]), 1.0), 0.0)


@compiled
def spots(
    x: float, y: float, hx: float, hy: float, across: float, along: float, kind: int, which: int
) -> float:
    """Factor of the spots of one size; its mean is 1."""
    sizes = spot_sizes(kind, which)
    fade = spot_fade(across, along, sizes)
    tone = 1.0
    if fade > 0.0 and near_spot(x, y, along, which, sizes):
        h, r, dx, dy = _spot(x, y, which, sizes)
        d = math.sqrt(dx * dx + dy * dy)
        if d < 1.3 * r + along:
            if which:
                # Stains have no round outline; the mean of their area is that of the circle.
                r *= 1.0 + 0.3 * noise(x / (0.7 * r), y / (0.7 * r), 68)
            nx, ny = (dx / d, dy / d) if d > 1e-9 else (1.0, 0.0)
            forward, aside = abs(nx * hx + ny * hy), abs(nx * hy - ny * hx)
            width = max(forward * along + aside * across, 1e-3)
            other = max(aside * along + forward * across, 1e-3)
            cover = _within(d, r, width) * min(2.0 * r / other, 1.0)
            own = _SPOTS[kind, which, 4 if _part(h, 69 + which) < _SPOTS[kind, which, 6] else 5]
            tone = 1.0 + cover * (own - 1.0)
    factor = 1.0 + fade * (tone * SPOT_LEVEL[kind, which] - 1.0)
    return float(factor)


@inlined
def _patch_at(x: float, y: float) -> tuple[np.uint32, float, float, float, float]:
    """Key of the cell of a place, half the sides of its patch, and the place from its middle."""
    h = key(cell(x / _PATCH), cell(y / _PATCH), 0)
    a = _PATCH_LONG[0] + (_PATCH_LONG[1] - _PATCH_LONG[0]) * _part(h, 71)
    b = _PATCH_WIDE[0] + (_PATCH_WIDE[1] - _PATCH_WIDE[0]) * _part(h, 72)
    free = 0.5 - math.sqrt(a * a + b * b) / _PATCH
    dx = x - (np.floor(x / _PATCH) + 0.5 + free * (2.0 * _part(h, 73) - 1.0)) * _PATCH
    dy = y - (np.floor(y / _PATCH) + 0.5 + free * (2.0 * _part(h, 74) - 1.0)) * _PATCH
    return h, a, b, dx, dy


@inlined
def near_patch(x: float, y: float, across: float, along: float) -> bool:
    """Whether a footprint of this size may reach a patch."""
    h, a, b, dx, dy = _patch_at(x, y)
    r = math.sqrt(a * a + b * b) + 2.0 * _SEAL + across + along
    return dx * dx + dy * dy < r * r and _part(h, 70) < _PATCHED


@compiled
def patch(x: float, y: float, hx: float, hy: float, across: float, along: float) -> float:
    """Factor of rectangular patches of darker or lighter asphalt with sealed edges; its mean is about 1."""
    tone = 1.0
    if near_patch(x, y, across, along):
        h, a, b, dx, dy = _patch_at(x, y)
        turn = math.pi * _part(h, 75)
        c, s = math.cos(turn), math.sin(turn)
        u, v = c * dx + s * dy, c * dy - s * dx
        p, q = abs(c * hx + s * hy), abs(c * hy - s * hx)
        wide_u, wide_v = max(p * along + q * across, 1e-3), max(q * along + p * across, 1e-3)
        if abs(u) < a + _SEAL + 0.5 * wide_u and abs(v) < b + _SEAL + 0.5 * wide_v:
            outer = _within(u, a + _SEAL, wide_u) * _within(v, b + _SEAL, wide_v)
            inner = _within(u, a - _SEAL, wide_u) * _within(v, b - _SEAL, wide_v)
            factor = _PATCH_DARK if _part(h, 76) < 0.5 else _PATCH_LIGHT
            tone = 1.0 + inner * (factor - 1.0) + (outer - inner) * (_SEALED - 1.0)
    return tone / PATCHES


@inlined
def _slope(x: float, y: float, k: int) -> tuple[float, float, float]:
    """`lidar.sensors.camera.texture.noise` and its derivatives."""
    h = key(cell(x), cell(y), k)
    s, t = x - np.floor(x), y - np.floor(y)
    u, v = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
    du, dv = 6.0 * s * (1.0 - s), 6.0 * t * (1.0 - t)
    p, q = float(mix(h)), float(mix(np.uint32(h + FACTOR_X)))
    r, w = float(mix(np.uint32(h + FACTOR_Y))), float(mix(np.uint32(h + FACTOR_X + FACTOR_Y)))
    low, high = p + u * (q - p), r + u * (w - r)
    return (
        2.0 * (low + v * (high - low)) - 1.0,
        2.0 * du * ((q - p) + v * ((w - r) - (q - p))),
        2.0 * dv * (high - low),
    )


@inlined
def wear(x: float, y: float, kind: int) -> Any:
    """Ground with more than 0 is cracked."""
    return noise(x / 9.0, y / 9.0, 80) - _CRACK_FROM[kind] + 0.4 * noise(x / 2.7, y / 2.7, 81)


@inlined
def _crack(x: float, y: float) -> tuple[float, float, float]:
    """Distance to the middle of the nearest crack, and the normal of the crack."""
    f, fx, fy = _slope(x / 2.3, y / 2.3, 82)
    g, gx, gy = _slope(x / 0.55, y / 0.55, 83)
    f += 0.35 * g
    fx, fy = fx / 2.3 + 0.35 * gx / 0.55, fy / 2.3 + 0.35 * gy / 0.55
    steep = max(math.sqrt(fx * fx + fy * fy), 0.3)
    return abs(f) / steep, fx / steep, fy / steep


@inlined
def near_crack(x: float, y: float, along: float, worn: float) -> bool:
    """Whether a footprint of this length may reach a crack, where ground has this `wear`."""
    d, _, _ = _crack(x, y)
    return worn > 0.0 and d <= _CRACK * min(2.5 * worn, 1.0) + along


@compiled
def draw_cracks(x: float, y: float, hx: float, hy: float, across: float, along: float, kind: int) -> float:
    """Share of a footprint in cracks: the zeros of a noise, where another one says that ground is worn."""
    worn = wear(x, y, kind) if across <= CRACKS else 0.0
    if worn <= 0.0:
        return 0.0
    d, nx, ny = _crack(x, y)
    wide = _CRACK * min(2.5 * worn, 1.0)
    if d > wide + along:
        return 0.0
    width = max(abs(nx * hx + ny * hy) * along + abs(nx * hy - ny * hx) * across, 1e-3)
    return _within(d, 0.5 * wide, width)


@inlined
def cracks(share: float, kind: int) -> Any:
    """Factor of ground of which this share lies in cracks."""
    return (1.0 - (1.0 - _CRACK_DARK) * share) / (1.0 - (1.0 - _CRACK_DARK) * CRACK_SHARE[kind])


@compiled
def _slabs(x: float, y: float, side: float, footprint: float) -> float:
    """Factor of square slabs of several tones with dark joints; its mean is 1."""
    joint = 0.014
    tone = 1.0
    if footprint < side:
        tone += 0.2 * (1.0 - footprint / side) * (hash_place(cell(x / side), cell(y / side), 5) - 0.5)
    share = 2.0 * joint / side - (joint / side) ** 2
    return tone * (1.0 - _JOINT_DARK * joints(x, y, side, joint, footprint)) / (1.0 - _JOINT_DARK * share)


@compiled
def _setts(x: float, y: float, footprint: float) -> float:
    """Factor of setts in shifted rows, each of its own tone, with dark joints; its mean is 1."""
    row = cell(y / _SETT_WIDE)
    shifted = x + _SETT_LONG * hash_place(row, 0, 84)
    tone = 1.0
    if footprint < _SETT_WIDE:
        stone = hash_place(cell(shifted / _SETT_LONG), row, 85) - 0.5
        tone += 0.6 * (1.0 - footprint / _SETT_WIDE) * stone
    a, b = _SETT_JOINT / _SETT_LONG, _SETT_JOINT / _SETT_WIDE
    share = a + b - a * b
    if footprint > _SETT_WIDE:
        return tone
    u = pulses(shifted + 0.5 * _SETT_LONG, _SETT_LONG, _SETT_JOINT, footprint)
    v = pulses(y + 0.5 * _SETT_WIDE, _SETT_WIDE, _SETT_JOINT, footprint)
    return tone * (1.0 - _SETT_DARK * (u + v - u * v)) / (1.0 - _SETT_DARK * share)


@compiled
def ground(
    kind: int, painted: bool, x: float, y: float, hx: float, hy: float, across: float, along: float
) -> float:
    """Factor around 1, with mean 1, on the albedo of level ground at scene point (x, y).

    painted : on the paint of a road, which wears with what is below it
    hx, hy  : horizontal unit vector along the line of sight
    across, along : width and length in metres of what a pixel covers
    """
    if kind == BARE:
        return 1.0
    tone = 1.0
    for k in range(4):
        tone += OCTAVES[kind, k, 0] * _octave(x, y, hx, hy, FINE[kind, k], across, along, 50 + 8 * k + kind)
    tone *= spots(x, y, hx, hy, across, along, kind, 0)
    tone *= spots(x, y, hx, hy, across, along, kind, 1)
    if kind == ASPHALT:
        tone *= patch(x, y, hx, hy, across, along)
    else:
        tone *= triangulate_pavement(kind, x, y, math.sqrt(across * along))
    if CRACK_SHARE[kind] > 0.0:
        tone *= cracks(draw_cracks(x, y, hx, hy, across, along, kind), kind)
    return 1.0 + PAINT_KEPT * (tone - 1.0) if painted else tone


@compiled
def triangulate_pavement(kind: int, x: float, y: float, footprint: float) -> float:
    """Factor of slabs or setts."""
    if kind == CONCRETE:
        return _slabs(x, y, _SLAB_CONCRETE, footprint)
    if kind == PAVING:
        return _slabs(x, y, _SLAB_PAVING, footprint)
    return _setts(x, y, footprint) if kind == SETTS else 1.0
