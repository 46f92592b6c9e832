"""Recorded drives in the layouts of other datasets, or with their clouds in another point-cloud format."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geoscene.support.console import command_line
from geoscene.support.files import write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.support.registry import unknown_name
from geoscene.typing import Float
from lidar.dataset.checksums import write_checksums
from lidar.dataset.derived import check_target, complete_folder, copy_dataset, derived_from
from lidar.dataset.formats import ALL, FORMATS, Format
from lidar.dataset.formats.table import Table, table_cloud
from lidar.dataset.layout import Dataset, DatasetLike, Paths, open_dataset, reading_file
from lidar.dataset.layouts import EXPORTERS, ExportSummary
from lidar.dataset.recorded import cloud_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.time_scales import drive_ns
from lidar.options.data import CONVERTED_FORMATS
from lidar.parameters import split_items
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.specs import rig_of
from lidar.simulation.record_clouds import sent_pulses, write_clouds
from lidar.simulation.recording import Recording
from lidar.tools.rerecord import recording_again

log = logging.getLogger(__name__)

_CLOCK_NS = 250
"""Nanoseconds within which times of files in the world frame are exact: GPS seconds as float64."""
_RING = 1e9
"""Weight of rings against nanoseconds / `_CLOCK_NS`, more than that of the longest frame."""
_NEAR = 1e-6
"""Metres from a scanner within which a return has no direction."""

_SEQUENCE = ("calib.txt", "times.txt", "poses.txt")


@shows_progress
def convert(
    source: DatasetLike, out: str | Path, *, to: str, overwrite: bool = False, progress: Progress = displayed
) -> ExportSummary:
    """Write a recorded drive to the folder ``out``, which appears when it is complete.

    source : directory or URL of the dataset
    to     : layout of another dataset, a name in `layouts.EXPORTERS`, with its parameters as in
             ``ros2:points=velodyne,imu=truth``; or a point-cloud format, a name in
             `lidar.dataset.formats.FORMATS`, for the dataset with its clouds in this format

    Clouds get the bytes of a drive with that format, as far as the recorded ones keep all digits.

    Raises InputError for another name and for ``out`` that exists without ``overwrite``, and DatasetError for
    a dataset that lacks what the layout or format needs.
    """
    out = Path(out)
    item, *others = split_items(to, [*EXPORTERS, *CONVERTED_FORMATS])
    if others:
        raise InputError(f"`to` {to}: give one layout or format")
    if item.name in EXPORTERS:
        return EXPORTERS[item.name].export(
            open_dataset(source), out, overwrite=overwrite, progress=progress, values=item.values
        )
    if to not in CONVERTED_FORMATS:
        known, removed = [*EXPORTERS, *CONVERTED_FORMATS], {**EXPORTERS.removed, **FORMATS.removed}
        raise InputError(unknown_name("`to`", to, known=known, removed=removed))
    return _with_clouds_as(FORMATS[to], open_dataset(source), out=out, overwrite=overwrite, progress=progress)


def _with_clouds_as(
    form: Format, dataset: Dataset, *, out: Path, overwrite: bool, progress: Progress
) -> ExportSummary:
    """Write a dataset again with its clouds in one format."""
    check_target(out, source=dataset.path, overwrite=overwrite)
    if dataset.manifest["frames_done"] != dataset.frames:
        raise DatasetError(f"{dataset.path}: the drive was not finished; finish it first")
    recording, source = recording_again(dataset, out), _source(dataset, form)
    deskew = recording.settings.deskew if form.frame == "sensor" else ""
    if recording.settings.deskew and not deskew:
        log.warning("de-skewed clouds are left out: %s files hold points in the world frame", form.name)
    settings = replace(recording.settings, formats=(form.name,), deskew=deskew)
    if not source.exact and source.module != form.module:
        log.warning("points have the digits of %s files, not all that a drive would write", source.name)
    with reading_file(dataset.paths.manifest):
        devices = scanners(rig_of(dataset.manifest["recipe"]["rig"]))
    dataset.fetch(progress)
    if not any(True for device in devices for _ in dataset.files(device.name, source)):
        raise DatasetError(f"{dataset.path}: has no {source.name} clouds to convert; drive with a scanner")
    with complete_folder(out) as part:
        writing, count = replace(recording, out=part, settings=settings), 0
        _copy_all_but_clouds(dataset, writing, devices=devices)
        for device in devices:
            frames = [frame for frame, _ in dataset.files(device.name, source)]
            for done, frame in enumerate(frames):
                _convert_cloud(dataset, writing, source=source, scanner=device, frame=frame)
                progress(device.name, done + 1, total=len(frames))
            count += len(frames)
        contents_of = {"formats": [form.name], "deskew": deskew}
        manifest = dataset.manifest | contents_of | {"recipe": dataset.manifest["recipe"] | contents_of}
        parents = derived_from(dataset.path, dataset.manifest, by=f"convert --to {form.name}")
        write_json(Paths(part).manifest, manifest | parents)
        write_checksums(part)
    return ExportSummary(out, {"clouds": count}, f"describe it with {command_line('lidar', 'info', out)}")


def _source(dataset: Dataset, form: Format) -> Format:
    """The format of recorded clouds that keeps most of what a format holds.

    Raises DatasetError if none keeps all of it, and InputError if it is the only one.
    """
    with reading_file(dataset.paths.manifest):
        recorded = [FORMATS[name] for name in dataset.manifest["recipe"]["formats"]]
    if recorded == [form]:
        raise InputError(f"{dataset.path}: its clouds are in {form.name} already")
    found = [f for f in recorded if f.module == form.module]
    found += [f for f in recorded if f.frame == "world" or f.columns == ALL]
    if not found:
        names = ", ".join(f.name for f in recorded)
        whole = ", ".join(f.name for f in FORMATS.values() if f.frame == "world" or f.columns == ALL)
        raise DatasetError(
            f"{dataset.path}: clouds in {names} lack what {form.name} files hold;"
            f" drive with `formats` {form.name}, or with one that can be converted: {whole}"
        )
    return max(found, key=lambda f: f.exact or f.module == form.module)


def _copy_all_but_clouds(dataset: Dataset, recording: Recording, *, devices: list[Scanner]) -> None:
    """Copy what a conversion of clouds leaves as it is; signatures are of the former files."""
    old, new = Paths(dataset.path), Paths(recording.out)
    left = {new.manifest, new.journal, new.integrity}
    if old.integrity.exists():
        log.warning("%s: left out: it is the signature of the former files", old.integrity)
    for device in devices:
        folder = new.sensor(device.name)
        left |= {form.path(folder, 0).parent for form in FORMATS.values()}
        left.add(new.deskewed(device.name, 0, suffix="").parent)
        left |= set() if recording.settings.kitti else {folder / name for name in _SEQUENCE}
    copy_dataset(dataset.path, recording.out, leave_out=left)


def _convert_cloud(
    dataset: Dataset, recording: Recording, *, source: Format, scanner: Scanner, frame: int
) -> None:
    """Write one recorded cloud in the format of a recording, and de-skewed if that says so."""
    path = source.path(dataset.paths.sensor(scanner.name), frame)
    paths = recording.paths(scanner, frame)
    (form,) = recording.settings.cloud_formats
    if source.module == form.module and form.frame == "world":
        with reading_file(path):
            form.write(paths[form.name], source.read(path), info=recording.las_info)
        return
    if source.frame == "world":
        with reading_file(path):
            table = _to_scanner_frame(source.read(path), recording, scanner=scanner, frame=frame)
    else:
        table = cloud_points(path)
    velocity = None
    if scanner.sensor.fmcw:
        with reading_file(path):
            velocity = table["velocity"].astype(np.float32)
    cloud = table_cloud(table, start_ns=scanner.frame_start_ns(frame))
    write_clouds(recording, scanner, frame=frame, cloud=cloud, paths=paths, velocity=velocity)


def _to_scanner_frame(table: Table, recording: Recording, *, scanner: Scanner, frame: int) -> Table:
    """A table of the world frame in that of its scanner, with the times and firing blocks of its pulses.

    A return is of the pulse of its ring that is nearest in time; of pulses at the same time, as of a flash,
    the nearest in direction.
    """
    sent, begin = sent_pulses(recording, scanner, frame=frame), scanner.frame_start_ns(frame)
    time_ns, mount = drive_ns(recording.start, table["gps_time"]), scanner.spec.mount
    placed = recording.geo.scene_points(np.column_stack([table[axis] for axis in "xyz"]))

    def seen(time_ns: NDArray[np.int64]) -> Float:
        return recording.trajectory.at(time_ns).mounted(mount.translation, mount.rotation).seen(placed)

    rough = seen(time_ns)
    rough /= np.maximum(np.linalg.norm(rough, axis=1), _NEAR)[:, None]
    known = _marks(sent.ring, sent.time_ns - begin, direction=sent.direction)
    _, row = cKDTree(known).query(_marks(table["ring"], time_ns - begin, direction=rough))
    matched = np.abs(sent.time_ns[row] - time_ns) <= _CLOCK_NS
    time_ns = np.where(matched, sent.time_ns[row], time_ns)
    points = dict(zip("xyz", seen(time_ns).T.astype(np.float32), strict=True))
    column = table.get("column", sent.column[row])
    return table | points | {"time_ns": (time_ns - begin).clip(0).astype(np.uint32), "column": column}


def _marks(ring: NDArray[Any], time_ns: NDArray[np.int64], *, direction: Float) -> Float:
    """Points (n, 5), near each other for pulses alike: ring counts before time, and time before direction."""
    return np.column_stack([ring.astype(float) * _RING, time_ns / _CLOCK_NS, direction])
