"""Reflection and transmission of glass, water and films of water."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.raycast.memory import inline

AIR, WATER, GLASS = 1.0003, 1.33, 1.5
"""Refractive indices."""

_ABSORPTION = (900.0, 1000.0, 1200.0, 1400.0, 1600.0), (6.8, 36.3, 104.0, 1239.0, 672.0)
"""Absorption of water: nanometres, and 1/m (Hale and Querry 1973)."""

_SLOPE_CALM, _SLOPE_WIND = 0.003, 0.00512  # Cox and Munk 1954: mean square slope 0.003 + 0.00512 U


def fresnel(cosine: ArrayLike, index: float, *, outside: float = AIR) -> tuple[Float, Float]:
    """Reflected shares of power (s, p) at a smooth boundary, by the cosine of incidence."""
    ci = np.asarray(cosine, float)
    ct = np.sqrt(1 - (outside / index) ** 2 * (1 - ci * ci))
    s: Float = ((outside * ci - index * ct) / (outside * ci + index * ct)) ** 2
    p: Float = ((index * ci - outside * ct) / (index * ci + outside * ct)) ** 2
    return s, p


def surface_reflection(cosine: ArrayLike, index: float = WATER) -> Float:
    """Reflected share of unpolarised light at one boundary."""
    s, p = fresnel(cosine, index)
    return (s + p) / 2


def pane_reflection(cosine: ArrayLike, index: float = GLASS) -> Float:
    """Reflected share of unpolarised light at a pane: both faces and all inner reflections, lossless."""
    s, p = fresnel(cosine, index)
    return s / (1 + s) + p / (1 + p)


@inline
def film(cosine: Any, reflectance: Any) -> Any:
    """Factor of the reflectance of a diffuse surface under a smooth film of water; compiled.

    Mean of both polarisations of t^2 / (1 - reflectance r), with the reflected share r and the transmitted
    share t = 1 - r of the air's boundary at the cosine of incidence, inside and outside (Hahner et al. 2022).
    """
    inside = math.sqrt(1.0 - (AIR / WATER) ** 2 * (1.0 - cosine * cosine))
    s = ((AIR * cosine - WATER * inside) / (AIR * cosine + WATER * inside)) ** 2
    p = ((WATER * cosine - AIR * inside) / (WATER * cosine + AIR * inside)) ** 2
    through_s = (1.0 - s) ** 2 / (1.0 - reflectance * s)
    return 0.5 * (through_s + (1.0 - p) ** 2 / (1.0 - reflectance * p))


@njit(cache=True, nogil=True)
def under_film(cosine: Float, reflectance: Float) -> Float:
    """Factor (n,) that a water film applies to the reflectance of surfaces; see `film`."""
    factor = np.empty(len(cosine))
    for i in range(len(cosine)):
        factor[i] = film(cosine[i], reflectance[i])
    return factor


def through_water(wavelength_nm: float, path: float) -> float:
    """Share of light that a path through water leaves."""
    wavelength, absorption = np.array(_ABSORPTION)
    return math.exp(-math.exp(float(np.interp(wavelength_nm, wavelength, np.log(absorption)))) * path)


def glint(cosine: ArrayLike, *, wind: float = 3.0) -> Float:
    """Apparent reflectance of open water near normal incidence: specular reflection by wave facets.

    R / (4 m cos^5) exp(-tan^2 / m) with the mean square slope m of Cox and Munk (1954), expressed as the
    Lambertian reflectance that returns the same power.

    wind : m/s
    """
    c = np.maximum(np.asarray(cosine, float), 1e-3)
    slope = _SLOPE_CALM + _SLOPE_WIND * wind
    tan2 = (1 - c * c) / (c * c)
    back: Float = float(surface_reflection(1.0)) / (4 * slope * c**5) * np.exp(-tan2 / slope)
    return back


def reflect(direction: Float, normal: Float) -> Float:
    """Directions (n, 3) mirrored at surfaces with unit normals (n, 3); lengths are kept."""
    along = np.einsum("ij,ij->i", direction, normal)[:, None]
    reflected: Float = direction - 2 * along * normal
    return reflected
