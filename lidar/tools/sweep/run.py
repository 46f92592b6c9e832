"""Runs the drives of a sweep, each in a folder of its own, and writes a table of their states."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from geoscene import __version__
from geoscene.errors import GeosceneError, WorkersLostError
from geoscene.scene import Scene, open_scene
from geoscene.scene.layout import using
from geoscene.support.cluster import DaskCluster, connect
from geoscene.support.columns import write_columns
from geoscene.support.digests import digest, file_digest
from geoscene.support.files import exclusive, write_json
from geoscene.support.processes import run_tasks
from geoscene.support.progress import Progress, displayed, shows_progress, silent
from lidar.dataset.journal import read_journal
from lidar.dataset.layout import Paths, open_dataset
from lidar.errors import InputError, LidarError
from lidar.options.drive import DriveOptions
from lidar.tools.sweep.grid import GridDrive, read_grid
from lidar.tools.tradeoff.accuracy import driven, pick_settings

log = logging.getLogger(__name__)

_TABLE = "sweep.json"
_GENERATOR = f"geoscene lidar {__version__}"
_SECONDS = 2.0
"""Between two updates of the table."""


@dataclass(frozen=True, slots=True)
class DriveRow:
    """One drive in the table of a sweep.

    name    : of its folder
    state   : waiting, done or failed
    error   : why it failed, one line
    frames  : of all sensors
    points  : of all scanners
    seconds : of simulated time
    metres  : driven
    digest  : of the journal, hence of all frames
    files   : digest of all files
    picked  : settings by which the drive reaches its accuracy or keeps its budget, in words
    reached : errors that its spot check found, in words
    """

    name: str
    state: str = "waiting"
    error: str = ""
    frames: int = 0
    points: int = 0
    seconds: float = 0.0
    metres: float = 0.0
    digest: str = ""
    files: str = ""
    picked: str = ""
    reached: str = ""


@dataclass(frozen=True, slots=True)
class SweepSummary:
    """A sweep that has ended.

    path : its folder
    rows : of the drives, in the order of the grid
    """

    path: Path
    rows: tuple[DriveRow, ...]

    @property
    def failed(self) -> list[DriveRow]:
        """The drives that failed."""
        return [row for row in self.rows if row.state == "failed"]


@shows_progress
def sweep(
    file: str | Path,
    out: str | Path,
    *,
    workers: int = 1,
    scheduler: str = "",
    overwrite: bool = False,
    progress: Progress = displayed,
) -> SweepSummary:
    """Record all drives of a grid; finished ones of the same options whose files are unchanged are kept.

    Folder ``out`` gets a dataset for each drive, ``sweep.json`` and ``sweep.csv``. A drive that fails, or
    whose map cannot be built, is a row with the reason, and the others go on. The bytes depend neither on
    ``workers`` nor on ``scheduler``.

    file      : TOML file, see `lidar.tools.sweep.grid.read_grid`
    workers   : processes, each of which records a drive at a time
    scheduler : address of a Dask scheduler, whose workers record the drives instead

    Raises InputError for a file with an error, before the first drive starts.
    """
    return record_drives(
        read_grid(Path(file)),
        Path(out),
        source=Path(file).name,
        workers=workers,
        scheduler=scheduler,
        overwrite=overwrite,
        progress=progress,
    )


def record_drives(
    drives: Sequence[GridDrive],
    folder: Path,
    *,
    source: str,
    workers: int = 1,
    scheduler: str = "",
    overwrite: bool = False,
    progress: Progress = silent,
) -> SweepSummary:
    """Record drives into a folder; see `sweep`.

    source : name of the file that describes them, for the table
    """
    if not 1 <= workers <= 256:
        raise InputError(f"`workers` {workers}: give 1 to 256")
    check_folder(folder, mark=_TABLE, what="sweep")
    with connect(scheduler) if scheduler else nullcontext() as cluster, exclusive(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if cluster is not None:
            inputs = dict.fromkeys(path for planned in drives for path in planned.inputs)
            cluster.check(folder.absolute(), inputs=list(inputs))
        with _table(folder, source, drives=drives) as table:
            scenes = _scenes(drives, folder.absolute(), workers=workers, cluster=cluster, progress=progress)
            threads = 1 if cluster else max(workers // len(drives), 1)
            tasks, place = list[_Task](), folder.absolute()
            for row, planned in enumerate(drives):
                scene = scenes[planned.map.name] if planned.map else planned.scene
                if isinstance(scene, str):
                    table.set(row, DriveRow(planned.name, "failed", scene))
                    continue
                ready = replace(planned, scene=scene, map=None)
                earlier = None if overwrite or table.rows[row].state != "done" else table.rows[row]
                tasks.append(_Task(row, ready, place, threads, overwrite=overwrite, earlier=earlier))
            progress("drives", 0, total=len(tasks))
            for done, (row, result) in enumerate(_results(tasks, workers=workers, cluster=cluster), 1):
                table.set(row, result)
                progress("drives", done, total=len(tasks))
    return SweepSummary(folder, tuple(table.rows))


def check_folder(folder: Path, *, mark: str, what: str) -> None:
    """Raise InputError for a folder that is not empty and lacks the file ``mark`` of such a one."""
    if folder.exists() and not (folder.is_dir() and ((folder / mark).is_file() or not any(folder.iterdir()))):
        raise InputError(f"{folder}: is not empty and no {what}; give another directory")


def _scenes(
    drives: Sequence[GridDrive],
    folder: Path,
    *,
    workers: int,
    cluster: DaskCluster | None,
    progress: Progress,
) -> dict[str, Path | str]:
    """Scenes of maps by name, in folder ``scenes``, each built once, as needed; or why it cannot be built."""
    scenes: dict[str, Path | str] = {}
    for one in {planned.map.name: planned.map for planned in drives if planned.map}.values():
        try:
            scenes[one.name] = one.built(
                folder / "scenes", workers=workers, cluster=cluster, progress=progress
            )
        except Exception as error:  # noqa: BLE001 - one map's defect must not end the others
            scenes[one.name] = f"map {one.name}: {failure_text(f'map {one.name}', error)}"
    return scenes


def failure_text(what: str, error: Exception) -> str:
    """An error in one line; a defect is logged, and its line begins with its class."""
    text = " ".join(str(error).split())
    if isinstance(error, GeosceneError | LidarError | OSError):
        return text
    log.error("%s", what, exc_info=error)
    return f"{type(error).__name__}: {text}"


@dataclass(frozen=True, slots=True)
class _Task:
    """One drive to record.

    row     : in the table
    folder  : of the sweep
    earlier : its row in the table of an earlier run that finished it
    """

    row: int
    drive: GridDrive
    folder: Path
    threads: int
    overwrite: bool
    earlier: DriveRow | None = None


def _results(
    tasks: Sequence[_Task], *, workers: int, cluster: DaskCluster | None
) -> Iterator[tuple[int, DriveRow]]:
    """Rows of the table as the drives end, with their numbers."""
    if cluster is not None:
        yield from cluster.run_tasks(_record_drive, tasks)
        return
    waiting = {task.row: task for task in tasks}
    try:
        for row, result in run_tasks(_record_drive, tasks, workers=workers):
            del waiting[row]
            yield row, result
    except WorkersLostError:
        # One at a time needs the least memory, and shows which drives cannot be recorded.
        for task in waiting.values():
            try:
                yield from run_tasks(_record_drive, [task], workers=1)
            except WorkersLostError as error:
                yield task.row, DriveRow(task.drive.name, "failed", str(error))


def _record_drive(task: _Task) -> tuple[int, DriveRow]:
    """Record a drive; its row of the table. Run by workers."""
    name, out, wanted = task.drive.name, task.folder / task.drive.name, task.drive.wanted
    options = replace(task.drive.options, workers=task.threads)
    try:
        with using(open_scene(task.drive.scene), known=LidarError) as scene:
            if task.earlier is not None and _is_unchanged(task, scene, options=options):
                return task.row, task.earlier
            pick = pick_settings(scene, options, wanted=wanted, out=None if task.overwrite else out)
            checked = driven(scene, out, options=options, wanted=wanted, pick=pick, overwrite=task.overwrite)
    except Exception as error:  # noqa: BLE001 - one drive's defect must not end the others
        return task.row, DriveRow(name, "failed", failure_text(f"drive {name}", error))
    done = checked.summary
    return task.row, DriveRow(
        name,
        "done",
        frames=len(read_journal(Paths(out).journal)),
        points=sum(done.points.values()),
        seconds=done.duration,
        metres=round(done.length, 3),
        digest=file_digest(Paths(out).journal),
        files=_digest_of_folder(out),
        picked=pick.label if pick else "",
        reached=checked.reached.reached.to_text("are") if checked.reached else "",
    )


def _is_unchanged(task: _Task, scene: Scene, *, options: DriveOptions) -> bool:
    """Whether a drive is there as an earlier run finished it, of the same version, scene and options.

    Whether other settings would be picked, or their errors checked again, is not known without a plan.
    """
    out, wanted = task.folder / task.drive.name, task.drive.wanted
    if task.earlier is None or wanted.picks or wanted.checks or not Paths(out).manifest.exists():
        return False
    manifest = open_dataset(out).manifest
    recipe = json.loads(json.dumps(options.recipe(scene)))
    known = {"generator": _GENERATOR, "recipe": recipe}
    return (
        known.items() <= manifest.items()
        and manifest["scene"]["path"] == scene.location
        and _digest_of_folder(out) == task.earlier.files
    )


def _digest_of_folder(folder: Path) -> str:
    """Digest of the names and contents of all files in a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    text = "".join(f"{path.relative_to(folder)} {file_digest(path)}\n" for path in files)
    return digest(text.encode())


class _Table:
    """The files ``sweep.json`` and ``sweep.csv`` of a sweep."""

    def __init__(self, folder: Path, source: str, *, drives: Sequence[GridDrive]) -> None:
        self._folder, self._source, self._drives = folder, source, drives
        earlier = self._finished()
        self.rows = [earlier.get(drive.name, DriveRow(drive.name)) for drive in drives]
        self._written = 0.0

    def _finished(self) -> dict[str, DriveRow]:
        """Rows by name of the drives that an earlier run has finished; none if its table is damaged."""
        names = [field.name for field in fields(DriveRow)]
        with suppress(OSError, ValueError, LookupError, TypeError):
            drives = json.loads((self._folder / _TABLE).read_text("utf-8-sig"))["drives"]
            rows = [DriveRow(*(drive[name] for name in names)) for drive in drives]
            return {row.name: row for row in rows if row.state == "done"}
        return {}

    def set(self, row: int, result: DriveRow) -> None:
        """Set a row; the files follow within seconds, while rows are set."""
        self.rows[row] = result
        if time.monotonic() - self._written > _SECONDS:
            self.write()

    def write(self) -> None:
        """Write the files."""
        documents: list[dict[str, Any]] = [
            {**asdict(row), "options": drive.values}
            for row, drive in zip(self.rows, self._drives, strict=True)
        ]
        write_json(
            self._folder / _TABLE,
            {"schema": 1, "generator": _GENERATOR, "grid": self._source, "drives": documents},
        )
        names = list(dict.fromkeys(name for drive in self._drives for name in drive.values))
        columns = {name: [drive.values.get(name, "") for drive in self._drives] for name in names}
        figures = {name: [row[name] for row in map(asdict, self.rows)] for name in asdict(self.rows[0])}
        clash = {f"option {name}" if name in figures else name: values for name, values in columns.items()}
        write_columns(self._folder / "sweep.csv", {k: np.array(v) for k, v in (figures | clash).items()})
        self._written = time.monotonic()


@contextmanager
def _table(folder: Path, source: str, *, drives: Sequence[GridDrive]) -> Iterator[_Table]:
    """Yield the table of a sweep, written at the start and at the end, however that comes."""
    table = _Table(folder, source, drives=drives)
    table.write()
    try:
        yield table
    finally:
        table.write()
