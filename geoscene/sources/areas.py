"""Areas of a map: closed ways and multipolygon relations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from geoscene.sources.data import (
    NOISE,
    Area,
    Bounds,
    Tags,
    area_tags,
    is_area,
    is_building,
    is_open_area,
    kind_of,
)
from geoscene.sources.elements import Elements, Members
from geoscene.sources.rings import RingMember, assemble, close_cut_ring, is_tangled, polygons_of
from geoscene.support.problems import Problem
from geoscene.typing import Float, Ints

_NO_NODES: Ints = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class Places:
    """Positions of nodes; nodes at the same position count as one.

    xy   : (n, 2) float64 degrees
    same : (n,) int64, index of the first node at the same position
    """

    xy: Float
    same: Ints

    @classmethod
    def of(cls, elements: Elements) -> Places:
        """Positions of all nodes."""
        packed = elements.node_xy[:, 0].astype(np.int64) << 32 | (
            elements.node_xy[:, 1].astype(np.int64) + 2**31
        )
        _, first, inverse = np.unique(packed, return_index=True, return_inverse=True)
        return cls(elements.lonlat(np.arange(len(packed))), first[inverse].astype(np.int64))

    def merged(self, nodes: Ints) -> Ints:
        """Node indices replaced by the first node at the same position; -1 stays."""
        return np.where(nodes >= 0, self.same[nodes], -1) if len(self.same) else nodes


def _descriptive(tags: Tags) -> Tags:
    """The tags that describe the object itself."""
    return {key: value for key, value in tags.items() if key not in NOISE and key != "type"}


@dataclass(frozen=True, slots=True)
class Claims:
    """Ways that belong to multipolygon relations.

    members : rows of ways that bound a multipolygon; such a way may be open without being a defect
    taken   : rows of ways whose area is that of the relation, so that they are not areas themselves
    """

    members: set[int]
    taken: set[int]


@dataclass(frozen=True, slots=True)
class _Boundary:
    """A multipolygon relation with its members resolved.

    ways : (row of the way, inner), row -1 for ways that are missing
    """

    osm_id: int
    tags: Tags
    ways: list[tuple[int, bool]]


_NO_RINGS = frozenset(
    {"part", "building:part", "ridge", "edge", "entrance", "label", "admin_centre", "address"}
)
"""Roles of members that do not bound a multipolygon."""


def is_multipolygon(tags: Tags) -> bool:
    """Whether a relation is of type multipolygon; relations of type ``boundary`` stay relations."""
    return tags.get("type") == "multipolygon"


def _is_untagged_outline(elements: Elements, row_of: dict[int, int], *, tags: Tags, members: Members) -> bool:
    """Whether a relation of type building has the tags of its outline, whose ways have none."""
    if tags.get("type") != "building" or not is_building(tags):
        return False
    outline = [(kind, row_of.get(i, -1)) for kind, i, role in members if role in ("outline", "outer")]
    return bool(outline) and all(
        kind == "way" and row >= 0 and not is_building(elements.way_tags[row]) for kind, row in outline
    )


def _is_tagged_area(tags: Tags) -> bool:
    return tags.get("area") == "yes" or bool(area_tags(tags))


def _boundary(
    elements: Elements, row_of: dict[int, int], *, osm_id: int, tags: Tags, members: Members
) -> tuple[_Boundary, set[int], bool]:
    """A relation with its effective tags, the ways whose area is the relation's, and whether both are tagged.

    If no tag of its own makes a relation an area, it inherits the tags that its outer ways have in common, as
    was the custom before 2016. An outer way is not an area itself if it has the relation's building tag or
    shares any area tag and value with it; an inner way is not if it is tagged the same. A building inherits
    further tags from a single outer way.
    """
    ways = [
        (row_of.get(i, -1), role == "inner")
        for kind, i, role in members
        if kind == "way" and role not in _NO_RINGS
    ]
    own = _descriptive(tags)
    outer = sorted({row for row, inner in ways if row >= 0 and not inner})
    tables = [m for row in outer if _is_tagged_area(m := _descriptive(elements.way_tags[row]))]
    common = {k: v for k, v in tables[0].items() if all(t.get(k) == v for t in tables)} if tables else {}
    old_style = not _is_tagged_area(own) and _is_tagged_area(common)
    if old_style:
        own = {**common, **own}
    area = area_tags(own)
    taken = set()
    for row, inner in ways:
        if row < 0:
            continue
        way_tags = _descriptive(elements.way_tags[row])
        shared = any(
            k in area and (k.startswith("building") or area[k] == v) for k, v in area_tags(way_tags).items()
        )
        same_tags = shared and way_tags.items() <= own.items()
        if same_tags if inner else shared or (old_style and elements.way_tags[row].get("area") == "yes"):
            taken.add(row)
    if len(outer) == 1 and outer[0] in taken and is_building(own):
        own = {**_descriptive(elements.way_tags[outer[0]]), **own}
    kept = {k: v for k, v in tags.items() if k in NOISE or k == "type"}
    return _Boundary(osm_id, {**kept, **own} if own else {}, ways), taken, not old_style


def _relation_area(
    elements: Elements, places: Places, *, boundary: _Boundary, extent: Bounds
) -> tuple[Any, Problem | None]:
    """The geometry of a multipolygon, or None, and its problem, if any."""
    chains: list[RingMember] = []
    missing_ways = cut = missing_nodes = 0
    for row, inner in boundary.ways:
        if row < 0:
            missing_ways += 1
            continue
        nodes = places.merged(elements.chain(row))
        missing = int((nodes < 0).sum())
        if missing and elements.way_closed[row]:
            ring = close_cut_ring(nodes, places.xy, extent=extent)
            if ring is not None:
                cut += 1
                chains.append(RingMember(ring, inner))
                continue
        missing_nodes += missing
        breaks = np.flatnonzero(np.diff((nodes >= 0).astype(np.int8))) + 1
        chains += [RingMember(run, inner) for run in np.split(nodes, breaks) if len(run) > 1 and run[0] >= 0]
    incomplete = missing_ways + missing_nodes > 0
    made = assemble(chains, places.xy, complete=not incomplete)
    reason = "incomplete-relation" if incomplete else made.reason or ("missing-nodes" if cut else "")
    osm_id = f"relation/{boundary.osm_id}"
    kind = kind_of(boundary.tags, area=True)
    if not reason:
        if made.geometry is not None:
            return made.geometry, None
        reason = "no-area"
    defects = [
        f"{n} {what}"
        for n, what in (
            (missing_ways, "member ways absent"),
            (missing_nodes, "nodes absent"),
            (cut, "cut rings closed"),
        )
        if n
    ]
    detail = ", ".join(defects) or f"{len(boundary.ways)} member ways"
    if made.geometry is None:
        why = "the inner rings leave no area" if reason in ("both-roles", "no-area") else "no ring closes"
        return None, Problem(osm_id, kind, "dropped", reason, f"{detail}; {why}")
    return made.geometry, Problem(osm_id, kind, "repaired", reason, detail)


def multipolygon_areas(
    elements: Elements, places: Places, *, extent: Bounds, wanted: Callable[[Ints], bool]
) -> tuple[list[Area], list[Problem], Claims]:
    """Areas of multipolygon relations in order of id, their problems, and the ways that belong to them.

    wanted : whether any of the ways in given rows is of interest
    """
    row_of = {int(i): row for row, i in enumerate(elements.way_id)}
    areas: list[Area] = []
    problems: list[Problem] = []
    claims = Claims(set(), set())
    for osm_id, tags, members in elements.relations:
        if not (is_multipolygon(tags) or _is_untagged_outline(elements, row_of, tags=tags, members=members)):
            continue
        boundary, taken, both_tagged = _boundary(elements, row_of, osm_id=osm_id, tags=tags, members=members)
        rows = np.array([row for row, _ in boundary.ways if row >= 0], np.int64)
        claims.members.update(rows.tolist())
        if not wanted(rows):
            continue
        name = f"relation/{osm_id}"
        if not boundary.tags:
            problems.append(Problem(name, "area", "dropped", "no-tags", f"{len(boundary.ways)} member ways"))
            continue
        geometry, problem = _relation_area(elements, places, boundary=boundary, extent=extent)
        if problem is not None:
            problems.append(problem)
        if geometry is None:
            continue
        claims.taken.update(taken)
        if both_tagged:
            detail = f"bounds {name}, which is tagged alike"
            problems += [
                Problem(
                    f"way/{elements.way_id[row]}",
                    kind_of(elements.way_tags[row]),
                    "dropped",
                    "tagged-twice",
                    detail,
                )
                for row in sorted(taken)
            ]
        areas.append(Area(name, boundary.tags, geometry, _NO_NODES))
    if areas:
        oriented = shapely.orient_polygons([area.geometry for area in areas])
        areas = [Area(a.osm_id, a.tags, g, a.nodes) for a, g in zip(areas, oriented, strict=True)]
    return areas, problems, claims


def way_areas(
    elements: Elements, places: Places, *, extent: Bounds, rows: Iterable[int], claims: Claims
) -> tuple[list[Area], list[Problem], set[int]]:
    """Areas of ways in order of id, their problems, and the rows of all ways that are tagged as areas."""
    areas: list[Area] = []
    problems: list[Problem] = []
    meant: set[int] = set()
    rings: list[Ints] = []
    of: list[int] = []
    for row in rows:
        tags = elements.way_tags[row]
        nodes = elements.chain(row)
        closed = elements.way_closed[row] or (
            len(nodes) > 3 and nodes[0] >= 0 <= nodes[-1] and places.same[nodes[0]] == places.same[nodes[-1]]
        )
        if not (is_area(tags) if closed else is_open_area(tags)):
            continue
        meant.add(row)
        if row in claims.taken or (not closed and row in claims.members):
            continue
        name, kind = f"way/{elements.way_id[row]}", kind_of(tags)
        missing = int((nodes < 0).sum())
        repair: tuple[str, str] | None = None
        if missing or not closed:
            reason = "missing-nodes" if missing else "open-ring"
            cut = close_cut_ring(nodes, places.xy, extent=extent)
            if cut is None:
                detail = (
                    f"{missing} of {len(nodes)} nodes absent"
                    if missing
                    else f"{len(nodes)} nodes, not closed"
                )
                problems.append(Problem(name, kind, "dropped", reason, detail))
                continue
            detail = f"{missing} of {len(nodes)} nodes absent, " if missing else ""
            repair = (reason, f"{detail}closed straight at the edge of the extract")
            nodes = cut
        merged = places.same[nodes]
        keep = np.append(True, merged[1:] != merged[:-1])
        if not keep.all():
            repair = repair or ("repeated-node", f"{np.count_nonzero(~keep)} left out")
            nodes = nodes[keep]
        if len(nodes) < 4:
            problems.append(Problem(name, kind, "dropped", "no-area", f"{len(nodes)} nodes"))
            continue
        if is_tangled(places.xy[nodes]):
            detail = f"{len(nodes)} nodes, over 10,000 crossings"
            problems.append(Problem(name, kind, "dropped", "tangled", detail))
            continue
        if repair:
            problems.append(Problem(name, kind, "repaired", *repair))
        rings.append(nodes)
        of.append(row)
    if not rings:
        return areas, problems, meant
    sizes = np.array([len(ring) for ring in rings])
    lines = shapely.linearrings(
        places.xy[np.concatenate(rings)], indices=np.repeat(np.arange(len(rings)), sizes)
    )
    sunwise = ~shapely.is_ccw(lines)
    polygons = shapely.polygons(lines)
    valid = shapely.is_valid(polygons)
    polygons = shapely.orient_polygons(polygons)
    for i, row in enumerate(of):
        tags = elements.way_tags[row]
        name = f"way/{elements.way_id[row]}"
        if valid[i]:
            nodes = elements.node_id[rings[i][::-1] if sunwise[i] else rings[i]]
            areas.append(Area(name, tags, polygons[i], nodes))
            continue
        geometry = polygons_of(polygons[i])
        why = str(shapely.is_valid_reason(polygons[i])).partition("[")[0]
        if geometry is None:
            problems.append(Problem(name, kind_of(tags), "dropped", "no-area", why))
            continue
        reason = "self-touching" if why.startswith("Ring ") else "self-crossing"
        pieces = int(shapely.get_num_geometries(geometry))
        detail = f"{why.lower()}, {pieces} part{'s' * (pieces > 1)}"
        problems.append(Problem(name, kind_of(tags), "repaired", reason, detail))
        areas.append(Area(name, tags, geometry, _NO_NODES))
    return areas, problems, meant
