"""Commands that make detections, and that compare estimates with the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from geoscene.errors import need
from geoscene.support.console import Report, command_line, note_new_folder
from geoscene.support.progress import progress_bar
from lidar.cli.program import Out, Reporting, show
from lidar.errors import InputError
from lidar.options.shared import OUTPUT
from lidar.options.trajectories import EvaluateOptions


def evaluate(
    estimate: Path,
    /,
    *,
    against: Path,
    options: EvaluateOptions = EvaluateOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Evaluate an estimate against ground truth: a trajectory with intervals, detections or tracks.

    For example:

    lidar evaluate odometry --against drive

    lidar evaluate odometry.tum --against drive --align none --map-error -o evaluation

    lidar evaluate poses.txt --against drive --sensor velodyne --align origin --json

    lidar evaluate detections --against drive

    lidar evaluate tracks.txt --against drive -o evaluation

    Parameters
    ----------
    estimate
        Trajectory in the layout of TUM (timestamp tx ty tz qx qy qz qw), of KITTI (12 numbers a line), or of
        poses.csv; a folder of lidar odometry; or a dataset. Detections: a folder of KITTI's NNNNNN.txt, or
        nuScenes' results as JSON. Tracks: a text file of KITTI's tracking benchmark or of MOT.
    against
        The truth: a dataset, or for a trajectory another one.
    out
        Folder to make: figures, tables, aligned trajectory and a page.
    """
    from lidar.tools.evaluation.objects import kind_of  # noqa: PLC0415
    from lidar.tools.evaluation.report import (  # noqa: PLC0415
        report_folder,
        trajectory_tables,
        write_trajectory_report,
    )
    from lidar.tools.evaluation.trajectory import evaluate_trajectory, method_of  # noqa: PLC0415

    if kind_of(estimate):
        return _evaluate_objects(estimate, against, options=options, out=out, report=report)
    with progress_bar(quiet=report.quiet) as progress:
        if out is None:
            found = evaluate_trajectory(estimate, against, options=options, progress=progress)
        else:
            need("matplotlib", "plots")
            note_new_folder(out)
            with report_folder(out, overwrite=report.overwrite) as folder:
                found = evaluate_trajectory(estimate, against, options=options, out=folder, progress=progress)
                write_trajectory_report(found, folder, estimate=estimate)
    parts = [method_of(found.errors), *(table.to_text() for table in trajectory_tables(found.errors))]
    parts += [] if out is None else [f"{out}: evaluation.html, figures and tables"]
    return show(found.errors.to_json(), "\n\n".join(parts), json=report.json)


def _evaluate_objects(
    estimate: Path, against: Path, *, options: EvaluateOptions, out: Path | None, report: Report
) -> int:
    from lidar.tools.evaluation.objects import evaluate_objects  # noqa: PLC0415
    from lidar.tools.evaluation.report import report_folder, write_object_report  # noqa: PLC0415

    if replace(options, sensor="") != EvaluateOptions():
        raise InputError(f"{estimate}: detections and tracks take no options of trajectories; leave them out")
    if out is None:
        found = evaluate_objects(estimate, against, sensor=options.sensor)
    else:
        note_new_folder(out)
        with report_folder(out, overwrite=report.overwrite) as folder:
            found = evaluate_objects(estimate, against, sensor=options.sensor)
            write_object_report(found, folder)
    parts = [f"{found.kind}: {found.frames:,} frames", *(table.to_text() for table in found.tables())]
    parts += [] if out is None else [f"{out}: evaluation.html and tables"]
    return show(found.to_json(), "\n\n".join(parts), json=report.json)


def detect(
    dataset: Path,
    /,
    *,
    to: Annotated[str, Parameter(help="Layout: kitti or nuscenes.")],
    detector: str = "rules",
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Detect road users in recorded point clouds, and write them in the layout of a benchmark.

    For example:

    lidar detect drive --to kitti -o detections

    lidar detect drive --to nuscenes --detector learned -o detections

    lidar evaluate detections --against drive

    Parameters
    ----------
    dataset
        Directory or URL of the dataset, or a folder with clouds of KITTI or nuScenes.
    detector
        rules, learned, or the file of a model (lidar train).
    out
        Folder to make: NNNNNN.txt of each frame, or results.json.
    """
    from lidar.dataset.layout import is_dataset  # noqa: PLC0415
    from lidar.tools.detection.learned import read_detector  # noqa: PLC0415
    from lidar.tools.evaluation.detect import LAYOUTS  # noqa: PLC0415
    from lidar.tools.evaluation.detect import detect as detected  # noqa: PLC0415

    if to not in LAYOUTS:
        raise InputError(f"`to` {to}: one of {', '.join(LAYOUTS)}")
    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        counts = detected(
            dataset,
            out,
            layout=to,
            detector=read_detector(detector),
            overwrite=report.overwrite,
            progress=progress,
        )
    text = f"{out}: {counts['boxes']:,} boxes in {counts['frames']:,} frames"
    if is_dataset(dataset):
        text += f"; next: {command_line('lidar', 'evaluate', out, '--against', dataset)}"
    return show({"path": str(out), **counts}, text, json=report.json)
