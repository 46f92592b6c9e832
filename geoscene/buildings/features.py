"""From map areas to the table of buildings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from geoscene.buildings.footprints import Polygons, clean, project
from geoscene.buildings.heights import HIGHEST, SIGMA_PRIOR, Tagged, infer_heights, read_heights
from geoscene.buildings.looks import read_roof, read_walls, settle
from geoscene.buildings.parts import assign, clusters, cut_overlaps, duplicates, remainder
from geoscene.buildings.rooftags import RoofTags, default_roof_height, read_roof_tags
from geoscene.buildings.table import BuildingOptions, Buildings
from geoscene.frames import Frame
from geoscene.report import Problem
from geoscene.sources.data import Area, OsmData, Tags

_NOT = ("no", "none", "false", "")
_OPEN_BELOW = ("roof", "carport", "canopy")


@dataclass(frozen=True, slots=True)
class _Row:
    """A building or a part on its way into the table."""

    osm_id: str
    tags: Tags
    footprint: Any
    outline: int
    is_part: bool
    use: str


def is_building(tags: Tags) -> bool:
    """The area is a building's outline."""
    return tags.get("building", "no") not in _NOT


def is_building_part(tags: Tags) -> bool:
    """The area is a part of a building and not an outline."""
    return tags.get("building:part", "no") not in _NOT and not is_building(tags)


def _underground(tags: Tags) -> bool:
    return tags.get("location") == "underground" or tags.get("parking") == "underground"


def _use(tags: Tags) -> str:
    value = tags["building"] if is_building(tags) else tags["building:part"]
    return value.split(";")[0].strip().lower()


def read_buildings(
    osm: OsmData, frame: Frame, *, options: BuildingOptions | None = None
) -> tuple[Buildings, list[Problem]]:
    """The table of all buildings and parts of a map, and what was repaired or dropped.

    Duplicates are dropped, parts given to outlines, missing heights inferred, and overlaps between buildings
    taken from the larger one. Depends on nothing but the map: no order of files, no neighbouring tile.
    """
    options = options or BuildingOptions()
    problems: list[Problem] = []
    outlines = _take(osm.areas, "building", options.min_area, frame, problems)
    parts = _take(osm.areas, "part", options.min_area / 100, frame, problems)

    shapes = _polygons([r.footprint for r in outlines])
    known = np.array([len(r.tags) + 1e3 * (_height_tagged(r.tags)) for r in outlines], float)
    gone, found = duplicates([r.osm_id for r in outlines], shapes, known)
    problems += found
    outlines = [r for r, g in zip(outlines, gone, strict=True) if not g]

    rows = _settle_parts(outlines, parts, osm, options, problems)
    return _table(rows, frame, options, problems)


def _height_tagged(tags: Tags) -> bool:
    return "height" in tags or "building:height" in tags


def _polygons(shapes: Sequence[Any]) -> Polygons:
    out = np.empty(len(shapes), dtype=object)
    out[:] = shapes
    return out


def _take(
    areas: Sequence[Area], kind: str, least: float, frame: Frame, problems: list[Problem]
) -> list[_Row]:
    """The buildings or parts among areas, in order of id, with clean footprints in scene metres."""
    wanted = is_building if kind == "building" else is_building_part
    chosen = []
    for area in areas:
        if not wanted(area.tags):
            continue
        if _underground(area.tags):
            problems.append(Problem(area.osm_id, "building", "dropped", "underground"))
            continue
        chosen.append(area)
    # by kind and number, so that the order of the file does not matter
    chosen.sort(key=lambda a: (a.osm_id.split("/")[0], int(a.osm_id.split("/")[1])))
    raw = project(_polygons([a.geometry for a in chosen]), frame)
    polygons, repaired = clean(raw)
    before, after = shapely.area(raw), shapely.area(polygons)
    rows = []
    for k, area in enumerate(chosen):
        if not after[k] >= least:
            detail = f"{after[k]:.3f} m2, least is {least:g} m2"
            problems.append(Problem(area.osm_id, "building", "dropped", "too-small", detail))
            continue
        if repaired[k]:
            detail = f"area {before[k]:.2f} to {after[k]:.2f} m2"
            problems.append(Problem(area.osm_id, "building", "repaired", "invalid-footprint", detail))
        rows.append(_Row(area.osm_id, area.tags, polygons[k], -1, kind == "part", _use(area.tags)))
    return rows


def _settle_parts(
    outlines: list[_Row],
    parts: list[_Row],
    osm: OsmData,
    options: BuildingOptions,
    problems: list[Problem],
) -> list[_Row]:
    """Buildings, then parts with their outline's row; what parts leave of an outline becomes a part itself."""
    rows = list(outlines)
    shapes = _polygons([p.footprint for p in parts])
    if not parts:
        return [_outline_of(r, i) for i, r in enumerate(rows)]
    target = assign(
        [p.osm_id for p in parts],
        shapes,
        [r.osm_id for r in rows],
        _polygons([r.footprint for r in rows]),
        osm.relations,
    )
    orphans = np.flatnonzero(target < 0)
    for group in np.unique(cluster := clusters(shapes[orphans])) if len(orphans) else ():
        members = orphans[cluster == group]
        largest = members[np.argmax(shapely.area(shapes[members]))]
        whole = clean(_polygons([shapely.union_all(shapes[members])]))[0][0]
        target[members] = len(rows)
        rows.append(_Row(parts[largest].osm_id, {}, whole, -1, is_part=False, use="yes"))
        detail = f"{len(members)} parts outside any outline, {shapely.area(whole):.1f} m2, made one building"
        problems.append(
            Problem(parts[largest].osm_id, "building", "repaired", "parts-without-outline", detail)
        )

    pieces = [
        _Row(p.osm_id, p.tags, p.footprint, int(target[i]), is_part=True, use=p.use)
        for i, p in enumerate(parts)
    ]
    for row in np.unique(target):
        rest, share = remainder(rows[row].footprint, shapes[target == row], covered=options.covered)
        if shapely.area(rest) < options.min_area:
            continue
        whole = rows[row]
        pieces.append(_Row(whole.osm_id, whole.tags, rest, int(row), is_part=True, use=whole.use))
        detail = f"parts cover {share:.0%} of the outline; {shapely.area(rest):.1f} m2 of it stay as a part"
        problems.append(Problem(whole.osm_id, "building", "repaired", "partly-covered", detail))
    return [_outline_of(r, i) for i, r in enumerate(rows)] + pieces


def _outline_of(row: _Row, number: int) -> _Row:
    return _Row(row.osm_id, row.tags, row.footprint, number, is_part=False, use=row.use)


@dataclass(slots=True)
class _Heights:
    """Columns of heights while they are settled."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    roof: NDArray[np.float64]
    sigma: NDArray[np.float64]
    source: NDArray[np.object_]
    low_source: NDArray[np.object_]
    roof_source: NDArray[np.object_]


def _table(
    rows: list[_Row], frame: Frame, options: BuildingOptions, problems: list[Problem]
) -> tuple[Buildings, list[Problem]]:
    n = len(rows)
    footprint = _polygons([r.footprint for r in rows])
    is_part = np.array([r.is_part for r in rows], np.bool_)
    outline = np.array([r.outline for r in rows], np.int32)
    use = np.array([r.use for r in rows], dtype=object)
    tagged = [read_heights(r.tags, options=options) for r in rows]
    roofs = [read_roof_tags(r.tags) for r in rows]
    for r, roof in zip(rows, roofs, strict=True):
        if roof.unknown:
            detail = f"roof:shape={roof.unknown} is made flat"
            problems.append(Problem(r.osm_id, "building", "repaired", "unknown-roof-shape", detail))

    heights = _settle_heights(rows, tagged, roofs, footprint, is_part, outline, use, options, problems)
    drawn = np.ones(n, np.bool_)
    drawn[outline[is_part]] = False
    solid = np.flatnonzero(drawn)
    ids = [r.osm_id for r in rows]
    cut, found = cut_overlaps(
        [ids[k] for k in solid],
        footprint[solid],
        outline[solid].astype(np.int64),
        heights.low[solid],
        heights.high[solid],
    )
    footprint[solid] = cut
    problems += found

    convergence = np.zeros(n)
    if n:
        centre = shapely.get_coordinates(shapely.centroid(footprint[drawn | is_part]))
        if len(centre):
            lon, lat = frame.to_geographic(*centre.mean(axis=0))
            convergence[:] = float(frame.convergence(lon, lat))
    azimuth = np.radians([r.direction_deg for r in roofs]) - convergence if n else np.empty(0)

    looks = [(read_walls(r.tags), read_roof(r.tags)) for r in rows]
    walls, tops = [], []
    for k, r in enumerate(rows):
        parent = looks[r.outline] if r.is_part else (None, None)
        pitched = heights.roof[k] > 0
        walls.append(settle(looks[k][0], parent[0], "plaster"))
        tops.append(settle(looks[k][1], parent[1], "roof_tile" if pitched else "tar_roof"))

    table = Buildings(
        osm_id=np.array(ids, dtype=object),
        footprint=footprint,
        is_part=is_part,
        outline=outline,
        min_height=heights.low,
        height=heights.high,
        roof_height=heights.roof,
        roof_shape=np.array([f.shape for f in roofs], dtype=object),
        roof_direction=np.asarray(np.pi / 2 - azimuth, float),
        roof_across=np.array([f.across for f in roofs], np.bool_),
        height_source=heights.source,
        height_sigma=heights.sigma,
        min_height_source=heights.low_source,
        roof_source=heights.roof_source,
        levels=np.array([t.levels for t in tagged], float),
        use=use,
        name=np.array([r.tags.get("name", "") for r in rows], dtype=object),
        wall_color=np.array([w[0] for w in walls], np.uint8).reshape(-1, 3),
        roof_color=np.array([t[0] for t in tops], np.uint8).reshape(-1, 3),
        wall_material=np.array([w[1] for w in walls], np.uint8),
        roof_material=np.array([t[1] for t in tops], np.uint8),
        wall_source=np.array([w[2] for w in walls], dtype=object),
        roof_look_source=np.array([t[2] for t in tops], dtype=object),
    )
    return _without_vanished(table), sorted(problems)


def _settle_heights(
    rows: list[_Row],
    tagged: list[Tagged],
    roofs: list[RoofTags],
    footprint: Polygons,
    is_part: NDArray[np.bool_],
    outline: NDArray[np.int32],
    use: NDArray[np.object_],
    options: BuildingOptions,
    problems: list[Problem],
) -> _Heights:
    """Every row's underside, top and roof, from its tags, its building, its parts, or by inference."""
    n = len(rows)
    high = np.array([t.height for t in tagged], float)
    low = np.array([t.minimum for t in tagged], float)
    roof = np.array([t.roof for t in tagged], float)
    sigma = np.array([t.sigma for t in tagged], float)
    source = np.array([t.source for t in tagged], dtype=object)
    low_source = np.array([t.minimum_source or "default" for t in tagged], dtype=object)
    roof_source = np.array([t.roof_source for t in tagged], dtype=object)
    shape = np.array([f.shape for f in roofs], dtype=object)
    low = np.where(np.isfinite(low), low, 0.0)

    for k in np.flatnonzero((shape != "flat") & ~np.isfinite(roof)):
        roof[k], roof_source[k] = default_roof_height(roofs[k], footprint[k])
        if source[k] == "levels":  # storeys do not count the roof
            high[k] += roof[k]
    flat = shape == "flat"
    roof[flat], roof_source[flat] = 0.0, "none"

    # a building whose parts have heights is as high as the highest; a part without takes its building's
    part = np.flatnonzero(is_part)
    tops = np.full(n, -np.inf)
    np.maximum.at(tops, outline[part], np.where(np.isfinite(high[part]), high[part], -np.inf))
    from_parts = ~is_part & ~np.isfinite(high) & np.isfinite(tops)
    high[from_parts], source[from_parts] = tops[from_parts], "parts"
    sigma[from_parts] = options.level_height

    whole = np.flatnonzero(~is_part)
    inferred, spread, rule = infer_heights(
        shapely.get_coordinates(shapely.point_on_surface(footprint[whole])),
        use[whole],
        np.asarray(shapely.area(footprint[whole]), float),
        high[whole],
        reach=options.reach,
    )
    lacking = ~np.isfinite(high[whole])
    high[whole[lacking]], sigma[whole[lacking]] = inferred[lacking], spread[lacking]
    source[whole[lacking]] = rule[lacking]

    lacking = is_part & ~np.isfinite(high)
    high[lacking], source[lacking] = high[outline[lacking]], "outline"
    sigma[lacking] = np.maximum(sigma[outline[lacking]], SIGMA_PRIOR * high[lacking] / 2)

    for k in np.flatnonzero(high - low < 0.01):
        detail = f"underside at {low[k]:g} m, top at {high[k]:g} m"
        if source[k] in ("tag", "est_height", "levels") and is_part[k] and high[k] > 0:
            # the mapper gave the part's own thickness, or slipped: the top is trusted, the underside is not
            detail += ", underside put at 0"
        low[k], low_source[k] = 0.0, "default"
        problems.append(Problem(rows[k].osm_id, "building", "repaired", "underside-over-top", detail))

    open_below = np.isin(use, _OPEN_BELOW) & (low_source == "default")
    lifted = high - np.minimum(roof, high) - options.canopy
    open_below &= lifted > 0.5
    low[open_below], low_source[open_below] = lifted[open_below], "canopy"

    for k in np.flatnonzero(roof > high - low + 1e-9):
        if roof_source[k] == "tag":
            detail = f"roof of {roof[k]:g} m on {high[k] - low[k]:g} m"
            problems.append(Problem(rows[k].osm_id, "building", "repaired", "roof-over-height", detail))
        roof[k] = high[k] - low[k] if roof_source[k] in ("tag", "levels") else 0.5 * (high[k] - low[k])
    high = np.minimum(high, HIGHEST)
    return _Heights(low, high, roof, sigma, source, low_source, roof_source)


def _without_vanished(table: Buildings) -> Buildings:
    """The table less rows whose footprint is empty, with the outlines' rows renumbered."""
    from dataclasses import fields  # noqa: PLC0415

    keep = ~shapely.is_empty(table.footprint)
    part = table.is_part & keep
    has_part = np.zeros(len(table), np.bool_)
    has_part[table.outline[part]] = True
    had_part = ~table.drawn
    keep &= table.is_part | has_part | ~had_part
    number = np.cumsum(keep) - 1
    columns = {f.name: getattr(table, f.name)[keep] for f in fields(Buildings)}
    columns["outline"] = number[columns["outline"]].astype(np.int32)
    return Buildings(**columns)
