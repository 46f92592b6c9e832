"""The factors of `texture.detail` and `ground_texture.ground` for many pixels.

They are those of one pixel. Each loop does one step for all pixels, reads and writes few columns, and has
selections in place of branches, so that the compiler makes vector instructions of it.
"""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.typing import Float
from lidar.sensors.camera import texture
from lidar.sensors.camera.ground_texture import (
    ASPHALT,
    CRACK_SHARE,
    CRACKS,
    FINE,
    OCTAVES,
    PAINT_KEPT,
    PATCHES,
    SPOT_LEVEL,
    cracks,
    draw_cracks,
    near_crack,
    near_patch,
    near_spot,
    patch,
    spot_fade,
    spot_sizes,
    spots,
    triangulate_pavement,
    wear,
)
from lidar.sensors.camera.texture import GRAINS, between, cell, compiled, courses, key, shingles, slabs

BLOCK = 256
"""Pixels of a block; its columns stay in the processor's first cache."""

PLACES = 9
"""Columns that factors depend on: x, y, z, u along an upright surface, hx, hy, across, along, footprint, as
`texture.detail` and `ground_texture.ground` describe them."""

PAINTED, UPRIGHT, DETAIL = 8, 1, 16
"""Kinds of texture are numbers: -1 for none; those of ground, with `PAINTED` on the paint of a road; and
`DETAIL` and twice those of detail, with `UPRIGHT` on upright surfaces."""

_KINDS = DETAIL + 2 * len(GRAINS)
_A, _B = texture.FACTOR_X, texture.FACTOR_Y

Scratch = tuple[Float, Float, NDArray[np.int32], NDArray[np.uint32], NDArray[np.float32], NDArray[np.int64]]


@compiled
def scratch() -> Any:
    """Columns to work in: places, others of 64 bits, counts, keys, others of 32 bits, and rows."""
    return (
        np.empty((PLACES, BLOCK)),
        np.empty((8, BLOCK)),
        np.empty(BLOCK, np.int32),
        np.empty(BLOCK, np.uint32),
        np.empty((3, BLOCK), np.float32),
        np.empty(BLOCK, np.int64),
    )


@compiled
def factors(kind: NDArray[np.int64], places: Float, work: Scratch, out: Float) -> None:
    """Fill ``out`` (n,) with factors on the albedos of n <= `BLOCK` pixels.

    kind   : (n,) of texture
    places : (`PLACES`, n)
    work   : `scratch`
    """
    own, tone, rows = work[0], work[1][0], work[5]
    used = np.zeros(_KINDS, np.bool_)
    for i in range(len(kind)):
        out[i] = 1.0
        if kind[i] >= 0:
            used[kind[i]] = True
    for k in range(_KINDS):
        if not used[k]:
            continue
        n = 0
        for i in range(len(kind)):
            rows[n] = i
            n += kind[i] == k
        at = places
        if n < len(kind):
            at = own
            for c in range(PLACES):
                for j in range(n):
                    own[c, j] = places[c, rows[j]]
        if k >= DETAIL:
            _detail((k - DETAIL) // 2, k & UPRIGHT, n, at, work, tone)
        else:
            _ground(k & (PAINTED - 1), k & PAINTED, n, at, work, tone)
        for j in range(n):
            out[rows[j]] = tone[j]


@compiled
def _ground(kind: int, painted: int, n: int, at: Float, work: Scratch, tone: Float) -> None:
    """The factors of `lidar.sensors.camera.ground_texture.ground`."""
    x, y, hx, hy, across, along = at[0], at[1], at[4], at[5], at[6], at[7]
    _, others, count, _, _, _ = work
    weight, start, step, total, px, py = others[1], others[2], others[3], others[4], others[5], others[6]
    for i in range(n):
        tone[i] = 1.0
    for k in range(4):
        amplitude, fine = OCTAVES[kind, k, 0], FINE[kind, k]
        if amplitude == 0.0:
            continue
        _weigh(n, fine, across, along, weight)
        most = _samples(n, fine, along, weight, count)
        _steps(n, fine, along, count, start, step)
        for i in range(n):
            total[i] = 0.0
        for s in range(most):
            _sample(n, fine, s, x, hx, start, step, px)
            _sample(n, fine, s, y, hy, start, step, py)
            noise = _noises(n, 50 + 8 * k + kind, px, py, work)
            for i in range(n):
                total[i] += noise[i] if s < count[i] else np.float32(0.0)
        if most > 0:
            _add_mean(n, amplitude, weight, total, count, tone)
    for which in range(2):
        _spot(kind, which, n, at, work, tone)
    if kind == ASPHALT:
        _patch(n, at, work, tone)
    else:
        for i in range(n):
            tone[i] *= triangulate_pavement(kind, x[i], y[i], np.sqrt(across[i] * along[i]))
    if CRACK_SHARE[kind] > 0.0:
        _crack(kind, n, at, work, tone)
    if painted:
        for i in range(n):
            tone[i] = 1.0 + PAINT_KEPT * (tone[i] - 1.0)


@compiled
def _spot(kind: int, which: int, n: int, at: Float, work: Scratch, tone: Float) -> None:
    """Multiply by the spots of one size."""
    x, y, hx, hy, across, along, near = at[0], at[1], at[4], at[5], at[6], at[7], work[2]
    sizes, level = spot_sizes(kind, which), SPOT_LEVEL[kind, which] - 1.0
    for i in range(n):
        near[i] = near_spot(x[i], y[i], along[i], which, sizes)
    for i in range(n):
        tone[i] *= 1.0 if near[i] else 1.0 + spot_fade(across[i], along[i], sizes) * level
    for i in range(n):
        if near[i]:
            tone[i] *= spots(x[i], y[i], hx[i], hy[i], across[i], along[i], kind, which)


@compiled
def _patch(n: int, at: Float, work: Scratch, tone: Float) -> None:
    """Multiply by the patches of asphalt."""
    x, y, hx, hy, across, along, near = at[0], at[1], at[4], at[5], at[6], at[7], work[2]
    for i in range(n):
        near[i] = near_patch(x[i], y[i], across[i], along[i])
    for i in range(n):
        tone[i] *= patch(x[i], y[i], hx[i], hy[i], across[i], along[i]) if near[i] else 1.0 / PATCHES


@compiled
def _crack(kind: int, n: int, at: Float, work: Scratch, tone: Float) -> None:
    """Multiply by the cracks."""
    x, y, hx, hy, across, along, near, worn = at[0], at[1], at[4], at[5], at[6], at[7], work[2], work[1][1]
    some = 0
    for i in range(n):
        some += across[i] <= CRACKS
    if some > 0:
        for i in range(n):
            worn[i] = wear(x[i], y[i], kind)
        some = 0
        for i in range(n):
            some += worn[i] > 0.0
    for i in range(n):
        near[i] = 0
    if some > 0:
        for i in range(n):
            near[i] = near_crack(x[i], y[i], along[i], worn[i])
    for i in range(n):
        share = draw_cracks(x[i], y[i], hx[i], hy[i], across[i], along[i], kind) if near[i] else 0.0
        tone[i] *= cracks(share, kind)


@compiled
def _weigh(n: int, fine: float, across: Float, along: Float, weight: Float) -> None:
    for i in range(n):
        weight[i] = max(min(2.0 - 2.0 * across[i] * fine, 1.0, 2.0 - 0.2 * (along[i] * fine)), 0.0)


@compiled
def _samples(n: int, fine: float, along: Float, weight: Float, count: NDArray[np.int32]) -> Any:
    """Fill ``count`` with the samples of each pixel; returns the greatest one of those that have weight."""
    most = np.int32(0)
    for i in range(n):
        count[i] = np.int32(min(1.6 * (along[i] * fine), 4.0)) + np.int32(1)
    for i in range(n):
        most = max(most, count[i] if weight[i] > 0.0 else np.int32(0))
    return most


@compiled
def _steps(n: int, fine: float, along: Float, count: NDArray[np.int32], start: Float, step: Float) -> None:
    for i in range(n):
        step[i] = along[i] * fine / count[i]
    for i in range(n):
        start[i] = 0.5 * (step[i] - along[i] * fine)


@compiled
def _sample(n: int, fine: float, s: int, x: Float, hx: Float, start: Float, step: Float, out: Float) -> None:
    for i in range(n):
        out[i] = x[i] * fine + (start[i] + s * step[i]) * hx[i]


@compiled
def _add_mean(
    n: int, amplitude: float, weight: Float, total: Float, count: NDArray[np.int32], tone: Float
) -> None:
    for i in range(n):
        tone[i] += amplitude * (weight[i] * total[i] / count[i])


@compiled
def _noises(n: int, k: int, x: Float, y: Float, work: Scratch) -> Any:
    """`lidar.sensors.camera.texture.noise` at n places."""
    keys, (u, v, out) = work[3], (work[4][0], work[4][1], work[4][2])
    first = key(0, 0, k)
    for i in range(n):
        keys[i] = np.uint32(first + np.uint32(np.uint32(cell(x[i])) * _A))
    for i in range(n):
        u[i] = np.float32(x[i] - np.floor(x[i]))
    for i in range(n):
        keys[i] = np.uint32(keys[i] + np.uint32(np.uint32(cell(y[i])) * _B))
    for i in range(n):
        v[i] = np.float32(y[i] - np.floor(y[i]))
    for i in range(n):
        out[i] = np.float32(between(keys[i], u[i], v[i]))
    return out


@compiled
def _detail(kind: int, upright: int, n: int, at: Float, work: Scratch, tone: Float) -> None:
    """The factors of `lidar.sensors.camera.texture.detail`."""
    x, y, z, u, footprint = at[0], at[1], at[2], at[3], at[8]
    a, b, fade, px, py = work[1][1], work[1][2], work[1][3], work[1][4], work[1][5]
    for i in range(n):
        a[i] = u[i] if upright else x[i] + 0.31 * z[i]
    for i in range(n):
        b[i] = z[i] if upright else y[i] + 0.47 * z[i]
    for i in range(n):
        tone[i] = 1.0
    for k in range(3):
        amplitude, fine, stretch = GRAINS[kind, k, 0], texture.FINE[kind, k], GRAINS[kind, k, 2]
        if amplitude == 0.0:
            continue
        some = 0
        for i in range(n):
            fade[i] = max(min(2.0 - 2.0 * footprint[i] * fine, 1.0), 0.0)
        for i in range(n):
            some += fade[i] > 0.0
        if some == 0:
            continue
        for i in range(n):
            px[i] = a[i] * fine
        for i in range(n):
            py[i] = b[i] * stretch * fine
        noise = _noises(n, 8 * k + kind, px, py, work)
        for i in range(n):
            tone[i] += amplitude * (fade[i] * noise[i])
    if kind == texture.SLABS:
        for i in range(n):
            tone[i] = slabs(a[i], b[i], footprint[i], tone[i])
    elif kind == texture.BRICK:
        for i in range(n):
            tone[i] *= 1.0 + 0.5 * courses(a[i], b[i], footprint[i])
    elif kind == texture.SHINGLED:
        for i in range(n):
            tone[i] *= shingles(z[i], footprint[i])
