"""Reflection at surfaces: reflectance, incidence laws, glass, water and films of water."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from geoscene.classes import materials
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


WAVELENGTHS_NM = (905.0, 1064.0, 1550.0)
"""Wavelengths for which the reflectance of materials is given."""

INCIDENCE_LAWS = ("lambert", "phong", "oren-nayar")
"""Laws of `sent_back`."""

_LAMBERT, _PHONG = 0, 1

RETRO = 1.0
"""A material with a greater reflectance is a retro-reflector."""

_ROUGHNESS = float(np.radians(20.0))  # slope deviation of rough facades, typical value
_RETRO_FLAT, _RETRO_FALL = math.pi / 6, math.pi / 4  # sheeting: flat to 30°, 40 % at 45°, typical
_RETRO_LEFT = 0.4

_FILM = 0.5e-3  # metres of water on and in a soaked surface, half of a road's texture of 1.2 mm, typical


@functools.lru_cache(maxsize=16)
def reflectance_table(wavelength_nm: float) -> tuple[Float, Float]:
    """Reflectance (256,) and specular share (256,) by material code, at a wavelength in nanometres.

    Linear between the wavelengths of the material table and constant beyond them. Codes without a material
    have the values of ``unknown``.
    """
    known = materials()
    plain = known["unknown"]
    reflectance = np.full(256, np.interp(wavelength_nm, WAVELENGTHS_NM, plain.reflectance))
    specular = np.full(256, plain.specular)
    for material in known.values():
        reflectance[material.code] = np.interp(wavelength_nm, WAVELENGTHS_NM, material.reflectance)
        specular[material.code] = material.specular
    reflectance.flags.writeable = specular.flags.writeable = False
    return reflectance, specular


class CoveredReflectance(NamedTuple):
    """Reflectance of surfaces open to the sky that are partly wet or under snow, by material code.

    That of a surface is open + film * `lidar.sensors.physics.reflect.film` (cosine, soaked).

    open   : (256,) of what is dry or under snow, times its share
    film   : (256,) of what is under water, times its share; 0 for dry surfaces
    soaked : (256,) of what is under water
    """

    open: Float
    film: Float
    soaked: Float


@functools.lru_cache(maxsize=16)
def covered_reflectance(wavelength_nm: float, *, wetness: float, snow: float) -> CoveredReflectance:
    """Reflectance in a world that is wet or under snow; snow lies on top of water.

    Water in the pores darkens the surface (`geoscene.classes.Material.wet`) and absorbs light.
    """
    dry, _ = reflectance_table(wavelength_nm)
    known, factor = materials(), np.ones(256)
    for material in known.values():
        factor[material.code] = material.wet
    soaked = dry * factor * through_water(wavelength_nm, 2 * _FILM)
    on_snow = dry[known["snow"].code]
    covered = snow * on_snow + (1 - snow) * (1 - wetness) * dry
    return CoveredReflectance(covered, (1 - snow) * wetness * soaked, soaked)


@inline
def sent_back(reflectance: Any, cosine: Any, specular: Any, law: Any) -> Any:
    """Reflectance of the Lambertian target at normal incidence that returns the same power; compiled.

    reflectance : diffuse reflectance at normal incidence; over `RETRO` a retro-reflector
    cosine      : of the angle between beam and normal, 0 to 1
    specular    : specular share, for ``phong``
    law         : index in `INCIDENCE_LAWS`

    ``lambert``: rho cos. ``phong``: rho ((1 - ks) cos + ks |cos 2 theta|^n), as in HELIOS++ (Winiwarter et
    al. 2022), with n = 10 (typical). ``oren-nayar``: Oren and Nayar 1994, source and receiver coincide,
    roughness 20 degrees (typical). Under each law, retro-reflective sheeting is constant to 30 degrees and
    falls to 40 % at 45 degrees and 0 at 90.
    """
    if reflectance > RETRO:
        angle = np.arccos(min(max(cosine, 0.0), 1.0))
        if angle <= _RETRO_FLAT:
            return reflectance
        if angle <= _RETRO_FALL:
            share = (angle - _RETRO_FLAT) / (_RETRO_FALL - _RETRO_FLAT)
            return reflectance * (1.0 + share * (_RETRO_LEFT - 1.0))
        return reflectance * _RETRO_LEFT * (0.5 * np.pi - angle) / (0.5 * np.pi - _RETRO_FALL)
    if law == _LAMBERT:
        return reflectance * cosine
    if law == _PHONG:
        square = (2.0 * cosine * cosine - 1.0) ** 2
        lobe = square * (square * square) ** 2  # to the tenth power
        return reflectance * ((1.0 - specular) * cosine + specular * lobe)
    if cosine <= 0.0:
        return 0.0
    s2 = _ROUGHNESS * _ROUGHNESS
    a, b = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    # With the source at the receiver: cos(phi_i - phi_r) = 1 and alpha = beta = theta.
    return reflectance * min(a * cosine + b * (1.0 - cosine * cosine), 1.0)
