"""The loop over the frames of a drive: threads take them in order of time, near one another at a time."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

import numpy as np

from geoscene.scene import Scene
from geoscene.typing import Float
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.devices import Scanner
from lidar.signal.attacks.attacker import Seen, check_sight, sent_only
from lidar.signal.situation import Situation
from lidar.simulation.plan import DrivePlan, SensorFrame
from lidar.simulation.recording import Recording
from lidar.simulation.situations import situation_of
from lidar.world.world import Region, Worlds

T = TypeVar("T")

CHUNK = 200.0
"""Scene metres along each axis that the vehicle may cover before other tiles are loaded."""


def run_jobs(
    task: Callable[[SensorFrame, Worlds], T],
    jobs: Sequence[SensorFrame],
    *,
    recording: Recording,
    scene: Scene,
    workers: int = 1,
    in_order: bool = False,
) -> Iterator[T]:
    """The results of a task for each frame, as they are finished or in the order of the frames.

    At most twice as many frames as workers are begun and not yet taken. Leaving the loop ends the threads.
    """
    max_range = max((job.sensor.max_range for job in jobs), default=0.0)
    worlds = Worlds(scene, max_range, actors=recording.actors, settings=recording.settings.world)
    workers = min(workers, os.cpu_count() or 1)  # more than cores would only wait for one another
    with _pool(workers) as pool:
        for chunk, region in recording_chunks(jobs, recording):
            with recording.watch.stage("load"):
                worlds.follow(region)
            running: deque[Future[T]] = deque()
            for job in chunk:
                running.append(pool.submit(task, job, worlds))
                if len(running) >= 2 * workers:
                    yield from _finish(running, in_order=in_order)
            while running:
                yield running.popleft().result()


def _finish(running: deque[Future[T]], *, in_order: bool) -> Iterator[T]:
    """Wait for a task, the first in order or any, and take the results that are there."""
    if in_order:
        yield running.popleft().result()
        return
    done = wait(running, return_when=FIRST_COMPLETED).done
    for future in done:
        running.remove(future)
        yield future.result()


@contextmanager
def _pool(workers: int) -> Iterator[ThreadPoolExecutor]:
    """Threads; an error drops waiting tasks, and an interruption does not wait for running ones either."""
    pool = ThreadPoolExecutor(workers)
    try:
        yield pool
    except BaseException as error:
        pool.shutdown(wait=isinstance(error, Exception), cancel_futures=True)
        raise
    pool.shutdown()


def check_attackers(plan: DrivePlan, recording: Recording) -> None:
    """Raise InputError for an attacker's device that no scanner of a drive ever has in sight."""
    check_sight(recording.settings.stages, _scanner_frames(plan, recording))


def _scanner_frames(plan: DrivePlan, recording: Recording) -> Iterator[tuple[Situation, Callable[[], Seen]]]:
    """Yield each scanner frame's context, and a function that tests lines of sight in its world."""
    worlds = Worlds(plan.scene, plan.max_range, actors=recording.actors, settings=recording.settings.world)

    def seen(scanner: Scanner, frame: int, *, region: Region) -> Seen:
        worlds.follow(region)
        world = worlds.during(*scanner.sensor.window_ns(frame))
        return sent_only(scanner.sensor, situation_of(recording, scanner, frame=frame, world=world))

    for chunk, region in chunks(plan.jobs, recording.trajectory):
        for job in chunk:
            if isinstance(job.sensor, Scanner):
                at = situation_of(recording, job.sensor, frame=job.frame)
                yield at, partial(seen, job.sensor, job.frame, region=region)


def recording_chunks(
    jobs: Sequence[SensorFrame], recording: Recording
) -> Iterator[tuple[Sequence[SensorFrame], Region]]:
    """`chunks` whose boxes also cover the places of earlier frames that stages ask for."""
    back_ns = recording.settings.stages.lookback_ns
    for run, box in chunks(jobs, recording.trajectory):
        yield run, _widen(box, run, trajectory=recording.trajectory, back_ns=back_ns) if back_ns else box


def _widen(box: Region, jobs: Sequence[SensorFrame], *, trajectory: Trajectory, back_ns: int) -> Region:
    """A box that also covers where the vehicle was within some time before jobs."""
    until, spans = 0, []
    for job in jobs:  # in order of time
        first = max(job.start_ns - back_ns, until, 0)
        spans.append(np.arange(first, job.start_ns, job.sensor.period_ns // 4))
        until = max(until, job.start_ns)
    places = trajectory.at(np.concatenate(spans)).position[:, :2]
    xy = np.vstack([places, np.reshape(box, (2, 2))])
    return _box(xy.min(axis=0), xy.max(axis=0))


def chunks(
    jobs: Sequence[SensorFrame], trajectory: Trajectory
) -> Iterator[tuple[Sequence[SensorFrame], Region]]:
    """Runs of jobs during which the vehicle stays within a square of `CHUNK`, with the box it covers."""
    first = 0
    low = high = np.zeros(2)
    for row, job in enumerate(jobs):
        span = np.linspace(job.start_ns, job.start_ns + job.sensor.period_ns, 5).astype(np.int64)
        xy = trajectory.at(span).position[:, :2]
        new_low, new_high = xy.min(axis=0), xy.max(axis=0)
        if row > first:
            new_low, new_high = np.minimum(low, new_low), np.maximum(high, new_high)
            if (new_high - new_low).max() > CHUNK:
                yield jobs[first:row], _box(low, high)
                first = row
                new_low, new_high = xy.min(axis=0), xy.max(axis=0)
        low, high = new_low, new_high
    if len(jobs):
        yield jobs[first:], _box(low, high)


def _box(low: Float, high: Float) -> Region:
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
