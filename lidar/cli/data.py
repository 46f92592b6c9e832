"""Commands that make other data of recorded clouds: maps, other formats, stages applied, filters."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from geoscene.support.console import Report, note_new_folder, print_json
from geoscene.support.progress import progress_bar
from lidar.cli.program import Out, Reporting, print_effects, show
from lidar.dataset.formats import map_suffixes
from lidar.options.data import ApplyOptions, ConvertOptions, DenoiseOptions
from lidar.options.maps import MapOptions
from lidar.options.shared import OUTPUT
from lidar.options.trajectories import OdometryOptions


def map_(
    dataset: Path,
    /,
    *,
    out: Annotated[
        Path,
        Parameter(
            name=["--out", "-o"],
            group=OUTPUT,
            help=f"File to write: {', '.join(map_suffixes())}; with --tiles, a folder.",
        ),
    ],
    options: MapOptions = MapOptions(),
    report: Reporting = Report(),
) -> int:
    """Aggregate all point clouds of a dataset into one georeferenced point cloud.

    For example:

    lidar map drive -o map.laz

    lidar map drive -o map.ply --voxel 0.1 --color height

    lidar map drive -o colored.laz --color image

    lidar map drive -o empty.laz --without vehicles,pedestrian

    lidar map drive -o junction.laz --bbox 24.941,60.165,24.943,60.166 --time 0,10 --echo last

    lidar map drive -o map.laz --raster dsm,dtm --resolution 0.5 --compare scene

    lidar map drive -o map.laz --poses estimate/trajectory.tum

    lidar map drive -o tiles --tiles 100 --voxel 0.1 --outliers 16,2

    Parameters
    ----------
    dataset
        Directory or URL of the dataset.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.tools.maps.aggregate import aggregate  # noqa: PLC0415
    from lidar.tools.maps.compare import LIMIT  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = aggregate(
            open_dataset(dataset), out, options=options, overwrite=report.overwrite, progress=progress
        )
    if report.json:
        counts: dict[str, Any] = {"points_in": summary.points_in, "points": summary.points}
        counts |= {"left_out": summary.left_out}
        counts |= {"frames": summary.frames, "missing_frames": summary.missing}
        counts |= {"poses": asdict(summary.poses) if summary.poses else None}
        counts |= {"beside": [str(path) for path in summary.beside]}
        counts |= {"distances": [asdict(row) for row in summary.distances], "notes": summary.notes}
        print_json({"path": str(out), **counts})
    else:
        left = [f"{n:,} of {_LEFT_OUT.get(name, f'--{name}')}" for name, n in summary.left_out.items() if n]
        print(
            f"{out}: {summary.points:,} of {summary.points_in:,} points from {summary.frames} frames"
            + (f"; left out: {', '.join(left)}" if left else "")
        )
        if summary.poses:
            print(
                f"poses: root mean square errors {summary.poses.horizontal_m:.3f} m horizontally,"
                f" {summary.poses.vertical_m:.3f} m vertically, {summary.poses.yaw_deg:.3f} degrees of yaw"
            )
        for row in summary.distances:
            print(
                f"  {row.name:20} {row.points:>12,} points  mean {1000 * row.mean_m:8.1f} mm"
                f"  median {1000 * row.median_m:8.1f} mm  95 % {1000 * row.p95_m:8.1f} mm"
                + (f"  farther than {LIMIT:g} m: {row.beyond / row.points:.1%}" if row.beyond else "")
            )
        for note in summary.notes:
            print(f"  {note}")
        if summary.beside:
            print(f"also written: {', '.join(map(str, summary.beside))}")
    if summary.missing:
        lost = ", ".join(f"{count} of {name}" for name, count in summary.missing.items())
        print(
            f"lidar: frames are missing: {lost}; was the drive stopped? The same command resumes it",
            file=sys.stderr,
        )
    return 0


_LEFT_OUT = {
    "noise": "noise (--noise keeps them)",
    "image": "points that no camera saw",
    "moving": "moving road users (--moving keeps them)",
    "poses": "times without poses",
    "time": "other times",
    "region": "other places",
    "only": "classes not in --only",
    "without": "classes in --without",
    "echo": "other echoes",
    "origin": "other origins",
    "outliers": "outliers",
}
"""Returns that maps leave out, by the reason."""


def convert(dataset: Path, /, *, out: Out, options: ConvertOptions, report: Reporting = Report()) -> int:
    """Write a dataset in the layout of another dataset, or its point clouds in another format.

    With a format of clouds, the result is the same dataset with its clouds in this format: those of a drive
    with --format, byte for byte, if the recorded format keeps all digits.

    For example:

    lidar drive scene --route random --rig nuscenes --traffic on --format pcd -o drive

    lidar convert drive --to nuscenes -o nuscenes

    lidar convert drive --to laz -o drive_laz

    lidar convert drive --to kitti -o odometry

    lidar convert drive --to ros2 -o bag

    Parameters
    ----------
    dataset
        Directory or URL of the dataset.
    out
        Directory to make.
    """
    from lidar.tools.convert import convert as converted  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = converted(dataset, out, to=options.to, overwrite=report.overwrite, progress=progress)
    counts = ", ".join(f"{count:,} {kind}" for kind, count in summary.counts.items())
    document = {"path": str(out), **summary.counts}
    return show(document, f"{out}: {counts}; {summary.hint}", json=report.json)


def apply(
    dataset: Path,
    /,
    *,
    options: ApplyOptions | None = None,
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Apply weather, attacks or other stages to a dataset, or to point clouds of KITTI or nuScenes.

    Stages before the detector take each recorded return as one echo, with the power that its intensity
    implies. Pulses without a return are known of datasets; in clouds of KITTI and nuScenes they fill the gaps
    between the returns of each ring.

    For example:

    lidar apply drive --stage dropped_packets:loss=0.02,burst=4 -o lossy

    lidar apply kitti/sequences/00 --stage cover_glass:transmission=0.7 -o dirty

    lidar apply drive --weather rain=10mm/h -o rainy

    Parameters
    ----------
    dataset
        Directory or URL of a dataset, or directory of velodyne*/*.bin (KITTI) or *.pcd.bin (nuScenes) files.
    out
        Directory to write to.
    """
    from lidar.tools.apply import apply_stages  # noqa: PLC0415

    options = options or ApplyOptions()
    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = apply_stages(dataset, out, options=options, overwrite=report.overwrite, progress=progress)
    if report.json:
        print_json({**asdict(summary), "path": str(out)})
    else:
        print(f"{out}: {summary.files} files, {summary.points:,} of {summary.points_in:,} points")
        print_effects(summary.effects)
        if summary.sight:
            by = {"scene": "rays in the scene", "returns": "recorded returns, without the scene"}
            print(f"line of sight to devices: by {by[summary.sight]}")
    return 0


def denoise(
    dataset: Path,
    /,
    *,
    options: DenoiseOptions,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Remove returns of rain and snow from recorded point clouds, and score filters against ground truth.

    For example:

    lidar denoise drive --method dror,lior,ddior

    lidar denoise drive --method dror:angle=0.2 -o clean

    Parameters
    ----------
    dataset
        Directory or URL of a dataset, or directory of velodyne*/*.bin (KITTI) or *.pcd.bin (nuScenes) files.
    out
        Directory to write the clouds to that the only method leaves.
    """
    from lidar.tools.denoise.denoise import denoise as denoised  # noqa: PLC0415
    from lidar.tools.denoise.filters import read_methods  # noqa: PLC0415

    methods = read_methods(options.methods)
    if out is not None:
        note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        found = denoised(dataset, methods, out=out, overwrite=report.overwrite, progress=progress)
    return show(found.to_json(), found.table().to_text(), json=report.json)


def odometry(dataset: Path, /, *, options: OdometryOptions, out: Out, report: Reporting = Report()) -> int:
    """Estimate the motion of the vehicle from recorded measurements, without ground truth.

    Writes trajectory.tum (TUM), trajectory.kitti (KITTI), poses.csv with standard deviations where the method
    states them, and odometry.json, which says what was done.

    For example:

    lidar odometry drive --method small_gicp -o estimate

    lidar odometry drive --method kiss-icp --set voxel=0.5 -o kiss

    lidar odometry drive --method stereo --sensor image_2 --sensor image_3 -o stereo

    lidar odometry drive --method fused --relative small_gicp -o fused

    Parameters
    ----------
    dataset
        Directory or URL of the dataset.
    out
        Directory to write to.
    """
    from lidar.tools.odometry.run import estimate_motion  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = estimate_motion(
            dataset, out, options=options, overwrite=report.overwrite, progress=progress
        )
    found = summary.to_json()
    figures = f"{found['poses']} poses by {options.method}, {summary.length_m:.1f} m"
    text = f"{out}: {figures}, in {summary.seconds:.1f} s"
    return show({"path": str(out), **found}, text, json=report.json)
