"""The side of the road that traffic keeps to."""

from __future__ import annotations

from collections import Counter
from typing import Literal, cast

from geoscene.geometry.frames import wrap_longitude
from geoscene.sources.data import OsmData

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
