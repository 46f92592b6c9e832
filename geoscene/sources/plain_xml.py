"""Reads OpenStreetMap XML with invalid coordinates, which libosmium refuses as a whole."""

from __future__ import annotations

import bz2
import gzip
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from geoscene.sources.data import Progress
from geoscene.sources.elements import UNITS, UNKNOWN, Collector

OPEN: dict[str, Callable[..., Any]] = {"": open, ".gz": gzip.open, ".bz2": bz2.open}
"""How to open a file by the suffix of its compression."""


def whole_units(degrees: Any) -> int:
    """A coordinate in 1e-7 degrees; `UNKNOWN` if it is not a number or far out of range."""
    try:
        value = float(degrees)
    except (TypeError, ValueError):
        return UNKNOWN
    return round(value * UNITS) if math.isfinite(value) and abs(value) <= 200 else UNKNOWN


def collect_xml(path: Path, form: str, *, collector: Collector, progress: Progress) -> None:
    """Add the objects of an XML file to ``collector``, also nodes without a position; slower than libosmium.

    form : ``osm``, ``osm.gz`` or ``osm.bz2``

    Raises ValueError or OSError for a damaged file.
    """
    try:
        with OPEN[form.removeprefix("osm")](path, "rb") as file:
            for _, item in progress(ET.iterparse(file)):  # noqa: S314 - expat limits the expansion of entities
                if item.tag not in {"node", "way", "relation"}:
                    continue
                tags = {tag.get("k", ""): tag.get("v", "") for tag in item.iter("tag")}
                osm_id = int(item.get("id", ""))
                if item.tag == "node":
                    x, y = whole_units(item.get("lon")), whole_units(item.get("lat"))
                    collector.node(osm_id, x, y=y, tags=tags or None)
                elif item.tag == "way":
                    collector.way(osm_id, [int(nd.get("ref", "")) for nd in item.iter("nd")], tags=tags)
                else:
                    members = tuple(
                        (m.get("type", ""), int(m.get("ref", "")), m.get("role", ""))
                        for m in item.iter("member")
                    )
                    collector.relation(osm_id, tags, members=members)
                if not collector.timestamp or item.get("timestamp", "") > collector.timestamp:
                    collector.timestamp = item.get("timestamp", "")
                item.clear()
    except ET.ParseError as error:
        raise ValueError(str(error)) from error
