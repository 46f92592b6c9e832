"""Frames of a planned drive, some of their pulses or pixels, simulated with other settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta

import numpy as np
from numpy.typing import NDArray

from geoscene.scene import Scene
from geoscene.support.columns import Columns
from geoscene.typing import Float, Ints
from lidar.geometry.poses import Trajectory
from lidar.sensors.camera.light import Lamps, sun_direction
from lidar.sensors.camera.render import CameraImage, render
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.laser.scan import DetectedEchoes, Sweep, cast, detect, deviates_of
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.camera_model import exposure_times
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.specs import CameraSpec
from lidar.simulation.plan import DrivePlan
from lidar.simulation.record_images import lamps_at
from lidar.tools.tradeoff.errors import ImageError, PulseReturns
from lidar.world.actors import actor_shapes, actor_transforms
from lidar.world.settings import PLAIN as WHOLE
from lidar.world.settings import WorldSettings
from lidar.world.world import Region, World

EXACT, FAST = "float64", "auto"
"""Backends of the reference and of drives."""

BLOCK = 4
"""Pixels along each side of the blocks that are compared: one of the lowest resolution."""

_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Steps along columns and rows of the R2 sequence of low discrepancy: powers of the plastic number."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame of a camera.

    sun   : (3,) direction towards the sun, scene axes
    lamps : signal heads that are lit
    """

    camera: Camera
    frame: int
    trajectory: Trajectory
    sun: Float
    lamps: Lamps | None = None


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
        plan, start = self.plan, camera.frame_start_ns(frame)
        x, y = plan.trajectory.position[0, :2].tolist()
        when = plan.start + timedelta(microseconds=start // 1000)
        sun = sun_direction(plan.scene.frame, when, at=(x, y))
        lamps = None if plan.signals is None else lamps_at(plan.signals, start)
        return Shot(camera, frame, plan.trajectory, sun, lamps)

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


@dataclass(frozen=True, slots=True)
class Pixels(Columns):
    """Blocks of a frame: rgb (n, b, b, 3) uint8, depth (n, b, b) metres, klass (n, b, b) uint8."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    klass: NDArray[np.uint8]

    def equals(self, other: Pixels) -> bool:
        """Whether all pixels are the same."""
        pairs = zip(self.columns().values(), other.columns().values(), strict=True)
        return all(np.array_equal(one, another) for one, another in pairs)

    def enlarged(self, factor: int) -> Pixels:
        """Each pixel repeated ``factor`` times along both sides."""
        columns = self.columns().items()
        return Pixels(**{name: c.repeat(factor, axis=1).repeat(factor, axis=2) for name, c in columns})


def coarse(camera: CameraSpec, resolution: int) -> CameraSpec:
    """The same camera with one pixel for each square of ``resolution`` pixels' side."""
    return replace(
        camera,
        width=camera.width // resolution,
        height=camera.height // resolution,
        fx=camera.fx / resolution,
        fy=camera.fy / resolution,
        cx=(camera.cx + 0.5) / resolution - 0.5,
        cy=(camera.cy + 0.5) / resolution - 0.5,
        row_ns=camera.row_ns * resolution,
    )


def image(shot: Shot, *, world: World, settings: CameraSettings, resolution: int = 1) -> CameraImage:
    """The whole frame."""
    return _render(shot, coarse(shot.camera.spec, resolution), world=world, settings=settings)


def blocks_of_frame(camera: CameraSpec, count: int, *, frame: int, seed: int) -> Ints:
    """Columns and rows (n, 2) of the top left pixels of at most ``count`` blocks, spread evenly over a frame.

    No square twice as wide as their mean distance is without one: rare effects are met in their share.
    """
    across, down = camera.width // BLOCK, camera.height // BLOCK
    row, column = np.divmod(np.arange(across * down), across)
    start = np.random.default_rng([seed, frame]).random()
    order = np.argsort((start + column * _STEPS[0] + row * _STEPS[1]) % 1.0, kind="stable")
    chosen = np.sort(order[:count])
    return (BLOCK * np.column_stack([column[chosen], row[chosen]])).astype(np.int64)


def pixels(
    shot: Shot, blocks: Ints, *, world: World, settings: CameraSettings, resolution: int = 1
) -> Pixels:
    """Blocks of a frame, of its coarse camera: ``BLOCK / resolution`` pixels wide."""
    spec, size = coarse(shot.camera.spec, resolution), BLOCK // resolution
    # Whether a pixel is at an edge depends on its neighbours.
    beside = int(settings.edge_rays > settings.supersample)
    rgb, depth, klass = [], [], []
    for left, top in (blocks // resolution).tolist():
        x, y = max(left - beside, 0), max(top - beside, 0)
        width = min(left + size + beside, spec.width) - x
        height = min(top + size + beside, spec.height) - y
        window = replace(spec, width=width, height=height, cx=spec.cx - x, cy=spec.cy - y)
        frame = _render(shot, window, world=world, settings=settings, top=y)
        own = np.s_[top - y : top - y + size, left - x : left - x + size]
        rgb.append(np.zeros((size, size, 3), np.uint8) if frame.rgb is None else frame.rgb[own])
        depth.append(frame.depth[own])
        klass.append(frame.klass[own])
    return Pixels(np.stack(rgb), np.stack(depth), np.stack(klass))


def _render(
    shot: Shot, spec: CameraSpec, *, world: World, settings: CameraSettings, top: int = 0
) -> CameraImage:
    """A frame of a camera, or of the part of it that begins at its row ``top``."""
    start = shot.camera.frame_start_ns(shot.frame)
    times = exposure_times(spec, start + top * spec.row_ns, samples=settings.moments(spec))
    mount = spec.mount
    return render(
        spec,
        shot.trajectory.at(times).mounted(mount.translation, mount.rotation),
        world=world,
        sun=shot.sun,
        lamps=shot.lamps,
        times=np.clip((times - start) / shot.camera.period_ns, 0.0, 1.0),
        settings=settings,
    )


def image_error(found: Pixels, exact: Pixels) -> ImageError:
    """Differences between the same pixels."""
    levels = np.abs(found.rgb.astype(np.int16) - exact.rgb.astype(np.int16)).ravel()
    here, there = np.isfinite(found.depth), np.isfinite(exact.depth)
    both = here & there
    depth = found.depth[both].astype(np.float64) - exact.depth[both]
    return ImageError(
        np.bincount(levels, minlength=256),
        np.abs(depth),
        missing=int(np.count_nonzero(here != there)),
        changed=int(np.count_nonzero(found.klass != exact.klass)),
        pixels=both.size,
    )
