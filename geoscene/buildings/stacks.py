"""Stacked building parts: close the holes and slits that rounded heights leave under them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from geoscene.buildings.footprints import Polygons, subtract
from geoscene.buildings.resolve import BuildingHeights, BuildingRow
from geoscene.buildings.table import GRID
from geoscene.support.problems import Problem

_SLIT = 0.3
"""Metres between a part's top and the underside of one above it that count as no gap; assumed, far below a
storey."""

_SUPPORT = 0.01
"""Square metres; parts that share less in plan do not stand on one another."""


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
