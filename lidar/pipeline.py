"""The drive: a vehicle follows a route through a scene and its sensors record a dataset."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.event import Event, Listener, install_listener

from geoscene.cluster import Cluster, connected
from geoscene.errors import GeosceneError
from geoscene.files import exclusive, json_bytes, write_json
from geoscene.progress import Progress, silent
from geoscene.scene import Scene
from geoscene.typing import Float
from lidar.attacks.sight import Seen, check_sight, sent_only
from lidar.cluster import record_on_cluster
from lidar.dataset.boxes import merge_box_files
from lidar.dataset.checksums import write_checksums
from lidar.dataset.journal import Journal, frame_digest, read_journal
from lidar.dataset.layout import Paths, own_files, prepare
from lidar.dataset.metadata import write_metadata
from lidar.dataset.record import record_frame
from lidar.dataset.recording import Recording
from lidar.dataset.situations import situation_of
from lidar.errors import LidarError
from lidar.geometry.poses import Trajectory
from lidar.geometry.trajectory_csv import write_trajectory
from lidar.options import DriveOptions
from lidar.plan import DrivePlan, Job, Jobs, plan_drive
from lidar.rig.devices import Scanner
from lidar.signal.effects import Counts
from lidar.signal.situation import Situation
from lidar.world.thread_worlds import Worlds
from lidar.world.world import Region

CHUNK = 200.0
"""Scene metres along each axis that the vehicle may cover before other tiles are loaded."""

_FORGET_NS = 60 * 10**9
"""Nanoseconds of a drive after which the memory of long motion is let go."""


@dataclass(frozen=True, slots=True)
class DriveSummary:
    """Figures of a finished drive.

    path      : the dataset
    frames    : frames of the first sensor
    resumed   : frames of all sensors that an earlier, unfinished run had written
    points    : returns of each scanner, by all runs
    written   : returns written by this run
    duration  : seconds of simulated time
    length    : true metres driven
    wall      : seconds of this run
    planning  : seconds of it in which the drive was planned
    recording : seconds of it in which frames were recorded
    stages    : seconds of all threads by stage
    effects   : what weather, attacks and other stages did in the frames of this run
    """

    path: Path
    frames: int
    resumed: int
    points: dict[str, int]
    written: int
    duration: float
    length: float
    wall: float
    planning: float
    recording: float
    stages: dict[str, float]
    effects: Counts = field(default_factory=dict)


def drive(
    scene: Scene,
    out: str | Path,
    *,
    options: DriveOptions,
    overwrite: bool = False,
    progress: Progress = silent,
    notes: Mapping[str, Any] | None = None,
    check: Callable[[DrivePlan], Mapping[str, Any]] | None = None,
    plan: DrivePlan | None = None,
) -> DriveSummary:
    """Drive a route through a scene and write the dataset; an unfinished one of the same options is finished.

    notes : further entries of ``dataset.json``
    check : called when all frames are recorded; returns entries that replace or join the notes
    plan  : of the same scene and options; made here by default

    Raises InputError (also as RouteError, RigError, DatasetError) for what cannot be driven or written.
    """
    began = time.perf_counter()
    with (
        install_listener("numba:compile", _CompilationProgress(progress)),
        connected(options.scheduler) if options.scheduler else nullcontext() as cluster,
    ):
        return _driven(
            scene,
            Path(out),
            options=options,
            overwrite=overwrite,
            cluster=cluster,
            progress=progress,
            notes=notes or {},
            check=check,
            plan=plan,
            began=began,
        )


class _CompilationProgress(Listener):
    """Reports the compilation of kernels, which takes seconds when a drive first needs them."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._compiled = progress, 0

    def on_start(self, event: Event) -> None:  # noqa: ARG002
        """A function begins to compile."""
        self._progress("compiling, once", self._compiled, total=0)

    def on_end(self, event: Event) -> None:  # noqa: ARG002
        """A function is compiled."""
        self._compiled += 1


def _driven(
    scene: Scene,
    out: Path,
    *,
    options: DriveOptions,
    overwrite: bool,
    cluster: Cluster | None,
    progress: Progress,
    notes: Mapping[str, Any],
    check: Callable[[DrivePlan], Mapping[str, Any]] | None,
    plan: DrivePlan | None,
    began: float,
) -> DriveSummary:
    """Plan and record; ``began`` is the time of the start, seconds."""
    planning_from = time.perf_counter()
    plan = plan or plan_drive(scene, options, progress=progress)
    planning_s = time.perf_counter() - planning_from
    manifest = plan.manifest() | dict(notes)
    recording = plan.recording(out)
    check_sight(recording.contents.stages, _scanner_frames(plan, recording))
    prepare(out, manifest["recipe"], overwrite=overwrite)
    with _removed_if_nothing_recorded(out), exclusive(out):
        journal = _verified(recording, plan.jobs, progress=progress)
        _write_plan(plan, recording, manifest=manifest)
        pending = _pending(plan, journal)
        resumed, before = len(plan.jobs) - len(pending), _points(plan, journal)
        trim_memory()
        recording_from = time.perf_counter()
        if cluster is None:
            record_all(
                recording, pending, scene=scene, journal=journal, workers=options.workers, progress=progress
            )
        else:
            record_on_cluster(
                plan,
                recording=recording,
                chunks=recording_chunks(pending, recording),
                cluster=cluster,
                journal=journal,
                progress=progress,
            )
        recording_s = time.perf_counter() - recording_from
        points = _points(plan, journal)
        journal.close()
        if plan.actors is not None:
            merge_box_files(out)
        manifest |= {"points": points, "frames_done": manifest["frames"]}
        checking_from = time.perf_counter()
        if check is not None:
            write_json(Paths(out).manifest, manifest)
            manifest |= check(plan)
        began += time.perf_counter() - checking_from  # what a drive takes is without measuring its errors
        _finish(recording, plan.jobs, manifest=manifest, journal=journal)
        wall = time.perf_counter() - began
    return DriveSummary(
        out,
        int(manifest["frames"]),
        resumed,
        points,
        written=sum(points.values()) - sum(before.values()),
        duration=plan.trajectory.duration_ns / 1e9,
        length=plan.length,
        wall=wall,
        planning=planning_s,
        recording=recording_s,
        stages=recording.watch.seconds,
        effects=recording.contents.stages.effects(recording.effects.counts),
    )


def _finish(recording: Recording, jobs: Sequence[Job], *, manifest: dict[str, Any], journal: Journal) -> None:
    """Write the checksums of all files and then the manifest, which marks a finished drive."""
    path, known = Paths(recording.out).manifest, dict[str, bytes]()
    for job in jobs:
        files = recording.paths(job.sensor, job.frame).values()
        digests = journal.file_digests(job.sensor.name, job.frame, count=len(files))
        names = (file.relative_to(recording.out).as_posix() for file in files)
        if digests:  # none of a frame that was not recorded
            known |= zip(names, digests, strict=True)
    known[path.name] = hashlib.sha256(json_bytes(manifest)).digest()
    with recording.watch.stage("checksums"):
        write_checksums(recording.out, known=known, own=own_files(recording.out))
    write_json(path, manifest)


def _scanner_frames(plan: DrivePlan, recording: Recording) -> Iterator[tuple[Situation, Callable[[], Seen]]]:
    """Where a drive's scanners take their frames, and what they see there; the world is loaded as needed."""
    worlds = Worlds(plan.scene, plan.max_range, actors=recording.actors, settings=recording.contents.world)

    def seen(scanner: Scanner, frame: int, *, region: Region) -> Seen:
        worlds.follow(region)
        world = worlds.during(*scanner.sensor.window_ns(frame))
        return sent_only(scanner.sensor, situation_of(recording, scanner, frame=frame, world=world))

    for chunk, region in chunks(plan.jobs, recording.trajectory):
        for job in chunk:
            if isinstance(job.sensor, Scanner):
                at = situation_of(recording, job.sensor, frame=job.frame)
                yield at, partial(seen, job.sensor, job.frame, region=region)


def trim_memory() -> None:
    """Give freed memory back to the system where the C library keeps it (glibc does, between used blocks)."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:  # musl has none
            trim(0)


def _write_plan(plan: DrivePlan, recording: Recording, *, manifest: dict[str, Any]) -> None:
    """Write all files of the dataset that do not depend on recorded frames."""
    paths = Paths(recording.out)
    if not paths.manifest.exists():
        write_json(paths.manifest, manifest | {"frames_done": 0})
    write_trajectory(paths.trajectory, plan.trajectory)
    write_metadata(
        recording.out,
        plan.scene,
        rig=plan.rig,
        sensors=plan.sensors,
        trajectory=plan.trajectory,
        start=plan.start,
        frames=plan.frames,
        contents=plan.options.contents(),
        effects=recording.effects,
    )


def _verified(recording: Recording, jobs: Sequence[Job], *, progress: Progress) -> Journal:
    """The journal of the dataset, with only those of the frames whose files are as they were written."""
    path = Paths(recording.out).journal
    old, journal = read_journal(path), Journal(path)
    tables = {name: old.of(name) for name in old.sensors}
    for k, job in enumerate(jobs if tables else ()):
        progress("verifying", k, total=len(jobs))
        table = tables.get(job.sensor.name)
        row = -1 if table is None else table.row(job.frame)
        if table is None or row < 0:
            continue
        digests = recording.digests(job.sensor, job.frame)
        if digests and table.digest[row].decode() == frame_digest(digests):
            journal.keep(job.sensor.name, job.frame, points=int(table.points[row]), digests=digests)
    journal.begin()
    return journal


def _pending(plan: DrivePlan, journal: Journal) -> Jobs:
    """The frames that are not finished."""
    finished = {name: np.zeros(count, bool) for name, count in plan.frames.items()}
    for name, done in finished.items():
        done[journal.entries.of(name).frame] = True
    return plan.jobs.where(lambda job: not finished[job.sensor.name][job.frame])


def _points(plan: DrivePlan, journal: Journal) -> dict[str, int]:
    """Points of the finished frames, by scanner."""
    names = [s.name for s in plan.sensors if isinstance(s, Scanner)]
    return {name: int(journal.entries.of(name).points.sum()) for name in names}


@contextmanager
def _removed_if_nothing_recorded(out: Path) -> Iterator[None]:
    """Remove a dataset that was begun here if an error ends the drive before any frame is recorded."""
    begun = not Paths(out).manifest.exists()
    try:
        yield
    except (GeosceneError, LidarError):
        if begun and not any(out.glob("*/*/*")):
            shutil.rmtree(out)
        raise


def record_all(
    recording: Recording,
    jobs: Sequence[Job],
    *,
    scene: Scene,
    journal: Journal,
    workers: int = 1,
    progress: Progress = silent,
) -> None:
    """Record frames and add them to the journal."""
    done = released_ns = 0
    progress("driving", done, total=len(jobs))
    max_range = max((job.sensor.max_range for job in jobs), default=0.0)
    worlds = Worlds(scene, max_range, actors=recording.actors, settings=recording.contents.world)
    workers = min(workers, os.cpu_count() or 1)  # more than cores would only wait for one another
    with _pool(workers) as pool:
        for chunk, region in recording_chunks(jobs, recording):
            with recording.watch.stage("load"):
                recording.release()
                worlds.follow(region)
            running: set[Future[None]] = set()
            for job in chunk:
                running.add(pool.submit(_record, recording, job, worlds=worlds, journal=journal))
                if len(running) >= 2 * workers:
                    done += _take(running, finished=wait(running, return_when=FIRST_COMPLETED).done)
                    progress("driving", done, total=len(jobs))
                if job.start_ns - released_ns > _FORGET_NS:
                    recording.release()
                    released_ns = job.start_ns
            done += _take(running, finished=wait(running).done)
            progress("driving", done, total=len(jobs))


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


def _record(recording: Recording, job: Job, *, worlds: Worlds, journal: Journal) -> None:
    """Record one frame and add it to the journal."""
    points = record_frame(recording, job.sensor, frame=job.frame, worlds=worlds)
    with recording.watch.stage("digest"):
        digests = recording.digests(job.sensor, job.frame)
    journal.add(job.sensor.name, job.frame, points=points, digests=digests)


def _take(running: set[Future[None]], *, finished: set[Future[None]]) -> int:
    """Remove finished frames from ``running``, raising their errors; return how many there were."""
    for future in finished:
        running.remove(future)
        future.result()
    return len(finished)


def recording_chunks(jobs: Sequence[Job], recording: Recording) -> Iterator[tuple[Sequence[Job], Region]]:
    """`chunks` whose boxes also cover the places of earlier frames that stages ask for."""
    back_ns = recording.contents.stages.lookback_ns
    for run, box in chunks(jobs, recording.trajectory):
        yield run, _widened(box, run, trajectory=recording.trajectory, back_ns=back_ns) if back_ns else box


def _widened(box: Region, jobs: Sequence[Job], *, trajectory: Trajectory, back_ns: int) -> Region:
    """A box that also covers where the vehicle was within some time before jobs."""
    until, spans = 0, []
    for job in jobs:  # in order of time
        first = max(job.start_ns - back_ns, until, 0)
        spans.append(np.arange(first, job.start_ns, job.sensor.period_ns // 4))
        until = max(until, job.start_ns)
    places = trajectory.at(np.concatenate(spans)).position[:, :2]
    xy = np.vstack([places, np.reshape(box, (2, 2))])
    return _box(xy.min(axis=0), xy.max(axis=0))


def chunks(jobs: Sequence[Job], trajectory: Trajectory) -> Iterator[tuple[Sequence[Job], Region]]:
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
