"""Positions of satellites in the sky and their visibility between buildings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.frames import Frame
from geoscene.typing import Bools, Float
from lidar.sensors.navigation.constellations import satellite_names, satellites
from lidar.sensors.rig.specs import SYSTEMS

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


class _Caster(Protocol):
    def occluded(self, origins: ArrayLike, directions: ArrayLike) -> Bools: ...


class _World(Protocol):
    @property
    def caster(self) -> _Caster: ...


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
    world_at: Callable[[tuple[float, float, float, float]], _World],
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
