"""Heights of buildings: from tags, inferred from levels and neighbours, and as measured in point clouds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geoscene.buildings.appearance import read_roof_tags
from geoscene.buildings.table import BuildingOptions, Buildings
from geoscene.sources.data import Tags
from geoscene.tags import Quantities, parse_length, parse_number
from geoscene.typing import Float

HIGHEST, LOWEST = 1000.0, -50.0
"""Tops above and undersides below are treated as typing errors, metres; the tallest building has 828 m, the
depth is assumed."""

THINNEST = 0.01
"""Least metres between underside and top; a thinner body is tagged by mistake."""

_MOST_LEVELS, _MOST_ROOF_LEVELS, _HIGHEST_ROOF = 200.0, 20.0, 300.0
"""Greater numbers of storeys and heights of roofs are treated as typing errors. The tallest building has 163
storeys below a spire of 244 m; storeys in a roof are assumed."""

_TYPICAL: dict[str, tuple[float, float]] = {
    # height in metres of a building of 200 m2, and how it grows: the exponent of area / 200 m2
    "house": (7.0, 0.10), "detached": (7.0, 0.10), "semidetached_house": (7.5, 0.05), "terrace": (8.0, 0.05),
    "bungalow": (4.5, 0.05),
    "residential": (9.5, 0.12), "apartments": (14.0, 0.12), "dormitory": (13.0, 0.12),
    "farm": (7.0, 0.05), "cabin": (3.5, 0.05), "static_caravan": (3.0, 0.0), "houseboat": (4.0, 0.0),
    "garage": (2.8, 0.05), "garages": (2.8, 0.0), "carport": (2.8, 0.0), "shed": (2.6, 0.05),
    "hut": (2.8, 0.05),
    "roof": (4.5, 0.05), "kiosk": (3.0, 0.0), "toilets": (3.0, 0.0), "greenhouse": (3.5, 0.05),
    "service": (3.2, 0.1), "transformer_tower": (8.0, 0.0), "barn": (7.0, 0.08), "stable": (4.5, 0.08),
    "farm_auxiliary": (5.0, 0.08), "industrial": (7.5, 0.08), "warehouse": (8.0, 0.08), "hangar": (10.0, 0.1),
    "manufacture": (8.0, 0.08), "retail": (6.0, 0.1), "supermarket": (6.0, 0.02), "commercial": (11.0, 0.15),
    "office": (16.0, 0.15), "hotel": (17.0, 0.15), "hospital": (13.0, 0.12), "school": (9.5, 0.08),
    "kindergarten": (4.5, 0.05), "university": (13.0, 0.1), "college": (12.0, 0.1), "public": (10.0, 0.1),
    "government": (13.0, 0.1), "civic": (10.0, 0.1), "parking": (11.0, 0.05), "train_station": (9.0, 0.05),
    "church": (13.0, 0.2), "cathedral": (22.0, 0.2), "chapel": (7.0, 0.2), "mosque": (11.0, 0.15),
    "tower": (20.0, 0.15), "bell_tower": (25.0, 0.15), "water_tower": (25.0, 0.1), "chimney": (30.0, 0.1),
    "silo": (15.0, 0.1), "storage_tank": (10.0, 0.1), "lighthouse": (20.0, 0.1), "windmill": (15.0, 0.05),
    "synagogue": (11.0, 0.15), "temple": (10.0, 0.15), "stadium": (18.0, 0.1), "sports_hall": (9.0, 0.05),
}  # fmt: skip
"""Assumed from usual storeys by use; known heights of neighbours correct them (`infer_heights`)."""

_TYPICAL_OTHER = (9.5, 0.33)
"""Fitted by least squares of logarithms to building=yes with heights in Heidelberg, Monaco, Moscow, Berlin,
Baltimore, New York and Helsinki, each city with the same weight; standard deviation of the residuals 0.62."""

CLOUD_ROOF = "cloud:roof"
"""Tag of a roof that was measured in a point cloud."""

CLOUD_SIGMA = "cloud:height_sigma"
"""Tag of a height that was measured in a point cloud: its standard deviation in metres."""

CLOUD_TOP = "cloud:top"
"""Tag of a height that was measured in a point cloud: z of the top, metres in the datum of the scene."""

SIGMA_TAG, SIGMA_EST, SIGMA_STOREYS = 0.5, 0.2, 0.15
"""Assumed standard deviations: metres for a tagged height, shares of it for est_height and storeys."""

SIGMA_PRIOR = 0.6
"""Standard deviation of ln(height / typical height) without neighbours."""

_PSEUDO = 0.05
"""Least weight of the pseudo-neighbour of `infer_heights`."""

_FAR = 0.005
"""Weight of a far neighbour of equal size in `infer_heights`."""

_SLENDER = 4.0
"""Height over the root of the footprint's area from which a building is a tower, a mast or a chimney and does
not inform its neighbours' heights: so are 0.5 % of the 2,184 known heights in eight cities."""

_STOUT = 3.0
"""The same ratio that no inferred height exceeds, unless the typical one does: 1.2 % of the known ones do."""

_LANDMARKS = (
    "tower", "bell_tower", "campanile", "minaret", "water_tower", "transformer_tower", "chimney", "silo",
    "storage_tank", "monument", "column", "obelisk", "lighthouse", "windmill", "church", "cathedral",
    "mosque", "temple", "stadium",
)  # fmt: skip
"""Uses whose heights say nothing about those of other uses nearby, and the other way round."""


@dataclass(frozen=True, slots=True)
class Tagged:
    """Tagged heights of one building or part, metres; NaN if not tagged.

    height   : top above base, roof included
    source   : cloud, tag, est_height, levels or ""
    sigma    : metres
    minimum  : underside above base
    minimum_source : tag, levels or ""
    roof     : height of the roof
    roof_source : cloud, tag, levels or ""
    levels   : storeys above ground, without those in the roof
    ignored  : tags whose values cannot be used, with the reasons
    """

    height: float
    source: str
    sigma: float
    minimum: float
    minimum_source: str
    roof: float
    roof_source: str
    levels: float
    ignored: tuple[str, ...]


def read_heights(tags: Tags, *, options: BuildingOptions) -> Tagged:
    """Tagged heights: ``height``, else ``building:height``, ``est_height`` or ``building:levels``.

    A height by storeys is storeys x level height, plus the roof's height or storeys (Simple 3D Buildings:
    building:levels leaves out the storeys of the roof). Storeys count from the ground, with those that
    building:min_level skips: as many as are skipped leave the roof alone. Of a part without a roof, or with
    fewer storeys than it skips, they count from its underside. A storey is as high as the tagged heights make
    it (``height`` without ``roof:height``, else ``min_height``).

    Ignored are values that are no lengths or numbers, tops below 1 cm or above 1,000 m, undersides below
    -50 m, more than 200 storeys, and roofs of more than 300 m or 20 storeys.
    """
    read = Quantities(tags)
    levels = read.first("building:levels", "levels", parse=parse_number, low=0, high=_MOST_LEVELS)
    roof_levels = read.first("roof:levels", parse=parse_number, low=0, high=_MOST_ROOF_LEVELS)
    roof = read.first("roof:height", "building:roof:height", parse=parse_length, low=0, high=_HIGHEST_ROOF)
    roof_source = ("cloud" if CLOUD_ROOF in tags else "tag") if np.isfinite(roof) else ""
    height, source, sigma = _tagged_height(read)

    minimum = read.first(
        "min_height", "building:min_height", parse=parse_length, low=LOWEST, high=HIGHEST - THINNEST
    )
    minimum_source = "tag" if np.isfinite(minimum) else ""
    skipped = read.first("building:min_level", "min_level", parse=parse_number, low=0, high=_MOST_LEVELS)

    walls, storeys = height, levels + np.nan_to_num(roof_levels)
    if np.isfinite(roof):
        walls, storeys = height - roof, levels
    step = options.level_height  # storey height of this building
    if np.isfinite(walls) and storeys > 0:
        step = float(np.clip(walls / storeys, 2.0, 6.0))
    elif minimum > 0 and skipped > 0:
        step = float(np.clip(minimum / skipped, 2.0, 6.0))
    if not np.isfinite(roof) and roof_levels > 0:
        roof, roof_source = roof_levels * step, "levels"
    if not minimum_source and np.isfinite(skipped):
        minimum, minimum_source = skipped * step, "levels"
    if not np.isfinite(height) and (levels > 0 or roof_levels > 0):
        body = float(np.nan_to_num(levels)) * step
        if body < minimum + THINNEST:
            roofed = roof > 0 or read_roof_tags(tags).shape != "flat"
            body = minimum if levels == skipped and roofed else body + minimum
        height = body + float(np.nan_to_num(roof))
        source, sigma = "levels", max(SIGMA_STOREYS * height, 1.0)
    elif not np.isfinite(height) and levels == 0:
        read.refused.append("building:levels=0 gives no height")
    return Tagged(
        height, source, sigma, minimum, minimum_source, roof, roof_source, levels, tuple(read.refused)
    )


def _tagged_height(read: Quantities) -> tuple[float, str, float]:
    """Height in metres, source and standard deviation of a tagged height; NaN and "" without one."""
    height = read.first("height", "building:height", parse=parse_length, low=THINNEST, high=HIGHEST)
    if np.isfinite(height) and CLOUD_SIGMA in read.tags:
        return height, "cloud", read.first(CLOUD_SIGMA, parse=parse_number)
    if np.isfinite(height):
        return height, "tag", SIGMA_TAG
    height = read.first("est_height", parse=parse_length, low=THINNEST, high=HIGHEST)
    return height, "est_height" if np.isfinite(height) else "", SIGMA_EST * height


def typical_height(use: NDArray[np.object_], area: Float) -> Float:
    """Typical heights (n,) in metres by use and footprint area in square metres."""
    table = np.array([_TYPICAL.get(u, _TYPICAL_OTHER) for u in use], float).reshape(-1, 2)
    growth = table[:, 1] * np.log(np.clip(area, 20.0, 2000.0) / 200.0)
    return np.asarray(table[:, 0] * np.exp(growth), float)


def infer_heights(
    xy: Float, use: NDArray[np.object_], *, area: Float, height: Float, reach: float = 400.0
) -> tuple[Float, Float, NDArray[np.object_]]:
    """Heights (n,), their standard deviations (n,) and the rule (n,), from the buildings with heights.

    The rule: a building's height is the typical height of its use and footprint area, times a factor. The
    factor is the weighted median of the factors of the 24 nearest buildings with known heights within reach
    (not itself) and of one pseudo-neighbour of factor 1. A neighbour weighs (exp(-distance / 40 m) + 0.005)
    exp(-|ln(ratio of areas)|), four times that for the same use; the pseudo-neighbour weighs as much as their
    mean plus 0.05, so that one neighbour alone counts half. Not counted are towers, at least four times as
    high as the square root of their footprint's area, and landmarks for or among other uses. The result is at
    most three times that root, or the typical height. The standard deviation is that of the neighbours'
    logarithms about the median, the pseudo-neighbour's being 0.6. The constants were chosen by trial on eight
    cities, each building guessed from others. Rule names: ``inferred-neighbours`` where a neighbour counts,
    else ``inferred-type``.

    xy     : (n, 2) scene metres, any point of each building
    area   : (n,) square metres
    height : (n,) metres, NaN where unknown
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    typical = typical_height(use, area)
    rule = np.full(len(xy), "inferred-type", dtype=object)
    with np.errstate(invalid="ignore"):
        known = np.flatnonzero(height < _SLENDER * np.sqrt(area))
    if not len(known):
        return typical, SIGMA_PRIOR * typical, rule
    excess = np.log(height[known] / typical[known])
    k = min(25, len(known))
    distance, near = cKDTree(xy[known]).query(xy, k=k, distance_upper_bound=reach)
    distance, near = distance.reshape(len(xy), k), near.reshape(len(xy), k)
    there = np.isfinite(distance)
    near = np.where(there, near, 0)
    same = use[known][near] == use[:, None]
    landmark = np.isin(use, _LANDMARKS)
    there &= same | ~(landmark[known][near] | landmark[:, None])
    there &= known[near] != np.arange(len(xy))[:, None]
    ratio = np.abs(np.log(np.maximum(area[known][near], 1.0) / np.maximum(area, 1.0)[:, None]))
    weight = there * (np.exp(-np.where(there, distance, 0.0) / 40.0) + _FAR) * np.exp(-ratio)
    weight *= np.where(same, 4.0, 1.0)
    pseudo = _PSEUDO + weight.sum(axis=1) / np.maximum(there.sum(axis=1), 1)
    weight = np.column_stack((weight, pseudo))
    factor = np.column_stack((excess[near], np.zeros(len(xy))))
    middle = _weighted_median(factor, weight)
    square = np.square(factor - middle[:, None])
    square[:, -1] += SIGMA_PRIOR**2
    sigma = np.sqrt((weight * square).sum(axis=1) / weight.sum(axis=1))
    rule[there.any(axis=1)] = "inferred-neighbours"
    inferred = np.minimum(typical * np.exp(middle), np.maximum(_STOUT * np.sqrt(area), typical))
    return inferred, inferred * sigma, rule


def _weighted_median(values: Float, weight: Float) -> Float:
    """Weighted median of each row, interpolated between the midpoints of the sorted values' weights."""
    values = np.where(weight > 0, values, np.inf)  # sorted to the end
    order = np.argsort(values, axis=1, kind="stable")
    values, weight = (np.take_along_axis(a, order, axis=1) for a in (values, weight))
    middle = (np.cumsum(weight, axis=1) - weight / 2) / weight.sum(axis=1, keepdims=True)
    low = np.maximum((middle <= 0.5).sum(axis=1) - 1, 0)
    high = np.minimum(low + 1, values.shape[1] - 1)
    rows = np.arange(len(values))
    high = np.where(np.isfinite(values[rows, high]), high, low)
    gap = middle[rows, high] - middle[rows, low]
    part = np.clip(np.divide(0.5 - middle[rows, low], gap, out=np.zeros(len(rows)), where=gap > 0), 0, 1)
    median: Float = values[rows, low] + part * (values[rows, high] - values[rows, low])
    return median


def with_measured_tops(buildings: Buildings, base: Float) -> Buildings:
    """Buildings whose measured tops lie at their heights z, on the base that the graded ground gives them.

    A cloud tells how high a roof lies, not where the base does: grading moves the ground along the outline.
    Bodies that stand on others of the same building move with them, so that none overlap and no slit opens.

    base : (count,) z in metres of each building's base, NaN for buildings that are not looked at
    """
    stands = base[buildings.outline]
    measured = np.isfinite(buildings.top) & np.isfinite(stands)
    if not measured.any():
        return buildings
    moved = np.zeros(buildings.count)
    row = np.flatnonzero(measured)[::-1]  # of several parts the first decides; all have the same base
    moved[buildings.outline[row]] = buildings.top[row] - stands[row] - buildings.height[row]
    by = moved[buildings.outline]
    raised = buildings.min_height > 0
    low = buildings.min_height + np.where(raised, by, 0.0)
    high = buildings.height + np.where(raised | measured, by, 0.0)
    high = np.clip(high, low + THINNEST, HIGHEST)
    return replace(
        buildings, min_height=low, height=high, roof_height=np.minimum(buildings.roof_height, high - low)
    )
