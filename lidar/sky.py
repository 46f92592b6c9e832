"""The satellites overhead, and which of them a receiver sees between the buildings.

The constellation is the baseline of 24 slots in 6 planes of the GPS Standard Positioning Service Performance
Standard: circular orbits of 55 degrees inclination and half a sidereal day, held at their nominal places. It
is a model sky, not an almanac: as many satellites, as high and as well spread as GPS gives, the same at the
same sidereal time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.frames import Frame

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

A, F = 6378137.0, 1 / 298.257223563
"""WGS 84: semi-major axis in metres, flattening."""
E2 = F * (2 - F)
_ORBIT = 26559.7e3  # metres, semi-major axis of the slots
_MU = 3.986005e14  # m^3/s^2, as GPS interfaces use it
_TILT = np.radians(55.0)
_EPOCH = datetime(1993, 7, 1, tzinfo=UTC)
_NODES_DEG = (
    272.847,
    332.847,
    32.847,
    92.847,
    152.847,
    212.847,
)  # planes A to F, right ascension at the epoch
_SLOTS_DEG = (  # argument of latitude at the epoch, four slots a plane
    (268.126, 161.786, 11.676, 41.806),
    (80.956, 173.336, 309.976, 204.376),
    (111.876, 11.796, 339.666, 241.556),
    (135.226, 265.446, 35.156, 167.356),
    (197.046, 302.596, 66.066, 333.686),
    (238.886, 345.226, 105.206, 135.346),
)

_RINGS = 6  # rings of the dome that is looked at for how much of it is blocked
_SPOKES = 16
_BLOCK_M = 100.0  # metres of road whose epochs share one world
REACH = 400.0
"""Metres within which buildings are held against the satellites."""


class _Caster(Protocol):
    def occluded(self, origins: ArrayLike, directions: ArrayLike) -> Bool: ...


class _World(Protocol):
    @property
    def caster(self) -> _Caster: ...


@dataclass(frozen=True, slots=True)
class Sky:
    """What a receiver has overhead at each of n epochs.

    azimuth, elevation : (n, 24) radians, azimuth clockwise from true north
    visible : (n, 24) bool, above the mask and not blocked
    above   : (n, 24) bool, above the mask
    blocked : (n,) share of the dome above the mask that something stands in front of, 0 in the open
    """

    azimuth: Float
    elevation: Float
    visible: Bool
    above: Bool
    blocked: Float

    @property
    def count(self) -> NDArray[np.int64]:
        """Satellites in view (n,)."""
        count: NDArray[np.int64] = self.visible.sum(axis=1)
        return count


def ecef(lon_deg: ArrayLike, lat_deg: ArrayLike, h: ArrayLike) -> Float:
    """Earth-centred, earth-fixed coordinates (..., 3) in metres of WGS 84 degrees and ellipsoidal heights."""
    lon, lat = np.radians(np.asarray(lon_deg, float)), np.radians(np.asarray(lat_deg, float))
    n = A / np.sqrt(1 - E2 * np.sin(lat) ** 2)
    h = np.asarray(h, float)
    out: Float = np.stack(
        [
            (n + h) * np.cos(lat) * np.cos(lon),
            (n + h) * np.cos(lat) * np.sin(lon),
            (n * (1 - E2) + h) * np.sin(lat),
        ],
        axis=-1,
    )
    return out


def enu_axes(lon_deg: ArrayLike, lat_deg: ArrayLike) -> Float:
    """Rotations (..., 3, 3) whose rows are east, north and up in earth-centred axes."""
    lon, lat = np.radians(np.asarray(lon_deg, float)), np.radians(np.asarray(lat_deg, float))
    cl, sl, cp, sp = np.cos(lon), np.sin(lon), np.cos(lat), np.sin(lat)
    rows = [[-sl, cl, np.zeros_like(cl)], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]
    out: Float = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return out


def sidereal_angle(seconds: ArrayLike) -> Float:
    """Greenwich mean sidereal time in radians (IAU 1982, linear part), seconds after 2000-01-01 12:00 UTC."""
    turns = 0.7790572732640 + 1.00273781191135448 * np.asarray(seconds, float) / 86400.0
    angle: Float = 2 * np.pi * np.mod(turns, 1.0)
    return angle


def satellites(start: datetime, time_ns: NDArray[np.integer]) -> Float:
    """Earth-fixed positions (n, 24, 3) in metres of the satellites at nanoseconds after a UTC start."""
    t = np.asarray(time_ns, float) * 1e-9
    since_epoch = (start - _EPOCH).total_seconds() + t
    since_2000 = (start - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() + t
    motion = np.sqrt(_MU / _ORBIT**3)
    u = np.radians(np.ravel(_SLOTS_DEG)) + np.mod(motion * since_epoch, 2 * np.pi)[:, None]
    node = np.radians(np.repeat(_NODES_DEG, 4)) - sidereal_angle(since_2000)[:, None]
    x, y = np.cos(u), np.sin(u) * np.cos(_TILT)
    out: Float = _ORBIT * np.stack(
        [x * np.cos(node) - y * np.sin(node), x * np.sin(node) + y * np.cos(node), np.sin(u) * np.sin(_TILT)],
        axis=-1,
    )
    return out


def look_up(
    lon_deg: Float, lat_deg: Float, h: Float, start: datetime, time_ns: NDArray[np.integer]
) -> tuple[Float, Float]:
    """True azimuth and elevation (n, 24) in radians of the satellites from n places, one a time."""
    d = satellites(start, time_ns) - ecef(lon_deg, lat_deg, h)[:, None, :]
    e, n, u = np.moveaxis(np.einsum("nij,nkj->nki", enu_axes(lon_deg, lat_deg), d), -1, 0)
    return np.mod(np.arctan2(e, n), 2 * np.pi), np.arctan2(u, np.hypot(e, n))


def grid_directions(azimuth: Float, elevation: Float, convergence: Float) -> Float:
    """Unit vectors (..., 3) in scene axes of true azimuths and elevations; convergence as of `Frame`."""
    grid, elevation = np.broadcast_arrays(azimuth - convergence, elevation)
    out: Float = np.stack(
        [np.sin(grid) * np.cos(elevation), np.cos(grid) * np.cos(elevation), np.sin(elevation)], axis=-1
    )
    return out


def open_sky(
    frame: Frame, antenna: Float, start: datetime, time_ns: NDArray[np.integer], *, mask_deg: float
) -> Sky:
    """The sky over antenna positions (n, 3) in scene metres, with nothing in the way."""
    lon, lat = frame.to_geographic(antenna[:, 0], antenna[:, 1])
    azimuth, elevation = look_up(lon, lat, antenna[:, 2], start, time_ns)
    above = elevation > np.radians(mask_deg)
    return Sky(azimuth, elevation, above, above, np.zeros(len(antenna)))


def sky_view(
    frame: Frame,
    antenna: Float,
    start: datetime,
    time_ns: NDArray[np.integer],
    world_at: Callable[[tuple[float, float, float, float]], _World],
    *,
    mask_deg: float,
) -> Sky:
    """The sky over antenna positions (n, 3) between what stands around them.

    Each satellite above the mask is a ray, and so are 96 directions that share the dome above the mask
    evenly.

    world_at : the world that covers a region (xmin, ymin, xmax, ymax), such as `World.follow`; asked once for
               every hundred metres or so of the drive, with `REACH` around them
    """
    sky = open_sky(frame, antenna, start, time_ns, mask_deg=mask_deg)
    lon, lat = frame.to_geographic(antenna[:, 0], antenna[:, 1])
    turn = frame.convergence(lon, lat)
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
            sky.azimuth[rows][k, satellite], sky.elevation[rows][k, satellite], turn[rows][k]
        )
        visible[rows[k], satellite] = ~caster.occluded(antenna[rows[k]], way)
        dome = grid_directions(spoke[None, :], rise[None, :], turn[rows, None]).reshape(-1, 3)
        hit = caster.occluded(np.repeat(antenna[rows], len(ring), axis=0), dome)
        blocked[rows] = hit.reshape(len(rows), -1).mean(axis=1)
    return Sky(sky.azimuth, sky.elevation, visible, sky.above, blocked)


def _blocks(antenna: Float) -> list[NDArray[np.int64]]:
    """Rows in order, cut where the way since the last cut exceeds a block."""
    step = np.hypot(*np.diff(antenna[:, :2], axis=0).T) if len(antenna) > 1 else np.empty(0)
    block = np.floor(np.concatenate([[0.0], np.cumsum(step)]) / _BLOCK_M)
    return np.split(np.arange(len(antenna)), np.flatnonzero(np.diff(block)) + 1)


def dilution(azimuth: Float, elevation: Float, used: Bool) -> Float:
    """Dilution of precision (n, 3): horizontal, vertical and in position; infinite where under 4 are used."""
    h = np.stack(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
            np.ones_like(azimuth),
        ],
        axis=-1,
    )
    normal = np.einsum("nki,nkj,nk->nij", h, h, used.astype(float))
    out = np.full((len(azimuth), 3), np.inf)
    enough = (used.sum(axis=1) >= 4) & (np.linalg.cond(normal) < 1e8)
    q = np.diagonal(np.linalg.inv(normal[enough]), axis1=1, axis2=2)
    out[enough] = np.sqrt(np.stack([q[:, 0] + q[:, 1], q[:, 2], q[:, :3].sum(axis=1)], axis=1))
    return out
