"""Reflection at surfaces: spectral reflectance and incidence laws."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from geoscene.classes import materials
from geoscene.support.compiled import njit
from geoscene.support.registry import unknown_name
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.raycast.memory import inline
from lidar.sensors.physics.fresnel import through_water

WAVELENGTHS_NM = (905.0, 1064.0, 1550.0)
"""Wavelengths for which the reflectance of materials is given."""

INCIDENCE_LAWS = ("lambert", "phong", "oren-nayar")
"""Laws of `apparent`."""

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

    That of a surface is open + film * `lidar.sensors.physics.fresnel.film` (cosine, soaked).

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


def apparent(
    reflectance: Float, cosine: Float, *, specular: Float | float = 0.0, law: str = "lambert"
) -> Float:
    """Reflectance of the Lambertian target at normal incidence that returns the same power.

    reflectance : diffuse reflectance at normal incidence; over `RETRO` a retro-reflector
    cosine      : of the angle between beam and normal, 0 to 1
    specular    : specular share, for ``phong``
    law         : ``lambert``: rho cos. ``phong``: rho ((1 - ks) cos + ks |cos 2 theta|^n), as in HELIOS++
                  (Winiwarter et al. 2022), with n = 10 (typical). ``oren-nayar``: Oren and Nayar 1994,
                  source and receiver coincide, roughness 20 degrees (typical)

    Under each law, retro-reflective sheeting is constant to 30 degrees and falls to 40 % at 45 degrees and 0
    at 90.

    Raises InputError if the law is unknown.
    """
    if law not in INCIDENCE_LAWS:
        raise InputError(unknown_name("`law`", law, known=INCIDENCE_LAWS))
    r, c, s = (
        np.ascontiguousarray(v, np.float64) for v in np.broadcast_arrays(reflectance, cosine, specular)
    )
    back: Float = np.empty(r.shape)
    _apparent(r.reshape(-1), c.reshape(-1), s.reshape(-1), INCIDENCE_LAWS.index(law), back.reshape(-1))
    return back


@inline
def sent_back(reflectance: Any, cosine: Any, specular: Any, law: Any) -> Any:
    """`apparent` of one surface, for compiled code; ``law`` is an index in `INCIDENCE_LAWS`."""
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


@njit(cache=True, nogil=True)
def _apparent(reflectance: Any, cosine: Any, specular: Any, law: Any, back: Any) -> None:
    for i in range(len(back)):
        back[i] = sent_back(reflectance[i], cosine[i], specular[i], law)
