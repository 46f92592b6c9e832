"""Speed limits from the tags of a way."""

from __future__ import annotations

import functools
import re

from geoscene.roadgraph.values import Remarks, remark_several, remark_unreadable
from geoscene.sources.data import Tags

NO_LIMIT = 130 / 3.6
"""Metres a second where the map says that there is no limit: what Germany advises on its motorways."""

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
    "": {"urban": 50, "living_street": 10, "bicycle_road": 30, "walk": 7},
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


# Keys with a limit of both directions, the most specific first. Those of the second row say where a limit
# comes from, which may be a legal default, and otherwise have no number.
_LIMITS = ("maxspeed", "maxspeed:lanes", "zone:maxspeed")
_SOURCES = ("maxspeed:type", "source:maxspeed", "zone:traffic")
# Words for limits that the map does not know.
_UNKNOWN = ("signals", "variable", "national", "default", "unposted", "implicit")

_COUNTRY = r"[A-Z]{2}(?:-[A-Z]+)?"
_IN_MPH = ("GB", "US")
"""Countries whose codes of zones count in miles per hour."""

Limit = tuple[float, str]
"""A limit in m/s and its source: ``maxspeed``, ``zone`` or ``default``."""


@functools.lru_cache(maxsize=1024)
def speed_limit(text: str) -> Limit | None:
    """A speed limit in m/s with its source (``maxspeed`` or ``zone``), or None if the text has no number.

    ``50``, ``30 mph``, ``10 knots``, ``walk``, ``none`` and the legal defaults ``DE:urban``,
    ``GB:nsl_single``, ``DE:zone:30``; of a list (``50;30``) the lowest. ``signals`` and ``variable`` name no
    number.
    """
    limits = [limit for part in re.split(r"[;|]", text) if (limit := _one_limit(part.strip())) is not None]
    return min(limits) if limits else None


def _one_limit(text: str) -> Limit | None:
    if match := re.fullmatch(r"(\d+(?:[.,]\d+)?)\s*(mph|knots|km/?h|kph|kmph)?", text, re.IGNORECASE):
        unit = {"mph": _MPH, "knots": _KNOT}.get((match[2] or "").lower(), _KMH)
        speed = float(match[1].replace(",", ".")) * unit
        return (speed, "maxspeed") if 0 < speed < 100 else None
    if text == "none":
        return NO_LIMIT, "maxspeed"
    if text == "walk":
        return _ZONES[""]["walk"] * _KMH, "maxspeed"
    if match := re.fullmatch(rf"(?:({_COUNTRY}):)?zone:?(\d+)", text):
        return float(match[2]) * _unit_of(match[1]), "zone"
    if match := re.fullmatch(rf"({_COUNTRY}):(\w+)", text):
        limit = _ZONES.get(match[1], {}).get(match[2], _ZONES[""].get(match[2]))
        return None if limit is None else (limit * _KMH, "zone")
    return None


def _unit_of(country: str | None) -> float:
    return _MPH if country in _IN_MPH else _KMH


def _lanes_limit(text: str) -> Limit | None:
    """The highest limit of a list of lanes (``100|80|60``)."""
    limits = [limit for part in text.split("|") if (limit := speed_limit(part)) is not None]
    return max(limits) if limits else None


def _zone_limit(text: str) -> Limit | None:
    """The limit of ``zone:maxspeed``: ``30``, ``20 mph``, ``DE:30`` or as of `speed_limit`."""
    if match := re.fullmatch(rf"({_COUNTRY}):(\d+)", text):
        return float(match[2]) * _unit_of(match[1]), "zone"
    limit = speed_limit(text)
    return None if limit is None else (limit[0], "zone")


def _read(tags: Tags, key: str, *, remarks: Remarks) -> Limit | None:
    """The limit that a tag names."""
    text = tags.get(key, "")
    if key.startswith("maxspeed:lanes"):
        return _lanes_limit(text)
    if key == "zone:maxspeed":
        return _zone_limit(text)
    limit = speed_limit(text)
    if limit is not None and ";" in text:
        remark_several(remarks, key, text=text, taken=describe_limit(limit))
    return limit


def describe_limit(limit: Limit) -> str:
    """A limit in words: ``30 km/h``."""
    return f"{limit[0] / _KMH:.4g} km/h"


def read_speeds(tags: Tags, highway: str, *, remarks: Remarks) -> tuple[tuple[float, float], tuple[str, str]]:
    """Limits in m/s along the way and against it, and their sources; remarks on tags that cannot be read.

    ``maxspeed``, of ``maxspeed:lanes`` the highest, ``zone:maxspeed``, then the legal default that the map
    names (``maxspeed:type``, ``source:maxspeed``, ``zone:traffic``), else the default of the class.
    """
    both: Limit | None = None
    unknown: list[tuple[str, str]] = []
    for key in (*_LIMITS, *_SOURCES):
        text = tags.get(key, "")
        if not text:
            continue
        both = _read(tags, key, remarks=remarks)
        if both is not None:
            break
        if text in _UNKNOWN or (key in _SOURCES and re.match(rf"{_COUNTRY}:", text)):
            unknown.append((key, text))
        elif key in _LIMITS:
            remark_unreadable(remarks, key, text=text)
    if both is None:
        both = _SPEED.get(highway, _SPEED["service"]) * _KMH, "default"
        for key, text in unknown:
            remark_unreadable(remarks, key, text=text, why=f"{describe_limit(both)} by class")
    ahead, back = (_directed(tags, side, both=both, remarks=remarks) for side in ("forward", "backward"))
    return (ahead[0], back[0]), (ahead[1], back[1])


def _directed(tags: Tags, side: str, *, both: Limit, remarks: Remarks) -> Limit:
    """The limit of one direction."""
    for key in (f"maxspeed:{side}", f"maxspeed:lanes:{side}"):
        if tags.get(key, ""):
            limit = _read(tags, key, remarks=remarks)
            if limit is not None:
                return limit
            if tags[key] not in _UNKNOWN:
                remark_unreadable(remarks, key, text=tags[key])
    return both
