"""Builds the features of a map from its nodes, ways and relations; every OpenStreetMap reader ends here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import shapely

from geoscene.errors import SourceNotFoundError
from geoscene.sources.areas import Places, is_multipolygon, multipolygon_areas, way_areas
from geoscene.sources.data import (
    AROUND_BOUNDS,
    Bounds,
    OsmData,
    Relation,
    TaggedNode,
    Tags,
    Way,
    existing_tags,
    has_meaning,
    is_area,
    is_line,
    kind_of,
)
from geoscene.sources.elements import UNITS, Elements
from geoscene.sources.extent import checked_bounds, locate, near_extent, widened
from geoscene.support.problems import Action, Problem
from geoscene.typing import Bools, Ints

_KINDS = ("road", "railway", "waterway", "barrier")
_TRAVELLED = ("highway", "railway", "waterway")
_CROWD, _CELL = 32, 1e-4
"""Lines of a kind in one place, and the side of a place in degrees, about 10 m."""


def _intersect(elements: Elements, bounds: Bounds | None) -> Bools:
    """(w,) bool, whether each way's bounding box intersects the bounds; false for ways without nodes."""
    count = len(elements.way_id)
    if bounds is None:
        return np.ones(count, np.bool_)
    ways = np.repeat(np.arange(count), np.diff(elements.way_start))
    here = elements.ref >= 0
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    xy = elements.lonlat(elements.ref[here])
    np.minimum.at(low, ways[here], xy)
    np.maximum.at(high, ways[here], xy)
    west, south, east, north = bounds
    return np.asarray((low <= (east, north)).all(axis=1) & (high >= (west, south)).all(axis=1), np.bool_)


def _lines(elements: Elements, rows: list[int]) -> tuple[list[Way], list[Problem]]:
    """Lines of ways; a line is split where nodes are missing, so that several may have the same id."""
    ways: list[Way] = []
    problems: list[Problem] = []
    for row in rows:
        nodes = elements.chain(row)
        tags = elements.way_tags[row]
        name = f"way/{elements.way_id[row]}"
        missing = int((nodes < 0).sum())
        runs = [nodes]
        if missing:
            breaks = np.flatnonzero(np.diff((nodes >= 0).astype(np.int8))) + 1
            runs = [run for run in np.split(nodes, breaks) if run[0] >= 0]
        count = 0
        for run in runs:
            if len(run) > 1 and (run[1:] == run[:-1]).any():
                keep = np.append(True, run[1:] != run[:-1])
                detail = f"{np.count_nonzero(~keep)} repeats left out"
                problems.append(Problem(name, kind_of(tags), "repaired", "repeated-node", detail))
                run = run[keep]  # noqa: PLW2901 - the cleaned run takes its place
            if len(run) > 1:
                ways.append(Way(name, tags, elements.node_id[run], elements.lonlat(run)))
                count += 1
        if missing or not count:
            detail = f"{missing} of {len(nodes)} nodes absent" if missing else f"{len(nodes)} nodes"
            action: Action = "repaired" if count else "dropped"
            problems.append(
                Problem(name, kind_of(tags), action, "missing-nodes" if missing else "too-short", detail)
            )
    return ways, problems


def _drop_crowded(ways: list[Way]) -> tuple[list[Way], list[Problem]]:
    """The lines without those beyond the first 32 of a kind in one place, by id, and these as problems.

    No place has so many; the time to cut the ground along their borders grows with the square of the number.
    """
    kinds = [kind_of(way.tags) for way in ways]
    rows = np.array([k for k, kind in enumerate(kinds) if kind in _KINDS], np.int64)
    number_of_kind = np.array([_KINDS.index(kinds[k]) for k in rows], np.int64)
    if len(rows) <= _CROWD:
        return ways, []
    xy = np.concatenate([ways[k].lonlat for k in rows])
    line = np.repeat(np.arange(len(rows)), [len(ways[k].lonlat) for k in rows])
    xy, line = shapely.get_coordinates(
        shapely.segmentize(shapely.linestrings(xy, indices=line), _CELL), return_index=True
    )
    cell = np.floor(xy / _CELL).astype(np.int64)
    where = (cell[:, 1] * len(_KINDS) + number_of_kind[line]) * 2**32 + cell[:, 0]
    _, place, points = np.unique(where, return_inverse=True, return_counts=True)
    many = points[place] > _CROWD
    pairs = np.unique(np.stack([place[many], line[many]], axis=1), axis=0)
    _, first, number = np.unique(pairs[:, 0], return_index=True, return_inverse=True)
    beyond = np.arange(len(pairs)) - first[number.ravel()] >= _CROWD
    dropped = set(rows[np.unique(pairs[beyond, 1])].tolist())
    detail = f"over {_CROWD} lines within 10 m"
    problems = [Problem(ways[k].osm_id, kinds[k], "dropped", "crowded", detail) for k in dropped]
    return [way for k, way in enumerate(ways) if k not in dropped], sorted(problems)


def _select(data: OsmData, bounds: Bounds) -> OsmData:
    """The features that intersect the bounds, not clipped; problems of features outside are left out."""
    box = shapely.box(*bounds)
    shapely.prepare(box)
    intersects = shapely.intersects(box, np.array([a.geometry for a in data.areas], object))
    areas = [a for a, inside in zip(data.areas, intersects, strict=True) if inside]
    lines = shapely.linestrings(
        np.concatenate([w.lonlat for w in data.ways]) if data.ways else np.empty((0, 2)),
        indices=np.repeat(np.arange(len(data.ways)), [len(w.nodes) for w in data.ways]),
    )
    intersects = shapely.intersects(box, lines)
    ways = [w for w, inside in zip(data.ways, intersects, strict=True) if inside]
    west, south, east, north = bounds
    points = [p for p in data.points if west <= p.lon <= east and south <= p.lat <= north]
    kept = {f.osm_id for group in (areas, ways, points) for f in group}
    outside = {f.osm_id for group in (data.areas, data.ways, data.points) for f in group} - kept
    return OsmData(
        bounds=bounds,
        ways=ways,
        areas=areas,
        points=points,
        relations=[r for r in data.relations if any(f"{kind}/{i}" in kept for kind, i, _ in r.members)],
        problems=[p for p in data.problems if p.osm_id not in outside],
        source=data.source,
        timestamp=data.timestamp,
    )


def _ways_around(elements: Elements, bounds: Bounds, *, inside: set[str]) -> list[Way]:
    """Streets, railways and waterways up to `AROUND_BOUNDS` metres beyond the bounds, not ``inside``."""
    near = _intersect(elements, widened(bounds, AROUND_BOUNDS))
    rows = [
        row
        for row in np.flatnonzero(near).tolist()
        if any(key in elements.way_tags[row] for key in _TRAVELLED)
        and not is_area(elements.way_tags[row])
        and f"way/{elements.way_id[row]}" not in inside
    ]
    return _lines(elements, rows)[0]


def features(elements: Elements, *, bounds: Bounds | None = None, source: str = "") -> OsmData:
    """The features of a map extract, each kind in order of id.

    bounds : keep the features that intersect this box (west, south, east, north, degrees), whole; all if None
    source : file or place that the elements are from, for messages

    Raises InputError for invalid bounds, SourceNotFoundError if there are no features (within them).
    """
    if bounds is not None:
        bounds = checked_bounds(bounds)
    if len(elements.node_id) == 0:
        raise SourceNotFoundError(
            f"{source}: holds no nodes with coordinates; is it a whole OpenStreetMap extract?"
        )
    elements, extent, far = locate(elements, bounds)
    places = Places.of(elements)
    near = _intersect(elements, bounds)
    elements, absent = _existing(elements, near, bounds=bounds)

    def wanted(rows: Ints) -> bool:
        return bool(near[rows].any())

    problems = [
        Problem(f"node/{i}", "node", "dropped", "bad-coordinates", "missing or out of range")
        for i in elements.misplaced.tolist()
    ]
    problems += [*elements.problems, *far, *absent]
    areas, found, claims = multipolygon_areas(elements, places, extent=extent, wanted=wanted)
    problems += found
    rows = [row for row in np.flatnonzero(near).tolist() if has_meaning(elements.way_tags[row])]
    more, found, meant = way_areas(elements, places, extent=extent, rows=rows, claims=claims)
    problems += found
    areas, found = near_extent(more + areas, extent)
    problems += found
    lines = [
        row
        for row in rows
        if row not in meant or (is_line(elements.way_tags[row]) and is_area(elements.way_tags[row]))
    ]
    ways, found = _lines(elements, lines)
    problems += found
    ways, found = _drop_crowded(ways)
    problems += found
    data = OsmData(
        bounds=bounds or extent,
        ways=ways,
        areas=areas,
        points=_points(elements),
        relations=[
            Relation(f"relation/{i}", tags, members)
            for i, tags, members in elements.relations
            if not is_multipolygon(tags)
        ],
        problems=problems,
        source=source,
        timestamp=elements.timestamp,
    )
    if bounds is not None:
        data = _select(data, bounds)
        data = replace(data, around=_ways_around(elements, bounds, inside={way.osm_id for way in data.ways}))
        if not (data.ways or data.areas or data.points):
            lonlat = elements.node_xy / UNITS
            covered = (*lonlat.min(axis=0), *lonlat.max(axis=0))
            raise SourceNotFoundError(
                f"{source}: nothing within {','.join(f'{v:g}' for v in bounds)};"
                f" it covers {','.join(f'{v:.7g}' for v in covered)} (west, south, east, north)"
            )
    return data


def _existing(elements: Elements, near: Bools, *, bounds: Bounds | None) -> tuple[Elements, list[Problem]]:
    """The elements without tags of what is planned or gone, and these objects within the bounds.

    near : (w,) bool, ways that intersect the bounds
    """
    problems: list[Problem] = []

    def existing(name: str, tags: Tags, *, inside: bool) -> Tags:
        kept, absent = existing_tags(tags)
        if absent and inside:
            kind = "node" if name.startswith("node") else kind_of(tags)
            problems.append(Problem(name, kind, "dropped", "does-not-exist", absent))
        return kept

    west, south, east, north = bounds or (-np.inf, -np.inf, np.inf, np.inf)
    ids = np.array(list(elements.node_tags), np.int64)
    lon, lat = elements.lonlat(np.searchsorted(elements.node_id, ids)).reshape(-1, 2).T
    inside = (lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)
    node_tags = {
        i: existing(f"node/{i}", elements.node_tags[i], inside=bool(here))
        for i, here in zip(ids.tolist(), inside, strict=True)
    }
    way_tags = [
        existing(f"way/{i}", tags, inside=bool(here))
        for i, tags, here in zip(elements.way_id.tolist(), elements.way_tags, near, strict=True)
    ]
    shown = set(elements.way_id[near].tolist())
    relations = [
        (
            i,
            existing(
                f"relation/{i}",
                tags,
                inside=any(kind == "way" and ref in shown for kind, ref, _ in members),
            ),
            members,
        )
        for i, tags, members in elements.relations
    ]
    return replace(elements, node_tags=node_tags, way_tags=way_tags, relations=relations), problems


def _points(elements: Elements) -> list[TaggedNode]:
    ids = np.array(list(elements.node_tags), np.int64)
    lonlat = elements.lonlat(np.searchsorted(elements.node_id, ids)).tolist()
    return [
        TaggedNode(f"node/{i}", elements.node_tags[i], lon, lat)
        for i, (lon, lat) in zip(ids.tolist(), lonlat, strict=True)
    ]
