"""Detail that no map holds, out of positions alone: grain, joints, courses, windows. Compiled, per pixel.

Everything is a hash of lattice points in the scene, so that the same place looks the same in every frame and
from every camera. Detail finer than a pixel's footprint fades to its mean instead of flickering.
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import math

import numpy as np
from numba import njit

compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})


_A, _B, _C = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77), np.uint32(0xC2B2AE3D)


@compiled
def _mixed(h: np.uint32) -> np.float32:
    """A number 0 <= m < 1 from 32 bits, well mixed (constants of C. Wellons' hash-prospector, 2018)."""
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.float32(h >> np.uint32(8)) * np.float32(2.0**-24)


@compiled
def _keyed(i: int, j: int, k: int) -> np.uint32:
    return np.uint32(
        np.uint32(np.uint32(i) * _A) + np.uint32(np.uint32(j) * _B) + np.uint32(np.uint32(k) * _C)
    )


@compiled
def hashed(i: int, j: int, k: int) -> float:
    """A number 0 <= h < 1 from three integers."""
    return float(_mixed(_keyed(i, j, k)))


@compiled
def noise(x: float, y: float, k: int) -> float:
    """Smooth noise in -1..1 on a lattice of spacing 1."""
    i, j = math.floor(x), math.floor(y)
    u, v = np.float32(x - i), np.float32(y - j)
    h = _keyed(i, j, k)
    u = u * u * (np.float32(3.0) - np.float32(2.0) * u)
    v = v * v * (np.float32(3.0) - np.float32(2.0) * v)
    p, q = _mixed(h), _mixed(np.uint32(h + _A))
    r, s = _mixed(np.uint32(h + _B)), _mixed(np.uint32(h + _A + _B))
    low = p + u * (q - p)
    return float(np.float32(2.0) * (low + v * (r + u * (s - r) - low)) - np.float32(1.0))


@compiled
def grain(x: float, y: float, size: float, footprint: float, k: int) -> float:
    """Noise of grains of ``size`` metres, faded to 0 where a pixel covers a grain."""
    fade = 2.0 - 2.0 * footprint / size
    if fade <= 0.0:
        return 0.0
    return min(fade, 1.0) * noise(x / size, y / size, k)


@compiled
def _risen(x: float, period: float, width: float) -> float:
    """Integral from 0 to x of a train of pulses, each ``width`` wide and in the middle of its period."""
    n = math.floor(x / period)
    return n * width + min(max(x - n * period - 0.5 * (period - width), 0.0), width)


@compiled
def pulses(x: float, period: float, width: float, footprint: float) -> float:
    """Share of a footprint about x that lies on a train of pulses."""
    f = max(footprint, 1e-3)
    return (_risen(x + 0.5 * f, period, width) - _risen(x - 0.5 * f, period, width)) / f


@compiled
def joints(x: float, y: float, side: float, width: float, footprint: float) -> float:
    """Share of a footprint on the joints between square slabs."""
    if footprint > side:
        return 2.0 * width / side
    a = pulses(x + 0.5 * side, side, width, footprint)
    b = pulses(y + 0.5 * side, side, width, footprint)
    return a + b - a * b


@compiled
def courses(u: float, v: float, footprint: float) -> float:
    """Share of a footprint on the mortar of a brick wall in stretcher bond: bricks of 239 x 71 mm."""
    if footprint > 0.12:
        return 0.25
    row = math.floor(v / 0.083)
    a = pulses(u + 0.125 * (row % 2) + 0.125, 0.25, 0.011, footprint)
    b = pulses(v + 0.0415, 0.083, 0.012, footprint)
    return a + b - a * b


PLAIN, SPECKLED, SLABS, BRICK, WEATHERED, LEAFY, LIQUID, SHINGLED = range(8)
"""Kinds of detail that a material may have."""


@compiled
def detail(kind: int, upright: int, x: float, y: float, z: float, u: float, footprint: float) -> float:
    """Factor about 1 on a surface's colour at scene point (x, y, z); u runs along an upright one."""
    if upright:
        a, b = u, z
    else:
        a, b = x + 0.31 * z, y + 0.47 * z
    if kind == SPECKLED:
        return (
            1.0
            + 0.10 * grain(a, b, 3.1, footprint, 1)
            + 0.12 * grain(a, b, 0.43, footprint, 2)
            + 0.26 * grain(a, b, 0.07, footprint, 3)
        )
    if kind == SLABS:
        tone = hashed(math.floor(a / 0.6), math.floor(b / 0.6), 5) - 0.5 if footprint < 0.6 else 0.0
        fade = max(0.0, 1.0 - footprint / 0.6)
        tone = 1.0 + 0.16 * fade * tone + 0.09 * grain(a, b, 0.09, footprint, 4)
        return tone * (1.0 - 0.45 * joints(a, b, 0.6, 0.014, footprint))
    if kind == BRICK:
        tone = 1.0 + 0.12 * grain(a, b, 0.9, footprint, 6) + 0.25 * grain(a, b * 3.0, 0.24, footprint, 7)
        return tone * (1.0 + 0.5 * courses(a, b, footprint))
    if kind == WEATHERED:
        return (
            1.0
            + 0.07 * grain(a, b, 2.3, footprint, 8)
            + 0.05 * grain(a, b * 0.15, 0.35, footprint, 9)
            + 0.05 * grain(a, b, 0.11, footprint, 10)
        )
    if kind == LEAFY:
        return (
            1.0
            + 0.28 * grain(a, b, 1.7, footprint, 11)
            + 0.30 * grain(a, b, 0.37, footprint, 12)
            + 0.34 * grain(a, b, 0.11, footprint, 13)
        )
    if kind == SHINGLED:
        tone = 1.0 + 0.12 * grain(a, b, 1.3, footprint, 14) + 0.16 * grain(a, b, 0.2, footprint, 15)
        return tone * (1.0 - 0.35 * pulses(z, 0.22, 0.03, footprint))
    return 1.0 + 0.05 * grain(a, b, 1.1, footprint, 16) + 0.04 * grain(a, b, 0.13, footprint, 17)
