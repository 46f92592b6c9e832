"""Reads the table of buildings from map areas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from shapely.errors import GEOSException

from geoscene.buildings.appearance import choose_appearance, read_roof, read_roof_tags, read_walls
from geoscene.buildings.footprints import (
    assign,
    clean,
    clusters,
    cut_overlaps,
    duplicates,
    groups,
    project,
    remainder,
)
from geoscene.buildings.guesses import region_at
from geoscene.buildings.heights import CLOUD_TOP, read_heights
from geoscene.buildings.resolve import BuildingHeights, BuildingRow, resolve_heights, texts, with_support
from geoscene.buildings.roof_guesses import guess_roofs
from geoscene.buildings.table import BuildingOptions, Buildings
from geoscene.geometry.frames import Frame
from geoscene.sources.data import Area, OsmData, Tags
from geoscene.support.problems import Problem, describe_unexpected, described, make_without_failures
from geoscene.tags import first_value, parse_number
from geoscene.typing import Ints

_NEGATIVE = ("no", "none", "false", "")

_ABOVE = (
    "location",
    "height",
    "building:height",
    "building:levels",
    "min_height",
    "min_level",
    "building:min_level",
)
"""Keys that say where a building stands, whatever its layer."""


def is_building(tags: Tags) -> bool:
    """Whether an area is the outline of a building."""
    return tags.get("building", "no") not in _NEGATIVE


def is_building_part(tags: Tags) -> bool:
    """Whether an area is a part of a building and not an outline."""
    return tags.get("building:part", "no") not in _NEGATIVE and not is_building(tags)


def is_underground(tags: Tags) -> bool:
    """Whether a building or part is below the ground.

    By ``location`` or ``parking``, else by a ``layer`` below 0 or storeys (``level``) below 0 alone, without
    a height or storeys that count from the ground.
    """
    if "underground" in (tags.get("location"), tags.get("parking")):
        return True
    below = any(key in tags and _is_negative(tags[key]) for key in ("layer", "level"))
    return below and not any(key in tags for key in _ABOVE)


def _is_negative(numbers: str) -> bool:
    """Whether all numbers of a list are below 0."""
    values = [parse_number(text) for text in numbers.split(";")]
    return all(value is not None and value < 0 for value in values)


def read_buildings(
    osm: OsmData, frame: Frame, *, options: BuildingOptions | None = None
) -> tuple[Buildings, list[Problem]]:
    """The table of all buildings and parts of a map, and the sorted problems.

    Duplicates are dropped, parts assigned to outlines, missing heights inferred, and overlaps between
    buildings cut from the larger one. The result does not depend on the order of the map's areas.
    """
    options = options or BuildingOptions()
    problems: list[Problem] = []
    outlines = _read_rows(osm.areas, frame, problems=problems, parts=False, options=options)
    parts = _read_rows(osm.areas, frame, problems=problems, parts=True, options=options)

    score = np.array([len(r.tags) + 1000 * bool(r.tagged.source) for r in outlines], float)
    repeated, found = duplicates(
        [r.osm_id for r in outlines], np.fromiter([r.footprint for r in outlines], object), score=score
    )
    problems += found
    outlines = [r for r, repeats in zip(outlines, repeated, strict=True) if not repeats]

    rows = _assign_parts(outlines, parts, osm=osm, options=options, problems=problems)
    if options.guess_roofs:
        west, south, east, north = osm.bounds
        rows = guess_roofs(rows, region_at((west + east) / 2, (south + north) / 2))
    table = _table(rows, osm.bounds, frame=frame, options=options, problems=problems)
    return _without_empty(table), sorted(problems)


def _read_rows(
    areas: Sequence[Area], frame: Frame, *, problems: list[Problem], parts: bool, options: BuildingOptions
) -> list[BuildingRow]:
    """Rows of the buildings, or of the parts, in order of id, with clean footprints in scene metres."""
    chosen = []
    for area in areas:
        if not (is_building_part if parts else is_building)(area.tags):
            continue
        if is_underground(area.tags):
            problems.append(Problem(area.osm_id, "building", "dropped", "underground"))
        else:
            chosen.append(area)
    chosen.sort(key=_id_order)
    made = make_without_failures(
        lambda some: _rows([chosen[k] for k in some.tolist()], frame, parts=parts, options=options),
        np.arange(len(chosen)),
        failed=lambda k, error: problems.append(
            describe_unexpected(chosen[k].osm_id, error, kind="building")
        ),
    )
    for _, found in made:
        problems += found
    return [row for rows, _ in made for row in rows]


def _rows(
    areas: Sequence[Area], frame: Frame, *, parts: bool, options: BuildingOptions
) -> tuple[list[BuildingRow], list[Problem]]:
    """Rows of areas that are large enough, and the problems."""
    raw = project(np.fromiter([a.geometry for a in areas], object), frame)
    polygons, repaired = clean(raw)
    before, after = shapely.area(raw), shapely.area(polygons)
    min_area = options.min_area / (100 if parts else 1)  # parts may be as small as masts and columns
    rows, problems = [], []
    for k, area in enumerate(areas):
        if not after[k] >= min_area:
            detail = f"{after[k]:.3f} m2, least is {min_area:g} m2"
            problems.append(Problem(area.osm_id, "building", "dropped", "too-small", detail))
            continue
        if repaired[k]:
            detail = f"area {before[k]:.2f} to {after[k]:.2f} m2"
            problems.append(Problem(area.osm_id, "building", "repaired", "invalid-footprint", detail))
        use = first_value(area.tags["building:part" if parts else "building"])
        rows.append(_row(area.osm_id, area.tags, footprint=polygons[k], use=use, options=options, part=parts))
    return rows, problems


def _row(
    osm_id: str, tags: Tags, *, footprint: Any, use: str, options: BuildingOptions, part: bool = False
) -> BuildingRow:
    return BuildingRow(
        osm_id,
        tags,
        footprint,
        use,
        tagged=read_heights(tags, options=options),
        roof=read_roof_tags(tags),
        looks=(read_walls(tags), read_roof(tags)),
        is_part=part,
    )


def _id_order(area: Area) -> tuple[str, int]:
    """Sort key of an area: ``way/9`` before ``way/10``; ids without a number by their text."""
    kind, _, number = area.osm_id.partition("/")
    return kind, int(number or 0)


def _assign_parts(
    outlines: list[BuildingRow],
    parts: list[BuildingRow],
    *,
    osm: OsmData,
    options: BuildingOptions,
    problems: list[Problem],
) -> list[BuildingRow]:
    """Buildings, then parts with the rows of their outlines; the rest of an outline is a part too."""
    shapes = np.fromiter([p.footprint for p in parts], object)
    target = assign(
        [p.osm_id for p in parts],
        shapes,
        outline_id=[r.osm_id for r in outlines],
        outline=np.fromiter([r.footprint for r in outlines], object),
        relations=osm.relations,
    )
    buildings = list(outlines)
    orphans = np.flatnonzero(target < 0)
    for group in groups(clusters(shapes[orphans])):
        members = orphans[group]
        first = parts[members[np.argmax(shapely.area(shapes[members]))]].osm_id
        shape = clean(np.fromiter([shapely.union_all(shapes[members])], object))[0][0]
        target[members] = len(buildings)
        buildings.append(_row(first, {}, footprint=shape, use="yes", options=options))
        detail = f"{len(members)} parts outside any outline, {shapely.area(shape):.1f} m2, made one building"
        problems.append(Problem(first, "building", "repaired", "parts-without-outline", detail))

    remainders = []
    for members in groups(target):
        row = int(target[members[0]])
        whole = buildings[row]
        try:
            rest, share, left_out = remainder(whole.footprint, shapes[members], strip=options.strip)
        except GEOSException as error:
            detail = f"no part made of what the parts leave of the outline, {described(error)}"
            problems.append(Problem(whole.osm_id, "building", "repaired", "unexpected-error", detail))
            continue
        if shapely.area(rest) >= options.min_area:
            remainders.append(replace(whole, footprint=rest, outline=row, is_part=True, is_remainder=True))
            detail = f"parts cover {share:.0%}; {shapely.area(rest):.1f} m2 of the outline stay as a part"
            problems.append(Problem(whole.osm_id, "building", "repaired", "partly-covered", detail))
        else:
            left_out += shapely.area(rest)
        if left_out >= options.min_area:
            detail = (
                f"{left_out:.1f} m2 of the outline that no part covers, narrower than {options.strip:g} m"
            )
            problems.append(Problem(whole.osm_id, "building", "repaired", "uncovered-strips", detail))
    return [
        *(replace(r, outline=i) for i, r in enumerate(buildings)),
        *(replace(p, outline=int(target[i])) for i, p in enumerate(parts)),
        *remainders,
    ]


def _table(
    rows: list[BuildingRow],
    bounds: tuple[float, float, float, float],
    *,
    frame: Frame,
    options: BuildingOptions,
    problems: list[Problem],
) -> Buildings:
    """The table's columns; ``bounds`` are those of the map in degrees."""
    footprint = np.fromiter([r.footprint for r in rows], object)
    is_part = np.array([r.is_part for r in rows], np.bool_)
    outline = np.array([r.outline for r in rows], np.int32)
    heights, found = resolve_heights(rows, options=options)
    problems += found
    problems += _ignored_tags(rows, heights)
    problems += with_support(rows, footprint, heights=heights)
    ids = texts([r.osm_id for r in rows])
    drawn = np.ones(len(rows), np.bool_)
    drawn[outline[is_part]] = False
    footprint[drawn], found = cut_overlaps(
        ids[drawn],
        footprint[drawn],
        owner=outline[drawn].astype(np.int64),
        rank=_ranks(rows, heights)[drawn],
        low=heights.low[drawn],
        high=heights.high[drawn],
    )
    problems += found

    # convert from true to grid north; one convergence is precise enough for the whole scene
    west, south, east, north = bounds
    turn = float(frame.convergence((west + east) / 2, (south + north) / 2)) if rows else 0.0
    azimuth = np.radians(np.array([r.roof.direction_deg for r in rows], float)) - turn

    of_outline = [rows[r.outline].looks if r.is_part else (None, None) for r in rows]
    walls = [
        choose_appearance(r.looks[0], up[0], default="plaster")
        for r, up in zip(rows, of_outline, strict=True)
    ]
    tops = [
        choose_appearance(r.looks[1], up[1], default="roof_tile" if roof > 0 else "tar_roof")
        for r, up, roof in zip(rows, of_outline, heights.roof, strict=True)
    ]
    return Buildings(
        osm_id=ids,
        footprint=footprint,
        passages=np.fromiter([() for _ in rows], object),
        is_part=is_part,
        outline=outline,
        min_height=heights.low,
        height=heights.high,
        roof_height=heights.roof,
        roof_shape=texts(
            [
                "flat" if r.roof.assumed and height <= 0 else r.roof.shape
                for r, height in zip(rows, heights.roof.tolist(), strict=True)
            ]
        ),
        roof_direction=np.pi / 2 - azimuth,
        roof_across=np.array([r.roof.across for r in rows], np.bool_),
        top=np.array(
            [
                float(r.tags.get(CLOUD_TOP, "nan")) if source == "cloud" else np.nan
                for r, source in zip(rows, heights.source, strict=True)
            ],
            float,
        ),
        height_source=heights.source,
        height_sigma=heights.sigma,
        min_height_source=heights.low_source,
        roof_source=heights.roof_source,
        levels=np.array([r.tagged.levels for r in rows], float),
        use=texts([r.use for r in rows]),
        name=texts([r.tags.get("name", "") for r in rows]),
        wall_color=np.array([w.color for w in walls], np.uint8).reshape(-1, 3),
        roof_color=np.array([t.color for t in tops], np.uint8).reshape(-1, 3),
        wall_material=np.array([w.material for w in walls], np.uint8),
        roof_material=np.array([t.material for t in tops], np.uint8),
        wall_source=texts([w.source for w in walls]),
        roof_look_source=texts([t.source for t in tops]),
    )


def _ranks(rows: Sequence[BuildingRow], heights: BuildingHeights) -> Ints:
    """Rank (n,) of each row's description: 2 if the building's height is known, 1 if only its name."""
    outline = [r.outline for r in rows]
    known = np.isin(heights.source, ("cloud", "tag", "est_height", "levels", "parts"))
    known |= known[outline]
    named = np.array(["name" in rows[k].tags for k in outline], np.bool_)
    return np.where(known, 2, named).astype(np.int64)


def _ignored_tags(rows: Sequence[BuildingRow], heights: BuildingHeights) -> list[Problem]:
    """A problem for each row with unusable tags, which names the value used instead."""
    problems = []
    for k, row in enumerate(rows):
        if row.is_remainder:  # has the tags of its outline, which is a row itself
            continue
        if row.roof.unknown:
            detail = f"roof:shape={row.roof.unknown} made flat"
            problems.append(Problem(row.osm_id, "building", "repaired", "unknown-roof-shape", detail))
        if ignored := row.tagged.ignored + row.roof.ignored:
            made = f"from {heights.low[k]:.4g} to {heights.high[k]:.4g} m ({heights.source[k]})"
            detail = f"{', '.join(ignored)}; built {made}"
            problems.append(Problem(row.osm_id, "building", "repaired", "unusable-tags", detail))
    return problems


def _without_empty(table: Buildings) -> Buildings:
    """The table without rows whose footprint has become empty; outlines are renumbered."""
    keep = ~shapely.is_empty(table.footprint)
    alive = np.zeros(len(table), np.bool_)
    alive[table.outline[table.is_part & keep]] = True
    keep &= table.is_part | table.drawn | alive
    number = np.cumsum(keep) - 1
    kept = table.take(keep)
    return replace(kept, outline=number[kept.outline].astype(np.int32))
