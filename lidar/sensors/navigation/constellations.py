"""Nominal satellite constellations: circular orbits of published inclinations and radii.

They are a model, not an almanac: number, elevations and spread of the satellites follow each system's design.
Positions depend on the time alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.typing import Float
from lidar.errors import InputError
from lidar.sensors.rig.specs import SYSTEMS

_MU = 3.986004418e14  # m^3/s^2, WGS 84
_STATIONARY = 42164.2e3  # metres, radius of an orbit with a period of one sidereal day
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class Constellation:
    """Orbits of a system's satellites.

    letter : RINEX code of the system
    tilt, node, phase : (k,) radians: inclination, right ascension of the ascending node and argument of
             latitude at the epoch
    radius : (k,) metres
    source : citation of the orbital parameters
    """

    letter: str
    tilt: Float
    node: Float
    phase: Float
    radius: Float
    epoch: datetime
    source: str

    @property
    def names(self) -> list[str]:
        """Names of the satellites, such as G01."""
        return [f"{self.letter}{k + 1:02d}" for k in range(len(self.node))]


def walker(
    letter: str,
    tilt_deg: float,
    *,
    planes: Sequence[float],
    first_deg: Sequence[float],
    radius: float,
    epoch: datetime,
    source: str = "",
    each: int = 8,
) -> Constellation:
    """A constellation with evenly spaced satellites in each plane.

    planes    : degrees, right ascensions of their ascending nodes
    first_deg : argument of latitude of the first satellite of each plane
    each      : satellites per plane
    """
    count = each * len(planes)
    phase = np.add.outer(first_deg, 360.0 / each * np.arange(each)).ravel()
    node, tilt = np.repeat(planes, each), np.full(count, tilt_deg)
    return Constellation(
        letter, np.radians(tilt), np.radians(node), np.radians(phase), np.full(count, radius), epoch, source
    )


def _gps() -> Constellation:
    slots = (
        (268.126, 161.786, 11.676, 41.806),
        (80.956, 173.336, 309.976, 204.376),
        (111.876, 11.796, 339.666, 241.556),
        (135.226, 265.446, 35.156, 167.356),
        (197.046, 302.596, 66.066, 333.686),
        (238.886, 345.226, 105.206, 135.346),
    )
    node = np.repeat(272.847 + 60.0 * np.arange(6), 4)
    return Constellation(
        "G",
        np.full(24, np.radians(55.0)),
        np.radians(node),
        np.radians(np.ravel(slots)),
        np.full(24, 26559.7e3),
        datetime(1993, 7, 1, tzinfo=UTC),
        "GPS Standard Positioning Service Performance Standard, the 24 baseline slots",
    )


def _beidou() -> Constellation:
    epoch = datetime(2020, 8, 1, tzinfo=UTC)
    medium = walker(
        "C",
        55.0,
        planes=(0.0, 120.0, 240.0),
        first_deg=(0.0, 15.0, 30.0),
        radius=27906.1e3,
        epoch=epoch,
    )
    # Geostationary satellites stay above a longitude. The inclined geosynchronous ones cross the equator at
    # one longitude, a third of a day apart.
    sidereal = float(sidereal_angle((epoch - _J2000).total_seconds()))
    longitude = np.radians([80.0, 110.5, 140.0]) + sidereal
    node = np.radians(118.0) + sidereal + np.radians([0.0, 120.0, 240.0])
    return Constellation(
        "C",
        np.concatenate([medium.tilt, np.zeros(3), np.full(3, np.radians(55.0))]),
        np.concatenate([medium.node, longitude, node]),
        np.concatenate([medium.phase, np.zeros(3), -np.radians([0.0, 120.0, 240.0])]),
        np.concatenate([medium.radius, np.full(6, _STATIONARY)]),
        epoch,
        "BeiDou Open Service Performance Standard: Walker 24/3/1 at 21,528 km and 55 degrees, three"
        " geostationary at 80, 110.5 and 140 degrees east, three inclined geosynchronous; places along the"
        " orbits assumed",
    )


def constellations() -> dict[str, Constellation]:
    """The supported systems by name."""
    return {
        "gps": _gps(),
        "glonass": walker(
            "R",
            64.8,
            planes=(0.0, 120.0, 240.0),
            first_deg=(0.0, 15.0, 30.0),
            radius=25510.0e3,
            epoch=datetime(2008, 1, 1, tzinfo=UTC),
            source="GLONASS Interface Control Document, edition 5.1: 24 in three planes 120 degrees apart,"
            " 64.8 degrees, 45 degrees along a plane and 15 between planes, 19,100 km; first node assumed",
        ),
        "galileo": walker(
            "E",
            56.0,
            planes=(317.632, 77.632, 197.632),
            first_deg=(225.153, 240.153, 255.153),
            radius=29599.801e3,
            epoch=datetime(2016, 11, 21, tzinfo=UTC),
            source="Galileo Open Service Service Definition Document: Walker 24/3/1, 56 degrees,"
            " 29,599.801 km, reference slots; the drift of the nodes since their epoch left out",
        ),
        "beidou": _beidou(),
    }


def check_systems(systems: Sequence[str]) -> None:
    """Raise InputError if no system is named, a name is unknown or a name is repeated."""
    unknown = [name for name in systems if name not in SYSTEMS]
    if unknown or not systems or len(set(systems)) < len(systems):
        raise InputError(
            f"constellations {', '.join(systems) or 'none'}: give one or more of {', '.join(SYSTEMS)},"
            " each once"
        )


def satellite_names(systems: Sequence[str] = SYSTEMS) -> NDArray[np.str_]:
    """Names (k,) of the satellites of systems, such as G01."""
    known = constellations()
    return np.array([name for system in systems for name in known[system].names], np.str_)


def sidereal_angle(seconds: ArrayLike) -> Float:
    """Greenwich mean sidereal time in radians (IAU 1982, linear part), seconds after 2000-01-01 12:00 UTC."""
    turns = 0.7790572732640 + 1.00273781191135448 * np.asarray(seconds, float) / 86400.0
    return 2 * np.pi * np.mod(turns, 1.0)


def satellites(start: datetime, time_ns: NDArray[np.integer], *, systems: Sequence[str] = SYSTEMS) -> Float:
    """Earth-fixed positions (n, k, 3) in metres of the satellites at nanoseconds (n,) after a UTC start.

    Raises InputError for an unknown system.
    """
    check_systems(systems)
    known = constellations()
    t = np.asarray(time_ns, float) * 1e-9
    earth_angle = sidereal_angle((start - _J2000).total_seconds() + t)[:, None]
    parts = []
    for orbit in (known[name] for name in systems):
        since = (start - orbit.epoch).total_seconds() + t
        motion = np.sqrt(_MU / orbit.radius**3)
        u = orbit.phase + np.mod(motion * since[:, None], 2 * np.pi)
        node = orbit.node - earth_angle
        x, y = np.cos(u), np.sin(u) * np.cos(orbit.tilt)
        parts.append(
            orbit.radius[:, None]
            * np.stack(
                [
                    x * np.cos(node) - y * np.sin(node),
                    x * np.sin(node) + y * np.cos(node),
                    np.sin(u) * np.sin(orbit.tilt),
                ],
                axis=-1,
            )
        )
    return np.concatenate(parts, axis=1)
