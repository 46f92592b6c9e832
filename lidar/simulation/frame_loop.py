"""The loop over the frames of a drive, which are measured in the simulated world and written as files.

Threads take them in order of time, near one another at a time, or workers of a Dask cluster some at a time.
"""

from __future__ import annotations

import os
import pickle
import secrets
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from geoscene.scene import Scene
from geoscene.support.cluster import DaskCluster
from geoscene.support.columns import write_columns
from geoscene.support.files import write_atomically
from geoscene.support.progress import Progress, silent
from geoscene.typing import Float
from lidar.dataset.journal import Journal
from lidar.geometry.poses import Trajectory
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.signal.attacks.attacker import Seen, check_sight, sent_only
from lidar.signal.situation import Counts, Situation
from lidar.signal.truth import write_truth
from lidar.simulation.plan import DrivePlan, SensorFrame
from lidar.simulation.record_clouds import measure_cloud, write_labelled_clouds
from lidar.simulation.recording import MeasuredCloud, MeasuredImages, Recording
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


def record_frame(
    recording: Recording, sensor: Scanner | Camera, *, frame: int, worlds: Worlds
) -> MeasuredCloud | MeasuredImages:
    """Simulate one frame and write its files. Several threads may do so at once."""
    measured = measure_frame(recording, sensor, frame=frame, worlds=worlds)
    paths = recording.paths(sensor, frame)
    if "truth" in paths:
        write_truth(paths["truth"], measured.truth)
    if "boxes" in paths:
        with recording.watch.stage("boxes"):
            write_columns(paths["boxes"], measured.boxes)
    if isinstance(sensor, Scanner):
        assert isinstance(measured, MeasuredCloud)  # noqa: S101
        write_labelled_clouds(recording, sensor, measured=measured, paths=paths)
        return measured
    from lidar.simulation.record_images import write_images  # noqa: PLC0415  (0.1 s)

    assert isinstance(measured, MeasuredImages)  # noqa: S101
    write_images(recording, measured, paths=paths)
    return measured


def measure_frame(
    recording: Recording, sensor: Scanner | Camera, *, frame: int, worlds: Worlds
) -> MeasuredCloud | MeasuredImages:
    """Simulate one frame as `record_frame` does, without files. Several threads may do so at once."""
    if isinstance(sensor, Camera):
        from lidar.simulation.record_images import measure_images  # noqa: PLC0415  (0.1 s)

        return measure_images(recording, sensor, frame=frame, worlds=worlds)
    return measure_cloud(recording, sensor, frame=frame, worlds=worlds)


_FRAMES = 8
"""Frames of a task: few, so that the tasks of a lost worker are soon repeated."""


@dataclass(frozen=True, slots=True)
class _Task:
    """Frames to record.

    plan   : file with the plan of the drive
    out    : dataset
    region : that the vehicle stays in
    frames : rows of the plan's sensors, and frame numbers
    """

    plan: Path
    out: Path
    region: Region
    frames: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class _Done:
    """Result of a task: recorded frames.

    frames  : sensor, frame, points, SHA-256 of the files
    seconds : by stage
    effects : what stages of signals did
    """

    frames: tuple[tuple[str, int, int, bytes], ...]
    seconds: dict[str, float]
    effects: Counts


def record_on_cluster(
    plan: DrivePlan,
    *,
    recording: Recording,
    chunks: Iterable[tuple[Sequence[SensorFrame], Region]],
    cluster: DaskCluster,
    journal: Journal,
    progress: Progress = silent,
) -> None:
    """Record frames and add them to the journal.

    chunks : frames during which the vehicle stays in a region, and the region
    """
    out, scene = recording.out.resolve(), replace(plan.scene, path=plan.scene.path.resolve())
    cluster.check(out, inputs=[] if scene.stored else [scene.files.manifest])  # workers fetch stored ones
    file = out / f"plan-{secrets.token_hex(8)}.part"
    tasks = [
        _Task(file, out, region, tuple((job.order, job.frame) for job in jobs[k : k + _FRAMES]))
        for jobs, region in chunks
        for k in range(0, len(jobs), _FRAMES)
    ]
    done, total = 0, sum(len(task.frames) for task in tasks)
    progress("driving", done, total=total)
    write_atomically(file, pickle.dumps(replace(plan, scene=scene, jobs=())))
    try:
        for result in cluster.run_tasks(_record_task, tasks):
            for sensor, frame, points, digests in result.frames:
                journal.add(sensor, frame, points=points, digests=digests)
            recording.watch.add(result.seconds)
            for stage, counts in result.effects.items():
                recording.effects.add(stage, counts)
            done += len(result.frames)
            progress("driving", done, total=total)
    finally:
        file.unlink(missing_ok=True)
    for left in out.rglob("*.part"):  # of workers that were lost while writing
        left.unlink()


class _Station(threading.local):
    """State that a worker's thread keeps between frames of a drive."""

    plan = Path()
    recording: Recording
    sensors: tuple[Scanner | Camera, ...]
    worlds: Worlds


_station = _Station()


def _record_task(task: _Task) -> _Done:
    """Record the frames of a task; run by workers."""
    if _station.plan != task.plan:
        plan: DrivePlan = pickle.loads(task.plan.read_bytes())  # noqa: S301 - of the program that gave the task
        _station.recording = plan.recording(task.out)
        _station.sensors = plan.sensors
        _station.worlds = Worlds(
            plan.scene, plan.max_range, actors=plan.actors, settings=_station.recording.settings.world
        )
        _station.plan = task.plan
    recording, worlds = _station.recording, _station.worlds
    recording.watch.seconds.clear()
    recording.effects.counts.clear()
    with recording.watch.stage("load"):
        worlds.follow(task.region)
    frames = []
    for row, frame in task.frames:
        sensor = _station.sensors[row]
        points = record_frame(recording, sensor, frame=frame, worlds=worlds).points
        with recording.watch.stage("digest"):
            frames.append((sensor.name, frame, points, recording.digests(sensor, frame)))
    return _Done(tuple(frames), dict(recording.watch.seconds), dict(recording.effects.counts))
