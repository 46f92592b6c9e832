"""Satellite receivers: ground truth and measured fixes.

    measured = antenna + b + m + w

w is white noise; b a first-order Gauss-Markov process (residual errors of atmosphere, orbits and clocks); m
another one (multipath), in proportion to the share of the sky that is blocked. All are in metres along true
east, true north and up.

Heights are the scene's: above the assumed level ground in a ``flat`` scene, above the geoid in an
``orthometric`` one, above the ellipsoid in an ``ellipsoidal`` one; see `Frame.vertical`.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.errors import InputError
from lidar.geometry.attitude import body_rates
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.sensors.navigation.measurements import NAMES, STATES, Fixes
from lidar.sensors.navigation.satellite_visibility import Sky, dilution, open_sky
from lidar.sensors.rig.specs import GnssSpec

MULTIPATH_TAU_S = 60.0
"""Correlation time of the multipath error m, seconds."""
SETTLE_S = 3.0
"""Seconds for which a better state must be possible before the receiver reports it."""
_LADDER = {  # by mode, best first: state, minimum satellites (of one system), maximum PDOP
    "ideal": (("ideal", 0, np.inf),),
    "single": (("single", 4, 25.0),),
    "sbas": (("sbas", 5, 25.0), ("single", 4, 25.0)),
    "rtk": (("fixed", 6, 4.0), ("float", 5, 8.0), ("single", 4, 25.0)),
}
"""A maximum PDOP of 25 is the default of u-blox receivers; the limits of carrier-phase states are assumed."""


def epochs(spec: GnssSpec, duration_ns: int) -> NDArray[np.int64]:
    """Times (n,) of a receiver's fixes in a drive of ``duration_ns``, nanoseconds since its start."""
    last = (duration_ns - spec.time_offset_ns) * spec.rate_hz / 1e9
    count = int(np.floor(last + 1e-9)) + 1 if last >= 0 else 0
    return np.round(np.arange(count) * (1e9 / spec.rate_hz)).astype(np.int64) + spec.time_offset_ns


def antenna_motion(
    trajectory: Trajectory, frame: Frame, *, spec: GnssSpec, time_ns: NDArray[np.int64]
) -> tuple[Float, Float]:
    """Position (n, 3) in scene metres and velocity (n, 3) in m/s true east, north, up of the antenna."""
    poses = trajectory.at(time_ns)
    arm = np.asarray(spec.mount.translation, float)
    position = poses.mounted(arm, np.eye(3)).position
    seconds = trajectory.time_ns * 1e-9
    rates = body_rates(seconds, trajectory.quat_xyzw)
    at = np.asarray(time_ns, float) * 1e-9
    rate = np.stack([np.interp(at, seconds, rates[:, k]) for k in range(3)], axis=1)
    velocity = np.stack([np.interp(at, seconds, trajectory.velocity[:, k]) for k in range(3)], axis=1)
    velocity = velocity + np.einsum("nij,nj->ni", poses.rotation, np.cross(rate, arm))
    lon, lat = frame.to_geographic(position[:, 0], position[:, 1])
    return position, _true_from_grid(velocity, frame.convergence(lon, lat))


def _true_from_grid(vectors: Float, convergence: Float) -> Float:
    """East, north, up (n, 3) of vectors along the scene's axes, whose y axis is grid north."""
    c, s = np.cos(convergence), np.sin(convergence)
    x, y, z = vectors.T
    return np.stack([x * c + y * s, y * c - x * s, z], axis=1)


def observe_gnss(
    trajectory: Trajectory,
    frame: Frame,
    *,
    spec: GnssSpec,
    seed: int,
    start: datetime,
    sky: Sky | None = None,
) -> Fixes:
    """The fixes of a receiver along a drive.

    start : UTC of the drive's start, which determines the positions of the satellites
    sky   : `sky_view` at `epochs` and `antenna_motion`; the open sky by default

    Random numbers are keyed by seed and receiver and drawn epoch by epoch from the start, so that a shorter
    drive has the same first fixes, bit for bit. Raises InputError for an unknown mode.
    """
    if spec.mode not in _LADDER:
        raise InputError(
            f"receiver {spec.name}: unknown mode {spec.mode}; choose one of {', '.join(_LADDER)}"
        )
    time_ns = epochs(spec, trajectory.duration_ns)
    position, velocity = antenna_motion(trajectory, frame, spec=spec, time_ns=time_ns)
    if sky is None:
        sky = open_sky(
            frame, position, start=start, time_ns=time_ns, mask_deg=spec.mask_deg, systems=spec.constellations
        )
    dop = dilution(sky.azimuth, sky.elevation, used=sky.visible, names=sky.names)
    state = _states(spec, sky, pdop=dop[:, 2])
    error = _errors(spec, sky, dop=dop, state=state, seed=seed)
    sizes = np.array([STATES[name].speed for name in NAMES])[state]
    velocity_noise = generator(seed, spec.name, "velocity").standard_normal((len(time_ns), 3))
    measured_velocity = velocity + sizes[:, None] * velocity_noise
    lon, lat = frame.to_geographic(position[:, 0], position[:, 1])
    true = np.column_stack([lon, lat, position[:, 2]])
    speed = np.hypot(measured_velocity[:, 0], measured_velocity[:, 1])
    return Fixes(
        time_ns=time_ns,
        state=state.astype(np.int8),
        quality=np.array([STATES[name].quality for name in NAMES], np.int8)[state],
        satellites=sky.count.astype(np.int8),
        dop=dop,
        lonlath=_shift(frame, position, error=error),
        speed=speed,
        course=_course(measured_velocity, speed, least=3.0 * np.nan_to_num(sizes) + 0.01),
        error=error,
        true_lonlath=true,
        true_velocity=velocity,
        used=sky.visible,
        names=sky.names,
    )


def _states(spec: GnssSpec, sky: Sky, *, pdop: Float) -> NDArray[np.int64]:
    """State (n,) at each epoch: drops at once, improves after `SETTLE_S`."""
    ladder = _LADDER[spec.mode]
    rank = np.full(len(sky.count), len(ladder))
    for k in reversed(range(len(ladder))):
        rank[(sky.spare >= ladder[k][1]) & (pdop <= ladder[k][2])] = k
    # The worst rank over the settling time; before the start, the first rank is assumed.
    wait = max(round(SETTLE_S * spec.rate_hz), 1)
    held = np.concatenate([np.full(wait - 1, rank[0]), rank]) if len(rank) else rank
    worst = np.lib.stride_tricks.sliding_window_view(held, wait).max(axis=1) if len(rank) else rank
    names = [*(name for name, _, _ in ladder), "none"]
    rows: NDArray[np.int64] = np.array([NAMES.index(name) for name in names])[worst]
    return rows


def _errors(spec: GnssSpec, sky: Sky, *, dop: Float, state: NDArray[np.int64], seed: int) -> Float:
    """Errors (n, 3) in metres east, north, up."""
    n = len(state)
    table = [STATES[name] for name in NAMES]

    def sizes(name: str) -> Float:
        pairs = np.array([getattr(row, name) for row in table])[state]
        return np.column_stack([pairs[:, 0], pairs[:, 0], pairs[:, 1]])

    # Blocked satellites also degrade the geometry: errors scale with the dilution of precision.
    unblocked = dilution(sky.azimuth, sky.elevation, used=sky.above, names=sky.names)
    with np.errstate(invalid="ignore"):
        growth = np.where(np.isfinite(dop[:, :2]), dop[:, :2] / unblocked[:, :2], 1.0)
    growth = np.where(np.isfinite(growth), growth, 1.0)[:, [0, 0, 1]]
    white = generator(seed, spec.name, "white").standard_normal((n, 3))
    tau = np.array([row.tau for row in table])[state]
    bias = gauss_markov(generator(seed, spec.name, "bias"), 1.0 / spec.rate_hz, tau=tau)
    multipath = gauss_markov(
        generator(seed, spec.name, "path"), 1.0 / spec.rate_hz, tau=np.full(n, MULTIPATH_TAU_S)
    )
    local = growth * (sizes("white") * white + sizes("bias") * bias)
    return local + sizes("blocked") * sky.blocked[:, None] * multipath


def gauss_markov(rng: np.random.Generator, dt: float, *, tau: Float) -> Float:
    """Three independent first-order Gauss-Markov processes (n, 3), stationary, of unit variance.

    u[k] = phi u[k-1] + sqrt(1 - phi^2) N(0, 1) with phi = exp(-dt / tau[k])
    """
    noise = rng.standard_normal((len(tau), 3))
    phi = np.exp(-dt / tau)
    drive = np.sqrt(1.0 - phi**2)[:, None] * noise
    out = np.empty_like(noise)
    u = np.zeros(3)
    for k in range(len(tau)):
        u = phi[k] * u + drive[k] if k else noise[0]
        out[k] = u
    return out


def _shift(frame: Frame, position: Float, *, error: Float) -> Float:
    """Longitude, latitude and height (n, 3) of positions displaced by metres east, north and up."""
    lon, lat = frame.to_geographic(position[:, 0], position[:, 1])
    turn, scale = frame.convergence(lon, lat), frame.scale(lon, lat)
    c, s = np.cos(turn), np.sin(turn)
    known = np.asarray(np.isfinite(error).all(axis=1))
    e, n = np.where(known[:, None], error[:, :2], 0.0).T
    x, y = position[:, 0] + scale * (e * c - n * s), position[:, 1] + scale * (e * s + n * c)
    lon, lat = frame.to_geographic(x, y)
    out = np.column_stack([lon, lat, position[:, 2] + error[:, 2]])
    out[~known] = np.nan
    return out


def _course(velocity: Float, speed: Float, *, least: Float) -> Float:
    """Course (n,) clockwise from true north; below the least speed the last known one, initially 0."""
    course = np.asarray(np.mod(np.arctan2(velocity[:, 0], velocity[:, 1]), 2 * np.pi))
    known: NDArray[np.int64] = np.where(speed > least, np.arange(len(speed)), -1)
    last: NDArray[np.int64] = np.maximum.accumulate(known)
    return np.where(last >= 0, course[np.maximum(last, 0)], 0.0)


def gnss_columns(fixes: Fixes) -> dict[str, NDArray[Any]]:
    """Columns of ``gnss.csv``: measurements, and ground truth prefixed ``true_``; degrees, metres, m/s."""
    return {
        "time_ns": fixes.time_ns,
        **dict(zip(("lon", "lat", "h"), fixes.lonlath.T, strict=True)),
        "speed": fixes.speed,
        "course_deg": np.degrees(fixes.course),
        "quality": fixes.quality,
        "satellites": fixes.satellites,
        "hdop": fixes.dop[:, 0],
        "vdop": fixes.dop[:, 1],
        **dict(zip(("true_lon", "true_lat", "true_h"), fixes.true_lonlath.T, strict=True)),
        **dict(zip(("true_east", "true_north", "true_up"), fixes.true_velocity.T, strict=True)),
    }
