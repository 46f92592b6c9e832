"""The drive: a vehicle follows a route through a scene and its sensors record a dataset."""

from __future__ import annotations

import ctypes
import hashlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba.core.event import Event, Listener, install_listener

from geoscene.errors import GeosceneError
from geoscene.scene import Scene, SceneLike
from geoscene.support.cluster import DaskCluster, connect
from geoscene.support.files import exclusive, json_bytes, write_json
from geoscene.support.option_values import expect
from geoscene.support.progress import Aside, Progress, displayed, shows_progress
from lidar.dataset.checksums import write_checksums
from lidar.dataset.journal import Journal, frame_digest, read_journal
from lidar.dataset.layout import Paths, finished, own_files, prepare, remove_dataset
from lidar.errors import InputError, LidarError
from lidar.geometry.trajectory_files import write_trajectory
from lidar.options.drive import DriveOptions
from lidar.sensors.rig.devices import Scanner
from lidar.signal.situation import Counts
from lidar.simulation.boxes import merge_box_files, merge_signal_files
from lidar.simulation.frame_loop import (
    check_attackers,
    record_frame,
    record_on_cluster,
    recording_chunks,
    run_jobs,
)
from lidar.simulation.metadata import write_metadata
from lidar.simulation.plan import DrivePlan, SensorFrame, plan_drive
from lidar.simulation.recording import MeasuredCloud, MeasuredImages, Recording
from lidar.simulation.scene_source import opened_for
from lidar.world.world import Worlds

Show = Callable[[MeasuredCloud | MeasuredImages], None]
"""Shows a frame that is recorded."""

Live = Callable[[DrivePlan], Show]
"""Begins to show a drive."""


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


@shows_progress
def drive(
    scene: SceneLike,
    out: str | Path,
    *,
    options: DriveOptions,
    overwrite: bool = False,
    progress: Progress = displayed,
    notes: Mapping[str, Any] | None = None,
    check: Callable[[DrivePlan], Mapping[str, Any]] | None = None,
    plan: DrivePlan | None = None,
    live: Live | None = None,
) -> DriveSummary:
    """Drive a route through a scene and write the dataset; an unfinished one of the same options is finished.

    scene : opened, its directory or URL, or a map file, of which the needed part is built
    notes : further entries of ``dataset.json``
    check : called when all frames are recorded; returns entries that replace or join the notes
    plan  : of the same scene and options; made here by default
    live  : called with the plan before the first frame; returns a function that is called with each frame
            once it is recorded, in any order

    Raises InputError (also as RouteError, RigError, DatasetError) for what cannot be driven or written.
    """
    expect(options, DriveOptions, name="options", error=InputError)
    scene = opened_for(scene, options, progress=progress)
    if live is not None and options.scheduler:
        raise InputError("`live` shows frames that this machine records; leave out `scheduler`")
    began, out = time.perf_counter(), Path(out)
    if (
        check is None
        and not overwrite
        and (ended := _finished(scene, out, options=options, progress=progress))
    ):
        return replace(ended, wall=time.perf_counter() - began)
    with (
        install_listener("numba:compile", _CompilationProgress(progress)),
        connect(options.scheduler) if options.scheduler else nullcontext() as cluster,
    ):
        planning_from = time.perf_counter()
        plan = plan or plan_drive(scene, options, progress=progress)
        planning_s = time.perf_counter() - planning_from
        manifest = plan.manifest() | dict(notes or {})
        recording = plan.recording(out)
        check_attackers(plan, recording)
        with exclusive(out), _begun(out, manifest, overwrite=overwrite):
            journal = _verify(recording, plan.jobs, progress=progress)
            _write_plan(plan, recording)
            pending = _pending(plan, journal)
            resumed, before = len(plan.jobs) - len(pending), _points(plan, journal)
            trim_memory()
            recording_from = time.perf_counter()
            record_all(
                plan,
                pending,
                recording=recording,
                cluster=cluster,
                journal=journal,
                progress=progress,
                live=live,
            )
            recording_s = time.perf_counter() - recording_from
            points = _points(plan, journal)
            journal.close()
            if plan.actors is not None:
                merge_box_files(out)
            if plan.signals is not None:
                merge_signal_files(out)
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
        effects=recording.settings.stages.effects(recording.effects.counts),
    )


def _finished(scene: Scene, out: Path, *, options: DriveOptions, progress: Progress) -> DriveSummary | None:
    """The summary of a drive that is finished already, without planning it again; None if it is not."""
    if not Paths(out).manifest.is_file():
        return None
    with exclusive(out):
        dataset = finished(out, options.recipe(scene), progress=progress)
    if dataset is None:
        return None
    manifest = dataset.manifest
    return DriveSummary(
        out,
        int(manifest["frames"]),
        sum(manifest["sensor_frames"].values()),
        manifest["points"],
        written=0,
        duration=manifest["duration_ns"] / 1e9,
        length=float(manifest["length_m"]),
        wall=0.0,
        planning=0.0,
        recording=0.0,
        stages={},
    )


class _CompilationProgress(Listener):
    """Reports the compilation of kernels, which takes seconds when a drive first needs them."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._compiled = progress, 0

    def on_start(self, event: Event) -> None:  # noqa: ARG002
        """A function begins to compile."""
        self._progress(Aside("compiling, once"), self._compiled, total=0)

    def on_end(self, event: Event) -> None:  # noqa: ARG002
        """Count a compiled function."""
        self._compiled += 1


def _finish(
    recording: Recording, jobs: Sequence[SensorFrame], *, manifest: dict[str, Any], journal: Journal
) -> None:
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


def trim_memory() -> None:
    """Give freed memory back to the system where the C library keeps it (glibc does, between used blocks)."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:  # musl has none
            trim(0)


def _write_plan(plan: DrivePlan, recording: Recording) -> None:
    """Write all files of the dataset that do not depend on recorded frames."""
    paths = Paths(recording.out)
    write_trajectory(paths.trajectory, plan.trajectory)
    write_metadata(
        recording.out,
        plan.scene,
        rig=plan.rig,
        sensors=plan.sensors,
        trajectory=plan.trajectory,
        start=plan.start,
        frames=plan.frames,
        settings=plan.options.recording_settings,
        effects=recording.effects,
    )


def _verify(recording: Recording, jobs: Sequence[SensorFrame], *, progress: Progress) -> Journal:
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


def _pending(plan: DrivePlan, journal: Journal) -> list[SensorFrame]:
    finished = {name: np.zeros(count, bool) for name, count in plan.frames.items()}
    for name, done in finished.items():
        done[journal.entries.of(name).frame] = True
    return [job for job in plan.jobs if not finished[job.sensor.name][job.frame]]


def _points(plan: DrivePlan, journal: Journal) -> dict[str, int]:
    """Points of the finished frames, by scanner."""
    names = [s.name for s in plan.sensors if isinstance(s, Scanner)]
    return {name: int(journal.entries.of(name).points.sum()) for name in names}


@contextmanager
def _begun(out: Path, manifest: Mapping[str, Any], *, overwrite: bool) -> Iterator[None]:
    """Begin or resume a dataset.

    A new one is removed if an error of the block ends the drive before any frame is recorded.
    """
    prepare(out, manifest["recipe"], overwrite=overwrite)
    new = not Paths(out).manifest.exists()
    if new:  # the first file: it marks a folder whose drive can be resumed
        write_json(Paths(out).manifest, dict(manifest) | {"frames_done": 0})
    try:
        yield
    except (GeosceneError, LidarError):
        if new and not any(out.glob("*/*/*")):
            remove_dataset(out)
            with suppress(OSError):  # files of others are in it
                out.rmdir()
        raise


def record_all(
    plan: DrivePlan,
    jobs: Sequence[SensorFrame],
    *,
    recording: Recording,
    cluster: DaskCluster | None,
    journal: Journal,
    progress: Progress,
    live: Live | None,
) -> None:
    """Record frames by threads or on a cluster, and add them to the journal."""
    if cluster is not None:
        chunks = recording_chunks(jobs, recording)
        record_on_cluster(
            plan, recording=recording, chunks=chunks, cluster=cluster, journal=journal, progress=progress
        )
        return
    progress("driving", 0, total=len(jobs))
    shown = None if live is None else live(plan)
    task = partial(_record, recording=recording, journal=journal, keep=shown is not None)
    recorded = run_jobs(task, jobs, recording=recording, scene=plan.scene, workers=plan.options.workers)
    for done, measured in enumerate(recorded, 1):
        if shown is not None and measured is not None:
            shown(measured)
        progress("driving", done, total=len(jobs))


def _record(
    job: SensorFrame, worlds: Worlds, *, recording: Recording, journal: Journal, keep: bool
) -> MeasuredCloud | MeasuredImages | None:
    """Record one frame and add it to the journal; return it if it is to be kept."""
    measured = record_frame(recording, job.sensor, frame=job.frame, worlds=worlds)
    with recording.watch.stage("digest"):
        digests = recording.digests(job.sensor, job.frame)
    journal.add(job.sensor.name, job.frame, points=measured.points, digests=digests)
    return measured if keep else None
