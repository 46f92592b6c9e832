"""Extinction and back-scatter of rain, snow, fog, dust and spray by wavelength; visibility on roads."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache, lru_cache, partial
from math import gamma, log, pi

import numpy as np
from numpy.typing import ArrayLike

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.motion.vehicle import DRY_GRIP, SNOW_GRIP, WET_GRIP, RoadConditions
from lidar.signal.weather.mie import mie_efficiencies
from lidar.signal.weather.setting import WeatherSetting

CONTRAST = 3.912
"""Optical depth of the visibility, ln(1 / 0.02): where contrast has fallen to 2 % (Koschmieder 1924)."""

_DB_PER_KM = 4342.9
"""dB/km of an extinction of 1/m, one way."""

# Wavelength (nm), refractive index, absorption. Water: Hale and Querry 1973; ice: Warren and Brandt 2008.
_WATER = np.array(
    [
        (400, 1.339, 1.86e-9),
        (550, 1.333, 1.96e-9),
        (700, 1.331, 3.35e-8),
        (800, 1.329, 1.25e-7),
        (850, 1.329, 2.93e-7),
        (900, 1.328, 4.86e-7),
        (950, 1.327, 2.93e-6),
        (1000, 1.327, 2.89e-6),
        (1200, 1.324, 9.89e-6),
        (1400, 1.321, 1.38e-4),
        (1600, 1.317, 8.55e-5),
        (1800, 1.312, 1.15e-4),
        (2000, 1.306, 1.10e-3),
    ]
)
_ICE = np.array(
    [
        (540, 1.3114, 1.813e-9),
        (550, 1.3110, 2.289e-9),
        (860, 1.3039, 2.150e-7),
        (900, 1.3032, 4.200e-7),
        (910, 1.3030, 4.440e-7),
        (1060, 1.3005, 1.960e-6),
        (1300, 1.2961, 1.320e-5),
        (1504, 1.2916, 5.373e-4),
        (1563, 1.2903, 3.858e-4),
        (1587, 1.2897, 3.105e-4),
    ]
)

# Density (cm^-3), a, g, mode radius (um) of modified gamma distributions, of which fogs are made
# (Shettle and Fenn 1979; Rasshofer et al. 2011).
_DROPLETS = {
    "strong-advection": (20.0, 3.0, 1.0, 10.0),
    "moderate-advection": (20.0, 3.0, 1.0, 8.0),
    "strong-spray": (100.0, 6.0, 1.0, 4.0),
    "moderate-spray": (100.0, 6.0, 1.0, 2.0),
    "chu-hogg": (20.0, 2.0, 0.5, 1.0),
    "continental-haze": (100.0, 2.0, 0.5, 0.07),
}
_DROPLETS_OF_LAW = {
    "kim": "moderate-advection",
    "kruse": "moderate-advection",
    "advection": "moderate-advection",
    "radiation": "moderate-spray",
}

_FLAKE_RATIO = 25.0  # sr, ice clouds, typical value (20 to 35)
_DUST_RATIO = 50.0  # sr, mineral dust, typical value (40 to 60)
_SPRAY_EXTINCTION = 1.0
"""1/m for 1 mm of water at 100 km/h. A tenth (assumed) of the water in two tracks 0.2 m wide is 1.1 l/s,
over the plume of 2 m^2 20 g/m^3; drops of 60 um (assumed) have 3 * 20 g/m^3 / (1 t/m^3 * 60 um)."""

_SPRAY_DEEPEST = 3.0  # mm of water from which on spray grows no more, assumed
_SPHERE, _OBLATE = 0.3, 1.0  # mm, drops are spheres up to the first and oblate from the second on
_SNOW_REFLECTANCE = ((400.0, 1100.0, 1500.0), (0.85, 0.85, 0.07))  # nm and reflectance, typical values


_no_numbers = partial(np.empty, 0)


@dataclass(frozen=True, slots=True, eq=False)
class Medium:
    """Homogeneous air with particles; equal only to itself, so that its back-scatter is cached.

    extinction  : 1/m, one way
    backscatter : 1/(m sr), of all particles
    diameter    : (k,) metres, of classes of particles that may be seen one by one; empty for small ones
    number      : (k,) particles per cubic metre in each class
    section     : (k,) square metres, radar back-scatter cross-section of a particle
    """

    extinction: float
    backscatter: float
    diameter: Float = field(default_factory=_no_numbers)
    number: Float = field(default_factory=_no_numbers)
    section: Float = field(default_factory=_no_numbers)


def water_index(wavelength_nm: float) -> complex:
    """Refractive index of water; its imaginary part is positive."""
    return _index(_WATER, wavelength_nm)


def ice_index(wavelength_nm: float) -> complex:
    """Refractive index of ice; its imaginary part is positive."""
    return _index(_ICE, wavelength_nm)


def _index(table: Float, wavelength_nm: float) -> complex:
    wavelength, real, imaginary = table.T
    return complex(
        np.interp(wavelength_nm, wavelength, real),
        np.exp(np.interp(wavelength_nm, wavelength, np.log(imaginary))),
    )


# Rain and snow: exponential distributions of diameters.


def rain_slope(rate: float) -> tuple[float, float]:
    """Marshall and Palmer (1948): N0 (1/(m^3 mm)) and the slope (1/mm) of drops, at a rain rate in mm/h."""
    return 8000.0, 4.1 * rate**-0.21


def snow_slope(rate: float, medium: str = "gunn-marshall") -> tuple[float, float]:
    """N0 (1/(m^3 mm)) and the slope (1/mm) of the melted diameters of flakes; rate as mm/h of water.

    Gunn and Marshall (1958), or Sekhon and Srivastava (1970), whose N0 is 2.5e3 R^-0.94; `stallabrass` has
    the flakes of the latter, whose water falls with 1 m/s, as snow does, and not with 0.5 m/s.
    """
    if medium in ("sekhon-srivastava", "stallabrass"):
        return 2500.0 * rate**-0.94, 2.29 * rate**-0.45
    return 7600.0 * rate**-0.87, 2.55 * rate**-0.48


@cache
def _classes() -> tuple[Float, Float]:
    """Middle and width (k,) of classes of diameter, mm."""
    edges = np.geomspace(0.02, 20.0, 97)
    return np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)


@cache
def _average(phase: str, wavelength_nm: float) -> tuple[Float, Float]:
    """Mie efficiencies (k,) of extinction and back-scatter of spheres, averaged within each class."""
    middle, width = _classes()
    across = (np.arange(12) + 0.5) / 12 - 0.5
    size = pi * (middle[:, None] + width[:, None] * across) / (wavelength_nm * 1e-6)
    # Beyond this size the extinction is within 0.5 % of 2, and the back-scatter is not that of a sphere.
    size = np.minimum(size, 2e4)
    index = water_index(wavelength_nm) if phase == "water" else ice_index(wavelength_nm)
    extinction, _, back = mie_efficiencies(size.ravel(), index)
    return extinction.reshape(size.shape).mean(axis=1), back.reshape(size.shape).mean(axis=1)


def drop_backscatter(diameter: ArrayLike, wavelength_nm: float) -> Float:
    """Radar back-scatter efficiency of raindrops; diameters in mm.

    Mie's for small drops. The glory of a sphere needs a ring that is round to a fraction of the wavelength;
    falling drops are flattened, so that of large ones the axial rays of geometrical optics are left: those
    reflected by the front, and by the back after two passes through the water (van de Hulst 1957).
    """
    d = np.asarray(diameter, float)
    n, k = water_index(wavelength_nm).real, water_index(wavelength_nm).imag
    front = ((n - 1) / (n + 1)) ** 2
    water = np.exp(-8 * pi * k / (wavelength_nm * 1e-6) * d)
    axial = front + front * (1 - front) ** 2 * (n / (2 - n)) ** 2 * water
    share = np.clip(np.log(d / _SPHERE) / log(_OBLATE / _SPHERE), 0, 1)
    middle, _ = _classes()
    sphere = np.interp(d, middle, _average("water", wavelength_nm)[1])
    efficiency: Float = np.exp((1 - share) * np.log(sphere) + share * np.log(axial))
    return efficiency


def flake_backscatter(wavelength_nm: float) -> float:
    """Radar back-scatter efficiency of a flake: a sphere with the diffuse reflectance of snow."""
    return 8 / 3 * float(np.interp(wavelength_nm, *_SNOW_REFLECTANCE))


def rain_extinction(rate: float, wavelength_nm: float, *, medium: str = "marshall-palmer") -> float:
    """Extinction (1/m) at a rain rate in mm/h: by Mie, or with the efficiency 2 of large drops."""
    if rate <= 0:
        return 0.0
    if medium == "large-drop":
        n0, slope = rain_slope(rate)
        return 1e-6 * pi * n0 / slope**3
    return _extinction(rain_slope(rate), "water", wavelength_nm=wavelength_nm)


def snow_extinction(rate: float, wavelength_nm: float, *, medium: str = "gunn-marshall") -> float:
    """Extinction (1/m) at a snowfall rate in mm/h of water.

    ``stallabrass`` is measured: 10.36 C^0.7776 1/km at a concentration of C g/m^3 of water (Stallabrass 1985,
    in Stoelinga and Warner 1999), here that of the flakes of Sekhon and Srivastava. ``itu-dry`` and
    ``itu-wet`` are of recommendation ITU-R P.1814, the others of ice spheres by Mie, of the melted diameter.
    """
    if rate <= 0:
        return 0.0
    if medium == "stallabrass":
        n0, slope = snow_slope(rate, medium)
        return 10.36e-3 * math.pow(1e-3 * pi * n0 / slope**4, 0.7776)
    if medium == "itu-dry":
        return (5.42e-5 * wavelength_nm + 5.4958776) * math.pow(rate, 1.38) / _DB_PER_KM
    if medium == "itu-wet":
        return (1.023e-4 * wavelength_nm + 3.7855466) * math.pow(rate, 0.72) / _DB_PER_KM
    return _extinction(snow_slope(rate, medium), "ice", wavelength_nm=wavelength_nm)


def _extinction(distribution: tuple[float, float], phase: str, *, wavelength_nm: float) -> float:
    efficiency, _ = _average(phase, wavelength_nm)
    diameter, number = _numbers(distribution)
    return float(1e-6 * pi / 4 * (diameter**2 * efficiency * number).sum())


def _numbers(distribution: tuple[float, float]) -> tuple[Float, Float]:
    """Diameter (k,) in mm and number (k,) per cubic metre of each class of an exponential distribution."""
    n0, slope = distribution
    middle, width = _classes()
    low = np.exp(-slope * (middle - width / 2)) - np.exp(-slope * (middle + width / 2))
    return middle, n0 / slope * low


# Fog: droplets of some micrometres.


def fog_extinction(visibility: float, wavelength_nm: float, *, medium: str = "kim") -> float:
    """Extinction (1/m) at a visibility in metres at 2 % contrast.

    kim, kruse           : Kim et al. 2001, Kruse et al. 1962
    advection, radiation : Al Naboulsi et al. 2004
    a droplet distribution : Mie's spectrum of it, with as many droplets as give the visibility at 550 nm
    """
    km, um = visibility / 1000, wavelength_nm / 1000
    if medium == "advection":
        return (0.11478 * um + 3.8367) / km / 1000
    if medium == "radiation":
        return (0.18126 * um**2 + 0.13709 * um + 3.7502) / km / 1000
    if medium in ("kim", "kruse"):
        exponent = _kim(km) if medium == "kim" else _kruse(km)
        return CONTRAST / km * math.pow(wavelength_nm / 550, -exponent) / 1000
    if medium not in _DROPLETS:
        raise InputError(f"medium {medium!r} of fog is unknown")
    spectrum = droplet_optics(medium, wavelength_nm)[0] / droplet_optics(medium, 550.0)[0]
    return CONTRAST / visibility * spectrum


def _kim(km: float) -> float:
    if km > 6:
        return 1.6 if km > 50 else 1.3
    if km > 1:
        return 0.16 * km + 0.34
    return km - 0.5 if km > 0.5 else 0.0


def _kruse(km: float) -> float:
    return _kim(km) if km > 6 else 0.585 * km ** (1 / 3)


@cache
def droplet_optics(name: str, wavelength_nm: float) -> tuple[float, float, float]:
    """Extinction (1/m), lidar ratio (sr) and liquid water (g/m^3) of a droplet distribution.

    N(r) = density g b^((a+1)/g) / Gamma((a+1)/g) r^a exp(-b r^g), b = a / (g mode^g), with r in um.
    """
    density, a, g, mode = _DROPLETS[name]
    b = a / (g * mode**g)
    edges = np.geomspace(mode / 300, mode * (300.0 if g < 1 else 12.0), 1201)
    r, width = np.sqrt(edges[1:] * edges[:-1]), np.diff(edges)
    log_n = log(g) + (a + 1) / g * log(b) - log(gamma((a + 1) / g)) + a * np.log(r) - b * r**g
    number = density * 1e6 * np.exp(log_n) * width
    extinction, _, back = mie_efficiencies(2 * pi * r / (wavelength_nm / 1000), water_index(wavelength_nm))
    area = pi * (r * 1e-6) ** 2
    alpha = float((number * area * extinction).sum())
    beta = float((number * area * back).sum()) / (4 * pi)
    water = float((number * 4 / 3 * pi * (r * 1e-4) ** 3).sum())
    return alpha, alpha / beta, water


def fog_ratio(wavelength_nm: float, *, medium: str = "kim") -> float:
    """Lidar ratio of fog, extinction over back-scatter, sr."""
    return droplet_optics(_DROPLETS_OF_LAW.get(medium, medium), wavelength_nm)[1]


# Media of the kinds of weather.

CLEAR = Medium(0.0, 0.0)
"""Air without particles."""


@lru_cache(maxsize=64)
def medium_of(kind: str, amount: float, *, wavelength_nm: float, medium: str) -> Medium:
    """The air in weather of a kind; amount in the kind's unit, medium of `setting.KINDS`."""
    if kind == "rain":
        return rain(amount, wavelength_nm, medium=medium)
    if kind == "snow":
        return snow(amount, wavelength_nm, medium=medium)
    if kind == "fog":
        alpha = fog_extinction(amount, wavelength_nm, medium=medium)
        return Medium(alpha, alpha / fog_ratio(wavelength_nm, medium=medium))
    if kind == "dust":
        alpha = CONTRAST / amount
        return Medium(alpha, alpha / _DUST_RATIO)
    if kind == "spray":
        return spray(amount, wavelength_nm)
    return CLEAR


@lru_cache(maxsize=64)
def spray(water_mm: float, wavelength_nm: float) -> Medium:
    """Droplets that tyres throw up from water on the road, as dense as behind the axle at 100 km/h."""
    extinction = _SPRAY_EXTINCTION * min(water_mm, _SPRAY_DEEPEST)
    ratio = droplet_optics("strong-spray", wavelength_nm)[1]
    return Medium(extinction, extinction / ratio)


def rain(rate: float, wavelength_nm: float, *, medium: str = "marshall-palmer") -> Medium:
    """Rain at a rate in mm/h."""
    if rate <= 0:
        return CLEAR
    diameter, number = _numbers(rain_slope(rate))
    efficiency = drop_backscatter(diameter, wavelength_nm)
    return _particles(
        rain_extinction(rate, wavelength_nm, medium=medium), diameter, number=number, efficiency=efficiency
    )


def snow(rate: float, wavelength_nm: float, *, medium: str = "gunn-marshall") -> Medium:
    """Snowfall at a rate in mm/h of water; the ITU laws have the flakes of Gunn and Marshall.

    Flakes of `stallabrass` are as large as their extinction needs with the efficiency 2 of large particles
    (0.07 of the density of water at 1 mm/h), and have the lidar ratio of ice clouds where ice does not
    absorb. Those of the other media have the melted diameter.
    """
    if rate <= 0:
        return CLEAR
    extinction = snow_extinction(rate, wavelength_nm, medium=medium)
    diameter, number = _numbers(snow_slope(rate, medium))
    efficiency = flake_backscatter(wavelength_nm)
    if medium == "stallabrass":
        diameter = diameter * math.sqrt(extinction / (1e-6 * pi / 2 * (diameter**2 * number).sum()))
        efficiency *= 8 * pi / _FLAKE_RATIO / flake_backscatter(_SNOW_REFLECTANCE[0][0])
    return _particles(extinction, diameter, number=number, efficiency=np.full(len(diameter), efficiency))


def _particles(extinction: float, diameter: Float, *, number: Float, efficiency: Float) -> Medium:
    """A medium of particles with diameters in mm."""
    keep = number > 1e-9 * number.sum()
    metres = diameter[keep] / 1000
    section = efficiency[keep] * pi / 4 * metres**2
    backscatter = float((number[keep] * section).sum()) / (4 * pi)
    return Medium(extinction, backscatter, metres, number[keep], section)


_GREEN_NM = 550.0
"""Wavelength of visibilities, nanometres."""


def road_conditions(weather: Iterable[WeatherSetting], *, wetness: float, snow: float) -> RoadConditions:
    """Grip of wet and snowy ground, and the visibility in all weather that is everywhere, at its worst.

    wetness : share of the ground that is soaked, see `lidar.world.settings.WorldSettings`
    snow    : share of it that is under snow

    Weather of a place, and plumes behind vehicles, do not lower the visibility.
    """
    extinction = sum(
        max(
            medium_of(setting.kind, amount, wavelength_nm=_GREEN_NM, medium=setting.medium).extinction
            for amount in (setting.amount, setting.amount_to)
            if amount >= 0
        )
        for setting in weather
        if setting.kind != "clear" and setting.medium != "plumes"
        if not (setting.radius or setting.polygon)
    )
    grip = (1 - snow) * (DRY_GRIP + wetness * (WET_GRIP - DRY_GRIP)) + snow * SNOW_GRIP
    return RoadConditions(grip, CONTRAST / extinction if extinction else math.inf)
