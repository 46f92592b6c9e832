"""Attributes of a street from the tags of its way, with defaults and their sources."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from geoscene.roadgraph.lane_tags import SHUT, Lanes, read_lanes, read_width
from geoscene.roadgraph.speeds import read_speeds
from geoscene.roadgraph.values import (
    Remarks,
    most_important,
    read_word,
    remark_several,
    remark_unreadable,
)
from geoscene.sources.data import TaggedNode, Tags, Way
from geoscene.support.problems import Problem
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

_NO = frozenset({"", "no", "false", "0"})
_ROUNDABOUT = ("roundabout", "circular")
# Values of tunnel at ground level: the road runs through a building or under a roof.
_ABOVE_GROUND = _NO | {"building_passage", "avalanche_protector", "covered", "culvert", "flooded"}


# Assumed: a car turns within 11 to 12 m from kerb to kerb, a loop leaves room for an island, and British
# mini-roundabouts are 13 to 20 m wide.
TURNING = {"turning_circle": 12.0, "turning_loop": 16.0, "mini_roundabout": 14.0}
"""Values of ``highway`` of nodes where roads widen for turning, and metres of those of unknown diameter."""
_LOOP_LANE = 5.0
"""Metres from the island of a turning loop to its outer kerb. Assumed."""
_SMALLEST_ISLAND = 0.3
"""Metres of the radius of an island: a smaller one is all kerb."""


@dataclass(frozen=True, slots=True)
class Street:
    """A way for cars. Pairs are (along the way, against it).

    direction : 1 for traffic along the way only, -1 against it only, 0 for both
    speed     : m/s
    lanes     : for cars and buses; against a one-way street those for buses alone
    described : what is mapped of each lane, cycle lanes among them
    width     : metres, the whole carriageway
    aside     : metres that the middle of the carriageway is left of the way, at its start and at its end
    """

    highway: str
    direction: int
    speed: tuple[float, float]
    speed_source: tuple[str, str]
    lanes: tuple[float, float]
    lanes_source: str
    described: tuple[Lanes, Lanes]
    width: float
    width_source: str
    aside: tuple[float, float]
    layer: int
    layer_source: str
    bridge: bool
    tunnel: bool
    roundabout: bool
    name: str
    ref: str

    @property
    def symmetric(self) -> bool:
        """Whether both directions have the same attributes."""
        pairs = (self.speed, self.lanes, self.described, (0.0, self.aside[0]), (0.0, self.aside[1]))
        return self.direction == 0 and all(one == other for one, other in pairs)


def road_class(tags: Tags) -> str:
    """The class of a road: the most important one of a list (``tertiary;residential``), "" without one."""
    return most_important(tags.get("highway", ""), CLASSES + OTHER_CLASSES)


def drivable(tags: Tags, *, private: bool = False) -> bool:
    """Whether the public may drive a car on the way; with ``private``, whether it carries any vehicles.

    The most specific of ``motorcar``, ``motor_vehicle``, ``vehicle`` and ``access`` decides.
    """
    if tags.get("area") == "yes" or road_class(tags) not in (CLASSES + OTHER_CLASSES if private else CLASSES):
        return False
    if private:
        return True
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):
        if key in tags:
            return tags[key] not in SHUT
    return tags.get("service") != "emergency_access"


def read_street(tags: Tags, *, left_hand: bool = False) -> tuple[Street, Remarks]:
    """The street's attributes, its middle on the way, and remarks on tags that cannot be used as they are.

    left_hand : traffic keeps left
    """
    remarks: Remarks = []
    highway = road_class(tags)
    if highway != tags["highway"]:
        remark_several(remarks, "highway", text=tags["highway"], taken=highway)
    direction = _direction(tags, remarks)
    lanes, lanes_source, described = read_lanes(
        tags, highway, direction=direction, left_hand=left_hand, remarks=remarks
    )
    width, width_source = read_width(
        tags,
        highway,
        direction=direction,
        counted=(sum(lanes), lanes_source),
        described=described,
        remarks=remarks,
    )
    speed, speed_source = read_speeds(tags, highway, remarks=remarks)
    layer, layer_source = read_layer(tags, remarks)
    street = Street(
        highway=highway,
        direction=direction,
        speed=speed,
        speed_source=speed_source,
        lanes=lanes,
        lanes_source=lanes_source,
        described=described,
        width=width,
        width_source=width_source,
        aside=(0.0, 0.0),
        layer=layer,
        layer_source=layer_source,
        bridge=is_bridge(tags),
        tunnel=is_tunnel(tags),
        roundabout=tags.get("junction") in _ROUNDABOUT,
        name=tags.get("name", ""),
        ref=tags.get("ref", ""),
    )
    return street, remarks


def read_diameter(tags: Tags, remarks: Remarks) -> float:
    """Metres from kerb to kerb of a turning circle, a turning loop or a mini-roundabout."""
    text = tags.get("diameter")
    if text is not None:
        metres = parse_length(text)
        if metres is not None and 3 <= metres <= 80:
            return metres
        remark_unreadable(remarks, "diameter", text=text)
    return TURNING[tags["highway"]]


def island_radius(tags: Tags, road_width: float) -> float:
    """Metres of the radius of the island of a turning loop in a road of a width; 0 without an island."""
    radius = max(read_diameter(tags, []), road_width) / 2 - _LOOP_LANE
    return radius if tags["highway"] == "turning_loop" and radius > _SMALLEST_ISLAND else 0.0


def find_odd_diameters(points: Sequence[TaggedNode]) -> list[Problem]:
    """Problems of places to turn whose diameters cannot be read."""
    problems = []
    for point in points:
        remarks: Remarks = []
        if point.tags.get("highway") in TURNING:
            read_diameter(point.tags, remarks)
        problems += [Problem(point.osm_id, "road", "repaired", reason, text) for reason, text in remarks]
    return problems


def find_unused_inclines(ways: Sequence[Way]) -> list[Problem]:
    """Problems of roads whose ``incline`` has a number, on maps without heights: these are level."""
    return [
        Problem(
            way.osm_id, "road", "repaired", "incline", f"incline={text}: level, for want of elevation data"
        )
        for way in ways
        if drivable(way.tags) and re.search(r"\d", text := way.tags.get("incline", ""))
    ]


def is_bridge(tags: Tags) -> bool:
    """Whether the way runs on a bridge."""
    return tags.get("bridge", "") not in _NO


def is_tunnel(tags: Tags) -> bool:
    """Whether the way runs underground (a passage through a house does not)."""
    return tags.get("tunnel", "") not in _ABOVE_GROUND


def is_passage(tags: Tags) -> bool:
    """Whether the way runs through or under a building."""
    return tags.get("tunnel") == "building_passage" or tags.get("covered", "no") not in _NO


def read_layer(tags: Tags, remarks: Remarks) -> tuple[int, str]:
    """Layer and its source: the tag, a storey (``level``), else 1 on bridges, -1 in tunnels, 0."""
    for key in ("layer", "level"):
        text = tags.get(key)
        if text is None:
            continue
        try:
            number = round(float(text.split(";", maxsplit=1)[0]))
        except (ValueError, OverflowError):
            remark_unreadable(remarks, key, text=text)
            continue
        if abs(number) <= 20:
            return number, key
        remark_unreadable(remarks, key, text=text)
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


# Meanings of oneway: 1 along the way, -1 against it, 0 both. Lanes that change their direction serve both.
_ONEWAY = {
    **dict.fromkeys(("yes", "true", "1"), 1),
    **dict.fromkeys(("-1", "reverse"), -1),
    **dict.fromkeys(("no", "false", "0", "reversible", "alternating"), 0),
}


def _direction(tags: Tags, remarks: Remarks) -> int:
    """1, -1 or 0, by the most specific of ``oneway:motorcar`` ... ``oneway`` and of closed directions."""
    value: int | None = None
    for key in ("oneway:motorcar", "oneway:motor_vehicle", "oneway:vehicle", "oneway"):
        if key in tags:
            value = read_word(tags, key, known=_ONEWAY, remarks=remarks)
            break
    if value:
        return value
    for key in ("motorcar", "motor_vehicle", "vehicle", "access"):
        if tags.get(f"{key}:backward") == "no":
            return 1
        if tags.get(f"{key}:forward") == "no":
            return -1
    implied = road_class(tags) == "motorway" or tags.get("junction") in _ROUNDABOUT
    return 1 if implied and value is None else 0
