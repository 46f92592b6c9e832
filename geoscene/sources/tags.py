"""What tags say a map object is: an area, a line, and of which kind."""

from __future__ import annotations

from geoscene.sources.data import Tags

ANY: frozenset[str] = frozenset()

NOISE = frozenset(
    {"attribution", "created_by", "fixme", "FIXME", "note", "odbl", "source", "source_ref", "todo"}
)
"""Keys that describe the mapping, not the thing; an object with no others counts as untagged."""

_NATURAL_LINES = frozenset(
    {"arch", "arete", "cliff", "coastline", "earth_bank", "gully", "ridge", "tree_row", "valley"}
)

AREA_KEYS: dict[str, tuple[bool, frozenset[str]]] = {
    # key: (True, values that are lines) or (False, the only values that are areas)
    "aeroway": (True, frozenset({"jet_bridge", "parking_position", "runway", "taxiway"})),
    "amenity": (True, frozenset({"bench", "weighbridge"})),
    "area:highway": (True, ANY),
    "boundary": (False, frozenset({"forest", "hazard", "national_park", "protected_area"})),
    "building": (True, ANY),
    "building:part": (True, ANY),
    "club": (True, ANY),
    "craft": (True, ANY),
    "emergency": (True, frozenset({"designated", "destination", "official", "private", "yes"})),
    "golf": (True, frozenset({"cartpath", "hole", "path"})),
    "healthcare": (True, ANY),
    "highway": (False, frozenset({"elevator", "escape", "platform", "rest_area", "services"})),
    "historic": (True, ANY),
    "indoor": (True, frozenset({"corridor", "wall"})),
    "landuse": (True, ANY),
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
    "office": (True, ANY),
    "place": (True, ANY),
    "power": (
        False,
        frozenset({"compensator", "converter", "generator", "plant", "substation", "transformer"}),
    ),
    "public_transport": (True, frozenset({"platform", "stop_position"})),
    "railway": (False, frozenset({"platform", "roundhouse", "station", "traverser", "turntable", "wash"})),
    "ruins": (True, ANY),
    "shop": (True, ANY),
    "tourism": (True, frozenset({"artwork", "attraction"})),
    "water": (True, ANY),
    "waterway": (False, frozenset({"boatyard", "dam", "dock", "fuel", "riverbank"})),
}
"""Which tags make a closed way an area where no ``area`` tag decides.

After the lists that the OpenStreetMap wiki ("Overpass turbo/Polygon Features") and the id-area-keys project
keep. Departures: piers, breakwaters, platforms and attractions are areas only with ``area=yes`` or another
area key, for their closed ways are as often walked round as filled, and barriers never are without it.
"""

LINE_KEYS = (
    "aerialway", "aeroway", "barrier", "golf", "highway", "leisure", "man_made", "natural", "power",
    "railway", "waterway",
)  # fmt: skip
"""Keys whose values, where `AREA_KEYS` does not take them for areas, are lines."""

_NO = frozenset({"no", "false", "0"})


def has_meaning(tags: Tags) -> bool:
    """Whether any tag says what the object is."""
    return any(key not in NOISE for key in tags)


def area_tags(tags: Tags) -> Tags:
    """The tags that make a closed way or a multipolygon an area."""
    out = {}
    for key, value in tags.items():
        rule = AREA_KEYS.get(key)
        if rule is not None and value not in _NO and (value not in rule[1] if rule[0] else value in rule[1]):
            out[key] = value
    return out


def is_building(tags: Tags) -> bool:
    """Whether it is a building or a part of one."""
    return tags.get("building", "no") not in _NO or tags.get("building:part", "no") not in _NO


def is_area(tags: Tags) -> bool:
    """Whether a closed way with these tags is an area: ``area`` decides, then `AREA_KEYS`."""
    stated = tags.get("area")
    if stated == "yes" or is_building(tags):
        return True
    return stated != "no" and bool(area_tags(tags))


def is_line(tags: Tags) -> bool:
    """Whether a closed way is a line too, as a fenced playground is both its ground and its fence."""
    if tags.get("area") == "yes":
        return False
    found = area_tags(tags)
    return any(tags.get(key, "no") not in _NO and key not in found for key in LINE_KEYS)


def is_open_area(tags: Tags) -> bool:
    """Whether a way with these tags is an area even if it is drawn open, so that the open end is a defect."""
    if is_building(tags):
        return True
    if any(tags.get(key, "no") not in _NO for key in LINE_KEYS if key not in area_tags(tags)):
        return False
    return tags.get("area") == "yes" or "landuse" in tags or "natural" in area_tags(tags)


def kind_of(tags: Tags, *, area: bool = False) -> str:
    """The kind under which problems with an object are counted; ``area`` if it is known to be one."""
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
