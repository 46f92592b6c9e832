"""The `geoscene` program: build, inspect, check, export and show scenes."""

from __future__ import annotations

import os
import time
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter, validators

from geoscene import __version__
from geoscene.errors import GeosceneError, InputError
from geoscene.options import (
    BuildOptions,
    BuildTradeoffOptions,
    CloudOptions,
    Degrees,
    ExportOptions,
    ViewOptions,
)
from geoscene.support.console import (
    DEFAULTS,
    FAILURE,
    SEVERAL,
    Report,
    command_line,
    degrees,
    note_new_folder,
    print_json,
    progress_bar,
    whole,
    with_flags,
)
from geoscene.support.console import main as run
from geoscene.support.progress import Progress
from geoscene.uses import USES

app = App(
    name="geoscene",
    version=__version__,
    default_parameter=DEFAULTS,
    suppress_keyboard_interrupt=False,
    help="""Turn a real place from OpenStreetMap into a watertight 3D scene.

    A first scene, without a network:  geoscene build --demo -o scene

    Then look at it (geoscene view scene -o page.html), check it (geoscene validate scene), open
    scene/features.gpkg in QGIS, or drive through it:  lidar drive scene --route random -o drive
    """,
)
app.register_install_completion_command()

_SOURCE = Group("Source of the map (one of)", sort_key=1)
_SCENE = Group("Scene", sort_key=2)
_CLOUD = Group("Point clouds", sort_key=3)
_OUTPUT = Group("Output", sort_key=4)

Out = Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)]
Reporting = Annotated[Report, Parameter(group=_OUTPUT)]


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

    radius: float = 500.0
    """Metres around --point."""

    demo: bool = False
    """The bundled extract of central Helsinki; needs no network."""

    source: tuple[str, ...] = ()
    """NAME=FILE of another source, whose features replace those of the map: overture=FILE for buildings of
    Overture Maps in GeoParquet. Without a map, the scene has only these. May be given several times."""

    cache: Path | None = None
    """Directory for answers of map servers and elevation tiles; ~/.cache/geoscene by default."""

    nominatim: str | None = None
    """URL of another Nominatim server."""

    overpass: str | None = None
    """URL of another Overpass server, or several separated by commas, tried in turn."""

    dem_server: str | None = None
    """URL of other tiles for --dem tiles, with {z}, {x} and {y}: terrarium PNGs of 256 pixels."""


@app.command
def build(
    *,
    source: Annotated[MapSource, Parameter(group=_SOURCE)] = MapSource(),
    options: Annotated[BuildOptions, Parameter(group=_SCENE)] = BuildOptions(),
    clouds: Annotated[CloudOptions, Parameter(group=_CLOUD)] = CloudOptions(),
    out: Out,
    workers: Annotated[int | None, Parameter(group=_OUTPUT, converter=whole)] = None,
    scheduler: Annotated[str, Parameter(group=_OUTPUT, metavar="ADDRESS")] = "",
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
        data = _read_map(source)
        options = _with_elevation(source, data, options=options, progress=progress)
        many = workers or os.cpu_count() or 1
        if clouds.cloud:
            from geoscene.clouds.survey import with_clouds  # noqa: PLC0415

            data, options = with_clouds(
                data, options, cloud=clouds, cache_dir=_cache_of(source), workers=many, progress=progress
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
        _print_scene(document)
        path = shown(out)
        drive = ("lidar", "drive", path, "--route", *(options.along or ("random",)), "-o", "drive")
        words = drive if document["counts"]["road_edges"] else ("geoscene", "export", path, "-o", "scene.glb")
        if not scene.has_tiles:
            words = ("geoscene", "export", path, "-o", "scene.gpkg")
        print(f"\n{document['seconds']:.1f} s; next: {command_line(*words)}")
    return 0


def _cache_of(source: MapSource) -> Path:
    from geoscene.support.storage import cache_folder  # noqa: PLC0415

    return source.cache or cache_folder()


def _with_elevation(
    source: MapSource, data: Any, *, options: BuildOptions, progress: Progress
) -> BuildOptions:
    """The options with the elevation file of a map, if they ask for public tiles."""
    from geoscene.sources import TileServer, with_elevation  # noqa: PLC0415

    url = source.dem_server
    server = TileServer(url, credit=f"elevation tiles: {url}") if url else None
    return with_elevation(options, data, cache_dir=_cache_of(source), server=server, progress=progress)


def _read_map(source: MapSource) -> Any:
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
        servers = replace(servers, overpass=tuple(source.overpass.split(",")))
    fetched: dict[str, Any] = {"cache_dir": _cache_of(source), "servers": servers}
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


@app.command
def tradeoff(
    *,
    source: Annotated[MapSource, Parameter(group=_SOURCE)] = MapSource(),
    options: Annotated[BuildOptions, Parameter(group=_SCENE)] = BuildOptions(),
    compared: BuildTradeoffOptions = BuildTradeoffOptions(),
    out: Annotated[Path | None, Parameter(name=["--out", "-o"], group=_OUTPUT)] = None,
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
        note_new_folder(out)
        if out.exists() and not report.overwrite:
            raise InputError(f"{out}: exists already; set `overwrite` to replace it")
    with progress_bar(quiet=report.quiet) as progress:
        found = measured(
            partial(_read_map, source),
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


@app.command
def info(
    scene: Annotated[Path, Parameter(validator=validators.Path(exists=False))],
    /,
    *,
    json: bool = False,
) -> int:
    """Describe a scene: frame, extent, counts, sources of heights, repaired and dropped features.

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    json
        Print as JSON.
    """
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from geoscene.support.storage import shown  # noqa: PLC0415

    opened = open_scene(scene)
    report = opened.manifest | {"path": shown(scene), "extent": _extent(opened.manifest)}
    if json:
        print_json(report)
    else:
        _print_scene(report)
    return 0


@app.command
def validate(scene: Path, /, *, json: bool = False) -> int:
    """Check all solids and surfaces of a scene; exit code 1 if one has a fault.

    A solid is closed, oriented and of positive volume, its faces meet in common edges and vertices only, and
    no two of its vertices are within 1 mm. In a surface, such as a road, no two vertices are
    within 1 mm, no face is a line and no edge has three faces.

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    json
        Print the result as JSON.
    """
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415
    from geoscene.scene.validate import check_scene  # noqa: PLC0415

    with using(open_scene(scene)) as opened:
        report = check_scene(opened)
    if json:
        print_json(report)
    else:
        for row in report["broken"]:
            print(f"{row['osm_id']} (feature {row['feature']}): {row['fault']}")
        valid = report["solids"] - len(report["broken"])
        print(f"{report['solids']} solids, {valid} closed, oriented and free of self-contact")
        for row in report["broken_surfaces"]:
            i, j = row["tile"]
            of = f" of {row['osm_id']} (feature {row['feature']})" if row["feature"] >= 0 else ""
            print(f"{row['class']}{of} in tile {i}, {j}: {row['fault']}")
        valid = report["surfaces"] - len(report["broken_surfaces"])
        print(f"{report['surfaces']} surfaces, {valid} without faults")
    return FAILURE if report["broken"] or report["broken_surfaces"] else 0


@app.command
def export(
    scene: Path,
    /,
    *,
    out: Out,
    options: ExportOptions = ExportOptions(),
    report: Reporting = Report(),
) -> int:
    """Write a scene in another format.

    For example:

    geoscene export scene -o city.city.json

    geoscene export scene -o city.glb

    geoscene export scene --to 3dtiles -o tiles

    geoscene export scene -o surface.tif --model surface --resolution 0.5

    geoscene export scene -o roads.xodr

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    out
        File to write; for 3D Tiles a directory.
    """
    from geoscene.export import export_scene  # noqa: PLC0415
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress, using(open_scene(scene)) as opened:
        summary = export_scene(opened, out, options=options, overwrite=report.overwrite, progress=progress)
    _print_file(
        summary,
        f"{summary.kind}, {summary.objects} {'cells' if summary.kind == 'geotiff' else 'objects'}",
        end=f", {summary.crs}",
        json=report.json,
    )
    return 0


@app.command
def view(
    scene: Path,
    /,
    *,
    out: Out,
    options: ViewOptions = ViewOptions(),
    report: Reporting = Report(),
) -> int:
    """Write a scene as one web page: rotate it, click an object, read its attributes and their sources.

    For example:

    geoscene view scene -o page.html

    geoscene view scene -o page

    The page needs no network and no server; open the file, or the index.html of the folder, in any browser
    with WebGL 2.

    Parameters
    ----------
    scene
        Directory or URL of the scene.
    out
        File to write (.html), or a folder (no suffix) whose page loads parts of the scene as they are seen:
        for scenes of any size.
    """
    from geoscene.scene.layout import open_scene, using  # noqa: PLC0415
    from geoscene.view import view_scene  # noqa: PLC0415

    note_new_folder(out)
    with progress_bar(quiet=report.quiet) as progress, using(open_scene(scene)) as opened:
        summary = view_scene(opened, out, options=options, overwrite=report.overwrite, progress=progress)
    _print_file(summary, f"{summary.faces} faces, {summary.objects} objects", json=report.json)
    return 0


def _print_file(summary: Any, contents: str, *, end: str = "", json: bool) -> None:
    """Print a summary of a written file, as JSON or as text."""
    if json:
        print_json({**asdict(summary), "path": str(summary.path)})
        return
    print(f"{summary.path}: {contents}, {summary.bytes / 1e6:.1f} MB{end}")
    for note in summary.notes:
        print(f"  {with_flags(app, note)}")


def _extent(manifest: dict[str, Any]) -> dict[str, Any]:
    xmin, ymin, xmax, ymax = manifest["bounds"]
    return {
        "width_m": xmax - xmin,
        "height_m": ymax - ymin,
        "geographic": manifest["geographic_bounds"],
    }


def _count_guessed(relief: dict[str, Any]) -> dict[str, int]:
    """What is guessed besides the openings of facades, by kind."""
    furniture = sum(relief.get("furniture_guessed", {}).values())
    found = relief.get("parts_guessed", {}) | relief.get("roofs_guessed", {}) | {"furniture": furniture}
    return {name: count for name, count in found.items() if count}


def _print_scene(report: dict[str, Any]) -> None:
    counts, frame, ground = report["counts"], report["frame"], report["ground"]
    water = ground.get("water_area", 0.0) / 1e6
    use = report["options"].get("use", "all")
    has_tiles = not USES[use].lacks("tiles")
    steep = _steep_roads(counts, terrain=frame["vertical"] != "flat")
    xmin, ymin, xmax, ymax = report["bounds"]
    west, south, east, north = report["geographic_bounds"]
    rows = {
        "frame": f"{frame['name']}, heights {frame['vertical']}",
        "extent": f"{xmax - xmin:.0f} x {ymax - ymin:.0f} m;"
        f" lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}",
        "buildings": f"{counts['buildings']} in the map, {counts['dropped']} dropped"
        + (f", {counts['solids']} solids" if has_tiles else ""),
        "watertight": f"{counts['watertight']} of {counts['closed_objects']} closed objects"
        if has_tiles
        else "",
        "standing": f"{counts['trees']} mapped trees, {counts['forest_trees']} in forests,"
        f" {counts['furniture']} lamps, signs and other furniture, {counts['barriers']} barriers",
        "ground": f"{ground['area'] / 1e6:.2f} km2" + (f", {water:.3g} km2 of it water" if water else "")
        if has_tiles
        else "",
        "roads": f"{counts['road_km']:.1f} km of carriageway in the extent; {counts['road_edges']} edges by"
        f" direction{steep}",
        "heights": _list_counts(report["heights"]),
        "roofs": _list_counts(report["roofs"]),
        "relief": report["options"].get("relief", "off"),
        "facades": _list_counts(report.get("relief", {}).get("facades", {})),
        "guessed": _list_counts(_count_guessed(report.get("relief", {}))),
    }
    for_drives = "area" in report
    if for_drives or report["options"].get("along"):
        features = max(stop for _, stop in report["layers"].values())
        part = "that drives need" if for_drives else "in range of the route"
        rows["along"] = (
            f"{len(report['tiles'])} tiles are built, those {part}; solids, watertight,"
            " trees in forests and ground count these tiles, all other figures the whole map (objects far"
            " away as mapped);"
            f" tables hold {sum(report['rows'].values())} of {features} features"
        )
    if use != "all":
        rows[f"for {use}"] = f"{USES[use].contents}; left out: {_left_out_text(report['left_out'])}"
    print(report["name"] or report["path"])
    for title, text in rows.items():
        if text:
            print(f"  {title:<10} {text}")
    for action, kinds in report["problems"].items():
        for kind, reasons in kinds.items():
            print(f"  {action:<10} {kind}: {_list_counts(reasons)}")
    for limit in report.get("limits", []):
        print(f"  {'limit':<10} {with_flags(app, limit['advice'])}")
    print(f"  {report['attribution']}")


def _left_out_text(counts: dict[str, int]) -> str:
    """What a scene for a use does not have."""
    names = {
        "tiles": "tiles with all meshes",
        "features": "features of other tables",
        "attributes": "attributes of features",
    }
    parts = [f"{counts[name]:,} {title}" for name, title in names.items() if counts.get(name)]
    size = f" ({counts['bytes'] / 1e6:.2f} MB before compression)" if counts.get("bytes") else ""
    return f"{', '.join(parts)}{size}"


def _steep_roads(counts: dict[str, Any], *, terrain: bool) -> str:
    steep = counts["road_km_steep"]
    if not terrain or steep <= 0.005 * counts["road_km"]:
        return ""
    return f", {steep:.1f} km steeper than 20 %; the terrain model may be too coarse"


def _list_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in counts.items())


def main() -> None:
    """Run the program."""
    run(app, (GeosceneError,), usage=(InputError,))


if __name__ == "__main__":
    main()
