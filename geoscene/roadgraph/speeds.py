"""Speed limits: as mapped, by a legal default that the map names, or by road class."""

from __future__ import annotations

import functools
import re

from geoscene.sources.data import Tags

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
