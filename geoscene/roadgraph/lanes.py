"""Side of the road that traffic keeps to, and lateral position of lanes on carriageways.

Routes, traffic, paint and OpenDRIVE all take the number, width and place of lanes from here. Lanes of an edge
are counted from the kerb: lane 0 is the outermost one. Offsets are measured from the carriageway's centre
line, positive towards the side that traffic keeps to.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from geoscene.geometry.frames import wrap_longitude
from geoscene.roadgraph.graph import RoadGraph
from geoscene.sources.data import OsmData
from geoscene.support.columns import Columns
from geoscene.typing import Bools, Float, Ints

WIDEST_LANE = 4.5
"""Metres: the lanes of a carriageway with several are not wider; the rest is for parking and bicycles."""

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

    own    : (m,) int64, lanes that only traffic along the edge uses
    other  : (m,) int64, lanes that only traffic against the edge uses
    shared : (m,) bool, there is one more lane between them, which both directions use
    carriageway : (m,) metres from kerb to kerb
    """

    own: Ints
    other: Ints
    shared: Bools
    carriageway: Float

    @property
    def count(self) -> Ints:
        """Lanes (m,) of both directions."""
        return self.own + self.other + self.shared

    @property
    def span(self) -> Float:
        """Metres (m,) that all lanes take up together, in the middle of the carriageway."""
        widest = np.where(self.count > 1, WIDEST_LANE * self.count, np.inf)
        return np.minimum(self.carriageway, widest)

    @property
    def width(self) -> Float:
        """Metres (m,) of a lane."""
        return self.span / self.count

    @property
    def divider(self) -> Float:
        """Offset (m,) of the line between the directions, in the middle of a shared lane.

        On a one-way street it is the edge of the lanes on the other side.
        """
        return self.span / 2 - (self.own + 0.5 * self.shared) * self.span / self.count

    def offsets(self, lane: ArrayLike = 0, *, body_width: float, clearance: float) -> Float:
        """Offset (m,) of the middle of a lane, or of a body that keeps clear of the kerbs where it can.

        On a single shared lane, each direction keeps to its half.

        lane       : number of the lane, from the kerb
        body_width : metres
        clearance  : metres between body and kerb; where there is no room for it the body takes the middle
        """
        middle = self.span / 2 - (np.asarray(lane) + 0.5) * self.span / self.count
        middle = np.where(self.shared & (self.count == 1), self.carriageway / 4, middle)
        room = np.maximum(self.carriageway / 2 - body_width / 2 - clearance, 0.0)
        return np.clip(middle, -room, room)


def lane_layout(along: Float, against: Float, *, two_way: Bools, width: Float) -> LaneLayout:
    """Layout of the lanes of carriageways.

    along, against : (m,) lanes of each direction as mapped; where both are fractions, as in 1.5 and 1.5,
                     there is a lane that both share; other fractions are dropped
    two_way : (m,) bool
    width   : (m,) metres from kerb to kerb
    """
    shared = two_way & (along % 1 > 0) & (against % 1 > 0)
    least = np.where(shared, 0, 1)
    own = np.maximum(np.floor(along), least).astype(np.int64)
    other = np.where(two_way, np.maximum(np.floor(against), least), 0).astype(np.int64)
    return LaneLayout(own, other, shared, width)


def graph_lanes(graph: RoadGraph) -> LaneLayout:
    """The lanes of the edges of a road graph."""
    two_way = graph.twin >= 0
    against = np.where(two_way, graph.lanes[graph.twin], 0.0)
    return lane_layout(graph.lanes, against, two_way=two_way, width=graph.width)


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
