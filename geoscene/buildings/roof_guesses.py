"""Guessed roofs of buildings whose roof shape the map does not give.

A roof is gabled, hipped or flat by the region's usual shares (``palettes.toml``), the shapes of tagged
neighbours, the building's use, size and outline, and what tags say beside the shape (material, storeys or
height of the roof). Large, commercial and high buildings stay flat. Buildings side by side have one kind of
roof, with the ridge across their party walls. All shares, pitches and limits are assumed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely

from geoscene.buildings.appearance import RoofTags
from geoscene.buildings.footprints import Polygons
from geoscene.buildings.guesses import kinds_of, palettes, seeds
from geoscene.buildings.heights import CLOUD_TOP, typical_height
from geoscene.buildings.resolve import BuildingRow, texts
from geoscene.buildings.roofs import RECTANGULAR, takes_gables
from geoscene.buildings.table import Buildings, Texts
from geoscene.support.graphs import components
from geoscene.support.splitmix import uniform_at
from geoscene.tags import first_value
from geoscene.typing import Bools, Float, Ints

_WIDEST, _BROADEST = 900.0, 26.0
"""Square metres and metres across from which a roof counts as flat; assumed."""

_HIGHEST, _MOST_LEVELS = 26.0, 8.0
"""Metres and storeys from which a roof counts as flat; assumed."""

_SMALLEST = 6.0
"""Square metres below which a roof counts as flat; assumed."""

_MOST_CORNERS = 24
"""Corners of an outline from which its roof counts as flat; assumed."""

_BEND = 0.3
"""Metres by which an outline is simplified before its corners are counted."""

_SQUARE = 1.25
"""Ratio of sides below which a roof is as often hipped as twice its region's share; assumed."""

_TOUCH = 0.2
"""Metres between buildings side by side, at most."""

_NEAR, _NEIGHBOURS, _PRIOR = 120.0, 6, 2.0
"""Metres and number of the nearest tagged roofs that count, and how many the region's shares weigh."""

_FLAT_USES = (
    "roof", "carport", "canopy", "grandstand", "kiosk", "parking", "transformer_tower", "silo",
    "storage_tank",
    "tank", "water_tower", "bunker", "ruins", "construction", "container", "greenhouse", "mosque", "temple",
    "synagogue", "shrine", "service", "toilets", "chimney", "static_caravan", "stadium", "train_station",
)  # fmt: skip
_BARNS = ("barn", "stable", "farm_auxiliary", "cowshed", "sty", "riding_hall", "shed", "hut", "boathouse")
_GARAGES = ("garage", "garages")
_SPIRES = ("church", "cathedral", "chapel", "monastery")

_SLOPED_MATERIALS = ("roof_tiles", "tile", "tiles", "roof_tile", "slate", "thatch", "shingle", "shingles",
                     "asphalt_shingle")  # fmt: skip
_LEVEL_MATERIALS = ("tar_paper", "tar", "bitumen", "membrane", "rubber", "gravel", "concrete", "grass",
                    "plants", "green", "solar_panels")  # fmt: skip

_PITCHED = ("gabled", "hipped", "half-hipped", "gambrel", "mansard")
"""Shapes of neighbours that a guessed roof may have."""

_SPREAD_DEG, _SPIRE_DEG, _BROKEN = 6.0, 45.0, 1.4
"""Degrees between the flattest and the steepest roofs of a region, least pitch of churches, and factor of the
height of roofs whose slopes have two pitches; assumed."""


@dataclass(frozen=True, slots=True)
class _Outline:
    """Outlines in plan, one row each.

    area        : (n,) square metres
    middle      : (n, 2) scene metres
    long, short : (n,) metres, sides of the smallest rectangle
    axis        : (n,) radians, direction of its longer side
    fill        : (n,) share of the rectangle
    corners     : (n,) after simplification
    hole        : (n,) bool, with a courtyard
    inner       : (n,) metres, radius of the largest circle within
    """

    area: Float
    middle: Float
    long: Float
    short: Float
    axis: Float
    fill: Float
    corners: Ints
    hole: Bools
    inner: Float


def guess_roofs(rows: Sequence[BuildingRow], region: str) -> list[BuildingRow]:
    """The rows, with guessed roofs on buildings of one body without a tagged roof shape.

    region : of ``palettes.toml``

    The guess is the roof's ``shape``, ``across`` and ``height``; ``assumed`` stays true.
    """
    divided = {row.outline for row in rows if row.is_part}
    chosen = [
        k
        for k, row in enumerate(rows)
        if not row.is_part and k not in divided and row.roof.assumed and CLOUD_TOP not in row.tags
    ]
    out = list(rows)
    for k, roof in zip(
        chosen, _guess([rows[k] for k in chosen], _known_roofs(rows), region=region), strict=True
    ):
        out[k] = replace(rows[k], roof=roof)
    return out


def without_guess(buildings: Buildings, chosen: Bools) -> Buildings:
    """Buildings (n,) of which the chosen ones have no guessed roofs: those with passages, which stay flat."""
    of = chosen & (buildings.roof_source == "assumed") & (buildings.roof_height > 0)
    added = np.where(buildings.height_source == "levels", buildings.roof_height, 0.0)
    shape = buildings.roof_shape.copy()
    shape[of] = "flat"
    return replace(
        buildings,
        height=np.where(of, buildings.height - added, buildings.height),
        roof_height=np.where(of, 0.0, buildings.roof_height),
        roof_shape=shape,
    )


def _guess(rows: Sequence[BuildingRow], known: _KnownRoofs, *, region: str) -> list[RoofTags]:
    """The roof of each row."""
    if not rows:
        return []
    usual = palettes()["regions"][region]
    footprint = np.fromiter([row.footprint for row in rows], object)
    outline = _measure(footprint)
    use = texts([row.use for row in rows])
    tagged = np.array([row.tagged.height for row in rows], float)
    walls = np.where(np.isfinite(tagged), tagged, typical_height(use, outline.area))
    kind = kinds_of(use, area=outline.area, walls=walls)
    beside, party = _side_by_side(footprint)
    draw = _draws(rows, beside, kind=kind)
    near = _near_roofs(known, outline.middle, kind=kind)

    share = _pitched_share(kind, use, near=near, usual=usual)
    share[_forced_flat(rows, use, outline=outline, kind=kind, walls=walls)] = 0.0
    told = np.array([_told_by_tags(row) for row in rows])
    pitched = np.where(told == 0, draw[0] < share, told > 0)
    shape = _shapes(near, outline, party=party, hipped=usual["hipped"], draw=draw[1])
    rectangular = (outline.fill >= RECTANGULAR) & ~outline.hole
    for k in np.flatnonzero(pitched & (shape == "gabled") & ~rectangular).tolist():
        if not takes_gables(footprint[k]):
            shape[k] = "hipped"
    ridged = rectangular & ~np.isin(shape, ("hipped", "mansard"))
    across = ridged & (np.abs(np.cos(party - outline.axis)) > np.sqrt(0.5))
    run = np.where(across, outline.long / 2, np.where(ridged, outline.short / 2, outline.inner))
    pitch = usual["pitch_deg"] + _SPREAD_DEG * (draw[2] - 0.5)
    pitch = np.where(np.isin(use, _SPIRES), np.maximum(pitch, _SPIRE_DEG), pitch)
    angle = np.array([row.roof.angle_deg for row in rows], float)
    pitch = np.where(np.isfinite(angle), angle, pitch)
    height = run * np.tan(np.radians(pitch)) * np.where(np.isin(shape, ("gambrel", "mansard")), _BROKEN, 1.0)
    return [
        replace(row.roof, shape=str(shape[k]), across=bool(across[k]), height=float(height[k]))
        if pitched[k]
        else row.roof
        for k, row in enumerate(rows)
    ]


def _measure(footprint: Polygons) -> _Outline:
    area = np.asarray(shapely.area(footprint), float)
    ring = shapely.get_coordinates(shapely.get_exterior_ring(shapely.oriented_envelope(footprint)))
    corner = ring.reshape(-1, 5, 2)
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 1]
    a, b = np.hypot(*first.T), np.hypot(*second.T)
    longer = np.where((a >= b)[:, None], first, second)
    circle = shapely.maximum_inscribed_circle(footprint, tolerance=0.1)
    rings = np.asarray(shapely.get_num_interior_rings(shapely.get_geometry(footprint, 0)), np.int64)
    return _Outline(
        area,
        shapely.get_coordinates(shapely.centroid(footprint)),
        np.maximum(a, b),
        np.minimum(a, b),
        np.arctan2(longer[:, 1], longer[:, 0]),
        area / (a * b),
        np.asarray(shapely.get_num_coordinates(shapely.simplify(footprint, _BEND)), np.int64) - 1,
        rings > 0,
        np.asarray(shapely.length(circle), float),
    )


def _told_by_tags(row: BuildingRow) -> int:
    """1 where other tags than the shape tell of a pitched roof, -1 of a flat one, 0 where none does."""
    if row.roof.unknown or row.tagged.roof == 0:
        return -1
    if row.tagged.roof > 0 or row.roof.angle_deg > 0:
        return 1
    material = first_value(row.tags.get("roof:material", "").lower())
    return 1 if material in _SLOPED_MATERIALS else -1 if material in _LEVEL_MATERIALS else 0


def _forced_flat(
    rows: Sequence[BuildingRow], use: Texts, *, outline: _Outline, kind: Texts, walls: Float
) -> Bools:
    """Whether (n,) a roof counts as flat, whatever its neighbours have."""
    levels = np.nan_to_num([row.tagged.levels for row in rows])
    raised = np.nan_to_num([row.tagged.minimum for row in rows]) > 0
    spire = np.isin(use, _SPIRES)
    large = (outline.area > _WIDEST) | (2 * outline.inner > _BROADEST)
    high = (walls > _HIGHEST) | (levels > _MOST_LEVELS)
    commercial = np.isin(kind, ("office", "hall")) & ~np.isin(use, _BARNS)
    odd = (outline.corners > _MOST_CORNERS) | (outline.area < _SMALLEST)
    flat: Bools = raised | odd | np.isin(use, _FLAT_USES) | (~spire & (large | high | commercial))
    return flat


def _pitched_share(kind: Texts, use: Texts, *, near: _NearRoofs, usual: Mapping[str, Any]) -> Float:
    """Probability (n,) of a pitched roof: the region's share, weighed against tagged neighbours."""
    share = np.where(np.isin(kind, ("low", "small")), usual["pitched_low"], usual["pitched_tall"]).astype(
        float
    )
    share[np.isin(use, _BARNS)] = max(usual["pitched_low"], 0.8)
    share[np.isin(use, _GARAGES)] = usual["pitched_low"] / 3
    share = np.asarray((_PRIOR * share + near.pitched.sum(axis=1)) / (_PRIOR + near.count), float)
    share[np.isin(use, _SPIRES)] = 1.0
    return share


def _shapes(near: _NearRoofs, outline: _Outline, *, party: Float, hipped: float, draw: Float) -> Texts:
    """A pitched shape (n,) for each roof; between party walls gabled, unless neighbours are otherwise."""
    square = (outline.long < _SQUARE * outline.short) | (outline.fill < RECTANGULAR)
    hip = np.where(square, min(2 * hipped, 0.9), hipped)
    hip = np.where(np.isfinite(party), 0.0, hip)
    hip = np.where(outline.hole, 1.0, hip)
    weights = near.pitched.astype(float)
    weights[:, 0] += _PRIOR * (1.0 - hip)
    weights[:, 1] += _PRIOR * hip
    ends = np.cumsum(weights, axis=1) / weights.sum(axis=1, keepdims=True)
    shape: Texts = np.array(_PITCHED, object)[(draw[:, None] >= ends[:, :-1]).sum(axis=1)]
    shape[outline.hole | (~np.isin(shape, ("gabled", "hipped")) & (outline.fill < RECTANGULAR))] = "hipped"
    return shape


def _side_by_side(footprint: Polygons) -> tuple[tuple[Ints, Ints], Float]:
    """Pairs of footprints with a common wall, and the direction (n,) of each one's party walls.

    Directions are radians, NaN without party walls and where these run in several directions.
    """
    corner, of = shapely.get_coordinates(
        shapely.get_exterior_ring(shapely.get_geometry(footprint, 0)), return_index=True
    )
    start = np.flatnonzero(of[1:] == of[:-1])
    a, b, of = corner[start], corner[start + 1], of[start]
    edge = b - a
    share = np.array([0.25, 0.5, 0.75])
    points = (a[:, None] + share[:, None] * edge[:, None]).reshape(-1, 2)
    place, other = shapely.STRtree(footprint).query(
        shapely.points(points), predicate="dwithin", distance=_TOUCH
    )
    own = of[place // len(share)]
    place, other, own = (column[other != own] for column in (place, other, own))
    touched = np.unique(place)
    wall, row = touched // len(share), of[touched // len(share)]
    turn = np.exp(2j * np.arctan2(edge[wall, 1], edge[wall, 0])) * np.hypot(*edge[wall].T)
    n = len(footprint)
    total = np.bincount(row, np.abs(turn), n)
    mean = np.bincount(row, turn.real, n) + 1j * np.bincount(row, turn.imag, n)
    clear = (np.abs(mean) > 0.5 * total) & (total > 0)
    return (own, other), np.where(clear, np.angle(mean) / 2, np.nan)


def _draws(rows: Sequence[BuildingRow], beside: tuple[Ints, Ints], *, kind: Texts) -> Float:
    """Random numbers (3, n) of the roofs; buildings of a kind side by side have those of the lowest seed."""
    own, other = beside
    alike = kind[own] == kind[other]
    group = components(own[alike], other[alike], count=len(rows))
    seed = seeds(texts([row.osm_id for row in rows]))
    lowest = np.full(len(rows), np.iinfo(np.int64).max)
    np.minimum.at(lowest, group, seed)
    return uniform_at(lowest[group], np.ones(len(rows), np.int64), count=3)


@dataclass(frozen=True, slots=True)
class _KnownRoofs:
    """Tagged roofs (k rows): places (k, 2), kinds of their buildings, and shapes."""

    middle: Float
    kind: Texts
    shape: Texts


@dataclass(frozen=True, slots=True)
class _NearRoofs:
    """Tagged roofs near each of n buildings: how many (n,), and of each shape (n, 5) of `_PITCHED`."""

    count: Ints
    pitched: Ints


def _known_roofs(rows: Sequence[BuildingRow]) -> _KnownRoofs:
    """The tagged roofs of whole buildings, and of parts where these have them."""
    known = [row for row in rows if not row.roof.assumed]
    footprint = np.fromiter([row.footprint for row in known], object)
    use = texts([rows[row.outline].use if row.is_part else row.use for row in known])
    area = np.asarray(shapely.area(footprint), float)
    height = np.array([row.tagged.height for row in known], float)
    walls = np.where(np.isfinite(height), height, typical_height(use, area))
    middle = shapely.get_coordinates(shapely.centroid(footprint)).reshape(-1, 2)
    return _KnownRoofs(
        middle, kinds_of(use, area=area, walls=walls), texts([row.roof.shape for row in known])
    )


def _near_roofs(known: _KnownRoofs, middle: Float, *, kind: Texts) -> _NearRoofs:
    """The nearest tagged roofs of buildings of the same kind."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    count, pitched = np.zeros(len(middle), np.int64), np.zeros((len(middle), len(_PITCHED)), np.int64)
    for name in sorted(set(kind.tolist())):
        mine, theirs = np.flatnonzero(kind == name), known.kind == name
        if not theirs.any():
            continue
        tree, shape = cKDTree(known.middle[theirs]), known.shape[theirs]
        distance, place = tree.query(
            middle[mine], k=np.arange(1, _NEIGHBOURS + 1), distance_upper_bound=_NEAR
        )
        there = np.isfinite(distance)
        near = np.append(shape, "")[place]
        count[mine] = there.sum(axis=1)
        for k, value in enumerate(_PITCHED):
            pitched[mine, k] = (near == value).sum(axis=1)
        # Other pitched shapes say that roofs are pitched here, not how.
        others = there & ~np.isin(near, [*_PITCHED, "flat"])
        pitched[mine, 0] += others.sum(axis=1)
    return _NearRoofs(count, pitched)
