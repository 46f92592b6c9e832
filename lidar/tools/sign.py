"""Signs datasets: a watermark in the points of their clouds, and a signed hash chain over their files."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geoscene.support.files import delete_leftovers, exclusive, write_atomically, write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from geoscene.typing import Float
from lidar.dataset.checksums import add_to_checksums, write_checksums
from lidar.dataset.derived import check_target, complete_folder, copy_dataset, derived_from
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.formats.table import table_cloud
from lidar.dataset.layout import Dataset, DatasetLike, Paths, open_dataset
from lidar.dataset.recorded import cloud_points
from lidar.errors import DatasetError, InputError
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.devices import Scanner, scanners
from lidar.sensors.rig.specs import rig_of
from lidar.simulation.record_clouds import write_clouds
from lidar.simulation.recording import Recording
from lidar.tools.integrity.chain import write_chain
from lidar.tools.integrity.keys import Signer
from lidar.tools.integrity.watermark import WatermarkCells, WatermarkKey
from lidar.tools.rerecord import recording_again


@dataclass(frozen=True, slots=True)
class SignSummary:
    """Result of signing.

    marked : clouds that got the watermark
    rms    : metres by which it moved points, root mean square of their distance
    frames : frames in hash chains
    files  : files with digests
    """

    path: Path
    marked: int = 0
    rms: float = 0.0
    frames: int = 0
    files: int = 0


def marked_formats(formats: tuple[str, ...]) -> list[Format]:
    """The formats, of some, whose files bear a watermark that can be read from them alone."""
    found = [FORMATS[name] for name in formats]
    return [form for form in found if form.frame == "sensor" and {"ring", "column"} <= set(form.columns)]


def cells_of(cloud: Cloud, *, sensor: str, frame: int) -> WatermarkCells:
    """Which pulses the returns of a cloud belong to."""
    return WatermarkCells(sensor, frame, cloud.ring, cloud.column, cloud.echo)


@shows_progress
def sign_dataset(
    source: DatasetLike,
    out: str | Path | None,
    *,
    watermark: WatermarkKey | None = None,
    signer: Signer | None = None,
    overwrite: bool = False,
    progress: Progress = displayed,
) -> SignSummary:
    """Write a dataset with a watermark, a signed hash chain or both to ``out``.

    Without ``out`` the chain is added to the dataset itself; a watermark changes clouds and needs ``out``.

    Raises InputError and DatasetError for data that cannot be signed; nothing is written then.
    """
    source = Path(source)
    dataset = open_dataset(source)
    if watermark is None and signer is None:
        raise InputError("give `watermark`, `chain` or both")
    if dataset.manifest["frames_done"] != dataset.frames:
        raise DatasetError(f"{source}: the drive was not finished; finish it first")
    if out is None:
        if watermark is not None or signer is None:
            raise InputError("`watermark` changes clouds; give a directory to write to with `out`")
        chain = Paths(source).chain
        if chain.exists() and not overwrite:
            raise DatasetError(f"{source}: is signed already; set `overwrite` to sign it again")
        with exclusive(source.resolve()):
            delete_leftovers(source)
            frames, files, data = write_chain(dataset, signer, progress=progress)
            known = {chain.relative_to(source).as_posix(): hashlib.sha256(data).digest()}
            add_to_checksums(source, below=Paths(source).integrity.name, known=known)
            write_atomically(chain, data)  # last: it marks signed data
        return SignSummary(source, frames=frames, files=files)
    out = Path(out)
    check_target(out, source=source, overwrite=overwrite)
    with complete_folder(out) as part:
        summary = SignSummary(out)
        if watermark is None:
            copy_dataset(source, part, leave_out={Paths(part).integrity})
        else:
            marked, rms = _mark(dataset, part, watermark=watermark, progress=progress)
            summary = replace(summary, marked=marked, rms=rms)
        if signer is not None:
            frames, files, data = write_chain(open_dataset(part), signer, progress=progress)
            summary = replace(summary, frames=frames, files=files)
            write_atomically(Paths(part).chain, data)
        write_checksums(part)
    return summary


def _mark(dataset: Dataset, out: Path, *, watermark: WatermarkKey, progress: Progress) -> tuple[int, float]:
    """Copy a dataset with a watermark in its clouds, in all formats; their number, and metres moved (rms)."""
    recipe = dataset.manifest["recipe"]
    if "watermark" in recipe:
        raise DatasetError(f"{dataset.path}: has a watermark already; sign the original")
    recording = recording_again(dataset, out)
    forms = marked_formats(recording.settings.formats)
    if not forms:
        known = ", ".join(form.name for form in marked_formats(tuple(FORMATS)))
        raise InputError(
            f"{dataset.path}: clouds are {','.join(recording.settings.formats)}; a watermark needs one of"
            f" {known}, which keep ring and column"
        )
    # Exact coordinates first: CSV rounds them.
    form = min(forms, key=lambda form: form.name == "csv")
    jobs = [
        (scanner, frame)
        for scanner in scanners(rig_of(recipe["rig"]))
        for frame in range(len(dataset.sample_times(scanner.name)))
    ]
    clouds = {
        path
        for job in jobs
        for name, path in recording.paths(*job).items()
        if name not in ("boxes", "truth") and not name.startswith("labels ")  # these stay as they are
    }
    leave_out = clouds | {Paths(out).manifest, Paths(out).journal, Paths(out).integrity}
    copy_dataset(dataset.path, out, leave_out=leave_out)
    squares = points = 0.0
    for done, (scanner, frame) in enumerate(jobs):
        progress("watermark", done, total=len(jobs))
        moved = _mark_frame(dataset, recording, scanner=scanner, frame=frame, form=form, watermark=watermark)
        squares, points = squares + float(moved @ moved), points + len(moved)
    progress("watermark", len(jobs), total=len(jobs))
    recipe = recipe | {"watermark": watermark.step}
    parents = derived_from(dataset.path, dataset.manifest, by="sign")
    write_json(Paths(out).manifest, dataset.manifest | {"recipe": recipe} | parents)
    return len(jobs), float(np.sqrt(squares / max(points, 1)))


def _mark_frame(
    dataset: Dataset,
    recording: Recording,
    *,
    scanner: Scanner,
    frame: int,
    form: Format,
    watermark: WatermarkKey,
) -> Float:
    """Write a cloud with the watermark; return the distances (n,) in metres by which points moved."""
    source = replace(recording, out=dataset.path).paths(scanner, frame)
    paths = recording.paths(scanner, frame)
    table = cloud_points(source[form.name])
    cloud = table_cloud(table, start_ns=scanner.frame_start_ns(frame))
    marked = watermark.embedded(cloud.xyz, cells_of(cloud, sensor=scanner.name, frame=frame))
    xyz = marked.astype(np.float32)
    before = np.linalg.norm(cloud.xyz.astype(np.float64), axis=1)
    longer = np.linalg.norm(xyz.astype(np.float64), axis=1) - before
    moved: Float = np.linalg.norm(xyz - cloud.xyz.astype(np.float64), axis=1)
    cloud = replace(cloud, xyz=xyz, range=cloud.range + longer)
    write_clouds(recording, scanner, frame=frame, cloud=cloud, paths=paths, velocity=table.get("velocity"))
    return moved
