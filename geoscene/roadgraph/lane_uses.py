"""Lane markings of a street from the tags of its way: turns, buses, bicycles, limits."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

from geoscene.roadgraph.lane_tags import (
    CYCLE_LANE,
    LaneKind,
    Lanes,
    is_plain,
    other_side,
    parking_width,
    tag_of_side,
)
from geoscene.roadgraph.tags import Street
from geoscene.sources.data import Tags
from geoscene.tags import parse_length

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
    bus, bicycles : numbers of the lanes for buses and of cycle lanes among those of cars, counted likewise
    cycle : beside the lanes on the left and right of the way
    speed : digits of a limit on the road, "" for none
    zone  : the limit is that of a zone, and painted only where the zone begins
    """

    turns: tuple[tuple[tuple[str, ...], ...], tuple[tuple[str, ...], ...]] = ((), ())
    bus: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    bicycles: tuple[tuple[int, ...], tuple[int, ...]] = ((), ())
    cycle: tuple[CycleLane | None, CycleLane | None] = (None, None)
    speed: str = ""
    zone: bool = False

    @property
    def symmetric(self) -> bool:
        """Whether both directions have the same paint."""
        pairs = (self.turns, self.bus, self.bicycles, self.cycle)
        return all(a == b for a, b in pairs)

    def __bool__(self) -> bool:
        """Whether any lane is marked."""
        return self != NO_USES


NO_USES = LaneUses()


def read_lane_uses(tags: Tags, street: Street, *, left_hand: bool = False) -> LaneUses:
    """The paint of a way's lanes.

    left_hand : traffic keeps left
    """
    if tags.get("lane_markings") == "no":
        return NO_USES
    ahead, back = street.described
    bicycles = _of_kind("biking", ahead), _of_kind("biking", back)
    cycle = (None, None) if any(bicycles) else _cycle_lanes(tags, street, left_hand=left_hand)
    speed, zone = _painted_limit(tags)
    return LaneUses(
        turns=(_arrows(ahead), _arrows(back)),
        bus=(_of_kind("bus", ahead), _of_kind("bus", back)),
        bicycles=bicycles,
        cycle=cycle,
        speed=speed,
        zone=zone,
    )


def _arrows(lanes: Lanes) -> tuple[tuple[str, ...], ...]:
    return tuple(lane.turns for lane in lanes) if any(lane.turns for lane in lanes) else ()


def _of_kind(kind: LaneKind, lanes: Lanes) -> tuple[int, ...]:
    """Numbers of the lanes of a kind."""
    return tuple(k for k, lane in enumerate(lanes) if lane.kind == kind)


def _cycle_lanes(tags: Tags, street: Street, *, left_hand: bool) -> tuple[CycleLane | None, CycleLane | None]:
    """Cycle lanes on the left and right of the way, where its width has room for them."""
    kept = "left" if left_hand else "right"
    kept = other_side(kept) if street.direction < 0 else kept
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
