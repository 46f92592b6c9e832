"""Frames of a planned drive, simulated with other settings, and the worlds that they share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import timedelta

import numpy as np
from numpy.typing import NDArray

from geoscene.scene import Scene
from geoscene.typing import Float
from lidar.sensors.camera.sun import sun_direction
from lidar.sensors.laser.scan import DetectedEchoes, Sweep, cast, detect, deviates_of
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.simulation.plan import DrivePlan
from lidar.simulation.signals import lamps_at
from lidar.tools.tradeoff.errors import PulseReturns
from lidar.tools.tradeoff.images import Shot
from lidar.world.actors import actor_shapes, actor_transforms
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings
from lidar.world.world import Region, World

EXACT, FAST = "float64", "auto"
"""Backends of the reference and of drives."""


@dataclass(frozen=True, slots=True)
class Bench:
    """Frames of a planned drive.

    plan   : the drive
    scenes : the plan's scene, and others of the same place and CRS frame
    frames : numbers of the frames, by name of the sensor
    """

    plan: DrivePlan
    scenes: tuple[Scene, ...]
    frames: dict[str, tuple[int, ...]]
    _worlds: dict[tuple[int, str, bool, WorldSettings], World] = field(default_factory=dict, repr=False)

    def close(self, *, backend: str) -> None:
        """Release the worlds of a backend, which are loaded again when needed."""
        for key in [key for key in self._worlds if key[1] == backend]:
            del self._worlds[key]

    def world(
        self,
        sensor: Scanner | Camera,
        frame: int,
        *,
        backend: str,
        scene: int = 0,
        traffic: bool = True,
        settings: WorldSettings = WHOLE,
    ) -> World:
        """The world during a frame, as far as rays of the bench's frames reach."""
        actors = self.plan.actors if traffic else None
        key = scene, backend, actors is not None, settings
        if key not in self._worlds:
            self._worlds[key] = World.load(
                self.scenes[scene],
                region=self._region(),
                margin=self.plan.max_range,
                actors=() if actors is None else actor_shapes(actors),
                settings=settings,
                backend=backend,
            )
        world = self._worlds[key]
        if actors is not None:
            start = sensor.frame_start_ns(frame)
            x0, y0, x1, y1 = self._region()
            reach = self.plan.max_range
            shape, transform, feature = actor_transforms(
                actors,
                start,
                end_ns=start + sensor.period_ns,
                region=(x0 - reach, y0 - reach, x1 + reach, y1 + reach),
            )
            world.place_actors(shape, transform, feature=feature)
        return world

    def shot(self, camera: Camera, frame: int) -> Shot:
        """A frame of a camera, to be rendered."""
        start, signals = camera.frame_start_ns(frame), self.plan.signals
        lamps = None if signals is None else lamps_at(signals, start)
        return Shot(camera, frame, self.plan.trajectory, self.sun(start), lamps)

    def sun(self, time_ns: int) -> Float:
        """Direction (3,) towards the sun at a time of the drive."""
        plan = self.plan
        x, y = plan.trajectory.position[0, :2].tolist()
        when = plan.start + timedelta(microseconds=time_ns // 1000)
        return sun_direction(plan.scene.frame, when, at=(x, y))

    def _region(self) -> Region:
        """Bounding box of the vehicle's positions during the frames, scene metres."""
        sensors = {sensor.name: sensor for sensor in self.plan.sensors}
        spans = []
        for name, frames in self.frames.items():
            for frame in frames:
                start = sensors[name].frame_start_ns(frame)
                spans.append(np.linspace(start, start + sensors[name].period_ns, 5).astype(np.int64))
        xy = self.plan.trajectory.at(np.concatenate(spans)).position[:, :2]
        return (float(xy[:, 0].min()), float(xy[:, 1].min()), float(xy[:, 0].max()), float(xy[:, 1].max()))


def bench_of(plan: DrivePlan, others: Sequence[Scene] = (), *, frames: int) -> Bench:
    """Some frames of each sensor, spread over a drive, in its scene and others."""
    return Bench(
        plan,
        (plan.scene, *others),
        {s.name: spread_frames(plan.frames[s.name], frames) for s in plan.sensors},
    )


def spread_frames(count: int, frames: int) -> tuple[int, ...]:
    """Numbers of at most ``frames`` of ``count`` frames, spread evenly, the first and last half steps in."""
    n = min(count, frames)
    return tuple(int((k + 0.5) * count / n) for k in range(n))


def chosen_pulses(count: int, pulses: int, *, frame: int, seed: int) -> NDArray[np.int64]:
    """Rows of at most ``pulses`` of the ``count`` pulses of a frame, at random, ascending."""
    rng = np.random.default_rng([seed, frame])
    return np.sort(rng.permutation(count)[:pulses]).astype(np.int64)


def swept(
    plan: DrivePlan,
    scanner: Scanner,
    *,
    frame: int,
    world: World,
    settings: ScannerSettings,
    pulses: NDArray[np.int64] | None = None,
    threads: int = 1,
) -> tuple[Sweep, DetectedEchoes]:
    """Pulses of a frame and the echoes that the scanner detects."""
    sweep = cast(
        scanner.sensor,
        scanner.spec.mount,
        trajectory=plan.trajectory,
        world=world,
        frame=frame,
        seed=plan.options.seed,
        settings=settings,
        pulses=pulses,
        threads=threads,
    )
    return sweep, detect(sweep, sweep.echoes, deviates=deviates_of(sweep))


def returns_of(
    plan: DrivePlan,
    scanner: Scanner,
    *,
    frame: int,
    world: World,
    settings: ScannerSettings,
    pulses: NDArray[np.int64],
    threads: int = 1,
) -> PulseReturns:
    """Returns of some pulses of a frame, placed in the scene in float64."""
    sweep, found = swept(
        plan, scanner, frame=frame, world=world, settings=settings, pulses=pulses, threads=threads
    )
    fired, rows = sweep.firings, found.echoes.pulse
    away = found.range - scanner.sensor.pattern.range_offset
    xyz = fired.origin[rows] + away[:, None] * fired.direction[rows]
    mount = scanner.spec.mount
    placed = plan.trajectory.place(
        xyz, fired.time_ns[rows], translation=mount.translation, rotation=mount.rotation
    )
    first = np.searchsorted(rows, rows)  # rows are sorted by pulse and range
    key = 256 * pulses[rows] + np.arange(len(rows)) - first
    return PulseReturns(key, found.range, found.echoes.klass, placed)
