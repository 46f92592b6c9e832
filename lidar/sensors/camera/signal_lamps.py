"""Light of the lamps of signal heads in images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class, materials
from geoscene.typing import Float

_LIGHT, _GLASS = int(Class.TRAFFIC_LIGHT), materials()["glass"].code

LENSES = 2.875
"""Height in metres of the middle one of the three lenses in the shape, see `geoscene.objects.shapes`."""

APART, RADIUS = 0.283, 0.1
"""Metres between the middles of lenses, and their radius: lenses of 200 mm (EN 12368)."""

_FRONT = 0.37  # metres from the post's axis beyond which a hit is on the side with the lenses
_SHARE = np.pi * RADIUS**2 / (0.26 * 0.85)  # of one lens in that side
_BLUR = 0.3  # metres of growth of a pixel beyond a radius, over which lenses cease to be told apart

_LUMINANCE = 200 / (np.pi * RADIUS**2) / 133_300
"""Luminance of a lens of 200 cd (EN 12368) in units of `light.Light`, of which one is the
illuminance of the sun above the atmosphere, 133.3 klx, per steradian."""

_COLORS = np.array([[1.0, 0.02, 0.01], [1.0, 0.36, 0.0], [0.0, 1.0, 0.5]])
"""Linear sRGB of red, amber and green lamps: their chromaticities by EN 12368, clipped to sRGB."""

_LUMA = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True, slots=True)
class Lamps:
    """Signal heads whose lamps are lit.

    feature : (n,) int32, ascending
    state   : (n,) uint8, which lamp is lit: 0 red, 1 amber, 2 green, from the top
    """

    feature: NDArray[np.int32]
    state: NDArray[np.uint8]

    def lit(
        self, feature: NDArray[np.int32], klass: NDArray[np.uint8], *, material: NDArray[np.uint8]
    ) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Rows of surfaces (n,) that are fronts of these heads, and the lamps that are lit there."""
        rows = np.flatnonzero((klass == _LIGHT) & (material & 127 == _GLASS))
        at = np.searchsorted(self.feature, feature[rows]).clip(max=max(len(self.feature) - 1, 0))
        known = self.feature[at] == feature[rows] if len(self.feature) else np.zeros(len(rows), np.bool_)
        return rows[known], self.state[at[known]]


def emit(state: NDArray[np.uint8], *, place: Float, width: Float, exposure: float) -> NDArray[np.float32]:
    """Linear light (n, 3) that lamps add, in units of `light.Light`.

    state    : (n,) which lamp of the head is lit
    place    : (n, 3) in the heads' own frames, metres
    width    : (n,) metres that a pixel is wide there
    exposure : of the image. A lamp is at most at full scale, so that its colour can be told at night, too
    """
    away = np.hypot(place[:, 1], place[:, 2] - LENSES - APART * (1.0 - state))
    sharp = np.clip((RADIUS - away) / np.maximum(width, 1e-6) + 0.5, 0.0, 1.0)
    far = np.clip((width - RADIUS) / _BLUR, 0.0, 1.0)
    share = np.where(place[:, 0] > _FRONT, (1 - far) * sharp + far * _SHARE, 0.0)
    color = _COLORS[state]
    bright = np.minimum(_LUMINANCE / (color @ _LUMA), 1 / (exposure * color.max(axis=1)))
    light: NDArray[np.float32] = ((share * bright)[:, None] * color).astype(np.float32)
    return light
