"""Side of the road that traffic keeps to, and lateral position of lanes on carriageways.

Routes, traffic, paint and OpenDRIVE all take the number, width and place of lanes from here. Lanes of an edge
are counted from the kerb: lane 0 is the outermost one. Offsets are measured from the carriageway's centre
line, positive towards the side that traffic keeps to.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geoscene.geometry.frames import wrap_longitude
from geoscene.roadgraph.graph import RoadGraph
from geoscene.roadgraph.lane_tags import CYCLE_LANE, Lane, LaneKind, Lanes
from geoscene.roadgraph.tags import Street
from geoscene.sources.data import OsmData
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

WIDEST_LANE = 4.5
"""Metres: the lanes of a carriageway with several are not wider; the rest is for parking and bicycles."""

_NARROWEST_LANE = 2.0
"""Metres: a lane of unknown width beside lanes of mapped widths is not narrower."""

Side = Literal["left", "right"]

LEFT_HAND = frozenset({
    "Europe/London", "Europe/Dublin", "Europe/Belfast", "Europe/Isle_of_Man", "Europe/Jersey",
    "Europe/Guernsey", "Europe/Malta", "Asia/Nicosia", "Asia/Famagusta", "Europe/Nicosia", "Asia/Tokyo",
    "Asia/Hong_Kong", "Asia/Macau", "Asia/Bangkok", "Asia/Singapore", "Asia/Kuala_Lumpur", "Asia/Kuching",
    "Asia/Brunei", "Asia/Jakarta", "Asia/Pontianak", "Asia/Makassar", "Asia/Jayapura", "Asia/Dili",
    "Asia/Kolkata", "Asia/Karachi", "Asia/Dhaka", "Asia/Kathmandu", "Asia/Thimphu", "Asia/Colombo",
    "Indian/Maldives", "Australia/Sydney", "Australia/Melbourne", "Australia/Hobart", "Australia/Brisbane",
    "Australia/Lindeman", "Australia/Adelaide", "Australia/Broken_Hill", "Australia/Darwin",
    "Australia/Perth", "Australia/Eucla", "Australia/Lord_Howe", "Antarctica/Macquarie", "Indian/Christmas",
    "Indian/Cocos", "Pacific/Norfolk", "Pacific/Auckland", "Pacific/Chatham", "Pacific/Rarotonga",
    "Pacific/Niue", "Pacific/Fakaofo", "Pacific/Pitcairn", "Pacific/Fiji", "Pacific/Tongatapu",
    "Pacific/Apia", "Pacific/Tarawa", "Pacific/Kanton", "Pacific/Kiritimati", "Pacific/Nauru",
    "Pacific/Funafuti", "Pacific/Guadalcanal", "Pacific/Port_Moresby", "Pacific/Bougainville",
    "Africa/Johannesburg", "Africa/Maseru", "Africa/Mbabane", "Africa/Windhoek", "Africa/Gaborone",
    "Africa/Harare", "Africa/Lusaka", "Africa/Blantyre", "Africa/Maputo", "Africa/Dar_es_Salaam",
    "Africa/Nairobi", "Africa/Kampala", "Indian/Mauritius", "Indian/Mahe", "Atlantic/St_Helena",
    "America/Guyana", "America/Paramaribo", "Atlantic/Stanley", "Atlantic/Bermuda", "America/Nassau",
    "America/Jamaica", "America/Cayman", "America/Grand_Turk", "America/St_Thomas", "America/Tortola",
    "America/Anguilla", "America/St_Kitts", "America/Antigua", "America/Montserrat", "America/Dominica",
    "America/St_Lucia", "America/St_Vincent", "America/Grenada", "America/Barbados", "America/Port_of_Spain",
})  # fmt: skip
"""Time zones (IANA) of the countries and territories that keep left, by the Geneva and Vienna conventions'
registers and Kincaid, The Rule of the Road (1986), with Samoa's change of 2009. No zone reaches into a
country of the other side."""


@dataclass(frozen=True, slots=True)
class LaneLayout(Columns):
    """Lanes of directed edges, one row each.

    own    : (m,) int64, lanes of traffic along the edge
    other  : (m,) int64, lanes of traffic against the edge; on a one-way street those for buses
    shared : (m,) bool, there is one more lane between them, which both directions use
    carriageway : (m,) metres from kerb to kerb
    borders : (m, k + 1) offsets of the borders of lanes, from the kerb of the edge to that of the other
              direction; the last one is repeated
    closed : (m, k) bool, lanes that cars may not use, in the same order
    """

    own: Ints
    other: Ints
    shared: Bools
    carriageway: Float
    borders: Float
    closed: Bools

    @property
    def count(self) -> Ints:
        """Lanes (m,) of both directions."""
        return self.own + self.other + self.shared

    @property
    def span(self) -> Float:
        """Metres (m,) that all lanes take up together, in the middle of the carriageway."""
        return self.borders[:, 0] - self.borders[:, -1]

    @property
    def width(self) -> Float:
        """Metres (m,) of the narrowest lane that cars use along the edge, or of a shared one without any."""
        lane = np.arange(self.closed.shape[1])
        used = ~self.closed & (lane < np.maximum(self.own, 1)[:, None])
        used[~used.any(axis=1), 0] = True
        narrowest: Float = np.where(used, -np.diff(self.borders, axis=1), np.inf).min(axis=1, initial=np.inf)
        return narrowest

    @property
    def divider(self) -> Float:
        """Offset (m,) of the line between the directions, in the middle of a shared lane.

        On a one-way street it is the edge of the lanes on the other side.
        """
        row = np.arange(len(self.own))
        return (self.borders[row, self.own] + self.borders[row, self.own + self.shared]) / 2

    def offsets(self, lane: ArrayLike = 0, *, body_width: float, clearance: float) -> Float:
        """Offset (m,) of the middle of a lane, or of a body that keeps clear of the kerbs where it can.

        On a single shared lane, each direction keeps to its half.

        lane       : number of the lane, from the kerb
        body_width : metres
        clearance  : metres between body and kerb; where there is no room for it the body takes the middle
        """
        row, number = np.arange(len(self.own)), np.asarray(lane, np.int64)
        middle = (self.borders[row, number] + self.borders[row, number + 1]) / 2
        middle = np.where(self.shared & (self.count == 1), self.carriageway / 4, middle)
        room = np.maximum(self.carriageway / 2 - body_width / 2 - clearance, 0.0)
        return np.clip(middle, -room, room)

    def open_lane(self, wanted: ArrayLike = 0) -> Ints:
        """The lane (m,) for cars along the edge that is nearest to a wanted one; that one if none is open."""
        lane = np.arange(self.closed.shape[1])
        own = lane < np.maximum(self.own, 1)[:, None]
        target = np.broadcast_to(np.asarray(wanted, np.int64), len(self.own))
        far = np.where(own & ~self.closed, np.abs(lane - target[:, None]), len(lane) + 1)
        nearest: Ints = np.where(
            far.min(axis=1, initial=len(lane) + 1) > len(lane), target, far.argmin(axis=1) if len(lane) else 0
        )
        return nearest


def lane_layout(
    along: Float,
    against: Float,
    *,
    two_way: Bools,
    width: Float,
    described: Mapping[int, tuple[Lanes, Lanes]] | None = None,
    left_hand: bool = False,
) -> LaneLayout:
    """Layout of the lanes of carriageways.

    along, against : (m,) lanes of each direction as mapped; where both are fractions, as in 1.5 and 1.5,
                     there is a lane that both share; other fractions are dropped
    two_way : (m,) bool
    width   : (m,) metres from kerb to kerb
    described : by row, the lanes of each direction where they are mapped one by one
    left_hand : traffic keeps left
    """
    shared = two_way & (along % 1 > 0) & (against % 1 > 0)
    least = np.where(shared, 0, 1)
    own = np.maximum(np.floor(along), np.where(two_way | (along > 0), least, 0)).astype(np.int64)
    other = np.where(two_way, np.maximum(np.floor(against), least), np.floor(against)).astype(np.int64)
    described = described or {}
    for row, (ahead, back) in described.items():
        own[row] = len(ahead) or own[row]
        other[row] = len(back) or other[row]
    count = own + other + shared
    span = np.where(count > 1, np.minimum(width, WIDEST_LANE * count), width)
    lane = np.arange(int(count.max(initial=0)) + 1)
    borders = span[:, None] * (0.5 - np.minimum(lane, count[:, None]) / count[:, None])
    closed = np.zeros((len(own), len(lane) - 1), np.bool_)
    for row, sides in described.items():
        lanes = _across(
            sides, (int(own[row]), int(other[row])), shared=bool(shared[row]), left_hand=left_hand
        )
        widths = _fill_widths(lanes, whole=float(width[row]))
        ends = np.append(0.0, np.cumsum(widths))
        borders[row] = ends[-1] / 2 - ends[np.minimum(lane, len(lanes))]
        closed[row, : len(lanes)] = [one.kind != "driving" for one in lanes]
    return LaneLayout(own, other, shared, width, borders, closed)


def _across(
    sides: tuple[Lanes, Lanes], counts: tuple[int, int], *, shared: bool, left_hand: bool
) -> list[Lane]:
    """All lanes of a carriageway, from the kerb of the lanes along it to the other one."""
    ahead, back = (side or (Lane(),) * count for side, count in zip(sides, counts, strict=True))
    if left_hand:
        back = back[::-1]
    else:
        ahead = ahead[::-1]
    return [*ahead, *([Lane()] if shared else []), *back]


def _fill_widths(lanes: Sequence[Lane], *, whole: float) -> Float:
    """Metres of each lane; those without a mapped width share what the others leave of the carriageway."""
    widths = np.array([one.width or (CYCLE_LANE if one.kind == "biking" else 0.0) for one in lanes])
    unknown = widths == 0.0
    if unknown.any():
        left = (whole - widths.sum()) / unknown.sum()
        widths[unknown] = np.clip(left, _NARROWEST_LANE, WIDEST_LANE if len(lanes) > 1 else np.inf)
    return np.asarray(widths * min(1.0, whole / widths.sum()), float)


def street_lanes(streets: Sequence[Street], width: Float, *, left_hand: bool) -> LaneLayout:
    """The lanes of streets (m,) as seen along their ways; ``width`` (m,) of the carriageways, metres."""
    lanes = np.array([s.lanes for s in streets], float).reshape(-1, 2)
    return lane_layout(
        lanes[:, 0],
        lanes[:, 1],
        two_way=np.array([s.direction == 0 for s in streets], np.bool_),
        width=width,
        described={k: s.described for k, s in enumerate(streets) if any(s.described)},
        left_hand=left_hand,
    )


def graph_lanes(graph: RoadGraph, *, left_hand: bool) -> LaneLayout:
    """The lanes of the edges of a road graph; ``left_hand``: traffic keeps left."""
    own = {k: edge_lanes(graph, k) for k in np.flatnonzero(has_lanes(graph)).tolist()}
    rows = {*own, *(int(graph.twin[k]) for k in own), *np.flatnonzero(graph.contraflow).tolist()} - {-1}
    described = {}
    for edge in sorted(rows):
        twin = int(graph.twin[edge])
        back = own.get(twin, ()) if twin >= 0 else (Lane("bus"),) * int(graph.contraflow[edge])
        described[edge] = own.get(edge, ()), back
    against = np.where(graph.twin >= 0, graph.lanes[graph.twin], graph.contraflow)
    return lane_layout(
        graph.lanes,
        against,
        two_way=graph.twin >= 0,
        width=graph.width,
        described=described,
        left_hand=left_hand,
    )


def has_lanes(graph: RoadGraph) -> Bools:
    """Whether (m,) the lanes of each edge are described one by one."""
    described: Bools = (graph.lane_kinds != "") | (graph.lane_widths != "") | (graph.lane_turns != "")
    return described


def edge_lanes(graph: RoadGraph, edge: int) -> Lanes:
    """The lanes of an edge that are described one by one; () if they are not."""
    columns = [str(c[edge]) for c in (graph.lane_kinds, graph.lane_widths, graph.lane_turns)]
    texts = [text.split("|") for text in columns if text]
    if not texts:
        return ()
    kinds, widths, turns = (text.split("|") if text else [""] * len(texts[0]) for text in columns)
    return tuple(
        Lane(cast("LaneKind", kind or "driving"), float(width or 0.0), tuple(filter(None, turn.split(";"))))
        for kind, width, turn in zip(kinds, widths, turns, strict=True)
    )


def lane_column(
    described: Sequence[Lanes], text: Callable[[Lane], str], *, plain: str = ""
) -> NDArray[np.str_]:
    """A column of `RoadGraph` (m,) with a text for each lane; "" where no lane's differs from ``plain``."""
    values = ([text(lane) for lane in lanes] for lanes in described)
    return np.array(["|".join(v) if any(one != plain for one in v) else "" for v in values], np.str_)


def side_at(lon: float, lat: float) -> Side:
    """The driving side of the country at a place; right at sea and in Antarctica."""
    from tzfpy import get_tz  # noqa: PLC0415  (reads the zones' outlines)

    return "left" if get_tz(lon, lat) in LEFT_HAND else "right"


def driving_side(osm: OsmData) -> tuple[Side, str]:
    """Driving side of a map extract and its source: ``tag`` or ``place``.

    The tag ``driving_side`` counts if half of the streets or more have it: single streets are exceptions.
    """
    tags = [way.tags for way in osm.ways if "highway" in way.tags]
    tagged = Counter(side for tag in tags if (side := tag.get("driving_side")) in ("left", "right"))
    if tagged and 2 * tagged.total() >= len(tags):
        return cast("Side", max(sorted(tagged), key=tagged.__getitem__)), "tag"
    west, south, east, north = osm.bounds
    return side_at(wrap_longitude((west + east) / 2), (south + north) / 2), "place"
