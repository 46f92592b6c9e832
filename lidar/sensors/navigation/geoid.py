"""Height of the geoid above the ellipsoid, from the grids that PROJ finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import Transformer
from pyproj.exceptions import ProjError

from geoscene.typing import Float

_MODELS = {"EGM2008": "EPSG:9518", "EGM96": "EPSG:9707"}  # WGS 84 with heights above each geoid


@dataclass(frozen=True, slots=True)
class Geoid:
    """Separation (n,) in metres of a geoid from the WGS 84 ellipsoid, upwards, and the geoid's name."""

    name: str
    separation: Float


def geoid_at(lon: Float, lat: Float) -> Geoid | None:
    """The geoid at longitudes and latitudes (n,) in degrees; None if PROJ has a grid of neither model.

    EGM2008, else EGM96: `projsync --file us_nga_egm96_15` installs a grid.
    """
    for name, code in _MODELS.items():
        try:
            turned = Transformer.from_crs(
                "EPSG:4979", code, always_xy=True, allow_ballpark=False, only_best=True
            )
            height = turned.transform(lon, lat, np.zeros(len(lon)))[2]
        except ProjError:
            continue
        separation = -np.asarray(height, float)
        if np.isfinite(separation).all():
            return Geoid(name, separation)
    return None
