"""Frames of a drive, recorded by the workers of a Dask cluster."""

from __future__ import annotations

import pickle
import secrets
import threading
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from geoscene.support.cluster import DaskCluster
from geoscene.support.files import write_atomically
from geoscene.support.progress import Progress, silent
from lidar.dataset.journal import Journal
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.signal.situation import Counts
from lidar.simulation.plan import DrivePlan, SensorFrame
from lidar.simulation.record import record_frame
from lidar.world.world import Region, Worlds

if TYPE_CHECKING:
    from lidar.simulation.recording import Recording

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
