"""Sun position from time and place."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike

from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.errors import InputError


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
