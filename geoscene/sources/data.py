"""Features of a map extract as data, and what their tags say: area or line, and the kind."""

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

AROUND_BOUNDS = 500.0
"""Metres beyond given bounds within which streets count for the heights of those within."""

_ALL_VALUES: frozenset[str] = frozenset()

NOISE = frozenset(
    {"attribution", "created_by", "fixme", "FIXME", "note", "odbl", "source", "source_ref", "todo"}
)
"""Keys that describe the mapping, not the object; an object with only these counts as untagged."""

_NATURAL_LINES = frozenset(
    {"arch", "arete", "cliff", "coastline", "earth_bank", "gully", "ridge", "tree_row", "valley"}
)

AREA_KEYS: dict[str, tuple[bool, frozenset[str]]] = {
    # key: (True, values that are lines) or (False, the only values that are areas)
    "aeroway": (True, frozenset({"jet_bridge", "parking_position", "runway", "taxiway"})),
    "amenity": (True, frozenset({"bench", "weighbridge"})),
    "area:highway": (True, _ALL_VALUES),
    "boundary": (False, frozenset({"forest", "hazard", "national_park", "protected_area"})),
    "building": (True, _ALL_VALUES),
    "building:part": (True, _ALL_VALUES),
    "club": (True, _ALL_VALUES),
    "craft": (True, _ALL_VALUES),
    "emergency": (True, frozenset({"designated", "destination", "official", "private", "yes"})),
    "golf": (True, frozenset({"cartpath", "hole", "path"})),
    "healthcare": (True, _ALL_VALUES),
    "highway": (False, frozenset({"elevator", "escape", "platform", "rest_area", "services"})),
    "historic": (True, _ALL_VALUES),
    "indoor": (True, frozenset({"corridor", "wall"})),
    "landuse": (True, _ALL_VALUES),
    "leisure": (True, frozenset({"slipway", "track"})),
    "man_made": (
        True,
        frozenset(
            {
                "breakwater",
                "crane",
                "cutline",
                "dyke",
                "embankment",
                "goods_conveyor",
                "groyne",
                "pier",
                "pipeline",
            }
        ),
    ),
    "military": (True, frozenset({"trench"})),
    "natural": (True, _NATURAL_LINES),
    "office": (True, _ALL_VALUES),
    "place": (True, _ALL_VALUES),
    "power": (
        False,
        frozenset({"compensator", "converter", "generator", "plant", "substation", "transformer"}),
    ),
    "public_transport": (True, frozenset({"platform", "stop_position"})),
    "railway": (False, frozenset({"platform", "roundhouse", "station", "traverser", "turntable", "wash"})),
    "ruins": (True, _ALL_VALUES),
    "shop": (True, _ALL_VALUES),
    "tourism": (True, frozenset({"artwork", "attraction"})),
    "water": (True, _ALL_VALUES),
    "waterway": (False, frozenset({"boatyard", "dam", "dock", "fuel", "riverbank"})),
}
"""Tags that make a closed way an area if it has no ``area`` tag.

After the lists that the OpenStreetMap wiki ("Overpass turbo/Polygon Features") and the id-area-keys project
keep. Departures: piers, breakwaters, platforms and attractions are areas only with ``area=yes`` or another
area key, because their closed ways are often lines around something; barriers never are without it.
"""

LINE_KEYS = (
    "aerialway", "aeroway", "barrier", "golf", "highway", "leisure", "man_made", "natural", "power",
    "railway", "waterway",
)  # fmt: skip
"""Keys whose values are lines unless `AREA_KEYS` makes them areas."""

_NO = frozenset({"no", "false", "0"})

_GONE = frozenset(
    {
        "cancelled",
        "collapsed",
        "demolished",
        "destroyed",
        "dismantled",
        "planned",
        "proposed",
        "razed",
        "removed",
    }
)
"""States of objects that do not exist, or no longer."""

_UNUSABLE = {
    "highway": frozenset({"abandoned", "construction", "disused"}),
    "railway": frozenset({"abandoned", "construction"}),
    "bridge": frozenset({"construction"}),
}
"""Values of ways that nothing runs on; buildings under construction and abandoned ones stand."""

_STANDING = frozenset({"abandoned", "disused", "ruins"})
"""Prefixes of buildings that stand."""

_STATED = (
    "building", "building:part", "highway", "railway", "barrier", "bridge", "natural", "man_made", "power",
    "amenity", "leisure", "waterway",
)  # fmt: skip
"""Keys that may have a state, as ``building=proposed`` or ``demolished:building=yes``."""

_STATES = _GONE | _STANDING | {"construction"}


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
    around      : streets, railways and waterways beyond the bounds, whole, on which the heights of streets
                  within depend; not part of the scene
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
    around: list[Way] = field(default_factory=list)

    @property
    def digest(self) -> str:
        """Digest of ids, tags and coordinates; equal for equal maps."""
        import shapely  # noqa: PLC0415  (this module is imported for its names alone)

        digest = hashlib.sha256()
        for way in [*self.ways, *self.around]:
            digest.update(repr((way.osm_id, sorted(way.tags.items()))).encode() + way.lonlat.tobytes())
        shapes = shapely.to_wkb([area.geometry for area in self.areas])
        for area, shape in zip(self.areas, shapes, strict=True):
            digest.update(repr((area.osm_id, sorted(area.tags.items()))).encode() + shape)
        for point in self.points:
            digest.update(repr((point.osm_id, sorted(point.tags.items()), point.lon, point.lat)).encode())
        for relation in self.relations:
            digest.update(repr((relation.osm_id, sorted(relation.tags.items()), relation.members)).encode())
        return digest.hexdigest()[:20]


def has_meaning(tags: Tags) -> bool:
    """Whether any tag describes the object itself."""
    return any(key not in NOISE for key in tags)


def existing_tags(tags: Tags) -> tuple[Tags, str]:
    """The tags of what exists, and the tags that say that something does not, as text; "" if none does.

    Planned and removed objects are tagged ``building=proposed``, ``demolished:building=yes``, or
    ``building=yes`` with ``demolished=yes``. Buildings that are disused, abandoned or ruined stand.
    """
    words = {*tags, *tags.values(), *(key.partition(":")[0] for key in tags)}
    if words.isdisjoint(_STATES):
        return tags, ""
    gone = [key for key in _GONE.intersection(tags) if tags[key] == "yes"]
    kept: Tags = {}
    absent = []
    for key, value in tags.items():
        prefix, _, rest = key.partition(":")
        if key in _STATED and (gone or value in _GONE or value in _UNUSABLE.get(key, ())):
            absent.append(f"{key}={value}")
        elif prefix in _STANDING and rest == "building":
            kept.setdefault("building", value)
        else:
            kept[key] = value
            if (
                rest in _STATED
                and rest not in tags
                and (prefix in _GONE or prefix in _UNUSABLE.get(rest, ()))
            ):
                absent.append(f"{key}={value}")
    return kept, ", ".join([*absent, *(f"{key}=yes" for key in sorted(gone) if absent)])


def area_tags(tags: Tags) -> Tags:
    """The tags that make a closed way or a multipolygon an area."""
    out = {}
    for key, value in tags.items():
        rule = AREA_KEYS.get(key)
        if rule is not None and value not in _NO and (value not in rule[1] if rule[0] else value in rule[1]):
            out[key] = value
    return out


def is_building(tags: Tags) -> bool:
    """Whether the tags are those of a building or of a part of one."""
    return tags.get("building", "no") not in _NO or tags.get("building:part", "no") not in _NO


def is_area(tags: Tags) -> bool:
    """Whether a closed way with these tags is an area, by ``area``, else by `AREA_KEYS`."""
    stated = tags.get("area")
    if stated == "yes" or is_building(tags):
        return True
    return stated != "no" and bool(area_tags(tags))


def is_line(tags: Tags) -> bool:
    """Whether a closed way is a line too: a fenced playground is both its ground and its fence."""
    if tags.get("area") == "yes":
        return False
    found = area_tags(tags)
    return any(tags.get(key, "no") not in _NO and key not in found for key in LINE_KEYS)


def is_open_area(tags: Tags) -> bool:
    """Whether a way with these tags must be closed, so that an open one is a defect."""
    if is_building(tags):
        return True
    found = area_tags(tags)
    if any(tags.get(key, "no") not in _NO and key not in found for key in LINE_KEYS):
        return False
    return tags.get("area") == "yes" or "landuse" in tags or "natural" in found


def kind_of(tags: Tags, *, area: bool = False) -> str:
    """The kind under which an object's problems are counted. ``area``: the object is known to be an area."""
    if tags.get("building", "no") not in _NO:
        return "building"
    if tags.get("building:part", "no") not in _NO:
        return "building-part"
    if tags.get("natural") == "water" or tags.get("waterway") in {"riverbank", "dock"} or "water" in tags:
        return "water"
    found = area_tags(tags)
    for key, kind in (
        ("highway", "road"),
        ("railway", "railway"),
        ("barrier", "barrier"),
        ("waterway", "waterway"),
    ):
        if tags.get(key, "no") not in _NO and key not in found and not (area and found):
            return kind
    return "area" if area or is_area(tags) else "line"
