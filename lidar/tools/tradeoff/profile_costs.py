"""CPU time of the settings of a profile."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from geoscene.support.progress import Progress
from geoscene.typing import Float
from lidar.sensors.camera.settings import CameraSettings
from lidar.sensors.physics.settings import ScannerSettings
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import firings
from lidar.simulation.plan import DrivePlan
from lidar.simulation.record import record_frame
from lidar.tools.tradeoff.errors import ErrorEstimate, median
from lidar.tools.tradeoff.images import strip
from lidar.tools.tradeoff.simulate import bench_of, spread_frames, swept
from lidar.world.thread_worlds import Worlds
from lidar.world.world import World

_TIMINGS = 3
"""Frames of each sensor that are timed."""

_BLOCKS, _BLOCK_PULSES = 8, 4000
"""Runs of pulses of a frame that are timed with several rays, and their total, or a 16th of the frame."""

_ROWS = 4
"""Rows of an image that are timed with several rays per pixel."""


def costs(
    plans: Sequence[DrivePlan],
    *,
    scanner: Sequence[ScannerSettings],
    camera: Sequence[CameraSettings],
    progress: Progress,
) -> tuple[list[ErrorEstimate], list[ErrorEstimate], ErrorEstimate]:
    """CPU seconds per simulated second of all scanners and of all cameras, and those to load the tiles.

    scanner, camera : settings, the cheapest first

    Frames of all sensors are recorded with the first settings, which are the plans', files and all, each once
    to warm up; what others add is timed on runs of pulses and on rows. Each repetition is of another frame,
    or of another drive.
    """
    spent: tuple[list[Float], list[Float]] = [], []
    loads: list[float] = []
    total = _TIMINGS * len(plans[0].sensors)
    with tempfile.TemporaryDirectory() as folder:
        for k in range(_TIMINGS):
            plan = plans[k % len(plans)]
            now = np.zeros(len(scanner)), np.zeros(len(camera))
            load = 0.0
            for row, sensor in enumerate(plan.sensors):
                progress("measuring costs", k * len(plan.sensors) + row, total=total)
                frames = spread_frames(plan.frames[sensor.name], _TIMINGS)
                if frames:
                    timing = _Timing(plan, sensor, frame=frames[k % len(frames)], out=Path(folder))
                    seconds = timing.more(scanner if isinstance(sensor, Scanner) else camera)
                    now[isinstance(sensor, Camera)][:] += timing.first + seconds
                    load = max(load, timing.load)
            for of, seconds in zip(spent, now, strict=True):
                of.append(seconds)
            loads.append(load)
    progress("measuring costs", total, total=total)
    scanners, cameras = ([median(column, seed=0) for column in np.array(of).T.tolist()] for of in spent)
    return scanners, cameras, median(loads, seed=0)


class _Timing:
    """CPU times of a frame of a sensor, the frame being written to a folder.

    load  : to load the world around the frame
    first : per simulated second, with the plan's settings
    """

    def __init__(self, plan: DrivePlan, sensor: Scanner | Camera, *, frame: int, out: Path) -> None:
        recording = plan.recording(out)
        self._plan, self._sensor, self._frame = plan, sensor, frame
        self._worlds = Worlds(
            plan.scene, plan.max_range, actors=plan.actors, settings=plan.options.recording_settings.world
        )
        start = self._start = sensor.frame_start_ns(frame)
        xy = plan.trajectory.at(np.array([start, start + sensor.period_ns])).position[:, :2]
        (x0, y0), (x1, y1) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
        began = time.process_time()
        self._worlds.follow((x0, y0, x1, y1))
        self._world()
        self.load = time.process_time() - began
        record_frame(recording, sensor, frame=frame, worlds=self._worlds)
        began = time.process_time()
        record_frame(recording, sensor, frame=frame, worlds=self._worlds)
        self.first = self._per_second(time.process_time() - began)

    def more(self, settings: Sequence[ScannerSettings] | Sequence[CameraSettings]) -> Float:
        """What further settings take per simulated second beyond the first, which are the plan's."""
        if isinstance(self._sensor, Scanner):
            spent, share = self._casts(self._sensor, cast("Sequence[ScannerSettings]", settings))
        else:
            spent, share = self._strips(self._sensor, cast("Sequence[CameraSettings]", settings))
        beyond = np.maximum.accumulate(np.array(spent) - spent[0])
        return np.array([self._per_second(s / share) for s in beyond.tolist()])

    def _casts(self, scanner: Scanner, settings: Sequence[ScannerSettings]) -> tuple[list[float], float]:
        """CPU seconds of runs of pulses with each of some settings, and their share of the frame."""
        count, world = len(firings(scanner.sensor, self._frame)), self._world()
        rows = _runs(count, max(_BLOCK_PULSES, count // 16))

        def sweep(one: ScannerSettings, pulses: NDArray[np.int64]) -> None:
            swept(self._plan, scanner, frame=self._frame, world=world, settings=one, pulses=pulses)

        return [
            _measure_time(partial(sweep, one, rows), warm=partial(sweep, one, rows[:64])) for one in settings
        ], len(rows) / count

    def _strips(self, camera: Camera, settings: Sequence[CameraSettings]) -> tuple[list[float], float]:
        """CPU seconds of rows of an image with each of some settings, and their share of the frame."""
        world, height = self._world(), camera.spec.height
        shot = bench_of(self._plan, frames=1).shot(camera, self._frame)
        tops = [int((k + 0.5) * height / _ROWS) for k in range(min(_ROWS, height))]

        def rows(one: CameraSettings, tops: Sequence[int]) -> None:
            for top in tops:
                strip(shot, world=world, settings=one, top=top, height=1)

        return [
            _measure_time(partial(rows, one, tops), warm=partial(rows, one, tops[:1])) for one in settings
        ], len(tops) / height

    def _world(self) -> World:
        if isinstance(self._sensor, Scanner):
            return self._worlds.during(*self._sensor.sensor.window_ns(self._frame))
        return self._worlds.during(self._start, self._start + self._sensor.period_ns)

    def _per_second(self, seconds: float) -> float:
        return seconds * 1e9 / self._sensor.period_ns


def _measure_time(work: Callable[[], None], *, warm: Callable[[], None]) -> float:
    """CPU seconds of some work after a smaller part of it."""
    warm()
    began = time.process_time()
    work()
    return time.process_time() - began


def _runs(count: int, pulses: int) -> NDArray[np.int64]:
    """Rows of about ``pulses`` of the ``count`` pulses of a frame, in `_BLOCKS` runs; all if they are few."""
    if count <= pulses:
        return np.arange(count)
    length = pulses // _BLOCKS
    starts = np.linspace(0, count - length, _BLOCKS).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(length))
