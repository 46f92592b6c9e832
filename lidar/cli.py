"""The `lidar` program: drive through scenes, and make maps of what was recorded."""

from __future__ import annotations

import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter

from geoscene.console import main as run
from geoscene.console import print_json, progress_bar, whole
from geoscene.errors import GeosceneError
from geoscene.errors import InputError as SceneInputError
from lidar import __version__
from lidar.dataset.export import EXPORTERS, exporter
from lidar.dataset.formats import FORMATS, LABELS
from lidar.errors import InputError, LidarError

app = App(
    name="lidar",
    version=__version__,
    suppress_keyboard_interrupt=False,
    help="""Drive vehicles with ray-cast sensors through scenes made by geoscene.

    lidar drive scene --route random --duration 20 -o drive

    lidar map drive -o map.laz

    lidar rigs, lidar sensors, lidar settings and lidar stages list what there is to choose from.
    """,
)
app.register_install_completion_command()

_OUTPUT = Group("Output", sort_key=3)


def _format_help() -> str:
    names: dict[str, list[str]] = {"sensor": [], "world": []}
    for row in FORMATS.values():
        names[row.frame].append(row.name)
    return (
        f"Point-cloud formats, with commas: {', '.join(names['sensor'])} (sensor frame),"
        f" {', '.join(names['world'])} (georeferenced)."
    )


def _label_help() -> str:
    return f"Label files in the codes of other datasets, with commas: {', '.join(LABELS)}."


def _exporter_help() -> str:
    return "Layout: " + "; ".join(f"{row.name} ({row.meaning})" for row in EXPORTERS.values()) + "."


@app.command
def drive(
    scene: Path,
    /,
    *,
    route: Annotated[list[str] | None, Parameter(consume_multiple=True, negative=())] = None,
    survey: str = "",
    altitude: float | None = None,
    overlap: float = 0.3,
    turns: Annotated[bool, Parameter(negative=())] = False,
    duration: float | None = None,
    from_rest: Annotated[bool, Parameter(negative=())] = False,
    rig: str = "seed",
    vehicle: str = "",
    side: str = "",
    seed: Annotated[int, Parameter(converter=whole)] = 0,
    start: str | None = None,
    fidelity: str = "standard",
    settings: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None,
    traffic: str | None = None,
    stage: Annotated[list[str] | None, Parameter(negative=())] = None,
    formats: Annotated[str, Parameter(name="--format", group=_OUTPUT, help=_format_help())] = "pcd,laz",
    labels: Annotated[str, Parameter(group=_OUTPUT, help=_label_help())] = "",
    deskew: Annotated[str, Parameter(group=_OUTPUT)] = "",
    crs: Annotated[str, Parameter(group=_OUTPUT)] = "utm",
    exact: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    workers: Annotated[int, Parameter(group=_OUTPUT, converter=whole)] = 2,
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

    lidar drive scene --route drive/trajectory.csv --rig kitti --traffic on -o again

    lidar drive scene --rig drone --survey all --altitude 80 -o flight

    Parameters
    ----------
    scene
        Directory of the scene.
    route
        random, a GPX or GeoJSON file, two or more waypoints as LAT,LON in degrees, or the trajectory.csv or
        poses.csv of an earlier drive, which is then driven again as it was.
    survey
        For what flies, instead of a route: all, W,S,E,N in degrees, or a GeoJSON file with a polygon, which
        is flown over in strips.
    altitude
        Metres above the ground of a flight; by default heights in the route's file, or 60 (drone) or 600.
    overlap
        Share of a survey's strip that the next one covers too.
    turns
        Scan in the turns between a survey's strips too; by default scanners work from a second before each
        strip to a second after it, as survey crews have it, and the clouds between are empty.
    duration
        Seconds to record; all of a given route, or 60 seconds of a random one, by default.
    from_rest
        Start and end a random drive at rest, as drives along a given route do; by default it is under way
        when the record starts and when it ends.
    rig
        Sensors and where they sit: a rig that comes along (lidar rigs lists them), or a TOML file.
    vehicle
        car, van, robot, backpack, drone, aircraft, or a TOML file; the rig's own by default.
    side
        Side of the road that is driven on, right or left; the scene's without.
    seed
        Of everything random: a whole number from 0 on.
    start
        UTC time of the drive's start, ISO 8601 (2026-06-21T08:00:00); it sets the sun and the time stamps.
        By default 10:00 local solar time on 21 June 2026.
    fidelity
        draft (one pose a frame, exact ranges, no shadows), standard (a pose a pulse, exact ranges) or survey
        (beams with a size, several echoes, noise, lost and false returns; image noise).
    settings
        One setting that differs from the level, NAME=VALUE; repeat for more. lidar settings lists them.
    traffic
        Other road users: on, or densities such as vehicles=20,parked=0.5,pedestrians=5,cyclists=2 (vehicles
        and cyclists per km of lane, pedestrians per km of sidewalk, parked as a share of the places);
        sumo or sumo,vehicles=20,...: the same densities, simulated by SUMO; or a file that sumo --fcd-output
        wrote, with net=FILE.net.xml, begin=SECONDS, parked=0.6 as needed.
    stage
        Change echoes, clouds or images by a stage: NAME, NAME:KEY=VALUE,KEY=VALUE or a TOML file with tables
        [[stage]]; again for more. lidar stages lists them all.
    deskew
        Clouds of the sensor frame a second time, all points brought to one moment of the frame: start, middle
        or end.
    crs
        CRS of LAZ files: utm, scene, or an EPSG code.
    exact
        Georeference every point through the full projection instead of a map that is within 0.1 mm of it.
    out
        Directory to write the dataset to.
    overwrite
        Replace a dataset that is there.
    workers
        Threads, a frame each, no more than there are cores; the bytes do not depend on it.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from lidar.drive import drive as record  # noqa: PLC0415
    from lidar.options import DriveOptions  # noqa: PLC0415
    from lidar.signal.registry import read_stages  # noqa: PLC0415

    if bool(route) == bool(survey):
        raise InputError("give one of --route and --survey, such as --route random")
    options = DriveOptions(
        route=_route(route or ["random"]),
        survey=survey,
        altitude=altitude,
        overlap=overlap,
        turns=turns,
        duration=duration,
        from_rest=from_rest,
        rig=rig,
        vehicle=vehicle,
        formats=_words(formats),
        labels=_words(labels),
        deskew=deskew.lower(),
        seed=seed,
        start=_time(start) if start else None,
        crs=crs,
        exact=exact,
        side=side,
        fidelity=fidelity,
        settings=tuple(_setting(text) for text in settings or ()),
        traffic=_traffic(traffic),
        stages=read_stages(stage or ()).stages,
        workers=workers,
    )
    with progress_bar(quiet=quiet) as progress:
        summary = record(open_scene(scene), out, options=options, overwrite=overwrite, progress=progress)
    document: dict[str, Any] = {
        "path": str(summary.path),
        "frames": summary.frames,
        "resumed": summary.resumed,
        "points": sum(summary.points.values()),
        "points_by_sensor": summary.points,
        "written": summary.written,
        "duration_s": summary.duration,
        "length_m": round(summary.length, 2),
        "wall_s": round(summary.wall, 2),
        "stages_s": {name: round(seconds, 3) for name, seconds in summary.stages.items()},
    }
    if json:
        print_json(document)
    else:
        total = sum(summary.points.values())
        there = f" ({total - summary.written:,} were there)" if summary.resumed else ""
        print(
            f"{out}: {summary.duration:.1f} s, {summary.length:.0f} m, {summary.frames} frames,"
            f" {total:,} points{there} in {summary.wall:.1f} s; next: lidar map {out} -o map.laz"
        )
    for name in (name for name, points in summary.points.items() if not points):
        print(
            f"lidar: {name} saw nothing in the whole drive; is anything within its range, where it looks?",
            file=sys.stderr,
        )
    return 0


def _words(text: str) -> tuple[str, ...]:
    return tuple(word for word in text.lower().split(",") if word)


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
    from lidar.traffic.fcd import TrafficFile  # noqa: PLC0415
    from lidar.traffic.populate import TrafficOptions  # noqa: PLC0415
    from lidar.traffic.sumo import SumoOptions  # noqa: PLC0415

    if text == "on":
        return TrafficOptions()
    file, *words = text.split(",")
    if file.lower().endswith((".xml", ".xml.gz")):
        return TrafficFile(Path(file), **_words_of_file(text, words))
    known = ("vehicles", "cyclists", "pedestrians", "parked", "radius")
    kind = SumoOptions if file == "sumo" else TrafficOptions
    given_words = words if file == "sumo" else text.split(",")
    pairs = [_setting(word) if "=" in word else (word, "") for word in given_words]
    if unknown := [name for name, _ in pairs if name not in known]:
        raise InputError(
            f"--traffic {text}: {', '.join(unknown)} is none of on, off, sumo, {', '.join(known)}"
        )
    try:
        given: dict[str, Any] = {name: float(value) for name, value in pairs}
        return kind(**given)
    except ValueError as error:
        raise InputError(f"--traffic {text}: {error}") from None


def _words_of_file(text: str, words: list[str]) -> dict[str, Any]:
    known = {"net": Path, "begin": float, "parked": float, "radius": float}
    given = dict(_setting(word) for word in words)
    if unknown := given.keys() - known.keys():
        raise InputError(f"--traffic {text}: {', '.join(sorted(unknown))} is none of {', '.join(known)}")
    try:
        return {name: known[name](value) for name, value in given.items()}
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
    noise: Annotated[bool, Parameter(negative=())] = False,
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
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
    noise
        Keep returns from where nothing is: false alarms, mirror images.
    overwrite
        Replace a file that is there.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415
    from lidar.maps.aggregate import aggregate  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        summary = aggregate(
            open_dataset(dataset),
            out,
            voxel=voxel,
            color=color,
            sensors=sensor or (),
            noise=noise,
            overwrite=overwrite,
            progress=progress,
        )
    if json:
        counts: dict[str, Any] = {"points_in": summary.points_in, "points": summary.points}
        counts["noise_left_out"] = summary.noise
        counts |= {"frames": summary.frames, "missing_frames": summary.missing}
        print_json({"path": str(out), **counts})
    else:
        left = f"; {summary.noise:,} of noise left out (--noise keeps them)" if summary.noise else ""
        print(f"{out}: {summary.points:,} of {summary.points_in:,} points from {summary.frames} frames{left}")
    if summary.missing:
        lost = ", ".join(f"{count} of {name}" for name, count in summary.missing.items())
        print(
            f"lidar: frames are missing: {lost}; was the drive stopped? The same command goes on with it",
            file=sys.stderr,
        )
    return 0


@app.command
def export(
    dataset: Path,
    /,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    to: Annotated[str, Parameter(help=_exporter_help())] = "nuscenes",
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
) -> int:
    """Write a recorded drive in the layout of another dataset.

    For example:

    lidar drive scene --rig nuscenes --traffic on --format pcd -o drive

    lidar export drive --to nuscenes -o nuscenes

    Parameters
    ----------
    dataset
        Directory of the dataset.
    out
        Directory to make.
    overwrite
        Replace a directory that is there.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from lidar.dataset.layout import open_dataset  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        summary = exporter(to).export(open_dataset(dataset), out, overwrite=overwrite, progress=progress)
    if json:
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
    stage: Annotated[list[str], Parameter(negative=())],
    sensor: str = "",
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
) -> int:
    """Apply stages to recorded data: a dataset, or point clouds of KITTI or nuScenes.

    Stages before the detector take each recorded return as one echo, with the power that its intensity
    implies; they add nothing to pulses without a return.

    For example:

    lidar apply drive --stage dropped_packets:loss=0.02,burst=4 -o lossy

    lidar apply kitti/sequences/00 --stage cover_glass:transmission=0.7 -o dirty

    Parameters
    ----------
    dataset
        Directory of a dataset, or of velodyne*/*.bin (KITTI) or *.pcd.bin (nuScenes) files.
    stage
        NAME, NAME:KEY=VALUE,KEY=VALUE or a TOML file with tables [[stage]]; again for more. lidar stages
        lists them all.
    sensor
        Scanner of KITTI's or nuScenes' clouds: a preset or a TOML file; hdl64e_s3 or hdl32e by default.
    out
        Directory to write to.
    overwrite
        Replace what is there.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from lidar.apply import apply_stages  # noqa: PLC0415
    from lidar.signal.registry import read_stages  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        summary = apply_stages(
            dataset,
            out,
            stages=read_stages(stage).stages,
            sensor=sensor,
            overwrite=overwrite,
            progress=progress,
        )
    if json:
        print_json({**asdict(summary), "path": str(out)})
    else:
        print(f"{out}: {summary.files} files, {summary.points:,} of {summary.points_in:,} points")
    return 0


@app.command
def stages(*, json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False) -> int:
    """List the stages that change echoes, point clouds or images, with their parameters.

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
        "\none that it acts on): lidar drive SCENE --stage NAME:KEY=VALUE,KEY=VALUE (see docs/stages.md)."
    )
    return 0


@app.command
def rigs(*, json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False) -> int:
    """List the rigs that come along.

    Parameters
    ----------
    json
        Print them as JSON, with all there is to know.
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
def sensors(*, json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False) -> int:
    """List the laser scanners that come along.

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
def settings(*, json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False) -> int:
    """List the fidelity settings: their values at each level, and what they do.

    Parameters
    ----------
    json
        Print them as JSON.
    """
    from lidar.rig.catalog import columns  # noqa: PLC0415
    from lidar.settings import levels, list_settings  # noqa: PLC0415

    rows = list_settings()
    if json:
        told = [
            {"name": s.name, "of": s.of, **dict(zip(levels(), s.values, strict=True)), "meaning": s.meaning}
            for s in rows
        ]
        print_json({"settings": told})
        return 0
    cells = [[s.name, s.of, *s.values, s.meaning] for s in rows]
    print(columns([["name", "of", *levels(), "meaning"], *cells]))
    print(
        "\n--fidelity takes a level, --set NAME=VALUE changes one setting. Separate options: --exact"
        "\n(the full projection for every point), --deskew, --crs; of scenes: geoscene build --lod, --dem,"
        "\n--along."
    )
    return 0


def main() -> None:
    """Run the program."""
    run(app, (LidarError, GeosceneError), usage=(InputError, SceneInputError))


if __name__ == "__main__":
    main()
