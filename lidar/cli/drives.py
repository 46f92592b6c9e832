"""Commands that record drives: one, a grid of them, with attacks, and with each setting."""

from __future__ import annotations

import sys
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from geoscene.errors import need
from geoscene.options import CloudOptions
from geoscene.support.console import (
    FAILURE,
    SEVERAL,
    Report,
    command_line,
    note_new_folder,
    print_json,
    whole,
)
from geoscene.support.progress import progress_bar
from lidar.cli.program import Out, Reporting, print_effects
from lidar.errors import InputError, LidarError
from lidar.options.accuracy import AccuracyOptions, TradeoffOptions
from lidar.options.drive import DriveOptions
from lidar.options.place import MAP, PlaceOptions
from lidar.options.shared import OUTPUT

if TYPE_CHECKING:
    from lidar.simulation.drive import Live
    from lidar.simulation.scene_source import OpenedScene


def drive(
    scene: Path | None = None,
    /,
    *,
    options: DriveOptions | None = None,
    place: PlaceOptions = PlaceOptions(),
    clouds: Annotated[CloudOptions, Parameter(group=MAP)] = CloudOptions(),
    wanted: AccuracyOptions = AccuracyOptions(),
    out: Out,
    live: Annotated[tuple[str, ...] | None, SEVERAL, Parameter(group=OUTPUT, metavar="[FILE.rrd]")] = None,
    report: Reporting = Report(),
) -> int:
    """Drive a route through a scene or a map, and record a dataset with the sensors of a rig.

    The same command resumes an interrupted drive; its files are those of an uninterrupted one, byte for
    byte. Of a map, the part that the drive needs is built first and kept for later drives; the recorded files
    are those of a drive in a scene of the whole map.

    For example:

    lidar drive scene --route random --duration 30 --seed 1 -o drive

    lidar drive city.osm.pbf --route random --duration 30 -o drive

    lidar drive scene --route 60.1662,24.9413 60.1655,24.9405 --rig vlp16 --format pcd,laz -o drive

    lidar drive scene --route track.gpx --rig my_rig.toml -o drive

    lidar drive scene --route drive/trajectory.csv --rig kitti --traffic on -o again

    lidar drive scene --rig drone --survey all --altitude 80 -o flight

    lidar drive scene --route random --rig vlp16 --accuracy 3cm -o drive

    lidar drive scene --route random --weather rain=10mm/h --road by-weather -o rain

    Parameters
    ----------
    scene
        Directory of the scene, or URL of one in object storage (s3://BUCKET/NAME, gs://), or a map: .osm,
        .osm.gz, .osm.bz2, .osm.pbf or Overpass JSON.
    out
        Directory or URL to write the dataset to.
    live
        Show clouds, images, boxes and the path in a viewer of Rerun while frames are recorded (extra live),
        or write them to FILE.rrd for it.
    """
    from geoscene.scene.layout import using  # noqa: PLC0415
    from geoscene.support.kernels import compile_ahead  # noqa: PLC0415
    from geoscene.support.storage import publish, shown, url_of  # noqa: PLC0415
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.simulation.scene_source import open_scene_or_map  # noqa: PLC0415
    from lidar.tools.tradeoff.accuracy import driven, pick_settings  # noqa: PLC0415

    options = options or DriveOptions()
    options.check_course()
    if wanted.resume and report.overwrite:
        raise InputError(
            "`resume` keeps files of the drive and `overwrite` deletes them; leave one of them out"
        )
    shows: AbstractContextManager[Live | None] = nullcontext()
    if live is not None:
        from lidar.tools.view.live import live_target, opened_live  # noqa: PLC0415

        shows = opened_live(live_target(live, overwrite=report.overwrite))
    if not url_of(out):
        note_new_folder(out)
    compile_ahead(*_uses(options, builds=scene is None or scene.is_file()), quiet=report.quiet)
    bar = partial(progress_bar, quiet=report.quiet)
    with bar() as progress:
        found = open_scene_or_map(scene, options, place=place, clouds=clouds, progress=progress)
    if not report.json:
        _print_built(found)
    with (
        using(found.scene, known=LidarError) as opened,
        publish(out, last="dataset.json", replaces=True, bar=bar) as folder,
    ):
        with bar() as progress:
            begun = None if report.overwrite else folder
            pick = pick_settings(opened, options, wanted=wanted, out=begun, progress=progress)
        if pick and not report.json:
            print(pick.to_text(), flush=True)
        with bar() as progress, shows as shown_live:
            done = driven(
                opened,
                folder,
                options=options,
                wanted=wanted,
                pick=pick,
                overwrite=report.overwrite,
                progress=progress,
                live=shown_live,
            )
        manifest = open_dataset(folder).manifest
    summary = done.summary
    document: dict[str, Any] = {
        "path": shown(out),
        "scene": found.scene.location,
        **({} if found.built is None else {"tiles_built": found.built}),
        "frames": summary.frames,
        "resumed": summary.resumed,
        "points": sum(summary.points.values()),
        "points_by_sensor": summary.points,
        "written": summary.written,
        "duration_s": summary.duration,
        "length_m": round(summary.length, 2),
        "wall_s": round(summary.wall, 2),
        "stages_s": {name: round(seconds, 3) for name, seconds in summary.stages.items()},
        **({"effects": summary.effects} if summary.effects else {}),
    }
    if pick or done.reached:
        document["accuracy"] = done.accuracy()
    if report.json:
        print_json(document)
    else:
        total = sum(summary.points.values())
        before = f" ({total - summary.written:,} recorded before)" if summary.resumed else ""
        print(
            f"{shown(out)}: {summary.duration:.1f} s, {summary.length:.0f} m, {summary.frames} frames,"
            f" {total:,} points{before} in {summary.wall:.1f} s;"
            f" next: {command_line('lidar', 'map', shown(out), '-o', 'map.laz')}"
        )
        print_effects(summary.effects if summary.written or not summary.resumed else {})
        if reached := done.to_text():
            print(reached)
    for missed in done.missed():
        print(f"lidar: {missed}", file=sys.stderr)
    for limit in manifest["limits"]:
        print(f"lidar: {limit['advice']}", file=sys.stderr)
    if empty := [name for name, count in manifest["sensor_frames"].items() if not count]:
        print(
            f"lidar: {', '.join(empty)}: no frame ends within {summary.duration:g} s, so nothing is recorded;"
            " drive longer, or set a higher rate_hz",
            file=sys.stderr,
        )
    for name in (name for name, points in summary.points.items() if not points and name not in empty):
        print(
            f"lidar: {name} has no returns in the whole drive; check its mount and maximum range",
            file=sys.stderr,
        )
    return 0


def _uses(options: DriveOptions, *, builds: bool) -> list[str]:
    """Uses of compiled functions that a drive has."""
    from lidar.sensors.rig.specs import load_rig  # noqa: PLC0415

    cameras, traffic = load_rig(options.rig).cameras, options.traffic
    return ["build"] * builds + ["drive"] + ["cameras"] * bool(cameras) + ["traffic"] * bool(traffic)


def _print_built(found: OpenedScene) -> None:
    """Say what of a map's scene was built for a drive."""
    if found.built is not None:
        tiles = len(found.scene.tile_indices)
        news = f"{found.built} of {tiles} tiles built" if found.built else f"{tiles} tiles, built before"
        print(f"scene {found.scene.path}: {news}", flush=True)


def sweep(
    file: Path,
    /,
    *,
    out: Out,
    workers: Annotated[int, Parameter(group=OUTPUT, converter=whole)] = 2,
    scheduler: Annotated[str, Parameter(group=OUTPUT, metavar="ADDRESS")] = "",
    report: Reporting = Report(),
) -> int:
    """Record a grid of drives: every combination of scenes, routes, seeds, rigs or other options.

    The same command resumes an interrupted sweep, and repeats only drives that failed. The bytes depend
    neither on the number of workers nor on where they are.

    For example:

    lidar sweep sweep.toml -o drives

    Parameters
    ----------
    file
        TOML file with the options of all drives in [drive], lists of values in [grid], and maps to build in
        [[map]]; docs/reference/sweeps.md has an example.
    out
        Directory to write to: a dataset for each drive, and the table sweep.json, also as sweep.csv.
    workers
        Processes; each records one drive at a time.
    scheduler
        Address of the scheduler of a Dask cluster (tcp://HOST:8786), whose workers record the drives instead;
        they need the scenes and the output folder under the same paths.
    """
    from lidar.tools.sweep import sweep as run_sweep  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = run_sweep(
            file, out, workers=workers, scheduler=scheduler, overwrite=report.overwrite, progress=progress
        )
    failed = summary.failed
    if report.json:
        print_json({"path": str(out), "drives": [asdict(row) for row in summary.rows]})
    else:
        points, length = (sum(r.points for r in summary.rows), sum(r.metres for r in summary.rows))
        done = len(summary.rows) - len(failed)
        print(f"{out}: {done} of {len(summary.rows)} drives, {length:,.0f} m, {points:,} points")
    for error in dict.fromkeys(row.error for row in failed):  # a map may fail many drives
        names = [row.name for row in failed if row.error == error]
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        print(f"lidar: {names[0]}{more}: {error}", file=sys.stderr)
    return FAILURE if failed else 0


def redteam(
    file: Path,
    /,
    *,
    out: Out,
    workers: Annotated[int, Parameter(group=OUTPUT, converter=whole)] = 2,
    report: Reporting = Report(),
) -> int:
    """Measure attacks against defences: success, detection at fixed false alarms, ROC, latency and cost.

    Each drive of a grid is recorded without attack and with each attack, and judged by all defences; one or
    more detectors of road users show which attacks succeed. Nothing is sent to any device. The same command
    resumes an interrupted matrix.

    For example:

    lidar redteam matrix.toml -o matrix

    Parameters
    ----------
    file
        TOML file with drives as for lidar sweep, attacks in [[attack]] and defences in [defences];
        docs/reference/security.md has an example.
    out
        Directory to write to: drives, redteam.json, CSV tables and the page redteam.html.
    workers
        Processes; each records or judges one drive at a time.
    """
    from lidar.tools.redteam import redteam as run_matrix  # noqa: PLC0415
    from lidar.tools.redteam.report import detection_tables, success_table  # noqa: PLC0415
    from lidar.tools.redteam.run import failed_drives  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = run_matrix(file, out, workers=workers, overwrite=report.overwrite, progress=progress)
    if report.json:
        print_json({"path": str(out), "drives": list(summary.drives), "failed": summary.failed})
    else:
        print(success_table(summary.matrix).to_text())
        for table in detection_tables(summary.matrix):
            print(f"\n{table.to_text()}")
        print(f"\n{out}: {len(summary.drives)} drives; page: {out / 'redteam.html'}")
    for line in failed_drives(summary.failed):
        print(f"lidar: {line}", file=sys.stderr)
    return FAILURE if summary.failed else 0


def tradeoff(
    scene: Path | None = None,
    /,
    *,
    options: DriveOptions | None = None,
    place: PlaceOptions = PlaceOptions(),
    clouds: Annotated[CloudOptions, Parameter(group=MAP)] = CloudOptions(),
    compared: TradeoffOptions = TradeoffOptions(),
    others: Annotated[tuple[Path, ...], Parameter(name="--scene", n_tokens=1)] = (),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Measure the error and the cost of each setting on a drive, and recommend the cheapest that is enough.

    Errors are differences from an exact reference, pulse by pulse, with 95 % intervals; costs are CPU time
    per simulated second, peak memory and bytes.

    For example:

    lidar tradeoff scene --route random --duration 10 --rig vlp16 -o tradeoff

    lidar tradeoff scene --route random --duration 10 --settings rays,poses --json

    Parameters
    ----------
    scene
        Directory of the scene, or a map, as for lidar drive.
    others
        Another scene of the same place and frame, built with other options, to compare with the first;
        repeat for more.
    out
        Folder to write tradeoff.json, tradeoff.html and a plot of each sensor to.
    """
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415
    from lidar.simulation.scene_source import open_scene_or_map  # noqa: PLC0415
    from lidar.tools.tradeoff.compare import compare_settings  # noqa: PLC0415
    from lidar.tools.tradeoff.report import document, to_text, write_report  # noqa: PLC0415
    from lidar.traffic.options import TrafficOptions  # noqa: PLC0415

    options = options or DriveOptions()
    options.check_course()
    if options.scheduler:
        raise InputError("`scheduler`: costs are those of this machine; leave it out")
    if out is not None:
        need("matplotlib", "plots")
        note_new_folder(out)
        if out.exists() and not report.overwrite:
            raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    with (
        progress_bar(quiet=report.quiet) as progress,
        ExitStack() as opened,
    ):
        needing = replace(options, traffic=options.traffic or TrafficOptions())  # it compares traffic, too
        found_scene = open_scene_or_map(scene, needing, place=place, clouds=clouds, progress=progress).scene
        scenes = [found_scene, *map(open_scene, others)]
        first, *rest = [opened.enter_context(using(s, known=LidarError)) for s in scenes]
        found = compare_settings(first, options, compared=compared, others=rest, progress=progress)
    if out is not None:
        write_report(found, out)
    if report.json:
        print_json(document(found))
    else:
        print(to_text(found))
    return 0
