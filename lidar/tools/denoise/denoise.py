"""Removes the returns of rain and snow from recorded clouds, and scores filters where the truth is known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from math import isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.drawing.report import Column, ReportTable, table_of
from geoscene.support.files import write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Float
from lidar.dataset.checksums import write_checksums
from lidar.dataset.derived import (
    check_target,
    complete_folder,
    copy_dataset,
    derived_from,
    write_folder_provenance,
)
from lidar.dataset.foreign import (
    ForeignFolder,
    foreign_labels,
    foreign_truth,
    open_recorded,
    read_foreign_stages,
    write_foreign_stages,
)
from lidar.dataset.formats import Format, read_table
from lidar.dataset.ground_truth import read_truth
from lidar.dataset.layout import Dataset, DatasetLike, Paths, reading_file
from lidar.dataset.recorded import cloud_points
from lidar.errors import DatasetError, InputError
from lidar.sensors.physics.origin import Origin
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.specs import rig_of
from lidar.signal.truth import Altered, cloud_truth, trace_unaltered, write_truth
from lidar.simulation.boxes import merge_box_files
from lidar.tools.denoise.filters import Bools, Filter, read_methods
from lidar.tools.rerecord import recorded_cloud, recording_again, richest_format, write_altered

_BYTES = {"kitti": 16, "nuscenes": 20}
"""Bytes of a return in the files of these formats."""


@dataclass(frozen=True, slots=True)
class FilterTally:
    """Counts of returns by true origin and by the filter's decision.

    frames, returns, removed : numbers
    weather      : returns of the weather; -1 if the truth is unknown
    weather_removed : those of them that are removed
    """

    frames: int = 0
    returns: int = 0
    removed: int = 0
    weather: int = 0
    weather_removed: int = 0

    def with_frame(self, kept: NDArray[np.bool_], weather: NDArray[np.bool_] | None) -> FilterTally:
        """With one more frame; its truth (n,) may be unknown, for then that of all is."""
        frames, returns = self.frames + 1, self.returns + len(kept)
        removed = self.removed + int(np.count_nonzero(~kept))
        if weather is None or self.weather < 0:
            return FilterTally(frames, returns, removed, -1)
        both = self.weather_removed + int(np.count_nonzero(~kept & weather))
        return FilterTally(frames, returns, removed, self.weather + int(np.count_nonzero(weather)), both)

    @property
    def precision(self) -> float:
        """Share of weather among removed returns; nan without any, or without ground truth."""
        return self.weather_removed / self.removed if self.removed and self.weather >= 0 else nan

    @property
    def recall(self) -> float:
        """Share of the weather that is removed; nan without weather or truth."""
        return self.weather_removed / self.weather if self.weather > 0 else nan

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.weather_removed / (self.removed + self.weather) if self.weather > 0 else nan

    @property
    def lost(self) -> float:
        """Share of the other returns that is removed too; nan if the truth is unknown."""
        others = self.returns - self.weather
        return (self.removed - self.weather_removed) / others if others and self.weather >= 0 else nan

    def to_json(self) -> dict[str, Any]:
        """Numbers and scores; unknown ones are null."""
        scores = {name: getattr(self, name) for name in ("precision", "recall", "f1", "lost")}
        counts = {"frames": self.frames, "returns": self.returns, "removed": self.removed}
        if self.weather >= 0:
            counts |= {"weather": self.weather, "weather_removed": self.weather_removed}
        return counts | {name: None if isnan(x) else round(x, 6) for name, x in scores.items()}


@dataclass(frozen=True, slots=True)
class Denoised:
    """Scores of filters.

    scores : by the filter's text and the scanner's name, ``all`` for all of them
    """

    path: Path
    out: Path | None
    scores: dict[str, dict[str, FilterTally]]

    def to_json(self) -> dict[str, Any]:
        """All scores."""
        rows = {
            text: {name: tally.to_json() for name, tally in of.items()} for text, of in self.scores.items()
        }
        return {"dataset": str(self.path), "out": self.out and str(self.out), "methods": rows}

    def table(self) -> ReportTable:
        """The scores; those of all scanners are left out where there is one."""
        rows = [
            (method, scanner, tally)
            for method, of in self.scores.items()
            for scanner, tally in of.items()
            if scanner != "all" or len(of) > 2
        ]
        return table_of(_COLUMNS, rows)


_COLUMNS: tuple[Column[tuple[str, str, FilterTally]], ...] = (
    Column("method", lambda row: row[0]),
    Column("scanner", lambda row: row[1]),
    Column("frames", lambda row: f"{row[2].frames:,}"),
    Column("returns", lambda row: f"{row[2].returns:,}"),
    Column("removed", lambda row: f"{row[2].removed:,}"),
    Column("weather", lambda row: f"{row[2].weather:,}" if row[2].weather >= 0 else "unknown"),
    Column("precision", lambda row: _fixed(row[2].precision)),
    Column("recall", lambda row: _fixed(row[2].recall)),
    Column("F1", lambda row: _fixed(row[2].f1)),
    Column("surfaces lost", lambda row: "-" if isnan(row[2].lost) else f"{row[2].lost:.2%}"),
)


def _fixed(value: float) -> str:
    return "-" if isnan(value) else f"{value:.3f}"


@shows_progress
def denoise(
    source: DatasetLike,
    methods: Mapping[str, Filter] | str,
    *,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: Progress = displayed,
) -> Denoised:
    """Scores of filters on recorded clouds; with ``out`` the clouds that the only filter leaves.

    A dataset of this program is written whole. Of other folders the point clouds are written, at the same
    relative paths: KITTI's ``*.bin`` in a folder ``velodyne*`` or in ``source`` itself, with SemanticKITTI's
    labels, and nuScenes' ``*.pcd.bin``. Scores are against the truth files of drives and of `tools.apply`;
    filters see positions and intensities alone.

    overwrite : replace an existing directory

    Raises InputError for several filters with ``out``, and DatasetError for data that cannot be read.
    """
    found = open_recorded(source)
    methods = read_methods([methods]) if isinstance(methods, str) else methods
    if out is None:
        return Denoised(found.path, None, _scores(found, methods, out=None, progress=progress))
    out = Path(out)
    check_target(out, source=found.path, overwrite=overwrite)
    if len(methods) > 1:
        raise InputError(f"`out` takes the clouds of one method, not of {len(methods)}")
    with complete_folder(out) as part:
        scores = _scores(found, methods, out=part, progress=progress)
        write_checksums(part)
    return Denoised(found.path, out, scores)


def _scores(
    found: Dataset | ForeignFolder, methods: Mapping[str, Filter], *, out: Path | None, progress: Progress
) -> dict[str, dict[str, FilterTally]]:
    """Scores by filter and scanner; with ``out`` the clouds are written."""
    frames: Iterator[_Frame]
    source = found.path
    if isinstance(found, Dataset):
        found.fetch(progress)
        job = _DatasetJob(found, out)
        count, frames = len(job.jobs), job.frames()
    else:
        job, count = None, len(found.clouds)
        frames = (_ForeignFrame(path, form, source=source, out=out) for path, form in found.clouds)
    scores: dict[str, dict[str, FilterTally]] = {text: {} for text in methods}
    for done, frame in enumerate(frames):
        progress("frames", done, total=count)
        for text, method in methods.items():
            kept = method.kept(frame.xyz, frame.intensity)
            for name in (frame.scanner, "all"):
                tally = scores[text].get(name, FilterTally())
                scores[text][name] = tally.with_frame(kept, frame.weather)
            frame.write(kept)
    progress("frames", count, total=count)
    if out is not None:
        if job is not None:
            job.finish(next(iter(methods)))
        else:
            write_folder_provenance(source, out, by="denoise")
            if acted := read_foreign_stages(source):
                write_foreign_stages(out, acted)
    return scores


class _Frame:
    """The cloud of one frame.

    xyz, intensity : as in `Filter.kept`
    weather        : (n,) which returns are the weather's; None if that is unknown
    """

    def __init__(self, scanner: str, xyz: Float, *, intensity: Float, weather: Bools | None) -> None:
        self.scanner, self.xyz, self.intensity, self.weather = scanner, xyz, intensity, weather

    def write(self, kept: Bools) -> None:
        """Write what a filter keeps, if it is to be written."""


# Datasets of this program.


class _DatasetJob:
    """The clouds of a dataset."""

    def __init__(self, dataset: Dataset, out: Path | None) -> None:
        self.dataset, self.out = dataset, out
        recipe = dataset.manifest["recipe"]
        with reading_file(dataset.paths.manifest):
            rig = rig_of(recipe["rig"])
            self.has_stages = bool({"stages", "applied_stages"} & recipe.keys())
        self.jobs = [(s, k) for s in scanners(rig) for k in range(len(dataset.sample_times(s.name)))]
        if not self.jobs:
            raise InputError(f"{dataset.path}: has no clouds")
        self.recording = recording_again(dataset, out or dataset.path)
        self.form = richest_format(self.recording.settings)
        self.points = dict.fromkeys((s.name for s, _ in self.jobs), 0)

    def frames(self) -> Iterator[_Frame]:
        """The frames in order."""
        if self.out is not None:
            written = {path for job in self.jobs for path in self.recording.paths(*job).values()}
            left_out = written | {Paths(self.out).manifest, Paths(self.out).journal}
            copy_dataset(self.dataset.path, self.out, leave_out=left_out)
        for scanner, number in self.jobs:
            yield _DatasetFrame(self, scanner, number=number)

    def finish(self, method: str) -> None:
        """Write the manifest."""
        assert self.out is not None  # noqa: S101
        if Paths(self.out).boxes.exists():
            merge_box_files(self.out)
        manifest = self.dataset.manifest
        recipe = manifest["recipe"] | {"denoised": method}
        parents = derived_from(self.dataset.path, manifest, by="denoise")
        write_json(Paths(self.out).manifest, manifest | {"recipe": recipe, "points": self.points} | parents)


class _DatasetFrame(_Frame):
    """The cloud of a frame of a dataset."""

    def __init__(self, job: _DatasetJob, scanner: Scanner, *, number: int) -> None:
        self._job, self._device, self._number = job, scanner, number
        path = replace(job.recording, out=job.dataset.path).paths(scanner, number)[job.form.name]
        table = cloud_points(path)
        xyz = np.column_stack([table["x"], table["y"], table["z"]]).astype(np.float64)
        self._truth = read_truth(job.dataset.paths.truth(scanner.name, number), count=len(xyz))
        weather = None if job.has_stages else np.zeros(len(xyz), bool)
        if self._truth is not None:
            weather = self._truth["origin"] == Origin.WEATHER
        super().__init__(scanner.name, xyz, intensity=table["intensity"].astype(np.float64), weather=weather)

    def write(self, kept: Bools) -> None:
        """Write the cloud, its labels, boxes and truth."""
        job, device = self._job, self._device
        if job.out is None:
            return
        cloud = recorded_cloud(job.dataset, job.recording, form=job.form, scanner=device, frame=self._number)
        altered = Altered(trace_unaltered(cloud).cloud.where(kept), cloud)
        truth = self._truth or cloud_truth(trace_unaltered(cloud), start_ns=cloud.start_ns)
        write_altered(
            altered,
            _filtered_truth(truth, kept),
            dataset=job.dataset,
            recording=job.recording,
            form=job.form,
            scanner=device,
            frame=self._number,
        )
        job.points[device.name] += int(np.count_nonzero(kept))


def _filtered_truth(truth: dict[str, NDArray[Any]], kept: Bools) -> dict[str, NDArray[Any]]:
    """The truth of the returns that are kept, and ``filtered``, the rows of the others in the given cloud."""
    found = {name: c[kept] if name in ("origin", "source", "hidden") else c for name, c in truth.items()}
    return found | {"filtered": np.flatnonzero(~kept).astype(np.int32)}


# KITTI and nuScenes.


class _ForeignFrame(_Frame):
    """A cloud of KITTI or nuScenes."""

    def __init__(self, path: Path, form: Format, *, source: Path, out: Path | None) -> None:
        self._path, self._form, self._source, self._out = path, form, source, out
        table = read_table(path, form.name)
        xyz = np.column_stack([table["x"], table["y"], table["z"]]).astype(np.float64)
        self._place = path.relative_to(source)
        self._truth = read_truth(foreign_truth(source, self._place, form=form), count=len(xyz))
        weather = None if self._truth is None else self._truth["origin"] == Origin.WEATHER
        super().__init__(
            path.parent.name, xyz, intensity=table["intensity"].astype(np.float64), weather=weather
        )

    def write(self, kept: Bools) -> None:
        """Write the records that are kept, byte by byte, with labels of SemanticKITTI and the truth."""
        if self._out is None:
            return
        _write_rows(self._path, self._out / self._place, kept=kept, size=_BYTES[self._form.name])
        labels = foreign_labels(self._path)
        if self._form.name == "kitti" and labels.is_file():
            _write_rows(labels, self._out / labels.relative_to(self._source), kept=kept, size=4)
        if self._truth is not None:
            truth = _filtered_truth(self._truth, kept)
            write_truth(foreign_truth(self._out, self._place, form=self._form), truth)


def _write_rows(path: Path, out: Path, *, kept: Bools, size: int) -> None:
    """Write the records of ``size`` bytes of a file that are kept.

    Raises DatasetError for a file with another number of records.
    """
    rows = np.fromfile(path, np.uint8)
    if len(rows) != size * len(kept):
        raise DatasetError(f"{path}: {len(rows) // size} records for {len(kept)} returns")
    out.parent.mkdir(parents=True, exist_ok=True)
    rows.reshape(-1, size)[kept].tofile(out)
