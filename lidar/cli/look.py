"""Commands that present recorded data: descriptions, players, figures and films."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from geoscene.support.console import Report, note_new_folder, whole, with_flags
from geoscene.support.progress import progress_bar
from lidar.cli.program import JsonFlag, Out, QuietFlag, Reporting, app, show
from lidar.errors import InputError
from lidar.options.look import FilmOptions, PlaybackOptions, PlotOptions
from lidar.options.shared import OUTPUT
from lidar.tools.plots import FIGURES

_FIGURES = "; ".join(f"{row.name} ({row.meaning})" for row in FIGURES.values()) + "."

Plotted = Literal["range-image", "intensity", "returns", "speed", "coverage", "gnss"]
"""Names of figures, as in `FIGURES`."""


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
    from lidar.tools.info import describe  # noqa: PLC0415
    from lidar.tools.info_text import info_text  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        document = describe(dataset, full=full, progress=progress)
    return show(document, info_text(document), json=json)


def view(
    dataset: Path,
    /,
    *,
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    options: PlaybackOptions = PlaybackOptions(),
    serve: bool = False,
    port: Annotated[int | None, Parameter(converter=whole)] = None,
    open3d: bool = False,
    report: Reporting = Report(),
) -> int:
    """Play a drive in a browser: point cloud, images, bounding boxes, plan and speed in step.

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
        Port of the server, 8765 by default; 0 for a free one.
    open3d
        Write no file; open the first frame, or a file of points, in a window of Open3D (extra open3d).
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.tools.view.page import view_drive  # noqa: PLC0415

    if (out is not None) + serve + open3d != 1:
        raise InputError("give one of `out`, `serve` and `open3d`")
    if port is not None and not serve:
        raise InputError(f"`port` {port}: has no effect without `serve`; leave it out")
    if open3d:
        from lidar.tools.view.live import show_window  # noqa: PLC0415

        show_window(dataset, options=options)
        return 0
    if serve:
        return _serve(dataset, options, port=_PORT if port is None else port)
    assert out is not None  # noqa: S101
    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        summary = view_drive(
            open_dataset(dataset), out, options=options, overwrite=report.overwrite, progress=progress
        )
    images = f", {summary.images} images" if summary.images else ""
    figures = f"{summary.frames} frames, {summary.returns:,} returns{images}, {summary.bytes / 1e6:.1f} MB"
    notes = [f"  {with_flags(app, note)}" for note in summary.notes]
    document = {**asdict(summary), "path": str(out)}
    return show(document, "\n".join([f"{out}: {figures}", *notes]), json=report.json)


_PORT = 8765
"""Port of the player's server by default."""


def _serve(dataset: Path, options: PlaybackOptions, *, port: int) -> int:
    """Serve the player until interrupted."""
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.tools.view.page import DriveServer  # noqa: PLC0415

    with DriveServer(open_dataset(dataset), options=options, port=port) as server:
        print(f"{server.address} plays {len(server.drive)} frames of {dataset}; Ctrl+C ends it", flush=True)
        with suppress(KeyboardInterrupt):
            server.serve_forever()
    return 0


def plot(
    what: Annotated[Plotted, Parameter(help=_FIGURES)],
    dataset: Path,
    /,
    *,
    options: PlotOptions = PlotOptions(),
    out: Out,
    report: Reporting = Report(),
) -> int:
    """Plot a recorded drive.

    For example:

    lidar plot range-image drive -o sweep.png

    lidar plot coverage drive -o coverage.svg

    Parameters
    ----------
    dataset
        Directory or URL of the dataset.
    out
        PNG or SVG to write.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.tools.plots import plot as drawn  # noqa: PLC0415

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
    return show({"path": str(out), **found.numbers}, f"{out}: {found.note}", json=report.json)


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
    from lidar.tools.films.film import film  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress:
        made = film(
            open_dataset(dataset), out, options=options, overwrite=report.overwrite, progress=progress
        )
    pixels = f"{made.size[0]} x {made.size[1]} pixels"
    figures = f"{made.images} images of {pixels}, {made.seconds:.2f} s, {', '.join(made.shown)}"
    notes = [f"  {with_flags(app, note)}" for note in made.notes]
    document = {**asdict(made), "path": str(out)}
    return show(document, "\n".join([f"{out}: {figures}", *notes]), json=report.json)
