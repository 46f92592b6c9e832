"""Light in images: the sun's position, daylight under a clear or clouded sky, and lamps of signal heads."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.classes import Class, materials
from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.sensors.camera.sky import LIMB, cloud_pattern

_LIGHT, _GLASS = int(Class.TRAFFIC_LIGHT), materials()["glass"].code

LENSES = 2.875
"""Height in metres of the middle one of the three lenses in the shape, see `geoscene.objects.shapes`."""

APART, RADIUS = 0.283, 0.1
"""Metres between the middles of lenses, and their radius: lenses of 200 mm (EN 12368)."""

_FRONT = 0.37  # metres from the post's axis beyond which a hit is on the side with the lenses
_SHARE = np.pi * RADIUS**2 / (0.26 * 0.85)  # of one lens in that side
_BLUR = 0.3  # metres of growth of a pixel beyond a radius, over which lenses cease to be told apart

_LUMINANCE = 200 / (np.pi * RADIUS**2) / 133_300
"""Luminance of a lens of 200 cd (EN 12368) in units of `Light`, of which one is the
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
    """Linear light (n, 3) that lamps add, in units of `Light`.

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


def sun_position(when: datetime, lon_deg: ArrayLike, *, lat_deg: ArrayLike) -> tuple[Float, Float]:
    """Azimuth (clockwise from true north) and apparent elevation of the sun's centre, radians, any shape.

    Good to 0.02° from 1950 to 2050. The low-accuracy solar coordinates of Meeus, Astronomical Algorithms
    (2nd ed., chapters 12, 22, 25), as used by the NOAA Solar Calculator, with NOAA's refraction for the
    standard atmosphere. Delta T (about 70 s, 0.001° of solar motion) is neglected.

    when : with a time zone

    Raises InputError for a time without a zone.
    """
    if when.tzinfo is None:
        raise InputError(f"{when.isoformat()}: a time for the sun needs a zone, such as {when.isoformat()}Z")
    days = (when.astimezone(UTC) - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    t = days / 36525
    mean_longitude = np.radians(280.46646 + t * (36000.76983 + t * 0.0003032))
    anomaly = np.radians(357.52911 + t * (35999.05029 - t * 0.0001537))
    centre = np.radians(
        np.sin(anomaly) * (1.914602 - t * (0.004817 + t * 0.000014))
        + np.sin(2 * anomaly) * (0.019993 - t * 0.000101)
        + np.sin(3 * anomaly) * 0.000289
    )
    node = np.radians(125.04 - 1934.136 * t)
    longitude = mean_longitude + centre - np.radians(0.00569 + 0.00478 * np.sin(node))
    obliquity = np.radians(
        23.0 + (26.0 + (21.448 - t * (46.815 + t * (0.00059 - t * 0.001813))) / 60) / 60
    ) + np.radians(0.00256 * np.cos(node))
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(obliquity) * np.sin(longitude))

    sidereal = np.radians((280.46061837 + 360.98564736629 * days + t * t * 0.000387933) % 360)
    hour = sidereal + np.radians(np.asarray(lon_deg, float)) - right_ascension
    latitude = np.radians(np.asarray(lat_deg, float))
    up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(declination) * np.cos(hour)
    elevation = np.arctan2(up, np.hypot(east, north))
    azimuth: Float = np.arctan2(east, north) % (2 * np.pi)
    return azimuth, elevation + refraction(elevation)


def refraction(elevation: ArrayLike) -> Float:
    """Atmospheric refraction in radians at true elevations in radians; NOAA Solar Calculator."""
    h = np.degrees(np.asarray(elevation, float))
    tangent = np.tan(np.radians(np.clip(h, -89.0, 85.0)))
    steep = np.where(tangent != 0, tangent, 1.0)
    high = 58.1 / steep - 0.07 / steep**3 + 0.000086 / steep**5
    low = 1735 + h * (-518.2 + h * (103.4 + h * (-12.79 + h * 0.711)))
    below = -20.772 / steep
    seconds = np.select([h > 85, h > 5, h > -0.575], [np.zeros_like(h), high, low], below)
    angle: Float = np.radians(seconds / 3600)
    return angle


def sun_direction(frame: Frame, when: datetime, *, at: tuple[float, float] = (0.0, 0.0)) -> Float:
    """Unit vector (3,) towards the sun in scene axes at scene point ``at`` (x, y), metres.

    True north is turned into grid north by the projection's meridian convergence.

    Raises InputError for a time without a zone.
    """
    lon, lat = frame.to_geographic(*at)
    azimuth, elevation = sun_position(when, lon, lat_deg=lat)
    bearing = azimuth - frame.convergence(lon, lat)
    flat = np.cos(elevation)
    return np.array([flat * np.sin(bearing), flat * np.cos(bearing), np.sin(elevation)])


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
# 0.3 + 0.7 N^2 (Kasten and Czeplak, Solar Energy 24, 1980).
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
    clear     : as ``sky``, without clouds, of which ``sky`` has the mean
    veil      : (3,) radiance of clouds at the zenith
    clouds    : (5,) where they are, `lidar.sensors.camera.sky.cloud_pattern`
    exposure  : factor that brings a level surface of 18 % in sun and sky to a quarter of full scale
    lamps     : signal heads that are lit; None for none
    """

    direction: Float
    beam: Float
    ambient: Float
    sky: Float
    horizon: Float
    mean: Float
    clear: Float
    veil: Float
    clouds: Float
    exposure: float
    lamps: Lamps | None = None

    @property
    def columns(self) -> tuple[Float, Float, Float, Float, Float, Float, Float, Float]:
        """What `lidar.sensors.camera.shade.shade` takes of the light."""
        sun = self.direction, self.beam, self.ambient
        return *sun, self.sky, self.horizon, self.clear, self.veil, self.clouds


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
    clear_sky, veil = sky, np.zeros(3)
    if cloud > 0:
        beam, veil, down = _add_clouds(beam, diffuse=diffuse, rise=rise, cloud=cloud)
        sky = (1 - cloud) * sky + cloud * (1 - LIMB * cloud * (1 - sine[..., None])) * veil
        radiance = sky_colour(sky, normal[:, 2], cos_turn=cos_turn)
    radiance[~above] = (_GROUND + snow * (_SNOW - _GROUND)) / np.pi * down
    basis = _harmonics(normal)
    # The clamped cosine in harmonics: pi, 2 pi / 3, pi / 4 for the orders 0, 1, 2.
    lobe = np.array([np.pi, *[2 * np.pi / 3] * 3, *[np.pi / 4] * 5])
    ambient = lobe[:, None] * np.einsum("ki,k,kc->ic", basis, weight, radiance)
    ambient += _GREYING * (ambient.mean(axis=1, keepdims=True) - ambient)
    exposure = 0.25 / 0.18 * np.pi / float(down.mean()) / (1 + snow * (_SNOW / 0.18 * 0.25 / 0.75 - 1))
    mean = (np.einsum("k,kc->c", weight, radiance) + beam) / (4 * np.pi)
    clouds = cloud_pattern(cloud, (0.0, 0.0))
    return Light(s, beam, ambient, sky, sky[1].mean(axis=0), mean, clear_sky, veil, clouds, exposure)


def _add_clouds(beam: Float, *, diffuse: Float, rise: float, cloud: float) -> tuple[Float, Float, Float]:
    """Beam, radiance of clouds at the zenith, downward irradiance under clouds that cover a share of the sky.

    diffuse : (3,) irradiance of the clear sky on level ground
    rise    : sine of the sun's elevation
    """
    clear = diffuse + beam * max(rise, 0.0)
    down = clear * (1 - _CLOUD_LOSS * cloud**_CLOUD_POWER)
    beam = beam * (1 - _CLOUD_LOSS * cloud**_CLOUD_POWER) * (1 - cloud**2)
    rest = down - beam * max(rise, 0.0) - (1 - cloud) * diffuse
    return beam, rest / cloud / (np.pi * (1 - LIMB / 3 * cloud)), down


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
