"""Attributes of a street from the tags of its way, with defaults and their sources."""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass

from geoscene.sources.data import Tags
from geoscene.tags import parse_length

CLASSES = (
    "motorway",
    "motorway_link",
    "trunk",
    "trunk_link",
    "primary",
    "primary_link",
    "secondary",
    "secondary_link",
    "tertiary",
    "tertiary_link",
    "unclassified",
    "residential",
    "living_street",
    "road",
    "service",
)
"""Values of ``highway`` that the public may drive on, most important first."""

OTHER_CLASSES = ("busway", "bus_guideway", "raceway", "escape", "track")
"""Values of ``highway`` with a carriageway that is not for the public."""

# Lanes in each direction (OSM wiki, Key:lanes, "Assumptions"). A half is one lane that both directions share.
_LANES = dict.fromkeys(CLASSES, 1.0) | {"motorway": 2.0, "service": 0.5, "track": 0.5}

# Metres. Assumed between RASt 06 / RAA (Germany: 2.75 in residential streets, 3.25 on main urban roads,
# 3.75 on motorways) and the AASHTO Green Book (2.7 to 3.6).
_LANE_WIDTH = {
    "motorway": 3.75,
    "trunk": 3.5,
    "primary": 3.5,
    "secondary": 3.25,
    "tertiary": 3.25,
    "unclassified": 3.0,
    "residential": 3.0,
    "living_street": 2.75,
    "road": 3.0,
    "service": 3.0,
    "track": 2.5,
}

# Metres of the whole carriageway of service roads without width or lanes: assumed (an aisle lets two cars
# pass between rows of parked ones, a driveway is one car wide).
_SERVICE_WIDTH = {"parking_aisle": 5.5, "alley": 3.5, "driveway": 3.0, "drive-through": 3.0}
_SERVICE_WIDTH_ELSE = 4.5

# One-way streets are kerb to kerb wider than their one lane: room to pass a stopped car. Assumed.
_ONEWAY_AT_LEAST = 4.0

CYCLE_LANE = 1.6
"""Metres, a cycle lane on the carriageway (RASt 06)."""

# Metres: a row of parked cars by how they stand (RASt 06).
_PARKED = {"parallel": 2.0, "diagonal": 4.5, "perpendicular": 5.0}

_SHUT = frozenset(
    {"no", "private", "agricultural", "forestry", "emergency", "military", "delivery", "use_sidepath"}
)
_NO = frozenset({"", "no", "false", "0"})
# Values of tunnel at ground level: the road runs through a building or under a roof.
_ABOVE_GROUND = _NO | {"building_passage", "avalanche_protector", "covered", "culvert", "flooded"}

_KMH = 1 / 3.6
_MPH = 0.44704
_KNOT = 1852 / 3600

# Limits in km/h where the map names none. Assumed: the usual urban limits, faster where the class is built
# for through traffic; OSM's wiki ("Speed limits") shows how far countries differ.
_SPEED = {
    "motorway": 110.0,
    "motorway_link": 60.0,
    "trunk": 80.0,
    "trunk_link": 50.0,
    "primary": 50.0,
    "primary_link": 40.0,
    "secondary": 50.0,
    "secondary_link": 40.0,
    "tertiary": 50.0,
    "tertiary_link": 40.0,
    "unclassified": 50.0,
    "residential": 40.0,
    "living_street": 15.0,
    "road": 40.0,
    "service": 20.0,
}

# Legal default limits in km/h by country and zone, as OSM's wiki lists them under "Speed limits" for the
# values that mappers put in maxspeed, maxspeed:type, source:maxspeed and zone:traffic.
_ZONES: dict[str, dict[str, float]] = {
    "": {"urban": 50, "living_street": 10, "bicycle_road": 30},
    "AT": {"rural": 100, "trunk": 100, "motorway": 130},
    "AU": {"rural": 100},
    "BE": {"rural": 90, "trunk": 120, "motorway": 120},
    "BE-BRU": {"urban": 30, "rural": 70, "motorway": 120},
    "BE-VLG": {"rural": 70, "trunk": 120, "motorway": 120},
    "BE-WAL": {"rural": 90, "trunk": 120, "motorway": 120},
    "BG": {"rural": 90, "trunk": 120, "motorway": 140},
    "BY": {"urban": 60, "rural": 90, "motorway": 110},
    "CH": {"rural": 80, "trunk": 100, "motorway": 120},
    "CZ": {"rural": 90, "trunk": 110, "urban_motorway": 80, "motorway": 130},
    "DE": {"rural": 100, "living_street": 7},
    "DK": {"rural": 80, "trunk": 80, "motorway": 130},
    "EE": {"rural": 90},
    "ES": {"rural": 90, "trunk": 90, "motorway": 120},
    "FI": {"rural": 80, "trunk": 100, "motorway": 120},
    "FR": {"rural": 80, "trunk": 110, "motorway": 130},
    "GB": {"nsl_restricted": 48.28032, "nsl_single": 96.56064, "nsl_dual": 112.65408, "motorway": 112.65408},
    "GR": {"rural": 90, "trunk": 110, "motorway": 130},
    "HU": {"rural": 90, "trunk": 110, "motorway": 130},
    "IT": {"rural": 90, "trunk": 110, "motorway": 130},
    "LT": {"rural": 90, "trunk": 110, "motorway": 130},
    "NL": {"rural": 80, "trunk": 100, "motorway": 100},
    "NO": {"rural": 80, "motorway": 110},
    "PL": {"rural": 90, "trunk": 100, "motorway": 140},
    "PT": {"rural": 90, "trunk": 100, "motorway": 120},
    "RO": {"rural": 90, "trunk": 100, "motorway": 130},
    "RS": {"rural": 80, "trunk": 100, "motorway": 130},
    "RU": {"urban": 60, "rural": 90, "motorway": 110, "living_street": 20},
    "SE": {"rural": 70, "trunk": 90, "motorway": 110},
    "SI": {"rural": 90, "trunk": 110, "motorway": 130},
    "SK": {"rural": 90, "trunk": 90, "motorway": 130},
    "UA": {"rural": 90, "trunk": 110, "motorway": 130, "living_street": 20},
}


@dataclass(frozen=True, slots=True)
class Street:
    """A way for cars. Pairs are (along the way, against it); a one-way street has 0 lanes against it.

    direction : 1 for traffic along the way only, -1 against it only, 0 for both
    speed     : m/s
    width     : metres, the whole carriageway
    """

    highway: str
    direction: int
    speed: tuple[float, float]
    speed_source: tuple[str, str]
    lanes: tuple[float, float]
    lanes_source: str
    width: float
    width_source: str
    layer: int
    layer_source: str
    bridge: bool
    tunnel: bool
    name: str
    ref: str

    @property
    def symmetric(self) -> bool:
        """Whether both directions have the same attributes."""
        return self.direction == 0 and self.speed[0] == self.speed[1] and self.lanes[0] == self.lanes[1]


def drivable(tags: Tags, *, private: bool = False) -> bool:
    """Whether the public may drive a car on the way; with ``private``, whether it carries any vehicles.

    The most specific of ``motorcar``, ``motor_vehicle``, ``vehicle`` and ``access`` decides.
    """
    highway = tags.get("highway")
    if tags.get("area") == "yes" or highway not in (CLASSES + OTHER_CLASSES if private else CLASSES):
        return False
    if private:
        return True
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):
        if key in tags:
            return tags[key] not in _SHUT
    return tags.get("service") != "emergency_access"


def read_street(tags: Tags) -> tuple[Street, list[str]]:
    """The street's attributes, and the tags (``key=value``) that could not be read."""
    unread: list[str] = []
    highway = tags["highway"]
    direction = _direction(tags)
    lanes, lanes_source = _lanes(tags, highway, direction=direction, unread=unread)
    width, width_source = _width(tags, direction, counted=(sum(lanes), lanes_source), unread=unread)
    speed, speed_source = read_speeds(tags, highway, unread=unread)
    layer, layer_source = read_layer(tags, unread)
    street = Street(
        highway=highway,
        direction=direction,
        speed=speed,
        speed_source=speed_source,
        lanes=lanes,
        lanes_source=lanes_source,
        width=width,
        width_source=width_source,
        layer=layer,
        layer_source=layer_source,
        bridge=is_bridge(tags),
        tunnel=is_tunnel(tags),
        name=tags.get("name", ""),
        ref=tags.get("ref", ""),
    )
    return street, unread


def is_bridge(tags: Tags) -> bool:
    """Whether the way runs on a bridge."""
    return tags.get("bridge", "") not in _NO


def is_tunnel(tags: Tags) -> bool:
    """Whether the way runs underground (a passage through a house does not)."""
    return tags.get("tunnel", "") not in _ABOVE_GROUND


def read_layer(tags: Tags, unread: list[str]) -> tuple[int, str]:
    """Layer and its source: the tag, a storey (``level``), else 1 on bridges, -1 in tunnels, 0."""
    for key in ("layer", "level"):
        text = tags.get(key)
        if text is None:
            continue
        try:
            number = round(float(text.split(";", maxsplit=1)[0]))
        except (ValueError, OverflowError):
            unread.append(f"{key}={text}")
            continue
        if abs(number) <= 20:
            return number, key
        unread.append(f"{key}={text}")
    if is_bridge(tags):
        return 1, "bridge"
    return (-1, "tunnel") if is_tunnel(tags) else (0, "default")


def place_of(*, bridge: bool, tunnel: bool) -> int:
    """0 on the ground, 1 on a bridge, 2 in a tunnel.

    ``layer`` and ``level`` alone do not count: a road of layer -1 without a tunnel tag runs in a cutting, on
    the ground.
    """
    return 1 if bridge else 2 if tunnel else 0


def place_and_layer(tags: Tags) -> tuple[int, int]:
    """Place of a way, as of `place_of`, and its layer."""
    return place_of(bridge=is_bridge(tags), tunnel=is_tunnel(tags)), read_layer(tags, [])[0]


def _direction(tags: Tags) -> int:
    """1, -1 or 0. Lanes that change their direction (``reversible``, ``alternating``) serve both."""
    value = tags.get("oneway:motor_vehicle", tags.get("oneway", ""))
    if value in ("yes", "true", "1"):
        return 1
    if value in ("-1", "reverse"):
        return -1
    for key in ("motor_vehicle", "vehicle", "access"):
        if tags.get(f"{key}:backward") == "no":
            return 1
        if tags.get(f"{key}:forward") == "no":
            return -1
    implied = tags["highway"] == "motorway" or tags.get("junction") in ("roundabout", "circular")
    return 1 if implied and value == "" else 0


def _count(tags: Tags, key: str, *, unread: list[str]) -> float | None:
    text = tags.get(key)
    if text is None:
        return None
    try:
        number = float(text.split(";", maxsplit=1)[0])
    except ValueError:
        number = -1.0
    if 0 < number <= 20:
        return number
    unread.append(f"{key}={text}")
    return None


def _lanes(tags: Tags, highway: str, *, direction: int, unread: list[str]) -> tuple[tuple[float, float], str]:
    total = _count(tags, "lanes", unread=unread)
    ahead = _count(tags, "lanes:forward", unread=unread) or _lanes_with_arrows(tags, "forward")
    back = _count(tags, "lanes:backward", unread=unread) or _lanes_with_arrows(tags, "backward")
    if direction:
        side = (ahead if direction == 1 else back) or _lanes_with_arrows(tags)
        given = total if total is not None else side
        count = _LANES.get(highway, 1.0) if given is None else given
        count = max(count, 1.0)
        return ((count, 0.0) if direction == 1 else (0.0, count)), ("default" if given is None else "lanes")
    middle = _count(tags, "lanes:both_ways", unread=unread) or 0.0
    if ahead is not None and back is not None:
        return (ahead + middle / 2, back + middle / 2), "lanes"
    if total is None:
        default = _LANES.get(highway, 1.0)
        source = "default" if ahead is None and back is None else "lanes"
        return (default if ahead is None else ahead, default if back is None else back), source
    if ahead is not None and total > ahead:
        return (ahead + middle / 2, total - ahead - middle / 2), "lanes"
    if back is not None and total > back:
        return (total - back - middle / 2, back + middle / 2), "lanes"
    return (total / 2, total / 2), "lanes"


def _lanes_with_arrows(tags: Tags, direction: str = "") -> float | None:
    """Lanes that ``turn:lanes`` lists, where no tag has their number."""
    values = tags.get(f"turn:lanes:{direction}" if direction else "turn:lanes", "").split("|")
    return float(len(values)) if 2 <= len(values) <= 8 else None


def _width(tags: Tags, direction: int, *, counted: tuple[float, str], unread: list[str]) -> tuple[float, str]:
    highway, (lanes, lanes_source) = tags["highway"], counted
    for key in ("width:carriageway", "width", "est_width"):
        if (text := tags.get(key)) is None:
            continue
        width = parse_length(text)
        if width is not None and 1.5 <= width <= 60:
            return width, "est_width" if key == "est_width" else "width"
        unread.append(f"{key}={text}")
    if highway == "service" and lanes_source == "default":
        return _SERVICE_WIDTH.get(tags.get("service", ""), _SERVICE_WIDTH_ELSE), "default"
    width = lanes * _LANE_WIDTH.get(highway.removesuffix("_link"), 3.5)
    if direction and lanes_source == "default":
        width = max(width, _ONEWAY_AT_LEAST)
    return width + _cycle_and_parking_width(tags), lanes_source


def _cycle_and_parking_width(tags: Tags) -> float:
    """Metres of the carriageway that mapped cycle lanes and rows of parked cars take up."""
    extra = 0.0
    one = is_plain(tags, "cycleway") and bool(_direction(tags))  # plain on a one-way street: on one side
    for side in ("left", "right"):
        lane = tag_of_side(tags, "cycleway", side=side) == "lane" and (side == "right" or not one)
        extra += (CYCLE_LANE if lane else 0.0) + parking_width(tags, side)
    return extra


def tag_of_side(tags: Tags, key: str, *, side: str) -> str:
    """Value of a tag such as ``cycleway`` on a side of the way; "" without it."""
    return tags.get(f"{key}:{side}", tags.get(f"{key}:both", tags.get(key, "")))


def is_plain(tags: Tags, key: str) -> bool:
    """Whether a tag such as ``cycleway`` does not say on which side of the way."""
    return key in tags and not any(f"{key}:{side}" in tags for side in ("left", "right", "both"))


def parking_width(tags: Tags, side: str) -> float:
    """Metres of the carriageway that a row of parked cars takes up on a side of the way."""
    where = tags.get(f"parking:{side}", tags.get("parking:both", "lane"))
    stand = tags.get(f"parking:{side}:orientation", tags.get("parking:both:orientation", ""))
    older = tags.get(f"parking:lane:{side}", tags.get("parking:lane:both", ""))
    return _PARKED.get(stand or older, 0.0) if where == "lane" else 0.0


@functools.lru_cache(maxsize=1024)
def speed_limit(text: str) -> tuple[float, str] | None:
    """A speed limit in m/s with its source (``maxspeed`` or ``zone``), or None if the text has no number.

    ``50``, ``30 mph``, ``10 knots``, ``walk`` and the legal defaults ``DE:urban``, ``GB:nsl_single``,
    ``DE:zone:30``; of a list (``50;30``) the lowest. ``none``, ``signals`` and ``variable`` name no number.
    """
    limits = [limit for part in re.split(r"[;|]", text) if (limit := _one_limit(part.strip())) is not None]
    return min(limits) if limits else None


def _one_limit(text: str) -> tuple[float, str] | None:
    if match := re.fullmatch(r"(\d+(?:[.,]\d+)?)\s*(mph|knots|km/?h|kph|kmph)?", text, re.IGNORECASE):
        unit = {"mph": _MPH, "knots": _KNOT}.get((match[2] or "").lower(), _KMH)
        speed = float(match[1].replace(",", ".")) * unit
        return (speed, "maxspeed") if 0 < speed < 100 else None
    if text == "walk":
        return _ZONES["DE"]["living_street"] * _KMH, "maxspeed"
    if match := re.fullmatch(r"(?:[A-Z]{2}(?:-[A-Z]+)?:)?zone:?(\d+)", text):
        return float(match[1]) * _KMH, "zone"
    if match := re.fullmatch(r"([A-Z]{2}(?:-[A-Z]+)?):(\w+)", text):
        limit = _ZONES.get(match[1], {}).get(match[2], _ZONES[""].get(match[2]))
        return None if limit is None else (limit * _KMH, "zone")
    return None


def read_speeds(
    tags: Tags, highway: str, *, unread: list[str]
) -> tuple[tuple[float, float], tuple[str, str]]:
    """Limits in m/s along the way and against it, and their sources; unreadable tags go to ``unread``."""
    default = _SPEED.get(highway, _SPEED["service"]) * _KMH, "default"
    both = default
    for key in ("maxspeed", "zone:maxspeed", "maxspeed:type", "source:maxspeed", "zone:traffic"):
        text = tags.get(key, "")
        if (limit := speed_limit(text)) is not None:
            both = limit
            break
        if key == "maxspeed" and text not in ("", "none", "signals", "variable", "national"):
            unread.append(f"{key}={text}")
    ahead, back = (speed_limit(tags.get(f"maxspeed:{side}", "")) or both for side in ("forward", "backward"))
    return (ahead[0], back[0]), (ahead[1], back[1])
