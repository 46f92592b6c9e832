"""The commands build and tradeoff, and the sources of the map that they take."""

from __future__ import annotations

import os
import time
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter

from geoscene.cli.program import OUTPUT, Out, Reporting, print_scene
from geoscene.errors import InputError, need
from geoscene.options import BuildOptions, BuildTradeoffOptions, CloudOptions, Degrees
from geoscene.support.console import (
    SEVERAL,
    Report,
    command_line,
    degrees,
    note_new_folder,
    number,
    parts,
    print_json,
    whole,
)
from geoscene.support.progress import Progress, progress_bar, silent
from geoscene.support.urls import without_secrets

_SCENE = Group("Scene", sort_key=2)
_CLOUD = Group("Point clouds", sort_key=3)


@Parameter(name="*")
@dataclass(frozen=True, slots=True)
class MapSource:
    """Sources of the map and its elevation."""

    osm: Annotated[tuple[Path, ...], SEVERAL] = ()
    """OpenStreetMap files: .osm, .osm.gz, .osm.bz2, .osm.pbf, or Overpass' .json and .json.gz; several are
    one map. With --bbox, only that part of it."""

    place: str | None = None
    """Name of a place, found by Nominatim and downloaded from Overpass (needs a network; answers
    are cached)."""

    bbox: Annotated[Degrees | None, degrees("W,S,E,N")] = None
    """W,S,E,N in degrees, downloaded from Overpass, or cut out of --osm, --demo or --source."""

    point: Annotated[tuple[float, float] | None, degrees("LAT,LON")] = None
    """LAT,LON in degrees, with --radius; downloaded from Overpass."""

    radius: Annotated[float, Parameter(converter=number)] = 500.0
    """Metres around --point."""

    demo: bool = False
    """The bundled extract of central Helsinki; needs no network."""

    source: tuple[str, ...] = ()
    """NAME=FILE of another source, whose features replace those of the map: overture=FILE for buildings of
    Overture Maps in GeoParquet. Without a map, the scene has only these. May be given several times."""

    refresh: bool = False
    """Ask map servers again, and replace their answers in the cache."""

    cache: Path | None = None
    """Directory for answers of map servers and elevation tiles; ~/.cache/geoscene by default."""

    nominatim: str | None = None
    """URL of another Nominatim server."""

    overpass: Annotated[tuple[str, ...], Parameter(converter=parts, n_tokens=1, metavar="URL,...")] = ()
    """URL of another Overpass server, or several separated by commas, tried in turn."""

    dem_server: str | None = None
    """URL of other tiles for --dem tiles, with {z}, {x} and {y}: terrarium PNGs of 256 pixels."""


Source = Annotated[MapSource, Parameter(group=Group("Source of the map (one of)", sort_key=1))]


def cache_of(source: MapSource) -> Path:
    """Folder for answers of servers."""
    from geoscene.support.storage import cache_folder  # noqa: PLC0415

    return source.cache or cache_folder()


def read_elevation(
    source: MapSource, data: Any, *, options: BuildOptions, progress: Progress
) -> BuildOptions:
    """The options with the elevation file of a map, if they ask for public tiles."""
    from geoscene.sources import TileServer, with_elevation  # noqa: PLC0415

    url = source.dem_server
    server = TileServer(url, credit=f"elevation tiles: {without_secrets(url)}") if url else None
    return with_elevation(options, data, cache_dir=cache_of(source), server=server, progress=progress)


def read_map(source: MapSource, *, progress: Progress = silent) -> Any:
    """The map of the options, merged with the features of other sources."""
    from geoscene import sources  # noqa: PLC0415

    local = source.osm or source.demo
    given = [f"`{name}`" for name in ("osm", "place", "point", "demo") if getattr(source, name)]
    if source.bbox and not (local or source.source):
        given.append("`bbox`")
    if len(given) > 1 or not (given or source.source):
        reason = f"not {' and '.join(given)} together" if given else "none was given"
        raise InputError(
            "give one of `osm` FILE, `place` NAME, `bbox`, `point`, `demo` or `source` NAME=FILE; " + reason
        )
    servers = sources.Servers()
    if source.nominatim:
        servers = replace(servers, nominatim=source.nominatim)
    if source.overpass:
        servers = replace(servers, overpass=source.overpass)
    fetched: dict[str, Any] = {"cache_dir": cache_of(source), "refresh": source.refresh}
    fetched |= {"servers": servers, "progress": progress}
    data = None
    if local:
        data = sources.read_osm(source.osm or sources.demo_path(), bounds=source.bbox)
    elif source.place:
        data = sources.fetch_place(source.place, **fetched)
    elif source.point:
        data = sources.fetch_point(*source.point, radius=source.radius, **fetched)
    elif given and source.bbox:
        data = sources.fetch_bbox(source.bbox, **fetched)
    for text in source.source:
        name, equals, path = text.partition("=")
        if not (equals and path):
            raise InputError(f"`source` {text}: give NAME=FILE")
        found = sources.read_source(name, path, bounds=data.bounds if data else source.bbox)
        data = sources.merge_sources(data, found) if data else found
    return data


def build(
    *,
    source: Source = MapSource(),
    options: Annotated[BuildOptions, Parameter(group=_SCENE)] = BuildOptions(),
    clouds: Annotated[CloudOptions, Parameter(group=_CLOUD)] = CloudOptions(),
    out: Out,
    workers: Annotated[int | None, Parameter(group=OUTPUT, converter=whole)] = None,
    scheduler: Annotated[str, Parameter(group=OUTPUT, metavar="ADDRESS")] = "",
    report: Reporting = Report(),
) -> int:
    """Build a scene: solids of all buildings, one ground surface, the drivable road graph.

    For example:

    geoscene build --demo -o scene

    geoscene build --osm city.osm.pbf -o scene --crs utm

    geoscene build --osm city.osm.pbf --source overture=buildings.parquet -o scene

    geoscene build --osm city.osm.pbf --cloud survey.laz -o scene

    geoscene build --place "Norfolk, VA" -o norfolk

    geoscene build --point 36.8853,-76.3059 --radius 800 -o odu

    Parameters
    ----------
    out
        Directory to write the scene to, or URL of one in object storage (s3://BUCKET/NAME, gs://).
    workers
        Number of processes, by default one per core. The scene does not depend on it.
    scheduler
        Address of the scheduler of a Dask cluster (tcp://HOST:8786), whose workers build the tiles instead;
        they need the output folder under the same path.
    """
    from geoscene.pipeline.build import build as build_scene  # noqa: PLC0415  (half a second, not needed for --help)
    from geoscene.scene.layout import SceneFiles  # noqa: PLC0415
    from geoscene.scene.writer import check_target  # noqa: PLC0415
    from geoscene.support.cluster import connect  # noqa: PLC0415
    from geoscene.support.kernels import compile_ahead  # noqa: PLC0415
    from geoscene.support.storage import publish, shown, url_of  # noqa: PLC0415

    started = time.perf_counter()
    if workers is not None and not 1 <= workers <= 256:
        raise InputError(f"`workers` {workers}: give 1 to 256")
    if source.dem_server and not options.elevation_tiles:
        raise InputError("`dem_server` needs --dem tiles")
    if not url_of(out):
        check_target(out, overwrite=report.overwrite)
        note_new_folder(out)
    compile_ahead("build", quiet=report.quiet)
    bar = partial(progress_bar, quiet=report.quiet)
    with (
        connect(scheduler) if scheduler else nullcontext() as cluster,
        publish(out, last=SceneFiles(Path()).manifest.name, replaces=report.overwrite, bar=bar) as folder,
        bar() as progress,
    ):
        progress("reading the map", 0, total=0)
        data = read_map(source, progress=progress)
        options = read_elevation(source, data, options=options, progress=progress)
        many = workers or os.cpu_count() or 1
        if clouds.cloud:
            from geoscene.clouds.survey import with_clouds  # noqa: PLC0415

            data, options = with_clouds(
                data, options, cloud=clouds, cache_dir=cache_of(source), workers=many, progress=progress
            )
        scene = build_scene(
            data,
            folder,
            options=options,
            overwrite=report.overwrite,
            workers=many,
            cluster=cluster,
            progress=progress,
        )
    document = scene.manifest | {"path": shown(out), "seconds": round(time.perf_counter() - started, 2)}
    if report.json:
        print_json(document)
    else:
        print_scene(document)
        path = shown(out)
        drive = ("lidar", "drive", path, "--route", *(options.along or ("random",)), "-o", "drive")
        words = drive if document["counts"]["road_edges"] else ("geoscene", "export", path, "-o", "scene.glb")
        if not scene.has_tiles:
            words = ("geoscene", "export", path, "-o", "scene.gpkg")
        print(f"\n{document['seconds']:.1f} s; next: {command_line(*words)}")
    return 0


def tradeoff(
    *,
    source: Source = MapSource(),
    options: Annotated[BuildOptions, Parameter(group=_SCENE)] = BuildOptions(),
    compared: BuildTradeoffOptions = BuildTradeoffOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=OUTPUT)] = None,
    report: Reporting = Report(),
) -> int:
    """Build a place with other settings, measure error and cost of each, and recommend the cheapest.

    Errors are those of the surface model, of volumes and footprints of buildings, and missing objects,
    against the full scene (--lod 2, all of --only, --for all); costs are CPU time, peak memory and bytes of
    a build by one process.

    For example:

    geoscene tradeoff --osm city.osm.pbf -o tradeoff

    geoscene tradeoff --osm city.osm.pbf --dem heights.tif --settings lod,terrain --json

    Parameters
    ----------
    out
        Folder to write tradeoff.json, tradeoff.html and pareto.png to.
    """
    from geoscene.tradeoff.engine import tradeoff as measured  # noqa: PLC0415
    from geoscene.tradeoff.report import document, to_text, write_report  # noqa: PLC0415

    if options.elevation_tiles:
        raise InputError("`dem` tiles: not compared; give elevation files")
    if out is not None:
        need("matplotlib", "plots")
        note_new_folder(out)
        if out.exists() and not report.overwrite:
            raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    with progress_bar(quiet=report.quiet) as progress:
        found = measured(
            partial(read_map, source),
            options,
            settings=compared.settings,
            resolution=compared.resolution,
            repetitions=compared.repetitions,
            progress=progress,
        )
    if report.json:
        print_json(document(found))
    else:
        print(to_text(found))
    if out is not None:
        write_report(found, out)
        if not report.json:
            print(f"{out / 'tradeoff.html'}")
    return 0
