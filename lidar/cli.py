"""The `lidar` program: drive through scenes, and make maps of what was recorded."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter

from geoscene.console import main as run
from geoscene.console import print_json, progress_bar
from geoscene.errors import GeosceneError
from geoscene.errors import InputError as SceneInputError
from lidar import __version__
from lidar.errors import InputError, LidarError

app = App(
    name="lidar",
    version=__version__,
    suppress_keyboard_interrupt=False,
    help="""Drive vehicles with ray-cast sensors through scenes made by geoscene.

    lidar drive scene --route random --duration 20 -o drive

    lidar map drive -o map.laz
    """,
)
app.register_install_completion_command()

_OUTPUT = Group("Output", sort_key=3)


@app.command
def drive(
    scene: Path,
    /,
    *,
    route: Annotated[list[str], Parameter(consume_multiple=True, negative=())],
    duration: float | None = None,
    rig: str = "seed",
    vehicle: str = "",
    side: str = "right",
    seed: int = 0,
    start: str | None = None,
    fidelity: str = "standard",
    settings: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None,
    traffic: str | None = None,
    formats: Annotated[str, Parameter(name="--format", group=_OUTPUT)] = "pcd,laz",
    crs: Annotated[str, Parameter(group=_OUTPUT)] = "utm",
    exact: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    workers: Annotated[int, Parameter(group=_OUTPUT)] = 2,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
) -> int:
    """Drive a route through a scene and record what the rig senses.

    A run that was stopped goes on where it stopped when the same command is given again, and ends with the
    same bytes.

    For example:

    lidar drive scene --route random --duration 30 --seed 1 -o drive

    lidar drive scene --route 60.1699,24.9384 60.1755,24.9414 --rig vlp16 --format pcd,laz -o drive

    lidar drive scene --route track.gpx --rig my_rig.toml -o drive

    Parameters
    ----------
    scene
        Directory of the scene.
    route
        random, a GPX or GeoJSON file, or two or more waypoints as LAT,LON in degrees.
    duration
        Seconds to record; all of a given route, or 60 seconds of a random one, by default.
    rig
        Sensors and where they sit: seed, vlp16 or another rig that comes along, or a TOML file.
    vehicle
        car or another vehicle that comes along, or a TOML file; the rig's own by default.
    side
        Side of the road that is driven on: right or left.
    seed
        Of everything random.
    start
        UTC time of the drive's start, ISO 8601 (2026-06-21T08:00:00); it sets the sun and the time stamps.
        By default 10:00 local solar time on 21 June 2026.
    fidelity
        draft (one pose a frame, exact ranges), standard (a pose a pulse, exact ranges) or survey (beams with
        a size, several echoes, noise, lost and false returns).
    settings
        One effect set apart from the level, NAME=VALUE; again for more. An unknown name lists them all.
    traffic
        Other road users: on, or densities such as vehicles=20,parked=0.5,walkers=5,cyclists=2 (vehicles and
        cyclists per km of lane, walkers per km of sidewalk, parked as a share of the places).
    formats
        Formats of clouds, with commas: pcd, ply, csv (sensor frame), laz, las (georeferenced).
    crs
        CRS of LAZ files: utm, scene, or an EPSG code.
    exact
        Georeference every point through the full projection instead of a map that is within 0.1 mm of it.
    out
        Directory to write the dataset to.
    overwrite
        Replace a dataset that is there.
    workers
        Threads; the bytes do not depend on it.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from geoscene.scene import open_scene  # noqa: PLC0415
    from lidar.drive import DriveOptions  # noqa: PLC0415
    from lidar.drive import drive as record  # noqa: PLC0415

    options = DriveOptions(
        route=_route(route),
        duration=duration,
        rig=rig,
        vehicle=vehicle,
        formats=tuple(f for f in formats.lower().split(",") if f),
        seed=seed,
        start=_time(start) if start else None,
        crs=crs,
        exact=exact,
        side=side,
        fidelity=fidelity,
        settings=tuple(_setting(text) for text in settings or ()),
        traffic=_traffic(traffic),
        workers=workers,
    )
    with progress_bar(quiet=quiet) as progress:
        summary = record(open_scene(scene), out, options, overwrite=overwrite, progress=progress)
    document: dict[str, Any] = {
        "path": str(summary.path),
        "frames": summary.frames,
        "resumed": summary.resumed,
        "points": summary.points,
        "duration_s": summary.duration,
        "length_m": round(summary.length, 2),
        "wall_s": round(summary.wall, 2),
        "stages_s": {name: round(seconds, 3) for name, seconds in summary.stages.items()},
    }
    if json:
        print_json(document)
    else:
        print(
            f"{out}: {summary.duration:.1f} s, {summary.length:.0f} m, {summary.frames} frames,"
            f" {summary.points:,} points in {summary.wall:.1f} s; next: lidar map {out} -o map.laz"
        )
    return 0


def _route(words: list[str]) -> str | Path | list[tuple[float, float]]:
    given = [w.strip() for w in words if w.strip()]
    if given == ["random"]:
        return "random"
    points = [_point(word) for word in given]
    if len(given) == 1 and points[0] is None:
        return Path(given[0])
    if len(points) < 2 or any(p is None for p in points):
        raise InputError(f"--route {' '.join(given)}: random, a file, or two or more LAT,LON")
    return [p for p in points if p is not None]


def _point(word: str) -> tuple[float, float] | None:
    try:
        lat, lon = (float(v) for v in word.split(","))
    except ValueError:
        return None
    if not (abs(lat) <= 90 and abs(lon) <= 180):
        raise InputError(f"--route {word}: not a latitude and longitude in degrees")
    return lat, lon


def _traffic(text: str | None) -> Any:
    if text is None or text == "off":
        return None
    from lidar.actors import TrafficOptions  # noqa: PLC0415

    if text == "on":
        return TrafficOptions()
    known = ("vehicles", "cyclists", "walkers", "parked", "reach")
    pairs = [_setting(word) for word in text.split(",")] if "=" in text else [(text, "")]
    if unknown := [name for name, _ in pairs if name not in known]:
        raise InputError(f"--traffic {text}: {', '.join(unknown)} is none of on, off, {', '.join(known)}")
    try:
        given: dict[str, Any] = {name: float(value) for name, value in pairs}
        return TrafficOptions(**given)
    except ValueError as error:
        raise InputError(f"--traffic {text}: {error}") from None


def _setting(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise InputError(f"--set {text}: give NAME=VALUE, such as rays=7")
    return name.strip(), value.strip()


def _time(text: str) -> datetime:
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(f"--start {text}: not an ISO 8601 time such as 2026-06-21T08:00:00") from None
    return when.replace(tzinfo=UTC) if when.tzinfo is None else when.astimezone(UTC)


@app.command(name="map")
def map_(
    dataset: Path,
    /,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    voxel: float | None = None,
    color: str = "class",
    sensor: Annotated[list[str] | None, Parameter(consume_multiple=True, negative=())] = None,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
) -> int:
    """Put all clouds of a dataset into one georeferenced cloud.

    For example:

    lidar map drive -o map.laz

    lidar map drive -o map.ply --voxel 0.1 --color height

    Parameters
    ----------
    dataset
        Directory of the dataset.
    out
        File to write: .laz, .las, .ply or .pcd.
    voxel
        Side in metres of cubes that keep one return each; all returns by default.
    color
        What colours show: class, height, intensity or sensor.
    sensor
        Names of the scanners to take; all by default.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from lidar.dataset import open_dataset  # noqa: PLC0415
    from lidar.map import aggregate  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        summary = aggregate(
            open_dataset(dataset), out, voxel=voxel, color=color, sensors=sensor or (), progress=progress
        )
    if json:
        counts = {"points_in": summary.points_in, "points": summary.points, "frames": summary.frames}
        print_json({"path": str(out), **counts})
    else:
        print(f"{out}: {summary.points:,} of {summary.points_in:,} points from {summary.frames} frames")
    return 0


def main() -> None:
    """Run the program."""
    run(app, (LidarError, GeosceneError), (InputError, SceneInputError))


if __name__ == "__main__":
    main()
