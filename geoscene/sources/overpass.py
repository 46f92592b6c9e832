"""Overpass: the query for an area, and the JSON of its answer."""

from __future__ import annotations

from typing import Any

from geoscene.errors import InputError
from geoscene.sources.data import Bounds, Tags
from geoscene.sources.elements import Collector
from geoscene.sources.plain_xml import whole_units

RELATIONS = "building|bridge|multipolygon|restriction|site|tunnel"
"""Types of relations that are fetched; routes and boundaries extend far beyond the area and are not used."""


def query_for(box: Bounds, *, timeout: int = 180) -> str:
    """The Overpass QL query for all features of a scene in a box (west, south, east, north, degrees).

    It returns ways that intersect the box, and multipolygons with all their ways, with all their nodes.
    """
    west, south, east, north = box
    area = f"({south:.7f},{west:.7f},{north:.7f},{east:.7f})"
    return (
        f"[out:json][timeout:{timeout}];"
        f"way{area}->.w;"
        f'rel{area}["type"~"^({RELATIONS})$"]->.r;'
        'rel.r["type"="multipolygon"]->.m;'
        "(.w;way(r.m););out body qt;"
        f"(node(w);node{area}(if:count_tags()>0););out body qt;"
        ".r out body qt;"
    )


def collect_answer(answer: Any, collector: Collector) -> None:
    """Add the objects of one answer to ``collector``.

    Raises InputError if it is not Overpass JSON.
    """
    if not isinstance(answer, dict) or not isinstance(answer.get("elements"), list):
        raise InputError("JSON, but not as Overpass answers with [out:json]: no list of elements")
    stamp = answer.get("osm3s", {}).get("timestamp_osm_base", "")
    collector.timestamp = max(collector.timestamp, str(stamp))
    try:
        for item in answer["elements"]:
            tags, kind, osm_id = _tags(item), item["type"], int(item["id"])
            if kind == "node":
                collector.node(
                    osm_id, whole_units(item.get("lon")), y=whole_units(item.get("lat")), tags=tags or None
                )
            elif kind == "way":
                collector.way(osm_id, [int(ref) for ref in item.get("nodes", ())], tags=tags)
            elif kind == "relation":
                members = tuple(
                    (str(m["type"]), int(m["ref"]), str(m["role"])) for m in item.get("members", ())
                )
                collector.relation(osm_id, tags, members=members)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(f"JSON, but not as Overpass answers with [out:json]: {error!r}") from error


def _tags(item: dict[str, Any]) -> Tags:
    """The tags of an object; raises TypeError for values that are not text."""
    tags: Tags = item.get("tags") or {}
    if not all(isinstance(value, str) for value in tags.values()):
        raise TypeError("tags that are not text")
    return tags
