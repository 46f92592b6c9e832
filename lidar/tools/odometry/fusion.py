"""Fusion of GNSS, inertial units and odometry: a smoother over all poses of a drive, by gtsam.

Unknowns are the pose of the vehicle at each knot and, with an inertial unit, its velocity and the unit's
biases. Between knots stand preintegrated inertial samples (Forster et al. 2017) and the steps of odometry;
fixes and their velocities tie them to the ground. Fixes that fail a chi-square test against all else are left
out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from geoscene.errors import need
from geoscene.typing import Bools, Float, Ints
from lidar.dataset.layout import Dataset
from lidar.dataset.navigation_files import read_fixes, read_samples
from lidar.errors import DatasetError
from lidar.sensors.navigation.imu import EARTH_RATE, normal_gravity
from lidar.sensors.navigation.measurements import NAMES, STATES, Inertial
from lidar.sensors.rig.imu_grades import Noise
from lidar.tools.odometry.estimate import along_axes
from lidar.tools.odometry.settings import OdometrySettings

_MOVING = 1.0  # m/s, from which the course tells the heading
_LEAST_SIGMA = 0.02  # metres, of a fix
_OPEN_SKY = 8.0  # satellites of a system over an open horizon; where some are hidden, fixes have multipath
_UPRIGHT = (0.05, 0.1, 0.3)  # radians: roll, slope and heading at the first knot, about level and the course
_PLACE = 10.0  # metres: what is known of the first position
_VELOCITY = 20.0  # m/s, likewise
_BIASES = (0.1, 0.01)  # m/s^2 and rad/s: of an inertial unit when it is switched on
_WALK = (1e-4, 1e-5)  # m/s^3 and rad/s^2 per root of a hertz: least random walk; less makes the system stiff
_INTEGRATION = 1e-3  # m per root of a second: errors of the integration itself
_ACROSS = 0.2  # m/s: the rear axle moves along the vehicle, but for slip and suspension
_STEP_FLOOR = (0.0005, 0.01)  # radians and metres: of a step of odometry, whatever the method states
_CAUCHY = 2.0  # standard deviations, from which fixes lose weight before the test
_UNDETERMINED = "fixes, samples and odometry do not determine the poses: too few, or far apart in time"
_ROUNDS = 3  # times that fixes are tested


@dataclass(frozen=True)
class Fixed:
    """Fixes of a receiver, in true metres: scene coordinates over ``scale`` horizontally.

    time_ns  : (n,) since the drive's start
    position : (n, 3) of the antenna
    velocity : (n, 3) m/s of the antenna along the scene's axes; the vertical one is not measured, and 0
    sigma, velocity_sigma : (n, 3) one standard deviation
    quality  : (n,) as in NMEA
    lever    : (3,) antenna in the vehicle's frame
    scale    : scene metres per true metre at the first fix
    """

    time_ns: Ints
    position: Float
    velocity: Float
    sigma: Float
    velocity_sigma: Float
    quality: Ints
    lever: Float
    scale: float


@dataclass(frozen=True)
class Unit:
    """Samples of an inertial unit, with its noise model.

    vehicle_from_unit : (4, 4)
    gravity           : m/s^2
    earth             : (3,) rotation of the Earth along the scene's axes, rad/s
    """

    samples: Inertial
    noise: Noise
    vehicle_from_unit: Float
    gravity: float
    earth: Float


@dataclass(frozen=True)
class Fused:
    """Poses (n, 4, 4) in the scene at the knots, deviations (n, 6), and which fixes (m,) were used."""

    poses: Float
    sigma: Float
    used: Bools


def fixes_of(dataset: Dataset, receiver: str) -> Fixed:
    """Fixes of a receiver, with standard deviations by their state and dilution of precision.

    Multipath is that of the share of the sky which is hidden, as the number of satellites tells it.

    Raises DatasetError without two fixes, and for damaged files.
    """
    fixes, _ = read_fixes(dataset.paths, receiver, vertical=dataset.frame.vertical)
    on = np.isfinite(fixes.lonlath).all(axis=1) & np.isfinite(fixes.speed)
    if np.count_nonzero(on) < 2:
        raise DatasetError(f"{dataset.paths.measurements(receiver)}: fewer than two fixes")
    lon, lat, height = fixes.lonlath[on].T
    scale = float(dataset.frame.scale(lon[0], lat[0]))
    x, y = dataset.frame.from_geographic(lon, lat)
    states = [STATES[name] for name in NAMES]
    typical = np.array([[math.hypot(s.white[k], s.bias[k]) for k in (0, 0, 1)] for s in states])
    blocked = np.array([[s.blocked[k] for k in (0, 0, 1)] for s in states])
    systems = len({name[0] for name in fixes.names.tolist()})
    hidden = np.clip(1.0 - fixes.satellites[on] / (_OPEN_SKY * max(systems, 1)), 0.0, 1.0)
    speeds = np.array([s.speed for s in states])
    state, dop = fixes.state[on], np.fmax(fixes.dop[on][:, [0, 0, 1]], 1.0)
    heading = math.pi / 2 - (fixes.course[on] - dataset.frame.convergence(lon, lat))
    speed = fixes.speed[on]
    velocity = np.column_stack([speed * np.cos(heading), speed * np.sin(heading), 0 * speed])
    spread = np.fmax(speeds[state], _LEAST_SIGMA)[:, None] * dop
    spread[:, 2] = 1.0 + 0.3 * speed  # roads have slopes
    return Fixed(
        fixes.time_ns[on],
        np.column_stack([x / scale, y / scale, height]),
        velocity,
        np.fmax(np.hypot(typical[state], hidden[:, None] * blocked[state]) * dop, _LEAST_SIGMA),
        spread,
        fixes.quality[on].astype(np.int64),
        np.array(dataset.sensors("gnss")[receiver]["vehicle_from_sensor"], float)[:3, 3],
        scale,
    )


def unit_of(dataset: Dataset, name: str, *, noise: Noise, fixes: Fixed) -> Unit:
    """An inertial unit of a dataset, where its vehicle is by its fixes."""
    samples = read_samples(dataset.paths.measurements(name))
    x, y = fixes.position[0, :2] * fixes.scale
    lon, lat = dataset.frame.to_geographic(np.array([x]), np.array([y]))
    turn = float(dataset.frame.convergence(lon, lat)[0])
    north, up = EARTH_RATE * np.cos(np.radians(lat[0])), EARTH_RATE * np.sin(np.radians(lat[0]))
    # North is the convergence to the left of the grid's y axis.
    earth = np.array([-north * math.sin(turn), north * math.cos(turn), up])
    gravity = float(normal_gravity(lat[0], fixes.position[0, 2]))
    mount = np.array(dataset.sensors("imu")[name]["vehicle_from_sensor"], float)
    return Unit(samples, noise, mount, gravity, earth)


def fuse_measurements(
    time_ns: Ints,
    fixes: Fixed,
    *,
    unit: Unit | None,
    steps: Float | None,
    step_sigma: Float | None,
    settings: OdometrySettings,
) -> Fused:
    """Poses of the vehicle at rising times (n,) that fit all measurements best.

    steps      : (n - 1, 4, 4) motion from each time to the next by odometry; None without it
    step_sigma : (n - 1, 6) one standard deviation of its rotation and translation

    First all fixes count, with Cauchy's loss. Then those are left out whose distance from the poses is
    greater than their deviations allow (``gate``), and the poses are found again with the others. Errors of
    fixes are the same for a while (``correlation_s``), so that one counts in such a time.

    Raises DatasetError if the vehicle does not move, so that no fix tells its heading.
    """
    inside = (fixes.time_ns >= time_ns[0]) & (fixes.time_ns <= time_ns[-1])
    fixes = _part(fixes, inside)
    graph = _Graph(time_ns, fixes, unit=unit, steps=steps, step_sigma=step_sigma, settings=settings)
    used = np.ones(len(fixes.time_ns), bool)
    values = graph.solved(graph.start(), used=used, robust=True)
    bound = float(chi2.ppf(settings.gate, 3))
    for _ in range(_ROUNDS):
        before, used = used, graph.distances(values) <= bound
        if used.sum() < 2:
            used = before
            break
        values = graph.solved(values, used=used, robust=False)
        if np.array_equal(before, used):
            break
    everywhere = np.zeros(len(inside), bool)
    everywhere[np.flatnonzero(inside)[used]] = True
    return Fused(*graph.result(values), everywhere)


def _part(fixes: Fixed, rows: Bools) -> Fixed:
    names = ("time_ns", "position", "velocity", "sigma", "velocity_sigma", "quality")
    return replace(fixes, **{name: getattr(fixes, name)[rows] for name in names})


class _Graph:
    """The factors of a drive."""

    def __init__(
        self,
        time_ns: Ints,
        fixes: Fixed,
        *,
        unit: Unit | None,
        steps: Float | None,
        step_sigma: Float | None,
        settings: OdometrySettings,
    ) -> None:
        self._gtsam = gtsam = need("gtsam", "odometry")
        self._time_ns, self._fixes, self._unit, self._steps = time_ns, fixes, unit, steps
        self._pose, self._velocity, self._bias = (getattr(gtsam.symbol_shorthand, letter) for letter in "XVB")
        self._knot = np.clip(np.searchsorted(time_ns, fixes.time_ns, side="right") - 1, 0, len(time_ns) - 2)
        span = time_ns[self._knot + 1] - time_ns[self._knot]
        self._share = (fixes.time_ns - time_ns[self._knot]) / span
        seconds = float(np.median(np.diff(fixes.time_ns))) * 1e-9 if len(fixes.time_ns) > 1 else 1.0
        self._shared = math.sqrt(max(settings.correlation_s / seconds, 1.0))
        self._last: Any = None
        self._motion = gtsam.NonlinearFactorGraph()
        self._add_steps(step_sigma)
        if unit is not None:
            self._add_samples(unit)

    def _add_steps(self, sigma: Float | None) -> None:
        gtsam, seconds = self._gtsam, np.diff(self._time_ns) * 1e-9
        if self._steps is not None:
            spread = np.hypot(0.0 if sigma is None else sigma, np.repeat(_STEP_FLOOR, 3))
            for k, step in enumerate(self._steps):
                noise = gtsam.noiseModel.Diagonal.Sigmas(np.broadcast_to(spread, (len(self._steps), 6))[k])
                self._motion.add(
                    gtsam.BetweenFactorPose3(self._pose(k), self._pose(k + 1), gtsam.Pose3(step), noise)
                )
            return
        if self._unit is not None:
            return
        for k, dt in enumerate(seconds.tolist()):  # fixes alone: even motion along the vehicle
            speed = float(np.interp(self._time_ns[k], self._fixes.time_ns, self._speed()))
            step = np.eye(4)
            step[0, 3] = speed * dt
            spread = np.array([0.05, 0.05, 0.5, 1.0, _ACROSS, _ACROSS]) * dt
            noise = gtsam.noiseModel.Diagonal.Sigmas(spread)
            self._motion.add(
                gtsam.BetweenFactorPose3(self._pose(k), self._pose(k + 1), gtsam.Pose3(step), noise)
            )

    def _add_samples(self, unit: Unit) -> None:
        """Preintegrated samples between the knots; each holds until the next."""
        gtsam, noise = self._gtsam, unit.noise
        parameters = gtsam.PreintegrationCombinedParams.MakeSharedU(unit.gravity)
        accel_walk = math.hypot(noise.accel_walk, noise.accel_instability)
        gyro_walk = math.hypot(noise.gyro_walk, noise.gyro_instability)
        parameters.setAccelerometerCovariance(np.eye(3) * noise.accel_noise**2)
        parameters.setGyroscopeCovariance(np.eye(3) * noise.gyro_noise**2)
        parameters.setIntegrationCovariance(np.eye(3) * _INTEGRATION**2)
        parameters.setBiasAccCovariance(np.eye(3) * max(accel_walk, _WALK[0]) ** 2)
        parameters.setBiasOmegaCovariance(np.eye(3) * max(gyro_walk, _WALK[1]) ** 2)
        parameters.setOmegaCoriolis(unit.earth)
        parameters.setBodyPSensor(gtsam.Pose3(unit.vehicle_from_unit))
        at = unit.samples.time_ns
        for k in range(len(self._time_ns) - 1):
            first, last = int(self._time_ns[k]), int(self._time_ns[k + 1])
            edges = np.unique(np.concatenate([[first, last], at[(at > first) & (at < last)]]))
            middle = (edges[1:] + edges[:-1]) / 2
            signals = [
                np.column_stack([np.interp(middle, at, axis) for axis in column.T])
                for column in (unit.samples.accel, unit.samples.gyro)
            ]
            sums = gtsam.PreintegratedCombinedMeasurements(parameters, gtsam.imuBias.ConstantBias())
            for accel, gyro, dt in zip(*signals, np.diff(edges) * 1e-9, strict=True):
                sums.integrateMeasurement(accel, gyro, float(dt))
            keys = (self._pose(k), self._velocity(k), self._pose(k + 1), self._velocity(k + 1))
            self._motion.add(gtsam.CombinedImuFactor(*keys, self._bias(k), self._bias(k + 1), sums))

    def _speed(self) -> Float:
        speed: Float = np.linalg.norm(self._fixes.velocity, axis=1)
        return speed

    def start(self) -> Any:
        """Values to begin with: positions by fixes, or by odometry turned and moved onto them."""
        gtsam, fixes, count = self._gtsam, self._fixes, len(self._time_ns)
        moving = np.flatnonzero(self._speed() > _MOVING)
        if not len(moving):
            raise DatasetError("no fix while the vehicle moves, so that its heading is not known")
        yaw = np.unwrap(np.arctan2(*fixes.velocity[moving, 1::-1].T))
        at = np.interp(self._time_ns, fixes.time_ns[moving], yaw)
        poses = np.tile(np.eye(4), (count, 1, 1))
        if self._steps is None:
            poses[:, :3, :3] = Rotation.from_euler("z", at[:, None]).as_matrix()
            for k in range(3):
                poses[:, k, 3] = np.interp(self._time_ns, fixes.time_ns, fixes.position[:, k])
            poses[:, :3, 3] -= poses[:, :3, :3] @ fixes.lever
        else:
            for k, step in enumerate(self._steps):
                poses[k + 1] = poses[k] @ step
            own = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
            turn = np.median(np.interp(fixes.time_ns[moving], self._time_ns, at - own))
            onto = np.eye(4)
            onto[:3, :3] = Rotation.from_euler("z", turn).as_matrix()
            poses = onto @ poses
            antenna = poses[:, :3, 3] + poses[:, :3, :3] @ fixes.lever
            here = np.column_stack([np.interp(fixes.time_ns, self._time_ns, axis) for axis in antenna.T])
            poses[:, :3, 3] += np.median(fixes.position - here, axis=0)
        values = gtsam.Values()
        velocity = np.gradient(poses[:, :3, 3], self._time_ns * 1e-9, axis=0)
        for k in range(count):
            values.insert(self._pose(k), gtsam.Pose3(poses[k]))
            if self._unit is not None:
                values.insert(self._velocity(k), velocity[k])
                values.insert(self._bias(k), gtsam.imuBias.ConstantBias())
        return values

    def _arm(self, values: Any, row: int) -> Float:
        """The antenna at the time of a fix in the vehicle's frame at the knot before."""
        first, second = (values.atPose3(self._pose(int(self._knot[row]) + i)) for i in (0, 1))
        logarithm = self._gtsam.Pose3.Logmap(first.between(second)) * self._share[row]
        arm: Float = self._gtsam.Pose3.Expmap(logarithm).transformFrom(self._fixes.lever)
        return arm

    def _swing(self, values: Any, knot: int) -> Float:
        """Velocity (3,) of the antenna relative to the vehicle's axle, as the vehicle turns after a knot."""
        first, second = (values.atPose3(self._pose(knot + i)) for i in (0, 1))
        seconds = float(self._time_ns[knot + 1] - self._time_ns[knot]) * 1e-9
        rate = self._gtsam.Rot3.Logmap(first.rotation().between(second.rotation())) / seconds
        swing: Float = first.rotation().matrix() @ np.cross(rate, self._fixes.lever)
        return swing

    def solved(self, values: Any, *, used: Bools, robust: bool) -> Any:
        """The values of least squares with some of the fixes."""
        gtsam = self._gtsam
        graph = gtsam.NonlinearFactorGraph(self._motion)
        first = values.atPose3(self._pose(0))
        loose = np.array([*_UPRIGHT, _PLACE, _PLACE, _PLACE])
        yaw = gtsam.Rot3.Yaw(first.rotation().yaw())
        graph.add(
            gtsam.PriorFactorPose3(
                self._pose(0), gtsam.Pose3(yaw, first.translation()), gtsam.noiseModel.Diagonal.Sigmas(loose)
            )
        )
        if self._unit is not None:
            graph.add(
                gtsam.PriorFactorVector(
                    self._velocity(0), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, _VELOCITY)
                )
            )
            spread = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(_BIASES, 3))
            graph.add(gtsam.PriorFactorConstantBias(self._bias(0), gtsam.imuBias.ConstantBias(), spread))
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY / self._shared)
        for row in np.flatnonzero(used).tolist():
            knot = int(self._knot[row])
            noise = gtsam.noiseModel.Diagonal.Sigmas(self._fixes.sigma[row] * self._shared)
            noise = gtsam.noiseModel.Robust.Create(cauchy, noise) if robust else noise
            place = self._fixes.position[row]
            graph.add(gtsam.GPSFactorArm(self._pose(knot), place, self._arm(values, row), noise))
            if self._unit is not None and self._speed()[row] > _MOVING:
                near = knot + int(self._share[row] > 0.5)
                spread = gtsam.noiseModel.Diagonal.Sigmas(self._fixes.velocity_sigma[row])
                spread = gtsam.noiseModel.Robust.Create(
                    gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY), spread
                )
                velocity = self._fixes.velocity[row] - self._swing(values, knot)
                graph.add(gtsam.PriorFactorVector(self._velocity(near), velocity, spread))
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")  # deviations of biases and of fixes are far apart
        try:
            found = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
        except RuntimeError as error:  # of an indeterminate system
            raise DatasetError(_UNDETERMINED) from error
        self._last = graph
        return found

    def distances(self, values: Any) -> Float:
        """Squared distances (m,) of fixes from the poses, in their standard deviations."""
        out = np.empty(len(self._fixes.time_ns))
        for row in range(len(out)):
            pose = values.atPose3(self._pose(int(self._knot[row])))
            off = pose.transformFrom(self._arm(values, row)) - self._fixes.position[row]
            out[row] = ((off / self._fixes.sigma[row]) ** 2).sum()
        return out

    def result(self, values: Any) -> tuple[Float, Float]:
        """Poses (n, 4, 4) and their standard deviations (n, 6), of rotation and position."""
        count = len(self._time_ns)
        poses = np.array([values.atPose3(self._pose(k)).matrix() for k in range(count)])
        parameters = self._gtsam.ISAM2Params()
        parameters.setFactorization("QR")  # the marginals of a batch have Cholesky's alone
        smoother = self._gtsam.ISAM2(parameters)
        try:
            smoother.update(self._last, values)
            covariance = np.array([smoother.marginalCovariance(self._pose(k)) for k in range(count)])
        except RuntimeError as error:
            raise DatasetError(_UNDETERMINED) from error
        return poses, along_axes(poses, covariance)
