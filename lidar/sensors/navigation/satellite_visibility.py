"""Positions of satellites in the sky, and their visibility between buildings.

Nominal constellations, a model and not an almanac: circular orbits of published inclinations and radii.
Number, elevations and spread of the satellites follow each system's design; positions depend on the time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.frames import Frame
from geoscene.typing import Bools, Float
from lidar.errors import InputError
from lidar.sensors.rig.specs import SYSTEMS

if TYPE_CHECKING:
    from lidar.world.world import World

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


A, F = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis in metres, flattening."""
E2 = F * (2 - F)

_RINGS = 6  # rings of directions that sample the blocked share of the sky
_SPOKES = 16
_EPOCHS = 4096  # epochs whose satellites are worked on at once
BLOCK_M = 100.0
"""Metres of the drive whose epochs share one loaded region."""
REACH = 400.0
"""Distance in metres within which buildings can block satellites."""


@dataclass(frozen=True, slots=True)
class Sky:
    """Satellites in the sky of a receiver at each of n epochs.

    azimuth, elevation : (n, k) radians, azimuth clockwise from true north
    visible : (n, k) bool, above the mask and not blocked
    above   : (n, k) bool, above the mask
    blocked : (n,) share of the sky above the mask that is blocked
    names   : (k,) of the satellites; the first letter identifies the system
    """

    azimuth: Float
    elevation: Float
    visible: Bools
    above: Bools
    blocked: Float
    names: NDArray[np.str_]

    @property
    def count(self) -> NDArray[np.int64]:
        """Number (n,) of satellites in view."""
        count: NDArray[np.int64] = self.visible.sum(axis=1)
        return count

    @property
    def spare(self) -> NDArray[np.int64]:
        """Satellites in view (n,) minus one for the clock offset of each system after the first."""
        seen = [self.visible[:, rows].any(axis=1) for rows in systems_of(self.names)]
        spare: NDArray[np.int64] = self.count - np.maximum(np.sum(seen, axis=0) - 1, 0)
        return spare


def systems_of(names: NDArray[np.str_]) -> list[NDArray[np.int64]]:
    """Columns of the satellites of each system, in order of first appearance."""
    letters = [str(name)[:1] for name in names]
    return [np.flatnonzero(np.array(letters) == letter) for letter in dict.fromkeys(letters)]


def ecef(lon_deg: ArrayLike, lat_deg: ArrayLike, *, h: ArrayLike) -> Float:
    """Earth-centred, earth-fixed coordinates (..., 3) in metres of WGS 84 degrees and ellipsoidal heights."""
    lon, lat = np.radians(np.asarray(lon_deg, float)), np.radians(np.asarray(lat_deg, float))
    n = A / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    h = np.asarray(h, float)
    return np.stack(
        [
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - E2) + h) * np.sin(lat),
        ],
        axis=-1,
    )


def enu_axes(lon_deg: ArrayLike, lat_deg: ArrayLike) -> Float:
    """Rotations (..., 3, 3) whose rows are east, north and up in earth-centred axes."""
    lon, lat = np.radians(np.asarray(lon_deg, float)), np.radians(np.asarray(lat_deg, float))
    cl, sl, cp, sp = np.cos(lon), np.sin(lon), np.cos(lat), np.sin(lat)
    rows = [[-sl, cl, np.zeros_like(cl)], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def look_up(
    lon_deg: Float,
    lat_deg: Float,
    *,
    h: Float,
    start: datetime,
    time_ns: NDArray[np.integer],
    systems: Sequence[str] = SYSTEMS,
) -> tuple[Float, Float]:
    """True azimuth and elevation (n, k) in radians of the satellites from n places, one per time."""
    d = satellites(start, time_ns, systems=systems) - ecef(lon_deg, lat_deg, h=h)[:, None, :]
    e, n, u = np.moveaxis(np.einsum("nij,nkj->nki", enu_axes(lon_deg, lat_deg), d), -1, 0)
    return np.mod(np.arctan2(e, n), 2 * np.pi), np.arctan2(u, np.hypot(e, n))


def grid_directions(azimuth: Float, elevation: Float, *, convergence: Float) -> Float:
    """Unit vectors (..., 3) in scene axes of true azimuths and elevations; convergence as of `Frame`."""
    grid, elevation = np.broadcast_arrays(azimuth - convergence, elevation)
    return np.stack(
        [np.sin(grid) * np.cos(elevation), np.cos(grid) * np.cos(elevation), np.sin(elevation)], axis=-1
    )


def open_sky(
    frame: Frame,
    antenna: Float,
    *,
    start: datetime,
    time_ns: NDArray[np.integer],
    mask_deg: float,
    systems: Sequence[str] = SYSTEMS,
) -> Sky:
    """The sky over antenna positions (n, 3) in scene metres, without obstacles.

    Raises InputError for an unknown system.
    """
    lon, lat = frame.to_geographic(antenna[:, 0], antenna[:, 1])
    names = satellite_names(systems)
    azimuth, elevation = (np.empty((len(antenna), len(names))) for _ in range(2))
    above = np.empty(azimuth.shape, bool)
    for first in range(0, len(antenna), _EPOCHS):
        rows = slice(first, first + _EPOCHS)
        azimuth[rows], elevation[rows] = look_up(
            lon[rows], lat[rows], h=antenna[rows, 2], start=start, time_ns=time_ns[rows], systems=systems
        )
        above[rows] = elevation[rows] > np.radians(mask_deg)
    return Sky(azimuth, elevation, above, above, np.zeros(len(antenna)), names)


def sky_view(
    frame: Frame,
    antenna: Float,
    *,
    start: datetime,
    time_ns: NDArray[np.integer],
    world_at: Callable[[tuple[float, float, float, float]], World],
    mask_deg: float,
    systems: Sequence[str] = SYSTEMS,
) -> Sky:
    """The sky over antenna positions (n, 3) in scene metres, with satellites blocked by the surroundings.

    A ray is cast to each satellite above the mask, and 96 rays sample the sky above the mask uniformly.

    world_at : returns the world of a region (xmin, ymin, xmax, ymax), such as `World.follow`; called about
               once per hundred metres of the drive, with a margin of `REACH`
    """
    sky = open_sky(frame, antenna, start=start, time_ns=time_ns, mask_deg=mask_deg, systems=systems)
    lon, lat = frame.to_geographic(antenna[:, 0], antenna[:, 1])
    convergence = frame.convergence(lon, lat)
    ring = np.repeat((np.arange(_RINGS) + 0.5) / _RINGS, _SPOKES)  # equal steps of sine: equal areas
    low = np.sin(np.radians(mask_deg))
    rise = np.arcsin(low + (1 - low) * ring)
    spoke = np.tile(2 * np.pi * np.arange(_SPOKES) / _SPOKES, _RINGS) + np.repeat(np.arange(_RINGS), _SPOKES)
    visible, blocked = sky.above.copy(), np.zeros(len(antenna))
    for rows in _blocks(antenna):
        x, y = antenna[rows, 0], antenna[rows, 1]
        caster = world_at((x.min() - REACH, y.min() - REACH, x.max() + REACH, y.max() + REACH)).caster
        k, satellite = np.nonzero(sky.above[rows])
        way = grid_directions(
            sky.azimuth[rows][k, satellite],
            sky.elevation[rows][k, satellite],
            convergence=convergence[rows][k],
        )
        visible[rows[k], satellite] = ~caster.occluded(antenna[rows[k]], way)
        dome = grid_directions(spoke[None, :], rise[None, :], convergence=convergence[rows, None])
        hit = caster.occluded(np.repeat(antenna[rows], len(ring), axis=0), dome.reshape(-1, 3))
        blocked[rows] = hit.reshape(len(rows), -1).mean(axis=1)
    return Sky(sky.azimuth, sky.elevation, visible, sky.above, blocked, sky.names)


def _blocks(antenna: Float) -> list[NDArray[np.int64]]:
    """Rows of consecutive positions, split every `BLOCK_M` along the path."""
    step = np.hypot(*np.diff(antenna[:, :2], axis=0).T) if len(antenna) > 1 else np.empty(0)
    block = np.floor(np.concatenate([[0.0], np.cumsum(step)]) / BLOCK_M)
    return np.split(np.arange(len(antenna)), np.flatnonzero(np.diff(block)) + 1)


def dilution(azimuth: Float, elevation: Float, *, used: Bools, names: NDArray[np.str_]) -> Float:
    """Dilution of precision (n, 3): HDOP, VDOP and PDOP; infinite with too few satellites.

    The unknowns are three coordinates and a clock offset per system in use: four satellites, and one more for
    each further system. ``names`` as in `Sky`.
    """
    out = np.empty((len(azimuth), 3))
    for first in range(0, len(azimuth), _EPOCHS):
        rows = slice(first, first + _EPOCHS)
        out[rows] = _dilution(azimuth[rows], elevation[rows], used=used[rows], names=names)
    return out


def _dilution(azimuth: Float, elevation: Float, *, used: Bools, names: NDArray[np.str_]) -> Float:
    """The rows of `dilution` for some epochs."""
    systems = systems_of(names)
    clocks = np.zeros((len(names), len(systems)))
    for column, rows in enumerate(systems):
        clocks[rows, column] = 1.0
    toward = grid_directions(azimuth, elevation, convergence=np.zeros(1))
    h = np.concatenate([toward, np.broadcast_to(clocks, (*azimuth.shape, len(systems)))], axis=-1)
    normal = np.einsum("nki,nkj,nk->nij", h, h, used.astype(float))
    clock_rows = 3 + np.arange(len(systems))
    unused = normal[:, clock_rows, clock_rows] == 0.0
    normal[:, clock_rows, clock_rows] += unused  # keeps the matrix regular for systems that are not in use
    out = np.full((len(azimuth), 3), np.inf)
    needed = 3 + (~unused).sum(axis=1)
    enough = (used.sum(axis=1) >= np.maximum(needed, 4)) & (np.linalg.cond(normal) < 1e8)
    q = np.diagonal(np.linalg.inv(normal[enough]), axis1=1, axis2=2)
    out[enough] = np.sqrt(np.stack([q[:, 0] + q[:, 1], q[:, 2], q[:, :3].sum(axis=1)], axis=1))
    return out
