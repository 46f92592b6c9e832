"""Procedural surface detail: grain, joints, courses, windows. Compiled, per pixel.

Everything is a hash of lattice points in the scene, so that the same place looks the same in every frame and
from every camera. Detail finer than a pixel's footprint fades to its mean instead of flickering.
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any

import numpy as np

from geoscene.support.compiled import njit

_CONTRACT = {"contract", "arcp", "nsz"}
_UNCOUNTED: dict[str, Any] = {"_nrt": False}

compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
inlined = njit(nogil=True, error_model="numpy", fastmath=_CONTRACT, forceinline=True, **_UNCOUNTED)
"""Decorators of functions that Python calls, and of those of a pixel, into which arrays go: without counting
references of arrays, which would take a third of the time. The caller holds them."""

FACTOR_X, FACTOR_Y, _C = np.uint32(0x9E3779B1), np.uint32(0x85EBCA77), np.uint32(0xC2B2AE3D)
"""Factors of the numbers of a cell in its key."""


@inlined
def mix(h: np.uint32) -> np.float32:
    """A number 0 <= m < 1 from 32 bits, well mixed (constants of C. Wellons' hash-prospector, 2018)."""
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D))
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.float32(np.int32(h >> np.uint32(8))) * np.float32(2.0**-24)


@inlined
def key(i: int, j: int, k: int) -> np.uint32:
    """32 bits for three integers, to be mixed."""
    return np.uint32(
        np.uint32(np.uint32(i) * FACTOR_X) + np.uint32(np.uint32(j) * FACTOR_Y) + np.uint32(np.uint32(k) * _C)
    )


@inlined
def hash_place(i: int, j: int, k: int) -> float:
    """A number 0 <= h < 1 from three integers."""
    return float(mix(key(i, j, k)))


@inlined
def cell(x: float) -> Any:
    """The whole number below x, of 32 bits: processors convert several of these at once."""
    return np.int32(np.floor(x))


@inlined
def between(h: np.uint32, u: np.float32, v: np.float32) -> float:
    """Smooth noise in -1..1 at (u, v) in the cell of a lattice whose key is h."""
    u = u * u * (np.float32(3.0) - np.float32(2.0) * u)
    v = v * v * (np.float32(3.0) - np.float32(2.0) * v)
    p, q = mix(h), mix(np.uint32(h + FACTOR_X))
    r, s = mix(np.uint32(h + FACTOR_Y)), mix(np.uint32(h + FACTOR_X + FACTOR_Y))
    low = p + u * (q - p)
    return float(np.float32(2.0) * (low + v * (r + u * (s - r) - low)) - np.float32(1.0))


@inlined
def noise(x: float, y: float, k: int) -> float:
    """Smooth noise in -1..1 on a lattice of spacing 1."""
    return between(key(cell(x), cell(y), k), np.float32(x - np.floor(x)), np.float32(y - np.floor(y)))


@compiled
def grain(x: float, y: float, fine: float, footprint: float, k: int) -> float:
    """Noise of grains, ``fine`` to a metre, faded to 0 where a pixel covers a grain."""
    fade = 2.0 - 2.0 * footprint * fine
    if fade <= 0.0:
        return 0.0
    return min(fade, 1.0) * noise(x * fine, y * fine, k)


@inlined
def span(x: float, period: float, footprint: float) -> tuple[float, float, float, float]:
    """A footprint about x on a pattern, for `cover`: its ends within their periods, periods between."""
    f = max(footprint, 1e-3)
    low, high = x - 0.5 * f, x + 0.5 * f
    first, last = np.floor(low / period), np.floor(high / period)
    return low - first * period, high - last * period, last - first, 1.0 / f


@inlined
def cover(ends: tuple[float, float, float, float], period: float, width: float) -> float:
    """Share of a `span` that lies on pulses, each ``width`` wide and in the middle of its period."""
    low, high, whole, inverse = ends
    gap = 0.5 * (period - width)
    ahead = min(max(high - gap, 0.0), width) - min(max(low - gap, 0.0), width)
    return (whole * width + ahead) * inverse


@inlined
def pulses(x: float, period: float, width: float, footprint: float) -> float:
    """Share of a footprint about x that lies on a train of pulses."""
    return cover(span(x, period, footprint), period, width)


@inlined
def joints(x: float, y: float, side: float, width: float, footprint: float) -> float:
    """Share of a footprint on the joints between square slabs."""
    if footprint > side:
        return 2.0 * width / side
    a = pulses(x + 0.5 * side, side, width, footprint)
    b = pulses(y + 0.5 * side, side, width, footprint)
    return a + b - a * b


@inlined
def courses(u: float, v: float, footprint: float) -> float:
    """Share of a footprint on the mortar of a brick wall in stretcher bond: bricks of 239 x 71 mm."""
    if footprint > 0.12:
        return 0.25
    row = np.floor(v / 0.083)
    odd = row - 2.0 * np.floor(0.5 * row)
    a = pulses(u + 0.125 * odd + 0.125, 0.25, 0.011, footprint)
    b = pulses(v + 0.0415, 0.083, 0.012, footprint)
    return a + b - a * b


PLAIN, SPECKLED, SLABS, BRICK, WEATHERED, LEAFY, LIQUID, SHINGLED = range(8)
"""Kinds of detail that a material may have."""

# For each kind up to three grains: amplitude, size in metres, ratio of width to height.
GRAINS = np.array(
    [
        [[0.05, 1.1, 1.0], [0.04, 0.13, 1.0], [0.0, 1.0, 1.0]],
        [[0.14, 1.9, 1.0], [0.16, 0.21, 1.0], [0.34, 0.045, 1.0]],
        [[0.04, 2.7, 1.0], [0.09, 0.09, 1.0], [0.0, 1.0, 1.0]],
        [[0.12, 0.9, 1.0], [0.25, 0.24, 3.0], [0.0, 1.0, 1.0]],
        [[0.07, 2.3, 1.0], [0.05, 0.35, 0.15], [0.05, 0.11, 1.0]],
        [[0.28, 1.7, 1.0], [0.30, 0.37, 1.0], [0.34, 0.11, 1.0]],
        [[0.05, 1.1, 1.0], [0.0, 1.0, 1.0], [0.0, 1.0, 1.0]],
        [[0.12, 1.3, 1.0], [0.16, 0.2, 1.0], [0.0, 1.0, 1.0]],
    ]
)

FINE = 1.0 / GRAINS[:, :, 1]


@inlined
def slabs(a: float, b: float, footprint: float, tone: float) -> float:
    """The factor with slabs of several tones and their joints."""
    slab = hash_place(cell(a / 0.6), cell(b / 0.6), 5) - 0.5
    tone += 0.16 * max(1.0 - footprint / 0.6, 0.0) * slab
    return tone * (1.0 - 0.45 * joints(a, b, 0.6, 0.014, footprint))


@inlined
def shingles(z: float, footprint: float) -> float:
    """Factor of rows of shingles."""
    return 1.0 - 0.35 * pulses(z, 0.22, 0.03, footprint)


@compiled
def detail(kind: int, upright: int, x: float, y: float, z: float, u: float, footprint: float) -> float:
    """Factor around 1 on the colour at scene point (x, y, z); u runs along an upright surface."""
    if upright:
        a, b = u, z
    else:
        a, b = x + 0.31 * z, y + 0.47 * z
    tone = 1.0
    for k in range(3):
        amplitude, fine, stretch = GRAINS[kind, k, 0], FINE[kind, k], GRAINS[kind, k, 2]
        if amplitude > 0.0:
            tone += amplitude * grain(a, b * stretch, fine, footprint, 8 * k + kind)
    if kind == SLABS:
        tone = slabs(a, b, footprint, tone)
    elif kind == BRICK:
        tone *= 1.0 + 0.5 * courses(a, b, footprint)
    elif kind == SHINGLED:
        tone *= shingles(z, footprint)
    return tone
