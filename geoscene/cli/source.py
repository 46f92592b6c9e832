"""Sources of the map on the command line, and the map that they give."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Group, Parameter

from geoscene.errors import InputError
from geoscene.options import BuildOptions, Degrees
from geoscene.support.console import SEVERAL, degrees
from geoscene.support.progress import Progress


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
    server = TileServer(url, credit=f"elevation tiles: {url}") if url else None
    return with_elevation(options, data, cache_dir=cache_of(source), server=server, progress=progress)


def read_map(source: MapSource) -> Any:
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
    fetched: dict[str, Any] = {"cache_dir": cache_of(source), "servers": servers}
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
