"""Inertial measurement units: true angular rates and specific forces, and their measurements.

    gyro  = omega + b_g + n_g        omega: angular rate in inertial space, rad/s
    accel = f + b_a + n_a            f = a - g: specific force, m/s^2

both along the unit's axes. n is white noise; b a random walk plus flicker noise (bias instability). At rest
f points upwards with the magnitude of gravity. omega includes the Earth rate and the transport rate (rotation
of the local vertical due to travel); f includes the Coriolis acceleration.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.frames import Frame
from geoscene.typing import Float
from lidar.geometry.attitude import body_rates, matrix_from_quat
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.sensors.navigation.measurements import Inertial
from lidar.sensors.navigation.satellite_visibility import E2, A
from lidar.sensors.rig.specs import ImuSpec

_FLICKER_TIMES = 0.1 * np.exp(np.arange(12))
"""Correlation times in seconds of the processes that add up to flicker noise: 0.1 s to 100 minutes."""

EARTH_RATE = 7.292115e-5
"""Angular rate of the Earth, rad/s (WGS 84)."""


def normal_gravity(lat_deg: ArrayLike, h: ArrayLike) -> Float:
    """Gravity in m/s^2 (Somigliana, WGS 84), decreased by 3.086e-6 per metre of height."""
    s2 = np.sin(np.radians(np.asarray(lat_deg, float))) ** 2
    at_zero = 9.7803253359 * (1 + 0.00193185265241 * s2) / np.sqrt(1 - E2 * s2)
    gravity: Float = at_zero - 3.086e-6 * np.asarray(h, float)
    return gravity


def true_inertial(
    trajectory: Trajectory, frame: Frame, *, spec: ImuSpec, time_ns: NDArray[np.int64]
) -> tuple[Float, Float]:
    """True angular rate (n, 3) and specific force (n, 3) of a unit at rising times, in its own axes.

    Central differences of the trajectory's attitudes and of the unit's velocity, interpolated linearly.
    """
    at, seconds = time_ns * 1e-9, trajectory.time_ns * 1e-9
    rate, force = (
        np.stack([np.interp(at, seconds, column) for column in signal.T], axis=1) @ spec.mount.rotation
        for signal in _at_poses(trajectory, frame, spec=spec)
    )
    return rate, force


def _at_poses(trajectory: Trajectory, frame: Frame, *, spec: ImuSpec) -> tuple[Float, Float]:
    """Angular rate (n, 3) and specific force (n, 3) of a unit at a trajectory's poses, in vehicle axes."""
    seconds = trajectory.time_ns * 1e-9
    R = matrix_from_quat(trajectory.quat_xyzw)
    turn = body_rates(seconds, trajectory.quat_xyzw)
    arm = np.asarray(spec.mount.translation, float)
    velocity = trajectory.velocity + np.einsum("nij,nj->ni", R, np.cross(turn, arm))
    acceleration = np.gradient(velocity, seconds, axis=0)
    earth, transport, gravity = _earth(trajectory, frame, velocity=velocity)
    specific_force = acceleration + np.cross(2 * earth + transport, velocity)
    specific_force[:, 2] += gravity
    rate = turn + np.einsum("nji,nj->ni", R, earth + transport)
    return rate, np.einsum("nji,nj->ni", R, specific_force)


def _earth(trajectory: Trajectory, frame: Frame, *, velocity: Float) -> tuple[Float, Float, Float]:
    """Earth rate (n, 3) and transport rate (n, 3) in scene axes, rad/s, and gravity (n,), m/s^2."""
    x, y, z = trajectory.position.T
    lon, lat = frame.to_geographic(x, y)
    convergence, phi = frame.convergence(lon, lat), np.radians(lat)
    # True north is rotated by the convergence, counter-clockwise from grid north.
    north = np.stack([-np.sin(convergence), np.cos(convergence), np.zeros_like(convergence)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    earth = EARTH_RATE * (np.cos(phi)[:, None] * north + np.sin(phi)[:, None] * up)
    w = np.sqrt(1 - E2 * np.sin(phi) ** 2)
    east = np.stack([np.cos(convergence), np.sin(convergence), np.zeros_like(convergence)], axis=1)
    to_east, to_north = (velocity * east).sum(axis=1), (velocity * north).sum(axis=1)
    # No vertical component: grid axes, unlike true north, keep their direction about the vertical.
    meridian, normal = A * (1 - E2) / w**3, A / w  # radii of curvature
    transport = (to_east / (normal + z))[:, None] * north - (to_north / (meridian + z))[:, None] * east
    return earth, transport, normal_gravity(lat, z)


def observe_imu(trajectory: Trajectory, frame: Frame, *, spec: ImuSpec, seed: int) -> Inertial:
    """The measurements of an inertial unit along a drive.

    Random numbers are keyed by seed and unit and drawn in time order from the start, so that a shorter
    drive has the same first rows, bit for bit.
    """
    step = 1e9 / spec.rate_hz
    count = int(np.floor((trajectory.duration_ns - spec.time_offset_ns) / step + 1e-9)) + 1
    time_ns = np.round(np.arange(max(count, 0)) * step).astype(np.int64) + spec.time_offset_ns
    rate, force = true_inertial(trajectory, frame, spec=spec, time_ns=time_ns)
    errors = inertial_noise(spec, len(time_ns), seed=seed)
    return Inertial(time_ns, rate + errors[:, :3], force + errors[:, 3:], rate, force)


def inertial_noise(spec: ImuSpec, count: int, *, seed: int) -> Float:
    """Errors (n, 6) of gyros, rad/s, and accelerometers, m/s^2: white noise, random walk, flicker."""
    dt = 1.0 / spec.rate_hz
    white = np.repeat([spec.gyro_noise, spec.accel_noise], 3) / np.sqrt(dt)
    step = np.repeat([spec.gyro_walk, spec.accel_walk], 3) * np.sqrt(dt)
    draw = generator(seed, spec.name, "imu").standard_normal((count, 12))
    total: Float = draw[:, :6] * white + np.cumsum(draw[:, 6:] * step, axis=0)
    for first, instability in ((0, spec.gyro_instability), (3, spec.accel_instability)):
        if instability and count:
            name = f"{spec.name}/imu/{first}"
            total[:, first : first + 3] += instability * _flicker(count, dt, seed=seed, name=name)
    return total


def _flicker(count: int, dt: float, *, seed: int, name: str) -> Float:
    """Three columns (n, 3) of noise whose spectrum is 1 / (2 pi f), with an Allan deviation of 0.664.

    The sum of stationary first-order Gauss-Markov processes, a factor of e apart in correlation time, each of
    variance 1 / pi: between the shortest and the longest time their spectra add up to it (IEEE Std 952-1997,
    annex C, for the spectrum of bias instability and its Allan deviation, B sqrt(2 ln 2 / pi)).
    """
    from scipy.signal import lfilter  # noqa: PLC0415 - slow to import

    total = np.zeros((count, 3))
    for time, phi in zip(_FLICKER_TIMES, np.exp(-dt / _FLICKER_TIMES), strict=True):
        noise = generator(seed, name, time).standard_normal((count, 3)) / np.sqrt(np.pi)
        noise[1:] *= np.sqrt(1 - phi**2)
        total += lfilter([1.0], [1.0, -phi], noise, axis=0)
    return total


def imu_columns(rows: Inertial) -> dict[str, NDArray[Any]]:
    """Columns of ``imu.csv``: measurements, and ground truth prefixed ``true_``; rad/s and m/s^2."""
    out: dict[str, NDArray[Any]] = {"time_ns": rows.time_ns}
    for prefix in ("", "true_"):
        for name in ("gyro", "accel"):
            values = getattr(rows, prefix + name)
            out |= {f"{prefix}{name}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
    return out
