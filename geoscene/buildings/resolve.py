"""Heights and roofs of buildings and their parts from tags; support of stacked parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from geoscene.buildings.appearance import Appearance, RoofTags, default_roof_height
from geoscene.buildings.footprints import Polygons, subtract
from geoscene.buildings.heights import HIGHEST, SIGMA_PRIOR, THINNEST, Tagged, infer_heights
from geoscene.buildings.table import GRID, BuildingOptions, Texts
from geoscene.sources.data import Tags
from geoscene.support.problems import Problem
from geoscene.typing import Bools, Float, Ints

_HALLS = (
    "church", "cathedral", "chapel", "mosque", "synagogue", "temple", "stadium", "sports_hall", "hangar",
    "train_station",
)  # fmt: skip
"""Uses of buildings whose single storey may have any height."""

_OPEN_BELOW = ("roof", "carport", "canopy")

LOWEST_WALLS, LOWEST_ROOF = 2.2, 0.4
"""Metres that walls below a guessed roof have at least, and below which a guessed roof is flat; assumed."""

_SIGMA_ROOF = {"default": 0.5, "angle": 0.2, "assumed": 0.5}
"""Assumed standard deviation of a roof's height as a share of it, by its source."""

_SLIT = 0.3
"""Metres between a part's top and the underside of one above it that count as no gap; assumed, far below a
storey."""

_SUPPORT = 0.01
"""Square metres; parts that share less in plan do not stand on one another."""


@dataclass(frozen=True, slots=True)
class BuildingRow:
    """A building or a part before it enters the table.

    tagged       : heights
    roof         : shape, direction and pitch of the roof
    looks        : appearance of the walls and of the roof
    outline      : row of its building; its own row for a building
    is_remainder : whether it is what parts leave of an outline
    """

    osm_id: str
    tags: Tags
    footprint: Any
    use: str
    tagged: Tagged
    roof: RoofTags
    looks: tuple[Appearance, Appearance]
    outline: int = -1
    is_part: bool = False
    is_remainder: bool = False


@dataclass(frozen=True, slots=True)
class BuildingHeights:
    """Columns (n,) of heights for `geoscene.buildings.table.Buildings`."""

    low: Float
    high: Float
    roof: Float
    sigma: Float
    source: Texts
    low_source: Texts
    roof_source: Texts


def texts(values: Sequence[str]) -> Texts:
    """Strings as an array of objects (n,)."""
    return np.array(values, dtype=object)


def resolve_heights(
    rows: Sequence[BuildingRow], *, options: BuildingOptions
) -> tuple[BuildingHeights, list[Problem]]:
    """Underside, top and roof height of every row (buildings, then parts), and repairs."""
    problems: list[Problem] = []
    tagged = [r.tagged for r in rows]
    h = BuildingHeights(
        np.nan_to_num([t.minimum for t in tagged]),
        np.array([t.height for t in tagged], float),
        np.array([t.roof for t in tagged], float),
        np.array([t.sigma for t in tagged], float),
        texts([t.source for t in tagged]),
        texts([t.minimum_source or "default" for t in tagged]),
        texts([t.roof_source for t in tagged]),
    )
    use = texts([r.use for r in rows])
    # a single storey of a hall is as high as the hall, not 3 m
    hall = np.isin(use, _HALLS) & (h.source == "levels") & (np.array([t.levels for t in tagged]) <= 1)
    h.high[hall], h.sigma[hall], h.source[hall] = np.nan, np.nan, ""
    _resolve_roofs(rows, h=h, options=options, problems=problems)
    is_part = np.array([r.is_part for r in rows], np.bool_)
    outline = np.array([r.outline for r in rows], np.int64)
    _resolve_buildings(rows, is_part, outline=outline, h=h, options=options)
    _resolve_remainders(rows, is_part, outline=outline, h=h)

    lacking = is_part & ~np.isfinite(h.high)
    h.high[lacking], h.source[lacking] = h.high[outline[lacking]], "outline"
    # the building's height is a poor estimate of one part's
    h.sigma[lacking] = np.maximum(h.sigma[outline[lacking]], SIGMA_PRIOR * h.high[lacking] / 2)
    np.minimum(h.high, HIGHEST, out=h.high)

    _repair_undersides(rows, h, problems=problems)
    lifted = h.high - np.minimum(h.roof, h.high) - options.canopy
    open_below = np.isin(use, _OPEN_BELOW) & (h.low_source == "default") & (lifted > 0.5)
    h.low[open_below], h.low_source[open_below] = lifted[open_below], "canopy"

    for k in np.flatnonzero(h.roof > h.high - h.low + 1e-9).tolist():
        room = h.high[k] - h.low[k]
        if h.roof_source[k] == "tag":
            detail = f"roof of {h.roof[k]:g} m on {room:g} m"
            problems.append(Problem(rows[k].osm_id, "building", "repaired", "roof-over-height", detail))
        h.roof[k] = room if h.roof_source[k] in ("cloud", "tag", "levels") else 0.5 * room
    _limit_guesses(rows, h)
    return h, problems


def _limit_guesses(rows: Sequence[BuildingRow], h: BuildingHeights) -> None:
    """Lower guessed roofs that leave too little for the walls below, in place; very low ones are flat."""
    guessed = np.flatnonzero([row.roof.assumed and row.roof.shape != "flat" for row in rows])
    room = h.high[guessed] - h.low[guessed]
    roof = np.minimum(h.roof[guessed], np.minimum(room - LOWEST_WALLS, 0.5 * room))
    h.roof[guessed] = np.where(roof < LOWEST_ROOF, 0.0, roof)
    h.roof_source[guessed] = "assumed"


def _repair_undersides(rows: Sequence[BuildingRow], h: BuildingHeights, *, problems: list[Problem]) -> None:
    """Put undersides above the top at 0 and those just below it 1 cm below it, in place."""
    for k in np.flatnonzero(h.high - h.low < THINNEST - 1e-9).tolist():
        tags = f"underside at {h.low[k]:g} m, top at {h.high[k]:g} m"
        if h.low[k] > h.high[k]:
            reason, detail = "underside-over-top", f"{tags}; underside put at 0"
            h.low[k], h.low_source[k] = 0.0, "default"
        else:
            reason, detail = "too-thin", f"{tags}; made {THINNEST:g} m thick"
            h.low[k] = h.high[k] - THINNEST
        problems.append(Problem(rows[k].osm_id, "building", "repaired", reason, detail))


def _resolve_roofs(
    rows: Sequence[BuildingRow], *, h: BuildingHeights, options: BuildingOptions, problems: list[Problem]
) -> None:
    """Set missing roof heights, in place. A flat roof has none: walls reach up to its top."""
    for k, row in enumerate(rows):
        if row.roof.shape == "flat":
            if h.roof[k] > 0 and h.roof_source[k] == "tag" and not (row.roof.assumed or row.is_remainder):
                detail = f"flat roof of {h.roof[k]:g} m"
                if h.source[k] == "levels":
                    detail += f"; walls of {h.high[k]:g} m, with it"
                problems.append(Problem(row.osm_id, "building", "repaired", "flat-roof-height", detail))
            h.roof[k], h.roof_source[k] = 0.0, "assumed" if row.roof.assumed else h.roof_source[k] or "tag"
        elif not np.isfinite(h.roof[k]):
            by_storeys = h.source[k] == "levels"
            walls = h.high[k] if by_storeys else np.inf
            if row.roof.assumed:
                h.roof[k], h.roof_source[k] = min(row.roof.height, walls), "assumed"
            else:
                h.roof[k], h.roof_source[k] = default_roof_height(
                    row.roof, row.footprint, walls=walls, storey=options.level_height
                )
            if by_storeys:  # building:levels excludes the roof
                h.high[k] += h.roof[k]
                h.sigma[k] = np.hypot(h.sigma[k], _SIGMA_ROOF[h.roof_source[k]] * h.roof[k])


def _resolve_buildings(
    rows: Sequence[BuildingRow],
    is_part: Bools,
    *,
    outline: Ints,
    h: BuildingHeights,
    options: BuildingOptions,
) -> None:
    """Set missing heights of buildings, in place: at least that of their highest part, else inferred."""
    own = np.flatnonzero(is_part & np.isfinite(h.high) & ~np.array([r.is_remainder for r in rows], np.bool_))
    own = own[np.argsort(h.high[own], kind="stable")]
    top = np.full(len(rows), -1)
    top[outline[own]] = own  # the last assignment is the highest part
    higher = np.flatnonzero(~is_part & (top >= 0))
    higher = higher[~(h.high[higher] >= h.high[top[higher]])]
    h.high[higher], h.source[higher] = h.high[top[higher]], "parts"
    h.sigma[higher] = h.sigma[top[higher]]

    whole = np.flatnonzero(~is_part)
    footprint = np.fromiter([rows[k].footprint for k in whole.tolist()], object)
    inferred, sigma, rule = infer_heights(
        shapely.get_coordinates(shapely.point_on_surface(footprint)),
        texts([rows[k].use for k in whole.tolist()]),
        area=np.asarray(shapely.area(footprint), float),
        height=h.high[whole],
        reach=options.reach,
    )
    lacking = ~np.isfinite(h.high[whole])
    gaps = whole[lacking]
    h.high[gaps], h.sigma[gaps], h.source[gaps] = inferred[lacking], sigma[lacking], rule[lacking]


def _resolve_remainders(
    rows: Sequence[BuildingRow], is_part: Bools, *, outline: Ints, h: BuildingHeights
) -> None:
    """Set the heights of the remainders of outlines, in place.

    The outline's tags apply, unless a part on the ground is as high: the tags then describe that part, and
    the remainder is as high as the lowest part on the ground. Heights measured in a cloud are
    the remainder's.
    """
    of = np.argsort(outline, kind="stable")
    begin, end = (np.searchsorted(outline[of], outline, side=side) for side in ("left", "right"))
    for k in np.flatnonzero([r.is_remainder and r.tagged.source != "cloud" for r in rows]):
        family = of[begin[k] : end[k]]
        parts = family[is_part[family] & np.isfinite(h.high[family])]
        grounded = [p for p in parts if p != k and h.low[p] < 0.01]
        if not grounded:
            continue
        tops = h.high[grounded]
        if not np.isfinite(h.high[k]) or tops.max() >= h.high[k] - 0.5:
            lowest = grounded[int(np.argmin(tops))]
            if not h.high[k] <= h.high[lowest]:
                h.high[k], h.source[k], h.sigma[k] = h.high[lowest], "parts", SIGMA_PRIOR * h.high[lowest]
                h.roof[k] = min(h.roof[k], h.high[k])


def with_support(
    rows: Sequence[BuildingRow], footprint: Polygons, *, heights: BuildingHeights
) -> list[Problem]:
    """Extend remainders of outlines under the parts above them, and close slits, both in place.

    A remainder keeps the ground of the parts that begin at its top or above: a penthouse does not stand over
    a hole. The underside of a part that lies less than 0.3 m over the flat top of another one is put on it,
    and reported.
    """
    low, high = heights.low, heights.high
    is_part = np.array([r.is_part for r in rows], np.bool_)
    outline = np.array([r.outline for r in rows], np.int64)
    raised = np.flatnonzero(is_part & (low > 0))
    problems: list[Problem] = []
    for building in np.unique(outline[raised]).tolist():
        family = np.flatnonzero(is_part & (outline == building))
        for k in (k for k in family.tolist() if rows[k].is_remainder):
            cutters = family[(family != k) & (low[family] < high[k] - _SLIT)]
            union = shapely.union_all(footprint[cutters], grid_size=GRID)
            footprint[k] = subtract(footprint[building], union)
        flat = family[heights.roof[family] <= 0]
        for k in family[low[family] > 0].tolist():
            gap = low[k] - high[flat]
            below = flat[(gap > 0) & (gap < _SLIT)]
            below = below[shapely.area(shapely.intersection(footprint[below], footprint[k])) > _SUPPORT]
            if len(below):
                top = float(high[below].max())
                detail = f"underside at {low[k]:z.2f} m put on the part below, at {top:z.2f} m"
                problems.append(Problem(rows[k].osm_id, "building", "repaired", "slit-between-parts", detail))
                low[k] = top
    return problems
