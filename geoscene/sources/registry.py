"""The registry of map sources: what each one gives, how it is read, its licence and its attribution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from geoscene.errors import InputError
from geoscene.sources.data import Bounds, Credit, OsmData, Progress, Tags, is_building
from geoscene.support.registry import Registry, load, unknown_name


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSourceKind:
    """One row of the registry.

    name        : on the command line and in ``scene.json``
    gives       : ``map`` (features of all kinds), ``buildings`` or ``heights``
    suffixes    : of its files; empty for a source that is only fetched over the network
    reader      : ``module:function`` here; for files ``(path, *, bounds, progress) -> OsmData``
    licence     : SPDX identifier, or in words
    attribution : text that the licence or the provider requires with the data
    """

    name: str
    gives: str
    suffixes: tuple[str, ...] = ()
    reader: str
    licence: str
    attribution: str


_OSM = "(c) OpenStreetMap contributors, ODbL 1.0, https://www.openstreetmap.org/copyright"

_TERRAIN_TILES = (
    "Terrain Tiles (Mapzen, AWS open data): ArcticDEM, DigitalGlobe, Inc., imagery funded by National Science"
    " Foundation awards 1043681, 1559691 and 1542736; © offene Daten Österreichs - Digitales Geländemodell"
    " (DGM) Österreich; contains information licensed under the Open Government Licence - Canada; produced"
    " using Copernicus data and information funded by the European Union - EU-DEM layers; ETOPO1, U.S."
    " National Oceanic and Atmospheric Administration; source: INEGI, Continental relief, 2016; © 2011 Crown"
    " copyright Land Information New Zealand and the New Zealand Government; © Kartverket; © Environment"
    " Agency copyright and/or database right 2015; 3DEP, SRTM and GMTED2010 courtesy of the U.S. Geological"
    " Survey"
)

_SOURCES = (
    MapSourceKind(
        name="osm",
        gives="map",
        suffixes=(".osm", ".osm.gz", ".osm.bz2", ".osm.pbf", ".o5m", ".json", ".json.gz", ".json.bz2"),
        reader="files:read_osm",
        licence="ODbL-1.0",
        attribution=_OSM,
    ),
    MapSourceKind(
        name="overpass", gives="map", reader="network:fetch_bbox", licence="ODbL-1.0", attribution=_OSM
    ),
    MapSourceKind(
        name="terrain-tiles",
        gives="heights",
        reader="elevation:fetch_elevation",
        licence="open licences of several providers, named in the attribution",
        attribution=_TERRAIN_TILES,
    ),
    MapSourceKind(
        name="overture",
        gives="buildings",
        suffixes=(".parquet", ".geoparquet"),
        reader="overture:read_overture",
        licence="ODbL-1.0",
        attribution="(c) Overture Maps Foundation, https://overturemaps.org",
    ),
)

SOURCES: Registry[MapSourceKind] = Registry("source", {row.name: row for row in _SOURCES}, error=InputError)
"""All sources by name."""

_LAYERS: dict[str, tuple[Callable[[Tags], bool], frozenset[str]]] = {
    "buildings": (is_building, frozenset({"building", "building-part"}))
}
"""By what a source gives: whether a feature belongs to it, and the kinds of its problems."""


def reader_of(name: str) -> Callable[..., Any]:
    """The reader of a source; its module is imported here, not before."""
    reader: Callable[..., Any] = load(f"geoscene.sources.{SOURCES[name].reader}")
    return reader


def read_source(
    name: str, path: str | Path, *, bounds: Bounds | None = None, progress: Progress = iter
) -> OsmData:
    """The features of a file of a source, within bounds (west, south, east, north, degrees) if given.

    Raises InputError for a name that is not in the registry or has no files, and the errors of the reader.
    """
    known = sorted(source.name for source in SOURCES.values() if source.suffixes)
    if name not in known:
        raise InputError(unknown_name("`source`", name, known=known))
    found: OsmData = reader_of(name)(path, bounds=bounds, progress=progress)
    return found


def credits_of(osm: OsmData) -> tuple[Credit, ...]:
    """Sources of a map, with licence and attribution."""
    row = SOURCES[osm.kind]
    own = Credit(osm.kind, osm.source, osm.timestamp, row.licence, osm.attribution or row.attribution)
    return (own, *osm.added)


def merge_sources(base: OsmData, other: OsmData) -> OsmData:
    """The map ``base`` with all features that the source of ``other`` gives taken from ``other`` instead.

    ``other`` should have been read within the bounds of ``base``, which the result keeps.
    """
    gives = SOURCES[other.kind].gives
    if gives not in _LAYERS:
        raise InputError(f"source {other.kind}: gives {gives}, not one of {', '.join(_LAYERS)}")
    belongs, kinds = _LAYERS[gives]
    return replace(
        base,
        ways=[way for way in base.ways if not belongs(way.tags)] + other.ways,
        areas=[area for area in base.areas if not belongs(area.tags)] + other.areas,
        points=[point for point in base.points if not belongs(point.tags)] + other.points,
        problems=[problem for problem in base.problems if problem.kind not in kinds] + other.problems,
        added=(*base.added, *credits_of(other)),
    )
