"""Consistency of fixes, inertial samples and recorded poses with the motion estimated from sweeps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy.spatial import cKDTree

from geoscene.typing import Float
from lidar.parameters import parameter
from lidar.tools.defences.defence import Defence, Verdict, Window
from lidar.tools.defences.observation import NavigationMeasurements as Measured
from lidar.tools.defences.observation import Observation

_LAG = 10
"""Frames over which increments are compared."""
_MOST, _FEWEST = 1500, 100
"""Returns that are matched, at most and at least."""
_NEIGHBOURS = 8
"""Returns that give the normal of a surface."""
_ROUNDS = 12
_SIGMA = {4: 0.03, 5: 0.3, 2: 0.8, 1: 1.5}
"""Metres, standard deviation of a fix by its quality in NMEA 0183, at a dilution of 1; typical values."""
_LIMIT = 16.27
"""Of a chi-squared distribution of 3 degrees of freedom: exceeded with probability 0.001."""


@dataclass(frozen=True, slots=True)
class Correction:
    """Motion of a frame against its recorded pose, measured by matching it to an earlier frame.

    shift      : (3,) metres to the east and north, radians counter-clockwise, about the sensor
    covariance : (3, 3)
    """

    shift: Float
    covariance: Float


@dataclass(frozen=True)
class NavigationDefence(Defence):
    """Chi-squared test of fixes, gyroscope and recorded poses against the motion estimated from sweeps."""

    history: ClassVar[int] = _LAG
    needs: ClassVar[frozenset[str]] = frozenset({"navigation"})

    sigma: float = parameter(0.05, "error of a matched return along its normal", unit="m", low=0.001, high=1)
    floor: float = parameter(
        0.02, "least standard deviation of the matched motion", unit="m", low=0.001, high=1
    )
    drift: float = parameter(0.2, "error of the turn by the gyroscope", unit="degrees", low=0.001, high=10)

    def judge(self, window: Window) -> Verdict:
        """Judge the last frame against the one `_LAG` frames earlier, or the earliest."""
        frame, past = window.frame, window.frames[0]
        if len(window.frames) < 2:
            return Verdict(None, None, 0.0)
        found = match_sweeps(frame, past, sigma=self.sigma, floor=self.floor, rng=window.rng)
        if found is None:
            return Verdict(None, None, 0.0)
        squared = float(found.shift @ np.linalg.solve(found.covariance, found.shift))
        if (increment := self._fixes(frame, past, found=found)) is not None:
            squared = max(squared, increment)
        return Verdict(None, None, squared / (squared + _LIMIT))

    def _fixes(self, frame: Observation, past: Observation, *, found: Correction) -> float | None:
        """Chi-squared of the difference of increments by fixes and gyroscope and by the scanner.

        None without fixes at both times.
        """
        data = frame.navigation
        assert data is not None, "the runner checks that there are measurements"  # noqa: S101
        times = np.array([past.start_ns, frame.start_ns])
        fixes, sigma = _fix_at(data, times)
        if not (np.isfinite(fixes).all() and np.isfinite(sigma).all()):
            return None
        pose = frame.trajectory.at(times)
        antenna = pose.position + pose.scale * (pose.rotation @ data.antenna)
        sensor = frame.poses(times[1:]).position[0]
        c, s = np.cos(found.shift[2]), np.sin(found.shift[2])
        arm = antenna[1, :2] - sensor[:2]
        corrected = (
            sensor[:2] + found.shift[:2] + np.array([c * arm[0] - s * arm[1], s * arm[0] + c * arm[1]])
        )
        difference = np.empty(3)
        difference[:2] = (fixes[1] - fixes[0]) - (corrected - antenna[0, :2])
        yaw = np.arctan2(pose.rotation[:, 1, 0], pose.rotation[:, 0, 0])
        turned = yaw[1] - yaw[0] + found.shift[2] - _turn_by_gyroscope(data, times)
        difference[2] = (turned + np.pi) % (2 * np.pi) - np.pi
        own = np.diag([*np.full(2, (sigma**2).sum()), np.radians(self.drift) ** 2])
        return float(difference @ np.linalg.solve(own + found.covariance, difference))


def _fix_at(data: Measured, times: Float) -> tuple[Float, Float]:
    """Places (k, 2) of the antenna by fixes in the scene at times, and their standard deviations (k,).

    Linear between fixes; NaN where there is none within a second.
    """
    known = np.isfinite(data.east_north).all(axis=1) & (data.gnss["quality"] > 0)
    at = data.gnss["time_ns"][known]
    if len(at) < 2:
        return np.full((len(times), 2), np.nan), np.full(len(times), np.nan)
    place = np.stack([np.interp(times, at, data.east_north[known, k]) for k in range(2)], axis=1)
    nearest = np.abs(at[None] - times[:, None]).argmin(axis=1)
    quality, dilution = data.gnss["quality"][known][nearest], data.gnss["hdop"][known][nearest]
    sigma = np.array([_SIGMA.get(int(q), 5.0) for q in quality]) * np.maximum(dilution, 1.0)
    return place, np.where(np.abs(at[nearest] - times) < 1e9, sigma, np.nan)


def _turn_by_gyroscope(data: Measured, times: Float) -> float:
    """Radians turned between two times about the vertical."""
    at, rate = data.imu["time_ns"], data.imu["gyro_z"]
    inside = (at > times[0]) & (at < times[1])
    knots = np.concatenate([times[:1], at[inside], times[1:]])
    return float(np.trapezoid(np.interp(knots, at, rate), (knots - knots[0]) / 1e9))


def match_sweeps(
    frame: Observation, past: Observation, *, sigma: float, floor: float, rng: np.random.Generator
) -> Correction | None:
    """The motion that a frame needs to fit an earlier one; both are placed by the recorded poses first.

    Returns above the ground are matched to the surfaces (lines as seen from above) of the nearest returns,
    with weights that ignore what moves. None if too few are matched.
    """
    rows = np.flatnonzero(~frame.ground & (frame.distance < 60))
    if len(rows) < _FEWEST or past.obstacles.n < _FEWEST:
        return None
    rows = np.sort(rng.choice(rows, min(_MOST, len(rows)), replace=False))
    center = frame.poses([frame.start_ns]).position[0, :2]
    place = frame.scene_xyz[rows].copy()
    place[:, :2] -= center
    target = past.obstacles.data - [*center, 0.0]
    tree = cKDTree(target)
    state, reach = np.zeros(3), 2.0
    hessian = np.eye(3)
    for _ in range(_ROUNDS):
        c, s = np.cos(state[2]), np.sin(state[2])
        moved = place.copy()
        moved[:, :2] = place[:, :2] @ np.array([[c, s], [-s, c]]) + state[:2]
        away, near = tree.query(moved, k=_NEIGHBOURS, distance_upper_bound=reach)
        full = np.isfinite(away).all(axis=1)
        if full.sum() < _FEWEST:
            return None
        normal, middle, flat = _normals(target[near[full]][:, :, :2])
        at = moved[full, :2]
        error = np.einsum("ij,ij->i", at - middle, normal)
        scale = max(1.5 * float(np.median(np.abs(error))), sigma)
        weight = flat / (1 + (error / (3 * scale)) ** 2) ** 2
        jacobian = np.column_stack([normal, normal[:, 1] * at[:, 0] - normal[:, 0] * at[:, 1]])
        hessian = (jacobian * weight[:, None]).T @ jacobian + 1e-6 * np.eye(3)
        step = np.linalg.solve(hessian, (jacobian * weight[:, None]).T @ error)
        state, reach = state - step, max(0.7 * reach, 0.6)
        if np.abs(step[:2]).max() < 1e-4 and reach <= 0.6:
            break
    # Neighbouring returns err alike, as those of a bent surface: count one in ten as independent.
    spread: Float = np.asarray(np.linalg.inv(hessian), float)
    covariance = 10 * sigma**2 * spread + np.diag([floor**2, floor**2, (floor / 10) ** 2])
    return Correction(state, covariance)


def _normals(groups: Float) -> tuple[Float, Float, Float]:
    """Normals (n, 2) and middles (n, 2) of groups of points (n, k, 2); 1 where they form a line, else 0."""
    middle = groups.mean(axis=1)
    away = groups - middle[:, None]
    spread = np.einsum("nki,nkj->nij", away, away) / groups.shape[1]
    values, vectors = np.linalg.eigh(spread)
    flat = (values[:, 0] < 0.1 * values[:, 1]).astype(float)
    return vectors[:, :, 0], middle, flat
