"""Stages on recorded data: datasets of this program, and point clouds of KITTI and nuScenes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geoscene.classes import Class
from geoscene.support.files import write_json
from geoscene.support.progress import Progress, displayed, shows_progress
from lidar.dataset.checksums import write_checksums
from lidar.dataset.derived import (
    check_target,
    complete_folder,
    copy_dataset,
    derived_from,
    write_folder_provenance,
)
from lidar.dataset.foreign import (
    KITTI,
    ForeignFolder,
    foreign_labels,
    foreign_truth,
    open_recorded,
    read_foreign_stages,
    write_foreign_stages,
)
from lidar.dataset.formats import FORMATS, Format
from lidar.dataset.formats.table import cloud_table
from lidar.dataset.ground_truth import read_truth
from lidar.dataset.layout import Dataset, DatasetLike, Paths, reading_file
from lidar.dataset.navigation_files import read_fixes, read_samples
from lidar.dataset.png import counts_to_depth, image_to_feature, read_png, write_png
from lidar.errors import DatasetError, InputError
from lidar.options.data import ApplyOptions
from lidar.options.stages import with_stage_settings
from lidar.sensors.camera.render import CameraImage as Image
from lidar.sensors.rig.devices import Camera, Scanner, cameras, scanners, sensor_kinds
from lidar.sensors.rig.scanner import Sensor, load_sensor
from lidar.sensors.rig.specs import GnssSpec, ImuSpec, Rig, rig_of
from lidar.signal.attacks.attacker import Attacker, Seen, check_sight
from lidar.signal.recorded import altered_recording, recorded_echoes
from lidar.signal.registry import NamedStage, Stages, dimming, number_stages
from lidar.signal.run import altered_image
from lidar.signal.situation import Counts, Effects, Situation
from lidar.signal.stage import LABELS, POSES
from lidar.signal.truth import Past, image_past, image_truth, truth_since, write_truth
from lidar.simulation.boxes import merge_box_files
from lidar.simulation.metadata import record_fixes, record_samples
from lidar.simulation.record_clouds import sent_pulses
from lidar.simulation.recording import Recording
from lidar.simulation.situations import RecordedSurroundings, situation_of, situation_of_unit, surroundings_of
from lidar.tools.rerecord import (
    Former,
    acted_stages,
    read_foreign,
    read_foreign_past,
    read_past,
    recorded_cloud,
    recording_again,
    richest_format,
    select_labels,
    truth_of_past,
    write_altered,
)

_SENSORS = {"kitti": "hdl64e_s2", "nuscenes": "hdl32e"}
"""Presets of the scanners that recorded these datasets; KITTI's takes 1.3 million points/s (Geiger 2013)."""


@dataclass(frozen=True, slots=True)
class ApplySummary:
    """Result of stages on recorded data.

    files          : point clouds, images and measurements of receivers and inertial units, as written
    points_in      : returns before the stages
    points         : returns after them
    effects        : counts of each stage
    sight          : how lines of sight to attackers' devices were checked: by rays in the ``scene``, or by
                     recorded ``returns``; empty without devices
    """

    path: Path
    files: int
    points_in: int
    points: int
    effects: Counts
    sight: str = ""


@shows_progress
def apply_stages(
    source: DatasetLike,
    out: str | Path,
    *,
    options: ApplyOptions,
    overwrite: bool = False,
    progress: Progress = displayed,
) -> ApplySummary:
    """Write recorded data after stages to ``out``, with truth files of the changes.

    A dataset of this program is written whole. Of other folders the point clouds are written, at the same
    relative paths: KITTI's ``*.bin`` in a folder ``velodyne*`` or in ``source`` itself, with SemanticKITTI's
    labels if there are any, and nuScenes' ``*.pcd.bin``. Their truth files are in ``out/truth``.

    overwrite : replace an existing directory

    Raises InputError for stages that cannot act on the data, and DatasetError for data that cannot be read.
    """
    found, out = open_recorded(source), Path(out)
    check_target(out, source=found.path, overwrite=overwrite)
    if isinstance(found, Dataset) and options.sensor:
        raise InputError("`sensor`: a dataset has its own sensors; leave it out")
    with complete_folder(out) as part:
        if isinstance(found, Dataset):
            found.fetch(progress)
            done = _apply_to_dataset(found, part, stages=options.all_stages, progress=progress)
        else:
            done = _apply_to_clouds(found, out=part, options=options, progress=progress)
            write_folder_provenance(found.path, part, by="apply")
        write_checksums(part)
    return replace(done, path=out)


def _apply_to_dataset(
    dataset: Dataset, out: Path, *, stages: tuple[NamedStage, ...], progress: Progress
) -> ApplySummary:
    recipe = dataset.manifest["recipe"]
    if dataset.manifest["frames_done"] != dataset.frames:
        raise DatasetError(f"{dataset.path}: the drive was not finished; finish it first")
    with reading_file(dataset.paths.manifest):
        rig = rig_of(recipe["rig"])
        acted = acted_stages(dataset)
        names = [str(table["name"]) for table in acted]
        chosen = Stages(number_stages(stages, after=names), int(dataset.manifest["seed"]), dimming(acted))
        columns = {name for form in recipe["formats"] for name in FORMATS[form].columns}
        labelled = dataset.paths.boxes.exists() and {"label", "instance"} <= columns
        chosen.check(sensor_kinds(rig), known=(POSES, LABELS) if labelled else (POSES,))
        _check_images(chosen, rig)
        points = dict(dataset.manifest["points"])
    sensors: list[Scanner | Camera] = [*scanners(rig), *cameras(rig)]
    last = dict.fromkeys(sensor_kinds(rig), dataset.trajectory().duration_ns / 1e9)
    last |= {s.name: float(dataset.sample_times(s.name)[-1:].sum()) / 1e9 for s in sensors}
    chosen.check_start(sensor_kinds(rig), last=last)
    recording = recording_again(dataset, out, stages=chosen)
    settings = recording.settings
    jobs = [
        (s, frame)
        for s in sensors
        if recording.has_stages(s)
        for frame in range(len(dataset.sample_times(s.name)))
    ]
    form = richest_format(settings) if any(isinstance(s, Scanner) for s, _ in jobs) else None
    has_devices = any(isinstance(named.stage, Attacker) for named in stages)
    around = surroundings_of(dataset) if has_devices else None
    if form is not None:
        _check_sight(dataset, recording, form=form, jobs=jobs, around=around)
    written = {path for job in jobs for path in recording.paths(*job).values()}
    units = _altered_units(rig, chosen)
    written |= {Paths(out).measurements(unit.name) for unit in units}
    copy_dataset(dataset.path, out, leave_out=written | {Paths(out).manifest, Paths(out).journal})
    before = sum(points.values())
    points |= dict.fromkeys((s.name for s, _ in jobs if isinstance(s, Scanner)), 0)
    for done, (device, frame) in enumerate(jobs):
        progress("stages", done, total=len(jobs))
        if isinstance(device, Camera):
            _apply_to_image(dataset, recording, camera=device, frame=frame)
        elif form is not None:
            points[device.name] += _apply_to_frame(
                dataset, recording, form=form, scanner=device, frame=frame, around=around
            )
    progress("stages", len(jobs), total=len(jobs))
    for unit in units:
        _apply_to_unit(dataset, recording, spec=unit)
    if Paths(out).boxes.exists():
        merge_box_files(out)
    applied = [
        *recipe.get("applied_stages", ()),
        *(describe_stage(s, seed=chosen.seed) for s in chosen.stages),
    ]
    recipe |= {"applied_stages": applied, "settings": with_stage_settings(recipe["settings"], stages)}
    parents = derived_from(dataset.path, dataset.manifest, by="apply")
    write_json(Paths(out).manifest, dataset.manifest | {"recipe": recipe, "points": points} | parents)
    sight = ("returns" if around is None else "scene") if has_devices else ""
    effects = chosen.effects(recording.effects.counts)
    return ApplySummary(out, len(jobs) + len(units), before, sum(points.values()), effects, sight)


def describe_stage(named: NamedStage, *, seed: int) -> dict[str, Any]:
    """A stage in the list of those that were applied, with its seed; ``seed`` is the data's."""
    return {"seed": seed} | named.to_json()


def _altered_units(rig: Rig, stages: Stages) -> list[GnssSpec | ImuSpec]:
    """Receivers and inertial units whose measurements stages change."""
    return [
        *(receiver for receiver in rig.gnss if stages.at("fixes", receiver.name)),
        *(unit for unit in rig.imus if stages.at("samples", unit.name)),
    ]


def _apply_to_unit(dataset: Dataset, recording: Recording, *, spec: GnssSpec | ImuSpec) -> None:
    """Write the measurements of a receiver or an inertial unit after the stages, and their truth."""
    stages, start, out = recording.settings.stages, recording.start, Paths(recording.out)
    at = situation_of_unit(
        spec.name,
        spec.mount,
        trajectory=recording.trajectory,
        start=start,
        seed=recording.settings.seed,
        effects=recording.effects,
    )
    truth = dataset.paths.measurements_truth(spec.name)
    past = truth if truth.exists() else None
    if isinstance(spec, ImuSpec):
        samples = read_samples(dataset.paths.measurements(spec.name))
        record_samples(out, samples, at=at, stages=stages, start=start, past=past)
        return
    fixes, heights = read_fixes(dataset.paths, spec.name, vertical=dataset.frame.vertical)
    record_fixes(out, fixes, at=at, stages=stages, start=start, heights=heights, past=past)


def _check_images(stages: Stages, rig: Rig) -> None:
    """Raise InputError for a stage on images that needs images of another kind which were not recorded."""
    for camera in rig.cameras:
        for named in stages.at("image", camera.name):
            if missing := sorted(set(named.stage.image_kinds) - set(camera.images)):
                raise InputError(
                    f"stage {named.name} needs {' and '.join(missing)} images of {camera.name}, which were"
                    f" not recorded; drive again with images = {[*camera.images, *missing]} in the rig, or"
                    " let it act on a scanner alone: `stage` with sensor=NAME"
                )


def _apply_to_frame(
    dataset: Dataset,
    recording: Recording,
    *,
    form: Format,
    scanner: Scanner,
    frame: int,
    around: RecordedSurroundings | None,
) -> int:
    """Write a cloud after the stages with its labels, boxes and truth; return the number of points."""
    settings = recording.settings

    def past_of(number: int) -> Past:
        cloud = recorded_cloud(dataset, recording, form=form, scanner=scanner, frame=number)
        return read_past(truth_of_past(dataset, scanner, frame=number), cloud)

    past = past_of(frame)

    threshold = settings.scanner.link or settings.scanner.detection
    at = situation_of(
        recording,
        scanner,
        frame=frame,
        cloud_of=lambda earlier: past_of(earlier).original,
        surroundings=around,
    )
    altered = altered_recording(
        past.cloud,
        settings.stages,
        sensor=scanner.sensor,
        at=at,
        threshold=threshold,
        sent=sent_pulses(recording, scanner, frame=frame) if "column" in form.columns else None,
    )
    truth = truth_since(past, altered, start_ns=scanner.frame_start_ns(frame))
    write_altered(
        altered, truth, dataset=dataset, recording=recording, form=form, scanner=scanner, frame=frame
    )
    return len(altered.cloud)


def _check_sight(
    dataset: Dataset,
    recording: Recording,
    *,
    form: Format,
    jobs: Sequence[tuple[Scanner | Camera, int]],
    around: RecordedSurroundings | None,
) -> None:
    """Raise InputError for an attacker without a line of sight to any scanner in any frame."""

    def seen(scanner: Scanner, at: Situation) -> Seen:
        cloud = recorded_cloud(dataset, recording, form=form, scanner=scanner, frame=int(at.frame))
        sent = sent_pulses(recording, scanner, frame=int(at.frame)) if "column" in form.columns else None
        return (*recorded_echoes(cloud, scanner.sensor, sent=sent), at)

    places = (
        (device, situation_of(recording, device, frame=frame, surroundings=around))
        for device, frame in jobs
        if isinstance(device, Scanner)
    )
    check_sight(recording.settings.stages, ((at, partial(seen, device, at)) for device, at in places))


def _apply_to_image(dataset: Dataset, recording: Recording, *, camera: Camera, frame: int) -> None:
    """Write a colour image after the stages, and its truth."""
    source = replace(recording, out=dataset.path).paths(camera, frame)
    paths = recording.paths(camera, frame)
    read: dict[str, NDArray[Any]] = {
        kind: read_png(path) for kind, path in source.items() if kind in ("rgb", *_IMAGES)
    }
    shape = read["rgb"].shape[:2]
    image = Image(
        read["rgb"],
        counts_to_depth(read["depth"]) if "depth" in read else np.full(shape, np.inf, np.float32),
        read.get("semantic", np.full(shape, Class.UNLABELED, np.uint8)),
        image_to_feature(read["instance"]) if "instance" in read else np.full(shape, -1, np.int32),
    )
    found = altered_image(image, recording.settings.stages, at=situation_of(recording, camera, frame=frame))
    assert found.rgb is not None  # noqa: S101
    write_png(paths["rgb"], found.rgb)
    truth = truth_of_past(dataset, camera, frame=frame)
    with reading_file(truth):
        original = image_past(image, read_truth(truth))
    write_truth(paths["truth"], image_truth(found, original))
    for kind in _IMAGES & source.keys():
        shutil.copyfile(source[kind], paths[kind])


_IMAGES = {"depth", "semantic", "instance"}


def _apply_to_clouds(
    folder: ForeignFolder, *, out: Path, options: ApplyOptions, progress: Progress
) -> ApplySummary:
    source, clouds = folder.path, folder.clouds
    devices: dict[tuple[str, str], Sensor] = {}
    for path, form in clouds:
        key = path.parent.name, form.name
        if key not in devices:
            devices[key] = load_sensor(options.sensor or _SENSORS[form.name], name=key[0])
    acted = read_foreign_stages(source)
    names = [str(table["name"]) for table in acted]
    chosen = Stages(number_stages(options.all_stages, after=names), before=dimming(acted))
    kinds = {name: "lidar" for name, _ in devices}
    chosen.check(kinds)
    chosen.check_start(kinds, last=dict.fromkeys(kinds, 0.0))
    effects = Effects()
    check_sight(
        chosen, (_place_of(path, form, device=devices[path.parent.name, form.name]) for path, form in clouds)
    )
    before = after = 0
    for done, (path, form) in enumerate(clouds):
        progress("stages", done, total=len(clouds))
        place = path.relative_to(source)
        stem = path.name.removesuffix(form.suffix)
        device = devices[path.parent.name, form.name]
        past = read_foreign_past(path, form, source=source, device=device)
        frame = int(stem) if stem.isdigit() else stem
        former = Former(clouds, done, source=source, device=device)
        at = Situation(device.name, frame, earlier=former.cloud, effects=effects)
        altered = altered_recording(past.cloud, chosen, sensor=device, at=at, sent=None)
        truth = foreign_truth(out, place, form=form)
        form.write(out / place, cloud_table(altered.cloud))
        write_truth(truth, truth_since(past, altered, start_ns=0))
        if form is KITTI and (labels := foreign_labels(path)).is_file():
            select_labels(labels, out / labels.relative_to(source), altered=altered)
        before, after = before + len(past.cloud), after + len(altered.cloud)
    write_foreign_stages(out, [*acted, *(describe_stage(stage, seed=chosen.seed) for stage in chosen.stages)])
    progress("stages", len(clouds), total=len(clouds))
    has_devices = any(isinstance(named.stage, Attacker) for named in chosen.stages)
    sight = "returns" if has_devices else ""
    return ApplySummary(out, len(clouds), before, after, chosen.effects(effects.counts), sight)


def _place_of(path: Path, form: Format, *, device: Sensor) -> tuple[Situation, Callable[[], Seen]]:
    """Situation and echoes of a cloud of KITTI or nuScenes, by which lines of sight are checked."""
    at = Situation(device.name, path.name)
    return at, lambda: (*recorded_echoes(read_foreign(path, form, device=device), device, sent=None), at)
