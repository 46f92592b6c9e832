"""The `lidar` program: drive through scenes, and make maps of what was recorded."""

from __future__ import annotations

import sys
from contextlib import ExitStack, suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from geoscene.console import (
    DEFAULTS,
    FAILURE,
    SEVERAL,
    WORDS,
    Report,
    command_line,
    note_new_folder,
    print_json,
    progress_bar,
    whole,
    with_flags,
)
from geoscene.console import main as run
from geoscene.errors import GeosceneError
from geoscene.errors import InputError as SceneInputError
from lidar import __version__
from lidar.dataset.formats import map_suffixes
from lidar.errors import InputError, LidarError
from lidar.options import (
    OUTPUT,
    AccuracyOptions,
    ApplyOptions,
    ConvertOptions,
    DefendOptions,
    DenoiseOptions,
    DriveOptions,
    FilmOptions,
    MapOptions,
    PlaceOptions,
    PlaybackOptions,
    PlotOptions,
    SignOptions,
    TradeoffOptions,
)
from lidar.plots import FIGURES

if TYPE_CHECKING:
    from lidar.scene_cache import OpenedScene
    from lidar.signal.effects import Counts

app = App(
    name="lidar",
    version=__version__,
    default_parameter=DEFAULTS,
    suppress_keyboard_interrupt=False,
    help="""Drive vehicles with ray-cast sensors through scenes made by geoscene.

    lidar drive scene --route random --duration 20 -o drive

    lidar map drive -o map.laz

    lidar rigs, lidar sensors, lidar settings and lidar stages list the choices, lidar classes the codes.

    Accuracy and stability at the extremes on this machine: lidar selftest.
    """,
)
app.register_install_completion_command()

_FIGURES = "; ".join(
    [
        *(f"{row.name} ({row.meaning})" for row in FIGURES.values()),
        "weather (range by visibility, extinction and lost returns by rate, echoes of the air by range).",
    ]
)

Plotted = Literal["weather", "range-image", "intensity", "returns", "speed", "coverage", "gnss"]
"""Names of figures: `FIGURES`, and of models without a drive."""

Out = Annotated[Path, Parameter(name=["--out", "-o"], group=OUTPUT)]
Reporting = Annotated[Report, Parameter(group=OUTPUT)]
JsonFlag = Annotated[bool, Parameter(group=OUTPUT)]
QuietFlag = Annotated[bool, Parameter(name=["--quiet", "-q"], group=OUTPUT)]


@app.command
def drive(
    scene: Path | None = None,
    /,
    *,
    options: DriveOptions | None = None,
    place: PlaceOptions = PlaceOptions(),
    wanted: AccuracyOptions = AccuracyOptions(),
    out: Out,
    live: Annotated[tuple[str, ...] | None, SEVERAL, Parameter(group=OUTPUT, metavar="[FILE.rrd]")] = None,
    report: Reporting = Report(),
) -> int:
    """Drive a route through a scene or a map and record what the rig senses.

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
    from geoscene.storage import published, shown, url_of  # noqa: PLC0415
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.scene_cache import open_scene_or_map  # noqa: PLC0415
    from lidar.tradeoff.accuracy import driven, picked  # noqa: PLC0415
    from lidar.view.live import live_target, opened_live  # noqa: PLC0415

    options = options or DriveOptions()
    options.check_course()
    target = live_target(live, overwrite=report.overwrite)
    if not url_of(out):
        note_new_folder(out)
    bar = partial(progress_bar, quiet=report.quiet)
    with bar() as progress:
        found = open_scene_or_map(scene, options, place=place, progress=progress)
    if not report.json:
        _print_built(found)
    with (
        using(found.scene, known=LidarError) as opened,
        published(out, last="dataset.json", replaces=True, bar=bar) as folder,
    ):
        with bar() as progress:
            begun = None if report.overwrite else folder
            pick = picked(opened, options, wanted=wanted, out=begun, progress=progress)
        if pick and not report.json:
            print(pick.to_text(options.workers), flush=True)
        with bar() as progress, opened_live(target) as shown_live:
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
        limits = open_dataset(folder).manifest["limits"]
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
        document["accuracy"] = done.accuracy(options.workers)
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
        _print_effects(summary.effects if summary.written or not summary.resumed else {})
        if reached := done.to_text():
            print(reached)
    for missed in done.missed():
        print(f"lidar: {missed}", file=sys.stderr)
    for limit in limits:
        print(f"lidar: {limit['advice']}", file=sys.stderr)
    for name in (name for name, points in summary.points.items() if not points):
        print(
            f"lidar: {name} has no returns in the whole drive; check its mount and maximum range",
            file=sys.stderr,
        )
    return 0


def _print_effects(effects: Counts) -> None:
    """Say what each stage did."""
    from lidar.signal.effects import effect_lines  # noqa: PLC0415

    for line in effect_lines(effects):
        print(line)


def _print_built(found: OpenedScene) -> None:
    """Say what of a map's scene was built for a drive."""
    if found.built is not None:
        tiles = len(found.scene.tile_indices)
        news = f"{found.built} of {tiles} tiles built" if found.built else f"{tiles} tiles, built before"
        print(f"scene {found.scene.path}: {news}", flush=True)


@app.command
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
        [[map]]; docs/sweeps.md has an example.
    out
        Directory to write to: a dataset for each drive, and the table sweep.json, also as sweep.csv.
    workers
        Processes; each records one drive at a time.
    scheduler
        Address of the scheduler of a Dask cluster (tcp://HOST:8786), whose workers record the drives instead;
        they need the scenes and the output folder under the same paths.
    """
    from lidar.sweep import sweep as run_sweep  # noqa: PLC0415

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


@app.command
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
        docs/security.md has an example.
    out
        Directory to write to: drives, redteam.json, CSV tables and the page redteam.html.
    workers
        Processes; each records or judges one drive at a time.
    """
    from lidar.redteam import redteam as run_matrix  # noqa: PLC0415
    from lidar.redteam.report import detection_tables, success_rows  # noqa: PLC0415
    from lidar.redteam.run import failed_drives  # noqa: PLC0415
    from lidar.rig.catalog import columns  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = run_matrix(file, out, workers=workers, overwrite=report.overwrite, progress=progress)
    if report.json:
        print_json({"path": str(out), "drives": list(summary.drives), "failed": summary.failed})
    else:
        print(columns(success_rows(summary.matrix)))
        for title, table in detection_tables(summary.matrix):
            print(f"\n{title}\n{columns(table)}")
        print(f"\n{out}: {len(summary.drives)} drives; page: {out / 'redteam.html'}")
    for line in failed_drives(summary.failed):
        print(f"lidar: {line}", file=sys.stderr)
    return FAILURE if summary.failed else 0


@app.command
def tradeoff(
    scene: Path | None = None,
    /,
    *,
    options: DriveOptions | None = None,
    place: PlaceOptions = PlaceOptions(),
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
    from lidar.scene_cache import open_scene_or_map  # noqa: PLC0415
    from lidar.tradeoff.engine import tradeoff as measured  # noqa: PLC0415
    from lidar.tradeoff.report import document, print_tables, write_report  # noqa: PLC0415
    from lidar.traffic.populate import TrafficOptions  # noqa: PLC0415

    options = options or DriveOptions()
    options.check_course()
    if options.scheduler:
        raise InputError("`scheduler`: costs are those of this machine; leave it out")
    if out is not None:
        note_new_folder(out)
        if out.exists() and not report.overwrite:
            raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    with (
        progress_bar(quiet=report.quiet) as progress,
        ExitStack() as opened,
    ):
        needing = replace(options, traffic=options.traffic or TrafficOptions())  # it compares traffic, too
        found_scene = open_scene_or_map(scene, needing, place=place, progress=progress).scene
        scenes = [found_scene, *map(open_scene, others)]
        first, *rest = [opened.enter_context(using(s, known=LidarError)) for s in scenes]
        found = measured(first, options, compared=compared, others=rest, progress=progress)
    if out is not None:
        write_report(found, out)
    if report.json:
        print_json(document(found))
    else:
        print_tables(found)
    return 0


@app.command
def info(
    dataset: Path,
    /,
    *,
    full: Annotated[bool, Parameter(negative=())] = False,
    json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Describe recorded data: sensors, frames, points, gaps, stages, extent, sources, licence, size.

    For example:

    lidar info drive

    lidar info drive --full --json

    Parameters
    ----------
    dataset
        Directory or URL of a dataset, or directory with clouds of KITTI or nuScenes.
    full
        Read all clouds and tables, too: points by class, road users, rates of large tables.
    json
        Print all of it as JSON.
    quiet
        Show no progress bars.
    """
    from lidar.dataset.info import describe  # noqa: PLC0415
    from lidar.dataset.info_text import info_text  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        document = describe(dataset, full=full, progress=progress)
    if json:
        print_json(document)
    else:
        print(info_text(document))
    return 0


@app.command(name="map")
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
    """Aggregate all point clouds of a dataset into one georeferenced cloud.

    For example:

    lidar map drive -o map.laz

    lidar map drive -o map.ply --voxel 0.1 --color height

    lidar map drive -o empty.laz --without vehicles,pedestrian

    lidar map drive -o junction.laz --bbox 24.941,60.165,24.943,60.166 --time 0,10 --echo last

    lidar map drive -o map.laz --raster dsm,dtm --resolution 0.5 --compare scene

    lidar map drive -o map.laz --poses gnss+imu --refine

    lidar map drive -o tiles --tiles 100 --voxel 0.1 --outliers 16,2

    Parameters
    ----------
    dataset
        Directory or URL of the dataset.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.maps.aggregate import aggregate  # noqa: PLC0415
    from lidar.maps.compare import LIMIT  # noqa: PLC0415

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
        counts |= {"distances": [asdict(row) for row in summary.distances]}
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
                f"  median {1000 * row.median_m:8.1f}  95 % {1000 * row.p95_m:8.1f}"
                + (f"  farther than {LIMIT:g} m: {row.beyond / row.points:.1%}" if row.beyond else "")
            )
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


@app.command
def view(
    dataset: Path,
    /,
    *,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    options: PlaybackOptions = PlaybackOptions(),
    serve: bool = False,
    port: int = 8765,
    open3d: bool = False,
    report: Reporting = Report(),
) -> int:
    """Play a drive in a browser: the point cloud in step with images, boxes, plan and speed.

    For example:

    lidar view drive -o page.html

    lidar view drive -o short.html --frames 0:100 --every 2

    lidar view drive --serve

    lidar view map.laz --open3d

    The page needs no network and no server; open the file in any browser with WebGL 2.

    Parameters
    ----------
    dataset
        Directory or URL of the dataset; for a window of Open3D also a file of points.
    out
        File to write.
    serve
        Write no file; serve the player at 127.0.0.1 until interrupted, for drives of any length.
    port
        Port of the server; 0 for a free one.
    open3d
        Write no file; open the first frame, or a file of points, in a window of Open3D (extra open3d).
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.view.page import view_drive  # noqa: PLC0415

    if (out is not None) + serve + open3d != 1:
        raise InputError("give one of `out`, `serve` and `open3d`")
    if open3d:
        from lidar.view.window import show_window  # noqa: PLC0415

        show_window(dataset, options=options)
        return 0
    if serve:
        return _serve(dataset, options, port=port)
    assert out is not None  # noqa: S101
    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = view_drive(
            open_dataset(dataset), out, options=options, overwrite=report.overwrite, progress=progress
        )
    if report.json:
        print_json({**asdict(summary), "path": str(out)})
        return 0
    images = f", {summary.images} images" if summary.images else ""
    print(
        f"{out}: {summary.frames} frames, {summary.returns:,} returns{images}, {summary.bytes / 1e6:.1f} MB"
    )
    for note in summary.notes:
        print(f"  {with_flags(app, note)}")
    return 0


def _serve(dataset: Path, options: PlaybackOptions, *, port: int) -> int:
    """Serve the player until interrupted."""
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.view.server import DriveServer  # noqa: PLC0415

    with DriveServer(open_dataset(dataset), options=options, port=port) as server:
        print(f"{server.address} plays {len(server.drive)} frames of {dataset}; Ctrl+C ends it", flush=True)
        with suppress(KeyboardInterrupt):
            server.serve_forever()
    return 0


@app.command
def convert(
    dataset: Path,
    /,
    *,
    out: Out,
    options: ConvertOptions,
    report: Reporting = Report(),
) -> int:
    """Write a recorded drive in the layout of another dataset, or its clouds in another format.

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
    from lidar.conversion import convert as converted  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = converted(dataset, out, to=options.to, overwrite=report.overwrite, progress=progress)
    if report.json:
        print_json({"path": str(out), **summary.counts})
    else:
        counts = ", ".join(f"{count:,} {kind}" for kind, count in summary.counts.items())
        print(f"{out}: {counts}; {summary.hint}")
    return 0


@app.command
def apply(
    dataset: Path,
    /,
    *,
    options: ApplyOptions | None = None,
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Apply weather, attacks or other stages to recorded data: a dataset, or clouds of KITTI or nuScenes.

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
        Directory of a dataset, or of velodyne*/*.bin (KITTI) or *.pcd.bin (nuScenes) files.
    out
        Directory to write to.
    """
    from lidar.apply import apply_stages  # noqa: PLC0415

    options = options or ApplyOptions()
    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = apply_stages(dataset, out, options=options, overwrite=report.overwrite, progress=progress)
    if report.json:
        print_json({**asdict(summary), "path": str(out)})
    else:
        print(f"{out}: {summary.files} files, {summary.points:,} of {summary.points_in:,} points")
        _print_effects(summary.effects)
        if summary.sight:
            by = {"scene": "rays in the scene", "returns": "recorded returns, without the scene"}
            print(f"line of sight to devices: by {by[summary.sight]}")
    return 0


@app.command
def plot(
    what: Annotated[Plotted, Parameter(help=_FIGURES)],
    dataset: Path | None = None,
    /,
    *,
    options: PlotOptions = PlotOptions(),
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Plot a recorded drive, or models of weather against published values.

    For example:

    lidar plot range-image drive -o sweep.png

    lidar plot coverage drive -o coverage.svg

    lidar plot weather --sensor vlp16 -o weather.png

    Parameters
    ----------
    dataset
        Directory or URL of the dataset; none for weather.
    out
        PNG or SVG to write.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.plots import plot as drawn  # noqa: PLC0415

    if what == "weather":
        if dataset is not None:
            raise InputError(f"`dataset` {dataset}: weather is plotted without one; leave it out")
        return _plot_weather(options, out, report=report)
    if dataset is None:
        raise InputError(f"`dataset`: give the drive to plot: lidar plot {what} DRIVE -o {out}")
    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        found = drawn(
            open_dataset(dataset),
            what,
            out=out,
            options=options,
            overwrite=report.overwrite,
            progress=progress,
        )
    if report.json:
        print_json({"path": str(out), **found.numbers})
    else:
        print(f"{out}: {found.note}")
    return 0


@app.command
def animate(
    dataset: Path,
    /,
    *,
    options: FilmOptions = FilmOptions(),
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Make a film of a recorded drive: sweeps, camera images and the growing map, in the drive's own time.

    For example:

    lidar animate drive -o drive.gif --size 640x360 --frames 0:20

    lidar animate drive -o drive.mp4 --show sweep --view top --color intensity

    lidar animate drive -o map.mp4 --show map --speed 4

    Parameters
    ----------
    dataset
        Directory or URL of the dataset.
    out
        MP4 (extra video) or GIF to write.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.films.film import film  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        made = film(
            open_dataset(dataset), out, options=options, overwrite=report.overwrite, progress=progress
        )
    if report.json:
        print_json({**asdict(made), "path": str(out)})
        return 0
    print(
        f"{out}: {made.images} images of {made.size[0]} x {made.size[1]} pixels, {made.seconds:.2f} s,"
        f" {', '.join(made.shown)}"
    )
    for note in made.notes:
        print(f"  {with_flags(app, note)}")
    return 0


def _plot_weather(options: PlotOptions, out: Path, *, report: Report) -> int:
    """Plot models of weather against published values."""
    from geoscene.files import write_atomically  # noqa: PLC0415
    from lidar.plots import check_out  # noqa: PLC0415
    from lidar.rig.scanner import load_sensor  # noqa: PLC0415
    from lidar.weather.figures import weather_figure  # noqa: PLC0415

    if options.frames or options.resolution is not None:
        raise InputError("`frames` and `resolution` are of drives; leave them out for weather")
    check_out(out, overwrite=report.overwrite)
    name = options.sensor or "hdl64e_s2"
    scanner = load_sensor(Path(name) if name.endswith(".toml") else name)
    note_new_folder(out)
    write_atomically(out, weather_figure(scanner).encoded(out.suffix.lower()))
    if report.json:
        print_json({"path": str(out)})
    else:
        print(f"{out}: weather and a {scanner.maker} {scanner.model}")
    return 0


@app.command
def denoise(
    dataset: Path,
    /,
    *,
    options: DenoiseOptions,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Remove the returns of rain and snow from recorded clouds, and score filters where the truth is known.

    For example:

    lidar denoise drive --method dror,lior,ddior

    lidar denoise drive --method dror:angle=0.2 -o clean

    Parameters
    ----------
    dataset
        Directory of a dataset, or of velodyne*/*.bin (KITTI) or *.pcd.bin (nuScenes) files.
    out
        Directory to write the clouds to that the only method leaves.
    """
    from lidar.denoise.denoise import denoise as denoised  # noqa: PLC0415
    from lidar.denoise.filters import read_methods  # noqa: PLC0415
    from lidar.rig.catalog import columns  # noqa: PLC0415

    methods = read_methods(options.methods)
    if out is not None:
        note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        found = denoised(dataset, methods, out=out, overwrite=report.overwrite, progress=progress)
    if report.json:
        print_json(found.to_json())
    else:
        print(columns(found.table()))
    return 0


@app.command
def defend(
    *datasets: Path,
    options: DefendOptions,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Judge recorded frames by defences against spoofing, and score the verdicts where the truth is known.

    Defences see what the sensors measured, never labels or truth files. Thresholds are those that a stated
    share of genuine returns, objects and frames passes.

    For example:

    lidar defend drive --defence occlusion,shadow -o verdicts

    lidar defend drive --defence all --fuse max --json

    lidar defend drive --defence shadow --detector learned --calibrate -o learned.toml

    lidar defend drive --defence all --calibrate -o calibration.toml

    Parameters
    ----------
    datasets
        Directories or URLs of datasets, which are judged together.
    out
        Directory to write the verdicts to: defend.json, frames.csv, objects.csv and an archive of suspicions
        of returns per frame; with --calibrate the TOML file.
    """
    from geoscene.scene import open_scene  # noqa: PLC0415
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.defences.calibration import read_calibration  # noqa: PLC0415
    from lidar.defences.defend import calibrate, score_rows  # noqa: PLC0415
    from lidar.defences.defend import defend as judged  # noqa: PLC0415
    from lidar.defences.registry import read_defences  # noqa: PLC0415
    from lidar.detection.registry import read_detector  # noqa: PLC0415

    if not datasets:
        raise InputError("`datasets`: give one or more")
    if options.calibrate and out is None:
        raise InputError("`calibrate`: give `out`, the file to write")
    if out is not None:
        note_new_folder(out)
    if options.calibrate and out is not None and (out.is_dir() or (out.exists() and not report.overwrite)):
        what = (
            "is a directory; give a file" if out.is_dir() else "exists already; set `overwrite` to replace it"
        )
        raise InputError(f"{out}: {what}")
    chosen, detector = read_defences(options.defences), read_detector(options.detector)
    opened = [open_dataset(path) for path in datasets]
    scene = None if options.scene is None else open_scene(options.scene)
    if options.calibrate and out is not None:
        with progress_bar(quiet=report.quiet) as progress:
            made = calibrate(
                opened,
                chosen,
                detector=detector,
                scene=scene,
                out=out,
                seed=options.seed,
                progress=progress,
            )
        if report.json:
            print_json({"path": str(out), "note": made.note})
        else:
            print(f"{out}: {made.note}")
        return 0
    calibration = read_calibration(options.calibration, detector=detector)
    with progress_bar(quiet=report.quiet) as progress:
        found = judged(
            opened,
            chosen,
            calibration=calibration,
            detector=detector,
            rule="" if options.fuse == "none" else options.fuse,
            scene=scene,
            out=out,
            overwrite=report.overwrite,
            seed=options.seed,
            progress=progress,
        )
    if report.json:
        print_json(found.document())
    else:
        from lidar.rig.catalog import columns  # noqa: PLC0415

        print(columns(score_rows(found)))
    return 0


@app.command
def train(
    *datasets: Path,
    out: Out,
    seed: Annotated[int, Parameter(converter=whole)] = 0,
    trees: Annotated[int, Parameter(converter=whole)] = 60,
    every: Annotated[int, Parameter(converter=whole)] = 1,
    workers: Annotated[int, Parameter(group=OUTPUT, converter=whole)] = 2,
    report: Reporting = Report(),
) -> int:
    """Train a detector of road users on the labelled clouds of drives.

    Needs scikit-learn (pip install 'geoscene[learn]'); what uses the model does not.

    For example:

    lidar train drive1 drive2 drive3 -o model.npz

    Parameters
    ----------
    datasets
        Directories of datasets with traffic, recorded without attacks.
    out
        File to write the model to, for --detector of lidar defend and detector of lidar redteam.
    seed
        Seed of the forest. The same data, options and seed give the same file.
    trees
        Trees of the forest.
    every
        Use each frame of that number: those that follow each other are nearly the same.
    workers
        Processes that read the clouds. The model does not depend on it.
    """
    from lidar.rig.catalog import columns  # noqa: PLC0415
    from lidar.train import train as trained  # noqa: PLC0415

    if not datasets:
        raise InputError("`datasets`: give one or more")
    if out.is_dir() or (out.exists() and not report.overwrite):
        raise InputError(f"{out}: exists already; set `overwrite` to replace it, or give another file")
    with progress_bar(quiet=report.quiet) as progress:
        made = trained(datasets, out, seed=seed, trees=trees, every=every, workers=workers, progress=progress)
    if report.json:
        print_json(made.to_json())
    else:
        print(columns(made.table()))
        print(f"{out}: {made.frames} frames; next: lidar defend {datasets[0]} --detector {out} ...")
    return 0


@app.command
def defences(*, json: JsonFlag = False) -> int:
    """List the defences against spoofing, with their parameters.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from lidar.defences.registry import defence_rows  # noqa: PLC0415
    from lidar.rig.catalog import columns  # noqa: PLC0415

    rows = defence_rows()
    if json:
        print_json({"defences": rows})
        return 0
    cells = [["name", "parameter", "default", "from", "to", "meaning"]]
    for row in rows:
        needs = f" Needs: {', '.join(row['needs'])}." if row["needs"] else ""
        past = f" Earlier frames: {row['history']}." if row["history"] else ""
        cells.append([row["name"], "", "", "", "", f"{row['meaning']}{needs}{past}"])
        for p in row["parameters"]:
            ends = [f"{p[end]:g}" if end in p else "" for end in ("low", "high")]
            cells.append(["", p["name"], str(p["default"]), *ends, p["meaning"]])
    print(columns(cells))
    print(
        "\nlidar defend DATASET --defence NAME,NAME:KEY=VALUE:KEY=VALUE judges recorded data"
        "\n(docs/defences.md)."
    )
    return 0


@app.command
def tamper(
    dataset: Path,
    /,
    *,
    replace: Annotated[tuple[str, ...], SEVERAL] = (),
    by: Path | None = None,
    freeze: bool = False,
    shift: Annotated[tuple[str, ...], SEVERAL] = (),
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Replace recorded files by those of other frames or drives, and shift time stamps between sensors.

    For attacks on what is stored; tamper.truth.csv tells what was done. Other attacks on recorded data are
    stages: lidar apply --attack.

    For example:

    lidar tamper drive --replace lidar_top:1-1=0 --shift lidar_top=0.05 -o tampered

    Parameters
    ----------
    dataset
        Directory of the dataset.
    replace
        Frames and the first of those that replace them: SENSOR:FIRST-LAST=SOURCE; repeat for more.
    by
        Directory of the dataset that these are taken from; the same one by default.
    freeze
        Repeat the first of them.
    shift
        Sensor and the seconds by which its time stamps are later: SENSOR=SECONDS; repeat for more.
    out
        Directory to write to.
    """
    from lidar.tamper import read_replacement, read_shift  # noqa: PLC0415
    from lidar.tamper import tamper as tampered  # noqa: PLC0415

    note_new_folder(out)
    done = tampered(
        dataset,
        out,
        replacements=[read_replacement(text) for text in replace],
        by=by or "",
        freeze=freeze,
        shifts=[read_shift(text) for text in shift],
        overwrite=report.overwrite,
    )
    if report.json:
        print_json({**asdict(done), "path": str(out)})
    else:
        shifts = "".join(f"; {name} is {ns / 1e9:g} s late" for name, ns in done.shifts.items())
        print(f"{out}: {done.files} files replaced{shifts}")
    return 0


@app.command
def sign(
    dataset: Path,
    /,
    *,
    options: SignOptions = SignOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Sign recorded data: a watermark in point clouds, a signed hash chain over files, or both.

    For example:

    lidar sign drive --watermark secret.key --chain secret.key -o signed

    lidar sign drive --chain private.pem

    lidar sign kitti/sequences/00 --watermark secret.key --chain secret.key -o signed_kitti

    Parameters
    ----------
    dataset
        Directory of a dataset, or of velodyne*/*.bin (KITTI) or *.pcd.bin (nuScenes) files.
    out
        Directory to write to; without it, the hash chain is added to the dataset itself.
    """
    from lidar.integrity.keys import read_secret, read_signer  # noqa: PLC0415
    from lidar.integrity.watermark import Watermark  # noqa: PLC0415
    from lidar.sign import sign_dataset  # noqa: PLC0415

    if out is not None:
        note_new_folder(out)
    mark = None if options.watermark is None else Watermark(read_secret(options.watermark), options.step)
    signer = None if options.chain is None else read_signer(options.chain)
    with progress_bar(quiet=report.quiet) as progress:
        summary = sign_dataset(
            dataset, out, watermark=mark, signer=signer, overwrite=report.overwrite, progress=progress
        )
    if report.json:
        print_json({**asdict(summary), "path": str(summary.path)})
    else:
        parts = [f"watermark in {summary.marked} clouds, points moved by {summary.rms * 1000:.1f} mm rms"]
        chained = f"{summary.frames} frames and {summary.files} files in a signed hash chain"
        parts = (parts if mark else []) + ([chained] if signer else [])
        print(f"{summary.path}: {'; '.join(parts)}")
    return 0


@app.command
def verify(
    dataset: Path,
    /,
    *,
    options: SignOptions = SignOptions(),
    noise: float = 0.001,
    false_alarms: float = 0.01,
    json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Find files that were changed, lost or added, and with keys what was tampered with in signed data.

    Without keys all files are compared with checksums.sha256. With keys the watermark, the signed hash chain
    or both are verified: files, frames, blocks of a ring by 10 degrees, points. Exits with 1 if anything is
    found.

    For example:

    lidar verify drive

    lidar verify signed --watermark secret.key --chain secret.key

    Parameters
    ----------
    dataset
        Directory of the dataset or export, or of clouds of KITTI or nuScenes; without keys also a URL.
    noise
        Standard deviation in metres that coordinates got since the watermark, such as by another format.
    false_alarms
        Blocks a cloud that the watermark's test may report without tampering, on average.
    json
        Print all findings as JSON.
    quiet
        Show no progress bars.
    """
    from lidar.integrity.keys import read_secret, read_signer  # noqa: PLC0415
    from lidar.integrity.watermark import Watermark  # noqa: PLC0415
    from lidar.verify import verify_dataset  # noqa: PLC0415

    mark = None if options.watermark is None else Watermark(read_secret(options.watermark), options.step)
    signer = None if options.chain is None else read_signer(options.chain)
    with progress_bar(quiet=quiet) as progress:
        found = verify_dataset(
            dataset,
            watermark=mark,
            signer=signer,
            noise=noise,
            false_alarms=false_alarms,
            progress=progress,
        )
    if json:
        print_json(found.to_json())
    else:
        print("\n".join(found.to_text(str(dataset))))
    return 0 if found.intact else FAILURE


@app.command
def stages(*, json: JsonFlag = False) -> int:
    """List the stages, weather and attacks among them, that change what sensors measure: their parameters.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from lidar.rig.catalog import columns  # noqa: PLC0415
    from lidar.signal.registry import stage_rows  # noqa: PLC0415

    rows = stage_rows()
    if json:
        print_json({"stages": rows})
        return 0
    cells = [["name", "parameter", "default", "from", "to", "meaning"]]
    for row in rows:
        meaning = f"{row['meaning']} Acts on: {', '.join(row['acts_on'])}."
        cells.append([row["name"], "", "", "", "", meaning])
        for p in row["parameters"]:
            ends = [f"{p[end]:g}" if end in p else "" for end in ("low", "high")]
            cells.append(["", p["name"], str(p["default"]), *ends, p["meaning"]])
    print(columns(cells))
    print(
        "\nEvery stage also takes seed (of its random numbers; the drive's by default) and sensor (the only"
        "\none that it acts on): lidar drive SCENE --stage NAME:KEY=VALUE,KEY=VALUE"
        "\n(docs/stages.md). Attacks, from inject to patch, are also values of --attack (docs/attacks.md);"
        "\nweather has shorter texts for --weather (docs/weather.md)."
    )
    return 0


@app.command
def rigs(*, json: JsonFlag = False) -> int:
    """List the built-in rigs.

    Parameters
    ----------
    json
        Print them as JSON, with all their values.
    """
    from lidar.rig.catalog import columns, rig_rows  # noqa: PLC0415

    rows = rig_rows()
    if json:
        print_json({"rigs": rows})
        return 0
    cells = [["name", "vehicle", "scanners", "cameras", "source"]]
    for row in rows:
        scanners = " ".join(row["lidars"].values())
        cells.append([row["name"], row["vehicle"], scanners, str(len(row["cameras"])), row["source"]])
    print(columns(cells))
    print("\nA rig of your own is a TOML file: lidar drive SCENE --rig FILE.toml (see docs/sensors.md).")
    return 0


@app.command
def sensors(*, json: JsonFlag = False) -> int:
    """List the built-in laser scanners.

    Parameters
    ----------
    json
        Print them as JSON, with the source of every number.
    """
    from lidar.rig.catalog import columns, sensor_rows  # noqa: PLC0415

    rows = sensor_rows()
    if json:
        print_json({"sensors": rows})
        return 0
    cells = [["name", "maker and model", "kind", "channels", "pulses/s", "Hz", "range m", "nm"]]
    for row in rows:
        reach = f"{row['min_range_m']:g}-{row['max_range_m']:g}"
        figures = [str(row["channels"]), f"{row['pulses_per_s']:,}", f"{row['rate_hz']:g}", reach]
        model = f"{row['maker']} {row['model']}"
        cells.append([row["name"], model, row["kind"], *figures, f"{row['wavelength_nm']:g}"])
    print(columns(cells))
    print(
        "\n--json adds the source of every number; a sensor of your own is a TOML file (see docs/sensors.md)."
    )
    return 0


@app.command
def classes(*, json: JsonFlag = False) -> int:
    """List the classes of points and pixels with their codes, also those of other datasets, and materials.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from geoscene.classes import class_rows, materials  # noqa: PLC0415
    from lidar.rig.catalog import columns  # noqa: PLC0415

    rows, surfaces = class_rows(), {m.name: m.code for m in materials().values()}
    if json:
        print_json({"classes": rows, "materials": surfaces})
        return 0
    print(columns([list(rows[0]), *([str(value) for value in row.values()] for row in rows)]))
    print("\nMaterials: " + ", ".join(f"{code} {name}" for name, code in surfaces.items()))
    return 0


@app.command
def settings(*, json: JsonFlag = False) -> int:
    """List the fidelity settings: their values at each level and their effect.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from lidar.rig.catalog import columns  # noqa: PLC0415
    from lidar.settings import levels, list_settings  # noqa: PLC0415

    rows = list_settings()
    if json:
        documents = [
            {"name": s.name, "of": s.of, **dict(zip(levels(), s.values, strict=True)), "meaning": s.meaning}
            for s in rows
        ]
        print_json({"settings": documents})
        return 0
    cells = [[s.name, s.of, *s.values, s.meaning] for s in rows]
    print(columns([["name", "of", *levels(), "meaning"], *cells]))
    print(
        "\n--fidelity takes a level, --set NAME=VALUE changes one setting. Separate options: --exact"
        "\n(the full projection for every point), --deskew, --crs; of scenes: geoscene build --lod, --dem,"
        "\n--along."
    )
    return 0


@app.command
def selftest(
    *,
    only: Annotated[tuple[str, ...], WORDS] = (),
    full: bool = False,
    json: JsonFlag = False,
    markdown: bool = False,
    quiet: QuietFlag = False,
) -> int:
    """Check on this machine that errors stay within documented bounds in extreme cases.

    Such as grazing rays, ranges of 100 km, places near the poles and zone borders, long drives and large
    scenes; docs/extremes.md lists them. Takes about 10 s. Exits with 1 if a bound does not hold.

    For example:

    lidar selftest --only places

    Parameters
    ----------
    only
        Groups of cases: rays, places, footprints, time, statistics, scale. All by default.
    full
        Measure as many samples as in the documentation, up to 100 million a case; takes tens of minutes.
    json
        Print the table and the machine as JSON.
    markdown
        Print the table as in docs/extremes.md.
    quiet
        Show no progress bars.
    """
    from lidar.selftest import run as extremes  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        done = list(extremes.outcomes(only, full=full, progress=progress))
    broken = sum(not one.ok for one in done)
    if json:
        print_json(extremes.document(done))
    elif markdown:
        print(extremes.markdown(done))
    else:
        extremes.print_table(done)
    if broken:
        print(f"lidar: {broken} of {len(done)} bounds do not hold on this machine", file=sys.stderr)
    return FAILURE if broken else 0


def main() -> None:
    """Run the program."""
    run(app, (LidarError, GeosceneError), usage=(InputError, SceneInputError))


if __name__ == "__main__":
    main()
