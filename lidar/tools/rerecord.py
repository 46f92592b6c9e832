"""Recordings that are written again, their clouds with the truth of earlier stages, and changed clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.support.columns import write_columns
from lidar.dataset.foreign import foreign_truth
from lidar.dataset.formats import Format
from lidar.dataset.formats.kitti import read_labels
from lidar.dataset.formats.table import PointLabels, table_cloud
from lidar.dataset.ground_truth import read_truth
from lidar.dataset.layout import Dataset, Paths, read_rows, reading_file
from lidar.dataset.recorded import cloud_points
from lidar.errors import DatasetError, InputError
from lidar.geometry.georeference import Georeference, export_crs
from lidar.options.stages import with_stage_settings
from lidar.sensors.laser.cloud import Cloud
from lidar.sensors.rig.devices import Camera, Scanner
from lidar.sensors.rig.scanner import Sensor
from lidar.settings import RecordingSettings, settings_of
from lidar.signal.recorded import complete
from lidar.signal.registry import NO_STAGES, Stages, acts_on
from lidar.signal.truth import Altered, Past, past_of, write_truth
from lidar.simulation.record_clouds import write_clouds
from lidar.simulation.recording import Recording


def acted_stages(dataset: Dataset) -> list[dict[str, Any]]:
    """The stages that have acted on a dataset, in order, as `NamedStage.to_json` writes them."""
    recipe = dataset.manifest["recipe"]
    return [*recipe.get("stages", ()), *recipe.get("applied_stages", ())]


def truth_of_past(dataset: Dataset, device: Scanner | Camera, *, frame: int) -> Path:
    """Truth file of a frame that stages may have changed already.

    Raises DatasetError if they have and the file is missing.
    """
    path = dataset.paths.truth(device.name, frame)
    kind = "camera" if isinstance(device, Camera) else "lidar"
    with reading_file(dataset.paths.manifest):
        needed = any(acts_on(table, device.name, kind=kind) for table in acted_stages(dataset))
    if needed and not path.exists():
        raise DatasetError(f"{path}: missing; without the truth of earlier stages no others can be applied")
    return path


def recording_again(dataset: Dataset, out: Path, *, stages: Stages = NO_STAGES) -> Recording:
    """The recording by which the frames of a dataset are written again, to another directory.

    Raises DatasetError for a damaged ``dataset.json``.
    """
    recipe = dataset.manifest["recipe"]
    with reading_file(dataset.paths.manifest):
        seed = int(dataset.manifest["seed"])
        recorded = [(name, text) for name, text in recipe["settings"]]
        chosen = settings_of(recipe["fidelity"], with_stage_settings(recorded, stages.stages))
        formats, labels = tuple(recipe["formats"]), tuple(recipe["labels"])
        settings = RecordingSettings(formats, labels, recipe["deskew"], seed, *chosen, stages)
        crs = export_crs(dataset.frame, recipe["crs"])
        on = dataset.manifest.get("scanners_on_ns")
        scanning_ns = None if on is None else np.array(on, np.int64).reshape(-1, 2)
    return Recording(
        out,
        dataset.frame,
        trajectory=dataset.trajectory(),
        start=dataset.start,
        geo=Georeference(dataset.frame, crs, exact=bool(recipe.get("exact"))),
        settings=settings,
        scanning_ns=scanning_ns,
    )


def richest_format(settings: RecordingSettings) -> Format:
    """The format in the sensor frame that keeps most columns.

    Raises InputError if there is none.
    """
    found = [form for form in settings.cloud_formats if form.frame == "sensor"]
    if not found:
        raise InputError(
            f"clouds are in the world frame ({','.join(settings.formats)}); record the sensor frame too"
        )
    return max(found, key=lambda form: len(form.columns))


def recorded_cloud(
    dataset: Dataset, recording: Recording, *, form: Format, scanner: Scanner, frame: int
) -> Cloud:
    """A cloud of a dataset."""
    path = replace(recording, out=dataset.path).paths(scanner, frame)[form.name]
    cloud = table_cloud(cloud_points(path), start_ns=scanner.frame_start_ns(frame))
    return complete(cloud, scanner.sensor, columns=form.columns)


def write_altered(
    altered: Altered,
    truth: dict[str, NDArray[Any]],
    *,
    dataset: Dataset,
    recording: Recording,
    form: Format,
    scanner: Scanner,
    frame: int,
) -> None:
    """Write a changed cloud of a dataset with its labels, boxes and truth.

    form : in which the dataset's cloud was read
    """
    settings, cloud = recording.settings, altered.cloud
    source = replace(recording, out=dataset.path).paths(scanner, frame)
    paths = recording.paths(scanner, frame)
    table = cloud_points(source[form.name])
    if form.kitti:  # recorded without the vehicle's motion: all points are those of the frame's start
        cloud = replace(cloud, time_ns=np.zeros_like(cloud.time_ns))
    velocity = None
    if "velocity" in table:
        velocity = np.where(cloud.source >= 0, np.append(table["velocity"], 0)[cloud.source], 0)
    write_clouds(recording, scanner, frame=frame, cloud=cloud, paths=paths, velocity=velocity)
    for labels in settings.label_formats:
        name = f"labels {labels.name}"
        labels.write(paths[name], _labels(altered, source[name] if labels.name == "semantickitti" else None))
    boxes = Paths(dataset.path).frame_boxes(scanner.name, frame)
    if boxes.exists():
        rows = read_rows(boxes)
        columns: dict[str, Any] = {name: [row[name] for row in rows] for name in (rows[0] if rows else ())}
        if rows:
            with reading_file(boxes):
                instances = [int(row["instance"]) for row in rows]
            hits = [np.count_nonzero(cloud.feature == instance) for instance in instances]
            write_columns(Paths(recording.out).frame_boxes(scanner.name, frame), columns | {"points": hits})
    write_truth(Paths(recording.out).truth(scanner.name, frame), truth)


def _labels(altered: Altered, semantic_kitti: Path | None) -> PointLabels:
    """Labels of a cloud after stages; road users come from its former labels of SemanticKITTI."""
    source, n = altered.cloud.source, len(altered.cloud)
    if semantic_kitti is None:
        return PointLabels(altered.cloud.klass, np.zeros(n, np.int64), np.zeros(n, bool))
    road_user, moving = read_labels(semantic_kitti)
    if len(road_user) != len(altered.original):
        raise DatasetError(f"{semantic_kitti}: {len(road_user)} labels for {len(altered.original)} points")
    return PointLabels(altered.cloud.klass, np.append(road_user, 0)[source], np.append(moving, False)[source])


def read_foreign(path: Path, form: Format, *, device: Sensor) -> Cloud:
    """A point cloud of KITTI or nuScenes."""
    return complete(table_cloud(form.read(path)), device, columns=form.columns)


def read_foreign_past(path: Path, form: Format, *, source: Path, device: Sensor) -> Past:
    """A point cloud of KITTI or nuScenes with the ground truth of earlier stages, if any."""
    truth = foreign_truth(source, path.relative_to(source), form=form)
    return read_past(truth, read_foreign(path, form, device=device))


@dataclass(frozen=True, slots=True)
class Former:
    """The point clouds before one in the order of names, of the same folder.

    clouds : all files
    row    : of the one
    """

    clouds: Sequence[tuple[Path, Format]]
    row: int
    source: Path
    device: Sensor

    def cloud(self, frames: int) -> Cloud | None:
        """The cloud a number of frames before, as without stages; None before the first."""
        path, _ = self.clouds[self.row]
        row = self.row - frames
        if row < 0 or self.clouds[row][0].parent != path.parent:
            return None
        return read_foreign_past(*self.clouds[row], source=self.source, device=self.device).original


def select_labels(path: Path, out: Path, *, altered: Altered) -> None:
    """Write labels of SemanticKITTI for the returns after stages; added ones are unlabelled (0)."""
    codes = np.append(np.fromfile(path, "<u4"), np.uint32(0))
    if len(codes) != len(altered.original) + 1:
        raise DatasetError(f"{path}: {len(codes) - 1} labels for {len(altered.original)} points")
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(codes[altered.cloud.source].astype("<u4").tobytes())


def read_past(path: Path, cloud: Cloud) -> Past:
    """A recorded cloud with the ground truth of its truth file, if any; see `lidar.signal.truth.past_of`.

    Raises DatasetError for a file that is damaged or of another cloud.
    """
    truth = read_truth(path, count=len(cloud))
    with reading_file(path):
        return past_of(cloud, truth)
