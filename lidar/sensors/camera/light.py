"""Daylight under a clear or clouded sky: direct sunlight, sky radiance and ambient irradiance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geoscene.typing import Float
from lidar.sensors.camera.signal_lamps import Lamps

# A clear atmosphere in three bands (red, green, blue: 615, 535, 465 nm). Extraterrestrial light relative to
# green from the sun at 5772 K. Rayleigh optical depths by Hansen and Travis (Space Science Reviews 16, 1974):
# tau = 0.008569 l^-4 (1 + 0.0113 l^-2 + 0.00013 l^-4), l in micrometres. Aerosol by Angstrom's law with
# beta = 0.06 (clear), alpha = 1.3. Ozone in the Chappuis band, 300 Dobson units.
_WAVELENGTH = np.array([0.615, 0.535, 0.465])
_SUN = np.array([0.98, 1.0, 1.02])
_RAYLEIGH = 0.008569 * _WAVELENGTH**-4 * (1 + 0.0113 * _WAVELENGTH**-2 + 0.00013 * _WAVELENGTH**-4)
_AEROSOL = 0.06 * _WAVELENGTH**-1.3
_OZONE = np.array([0.036, 0.022, 0.004])
_FORWARD = 0.72  # asymmetry of the aerosol's Henyey-Greenstein phase function, continental haze
_GROUND = 0.18  # albedo of what lies below the horizon
_SNOW = 0.83  # the same under snow; 0.75 to 0.9 when fresh, typical value
# Multiple scattering is isotropic and grows with the optical depth: this multiple of the isotropic part of
# single scattering gives clear skies their measured fifth to quarter of daylight.
_MULTIPLE = 3.0
_GREYING = 0.4  # share of ambient light that is reflected by grey walls and pavements

# Irradiance under clouds by their share N of the sky: G = G0 (1 - 0.75 N^3.4), of which the diffuse share is
# 0.3 + 0.7 N^2 (Kasten and Czeplak, Solar Energy 24, 1980). The radiance of an overcast sky is
# (1 + 2 sin(elevation)) / 3 of that of its zenith (CIE standard overcast sky, ISO 15469).
_CLOUD_LOSS, _CLOUD_POWER = 0.75, 3.4


@dataclass(frozen=True)
class Light:
    """Sun and sky as linear colours; 1 is the green irradiance of the sun above the atmosphere, facing it.

    direction : (3,) unit vector towards the sun, scene axes
    beam      : (3,) irradiance of the sun's beam on a surface facing it
    ambient   : (9, 3) spherical harmonics of the irradiance of sky and ground on a surface by its normal
    sky       : (rows, columns, 3) radiance of the sky: rows by sqrt(elevation / 90°) from 0 to 1, columns by
                the cosine of the azimuth from the sun, from 1 to -1
    horizon   : (3,) mean radiance at the horizon, the colour of haze
    mean      : (3,) mean radiance from all directions, the sun's beam included: the colour of dense fog
    exposure  : factor that brings a level surface of 18 % in sun and sky to a quarter of full scale
    lamps     : signal heads that are lit; None for none
    """

    direction: Float
    beam: Float
    ambient: Float
    sky: Float
    horizon: Float
    mean: Float
    exposure: float
    lamps: Lamps | None = None


def _air_mass(sine: Float) -> Float:
    """Air mass towards an elevation by its sine >= 0; Kasten and Young, Applied Optics 28 (1989)."""
    h = np.degrees(np.arcsin(np.clip(sine, 0.0, 1.0)))
    return 1.0 / (np.sin(np.radians(h)) + 0.50572 * (h + 6.07995) ** -1.6364)


def _sky_radiance(sine: Float, cosine: Float, *, sun_sine: float) -> Float:
    """Radiance (..., 3) of a clear sky at elevations by sine, ``cosine`` being that of the angle to the sun.

    Single scattering in a plane-parallel atmosphere with the air masses of a spherical one.
    """
    tau = _RAYLEIGH + _AEROSOL
    rayleigh = 0.75 * (1 + cosine**2)
    g = _FORWARD
    haze = (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5
    phase = (_RAYLEIGH * rayleigh[..., None] + _AEROSOL * haze[..., None]) / tau + _MULTIPLE * tau
    view = _air_mass(sine)[..., None]
    sun = float(_air_mass(np.array(max(sun_sine, 0.0))))
    gap = view - sun
    near = np.abs(gap) < 1e-3
    slab = np.where(
        near,
        tau * np.exp(-tau * sun),
        (np.exp(-tau * sun) - np.exp(-tau * view)) / np.where(near, 1.0, gap),
    )
    return _SUN * np.exp(-_OZONE * sun) * phase / (4 * np.pi) * view * slab


def _harmonics(n: Float) -> Float:
    """Real spherical harmonics (..., 9) of order 0 to 2 at unit vectors (..., 3)."""
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    return np.stack(
        [
            np.full_like(x, 0.282095),
            0.488603 * y,
            0.488603 * z,
            0.488603 * x,
            1.092548 * x * y,
            1.092548 * y * z,
            0.315392 * (3 * z * z - 1),
            1.092548 * x * z,
            0.546274 * (x * x - y * y),
        ],
        axis=-1,
    )


def daylight(
    direction: ArrayLike, *, cloud: float = 0.0, snow: float = 0.0, rows: int = 64, columns: int = 64
) -> Light:
    """The light of a day with the sun towards ``direction`` (3,), scene axes.

    cloud : share of the sky that clouds cover, 0 to 1
    snow  : share of the ground under snow, 0 to 1, which is exposed to three quarters of full scale

    With the sun below the horizon there is no direct light and the sky fades to that of a moonlit night; the
    exposure follows. Ambient light is stored as spherical harmonics of order 2 (Ramamoorthi and Hanrahan, An
    efficient representation for irradiance environment maps, 2001).
    """
    s = np.asarray(direction, float)
    s = s / np.linalg.norm(s)
    rise = float(s[2])
    up = np.linspace(0, 1, rows)
    sine = np.sin(up**2 * np.pi / 2)[:, None]
    turn = np.linspace(1, -1, columns)[None]
    flat = np.sqrt(np.clip(1 - sine**2, 0, 1))
    cosine = np.clip(sine * rise + flat * np.hypot(s[0], s[1]) * turn, -1, 1)
    # Twilight: each degree below the horizon halves the sky's radiance, down to a minimum.
    dusk = max(2.0 ** min(np.degrees(np.arcsin(rise)), 0.0), 1e-4)
    sky = _sky_radiance(np.broadcast_to(sine, cosine.shape), cosine, sun_sine=rise) * dusk
    sun_mass = float(_air_mass(np.array(max(rise, 0.0))))
    clear = np.clip(np.degrees(np.arcsin(rise)) / 0.5 + 0.5, 0.0, 1.0)  # the disc is half a degree wide
    beam = clear * _SUN * np.exp(-(_RAYLEIGH + _AEROSOL + _OZONE) * sun_mass)

    normal, weight = _sphere(48, 96)
    bearing = np.hypot(normal[:, 0], normal[:, 1])
    cos_turn = (normal[:, 0] * s[0] + normal[:, 1] * s[1]) / np.maximum(bearing * np.hypot(s[0], s[1]), 1e-9)
    radiance = sky_colour(sky, normal[:, 2], cos_turn=cos_turn)
    above = normal[:, 2] > 0
    diffuse = (radiance * (weight * normal[:, 2])[:, None])[above].sum(axis=0)
    down = diffuse + beam * max(rise, 0.0)
    if cloud > 0:
        beam, sky, down = _add_clouds(beam, sky, diffuse=diffuse, rise=rise, sine=sine, cloud=cloud)
        radiance = sky_colour(sky, normal[:, 2], cos_turn=cos_turn)
    radiance[~above] = (_GROUND + snow * (_SNOW - _GROUND)) / np.pi * down
    basis = _harmonics(normal)
    # The clamped cosine in harmonics: pi, 2 pi / 3, pi / 4 for the orders 0, 1, 2.
    lobe = np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
    ambient = lobe[:, None] * np.einsum("ki,k,kc->ic", basis, weight, radiance)
    ambient += _GREYING * (ambient.mean(axis=1, keepdims=True) - ambient)
    exposure = 0.25 / 0.18 * np.pi / float(down.mean()) / (1 + snow * (_SNOW / 0.18 * 0.25 / 0.75 - 1))
    mean = (np.einsum("k,kc->c", weight, radiance) + beam) / (4 * np.pi)
    return Light(s, beam, ambient, sky, sky[1].mean(axis=0), mean, exposure)


def _add_clouds(
    beam: Float, sky: Float, *, diffuse: Float, rise: float, sine: Float, cloud: float
) -> tuple[Float, Float, Float]:
    """Beam, sky and downward irradiance under clouds that cover a share of the sky.

    diffuse : (3,) irradiance of the clear sky on level ground
    rise    : sine of the sun's elevation
    sine    : (rows, 1) of the elevation, of the rows of ``sky``
    """
    clear = diffuse + beam * max(rise, 0.0)
    down = clear * (1 - _CLOUD_LOSS * cloud**_CLOUD_POWER)
    beam = beam * (1 - _CLOUD_LOSS * cloud**_CLOUD_POWER) * (1 - cloud**2)
    rest = down - beam * max(rise, 0.0) - (1 - cloud) * diffuse
    overcast = (1 + 2 * sine[..., None]) / 3 * rest / (7 * np.pi / 9)
    return beam, (1 - cloud) * sky + overcast, down


def _sphere(rows: int, columns: int) -> tuple[Float, Float]:
    """Unit vectors (n, 3) over the sphere in cells of equal area, and their solid angles (n,)."""
    z = (np.arange(rows) + 0.5) / rows * 2 - 1
    a = (np.arange(columns) + 0.5) / columns * 2 * np.pi
    zz, aa = (v.ravel() for v in np.meshgrid(z, a, indexing="ij"))
    flat = np.sqrt(1 - zz * zz)
    return np.stack([flat * np.cos(aa), flat * np.sin(aa), zz], axis=1), np.full(zz.size, 4 * np.pi / zz.size)


def sky_colour(sky: Float, sine: Float, *, cos_turn: Float) -> Float:
    """Radiance (n, 3) from the table `Light.sky` at sines of elevation and cosines of azimuth to the sun."""
    rows, columns = sky.shape[:2]
    elevation = np.arcsin(np.clip(sine, 0, 1)) / (np.pi / 2)
    i = np.clip(np.rint(np.sqrt(elevation) * (rows - 1)).astype(int), 0, rows - 1)
    j = np.clip(np.rint((1 - cos_turn) / 2 * (columns - 1)).astype(int), 0, columns - 1)
    colour: Float = sky[i, j]
    return colour
