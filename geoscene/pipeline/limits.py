"""Length errors that follow from where a scene lies and which CRS it has: map scale, ellipsoidal height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from geoscene.geometry.frames import Frame
from geoscene.typing import Float

LENGTHS = 100.0
"""Millimetres per kilometre by which lengths may be off unreported: 1 cm in 100 m, typical of scanners."""

_RADIUS = 6_371_008.8
"""Metres, the Earth's mean radius."""

_SIDE = 33
"""Places looked at along each side of a scene."""


@dataclass(frozen=True, slots=True)
class Limit:
    """An error that exceeds its bound.

    name     : ``map scale``, ``height``, ``origin`` or ``reach``
    measured : the largest error found
    bound    : the largest that is not reported
    unit     : of both
    advice   : one line: what is off, by how much, and what to do
    """

    name: str
    measured: float
    bound: float
    unit: str
    advice: str

    def to_json(self) -> dict[str, Any]:
        """The JSON object in ``scene.json`` and ``dataset.json``."""
        return asdict(self)


def scale_limit(frame: Frame, bounds: Sequence[float]) -> list[Limit]:
    """A limit if the map scale of the CRS puts lengths in scene coordinates off by more than `LENGTHS`.

    bounds : (xmin, ymin, xmax, ymax), scene metres
    """
    xy = places(bounds)
    scale = frame.scale_at(*xy.T)
    off = (scale - 1) * 1e6
    worst = float(off[np.nanargmax(np.abs(off))])
    if abs(worst) <= LENGTHS:
        return []
    way = "longer" if worst > 0 else "shorter"
    remedy = "build a smaller scene" if frame.name.startswith("Local") else "build with `crs` local"
    advice = (
        f"lengths in scene coordinates are up to {abs(worst):,.0f} mm per km {way} than true ones"
        f" ({frame.name}); drives take that into account, your own measurements must divide by the scale, or"
        f" {remedy}"
    )
    return [Limit("map scale", round(abs(worst), 1), LENGTHS, "mm/km", advice)]


def height_limit(z: Float) -> list[Limit]:
    """A limit if heights z (n,) in metres above the ellipsoid put lengths off by more than `LENGTHS`."""
    height = float(z[np.argmax(np.abs(z))])
    off = height / _RADIUS * 1e6
    if abs(off) <= LENGTHS:
        return []
    way = "longer" if off > 0 else "shorter"
    advice = (
        f"at a height of {height:,.0f} m true lengths are {abs(off):,.0f} mm per km {way} than in the scene"
        f" and in drives, which have those on the ellipsoid; multiply by {1 + off / 1e6:.6f}"
    )
    return [Limit("height", round(abs(off), 1), LENGTHS, "mm/km", advice)]


def places(bounds: Sequence[float]) -> Float:
    """A lattice of places (n, 2) over a scene's bounds."""
    xmin, ymin, xmax, ymax = bounds
    x, y = np.meshgrid(np.linspace(xmin, xmax, _SIDE), np.linspace(ymin, ymax, _SIDE))
    return np.column_stack([x.ravel(), y.ravel()])
