"""Nodes, ways and relations of a map as columns, before features are built from them."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from geoscene.errors import InputError, reason_of
from geoscene.sources.data import Bounds, Progress, Tags
from geoscene.support.problems import Problem
from geoscene.support.untrusted import open_unpacked
from geoscene.typing import Bools, Float, Ints

Members = tuple[tuple[str, int, str], ...]

UNITS = 10_000_000
"""Coordinate units per degree: OpenStreetMap stores integers of 1e-7 degrees."""

UNKNOWN = 2**31 - 1
"""Value of a missing coordinate."""

LONGEST_TAG = 1024
"""Bytes of the longest key or value that is read, as libosmium's; OpenStreetMap allows 255 characters."""

RELATIONS = "building|bridge|multipolygon|restriction|site|tunnel"
"""Types of relations that are fetched; routes and boundaries extend far beyond the area and are not used."""


@dataclass(frozen=True, slots=True)
class Elements:
    """Nodes, ways and relations, each sorted by unique id, independent of the order in the file.

    node_id   : (n,) int64
    node_xy   : (n, 2) int32, longitude and latitude in 1e-7 degrees, within range
    node_tags : tags of tagged nodes, by id
    way_id    : (w,) int64
    way_start : (w + 1,) int64, way i refers to ``ref[way_start[i] : way_start[i + 1]]``
    way_closed : (w,) bool, whether the first and last reference are the same node, even if it is missing
    way_tags  : tags of each way
    ref       : (r,) int64, node index, or -1 for a missing node
    relations : (id, tags, members)
    bounds    : (west, south, east, north) degrees as stated by the source, or None
    timestamp : ISO 8601 or ""
    misplaced : ids of nodes whose coordinates were missing or out of range
    problems  : tags that were left out
    """

    node_id: Ints
    node_xy: NDArray[np.int32]
    node_tags: dict[int, Tags]
    way_id: Ints
    way_start: Ints
    way_closed: Bools
    way_tags: list[Tags]
    ref: Ints
    relations: list[tuple[int, Tags, Members]]
    bounds: tuple[float, float, float, float] | None
    timestamp: str
    misplaced: Ints
    problems: tuple[Problem, ...] = ()

    def chain(self, way: int) -> Ints:
        """(k,) node indices of the way in row ``way``, -1 for missing nodes."""
        return self.ref[self.way_start[way] : self.way_start[way + 1]]

    def lonlat(self, nodes: Ints) -> Float:
        """Longitude and latitude (k, 2) of nodes by index, degrees."""
        return self.node_xy[nodes] / UNITS


def _last_of_each(ids: Ints) -> Ints:
    """Indices that sort ``ids``; of equal ids only the last."""
    order = np.argsort(ids, kind="stable")
    ordered = ids[order]
    last = np.ones(len(ids), bool)
    last[:-1] = ordered[1:] != ordered[:-1]
    return order[last]


def _without(ids: Ints, rows: Ints, *, deleted: set[int]) -> Ints:
    """The rows whose ids are not deleted."""
    return rows[~np.isin(ids[rows], np.array(sorted(deleted), np.int64))] if deleted else rows


_KINDS = ("node", "way", "relation")


@dataclass(slots=True)
class Collector:
    """Collects map objects one by one, in any order; `finish` returns them as `Elements`.

    Of objects with the same id the last counts; none does if that is deleted.
    """

    bounds: tuple[float, float, float, float] | None = None
    timestamp: str = ""
    _node_id: array[int] = field(default_factory=lambda: array("q"))
    _node_x: array[int] = field(default_factory=lambda: array("i"))
    _node_y: array[int] = field(default_factory=lambda: array("i"))
    _node_tags: dict[int, Tags] = field(default_factory=dict)
    _way_id: array[int] = field(default_factory=lambda: array("q"))
    _way_size: array[int] = field(default_factory=lambda: array("q"))
    _way_tags: list[Tags] = field(default_factory=list)
    _refs: array[int] = field(default_factory=lambda: array("q"))
    _relations: dict[int, tuple[Tags, Members]] = field(default_factory=dict)
    _deleted: dict[str, set[int]] = field(default_factory=lambda: {kind: set() for kind in _KINDS})
    _problems: list[Problem] = field(default_factory=list)

    def __len__(self) -> int:
        """Number of objects added or deleted."""
        deleted = sum(map(len, self._deleted.values()))
        return len(self._node_id) + len(self._way_id) + len(self._relations) + deleted

    def node(self, osm_id: int, x: int, *, y: int, tags: Tags | None) -> None:
        """Add a node at ``x``, ``y`` (longitude, latitude in 1e-7 degrees, `UNKNOWN` if missing)."""
        self._deleted["node"].discard(osm_id)
        self._node_id.append(osm_id)
        self._node_x.append(x)
        self._node_y.append(y)
        self._node_tags.pop(osm_id, None)
        if tags:
            self._node_tags[osm_id] = self._short(f"node/{osm_id}", tags)

    def nodes(self, ids: Ints, *, x: NDArray[np.int32], y: NDArray[np.int32]) -> None:
        """Add nodes (n,) as `node`, without tags."""
        self._node_id.frombytes(np.ascontiguousarray(ids, np.int64).tobytes())
        self._node_x.frombytes(np.ascontiguousarray(x, np.int32).tobytes())
        self._node_y.frombytes(np.ascontiguousarray(y, np.int32).tobytes())

    def node_tags(self, osm_id: int, tags: Tags) -> None:
        """Add the tags of a node."""
        self._node_tags[osm_id] = self._short(f"node/{osm_id}", tags)

    def way(self, osm_id: int, refs: Iterable[int], *, tags: Tags) -> None:
        """Add a way by its node ids."""
        self._deleted["way"].discard(osm_id)
        before = len(self._refs)
        self._refs.extend(refs)
        self._way_id.append(osm_id)
        self._way_size.append(len(self._refs) - before)
        self._way_tags.append(self._short(f"way/{osm_id}", tags))

    def relation(self, osm_id: int, tags: Tags, *, members: Members) -> None:
        """Add a relation."""
        self._deleted["relation"].discard(osm_id)
        self._relations[osm_id] = (self._short(f"relation/{osm_id}", tags), members)

    def delete(self, kind: str, osm_id: int) -> None:
        """Leave out an object (``node``, ``way`` or ``relation``), unless it is added again afterwards."""
        self._deleted[kind].add(osm_id)

    def _short(self, name: str, tags: Tags) -> Tags:
        """The tags without those that are too long, which become problems."""
        if sum(map(len, tags)) + sum(map(len, tags.values())) <= LONGEST_TAG // 4:
            return tags
        kept = {}
        for key, value in tags.items():
            size = max(len(key.encode()), len(value.encode()))
            if size <= LONGEST_TAG:
                kept[key] = value
                continue
            detail = f"tag {key[:40]} of {size:,} bytes left out, maximum is {LONGEST_TAG:,}"
            self._problems.append(Problem(name, name.partition("/")[0], "repaired", "overlong-tag", detail))
        return kept

    def has_drawn_nodes(self) -> bool:
        """Whether tags or ways refer to nodes with negative ids, which are not in OpenStreetMap yet."""
        refs = np.array(self._refs, np.int64)
        return bool((refs < 0).any()) or min(self._node_tags, default=0) < 0

    def clashing(self, other: Collector) -> str:
        """A node or way with a negative id that differs between both, such as ``node/-3``; "" if none does.

        Editors number objects that are not in OpenStreetMap yet by negative ids, each file by itself.
        """
        for kind in ("node", "way"):
            mine, theirs = self._drawn(kind), other._drawn(kind)
            for osm_id in sorted(mine.keys() & theirs.keys()):
                if mine[osm_id] != theirs[osm_id]:
                    return f"{kind}/{osm_id}"
        return ""

    def _drawn(self, kind: str) -> dict[int, object]:
        """Positions of nodes or tags of ways with negative ids, by id."""
        if kind == "way":
            return {i: tags for i, tags in zip(self._way_id, self._way_tags, strict=True) if i < 0}
        places = zip(self._node_id, self._node_x, self._node_y, strict=True)
        return {i: (x, y) for i, x, y in places if i < 0}

    def joined(self, other: Collector) -> Collector:
        """Objects of both; of objects with the same id those of ``other``."""
        boxes = [bounds for bounds in (self.bounds, other.bounds) if bounds is not None]
        edges = list(zip(*boxes, strict=True))
        return Collector(
            (min(edges[0]), min(edges[1]), max(edges[2]), max(edges[3])) if boxes else None,
            max(self.timestamp, other.timestamp),
            self._node_id + other._node_id,
            self._node_x + other._node_x,
            self._node_y + other._node_y,
            self._node_tags | other._node_tags,
            self._way_id + other._way_id,
            self._way_size + other._way_size,
            self._way_tags + other._way_tags,
            self._refs + other._refs,
            self._relations | other._relations,
            {
                kind: self._deleted[kind] - set(ids) | other._deleted[kind]
                for kind, ids in zip(_KINDS, (other._node_id, other._way_id, other._relations), strict=True)
            },
            self._problems + other._problems,
        )

    def finish(self) -> Elements:
        """All objects, sorted by id, with resolved node references."""
        ids = np.frombuffer(self._node_id, np.int64) if self._node_id else np.empty(0, np.int64)
        keep = _without(ids, _last_of_each(ids), deleted=self._deleted["node"])
        ids = ids[keep]
        xy = np.empty((len(ids), 2), np.int32)
        for column, values in enumerate((self._node_x, self._node_y)):
            xy[:, column] = np.frombuffer(values, np.int32)[keep] if values else 0
        placed = (np.abs(xy.astype(np.int64)) <= (180 * UNITS, 90 * UNITS)).all(axis=1)
        misplaced, ids, xy = ids[~placed], ids[placed], xy[placed]

        way_id = np.array(self._way_id, np.int64)
        rows = _without(way_id, _last_of_each(way_id), deleted=self._deleted["way"])
        sizes = np.array(self._way_size, np.int64)
        starts = np.concatenate([[0], np.cumsum(sizes)])
        new_starts = np.concatenate([[0], np.cumsum(sizes[rows])])
        picked = np.arange(new_starts[-1]) + np.repeat(starts[rows] - new_starts[:-1], sizes[rows])
        refs = np.array(self._refs, np.int64)[picked]
        closed = sizes[rows] > 1
        closed[closed] = refs[new_starts[:-1][closed]] == refs[new_starts[1:][closed] - 1]
        if len(ids):
            place = np.minimum(np.searchsorted(ids, refs), len(ids) - 1)
            index = np.where(ids[place] == refs, place, -1)
        else:
            index = np.full(len(refs), -1)
        gone = self._deleted["node"].union(misplaced.tolist())
        return Elements(
            node_id=ids,
            node_xy=xy,
            node_tags={i: self._node_tags[i] for i in sorted(self._node_tags) if i not in gone},
            way_id=way_id[rows],
            way_start=new_starts,
            way_closed=closed,
            way_tags=[self._way_tags[i] for i in rows.tolist()],
            ref=index.astype(np.int64),
            relations=[
                (i, *self._relations[i]) for i in sorted(self._relations.keys() - self._deleted["relation"])
            ],
            bounds=self.bounds,
            timestamp=self.timestamp,
            misplaced=misplaced,
            problems=tuple(dict.fromkeys(self._problems)),
        )


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
        with open_unpacked(path, form.removeprefix("osm")) as file:
            deleting = False  # in the section of OsmChange for what was deleted
            for event, item in progress(ET.iterparse(file, ("start", "end"))):  # noqa: S314 - expat limits entities
                if item.tag == "delete":
                    deleting = event == "start"
                if event == "start" or item.tag not in _KINDS:
                    continue
                _collect_element(item, collector, deleted=deleting or is_deleted(item.attrib))
                item.clear()
    except ET.ParseError as error:
        raise ValueError(reason_of(error)) from error


def is_deleted(attributes: Mapping[str, Any]) -> bool:
    """Whether an object is marked as deleted by an editor (``action``) or by OpenStreetMap (``visible``)."""
    return attributes.get("action") == "delete" or attributes.get("visible") in ("false", False)


def _collect_element(item: ET.Element, collector: Collector, *, deleted: bool) -> None:
    """Add an object's XML element to ``collector``."""
    osm_id = int(item.get("id", ""))
    if deleted:
        collector.delete(item.tag, osm_id)
        return
    tags = {tag.get("k", ""): tag.get("v", "") for tag in item.iter("tag")}
    if item.tag == "node":
        x, y = whole_units(item.get("lon")), whole_units(item.get("lat"))
        collector.node(osm_id, x, y=y, tags=tags or None)
    elif item.tag == "way":
        collector.way(osm_id, [int(nd.get("ref", "")) for nd in item.iter("nd")], tags=tags)
    else:
        members = tuple(
            (m.get("type", ""), int(m.get("ref", "")), m.get("role", "")) for m in item.iter("member")
        )
        collector.relation(osm_id, tags, members=members)
    if not collector.timestamp or item.get("timestamp", "") > collector.timestamp:
        collector.timestamp = item.get("timestamp", "")


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
            if is_deleted(item) and kind in _KINDS:
                collector.delete(kind, osm_id)
            elif kind == "node":
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
        raise InputError(f"JSON, but not as Overpass answers with [out:json]: {reason_of(error)}") from error


def _tags(item: dict[str, Any]) -> Tags:
    """The tags of an object; raises TypeError for values that are not text."""
    tags: Tags = item.get("tags") or {}
    if not all(isinstance(value, str) for value in tags.values()):
        raise TypeError("tags that are not text")
    return tags
