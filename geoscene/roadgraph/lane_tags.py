"""Number, use and width of the lanes of a street, from the tags of its way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from geoscene.roadgraph.values import Remarks, remark_several, remark_unreadable
from geoscene.sources.data import Tags
from geoscene.tags import parse_length

# Lanes in each direction (OSM wiki, Key:lanes, "Assumptions"). A half is one lane that both directions share.
_LANES = {"motorway": 2.0, "service": 0.5, "track": 0.5}

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

SHUT = frozenset(
    {"no", "private", "agricultural", "forestry", "emergency", "military", "delivery", "use_sidepath"}
)
"""Values of access that close a road or a lane to the public."""

# Vehicle classes that include a car, the most specific first.
_CAR = ("motorcar", "motor_vehicle", "vehicle", "access")
_BUS = ("bus", "psv")
TURNS = frozenset(
    {"left", "slight_left", "sharp_left", "through", "right", "slight_right", "sharp_right", "reverse",
     "merge_to_left", "merge_to_right"}
)  # fmt: skip
"""Values of ``turn:lanes``."""

_SIDES = ("forward", "backward")
_NARROWEST, _WIDEST = 0.8, 10.0  # metres of a lane that are believed

LaneKind = Literal["driving", "bus", "biking", "restricted"]


@dataclass(frozen=True, slots=True)
class Lane:
    """A lane that the map describes.

    kind  : who may drive on it, in the words of OpenDRIVE; ``restricted`` is none of the others
    width : metres, 0 if not mapped
    turns : values of ``turn:lanes``, () if there are none
    """

    kind: LaneKind = "driving"
    width: float = 0.0
    turns: tuple[str, ...] = ()


Lanes = tuple[Lane, ...]
"""Lanes of one direction from left to right, as those who drive there see them; () if none is described."""


def read_lanes(
    tags: Tags, highway: str, *, direction: int, left_hand: bool, remarks: Remarks
) -> tuple[tuple[float, float], str, tuple[Lanes, Lanes]]:
    """Lanes along the way and against it, the source of their number, and what is mapped of each.

    A one-way street has lanes against its traffic only for buses. Cycle lanes are among the lanes that are
    described, and not counted.

    direction : 1 along the way, -1 against it, 0 for both
    left_hand : traffic keeps left
    """
    counts, source = _count_lanes(tags, highway, direction=direction, remarks=remarks)
    lists = _Lists(tags, direction, counts=counts, left_hand=left_hand)
    forward, backward = (
        _describe(tags, lists, side=side, direction=direction, remarks=remarks) for side in (0, 1)
    )
    return counts, source, (forward, backward)


def _count_lanes(
    tags: Tags, highway: str, *, direction: int, remarks: Remarks
) -> tuple[tuple[float, float], str]:
    total = _count(tags, "lanes", remarks=remarks)
    ahead, back = (
        _count(tags, f"lanes:{side}", remarks=remarks) or _listed(tags, f":{side}") for side in _SIDES
    )
    if direction:
        own, other = (ahead, back) if direction == 1 else (back, ahead)
        against = _against(tags, other, direction=direction)
        if not against and total is not None and own is not None and _is_for_buses(tags):
            against = max(total - own, 0.0)
        if total is not None:
            count = max(total - against, 1.0)
        else:
            listed = own or _listed(tags)
            count = max(_LANES.get(highway, 1.0) if listed is None else listed, 1.0)
            total = listed
        pair = (count, against) if direction == 1 else (against, count)
        return pair, ("default" if total is None else "lanes")
    middle = _count(tags, "lanes:both_ways", remarks=remarks) or 0.0
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


def _count(tags: Tags, key: str, *, remarks: Remarks) -> float | None:
    text = tags.get(key)
    if text is None:
        return None
    first = text.split(";", maxsplit=1)[0].strip()
    try:
        number = float(first)
    except ValueError:
        number = -1.0
    if 0 < number <= 20:
        if first != text.strip():
            remark_several(remarks, key, text=text, taken=first)
        return number
    remark_unreadable(remarks, key, text=text)
    return None


def _listed(tags: Tags, suffix: str = "") -> float | None:
    """Lanes for cars and buses that tags list one by one, where no tag has their number."""
    for name in ("turn", "width", *_BUS, *_CAR):
        values = tags.get(f"{name}:lanes{suffix}", "").split("|")
        if 2 <= len(values) <= 10:
            bicycles = tags.get(f"bicycle:lanes{suffix}", "").split("|")
            return float(max(len(values) - bicycles.count("designated"), 1))
    return None


def _against(tags: Tags, lanes: float | None, *, direction: int) -> float:
    """Lanes of a one-way street against its traffic; ``lanes`` are those that tags count there."""
    other = _SIDES[1 if direction == 1 else 0]
    for kind in _BUS:
        if (text := tags.get(f"lanes:{kind}:{other}", "")).isdigit() and 0 < int(text) <= 20:
            return float(text)
    if lanes is not None:
        return lanes
    if any(tag_of_side(tags, "busway", side=side) == "opposite_lane" for side in ("left", "right")):
        return 1.0
    return 0.0


class _Lists:
    """Values of tags on single lanes, by key, for both directions."""

    def __init__(self, tags: Tags, direction: int, *, counts: tuple[float, float], left_hand: bool) -> None:
        self._tags, self._direction, self._left_hand = tags, direction, left_hand
        self.counts = tuple(
            max(int(count), 1) if count or direction in (0, 1 - 2 * side) else 0
            for side, count in enumerate(counts)
        )
        self._whole = sum(counts) == sum(self.counts)

    def of(self, name: str, side: int) -> tuple[str, tuple[str, ...]]:
        """Key and values of one direction, from left to right as seen there; no values without the tag.

        Without a direction in the key, they are those of a one-way street, or of both directions from left
        to right as seen along the way.
        """
        key = f"{name}:lanes"
        directed = f"{key}:{_SIDES[side]}"
        if directed in self._tags:
            return directed, tuple(value.strip() for value in self._tags[directed].split("|"))
        if key not in self._tags:
            return key, ()
        values = tuple(value.strip() for value in self._tags[key].split("|"))
        if self._direction:
            return key, values if self._direction == 1 - 2 * side else ()
        if not self._whole or len(values) != sum(self.counts) or f"{key}:{_SIDES[1 - side]}" in self._tags:
            return key, ()
        ahead, back = self.counts
        if side == 0:
            return key, values[:ahead] if self._left_hand else values[back:]
        return key, (values[ahead:] if self._left_hand else values[:back])[::-1]

    def bus_lanes(self, side: int) -> tuple[int, ...]:
        """Lanes for buses that tags on the whole way name; not the only one."""
        count = self.counts[side]
        suffix = f":{_SIDES[side]}"
        for kind in _BUS:
            text = self._tags.get(
                f"lanes:{kind}{suffix}", self._tags.get(f"lanes:{kind}", "") if self._direction else ""
            )
            if text.isdigit() and 0 < int(text) < count:
                lanes = range(count)
                return tuple(lanes[: int(text)] if self._left_hand else lanes[count - int(text) :])
        outer = 0 if self._left_hand else count - 1
        kept = "left" if self._left_hand else "right"
        if count < 2:
            return ()
        if self._direction == 0:
            own = kept if side == 0 else other_side(kept)
            return (outer,) if tag_of_side(self._tags, "busway", side=own) == "lane" else ()
        if is_plain(self._tags, "busway"):
            return (outer,) if self._tags["busway"] == "lane" else ()
        ends = (0, count - 1) if side == 0 else (count - 1, 0)
        return tuple(
            sorted(
                lane
                for lane, name in zip(ends, ("left", "right"), strict=True)
                if tag_of_side(self._tags, "busway", side=name) == "lane"
            )
        )


def _describe(tags: Tags, lists: _Lists, *, side: int, direction: int, remarks: Remarks) -> Lanes:
    """The lanes of one direction as far as they are mapped one by one."""
    count = lists.counts[side]
    if not count:
        return ()
    if direction and direction != 1 - 2 * side:
        kinds: tuple[LaneKind, ...] = ("bus" if _is_for_buses(tags) else "restricted",) * count
    else:
        kinds = _kinds(lists, side, count=count)
    lanes = [Lane(kind) for kind in kinds]
    cars = [k for k, kind in enumerate(kinds) if kind != "biking"]
    for name, what in (("turn", "arrows"), ("width", "widths")):
        key, values = lists.of(name, side)
        if not values:
            continue
        rows = list(range(len(lanes))) if len(values) == len(lanes) else cars
        if len(values) != len(rows):
            why = f"{what} of {len(values)} lanes where there are {count}"
            remark_unreadable(remarks, key, text="|".join(values), why=why)
            continue
        for row, value in zip(rows, values, strict=True):
            if name == "turn":
                lanes[row] = replace(lanes[row], turns=tuple(v for v in value.split(";") if v in TURNS))
            elif value:
                width = parse_length(value)
                if width is None or not _NARROWEST <= width <= _WIDEST:
                    remark_unreadable(
                        remarks, key, text="|".join(values), why=f"{value} is no width of a lane"
                    )
                else:
                    lanes[row] = replace(lanes[row], width=width)
    return tuple(lanes) if any(lane != Lane() for lane in lanes) else ()


def _is_for_buses(tags: Tags) -> bool:
    """Whether tags say that lanes against a one-way street are for buses."""
    opposite = any(tag_of_side(tags, "busway", side=side) == "opposite_lane" for side in ("left", "right"))
    return opposite or any(
        tags.get(f"oneway:{kind}") == "no"
        or any(f"{name}:{side}" in tags for name in (f"lanes:{kind}", f"{kind}:lanes") for side in _SIDES)
        for kind in _BUS
    )


def _kinds(lists: _Lists, side: int, *, count: int) -> tuple[LaneKind, ...]:
    """Who may drive on the lanes of one direction: ``count`` for cars and buses, and cycle lanes."""
    values = {name: lists.of(name, side)[1] for name in (*_CAR, *_BUS, "bicycle")}
    for length in sorted({len(v) for v in values.values() if v}, reverse=True):
        fitting = {name: v for name, v in values.items() if len(v) == length}
        kinds = tuple(
            _kind({name: v[k] for name, v in fitting.items()}, extra=length > count) for k in range(length)
        )
        if length - kinds.count("biking") == count or length == count:
            return kinds
    buses = lists.bus_lanes(side)
    return tuple("bus" if k in buses else "driving" for k in range(count))


def _kind(values: dict[str, str], *, extra: bool) -> LaneKind:
    """Kind of a lane by its values of access.

    extra : the lanes are more than those for cars and buses, so that some are for bicycles
    """
    buses = [values.get(name, "") for name in _BUS]
    if "designated" in buses:
        return "bus"
    cars = next((values[name] for name in _CAR if values.get(name)), "")
    bicycles = values.get("bicycle", "")
    if cars in SHUT:
        allowed: tuple[LaneKind, ...] = ("bus",) if "yes" in buses else ()
        allowed += ("biking",) if bicycles in ("yes", "designated") else ()
        return allowed[0] if allowed else "restricted"
    return "biking" if extra and not cars and bicycles == "designated" else "driving"


def default_lane_width(highway: str) -> float:
    """Metres of a lane of a road class where the map has none."""
    return _LANE_WIDTH.get(highway.removesuffix("_link"), 3.5)


def read_width(
    tags: Tags,
    highway: str,
    *,
    direction: int,
    counted: tuple[float, str],
    described: tuple[Lanes, Lanes],
    remarks: Remarks,
) -> tuple[float, str]:
    """Metres of the whole carriageway, and their source.

    counted   : number of lanes of both directions, and its source
    described : the lanes that the map describes
    """
    lanes, lanes_source = counted
    for key in ("width:carriageway", "width", "est_width"):
        if (text := tags.get(key)) is None:
            continue
        width = parse_length(text)
        if width is not None and 1.5 <= width <= 60:
            return width, "est_width" if key == "est_width" else "width"
        remark_unreadable(remarks, key, text=text)
    each = [lane for side in described for lane in side]
    bicycles = [lane.width or CYCLE_LANE for lane in each if lane.kind == "biking"]
    mapped = [lane.width for lane in each if lane.width and lane.kind != "biking"]
    if highway == "service" and lanes_source == "default":
        return _SERVICE_WIDTH.get(tags.get("service", ""), _SERVICE_WIDTH_ELSE), "default"
    width = sum(mapped) + max(lanes - len(mapped), 0.0) * default_lane_width(highway)
    if direction and lanes_source == "default":
        width = max(width, _ONEWAY_AT_LEAST)
    beside = sum(bicycles) if bicycles else _cycle_lanes_width(tags, direction)
    beside += parking_width(tags, "left") + parking_width(tags, "right")
    whole = mapped and len(mapped) >= lanes
    return width + beside, "width" if whole else lanes_source


def _cycle_lanes_width(tags: Tags, direction: int) -> float:
    """Metres of the carriageway that mapped cycle lanes take up."""
    one = is_plain(tags, "cycleway") and bool(direction)  # plain on a one-way street: on one side
    on = [tag_of_side(tags, "cycleway", side=side) == "lane" for side in ("left", "right")]
    return CYCLE_LANE * ((on[0] and not one) + on[1])


def tag_of_side(tags: Tags, key: str, *, side: str) -> str:
    """Value of a tag such as ``cycleway`` on a side of the way; "" without it."""
    return tags.get(f"{key}:{side}", tags.get(f"{key}:both", tags.get(key, "")))


def is_plain(tags: Tags, key: str) -> bool:
    """Whether a tag such as ``cycleway`` does not say on which side of the way."""
    return key in tags and not any(f"{key}:{side}" in tags for side in ("left", "right", "both"))


def other_side(side: str) -> str:
    """Right for left, and left for right."""
    return "left" if side == "right" else "right"


def parking_width(tags: Tags, side: str) -> float:
    """Metres of the carriageway that a row of parked cars takes up on a side of the way."""
    where = tags.get(f"parking:{side}", tags.get("parking:both", "lane"))
    stand = tags.get(f"parking:{side}:orientation", tags.get("parking:both:orientation", ""))
    older = tags.get(f"parking:lane:{side}", tags.get("parking:lane:both", ""))
    return _PARKED.get(stand or older, 0.0) if where == "lane" else 0.0
