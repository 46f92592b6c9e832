"""The `geoscene` program: build, look into and check scenes."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Group, Parameter, validators

from geoscene import __version__
from geoscene.console import FAILURE, print_json, progress_bar, whole, with_flags
from geoscene.console import main as run
from geoscene.errors import GeosceneError, InputError
from geoscene.progress import Progress

app = App(
    name="geoscene",
    version=__version__,
    suppress_keyboard_interrupt=False,
    help="""Turn a real place from OpenStreetMap into a watertight 3D scene.

    A first scene, without a network:  geoscene build --demo -o scene

    Then look at it (geoscene view scene -o page.html), check it (geoscene validate scene), open
    scene/features.gpkg in QGIS, or drive through it:  lidar drive scene --route random -o drive
    """,
)
app.register_install_completion_command()

_SOURCE = Group("Where the map comes from (one of)", sort_key=1)
_OUTPUT = Group("Output", sort_key=3)

Numbers = Annotated[str | None, Parameter(group=_SOURCE)]


def _numbers(text: str, option: str, *, names: str) -> list[float]:
    count = names.count(",") + 1
    try:
        values = [float(v) for v in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{option} {text.strip()}: give {count} numbers in degrees as {names}")
    return values


@app.command
def build(
    *,
    osm: Annotated[Path | None, Parameter(group=_SOURCE)] = None,
    place: Annotated[str | None, Parameter(group=_SOURCE)] = None,
    bbox: Numbers = None,
    point: Numbers = None,
    radius: Annotated[float, Parameter(group=_SOURCE)] = 500.0,
    demo: Annotated[bool, Parameter(group=_SOURCE, negative=())] = False,
    source: Annotated[list[str] | None, Parameter(group=_SOURCE, negative=())] = None,
    cache: Annotated[Path | None, Parameter(group=_SOURCE)] = None,
    nominatim: Annotated[str | None, Parameter(group=_SOURCE)] = None,
    overpass: Annotated[str | None, Parameter(group=_SOURCE)] = None,
    dem_server: str | None = None,
    crs: str = "local",
    lod: Annotated[int, Parameter(converter=whole)] = 2,
    dem: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative=())] = None,
    dem_gaps: str = "error",
    driving_side: str = "",
    only: str = "",
    along: Annotated[list[str] | None, Parameter(consume_multiple=True, negative=())] = None,
    reach: float = 120.0,
    tile_size: float = 250.0,
    name: str = "",
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    workers: Annotated[int | None, Parameter(group=_OUTPUT, converter=whole)] = None,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
) -> int:
    """Build a scene: solids of all buildings, one ground surface, the drivable road graph.

    For example:

    geoscene build --demo -o scene

    geoscene build --osm city.osm.pbf -o scene --crs utm

    geoscene build --place "Norfolk, VA" -o norfolk

    geoscene build --point 36.8853,-76.3059 --radius 800 -o odu

    geoscene build --osm city.osm.pbf --source overture=buildings.parquet -o scene

    Parameters
    ----------
    osm
        OpenStreetMap file: .osm, .osm.gz, .osm.bz2 or .osm.pbf. With --bbox, the part of it inside.
    place
        Name of a place, asked of Nominatim and fetched from Overpass (needs a network; answers are cached).
    bbox
        W,S,E,N in degrees, fetched from Overpass, or cut out of --osm, --demo or --source.
    point
        LAT,LON in degrees, with --radius, fetched from Overpass.
    radius
        Metres around --point.
    demo
        The bundled extract of central Helsinki; needs no network.
    source
        NAME=FILE of another source, whose features replace those of the map: overture=FILE, buildings of
        Overture Maps in GeoParquet. Alone, the scene has only these. May be given several times.
    cache
        Directory for answers of map servers and elevation tiles; ~/.cache/geoscene by default.
    nominatim
        Address of another Nominatim server.
    overpass
        Address of another Overpass server, or several with commas, tried in turn.
    crs
        Frame of the scene: local (a transverse Mercator on its centre in which a metre is a metre), utm, or
        an EPSG code such as EPSG:32618.
    lod
        Level of detail of buildings: 0 blocks, 1 parts with flat roofs, 2 roofs.
    dem
        Elevation files: GeoTIFF, .hgt or .hgt.zip, one or more, in any CRS; or the word tiles: public
        elevation tiles of 5 to 10 m (needs a network; tiles are cached). Level ground without.
    dem_server
        Address of other tiles for --dem tiles, with {z}, {x} and {y} in it: terrarium PNGs of 256 pixels.
    dem_gaps
        Where they do not cover the scene: error, or nearest (take the nearest height and say so).
    driving_side
        Side of the road that traffic keeps to: left or right. That of the map's tags or of the country
        without.
    only
        What is built besides the ground, with commas: buildings, roads, landcover, trees, furniture,
        barriers.
    along
        Build only the tiles that can be seen from a route: LAT,LON LAT,LON ... or a GPX, GeoJSON or CSV file
        (such as the poses.csv of a dataset).
    reach
        How far can be seen from --along, metres: the reach of the sensors.
    tile_size
        Side of a tile in metres.
    name
        Name of the scene, for people.
    out
        Directory to write the scene to.
    overwrite
        Replace a scene that is there. What its tiles have in common with it is not computed again.
    workers
        Processes; as many as there are cores by default. The bytes do not depend on it.
    json
        Print the build report as JSON.
    quiet
        No progress bars.
    """
    from geoscene.build import BuildOptions  # noqa: PLC0415  (half a second, not needed for --help)
    from geoscene.build import build as build_scene  # noqa: PLC0415
    from geoscene.plan import KINDS  # noqa: PLC0415

    began = time.perf_counter()
    kept = cache or Path.home() / ".cache" / "geoscene"
    fetched = [str(path) for path in dem or ()] == ["tiles"]
    if dem_server and not fetched:
        raise InputError("--dem-server goes with --dem tiles")
    options = BuildOptions(
        crs=crs,
        lod=lod,
        dem=() if fetched else tuple(map(str, dem or ())),
        dem_gaps=dem_gaps,
        driving_side=driving_side,
        only=tuple(k for k in only.split(",") if k) or KINDS,
        along=tuple(along or ()),
        reach=reach,
        tile_size=tile_size,
        name=name,
    )
    with progress_bar(quiet=quiet) as progress:
        progress("reading the map", 0, total=0)
        asked = {"cache_dir": kept} | _servers(nominatim, overpass)
        data = _read(
            osm, place, bbox=bbox, point=point, radius=radius, asked=asked, demo=demo, files=source or ()
        )
        if fetched:
            options = replace(
                options, dem=(_elevation(data, kept, crs=crs, template=dem_server, progress=progress),)
            )
        scene = build_scene(
            data, out, options=options, overwrite=overwrite, workers=_workers(workers), progress=progress
        )
    report = scene.manifest | {"path": str(out), "seconds": round(time.perf_counter() - began, 2)}
    if json:
        print_json(report)
    else:
        _print_scene(report)
        drive = f"lidar drive {out} --route random -o drive"
        following = drive if report["counts"]["road_edges"] else f"geoscene export {out} -o scene.glb"
        print(f"\n{report['seconds']:.1f} s; next: {following}")
    return 0


def _servers(nominatim: str | None, overpass: str | None) -> dict[str, Any]:
    """The servers option for `geoscene.sources`, where other addresses are given."""
    given: dict[str, Any] = {}
    if nominatim:
        given["nominatim"] = nominatim
    if overpass:
        given["overpass"] = tuple(overpass.split(","))
    if not given:
        return {}
    from geoscene.sources import Servers  # noqa: PLC0415

    return {"servers": Servers(**given)}


def _elevation(data: Any, cache: Path, *, crs: str, template: str | None, progress: Progress) -> str:
    """The elevation file made of tiles for a map."""
    from geoscene.sources import TileServer, fetch_elevation  # noqa: PLC0415

    server = TileServer(template, credit=f"elevation tiles: {template}") if template else None
    return str(fetch_elevation(data, cache_dir=cache, crs=crs, server=server, progress=progress))


def _workers(given: int | None) -> int:
    if given is not None and not 1 <= given <= 256:
        raise InputError(f"--workers {given}: give 1 to 256")
    return given or os.cpu_count() or 1


def _read(
    osm: Path | None,
    place: str | None,
    *,
    bbox: str | None,
    point: str | None,
    radius: float,
    asked: dict[str, Any],
    demo: bool,
    files: Sequence[str],
) -> Any:
    """The map that the options name, with the features of other sources merged in."""
    from geoscene import sources  # noqa: PLC0415

    given = [n for n, v in (("--osm", osm), ("--place", place), ("--point", point), ("--demo", demo)) if v]
    if bbox and not (osm or demo or files):
        given.append("--bbox")
    if len(given) > 1 or not (given or files):
        what = f"not {' and '.join(given)} together" if given else "none was given"
        raise InputError(
            f"give one of --osm FILE, --place NAME, --bbox, --point, --demo or --source NAME=FILE; {what}"
        )
    box = None
    if bbox:
        west, south, east, north = _numbers(bbox, "--bbox", names="W,S,E,N")
        if not (-180 <= west < east <= 180 and -90 <= south < north <= 90):
            raise InputError(f"--bbox {bbox.strip()}: W,S,E,N must rise from west to east and south to north")
        box = (west, south, east, north)
    data = None
    if osm or demo:
        data = sources.read_source("osm", osm or sources.demo_path(), bounds=box)
    elif place:
        data = sources.fetch_place(place, **asked)
    elif point:
        lat, lon = _numbers(point, "--point", names="LAT,LON")
        if not (abs(lat) <= 90 and abs(lon) <= 180):
            raise InputError(f"--point {point.strip()}: not a latitude and longitude in degrees")
        data = sources.fetch_point(lat, lon, radius=radius, **asked)
    elif given and box:
        data = sources.fetch_bbox(box, **asked)
    for text in files:
        name, equals, path = text.partition("=")
        if not (equals and path):
            raise InputError(f"--source {text}: give NAME=FILE")
        found = sources.read_source(name, path, bounds=data.bounds if data else box)
        data = sources.merged(data, found) if data else found
    return data


@app.command
def info(
    scene: Annotated[Path, Parameter(validator=validators.Path(exists=False))],
    /,
    *,
    json: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Say what a scene holds: frame, extent, counts, where heights come from, repairs and drops.

    Parameters
    ----------
    scene
        Directory of the scene.
    json
        Print as JSON.
    """
    from geoscene.scene.layout import open_scene  # noqa: PLC0415

    opened = open_scene(scene)
    report = opened.manifest | {"path": str(scene), "extent": _extent(opened.manifest)}
    if json:
        print_json(report)
    else:
        _print_scene(report)
    return 0


@app.command
def validate(scene: Path, /, *, json: Annotated[bool, Parameter(negative=())] = False) -> int:
    """Check every solid of a scene: closed, oriented, of positive volume. Exit code 1 if one is not.

    Parameters
    ----------
    scene
        Directory of the scene.
    json
        Print the verdicts as JSON.
    """
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from geoscene.scene.validate import check_scene  # noqa: PLC0415

    report = check_scene(open_scene(scene))
    if json:
        print_json(report)
    else:
        for row in report["broken"]:
            print(f"{row['osm_id']} (feature {row['feature']}): {row['fault']}")
        sound = report["solids"] - len(report["broken"])
        print(f"{report['solids']} solids, {sound} closed, oriented and of positive volume")
    return FAILURE if report["broken"] else 0


@app.command
def export(
    scene: Path,
    /,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    kind: Annotated[str | None, Parameter(name="--to")] = None,
    crs: str | None = None,
    layers: str | None = None,
    model: str | None = None,
    resolution: float | None = None,
    height_offset: float | None = None,
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
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
        Directory of the scene.
    out
        File to write; for 3D Tiles a directory.
    kind
        cityjson, glb, 3dtiles, obj, ply, stl, gpkg, geojson, geoparquet, geotiff, opendrive or sumo; by the
        name of the file where that says it.
    crs
        CRS of the export, where the format carries one: an EPSG code; the scene's own by default, or its UTM
        zone.
    layers
        Layers of GIS formats, with commas; all by default.
    model
        Of a GeoTIFF: surface, terrain or classes.
    resolution
        Of a GeoTIFF: metres a cell.
    height_offset
        Metres added to heights, such as the geoid's height for formats that want ellipsoidal ones.
    overwrite
        Replace what is there.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from geoscene.export import export_scene  # noqa: PLC0415
    from geoscene.scene.layout import open_scene  # noqa: PLC0415

    with progress_bar(quiet=quiet) as progress:
        summary = export_scene(
            open_scene(scene),
            out,
            kind=kind,
            crs=crs,
            layers=tuple(layers.split(",")) if layers else None,
            model=model,
            resolution=resolution,
            height_offset=height_offset,
            overwrite=overwrite,
            progress=progress,
        )
    if json:
        print_json({**asdict(summary), "path": str(summary.path)})
    else:
        size = f"{summary.bytes / 1e6:.1f} MB"
        what = "cells" if summary.kind == "geotiff" else "objects"
        print(f"{summary.path}: {summary.kind}, {summary.objects} {what}, {size}, {summary.crs}")
        for note in summary.notes:
            print(f"  {with_flags(app, note)}")
    return 0


@app.command
def view(
    scene: Path,
    /,
    *,
    out: Annotated[Path, Parameter(name=["--out", "-o"], group=_OUTPUT)],
    bounds_deg: Annotated[str | None, Parameter(name="--bbox")] = None,
    layers: str = "",
    max_mb: Annotated[float | None, Parameter(name="--max-size")] = None,
    overwrite: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    json: Annotated[bool, Parameter(group=_OUTPUT, negative=())] = False,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], group=_OUTPUT, negative=())] = False,
) -> int:
    """Write a scene as one web page: turn it, click an object, read what is known of it and what is guessed.

    For example:

    geoscene view scene -o page.html

    The page needs no network and no server; open it from disk with any browser that has WebGL 2.

    Parameters
    ----------
    scene
        Directory of the scene.
    out
        File to write.
    bounds_deg
        W,S,E,N in degrees: only the tiles that meet it.
    layers
        Only these, with commas, such as ground,buildings,trees; all by default.
    max_mb
        Megabytes that the page may have, 40 by default. A larger one is refused, with the bounds of a part
        that fits.
    overwrite
        Replace what is there.
    json
        Print the summary as JSON.
    quiet
        No progress bars.
    """
    from geoscene.scene.layout import open_scene  # noqa: PLC0415
    from geoscene.view import MAX_MB, view_scene  # noqa: PLC0415

    west, south, east, north = _numbers(bounds_deg, "--bbox", names="W,S,E,N") if bounds_deg else (0.0,) * 4
    with progress_bar(quiet=quiet) as progress:
        summary = view_scene(
            open_scene(scene),
            out,
            bounds_deg=(west, south, east, north) if bounds_deg else None,
            layers=tuple(name for name in layers.split(",") if name),
            max_mb=MAX_MB if max_mb is None else max_mb,
            overwrite=overwrite,
            progress=progress,
        )
    if json:
        print_json({**asdict(summary), "path": str(summary.path)})
    else:
        print(
            f"{summary.path}: {summary.faces} faces, {summary.objects} objects, {summary.bytes / 1e6:.1f} MB"
        )
        for note in summary.notes:
            print(f"  {with_flags(app, note)}")
    return 0


def _extent(manifest: dict[str, Any]) -> dict[str, Any]:
    xmin, ymin, xmax, ymax = manifest["bounds"]
    return {
        "width_m": xmax - xmin,
        "height_m": ymax - ymin,
        "geographic": manifest["geographic_bounds"],
    }


def _print_scene(report: dict[str, Any]) -> None:
    counts, frame = report["counts"], report["frame"]
    xmin, ymin, xmax, ymax = report["bounds"]
    west, south, east, north = report["geographic_bounds"]
    rows = {
        "frame": f"{frame['name']}, heights {frame['vertical']}",
        "extent": f"{xmax - xmin:.0f} x {ymax - ymin:.0f} m;"
        f" lon {west:.5f} to {east:.5f}, lat {south:.5f} to {north:.5f}",
        "buildings": f"{counts['buildings']} in the map, {counts['dropped']} dropped,"
        f" {counts['solids']} solids",
        "watertight": f"{counts['watertight']} of {counts['closed_objects']} closed objects",
        "standing": f"{counts['trees']} mapped trees, {counts['furniture']} pieces of furniture,"
        f" {counts['barriers']} barriers",
        "roads": f"{counts['road_km']:.1f} km in {counts['road_edges']} edges" + _steep_roads(counts),
        "heights": _listed(report["heights"]),
        "roofs": _listed(report["roofs"]),
    }
    if report["options"]["along"]:
        rows["along"] = (
            f"{len(report['tiles'])} tiles are built, those seen from the route; solids and watertight count"
            " what is in them, all else the whole map"
        )
    print(report["name"] or report["path"])
    for title, text in rows.items():
        print(f"  {title:<10} {text}")
    for action, kinds in report["problems"].items():
        for kind, reasons in kinds.items():
            print(f"  {action:<10} {kind}: {_listed(reasons)}")
    print(f"  {report['attribution']}")


def _steep_roads(counts: dict[str, Any]) -> str:
    if counts["road_km_steep"] < 0.005 * counts["road_km"]:
        return ""
    steep = counts["road_km_steep"]
    return f", {steep:.1f} km steeper than 20 %; is the terrain model coarser than the streets?"


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {n}" for name, n in counts.items())


def main() -> None:
    """Run the program."""
    run(app, (GeosceneError,), usage=(InputError,))


if __name__ == "__main__":
    main()
