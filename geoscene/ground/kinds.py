"""Land cover by tags: class, material and order of precedence."""

from __future__ import annotations

from dataclasses import dataclass

from geoscene.classes import Class
from geoscene.sources.data import Tags
from geoscene.tags import parse_length, parse_number


@dataclass(frozen=True, slots=True)
class GroundKind:
    """Class, material and priority of a kind of ground.

    klass    : `geoscene.classes.Class`
    material : name in `geoscene.classes.materials`, `OPEN` or `FIELD`, where no ``surface`` tag says
               otherwise
    tier     : 0..99, the higher covers the lower; within a tier the smaller polygon covers the larger
    width    : metres, for lines without a usable ``width``; 0 for areas
    body     : ``sea``, ``standing`` or ``river`` for water, else ""
    """

    klass: Class
    material: str
    tier: int
    width: float = 0.0
    body: str = ""


OPEN, FIELD = "open", "field"
"""Materials of built-up and of farmed land whose surface the map does not give: as usual in the region."""

_BUILT = GroundKind(Class.TERRAIN, OPEN, 10)
_BARE = GroundKind(Class.TERRAIN, "soil", 10)
_PAVED = GroundKind(Class.PAVED, "paving", 11)
_LOOSE = GroundKind(Class.TERRAIN, "gravel", 12)
_FIELD = GroundKind(Class.TERRAIN, FIELD, 20)
_GREEN = GroundKind(Class.GRASS, "grass", 22)
_LAWN = GroundKind(Class.GRASS, "grass", 26)
_WOOD = GroundKind(Class.FOREST_FLOOR, "soil", 24)
_SCRUB = GroundKind(Class.TERRAIN, "dry_grass", 23)
_SAND = GroundKind(Class.SAND, "sand", 30)
_STONES = GroundKind(Class.TERRAIN, "gravel", 30)
_ROCK = GroundKind(Class.TERRAIN, "stone", 30)
_STANDING = GroundKind(Class.WATER, "water", 40, body="standing")
_RIVER = GroundKind(Class.WATER, "water", 41, body="river")
_MOLE = GroundKind(Class.TERRAIN, "stone", 50)
_PIER = GroundKind(Class.SIDEWALK, "concrete", 55)
_RUNWAY = GroundKind(Class.ROAD, "asphalt", 70)
_PARKING = GroundKind(Class.PARKING, "asphalt", 65)
_SQUARE = GroundKind(Class.SIDEWALK, "paving", 60)
_BASIN = GroundKind(Class.WATER, "water", 75, body="standing")

SEA = GroundKind(Class.WATER, "water", 39, body="sea")

AREAS: dict[str, dict[str, GroundKind]] = {
    "landuse": {
        "residential": _BUILT, "construction": _BARE, "brownfield": _BARE, "military": _BUILT,
        "farmyard": _BARE, "landfill": _BARE, "greenfield": _BUILT, "civil": _BUILT, "education": _BUILT,
        "religious": _BUILT, "institutional": _BUILT, "plant_nursery": _FIELD,
        "commercial": _PAVED, "retail": _PAVED, "industrial": _PAVED, "garages": _PAVED, "depot": _PAVED,
        "port": _PAVED, "harbour": _PAVED, "quarry": _LOOSE,
        "farmland": _FIELD, "farm": _FIELD, "vineyard": GroundKind(Class.TERRAIN, "soil", 20),
        "orchard": _GREEN, "allotments": _GREEN,
        "forest": _WOOD, "meadow": _GREEN, "cemetery": _GREEN, "recreation_ground": _GREEN,
        "village_green": _GREEN, "grass": _LAWN, "flowerbed": GroundKind(Class.GRASS, "soil", 27),
        "basin": _STANDING, "reservoir": _STANDING, "salt_pond": _STANDING,
        "railway": GroundKind(Class.RAIL, "gravel", 25),
    },
    "natural": {
        "wood": _WOOD, "scrub": _SCRUB, "heath": _SCRUB, "fell": _SCRUB, "moor": _SCRUB, "shrubbery": _SCRUB,
        "tundra": _SCRUB, "grassland": _LAWN, "wetland": GroundKind(Class.TERRAIN, "grass", 28),
        "mud": GroundKind(Class.TERRAIN, "soil", 29), "beach": _SAND, "sand": _SAND, "dune": _SAND,
        "shingle": _STONES, "scree": _STONES, "bare_rock": _ROCK, "rock": _ROCK, "stone": _ROCK,
        "shoal": _SAND, "reef": _ROCK, "glacier": GroundKind(Class.TERRAIN, "snow", 31),
        "water": _STANDING, "bay": _STANDING, "strait": _STANDING,
    },
    "leisure": {
        "park": GroundKind(Class.GRASS, "grass", 21), "common": _GREEN, "golf_course": _GREEN,
        "garden": _LAWN,
        "dog_park": _GREEN, "pitch": GroundKind(Class.GRASS, "grass", 62), "stadium": _PAVED,
        "sports_centre": _BUILT,
        "playground": GroundKind(Class.SAND, "sand", 61),
        "track": GroundKind(Class.TERRAIN, "dirt", 61),
        "swimming_pool": _BASIN, "schoolyard": _PAVED,
        "fitness_station": GroundKind(Class.SAND, "sand", 61),
        "marina": GroundKind(Class.PAVED, "concrete", 9),
        "slipway": GroundKind(Class.PAVED, "concrete", 56),
    },
    "golf": {
        "green": _LAWN, "fairway": _LAWN, "tee": _LAWN, "rough": _GREEN, "driving_range": _LAWN,
        "bunker": _SAND, "water_hazard": _STANDING, "lateral_water_hazard": _STANDING,
    },
    "amenity": {
        "parking": _PARKING, "parking_space": _PARKING, "motorcycle_parking": _PARKING,
        "bicycle_parking": GroundKind(Class.SIDEWALK, "paving", 66),
        "fuel": GroundKind(Class.PARKING, "concrete", 64),
        "taxi": _PARKING, "bus_station": GroundKind(Class.PARKING, "asphalt", 63), "marketplace": _SQUARE,
        "school": _BUILT, "kindergarten": _BUILT, "university": _BUILT, "college": _BUILT, "hospital": _BUILT,
        "grave_yard": _GREEN, "fountain": _BASIN, "swimming_pool": _BASIN,
    },
    "place": {"square": GroundKind(Class.SIDEWALK, "paving", 58)},
    "railway": {"platform": _SQUARE},
    "public_transport": {"platform": _SQUARE},
    "waterway": {"riverbank": _RIVER, "dock": _STANDING, "boatyard": _PAVED},
    "man_made": {
        "pier": _PIER, "breakwater": _MOLE, "groyne": _MOLE, "quay": _PIER, "courtyard": _PAVED,
        "wastewater_plant": _PAVED, "water_works": _PAVED, "works": _PAVED,
    },
    "aeroway": {
        "runway": _RUNWAY, "taxiway": _RUNWAY, "apron": GroundKind(Class.PARKING, "concrete", 68),
        "helipad": GroundKind(Class.PARKING, "asphalt", 71), "aerodrome": _GREEN, "heliport": _PAVED,
    },
}  # fmt: skip
"""Kinds of areas by key and value."""

LINES: dict[str, dict[str, GroundKind]] = {
    # Widths where the map has none, metres. Waterways: the orders of size that the OpenStreetMap wiki
    # gives each value. Railways: the ballast of one track of standard gauge, sleepers of 2.6 m and a
    # shoulder on each side; a tram lies in paving. Runways and taxiways: code letters C and D of ICAO
    # Annex 14, 45 m and 15 m.
    "waterway": {
        "river": GroundKind(Class.WATER, "water", 41, 12.0, "river"),
        "canal": GroundKind(Class.WATER, "water", 41, 10.0, "river"),
        "stream": GroundKind(Class.WATER, "water", 41, 2.0, "river"),
        "brook": GroundKind(Class.WATER, "water", 41, 2.0, "river"),
        "tidal_channel": GroundKind(Class.WATER, "water", 41, 3.0, "river"),
        "ditch": GroundKind(Class.WATER, "water", 41, 1.0, "river"),
        "drain": GroundKind(Class.WATER, "water", 41, 1.0, "river"),
    },
    "railway": {
        "rail": GroundKind(Class.RAIL, "ballast", 80, 3.6),
        "light_rail": GroundKind(Class.RAIL, "ballast", 80, 3.6),
        "subway": GroundKind(Class.RAIL, "ballast", 80, 3.6),
        "narrow_gauge": GroundKind(Class.RAIL, "ballast", 80, 2.8),
        "funicular": GroundKind(Class.RAIL, "ballast", 80, 2.8),
        "preserved": GroundKind(Class.RAIL, "ballast", 80, 3.6),
        "disused": GroundKind(Class.RAIL, "ballast", 79, 3.6),
        "tram": GroundKind(Class.RAIL, "paving", 81, 2.4),
        "platform": GroundKind(Class.SIDEWALK, "paving", 82, 3.0),
    },
    "man_made": {
        "pier": GroundKind(Class.SIDEWALK, "concrete", 55, 3.0),
        "quay": GroundKind(Class.SIDEWALK, "concrete", 55, 3.0),
        "breakwater": GroundKind(Class.TERRAIN, "stone", 50, 6.0),
        "groyne": GroundKind(Class.TERRAIN, "stone", 50, 3.0),
    },
    "aeroway": {
        "runway": GroundKind(Class.ROAD, "asphalt", 70, 45.0),
        "taxiway": GroundKind(Class.ROAD, "asphalt", 69, 15.0),
    },
}
"""Kinds of lines by key and value."""

SURFACES: dict[str, str] = {
    "asphalt": "asphalt", "chipseal": "asphalt", "paved": "asphalt", "tartan": "asphalt",
    "acrylic": "asphalt",
    "concrete": "concrete", "concrete:plates": "concrete", "concrete:lanes": "concrete",
    "paving_stones": "paving", "sett": "stone", "cobblestone": "stone", "unhewn_cobblestone": "stone",
    "stone": "stone", "rock": "stone", "bricks": "brick", "brick": "brick",
    "gravel": "gravel", "fine_gravel": "gravel", "pebblestone": "gravel", "compacted": "gravel",
    "unpaved": "gravel", "shells": "gravel", "rubber": "asphalt",
    "dirt": "dirt", "earth": "dirt", "ground": "dirt", "mud": "soil", "clay": "dirt", "woodchips": "bark",
    "grass": "grass", "grass_paver": "grass", "artificial_turf": "grass", "sand": "sand", "wood": "wood",
    "metal": "metal", "snow": "snow", "ice": "snow",
}  # fmt: skip
"""Materials by value of ``surface``."""

_UNPAVED: dict[str, Class] = {
    "grass": Class.GRASS, "dry_grass": Class.GRASS, "sand": Class.SAND, "soil": Class.TERRAIN,
    "dirt": Class.TERRAIN, "gravel": Class.TERRAIN, "bark": Class.TERRAIN, "snow": Class.TERRAIN,
}  # fmt: skip
"""Classes of ground of unpaved materials; all other materials are paving."""

_OPEN = frozenset({Class.TERRAIN, Class.GRASS, Class.SAND, Class.PAVED})
_BEDROCK = frozenset({"stone", "rock"})
"""Values of ``surface`` that are natural on open ground."""

_NO = frozenset({"no", "false", "0"})
_RIVERS = frozenset({"river", "stream", "canal", "rapids", "ditch", "drain", "lock"})


def ground_class(klass: Class, material: str) -> Class:
    """The class of ground of a kind and a material: open ground and places for pedestrians are paved or not.

    Forests, water, rails, carriageways and car parks stay what they are.
    """
    if klass == Class.SIDEWALK:
        return _UNPAVED.get(material, klass)
    return _UNPAVED.get(material, Class.PAVED) if klass in _OPEN else klass


def read_surface(tags: Tags, kind: GroundKind) -> tuple[Class, str, str]:
    """Class, material and source: by the tag ``surface``, else those of the kind (source ``tags``)."""
    value = tags.get("surface", "").split(";", maxsplit=1)[0].strip()
    if value not in SURFACES or kind.body:
        return kind.klass, kind.material, "tags"
    natural = value in _BEDROCK and kind.klass in _OPEN
    return kind.klass if natural else ground_class(kind.klass, SURFACES[value]), SURFACES[value], "surface"


def is_underground(tags: Tags) -> bool:
    """Whether a feature is not on the ground: in a tunnel, on a bridge or a roof, in or under a building."""
    return (
        any(
            tags.get(key, "no") not in _NO
            for key in ("tunnel", "bridge", "indoor", "covered", "building:part")
        )
        or tags.get("building", "no") not in _NO
        or tags.get("location") in {"underground", "roof", "rooftop", "indoor", "overhead"}
        or tags.get("parking") in {"underground", "multi-storey", "rooftop", "carports"}
    )


def storey_tag(tags: Tags, *, least: float = 1.0) -> str:
    """The tag that puts an object on a roof, an upper storey or below the ground, as text; "" on the ground.

    least : metres, ``min_height`` from which it counts
    """
    low, level = parse_length(tags.get("min_height")), parse_number(tags.get("level"))
    if low is not None and low >= least:
        return f"min_height={tags['min_height']}"
    if level is not None and level != 0 and "0" not in tags["level"].split(";"):
        return f"level={tags['level']}"
    return f"location={tags['location']}" if tags.get("location") in {"roof", "rooftop"} else ""


def area_kind(tags: Tags) -> GroundKind | None:
    """The kind of ground of an area: the highest tier of all its keys; None if it is none."""
    found = [kind for key, values in AREAS.items() if (kind := values.get(tags.get(key, ""))) is not None]
    if not found or is_underground(tags):
        return None
    kind = max(found, key=lambda k: k.tier)
    if kind is _STANDING and tags.get("water") in _RIVERS:
        return _RIVER
    return kind


def line_kind(tags: Tags) -> GroundKind | None:
    """The kind of ground of a line; None if it is none."""
    for key, values in LINES.items():
        kind = values.get(tags.get(key, ""))
        if kind is not None and not is_underground(tags):
            return kind
    return None
