"""One frame of a scanner: cast rays, detect echoes, report a point cloud."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.compiled import njit
from geoscene.typing import Float
from lidar.geometry.attitude import Mount
from lidar.geometry.poses import Trajectory
from lidar.geometry.random_streams import generator
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.laser.footprints import beside
from lidar.sensors.laser.surface_echoes import SentPulses, surface_echoes
from lidar.sensors.physics.detector import Deviates, detect_echoes, false_echoes, measured_range, receive
from lidar.sensors.physics.echoes import Echoes, TracedEchoes, join, number_echoes, select_reported, trace
from lidar.sensors.physics.link import reflectivity_code, transmission
from lidar.sensors.physics.settings import PLAIN, ScannerSettings
from lidar.sensors.rig.patterns.beams import Firings, chosen
from lidar.sensors.rig.scanner import Sensor
from lidar.sensors.rig.scanner import firings as fire
from lidar.world.world import World


@dataclass(frozen=True, slots=True)
class Sweep:
    """One frame before the detector: the pulses, and the echoes that reach the receiver.

    seed, settings : of the detector
    firings : the pulses as the sensor reports them
    sent    : the pulses as they were sent: with noise of their direction
    echoes  : sorted by pulse and range
    """

    sensor: Sensor
    frame: int
    seed: int
    settings: ScannerSettings
    firings: Firings
    sent: Firings
    echoes: Echoes


@dataclass(frozen=True, slots=True)
class DetectedEchoes:
    """The echoes of a sweep that the sensor reports.

    range  : (n,) metres as the sensor reports it
    number : (n,) of the echo in its pulse, from 1
    count  : (n,) echoes of its pulse
    """

    echoes: Echoes
    range: Float
    number: NDArray[np.uint8]
    count: NDArray[np.uint8]


def scan(
    sensor: Sensor,
    mount: Mount,
    *,
    trajectory: Trajectory,
    world: World,
    frame: int,
    seed: int = 0,
    settings: ScannerSettings = PLAIN,
    threads: int = 1,
) -> Cloud:
    """The returns of frame ``frame`` of the drive, in the order they were fired.

    Actors of the world move with the ray time, which runs from 0 to 1 over `Sensor.window_ns`. The same seed,
    sensor name and frame give the same cloud, whatever was scanned before.

    Raises BackendError if the ray engine does not work here.
    """
    sweep = cast(
        sensor,
        mount,
        trajectory=trajectory,
        world=world,
        frame=frame,
        seed=seed,
        settings=settings,
        threads=threads,
    )
    return measure(sweep)


def measure(sweep: Sweep) -> Cloud:
    """The point cloud of a sweep without stages."""
    return report(sweep, detect(sweep, sweep.echoes, deviates=deviates_of(sweep)))


def cast(
    sensor: Sensor,
    mount: Mount,
    *,
    trajectory: Trajectory,
    world: World,
    frame: int,
    seed: int = 0,
    settings: ScannerSettings = PLAIN,
    pulses: NDArray[np.integer] | None = None,
    threads: int = 1,
) -> Sweep:
    """The pulses of a frame and their echoes, before the detector; other parameters as of `scan`.

    pulses : (k,) ascending rows of the frame's pulses to send; all by default
    """
    firings = find_pulse(sensor, frame, settings=settings)
    sent = SentPulses(firings, _turns(len(firings), sensor=sensor, frame=frame, seed=seed, settings=settings))
    kept = None
    if pulses is not None:
        kept = np.isin(np.arange(len(firings)), pulses)
        needed = kept | beside(firings, kept) if settings.footprint else kept
        sent, firings, kept = sent.take(needed), chosen(firings, needed), kept[needed]
    if settings.angle_noise:
        noise = generator(seed, sensor.name, frame, "angle").standard_normal((len(firings), 3))
        bent = firings.direction + sensor.angle_sigma * noise
        bent /= np.linalg.norm(bent, axis=1, keepdims=True)
        sent = sent._replace(firings=replace(firings, direction=bent))
    if any(group.transform.ndim == 4 for group in world.caster.instances):  # actors move
        start, stop = sensor.window_ns(frame)
        sent = sent._replace(time=((firings.time_ns - start) / (stop - start)).astype(np.float32))
    echoes = surface_echoes(
        sent,
        mount,
        sensor=sensor,
        trajectory=trajectory,
        world=world,
        settings=settings,
        seed=seed,
        frame=frame,
        threads=threads,
    )
    if kept is not None and not kept.all():  # rays of a pulse depend on those that are fired beside it
        number = (np.cumsum(kept) - 1).astype(np.int32)
        echoes = echoes.where(kept[echoes.pulse])
        echoes = replace(echoes, pulse=number[echoes.pulse])
        sent, firings = sent.take(kept), chosen(firings, kept)
    if settings.extinction:
        away = echoes.range + sensor.pattern.range_offset
        echoes = replace(echoes, apparent=echoes.apparent * transmission(away, settings.extinction))
    return Sweep(sensor, frame, seed, settings, firings, sent.firings, echoes)


def _turns(count: int, *, sensor: Sensor, frame: int, seed: int, settings: ScannerSettings) -> Float:
    """Radians by which the rays of each pulse of a frame are turned about its axis; empty for one ray."""
    if not settings.traces_footprints:
        return np.empty(0)
    return 2 * np.pi * generator(seed, sensor.name, frame, "footprint").random(count)


def find_pulse(sensor: Sensor, frame: int, *, settings: ScannerSettings) -> Firings:
    """The pulses of a frame, at the times whose poses they are cast from."""
    firings = fire(sensor, frame)
    if settings.poses == "firing":
        return firings
    return replace(firings, time_ns=_pose_times(firings, settings.poses))


def _pose_times(firings: Firings, poses: str) -> NDArray[np.int64]:
    """Times (n,) of the first pulses of the columns or of the frame."""
    if poses == "frame":
        return np.full_like(firings.time_ns, firings.time_ns[0])
    _, first, block = np.unique(firings.column, return_index=True, return_inverse=True)
    return firings.time_ns[first][block]


def deviates_of(sweep: Sweep) -> Deviates:
    """The noise of a sweep's detector: streams of their own for each purpose, one deviate an echo."""

    def deviates(purpose: str, echoes: Echoes) -> Float:
        rng = generator(sweep.seed, sweep.sensor.name, sweep.frame, purpose)
        return rng.standard_normal(len(echoes))

    return deviates


def detect(sweep: Sweep, echoes: Echoes, *, deviates: Deviates) -> DetectedEchoes:
    """Detection, return mode and measured range of echoes that reach the receiver in a sweep.

    echoes : sorted by pulse and range: the sweep's own, or traced ones that stages have changed. Of traced
             ones, the k-th kind of false echo of pulse p gets the source m + k n + p, where the sweep has m
             echoes and n pulses
    """
    sensor, settings, offset = sweep.sensor, sweep.settings, sweep.sensor.pattern.range_offset
    echoes = echoes.where(echoes.range + offset >= sensor.min_range)
    if settings.link or settings.detection:
        echoes = detect_echoes(sensor, echoes, settings=settings, deviates=deviates)
    false = false_echoes(
        sensor, sweep.firings, echoes=echoes, settings=settings, seed=sweep.seed, frame=sweep.frame
    )
    is_traced = isinstance(echoes, TracedEchoes)
    for k, (origin, found) in enumerate(false):
        first = len(sweep.echoes) + k * len(sweep.firings)
        echoes = join(echoes, trace(found, origin, source=first + found.pulse) if is_traced else found)
    number, count = number_echoes(echoes)
    if settings.traces_footprints or settings.mirrors or false or is_traced:
        power = receive(sensor, echoes)
        rows = select_reported(
            echoes, power, mode=sensor.return_mode, most=sensor.max_echoes, second=sensor.second_strongest
        )
        if len(rows) < len(echoes):
            echoes, number, count = echoes.take(rows), number[rows], count[rows]
        count = np.minimum(count, sensor.max_echoes)
    distance = measured_range(
        sensor, sweep.firings, echoes=echoes, settings=settings, seed=sweep.seed, deviates=deviates
    )
    keep = (distance >= sensor.min_range) & (distance <= sensor.max_range)
    return DetectedEchoes(echoes.where(keep), distance[keep], number[keep], count[keep])


def report(sweep: Sweep, detection: DetectedEchoes) -> Cloud:
    """The point cloud of what a sweep's sensor reports."""
    sensor, pulses, echoes = sweep.sensor, sweep.firings, detection.echoes
    pulse, offset, start = echoes.pulse, sensor.pattern.range_offset, int(pulses.time_ns[0])
    n = len(pulse)
    xyz, time = np.empty((n, 3), np.float32), np.empty(n, np.int32)
    _place(pulse, detection.range - offset, pulses.origin, pulses.direction, pulses.time_ns, xyz, time)
    code = reflectivity_code(echoes.apparent, diffuse_code=sensor.diffuse_code, whole=sweep.settings.quantise)
    real = echoes.true_range > 0
    return Cloud(
        start_ns=start,
        xyz=xyz,
        time_ns=time,
        ring=pulses.ring[pulse],
        column=pulses.column[pulse],
        range=detection.range,
        intensity=code,
        klass=echoes.klass,
        feature=echoes.feature,
        incidence=np.arccos(echoes.cosine).astype(np.float32),
        true_range=np.where(real, echoes.true_range + offset, 0.0),
        echo=detection.number,
        echoes=detection.count,
    )


@njit(cache=True, nogil=True)
def _place(pulse: Any, distance: Any, origin: Any, direction: Any, time_ns: Any, xyz: Any, time: Any) -> None:
    """Fill ``xyz`` and ``time`` of returns."""
    for i in range(len(pulse)):
        p = pulse[i]
        xyz[i, 0] = origin[p, 0] + distance[i] * direction[p, 0]
        xyz[i, 1] = origin[p, 1] + distance[i] * direction[p, 1]
        xyz[i, 2] = origin[p, 2] + distance[i] * direction[p, 2]
        time[i] = time_ns[p] - time_ns[0]
