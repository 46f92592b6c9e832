"""Inertial measurement units: true angular rates and specific forces, and their measurements.

    gyro  = omega + b_g + n_g        omega: angular rate in inertial space, rad/s
    accel = f + b_a + n_a            f = a - g: specific force, m/s^2

both along the unit's axes. n is white noise; b a random walk plus flicker noise (bias instability). At rest
f points upwards with the magnitude of gravity. omega includes the Earth rate and the transport rate (rotation
of the local vertical due to travel); f includes the Coriolis acceleration.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.frames import Frame
from geoscene.support.csv_tables import table_blocks
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
    blocks = [*_true_blocks(trajectory, frame, spec=spec, time_ns=time_ns)]
    rate, force = (np.concatenate([np.empty((0, 3)), *(block[k] for block in blocks)]) for k in (1, 2))
    return rate, force


def _true_blocks(
    trajectory: Trajectory, frame: Frame, *, spec: ImuSpec, time_ns: NDArray[np.int64]
) -> Iterator[tuple[slice, Float, Float]]:
    """Rows of times, and `true_inertial` of these, in order: blocks for tables."""
    own = spec.mount.rotation
    seconds = trajectory.time_ns * 1e-9
    signals = _at_poses(trajectory, frame, spec=spec)
    for rows in table_blocks(len(time_ns)):
        at = time_ns[rows] * 1e-9
        rate, force = (
            np.stack([np.interp(at, seconds, v[:, k]) for k in range(3)], axis=1) @ own for v in signals
        )
        yield rows, rate, force


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


def observe_imu(trajectory: Trajectory, frame: Frame, *, spec: ImuSpec, seed: int) -> Iterator[Inertial]:
    """The measurements of an inertial unit along a drive, in blocks for tables; an empty one for none.

    Random numbers are keyed by seed and unit and drawn in time order from the start, so that a shorter
    drive has the same first rows, bit for bit.
    """
    time_ns = _times(trajectory, spec)
    noise = _Noise(spec, seed)
    for rows, rate, force in _true_blocks(trajectory, frame, spec=spec, time_ns=time_ns):
        errors = noise.following(len(rate))
        yield Inertial(time_ns[rows], rate + errors[:, :3], force + errors[:, 3:], rate, force)


def _times(trajectory: Trajectory, spec: ImuSpec) -> NDArray[np.int64]:
    """Times (n,) of a unit's measurements along a drive."""
    step = 1e9 / spec.rate_hz
    count = int(np.floor((trajectory.duration_ns - spec.time_offset_ns) / step + 1e-9)) + 1
    return np.round(np.arange(max(count, 0)) * step).astype(np.int64) + spec.time_offset_ns


def inertial_noise(spec: ImuSpec, count: int, *, seed: int) -> Float:
    """Errors (n, 6) of gyros, rad/s, and accelerometers, m/s^2: white noise, random walk, flicker."""
    return _Noise(spec, seed).following(count)


class _Noise:
    """Errors of a unit, drawn in blocks of rows; their values do not depend on the blocks."""

    def __init__(self, spec: ImuSpec, seed: int) -> None:
        dt = 1.0 / spec.rate_hz
        self._random = generator(seed, spec.name, "imu")
        self._white = np.repeat([spec.gyro_noise, spec.accel_noise], 3) / np.sqrt(dt)
        self._step = np.repeat([spec.gyro_walk, spec.accel_walk], 3) * np.sqrt(dt)
        self._walk = np.full(6, -0.0)  # changes no step, not even the sign of zero
        self._flicker = [
            (axes, instability, _Flicker(dt, seed=seed, name=f"{spec.name}/imu/{axes.start}"))
            for axes, instability in (
                (slice(0, 3), spec.gyro_instability),
                (slice(3, 6), spec.accel_instability),
            )
            if instability
        ]

    def following(self, count: int) -> Float:
        """Errors (n, 6) of the next ``count`` measurements."""
        draw = self._random.standard_normal((count, 12))
        steps = draw[:, 6:] * self._step
        steps[:1] += self._walk
        walk = np.cumsum(steps, axis=0)
        total: Float = draw[:, :6] * self._white + walk
        self._walk = walk[-1] if count else self._walk
        for axes, instability, flicker in self._flicker:
            total[:, axes] += instability * flicker.following(count)
        return total


class _Flicker:
    """Three columns of noise whose spectrum is 1 / (2 pi f), with an Allan deviation of 0.664.

    The sum of stationary first-order Gauss-Markov processes, a factor of e apart in correlation time, each of
    variance 1 / pi: between the shortest and the longest time their spectra add up to it (IEEE Std 952-1997,
    annex C, for the spectrum of bias instability and its Allan deviation, B sqrt(2 ln 2 / pi)).
    """

    def __init__(self, dt: float, *, seed: int, name: str) -> None:
        self._random = [generator(seed, name, time) for time in _FLICKER_TIMES]
        self._phi = np.exp(-dt / _FLICKER_TIMES)
        self._state = np.zeros((len(_FLICKER_TIMES), 1, 3))
        self._begun = False

    def following(self, count: int) -> Float:
        """The next ``count`` rows (n, 3)."""
        from scipy.signal import lfilter  # noqa: PLC0415 - slow to import

        total = np.zeros((count, 3))
        for k, (random, phi) in enumerate(zip(self._random, self._phi, strict=True)):
            noise = random.standard_normal((count, 3)) / np.sqrt(np.pi)
            noise[0 if self._begun else 1 :] *= np.sqrt(1 - phi**2)
            sums, self._state[k] = lfilter([1.0], [1.0, -phi], noise, axis=0, zi=self._state[k])
            total += sums
        self._begun = self._begun or count > 0
        return total


def imu_columns(rows: Inertial) -> dict[str, NDArray[Any]]:
    """Columns of ``imu.csv``: measurements, and ground truth prefixed ``true_``; rad/s and m/s^2."""
    out: dict[str, NDArray[Any]] = {"time_ns": rows.time_ns}
    for prefix in ("", "true_"):
        for name in ("gyro", "accel"):
            values = getattr(rows, prefix + name)
            out |= {f"{prefix}{name}_{axis}": values[:, k] for k, axis in enumerate("xyz")}
    return out
