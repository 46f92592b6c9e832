"""Lane markings of a street from the tags of its way: turns, buses, bicycles, limits."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

from geoscene.roadgraph.tags import CYCLE_LANE, Street, is_plain, parking_width, tag_of_side
from geoscene.sources.data import Tags
from geoscene.tags import parse_length

_TURNS = frozenset(
    {"left", "slight_left", "sharp_left", "through", "right", "slight_right", "sharp_right", "reverse",
     "merge_to_left", "merge_to_right"}
)  # fmt: skip
_LEAST_LANE = 2.5
"""Metres that the lanes for cars keep beside cycle lanes and parked cars."""


@dataclass(frozen=True, slots=True)
class CycleLane:
    """A cycle lane on one side of a carriageway, or the mark of a lane that cars and bicycles share.

    kind    : ``lane``, ``advisory`` (cars may use it, too) or ``shared`` (no lane of its own)
    width   : metres
    inset   : metres between the lane and the kerb, for parked cars
    against : bicycles ride against the traffic of this side
    """

    kind: Literal["lane", "advisory", "shared"]
    width: float
    inset: float
    against: bool


@dataclass(frozen=True, slots=True)
class LaneUses:
    """Markings of the lanes of a street. Pairs are (along the way, against it).

    turns : of each lane from left to right, as seen in its direction, the arrows on it; () if not tagged
    bus   : numbers of the lanes for buses, counted in the same way
    cycle : on the left and right of the way
    speed : digits of a limit on the road, "" for none
    zone  : the limit is that of a zone, and painted only where the zone begins
    """

    turns: tuple[tuple[tuple[str, ...], ...], tuple[tuple[str, ...], ...]] = ((), ())
    bus: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    cycle: tuple[CycleLane | None, CycleLane | None] = (None, None)
    speed: str = ""
    zone: bool = False

    @property
    def symmetric(self) -> bool:
        """Whether both directions have the same paint."""
        pairs = (self.turns, self.bus, self.cycle)
        return all(a == b for a, b in pairs)

    def __bool__(self) -> bool:
        """Whether any lane is marked."""
        return self != NO_USES


NO_USES = LaneUses()


def read_lane_uses(tags: Tags, street: Street, *, left_hand: bool = False) -> tuple[LaneUses, list[str]]:
    """The paint of a way's lanes, and the tags (``key=value: reason``) that do not fit its lanes.

    left_hand : traffic keeps left
    """
    if tags.get("lane_markings") == "no":
        return NO_USES, []
    unread: list[str] = []
    counts = [max(int(count), 1) for count in street.lanes]
    turns = [_turns(tags, street, side=k, count=counts[k], unread=unread) for k in (0, 1)]
    bus = [_bus_lanes(tags, street, side=k, count=counts[k], left_hand=left_hand) for k in (0, 1)]
    speed, zone = _painted_limit(tags)
    cycle = _cycle_lanes(tags, street, left_hand=left_hand)
    return LaneUses((turns[0], turns[1]), (bus[0], bus[1]), cycle, speed, zone), unread


def _driven(street: Street, side: int) -> bool:
    """Whether traffic runs along (0) or against (1) the way."""
    return street.direction != (-1 if side == 0 else 1)


def _of_direction(tags: Tags, key: str, *, street: Street, side: int) -> tuple[str, str]:
    """Key and value of a tag on the lanes of one direction; "" without it.

    Without a direction in the key, it is that of a one-way street.
    """
    if not _driven(street, side):
        return key, ""
    directed = f"{key}:{('forward', 'backward')[side]}"
    if directed in tags:
        return directed, tags[directed]
    return key, tags.get(key, "") if street.direction else ""


def _turns(
    tags: Tags, street: Street, *, side: int, count: int, unread: list[str]
) -> tuple[tuple[str, ...], ...]:
    key, text = _of_direction(tags, "turn:lanes", street=street, side=side)
    if not text:
        return ()
    lanes = tuple(tuple(v for v in lane.split(";") if v in _TURNS) for lane in text.split("|"))
    if len(lanes) != count:
        unread.append(f"{key}={text}: arrows of {len(lanes)} lanes where there are {count}")
        return ()
    return lanes if any(lanes) else ()


def _bus_lanes(tags: Tags, street: Street, *, side: int, count: int, left_hand: bool) -> tuple[int, ...]:
    """Lanes of one direction that are for buses; not the only one."""
    if count < 2 or not _driven(street, side):
        return ()
    for kind in ("bus", "psv"):
        values = _of_direction(tags, f"{kind}:lanes", street=street, side=side)[1].split("|")
        if len(values) == count and "designated" in values:
            return tuple(k for k, value in enumerate(values) if value == "designated")
    outer = 0 if left_hand else count - 1
    number = next(
        (
            int(text)
            for kind in ("bus", "psv")
            if (text := _of_direction(tags, f"lanes:{kind}", street=street, side=side)[1]).isdigit()
        ),
        0,
    )
    if 0 < number < count:
        return tuple(range(number)) if left_hand else tuple(range(count - number, count))
    kept = "left" if left_hand else "right"
    if street.direction == 0:
        own = kept if side == 0 else _other(kept)
        return (outer,) if tag_of_side(tags, "busway", side=own) == "lane" else ()
    if is_plain(tags, "busway"):
        return (outer,) if tags["busway"] == "lane" else ()
    lanes = (0, count - 1) if side == 0 else (count - 1, 0)
    return tuple(
        sorted(
            lane
            for lane, name in zip(lanes, ("left", "right"), strict=True)
            if tag_of_side(tags, "busway", side=name) == "lane"
        )
    )


def _other(side: str) -> str:
    return "left" if side == "right" else "right"


def _cycle_lanes(tags: Tags, street: Street, *, left_hand: bool) -> tuple[CycleLane | None, CycleLane | None]:
    """Cycle lanes on the left and right of the way, where its width has room for them."""
    kept = "left" if left_hand else "right"
    kept = _other(kept) if street.direction < 0 else kept
    plain = street.direction != 0 and is_plain(tags, "cycleway")
    found: list[CycleLane | None] = []
    for side in ("left", "right"):
        value = tag_of_side(tags, "cycleway", side=side)
        # Plain on a one-way street, a lane is on the side that traffic keeps to, one against it on the other.
        here = not plain or (side == kept) == (value != "opposite_lane")
        found.append(_cycle_lane(tags, street, side=side) if here else None)
    lanes = found[0], found[1]
    room = street.width - _LEAST_LANE * max(sum(street.lanes), 1.0)
    if sum(lane.width + lane.inset for lane in lanes if lane and lane.kind != "shared") > room:
        lanes = (_at_kerb(lanes[0]), _at_kerb(lanes[1]))
    if sum(lane.width for lane in lanes if lane and lane.kind != "shared") > room:
        return None, None
    return lanes


def _at_kerb(lane: CycleLane | None) -> CycleLane | None:
    return None if lane is None else replace(lane, inset=0.0)


def _cycle_lane(tags: Tags, street: Street, *, side: str) -> CycleLane | None:
    value = tag_of_side(tags, "cycleway", side=side)
    if value not in ("lane", "opposite_lane", "shared_lane"):
        return None
    kind, oneway, width = (
        tags.get(f"cycleway:{side}:{name}", tags.get(f"cycleway:both:{name}", ""))
        for name in ("lane", "oneway", "width")
    )
    metres = parse_length(width or None)
    soft = kind in ("advisory", "soft_lane")
    return CycleLane(
        kind="shared" if value == "shared_lane" else "advisory" if soft else "lane",
        width=metres if metres and 0.8 <= metres <= 4 else CYCLE_LANE,
        inset=parking_width(tags, side),
        against=value == "opposite_lane" or (oneway == "-1" and street.direction == 1),
    )


def _painted_limit(tags: Tags) -> tuple[str, bool]:
    """Digits of a limit that is painted on the road, and whether it is that of a zone.

    The tags say so where the limit was mapped from paint (``source:maxspeed=markings``); zones have it where
    they begin.
    """
    source = tags.get("maxspeed:type", tags.get("source:maxspeed", ""))
    zone = re.fullmatch(r"(?:[A-Z]{2}(?:-[A-Z]+)?:)?zone:?(\d{2})", source)
    zone = zone or re.fullmatch(r"(?:[A-Z]{2}:)?(\d{2})", tags.get("zone:maxspeed", ""))
    if zone:
        return zone[1], True
    number = re.fullmatch(r"(\d{2,3})(?: mph)?", tags.get("maxspeed", ""))
    painted = source in ("marking", "markings") or tags.get("source:maxspeed") in ("marking", "markings")
    return (number[1], False) if number and painted else ("", False)
