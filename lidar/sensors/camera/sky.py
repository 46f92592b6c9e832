"""Radiance where rays hit nothing: sky, clouds, haze below the horizon. Compiled, per pixel."""

# mypy: disallow-untyped-decorators=False
from __future__ import annotations

import math
from statistics import NormalDist
from typing import Any

import numpy as np

from geoscene.typing import Float
from lidar.sensors.camera.texture import inlined, noise

HEIGHT = 1200.0
"""Metres from cameras up to the clouds, a flat layer; typical of cumulus in fair weather."""

LIMB = 2 / 3
"""Share of the zenith's radiance that closed clouds lose down to the horizon: the CIE standard overcast sky
(ISO 15469). Single clouds are as bright everywhere, and lose the share in between."""

_SIZE, _OCTAVES, _GAIN = 1300.0, 6, 0.56
"""Metres of the largest lumps of clouds, number of sizes, each half the last, and ratio of amplitudes."""

_DEVIATION = 0.52
"""Standard deviation of the sum of these lumps, whose heights are about normal."""

_EDGE = 0.2
"""Height of lumps over which the edge of a cloud fades in."""

_RIM = 0.035
"""Added to the sine of the elevation: the layer ends at 1 / _RIM times its height, as on a round earth."""


def cloud_pattern(cover: float, place: tuple[float, float]) -> Float:
    """The clouds of a sky, (5,): cover, height of lumps that are clouds, their mean height, east, north.

    cover : share of the sky that clouds cover
    place : metres east and north of the scene's origin at which the pattern begins
    """
    normal = NormalDist()
    bound = normal.inv_cdf(min(max(1 - cover, 1e-6), 1 - 1e-6))
    mean = normal.pdf(bound) / max(cover, 1e-6)
    return np.array([cover, _DEVIATION * bound, _DEVIATION * mean, *place])


@inlined
def sky_radiance(sky: Any, x: float, y: float, z: float, sun: Any, out: Any) -> None:
    """Radiance of the sky towards a unit vector with z >= 0, between the entries of the table."""
    rows, columns = sky.shape[0] - 1, sky.shape[1] - 1
    flat = math.sqrt((x * x + y * y) * (sun[0] * sun[0] + sun[1] * sun[1]))
    turn = (x * sun[0] + y * sun[1]) / flat if flat > 1e-12 else 0.0
    a = math.sqrt(math.asin(min(max(z, 0.0), 1.0)) * (2.0 / math.pi)) * rows
    b = (1.0 - min(max(turn, -1.0), 1.0)) * 0.5 * columns
    i, j = min(int(a), rows - 1), min(int(b), columns - 1)
    a, b = a - i, b - j
    for c in range(3):
        low = sky[i, j, c] + b * (sky[i, j + 1, c] - sky[i, j, c])
        high = sky[i + 1, j, c] + b * (sky[i + 1, j + 1, c] - sky[i + 1, j, c])
        out[c] = low + a * (high - low)


@inlined
def _lumps(u: float, v: float, footprint: float) -> float:
    """Height of the lumps of clouds at a place of the layer, without those that a pixel covers."""
    height, size, amplitude = 0.0, _SIZE, 1.0
    for k in range(_OCTAVES):
        fade = 2.0 - 2.0 * footprint / size
        if fade > 0.0:
            height += min(fade, 1.0) * amplitude * noise(u / size, v / size, 50 + k)
        u, v = 0.8 * u - 0.6 * v, 0.6 * u + 0.8 * v  # so that lattices of the sizes are not parallel
        size *= 0.5
        amplitude *= _GAIN
    return height


@inlined
def background(i: int, view: Any, light: Any, angle: float, colors: Any, out: Any) -> None:
    """Fill row ``i`` of ``out`` where nothing is hit.

    angle : of a pixel, radians
    """
    origin, row, direction, _, _ = view
    sun, beam, _, _, horizon, clear, veil, clouds = light
    d, glow = colors[0], colors[1]
    dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    d[0], d[1], d[2] = dx / length, dy / length, dz / length
    up = max(d[2], 0.0)
    sky_radiance(clear, d[0], d[1], up, sun, glow)
    cover, tone = clouds[0], 1.0
    if cover > 0.0 and d[2] > 0.0:
        away = HEIGHT / (up + _RIM)
        footprint = angle * away / (up + _RIM)
        known = min(max(2.0 - 2.0 * footprint / _SIZE, 0.0), 1.0)
        if known > 0.0:
            o = row[i]
            height = _lumps(
                origin[o, 0] + away * d[0] - clouds[3], origin[o, 1] + away * d[1] - clouds[4], footprint
            )
            share = min(max((height - clouds[1]) / _EDGE + 0.5, 0.0), 1.0)
            share = share * share * (3.0 - 2.0 * share)
            cover += known * (share - cover)
            # Thick clouds are darker below, thin edges brighter.
            contrast = known * (0.45 - 0.25 * clouds[0])
            tone = min(max(1.0 - contrast * (height - clouds[2]), 0.5), 1.5)
    below = min(max(-50.0 * d[2], 0.0), 1.0)  # beyond the edge of the scene there is haze
    facing = d[0] * sun[0] + d[1] * sun[1] + d[2] * sun[2]
    disc = min(max((facing - 0.999985) / 4e-6, 0.0), 1.0)  # 0.27 degrees, softened
    overcast = tone * (1.0 - LIMB * clouds[0] * (1.0 - up))
    for c in range(3):
        seen = glow[c] + cover * (overcast * veil[c] - glow[c])
        out[i, c] = seen + below * (horizon[c] - seen) + (1.0 - cover) * disc * beam[c] * 100.0
