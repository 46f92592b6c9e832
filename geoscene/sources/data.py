"""The data of a map: features with their tags as mapped, in longitude and latitude."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from geoscene.support.problems import Problem
from geoscene.typing import Float, Ints

Tags = dict[str, str]

Bounds = tuple[float, float, float, float]
"""West, south, east, north in degrees."""

Progress = Callable[[Iterable[Any]], Iterable[Any]]
"""Wraps a stream of map objects or of requests, to show its progress."""

METRES_PER_DEGREE = 111_195.0
"""Of latitude, on a sphere of 6371 km, the mean radius of the Earth (IUGG)."""


@dataclass(frozen=True, slots=True)
class Way:
    """A line with tags: a road, a railway, a barrier, a tree row.

    osm_id  : ``way/123``
    nodes   : (n,) int64 OSM node ids
    lonlat  : (n, 2) float64 degrees
    """

    osm_id: str
    tags: Tags
    nodes: Ints
    lonlat: Float


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon with tags, such as a closed way or a multipolygon relation.

    osm_id   : ``way/123`` or ``relation/45``; of other sources ``name:id``
    geometry : valid shapely Polygon or MultiPolygon, degrees, exteriors counter-clockwise
    nodes    : ids of the outer ring's nodes if the area is one closed way, else empty
    """

    osm_id: str
    tags: Tags
    geometry: Any
    nodes: Ints


@dataclass(frozen=True, slots=True)
class TaggedNode:
    """A node with tags. ``osm_id`` is ``node/6``."""

    osm_id: str
    tags: Tags
    lon: float
    lat: float


@dataclass(frozen=True, slots=True)
class Relation:
    """A relation that is not an area: ``type=restriction``, ``type=building`` ...

    members : (kind, id, role); kind is ``node``, ``way`` or ``relation``
    """

    osm_id: str
    tags: Tags
    members: tuple[tuple[str, int, str], ...]


@dataclass(frozen=True, slots=True)
class Credit:
    """A source whose features are in a map.

    kind        : its name in the registry
    origin      : file or place it was read from
    timestamp   : newest edit, ISO 8601, or "" if unknown
    licence     : SPDX identifier, or in words
    attribution : text to show with the data
    """

    kind: str
    origin: str
    timestamp: str
    licence: str
    attribution: str


@dataclass(frozen=True, slots=True)
class OsmData:
    """One map extract.

    bounds      : (west, south, east, north) degrees: the requested area, else the extract's, else its nodes'
    ways        : ways with tags that are lines (``highway``, ``railway``, ``barrier``, ``waterway`` ...)
    areas       : closed ways and multipolygons that are areas
    points      : nodes with tags
    relations   : relations that are not areas
    problems    : what was repaired or dropped while reading
    source      : file or place it was read from, for messages
    timestamp   : newest edit or replication time, ISO 8601, or "" if unknown
    kind        : name of the source in `geoscene.sources.registry.SOURCES`
    attribution : of these data, if more specific than the registry's
    added       : credits of other sources from which features were merged in
    cloud       : what was measured in point clouds, for the report; None without
    """

    bounds: Bounds
    ways: list[Way]
    areas: list[Area]
    points: list[TaggedNode]
    relations: list[Relation]
    problems: list[Problem] = field(default_factory=list)
    source: str = ""
    timestamp: str = ""
    kind: str = "osm"
    attribution: str = ""
    added: tuple[Credit, ...] = ()
    cloud: dict[str, Any] | None = None

    @property
    def digest(self) -> str:
        """Digest of ids, tags and coordinates; equal for equal maps."""
        import shapely  # noqa: PLC0415  (this module is imported for its names alone)

        digest = hashlib.sha256()
        for way in self.ways:
            digest.update(repr((way.osm_id, sorted(way.tags.items()))).encode() + way.lonlat.tobytes())
        shapes = shapely.to_wkb([area.geometry for area in self.areas])
        for area, shape in zip(self.areas, shapes, strict=True):
            digest.update(repr((area.osm_id, sorted(area.tags.items()))).encode() + shape)
        for point in self.points:
            digest.update(repr((point.osm_id, sorted(point.tags.items()), point.lon, point.lat)).encode())
        for relation in self.relations:
            digest.update(repr((relation.osm_id, sorted(relation.tags.items()), relation.members)).encode())
        return digest.hexdigest()[:20]
