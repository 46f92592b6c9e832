"""Commands that compare estimates with the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from geoscene.console import Report, note_new_folder, print_json, progress_bar
from lidar.cli.program import Reporting
from lidar.options import OUTPUT, EvaluateOptions


def evaluate(
    estimate: Path,
    /,
    *,
    against: Path,
    options: EvaluateOptions = EvaluateOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Measure the errors of an estimated trajectory against the truth, with 95 % intervals.

    For example:

    lidar evaluate odometry.tum --against drive

    lidar evaluate odometry.tum --against drive --align none --map-error -o evaluation

    lidar evaluate poses.txt --against drive --sensor velodyne --align origin --json

    Parameters
    ----------
    estimate
        Trajectory in the layout of TUM (timestamp tx ty tz qx qy qz qw), of KITTI (12 numbers a line), or of
        poses.csv; or a dataset.
    against
        The truth: a dataset, or a trajectory.
    out
        Folder to make: figures, tables, aligned trajectory and a page.
    """
    from lidar.evaluation.report import report_folder, tables, write_trajectory_report  # noqa: PLC0415
    from lidar.evaluation.trajectory import evaluate_trajectory, method_of  # noqa: PLC0415
    from lidar.rig.catalog import columns  # noqa: PLC0415

    with progress_bar(quiet=report.quiet) as progress:
        if out is None:
            found = evaluate_trajectory(estimate, against, options=options, progress=progress)
        else:
            note_new_folder(out)
            with report_folder(out, overwrite=report.overwrite) as folder:
                found = evaluate_trajectory(estimate, against, options=options, out=folder, progress=progress)
                write_trajectory_report(found, folder, estimate=estimate)
    if report.json:
        print_json(found.errors.to_json())
        return 0
    print(method_of(found.errors))
    for title, head, rows in tables(found.errors):
        print(f"\n{title}")
        print(columns([head, *rows]))
    if out is not None:
        print(f"\n{out}: evaluation.html, figures and tables")
    return 0
