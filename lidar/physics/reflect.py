"""How much of a pulse a surface sends back: spectral reflectance and incidence laws."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import materials
from lidar.errors import InputError

Float = NDArray[np.float64]

WAVELENGTHS_NM = (905.0, 1064.0, 1550.0)
"""Where materials have their reflectance."""

INCIDENCE_LAWS = ("lambert", "phong", "oren-nayar")
"""Laws of `apparent`."""

RETRO = 1.0
"""Reflectance over which a material is a retro-reflector."""

_ROUGHNESS = np.radians(20.0)  # slope deviation of rough facades, typical value
_RETRO_FLAT, _RETRO_FALL = np.radians(30.0), np.radians(45.0)  # sheeting: flat to 30°, 40 % at 45°, typical
_RETRO_LEFT = 0.4


@functools.lru_cache(maxsize=16)
def reflectance_table(wavelength_nm: float) -> tuple[Float, Float]:
    """Reflectance (256,) and specular share (256,) by material code, at a wavelength in nanometres.

    Linear between the wavelengths of the material table and held beyond them; codes without a material are
    those of ``unknown``.
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


def apparent(
    reflectance: Float, cosine: Float, *, specular: Float | float = 0.0, law: str = "lambert"
) -> Float:
    """Reflectance of the white Lambertian target, square on, that would send back as much.

    reflectance : diffuse reflectance at normal incidence; over `RETRO` a retro-reflector
    cosine      : of the angle between beam and normal, 0 to 1
    specular    : mirror-like share, for ``phong``
    law         : ``lambert``: rho cos. ``phong``: rho ((1 - ks) cos + ks |cos 2 theta|^n), as in HELIOS++
                  (Winiwarter et al. 2022), with n = 10 (typical). ``oren-nayar``: Oren and Nayar 1994,
                  source and receiver in one place, roughness 20 degrees (typical)

    Retro-reflective sheeting is flat to 30 degrees, falls to 40 % at 45 and to nothing at 90 under each law.

    Raises InputError for a law that is not known.
    """
    if law == "lambert":
        back = reflectance * cosine
    elif law == "phong":
        square = (2 * cosine * cosine - 1) ** 2
        lobe = square * (square * square) ** 2  # to the tenth power
        back = reflectance * ((1 - specular) * cosine + specular * lobe)
    elif law == "oren-nayar":
        s2 = _ROUGHNESS * _ROUGHNESS
        a, b = 1 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
        # With the source at the receiver: cos(phi_i - phi_r) = 1 and alpha = beta = theta.
        back = reflectance * (a * cosine + b * (1 - cosine * cosine))
        back = np.minimum(back, reflectance) * (cosine > 0)
    else:
        raise InputError(f"incidence law {law!r} is not known: {', '.join(INCIDENCE_LAWS)}")
    retro = reflectance > RETRO
    if retro.any():
        angle = np.arccos(np.clip(cosine, 0, 1))
        knots = (0.0, _RETRO_FLAT, _RETRO_FALL, np.pi / 2)
        back = np.where(retro, reflectance * np.interp(angle, knots, (1.0, 1.0, _RETRO_LEFT, 0.0)), back)
    return back
