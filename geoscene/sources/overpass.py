"""Overpass: the query that fetches an area, and the JSON that answers it."""

from __future__ import annotations

from typing import Any

from geoscene.errors import InputError
from geoscene.sources.data import Tags
from geoscene.sources.elements import Collector
from geoscene.sources.plain_xml import whole_units

Box = tuple[float, float, float, float]

RELATIONS = "building|bridge|multipolygon|restriction|site|tunnel"
"""Types of relations that are fetched; routes and boundaries reach far beyond and say nothing of an area."""


def query_for(box: Box, *, timeout: int = 180) -> str:
    """The Overpass QL query for everything a scene is made of in a box (west, south, east, north, degrees).

    Ways that meet the box and multipolygons with all their ways come whole, with their nodes.
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


def collect_answer(answer: Any, taken: Collector) -> None:
    """Put the objects of one answer into ``taken``.

    Raises InputError if it is not the JSON that Overpass answers with.
    """
    if not isinstance(answer, dict) or not isinstance(answer.get("elements"), list):
        raise InputError("JSON, but not as Overpass answers with [out:json]: no list of elements")
    stamp = answer.get("osm3s", {}).get("timestamp_osm_base", "")
    taken.timestamp = max(taken.timestamp, str(stamp))
    try:
        for item in answer["elements"]:
            tags: Tags = item.get("tags") or {}
            kind, osm_id = item["type"], item["id"]
            if kind == "node":
                taken.node(
                    osm_id, whole_units(item.get("lon")), y=whole_units(item.get("lat")), tags=tags or None
                )
            elif kind == "way":
                taken.way(osm_id, item.get("nodes", ()), tags=tags)
            elif kind == "relation":
                members = tuple((m["type"], m["ref"], m["role"]) for m in item.get("members", ()))
                taken.relation(osm_id, tags, members=members)
    except (KeyError, TypeError, AttributeError, OverflowError) as error:
        raise InputError(f"JSON, but not as Overpass answers with [out:json]: {error!r}") from error
